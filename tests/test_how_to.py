"""The recipes of docs/how_to.md: each runs as written, but with tiny sizes."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "how_to.md").read_text()

TINY = {
    '"laptop"': '"debug"',
    "--preset laptop": "--preset debug",
    "--env.num-envs 4096 --ppo.minibatches 8": "--env.num-envs 32 --ppo.minibatches 4",
    "--steps 80000000": "--steps 2048",
    "--speeds 1 2 --seeds 8 --seconds 20": "--speeds 1 --seeds 1 --seconds 3",
    "--seconds 10": "--seconds 1",
}
"""Text in a snippet, and the text that the test runs in its place."""

CHANGES = ("Add a reward", "Add an observation")
"""Recipes that change the source code."""

QUICK = ("It only stands: what now?", "Run a policy in your own loop")
SLOW = {
    "Train a variant of the robot": "a training",
    "Use the environment with another learner": "compiles an environment step",
    "Change the speed range": "two trainings",
    "Train on uneven ground": "a training, and trials in C MuJoCo",
    "Use more environments on a GPU": "a training",
    "Stop and resume": "two trainings go on",
    "Start from a trained policy": "a training",
    "Try a policy under other conditions": "trials in C MuJoCo",
    "Deploy the ONNX file": "exports, compares and runs a policy",
}


def recipes() -> dict[str, list[tuple[str, str]]]:
    """(language, text) of the fenced blocks of each section."""
    _, *sections = PAGE.split("\n## ")
    fence = re.compile(r"^```(\w+)\n(.*?)^```$", re.M | re.S)
    return {section.split("\n", 1)[0]: fence.findall(section) for section in sections}


def tiny(text: str) -> str:
    for said, done in TINY.items():
        text = text.replace(said, done)
    return text


def environment(package: Path) -> dict[str, str]:
    """Environment of a child: `python` is this interpreter; it imports the code in `package`."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return {**os.environ, "PATH": path, "PYTHONPATH": str(package), "JAX_PLATFORMS": "cpu"}


def shell(command: list[str], cwd: Path, package: Path) -> str:
    """Runs a child, whose exit code must be 0; returns its stdout."""
    done = subprocess.run(
        command, cwd=cwd, env=environment(package), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def change(text: str, root: Path) -> None:
    """Applies a diff. "+++ FILE" names the file, and "@@" separates two places in it. The old lines
    of each place must occur exactly once in the file."""
    for part in re.split(r"^\+\+\+ ", text, flags=re.M)[1:]:
        name, body = part.split("\n", 1)
        file = root / name
        for hunk in re.split(r"^@@\n", body, flags=re.M):
            lines = hunk.splitlines(keepends=True)
            old = "".join(line[1:] for line in lines if line[0] != "+")
            new = "".join(line[1:] for line in lines if line[0] != "-")
            assert file.read_text().count(old) == 1, f"{name}: not there once:\n{old}"
            file.write_text(file.read_text().replace(old, new))


def test_every_recipe_is_listed_and_executed():
    listed = re.findall(r"^- \[(.*)\]\(#", PAGE, re.M)
    assert listed == list(recipes())
    assert set(listed) == {*CHANGES, *QUICK, *SLOW}
    lengths = {
        name: len(part.splitlines())
        for name, part in zip(recipes(), PAGE.split("\n## ")[1:], strict=True)
    }
    assert max(lengths.values()) <= 40, lengths
    for said in TINY:
        assert said in PAGE, f"{said!r} stands in no recipe"


def test_changes_of_the_code(tmp_path):
    """All changes go into one copy of the package, and the new tests run in it."""
    shutil.copytree(ROOT / "kslc_jax", tmp_path / "kslc_jax", symlinks=True)
    shutil.copytree(ROOT / "tests", tmp_path / "tests", ignore=shutil.ignore_patterns("data"))
    blocks = [block for name in CHANGES for block in recipes()[name]]
    for text in (text for language, text in blocks if language == "diff"):
        change(text, tmp_path)
    tests = ["tests/test_rewards.py", "tests/test_observations.py"]
    chosen = "arm_torques or one_to_one or has_a_case or humanoid_gyms or feels_the_feet"
    program = "import sys, pytest\n"
    program += (
        f"sys.exit(pytest.main([*{tests}, '-q', '-p', 'no:cacheprovider', '-k', {chosen!r}]))"
    )
    said = shell([sys.executable, "-c", program], tmp_path, tmp_path)
    assert re.search(r"^8 passed", said, re.M), said


def execute(name: str, folder: Path, monkeypatch) -> None:
    """Runs the blocks of a recipe in order: sh in a child, python in this process."""
    monkeypatch.chdir(folder)
    for language, text in recipes()[name]:
        if language == "sh":
            shell(["bash", "-e", "-c", tiny(text)], folder, ROOT)
        else:
            exec(compile(tiny(text), f"how_to.md: {name}", "exec"), {})


@pytest.mark.parametrize("name", QUICK)
def test_quick_recipes(name, tmp_path, monkeypatch, capsys):
    run = tmp_path / "runs" / "laptop-seed0"
    run.mkdir(parents=True)
    shutil.copy(ROOT / "docs" / "training" / "xbot_l_run.jsonl", run / "metrics.jsonl")
    execute(name, tmp_path, monkeypatch)
    said = capsys.readouterr().out
    if name == QUICK[0]:
        assert "curriculum/v_max     4.50\n" in said and "episode_steps        2" in said
    else:
        assert len(said.replace("[", " ").replace("]", " ").split()) == 16


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A folder with a training of the debug preset in runs/laptop-seed0."""
    folder = tmp_path_factory.mktemp("trained")
    train = "python -m kslc_jax.train --preset debug --run-dir runs/laptop-seed0"
    shell(["bash", "-c", train], folder, ROOT)
    (folder / "examples").symlink_to(ROOT / "examples")
    return folder


@pytest.mark.slow(reason="some twenty seconds each: trainings, trials and an export")
@pytest.mark.parametrize("name", SLOW)
def test_recipes(name, trained, monkeypatch, capsys):
    execute(name, trained, monkeypatch)
    if "variant" in name:
        assert capsys.readouterr().out.startswith("250.0\n")
