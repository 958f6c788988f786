"""Shared fixtures. Tests run in float32, as training does on the CPU."""

from pathlib import Path
from typing import Any

import compiler  # noqa: F401  (before JAX)
import pytest

from kslc_jax import config, robot, runtime

runtime.quiet()  # as commands do; else saves that fail on purpose print tracebacks

TRAIN_STEP = ("test_faults", "test_pinned", "test_run", "test_train_step")
"""Files that compile the train step of the debug preset. One worker runs them all, and compiles it
once."""


@pytest.hookimpl(optionalhook=True)  # without pytest-xdist nobody calls it
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `--dist loadfile` the files of `TRAIN_STEP` stay together, too."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "train step" if Path(file).stem in TRAIN_STEP else file

    return Scheduling(config, log)


@pytest.fixture(scope="session")
def xbot() -> robot.Robot:
    """The training-fidelity robot."""
    return robot.load()


@pytest.fixture(scope="session")
def debug() -> config.Config:
    """The debug preset."""
    return config.preset("debug")
