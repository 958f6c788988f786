"""Trials of a trained policy under constant or changing commands.

A trial runs in the policy's training physics, or in full C MuJoCo at high fidelity. Both use the
same code with another physics config.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import commands, env, gait, maths, networks, observations, physics, randomize, signals
from kslc_jax.config import (
    Config,
    ConfigError,
    Fidelity,
    HighFidelity,
    PhysicsConfig,
    RandomizeConfig,
    TerrainConfig,
)
from kslc_jax.curriculum import Curriculum
from kslc_jax.evaluation import perturbations, schedules, variation
from kslc_jax.evaluation.perturbations import Variation
from kslc_jax.evaluation.schedules import Leg, Schedule
from kslc_jax.evaluation.variation import Body
from kslc_jax.ground import Ground
from kslc_jax.policy import Policy
from kslc_jax.robot import Robot

AS_DESCRIBED = Variation()
"""No difference between the robot and its description."""

NOMINAL = RandomizeConfig(
    friction=(1.0, 1.0), ground_friction=1.0, base_mass=(0.0, 0.0), push_seconds=0.0
)
"""No randomisation: friction 1, the robot as described, no pushes."""


FARTHEST = 3.0
"""Largest angle [rad] from the robot's heading to the commanded one. It must be below pi."""


FOREVER = 864_000.0
"""Ten days [s], longer than any trial or session."""


@dataclass(frozen=True)
class Setting:
    """Conditions of a trial."""

    physics: PhysicsConfig
    randomize: RandomizeConfig = NOMINAL
    seconds: float = 20.0
    noise: bool = False
    """True: sensor noise, action delay and action noise at the full level of training."""
    latency: int = 0
    """Number of control steps by which every action is delayed."""
    imu_offset: tuple[float, float] = (0.0, 0.0)
    """Constant error of the roll and pitch that the policy sees [rad]."""
    simulate: Callable[..., physics.PhysicsState] | None = None
    """Another engine, with the signature of `physics.step`; None: the engine of `physics`."""
    schedule: Schedule | None = None
    """Commands that change; None: one constant command per robot."""
    heading: float = 0.0
    """Heading [rad] at the start. It is also the commanded heading until a schedule changes it."""
    variation: Variation = AS_DESCRIBED
    """Differences between the robots beyond those of `randomize`."""


@flax.struct.dataclass
class Trace:
    """Recorded values, [T, N, ...]. From a fall on they do not count: `alive` is then False."""

    alive: jax.Array  # bool
    mass: jax.Array  # kg, of the robot with its payload
    qpos: jax.Array  # [7 + n]
    linvel: jax.Array  # [3] m/s, base frame
    angvel: jax.Array  # [3] rad/s, base frame
    euler: jax.Array  # [3] rad
    joint_vel: jax.Array  # [n] rad/s
    torque: jax.Array  # [n] N m
    contact: jax.Array  # [2] bool, left and right foot
    foot_height: jax.Array  # [2] m, ankle-roll link above the ground
    angular_momentum: jax.Array  # [3] kg m^2/s about the whole-body CoM, world
    command: jax.Array  # [3] wanted vx, vy [m/s], and the yaw rate [rad/s] during the step
    leg: jax.Array  # int, number of the schedule's leg
    ground: Ground | None = None  # uneven ground; None: the flat floor


@flax.struct.dataclass
class Trial:
    """State of one robot's trial between two control steps."""

    env: env.EnvState
    alive: jax.Array  # [] bool
    queue: jax.Array  # [latency, n] delayed actions, the next one first
    leg: Leg
    body: Body
    key: jax.Array  # random key of this robot


