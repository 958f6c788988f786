"""The environment: pure functions `reset` and `step` for ONE robot. The caller vmaps and jits.

Only `step` defines the order of operations in a control step. `reset` sets every field, so nothing
passes from one episode to the next.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import (
    commands,
    disturbances,
    gait,
    ground,
    maths,
    motors,
    observations,
    physics,
    randomize,
    rewards,
    signals,
)
from kslc_jax import curriculum as curriculum_lib
from kslc_jax.commands import Command
from kslc_jax.config import Config
from kslc_jax.curriculum import Curriculum
from kslc_jax.disturbances import Disturbances
from kslc_jax.gait import GaitState
from kslc_jax.physics import PhysicsState
from kslc_jax.randomize import Dynamics
from kslc_jax.signals import Signals

NEVER = -1_000_000
"""`EnvState.top_until` of a robot that has had no command at the top."""

DIVERGED = 1e3
"""Physics with a speed [m/s, rad/s] of this size, or with non-finite numbers, has diverged."""


@flax.struct.dataclass
class EnvState:
    """Whole state of one environment."""

    physics: PhysicsState
    dynamics: Dynamics
    gait: GaitState
    command: Command
    command_since: jax.Array  # [] int, `time` when the command was drawn
    command_until: jax.Array  # [] int, `time` when the next one is drawn
    top_until: jax.Array  # [] int, `time` when the last command at the top ended, see is_top
    history: jax.Array  # [K, W] actor frames, oldest first
    privileged_history: jax.Array  # [Kp, W] critic frames, oldest first
    last_action: jax.Array  # [n] as applied
    last_last_action: jax.Array  # [n]
    last_base_velocity: jax.Array  # [6] world
    push: jax.Array  # [5] last push: m/s (x, y), rad/s (3)
    time: jax.Array  # [] int, control steps since the reset
    disturbances: Disturbances | None = None  # None: the config has none


@flax.struct.dataclass
class Outcome:
    """Result of one step. `terminated` and `truncated` never hold both."""

    reward: jax.Array  # []
    terminated: jax.Array  # [] bool, the robot fell, or the physics diverged
    truncated: jax.Array  # [] bool, the episode reached its time limit
    broken: jax.Array  # [] bool, the physics diverged; PPO ignores this sample
    terms: dict[str, jax.Array]  # unweighted reward terms, see rewards.TERMS
    settled: jax.Array  # [] bool, the command is unchanged for `settle_seconds` or longer
    fast: jax.Array  # [] bool, settled and in the top part of the range, see is_fast
    top: jax.Array  # [] bool, the command is less than one `v_step` below v_max
    braking: jax.Array  # [] bool, such a command has ended within the last `falls_after` seconds
    ends_command: jax.Array  # [] bool, a new command is drawn after this step
    commanded: jax.Array  # [] m/s, commanded vx
    speed: jax.Array  # [] m/s, vx of the base, base frame
    episode_steps: jax.Array  # [] int, age of the episode, see train_step._episodes
    speeding: jax.Array  # [] bool, a joint is at or above its speed limit


def reset(config: Config, key: jax.Array, curriculum: Curriculum) -> EnvState:
    """Starts a new episode of one environment."""
    key_start, key_noise = jax.random.split(key)
    return observe(config, begin(config, key_start, curriculum), key_noise)


def begin(config: Config, key: jax.Array, curriculum: Curriculum) -> EnvState:
    """The start of an episode, before its first observation."""
    keys = jax.random.split(key, 7)
    robot = physics.robot_for(config.physics)
    noise = config.env.reset_joint_noise
    joints = jax.random.uniform(keys[0], (robot.count,), minval=-noise, maxval=noise)
    qpos = jnp.asarray(robot.default_qpos, jnp.float32).at[7:].add(joints)
    state = physics.initial_state(config.physics, qpos, jnp.zeros(robot.mj_model.nv))
    dynamics = randomize.sample(config.randomize, robot, keys[2])
    if config.physics.uneven:
        drawn = ground.sample(config.physics.uneven, keys[5], curriculum.v_max)
        dynamics = dynamics.replace(ground=drawn)
    now = signals.read(robot, state, dynamics.ground)
    command = _sample_command(config, keys[1], curriculum, now)
    return EnvState(
        physics=state,
        dynamics=dynamics,
        gait=gait.init(config.gait, keys[3], command, now.foot_pos[:, 2]),
        command=command,
        command_since=jnp.zeros((), jnp.int32),
        command_until=commands.holding_steps(config.command, keys[4], config.control_dt),
        top_until=jnp.full((), NEVER, jnp.int32),
        history=jnp.zeros((config.env.frames, observations.actor_width(robot))),
        privileged_history=jnp.zeros(
            (
                config.env.privileged_frames,
                observations.critic_width(robot, config.env.critic_memory),
            )
        ),
        last_action=jnp.zeros(robot.count),
        last_last_action=jnp.zeros(robot.count),
        last_base_velocity=jnp.zeros(6),
        push=jnp.zeros(5),
        time=jnp.zeros((), jnp.int32),
        disturbances=disturbances.start(config.randomize, keys[6], qpos[7:]),
    )


def step(
    config: Config,
    state: EnvState,
    action: jax.Array,
    key: jax.Array,
    curriculum: Curriculum,
    simulate: Callable[..., PhysicsState] = physics.step,
) -> tuple[EnvState, Outcome]:
    """Advances one environment by one control step, and resets it if its episode ends.

    Args:
      config: static.
      state: the environment before the step.
      action: [n] in joint order, unscaled.
      key: source of all randomness in this step.
      curriculum: present command range and gait cycle.
      simulate: the engine, with the signature of `physics.step`.

    Returns:
      (state for the next action, outcome of this step). The state is already reset if the episode
      ended.
    """
    keys = jax.random.split(key, 5)
    robot = physics.robot_for(config.physics)

    noise = state.dynamics.noise
    action = _applied_action(config, action, state.last_action, noise, keys[0])
    home = jnp.asarray(robot.default_qpos[7:], jnp.float32)
    target = home + motors.action_scale(config.env, robot) * action
    disturbed, target, force = disturbances.apply(
        config.randomize, robot, state.disturbances, state.time, target, config.control_dt
    )
    floor = config.randomize.ground_friction
    new = simulate(config.physics, state.physics, target, state.dynamics, floor, force)
    broken = ~(jnp.all(jnp.isfinite(new.qpos)) & jnp.all(jnp.abs(new.qvel) < DIVERGED))
    new = maths.tree_where(broken, state.physics, new)
    now = signals.read(robot, new, state.dynamics.ground)

    command = commands.steer(config.command, state.command, now.base_euler[2], config.control_dt)
    cycle = gait.cycle_time(config, command, curriculum.cycle_time, curriculum.v_max)
    gait_now = gait.update(config.gait, state.gait, now, command, cycle, config.control_dt)

    outcome = _outcome(config, state, action, now, gait_now, command, broken, curriculum)
    time = state.time + 1
    state = state.replace(
        physics=new,
        gait=gait_now,
        command=command,
        last_action=action,
        last_last_action=state.last_action,
        last_base_velocity=now.base_velocity,
        time=time,
        top_until=jnp.where(outcome.top, time, state.top_until),
        disturbances=disturbed,
    )
    state = _resample(config, state, keys[1], curriculum, now)
    state = _push(config, state, keys[2])
    fresh = begin(config, keys[3], curriculum)
    state = maths.tree_where(outcome.terminated | outcome.truncated, fresh, state)
    return observe(config, state, keys[4]), outcome


def _outcome(
    config: Config,
    before: EnvState,
    action: jax.Array,
    now: Signals,
    gait_now: GaitState,
    command: Command,
    broken: jax.Array,
    curriculum: Curriculum,
) -> Outcome:
    """Reward, end of episode and statistics of the step from `before` to `now`.

    `command` is the command that the policy saw, with its yaw rate recomputed for the new heading
    (HG).
    """
    robot = physics.robot_for(config.physics)
    time = before.time + 1
    terminated = now.torso_contact | broken
    reward, terms = rewards.evaluate(
        config.rewards,
        robot,
        config.control_dt,
        rewards.Inputs(
            signals=now,
            gait=gait_now,
            command=command,
            reference=gait.reference_pose(config.gait, robot, gait_now, command),
            action=action,
            last_action=before.last_action,
            last_last_action=before.last_last_action,
            last_joint_vel=before.physics.qvel[6:],
            last_base_velocity=before.last_base_velocity,
            v_max=curriculum.v_max,
        ),
    )
    held = (before.time - before.command_since) * config.control_dt
    settled = held >= config.curriculum.settle_seconds
    vx = command.velocity[0]
    return Outcome(
        reward=jnp.where(broken, 0.0, reward),
        terminated=terminated,
        truncated=(time >= config.episode_steps) & ~terminated,
        broken=broken,
        terms=terms,
        settled=settled,
        fast=settled & curriculum_lib.is_fast(config.curriculum, curriculum, vx),
        top=curriculum_lib.is_top(config.curriculum, curriculum, vx),
        braking=(before.time - before.top_until) * config.control_dt
        < config.curriculum.falls_after,
        ends_command=time >= before.command_until,
        commanded=vx,
        speed=now.base_linvel[0],
        episode_steps=time,
        speeding=jnp.any(jnp.abs(now.joint_vel) >= robot.speed_limit),
    )


def _applied_action(
    config: Config, action: jax.Array, last_action: jax.Array, noise: jax.Array, key: jax.Array
) -> jax.Array:
    """Clips the action, then applies a random delay and multiplicative noise (HG).

    The episode's factor `noise` [] scales both. Held arms get zero.
    """
    key_delay, key_noise = jax.random.split(key)
    action = jnp.clip(action, -config.env.action_clip, config.env.action_clip)
    delay = noise * config.env.action_delay * jax.random.uniform(key_delay)
    action = (1.0 - delay) * action + delay * last_action
    spread = noise * config.env.action_noise
    action = action * (1.0 + spread * jax.random.normal(key_noise, action.shape))
    if config.env.arms == "held":
        action = action * ~physics.robot_for(config.physics).is_arm
    return action


def _sample_command(
    config: Config,
    key: jax.Array,
    curriculum: Curriculum,
    now: Signals,
    before: Command | None = None,
) -> Command:
    """Draws a command from the curriculum's present range; `before` is the one that ends."""
    vx_range = (jnp.asarray(config.curriculum.v_min), curriculum.v_max)
    top_width = config.curriculum.v_step
    return commands.sample(config.command, key, vx_range, now.base_euler[2], top_width, before)


