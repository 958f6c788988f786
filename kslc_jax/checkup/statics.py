"""Numbers of a robot without a simulation: standing torques, contacts, the reference motion."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from kslc_jax import commands, gait
from kslc_jax.config import Config
from kslc_jax.robot import Robot
from kslc_jax.robots.build import SIDES, TOUCH_BORDER
from kslc_jax.robots.contacts import PAIR_MARGIN

POSES = 400
"""Number of random poses in which contacts are counted."""

SPREAD = 1.0
"""Largest angle [rad] from home of a random pose."""

PHASES = 40
"""Number of gait phases at which the reference motion is looked at."""


def posed(robot: Robot, qpos: np.ndarray) -> mujoco.MjData:
    """The robot at rest in this pose: kinematics, contacts, forces."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_forward(robot.mj_model, data)
    return data


def on_the_ground(robot: Robot) -> np.ndarray:
    """qpos [7 + n] of the home pose with the lower sole on the ground."""
    qpos = robot.default_qpos.copy()
    qpos[2] -= min(sole_centre(robot, posed(robot, qpos), side)[2] for side in SIDES)
    return qpos


def sole_centre(robot: Robot, data: mujoco.MjData, side: str) -> np.ndarray:
    """[3] m, world."""
    return data.site(f"{side}_foot").xpos


def sole_size(robot: Robot, side: str) -> np.ndarray:
    """[2] m, half the length and half the width."""
    return robot.mj_model.site(f"{side}_foot").size[:2] - TOUCH_BORDER


def standing_torque(robot: Robot) -> np.ndarray:
    """Torques [n, N m] that hold the home pose while each foot carries half of the weight.

    The ground pushes straight up, at the point of each sole that is nearest to the centre of mass
    in the forward direction.
    """
    model, data = robot.mj_model, posed(robot, robot.default_qpos)
    torque = data.qfrc_bias - data.qfrc_passive
    for side in SIDES:
        site = model.site(f"{side}_foot")
        centre, forward = data.site_xpos[site.id], data.site_xmat[site.id].reshape(3, 3)[:, 0]
        reach = sole_size(robot, side)[0]
        point = centre + forward * np.clip(data.sensor("com").data[0] - centre[0], -reach, reach)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, int(site.bodyid[0]))
        torque -= jacobian[2] * robot.total_mass * 9.81 / 2
    return torque[6:]


def ankle_share(robot: Robot) -> float:
    """Stiffness of both ankles together [N m/rad] by m g h, the robot's weight times the height of
    its centre of mass. With a share of 1 a rigid robot stands on them without control."""
    data = posed(robot, on_the_ground(robot))
    ankles = [robot.anatomy.roles[f"{side}_ankle"] for side in SIDES]
    return float(robot.kp[ankles].sum() / (robot.total_mass * 9.81 * data.sensor("com").data[2]))


def off_balance(robot: Robot) -> float:
    """Distance [m] of the centre of mass in front of the toes (> 0) or behind the heels (< 0) at
    home; 0 above the soles."""
    data = posed(robot, robot.default_qpos)
    reach = [sole_size(robot, side)[0] for side in SIDES]
    centre = [sole_centre(robot, data, side)[0] for side in SIDES]
    x = data.sensor("com").data[0]
    toe, heel = np.max(np.add(centre, reach)), np.min(np.subtract(centre, reach))
    return float(max(x - toe, 0.0) + min(x - heel, 0.0))


# ----------------------------------------------------------------------------------------- contacts


def link_names(robot: Robot, contact: mujoco.MjContact) -> tuple[str, str]:
    """Names of the two bodies in contact."""
    first, second = (robot.mj_model.geom_bodyid[geom] for geom in contact.geom)
    return robot.mj_model.body(first).name, robot.mj_model.body(second).name


def limb_of_bodies(robot: Robot) -> list[str]:
    """Limb of each body: "left_leg", ..., or "trunk"."""
    bodies, limbs = robot.joint_body_ids, ["trunk"] * robot.mj_model.nbody
    for limb, joints in robot.anatomy.limbs.items():
        for joint in joints:
            limbs[bodies[joint]] = limb
    return limbs


def touching_limbs(robot: Robot, qpos: np.ndarray, depth: float) -> set[frozenset[str]]:
    """Pairs of limbs with shapes that are nearer to each other than `depth` [m]."""
    model, limbs = robot.mj_model, limb_of_bodies(robot)
    found = set()
    for contact in posed(robot, qpos).contact:
        a, b = (model.geom_bodyid[geom] for geom in contact.geom)
        if contact.dist < depth and a and b and limbs[a] != limbs[b]:
            found.add(frozenset((limbs[a], limbs[b])))
    return {pair for pair in found if "trunk" not in pair}


