"""Shared fixtures. Tests run in float32, as training does on the CPU."""

import compiler  # noqa: F401  (before JAX)
import pytest

from kslc_jax import config, robot, runtime

runtime.quiet()  # as commands do; else saves that fail on purpose print tracebacks


@pytest.fixture(scope="session")
def xbot() -> robot.Robot:
    """The training-fidelity robot."""
    return robot.load()


@pytest.fixture(scope="session")
def debug() -> config.Config:
    """The debug preset."""
    return config.preset("debug")
