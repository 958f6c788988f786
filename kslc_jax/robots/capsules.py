"""Capsules that stand for the robot's parts in the contacts of training."""

import itertools
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from kslc_jax.robots.anatomy import Anatomy
from kslc_jax.robots.contacts import PAIR_MARGIN, Part

INSIDE = 0.9
"""Least share of a part's surface points that its capsule has inside."""

CELL = 0.05
"""Size of the cells in which one point counts, as a share of the part's largest extent."""

THINNEST = 0.3
"""Least share of its radius that a capsule keeps where parts of different limbs are close."""


THICKER = 1.5
"""A thigh's capsule stands for the hip, too, if that makes it thicker by less than this factor.

A thicker one would keep the legs apart where only the hips are wide. Such hips have a capsule of
their own."""

_MIRROR = np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` of a segment, in the world at home [m]."""

    start: np.ndarray  # [3]
    end: np.ndarray  # [3]
    radius: float


def parts(model: mujoco.MjModel, anatomy: Anatomy) -> dict[str, list[int]]:
    """Bodies of each part: "trunk", "left_hip", "left_thigh", "left_shank", "left_forearm", ...

    The capsule of a part moves with its first body. The hip has all bodies of the leg above the
    thigh, the lowest one first. The forearm has all bodies from the elbow on. An arm without elbow
    is one part, the forearm.
    """
    bodies, parent = model.jnt_bodyid[1:], model.body_parentid
    found = {"trunk": [anatomy.trunk]}
    for side, foot in zip(("left", "right"), anatomy.feet, strict=True):
        knee = int(bodies[anatomy.roles[f"{side}_knee"]])
        thigh = int(parent[knee])
        leg = bodies[list(anatomy.limbs[f"{side}_leg"])].tolist()
        found[f"{side}_hip"] = [body for body in reversed(leg) if body < thigh]
        found |= {f"{side}_thigh": [thigh], f"{side}_shank": [knee], f"{side}_foot": [foot]}
        if arm := anatomy.limbs.get(f"{side}_arm"):
            elbow = int(bodies[anatomy.roles.get(f"{side}_elbow", arm[0])])
            if elbow != bodies[arm[0]]:
                found[f"{side}_upper_arm"] = [int(parent[elbow])]
            found[f"{side}_forearm"] = [int(b) for b in bodies[list(arm)] if b >= elbow]
    return found


def part(name: str) -> Part:
    """A part by its name: "left_shank" belongs to the left leg."""
    side, _, kind = name.partition("_")
    limb = f"{side} {'arm' if kind.endswith('arm') else 'leg'}" if kind else name
    return Part(geom_name(name), limb, kind == "foot")


def geom_name(name: str) -> str:
    """Name of a part's capsule."""
    return f"{name}_bumper"


def fit_all(clouds: dict[str, np.ndarray]) -> dict[str, Capsule]:
    """A capsule per part, left and right ones mirror images of each other.

    Where `THICKER` allows it, the thighs' capsules stand for the hips, which get none.

    Args:
      clouds: points [k, 3] on the surface of each part, world at home [m]. Parts without a point
        get no capsule.
    """
    both = {name: _with_twin(clouds, name) for name in clouds if not name.startswith("right")}
    fitted = {name: fit(points) for name, points in both.items() if len(points)}
    if {"left_hip", "left_thigh"} <= set(fitted):
        legs = {
            f"{side}_leg": np.concatenate([clouds[f"{side}_hip"], clouds[f"{side}_thigh"]])
            for side in ("left", "right")
        }
        wide = fit(_with_twin(legs, "left_leg"))
        if wide.radius < THICKER * fitted["left_thigh"].radius:
            fitted["left_thigh"] = wide
            del fitted["left_hip"]
    return {
        name: fitted[name] if name in fitted else _mirrored(fitted[_twin(name)])
        for name in clouds
        if name in fitted or _twin(name) in fitted
    }


def _mirrored(capsule: Capsule) -> Capsule:
    return replace(capsule, start=capsule.start * _MIRROR, end=capsule.end * _MIRROR)


def _twin(name: str) -> str:
    """The part on the other side; the trunk is its own."""
    swap = ("left", "right") if "left" in name else ("right", "left")
    return name.replace(*swap)


def _with_twin(clouds: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Points of a part and mirrored points of its twin."""
    return np.concatenate([clouds[name], clouds[_twin(name)] * _MIRROR])


def fit(points: np.ndarray) -> Capsule:
    """The smallest capsule along the points' principal axis that has most of them inside.

    Args:
      points: [k, 3] m. Dense parts of the cloud count no more than others.
    """
    cell = CELL * np.ptp(points, axis=0).max()
    even = points[np.unique(np.round(points / cell), axis=0, return_index=True)[1]]
    axes = np.linalg.eigh(np.cov(even.T))[1][:, ::-1]  # the principal axis first
    lower, upper = (points @ axes).min(axis=0), (points @ axes).max(axis=0)
    middle, half = (lower + upper) / 2, (upper[0] - lower[0]) / 2
    offset = even @ axes - middle
    along, across = np.abs(offset[:, 0]), np.hypot(offset[:, 1], offset[:, 2])
    best, size = (half, half), np.inf
    for straight in np.linspace(0.01, 1.0, 34) * half:
        beyond = np.maximum(along - straight, 0.0)
        radius = float(np.quantile(np.hypot(beyond, across), INSIDE))
        volume = radius**2 * (2 * straight + 4 / 3 * radius)
        if volume < size:
            best, size = (straight, radius), volume
    centre, reach = axes @ middle, axes[:, 0] * best[0]
    return Capsule(centre - reach, centre + reach, best[1])


def gap(a: Capsule, b: Capsule, count: int = 65) -> float:
    """Distance [m] between the surfaces of two capsules; below 0 if they overlap."""
    share = np.linspace(0, 1, count)[:, None]
    points = a.start + share * (a.end - a.start)
    along = b.end - b.start
    nearest = np.clip((points - b.start) @ along / (along @ along), 0, 1)[:, None]
    distance = np.linalg.norm(points - b.start - nearest * along, axis=1).min()
    return float(distance) - a.radius - b.radius


def strangers(names: list[str]) -> list[tuple[str, str]]:
    """Pairs of parts that may touch: of different limbs, and not joined to the trunk."""
    return [
        (a, b)
        for a, b in itertools.combinations(names, 2)
        if part(a).limb != part(b).limb and not joined(a, b)
    ]


def joined(a: str, b: str) -> bool:
    """True for the trunk and a part that starts at it."""
    first = ("hip", "thigh", "upper_arm")
    return "trunk" in (a, b) and any(name.endswith(first) for name in (a, b))


def slim(capsules: dict[str, Capsule]) -> dict[str, Capsule]:
    """Makes capsules thinner where parts that may touch are closer than the margin at home."""
    lack = dict.fromkeys(capsules, 0.0)
    for a, b in strangers(list(capsules)):
        short = (PAIR_MARGIN - gap(capsules[a], capsules[b])) / 2
        lack[a], lack[b] = max(lack[a], short), max(lack[b], short)
    return {
        name: replace(c, radius=max(c.radius - lack[name], THINNEST * c.radius))
        for name, c in capsules.items()
    }