def unfelt(train: Robot, high: Robot) -> tuple[int, int]:
    """Counts contacts of two limbs in random poses.

    Returns:
      (contacts at high fidelity that training does not feel, all contacts at high fidelity).
    """
    random = np.random.default_rng(0)
    home = train.default_qpos
    low = np.maximum(train.joint_lower, home[7:] - SPREAD)
    upper = np.minimum(train.joint_upper, home[7:] + SPREAD)
    missed = there = 0
    for _ in range(POSES):
        qpos = np.concatenate([home[:2], [5.0], home[3:7], random.uniform(low, upper)])
        touching = touching_limbs(high, qpos, 0.0)
        there += len(touching)
        missed += len(touching - touching_limbs(train, qpos, PAIR_MARGIN))
    return missed, there


# --------------------------------------------------------------------------------- reference motion


def reference(config: Config, robot: Robot, speed: float, phases: np.ndarray) -> np.ndarray:
    """Reference angles [..., n, rad] from home at a commanded speed [m/s] and phases [...] in
    [0, 1)."""
    pose = functools.partial(_pose, config, robot, speed)
    return np.asarray(jnp.vectorize(pose, signature="()->(n)")(jnp.asarray(phases)))


def _walking(speed: float | jax.Array) -> commands.Command:
    """The command to walk ahead with `speed` [m/s]."""
    ahead, moving = jnp.array([speed, 0.0, 0.0]), jnp.ones((), bool)
    return commands.standing(jnp.zeros(())).replace(velocity=ahead, moving=moving)


def _pose(config: Config, robot: Robot, speed: float | jax.Array, phase: jax.Array) -> jax.Array:
    """Reference angles [n, rad] from home at a commanded speed [m/s] and a phase [] in [0, 1)."""
    command = _walking(speed)
    start = gait.init(config.gait, jax.random.key(0), command, jnp.zeros(2))
    clock, stance = gait.clock_of(config.gait, phase, command)
    now = start.replace(clock=clock, stance=stance)
    return gait.reference_pose(config.gait, robot, now, command)


def out_of_range(config: Config, robot: Robot) -> np.ndarray:
    """[n] rad by which the reference motion would leave the range of each joint, at the slowest and
    at the fastest reference."""
    endless = np.full(robot.count, np.inf)
    free = dataclasses.replace(robot, joint_lower=-endless, joint_upper=endless)
    phases = np.arange(PHASES) / PHASES
    beyond = [
        np.abs(reference(config, free, speed, phases) - reference(config, robot, speed, phases))
        for speed in (0.0, config.gait.full_speed)
    ]
    return np.max(beyond, axis=(0, 1))


def reference_speed(config: Config, robot: Robot) -> np.ndarray:
    """[n] largest speed [rad/s] that the reference motion asks of each joint, under commands from
    rest to the last v_max.

    HG's swing jumps where double support ends; these jumps do not count.
    """
    limits = config.curriculum
    phases = jnp.arange(PHASES) / PHASES
    speeds = np.arange(limits.v_start, limits.v_limit + limits.v_step / 2, limits.v_step)

    def fastest(speed: jax.Array) -> jax.Array:
        pose = functools.partial(_pose, config, robot, speed)
        cycle = gait.cycle_time(config, _walking(speed), limits.cycle_min, limits.v_limit)
        return jnp.abs(jax.vmap(jax.jacfwd(pose))(phases)).max(axis=0) / cycle

    return np.asarray(jax.jit(jax.vmap(fastest))(jnp.asarray(speeds)).max(axis=0))


def foot_lift(config: Config, robot: Robot) -> float:
    """Height [m] of the swing foot above the stance foot in the middle of the reference's swing, at
    commanded speed 0; the smaller one of left and right."""
    lifts = []
    swings = reference(config, robot, 0.0, np.array([0.75, 0.25]))
    for side, swing in zip(SIDES, swings, strict=True):
        qpos = robot.default_qpos.copy()
        qpos[7:] += swing
        data = posed(robot, qpos)
        left, right = (data.sensor(f"{name}_foot_pos").data[2] for name in SIDES)
        lifts.append(left - right if side == "left" else right - left)
    return float(min(lifts))
