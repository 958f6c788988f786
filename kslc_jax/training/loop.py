"""The host's loop around the jitted train step.

`train_step` computes all numbers. This loop calls it, reads its metrics, saves, goes back to a
checkpoint after bad numbers, and stops. With several processes each one runs this loop. Some facts
are known to one process only (a signal, the time, the contents of the disk); `devices` sends them
to the others.
"""

import contextlib
import os
import shlex
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from kslc_jax import config as config_lib
from kslc_jax import files, physics, train_step
from kslc_jax.config import Config
from kslc_jax.runtime import Watchdog
from kslc_jax.train_step import TrainState
from kslc_jax.training import devices, memory, profiling, recovery, run_folder, starting
from kslc_jax.training import recorder as recorder_lib
from kslc_jax.training import seeds as seeds_lib
from kslc_jax.training.checkpoint_process import ChildProcessStorage, LocalStorage
from kslc_jax.training.logs import Progress, range_reached
from kslc_jax.training.recorder import NullRecorder, Record
from kslc_jax.training.recovery import NonFiniteState, NumbersError
from kslc_jax.training.stopping import Stop, stop_requests


@dataclass(frozen=True)
class _Job:
    """One training: its config, folder and devices, its output, and its compiled functions."""

    config: Config
    run_dir: Path
    resume: bool
    mesh: Mesh | None
    progress: Progress
    recorder: NullRecorder
    profile: profiling.Profile
    like: TrainState  # shapes
    init: Callable[[], TrainState]
    step: Any  # jitted

    def restored(self) -> TrainState:
        """The latest whole checkpoint, on its devices."""
        state = devices.from_first(lambda: self.recorder.restore(self.like), self.like)
        return state if self.mesh is None else devices.place(self.mesh, state)


def train(
    config: Config,
    run_dir: Path,
    resume: bool,
    progress: Progress,
    start_from: Path | None = None,
    mesh: Mesh | None = None,
    profile: int = 0,
    wandb: bool = False,
    seeds: int = 1,
) -> TrainState:
    """Trains until `config.run.steps` or a signal. Saves every few minutes and at the end.

    Args:
      config: the training's config.
      run_dir: the run folder; with several processes only that of the first one is used.
      resume: True: continue from the run folder's latest checkpoint.
      progress: shows metrics and messages.
      start_from: a policy; the new training begins with its networks and curriculum.
      mesh: the devices of all processes, see `devices.mesh`; None for one device.
      profile: number of train steps to trace, see `profiling`.
      wandb: True: also send the records to Weights & Biases, see `wandb_run`.
      seeds: number of trainings in one program, see `seeds`. More than 1 excludes `start_from`,
        `mesh`, `profile` and `wandb`; the state then has a leading axis of seeds.

    Raises:
      RunError, ConfigError, CheckpointError: the training cannot start, or its last state cannot be
        saved.
      MissingPackage, UserError: the package wandb is missing, or it refuses.
      NumbersError: numbers went bad in all attempts, or no train step learnt anything.
      Elsewhere: the first process raised one of these, and this is another process.
    """
    init, step = _program(config, mesh, seeds)
    like = jax.eval_shape(init)
    count = 1 if mesh is None else mesh.size
    memory.check(config, count, seeds)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.closing(progress))
        storage = (
            ChildProcessStorage() if devices.several() and devices.is_first() else LocalStorage()
        )
        stack.enter_context(contextlib.closing(storage))
        facts = run_folder.circumstances(config, count, seeds)
        if start_from is not None:
            init, origin = starting.from_policy(start_from, config, init, storage, mesh)
            facts |= origin
        opened = seeds_lib.opened(seeds) if seeds > 1 else recorder_lib.opened
        recorder = devices.on_first(
            lambda: stack.enter_context(
                opened(config, run_dir, resume, facts, progress, storage, wandb)
            )
        )
        tracing = profiling.Profile(
            run_dir / files.PROFILE,
            profile if devices.is_first() else 0,
            progress.say,
            progress.warn,
        )
        kept = recorder or NullRecorder()
        job = _Job(config, run_dir, resume, mesh, progress, kept, tracing, like, init, step)
        stop = stack.enter_context(stop_requests())  # also while it compiles
        return _train(job, stop)


def _program(config: Config, mesh: Mesh | None, seeds: int) -> tuple[Callable[[], TrainState], Any]:
    """(init, train_step) of one training, on one device or on a mesh, or of several seeds."""
    if seeds > 1:
        return seeds_lib.make(config, seeds)
    return train_step.make(config) if mesh is None else devices.make(config, mesh)


def _done(state: TrainState) -> int:
    """Train steps done; of several seeds, by the one that has done the fewest."""
    return int(np.asarray(state.step).min())


def _train(job: _Job, stop: Stop) -> TrainState:
    """Compiles and trains. Goes back to a checkpoint after bad numbers, see `recovery`.

    After a signal it does at least one train step, so that it can save.
    """
    start = time.monotonic()
    if job.resume:
        state = job.restored()
        if _done(state) >= job.config.num_updates:
            job.progress.say(_nothing_to_do(job, _done(state)))
            return state
        job.progress.say(f"resumed at train step {_done(state)}; compiling the train step")
        compiled = _compiled(job.step, job.like)
    else:
        job.progress.say("compiling the first state and the train step")
        in_turn = devices.several()  # several processes must run their programs in one order
        state, compiled = first_state_and_step(job.init, job.step, job.like, in_turn)
    seconds, need = time.monotonic() - start, memory.measured(compiled)
    needs = f", needs {memory.shown(need)}" if need else ""
    job.progress.say(f"compiled in {seconds:.0f} s{needs}; training")
    attempt, back_to = 0, -1
    with contextlib.closing(job.profile):
        while True:
            try:
                return _loop(job, state, compiled, stop)
            except NonFiniteState as bad:
                state, attempt = _go_back(job, bad, attempt, back_to)
                back_to = _done(state)


