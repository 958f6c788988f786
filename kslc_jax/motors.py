"""The motors: PD torque within their limits, and the damping that the engines take implicitly.

The two engines share these functions: `xp` is numpy or jax.numpy.
"""

from typing import Any

import jax.numpy as jnp

from kslc_jax.robot import Robot

TORQUE_KNEE = 0.75
"""Share of a joint's speed limit above which its driving torque falls, linearly, to zero."""

SERVO_DAMPING = 2
"""Where -damping stands in a servo's `actuator_biasprm`."""

THETA = 0.6
"""theta: share of a step's motor torque taken from its end. 1, backward Euler, brakes at 5 ms what
moves freely at 1 ms; below 0.5 it is unstable."""

LEAST_CHANGE = 0.01
"""Least change of joint speed [rad/s] over which `motor_damping` takes a chord."""

FRICTION_SPEED = 0.2
"""Joint speed [rad/s] at which Coulomb friction is 76 % grown (tanh keeps it smooth)."""


def motor_torque(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """PD torque within the motor's limits, minus joint friction [16, N m].

    clip(kp (target - q) - kd dq, lower, upper): in the driving direction the available torque
    falls on a line from its full value (0.85 x effort limit x strength) at 75 % of the joint's
    speed limit to zero at the limit, and on from there: a motor that is turned faster than it can
    turn by itself brakes. Braking keeps all of the torque.

    Args:
      robot: gains and limits.
      dynamics: factors on them, see `Dynamics`.
      q, dq, target: joint angles [rad], speeds [rad/s], target angles [rad], [..., 16].
      xp: numpy or jax.numpy; the two engines share this function.
    """
    pd = dynamics.kp * robot.kp * (target - q) - dynamics.kd * robot.kd * dq
    full = robot.effort_limit * dynamics.motor_strength
    fall = (1.0 - TORQUE_KNEE) * robot.speed_limit
    upper = full * xp.clip((robot.speed_limit - dq) / fall, -1.0, 1.0)
    lower = -full * xp.clip((robot.speed_limit + dq) / fall, -1.0, 1.0)
    return xp.clip(pd, lower, upper) - dynamics.joint_friction * xp.tanh(dq / FRICTION_SPEED)


def motor_damping(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any = jnp):
    """How `motor_torque` falls with joint speed over the coming physics step [16, N m s/rad], from
    its present `torque`.

    The engines take it implicitly: full torque would carry an unloaded shank by 20 rad/s in 5 ms.
    It is `THETA` times the slope of the chord from the present speed to that at the end of the
    step, so that a joint alone moves by the theta-method.
    """
    change = _speed_ahead(robot, dynamics, q, dq, target, torque, xp) - dq
    change = xp.where(xp.abs(change) < LEAST_CHANGE, LEAST_CHANGE, change)
    then = motor_torque(robot, dynamics, q, dq + change, target, xp)
    return THETA * (torque - then) / change


def _speed_ahead(robot: Robot, dynamics: Any, q, dq, target, torque, xp: Any):
    """Joint speed [16] at the end of the step, were each joint alone with its inertia.

    v = dq + h / inertia ((1 - theta) torque + theta torque(v)), solved for each straight piece of
    the torque's law. The law falls with v, so that the solutions are clipped by each other as the
    pieces are.
    """
    rate = robot.mj_model.opt.timestep / robot.joint_inertia
    start, rate = dq + (1.0 - THETA) * rate * torque, THETA * rate
    gain, kd = dynamics.kp * robot.kp, dynamics.kd * robot.kd
    full = robot.effort_limit * dynamics.motor_strength
    slope = full / ((1.0 - TORQUE_KNEE) * robot.speed_limit)
    slowest, fastest = start - rate * full, start + rate * full

    def on_line(torque_at_rest, slope):
        return (start + rate * torque_at_rest) / (1.0 + rate * slope)

    upper = xp.clip(on_line(slope * robot.speed_limit, slope), slowest, fastest)
    lower = xp.clip(on_line(-slope * robot.speed_limit, slope), slowest, fastest)
    return xp.clip(on_line(gain * (target - q), kd), lower, upper)


def servo_control(robot: Robot, torque, damping, q, dq):
    """Control signal that makes position servos kp (ctrl - q) - damping dq give `torque`."""
    return q + (torque + damping * dq) / robot.kp


def drive(robot: Robot, dynamics: Any, q, dq, target, xp: Any = jnp):
    """(motor torque, servos' control, servos' bias on joint speed) of one physics step, [..., 16].

    The last one belongs to `actuator_biasprm[..., SERVO_DAMPING]`.
    """
    torque = motor_torque(robot, dynamics, q, dq, target, xp)
    damping = motor_damping(robot, dynamics, q, dq, target, torque, xp)
    return torque, servo_control(robot, torque, damping, q, dq), -damping
