"""PhysicsState -> Signals: all physical quantities that other modules read, by name.

Training, evaluation, sim-to-sim and export share this file. The same code reads the state of every
engine.
"""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import ground as ground_lib
from kslc_jax import maths
from kslc_jax.ground import Ground
from kslc_jax.physics import PhysicsState
from kslc_jax.robot import Robot

CONTACT_FORCE = 5.0
"""Foot force [N] above which the foot counts as in contact (HG)."""


@flax.struct.dataclass
class Signals:
    """Physical quantities of one environment at one instant. Feet and knees: left, right.

    On uneven ground a height is that above the ground: below the point itself, or for the base the
    mean of the ground below both feet.
    """

    joint_pos: jax.Array  # [n] rad, from the home pose
    joint_vel: jax.Array  # [n] rad/s
    torque: jax.Array  # [n] N m
    base_pos: jax.Array  # [3] m, world; z is the height
    base_euler: jax.Array  # [3] roll, pitch, yaw [rad]
    base_linvel: jax.Array  # [3] m/s, base frame
    base_angvel: jax.Array  # [3] rad/s, base frame
    base_velocity: jax.Array  # [6] linear [m/s] and angular [rad/s], world
    gravity: jax.Array  # [3] unit vector of gravity, base frame
    foot_pos: jax.Array  # [2, 3] m, world, ankle-roll link; z is the height
    foot_vel: jax.Array  # [2, 3] m/s, world
    knee_pos: jax.Array  # [2, 3] m, world; z is the height
    foot_force: jax.Array  # [2] N, sum of the normal forces
    foot_contact: jax.Array  # [2] bool
    angular_momentum: jax.Array  # [3] kg m^2/s about the whole-body CoM, world (paper, Eq. 3)
    torso_contact: jax.Array  # [] bool: the 0.4 m box around the torso touches the ground (HG)
    ground: dict[str, jax.Array] = flax.struct.field(default_factory=dict)
    """Uneven ground, for the critic. "foot_ground" [2, m]: ground below the feet, above that below
    the base. "slope" [2]: rise per metre below the base, ahead and to the left."""


def read(robot: Robot, state: PhysicsState, ground: Ground | None = None) -> Signals:
    """Reads all signals of one environment. Without `ground` the floor is flat."""
    signals = _on_the_flat(robot, state)
    return signals if ground is None else _above(robot, state, ground, signals)


def _on_the_flat(robot: Robot, state: PhysicsState) -> Signals:
    """All signals above a flat floor."""
    quat = state.qpos[3:7]

    def sensor(name: str) -> jax.Array:
        return state.sensordata[robot.sensor(name)]

    def both(name: str) -> jax.Array:
        return jnp.stack([sensor(f"left_{name}"), sensor(f"right_{name}")])

    foot_force = both("foot_touch")[:, 0]
    angvel = state.qvel[3:6]
    return Signals(
        joint_pos=state.qpos[7:] - jnp.asarray(robot.default_qpos[7:], state.qpos.dtype),
        joint_vel=state.qvel[6:],
        torque=state.torque,
        base_pos=state.qpos[:3],
        base_euler=maths.quat_to_euler(quat),
        base_linvel=maths.quat_rotate_inverse(quat, state.qvel[:3]),
        base_angvel=angvel,
        base_velocity=jnp.concatenate([state.qvel[:3], maths.quat_rotate(quat, angvel)]),
        gravity=maths.quat_rotate_inverse(quat, jnp.array([0.0, 0.0, -1.0])),
        foot_pos=both("foot_pos"),
        foot_vel=both("foot_linvel"),
        knee_pos=both("knee_pos"),
        foot_force=foot_force,
        foot_contact=foot_force > CONTACT_FORCE,
        angular_momentum=sensor("angmom"),
        torso_contact=_torso_height(robot, state.qpos[:3], quat) < 0.0,
    )


def _above(robot: Robot, state: PhysicsState, ground: Ground, flat: Signals) -> Signals:
    """The signals with heights above uneven ground, from those above a flat floor."""

    def lowered(points: jax.Array, by: jax.Array) -> jax.Array:
        return points.at[..., 2].add(-by)

    def below(points: jax.Array) -> jax.Array:
        return ground_lib.height(ground, points[..., 0], points[..., 1])

    feet, base = below(flat.foot_pos), below(flat.base_pos)
    yaw = flat.base_euler[2]
    ahead, left = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]), jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
    gradient = ground_lib.slope(ground, *flat.base_pos[:2])
    above_base = lowered(flat.base_pos, base)
    return flat.replace(
        base_pos=lowered(flat.base_pos, jnp.mean(feet)),
        foot_pos=lowered(flat.foot_pos, feet),
        knee_pos=lowered(flat.knee_pos, below(flat.knee_pos)),
        torso_contact=_torso_height(robot, above_base, state.qpos[3:7]) < 0.0,
        ground={
            "foot_ground": feet - base,
            "slope": jnp.stack([gradient @ ahead, gradient @ left]),
        },
    )


def _torso_height(robot: Robot, base_pos: jax.Array, quat: jax.Array) -> jax.Array:
    """Height of the torso box's lowest corner [m], for a base at the height `base_pos[2]`."""
    up = maths.quat_rotate_inverse(quat, jnp.array([0.0, 0.0, 1.0]))
    centre = base_pos[2] + jnp.dot(up, jnp.asarray(robot.torso_box_center))
    return centre - jnp.dot(jnp.abs(up), jnp.asarray(robot.torso_box_half_size))