def _compiled(step: Any, like: TrainState) -> Any:
    return step.lower(like).compile()


def first_state_and_step(
    init: Callable[[], TrainState], step: Any, like: TrainState, in_turn: bool = False
) -> tuple[TrainState, Any]:
    """The first state and the compiled train step.

    Args:
      init, step: of `train_step.make`.
      like: shapes of the state.
      in_turn: False compiles the two programs at the same time, in two threads.
    """
    if in_turn:
        return init(), _compiled(step, like)
    with ThreadPoolExecutor(1) as other:
        compiled = other.submit(_compiled, step, like)
        return init(), compiled.result()


def _go_back(job: _Job, bad: NonFiniteState, attempt: int, back_to: int) -> tuple[TrainState, int]:
    """The state of the last checkpoint with a lower learning rate, and the number of this attempt.

    `attempt` is the number of the last attempt; it started from train step `back_to`.

    Raises:
      NumbersError: all attempts from this checkpoint failed; the message names the dump.
    """
    before = devices.whole(bad.before)
    state = _last_good(job)
    attempt = attempt + 1 if _done(state) == back_to else 1
    if attempt > recovery.ATTEMPTS:
        folder = job.run_dir if devices.is_first() else Path(os.devnull)
        left = recovery.leave(job.config, folder / files.BAD_STATE, before)
        raise NumbersError(
            f"{bad}, also after {recovery.ATTEMPTS} attempts from train step {back_to} with lower "
            f"learning rates; {left}"
        ) from bad
    state = recovery.with_lower_rate(state, attempt)
    job.progress.warn(
        f"{bad}; back to train step {_done(state)} with learning rate "
        f"{float(state.learner.learning_rate):.2g} (attempt {attempt} of {recovery.ATTEMPTS})"
    )
    return state, attempt


def _last_good(job: _Job) -> TrainState:
    """The state of the last checkpoint, or the first state if there is none."""
    job.recorder.settle()
    (there,) = devices.agree(job.recorder.has_checkpoints())
    state = job.restored() if there else job.init()
    job.recorder.drop_snapshots(_done(state))
    return state


def _loop(job: _Job, state: TrainState, step_fn: Any, stop: Stop) -> TrainState:
    """Trains step by step until `stop` asks for the end; saves and returns the last state."""
    first = _done(state)
    record: Record = {}
    numerics, watchdog = job.recorder.check(state), Watchdog()
    with contextlib.ExitStack() as opened:
        devices.on_first(lambda: opened.enter_context(job.recorder.at(first)))
        for step in range(first + 1, job.config.num_updates + 1):
            numerics.before(state)
            with job.profile.step(step), watchdog.step():
                tick = time.monotonic()
                state, metrics = step_fn(state)
                metrics = jax.device_get(metrics)
                took = time.monotonic() - tick
            record = job.recorder.log(metrics, step, took)
            if warning := numerics.after(record):
                job.progress.warn(warning)
            if numerics.good:
                job.recorder.keep_snapshot(state, step)
            stopped, due = devices.agree(stop.requested is not None, job.recorder.due())
            if stopped:
                stop.requested = stop.requested or "a signal to another process"
                break
            numerics.require_good()
            if numerics.good and due:
                job.recorder.save(devices.whole(state), record)
        if record and numerics.finite:
            last = devices.whole(state)
            devices.on_first(lambda: job.recorder.finish(last, record))
    if not stop.requested:
        numerics.require_some_good()
    _farewell(job, state, stop.requested, numerics.finite)
    return state


def _farewell(job: _Job, state: TrainState, stopped_by: str | None, whole: bool) -> None:
    step = _done(state)
    saved = "saved" if whole else "not saved: the numbers are not finite"
    if stopped_by and step < job.config.num_updates:
        job.progress.say(
            f"stopped by {stopped_by} at train step {step}, {saved}; go on with: "
            f"python -m kslc_jax.train --resume --run-dir {shlex.quote(str(job.run_dir))}"
        )
    else:
        job.progress.say(f"done: {job.config.num_updates} train steps, {saved} in {job.run_dir}")
        for line in range_reached(job.config, jax.device_get(state.curriculum)):
            job.progress.say(line)


def _nothing_to_do(job: _Job, step: int) -> str:
    past = step > job.config.num_updates
    return (
        f"nothing to do: {job.run_dir} has done {step * job.config.batch_size} environment steps, "
        f"{'more than' if past else 'all of'} the {job.config.run.steps} that --steps asks for; "
        "it counts from the beginning of the run. Nothing is changed"
    )


def describe(config: Config, run_dir: Path, mesh: Mesh | None = None, seeds: int = 1) -> str:
    """Describes the coming training: its size, engine, devices, memory and folder."""
    n, t = config.env.num_envs, config.ppo.rollout_steps
    engine, kind = physics.resolve_engine(config.physics), jax.devices()[0].device_kind
    count = 1 if mesh is None else mesh.size
    on = kind if jax.device_count() == 1 else f"{count} of {jax.device_count()} devices ({kind})"
    if devices.several():
        on += f", {jax.process_count()} processes"
    need = memory.estimate(config, count) * seeds
    each = f"{seeds} seeds, each with " if seeds > 1 else ""
    robot = config.physics.robot
    copied = f", robot {robot}" if config_lib.is_description(robot) else ""
    return (
        f"{each}{n} environments x {t} steps = {config.batch_size} samples an update, "
        f"{config.run.steps / 1e6:.2f}M steps in all; engine {engine} on {on}, about "
        f"{memory.shown(need)} of memory{' each' * (count > 1)}; run folder {run_dir}{copied}"
    )
