"""Records of the metrics: JSONL and TensorBoard files, and the progress on the terminal."""

import contextlib
import json
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2
from tensorboardX.summary import Summary

from kslc_jax import curriculum, files
from kslc_jax.config import Config
from kslc_jax.curriculum import Curriculum

PLAIN_SECONDS = 10.0
"""Time [s] between two progress lines if the output is no terminal."""


def rows_written(run_dir: Path) -> int:
    """Number of records in a run folder's metrics.jsonl."""
    path = run_dir / files.METRICS
    return path.read_bytes().count(b"\n") if path.exists() else 0


class MetricsFile:
    """Writes metrics.jsonl (one record per line) and TensorBoard events of one run folder.

    It removes the records after train step `after`, because the resumed run writes them again. If
    the disk is full, it calls `warn` once and keeps the records in memory until there is room.
    """

    def __init__(self, run_dir: Path, after: int = 0, warn: Callable[[str], None] = print):
        self.path = run_dir / files.METRICS
        self.seconds_before = 0.0
        """Wall time [s] at the last kept record."""
        kept = []
        if self.path.exists():
            lines = self.path.read_text(errors="replace").splitlines()
            kept = [line for line in lines if _step(line) <= after]
            files.write_atomically(self.path, "".join(f"{line}\n" for line in kept))
        last = json.loads(kept[-1]) if kept else {}
        self.seconds_before = last.get("seconds", 0.0)
        self._file = self.path.open("ab", buffering=0)
        self._waiting = b""
        self._board = _Board(run_dir / files.TENSORBOARD, int(last.get("env_steps", 0)))
        self._warn, self._full = warn, False

    def write(self, record: dict[str, float]) -> None:
        """Appends one record to the disk at once."""
        self._waiting += (json.dumps(record) + "\n").encode()
        try:
            self._flush()
            self._board.write(record)
            self._full = False
        except OSError as error:
            if not self._full:
                self._warn(f"cannot write metrics ({error.strerror}); training goes on")
            self._full = True

    def _flush(self) -> None:
        """Writes as much as fits. If a full disk cuts a line off, a later call completes it."""
        while self._waiting:
            self._waiting = self._waiting[self._file.write(self._waiting) :]

    def close(self) -> None:
        """Writes the records that still wait, and closes the files."""
        with contextlib.suppress(OSError):  # already reported
            self._flush()
        with contextlib.suppress(OSError):
            self._board.close()
        self._file.close()


class _Board:
    """Writes TensorBoard events in the thread of the caller.

    The SummaryWriter of tensorboardX has its own thread. That thread dies if the disk is full, and
    the training would then wait for it for ever.
    """

    def __init__(self, folder: Path, after: int):
        folder.mkdir(exist_ok=True)
        self._events = EventsWriter(str(folder / "events"), f".{os.getpid()}.{after}")
        # This event makes TensorBoard hide older records beyond `after`.
        session = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        self._events.write_event(event_pb2.Event(step=after + 1, session_log=session))

    def write(self, record: dict[str, float]) -> None:
        """Writes the finite values of one record over its env_steps."""
        values = [
            Summary.Value(tag=name, simple_value=value)
            for name, value in finite_values(record).items()
        ]
        step = int(record["env_steps"])
        event = event_pb2.Event(wall_time=time.time(), step=step, summary=Summary(value=values))
        self._events.write_event(event)
        self._events.flush()

    def close(self) -> None:
        """Writes the last events and closes the file."""
        self._events.close()


def finite_values(record: dict[str, float]) -> dict[str, float]:
    """The values of a record that a curve can show."""
    return {name: value for name, value in record.items() if math.isfinite(value)}


