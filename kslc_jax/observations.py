"""Observations of actor and critic: frames, histories, noise and mirroring.

A table of components defines each frame. A frame is the concatenation of its components (paper,
Table II; order and scales of Humanoid-Gym). Training, evaluation and export all build frames here.
"""

import functools
from dataclasses import dataclass
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax.commands import Command
from kslc_jax.config import EnvConfig
from kslc_jax.gait import GaitState
from kslc_jax.randomize import Dynamics
from kslc_jax.robot import Robot
from kslc_jax.signals import Signals

Mirror = Literal["negate", "keep", "joints", "swap", "polar", "axial", "command"]

# Signs under mirroring in the sagittal plane. Polar vectors (velocities) flip y. Axial vectors
# (angular rates, roll-pitch-yaw) flip x and z. Commands are (vx, vy, yaw rate).
POLAR = (1, -1, 1)
_SIGNS = {"polar": POLAR, "axial": (-1, 1, -1), "command": (1, -1, -1)}

MASS_SCALE = 30.0
"""Mass [kg] of XBot-L's trunk that the critic sees as 1. It scales with the mass of a robot."""


@dataclass(frozen=True)
class Component:
    """One block of a frame.

    `noise` is a standard deviation, before `scale` and `noise_level`. `mirror` is the rule for the
    mirrored robot.
    """

    name: str
    width: int
    scale: tuple[float, ...] | float
    noise: float
    mirror: Mirror


Table = tuple[Component, ...]


@functools.lru_cache(maxsize=32)
def actor_table(robot: Robot) -> Table:
    """Components of the actor's frame: 11 + 3 n values for n joints, 59 for XBot-L."""
    n = robot.count
    return (
        Component("clock", 2, 1.0, 0.0, "negate"),
        Component("command", 3, (2.0, 2.0, 1.0), 0.0, "command"),
        Component("joint_pos", n, 1.0, 0.05, "joints"),
        Component("joint_vel", n, 0.05, 0.5, "joints"),
        Component("last_action", n, 1.0, 0.0, "joints"),
        Component("base_angvel", 3, 1.0, 0.1, "axial"),
        Component("base_euler", 3, 1.0, 0.03, "axial"),
    )


@functools.lru_cache(maxsize=32)
def critic_table(robot: Robot, memory: bool = False) -> Table:
    """Components of the critic's frame: 25 + 4 n values for n joints, 89 for XBot-L.

    On uneven ground that the critic sees there are four more. `memory` adds eight, see
    `EnvConfig.critic_memory`.
    """
    n = robot.count
    seen = robot.terrain is not None and robot.terrain.critic_sees
    ground = (
        Component("foot_ground", 2, 10.0, 0.0, "swap"),
        Component("slope", 2, 5.0, 0.0, "polar"),
    )
    remembered = (
        Component("wanted", 2, 2.0, 0.0, "polar"),
        Component("mean_error", 2, 2.0, 0.0, "polar"),
        Component("air_time", 2, 2.0, 0.0, "swap"),
        Component("swing_height", 2, 10.0, 0.0, "swap"),
    )
    return (
        Component("clock", 2, 1.0, 0.0, "negate"),
        Component("command", 3, (2.0, 2.0, 1.0), 0.0, "command"),
        Component("joint_pos", n, 1.0, 0.0, "joints"),
        Component("joint_vel", n, 0.05, 0.0, "joints"),
        Component("last_action", n, 1.0, 0.0, "joints"),
        Component("tracking_difference", n, 1.0, 0.0, "joints"),
        Component("base_linvel", 3, 2.0, 0.0, "polar"),
        Component("base_angvel", 3, 1.0, 0.0, "axial"),
        Component("base_euler", 3, 1.0, 0.0, "axial"),
        Component("push_linear", 2, 1.0, 0.0, "polar"),
        Component("push_angular", 3, 1.0, 0.0, "axial"),
        Component("friction", 1, 1.0, 0.0, "keep"),
        Component("base_mass", 1, 1.0 / (MASS_SCALE * robot.mass_ratio), 0.0, "keep"),
        Component("stance", 2, 1.0, 0.0, "swap"),
        Component("contact", 2, 1.0, 0.0, "swap"),
        *(ground if seen else ()),
        *(remembered if memory else ()),
    )


def width(table: Table) -> int:
    """Width of a frame: the number of its values."""
    return sum(c.width for c in table)


