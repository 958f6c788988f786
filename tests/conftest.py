"""Shared fixtures. Tests run in float32, as training does on the CPU.

Most of the suite's time is XLA's compiler. With these flags it takes a fifth of the time; the
programs are slower, which short ones do not notice. tests/test_pinned.py runs without them.
"""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false",
)

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
