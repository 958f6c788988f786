"""The host's loop around the jitted train step: run folder, logs, checkpoints, stopping.

Everything that decides a number is in `train_step`; this file only calls it, reads its metrics,
saves, and stops.
"""

import contextlib
import dataclasses
import fcntl
import importlib.metadata
import json
import math
import os
import platform
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Generator
from pathlib import Path
from types import FrameType
from typing import Any

import jax

from kslc_jax import checkpoint, physics, recovery, train_step
from kslc_jax import config as config_lib
from kslc_jax.checkpoint import BEST_METRIC, CheckpointError, Store, first_line
from kslc_jax.config import Config, ConfigError
from kslc_jax.logs import MetricsFile, Progress, rows_written, write_whole
from kslc_jax.recovery import Health
from kslc_jax.runtime import Watchdog
from kslc_jax.train_step import TrainState

SAMPLE_BYTES = 1024
"""What a sample of a rollout takes at least: its frames, actions and reward terms."""

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")


class RunError(RuntimeError):
    """A run folder that cannot be used; the message says why and what to do."""


class _Stop:
    """Turns the first SIGINT or SIGTERM into a request that the loop reads between steps."""

    def __init__(self) -> None:
        self.requested: str | None = None

    def __enter__(self) -> "_Stop":
        self._old = {s: signal.signal(s, self._handle) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        if self.requested:  # a second one means now
            raise KeyboardInterrupt
        self.requested = signal.Signals(number).name


def versions() -> dict[str, str]:
    """Versions that a result depends on, and the git revision if there is one."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": str(jax.devices()[0].device_kind),
        "git": _revision() or "unknown",
        **found,
    }


def _revision() -> str:
    """Of the git checkout that this file lies in; empty where there is none, or no git."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip()


@contextlib.contextmanager
def _writing(run_dir: Path) -> Generator[None]:
    """RunError where the run folder cannot be written to."""
    try:
        yield
    except OSError as error:
        why = error.strerror or first_line(error)
        raise RunError(f"cannot write to {run_dir}: {why}") from error


@contextlib.contextmanager
def locked(run_dir: Path) -> Generator[None]:
    """Holds the run folder's lock, which the system takes back at the process's death; RunError
    with the other's process id if another process holds it."""
    with _writing(run_dir):
        file = (run_dir / ".lock").open("a+")
    with file:
        with _writing(run_dir):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                holder = file.read().strip() or "unknown"
                raise RunError(f"{run_dir} is in use by another process, id {holder}") from error
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
        yield


def open_folder(run_dir: Path, config: Config, resume: bool, origin: dict[str, str]) -> None:
    """Fills a new run folder, or checks that it may go on; RunError or ConfigError if not.

    A training that ended before its first train step was saved has left nothing to lose."""
    if resume:
        difference(read_config(run_dir), config)
    elif checkpoint.has_checkpoints(run_dir) or rows_written(run_dir) > 1:
        raise RunError(
            f"{run_dir} already holds a training: go on with --resume --run-dir "
            f"{shlex.quote(str(run_dir))}, or name another --run-dir"
        )
    with _writing(run_dir):
        if not resume:
            write_whole(run_dir / "versions.json", json.dumps(versions() | origin, indent=1))
        write_whole(run_dir / "config.json", json.dumps(config_lib.to_dict(config), indent=1))


def read_config(run_dir: Path) -> Config:
    """The config stored in a run folder; RunError if there is none, ConfigError if damaged."""
    path = run_dir / "config.json"
    try:
        return config_lib.from_dict(json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RunError(f"{run_dir} holds no training to resume (no config.json)") from error
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # no JSON, or no text
        raise ConfigError(f"{path} is damaged: {first_line(error)}") from error


def difference(stored: Config, wanted: Config) -> None:
    """ConfigError naming the first field, `run` apart, in which a resumed run would differ."""

    def walk(a: object, b: object, where: str) -> None:
        if dataclasses.is_dataclass(a):
            for f in dataclasses.fields(a):
                walk(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}".lstrip("."))
        elif a != b:
            raise ConfigError(
                f"{where} is {a} in the run to resume, not {b}: start a new run for that"
            )

    for f in dataclasses.fields(stored):
        if f.name != "run":
            walk(getattr(stored, f.name), getattr(wanted, f.name), f.name)


def memory_need(config: Config, like: TrainState) -> int:
    """Bytes that the state and one rollout take at least."""
    state = sum(math.prod(x.shape) * 4 for x in jax.tree.leaves(like))
    return state + SAMPLE_BYTES * config.batch_size


def check_memory(config: Config, like: TrainState) -> None:
    """ConfigError where the state and one rollout cannot fit into this machine's memory."""
    stats = jax.devices()[0].memory_stats() or {}
    memory = stats.get("bytes_limit") or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    need = memory_need(config, like)
    if need > memory:
        raise ConfigError(
            f"env.num_envs, env.frames, ppo.rollout_steps and network sizes need {need / 2**30:.0f}"
            f" GiB or more; {jax.devices()[0].device_kind} has {memory / 2**30:.0f}"
        )


def train(
    config: Config,
    run_dir: Path,
    resume: bool,
    progress: Progress,
    start_from: Path | None = None,
) -> TrainState:
    """Trains until `config.run.steps`, a signal, or an error; the state is saved in each case.

    Args:
      config: what to train.
      run_dir: where everything goes.
      resume: go on from the run folder's latest checkpoint.
      progress: shows it.
      start_from: a policy whose networks and curriculum a new training begins with.

    Raises:
      RunError, ConfigError, CheckpointError: it cannot start, or its last state cannot be saved.
      NumbersError: numbers went bad again and again.
    """
    init, step_fn = train_step.make(config)
    origin = {}
    if start_from is not None:
        init, origin = _starting_from(start_from, init)
    check_memory(config, jax.eval_shape(init))
    if not resume:
        with _writing(run_dir):
            run_dir.mkdir(parents=True, exist_ok=True)
    with locked(run_dir), contextlib.closing(progress):
        open_folder(run_dir, config, resume, origin)
        with _writing(run_dir):
            store = Store(run_dir, config.run.keep)
        with contextlib.closing(store):
            return _persist(config, run_dir, resume, progress, store, init, step_fn)


def _persist(
    config: Config,
    run_dir: Path,
    resume: bool,
    progress: Progress,
    store: Store,
    init: Callable[[], TrainState],
    step_fn: Any,
) -> TrainState:
    """Compiles and trains; goes back to a checkpoint where numbers go bad."""
    like = jax.eval_shape(init)
    start = time.monotonic()
    state = store.restore(like, progress.warn) if resume else init()
    if resume:
        progress.say(f"resumed at train step {int(state.step)}")
    compiled = step_fn.lower(like).compile()
    progress.say(f"compiled in {time.monotonic() - start:.0f} s; training")

    def again() -> TrainState:
        with _going_on(progress):
            store.wait()
        state = store.restore(like, progress.warn) if store.steps() else init()
        _drop_snapshots(run_dir, int(state.step))
        return state

    def go(state: TrainState) -> TrainState:
        return _loop(config, run_dir, state, compiled, store, progress)

    return recovery.persist(config, run_dir, go, state, again, progress.warn)


def _starting_from(
    path: Path, init: Callable[[], TrainState]
) -> tuple[Callable[[], TrainState], dict[str, str]]:
    """`init` with a policy's networks and curriculum, and where they come from."""
    policy = checkpoint.load_policy(path)

    def begin() -> TrainState:
        return train_step.start_from(init(), policy.params, policy.curriculum)

    try:
        jax.eval_shape(begin)
    except ValueError as error:
        raise ConfigError(
            f"cannot start from {path}: it has {error}, see network and env.frames in its config"
        ) from error
    return begin, {"start_from": f"{path}, train step {policy.step}"}


def _loop(config, run_dir, state, step_fn, store: Store, progress: Progress) -> TrainState:
    """Steps, logs and saves; returns the last state, which is on disk."""
    first = int(state.step)
    with _writing(run_dir):
        file = MetricsFile(run_dir, first, progress.warn)
    begun = time.monotonic() - file.seconds_before
    # The first train step of a new run is saved, so that whatever happens there is a way back.
    saved = time.monotonic() if store.steps() else -math.inf
    record: dict[str, float] = {}
    health, watchdog = Health(state), Watchdog()
    with _Stop() as stop, contextlib.closing(file):
        for step in range(first + 1, config.num_updates + 1):
            tick = time.monotonic()
            health.before(state)
            with watchdog.step():
                state, metrics = step_fn(state)
                record = {name: float(value) for name, value in jax.device_get(metrics).items()}
            now = time.monotonic()
            record |= {
                "step": step,
                "env_steps": step * config.batch_size,
                "seconds": now - begun,
                "steps_per_second": config.batch_size / (now - tick),
                BEST_METRIC: record["curriculum/v_max"] + record["curriculum/tracking"],
            }
            if step % config.run.log_every == 0:
                file.write(record)
            progress.show(record)
            health.after(record)
            if stop.requested:
                break
            health.check()
            if health.good and snapshot_due(config, step):
                _keep_snapshot(config, run_dir, state, progress)
            if health.good and now - saved > 60.0 * config.run.checkpoint_minutes:
                _save(store, state, config, record, progress)
                if math.isinf(saved):
                    with _going_on(progress):
                        store.wait()
                saved = now
        if record and health.finite:
            with _going_on(progress):
                store.wait()
            store.save(state, config, record)
            store.wait()
    _farewell(config, run_dir, int(state.step), stop.requested, health.finite, progress)
    return state


@contextlib.contextmanager
def _going_on(progress: Progress) -> Generator[None]:
    """Says that a checkpoint could not be saved; hours of training must not die of it."""
    try:
        yield
    except CheckpointError as error:
        progress.warn(f"{error}; training goes on")


def _save(store: Store, state: TrainState, config: Config, record, progress: Progress) -> None:
    """Starts a save, and says whether the one before failed."""
    with _going_on(progress):
        store.wait()
    with _going_on(progress):
        store.save(state, config, record)


def snapshot_due(config: Config, step: int) -> bool:
    """Whether one of `run.snapshots` equal parts of the run ends with this train step."""
    parts, steps = config.run.snapshots, config.num_updates
    return step * parts // steps > (step - 1) * parts // steps


def _drop_snapshots(run_dir: Path, after: int) -> None:
    """Removes policies of train steps that a training went back behind: it will not pass there."""
    for folder in (run_dir / checkpoint.SNAPSHOTS).glob("[0-9]*"):
        if folder.name.isdigit() and int(folder.name) > after:
            shutil.rmtree(folder, ignore_errors=True)


def _keep_snapshot(config: Config, run_dir: Path, state: TrainState, progress: Progress) -> None:
    """Saves the policy alone; one that is there, from before a resume, stays."""
    folder = run_dir / checkpoint.SNAPSHOTS / str(int(state.step))
    with _going_on(progress):
        if not folder.exists():
            checkpoint.save_policy(checkpoint.policy_of(config, state), folder)


def _farewell(
    config: Config,
    run_dir: Path,
    step: int,
    stopped_by: str | None,
    whole: bool,
    progress: Progress,
) -> None:
    saved = "saved" if whole else "not saved: the numbers are not finite"
    if stopped_by:
        progress.say(
            f"stopped by {stopped_by} at train step {step}, {saved}; go on with: "
            f"python -m kslc_jax.train --resume --run-dir {shlex.quote(str(run_dir))}"
        )
    else:
        progress.say(f"done: {config.num_updates} train steps, {saved} in {run_dir}")


def describe(config: Config, run_dir: Path) -> str:
    """One paragraph on what is about to run."""
    n, t = config.env.num_envs, config.ppo.rollout_steps
    engine, device = physics.resolve_engine(config.physics), jax.devices()[0].device_kind
    return (
        f"{n} environments x {t} steps = {config.batch_size} samples an update, "
        f"{config.run.steps / 1e6:.2f}M steps in all; engine {engine} on {device}; "
        f"run folder {run_dir}"
    )
