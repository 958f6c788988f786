"""The host's loop around the jitted train step: run folder, logs, checkpoints, stopping.

Everything that decides a number is in `train_step`; this file only calls it, reads its metrics,
saves, and stops.
"""

import contextlib
import dataclasses
import fcntl
import importlib.metadata
import json
import platform
import signal
import subprocess
import time
from collections.abc import Generator
from pathlib import Path
from types import FrameType

import jax

from kslc_jax import config as config_lib
from kslc_jax import physics, train_step
from kslc_jax.checkpoint import BEST_METRIC, Store, first_line
from kslc_jax.config import Config, ConfigError
from kslc_jax.logs import MetricsFile, Progress
from kslc_jax.train_step import TrainState

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
    git = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "device": str(jax.devices()[0].device_kind),
        "git": git.stdout.strip() or "unknown",
        **found,
    }


@contextlib.contextmanager
def locked(run_dir: Path) -> Generator[None]:
    """Holds the run folder's lock; RunError if another process does."""
    with (run_dir / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RunError(f"{run_dir} is in use by another process") from error
        yield


def open_folder(run_dir: Path, config: Config, resume: bool) -> None:
    """Creates the run folder, or checks that it may go on; RunError or ConfigError if not."""
    path = run_dir / "config.json"
    if resume:
        difference(read_config(run_dir), config)
        return
    if path.exists():
        raise RunError(
            f"{run_dir} already holds a training: add --resume, or name another --run-dir"
        )
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(config_lib.to_dict(config), indent=1))
        (run_dir / "versions.json").write_text(json.dumps(versions(), indent=1))
    except OSError as error:
        raise RunError(f"cannot write to {run_dir}: {error.strerror}") from error


def read_config(run_dir: Path) -> Config:
    """The config stored in a run folder; RunError if there is none, ConfigError if damaged."""
    path = run_dir / "config.json"
    if not path.exists():
        raise RunError(f"{run_dir} holds no training to resume (no config.json)")
    try:
        return config_lib.from_dict(json.loads(path.read_text()))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged: {error}") from error


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


def train(config: Config, run_dir: Path, resume: bool, progress: Progress) -> TrainState:
    """Trains until `config.run.steps`, a signal, or an error; the state is saved in each case."""
    open_folder(run_dir, config, resume)
    with locked(run_dir), contextlib.closing(Store(run_dir, config.run.keep)) as store:
        init, step_fn = train_step.make(config)
        start = time.monotonic()
        if resume:
            like = jax.eval_shape(init)
            state = store.restore(like, lambda text: progress.say(f"warning: {text}"))
            progress.say(f"resumed at train step {int(state.step)}")
        else:
            state = init()
        compiled = step_fn.lower(state).compile()
        progress.say(f"compiled in {time.monotonic() - start:.0f} s; training")
        try:
            return _loop(config, run_dir, state, compiled, store, progress)
        finally:
            progress.close()


def _loop(config, run_dir, state, step_fn, store: Store, progress: Progress) -> TrainState:
    """Steps, logs and saves; returns the last state, which is on disk."""
    first = int(state.step)
    file = MetricsFile(run_dir, after=first)
    saved = time.monotonic()
    begun = saved - file.seconds_before
    record: dict[str, float] = {}
    with _Stop() as stop, contextlib.closing(file):
        for step in range(first + 1, config.num_updates + 1):
            tick = time.monotonic()
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
            if stop.requested:
                break
            if now - saved > 60.0 * config.run.checkpoint_minutes:
                saved = now
                _save(store, state, config, record, progress)
        if record:
            _save(store, state, config, record, progress)
            _settle(store)
    _farewell(config, run_dir, state, stop.requested, progress)
    return state


def _save(store: Store, state: TrainState, config: Config, record, progress: Progress) -> None:
    """Saves; a failure is said, and training goes on with the checkpoints before."""
    try:
        store.save(state, config, record)
    except Exception as error:  # whatever orbax met: hours of training must not die of it
        progress.say(f"warning: could not save a checkpoint: {first_line(error)}; training goes on")


def _settle(store: Store) -> None:
    """Waits until the last save is on disk; RunError if it is not."""
    try:
        store.wait()
    except Exception as error:
        message = f"the last state could not be saved: {first_line(error)}"
        raise RunError(f"{message}; the checkpoints before it are whole") from error


def _farewell(
    config: Config, run_dir: Path, state: TrainState, stopped_by: str | None, progress: Progress
) -> None:
    if stopped_by:
        progress.say(
            f"stopped by {stopped_by} at train step {int(state.step)}, saved; go on with: "
            f"python -m kslc_jax.train --resume --run-dir {run_dir}"
        )
    else:
        progress.say(f"done: {config.num_updates} train steps, saved in {run_dir}")


def describe(config: Config, run_dir: Path) -> str:
    """One paragraph on what is about to run."""
    n, t = config.env.num_envs, config.ppo.rollout_steps
    engine, device = physics.resolve_engine(config.physics), jax.devices()[0].device_kind
    return (
        f"{n} environments x {t} steps = {config.batch_size} samples an update, "
        f"{config.run.steps / 1e6:.2f}M steps in all; engine {engine} on {device}; "
        f"run folder {run_dir}"
    )
