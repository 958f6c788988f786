"""Presets for a robot of any size, by dynamic similarity with XBot-L.

Two robots of the same shape move alike if lengths scale with l, times and speeds with sqrt(l),
forces with m, torques with m l and angular momenta with m l sqrt(l). l is the ratio of the standing
heights, m that of the masses. Sums over the joints also scale with their number. XBot-L has
l = m = 1, and its presets stay as they are. docs/own_robot.md explains each rule and its limits.
"""

import dataclasses
import math
import typing
from functools import reduce
from typing import Any

from kslc_jax import config as config_lib
from kslc_jax import robot as robot_lib
from kslc_jax.config import Config, ConfigError
from kslc_jax.config.storage import valid
from kslc_jax.robot import Robot
from kslc_jax.robots import build, description

DIGITS = 3
"""Significant digits of a scaled number: more would claim an accuracy that similarity lacks."""


def preset(name: str, robot: str = config_lib.XBOT_L, without: tuple[str, ...] = ()) -> Config:
    """The named preset for a robot: scaled, then with the [config] of the robot's description.

    Args:
      name: of the preset.
      robot: a shipped robot, or the path of a description.
      without: ablations.

    Raises:
      ConfigError: unknown preset, ablation or field, or a value that cannot work.
      RobotError: unknown robot, one that cannot be used, or one whose files changed after this
        process had loaded it.
    """
    about, config = description.read(robot), config_lib.preset(name, without)
    where = robot if robot in description.known() else str(about.path)
    physics = dataclasses.replace(config.physics, robot=where)
    loaded = robot_lib.load(name=where)
    if loaded.files_changed != build.changed_at(about):
        raise description.RobotError(
            f"{about.path}: a file of this robot changed after this process had loaded it; start "
            "Python again (in a notebook: restart the kernel)"
        )
    config = scaled(dataclasses.replace(config, physics=physics), loaded)
    return _changed(config, dict(about.config), f"{about.path}: config")


SPEED = "curriculum.v_limit"
"""Field whose entry in `factors` is the factor on speeds."""


def scaled(config: Config, robot: Robot) -> Config:
    """A config for XBot-L, scaled to another robot."""
    changes = {
        field: _times(reduce(getattr, field.split("."), config), factor)
        for field, factor in factors(robot).items()
        if factor != 1.0
    }
    return _changed(config, changes, "scaled")


def factors(robot: Robot) -> dict[str, float]:
    """Factor on each config field that depends on the robot's size, by the field's dotted name."""
    xbot = robot_lib.load()
    length, mass = robot.length_ratio, robot.mass_ratio
    time = math.sqrt(length)  # of speeds too
    joints = xbot.count / robot.count
    return {
        "command.vy": time,
        "command.dead_zone": time,
        "command.slow_speed": time,
        "command.narrow_speed": time,
        "gait.cycle_time": time,
        "gait.full_speed": time,
        "gait.cycle_from_speed": time,
        "curriculum.v_min": time,
        "curriculum.v_start": time,
        "curriculum.gait_from": time,
        "curriculum.v_step": time,
        "curriculum.v_limit": time,
        "curriculum.cycle_min": time,
        "curriculum.top_error_from": time,
        "curriculum.top_error_floor": time,
        "physics.terrain.rough": length,
        "physics.terrain.stairs": length,
        "physics.terrain.full_from": time,
        "randomize.base_mass": mass,
        "randomize.base_com": length,
        "randomize.link_com": length,
        "randomize.hand_mass": mass,
        "randomize.joint_friction": mass * length,
        "randomize.sole": length,
        "randomize.punch": mass,
        "randomize.push_velocity": time,
        "randomize.push_angular": 1.0 / time,
        "rewards.momentum_scale": mass * length * time,
        "rewards.base_height_target": length,
        "rewards.base_height_kernel": 1.0 / length,
        "rewards.clearance_target": length,
        "rewards.clearance_width": length,
        "rewards.max_contact_force": mass,
        "rewards.contact_force_range": mass,
        "rewards.longest_air_time": time,
        "rewards.feet_distance": robot.feet_apart / xbot.feet_apart,
        "rewards.knee_distance": robot.knees_apart / xbot.knees_apart,
        "rewards.lean_per_speed": 1.0 / time,
        "rewards.exact_from": time,
        "rewards.exact_full": time,
        "rewards.joint_pos_kernel": math.sqrt(joints),
        "rewards.joint_pos_penalty": math.sqrt(joints),
        "rewards.joint_pos_clip": 1.0 / math.sqrt(joints),
        "rewards.restless": math.sqrt(joints),  # within stand_still
        "rewards.shuffle": 1.0 / math.sqrt(joints),  # the same
        "rewards.shuffle_speed": time,
        "rewards.weights.stand_still": math.sqrt(joints),
        "rewards.weights.dof_vel_limits": joints,
        "rewards.weights.feet_air_time": 1.0 / time,
        "rewards.weights.foot_slip": 1.0 / math.sqrt(time),
        "rewards.weights.feet_contact_forces": 1.0 / mass,
        "rewards.weights.action_smoothness": joints,
        "rewards.weights.torques": joints / (mass * length) ** 2,
        "rewards.weights.dof_vel": joints * length,
        "rewards.weights.dof_acc": joints * length**2,
    }


def _times(value: Any, factor: float) -> Any:
    """A number or a range, times a factor."""
    if isinstance(value, tuple):
        return tuple(_times(part, factor) for part in value)
    return float(f"{value * factor:.{DIGITS}g}") if abs(value) < 1e8 else value  # 1e9: switched off


def _changed(config: Any, changes: dict[str, Any], where: str) -> Any:
    """The config with other values of fields, by their dotted names. All change at once, because
    checks compare fields with each other."""
    inside: dict[str, dict[str, Any]] = {}
    for field, value in changes.items():
        name, _, rest = field.partition(".")
        inside.setdefault(name, {})[rest] = value
    names = [f.name for f in dataclasses.fields(config)]
    new = {}
    for name, parts in inside.items():
        if name not in names:
            raise ConfigError(f"{where}: unknown field {name!r}; there are {', '.join(names)}")
        old = getattr(config, name)
        if "" in parts:
            # A description is the robot: it cannot name another one.
            if name == "robot" or dataclasses.is_dataclass(old):
                raise ConfigError(f"{where}: {name}: {parts['']!r} is not a valid value")
            hint = typing.get_type_hints(type(config))[name]
            new[name] = valid(hint, parts[""], f"{where}: {name}")
        elif dataclasses.is_dataclass(old):
            new[name] = _changed(old, parts, where)
        else:
            raise ConfigError(f"{where}: {name!r} has no field {next(iter(parts))!r}")
    return dataclasses.replace(config, **new)
