"""Names of the files in a run folder, and writing of results: complete or not at all.

If a file cannot be written, the error has one line.
"""

import json
import os
from pathlib import Path
from typing import Any

from kslc_jax.config import ROBOT_FOLDER, ConfigError

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


def seeds_in(run_dir: Path) -> list[int]:
    """The seeds that have a run folder in `run_dir`, in ascending order; none in a run folder."""
    if not os.path.isdir(run_dir) or (run_dir / CONFIG).exists():
        return []
    names = [path.parent.name.removeprefix(SEED) for path in run_dir.glob(f"{SEED}*/{CONFIG}")]
    return sorted(int(name) for name in names if name.isdecimal())


# ------------------------------------------------------------------------------------- writing


def _target(path: Path) -> Path:
    """The path that a link points to, even if it does not exist yet; otherwise the path itself."""
    return Path(os.path.realpath(path))


def write_atomically(path: Path, text: str) -> None:
    """Writes a file in one step: at any time `path` has either the old text or the new text.

    If `path` is a link, it stays a link, and its target gets the text.
    """
    path = _target(path)
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(text)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def require_writable(path: Path | None) -> None:
    """Makes the folder of a result; ConfigError if the result cannot be written there."""
    if path is None:
        return
    try:
        folder = _target(path).parent
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
    if path.is_dir() or not os.access(path if path.exists() else folder, os.W_OK):
        raise ConfigError(f"cannot write {path}")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes numbers as JSON; ConfigError if that fails. The old file is then unchanged."""
    special = path.exists() and not path.is_file()  # such as /dev/stdout
    try:
        (Path.write_text if special else write_atomically)(path, json.dumps(content, indent=1))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
