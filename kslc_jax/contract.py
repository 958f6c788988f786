"""The files that a deployer needs beside the network: data, the robot's model, a golden trace.

A golden trace holds measurements, and the actions and joint targets that this package computes from
them. A program for a robot's computer that computes other targets is wrong. examples/check_trace.py
finds the first difference.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kslc_jax import __version__, files

if TYPE_CHECKING:
    from kslc_jax.policy import Policy

METADATA_VERSION = 5
"""Version of `metadata`; it grows when a name or its meaning changes."""

TRACE_SECONDS = 10.0
"""Length of each golden trial."""

SHARES = (0.0, 0.25, 0.5)
"""Commanded speeds of the golden trials, as shares of v_max."""

SIDEWAYS, HEADING = 0.1, 0.3
"""Commanded sideways velocity [m/s] and heading [rad] of the second golden trial."""


def paths(out: Path) -> list[Path]:
    """The files beside `out`: the data (.json), the robot (.xml) and a golden trace (.npz)."""
    return [out.with_suffix(suffix) for suffix in (".json", ".xml", ".npz")]


def write(policy: Policy, out: Path) -> list[Path]:
    """Writes the files beside `out`, which is there already; returns `paths`.

    The data have more than `metadata`: the robot, its joints' ranges [rad], the latency budget [s],
    and checksums, by which one sees if four files belong together.
    """
    data, model, trace = beside = paths(out)
    with files.saving(model) as part:
        part.write_text(mjcf(policy), encoding="utf-8")
    numbers: dict[str, Any] = golden(policy)
    with files.saving(trace) as part:
        np.savez_compressed(part, **numbers)
    files.write_json(data, metadata(policy) | _facts(policy) | {"sha256": checksums(out)})
    return beside


def _facts(policy: Policy) -> dict[str, Any]:
    from kslc_jax import physics

    robot = physics.robot_for(policy.config.physics)
    return {
        "robot": robot.name,
        "joint_lower": robot.joint_lower.tolist(),
        "joint_upper": robot.joint_upper.tolist(),
        "latency_budget": policy.config.env.action_delay * policy.config.control_dt,
    }


def checksums(out: Path) -> dict[str, str]:
    """SHA-256 of `out` and of the files beside it, without the data, by their suffix."""
    there = [out, *(path for path in paths(out) if path.suffix != ".json")]
    return {path.suffix: hashlib.sha256(path.read_bytes()).hexdigest() for path in there}


def metadata(policy: Policy) -> dict[str, Any]:
    """The data that a program needs to run the network. SI units, joints in action order.

    All values can be written as JSON.
    """
    from kslc_jax import commands, motors, observations, physics

    config, robot = policy.config, physics.robot_for(policy.config.physics)
    table = observations.actor_table(robot)
    held = robot.is_arm & (config.env.arms == "held")
    return {
        "metadata_version": METADATA_VERSION,
        "kslc_jax_version": __version__,
        "train_step": policy.step,
        "control_dt": config.control_dt,
        "joint_names": list(robot.joint_names),
        "default_joint_pos": robot.default_qpos[7:].tolist(),
        "kp": robot.kp.tolist(),
        "kd": robot.kd.tolist(),
        "effort_limit": robot.effort_limit.tolist(),
        "speed_limit": robot.speed_limit.tolist(),
        "corner_speed": motors.CORNER_SPEED,
        "action_scale": motors.action_scale(config.env, robot).tolist(),
        "action_clip": config.env.action_clip,
        "held_joints": [name for name, h in zip(robot.joint_names, held, strict=True) if h],
        "history_length": config.env.frames,
        "observation_clip": config.env.observation_clip,
        "frame": [{"name": c.name, "width": c.width, "scale": c.scale} for c in table],
        "gait": {
            "cycle_time": float(policy.curriculum.cycle_time),
            "v_max": float(policy.curriculum.v_max),
            "cycle_follows_speed": config.gait.cycle_follows_speed,
            "base_cycle_time": config.gait.cycle_time,
            "cycle_from_speed": config.gait.cycle_from_speed,
            "cycle_factor": config.curriculum.cycle_factor,
            "speed_step": config.curriculum.v_step,
        },
        "command": {
            "dead_zone": config.command.dead_zone,
            "acceleration": config.command.acceleration,
            "heading_gain": config.command.heading_gain,
            "max_yaw_rate": config.command.max_yaw_rate,
            "stand_still": config.command.stand_still,
            "turning": commands.TURNING,
        },
    }


def mjcf(policy: Policy) -> str:
    """The text of an MJCF: the training model of the policy's robot, with the policy's physics."""
    from kslc_jax import physics
    from kslc_jax.robots import build, description

    spec = build.spec(description.read(policy.config.physics.robot), "train")
    trained = physics.robot_for(policy.config.physics).mj_model.opt
    for name in ("timestep", "cone", "iterations", "ls_iterations"):
        setattr(spec.option, name, getattr(trained, name))
    spec.compile()
    return spec.to_xml()


def _golden_commands(v_max: float) -> np.ndarray:
    """[R, 3] vx, vy [m/s], heading [rad]."""
    speeds, second = np.asarray(SHARES) * v_max, np.arange(len(SHARES)) == 1
    return np.stack([speeds, SIDEWAYS * second, HEADING * second], axis=1).astype(np.float32)


def golden(policy: Policy, seconds: float = TRACE_SECONDS) -> dict[str, np.ndarray]:
    """Records R golden trials in the training's engine, each under one constant command.

    The robot starts in its home pose, without noise or delay. A trial ends when the robot falls.

    Returns:
      command [R, 3]: vx, vy [m/s], heading [rad, world]; phase [R]: of the gait clock, before the
      first control step; steps [R]: control steps of each trial. For each control step [R, T, ...],
      NaN after a trial's end: quat [4], angvel [3] (rad/s, base frame), joint_pos [n] (rad),
      joint_vel [n] (rad/s), frame [W], action [n] (clipped, 0 for held joints), target [n] (rad).
    """
    import jax
    import jax.numpy as jnp

    from kslc_jax import env, motors, physics
    from kslc_jax.evaluation import trials

    setting = trials.Setting(trials.engine(policy, "train"))  # on the flat floor
    config = trials.trial_config(policy.config, setting, len(SHARES))
    config = trials.without_joint_noise(config)
    robot = physics.robot_for(config.physics)
    home = jnp.asarray(robot.default_qpos[7:], jnp.float32)
    commands = _golden_commands(float(policy.curriculum.v_max))

    def one(carry: tuple[env.EnvState, jax.Array], _: None):
        state, alive = carry
        before = state.physics
        key = jax.random.key(0)  # nothing is random
        new, out = env.step(config, state, policy.act_on(state.history), key, policy.curriculum)
        alive = alive & ~out.terminated
        row = {
            "quat": before.qpos[3:7],
            "angvel": before.qvel[3:6],
            "joint_pos": before.qpos[7:],
            "joint_vel": before.qvel[6:],
            "frame": state.history[-1],
            "action": new.last_action,
            "target": home + motors.action_scale(config.env, robot) * new.last_action,
        }
        return (new, alive), jax.tree.map(lambda x: jnp.where(alive, x, jnp.nan), row)

    def trial(command: jax.Array, key: jax.Array):
        state = env.reset(config, key, policy.curriculum)
        state = trials.facing_command(config, state, command)
        steps = round(seconds / config.control_dt)
        begin = state, jnp.ones((), bool)
        _, rows = jax.lax.scan(one, begin, None, steps)
        return state.gait.phase, rows

    keys = jax.random.split(jax.random.key(0), len(SHARES))
    phase, rows = jax.jit(jax.vmap(trial))(commands, keys)
    rows = jax.tree.map(np.asarray, rows)
    steps = np.isfinite(rows["target"]).all(axis=-1).sum(axis=1)
    return {"command": commands, "phase": np.asarray(phase), "steps": steps, **rows}
