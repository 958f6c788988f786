"""Results on disk: whole or not at all, and a full or forbidden one told in one line."""

import json
import os
from pathlib import Path
from typing import Any

from kslc_jax.config import ConfigError

# ------------------------------------------------------------------- names within a run folder

CONFIG = "config.json"
"""The training's config."""

VERSIONS = "versions.json"
"""Versions of the packages, the machine, and where the training began."""

METRICS = "metrics.jsonl"
"""One record of metrics per line."""

TENSORBOARD = "tensorboard"
"""Folder of the same records as TensorBoard events."""

WANDB_ID = "wandb_id"
"""Id of the training's run in Weights & Biases."""

CHECKPOINTS = "checkpoints"
"""Folder of the checkpoints, one folder per train step."""

SNAPSHOTS = "snapshots"
"""Folder of the policies that were kept during the training, one folder per train step."""

LOCK = ".lock"
"""Locked by the process that trains; holds its process id."""

PROFILE = "profile"
"""Folder of the profiler's trace."""

BAD_STATE = "bad_state.npz"
"""The state before the first bad train step of a training that gave up."""

EVALUATION = "evaluation.json"
"""Numbers of `evaluate`, in a run folder of `compare` and beside a shipped policy."""

LEARNING = "learning.json"
"""Numbers of `learning`: how each commanded speed was learnt."""

MILESTONES = "milestones.json"
"""Beside a shipped policy: environment steps until commands reached each speed."""

# ------------------------------------------------------------------------------------- writing


def _target(path: Path) -> Path:
    """Where a link leads to, also if nothing is there yet; else the path itself."""
    return Path(os.path.realpath(path))


def write_atomically(path: Path, text: str) -> None:
    """Writes a file at once: whatever happens, `path` holds all of the old or all of the new.

    A link stays one; what it points to is written.
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
    """ConfigError where a result could not be written in the end; makes its folder."""
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
    """Keeps numbers as JSON; ConfigError where that fails, and then the old file is still whole."""
    special = path.exists() and not path.is_file()  # /dev/stdout
    try:
        (Path.write_text if special else write_atomically)(path, json.dumps(content, indent=1))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
