"""Shared fixtures. Tests run on the CPU in float32, as training does there."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import pytest

from kslc_jax import config, robot, runtime

runtime.quiet()  # as in a command: saves that fail on purpose leave no stray tracebacks


@pytest.fixture(scope="session")
def xbot() -> robot.Robot:
    """The training-fidelity robot."""
    return robot.load()


@pytest.fixture(scope="session")
def debug() -> config.Config:
    """The debug preset."""
    return config.preset("debug")
