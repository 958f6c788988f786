"""The metrics of 20 train steps of the debug preset, and what the shipped policy does and is
exported as, compared with a stored file.

A refactoring must not change a number. A commit that changes numbers on purpose also writes the
file again:

  python tests/test_pinned.py
"""

import dataclasses
import hashlib
import importlib.metadata
import json
import os
from pathlib import Path
from typing import Any

import compiler  # noqa: F401  (before JAX)
import jax
import numpy as np
import pytest

from kslc_jax import config as config_lib
from kslc_jax import export, load_policy, physics, processors, train_step
from kslc_jax.evaluation import trials

FILE = Path(__file__).parent / "data" / "pinned_metrics.json"

STEPS = 20

POLICY = "xbot_l_run"

FIRST_STEPS = 2
"""Train steps to compare on another machine. Later, chaos amplifies its other rounding."""

RELATIVE, ABSOLUTE = 1e-2, 1e-4
"""Tolerances of the first steps, for a machine or packages other than those of the file."""

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")


def machine() -> dict[str, str]:
    """All that decides the last bit of a number: hardware, compiler flags and package versions."""
    return {
        "cpu": processors.model(),
        "flags": os.environ["XLA_FLAGS"],
        **{name: importlib.metadata.version(name) for name in PACKAGES},
    }


def metrics(engine: str, steps: int = STEPS) -> dict[str, list[str]]:
    """Each metric of the first train steps, as hexadecimal floats, which keep every bit."""
    config = config_lib.preset("debug")
    if physics.resolve_engine(config.physics) != engine:  # else other tests have compiled it
        other = dataclasses.replace(config.physics, engine=engine)
        config = dataclasses.replace(config, physics=other)
    init, step = train_step.make(config)
    state, rows = init(), []
    for _ in range(steps):
        state, out = step(state)
        rows.append({name: float(value).hex() for name, value in jax.device_get(out).items()})
    return {name: [row[name] for row in rows] for name in rows[0]}


def behaviour(fidelity: config_lib.Fidelity) -> list[str]:
    """Every number of the state of one robot after a second at 2 m/s, as hexadecimal floats."""
    policy = load_policy(POLICY)
    setting = trials.Setting(trials.engine(policy, fidelity), seconds=1.0)
    (trace,) = trials.run(policy, setting, np.array([[2.0, 0.0, 0.0]]))
    last = [trace.qpos[-1, 0], trace.joint_vel[-1, 0], trace.torque[-1, 0]]
    return [float(x).hex() for x in np.concatenate(last)]


def exported() -> str:
    """SHA-256 of the ONNX file."""
    return hashlib.sha256(export.to_onnx(load_policy(POLICY))).hexdigest()


def measure(part: str) -> Any:
    """The numbers of an engine, "mujoco" or "mjx", or those of the shipped policy, "policy"."""
    if part != "policy":
        return metrics(part)
    fidelities: tuple[config_lib.Fidelity, ...] = ("train", "high")
    return {f: behaviour(f) for f in fidelities} | {"onnx": exported()}


def check(engine: str) -> None:
    """Fails if a metric differs from the stored one."""
    stored = json.loads(FILE.read_text())
    exact = stored["machine"] == machine()
    steps = STEPS if exact else FIRST_STEPS
    found, wanted = measure(engine), stored[engine]
    for name, then in wanted.items():  # there may be new metrics, of a reward that somebody adds
        if exact:
            assert found[name] == then, name
        else:
            numbers = [[float.fromhex(x) for x in row[:steps]] for row in (found[name], then)]
            np.testing.assert_allclose(*numbers, rtol=RELATIVE, atol=ABSOLUTE, err_msg=name)


def test_numbers_in_c_mujoco_are_pinned():
    check("mujoco")


def test_what_the_shipped_policy_does_is_pinned():
    stored = json.loads(FILE.read_text())
    exact, now = stored["machine"] == machine(), measure("policy")
    for fidelity in ("train", "high"):
        found, wanted = now[fidelity], stored["policy"][fidelity]
        if exact:
            assert found == wanted, fidelity
        else:  # a second is long enough for another rounding to grow
            numbers = [[float.fromhex(x) for x in row] for row in (found, wanted)]
            np.testing.assert_allclose(numbers[0][:7], numbers[1][:7], atol=0.05)
    if exact:
        assert now["onnx"] == stored["policy"]["onnx"]


@pytest.mark.slow  # MJX takes a minute to compile where nothing is cached
def test_numbers_in_mjx_are_pinned():
    check("mjx")


def main() -> None:
    """Writes the file again."""
    found = {part: measure(part) for part in ("mujoco", "mjx", "policy")}
    FILE.write_text(json.dumps({"machine": machine(), **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
