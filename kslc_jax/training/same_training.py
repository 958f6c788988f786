"""Checks that a resumed training has the config of the run folder; else says what to type."""

import dataclasses
import itertools
import shlex
from pathlib import Path
from typing import Any

import jax

from kslc_jax import config as config_lib
from kslc_jax import networks, similar
from kslc_jax.checkpoint_format import identity
from kslc_jax.config import Config, ConfigError
from kslc_jax.fingerprint import changes, fingerprint


def difference(stored: Config, wanted: Config) -> None:
    """ConfigError if the configs differ. It names the first field; the part `run` may differ."""

    def walk(a: object, b: object, where: str) -> None:
        if dataclasses.is_dataclass(a):
            for f in dataclasses.fields(a):
                walk(getattr(a, f.name), getattr(b, f.name), f"{where}.{f.name}".lstrip("."))
        elif a != b and not (where == "physics.robot" and _same_robot(str(a), str(b))):
            raise ConfigError(f"{where} is {a} in the run that is there, not {b}")

    for f in dataclasses.fields(stored):
        if f.name != "run":
            walk(getattr(stored, f.name), getattr(wanted, f.name), f.name)


def _same_robot(stored: str, wanted: str) -> bool:
    """True if the run's copy of a robot has the numbers of the description that is asked for.

    ConfigError names the numbers that have changed since the copy was made.
    """
    if not all(map(config_lib.is_description, (stored, wanted))):
        return False
    if identity(stored) != identity(wanted):
        return False
    if changed := changes(fingerprint(stored), fingerprint(wanted)):
        raise ConfigError(f"{wanted} has changed since the run began: {changed}")
    return True


def require(run_dir: Path, stored: Config, wanted: Config) -> None:
    """ConfigError if `difference` raises one. It adds the command that begins a new training.

    Args:
      run_dir: the run folder with the config `stored`.
      stored, wanted: config of the training there, and of the one that should go on.
    """
    try:
        difference(stored, wanted)
    except ConfigError as error:
        robots = identity(stored.physics.robot), identity(wanted.physics.robot)
        if robots[0] == robots[1] and _networks(stored) == _networks(wanted):
            more, where = ["--start-from", str(run_dir)], "with this run's networks and curriculum"
        else:
            more, where = [], "from the start"
        raise ConfigError(_begin_another(error, where, run_dir, wanted, *more)) from error


def require_seeds(run_dir: Path, stored: list[Config], wanted: Config) -> None:
    """Does the same as `require` for the seeds of `train --seeds`; `wanted` is of the first one."""
    for config in stored:
        try:
            difference(config, dataclasses.replace(wanted, seed=config.seed))
        except ConfigError as error:
            seeds = "--seeds", str(len(stored))
            text = _begin_another(error, "from the start", run_dir, wanted, *seeds)
            raise ConfigError(text) from error


def _begin_another(
    error: ConfigError, where: str, run_dir: Path, wanted: Config, *more: str
) -> str:
    """The message of `difference`, with the command that begins a training with this config."""
    presets = {n: similar.preset(n, wanted.physics.robot) for n in config_lib.PRESETS}
    names = (run_dir.with_name(f"{run_dir.name}-{i}") for i in itertools.count(2))
    command = ["python", "-m", "kslc_jax.train", *config_lib.options(wanted, presets)]
    command += ["--run-dir", str(next(name for name in names if not name.exists())), *more]
    return (
        f"{error}, and --resume goes on with the same training. To begin a new one {where}: "
        f"{shlex.join(command)}"
    )


def _networks(config: Config) -> Any:
    """(structure, shapes) of a config's networks."""
    shapes = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
    return jax.tree.structure(shapes), [x.shape for x in jax.tree.leaves(shapes)]
