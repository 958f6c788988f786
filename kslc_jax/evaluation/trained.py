"""Compares the conditions of a trial with the conditions that the policy was trained for."""

import dataclasses
import math
from collections.abc import Sequence

from kslc_jax import commands
from kslc_jax.config import GROUNDS, Config, RandomizeConfig, TerrainConfig
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.evaluation.schedules import Schedule
from kslc_jax.evaluation.trials import Setting
from kslc_jax.policy import Policy

TOLERANCE = 1e-6
"""Numbers that exceed a range by at most this still lie in the range."""

RANGES = ("base_mass", "base_com", "kp", "kd", "motor_strength", "joint_friction", "link_mass")
"""Fields of RandomizeConfig whose ranges are compared directly."""


def beyond(
    policy: Policy, setting: Setting, command: Sequence[float] = (0.0, 0.0, 0.0)
) -> dict[str, list[str]]:
    """{"beyond": reasons} if a trial goes beyond the training conditions, else {}.

    Args:
      policy: its config and curriculum give the training conditions.
      setting: conditions of the trial; its schedule, if any, gives the commands.
      command: vx, vy [m/s], yaw rate [rad/s] of a trial without a schedule.
    """
    trained, v_max = policy.config, float(policy.curriculum.v_max)
    schedule = setting.schedule
    asked = _commanded(schedule, trained, setting.heading) if schedule else [tuple(command)]
    reasons = _command_reasons(trained, v_max, asked)
    shortest = trained.command.shortest_seconds or trained.command.resample_seconds
    if schedule and _pace(schedule) < shortest - TOLERANCE:
        reasons.append("pace")
    reasons += _robot_reasons(trained.randomize, setting.randomize)
    reasons += _ground_reasons(trained.physics.terrain, v_max, setting.physics.terrain)
    if setting.latency > trained.env.action_delay:
        reasons.append("latency")
    others: dict[str, bool | float] = {"imu": any(setting.imu_offset)}
    for field in dataclasses.fields(Variation):
        others[field.name] = getattr(setting.variation, field.name)
    others["hands"] = setting.variation.hands > trained.randomize.hand_mass[1] + TOLERANCE
    reasons += [name for name, value in others.items() if value]
    return {"beyond": reasons} if reasons else {}


def _commanded(
    schedule: Schedule, trained: Config, facing: float
) -> list[tuple[float, float, float]]:
    """vx, vy [m/s] and yaw rate [rad/s] of each command, of a robot that begins at `facing` [rad].

    A step with a heading asks for the yaw rate with which the turn to it begins.
    """
    if not schedule.steps:
        return [(schedule.low, 0.0, 0.0), (schedule.top, 0.0, 0.0)]
    asked, most = [], trained.command.max_yaw_rate
    for step in 2 * schedule.steps:  # the list repeats
        rate = step.yaw_rate
        facing += rate * step.seconds
        if step.heading is not None:
            turn = math.remainder(step.heading - facing, 2 * math.pi)
            rate = max(-most, min(most, trained.command.heading_gain * turn))
            facing = step.heading
        asked.append((step.vx, step.vy, rate))
    return asked


def _pace(schedule: Schedule) -> float:
    """Duration of the shortest leg [s]."""
    return min((step.seconds for step in schedule.steps), default=schedule.seconds[0])


def _command_reasons(trained: Config, v_max: float, asked) -> list[str]:
    """Those of "speed", "sideways" and "turn" for which a command asks more than the training."""
    found = set()
    for vx, vy, yaw_rate in asked:
        right, left, turn = commands.widest(trained.command, vx)
        spans = {
            "speed": (vx, trained.curriculum.v_min, v_max),
            "sideways": (vy, right, left),
            "turn": (yaw_rate, -turn, turn),
        }
        for name, (value, low, high) in spans.items():
            if not low - TOLERANCE <= value <= high + TOLERANCE:
                found.add(name)
    return [name for name in ("speed", "sideways", "turn") if name in found]


def _robot_reasons(trained: RandomizeConfig, tried: RandomizeConfig) -> list[str]:
    def contact(config: RandomizeConfig) -> tuple[float, float]:
        low, high = (0.5 * (mu + config.ground_friction) for mu in config.friction)
        return low, high

    spans = {name: (getattr(tried, name), getattr(trained, name)) for name in RANGES}
    spans["friction"] = contact(tried), contact(trained)
    reasons = [
        name
        for name, (mine, theirs) in spans.items()
        if mine[0] < theirs[0] - TOLERANCE or mine[1] > theirs[1] + TOLERANCE
    ]
    largest = trained.push_velocity if trained.push_seconds > 0 else 0.0
    pushed = tried.push_seconds > 0 and tried.push_velocity > largest
    punched = tried.punch[1] > trained.punch[1]
    held = tried.held_arms > 0 and trained.held_arms == 0
    return reasons + ["push"] * pushed + ["punch"] * punched + ["arms"] * held


def _ground_reasons(trained: TerrainConfig, v_max: float, tried: TerrainConfig) -> list[str]:
    grown = min(1.0, v_max / trained.full_from) if trained.full_from else 1.0
    larger = (getattr(tried, kind) > grown * getattr(trained, kind) + TOLERANCE for kind in GROUNDS)
    return ["ground"] * any(larger)
