"""Is this machine fit to train on, and where did a training go wrong?

python -m kslc_jax.doctor checks versions, devices, both physics engines against each other, the
renderer, disk, cache and cores, and says how to fix what fails; exit code 1 if something does.
python -m kslc_jax.doctor replay DUMP steps the state that a failed training left (bad_state.npz in
its run folder) again, and shows where the first non-finite number appears.
"""

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from kslc_jax import runtime
from kslc_jax.config import ConfigError, PhysicsConfig

PYTHONS = ((3, 11), (3, 13))
"""Oldest and newest Python this is tested with."""

TESTED = " to ".join(f"{major}.{minor}" for major, minor in PYTHONS)

AGREEMENT = 1e-4
"""Difference [rad] between the engines' joint angles after `AGREEMENT_STEPS` control steps."""

AGREEMENT_STEPS = 20

FREE_DISK = 2.0
"""Free space [GiB] for run folders and the compilation cache."""


@dataclass(frozen=True)
class Check:
    """Check this machine."""


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


# ------------------------------------------------------------------------------------------ check


def check_python() -> str:
    """Version within the tested range."""
    if not PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]:
        raise RuntimeError(f"Python {platform.python_version()} is not tested")
    return platform.python_version()


def check_jax() -> str:
    """Not one of the versions that hang."""
    import jax

    runtime.require_good_jax()
    return jax.__version__


def check_devices() -> str:
    """JAX uses the accelerator if there is one."""
    import jax

    if runtime.idle_gpu():
        raise RuntimeError(runtime.IDLE_GPU)
    return ", ".join(f"{d.platform}: {d.device_kind}" for d in jax.devices())


def check_engines() -> str:
    """C MuJoCo and MJX give the same motion."""
    import numpy as np

    a, b = _joint_angles("mujoco"), _joint_angles("mjx")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise RuntimeError("an engine gives numbers that are not finite")
    apart = float(np.abs(a - b).max())
    if apart > AGREEMENT:
        raise RuntimeError(f"engines are {apart:.1e} rad apart after {AGREEMENT_STEPS} steps")
    version = importlib.metadata.version
    return f"mujoco {version('mujoco')}, mjx {version('mujoco-mjx')}: {apart:.0e} rad apart"


def _joint_angles(engine: Literal["mujoco", "mjx"]):
    """Joint angles [16] after some control steps from standing."""
    import jax
    import jax.numpy as jnp

    from kslc_jax import physics, randomize
    from kslc_jax.config import NUM_JOINTS

    config = PhysicsConfig(engine=engine, iterations=10, ls_iterations=10)
    home = jnp.asarray(physics.robot_for(config).default_qpos, jnp.float32)
    start = physics.initial_state(config, home, jnp.zeros(home.size - 1))

    def one(state: Any, t: jax.Array) -> tuple[Any, None]:
        target = home[7:] + 0.05 * jnp.sin(0.2 * t + jnp.arange(NUM_JOINTS))
        return physics.step(config, state, target, randomize.nominal(), 1.0), None

    run = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(AGREEMENT_STEPS))[0])
    return jax.device_get(run(start).qpos[7:])


def check_renderer() -> str:
    """A picture can be drawn; in a process of its own, for GL is chosen before mujoco starts."""
    code = (
        "from kslc_jax import robot; from kslc_jax.viewer import render; import os;"
        "next(render.frames(robot.load('high').default_qpos[None])); print(os.environ['MUJOCO_GL'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
    )
    if done.returncode:
        raise RuntimeError((done.stderr.strip() or "no picture").splitlines()[-1])
    return done.stdout.strip()


def check_disk() -> str:
    """Room for run folders."""
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    if free < FREE_DISK:
        raise RuntimeError(f"{free:.1f} GiB free in {Path.cwd()}")
    return f"{free:.0f} GiB free"


def check_cache() -> str:
    """The compilation cache can be written."""
    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or runtime.cache_dir())
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return str(folder)


