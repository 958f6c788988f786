"""Measures all that the bars read: constant commands, schedules, perturbations, Drake."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

from kslc_jax import physics, similar
from kslc_jax import robot as robot_lib
from kslc_jax.config import RandomizeConfig, preset
from kslc_jax.evaluation import (
    bars,
    gait_metrics,
    options,
    scheduled,
    schedules,
    trained,
    trials,
    variation,
)
from kslc_jax.evaluation import measure as measuring
from kslc_jax.evaluation.size import ROBOTS, Size
from kslc_jax.policy import Policy
from kslc_jax.robot import Robot

SCHEDULE = "random"

DRAKE_SECONDS = 20.0

Rows = list[dict[str, Any]]
"""Metrics of each commanded speed or schedule."""

Told = Callable[[float], None]
"""Takes the share [] of a part that is done."""


def measure(
    policy: Policy,
    size: Size,
    seed: int,
    names: Sequence[str],
    progress: Callable[[str, float], None],
    keep: Callable[[dict[str, Any]], None] = lambda found: None,
) -> dict[str, Any]:
    """The results of the parts `names` of `PARTS`, by their names.

    Args:
      policy: acts deterministically, in C MuJoCo at high fidelity.
      size: of the measurement; of `for_robot`.
      seed: seed of initial states, robots and random commands.
      names: parts to measure.
      progress: called with the name of a part and the share [] of it that is done.
      keep: called with all results after each part.
    """
    found: dict[str, Any] = {}
    for name in names:
        found[name] = PARTS[name](policy, size, seed, functools.partial(progress, name))
        keep(found)
    return found


def for_robot(size: Size, robot: Robot) -> Size:
    """The size for another robot than XBot-L: other speeds, other perturbations."""
    factor = similar.factors(robot)[similar.SPEED]

    def own(speeds: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(bars.scaled(speed, factor) for speed in speeds)

    return dataclasses.replace(
        size,
        speeds=own(size.speeds),
        perturbations=variation.for_robot(size.perturbations, robot),
        perturbed_speeds=own(size.perturbed_speeds),
        top=own((size.top,))[0],
    )


def robots_that_differ(name: str) -> RandomizeConfig:
    """`ROBOTS`, scaled to a robot: a shipped one, or the path of a description."""
    config = dataclasses.replace(preset("laptop"), randomize=ROBOTS)
    return similar.scaled(config, robot_lib.load(name=name)).randomize


def speeds(policy: Policy, size: Size, seed: int, told: Told) -> Rows:
    """Constant commands."""
    plain = trials.Setting(trials.engine(policy, "high"), seconds=size.seconds)
    rows = measuring.measure(policy, plain, size.speeds, size.seeds, seed, told)
    return _marked(rows, policy, plain)


def under_schedules(policy: Policy, size: Size, seed: int, told: Told) -> dict[str, Rows]:
    """Random commands for robots that differ, from each starting heading."""
    found, robots = {}, robots_that_differ(policy.config.physics.robot)
    schedule = schedules.named(SCHEDULE, policy.config, float(policy.curriculum.v_max))
    for i, heading in enumerate(size.headings):
        setting = trials.Setting(
            trials.engine(policy, "high"),
            randomize=robots,
            seconds=size.schedule_seconds,
            heading=heading,
        )
        part = _part(told, i, len(size.headings))
        found[f"heading={heading:.2f}"] = scheduled.measure(
            policy, setting, [schedule], size.schedule_robots, seed, part
        )
    return found


def perturbed(policy: Policy, size: Size, seed: int, told: Told) -> dict[str, Rows]:
    """Survival and mean speed under each perturbation."""
    found = {}
    for i, condition in enumerate(size.perturbations):
        trial = condition, size.perturbed_speeds, size.perturbed_seeds, size.perturbed_seconds
        found[condition] = _tried(policy, *trial, seed, _part(told, i, len(size.perturbations)))
    return found


def harsh(policy: Policy, size: Size, seed: int, told: Told) -> dict[str, dict[str, Any]]:
    """The wanted share and the rows of each condition of `bars.HARSH` that the robot can have."""
    robot = physics.robot_for(policy.config.physics)
    factor, found = similar.factors(robot)[similar.SPEED], {}
    for i, (condition, (wanted, commanded)) in enumerate(bars.HARSH.items()):
        own = tuple(bars.scaled(speed, factor) for speed in commanded)
        for name in variation.for_robot([condition], robot):
            trial = name, own, size.harsh_seeds, size.harsh_seconds
            rows = _tried(policy, *trial, seed, _part(told, i, len(bars.HARSH)))
            found[name] = {"wanted": wanted, "rows": rows}
    return found


def in_drake(policy: Policy, size: Size, seed: int, told: Told) -> Rows:
    """Constant commands in Drake, one trial per speed."""
    engine, simulate = trials.engine(policy, "high"), options.simulator("drake")
    setting = trials.Setting(engine, seconds=DRAKE_SECONDS, simulate=simulate)
    commanded = [speed for speed in size.speeds if speed <= size.top]
    return measuring.measure(policy, setting, commanded, 1, seed, told)


PARTS = {
    "speeds": speeds,
    "schedules": under_schedules,
    "perturbed": perturbed,
    "harsh": harsh,
    "drake": in_drake,
}
"""Parts of the measurement, in their order."""


def _part(told: Told, index: int, count: int) -> Told:
    """A function for the condition number `index` of `count`: it takes the share of it that is
    done, and reports the share of all conditions."""
    return lambda share: told((index + share) / count)


def _tried(
    policy: Policy,
    condition: str,
    commanded: Sequence[float],
    seeds: int,
    seconds: float,
    seed: int,
    told: Told,
) -> Rows:
    """Survival and mean speed at each commanded speed [m/s] under one condition."""

    def speed(trace, command: float, robot: Robot, dt: float) -> dict[str, float]:
        return gait_metrics.speed(trace, command, dt)

    plain = trials.Setting(trials.engine(policy, "high"), seconds=seconds)
    setting = trials.under(plain, condition)
    rows = measuring.measure(policy, setting, commanded, seeds, seed, told, speed)
    return _marked(rows, policy, setting)


def _marked(rows: Rows, policy: Policy, setting: trials.Setting) -> Rows:
    """The rows, each with the reasons of `trained.beyond`."""
    return [row | trained.beyond(policy, setting, (row["command"], 0.0, 0.0)) for row in rows]
