"""Sends the records of a training to Weights & Biases: `train --wandb`. Needs the package wandb.

The environment variables of wandb apply. WANDB_MODE=offline needs no account and no network.
"""

import contextlib
import os
import secrets
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from kslc_jax import config as config_lib
from kslc_jax import files
from kslc_jax.config import Config
from kslc_jax.errors import MissingPackage, UserError
from kslc_jax.runtime import first_line
from kslc_jax.training.logs import finite_values

PROJECT = "kslc_jax"
"""Project of all trainings, unless WANDB_PROJECT names another."""


def package() -> Any:
    """The package wandb. If it is missing, MissingPackage says what to install."""
    try:
        import wandb
    except ImportError as error:
        raise MissingPackage(f"--wandb: {error} (pip install 'kslc_jax[wandb]')") from error
    return wandb


class WandbRun:
    """One training as a run of Weights & Biases. Its failures never end the training."""

    def __init__(self, run: Any, warn: Callable[[str], None]):
        self._run, self._warn = run, warn
        self._failed = False

    def write(self, record: dict[str, float]) -> None:
        """Sends the finite values of a record. Only the first failure calls `warn`."""
        try:
            # Without `step`: wandb ignores a step that does not grow, as after going back.
            self._run.log(finite_values(record))
        except Exception as error:  # network, disk, or a bug of the package
            if not self._failed:
                self._warn(f"cannot write to wandb ({first_line(error)}); training goes on")
            self._failed = True

    def close(self, exit_code: int) -> None:
        """Sends the remaining records. An `exit_code` other than 0 marks the run as failed."""
        try:
            self._run.finish(exit_code=exit_code)
        except Exception as error:
            self._warn(f"cannot finish the wandb run ({first_line(error)})")


@contextlib.contextmanager
def wandb_run(
    config: Config, run_dir: Path, resume: bool, warn: Callable[[str], None]
) -> Generator[WandbRun]:
    """Opens the wandb run of a training; a resume opens the same run again.

    Raises:
      UserError: wandb refuses.
    """
    wandb = package()
    try:
        run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            name=os.environ.get("WANDB_NAME", run_dir.name),
            id=_run_id(run_dir, resume),
            resume="allow",
            dir=str(run_dir),
            config=config_lib.to_dict(config),
            settings=wandb.Settings(console="off"),  # the progress table is no log
        )
        run.define_metric("*", step_metric="env_steps")
    except Exception as error:  # no account, no network, a wrong setting
        other = "WANDB_MODE=offline needs no account and no network"
        raise UserError(f"--wandb: {first_line(error)} ({other})") from error
    opened = WandbRun(run, warn)
    try:
        yield opened
    except BaseException:
        opened.close(1)
        raise
    opened.close(0)


def _run_id(run_dir: Path, resume: bool) -> str:
    """The id that is stored in the run folder. A new training stores a new one."""
    path = run_dir / files.WANDB_ID
    if resume and path.exists():
        return path.read_text().strip()
    new = secrets.token_hex(4)
    files.write_atomically(path, new)
    return new
