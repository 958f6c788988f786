"""Configs as JSON: plain dicts with a schema version. Reading refuses unknown or wrong fields."""

import dataclasses
import json
import typing
from pathlib import Path
from typing import Any, Literal

from kslc_jax.config.checks import require
from kslc_jax.config.schema import Config

SCHEMA_VERSION = 1

REMOVED_FIELDS = {"config.physics.clamp_joint_speed"}
"""Fields of older files that the reader ignores."""


ROBOT_FOLDER = "robot"
"""Folder with the copy of a user's robot, in a run folder or in the folder of a policy."""


def to_dict(config: Config) -> dict[str, Any]:
    """Plain nested dict for JSON, with the schema version.

    The path of a robot's description becomes that of its copy, relative to the run folder: files on
    disk name no folder of this machine.
    """
    data = dataclasses.asdict(config)
    if is_description(robot := config.physics.robot):
        data["physics"]["robot"] = f"{ROBOT_FOLDER}/{Path(robot).name}"
    return {"schema": SCHEMA_VERSION, **data}


def is_description(robot: str) -> bool:
    """True if `physics.robot` is the path of a description, False if it is a shipped robot."""
    return robot.endswith(".toml")


def find_robot(robot: str, folder: Path) -> str:
    """The path of the robot's copy in `folder`; `robot` itself if there is none.

    Args:
      robot: `physics.robot` of a stored config.
      folder: run folder, or folder of a policy.

    Raises:
      ConfigError: `robot` is a description, and neither of these files exists.
    """
    if not is_description(robot):
        return robot
    name = Path(robot).name
    copy = folder.resolve() / ROBOT_FOLDER / name  # the same path also through a link
    if copy.is_file():
        return str(copy)
    require(
        Path(robot).is_file(),
        f"its robot is missing, {ROBOT_FOLDER}/{name}: copy the folder {ROBOT_FOLDER} of its run "
        f"to {folder}",
    )
    return robot


def from_dict(data: dict[str, Any], folder: Path | None = None) -> Config:
    """Inverse of `to_dict`. ConfigError names an unknown field or a wrong value.

    A missing field gets its default. So the default of a new field must keep the old behaviour.
    `find_robot` looks for the robot in `folder`, the run folder or the folder of the policy.
    """
    require(isinstance(data, dict), "config: not a JSON object")
    data = dict(data)
    schema = data.pop("schema", None)
    require(
        schema == SCHEMA_VERSION,
        f"config: schema version {schema}, this kslc_jax reads version {SCHEMA_VERSION}",
    )
    config = _build(Config, data, "config")
    if folder is None:
        return config
    robot = find_robot(config.physics.robot, folder)
    return dataclasses.replace(config, physics=dataclasses.replace(config.physics, robot=robot))


def _build(cls: Any, data: Any, where: str) -> Any:
    require(isinstance(data, dict), f"{where}: expected an object, got {type(data).__name__}")
    resolved = typing.get_type_hints(cls)
    hints = {f.name: resolved[f.name] for f in dataclasses.fields(cls)}
    data = {n: value for n, value in data.items() if f"{where}.{n}" not in REMOVED_FIELDS}
    unknown = set(data) - set(hints)
    require(not unknown, f"{where}: unknown field {', '.join(sorted(unknown))}")
    return cls(**{n: valid(hints[n], data[n], f"{where}.{n}") for n in data})


def valid(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint` of its field: a list becomes a tuple, an int a float.

    Raises:
      ConfigError: `value` is not of that type. The message begins with `where`.
    """
    wrong = f"{where}: {json.dumps(value, default=str)} is not a valid value"
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where)
    if origin is Literal:
        require(value in typing.get_args(hint), wrong)
        return value
    if origin is tuple:
        require(isinstance(value, list | tuple), wrong)
        args = typing.get_args(hint)
        require(args[-1] is Ellipsis or len(value) == len(args), wrong)
        return tuple(valid(args[0], v, where) for v in value)
    if hint is float:
        require(isinstance(value, int | float) and not isinstance(value, bool), wrong)
        return float(value)
    require(isinstance(value, hint) and (hint is bool or not isinstance(value, bool)), wrong)
    return value
