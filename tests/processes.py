"""Starts trainings in child processes that see a chosen number of CPU devices."""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

DEBUG = ("--preset", "debug", "--physics.engine", "mjx")

TRAIN = ("-m", "kslc_jax.train")

METRICS = dict.fromkeys(
    [
        *("score", "finite", "ppo/skipped", "tracking", "fast_tracking", "episode_steps"),
        *("curriculum/v_max", "curriculum/cycle_time", "curriculum/tracking"),
    ],
    0.5,
) | {"broken": 0.0}
"""The metrics of a train step that loop, recorder and progress read, with made-up values."""


def command(*args: Any, forced: int) -> dict[str, Any]:
    """Arguments of `subprocess` that run Python with `forced` CPU devices."""
    flags = f"--xla_force_host_platform_device_count={forced}"
    return {
        "args": [sys.executable, *map(str, args)],
        "env": {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags},
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def started(stack: contextlib.ExitStack, *args: Any, processes: int = 2, forced: int = 2) -> list:
    """Starts the processes of one training, each with `forced` devices.

    The end of `stack` kills them.
    """
    options = ["--coordinator", f"127.0.0.1:{free_port()}", "--processes", processes]
    options += ["--devices", forced, "--process-index"]
    running = []
    for index in range(processes):
        process = subprocess.Popen(**command(*args, *options, index, forced=forced))
        running.append(stack.enter_context(process))
        stack.callback(process.kill)
    return running


def ended(processes: list, code: int = 0, within: float = 5000.0) -> list[tuple[str, str]]:
    """Waits until all processes have ended with this exit code; returns each (stdout, stderr).

    The output is without the lines of Gloo, which XLA uses between CPU processes.
    """
    said = [process.communicate(timeout=within) for process in processes]
    assert [process.returncode for process in processes] == [code] * len(processes), said
    return [(re.sub(r"(?m)^\[Gloo\].*\n", "", out), err) for out, err in said]


def alone(*args: Any, devices: int = 1) -> str:
    """Runs one process, which must end with exit code 0; returns its stdout."""
    how = command(*args, "--devices", devices, forced=devices)
    done = subprocess.run(**how, timeout=5000, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def rows(run_dir: Path) -> list[dict[str, float]]:
    return [json.loads(row) for row in (run_dir / "metrics.jsonl").read_text().splitlines()]


def wait_for_rows(run_dir: Path, count: int, processes: list) -> None:
    for _ in range(50000):
        if (run_dir / "metrics.jsonl").exists() and len(rows(run_dir)) >= count:
            return
        assert all(process.poll() is None for process in processes), processes[0].communicate()
        time.sleep(0.1)
    raise AssertionError("no progress")
