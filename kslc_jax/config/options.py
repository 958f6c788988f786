"""A config as command-line options of `python -m kslc_jax.train`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from kslc_jax.config.physics import XBOT_L
from kslc_jax.config.presets import PRESETS
from kslc_jax.config.schema import Config


def options(config: Config, presets: Mapping[str, Config] = PRESETS) -> list[str]:
    """The options of `train` that give `config`: the nearest preset and what differs from it.

    `presets` are those of the config's robot.
    """
    robot = config.physics.robot
    changes = {name: _changes(preset, config) for name, preset in presets.items()}
    nearest = min(changes, key=lambda name: len(changes[name]))
    of = [] if robot == XBOT_L else ["--robot", robot]
    return [*of, "--preset", nearest, *(word for option in changes[nearest] for word in option)]


def _changes(base: Any, wanted: Any, where: str = "") -> list[list[str]]:
    """One option per field in which `wanted` differs from `base`."""
    if dataclasses.is_dataclass(base):
        names = [f.name for f in dataclasses.fields(base)]
        parts = (_changes(getattr(base, n), getattr(wanted, n), f"{where}.{n}") for n in names)
        return [option for part in parts for option in part]
    return [] if base == wanted else [_option(where, wanted)]


def _option(where: str, value: Any) -> list[str]:
    *groups, name = where.lstrip(".").replace("_", "-").split(".")
    if isinstance(value, bool):
        name = name if value else f"no-{name}"
        return ["--" + ".".join([*groups, name])]
    values = value if isinstance(value, tuple) else (value,)
    return ["--" + ".".join([*groups, name]), *map(str, values)]
