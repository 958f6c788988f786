"""Motors: PD torque within speed-dependent limits, and its damping for the implicit integrators.

Both engines share these functions: `xp` is numpy or jax.numpy.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from kslc_jax.config import EnvConfig
from kslc_jax.robot import Robot

CORNER_SPEED = 0.75
"""Share of the joint's speed limit above which its driving torque falls linearly.

The torque is zero at the limit."""

SERVO_DAMPING = 2
"""Index of -damping in a position servo's `actuator_biasprm`."""

THETA = 0.6
"""theta of the theta-method: weight of the motor torque at the end of a physics step.

The torque at its start has the weight 1 - theta. theta = 1 is backward Euler: at 5 ms it damps
motions that steps of 1 ms do not damp. Below 0.5 the method is unstable
(docs/fidelity_physics.md)."""

LEAST_CHANGE = 0.01
"""Smallest change of joint speed [rad/s] over which `motor_damping` measures the slope."""

FRICTION_SPEED = 0.2
"""Joint speed [rad/s] at which Coulomb friction has 76 % of its full size (smoothed by tanh)."""


def action_scale(config: EnvConfig, robot: Robot) -> np.ndarray:
    """Change of each joint's target per unit of action [n, rad], see `EnvConfig.least_torque`."""
    least = config.least_torque * robot.effort_limit / robot.kp
    return np.maximum(config.action_scale, least).astype(np.float32)


def motor_torque(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """PD torque within the motor's limits, minus joint friction [..., n, N m].

    clip(kp (target - q) - kd dq, lower, upper). The full torque is effort_limit x motor_strength.
    In the driving direction the available torque is full up to 75 % of the joint's speed limit. It
    then falls linearly: to zero at the limit, and below zero beyond it, so that a motor above its
    limit brakes. In the braking direction the torque is always full.

    Args:
      robot: gains and limits.
      dynamics: factors on gains and limits, see `Dynamics`.
      q, dq, target: joint angles [rad], speeds [rad/s], target angles [rad], [..., n].
      xp: numpy or jax.numpy.
    """
    pd = dynamics.kp * robot.kp * (target - q) - dynamics.kd * robot.kd * dq
    full = robot.effort_limit * dynamics.motor_strength
    fall = (1.0 - CORNER_SPEED) * robot.speed_limit
    upper = full * xp.clip((robot.speed_limit - dq) / fall, -1.0, 1.0)
    lower = -full * xp.clip((robot.speed_limit + dq) / fall, -1.0, 1.0)
    return xp.clip(pd, lower, upper) - dynamics.joint_friction * xp.tanh(dq / FRICTION_SPEED)


def motor_damping(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any = jnp):
    """Damping [..., n, N m s/rad] that the motors have over the next physics step.

    It is `THETA` times the mean slope of `motor_torque`, from the present speed and `torque` to the
    expected speed at the end of the step. A joint alone then moves by the theta-method.

    The engines integrate this damping implicitly. Without it, full torque would change the speed of
    an unloaded shank by 20 rad/s in 5 ms.
    """
    change = _speed_ahead(robot, dynamics, q, dq, target, torque, xp) - dq
    change = xp.where(xp.abs(change) < LEAST_CHANGE, LEAST_CHANGE, change)
    then = motor_torque(robot, dynamics, q, dq + change, target, xp)
    return THETA * (torque - then) / change


def _speed_ahead(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any):
    """Joint speed [..., n, rad/s] at the end of the step if each joint moved alone.

    Solves v = dq + h / inertia ((1 - theta) torque + theta torque(v)) with `robot.joint_inertia`.
    torque(v) leaves out joint friction. It is a clip of linear pieces. Each piece has one solution.
    The pieces never rise with v, so clipping their solutions in the same way solves the whole law.
    """
    rate = robot.mj_model.opt.timestep / robot.joint_inertia
    start, rate = dq + (1.0 - THETA) * rate * torque, THETA * rate
    gain, kd = dynamics.kp * robot.kp, dynamics.kd * robot.kd
    full = robot.effort_limit * dynamics.motor_strength
    slope = full / ((1.0 - CORNER_SPEED) * robot.speed_limit)
    slowest, fastest = start - rate * full, start + rate * full

    def on_line(torque_at_rest, slope):
        return (start + rate * torque_at_rest) / (1.0 + rate * slope)

    upper = xp.clip(on_line(slope * robot.speed_limit, slope), slowest, fastest)
    lower = xp.clip(on_line(-slope * robot.speed_limit, slope), slowest, fastest)
    return xp.clip(on_line(gain * (target - q), kd), lower, upper)


def servo_control(robot: Robot, torque, damping, q, dq):
    """Control [..., n] that makes the servos' kp (ctrl - q) - damping dq equal to `torque`."""
    return q + (torque + damping * dq) / robot.kp


def drive(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """(motor torque, servo control, servo bias on joint speed) of one physics step, each [..., n].

    Write the bias to `actuator_biasprm[..., SERVO_DAMPING]`.
    """
    torque = motor_torque(robot, dynamics, q, dq, target, xp)
    damping = motor_damping(robot, dynamics, q, dq, target, torque, xp)
    return torque, servo_control(robot, torque, damping, q, dq), -damping
