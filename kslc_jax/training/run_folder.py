"""A run folder: its lock, its config and versions, and whether a training may go on in it."""

import contextlib
import dataclasses
import fcntl
import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
from collections.abc import Generator
from pathlib import Path
from typing import Any

import jax

from kslc_jax import config as config_lib
from kslc_jax import files
from kslc_jax.checkpoint_format import has_checkpoints
from kslc_jax.config import Config, ConfigError
from kslc_jax.errors import UserError
from kslc_jax.runtime import first_line
from kslc_jax.training.logs import rows_written

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")


class RunError(UserError, RuntimeError):
    """A run folder that cannot be used; the message says why and what to do."""


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
def writing(run_dir: Path) -> Generator[None]:
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
    with writing(run_dir):
        file = (run_dir / files.LOCK).open("a+")
    with file:
        with writing(run_dir):
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
    elif has_checkpoints(run_dir) or rows_written(run_dir) > 1:
        raise RunError(
            f"{run_dir} already holds a training: go on with --resume --run-dir "
            f"{shlex.quote(str(run_dir))}, or name another --run-dir"
        )
    with writing(run_dir):
        if not resume:
            files.write_atomically(
                run_dir / files.VERSIONS, json.dumps(versions() | origin, indent=1)
            )
        files.write_atomically(
            run_dir / files.CONFIG, json.dumps(config_lib.to_dict(config), indent=1)
        )


def _write(path: Path, content: dict[str, Any]) -> None:
    files.write_atomically(path, json.dumps(content, indent=1))


def read_config(run_dir: Path) -> Config:
    """The config stored in a run folder; RunError if there is none, ConfigError if damaged."""
    path = run_dir / files.CONFIG
    try:
        return config_lib.from_dict(json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RunError(f"{run_dir} holds no training to resume (no {files.CONFIG})") from error
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
                f"{where} is {a} in the run that is there, not {b}: start a new run for that"
            )

    for f in dataclasses.fields(stored):
        if f.name != "run":
            walk(getattr(stored, f.name), getattr(wanted, f.name), f.name)
