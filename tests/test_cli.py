"""Behaviour of all commands: one line for an error, its exit code, process-wide settings."""

import logging
import os
import sys

import pytest

from kslc_jax import cli, runtime
from kslc_jax.config import ConfigError
from kslc_jax.errors import MissingPackage, UserError
from kslc_jax.training.recovery import NumbersError


def failing(error):
    def do():
        raise error

    return do


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UserError("so"), 2),
        (ConfigError("so"), 2),
        (MissingPackage("so"), 2),
        (NumbersError("so"), 1),
    ],
)
def test_a_users_error_is_one_line_and_an_exit_code(error, code, capsys):
    assert cli.run(failing(error)) == code
    assert capsys.readouterr().err == "error: so\n"


def test_any_other_error_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        cli.run(failing(ZeroDivisionError()))


def test_exit_codes():
    assert cli.run(lambda: None) == 0
    assert cli.run(lambda: 130) == 130


@pytest.fixture
def process(monkeypatch):
    """A process whose hooks and log levels are Python's own."""
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    levels = {name: logging.getLogger(name).level for name in ("absl", "asyncio")}
    for name in levels:
        logging.getLogger(name).setLevel(logging.WARNING)
    yield
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def hooks():
    levels = [logging.getLogger(name).level for name in ("absl", "asyncio")]
    return sys.excepthook, sys.unraisablehook, levels


def test_preparing_leaves_hooks_and_logs_alone(process):
    """Notebooks and scripts of users call it too."""
    before = hooks()
    runtime.prepare()
    assert hooks() == before


def test_a_command_silences_its_process(process):
    cli.run(lambda: None)
    assert sys.excepthook is not sys.__excepthook__
    assert logging.getLogger("absl").level == logging.CRITICAL


@pytest.mark.parametrize(
    ("there", "chosen"),
    [(("EGL", "OSMesa"), "egl"), (("OSMesa",), "osmesa"), ((), None)],
)
def test_preparing_chooses_the_gl_that_is_there(there, chosen, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "")  # monkeypatch restores it after the test
    find = lambda name: f"lib{name}.so" if name in there else None  # noqa: E731
    monkeypatch.setattr(runtime.ctypes.util, "find_library", find)
    runtime.prepare(gl=False)
    assert not os.environ["MUJOCO_GL"]
    runtime.prepare()
    assert (os.environ["MUJOCO_GL"] or None) == chosen
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    runtime.prepare()
    assert os.environ["MUJOCO_GL"] == "glfw"