def actor_width(robot: Robot) -> int:
    """Width of the actor's frame."""
    return width(actor_table(robot))


def critic_width(robot: Robot, memory: bool = False) -> int:
    """Width of the critic's frame."""
    return width(critic_table(robot, memory))


def slices(table: Table) -> dict[str, slice]:
    """Slice of each component in its frame, by name."""
    ends = np.cumsum([c.width for c in table])
    return {c.name: slice(int(e) - c.width, int(e)) for c, e in zip(table, ends, strict=True)}


def row(table: Table, field: str) -> np.ndarray:
    """[W] the named field ("scale" or "noise") of the component that each value belongs to."""
    parts = [np.broadcast_to(getattr(c, field), (c.width,)) for c in table]
    return np.concatenate(parts).astype(np.float32)


@flax.struct.dataclass
class Sources:
    """Inputs from which frames are computed."""

    signals: Signals
    gait: GaitState
    command: Command
    dynamics: Dynamics
    reference: jax.Array  # [n] rad
    last_action: jax.Array  # [n]
    push: jax.Array  # [5] last push: m/s (x, y), rad/s (3)
    base_mass: jax.Array  # [] kg, mass of the trunk


def _values(src: Sources) -> dict[str, jax.Array]:
    """Unscaled value of every component, by name."""
    s = src.signals
    return s.ground | {
        "clock": src.gait.clock,
        "command": src.command.velocity,
        "joint_pos": s.joint_pos,
        "joint_vel": s.joint_vel,
        "last_action": src.last_action,
        "tracking_difference": s.joint_pos - src.reference,
        "base_linvel": s.base_linvel,
        "base_angvel": s.base_angvel,
        "base_euler": s.base_euler,
        "push_linear": src.push[:2],
        "push_angular": src.push[2:],
        "friction": src.dynamics.friction[None],
        "base_mass": src.base_mass[None],
        "stance": src.gait.stance.astype(jnp.float32),
        "contact": s.foot_contact.astype(jnp.float32),
        "wanted": src.command.wanted,
        "mean_error": src.gait.mean_error,
        "air_time": src.gait.air_time,
        "swing_height": src.gait.swing_height,
    }


def _frame(table: Table, src: Sources) -> jax.Array:
    """[W] the scaled components of the table, without noise."""
    values = _values(src)
    return jnp.concatenate([values[c.name] for c in table]) * row(table, "scale")


def actor_frame(config: EnvConfig, robot: Robot, src: Sources, key: jax.Array) -> jax.Array:
    """Actor frame [W] with noise, clipped. The noise is scaled like its component (HG)."""
    table = actor_table(robot)
    frame = _frame(table, src)
    level = config.noise_level * src.dynamics.noise
    scale = level * row(table, "noise") * row(table, "scale")
    frame = frame + scale * jax.random.normal(key, frame.shape)
    return jnp.clip(frame, -config.observation_clip, config.observation_clip)


def critic_frame(config: EnvConfig, robot: Robot, src: Sources) -> jax.Array:
    """Critic frame [W] without noise, clipped."""
    frame = _frame(critic_table(robot, config.critic_memory), src)
    return jnp.clip(frame, -config.observation_clip, config.observation_clip)


# ---------------------------------------------------------------------------------------- history


def append_frame(history: jax.Array, frame: jax.Array) -> jax.Array:
    """Appends `frame` [W] to `history` [K, W], and drops the oldest frame. Oldest first."""
    return jnp.concatenate([history[1:], frame[None]])


# ----------------------------------------------------------------------------------------- mirror


@functools.lru_cache(maxsize=32)
def mirror_map(table: Table, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """(permutation [W], sign [W]): frame[permutation] * sign is the frame of the mirrored robot."""
    joints, joint_sign = robot.anatomy.permutation, robot.anatomy.sign
    permutation, sign = np.arange(width(table)), np.ones(width(table), np.float32)
    for c in table:
        at = slices(table)[c.name]
        if c.mirror == "joints":
            permutation[at], sign[at] = at.start + np.asarray(joints), joint_sign
        elif c.mirror == "swap":
            permutation[at] = permutation[at][::-1].copy()
        elif c.mirror == "negate":
            sign[at] = -1
        elif c.mirror in _SIGNS:
            sign[at] = _SIGNS[c.mirror][: c.width]
    return permutation, sign
