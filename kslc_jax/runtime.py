"""What must be set before JAX starts, and what the machine decides. Imports JAX only when asked."""

import contextlib
import ctypes.util
import faulthandler
import inspect
import logging
import os
import statistics
import sys
import time
from collections import deque
from collections.abc import Generator
from pathlib import Path
from types import TracebackType

from kslc_jax.errors import UserError

BAD_JAX = ("0.10.", "0.11.0")
"""JAX versions whose CPU backend can hang for ever in batched Cholesky factorisations."""

JAX_FIX = "pip install -U 'jax>=0.7.2,!=0.10.*,!=0.11.0'"
"""A JAX that does not, as in pyproject.toml."""


IDLE_GPU = "there is an NVIDIA GPU, but JAX computes on the CPU"

CUDA_FIX = "pip install 'kslc_jax[cuda]'"
"""A JAX that computes on it."""

NVIDIA = Path("/dev/nvidia0")
"""There where the driver of an NVIDIA GPU is."""


GL_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
"""Values of MUJOCO_GL, the better one first, and the libraries that they need."""


def cache_dir() -> Path:
    """Folder of the persistent compilation cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "kslc_jax"


def prepare(gl: bool = True) -> None:
    """Sets environment variables: a quiet XLA, a persistent compilation cache, and with `gl` the
    library that draws off screen. Variables that the user has set stay. Call it before JAX and
    MuJoCo are imported."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_dir()))
    if gl:
        choose_gl()


def choose_gl() -> None:
    """Sets MUJOCO_GL to EGL, or else OSMesa, if the user has not set it and the library is there.
    MuJoCo reads it once, when it is first imported."""
    if os.environ.get("MUJOCO_GL"):
        return
    for backend, library in GL_LIBRARIES.items():
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return


def quiet() -> None:
    """Silences what libraries say of errors that this package reports itself. It changes the whole
    process: for commands only."""
    # Orbax raises what went wrong, and besides tells of it in pages of its threads' tracebacks.
    for name in ("absl", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    sys.excepthook, sys.unraisablehook = _excepthook, _unraisablehook


def _excepthook(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    if str(error) != "Event loop is closed":
        sys.__excepthook__(kind, error, trace)


def _unraisablehook(args: "sys.UnraisableHookArgs") -> None:
    if not inspect.iscoroutine(args.object):
        sys.__unraisablehook__(args)


def first_line(error: Exception) -> str:
    """The first line of an error's message, cut to what fits a terminal."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def idle_gpu() -> str:
    """What to say where an NVIDIA GPU is there that JAX does not use; empty where there is none."""
    import jax

    if jax.default_backend() != "cpu" or not NVIDIA.exists():
        return ""
    return f"{IDLE_GPU}: {CUDA_FIX}"


class JaxError(UserError, RuntimeError):
    """An installed JAX that must not be trained with."""


def require_good_jax() -> None:
    """JaxError where the installed JAX is known to hang on this machine."""
    import jax

    check_jax(jax.__version__, jax.default_backend())


def check_jax(version: str, backend: str) -> None:
    """JaxError for versions that hang on this backend, with the fix."""
    if backend == "cpu" and version.startswith(BAD_JAX):
        raise JaxError(f"jax {version} can hang for ever on a CPU, install another: {JAX_FIX}")


class Watchdog:
    """Prints every thread's stack to stderr while a step takes far longer than those before.

    faulthandler's thread does the waiting and the printing: it runs even where this program's
    threads cannot.
    """

    def __init__(self, factor: float = 20.0, least: float = 60.0, first: float = 600.0):
        self.factor, self.least, self.first = factor, least, first
        self._seconds: deque[float] = deque(maxlen=100)

    def limit(self) -> float:
        """Seconds that the next step may take."""
        if not self._seconds:
            return self.first
        return max(self.least, self.factor * statistics.median(self._seconds))

    @contextlib.contextmanager
    def step(self) -> Generator[None]:
        """Watches over one step."""
        start = time.monotonic()
        faulthandler.dump_traceback_later(self.limit(), file=2)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            self._seconds.append(time.monotonic() - start)
