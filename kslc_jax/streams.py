"""Output of a command whose reader may go away: `head`, a pager that is left, a closed terminal."""

import contextlib
import errno
import io
import os
import sys
from collections.abc import Generator
from typing import Any, TextIO

GONE = (errno.EPIPE, errno.EIO)
"""Errors of a write that nobody can read any more: a closed pipe, a closed terminal."""


class _Sink(io.FileIO):
    """Writes to a file descriptor, and throws away what cannot be written."""

    failure: OSError | None = None
    """First error that lost output while somebody could read it, such as a full disk."""

    def write(self, data: Any, /) -> int:
        """Number of bytes written or thrown away."""
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in GONE:
                self.failure = self.failure or error
            return len(data)


def _lasting(stream: TextIO) -> tuple[TextIO, _Sink]:
    """A stream like `stream` that no write to it can fail on."""
    stream.flush()
    sink = _Sink(stream.fileno(), "w", closefd=False)
    text = io.TextIOWrapper(
        io.BufferedWriter(sink),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=bool(stream.line_buffering or stream.write_through),
    )
    return text, sink


def open_missing() -> None:
    """Opens /dev/null as standard input, output or error where a process was started without.

    Else the next file that is opened, say a checkpoint, would get what libraries print."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


class Output:
    """Standard output and error of a command, see `lasting`."""

    def __init__(self) -> None:
        self.sinks: list[_Sink] = []

    @property
    def failure(self) -> OSError | None:
        """Why output was lost; None if it was not, or if nobody reads it."""
        return next((sink.failure for sink in self.sinks if sink.failure), None)


@contextlib.contextmanager
def lasting() -> Generator[Output]:
    """Within the context no write to the process's own stdout and stderr fails.

    Streams that somebody has put in their place, as notebooks do, stay as they are.
    """
    output, before = Output(), (sys.stdout, sys.stderr)
    if sys.stdout is sys.__stdout__ and sys.stdout is not None:
        sys.stdout, sink = _lasting(sys.stdout)
        output.sinks.append(sink)
    if sys.stderr is sys.__stderr__ and sys.stderr is not None:
        sys.stderr, sink = _lasting(sys.stderr)
    ours = (sys.stdout, sys.stderr)
    try:
        yield output
    finally:
        for stream in ours:
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before
