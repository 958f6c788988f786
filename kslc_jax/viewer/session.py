"""One environment with a policy. The command may change at any step, or follow a schedule.

This module has no window and reads no clock. `Session` does control steps. `Pacer` computes how
many control steps are due.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import env, maths, physics, signals
from kslc_jax.commands import TURNING
from kslc_jax.config import Config, PhysicsConfig, RandomizeConfig
from kslc_jax.curriculum import Curriculum
from kslc_jax.disturbances import PUNCH_SECONDS
from kslc_jax.evaluation import schedules, trials
from kslc_jax.evaluation.schedules import Leg, Schedule
from kslc_jax.ground import Ground
from kslc_jax.networks import Params
from kslc_jax.policy import Policy

FALLEN_SECONDS = 1.0
"""Time that a fallen robot lies still before the next episode starts."""

EPSILON = 1e-5
"""Relative distance of the slowest command above the dead zone, large enough for float32."""


STOP = 0.9
"""Share of the dead zone. A walking robot stops at commands below it."""


def steady(
    velocity: np.ndarray, before: tuple[bool, bool], dead_zone: float
) -> tuple[np.ndarray, tuple[bool, bool]]:
    """Steadies a command at the edge of the dead zone, where a joystick may tremble.

    Walking begins above the dead zone and ends below `STOP` times it. In between, a walking robot
    gets the slowest command of the training, at the edge of the dead zone. The same holds for the
    yaw rate, from which a standing robot begins to turn (`commands.TURNING`).

    Args:
      velocity: [3] wanted vx, vy [m/s], yaw rate [rad/s].
      before: what this function returned at the last step; (False, False) at first.
      dead_zone: of the training's commands [m/s].

    Returns:
      (command [3], (True if the robot walks, True if the yaw rate counts as turning)).
    """
    speed, rate = float(np.hypot(*velocity[:2])), abs(float(velocity[2]))
    faster, walks = _held(speed, before[0], dead_zone)
    quicker, turns = _held(rate, before[1], TURNING)
    return velocity * np.array([faster, faster, 1.0 if walks else quicker]), (walks, turns)


def _held(size: float, on: bool, edge: float) -> tuple[float, bool]:
    """(factor on a value of this size, True if it counts), see `steady`."""
    if not size > edge * (STOP if on else 1.0):
        return 1.0, False
    return max(edge * (1.0 + EPSILON) / size, 1.0), True


@flax.struct.dataclass
class View:
    """The values of one control step that the viewer shows."""

    qpos: jax.Array  # [7 + n]
    command: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s]
    velocity: jax.Array  # [3] actual vx, vy [m/s], yaw rate [rad/s]; base frame
    phase: jax.Array  # [] share of the gait cycle
    contact: jax.Array  # [2] bool, left and right foot
    fallen: jax.Array  # [] bool
    ground: Ground | None  # uneven ground; None: the flat floor


@flax.struct.dataclass
class Memory:
    """State of a session between two control steps."""

    env: env.EnvState
    leg: Leg  # the present command
    key: jax.Array  # random key of the schedule, another one in each episode


@flax.struct.dataclass
class Asked:
    """The user's wishes for one control step."""

    command: jax.Array  # [3] vx, vy [m/s], yaw rate [rad/s]
    by_hand: jax.Array  # [] bool, False: the command of the schedule counts
    force: jax.Array  # [nbody, 6] force [N] and torque [N m] on each body, world frame


@functools.partial(jax.jit, static_argnums=0)
def _reset(config: Config, curriculum: Curriculum, key: jax.Array) -> tuple[Memory, View]:
    state = env.reset(config, key, curriculum)
    memory = Memory(state, schedules.before_start(0.0), jax.random.fold_in(key, 1))
    return memory, _view(config, state, jnp.zeros(3), jnp.zeros((), bool))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _advance(
    config: Config,
    schedule: Schedule | None,
    params: Params,
    curriculum: Curriculum,
    memory: Memory,
    asked: Asked,
    key: jax.Array,
    count: jax.Array,
) -> tuple[Memory, View]:
    """One control step. After a fall the view shows the state before the step."""
    leg = _next_leg(config, schedule, memory, asked)
    before = trials.with_command(config, memory.env, leg.velocity, leg.heading)
    action = Policy(config, params, curriculum, 0).act_on(before.history)
    key_step = jax.random.fold_in(key, count)
    simulate = functools.partial(_simulate, asked.force)
    after, outcome = env.step(config, before, action, key_step, curriculum, simulate)
    fallen = outcome.terminated
    view = _view(config, maths.tree_where(fallen, before, after), leg.velocity, fallen)
    yaw = signals.read(physics.robot_for(config.physics), after.physics).base_euler[2]
    leg = leg.replace(heading=jnp.where(leg.velocity[2] == 0.0, leg.heading, yaw))
    again = Memory(after, schedules.before_start(0.0), jax.random.fold_in(memory.key, count))
    return maths.tree_where(fallen, again, Memory(after, leg, memory.key)), view


def _next_leg(config: Config, schedule: Schedule | None, memory: Memory, asked: Asked) -> Leg:
    """The leg of the coming step: the user's command, or the leg of the schedule.

    When the user gives the command back, the schedule begins its next leg.
    """
    by_hand = memory.leg.replace(velocity=asked.command, left=jnp.zeros(()))
    if schedule is None:
        return by_hand
    qpos = memory.env.physics.qpos
    yaw = maths.quat_to_euler(qpos[3:7])[2]
    leg, dt = memory.leg, config.control_dt
    planned = schedules.update(schedule, config.command, leg, memory.key, yaw, qpos[:2], dt)
    return maths.tree_where(asked.by_hand, by_hand, planned)


