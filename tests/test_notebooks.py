"""The notebooks: the stored files are tidy, and they run from top to bottom in their short mode."""

import math
import re
import shutil
from pathlib import Path

import nbclient
import nbformat
import pytest

from kslc_jax import records, rewards
from kslc_jax.robots import description

ROOT = Path(__file__).parents[1]
NAMES = ("01_quickstart", "02_train_and_evaluate", "03_rewards_and_curriculum", "04_own_robot")

MOST_BYTES = 1_000_000
MOST_LINES = 16
"""Limit for a cell: a notebook calls the package and has no logic of its own."""


def read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [out for cell in notebook.cells for out in cell.get("outputs", ())]


def text(notebook: nbformat.NotebookNode) -> str:
    """The text output of all cells."""
    parts = [
        out.get("text") or out.get("data", {}).get("text/plain", "") for out in outputs(notebook)
    ]
    return "\n".join(parts)


def pictures(notebook: nbformat.NotebookNode) -> int:
    return sum("image/png" in out.get("data", {}) for out in outputs(notebook))


@pytest.fixture
def execute(tmp_path, monkeypatch):
    """Runs a notebook in its short mode, on the CPU, in a temporary folder with `docs`."""
    monkeypatch.setenv("KSLC_SHORT", "1")
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)

    def run(name: str) -> nbformat.NotebookNode:
        where = {"metadata": {"path": str(tmp_path / "notebooks")}}
        notebook = read(name)
        return nbclient.NotebookClient(notebook, timeout=600, resources=where).execute()

    return run


@pytest.mark.parametrize("name", NAMES)
def test_stored_as_run(name):
    """Cells are short and ran in order without an error. The file has pictures and is small."""
    notebook = read(name)
    nbformat.validate(notebook)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert max(len(cell.source.splitlines()) for cell in cells) <= MOST_LINES
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert not [out for out in outputs(notebook) if out.output_type == "error"]
    assert pictures(notebook) >= 2
    assert str(ROOT) not in nbformat.writes(notebook)
    assert (ROOT / "notebooks" / f"{name}.ipynb").stat().st_size < MOST_BYTES


@pytest.mark.slow(reason="a minute: renders a video and compiles a train step")
def test_quickstart(execute):
    """Three updates with finite rewards. There are a strip and a curve, or a line that says why
    there is no strip."""
    notebook = execute("01_quickstart")
    rewards = [float(x) for x in re.findall(r"update .* reward (-?[\d.]+)", text(notebook))]
    assert len(rewards) == 3 and all(map(math.isfinite, rewards))
    drawn = "no pictures here" not in text(notebook)
    assert pictures(notebook) == 1 + drawn
    assert ("video/mp4" in nbformat.writes(notebook)) == drawn


@pytest.mark.slow(reason="starts a kernel")
def test_quickstart_where_nothing_can_be_drawn(tmp_path, monkeypatch):
    """If GL is installed but does not work, the notebook prints a line and does not fail."""
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "nonsense")
    notebook = read("01_quickstart")
    notebook.cells = [cell for cell in notebook.cells if "import render" in cell.source]
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=600, resources=where).execute()
    assert text(notebook).startswith("no pictures here: MUJOCO_GL=osmesa does not work here")


@pytest.mark.slow(reason="a minute: two trainings, and trials of a policy")
def test_train_and_evaluate(execute, tmp_path):
    """The second training resumes the first one. The table has a row per speed."""
    notebook = execute("02_train_and_evaluate")
    assert "no GPU: on one" in text(notebook)
    assert "resumed at train step 4" in text(notebook)
    metrics = records.read_metrics(tmp_path / "runs" / "notebook-debug")
    assert list(metrics["step"]) == list(range(1, 9))
    assert re.search(r"│\s+1\.0 │.*\n│\s+2\.0 │", text(notebook))
    assert pictures(notebook) == 3


