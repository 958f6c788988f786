"""Domain randomisation: physical parameters that differ per robot, sampled at every reset."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import draws
from kslc_jax.config import ConfigError, RandomizeConfig
from kslc_jax.ground import Ground
from kslc_jax.robot import Robot

LIGHTEST = 0.05
"""Smallest share of the trunk's mass that must stay when mass is taken away."""


@flax.struct.dataclass
class Dynamics:
    """Physical parameters of one episode."""

    friction: jax.Array  # [] sliding friction of the feet, not yet averaged with the ground
    base_mass: jax.Array  # [] kg added to the trunk
    base_com: jax.Array  # [3] m, shift of the trunk's centre of mass, trunk frame
    kp: jax.Array  # [n] factor on the position gain
    kd: jax.Array  # [n] factor on the velocity gain
    motor_strength: jax.Array  # [n] factor on the available torque
    joint_friction: jax.Array  # [n] N m
    link_mass: jax.Array  # [L] factor on mass and inertia, order of robot.link_body_ids
    link_com: jax.Array  # [L, 3] m, shift of the centre of mass, link frame, same order
    hand_mass: jax.Array  # [] kg added to the last link of each arm
    sole: jax.Array  # [k] m, shift of each sole sphere, see robot.sole_inward
    noise: jax.Array  # [] factor on sensor noise, action noise and action delay
    ground: Ground | None = None  # uneven ground; None: the flat floor


def nominal(robot: Robot, friction: float = 1.0) -> Dynamics:
    """Parameters of the model file, without randomisation."""
    joints, links = robot.count, len(robot.link_body_ids)
    return Dynamics(
        friction=jnp.asarray(friction),
        base_mass=jnp.zeros(()),
        base_com=jnp.zeros(3),
        kp=jnp.ones(joints),
        kd=jnp.ones(joints),
        motor_strength=jnp.ones(joints),
        joint_friction=jnp.zeros(joints),
        link_mass=jnp.ones(links),
        link_com=jnp.zeros((links, 3)),
        hand_mass=jnp.zeros(()),
        sole=jnp.zeros(len(robot.sole_geom_ids)),
        noise=jnp.ones(()),
    )


def lacks_arms(config: RandomizeConfig, robot: Robot) -> bool:
    """True if arms are to be held, and the robot has none."""
    return config.held_arms > 0.0 and not robot.is_arm.any()


def require(config: RandomizeConfig, robot: Robot) -> None:
    """ConfigError if the trunk could become too light, or if the robot has no arms to be held."""
    if lacks_arms(config, robot):
        raise ConfigError(f"held arms: {robot.name} has no arms; leave them out")
    trunk = float(robot.mj_model.body_mass[robot.trunk_body_id])
    left = trunk * config.link_mass[0] + config.base_mass[0]
    if left < LIGHTEST * trunk:
        raise ConfigError(
            f"randomize.base_mass: {config.base_mass[0]:g} kg leave {left:.1f} of the trunk's "
            f"{trunk:.1f} kg; at least {LIGHTEST:.0%} must stay"
        )


def sample(config: RandomizeConfig, robot: Robot, key: jax.Array) -> Dynamics:
    """Draws the parameters of one episode. Each is uniform in the range of its name in `config`.

    Raises:
      ConfigError: see `require`.
    """
    require(config, robot)
    described = nominal(robot)
    names = [f.name for f in dataclasses.fields(Dynamics) if hasattr(config, f.name)]
    shapes = [getattr(described, name).shape for name in names]
    units = draws.uniforms(key, *shapes)
    ranges = [getattr(config, name) for name in names]
    values = [draws.between(unit, *bounds) for unit, bounds in zip(units, ranges, strict=True)]
    return described.replace(**dict(zip(names, values, strict=True)))


def link_masses(robot: Robot, dynamics: Dynamics) -> jax.Array:
    """Mass [B, kg] of every body of the model; the world's is 0."""
    mass = (
        jnp.asarray(robot.mj_model.body_mass).at[robot.link_body_ids].multiply(dynamics.link_mass)
    )
    mass = mass.at[robot.trunk_body_id].add(dynamics.base_mass)
    return mass.at[robot.hand_body_ids].add(dynamics.hand_mass)


def total_mass(robot: Robot, dynamics: Dynamics) -> jax.Array:
    """Mass [] of the robot with all that it carries [kg]."""
    return jnp.sum(link_masses(robot, dynamics))


def model_fields(robot: Robot, dynamics: Dynamics, ground_friction: float) -> dict[str, jax.Array]:
    """New values of the mjModel fields that `dynamics` changes, by name, for both engines.

    Contact friction is the mean of foot and ground, as in PhysX; MuJoCo's own rule takes the larger
    one. The inertia of a link scales with its mass. The subtree masses are recomputed. All other
    derived constants keep their nominal values in both engines: they only scale the contact
    regularisation.
    """
    model, trunk, links = robot.mj_model, robot.trunk_body_id, robot.link_body_ids
    contact_friction = 0.5 * (dynamics.friction + ground_friction)
    mass = link_masses(robot, dynamics)
    spheres, shift = robot.sole_geom_ids, dynamics.sole[:, None] * robot.sole_inward
    com = jnp.asarray(model.body_ipos).at[links].add(dynamics.link_com)
    scale = mass[1:] / model.body_mass[1:]  # body 0, the world, has no mass
    return {
        "geom_friction": jnp.asarray(model.geom_friction)
        .at[robot.foot_geom_ids, 0]
        .set(contact_friction),
        "geom_pos": jnp.asarray(model.geom_pos).at[spheres].add(shift),
        "body_mass": mass,
        "body_inertia": jnp.asarray(model.body_inertia).at[1:].multiply(scale[:, None]),
        "body_ipos": com.at[trunk].add(dynamics.base_com),
        "body_subtreemass": jnp.sum(robot.subtree * mass, axis=1),
    }
