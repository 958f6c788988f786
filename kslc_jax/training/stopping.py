"""Signals that stop a training: it finishes its train step, saves, and exits."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Generator
from types import FrameType

INSISTENT = (signal.SIGINT, signal.SIGTERM)
"""Signals that end the process at once if they come a second time."""

SIGNALS = (*INSISTENT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
"""Signals that stop a training. A closed terminal sends SIGHUP; schedulers send the last three some
time before they kill."""

SAME_SIGNAL_SECONDS = 1.0
"""Signals within this time [s] count as one: a scheduler that signals every process of a job
reaches a training twice, once through the process that started it."""

Handler = Callable[[int, FrameType | None], None]


@contextlib.contextmanager
def handling(handler: Handler) -> Generator[None]:
    """Calls `handler` at each of `SIGNALS` within the context.

    Python handles signals in the main thread only: in another thread they stay as they are. So does
    a SIGHUP that is ignored, because nohup wants that.
    """
    main = threading.current_thread() is threading.main_thread()
    old = {s: signal.signal(s, handler) for s in SIGNALS if main and not _under_nohup(s)}
    try:
        yield
    finally:
        for number, before in old.items():
            # None: not Python's handler but that of a program around it; it cannot be set again.
            signal.signal(number, signal.SIG_DFL if before is None else before)


def _under_nohup(number: signal.Signals) -> bool:
    return number == signal.SIGHUP and signal.getsignal(number) == signal.SIG_IGN


class Stop:
    """Request to stop; the loop reads it between train steps."""

    def __init__(self) -> None:
        self.requested: str | None = None
        """Name of the first signal; None before it."""
        self._since: float | None = None

    def handle(self, number: int, _: FrameType | None) -> None:
        """Notes a signal; KeyboardInterrupt at the second one of `INSISTENT`."""
        self.requested = self.requested or signal.Signals(number).name
        if number in INSISTENT:
            now = time.monotonic()
            if self._since is not None and now - self._since > SAME_SIGNAL_SECONDS:
                raise KeyboardInterrupt
            self._since = self._since or now


@contextlib.contextmanager
def stop_requests() -> Generator[Stop]:
    """Turns signals into a request to stop within the context."""
    stop = Stop()
    with handling(stop.handle):
        yield stop