def _simulate(shove, config, state, target, dynamics, ground_friction, force):
    """`physics.step` with the force `shove` [nbody, 6] beside that of the disturbances."""
    total = shove if force is None else force + shove
    return physics.step(config, state, target, dynamics, ground_friction, total)


def _view(config: Config, state: env.EnvState, command: jax.Array, fallen: jax.Array) -> View:
    now = signals.read(physics.robot_for(config.physics), state.physics, state.dynamics.ground)
    return View(
        qpos=state.physics.qpos,
        command=command,
        velocity=jnp.append(now.base_linvel[:2], now.base_angvel[2]),
        phase=state.gait.phase,
        contact=now.foot_contact,
        fallen=fallen,
        ground=state.dynamics.ground,
    )


class Session:
    """A policy that controls one robot; `view` is the present state."""

    view: View

    def __init__(
        self,
        policy: Policy,
        engine: PhysicsConfig,
        seed: int = 0,
        schedule: Schedule | None = None,
        randomize: RandomizeConfig = trials.NOMINAL,
    ):
        """Starts the first episode.

        Args:
          policy: acts deterministically.
          engine: the physics, see `trials.engine`.
          seed: seed of initial states and of the schedule's random commands.
          schedule: the commands of `advance(None)`.
          randomize: differences of the robot, and disturbances such as punches.
        """
        self.policy, self.schedule = policy, schedule
        self.dt = engine.control_dt
        setting = trials.Setting(engine, randomize)
        self._config = trials.trial_config(policy.config, setting, 1)
        self._key_reset, self._key_step = jax.random.split(jax.random.key(seed))
        self._model = physics.robot_for(engine).mj_model
        self._steps = self._resets = 0
        self.reset()

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links that `shove` knows, the base first."""
        return tuple(self._model.body(i).name for i in range(1, self._model.nbody))

    def reset(self) -> View:
        """Starts a new episode."""
        key = jax.random.fold_in(self._key_reset, self._resets)
        self._resets += 1
        memory, view = _reset(self._config, self.policy.curriculum, key)
        # On a named device, like the loaded parameters. Else the second step compiles again.
        self._memory = jax.device_put(memory, jax.devices()[0])
        self._lies, self._moves = 0.0, (False, False)
        self._end_shove()
        self.view = jax.device_get(view)
        return self.view

    def _end_shove(self) -> None:
        self._shove_steps, self._force = 0, np.zeros((self._model.nbody, 6), np.float32)

    def shove(self, link: str, newtons: float, angle: float) -> None:
        """Pushes a link with a horizontal force for the next `PUNCH_SECONDS`.

        A new shove replaces the present one.

        Args:
          link: one of `links`; the force acts at its centre of mass.
          newtons: size of the force [N].
          angle: direction of the force [rad], from the robot's present heading to the left.
        """
        w, x, y, z = self.view.qpos[3:7]
        angle += np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self._end_shove()
        way = np.array([np.cos(angle), np.sin(angle)])
        self._force[self._model.body(link).id, :2] = newtons * way
        self._shove_steps = round(PUNCH_SECONDS / self.dt)

    def advance(self, command: np.ndarray | None = None) -> View:
        """Does one control step. After a fall the view stays for `FALLEN_SECONDS`.

        Then a new episode starts, and the schedule with it.

        Args:
          command: [3] vx, vy [m/s], yaw rate [rad/s], base frame. None: the command of the
            schedule; without a schedule the robot stands.
        """
        if self._lies > self.dt / 2:
            self._lies -= self.dt
            return self.view
        if self._shove_steps == 0:
            self._end_shove()
        self._memory, view = _advance(
            self._config,
            self.schedule,
            self.policy.params,
            self.policy.curriculum,
            self._memory,
            self._asked(command),
            self._key_step,
            self._steps,
        )
        self._steps += 1
        self._shove_steps = max(0, self._shove_steps - 1)
        self.view = jax.device_get(view)
        if self.view.fallen:
            self._lies = FALLEN_SECONDS
            self._end_shove()
        return self.view

    def _asked(self, command: np.ndarray | None) -> Asked:
        dead_zone, by_hand = self._config.command.dead_zone, command is not None
        wanted = np.zeros(3) if command is None else np.asarray(command)
        wanted, self._moves = steady(wanted, self._moves, dead_zone)
        return Asked(
            jnp.asarray(wanted, jnp.float32), jnp.asarray(by_hand), jnp.asarray(self._force)
        )


class Pacer:
    """Computes how many steps of `dt` [s] are due, so that simulated time follows the clock."""

    def __init__(self, dt: float, longest: float = 0.1):
        """If a slow simulation lags behind the clock, it skips the lag above `longest` [s]."""
        self._dt, self._longest = dt, longest
        self._last: float | None = None
        self._owed = 0.0

    def due(self, now: float, rate: float) -> int:
        """Number of steps due at the clock time `now` [s], at `rate` simulated seconds a second."""
        elapsed = 0.0 if self._last is None else now - self._last
        self._last = now
        self._owed = min(self._owed + rate * elapsed, max(1.0, rate) * self._longest)
        steps = int(self._owed / self._dt + 1e-6)
        self._owed -= steps * self._dt
        return steps
