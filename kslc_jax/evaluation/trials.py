"""Trials: a trained policy under fixed commands, in the environment it was trained in or in full
C MuJoCo at high fidelity. One code path for both: only the physics config differs.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import commands, env, networks, observations, physics, signals
from kslc_jax.config import Config, Fidelity, HighFidelity, PhysicsConfig, RandomizeConfig
from kslc_jax.curriculum import Curriculum
from kslc_jax.policy import Policy

NOMINAL = RandomizeConfig(
    friction=(1.0, 1.0), ground_friction=1.0, base_mass=(0.0, 0.0), push_seconds=0.0
)
"""No randomisation: friction 1, the robot as described, no pushes."""


FARTHEST = 3.0
"""How far [rad] a wanted heading lies ahead of the robot at most."""


FOREVER = 864_000.0
"""Time [s] that no trial and no session lasts: ten days."""


@dataclass(frozen=True)
class Setting:
    """Under what conditions a policy is tried."""

    physics: PhysicsConfig
    randomize: RandomizeConfig = NOMINAL
    seconds: float = 20.0
    noise: bool = False
    """Sensor noise, action delay and action noise, the most that training has."""
    latency: bool = False
    """Every action comes one control step late."""
    imu_offset: tuple[float, float] = (0.0, 0.0)
    """Constant error of the roll and pitch that the policy sees [rad]."""
    simulate: Callable[..., physics.PhysicsState] | None = None
    """Another engine, with the signature of `physics.step`; None takes that of `physics`."""


@flax.struct.dataclass
class Trace:
    """What was recorded, [T, N, ...]; nothing counts from a fall on, where `alive` is False."""

    alive: jax.Array  # bool
    mass: jax.Array  # kg, of the robot and what it carries
    qpos: jax.Array  # [23]
    linvel: jax.Array  # [3] m/s, base frame
    angvel: jax.Array  # [3] rad/s, base frame
    euler: jax.Array  # [3] rad
    joint_vel: jax.Array  # [16] rad/s
    torque: jax.Array  # [16] N m
    contact: jax.Array  # [2] bool, left and right foot
    foot_height: jax.Array  # [2] m, ankle-roll link
    angular_momentum: jax.Array  # [3] kg m^2/s about the whole-body CoM, world


def engine(policy: Policy, fidelity: Fidelity) -> PhysicsConfig:
    """The physics that the policy was trained in ("train") or the high-fidelity one."""
    return HighFidelity() if fidelity == "high" else policy.config.physics


def trial_config(config: Config, setting: Setting, count: int) -> Config:
    """The policy's config under the setting's conditions: fixed commands, no time limit."""
    quiet = {} if setting.noise else {"noise_level": 0.0, "action_delay": 0.0, "action_noise": 0.0}
    return dataclasses.replace(
        config,
        physics=setting.physics,
        randomize=setting.randomize,
        env=dataclasses.replace(config.env, num_envs=count, episode_seconds=FOREVER, **quiet),
        command=dataclasses.replace(config.command, resample_seconds=FOREVER, shortest_seconds=0.0),
        ppo=dataclasses.replace(config.ppo, minibatches=1),
    )


def with_command(
    config: Config, state: env.EnvState, velocity: jax.Array, heading: jax.Array | float = 0.0
) -> env.EnvState:
    """The environment under the command `velocity` [3]: vx, vy [m/s], yaw rate [rad/s].

    A wanted yaw rate moves the heading ahead of the robot, by less than half a turn, beyond which
    it would turn the other way; without one it is `heading` [rad].
    """
    yaw = signals.read(physics.robot_for(config.physics), state.physics).base_euler[2]
    ahead = yaw + jnp.clip(velocity[2] / config.command.heading_gain, -FARTHEST, FARTHEST)
    heading = jnp.where(velocity[2] == 0.0, heading, ahead)
    command = commands.with_velocity(config.command, state.command, velocity)
    return state.replace(command=command.replace(heading=heading))


def run(
    policy: Policy, setting: Setting, velocities: np.ndarray, seed: int = 0, chunk: float = 1.0
) -> Iterator[Trace]:
    """Tries one command per environment; yields the trace in pieces of `chunk` seconds.

    The command holds from the first step on; the one frame before it, the reset's, shows whatever
    command was drawn there.

    Args:
      policy: acts deterministically.
      setting: conditions.
      velocities: [N, 3] commanded vx, vy [m/s] and, by heading, yaw rate [rad/s]. With a yaw rate
        of 0 the robot is asked to keep its heading, as in training.
      seed: of initial states and randomisation.
      chunk: seconds per piece.
    """
    count = len(velocities)
    reset, advance = _programs(policy.config, setting, count, env.step)
    wanted = jnp.asarray(velocities, jnp.float32)
    key_reset, key_run = jax.random.split(jax.random.key(seed))
    states = reset(policy.curriculum, jax.random.split(key_reset, count))
    carry = states, jnp.ones(count, bool), states.last_action
    steps = round(chunk / setting.physics.control_dt)
    for i in range(round(setting.seconds / chunk)):
        step_keys = jax.random.split(jax.random.fold_in(key_run, i), steps)
        carry, trace = advance(policy.params, policy.curriculum, wanted, carry, step_keys)
        yield jax.tree.map(np.asarray, trace)


@functools.lru_cache(maxsize=4)
def _programs(trained: Config, setting: Setting, count: int, step: Callable):
    """(reset, advance) of `count` environments, jitted once for all policies of a config."""
    config = trial_config(trained, setting, count)
    robot = physics.robot_for(config.physics)
    error = _frame_error(setting)
    if setting.simulate:
        step = functools.partial(step, simulate=setting.simulate)

    def one(policy: Policy, wanted: jax.Array, carry, key: jax.Array):
        state, alive, last_action = carry
        state = jax.vmap(lambda s, v: with_command(config, s, v))(state, wanted)
        action = jax.vmap(policy.act_on)(state.history + error)
        sent = last_action if setting.latency else action
        keys = jax.random.split(key, count)
        state, outcome = jax.vmap(step, (None, 0, 0, 0, None))(
            config, state, sent, keys, policy.curriculum
        )
        alive = alive & ~outcome.terminated
        return (state, alive, action), _record(robot, state, alive)

    def advance(params: networks.Params, curriculum: Curriculum, wanted, carry, keys):
        policy = Policy(trained, params, curriculum, step=0)
        return jax.lax.scan(functools.partial(one, policy, wanted), carry, keys)

    def reset(curriculum: Curriculum, keys: jax.Array):
        return jax.vmap(env.reset, (None, 0, None))(config, keys, curriculum)

    return jax.jit(reset), jax.jit(advance)


def _frame_error(setting: Setting) -> np.ndarray:
    """What the setting's sensor errors add to every actor frame [59]."""
    error = np.zeros(observations.ACTOR_WIDTH, np.float32)
    at = observations.slices(observations.ACTOR)["base_euler"].start
    error[at : at + 2] = setting.imu_offset
    return error


def _record(robot, state: env.EnvState, alive: jax.Array) -> Trace:
    now = jax.vmap(lambda s: signals.read(robot, s))(state.physics)
    return Trace(
        alive=alive,
        mass=robot.total_mass + state.dynamics.base_mass,
        qpos=state.physics.qpos,
        linvel=now.base_linvel,
        angvel=now.base_angvel,
        euler=now.base_euler,
        joint_vel=now.joint_vel,
        torque=now.torque,
        contact=now.foot_contact,
        foot_height=now.foot_pos[..., 2],
        angular_momentum=now.angular_momentum,
    )


def join(pieces: list[Trace]) -> Trace:
    """One trace from consecutive pieces."""
    return jax.tree.map(lambda *x: np.concatenate(x), *pieces)