def _step(line: str) -> int:
    """Train step of a record. A line that is cut off gets a number larger than any other."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return 2**62


def duration(seconds: float) -> str:
    """A time [s] as h:mm:ss."""
    minutes, s = divmod(int(max(seconds, 0)), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{s:02d}"


class Progress:
    """Shows a live table on a terminal; otherwise prints a line every few seconds."""

    def __init__(self, config: Config, console: Console | None = None):
        self.config = config
        self.console = console or Console(highlight=False, soft_wrap=True)
        self._live: Live | None = None
        self._printed = 0.0

    def say(self, message: str) -> None:
        """Prints one line above the table."""
        self.console.print(message, markup=False)

    def warn(self, message: str) -> None:
        """Prints a warning; the training goes on."""
        self.say(f"warning: {message}")

    def show(self, record: dict[str, float]) -> None:
        """Shows one record of metrics."""
        if self.console.is_terminal:
            if self._live is None:
                self._live = Live(console=self.console, auto_refresh=False)
                self._live.start()
            self._live.update(self._table(record), refresh=True)
        elif time.monotonic() - self._printed > PLAIN_SECONDS:
            self._printed = time.monotonic()
            self.console.print(self._line(record), markup=False)

    def close(self) -> None:
        """Leaves the last table on the screen."""
        if self._live is not None:
            self._live.stop()

    def _headline(self, r: dict[str, float]) -> dict[str, str]:
        """The most important values, by name."""
        left = (self.config.run.steps - r["env_steps"]) / max(r["steps_per_second"], 1e-9)
        return {
            "steps": f"{r['env_steps'] / 1e6:.2f}M/{self.config.run.steps / 1e6:.1f}M",
            "steps/s": f"{r['steps_per_second']:.0f}",
            "elapsed": duration(r["seconds"]),
            "ETA": duration(left),
            "episode": f"{r['episode_steps']:.0f}/{self.config.episode_steps}",
            "tracking": f"{r['tracking']:.2f}",
            "fast tracking": f"{r['fast_tracking']:.2f}",
            "v_max": f"{r['curriculum/v_max']:.1f} m/s",
            "cycle": f"{r['curriculum/cycle_time']:.2f} s",
        }

    def _line(self, record: dict[str, float]) -> str:
        return "  ".join(f"{name} {value}" for name, value in self._headline(record).items())

    def _table(self, record: dict[str, float]) -> Table:
        """The headline beside the reward terms and their weights, in 80 columns."""
        head = Table.grid(padding=(0, 1))
        for name, value in self._headline(record).items():
            head.add_row(name, f"[bold]{value}")
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for column in ("reward term", "value", "weight", "weighted"):
            table.add_column(column, justify="left" if column == "reward term" else "right")
        weights = self.config.rewards.weights
        for name, value in record.items():
            term = name.removeprefix("reward/")
            if term == name or getattr(weights, term) == 0:
                continue
            weight = getattr(weights, term)
            table.add_row(term, f"{value:.4g}", f"{weight:g}", f"{weight * value:+.4f}")
        both = Table.grid(padding=(0, 1))
        both.add_row(head, table)
        return both


class SeedsProgress(Progress):
    """Shows the median, the lowest and the highest value of each metric over the seeds."""

    def __init__(self, config: Config, console: Console | None = None):
        super().__init__(config, console)
        self.records: list[dict[str, float]] = []
        """The latest record of each seed that trains."""
        self.stopped: list[str] = []
        """Names of the seeds whose numbers went bad."""

    def _columns(self) -> list[dict[str, float]]:
        names = self.records[0]
        values = {name: [record[name] for record in self.records] for name in names}
        return [{n: float(f(v)) for n, v in values.items()} for f in (np.median, min, max)]

    def _title(self) -> str:
        rate = sum(record["steps_per_second"] for record in self.records)
        stopped = f"; stopped: {', '.join(self.stopped)}" if self.stopped else ""
        count = len(self.records)
        return f"{count} seed{'s' * (count > 1)}, {rate:.0f} steps/s in all{stopped}"

    def _line(self, record: dict[str, float]) -> str:
        middle, low, high = map(self._headline, self._columns())
        said = [
            f"{name} {text}"
            + (f" ({low[name]} to {high[name]})" if low[name] != high[name] else "")
            for name, text in middle.items()
        ]
        return "  ".join([self._title(), *said])

    def _table(self, record: dict[str, float]) -> Table:
        table = Table(box=box.SIMPLE_HEAD, title=self._title(), title_justify="left")
        for column in ("metric", "median", "lowest", "highest"):
            table.add_column(column, justify="left" if column == "metric" else "right")
        columns = self._columns()
        heads = [self._headline(column) for column in columns]
        for name in heads[0]:
            table.add_row(name, *(head[name] for head in heads))
        weights = self.config.rewards.weights
        for name in columns[0]:
            term = name.removeprefix("reward/")
            if term != name and getattr(weights, term) != 0:
                table.add_row(term, *(f"{column[name]:.4g}" for column in columns))
        return table


def range_reached(config: Config, state: Curriculum) -> list[str]:
    """A line for each seed whose range of commands did not grow to its limit, with the reasons."""
    lines, limits = [], config.curriculum
    for i in range(np.size(state.v_max)):
        one = jax.tree.map(lambda x, i=i: np.atleast_1d(x)[i], state)
        if limits.velocity and one.v_max < limits.v_limit:
            unmet = [name for name, met in curriculum.conditions(limits, one).items() if not met]
            reasons = f"not good enough at the end: {', '.join(unmet)}"
            whose = f"seed {config.seed + i}: " * (np.size(state.v_max) > 1)
            lines.append(
                f"{whose}the commands grew to {one.v_max:g} of {limits.v_limit:g} m/s; "
                + (reasons if unmet else "all conditions for more were met")
            )
    return lines
