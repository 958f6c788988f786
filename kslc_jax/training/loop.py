"""The host's loop around the jitted train step.

`train_step` computes all numbers. This loop calls it, reads its metrics, saves, goes back to a
checkpoint after bad numbers, and stops. With several processes each one runs this loop. Some facts
are known to one process only (a signal, the time, the contents of the disk); `devices` sends them
to the others.
"""

import contextlib
import functools
import os
import shlex
import time
import warnings
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from kslc_jax import config as config_lib
from kslc_jax import files, physics, train_step
from kslc_jax.checkpoint_format import identity
from kslc_jax.config import Config, ConfigError
from kslc_jax.curriculum import Curriculum
from kslc_jax.fingerprint import changes, fingerprint
from kslc_jax.networks import Params
from kslc_jax.policy import policy_name
from kslc_jax.runtime import Watchdog
from kslc_jax.train_step import TrainState
from kslc_jax.training import devices, memory, profiling, recovery, run_folder, wandb_run
from kslc_jax.training.checkpoint_process import ChildProcessStorage, LocalStorage
from kslc_jax.training.logs import Progress
from kslc_jax.training.recorder import NullRecorder, Record, Recorder, snapshot_due
from kslc_jax.training.recovery import NonFiniteState, NumbersError, NumericsCheck
from kslc_jax.training.run_folder import locked, open_folder, writing
from kslc_jax.training.stopping import stop_requests


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

    Raises:
      RunError, ConfigError, CheckpointError: the training cannot start, or its last state cannot be
        saved.
      MissingPackage, UserError: the package wandb is missing, or it refuses.
      NumbersError: numbers went bad in all attempts, or no train step learnt anything.
      Elsewhere: the first process raised one of these, and this is another process.
    """
    init, step = train_step.make(config) if mesh is None else devices.make(config, mesh)
    like = jax.eval_shape(init)
    memory.check(config, 1 if mesh is None else mesh.size)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.closing(progress))
        storage = (
            ChildProcessStorage() if devices.several() and devices.is_first() else LocalStorage()
        )
        stack.enter_context(contextlib.closing(storage))
        origin: dict[str, str] = {}
        if start_from is not None:
            init, origin = _starting_from(start_from, config, init, storage, mesh)
        facts = run_folder.circumstances(config, 1 if mesh is None else mesh.size) | origin
        recorder = devices.on_first(
            lambda: stack.enter_context(
                _recorder(config, run_dir, resume, facts, progress, storage, wandb)
            )
        )
        tracing = profiling.Profile(
            run_dir / files.PROFILE,
            profile if devices.is_first() else 0,
            progress.say,
            progress.warn,
        )
        kept = recorder or NullRecorder()
        return _train(
            _Job(config, run_dir, resume, mesh, progress, kept, tracing, like, init, step)
        )


@contextlib.contextmanager
def _recorder(
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
        online = wandb_run.wandb_run(config, run_dir, resume, progress.warn) if wandb else None
        run = stack.enter_context(online) if online else None
        yield Recorder(config, run_dir, store, progress, storage.save_policy, run)


def _starting_from(
    path: Path,
    config: Config,
    init: Callable[[], TrainState],
    storage: LocalStorage,
    mesh: Mesh | None,
) -> tuple[Callable[[], TrainState], dict[str, str]]:
    """`init` with a policy's networks and curriculum, and a note of their origin."""
    start = functools.partial(train_step.start_from, config)
    like = jax.eval_shape(init)
    step = 0

    def chosen() -> tuple[Params, Curriculum]:
        nonlocal step
        policy = storage.load_policy(path)
        step = policy.step
        theirs, ours = (identity(c.physics.robot) for c in (policy.config, config))
        if theirs != ours:
            raise ConfigError(
                f"cannot start from {path}: it is of the robot {theirs['name']}, not of "
                f"{ours['name']}, or its joints have another order"
            )
        if policy.config.physics.robot != config.physics.robot and (
            changed := changes(policy.robot or {}, fingerprint(config.physics.robot))
        ):
            warnings.warn(f"{path} was trained with another robot: {changed}", stacklevel=2)
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

    return begin, {"start_from": f"{policy_name(path)}, train step {step}"}


def _train(job: _Job) -> TrainState:
    """Compiles and trains. Goes back to a checkpoint after bad numbers, see `recovery`."""
    start = time.monotonic()
    if job.resume:
        state = job.restored()
        if int(state.step) >= job.config.num_updates:
            job.progress.say(_nothing_to_do(job, int(state.step)))
            return state
        job.progress.say(f"resumed at train step {int(state.step)}; compiling the train step")
        compiled = _compiled(job)
    else:
        job.progress.say("compiling the first state and the train step")
        state, compiled = _first_state_and_step(job)
    seconds, need = time.monotonic() - start, memory.measured(compiled)
    needs = f", needs {memory.shown(need)}" if need else ""
    job.progress.say(f"compiled in {seconds:.0f} s{needs}; training")
    attempt, back_to = 0, -1
    with contextlib.closing(job.profile):
        while True:
            try:
                return _loop(job, state, compiled)
            except NonFiniteState as bad:
                state, attempt = _go_back(job, bad, attempt, back_to)
                back_to = int(state.step)


