"""Contacts of the two fidelities: which parts touch, and the solver's settings."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

FLOOR_BIT, PART_BIT = 1, 2
"""Collision bits of shapes that touch the floor, and of shapes that touch other parts."""

_DECOR_GROUP = 1
"""Geom group of shapes that never collide, in an MJCF of ours."""
_BUMPER_GROUP = 5
"""Geom group of capsules that replace parts of other shapes in training; never drawn."""

PAIR_MARGIN = 0.012
"""Distance [m] below which two parts repel each other in training.

A policy uses all of the allowed space, and simulators differ a little. Without this margin policies
trip at high fidelity (docs/fidelity_physics.md)."""

PAIR_CONTACTS = 9
"""Contacts of each condim that MJX solves: those with the smallest distance.

All 9 contacts with friction fit: 8 sole spheres on the floor, and 1 pair of feet."""


@dataclass(frozen=True)
class Part:
    """A part of the robot in the contacts of training: one capsule."""

    geom: str  # name of the capsule
    limb: str
    foot: bool


def high_options(spec: mujoco.MjSpec) -> None:
    """Solver settings of the evaluation model, in place."""
    spec.option.timestep = 0.001
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.iterations = 100
    spec.option.ls_iterations = 50
    spec.option.tolerance = 1e-10


def keep_parts_apart(
    spec: mujoco.MjSpec, parts: Sequence[Part], barred: set[frozenset[str]]
) -> None:
    """Adds contact pairs between parts that can touch at high fidelity, in place.

    One capsule represents each part. Parts of different limbs can touch, and parts of a limb can
    touch the trunk. Neighbours cannot, as at high fidelity. Only the pair of feet has friction,
    because friction between the feet makes the robot trip. All other pairs are frictionless: such a
    contact costs the solver one row instead of four.

    Args:
      spec: the training model; it has the capsules.
      parts: all parts.
      barred: pairs of names of capsules that get no contact.
    """
    for a, b in itertools.combinations(parts, 2):
        if a.limb == b.limb or frozenset((a.geom, b.geom)) in barred:
            continue
        spec.add_pair(
            geomname1=a.geom,
            geomname2=b.geom,
            condim=3 if a.foot and b.foot else 1,
            margin=PAIR_MARGIN,
        )
    spec.add_numeric(name="max_contact_points", data=[PAIR_CONTACTS])


# ------------------------------------------------------------------------- a prepared MJCF of ours


def train_prepared(spec: mujoco.MjSpec) -> None:
    """Turns a prepared MJCF into the training model, in place.

    Its capsules are the parts. A bumper replaces the other shapes of its body.
    """
    capsules = [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    drawn = sorted((g for g in capsules if g.group != _DECOR_GROUP), key=lambda g: g.group)
    shapes = {g.parent.name: g for g in drawn}  # a bumper comes last and replaces the part
    feet = {g.parent.name for g in spec.geoms if g.priority > 0}
    excluded = {frozenset((e.bodyname1, e.bodyname2)) for e in spec.excludes}
    barred = {
        frozenset((a.name, b.name))
        for (body, a), (other, b) in itertools.combinations(shapes.items(), 2)
        if frozenset((body, other)) in excluded or a.parent.name == b.parent.parent.name
    }
    parts = [Part(g.name, _limb(g.parent), body in feet) for body, g in shapes.items()]
    keep_parts_apart(spec, parts, barred)


def raise_prepared(spec: mujoco.MjSpec) -> None:
    """Turns a prepared MJCF into the evaluation model, in place."""
    high_options(spec)
    for stand_in in (g for g in spec.geoms if g.group == _BUMPER_GROUP):
        spec.delete(stand_in)
    sole = next(g for g in spec.geoms if g.priority > 0)
    friction, priority = sole.friction.copy(), sole.priority
    for geom in spec.geoms:
        if geom.priority > 0:  # the foot boxes replace the sole spheres
            geom.contype = 0
        elif geom.parent.name != "world" and geom.group != _DECOR_GROUP:
            geom.contype, geom.conaffinity = FLOOR_BIT | PART_BIT, PART_BIT
        if geom.name in ("left_foot", "right_foot"):
            geom.friction, geom.priority = friction, priority


def _limb(body: mujoco.MjsBody) -> str:
    """Name of the first body of the limb that `body` belongs to; for the trunk, its own name."""
    while body.parent.name != "world" and body.parent.parent.name != "world":
        body = body.parent
    return body.name
