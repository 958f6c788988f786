"""The profiler's trace of a few train steps: the time that each operation takes."""

import contextlib
from collections.abc import Callable, Generator
from pathlib import Path

import jax

trace = jax.profiler.trace
"""trace(folder): a context that traces host and devices, and writes into a new subfolder."""


def how_to_open(folder: Path) -> str:
    """Says how to open the trace in `folder`."""
    return (
        "open its *.trace.json.gz at ui.perfetto.dev, or all of it with xprof "
        f"(pip install xprof; xprof --logdir '{folder}') or TensorBoard and its profile plugin"
    )


class Profile:
    """Traces `steps` train steps of a loop. It skips the first step, which meets cold caches.

    It changes no number. A trace that cannot be written ends no training: it calls `warn`.
    """

    def __init__(
        self, folder: Path, steps: int, say: Callable[[str], None], warn: Callable[[str], None]
    ):
        self._folder, self._say, self._warn = folder, say, warn
        self._asked = self._left = steps
        self._seen = 0
        self._tracing = contextlib.ExitStack()

    @contextlib.contextmanager
    def step(self, number: int) -> Generator[None]:
        """Context of the train step `number`."""
        self._seen += 1
        if self._seen == 1 or not self._left:
            yield
            return
        if self._left == self._asked:
            self._tracing.enter_context(trace(str(self._folder)))
        with jax.profiler.StepTraceAnnotation("train", step_num=number):
            yield
        self._left -= 1
        if not self._left:
            self._finish()

    def close(self) -> None:
        """Writes the traced steps if the loop ended before all were traced."""
        if self._left:
            self._finish()

    def _finish(self) -> None:
        traced, self._left = self._asked - self._left, 0
        try:
            self._tracing.close()
        except (OSError, RuntimeError) as error:
            self._warn(f"the profile could not be written to {self._folder}: {error}")
            return
        if traced:
            steps = f"{traced} train step{'s' * (traced > 1)}"
            self._say(f"profile of {steps} in {self._folder}: {how_to_open(self._folder)}")
        else:
            self._warn("the training ended before there was a train step to profile")
