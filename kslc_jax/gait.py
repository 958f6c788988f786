"""Gait clock, stance mask, reference pose, air time and swing height of one environment."""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax.commands import Command, speed_share
from kslc_jax.config import Config, GaitConfig
from kslc_jax.robot import Robot
from kslc_jax.signals import Signals

# Reference motion of the left side: each joint's share of an amplitude, as a rotation about the y
# axis of the base. A negative rotation moves a hanging limb forward; a positive one bends the knee.
# LEG is the swing of a leg (HG), _HIP the stride sweep, _ARM the arm swing, _ELBOW the elbow bend.
# The right side moves half a cycle later: signs are opposite there.
LEG = {"hip": 1.0, "knee": -2.0, "ankle": 1.0}
_HIP = {"hip": 1.0}
_ARM = {"shoulder": 1.0}
_ELBOW = {"elbow": -1.0}


@flax.struct.dataclass
class GaitState:
    """State of the gait from step to step. Feet: left, right."""

    phase: jax.Array  # [] share of the gait cycle, in [0, 1)
    contact: jax.Array  # [2] bool, foot contact at the newest step
    lift_z: jax.Array  # [2] m, height of the ankle-roll link at the last contact
    air_time: jax.Array  # [2] s in the air, 0 if grounded (see `update`)
    landed_air_time: jax.Array  # [2] s, air time that ended at this step, else 0
    swing_height: jax.Array  # [2] m above the last contact
    mean_error: jax.Array  # [2] m/s, mean error of vx, vy over about a cycle, base frame
    stance: jax.Array  # [2] bool, True: the clock wants this foot on the ground
    clock: jax.Array  # [2] sin and cos of the phase; (0, 0) while standing still


def init(config: GaitConfig, key: jax.Array, command: Command, foot_z: jax.Array) -> GaitState:
    """Gait state at the start of an episode.

    `foot_z` [2, m] is the present height of the feet. Swing heights are measured from there until
    the first contact.
    """
    phase = jax.random.uniform(key) if config.random_phase else jnp.zeros(())
    clock, stance = clock_of(config, phase, command)
    zeros = jnp.zeros(2)
    return GaitState(
        phase=phase,
        contact=jnp.zeros(2, bool),
        lift_z=foot_z,
        air_time=zeros,
        landed_air_time=zeros,
        swing_height=zeros,
        mean_error=zeros,
        stance=stance,
        clock=clock,
    )


def update(
    config: GaitConfig,
    state: GaitState,
    signals: Signals,
    command: Command,
    cycle_time: jax.Array,
    dt: float,
) -> GaitState:
    """Advances the clock by `dt` [s] and updates contacts, air times and heights.

    A foot is grounded if it has contact, had contact at the step before, or should have it by the
    clock (HG). When a foot becomes grounded, `landed_air_time` is its air time. While the command
    approaches the wanted one, the error counts as 0 in `mean_error`. Otherwise the robot's lag
    would stay in the mean, and only an overshoot could cancel it.
    """
    phase = jnp.mod(state.phase + dt / cycle_time, 1.0)
    clock, stance = clock_of(config, phase, command)
    contact = signals.foot_contact
    grounded = contact | stance | state.contact
    flown = state.air_time > 0.0
    air_time = state.air_time + dt
    arrived = jnp.all(command.velocity[:2] == command.wanted)
    error = arrived * (signals.base_linvel[:2] - command.velocity[:2])
    foot_z = signals.foot_pos[:, 2]
    return GaitState(
        phase=phase,
        contact=contact,
        lift_z=jnp.where(contact, foot_z, state.lift_z),
        air_time=jnp.where(grounded, 0.0, air_time),
        landed_air_time=jnp.where(flown & grounded, air_time, 0.0),
        swing_height=foot_z - state.lift_z,
        mean_error=state.mean_error + dt / cycle_time * (error - state.mean_error),
        stance=stance,
        clock=clock,
    )


