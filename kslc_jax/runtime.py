"""Settings that must be made before JAX starts, and facts about this machine.

Only the functions that need JAX import it.
"""

import contextlib
import ctypes.util
import faulthandler
import inspect
import logging
import os
import statistics
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Any

from kslc_jax import processors
from kslc_jax.errors import UserError

BAD_JAX = ("0.10.", "0.11.0")
"""JAX versions whose CPU backend can hang for ever in batched Cholesky factorisations."""

JAX_FIX = "pip install -U 'jax>=0.7.2,!=0.10.*,!=0.11.0'"
"""Command that installs a JAX that does not hang. pyproject.toml has the same versions."""


IDLE_GPU = "there is an NVIDIA GPU, but JAX computes on the CPU"

CUDA_FIX = "pip install 'kslc_jax[cuda]'"
"""Command that installs a JAX for NVIDIA GPUs."""

NVIDIA = Path("/dev/nvidia0")
"""A file that exists if the driver of an NVIDIA GPU is loaded."""

Value = str | bool | float | None
"""Value of an option of JAX."""

NUMERICS: dict[str, Value] = {
    "jax_enable_x64": False,
    "jax_default_matmul_precision": None,
    "jax_default_prng_impl": "threefry2x32",
    "jax_threefry_partitionable": True,
    "jax_random_seed_offset": 0,
    "jax_numpy_dtype_promotion": "standard",
    "jax_numpy_rank_promotion": "allow",
    "jax_disable_jit": False,
    "jax_debug_nans": False,
    "jax_debug_infs": False,
    "jax_error_checking_behavior_nan": "ignore",
    "jax_error_checking_behavior_divide": "ignore",
    "jax_error_checking_behavior_oob": "ignore",
    "jax_debug_key_reuse": False,
    "jax_check_tracer_leaks": False,
    "jax_no_tracing": False,
    "jax_no_execution": False,
    "jax_thread_guard": False,
    "jax_transfer_guard": None,
    "jax_transfer_guard_host_to_device": None,
    "jax_transfer_guard_device_to_host": None,
    "jax_transfer_guard_device_to_device": None,
    "jax_optimization_level": "UNKNOWN",
    "jax_disable_most_optimizations": False,
    "jax_exec_time_optimization_effort": 0.0,
    "jax_memory_fitting_effort": 0.0,
    "jax_memory_fitting_level": "O2",
}
"""Options of JAX that change numbers, or that raise errors in sound programs, say at a NaN that
this package masks. All commands use these values, which are JAX's defaults."""

_YES, _NO = ("1", "true", "t", "yes", "y", "on"), ("0", "false", "f", "no", "n", "off")

XLA_THREADS = "PJRT_NPROC"
"""Environment variable with the number of XLA's threads on a CPU. XLA itself reads the affinity,
but no quota."""


GL_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""Value of MUJOCO_GL -> the library that it needs; the better one first."""


def cache_dir() -> Path | None:
    """Folder of the persistent compilation cache; None for a user without a home folder."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return None if base.startswith("~") else Path(base) / "kslc_jax"


def prepare(gl: bool = True) -> None:
    """Sets environment variables; call it before JAX and MuJoCo are imported.

    It makes XLA quiet, and sets a persistent compilation cache and the number of threads that this
    process may use. With `gl` it also chooses the library that draws off screen. Variables that the
    user has set stay. The exceptions are those of `NUMERICS`: it removes them, with a
    warning on stderr.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if folder := cache_dir():
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    if processors.usable() < processors.affine():
        os.environ.setdefault(XLA_THREADS, str(processors.usable()))
    if others := fix_numerics():
        why = "would change numbers or raise errors"
        print(f"warning: {', '.join(others)} ignored: {why}", file=sys.stderr)
    if gl:
        choose_gl()


def fix_numerics() -> list[str]:
    """Resets the options of `NUMERICS` in the environment, and in JAX if it is already imported.

    Returns the options that had another value, as NAME=VALUE.
    """
    found = {}
    for name, ours in NUMERICS.items():
        text = os.environ.pop(name.upper(), "")
        if text and not _means(text, ours):
            found[name.upper()] = text
        if jax := sys.modules.get("jax"):
            value = _option(jax.config, name, ours)  # a JAX version may lack an option
            if value != ours:
                found.setdefault(name.upper(), str(value))
                jax.config.update(name, ours)
    return [f"{name}={value}" for name, value in found.items()]


def _option(options: Any, name: str, default: Value) -> Value:
    """The present value of an option in `jax.config`; `default` if this JAX lacks it."""
    return getattr(options, name, options.values.get(name, default))


@contextlib.contextmanager
def own_numerics() -> Generator[None]:
    """At its end the options of `NUMERICS` in JAX and in the environment are what they were.

    A command may run in a notebook whose user has chosen, say, 64-bit numbers.
    """
    texts = {name: text for name in NUMERICS if (text := os.environ.get(name.upper()))}
    jax = sys.modules.get("jax")
    before = {name: _option(jax.config, name, x) for name, x in NUMERICS.items()} if jax else {}
    try:
        yield
    finally:
        os.environ.update({name.upper(): text for name, text in texts.items()})
        if not jax and (jax := sys.modules.get("jax")):  # the command imported it
            before = {name: _read_as(text, NUMERICS[name]) for name, text in texts.items()}
        for name, value in before.items():
            if jax and name in jax.config.values:
                _set(jax.config, name, value)


def _set(options: Any, name: str, value: Value) -> None:
    """Sets an option in `jax.config`. A value that JAX cannot read changes nothing."""
    if isinstance(value, str) and isinstance(NUMERICS[name], bool):
        return  # JAX would take any text for True
    with contextlib.suppress(ValueError):
        options.update(name, value)


def _means(text: str, value: Value) -> bool:
    """True if JAX reads `text` in the environment as `value`."""
    return _read_as(text, value) == value


def _read_as(text: str, like: Value) -> Value:
    """What JAX reads from `text` in the environment, for an option whose default is `like`.

    A text that it cannot read stays a text.
    """
    if isinstance(like, bool):
        return text.lower() in _YES if text.lower() in _YES + _NO else text
    if isinstance(like, int | float):
        with contextlib.suppress(ValueError):
            return type(like)(text)
    return like if text == str(like) else text


def choose_gl() -> None:
    """Sets MUJOCO_GL to egl, else to osmesa, if that library is installed.

    A value that the user has set stays. MuJoCo reads the variable once, at its first import.
    """
    if os.environ.get("MUJOCO_GL"):
        return
    for backend, library in GL_LIBRARIES.items():
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return


LOG_LEVELS = {
    # Orbax raises its errors. It also prints pages of tracebacks of its threads.
    "absl": logging.CRITICAL,
    "asyncio": logging.CRITICAL,
    # Drake warns about deformable bodies at every half space, though there are none.
    "drake": logging.ERROR,
}
"""Levels of other libraries' loggers in a command."""


