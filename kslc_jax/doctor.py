"""Checks this machine or a robot, and replays a failed training.

python -m kslc_jax.doctor checks versions, devices, both physics engines against each other, the
renderer, disk, cache and cores, and says how to fix what fails; exit code 1 if something does.
python -m kslc_jax.doctor robot NAME reads the description of a robot (docs/own_robot.md), shows
what follows from it as tables and as a picture, lets the robot stand without a policy, and says
what looks wrong and which field to change; exit code 0 also then, 2 if the robot cannot be used.
python -m kslc_jax.doctor replay DUMP steps the state that a failed training left (bad_state.npz in
its run folder) again, and shows where the first non-finite number appears.
"""

import importlib.metadata
import math
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.table import Table

from kslc_jax import cli, files, processors, runtime
from kslc_jax.config import ConfigError, preset

PYTHONS = ((3, 11), (3, 13))
"""Oldest and newest Python this is tested with."""

TESTED = " to ".join(f"{major}.{minor}" for major, minor in PYTHONS)

FREE_DISK = 2.0
"""Free space [GiB] for run folders and the compilation cache."""


@dataclass(frozen=True)
class Check:
    """Check this machine."""


@dataclass(frozen=True)
class Robot:
    """Show what follows from a robot's description, and what looks wrong with it."""

    name: tyro.conf.Positional[str]
    """A shipped robot, such as unitree_g1, or the path of a description, such as my/robot.toml."""
    picture: Path | None = None
    """Draws limbs, joint axes, soles and trunk at home into this file, such as robot.png."""
    engines: bool = True
    """Compare MJX with C MuJoCo; it compiles for a minute or more."""

    def __post_init__(self):
        files.require_suffix(self.picture, files.FIGURES)


@dataclass(frozen=True)
class Replay:
    """Step a failed training's last state again and show where it goes bad."""

    dump: tyro.conf.Positional[Path]
    """bad_state.npz of a run folder."""
    steps: int = 12
    """Train steps to look through at most."""

    def __post_init__(self):
        if self.steps < 1:
            raise ConfigError("steps must be at least 1")


def check_python() -> str:
    """The version, if it lies within the tested range."""
    if not PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]:
        raise RuntimeError(f"Python {platform.python_version()} is not tested")
    return platform.python_version()


def check_jax() -> str:
    """The version, unless it is one that hangs."""
    import jax

    runtime.require_good_jax()
    return jax.__version__


def check_devices() -> str:
    """JAX's devices; an accelerator must be among them if there is one."""
    import jax

    if runtime.idle_gpu():
        raise RuntimeError(runtime.IDLE_GPU)
    return ", ".join(f"{d.platform}: {d.device_kind}" for d in jax.devices())


def check_engines() -> str:
    """The engines' versions, and the distance between their motions."""
    from kslc_jax.checkup import findings, trials

    apart = trials.engines_apart(preset("laptop").physics)
    if math.isnan(apart):
        raise RuntimeError("an engine gives numbers that are not finite")
    if apart > findings.AGREEMENT:
        raise RuntimeError(
            f"engines are {apart:.1e} rad apart after {trials.AGREEMENT_STEPS} steps"
        )
    version = importlib.metadata.version
    return f"mujoco {version('mujoco')}, mjx {version('mujoco-mjx')}: {apart:.0e} rad apart"


def check_renderer() -> str:
    """Draws a picture. It takes a process of its own, because GL is chosen before mujoco starts."""
    code = (
        "from kslc_jax import runtime; runtime.prepare();"
        "from kslc_jax import robot; from kslc_jax.viewer import render; import os;"
        "xbot = robot.load('high');"
        "next(render.frames(xbot, xbot.default_qpos[None])); print(os.environ['MUJOCO_GL'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    if done.returncode:
        raise RuntimeError((done.stderr.strip() or "no picture").splitlines()[-1])
    return done.stdout.strip()


def check_disk() -> str:
    """Free space for run folders."""
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    if free < FREE_DISK:
        raise RuntimeError(f"{free:.1f} GiB free in {Path.cwd()}")
    return f"{free:.0f} GiB free"


def check_cache() -> str:
    """The folder of the compilation cache, if it can be written."""
    given = os.environ.get("JAX_COMPILATION_CACHE_DIR") or runtime.cache_dir()
    if given is None:
        raise OSError("this user has no home folder")
    folder = Path(given)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return str(folder)


def check_cores() -> str:
    """Cores that this process may use, of all that the machine has, and what limits them."""
    usable, there = processors.usable(), os.cpu_count() or 1
    if usable >= there:
        return f"{usable} of {there}"
    return f"{usable} of {there} ({'quota' if usable < processors.affine() else 'affinity'})"


CHECKS: tuple[tuple[str, Callable[[], str], str], ...] = (
    ("python", check_python, f"use Python {TESTED}: make PYTHON=python3.12 train"),
    ("jax", check_jax, runtime.JAX_FIX),
    ("devices", check_devices, runtime.CUDA_FIX),
    ("engines", check_engines, "pip install -e . -c constraints.txt"),
    ("renderer", check_renderer, "apt-get install libegl1 libgl1-mesa-dri (for pictures only)"),
    ("disk", check_disk, f"free {FREE_DISK:g} GiB, or give --run-dir on another disk"),
    ("cache", check_cache, "set JAX_COMPILATION_CACHE_DIR to a folder that can be written"),
    ("cores", check_cores, ""),
)


def check() -> int:
    """Prints the table; 1 if a check failed."""
    table = Table(title="kslc_jax on this machine", title_justify="left")
    for column in ("check", "result", "found", "fix"):
        table.add_column(column, overflow="fold")
    failed = 0
    for name, look, fix in CHECKS:
        try:
            table.add_row(name, "[green]pass", look(), "")
        except Exception as error:  # whatever is wrong with this machine
            failed += 1
            table.add_row(name, "[red]FAIL", runtime.first_line(error), fix)
    Console(highlight=False).print(table)
    return 1 if failed else 0


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    kinds: Any = Check | Robot | Replay
    return cli.run(lambda: _run(cli.parse("doctor", kinds, argv, __doc__, default=Check())))


def _run(args: Check | Robot | Replay) -> int:
    if isinstance(args, Check):
        return check()
    if isinstance(args, Robot):
        from kslc_jax.checkup import report

        files.require_writable(args.picture)
        report.check(args.name, args.picture, args.engines)
        return 0
    from kslc_jax.training.replay import replay

    replay(args.dump, args.steps)
    return 0


if __name__ == "__main__":
    sys.exit(main())