def _compiled(job: _Job) -> Any:
    return job.step.lower(job.like).compile()


def _first_state_and_step(job: _Job) -> tuple[TrainState, Any]:
    """The first state and the compiled train step. Their programs compile at the same time, in two
    threads; several processes must run their programs in one order, so they take turns."""
    if devices.several():
        return job.init(), _compiled(job)
    with ThreadPoolExecutor(1) as other:
        step = other.submit(_compiled, job)
        return job.init(), step.result()


def _go_back(job: _Job, bad: NonFiniteState, attempt: int, back_to: int) -> tuple[TrainState, int]:
    """The state of the last checkpoint with a lower learning rate, and the number of this attempt.

    `attempt` is the number of the last attempt; it started from train step `back_to`.

    Raises:
      NumbersError: all attempts from this checkpoint failed; the message names the dump.
    """
    before = devices.whole(bad.before)
    state = _last_good(job)
    attempt = attempt + 1 if int(state.step) == back_to else 1
    if attempt > recovery.ATTEMPTS:
        folder = job.run_dir if devices.is_first() else Path(os.devnull)
        left = recovery.leave(job.config, folder / files.BAD_STATE, before)
        raise NumbersError(
            f"{bad}, also after {recovery.ATTEMPTS} attempts from train step {back_to} with lower "
            f"learning rates; {left}"
        ) from bad
    state = recovery.with_lower_rate(state, attempt)
    job.progress.warn(
        f"{bad}; back to train step {int(state.step)} with learning rate "
        f"{float(state.learner.learning_rate):.2g} (attempt {attempt} of {recovery.ATTEMPTS})"
    )
    return state, attempt


def _last_good(job: _Job) -> TrainState:
    """The state of the last checkpoint, or the first state if there is none."""
    job.recorder.settle()
    (there,) = devices.agree(job.recorder.has_checkpoints())
    state = job.restored() if there else job.init()
    job.recorder.drop_snapshots(int(state.step))
    return state


def _loop(job: _Job, state: TrainState, step_fn: Any) -> TrainState:
    """Trains step by step; saves and returns the last state."""
    first = int(state.step)
    record: Record = {}
    numerics, watchdog = NumericsCheck(state), Watchdog()
    with stop_requests() as stop, contextlib.ExitStack() as opened:
        devices.on_first(lambda: opened.enter_context(job.recorder.at(first)))
        for step in range(first + 1, job.config.num_updates + 1):
            numerics.before(state)
            with job.profile.step(step), watchdog.step():
                tick = time.monotonic()
                state, metrics = step_fn(state)
                record = {name: float(value) for name, value in jax.device_get(metrics).items()}
                took = time.monotonic() - tick
            record = job.recorder.log(record, step, took)
            if warning := numerics.after(record):
                job.progress.warn(warning)
            if numerics.good and snapshot_due(job.config, step):
                job.recorder.keep_snapshot(state)
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
    _farewell(job, int(state.step), stop.requested, numerics.finite)
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


def _nothing_to_do(job: _Job, step: int) -> str:
    past = step > job.config.num_updates
    return (
        f"nothing to do: {job.run_dir} has done {step * job.config.batch_size} environment steps, "
        f"{'more than' if past else 'all of'} the {job.config.run.steps} that --steps asks for; "
        "it counts from the beginning of the run. Nothing is changed"
    )


def describe(config: Config, run_dir: Path, mesh: Mesh | None = None) -> str:
    """Describes the coming training: its size, engine, devices, memory and folder."""
    n, t = config.env.num_envs, config.ppo.rollout_steps
    engine, kind = physics.resolve_engine(config.physics), jax.devices()[0].device_kind
    count = 1 if mesh is None else mesh.size
    on = kind if jax.device_count() == 1 else f"{count} of {jax.device_count()} devices ({kind})"
    if devices.several():
        on += f", {jax.process_count()} processes"
    need = memory.estimate(config, count)
    robot = config.physics.robot
    copied = f", robot {robot}" if config_lib.is_description(robot) else ""
    return (
        f"{n} environments x {t} steps = {config.batch_size} samples an update, "
        f"{config.run.steps / 1e6:.2f}M steps in all; engine {engine} on {on}, about "
        f"{memory.shown(need)} of memory{' each' * (count > 1)}; run folder {run_dir}{copied}"
    )
