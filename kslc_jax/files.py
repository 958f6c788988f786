"""Names of the files in a run folder, and writing of results: complete or not at all.

If a file cannot be written, the error has one line.
"""

import contextlib
import errno
import json
import os
import re
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

from kslc_jax.config import ROBOT_FOLDER, ConfigError
from kslc_jax.runtime import first_line

# ------------------------------------------------------------------- names within a run folder

CONFIG = "config.json"
"""The training's config."""

ROBOT = ROBOT_FOLDER
"""Folder with the copy of a user's robot; a policy that was exported has one, too."""

VERSIONS = "versions.json"
"""Versions of the packages, the machine, and the policy that the training started from."""

METRICS = "metrics.jsonl"
"""One record of metrics per line."""

TENSORBOARD = "tensorboard"
"""Folder with the same records as TensorBoard events."""

WANDB_ID = "wandb_id"
"""Id of the training's run in Weights & Biases."""

CHECKPOINTS = "checkpoints"
"""Folder of the checkpoints, one folder per train step."""

SNAPSHOTS = "snapshots"
"""Folder of the policies that were kept during the training, one folder per train step."""

LOCK = ".lock"
"""Lock file. The process that trains locks it, and writes its process id into it."""

PROFILE = "profile"
"""Folder of the profiler's trace."""

BAD_STATE = "bad_state.npz"
"""Dump of a training that gave up: the state before the first bad train step."""

EVALUATION = "evaluation.json"
"""Results of `evaluate`, in a run folder of `compare` and in the folder of a shipped policy."""

LEARNING = "learning.json"
"""Results of `learning`: mean speed of each snapshot at each command."""

MILESTONES = "milestones.json"
"""In the folder of a shipped policy: environment steps until the commands reached each speed."""

SEED = "seed-"
"""Beginning of the names of the run folders of `train --seeds`, within the folder of all."""


def seed_folder(run_dir: Path, seed: int) -> Path:
    """The run folder of one seed of `train --seeds`."""
    return run_dir / f"{SEED}{seed}"


def run_name(folder: Path) -> str:
    """The name of a run in results: that of its folder, RUN-seed2 for the folder RUN/seed-2."""
    path = folder.resolve()
    seed = re.fullmatch(f"{SEED}([0-9]+)", path.name)
    return f"{path.parent.name}-seed{seed[1]}" if seed else path.name


def seeds_in(run_dir: Path) -> list[int]:
    """The seeds that have a run folder in `run_dir`, in ascending order; none in a run folder."""
    if not os.path.isdir(run_dir) or (run_dir / CONFIG).exists():
        return []
    names = [path.parent.name.removeprefix(SEED) for path in run_dir.glob(f"{SEED}*/{CONFIG}")]
    return sorted(int(name) for name in names if name.isdecimal())


def seeds_hint(run_dir: Path) -> str:
    """End of a message: the run folders of the seeds in `run_dir`; empty if it has none."""
    seeds = seeds_in(run_dir)
    names = ", ".join(str(seed_folder(run_dir, seed)) for seed in seeds)
    return f"; it holds several trainings, name one: {names}" if seeds else ""


# ------------------------------------------------------------------------------------- writing

FIGURES = (".png", ".jpg", ".webp", ".svg", ".pdf")
"""Suffixes of the figures of `plots` and `doctor`."""


def _target(path: Path) -> Path:
    """The path that a link points to, even if it does not exist yet; otherwise the path itself."""
    return Path(os.path.realpath(path))


def _is_device(path: Path) -> bool:
    """True if the path exists and is no regular file: a device such as /dev/stdout, or a folder."""
    return path.exists() and not path.is_file()


def _part(target: Path) -> Path:
    """Path of the unfinished new content of a file. It has the same suffix."""
    return target.with_name(f".{target.stem}.part{target.suffix}")


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path]:
    """Gives the path of a file to write; at the end that file replaces `path` in one step.

    At any time `path` has either the old content or the new content. After an error the old file is
    unchanged. If `path` is a link, it stays a link, and its target gets the content. A device such
    as /dev/stdout is written directly.
    """
    if _is_device(path):
        yield path
        return
    target = _target(path)
    try:
        yield _part(target)
        os.replace(_part(target), target)
    except BaseException:  # Ctrl-C, too
        with contextlib.suppress(OSError):
            _part(target).unlink()
        raise


def write_atomically(path: Path, text: str) -> None:
    """Writes a file in one step, see `replacing`."""
    with replacing(path) as part:
        part.write_text(text)


@contextlib.contextmanager
def saving(path: Path) -> Generator[Path]:
    """`replacing` for a result that a user has asked for; makes its folder, too.

    Raises:
      ConfigError: the result cannot be written.
    """
    try:
        _make_folder(path)
        with replacing(path) as part:
            yield part
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror or first_line(error)}") from error


def require_writable(path: Path | None) -> None:
    """Makes the folder of a result; ConfigError if the result cannot be written there.

    Call it before work that takes long.
    """
    if path is None:
        return
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if not _is_device(path):
            _make_folder(path)
            target = _target(path)
            _part(target).touch()
            _part(target).unlink()
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error


def _make_folder(path: Path) -> None:
    """Makes the folder of a file; of a link, the folder of the file that it points to."""
    _target(path).parent.mkdir(parents=True, exist_ok=True)


def require_suffix(path: Path | None, kinds: Sequence[str]) -> None:
    """ConfigError if the name of a result ends in none of `kinds`, such as .png."""
    if path is not None and path.suffix.lower() not in kinds:
        raise ConfigError(f"{path}: its name must end in {' or '.join(kinds)}")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes numbers as JSON; ConfigError if that fails. The old file is then unchanged."""
    with saving(path) as part:
        part.write_text(json.dumps(content, indent=1))
