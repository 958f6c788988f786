"""What a person sees of a training: JSONL and TensorBoard files, and progress on the terminal."""

import json
import time
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.table import Table
from tensorboardX import SummaryWriter

from kslc_jax.config import Config

PLAIN_SECONDS = 10.0
"""Seconds between progress lines where the output is no terminal."""


class MetricsFile:
    """metrics.jsonl (one record a line) and TensorBoard events of one run folder.

    Going on from train step `after` drops the records that lie behind it: the resumed run writes
    them again.
    """

    def __init__(self, run_dir: Path, after: int = 0):
        self.path = run_dir / "metrics.jsonl"
        self.seconds_before = 0.0
        """Wall time [s] that the kept records have seen."""
        if self.path.exists():
            kept = [line for line in self.path.read_text().splitlines() if _step(line) <= after]
            self.path.write_text("".join(f"{line}\n" for line in kept))
            self.seconds_before = json.loads(kept[-1]).get("seconds", 0.0) if kept else 0.0
        self._file = self.path.open("a")
        self._board = SummaryWriter(str(run_dir / "tensorboard"), purge_step=after)

    def write(self, record: dict[str, float]) -> None:
        """Appends one record; on disk at once."""
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()
        for name, value in record.items():
            self._board.add_scalar(name, value, int(record["env_steps"]))

    def close(self) -> None:
        """Flushes both."""
        self._file.close()
        self._board.close()


def _step(line: str) -> int:
    """Train step of a record; a torn last line counts as behind everything."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return 2**62


def duration(seconds: float) -> str:
    """h:mm:ss."""
    minutes, s = divmod(int(max(seconds, 0)), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{s:02d}"


class Progress:
    """Live table on a terminal, a line every few seconds elsewhere."""

    def __init__(self, config: Config, console: Console | None = None):
        self.config = config
        self.console = console or Console(highlight=False, soft_wrap=True)
        self._live: Live | None = None
        self._printed = 0.0

    def say(self, message: str) -> None:
        """One line above the progress."""
        self.console.print(message, markup=False)

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
        """What matters most, by name."""
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
        """Headline above the reward terms with their weights."""
        table = Table(title=self._line(record), title_justify="left", title_style="bold")
        for column in ("reward term", "value", "weight", "weighted"):
            table.add_column(column, justify="left" if column == "reward term" else "right")
        weights = self.config.rewards.weights
        for name, value in record.items():
            term = name.removeprefix("reward/")
            if term == name or getattr(weights, term) == 0:
                continue
            weight = getattr(weights, term)
            table.add_row(term, f"{value:.4g}", f"{weight:g}", f"{weight * value:+.4f}")
        return table
