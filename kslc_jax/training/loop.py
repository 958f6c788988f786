"""The host's loop around the jitted train step: stepping, going back, stopping.

Everything that decides a number is in `train_step`; this file only calls it, reads its metrics, has
them kept, and stops. Of several processes each runs this loop; what one of them alone can know (a
signal, the clock, what is on the disk) they tell each other through `devices`.
"""

import contextlib
import functools
import os
import shlex
import signal
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import jax
from jax.sharding import Mesh

from kslc_jax import files, physics, train_step
from kslc_jax.config import Config, ConfigError
from kslc_jax.curriculum import Curriculum
from kslc_jax.networks import Params
from kslc_jax.runtime import Watchdog
from kslc_jax.train_step import TrainState
from kslc_jax.training import devices, memory, profiling, recovery
from kslc_jax.training.checkpoint_process import Disk, DiskProcess
from kslc_jax.training.logs import Progress
from kslc_jax.training.recorder import Keeper, Onlooker, Record, snapshot_due
from kslc_jax.training.recovery import Health, WentBad
from kslc_jax.training.run_folder import locked, open_folder, writing

ONE_WISH = 1.0
"""Seconds within which signals count as one: a scheduler that signals every process of a job tells
a training twice, itself and by way of what started it."""


class _Stop:
    """Turns the first SIGINT or SIGTERM into a request that the loop reads between steps."""

    def __init__(self) -> None:
        self.requested: str | None = None
        self._since = 0.0

    def __enter__(self) -> "_Stop":
        self._old = {s: signal.signal(s, self._handle) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        if not self.requested:
            self.requested, self._since = signal.Signals(number).name, time.monotonic()
        elif time.monotonic() - self._since > ONE_WISH:  # a second one means now
            raise KeyboardInterrupt


@dataclass(frozen=True)
class _Job:
    """One training: what, where, on what, and who says and keeps what."""

    config: Config
    run_dir: Path
    resume: bool
    mesh: Mesh | None
    progress: Progress
    keeper: Onlooker
    profile: profiling.Profile
    like: TrainState  # shapes
    init: Callable[[], TrainState]
    step: Any  # jitted

    def restored(self) -> TrainState:
        """The latest whole checkpoint, on its devices."""
        state = devices.from_first(lambda: self.keeper.restore(self.like), self.like)
        return state if self.mesh is None else devices.place(self.mesh, state)


def train(
    config: Config,
    run_dir: Path,
    resume: bool,
    progress: Progress,
    start_from: Path | None = None,
    mesh: Mesh | None = None,
    profile: int = 0,
) -> TrainState:
    """Trains until `config.run.steps` or a signal, and saves the state; every few minutes too.

    Args:
      config: what to train.
      run_dir: where everything goes; of several processes only the first one's matters.
      resume: go on from the run folder's latest checkpoint.
      progress: shows it.
      start_from: a policy whose networks and curriculum a new training begins with.
      mesh: the devices of all processes, see `devices.mesh`; one device without.
      profile: train steps to trace, see `profiling`.

    Raises:
      RunError, ConfigError, CheckpointError: it cannot start, or its last state cannot be saved.
      NumbersError: numbers went bad again and again.
      Elsewhere: one of these in the first process, where this is another.
    """
    init, step = train_step.make(config) if mesh is None else devices.make(config, mesh)
    like = jax.eval_shape(init)
    memory.check(config, like, 1 if mesh is None else mesh.size)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.closing(progress))
        disk = DiskProcess() if devices.several() and devices.is_first() else Disk()
        stack.enter_context(contextlib.closing(disk))
        origin: dict[str, str] = {}
        if start_from is not None:
            init, origin = _starting_from(start_from, config, init, disk, mesh)
        keeper = devices.on_first(
            lambda: stack.enter_context(_keeper(config, run_dir, resume, origin, progress, disk))
        )
        tracing = profiling.Profile(
            run_dir / files.PROFILE,
            profile if devices.is_first() else 0,
            progress.say,
            progress.warn,
        )
        kept = keeper or Onlooker()
        return _persist(
            _Job(config, run_dir, resume, mesh, progress, kept, tracing, like, init, step)
        )


