"""Domain randomisation: what differs from robot to robot, sampled anew at every reset."""

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax.config import NUM_JOINTS, RandomizeConfig, Range
from kslc_jax.robot import Robot


@flax.struct.dataclass
class Dynamics:
    """Physical parameters of one episode."""

    friction: jax.Array  # [] sliding friction of the feet, before averaging with the ground's
    base_mass: jax.Array  # [] kg added to the base link
    base_com: jax.Array  # [3] m, shift of the base link's centre of mass, base frame
    kp: jax.Array  # [16] factor on the position gain
    kd: jax.Array  # [16] factor on the velocity gain
    motor_strength: jax.Array  # [16] factor on the available torque
    joint_friction: jax.Array  # [16] N m
    noise: jax.Array  # [] factor on sensor noise, action noise and action delay


def nominal(friction: float = 1.0) -> Dynamics:
    """The robot as described: no randomisation."""
    return Dynamics(
        friction=jnp.asarray(friction),
        base_mass=jnp.zeros(()),
        base_com=jnp.zeros(3),
        kp=jnp.ones(NUM_JOINTS),
        kd=jnp.ones(NUM_JOINTS),
        motor_strength=jnp.ones(NUM_JOINTS),
        joint_friction=jnp.zeros(NUM_JOINTS),
        noise=jnp.ones(()),
    )


def sample(config: RandomizeConfig, key: jax.Array) -> Dynamics:
    """Draws the parameters of one episode, each uniform in its configured range."""
    keys = jax.random.split(key, 8)

    def uniform(key: jax.Array, bounds: Range, shape: tuple[int, ...] = ()) -> jax.Array:
        return jax.random.uniform(key, shape, minval=bounds[0], maxval=bounds[1])

    return Dynamics(
        friction=uniform(keys[0], config.friction),
        base_mass=uniform(keys[1], config.base_mass),
        base_com=uniform(keys[2], config.base_com, (3,)),
        kp=uniform(keys[3], config.kp, (NUM_JOINTS,)),
        kd=uniform(keys[4], config.kd, (NUM_JOINTS,)),
        motor_strength=uniform(keys[5], config.motor_strength, (NUM_JOINTS,)),
        joint_friction=uniform(keys[6], config.joint_friction, (NUM_JOINTS,)),
        noise=uniform(keys[7], config.noise),
    )


def model_fields(robot: Robot, dynamics: Dynamics, ground_friction: float) -> dict[str, jax.Array]:
    """The mjModel fields that `dynamics` changes, by name; both engines take them as they are.

    Friction is the mean of foot and ground, PhysX's rule (MuJoCo would take the larger); the base's
    inertia scales with its mass. Derived constants other than the subtree masses keep their nominal
    values in both engines: they only scale the contact regularisation.
    """
    model, base = robot.mj_model, robot.base_body_id
    contact_friction = 0.5 * (dynamics.friction + ground_friction)
    mass = model.body_mass[base] + dynamics.base_mass
    subtree = jnp.asarray(model.body_subtreemass)
    return {
        "geom_friction": jnp.asarray(model.geom_friction)
        .at[robot.foot_geom_ids, 0]
        .set(contact_friction),
        "body_mass": jnp.asarray(model.body_mass).at[base].set(mass),
        "body_inertia": jnp.asarray(model.body_inertia)
        .at[base]
        .multiply(mass / model.body_mass[base]),
        "body_ipos": jnp.asarray(model.body_ipos).at[base].add(dynamics.base_com),
        "body_subtreemass": subtree.at[: base + 1].add(dynamics.base_mass),
    }
