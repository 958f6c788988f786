"""Limbs, roles of joints and the left-right mirror map, from the kinematics at the home pose.

Names of joints and bodies play no part. The base frame has x forward, y left and z up.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from kslc_jax.robots import loops
from kslc_jax.robots.description import RobotError

ANCHOR_TOLERANCE = 0.005
"""Largest distance [m] between a joint's anchor and the mirror image of its partner's."""

AXIS_TOLERANCE = 0.02
"""Largest 1 - |cos| between a joint's axis and the mirror image of its partner's."""

TIE = 0.01
"""An axis counts as near to two directions if its components differ by less than this."""

_AXIAL = np.array([-1.0, 1.0, -1.0])
"""Left-right mirror image of a rotation axis, as factors."""

_LEG = ("hip", "knee", "ankle")
_ARM = ("shoulder", "elbow")
_X, _Y, _Z = range(3)


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Parts of the robot. Joints are indices of the n hinges in MJCF order, the action order."""

    permutation: np.ndarray  # [n] int: q[permutation] * sign is the mirrored joint vector
    sign: np.ndarray  # [n] float32, +1 or -1
    pitch: np.ndarray  # [n] sign of axis_y (base frame, home) of joints that pitch, else 0
    roles: dict[str, int]  # joint of "left_hip", "left_hip_roll", "right_elbow", ...
    limbs: dict[str, tuple[int, ...]]  # joints of "left_leg", "right_arm", ... from the base
    feet: tuple[int, int]  # body ids, left and right: the last body with a joint of each leg
    trunk: int  # body id: the heaviest body in no limb
    is_arm: np.ndarray  # [n] bool
    base: int  # body id of the free joint


def study(model: mujoco.MjModel, qpos: np.ndarray) -> Anatomy:
    """Finds the parts of a compiled model.

    Args:
      model: a free joint, then n hinges.
      qpos: [7 + n] home pose.

    Raises:
      RobotError: the model is no biped of this kind; the message names the part and the fix.
    """
    check(model)
    anchors, axes = _hinges(model, qpos)
    permutation, sign = _mirror(model, anchors, axes)
    legs, arms = _legs_and_arms(_chains(model), permutation, anchors)
    limbs = {f"{side}_leg": leg for side, leg in zip(("left", "right"), legs, strict=True)}
    limbs |= {f"{side}_arm": arm for side, arm in zip(("left", "right"), arms, strict=False)}
    _require_in_limbs(model, limbs, permutation)
    bodies = model.jnt_bodyid[1:]
    return Anatomy(
        permutation=permutation,
        sign=sign,
        pitch=np.where(_near(axes, _Y), np.sign(axes[:, _Y]), 0.0),
        roles=_roles(model, limbs, axes),
        limbs=limbs,
        feet=(int(bodies[legs[0][-1]]), int(bodies[legs[1][-1]])),
        trunk=_trunk(model, limbs),
        is_arm=np.isin(np.arange(len(axes)), [joint for arm in arms for joint in arm]),
        base=int(model.jnt_bodyid[0]),
    )


def check(model: mujoco.MjModel, welded: frozenset[int] = frozenset()) -> None:
    """Refuses models that are no tree of hinges on a free base.

    Args:
      welded: ids of joints that will be removed, so that they may be of any kind.
    """
    free, hinge = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
    if model.njnt == 0 or model.jnt_type[0] != free:
        raise RobotError("the first joint is no free joint: put <freejoint/> into the base body")
    if bound := loops.found(model, welded):
        raise RobotError(
            f"{bound} (closed loops) are not supported: remove them from the MJCF, or weld all "
            "joints that they couple"
        )
    base = model.jnt_bodyid[0]
    for i in (i for i in range(1, model.njnt) if i not in welded):
        name = model.joint(i).name
        if model.body_rootid[model.jnt_bodyid[i]] != base:
            raise RobotError(f"joint {name!r} is not on the robot: remove it from the MJCF")
        if model.jnt_type[i] != hinge:
            raise RobotError(f"joint {name!r} is no hinge: weld it, or remove it from the MJCF")
        if not model.jnt_limited[i]:
            raise RobotError(f"joint {name!r} has no range: add range to it in the MJCF")


