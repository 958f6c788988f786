"""Short simulations of a robot without a policy: it stands, it hangs, two engines are compared."""

import copy
import dataclasses
import math
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from kslc_jax import physics, randomize
from kslc_jax.config import PhysicsConfig
from kslc_jax.motors import SERVO_DAMPING, drive
from kslc_jax.robot import Robot

STAND_SECONDS = 4.0
"""Time [s] for which a robot tries to stand; XBot-L falls after 2.4 s."""

HANG_SECONDS = 2.0
"""Time [s] for which a robot hangs."""

HANG_HEIGHT = 5.0
"""Height [m] of the base above its place at home while the robot hangs."""

HEAVY = 1e6
"""Inertia [kg, kg m^2] that holds the base in the air: gravity moves it by 1 mm while it hangs."""

AGREEMENT_STEPS = 20
"""Control steps after which two engines are compared."""


def fall_time(robot: Robot) -> float:
    """Time [s] after which a robot falls whose servos hold its home pose; inf if it stands.

    It starts as episodes do, with the soles a little above the ground. It has fallen when its torso
    box touches the ground, as in training.
    """
    model = copy.copy(robot.mj_model)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    dynamics = _nominal(robot)
    while data.time < STAND_SECONDS:
        _hold(robot, dynamics, model, data)
        if _torso_height(robot, data) < 0 or not np.isfinite(data.qpos).all():
            return float(data.time)
    return math.inf


def _torso_height(robot: Robot, data: mujoco.MjData) -> float:
    """Height [m] of the torso box's lowest corner above the ground."""
    up = data.xmat[robot.anatomy.base].reshape(3, 3)[2]
    centre = data.qpos[2] + up @ robot.torso_box_center
    return float(centre - np.abs(up) @ robot.torso_box_half_size)


def sag(robot: Robot) -> np.ndarray:
    """Angles [n, rad] from home after the robot has hung in the air, held at its base."""
    model = copy.copy(robot.mj_model)
    model.dof_armature[:6] = HEAVY
    data = mujoco.MjData(model)
    data.qpos[:] = robot.default_qpos
    data.qpos[2] += HANG_HEIGHT
    dynamics = _nominal(robot)
    while data.time < HANG_SECONDS:
        _hold(robot, dynamics, model, data)
    return data.qpos[7:] - robot.default_qpos[7:]


def _nominal(robot: Robot) -> randomize.Dynamics:
    """The described robot, in numpy."""
    return jax.tree.map(np.asarray, randomize.nominal(robot))


def _hold(
    robot: Robot, dynamics: randomize.Dynamics, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    """One physics step with the home pose as target, in place."""
    _, data.ctrl[:], model.actuator_biasprm[:, SERVO_DAMPING] = drive(
        robot, dynamics, data.qpos[7:], data.qvel[6:], robot.default_qpos[7:], np
    )
    with physics.own_warnings():
        mujoco.mj_step(model, data)


def engines_apart(config: PhysicsConfig) -> float:
    """Largest difference [rad] between the joint angles of the two engines after some steps; nan
    if an engine gives numbers that are not finite. The engine of `config` does not matter."""
    a, b = joint_angles("mujoco", config), joint_angles("mjx", config)
    return float(np.abs(a - b).max()) if np.isfinite([a, b]).all() else math.nan


def joint_angles(engine: Literal["mujoco", "mjx"], config: PhysicsConfig) -> np.ndarray:
    """Joint angles [n, rad] after `AGREEMENT_STEPS` control steps from home."""
    config = dataclasses.replace(config, engine=engine, iterations=10, ls_iterations=50)
    robot = physics.robot_for(config)
    home = jnp.asarray(robot.default_qpos, jnp.float32)
    start = physics.initial_state(config, home, jnp.zeros(home.size - 1))

    def one(state: physics.PhysicsState, t: jax.Array) -> tuple[physics.PhysicsState, None]:
        target = home[7:] + 0.05 * jnp.sin(0.2 * t + jnp.arange(robot.count))
        return physics.step(config, state, target, randomize.nominal(robot), 1.0), None

    run = jax.jit(lambda state: jax.lax.scan(one, state, jnp.arange(AGREEMENT_STEPS))[0])
    return np.asarray(jax.device_get(run(start).qpos[7:]))
