"""One environment with a policy. The command may change at any step.

This module has no window and reads no clock. `Session` does control steps. `Pacer` computes how
many control steps are due.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import env, maths, physics, signals
from kslc_jax.config import Config, PhysicsConfig
from kslc_jax.curriculum import Curriculum
from kslc_jax.evaluation import trials
from kslc_jax.ground import Ground
from kslc_jax.networks import Params
from kslc_jax.policy import Policy

FALLEN_SECONDS = 1.0
"""Time that a fallen robot lies still before the next episode starts."""

EPSILON = 1e-5
"""Relative distance of the slowest command above the dead zone, large enough for float32."""


STOP = 0.9
"""Share of the dead zone. A walking robot stops at commands below it."""


def steady(velocity: np.ndarray, walks: bool, dead_zone: float) -> tuple[np.ndarray, bool]:
    """Steadies a command at the edge of the dead zone, where a joystick may tremble.

    Walking begins above the dead zone and ends below `STOP` times it. In between, a walking robot
    gets the slowest command of the training, at the edge of the dead zone.

    Args:
      velocity: [3] wanted vx, vy [m/s], yaw rate [rad/s].
      walks: True if the robot walked in the last step.
      dead_zone: of the training's commands [m/s].

    Returns:
      (command [3], True if the robot must walk).
    """
    speed = float(np.hypot(*velocity[:2]))
    if not speed > dead_zone * (STOP if walks else 1.0):
        return velocity, False
    edge = dead_zone * (1.0 + EPSILON)
    return velocity * np.array([*2 * [max(edge / speed, 1.0)], 1.0]), True


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
    heading: jax.Array  # [] rad, commanded while the commanded yaw rate is 0


@functools.partial(jax.jit, static_argnums=0)
def _reset(config: Config, curriculum: Curriculum, key: jax.Array) -> tuple[Memory, View]:
    state = env.reset(config, key, curriculum)
    return Memory(state, jnp.zeros(())), _view(config, state, jnp.zeros(3), jnp.zeros((), bool))


@functools.partial(jax.jit, static_argnums=0)
def _advance(
    config: Config,
    params: Params,
    curriculum: Curriculum,
    memory: Memory,
    command: jax.Array,
    push: jax.Array,
    key: jax.Array,
    count: jax.Array,
) -> tuple[Memory, View]:
    """One control step. After a fall the view shows the state before the step."""
    qvel = memory.env.physics.qvel.at[:2].add(push)
    pushed = memory.env.replace(physics=memory.env.physics.replace(qvel=qvel))
    before = trials.with_command(config, pushed, command, memory.heading)
    action = Policy(config, params, curriculum, 0).act_on(before.history)
    after, outcome = env.step(config, before, action, jax.random.fold_in(key, count), curriculum)
    fallen = outcome.terminated
    view = _view(config, maths.tree_where(fallen, before, after), command, fallen)
    yaw = signals.read(physics.robot_for(config.physics), after.physics).base_euler[2]
    heading = jnp.where(command[2] == 0.0, memory.heading, yaw)
    return Memory(after, jnp.where(fallen, 0.0, heading)), view


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

    def __init__(self, policy: Policy, engine: PhysicsConfig, seed: int = 0):
        self.policy = policy
        self.dt = engine.control_dt
        self._config = trials.trial_config(policy.config, trials.Setting(engine), 1)
        self._key_reset, self._key_step = jax.random.split(jax.random.key(seed))
        self._steps = self._resets = 0
        self.reset()

    def reset(self) -> View:
        """Starts a new episode."""
        key = jax.random.fold_in(self._key_reset, self._resets)
        self._resets += 1
        memory, view = _reset(self._config, self.policy.curriculum, key)
        # On a named device, like the loaded parameters. Else the second step compiles again.
        self._memory = jax.device_put(memory, jax.devices()[0])
        self._lies, self._walks = 0.0, False
        self.view = jax.device_get(view)
        return self.view

    def advance(self, command: np.ndarray, push: np.ndarray | None = None) -> View:
        """Does one control step. After a fall the view stays for `FALLEN_SECONDS`.

        Then a new episode starts.

        Args:
          command: [3] vx, vy [m/s], yaw rate [rad/s], base frame.
          push: [2] sudden change of the base's velocity in the world frame [m/s].
        """
        if self._lies > self.dt / 2:
            self._lies -= self.dt
            return self.view
        dead_zone = self._config.command.dead_zone
        command, self._walks = steady(np.asarray(command), self._walks, dead_zone)
        self._memory, view = _advance(
            self._config,
            self.policy.params,
            self.policy.curriculum,
            self._memory,
            np.asarray(command, np.float32),
            np.asarray((0.0, 0.0) if push is None else push, np.float32),
            self._key_step,
            self._steps,
        )
        self._steps += 1
        self.view = jax.device_get(view)
        self._lies = FALLEN_SECONDS if self.view.fallen else 0.0
        return self.view


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