def _resample(
    config: Config, state: EnvState, key: jax.Array, curriculum: Curriculum, now: Signals
) -> EnvState:
    """Draws a new command if the time of the old one is over."""
    key_command, key_time = jax.random.split(key)
    fresh = state.replace(
        command=_sample_command(config, key_command, curriculum, now, state.command),
        command_since=state.time,
        command_until=state.time
        + commands.holding_steps(config.command, key_time, config.control_dt),
    )
    return maths.tree_where(state.time >= state.command_until, fresh, state)


def _push(config: Config, state: EnvState, key: jax.Array) -> EnvState:
    """Pushes the base every `push_seconds`.

    A push changes the planar velocity [m/s, world] and the angular velocity [rad/s, body frame].
    """
    r = config.randomize
    if r.push_seconds <= 0:
        return state
    size = jnp.array([r.push_velocity] * 2 + [r.push_angular] * 3)
    push = size * jax.random.uniform(key, (5,), minval=-1.0, maxval=1.0)
    keep = 1.0 if r.push_adds else 0.0
    qvel = state.physics.qvel
    pushed = qvel.at[:2].set(keep * qvel[:2] + push[:2]).at[3:6].set(keep * qvel[3:6] + push[2:])
    now = state.time % round(r.push_seconds / config.control_dt) == 0
    return state.replace(
        physics=state.physics.replace(qvel=jnp.where(now, pushed, qvel)),
        push=jnp.where(now, push, state.push),
    )


def observe(config: Config, state: EnvState, key: jax.Array) -> EnvState:
    """Appends the present actor and critic frames to the histories."""
    robot = physics.robot_for(config.physics)
    src = observations.Sources(
        signals=signals.read(robot, state.physics, state.dynamics.ground),
        gait=state.gait,
        command=state.command,
        dynamics=state.dynamics,
        reference=gait.reference_pose(config.gait, robot, state.gait, state.command),
        last_action=state.last_action,
        push=state.push,
        base_mass=robot.mj_model.body_mass[robot.trunk_body_id] + state.dynamics.base_mass,
    )
    frame = observations.actor_frame(config.env, robot, src, key)
    privileged = observations.critic_frame(config.env, robot, src)
    return state.replace(
        history=observations.append_frame(state.history, frame),
        privileged_history=observations.append_frame(state.privileged_history, privileged),
    )