def engine(
    policy: Policy, fidelity: Fidelity, terrain: TerrainConfig | None = None
) -> PhysicsConfig:
    """The physics config: that of the policy's training ("train"), or high fidelity ("high").

    The control step is that of the training. Without `terrain` the floor is flat.

    Raises:
      ConfigError: at high fidelity, no number of physics steps fills the control step.
    """
    trained, terrain = policy.config.physics, terrain or TerrainConfig()
    if fidelity == "high":
        exact = trained.control_dt / HighFidelity.timestep
        if abs(exact - round(exact)) > 1e-6 * exact:
            raise ConfigError(
                f"high fidelity has steps of {HighFidelity.timestep:g} s, which do not fill this "
                f"policy's control step of {trained.control_dt:g} s"
            )
        return HighFidelity(robot=trained.robot, terrain=terrain, decimation=round(exact))
    return dataclasses.replace(trained, terrain=terrain)


def under(setting: Setting, condition: str) -> Setting:
    """The setting with the changes of a condition, such as "payload=5" or "rough:0.05"."""
    made, engine = perturbations.changes(condition), setting.physics
    if "terrain" in made:
        engine = dataclasses.replace(engine, terrain=made.pop("terrain"))
    changed = perturbations.settings(made, setting.randomize)
    return dataclasses.replace(setting, physics=engine, **changed)


def require(setting: Setting, robot: Robot) -> None:
    """ConfigError if the robot cannot have the setting's conditions."""
    randomize.require(setting.randomize, robot)
    variation.require(setting.variation, robot)


def trial_config(config: Config, setting: Setting, count: int) -> Config:
    """The policy's config, changed to the setting's conditions: fixed commands, no time limit.

    ConfigError if the physics has another control step than the policy was trained with.
    """
    if not math.isclose(setting.physics.control_dt, config.control_dt):
        raise ConfigError(
            f"the policy acts every {config.control_dt:g} s, but timestep x decimation of this "
            f"physics is {setting.physics.control_dt:g} s"
        )
    quiet = {} if setting.noise else {"noise_level": 0.0, "action_delay": 0.0, "action_noise": 0.0}
    return dataclasses.replace(
        config,
        physics=setting.physics,
        randomize=setting.randomize,
        env=dataclasses.replace(config.env, num_envs=count, episode_seconds=FOREVER, **quiet),
        command=dataclasses.replace(config.command, resample_seconds=FOREVER, shortest_seconds=0.0),
        ppo=dataclasses.replace(config.ppo, minibatches=1),
    )


def without_joint_noise(config: Config) -> Config:
    """The config with episodes that start in the home pose."""
    return dataclasses.replace(config, env=dataclasses.replace(config.env, reset_joint_noise=0.0))


def facing_command(config: Config, state: env.EnvState, command: jax.Array) -> env.EnvState:
    """A reset environment with the command [3]: vx, vy [m/s], heading [rad].

    Its first frame shows the command. With `command.acceleration` the frame shows zero velocity,
    from which the command starts.
    """
    still = commands.standing(command[2])
    wanted = commands.with_velocity(config.command, still, jnp.append(command[:2], 0.0))
    robot = physics.robot_for(config.physics)
    yaw = signals.read(robot, state.physics).base_euler[2]
    steered = commands.steer(config.command, wanted, yaw, 0.0)
    clock, stance = gait.clock_of(config.gait, state.gait.phase, steered)
    state = state.replace(
        command=steered,
        gait=state.gait.replace(clock=clock, stance=stance),
        history=jnp.zeros_like(state.history),
        privileged_history=jnp.zeros_like(state.privileged_history),
    )
    return env.observe(config, state, jax.random.key(0))


def with_command(
    config: Config, state: env.EnvState, velocity: jax.Array, heading: jax.Array | float = 0.0
) -> env.EnvState:
    """Gives the environment the command `velocity` [3]: vx, vy [m/s], yaw rate [rad/s].

    A yaw rate other than 0 sets the commanded heading ahead of the robot, by at most `FARTHEST`:
    beyond half a turn the robot would turn the other way. With a yaw rate of 0 the commanded
    heading is `heading` [rad].

    While a command holds, a turn on the spot that has ended does not begin again, as in training
    (`commands.steer`). Else a standing robot near the smallest such turn would step and stop again
    and again.
    """
    yaw = signals.read(physics.robot_for(config.physics), state.physics).base_euler[2]
    ahead = yaw + jnp.clip(velocity[2] / config.command.heading_gain, -FARTHEST, FARTHEST)
    heading = jnp.where(velocity[2] == 0.0, heading, ahead)
    before, now = state.command, commands.with_velocity(config.command, state.command, velocity)
    held = (heading == before.heading) & jnp.all(now.wanted == before.wanted)
    turns = jnp.where(held, before.turns, now.turns)
    return state.replace(command=now.replace(heading=heading, turns=turns))


