"""Several seeds of one training in one program: `train --seeds N`.

The train step is vmapped over a leading axis of seeds. The seeds share nothing, so each one
computes what it computes alone, up to the rounding of batched matrix products. On disk each seed is
an ordinary run folder, RUN/seed-S, with its own lock, metrics and checkpoints. A seed goes on from
its own latest checkpoint, and ends when it has done all its train steps; seeds need not be at the
same train step.

A seed whose numbers go bad stops, and the others go on. The program still computes its numbers, but
nobody reads them. Its folder keeps its last good checkpoint. A single training resumes from there
with a lower learning rate, see `recovery`.
"""

import contextlib
import dataclasses
import functools
import shlex
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from kslc_jax import files, train_step
from kslc_jax.checkpoint_format import CheckpointError, has_checkpoints
from kslc_jax.config import Config, RunConfig
from kslc_jax.train_step import Metrics, TrainState
from kslc_jax.training import recorder as recorder_lib
from kslc_jax.training import run_folder, same_training
from kslc_jax.training.checkpoint_process import LocalStorage
from kslc_jax.training.logs import Progress, SeedsProgress
from kslc_jax.training.recorder import NullRecorder, Record, Recorder
from kslc_jax.training.recovery import NonFiniteState, NumbersError, NumericsCheck

# ------------------------------------------------------------------------------------- the program


