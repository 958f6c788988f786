"""Which number of a robot decides if it falls: friction, payload, motors, ..., in numpy."""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from kslc_jax.randomize import Dynamics

QUARTERS = 4

ENOUGH = 3.0
"""A number stands out if robots that fell differ in it from the others by so many standard errors.
By chance alone, one number of 370 does."""

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
    "noise": "noise, factor",
}
"""Fields of `Dynamics`, in words."""


@dataclass(frozen=True)
class Suspect:
    """A number in which robots that fell differ from those that did not."""

    name: str
    errors: float  # difference of the two means in standard errors; below 0: less of it falls
    shares: tuple[float, ...]  # share that fell, of the quarter with the least of it to the most


def numbers(dynamics: Dynamics) -> dict[str, np.ndarray]:
    """The drawn numbers of N robots: name -> [N]. Of a number per joint or link, the mean counts;
    of a position, each axis."""
    found = {}
    for field, name in NAMES.items():
        values = np.asarray(getattr(dynamics, field))
        if field.endswith("_com"):
            means = values.reshape(len(values), -1, 3).mean(1)
            found |= {f"{name}, {axis}": means[:, i] for i, axis in enumerate("xyz")}
        else:
            found[name] = values.reshape(len(values), -1).mean(1)
    return {name: values for name, values in found.items() if np.ptp(values) > 0}


def suspects(fell: np.ndarray, drawn: dict[str, np.ndarray]) -> list[Suspect]:
    """The numbers that stand out, the clearest first. Empty if too few fell, or too few did not.

    Args:
      fell: [N] bool.
      drawn: name -> [N], as of `numbers`.
    """
    if min(fell.sum(), (~fell).sum()) < FEWEST:
        return []
    spread = np.sqrt(1 / fell.sum() + 1 / (~fell).sum())
    found = []
    for name, values in drawn.items():
        errors = (values[fell].mean() - values[~fell].mean()) / (values.std() * spread)
        if abs(errors) >= ENOUGH:
            parts = np.array_split(fell[np.argsort(values, kind="stable")], QUARTERS)
            shares = tuple(float(part.mean()) for part in parts)
            found.append(Suspect(name, float(errors), shares))
    return sorted(found, key=lambda suspect: -abs(suspect.errors))


def usual(falls: list[dict[str, Any]], shown: int = 3) -> list[tuple[str, int]]:
    """The most frequent changes of the command before a fall, and how often each came.

    A change is named by its forward speeds [m/s], rounded: "4 -> 0". `falls` as of `reaction`.
    """
    names = (" -> ".join(f"{round(fall[end][0]) + 0}" for end in ("from", "to")) for fall in falls)
    return Counter(names).most_common(shown)


def report(fell: np.ndarray, dynamics: Dynamics, falls: list[dict[str, Any]]) -> dict[str, Any]:
    """Share that fell, the usual commands before, and the suspects, ready for JSON."""
    found = suspects(fell, numbers(dynamics))
    return {
        "robots": len(fell),
        "fell": float(fell.mean()),
        "commands": usual(falls),
        "suspects": [dataclasses.asdict(suspect) for suspect in found],
        "falls": falls,
    }
