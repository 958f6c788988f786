"""Behaviour of all commands: one line for an error, its exit code, process-wide settings."""

import dataclasses
import json
import logging
import math
import os
import subprocess
import sys
import typing
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest
import slow

from kslc_jax import (
    cli,
    compare,
    doctor,
    evaluate,
    export,
    falls,
    judge,
    learning,
    physics,
    play,
    plots,
    processors,
    reproduce,
    robot,
    runtime,
    sim2sim,
    train,
)
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


def test_ctrl_c_is_one_line_and_ends_a_script_or_cell(process, capsys, monkeypatch):
    """Python then ends by the signal, so that a shell's loop over commands ends, too."""
    monkeypatch.setattr(runtime, "is_program", lambda: True)
    with pytest.raises(KeyboardInterrupt):
        cli.run(failing(KeyboardInterrupt()))
    sys.excepthook(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert capsys.readouterr().err == "interrupted\n"


def test_exit_codes():
    assert cli.run(lambda: None) == 0
    assert cli.run(lambda: 130) == 130


@pytest.fixture
def process(monkeypatch):
    """A process whose hooks and log levels are Python's own."""
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    monkeypatch.setattr(warnings, "formatwarning", lambda *args: "")
    levels = {name: logging.getLogger(name).level for name in ("absl", "asyncio")}
    for name in levels:
        logging.getLogger(name).setLevel(logging.WARNING)
    yield
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def hooks():
    levels = [logging.getLogger(name).level for name in ("absl", "asyncio")]
    return sys.excepthook, sys.unraisablehook, warnings.formatwarning, levels


def test_preparing_leaves_hooks_and_logs_alone(process):
    """Notebooks and scripts of users call it too."""
    before = hooks()
    runtime.prepare()
    assert hooks() == before


LATE_WRITES = """
import asyncio, sys, time
import numpy as np
from kslc_jax import runtime
{quiet}
import tensorstore

async def fails(path):
    spec = {{"driver": "zarr", "kvstore": {{"driver": "file", "path": path}}}}
    store = await tensorstore.open(spec, create=True, dtype=tensorstore.float32, shape=[2000, 2000])

    async def write():
        await store.write(np.random.rand(2000, 2000).astype(np.float32))

    tasks = [asyncio.create_task(write()) for _ in range(8)]
    await asyncio.sleep(0)
    return tasks

loop = asyncio.new_event_loop()
tasks = loop.run_until_complete(fails(sys.argv[1]))
loop.close()
time.sleep(2)
"""


@pytest.mark.parametrize("quiet", [True, *slow.cases("a process of its own", False)])
def test_writes_that_end_after_a_failed_save_are_silent(quiet, tmp_path):
    """Orbax closes its event loop when a save fails; threads of tensorstore still call it."""
    code = LATE_WRITES.format(quiet="runtime.quiet()" if quiet else "")
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert ("Event loop is closed" in done.stderr) != quiet


def test_other_errors_that_nobody_can_catch_are_shown(process, capsys):
    class Bad:
        def __del__(self):
            raise ValueError("so")

    cli.run(lambda: None)
    Bad()
    assert "ValueError: so" in capsys.readouterr().err


def test_a_command_silences_its_process(process, monkeypatch):
    """A notebook's process only while the command runs."""
    before, inside = hooks(), []
    assert not runtime.is_program()
    cli.run(lambda: inside.append(hooks()))
    assert hooks() == before and all(a != b for a, b in zip(inside[0], before, strict=True))
    monkeypatch.setattr(runtime, "is_program", lambda: True)
    cli.run(lambda: None)
    assert hooks() == inside[0]


IS_PROGRAM = "from kslc_jax import runtime; print(runtime.is_program())"


@pytest.mark.parametrize("how", ["module", "code"])
def test_a_program_is_a_command_of_this_package(how, tmp_path):
    if how == "module":
        folder = tmp_path / "benchmarks"
        folder.mkdir()
        (folder / "__init__.py").touch()
        (folder / "one.py").write_text(IS_PROGRAM)
        words = ["-m", "benchmarks.one"]
    else:
        words = ["-c", IS_PROGRAM]
    argv = [sys.executable, *words]
    done = subprocess.run(argv, cwd=tmp_path, check=True, capture_output=True, text=True)
    assert done.stdout == f"{how == 'module'}\n"


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


NUMERICS = {
    "JAX_ENABLE_X64": "1",
    "JAX_DEBUG_NANS": "true",
    "JAX_DEFAULT_MATMUL_PRECISION": "bfloat16",
    "JAX_THREEFRY_PARTITIONABLE": "0",
    "JAX_RANDOM_SEED_OFFSET": "3",
    "JAX_OPTIMIZATION_LEVEL": "O0",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_EXEC_TIME_OPTIMIZATION_EFFORT": "-0.5",
    "JAX_TRANSFER_GUARD": "disallow",
    "JAX_DEBUG_KEY_REUSE": "1",
}


def test_variables_that_change_numbers_are_overridden(monkeypatch, capsys):
    """In one line, and not passed on to child processes."""
    for name, value in NUMERICS.items():
        monkeypatch.setenv(name, value)
    runtime.prepare(gl=False)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(f"{n}={v}" in said for n, v in NUMERICS.items())
    assert not set(NUMERICS) & set(os.environ)
    runtime.prepare(gl=False)
    assert capsys.readouterr().err == ""


@pytest.mark.slow(reason="eight processes; with mjx they compile for minutes")
@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_commands_compute_the_same_under_these_variables(engine, tmp_path):
    """A training, its evaluation at both fidelities, and the golden trace of its export."""

    def numbers(name: str, variables: dict[str, str]):
        run, env = tmp_path / name / "run", {**os.environ, **variables}
        short = ["--speeds", "1", "--seeds", "2", "--seconds", "3", "--json"]
        for argv in (
            ["train", "--preset", "debug", "--physics.engine", engine, "--run-dir", run],
            ["evaluate", run, *short, run / "evaluate.json"],
            ["sim2sim", run, *short, run / "sim2sim.json"],
            ["export", run, run / "policy.onnx"],
        ):
            words = [sys.executable, "-m", f"kslc_jax.{argv[0]}", *map(str, argv[1:])]
            subprocess.run(words, env=env, check=True, capture_output=True)
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        clock = {"seconds", "steps_per_second"}
        rows = [{k: v for k, v in row.items() if k not in clock} for row in rows]
        found = [json.loads((run / f"{x}.json").read_text()) for x in ("evaluate", "sim2sim")]
        with np.load(run / "policy.npz") as trace:
            return rows, found, {k: trace[k].tobytes() for k in trace}

    assert numbers("plain", {}) == numbers("changed", NUMERICS)


def test_a_user_without_a_home_folder_has_no_cache(monkeypatch):
    """As in a container that runs with any user id; then Path.home() raises."""
    for name in ("HOME", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 987_654_321)
    runtime.prepare(gl=False)
    assert runtime.cache_dir() is None and "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_variables_that_change_nothing_are_no_word(monkeypatch, capsys):
    for name in NUMERICS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("JAX_ENABLE_X64", "False")
    monkeypatch.setenv("JAX_THREEFRY_PARTITIONABLE", "1")
    monkeypatch.setenv("JAX_DEBUG_NANS", "")
    monkeypatch.setenv("JAX_EXEC_TIME_OPTIMIZATION_EFFORT", "0")
    runtime.prepare(gl=False)
    assert capsys.readouterr().err == ""


def test_options_of_a_jax_that_is_there_already_are_overridden_too(capsys):
    """A notebook may have set them before it calls a command."""

    def options():
        return {n: runtime._option(jax.config, n, x) for n, x in runtime.NUMERICS.items()}

    before = options()
    assert before == runtime.NUMERICS  # JAX's defaults, with the oldest JAX and the newest
    try:
        jax.config.update("jax_enable_x64", True)
        jax.config.update("jax_default_matmul_precision", "bfloat16")
        jax.config.update("jax_disable_most_optimizations", True)
        jax.config.update("jax_transfer_guard", "disallow")
        runtime.prepare(gl=False)
        said = capsys.readouterr().err
        assert "JAX_ENABLE_X64=True" in said and "MATMUL_PRECISION=bfloat16" in said
        assert "DISABLE_MOST_OPTIMIZATIONS=True" in said and "TRANSFER_GUARD=disallow" in said
        assert options() == before
        jax.config.update("jax_enable_x64", True)
        inside = []
        assert cli.run(lambda: inside.append(jax.config.jax_enable_x64)) == 0
        assert inside == [False] and jax.config.jax_enable_x64  # the user's option comes back
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_variables_that_jax_cannot_read_end_no_command(monkeypatch, capsys):
    """JAX would refuse them at its import; here the command imports it without them."""
    wrong = dict.fromkeys(runtime.NUMERICS, "junk")
    for name, value in wrong.items():
        monkeypatch.setenv(name.upper(), value)
    monkeypatch.delitem(sys.modules, "jax")
    assert cli.run(lambda: sys.modules.update(jax=jax)) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(f"{name.upper()}=junk" in said for name in wrong)
    assert {name: os.environ[name.upper()] for name in wrong} == wrong  # the user's, as before
    options = {n: runtime._option(jax.config, n, x) for n, x in runtime.NUMERICS.items()}
    assert options == runtime.NUMERICS


def test_variables_of_a_notebook_count_again_after_a_command():
    """Also if the command is the first that imports JAX."""
    code = (
        "import os; from kslc_jax import cli\n"
        "inside = []\n"
        "def do():\n"
        "    import jax, jax.numpy as jnp\n"
        "    inside.append((jnp.ones(1).dtype.name, os.environ.get('JAX_ENABLE_X64')))\n"
        "cli.run(do)\n"
        "import jax.numpy as jnp\n"
        "print(inside, jnp.ones(1).dtype.name, os.environ['JAX_ENABLE_X64'])"
    )
    env = {**os.environ, "JAX_ENABLE_X64": "1"}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[('float32', None)] float64 1"


COMMANDS = {
    "train": [train.Args],
    "evaluate": [evaluate.Args],
    "sim2sim": [sim2sim.Args],
    "judge": [judge.Args],
    "play": [play.Args],
    "export": [export.Args],
    "compare": [compare.Args],
    "falls": [falls.Args],
    "learning": [learning.Args],
    "reproduce": [reproduce.Args],
    "plots": typing.get_args(plots.Drawing),
    "doctor": [doctor.Check, doctor.Robot, doctor.Replay],
}


def test_public_options_stay():
    """Users' scripts have them. A new option goes into the file."""

    def names(kind, prefix=""):
        for field in dataclasses.fields(kind):
            inside = typing.get_type_hints(kind)[field.name]
            if dataclasses.is_dataclass(inside):
                yield from names(inside, "" if field.name == "config" else f"{prefix}{field.name}.")
            else:
                yield prefix + field.name

    found = []
    for command, kinds in COMMANDS.items():
        for kind in kinds:
            title = command if len(kinds) == 1 else f"{command} {kind.__name__.lower()}"
            found += [title, *(f"{title} {name}" for name in names(kind))]
    stored = (Path(__file__).parent / "data" / "options.txt").read_text().splitlines()
    assert sorted(found) == stored


def test_every_option_of_jax_is_known():
    """A new one may change numbers: then it belongs in `runtime.NUMERICS`, else in the file."""
    known = (Path(__file__).parent / "data" / "jax_options.txt").read_text().split()
    assert {*jax.config.values} - {*known, *runtime.NUMERICS} == set()


def cgroup(root, groups: str, **files: str) -> None:
    """A machine's control groups under `root`; a file's name has `__` for a slash."""
    for name, text in {"proc__self__cgroup": groups, **files}.items():
        path = root.joinpath(*name.split("__"))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.mark.parametrize(
    ("groups", "files", "quota"),
    [
        ("0::/", {"sys__fs__cgroup__cpu.max": "200000 100000\n"}, 2.0),
        ("0::/", {"sys__fs__cgroup__cpu.max": "max 100000\n"}, math.inf),
        ("0::/a/b", {"sys__fs__cgroup__a__cpu.max": "150000 100000\n"}, 1.5),  # of a group above
        ("0::/hosts/own", {"sys__fs__cgroup__cpu.max": "50000 100000\n"}, 0.5),  # in a container
        (
            "3:cpuset:/\n2:cpu,cpuacct:/job\n0::/",
            {
                "sys__fs__cgroup__cpu__job__cpu.cfs_quota_us": "300000\n",
                "sys__fs__cgroup__cpu__job__cpu.cfs_period_us": "100000\n",
                "sys__fs__cgroup__cpu__cpu.cfs_quota_us": "-1\n",
                "sys__fs__cgroup__cpu__cpu.cfs_period_us": "100000\n",
            },
            3.0,
        ),
        ("", {}, math.inf),
    ],
)
def test_the_quota_of_cpus(tmp_path, groups, files, quota):
    cgroup(tmp_path, groups, **files)
    assert processors.quota(tmp_path) == quota


@pytest.mark.parametrize(
    ("groups", "files", "limit"),
    [
        ("0::/a/b", {"sys__fs__cgroup__a__memory.max": "1048576\n"}, 2**20),  # of a group above
        ("0::/a", {"sys__fs__cgroup__a__memory.max": "max\n"}, None),
        ("3:cpu:/\n4:memory:/job", {"sys__fs__cgroup__memory__job__memory.limit_in_bytes": "9"}, 9),
        # A group without a limit, version 1: more than any machine has.
        ("4:memory:/", {"sys__fs__cgroup__memory__memory.limit_in_bytes": f"{2**63 - 4096}"}, None),
    ],
)
def test_the_limit_of_memory(tmp_path, groups, files, limit):
    cgroup(tmp_path, groups, **files)
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert processors.memory(tmp_path) == (there if limit is None else limit)


def test_the_processor_and_its_vector_instructions(tmp_path):
    path = tmp_path / "cpuinfo"
    path.write_text("processor\t: 0\nmodel name\t: A CPU\nflags\t\t: fpu avx avx2 sse\n\nother\n")
    assert processors.model(path) == "A CPU, avx2"
    assert "," not in processors.model(tmp_path / "none")


def test_a_machine_without_control_groups(tmp_path):
    assert processors.quota(tmp_path) == math.inf


def test_threads_are_as_many_as_affinity_and_quota_allow(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.delenv(runtime.XLA_THREADS, raising=False)
    for affine, quota, usable, said in (
        (64, 2.0, 2, "2 of 64 (quota)"),
        (64, 1.5, 2, "2 of 64 (quota)"),
        (64, 0.2, 1, "1 of 64 (quota)"),
        (4, 16.0, 4, "4 of 64 (affinity)"),
        (64, math.inf, 64, "64 of 64"),
    ):
        monkeypatch.setattr(processors, "affine", lambda affine=affine: affine)
        monkeypatch.setattr(processors, "quota", lambda quota=quota: quota)
        assert (processors.usable(), doctor.check_cores()) == (usable, said)
        os.environ.pop(runtime.XLA_THREADS, None)
        runtime.prepare(gl=False)
        assert os.environ.pop(runtime.XLA_THREADS, None) == (
            str(usable) if usable < affine else None
        )


def test_the_engine_takes_as_many_threads_as_are_allowed(monkeypatch):
    asked = []
    monkeypatch.setattr(
        physics.mujoco.batch, "Batch", lambda model, size, nthread: asked.append(nthread)
    )
    monkeypatch.setattr(processors, "usable", lambda: 3)
    for threads in (0, 5):
        physics._batch.__wrapped__(robot.load(), 7, threads, frozenset())
    assert asked == [3, 5]


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