def run(
    policy: Policy, setting: Setting, velocities: np.ndarray, seed: int = 0, chunk: float = 1.0
) -> Iterator[Trace]:
    """Runs N robots, each under its own command. Yields the trace in pieces of `chunk` seconds.

    The command holds from the first step on. Only the frame that the reset makes before that step
    contains another, random command.

    Args:
      policy: acts deterministically.
      setting: conditions.
      velocities: [N, 3] commanded vx, vy [m/s], yaw rate [rad/s]. A yaw rate of 0 commands a
        constant heading, as in training. With a schedule only N counts.
      seed: seed of initial states and randomisation.
      chunk: duration of a piece [s].
    """
    count = len(velocities)
    _, advance = _programs(policy.config, _compiled(setting), count, env.step)
    carry, key_run = _begin(policy, setting, velocities, seed)
    # On a named device, like the loaded parameters. Else the second piece compiles again.
    carry = jax.device_put(carry, jax.devices()[0])
    steps = round(chunk / setting.physics.control_dt)
    for i in range(round(setting.seconds / chunk)):
        step_keys = jax.random.split(jax.random.fold_in(key_run, i), steps)
        carry, trace = advance(policy.params, policy.curriculum, carry, step_keys)
        yield jax.tree.map(np.asarray, trace)


def drawn(policy: Policy, setting: Setting, count: int, seed: int) -> randomize.Dynamics:
    """How the `count` robots [count, ...] of `run` with this seed differ from the described one."""
    start, _ = _begin(policy, setting, np.zeros((count, 3)), seed)
    return start.env.dynamics


def _begin(policy: Policy, setting: Setting, velocities: np.ndarray, seed: int):
    """(trials before the first step [N, ...], random key of the steps)."""
    start, _ = _programs(policy.config, _compiled(setting), len(velocities), env.step)
    legs = jnp.asarray(velocities, jnp.float32), jnp.float32(setting.heading)
    key_reset, key_run = jax.random.split(jax.random.key(seed))
    keys = jax.random.split(key_reset, len(velocities))
    return start(policy.curriculum, *legs, keys), key_run


def _compiled(setting: Setting) -> Setting:
    """The setting without the fields of which one compiled program serves all values."""
    return dataclasses.replace(setting, seconds=0.0, heading=0.0)


@functools.lru_cache(maxsize=4)
def _programs(trained: Config, setting: Setting, count: int, step: Callable):
    """(start, advance) for `count` environments, jitted once for all policies of a config."""
    config = trial_config(trained, setting, count)

    def start(curriculum: Curriculum, wanted: jax.Array, heading: jax.Array, keys) -> Trial:
        begin = functools.partial(_start, config, setting, curriculum)
        return jax.vmap(begin, (0, None, 0))(wanted, heading, keys)

    def advance(params: networks.Params, curriculum: Curriculum, trials: Trial, keys: jax.Array):
        policy = Policy(trained, params, curriculum, step=0)
        one = functools.partial(_advance, config, setting, step, policy)

        def all_of_them(trials: Trial, key: jax.Array) -> tuple[Trial, Trace]:
            return jax.vmap(one)(trials, jax.random.split(key, count))

        return jax.lax.scan(all_of_them, trials, keys)

    return jax.jit(start), jax.jit(advance)