@contextlib.contextmanager
def _keeper(
    config: Config,
    run_dir: Path,
    resume: bool,
    origin: dict[str, str],
    progress: Progress,
    disk: Disk,
) -> Generator[Keeper]:
    """Opens the run folder, which is this process's alone meanwhile."""
    if not resume:
        with writing(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
    with locked(run_dir):
        open_folder(run_dir, config, resume, origin)
        with writing(run_dir):
            store = disk.open(run_dir, config)
        with contextlib.closing(store):
            yield Keeper(config, run_dir, store, progress, disk.save_policy)


def _starting_from(
    path: Path, config: Config, init: Callable[[], TrainState], disk: Disk, mesh: Mesh | None
) -> tuple[Callable[[], TrainState], dict[str, str]]:
    """`init` with a policy's networks and curriculum, and where they come from."""
    start = functools.partial(train_step.start_from, config)
    like = jax.eval_shape(init)
    step = 0

    def chosen() -> tuple[Params, Curriculum]:
        nonlocal step
        policy = disk.load_policy(path)
        step = policy.step
        try:
            jax.eval_shape(start, like, policy.params, policy.curriculum)
        except ValueError as error:
            raise ConfigError(
                f"cannot start from {path}: it has {error}, see network and env.frames in its "
                "config"
            ) from error
        return policy.params, policy.curriculum

    params, curriculum = devices.from_first(chosen, (like.learner.params, like.curriculum))

    def begin() -> TrainState:
        state = start(init(), params, curriculum)
        return state if mesh is None else devices.place(mesh, state)

    return begin, {"start_from": f"{path}, train step {step}"}


def _persist(job: _Job) -> TrainState:
    """Compiles and trains; goes back to a checkpoint where numbers go bad."""
    start = time.monotonic()
    state = job.restored() if job.resume else job.init()
    if job.resume:
        job.progress.say(f"resumed at train step {int(state.step)}")
    compiled = job.step.lower(job.like).compile()
    seconds, need = time.monotonic() - start, memory.measured(compiled)
    needs = f", needs {memory.shown(need)}" if need else ""
    job.progress.say(f"compiled in {seconds:.0f} s{needs}; training")

    def again() -> TrainState:
        job.keeper.settle()
        (there,) = devices.agree(job.keeper.has_checkpoints())
        state = job.restored() if there else job.init()
        job.keeper.drop_snapshots(int(state.step))
        return state

    def go(state: TrainState) -> TrainState:
        try:
            return _loop(job, state, compiled)
        except WentBad as bad:  # it may have to be written down
            raise WentBad(str(bad), devices.whole(bad.before)) from bad

    with contextlib.closing(job.profile):
        folder = job.run_dir if devices.is_first() else Path(os.devnull)
        return recovery.persist(job.config, folder, go, state, again, job.progress.warn)


def _loop(job: _Job, state: TrainState, step_fn: Any) -> TrainState:
    """Steps; returns the last state, which is kept."""
    first = int(state.step)
    record: Record = {}
    health, watchdog = Health(state), Watchdog()
    with _Stop() as stop, contextlib.ExitStack() as opened:
        devices.on_first(lambda: opened.enter_context(job.keeper.at(first)))
        for step in range(first + 1, job.config.num_updates + 1):
            health.before(state)
            with job.profile.step(step), watchdog.step():
                tick = time.monotonic()
                state, metrics = step_fn(state)
                record = {name: float(value) for name, value in jax.device_get(metrics).items()}
                took = time.monotonic() - tick
            record = job.keeper.log(record, step, took)
            health.after(record)
            if health.good and snapshot_due(job.config, step):
                job.keeper.keep_snapshot(state)
            stopped, due = devices.agree(stop.requested is not None, job.keeper.due())
            if stopped:
                stop.requested = stop.requested or "a signal to another process"
                break
            health.check()
            if health.good and due:
                job.keeper.save(devices.whole(state), record)
        if record and health.finite:
            last = devices.whole(state)
            devices.on_first(lambda: job.keeper.finish(last, record))
    _farewell(job, int(state.step), stop.requested, health.finite)
    return state


def _farewell(job: _Job, step: int, stopped_by: str | None, whole: bool) -> None:
    saved = "saved" if whole else "not saved: the numbers are not finite"
    if stopped_by:
        job.progress.say(
            f"stopped by {stopped_by} at train step {step}, {saved}; go on with: "
            f"python -m kslc_jax.train --resume --run-dir {shlex.quote(str(job.run_dir))}"
        )
    else:
        job.progress.say(f"done: {job.config.num_updates} train steps, {saved} in {job.run_dir}")


def describe(config: Config, run_dir: Path, mesh: Mesh | None = None) -> str:
    """One paragraph on what is about to run."""
    n, t = config.env.num_envs, config.ppo.rollout_steps
    engine, kind = physics.resolve_engine(config.physics), jax.devices()[0].device_kind
    count = 1 if mesh is None else mesh.size
    on = kind if jax.device_count() == 1 else f"{count} of {jax.device_count()} devices ({kind})"
    if devices.several():
        on += f", {jax.process_count()} processes"
    like = jax.eval_shape(lambda: train_step.init(config, 0))
    need = memory.estimate(config, like, count)
    return (
        f"{n} environments x {t} steps = {config.batch_size} samples an update, "
        f"{config.run.steps / 1e6:.2f}M steps in all; engine {engine} on {on}, about "
        f"{memory.shown(need)} of memory{' each' * (count > 1)}; run folder {run_dir}"
    )
