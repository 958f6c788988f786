"""Shared functions of the benchmarks: timing in turn, description of the machine, result files."""

import dataclasses
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from kslc_jax import processors
from kslc_jax.config import Config

Seconds = dict[str, list[float]]


def in_turn(runs: Mapping[str, Callable[[], Any]], repeats: int) -> Seconds:
    """Seconds of `repeats` calls of each run. The runs take turns.

    So a drift of the machine's speed affects all runs alike. The first call of each run compiles
    and does not count.
    """
    for run in runs.values():
        run()
    seconds: Seconds = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return seconds


def medians(seconds: Seconds) -> dict[str, float]:
    """Median seconds of each run."""
    return {name: statistics.median(s) for name, s in seconds.items()}


def on_engine(config: Config, engine: Any) -> Config:
    """`config` with another physics engine."""
    return dataclasses.replace(config, physics=dataclasses.replace(config.physics, engine=engine))


def resized(config: Config, num_envs: int | None = None, frames: int | None = None) -> Config:
    """`config` with another number of environments or of actor frames; None keeps the number."""
    changes = {"num_envs": num_envs, "frames": frames}
    changes = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(config, env=dataclasses.replace(config.env, **changes))


def child(
    module: str,
    args: list[str],
    env: dict[str, str] | None = None,
    timeout: float | None = None,
) -> Any:
    """Runs `python -m MODULE ARGS` and returns its last line, which must be JSON.

    SubprocessError if it fails, or takes longer than `timeout` [s].
    """
    done = subprocess.run(
        [sys.executable, "-m", module, *args],
        env={**os.environ, **(env or {})},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=timeout,
    )
    return json.loads(done.stdout.splitlines()[-1])


def machine() -> dict[str, Any]:
    """Hardware, load and software versions, so that a reader can compare machines."""
    import jax
    import mujoco

    return {
        "cpu": processors.model(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30),
        "device": jax.devices()[0].device_kind,
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }


def report(result: dict[str, Any], path: Path | None) -> None:
    """Writes a result and the description of the machine to `path`, if it is given."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"machine": machine(), **result}, indent=1) + "\n")
        print(f"wrote {path}")
