"""A run folder: its lock, config and versions, and the checks before a training resumes in it."""

import contextlib
import fcntl
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Generator
from pathlib import Path
from typing import Any

import jax

from kslc_jax import __version__, files, physics, processors
from kslc_jax import config as config_lib
from kslc_jax.checkpoint_format import (
    has_checkpoints,
    keep_robot,
)
from kslc_jax.config import Config, ConfigError
from kslc_jax.errors import UserError
from kslc_jax.runtime import first_line
from kslc_jax.training import same_training
from kslc_jax.training.logs import rows_written

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")

VARIABLES = ("XLA_FLAGS", "NVIDIA_TF32_OVERRIDE")
"""Environment variables that change the bits of a result."""

_PATH = re.compile(r"""(?<==)(["'])[^"']*/[^"']*\1|[^\s=]*/\S*""")
"""A path in the text of a variable, in quotes or without."""


class RunError(UserError, RuntimeError):
    """A run folder cannot be used. The message gives the reason and a way out."""


def versions() -> dict[str, str]:
    """Versions of software and hardware that the bits of a result depend on.

    `git` is the commit of this package's own checkout, or "unknown" if it runs from none. `code` is
    a digest of its Python files: two edited checkouts of one commit differ in it.
    """
    package = Path(__file__).parents[1]
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    found |= {d.name: d.version for d in importlib.metadata.distributions(name="jax-cuda12-plugin")}
    return {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpu": processors.model(),
        **{name: _PATH.sub("PATH", os.environ.get(name, "")) for name in VARIABLES},
        "device": str(jax.devices()[0].device_kind),
        "kslc_jax": __version__,
        "git": _revision(Path(__file__)) or "unknown",
        "code": _digest(package),
        **found,
    }


def _revision(module: Path) -> str:
    """Commit of the checkout that holds `module`, a file of this package; empty if there is none.

    The package may be installed inside another repository, and the commit of that repository does
    not describe this code. So the package must lie at the top of the checkout, and git must track
    the module.
    """
    package = module.resolve().parents[1]
    top = _git(package, "rev-parse", "--show-toplevel")
    if not top or Path(top).resolve() != package.parent:
        return ""
    if not _git(package, "ls-files", "--", str(module.resolve())):
        return ""
    return _git(package, "describe", "--always", "--dirty")


def _digest(package: Path) -> str:
    """Beginning of a SHA-256 of the names and texts of all Python files in a folder."""
    found = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        found.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    return found.hexdigest()[:12]


def _git(folder: Path, *command: str) -> str:
    """Output of a git command in `folder`; empty if it fails or git is missing."""
    # Within a git hook these variables point to the hook's repository.
    env = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    argv = ["git", "-C", str(folder), *command]
    try:
        done = subprocess.run(argv, capture_output=True, text=True, check=False, env=env)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


@contextlib.contextmanager
def writing(run_dir: Path) -> Generator[None]:
    """Turns an OSError into a RunError that says that the run folder cannot be written."""
    try:
        yield
    except OSError as error:
        why = error.strerror or first_line(error)
        raise RunError(f"cannot write to {run_dir}: {why}") from error


@contextlib.contextmanager
def locked(run_dir: Path) -> Generator[None]:
    """Holds the run folder's lock. If another process holds it, RunError names the process's id.

    The operating system releases the lock when the process dies.
    """
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


def open_folder(run_dir: Path, config: Config, resume: bool, facts: dict[str, Any]) -> None:
    """Checks the content of a run folder. For a new training it also writes config and versions.

    Args:
      run_dir: the folder, which must exist.
      config: config of the training.
      resume: True: the training in the folder continues. `note_resume` writes the files, once its
        state is restored: a resume that fails changes nothing.
      facts: `circumstances`, and the policy that the training starts from, if any.

    Raises:
      RunError: there is no training to resume, or see `require_free`.
      ConfigError: the training in the folder has another config.
    """
    if resume:
        same_training.require(run_dir, read_config(run_dir), config)
        return
    require_free(run_dir)
    with writing(run_dir):
        keep_robot(config, run_dir, anew=True)
        _write(run_dir / files.VERSIONS, facts)
        _write(run_dir / files.CONFIG, config_lib.to_dict(config))


