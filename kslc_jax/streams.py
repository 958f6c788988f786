"""Output of a command whose reader may disappear: `head`, a pager, a closed terminal."""

import contextlib
import errno
import io
import os
import select
import sys
from collections.abc import Generator
from typing import Any, TextIO

GONE = (errno.EPIPE, errno.EIO)
"""Errors of a write without a reader: a closed pipe, a closed terminal."""


class _Sink(io.FileIO):
    """Writes to a file descriptor, and discards data that cannot be written."""

    failure: OSError | None = None
    """First error that lost output although it had a reader, such as a full disk."""

    def write(self, data: Any, /) -> int:
        """Writes or discards the data; returns the number of bytes.

        At a pipe that is full it waits for the reader, as a blocking pipe does, also if another
        program has made the pipe a non-blocking one.
        """
        try:
            while (written := super().write(data)) is None:
                select.select([], [self], [])
            return written
        except OSError as error:
            if error.errno not in GONE:
                self.failure = self.failure or error
            return len(data)


def _lasting(stream: TextIO) -> tuple[TextIO, _Sink]:
    """(a stream like `stream` on which no write fails, its sink).

    A character that the encoding lacks, say of a path, becomes an escape such as \\xf6.
    """
    stream.flush()
    sink = _Sink(stream.fileno(), "w", closefd=False)
    text = io.TextIOWrapper(
        io.BufferedWriter(sink),
        encoding=stream.encoding,
        errors="backslashreplace" if stream.errors == "strict" else stream.errors,
        line_buffering=bool(stream.line_buffering or stream.write_through),
    )
    return text, sink


def open_missing() -> None:
    """Opens /dev/null for standard input, output or error if the process started without them.

    Otherwise the next opened file, such as a checkpoint, would take the free descriptor, and
    libraries would print into it. Python's streams, None until then, are opened, too.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free descriptor
        if getattr(sys, name) is None:
            stream = open(os.devnull, "w" if number else "r")  # noqa: SIM115 (until the end)
            setattr(sys, name, stream)


class Output:
    """Standard output and error of a command, see `lasting`."""

    def __init__(self) -> None:
        self.sinks: list[_Sink] = []

    @property
    def failure(self) -> OSError | None:
        """The error that lost output; None if no output was lost, or if it had no reader."""
        return next((sink.failure for sink in self.sinks if sink.failure), None)


@contextlib.contextmanager
def lasting() -> Generator[Output]:
    """Within the context, no write to the process's own stdout and stderr fails.

    If the caller has replaced these streams, as notebooks do, they stay unchanged.
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