@pytest.mark.slow(reason="a quarter of a minute")
def test_rewards_and_curriculum(execute):
    """The printed numbers equal the formulas worked out by hand."""
    notebook = execute("03_rewards_and_curriculum")
    printed, read = -math.exp(5.0), 1.0 - math.exp(1.0)
    assert f"printed {printed:.1f}, as read {read:.3f}" in text(notebook)
    for v in (0.5, 1.0, 2.0, 3.5):
        value = math.exp(-5.0 * v**2)
        line = f"commanded {v:.1f} m/s: reward {value:.1e}, slope {10.0 * v * value:.1e}"
        assert line in text(notebook)
    stored = records.read_metrics(ROOT / "docs" / "training" / "xbot_l_run.jsonl")
    assert len(re.findall("^v_max .* m/s from", text(notebook), re.M)) == len(
        records.milestones(stored)
    )
    assert pictures(notebook) == 13


@pytest.mark.slow(reason="a minute: a training, and the doctor twice")
def test_own_robot(execute, tmp_path, monkeypatch):
    """The tests' biped in place of the G1, which may need a download. Stiff ankles are found."""
    monkeypatch.setenv("KSLC_ROBOT", str(ROOT / "tests" / "data" / "biped.toml"))
    notebook = execute("04_own_robot")
    said = text(notebook)
    assert "nothing looks wrong" in said and "soften them" in said
    assert re.search(r"gait.cycle_time +XBot-L +0.64 +biped +0.52", said)
    assert pictures(notebook) == 2
    metrics = records.read_metrics(tmp_path / "runs" / "notebook-own-robot")
    assert list(metrics["step"]) == [1, 2, 3, 4]


def test_the_notebook_adds_a_motor_to_any_description(tmp_path):
    """Also to one that ends in another table."""
    data = ROOT / "tests" / "data"
    (tmp_path / "biped.xml").write_text((data / "biped.xml").read_text())
    mine = tmp_path / "biped.toml"
    mine.write_text((data / "biped.toml").read_text() + '[config]\n"gait.arm_swing" = 0.1')
    (cell,) = (c for c in read("04_own_robot").cells if '"stiff.toml"' in c.source)
    code = "\n".join(line for line in cell.source.splitlines() if not line.startswith("!"))
    exec(code, {"ROBOT": str(mine), "PICTURES": tmp_path, "about": description.read(str(mine))})
    stiff = description.read(str(tmp_path / "stiff.toml"))
    assert stiff.motors[-1] == ("port_rudder|star_rudder", description.Motor(kp=24.0))
    assert stiff.config == (("gait.arm_swing", 0.1),)


def test_the_reward_terms_shown_are_there_and_told():
    """The notebook plots each of the paper's four terms alone. The other terms share figures, and
    each has a sentence."""
    cells = read("03_rewards_and_curriculum").cells
    code, prose = (
        "\n".join(cell.source for cell in cells if cell.cell_type == kind)
        for kind in ("code", "markdown")
    )
    papers = {"angular_momentum", "base_height", "feet_clearance", "joint_pos"}
    assert all(f"reward(rewards.{name}, " in code for name in papers)
    others = re.findall(r'^    \("(\w+)", ', code, re.M)
    assert others and set(others) <= set(rewards.TERMS) - papers
    assert all(f"\n- `{name}`: " in prose for name in others)


@pytest.mark.slow(reason="starts a kernel")
def test_without_a_checkout_the_address_is_asked_for(tmp_path, monkeypatch):
    """The error asks for the address, instead of git's error about a missing repository. All
    notebooks have the same cell."""
    monkeypatch.delenv("KSLC_REPO", raising=False)
    first, *others = (
        [cell for cell in read(name).cells if "git clone" in cell.source] for name in NAMES
    )
    assert [[cell.source for cell in cells] for cells in others] == [[first[0].source]] * 3
    notebook = nbformat.v4.new_notebook(cells=first)
    client = nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}})
    with pytest.raises(nbclient.exceptions.CellExecutionError) as error:
        client.execute()
    assert error.value.evalue == "write the address of your copy of kslc_jax into URL, in this cell"
