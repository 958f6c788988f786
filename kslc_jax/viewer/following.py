"""Finds the newest policy of a running training."""

import math
import time
from pathlib import Path

from kslc_jax import files
from kslc_jax.checkpoint_format import CheckpointError, has_checkpoints, whole_checkpoints
from kslc_jax.config import ConfigError
from kslc_jax.policy import checkpoint_folder

LOOK_SECONDS = 1.0
"""Time [s] between two looks into the run folder."""


def newest(run_dir: Path) -> Path | None:
    """The folder of the latest checkpoint or snapshot; None before the first checkpoint."""
    if not has_checkpoints(run_dir):
        return None
    folders = [run_dir / files.CHECKPOINTS, run_dir / files.SNAPSHOTS]
    found = [path for folder in folders if folder.is_dir() for path in whole_checkpoints(folder)]
    # If both exist for a train step, take the snapshot: the training never removes it.
    return max(found, key=lambda p: (int(p.name), p.parent.name == files.SNAPSHOTS), default=None)


def _is_policy(path: Path) -> bool:
    """True if `load_policy` finds a policy there."""
    try:
        checkpoint_folder(path)
    except CheckpointError:
        return False
    return True


class Follower:
    """Returns each new policy of one run folder once."""

    def __init__(self, run_dir: Path):
        """ConfigError if the path cannot become the run folder of a training, see `_begun`."""
        self._run_dir = run_dir
        self._seen: Path | None = None
        self._looked = -math.inf
        self._begun()

    def _begun(self) -> bool:
        """True if the training has begun, False if it may still begin.

        ConfigError if the path is something else: a policy, a file, the folder of several seeds.
        """
        if (self._run_dir / files.CONFIG).is_file():
            return True
        if self._run_dir.is_file() or files.seeds_in(self._run_dir) or _is_policy(self._run_dir):
            raise ConfigError(
                f"--follow: {self._run_dir} is no run folder of a training (no {files.CONFIG})"
                f"{files.seeds_hint(self._run_dir)}"
            )
        return False

    def wait(self) -> Path:
        """The folder of the newest policy. Waits for the training and for its first checkpoint."""
        if newest(self._run_dir) is None:
            yet = "" if self._begun() else "; no training has begun there yet"
            print(f"waiting for the first checkpoint in {self._run_dir}{yet}", flush=True)
        while (path := self.fresh(time.monotonic())) is None:
            self._begun()
            time.sleep(LOOK_SECONDS)
        return path

    def fresh(self, now: float) -> Path | None:
        """The folder of a policy that is new since the last call, else None.

        `now` is the clock time [s]. Calls within `LOOK_SECONDS` of a look return None.
        """
        if now - self._looked < LOOK_SECONDS:
            return None
        self._looked = now
        path = newest(self._run_dir)
        if path == self._seen:
            return None
        self._seen = path
        return path