def make(
    config: Config, count: int
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """(init, train_step) as from `train_step.make`, for the seeds `config.seed` to + `count` - 1.

    All arrays of the state and of the metrics have a leading axis [count].
    """
    init, step = _jitted(dataclasses.replace(config, seed=0, run=RunConfig()))
    return lambda: init(config.seed + jnp.arange(count)), step


@functools.lru_cache(maxsize=8)
def _jitted(config: Config) -> tuple[Any, Any]:
    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        return train_step.step(config, state)

    init = jax.vmap(functools.partial(train_step.init, config))
    return jax.jit(init), jax.jit(jax.vmap(step), donate_argnums=0)


@jax.jit
def one_of(states: TrainState, index: int) -> TrainState:
    """The state of one seed. The index is traced, so all seeds share one program."""
    return jax.tree.map(lambda x: x[index], states)


# --------------------------------------------------------------------------------------- recording


class _OneOf(Progress):
    """The messages of one seed, with its name. The table of all seeds shows its metrics."""

    def __init__(self, whole: Progress, name: str):
        super().__init__(whole.config, whole.console)
        self._name = name

    def say(self, message: str) -> None:
        super().say(f"{self._name}: {message}")

    def show(self, record: Record) -> None:
        """Shows nothing."""


@dataclass
class _Seed:
    """One seed on the host."""

    config: Config
    folder: Path
    progress: Progress
    recorder: Recorder
    check: NumericsCheck = dataclasses.field(init=False)
    record: Record = dataclasses.field(default_factory=dict)
    step: int = 0  # train steps done
    over: bool = False  # True: all its train steps are done and saved, or its numbers went bad
    bad: str = ""  # why it stopped early

    @property
    def last(self) -> bool:
        """True after the last train step."""
        return self.step >= self.config.num_updates


def opened(count: int) -> Callable[..., contextlib.AbstractContextManager["SeedsRecorder"]]:
    """`recorder.opened` for so many seeds: it opens and locks all their run folders."""

    @contextlib.contextmanager
    def open_all(
        config: Config,
        run_dir: Path,
        resume: bool,
        facts: dict[str, Any],
        progress: SeedsProgress,
        storage: LocalStorage,
        wandb: bool,
    ) -> Generator[SeedsRecorder]:
        with contextlib.ExitStack() as stack:
            if resume:
                folders = [files.seed_folder(run_dir, seed) for seed in files.seeds_in(run_dir)]
                stored = [run_folder.read_config(folder) for folder in folders]
                same_training.require_seeds(run_dir, stored, config)
            else:
                run_folder.require_free(run_dir)
            seeds = []
            for number in range(config.seed, config.seed + count):
                its = dataclasses.replace(config, seed=number)
                folder = files.seed_folder(run_dir, number)
                voice = _OneOf(progress, folder.name)
                # A kill during the very first save leaves seeds without a checkpoint: these begin.
                going_on = resume and has_checkpoints(folder)
                recorder = recorder_lib.opened(its, folder, going_on, facts, voice, storage, wandb)
                seeds.append(_Seed(its, folder, voice, stack.enter_context(recorder)))
            yield SeedsRecorder(seeds, progress)

    return open_all


class SeedsRecorder(NullRecorder):
    """The recorders of all seeds, for a loop over their common state."""

    def __init__(self, seeds: list[_Seed], progress: SeedsProgress):
        self._seeds, self._progress = seeds, progress

    def _going(self) -> list[tuple[int, _Seed]]:
        """The seeds that train, with their index in the state."""
        return [(i, seed) for i, seed in enumerate(self._seeds) if not seed.over]

    def restore(self, like: TrainState) -> TrainState:
        """The latest whole checkpoint of each seed; its first state if it has none."""
        single = jax.eval_shape(lambda s: one_of(s, 0), like)
        states = [
            seed.recorder.restore(single)
            if seed.recorder.has_checkpoints()
            else train_step.make(seed.config)[0]()
            for seed in self._seeds
        ]
        for seed, state in zip(self._seeds, states, strict=True):
            seed.step = int(state.step)
            seed.over = seed.last
        return jax.tree.map(lambda *x: jnp.stack(x), *states)

    @contextlib.contextmanager
    def at(self, step: int) -> Generator[None]:
        with contextlib.ExitStack() as stack:
            for _, seed in self._going():
                stack.enter_context(seed.recorder.at(seed.step))
            yield

    def check(self, state: TrainState) -> NumericsCheck:
        for _, seed in self._going():
            seed.check = NumericsCheck(state)
        return SeedsCheck(self._seeds, state)

    def log(self, metrics: dict[str, Any], step: int, took: float) -> Record:
        """Writes the metrics [seeds] of each seed that trains, and shows the table.

        Returns the record of one of them.
        """
        for i, seed in self._going():
            seed.step = int(metrics["step"][i])
            its = {name: values[i] for name, values in metrics.items()}
            seed.record = seed.recorder.log(its, seed.step, took)
        going = [seed.record for _, seed in self._going()]
        self._progress.records = going
        self._progress.stopped = [seed.folder.name for seed in self._seeds if seed.bad]
        self._progress.show(going[0])
        return going[0]

    def due(self) -> bool:
        return any(seed.last or seed.recorder.due() for _, seed in self._going())

    def save(self, state: TrainState, record: Record) -> None:
        """Writes a checkpoint of each seed that trains. A seed that is done ends with it."""
        for i, seed in self._going():
            if seed.last:
                self._finish(i, seed, state)
            elif seed.check.good:
                seed.recorder.save(one_of(state, i), seed.record)

    def keep_snapshot(self, state: TrainState, step: int) -> None:
        for i, seed in self._going():
            if seed.check.good and recorder_lib.snapshot_due(seed.config, seed.step):
                seed.recorder.keep_snapshot(one_of(state, i), seed.step)

    def finish(self, state: TrainState, record: Record) -> None:
        """Saves all seeds that train. CheckpointError if one of them cannot be saved."""
        failed = [self._finish(i, seed, state) for i, seed in self._going()]
        for error in filter(None, failed):
            raise error

    def _finish(self, index: int, seed: _Seed, state: TrainState) -> CheckpointError | None:
        """Writes the last checkpoint of a seed; a failure must not end the others."""
        seed.over = True
        try:
            if seed.check.finite:
                seed.recorder.finish(one_of(state, index), seed.record)
        except CheckpointError as error:
            seed.bad = str(error)
            seed.progress.warn(seed.bad)
            return error
        return None


class SeedsCheck(NumericsCheck):
    """Checks each seed, and stops those whose numbers are bad."""

    def __init__(self, seeds: list[_Seed], state: TrainState):
        super().__init__(state)
        self._seeds = seeds

    @property
    def good(self) -> bool:
        return True  # the recorder asks the check of each seed

    finite = good

    def before(self, state: TrainState) -> None:
        """NumbersError if no seed trains any more: some have stopped, the others are done.

        It keeps no copy of the state, because a seed that stops resumes from its checkpoint.
        """
        if all(seed.over for seed in self._seeds):
            self.require_some_good()

    def after(self, metrics: Record) -> str:
        """Checks the latest record of each seed that trains. The seeds say their own warnings."""
        for seed in self._seeds:
            if seed.over:
                continue
            if warning := seed.check.after(seed.record):
                seed.progress.warn(warning)
            try:
                seed.check.require_good()
            except NonFiniteState as bad:
                seed.bad, seed.over = str(bad), True
                seed.progress.warn(f"{bad} at train step {seed.step}; the other seeds go on")
        return ""

    def require_good(self) -> None:
        """Does nothing: `after` has stopped the bad seeds."""

    def require_some_good(self) -> None:
        """NumbersError if a seed has stopped, or has learnt nothing; the others are saved."""
        for seed in self._seeds:
            try:
                if seed.record and not seed.bad:
                    seed.check.require_some_good()
            except NumbersError as error:
                seed.bad = str(error)
        bad = [seed for seed in self._seeds if seed.bad]
        if bad:
            names = ", ".join(f"{s.folder.name} (train step {s.step}: {s.bad})" for s in bad)
            raise NumbersError(
                f"{len(self._seeds) - len(bad)} of {len(self._seeds)} seeds are done; stopped: "
                f"{names}; go on with one alone: python -m kslc_jax.train --resume --run-dir "
                f"{shlex.quote(str(bad[0].folder))}"
            )