def clock_of(config: GaitConfig, phase: jax.Array, command: Command) -> tuple[jax.Array, jax.Array]:
    """sin and cos of the phase [2], and the stance mask [2]."""
    angle = 2.0 * jnp.pi * phase
    s = jnp.sin(angle)
    run = jnp.square(_share_of_full_speed(config, command))
    both = config.double_support + run * (config.double_support_at_speed - config.double_support)
    stance = jnp.stack([s >= 0.0, s < 0.0]) | (jnp.abs(s) < both)
    stance = stance & (jnp.abs(s) >= -both)
    clock = jnp.stack([s, jnp.cos(angle)]) * command.moving
    return clock, stance | ~command.moving


def _share_of_full_speed(config: GaitConfig, command: Command) -> jax.Array:
    """Commanded |vx| as a share [] of `full_speed`, in [0, 1]."""
    return jnp.clip(jnp.abs(command.velocity[0]) / config.full_speed, 0.0, 1.0)


def cycle_time(config: Config, command: Command, curriculum_cycle, v_max) -> jax.Array:
    """Seconds per gait cycle [] for this command.

    `curriculum_cycle` [s] and `v_max` [m/s] are the curriculum's present values. By default every
    command uses `curriculum_cycle`. With `cycle_from_speed` the cycle depends on the commanded
    speed: it is the curriculum's cycle (Eq. 10) of the time when v_max was equal to that speed. The
    cycle of a command then stays the same while the range grows.
    """
    gait = config.gait
    if gait.cycle_from_speed > 0:
        beyond = jnp.maximum(jnp.abs(command.velocity[0]) - gait.cycle_from_speed, 0.0)
        factor = config.curriculum.cycle_factor ** (beyond / config.curriculum.v_step)
        return jnp.maximum(gait.cycle_time * factor, curriculum_cycle)
    if gait.cycle_follows_speed:
        share = speed_share(command, v_max)
        return gait.cycle_time + share * (curriculum_cycle - gait.cycle_time)
    return curriculum_cycle


def reference_pose(
    config: GaitConfig, robot: Robot, state: GaitState, command: Command
) -> jax.Array:
    """Reference joint angles [n, rad], from the home pose: Humanoid-Gym's, with optional parts
    that grow with speed. They stay within the limits of the joints.

    The swing leg follows a half sine (HG). With `stride_sweep` the hips follow the cosine. With
    `arm_swing` the arms follow it in the opposite direction of the leg on the same side. With
    `elbow_bend` the elbows flex. The last three parts are zero by default, as in HG.
    """
    share = _share_of_full_speed(config, command)
    s, c = state.clock
    swing = jnp.where(jnp.abs(s) < config.double_support, 0.0, s)
    leg = config.reference_scale * (1.0 + config.reference_speed_gain * share)
    pose = leg * (
        pattern(robot, "left", LEG) * jnp.minimum(swing, 0.0)
        + pattern(robot, "right", LEG) * jnp.maximum(swing, 0.0)
    )
    hips = pattern(robot, "left", _HIP) + pattern(robot, "right", _HIP)
    arms = pattern(robot, "left", _ARM) + pattern(robot, "right", _ARM)
    elbows = pattern(robot, "left", _ELBOW) - pattern(robot, "right", _ELBOW)
    swing_of_arms = config.arm_swing_slow + share * (config.arm_swing - config.arm_swing_slow)
    sweep = c * (swing_of_arms * arms - share * config.stride_sweep * hips)
    lower, upper = robot.reference_range
    return jnp.clip(pose + sweep + share * config.elbow_bend * elbows, lower, upper)


def pattern(robot: Robot, side: str, shares: dict[str, float]) -> np.ndarray:
    """[n] joint angles that rotate the named joints of one side about y by their shares.

    All other joints are zero. On the right side the sign is opposite. A robot may lack arms.
    """
    values = np.zeros(robot.count)
    for joint, share in shares.items():
        at = robot.anatomy.roles.get(f"{side}_{joint}")
        if at is not None:
            values[at] = share * robot.anatomy.pitch[at] * (1.0 if side == "left" else -1.0)
    return values
