"""Keeps the results of a training: metrics, checkpoints, and snapshots of the policy.

With several processes only the first one writes. The others have a `NullRecorder`, so that all
processes run the same loop.
"""

import contextlib
import functools
import math
import shutil
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from kslc_jax import files, policy
from kslc_jax.checkpoint_format import CheckpointError
from kslc_jax.config import Config
from kslc_jax.policy import Policy
from kslc_jax.train_step import TrainState
from kslc_jax.training import checkpoint, wandb_run
from kslc_jax.training.checkpoint import BEST_METRIC
from kslc_jax.training.checkpoint_process import CheckpointStore, LocalStorage
from kslc_jax.training.logs import MetricsFile, Progress
from kslc_jax.training.recovery import NumericsCheck
from kslc_jax.training.run_folder import locked, note_resume, open_folder, writing
from kslc_jax.training.wandb_run import WandbRun

Record = dict[str, float]


class NullRecorder:
    """Does nothing."""

    def at(self, step: int) -> contextlib.AbstractContextManager[None]:
        """Context of a loop that begins after train step `step`."""
        return contextlib.nullcontext()

    def check(self, state: TrainState) -> NumericsCheck:
        """Checks the numbers of a loop that begins with `state`."""
        return NumericsCheck(state)

    def log(self, metrics: dict[str, Any], step: int, took: float) -> Record:
        """Shows and writes the metrics of a train step that took `took` seconds; returns them."""
        return {name: float(value) for name, value in metrics.items()}

    def has_checkpoints(self) -> bool:
        """True if there is a checkpoint to go back to."""
        return False

    def restore(self, like: TrainState) -> TrainState:
        """The latest whole checkpoint; CheckpointError if there is none."""
        raise NotImplementedError

    def due(self) -> bool:
        """True if it is time for a checkpoint."""
        return False

    def save(self, state: TrainState, record: Record) -> None:
        """Writes a checkpoint in the background."""

    def keep_snapshot(self, state: TrainState, step: int) -> None:
        """Writes a snapshot, the policy alone, if one is due after train step `step`."""

    def drop_snapshots(self, after: int) -> None:
        """Removes the snapshots of later train steps than `after`; the training went back to it."""

    def settle(self) -> None:
        """Blocks until the last save is on disk or has failed; the training goes on either way."""

    def finish(self, state: TrainState, record: Record) -> None:
        """Writes the last checkpoint and waits for it."""


class Recorder(NullRecorder):
    """Writes everything into one run folder, and shows the metrics.

    A failed save must not end hours of training: it gives a warning, and the next save tries again.
    Only the last save raises a CheckpointError.
    """

    def __init__(
        self,
        config: Config,
        run_dir: Path,
        store: CheckpointStore,
        progress: Progress,
        save_policy: Callable[[Policy, Path], None] = policy.save_policy,
        wandb: WandbRun | None = None,
        begin: Callable[[int], None] = lambda step: None,
    ):
        """`begin` is called with the train step after which a loop begins."""
        self._begin = begin
        self._config, self._run_dir, self._store = config, run_dir, store
        self._progress, self._save_policy, self._wandb = progress, save_policy, wandb

    @contextlib.contextmanager
    def at(self, step: int) -> Generator[None]:
        self._begin(step)
        with writing(self._run_dir):
            self._file = MetricsFile(self._run_dir, step, self._progress.warn)
        self._begun = time.monotonic() - self._file.seconds_before
        # A new run saves its first train step, so that it can always go back.
        self._saved = time.monotonic() if self._store.steps() else -math.inf
        with contextlib.closing(self._file):
            yield

    def log(self, metrics: dict[str, Any], step: int, took: float) -> Record:
        metrics, batch = super().log(metrics, step, took), self._config.batch_size
        record = metrics | {
            "step": step,
            "env_steps": step * batch,
            "seconds": time.monotonic() - self._begun,
            "steps_per_second": batch / took,
            BEST_METRIC: metrics["curriculum/v_max"] + metrics["curriculum/tracking"],
        }
        if step % self._config.run.log_every == 0:
            self._file.write(record)
            if self._wandb:
                self._wandb.write(record)
        self._progress.show(record)
        return record

    def has_checkpoints(self) -> bool:
        return bool(self._store.steps())

    def restore(self, like: TrainState) -> TrainState:
        return self._store.restore(like, self._progress.warn)

    def due(self) -> bool:
        return time.monotonic() - self._saved > 60.0 * self._config.run.checkpoint_minutes

    def save(self, state: TrainState, record: Record) -> None:
        self.settle()
        with self._going_on():
            self._store.save(state, self._config, record)
        if math.isinf(self._saved):
            self.settle()
        self._saved = time.monotonic()

    def keep_snapshot(self, state: TrainState, step: int) -> None:
        """Writes a snapshot that is due, unless it is there from before a resume."""
        folder = self._run_dir / files.SNAPSHOTS / str(step)
        with self._going_on():
            if snapshot_due(self._config, step) and not folder.exists():
                self._save_policy(checkpoint.policy_of(self._config, state), folder)

    def drop_snapshots(self, after: int) -> None:
        for folder in (self._run_dir / files.SNAPSHOTS).glob("[0-9]*"):
            if folder.name.isdigit() and int(folder.name) > after:
                shutil.rmtree(folder, ignore_errors=True)

    def settle(self) -> None:
        with self._going_on():
            self._store.wait()

    def finish(self, state: TrainState, record: Record) -> None:
        self.settle()
        self._store.save(state, self._config, record)
        self._store.wait()

    @contextlib.contextmanager
    def _going_on(self) -> Generator[None]:
        """Turns a failed save into a warning."""
        try:
            yield
        except CheckpointError as error:
            self._progress.warn(f"{error}; training goes on")


@contextlib.contextmanager
def opened(
    config: Config,
    run_dir: Path,
    resume: bool,
    facts: dict[str, Any],
    progress: Progress,
    storage: LocalStorage,
    wandb: bool,
) -> Generator[Recorder]:
    """Opens the run folder and locks it for this process."""
    if wandb:
        wandb_run.package()  # before anything is written
    if not resume:
        with writing(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
    with locked(run_dir), contextlib.ExitStack() as stack:
        open_folder(run_dir, config, resume, facts)
        with writing(run_dir):
            store = stack.enter_context(contextlib.closing(storage.open(run_dir, config)))
        over = max(store.steps(), default=0) >= config.num_updates  # a resume does nothing then
        send = wandb and not over
        online = wandb_run.wandb_run(config, run_dir, resume, progress.warn) if send else None
        run = stack.enter_context(online) if online else None
        begin = functools.partial(note_resume, run_dir, config, facts)
        yield Recorder(config, run_dir, store, progress, storage.save_policy, run, begin)


def snapshot_due(config: Config, step: int) -> bool:
    """True if one of `run.snapshots` equal parts of the run ends with this train step."""
    parts, steps = config.run.snapshots, config.num_updates
    return step * parts // steps > (step - 1) * parts // steps
