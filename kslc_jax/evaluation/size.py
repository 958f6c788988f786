"""How thoroughly `kslc_jax.judge` measures a policy. Imports no JAX."""

import math
from dataclasses import dataclass

from kslc_jax.config import RandomizeConfig
from kslc_jax.evaluation.bars import PERTURBED_TOP, TOP
from kslc_jax.evaluation.perturbations import ALL

SPEEDS = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
"""Commanded speeds [m/s]. No bar uses the last one; only --json has its numbers."""

HEADINGS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Starting headings [rad] of the schedule. At pi the measured yaw jumps between pi and -pi."""


ROBOTS = RandomizeConfig(
    friction=(0.1, 2.0),
    ground_friction=0.6,
    base_mass=(-5.0, 5.0),
    base_com=(-0.02, 0.02),
    kp=(0.9, 1.1),
    kd=(0.9, 1.1),
    motor_strength=(0.9, 1.0),
    joint_friction=(0.0, 1.0),
    link_mass=(0.9, 1.1),
    link_com=(-0.01, 0.01),
    hand_mass=(0.0, 0.5),
    sole=(0.0, 0.02),
    noise=(0.0, 1.0),
    push_seconds=0.0,
)
"""Robots that differ, for XBot-L: those of the schedule. They do not change with a recipe, so that
policies of all recipes meet the same robots."""


@dataclass(frozen=True)
class Size:
    """Size of the measurement: speeds [m/s], headings [rad], robots per condition, seconds."""

    speeds: tuple[float, ...] = SPEEDS
    seeds: int = 4
    seconds: float = 60.0
    headings: tuple[float, ...] = HEADINGS
    schedule_robots: int = 16
    schedule_seconds: float = 60.0
    perturbations: tuple[str, ...] = ALL
    perturbed_speeds: tuple[float, ...] = (1.0, 2.0, PERTURBED_TOP)
    perturbed_seeds: int = 4
    perturbed_seconds: float = 20.0
    harsh_seeds: int = 32
    harsh_seconds: float = 30.0
    top: float = TOP  # fastest speed that Drake tries


FULL = Size()
"""A judgement."""

QUICK = Size(
    speeds=(0.0, 0.5, 2.0, 3.5, 4.0),
    seeds=2,
    seconds=15.0,
    headings=(0.0, math.pi),
    schedule_robots=8,
    schedule_seconds=20.0,
    perturbations=("push=0.5",),
    perturbed_speeds=(PERTURBED_TOP,),
    perturbed_seeds=2,
    perturbed_seconds=8.0,
    harsh_seeds=4,
    harsh_seconds=8.0,
)
"""A first look."""
