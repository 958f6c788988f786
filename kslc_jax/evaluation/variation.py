"""Differences of one robot from its description that training does not have in this form.

These are heavier hands, soles whose contact area changes all the time, and friction and damping of
each joint. All of them change fields of the mjModel, see `physics.step`.
"""

import functools
from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from kslc_jax import maths, randomize, similar
from kslc_jax.config import ConfigError, RandomizeConfig
from kslc_jax.evaluation import perturbations
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.robot import Robot

LEVEL = 0.999
"""Least cosine between a foot box's z axis at home and the vertical, for `sole`."""

TILT = 0.003
"""Largest tilt of a varied sole about each horizontal axis [rad]. Two to four of its corners then
carry the load."""

Fields = dict[str, jax.Array]


@flax.struct.dataclass
class Body:
    """Differences of one robot's joints from the description."""

    friction: jax.Array  # [n] N m, added Coulomb friction
    damping: jax.Array  # [n] N m s/rad, added damping


def for_robot(conditions: Sequence[str], robot: Robot) -> tuple[str, ...]:
    """The conditions that the robot can have, see `require`, with values that fit its size.

    `sole` counts for a robot at high fidelity only.
    """
    factors = similar.factors(robot)
    return tuple(
        perturbations.scaled(condition, factors)
        for condition in conditions
        if _possible(perturbations.changes(condition), robot)
    )


def _possible(changes: dict[str, Any], robot: Robot) -> bool:
    """True if the robot can have the `perturbations.changes` of a condition."""
    made = perturbations.settings(changes, RandomizeConfig())
    armless = randomize.lacks_arms(made["randomize"], robot)
    return not armless and not _lacking(made.get("variation", Variation()), robot)


def require(variation: Variation, robot: Robot) -> None:
    """ConfigError if the robot lacks a part that the changes need.

    `hands` needs arms; `sole` needs feet of one box each, with its z axis upwards.
    """
    if lacking := _lacking(variation, robot):
        raise ConfigError(f"{lacking}; leave it out")


def _lacking(variation: Variation, robot: Robot) -> str:
    """The reason why the robot cannot have the changes; empty if it can."""
    if variation.sole and len(_foot_boxes(robot)) < 2:
        return f"sole: a foot of {robot.name} is not one box with its z axis upwards"
    if variation.hands and not len(robot.hand_body_ids):
        return f"hands: {robot.name} has no arms"
    return ""


@functools.lru_cache(maxsize=8)
def _foot_boxes(robot: Robot) -> tuple[int, ...]:
    """Geoms of the left and the right foot, without those that `sole` cannot change."""
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_kinematics(model, data)
    alone = (int(foot[0]) for foot in robot.foot_shapes if len(foot) == 1)
    is_box = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    return tuple(foot for foot in alone if is_box[foot] and data.geom_xmat[foot, 8] > LEVEL)


def sample(variation: Variation, robot: Robot, key: jax.Array) -> Body:
    """Draws the differences of one robot."""
    key_friction, key_damping = jax.random.split(key)
    return Body(
        friction=variation.joints * jax.random.uniform(key_friction, (robot.count,)),
        damping=variation.joints * jax.random.uniform(key_damping, (robot.count,)),
    )


def alter(variation: Variation, robot: Robot, body: Body, key: jax.Array, fields: Fields) -> Fields:
    """Applies the variation to the mjModel fields of `randomize.model_fields`.

    Args:
      variation: sizes of the differences (static under jit), see `require`; 0 changes nothing.
      robot: the described robot; `sole` needs it at high fidelity.
      body: the differences of its joints.
      key: random key of this control step.
      fields: mjModel fields by name.
    """
    model = robot.mj_model
    if variation.hands:
        fields = fields | _heavier_hands(variation.hands, robot, fields)
    if variation.joints:
        fields = fields | {
            "dof_frictionloss": jnp.asarray(model.dof_frictionloss).at[6:].add(body.friction),
            "dof_damping": jnp.asarray(model.dof_damping).at[6:].add(body.damping),
        }
    if variation.sole:
        fields = fields | _soles(variation.sole, robot, key, fields)
    return fields


def _heavier_hands(kg: float, robot: Robot, fields: Fields) -> Fields:
    hands = robot.hand_body_ids
    mass = fields["body_mass"].at[hands].add(kg)
    placed = {
        name: fields.get(name, jnp.asarray(getattr(robot.mj_model, name)))
        .at[hands]
        .set(value[hands])
        for name, value in _with_hands(robot, kg).items()
    }
    subtree = jnp.sum(robot.subtree * mass, axis=1)
    return placed | {"body_mass": mass, "body_subtreemass": subtree}


@functools.lru_cache(maxsize=32)
def _with_hands(robot: Robot, kg: float) -> dict[str, np.ndarray]:
    """Centre, inertia and principal axes of all bodies, with a point mass of `kg` at each hand."""
    model = robot.mj_model
    names = ("body_ipos", "body_inertia", "body_iquat")
    out = {name: getattr(model, name).copy() for name in names}
    for i, hand in zip(robot.hand_body_ids, robot.hand_points, strict=True):
        mass, centre = model.body_mass[i], out["body_ipos"][i]
        arm = hand - centre
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[i])
        axes = axes.reshape(3, 3)
        # Parallel axes: about their common centre two masses have the inertia (reduced mass) d^2.
        reduced = mass * kg / (mass + kg)
        spread = reduced * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        inertia, axes = np.linalg.eigh(axes @ np.diag(out["body_inertia"][i]) @ axes.T + spread)
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])  # a rotation, not a reflection
        out["body_ipos"][i] = centre + arm * kg / (mass + kg)
        out["body_inertia"][i] = inertia
        mujoco.mju_mat2Quat(out["body_iquat"][i], axes.flatten())
    return out


def _soles(inset: float, robot: Robot, key: jax.Array, fields: Fields) -> Fields:
    """Random foot boxes that lie inside the described ones and are tilted by up to `TILT`."""
    model = robot.mj_model
    feet = np.array(_foot_boxes(robot))
    described = jnp.asarray(model.geom_quat[feet])
    key_sides, key_tilt = jax.random.split(key)
    sides = inset * jax.random.uniform(key_sides, (2, 2, 2))  # foot, axis, front or back
    tilt = jax.random.uniform(key_tilt, (2, 2), minval=-TILT, maxval=TILT)
    shift, shrink = 0.5 * (sides[..., 1] - sides[..., 0]), 0.5 * sides.sum(-1)
    shift = jnp.concatenate([shift, jnp.zeros((2, 1))], axis=1)  # frame of the box
    turn = jnp.concatenate([jnp.ones((2, 1)), 0.5 * tilt, jnp.zeros((2, 1))], axis=1)
    return {
        "geom_size": jnp.asarray(model.geom_size).at[feet, :2].add(-shrink),
        "geom_pos": fields["geom_pos"].at[feet].add(jax.vmap(maths.quat_rotate)(described, shift)),
        "geom_quat": jnp.asarray(model.geom_quat)
        .at[feet]
        .set(jax.vmap(maths.quat_multiply)(described, turn)),
        "geom_sameframe": jnp.asarray(model.geom_sameframe).at[feet].set(0),  # use geom_quat
    }