def is_program() -> bool:
    """True if this process runs a command of this package only, as python -m kslc_jax.train does.

    False in a notebook, or in a program that calls the command. The modules of `benchmarks` count
    as commands.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return spec is not None and spec.name.partition(".")[0] in ("kslc_jax", "benchmarks")


@contextlib.contextmanager
def own_hooks() -> Generator[None]:
    """At its end everything that `quiet` changes is what it was."""
    hooks, show = (sys.excepthook, sys.unraisablehook), warnings.formatwarning
    levels = {name: logging.getLogger(name).level for name in LOG_LEVELS}
    try:
        yield
    finally:
        sys.excepthook, sys.unraisablehook = hooks
        warnings.formatwarning = show
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def quiet() -> None:
    """Silences error reports of libraries, and prints Python warnings and Ctrl-C in one line.

    This package reports these errors itself. The function changes the whole process, so only
    commands call it.
    """
    for name, level in LOG_LEVELS.items():
        logging.getLogger(name).setLevel(level)
    sys.excepthook, sys.unraisablehook = _excepthook, _unraisablehook
    warnings.formatwarning = _one_line  # ty: ignore[invalid-assignment]


def _excepthook(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)  # then Python ends as the signal ends a process
    else:
        sys.__excepthook__(kind, error, trace)


def _unraisablehook(args: "sys.UnraisableHookArgs") -> None:
    # After a failed save, orbax leaves coroutines behind, and threads of tensorstore still call the
    # event loop, which it has closed.
    late = str(args.exc_value) == "Event loop is closed"
    if not (late or inspect.iscoroutine(args.object)):
        sys.__unraisablehook__(args)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> str:
    """A Python warning without the source line that raised it."""
    return f"warning: {message}\n"


def first_line(error: Exception) -> str:
    """The first line of an error's message, at most 200 characters."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def idle_gpu() -> str:
    """A message if JAX does not use an NVIDIA GPU of this machine; else empty."""
    import jax

    if jax.default_backend() != "cpu" or not NVIDIA.exists():
        return ""
    return f"{IDLE_GPU}: {CUDA_FIX}"


class JaxError(UserError, RuntimeError):
    """The installed JAX cannot train reliably."""


def require_good_jax() -> None:
    """Raises JaxError if the installed JAX is known to hang on this machine."""
    import jax

    check_jax(jax.__version__, jax.default_backend())


def check_jax(version: str, backend: str) -> None:
    """Raises JaxError if this version of JAX hangs on this backend. The message has the fix."""
    if backend == "cpu" and version.startswith(BAD_JAX):
        raise JaxError(f"jax {version} can hang for ever on a CPU, install another: {JAX_FIX}")


class Watchdog:
    """Prints the stack of every thread to stderr if a step takes far longer than those before.

    A thread of Python counts the time and prints. So a pause of the whole process does not count,
    as when a laptop sleeps. A timer of faulthandler would count it, and would read the stacks while
    the program runs: that ended a training by a segmentation fault.
    """

    def __init__(self, factor: float = 20.0, least: float = 60.0, first: float = 600.0):
        self.factor, self.least, self.first = factor, least, first
        self._seconds: deque[float] = deque(maxlen=100)

    def limit(self) -> float:
        """Longest time [s] that the next step may take before the stacks are printed."""
        if not self._seconds:
            return self.first
        return max(self.least, self.factor * statistics.median(self._seconds))

    @contextlib.contextmanager
    def step(self) -> Generator[None]:
        """Watches one step."""
        start, over = time.monotonic(), threading.Event()
        with contextlib.suppress(RuntimeError):  # there can be no more threads
            threading.Thread(target=_report, args=(over, self.limit()), daemon=True).start()
        try:
            yield
        finally:
            over.set()
            self._seconds.append(time.monotonic() - start)


def _report(over: threading.Event, limit: float) -> None:
    """Prints the stacks, unless `over` is set before the process has run for `limit` seconds."""
    ticks = 20  # a pause counts as one tick at most
    for _ in range(ticks):
        if over.wait(limit / ticks):
            return
    with contextlib.suppress(OSError):  # stderr is closed
        os.write(2, f"this step takes longer than {limit:.0f} s; all threads:\n".encode())
        faulthandler.dump_traceback(file=2)
