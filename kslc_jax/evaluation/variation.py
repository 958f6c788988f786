"""Robots that differ from the described one in more than training's ranges say: every link's mass,
heavier hands, wandering sole contact, friction and damping of each joint.

They change fields of the mjModel, see `physics.step`. One robot each.
"""

import functools
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from kslc_jax.config import NUM_JOINTS, ConfigError
from kslc_jax.robot import Robot

FEET = ("left_foot", "right_foot")
"""Boxes with which the feet meet the floor at high fidelity."""

TILT = 0.003
"""Largest tilt of a wandering sole about each horizontal axis [rad]: 2 to 4 of its corners bear."""

MOST_SHARE, MOST_INSET = 0.9, 0.04
"""Largest `links` and `sole`: links keep some mass, soles keep some area."""

Fields = dict[str, jax.Array]


@dataclass(frozen=True)
class Variation:
    """By how much robots differ; 0 is the described robot."""

    links: float = 0.0
    """Largest change of each link's mass and inertia, as a share of it."""
    hands: float = 0.0
    """Mass added at each hand [kg]."""
    sole: float = 0.0
    """Each side of a sole lies up to this far inside the foot's outline [m], anew every control
    step."""
    joints: float = 0.0
    """Largest Coulomb friction [N m] and largest damping [N m s/rad] added to each joint."""

    def __post_init__(self):
        for name in ("hands", "joints"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must not be negative")
        if not 0 <= self.links <= MOST_SHARE:
            raise ConfigError(f"links must lie in [0, {MOST_SHARE}]")
        if not 0 <= self.sole <= MOST_INSET:
            raise ConfigError(f"sole must lie in [0, {MOST_INSET}] m")


NOMINAL = Variation()
"""The described robot."""


@flax.struct.dataclass
class Body:
    """How one robot differs."""

    mass: jax.Array  # [nbody] factor on each body's mass and inertia
    friction: jax.Array  # [16] N m
    damping: jax.Array  # [16] N m s/rad


def sample(variation: Variation, robot: Robot, key: jax.Array) -> Body:
    """Draws one robot."""
    keys = jax.random.split(key, 3)
    most = variation.links
    share = jax.random.uniform(keys[0], (robot.mj_model.nbody,), minval=-most, maxval=most)
    return Body(
        mass=1.0 + share,
        friction=variation.joints * jax.random.uniform(keys[1], (NUM_JOINTS,)),
        damping=variation.joints * jax.random.uniform(keys[2], (NUM_JOINTS,)),
    )


def alter(variation: Variation, robot: Robot, body: Body, key: jax.Array, fields: Fields) -> Fields:
    """The mjModel `fields` of `randomize.model_fields` for this robot.

    Args:
      variation: static; only what it asks for is changed.
      robot: at high fidelity, if soles wander.
      body: how the robot differs.
      key: of this control step.
      fields: mjModel fields by name.
    """
    model = robot.mj_model
    if variation.links or variation.hands:
        fields = fields | _masses(variation, robot, body, fields)
    if variation.joints:
        fields = fields | {
            "dof_frictionloss": jnp.asarray(model.dof_frictionloss).at[6:].add(body.friction),
            "dof_damping": jnp.asarray(model.dof_damping).at[6:].add(body.damping),
        }
    if variation.sole:
        fields = fields | _soles(variation.sole, robot, key)
    return fields


def total_mass(variation: Variation, robot: Robot, body: Body, base_mass: jax.Array) -> jax.Array:
    """Mass [kg] of the robot with `base_mass` [kg] added to its base."""
    mass = jnp.asarray(_with_hands(robot, variation.hands)["body_mass"])
    return jnp.sum(body.mass * mass.at[robot.base_body_id].add(base_mass))


def _masses(variation: Variation, robot: Robot, body: Body, fields: Fields) -> Fields:
    heavier = _with_hands(robot, variation.hands)
    hands = np.array(_hand_bodies(robot))
    new = {
        name: fields.get(name, jnp.asarray(getattr(robot.mj_model, name)))
        .at[hands]
        .set(value[hands])
        for name, value in heavier.items()
    }
    new["body_mass"] = new["body_mass"] * body.mass
    new["body_inertia"] = new["body_inertia"] * body.mass[:, None]
    return new | {"body_subtreemass": jnp.asarray(_subtrees(robot)) @ new["body_mass"]}


def _hand_bodies(robot: Robot) -> list[int]:
    return [robot.mj_model.geom(f"{side}_hand").bodyid[0] for side in ("left", "right")]


@functools.lru_cache(maxsize=32)
def _subtrees(robot: Robot) -> np.ndarray:
    """[nbody, nbody] 1 where the second body is the first one or hangs on it."""
    parent = robot.mj_model.body_parentid
    below = np.eye(len(parent))
    for i in reversed(range(1, len(parent))):
        below[parent[i]] += below[i]
    return below


@functools.lru_cache(maxsize=32)
def _with_hands(robot: Robot, kg: float) -> dict[str, np.ndarray]:
    """Mass, centre, inertia and principal axes of all bodies, with point masses at the hands."""
    model = robot.mj_model
    names = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    out = {name: getattr(model, name).copy() for name in names}
    if kg == 0:
        return out
    for i, side in zip(_hand_bodies(robot), ("left", "right"), strict=True):
        mass, centre = out["body_mass"][i], out["body_ipos"][i]
        arm = model.geom(f"{side}_hand").pos - centre
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, model.body_iquat[i])
        axes = axes.reshape(3, 3)
        # Parallel axes: two masses about their common centre have the reduced mass times d^2.
        reduced = mass * kg / (mass + kg)
        spread = reduced * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        inertia, axes = np.linalg.eigh(axes @ np.diag(out["body_inertia"][i]) @ axes.T + spread)
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])  # a rotation, not a reflection
        out["body_mass"][i] = mass + kg
        out["body_ipos"][i] = centre + arm * kg / (mass + kg)
        out["body_inertia"][i] = inertia
        mujoco.mju_mat2Quat(out["body_iquat"][i], axes.flatten())
    return out


def _soles(inset: float, robot: Robot, key: jax.Array) -> Fields:
    """Foot boxes inside the described ones, tilted by up to `TILT`."""
    model = robot.mj_model
    feet = np.array([model.geom(name).id for name in FEET])
    key_sides, key_tilt = jax.random.split(key)
    sides = inset * jax.random.uniform(key_sides, (2, 2, 2))  # foot, axis, front or back
    tilt = jax.random.uniform(key_tilt, (2, 2), minval=-TILT, maxval=TILT)
    shift, shrink = 0.5 * (sides[..., 1] - sides[..., 0]), 0.5 * sides.sum(-1)
    quat = jnp.concatenate([jnp.ones((2, 1)), 0.5 * tilt, jnp.zeros((2, 1))], axis=1)
    return {
        "geom_size": jnp.asarray(model.geom_size).at[feet, :2].add(-shrink),
        "geom_pos": jnp.asarray(model.geom_pos).at[feet, :2].add(shift),
        "geom_quat": jnp.asarray(model.geom_quat).at[feet].set(quat),
        "geom_sameframe": jnp.asarray(model.geom_sameframe).at[feet].set(0),  # use geom_quat
    }
