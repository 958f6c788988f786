"""The documents: links have a target, names exist, the index lists every page."""

import ast
import importlib.util
import json
import re
import subprocess
from pathlib import Path

import pytest
from states import XBOT

import kslc_jax
from kslc_jax import observations
from kslc_jax.config import preset

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md"), *(ROOT / "kslc_jax").rglob("*.md")])
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def prose(path: Path) -> str:
    """The text of a page or of a notebook, without fenced code."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)


def anchors(path: Path) -> set[str]:
    """The anchors that GitHub makes from the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.M)
    kept = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in kept}


def broken_links(path: Path) -> list[str]:
    """The relative links of a page that have no target."""
    links = re.findall(r"\]\(([^)\s]+)\)", prose(path))
    broken = []
    for link in (link for link in links if not re.match(r"[a-z]+:", link)):
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


@pytest.mark.parametrize("path", PAGES + NOTEBOOKS, ids=lambda path: path.name)
def test_links_lead_somewhere(path):
    assert broken_links(path) == []


def test_a_broken_link_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A head-line, *bold*\n[a](#a-head-line-bold) [b](none.md) [c](page.md#no)")
    assert broken_links(page) == ["none.md", "page.md#no"]


def test_every_page_is_listed():
    listed = set(re.findall(r"^- \[[^\]]*\]\((\w+\.md)\)", (DOCS / "index.md").read_text(), re.M))
    assert listed == {path.name for path in DOCS.glob("*.md")} - {"index.md"}


def test_pages_named_in_code_exist():
    code = [*ROOT.glob("kslc_jax/**/*.py"), *ROOT.glob("kslc_jax/**/*.xml"), ROOT / "Makefile"]
    code += [*ROOT.glob("benchmarks/*.py"), *ROOT.glob("examples/*.py"), *ROOT.glob("tests/*.py")]
    named = {name for path in code for name in re.findall(r"docs/\w+\.md", path.read_text())}
    assert named and [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_tests_named_in_documents_exist():
    defined = {path.stem for path in ROOT.glob("tests/*.py")}
    for path in ROOT.glob("tests/*.py"):
        defined |= set(re.findall(r"^\s*(?:def|class) (test_\w+|Test\w+)", path.read_text(), re.M))
    named = {
        name for path in PAGES for name in re.findall(r"\b(test_\w+|Test[A-Z]\w+)", prose(path))
    }
    assert len(named) > 50 and sorted(named - defined) == []


def test_the_film_comes_first_and_is_small():
    readme = (ROOT / "README.md").read_text().splitlines()
    film = re.fullmatch(r"!\[.+\]\((docs/media/\w+\.webp)\)", readme[2])
    assert film and (ROOT / film[1]).stat().st_size < 3_000_000
    assert len(readme) <= 150
    assert f"--video {film[1]}" in (DOCS / "results.md").read_text()


def test_the_citation_has_the_packages_version():
    assert f"\nversion: {kslc_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()


HOMES = ("home", "Users", "root", "tmp", "work", "workspace", "mnt", "scratch", "private")
HOMES += ("data", "opt", "srv", "gpfs", "lustre")
"""Folders under / in which people and machines work."""


def absolute_paths(content: bytes) -> list[bytes]:
    """Paths below one of `HOMES` that stand in a file."""
    return re.findall(rb"(?<![\w.~/-])/(?:%s)/[\w.-]+" % "|".join(HOMES).encode(), content)


def test_no_file_names_a_folder_of_somebodys_machine():
    """Results and stored policies name runs."""
    try:
        listed = subprocess.run(
            ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not in a git checkout")
    names = [name for name in listed.stdout.decode().split("\0") if name]
    found = {name: absolute_paths((ROOT / name).read_bytes()) for name in names}
    assert len(found) > 100 and {name: paths for name, paths in found.items() if paths} == {}


def test_a_folder_of_somebodys_machine_is_found():
    folder = "/".join(["", "home", "me", "runs"])
    assert absolute_paths(f'{{"policy": "{folder}"}}'.encode()) == [b"/home/" + b"me"]
    assert absolute_paths(b"runs/tmp/x https://example.org/home/x") == []


CODE = r"^```python$(.*?)^```$"


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_what_documents_name_in_the_code_exists(path):
    """Places such as `env.py:step`, and the imports of code blocks."""
    named = re.findall(r"`((?:\w+/)*\w+\.py):([A-Za-z]\w*)`", path.read_text())
    ours = [(ROOT / "kslc_jax" / file, name) for file, name in named if "test_" not in file]
    for file, name in ours:
        assert re.search(rf"^\s*(def|class) {name}\b|^{name}\b", file.read_text(), re.M), (
            file,
            name,
        )
    for block in re.findall(CODE, path.read_text(), re.M | re.S):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("kslc_jax"):
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    whole = f"{node.module}.{alias.name}"
                    assert hasattr(module, alias.name) or importlib.util.find_spec(whole), whole


def test_the_readme_has_a_place_for_every_module():
    text = (ROOT / "README.md").read_text()
    for path in (ROOT / "kslc_jax").iterdir():
        name = path.name if path.is_dir() else path.stem
        if not name.startswith("__"):
            assert any(f"`{x}`" in text for x in (name, f"{name}.py", f"{name}/")), name


def test_the_drawing_of_a_train_step_has_the_laptop_presets_sizes():
    text = (ROOT / "docs" / "train_step.svg").read_text()
    laptop = preset("laptop")
    actor = sum(c.width for c in observations.actor_table(XBOT))
    critic = sum(c.width for c in observations.critic_table(XBOT, laptop.env.critic_memory))
    assert f"[N, {actor}]" in text and f"[B, K, {actor}]" in text
    assert f"[N, {critic}]" in text and f"[B, Kp, {critic}]" in text
    assert f"{laptop.ppo.epochs} epochs x {laptop.ppo.minibatches} minibatches" in text
    assert f"B = {laptop.minibatch_size:,} samples" in text
