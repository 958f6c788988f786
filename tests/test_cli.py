"""What all commands share: one line for an error, its exit code, and a process left as it was."""

import logging
import os
import sys

import pytest

from kslc_jax import cli, compare, runtime, train
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
    """It is called in notebooks and scripts, which are not ours."""
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
    monkeypatch.setenv("MUJOCO_GL", "")  # to be restored, whatever is chosen
    find = lambda name: f"lib{name}.so" if name in there else None  # noqa: E731
    monkeypatch.setattr(runtime.ctypes.util, "find_library", find)
    runtime.prepare(gl=False)
    assert not os.environ["MUJOCO_GL"]
    runtime.prepare()
    assert (os.environ["MUJOCO_GL"] or None) == chosen
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    runtime.prepare()
    assert os.environ["MUJOCO_GL"] == "glfw"


@pytest.mark.parametrize(
    ("text", "number"),
    [("60000000", 60_000_000), ("60_000_000", 60_000_000), ("60e6", 60_000_000), ("-1.5e1", -15)],
)
def test_whole_numbers(text, number):
    assert cli.whole_number(text) == number and type(cli.whole_number(text)) is int


@pytest.mark.parametrize("text", ["1.5", "1e-1", "nan", "inf", "1e400000000", "x", ""])
def test_no_whole_numbers(text):
    with pytest.raises(ValueError, match="60_000_000 or 60e6"):
        cli.whole_number(text)


def test_every_integer_option_takes_them():
    options = "--preset debug --steps 1e3 --env.num-envs 3.2e1 --devices 2e0 --seed 1e1"
    args = train.parse([*options.split(), "--network.actor", "1e2", "5_0"])
    assert (args.config.run.steps, args.config.env.num_envs, args.devices) == (1000, 32, 2)
    assert args.config.network.actor == (100, 50) and args.config.seed == 10
    compared = cli.parse("compare", compare.Args, ["--steps", "4e7", "--seeds", "0", "1e0"], None)
    assert (compared.steps, compared.seeds) == (40_000_000, (0, 1))
