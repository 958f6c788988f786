"""Signals that stop a training. It finishes its train step, saves, and exits."""

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Generator
from types import FrameType

INSISTENT = (signal.SIGINT, signal.SIGTERM)
"""Signals that end the process at once if they come a second time."""

SIGNALS = (*INSISTENT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
"""Signals that stop a training. A closed terminal sends SIGHUP. Schedulers send the last three some
time before they kill the process."""

SAME_SIGNAL_SECONDS = 1.0
"""Signals within this time [s] count as one. A scheduler signals every process of a job. A training
then gets the signal twice: directly, and from the process that started it."""

Handler = Callable[[int, FrameType | None], None]


@contextlib.contextmanager
def handling(handler: Handler) -> Generator[None]:
    """Within the context, each of `SIGNALS` calls `handler`.

    In another thread than the main thread this changes nothing, because Python handles signals in
    the main thread only. An ignored signal stays ignored: nohup needs that for SIGHUP, and a
    shell's background jobs for Ctrl-C.
    """
    main = threading.current_thread() is threading.main_thread()
    ours = [s for s in SIGNALS if main and signal.getsignal(s) != signal.SIG_IGN]
    old = {s: signal.signal(s, handler) for s in ours}
    try:
        yield
    finally:
        for number, before in old.items():
            # None: the handler was not set by Python, so Python cannot restore it.
            signal.signal(number, signal.SIG_DFL if before is None else before)


class Stop:
    """A request to stop. The loop reads it between train steps."""

    def __init__(self) -> None:
        self.requested: str | None = None
        """Name of the first signal; None if there was none."""
        self._since: float | None = None

    def handle(self, number: int, _: FrameType | None) -> None:
        """Records a signal. Raises KeyboardInterrupt at the second signal of `INSISTENT`."""
        self.requested = self.requested or signal.Signals(number).name
        if number in INSISTENT:
            now = time.monotonic()
            if self._since is not None and now - self._since > SAME_SIGNAL_SECONDS:
                raise KeyboardInterrupt
            self._since = self._since or now


@contextlib.contextmanager
def stop_requests() -> Generator[Stop]:
    """Within the context, signals become a request to stop."""
    stop = Stop()
    with handling(stop.handle):
        yield stop
