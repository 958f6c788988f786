"""The built wheel, installed with its extras into a new environment, away from the source code."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

SOURCES = ("kslc_jax", "pyproject.toml", "README.md", "LICENSE", "NOTICE")

TRAINED = ("--preset", "debug", "--run-dir")
SHORT = ("--speeds", "1", "--seeds", "1", "--seconds", "3")

pytestmark = pytest.mark.slow  # builds a wheel and installs JAX: takes minutes and a network


def run(*command: object, cwd: Path) -> str:
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = list(map(str, command))
    done = subprocess.run(
        words, cwd=cwd, env=env, capture_output=True, text=True, timeout=1500, check=False
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    for name in SOURCES:  # a copy, because the build leaves folders beside the sources
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    run(sys.executable, "-m", "pip", "wheel", ".", "--no-deps", "-q", "-w", "out", cwd=folder)
    (built,) = (folder / "out").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def python(wheel, tmp_path_factory) -> Path:
    """The Python of an environment with the wheel. The package in it is read-only."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", folder, cwd=folder)
    python = folder / "bin" / "python"
    what = f"{wheel}[video,export,viewer]"
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", what, cwd=folder)
    installed = package(python, folder)
    run(python, "-m", "compileall", "-q", installed, cwd=folder)
    for path in (installed, *installed.rglob("*")):
        path.chmod(path.stat().st_mode & ~0o222)
    return python


def package(python: Path, cwd: Path) -> Path:
    code = "import kslc_jax; print(kslc_jax.__path__[0])"
    return Path(run(python, "-c", code, cwd=cwd).strip())


def test_everything_is_in_the_wheel(wheel):
    """Every module of every subpackage, the models of the robots, and the shipped policies."""
    kept = {f"kslc_jax/{p.relative_to(ROOT / 'kslc_jax')}" for p in files_of(ROOT / "kslc_jax")}
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.startswith("kslc_jax/")}
    assert packed == kept
    assert "kslc_jax/robots/xbot_l.xml" in packed


def files_of(folder: Path) -> list[Path]:
    return [p for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts]


def test_commands_run_from_an_installed_package(python, tmp_path):
    """No command writes into the package. The times are compared, because root may always write."""
    installed = package(python, tmp_path)
    assert ROOT not in installed.parents
    before = {path: path.stat().st_mtime_ns for path in installed.rglob("*")}

    def command(name: str, *args: object) -> str:
        return run(python, "-m", f"kslc_jax.{name}", *args, cwd=tmp_path)

    assert "done: 8 train steps" in command("train", *TRAINED, "r")
    assert "r, train step 8, train fidelity" in command("evaluate", "r", *SHORT)
    assert "xbot_l_run, train step" in command("sim2sim", "xbot_l_run", *SHORT)
    assert "equals JAX" in command("export", "xbot_l_run", "policy.onnx")
    assert "python -m kslc_jax.play" in command("play", "--help")
    assert {path: path.stat().st_mtime_ns for path in installed.rglob("*")} == before
