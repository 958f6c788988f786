"""Results on disk: whole or not at all, and a full or forbidden one told in one line."""

import json
import os
from pathlib import Path
from typing import Any

from kslc_jax.config import ConfigError


def _target(path: Path) -> Path:
    """Where a link leads to, also if nothing is there yet; else the path itself."""
    return Path(os.path.realpath(path))


def write_whole(path: Path, text: str) -> None:
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
        (Path.write_text if special else write_whole)(path, json.dumps(content, indent=1))
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error