def _hinges(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Anchors [n, 3, m] and axes [n, 3] of the hinges at `qpos`, in the base frame."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    base = model.jnt_bodyid[0]
    rotation = data.xmat[base].reshape(3, 3)
    return (data.xanchor[1:] - data.xpos[base]) @ rotation, data.xaxis[1:] @ rotation


def _near(axes: np.ndarray, direction: int) -> np.ndarray:
    """[n] bool: the axis is nearer to this direction than to the two others.

    A pitch axis is clearly nearer. An axis halfway between roll and yaw counts as both.
    """
    sizes = np.abs(axes)
    slack = 0.0 if direction == _Y else TIE
    return sizes[:, direction] >= sizes.max(axis=1) - slack


def _mirror(
    model: mujoco.MjModel, anchors: np.ndarray, axes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Partner [n] and sign [n] of each joint."""
    gaps = np.linalg.norm(anchors[:, None] * [1, -1, 1] - anchors[None], axis=2)
    cosines = (axes * _AXIAL) @ axes.T
    score = np.where(gaps < ANCHOR_TOLERANCE, np.abs(cosines), 0.0)
    partner = score.argmax(axis=1)
    rows = np.arange(len(partner))
    lost = (score[rows, partner] < 1.0 - AXIS_TOLERANCE) | (partner[partner] != rows)
    if lost.any():
        name = model.joint(1 + int(np.flatnonzero(lost)[0])).name
        raise RobotError(
            f"joint {name!r} has no left-right partner: at home no joint has the mirrored anchor "
            f"(within {1000 * ANCHOR_TOLERANCE:g} mm) and axis; make [home] symmetric, or weld it"
        )
    return partner, np.sign(cosines[rows, partner]).astype(np.float32)


def _chains(model: mujoco.MjModel) -> list[tuple[int, ...]]:
    """Per tip of the tree, the joints that lead to this tip only, from the base to the tip."""
    base = model.jnt_bodyid[0]
    tips = np.zeros(model.nbody, int)  # tips in the subtree of each body
    ends = []
    for body in reversed(range(base + 1, model.nbody)):
        if tips[body] == 0 and model.body_jntnum[body]:
            tips[body] = 1
            ends.append(body)
        tips[model.body_parentid[body]] += tips[body]
    chains = []
    for body in ends:
        chain: list[int] = []
        while body != base and tips[body] == 1:
            first = model.body_jntadr[body]
            chain = [*range(first - 1, first - 1 + model.body_jntnum[body]), *chain]
            body = model.body_parentid[body]
        chains.append(tuple(chain))
    return chains


def _legs_and_arms(
    chains: list[tuple[int, ...]], partner: np.ndarray, anchors: np.ndarray
) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """(left, right) legs and (left, right) arms; no arms: an empty list."""
    pairs = []
    for left in (c for c in chains if c and anchors[c[-1], _Y] > 0):
        right = tuple(int(partner[joint]) for joint in left)
        if right in chains and right != left:
            pairs.append([left, right])
    if not pairs:
        raise RobotError("found no pair of legs: two limbs must be mirror images of each other")
    legs = min(pairs, key=lambda pair: anchors[pair[0][-1], _Z])
    others = [pair for pair in pairs if pair is not legs]
    return legs, max(others, key=lambda pair: len(pair[0]), default=[])


def _require_in_limbs(
    model: mujoco.MjModel, limbs: dict[str, tuple[int, ...]], partner: np.ndarray
) -> None:
    """Refuses joints with a partner on the other side that are in no limb."""
    inside = {joint for joints in limbs.values() for joint in joints}
    left_out = [j for j, other in enumerate(partner) if j != other and j not in inside]
    if not left_out:
        return
    first = left_out[0]
    name, other = (model.joint(1 + int(joint)).name for joint in (first, partner[first]))
    branches = [c[0] for c in _chains(model) if c and _is_below(model, c[0], first)]
    if len(branches) > 1:
        names = ", ".join(model.joint(1 + joint).name for joint in sorted(branches))
        raise RobotError(
            f"the limb with joint {name!r} forks, into {names}: weld all of these branches, such "
            "as the fingers of a hand, or all but one"
        )
    raise RobotError(f"joints {name!r} and {other!r} are in no leg and no arm: weld them")


def _is_below(model: mujoco.MjModel, joint: int, above: int) -> bool:
    """True if a joint's body is in the subtree of another joint's body, and is not this body."""
    body, top = model.jnt_bodyid[1 + joint], model.jnt_bodyid[1 + above]
    while body > top:
        body = model.body_parentid[body]
        if body == top:
            return True
    return False


def _roles(
    model: mujoco.MjModel, limbs: dict[str, tuple[int, ...]], axes: np.ndarray
) -> dict[str, int]:
    """Joint of each role. Pitch joints have the roles of `_LEG` or `_ARM`, from the base."""
    roles = {}
    for limb, joints in limbs.items():
        side, kind = limb.split("_")
        pitch = [joint for joint in joints if _near(axes, _Y)[joint]]
        if kind == "arm":
            roles |= {f"{side}_{name}": i for name, i in zip(_ARM, pitch, strict=False)}
            continue
        if len(pitch) != len(_LEG):
            names = ", ".join(model.joint(1 + i).name for i in pitch) or "none"
            raise RobotError(
                f"the {side} leg has {len(pitch)} pitch joints ({names}), not 3 (hip, knee, ankle):"
                " weld the others, or check [home], which turns the axes"
            )
        roles |= {f"{side}_{name}": i for name, i in zip(_LEG, pitch, strict=True)}
        for name, direction in (("hip_roll", _X), ("hip_yaw", _Z)):
            near = [i for i in joints if _near(axes, direction)[i] and i not in roles.values()]
            roles |= {f"{side}_{name}": i for i in near[:1]}
    return roles


def _trunk(model: mujoco.MjModel, limbs: dict[str, tuple[int, ...]]) -> int:
    """Id of the heaviest body that is in no limb."""
    inside = np.zeros(model.nbody, bool)
    inside[model.jnt_bodyid[[1 + joints[0] for joints in limbs.values()]]] = True
    for body in range(1, model.nbody):  # parents come before their children
        inside[body] |= inside[model.body_parentid[body]]
    return int(np.where(inside, 0.0, model.body_mass).argmax())