def note_resume(run_dir: Path, config: Config, facts: dict[str, Any], step: int) -> None:
    """Writes the config of a resumed training, and what changed since it last ran.

    `step` is the number of train steps done. A second call, and one for a new training, changes
    nothing.
    """
    with writing(run_dir):
        keep_robot(config, run_dir)
        if news := _news(run_dir, facts):
            kept = _stored_versions(run_dir)
            news = {"train_step": step, **news}
            _write(run_dir / files.VERSIONS, kept | {RESUMED: [*kept.get(RESUMED, []), news]})
        _write(run_dir / files.CONFIG, config_lib.to_dict(config))


def require_free(run_dir: Path) -> None:
    """RunError if a new training in this folder would overwrite another one, or the seeds of one.

    A training that ended before it saved its first train step may be overwritten.
    """
    seeds = [files.seed_folder(run_dir, seed) for seed in files.seeds_in(run_dir)]
    if any(has_checkpoints(folder) or rows_written(folder) > 1 for folder in (run_dir, *seeds)):
        held = f"a training of {len(seeds)} seeds" if seeds else "a training"
        raise RunError(
            f"{run_dir} already holds {held}: go on with --resume --run-dir "
            f"{shlex.quote(str(run_dir))}, or name another --run-dir"
        )


# ---------------------------------------------------------------------------------- circumstances

RESUMED = "resumed"
"""Entry of versions.json: a list with the differences at each resume, and its train step. The other
entries are those of the training's start."""


def circumstances(config: Config, devices: int, seeds: int = 1) -> dict[str, Any]:
    """Everything besides the config that can change the bits of a training."""
    engine = physics.resolve_engine(config.physics)
    return versions() | {"engine": engine, "devices": devices, "seeds": seeds}


def what_changed(run_dir: Path, facts: dict[str, Any]) -> str:
    """A short description of the differences since the training last ran; empty without any."""
    before = _last_known(run_dir)
    changed = [
        f"{name} {now or 'none'} instead of {before[name] or 'none'}"
        for name, now in _news(run_dir, facts).items()
        if name in before
    ]
    return f"with {', '.join(changed)} (bits may differ from here)" if changed else ""


def _news(run_dir: Path, facts: dict[str, Any]) -> dict[str, Any]:
    before = _last_known(run_dir)
    return {name: now for name, now in facts.items() if before.get(name) != now}


def _last_known(run_dir: Path) -> dict[str, Any]:
    """The circumstances under which the training last ran."""
    known: dict[str, Any] = {"seeds": 1}  # older files do not say it
    known |= _stored_versions(run_dir)
    for later in known.pop(RESUMED, []):
        known |= later
    return known


def _stored_versions(run_dir: Path) -> dict[str, Any]:
    """The content of versions.json; empty if the file is missing or damaged.

    That is no error, because no number depends on the file.
    """
    try:
        stored = json.loads((run_dir / files.VERSIONS).read_text())
        resumed = stored.get(RESUMED, [])
        readable = isinstance(resumed, list) and all(isinstance(x, dict) for x in resumed)
        return stored if readable else {}
    except (OSError, ValueError, RecursionError, AttributeError):
        return {}


# ----------------------------------------------------------------------------------------- config


def _write(path: Path, content: dict[str, Any]) -> None:
    files.write_atomically(path, json.dumps(content, indent=1))


def read_config(run_dir: Path) -> Config:
    """The config in a run folder; RunError if it cannot be read, ConfigError if it is damaged."""
    path = run_dir / files.CONFIG
    try:
        return config_lib.from_dict(json.loads(path.read_text()), run_dir)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RunError(f"{run_dir} holds no training to resume (no {files.CONFIG})") from error
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # no JSON, or no text
        raise ConfigError(f"{path} is damaged: {first_line(error)}") from error