def check_cores() -> str:
    """How many of the machine's cores this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{usable} of {os.cpu_count()} usable"


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
    from rich.console import Console
    from rich.table import Table

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


# ----------------------------------------------------------------------------------------- replay


def bad_leaves(tree: Any) -> dict[str, Any]:
    """Where (as an array of bools) the numbers of a tree are not finite, by name."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    found = {}
    for path, leaf in jax.tree.leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            bad = ~np.isfinite(np.asarray(leaf))
            if bad.any():
                found[jax.tree_util.keystr(path, simple=True, separator=".")] = bad
    return found


def replay(args: Replay) -> int:
    """Prints what goes bad in the first train step in which anything does."""
    from kslc_jax import train_step
    from kslc_jax.training import recovery

    config, state = recovery.read_dump(args.dump)
    _, step = train_step.make(config)
    roll = _roller(config)
    for _ in range(args.steps):
        number = int(state.step) + 1
        said = [f"before: {_count(name, bad)}" for name, bad in bad_leaves(_parts(state)).items()]
        said += _first_in_rollout(roll, config, state)
        state, metrics = step(state)
        after = {**_parts(state), "metrics": metrics}
        said += [f"after: {_count(name, bad)}" for name, bad in bad_leaves(after).items()]
        if said:
            print(f"train step {number} is the first with a number that is not finite:")
            print("\n".join(f"  {line}" for line in said))
            return 0
        print(f"train step {number}: all finite, {float(metrics['ppo/skipped']):.0%} skipped")
    return 0


def _parts(state: Any) -> dict[str, Any]:
    """What a train step goes from and to."""
    return {"learner": state.learner, "curriculum": state.curriculum, "env": state.env}


def _count(name: str, bad: Any) -> str:
    return f"{name}, {int(bad.sum())} of {bad.size}"


def _roller(config: Any) -> Callable[..., tuple[Any, Any, Any]]:
    """One control step (state, envs, key): envs as training goes on with, and what was before it
    masked anything."""
    import jax

    from kslc_jax import rollout

    @jax.jit
    def one(state: Any, envs: Any, key: jax.Array) -> tuple[Any, Any, Any]:
        params, curriculum = state.learner.params, state.curriculum
        raw, traj = rollout.control_step(config, params, envs, curriculum, key)
        return jax.vmap(rollout.contain)(raw, traj.outcome)[0], raw, traj

    return one


def _first_in_rollout(roll: Callable[..., Any], config: Any, state: Any) -> list[str]:
    """What goes bad in the first control step in which anything does, and in which environments."""
    import jax
    import numpy as np

    from kslc_jax import rollout, train_step

    envs = jax.vmap(rollout.usable)(state.env)
    keys = jax.random.split(train_step.step_keys(state)[0], config.ppo.rollout_steps)
    for t, key in enumerate(keys):
        envs, raw, traj = roll(state, envs, key)
        rows = {
            name: bad.reshape(len(bad), -1).any(1)
            for name, bad in bad_leaves({"rollout": traj, "env": raw}).items()
        }
        broken = np.asarray(traj.outcome.broken)
        if broken.any():
            rows["physics diverged"] = broken
        if rows:
            where = f"control step {t + 1} of {len(keys)}"
            return [f"{where}: {name}, environments {_some(bad)}" for name, bad in rows.items()]
    return []


def _some(bad: Any, shown: int = 5) -> str:
    """The first few indices of True."""
    indices = bad.nonzero()[0]
    more = f" and {len(indices) - shown} more" if len(indices) > shown else ""
    return ", ".join(map(str, indices[:shown])) + more


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    runtime.prepare()
    try:
        args = tyro.cli(
            Check | Replay,
            args=argv,
            default=Check(),
            description=__doc__,
            prog="python -m kslc_jax.doctor",
        )
        if isinstance(args, Check):
            return check()
        from kslc_jax.checkpoint_format import CheckpointError
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        return replay(args)
    except (CheckpointError, ConfigError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
