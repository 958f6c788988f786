"""Which numbers of a robot go with its falls: friction, payload, motors, ..., in numpy."""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from kslc_jax.randomize import Dynamics
from kslc_jax.robot import Robot

QUARTERS = 4

ENOUGH = 16.3
"""Least chi-square of a suspect. With three degrees of freedom, chance alone exceeds it once in a
thousand. A report tests some 25 numbers, so one report of 40 names a number by chance."""

FEWEST = 4
"""Least number of robots that fell, and of robots that did not, from which anything can be told."""

NAMES = {
    "friction": "friction of the feet",
    "base_mass": "payload [kg]",
    "base_com": "trunk's centre of mass [m]",
    "kp": "kp, factor",
    "kd": "kd, factor",
    "motor_strength": "strength of the motors, factor",
    "joint_friction": "friction of the joints [N m]",
    "link_mass": "mass of the links, factor",
    "link_com": "links' centres of mass [m]",
    "hand_mass": "mass at the hands [kg]",
    "sole": "smaller soles [m]",
}
"""Fields of `Dynamics`, in words. The trials have no noise."""


@dataclass(frozen=True)
class Suspect:
    """A number of the robots that goes with their falls."""

    name: str
    chi_square: float  # how much the quarters differ
    shares: tuple[float, ...]  # share that fell, of the quarter with the least of it to the most


def numbers(dynamics: Dynamics, robot: Robot) -> dict[str, np.ndarray]:
    """The drawn numbers of N robots that can matter: name -> [N]. Of a number per joint or link,
    the mean counts; of a position, each axis."""
    touching = robot.mj_model.geom_contype[robot.sole_geom_ids].any()
    without = {"sole": not touching, "hand_mass": not len(robot.hand_body_ids)}
    found = {}
    for field, name in NAMES.items():
        values = np.asarray(getattr(dynamics, field))
        if without.get(field):
            continue
        if field.endswith("_com"):
            means = values.reshape(len(values), -1, 3).mean(1)
            found |= {f"{name}, {axis}": means[:, i] for i, axis in enumerate("xyz")}
        else:
            found[name] = values.reshape(len(values), -1).mean(1)
    return {name: values for name, values in found.items() if np.ptp(values) > 0}


def told(fell: np.ndarray) -> bool:
    """True if enough robots fell, and enough did not, to tell anything. `fell` is [N] bool."""
    return min(fell.sum(), (~fell).sum()) >= FEWEST


def suspects(fell: np.ndarray, drawn: dict[str, np.ndarray]) -> list[Suspect]:
    """The numbers whose quarters differ more than by chance, the clearest first.

    Args:
      fell: [N] bool.
      drawn: name -> [N], as of `numbers`.
    """
    if not told(fell):
        return []
    mean, found = fell.mean(), []
    for name, values in drawn.items():
        parts = np.array_split(fell[np.argsort(values, kind="stable")], QUARTERS)
        apart = (len(part) * (part.mean() - mean) ** 2 for part in parts)
        chi_square = float(sum(apart) / (mean * (1.0 - mean)))
        if chi_square >= ENOUGH:
            found.append(Suspect(name, chi_square, tuple(float(part.mean()) for part in parts)))
    return sorted(found, key=lambda suspect: -suspect.chi_square)


def kind(speed: float, top: float) -> str:
    """Kind of a commanded forward speed [m/s]: stand, back, slow, or fast (above half of `top`)."""
    if speed <= 0.0:
        return "back" if speed < 0.0 else "stand"
    return "fast" if speed > top / 2 else "slow"


def usual(falls: list[dict[str, Any]], top: float, shown: int = 3) -> list[tuple[str, int]]:
    """The most frequent changes of the command before a fall, such as "fast -> stand", and how
    often each came. `falls` as of `reaction`, `top` [m/s] as of the schedule."""
    names = (" -> ".join(kind(fall[end][0], top) for end in ("from", "to")) for fall in falls)
    return Counter(names).most_common(shown)


def report(
    fell: np.ndarray, drawn: dict[str, np.ndarray], falls: list[dict[str, Any]], top: float
) -> dict[str, Any]:
    """Share that fell, the usual commands before, and the suspects, ready for JSON."""
    return {
        "robots": len(fell),
        "fell": float(fell.mean()),
        "enough_to_tell": bool(told(fell)),
        "commands": usual(falls, top),
        "suspects": [dataclasses.asdict(suspect) for suspect in suspects(fell, drawn)],
        "falls": falls,
    }