def _start(
    config: Config, setting: Setting, curriculum: Curriculum, wanted: jax.Array, heading, key
) -> Trial:
    """Starts one robot at rest, with the heading `heading` [rad].

    Without a schedule its command is `wanted` [3].
    """
    state, robot = env.reset(config, key, curriculum), physics.robot_for(config.physics)
    own, key_body = jax.random.split(jax.random.fold_in(key, 1))
    leg = schedules.constant(wanted, heading)
    if setting.schedule:
        leg = schedules.before_start(heading)
    return Trial(
        env=_face(robot, state, heading),
        alive=jnp.ones((), bool),
        queue=jnp.zeros((setting.latency, len(state.last_action))),
        leg=leg,
        body=variation.sample(setting.variation, robot, key_body),
        key=own,
    )


def _face(robot: Robot, state: env.EnvState, heading: jax.Array) -> env.EnvState:
    """Turns a robot with yaw 0 to `heading` [rad], in its state and in its first frame."""
    zero = jnp.zeros(())
    quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)])
    at = observations.slices(observations.actor_table(robot))["base_euler"].stop - 1
    yaw = maths.quat_to_euler(quat)[2]
    return state.replace(
        physics=state.physics.replace(qpos=state.physics.qpos.at[3:7].set(quat)),
        history=state.history.at[-1, at].add(yaw),
    )


def _advance(
    config: Config, setting: Setting, step: Callable, policy: Policy, trial: Trial, key: jax.Array
) -> tuple[Trial, Trace]:
    """One control step of one robot."""
    robot, dt = physics.robot_for(config.physics), config.control_dt
    leg = trial.leg
    if setting.schedule:
        qpos = trial.env.physics.qpos
        yaw = maths.quat_to_euler(qpos[3:7])[2]
        leg = schedules.update(setting.schedule, config.command, leg, trial.key, yaw, qpos[:2], dt)
    state = with_command(config, trial.env, leg.velocity, leg.heading)
    action = policy.act_on(state.history + _frame_error(setting, robot))
    queue = jnp.concatenate([trial.queue, action[None]])
    simulate = _simulator(setting, robot, trial.body, key)
    after, outcome = step(config, state, queue[0], key, policy.curriculum, simulate=simulate)
    trial = trial.replace(
        env=after,
        alive=trial.alive & ~outcome.terminated,
        queue=queue[1:],
        leg=leg,
    )
    mass = randomize.total_mass(robot, after.dynamics)
    mass += len(robot.hand_body_ids) * setting.variation.hands
    wanted = jnp.append(state.command.wanted, state.command.velocity[2])
    return trial, _record(robot, trial, wanted, mass)


def _simulator(setting: Setting, robot: Robot, body: Body, key: jax.Array):
    """The engine with the setting's variation. It has the signature of `physics.step`."""
    engine = setting.simulate or physics.step
    if setting.variation == AS_DESCRIBED:
        return engine
    key_body = jax.random.fold_in(key, 1)
    alter = functools.partial(variation.alter, setting.variation, robot, body, key_body)
    return functools.partial(engine, alter=alter)


def _frame_error(setting: Setting, robot: Robot) -> np.ndarray:
    """Sum [W] of the setting's sensor errors, to be added to every actor frame."""
    table = observations.actor_table(robot)
    error = np.zeros(observations.width(table), np.float32)
    at = observations.slices(table)["base_euler"].start
    error[at : at + 2] = setting.imu_offset
    return error


def _record(robot: Robot, trial: Trial, command: jax.Array, mass: jax.Array) -> Trace:
    state, ground = trial.env.physics, trial.env.dynamics.ground
    now = signals.read(robot, state, ground)
    return Trace(
        alive=trial.alive,
        mass=mass,
        qpos=state.qpos,
        linvel=now.base_linvel,
        angvel=now.base_angvel,
        euler=now.base_euler,
        joint_vel=now.joint_vel,
        torque=now.torque,
        contact=now.foot_contact,
        foot_height=now.foot_pos[..., 2],
        angular_momentum=now.angular_momentum,
        command=command,
        leg=trial.leg.number,
        ground=ground,
    )


def join(pieces: list[Trace]) -> Trace:
    """Joins consecutive pieces to one trace."""
    return jax.tree.map(lambda *x: np.concatenate(x), *pieces)
