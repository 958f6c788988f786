"""Equality constraints and tendons that bind parts which move: closed loops."""

import mujoco
import numpy as np

_JOINT, _BODY, _SITE, _GEOM = (
    int(getattr(mujoco.mjtObj, f"mjOBJ_{kind}")) for kind in ("JOINT", "BODY", "SITE", "GEOM")
)
_WRAPPED = {
    int(mujoco.mjtWrap.mjWRAP_JOINT): _JOINT,
    int(mujoco.mjtWrap.mjWRAP_SITE): _SITE,
    int(mujoco.mjtWrap.mjWRAP_SPHERE): _GEOM,
    int(mujoco.mjtWrap.mjWRAP_CYLINDER): _GEOM,
}
"""Kind of the object that a tendon passes, per type of wrap; a pulley is no object."""

_EQUAL_JOINTS, _EQUAL_TENDONS = (
    int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("JOINT", "TENDON")
)

Parts = list[tuple[int, int]]
"""(kind, id) of objects of a model."""


def found(model: mujoco.MjModel, welded: frozenset[int]) -> str:
    """What binds parts that move against each other: equality constraints, tendons, or nothing.

    Args:
      model: the compiled MJCF.
      welded: ids of joints that will be removed. What couples only these may stay.
    """
    rigid = _rigid(model, welded)
    if any(_binds(model, _of_equality(model, i), rigid, welded) for i in range(model.neq)):
        return "equality constraints"
    if any(_binds(model, _of_tendon(model, i), rigid, welded) for i in range(model.ntendon)):
        return "tendons"
    return ""


def _rigid(model: mujoco.MjModel, welded: frozenset[int]) -> np.ndarray:
    """[nbody] the first body of those that do not move against each other, for each body."""
    rigid = np.arange(model.nbody)
    for body in range(1, model.nbody):
        first = int(model.body_jntadr[body])
        if welded.issuperset(range(first, first + int(model.body_jntnum[body]))):
            rigid[body] = rigid[model.body_parentid[body]]
    return rigid


def _of_tendon(model: mujoco.MjModel, tendon: int) -> Parts:
    """The joints, sites and geoms of a tendon."""
    first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
    own = slice(first, first + count)
    wraps = zip(model.wrap_type[own].tolist(), model.wrap_objid[own].tolist(), strict=True)
    return [(_WRAPPED[kind], part) for kind, part in wraps if kind in _WRAPPED]


def _of_equality(model: mujoco.MjModel, equality: int) -> Parts:
    """The joints, bodies and sites of an equality constraint; flexes have their own kind."""
    kind = int(model.eq_type[equality])
    ids = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if kind == _EQUAL_TENDONS:
        return [part for tendon in ids if tendon >= 0 for part in _of_tendon(model, tendon)]
    of = _JOINT if kind == _EQUAL_JOINTS else int(model.eq_objtype[equality])
    return [(of, part) for part in ids if part >= 0]


def _binds(model: mujoco.MjModel, parts: Parts, rigid: np.ndarray, welded: frozenset[int]) -> bool:
    """True if some of these parts can move against each other."""
    joints = {part for kind, part in parts if kind == _JOINT}
    bodies = {_BODY: np.arange(model.nbody), _SITE: model.site_bodyid, _GEOM: model.geom_bodyid}
    others = [(kind, part) for kind, part in parts if kind != _JOINT]
    if not joints <= welded or any(kind not in bodies for kind, _ in others):
        return True
    return len({int(rigid[bodies[kind][part]]) for kind, part in others}) > 1
