"""What the benchmarks share: timing in turn, machines in words, results on disk."""

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

from kslc_jax.config import Config

Seconds = dict[str, list[float]]


def in_turn(runs: Mapping[str, Callable[[], Any]], repeats: int) -> Seconds:
    """Seconds of each of `repeats` calls of each run, all runs in turn.

    Drifts of the machine so hit all alike. A first call of each compiles and does not count.
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
    """`config` with other numbers of environments and of actor frames, where given."""
    changes = {"num_envs": num_envs, "frames": frames}
    changes = {name: value for name, value in changes.items() if value is not None}
    return dataclasses.replace(config, env=dataclasses.replace(config.env, **changes))


def child(module: str, args: list[str], env: dict[str, str] | None = None) -> Any:
    """What `python -m MODULE ARGS` prints last, which is JSON."""
    done = subprocess.run(
        [sys.executable, "-m", module, *args],
        env={**os.environ, **(env or {})},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def machine() -> dict[str, Any]:
    """The machine and what ran on it, in words that a reader can compare with their own."""
    import jax
    import mujoco

    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30),
        "device": jax.devices()[0].device_kind,
        "load": os.getloadavg()[0],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }


def _cpu_model() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def report(result: dict[str, Any], path: Path | None) -> None:
    """Writes a result beside the machine that it was measured on, where a path is given."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"machine": machine(), **result}, indent=1) + "\n")
        print(f"wrote {path}")
