"""What actor and critic see: tables of components -> widths, slices, noise, mirroring, history.

A frame is the concatenation of its table's components (paper, Table II; order and scales of
Humanoid-Gym). Training, evaluation and export all build frames here.
"""

import functools
from dataclasses import dataclass
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import robot as robot_lib
from kslc_jax.commands import Command
from kslc_jax.config import NUM_JOINTS, EnvConfig
from kslc_jax.gait import GaitState
from kslc_jax.randomize import Dynamics
from kslc_jax.signals import Signals

Mirror = Literal["negate", "keep", "joints", "swap", "polar", "axial", "command"]

# Signs under mirroring in the sagittal plane: polar vectors (velocities) flip y, axial ones (rates,
# roll-pitch-yaw) flip x and z. Commands are (vx, vy, yaw rate).
POLAR = (1, -1, 1)
_SIGNS = {"polar": POLAR, "axial": (-1, 1, -1), "command": (1, -1, -1)}

MASS_SCALE = 30.0


@dataclass(frozen=True)
class Component:
    """One block of a frame: its width, scale, noise (before noise_level), and mirror rule."""

    name: str
    width: int
    scale: tuple[float, ...] | float
    noise: float
    mirror: Mirror


ACTOR: tuple[Component, ...] = (
    Component("clock", 2, 1.0, 0.0, "negate"),
    Component("command", 3, (2.0, 2.0, 1.0), 0.0, "command"),
    Component("joint_pos", NUM_JOINTS, 1.0, 0.05, "joints"),
    Component("joint_vel", NUM_JOINTS, 0.05, 0.5, "joints"),
    Component("last_action", NUM_JOINTS, 1.0, 0.0, "joints"),
    Component("base_angvel", 3, 1.0, 0.1, "axial"),
    Component("base_euler", 3, 1.0, 0.03, "axial"),
)
CRITIC: tuple[Component, ...] = (
    Component("clock", 2, 1.0, 0.0, "negate"),
    Component("command", 3, (2.0, 2.0, 1.0), 0.0, "command"),
    Component("joint_pos", NUM_JOINTS, 1.0, 0.0, "joints"),
    Component("joint_vel", NUM_JOINTS, 0.05, 0.0, "joints"),
    Component("last_action", NUM_JOINTS, 1.0, 0.0, "joints"),
    Component("tracking_difference", NUM_JOINTS, 1.0, 0.0, "joints"),
    Component("base_linvel", 3, 2.0, 0.0, "polar"),
    Component("base_angvel", 3, 1.0, 0.0, "axial"),
    Component("base_euler", 3, 1.0, 0.0, "axial"),
    Component("push_linear", 2, 1.0, 0.0, "polar"),
    Component("push_angular", 3, 1.0, 0.0, "axial"),
    Component("friction", 1, 1.0, 0.0, "keep"),
    Component("base_mass", 1, 1.0 / MASS_SCALE, 0.0, "keep"),
    Component("stance", 2, 1.0, 0.0, "swap"),
    Component("contact", 2, 1.0, 0.0, "swap"),
)


def width(table: tuple[Component, ...]) -> int:
    """Numbers per frame."""
    return sum(c.width for c in table)


ACTOR_WIDTH = width(ACTOR)
CRITIC_WIDTH = width(CRITIC)


def slices(table: tuple[Component, ...]) -> dict[str, slice]:
    """Where each component lies in its frame."""
    ends = np.cumsum([c.width for c in table])
    return {c.name: slice(int(e) - c.width, int(e)) for c, e in zip(table, ends, strict=True)}


def row(table: tuple[Component, ...], field: str) -> np.ndarray:
    parts = [np.broadcast_to(getattr(c, field), (c.width,)) for c in table]
    return np.concatenate(parts).astype(np.float32)


@flax.struct.dataclass
class Sources:
    """Everything that frames are made of."""

    signals: Signals
    gait: GaitState
    command: Command
    dynamics: Dynamics
    reference: jax.Array  # [16] rad
    last_action: jax.Array  # [16]
    push: jax.Array  # [5] m/s and rad/s, the last push
    base_mass: jax.Array  # [] kg of the base link


def _values(src: Sources) -> dict[str, jax.Array]:
    """Unscaled value of every component, by name."""
    s = src.signals
    return {
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
    }


def _frame(table: tuple[Component, ...], src: Sources) -> jax.Array:
    values = _values(src)
    return jnp.concatenate([values[c.name] for c in table]) * row(table, "scale")


def actor_frame(config: EnvConfig, src: Sources, key: jax.Array) -> jax.Array:
    """Noisy actor frame [59]; noise is scaled with its component, as in HG."""
    frame = _frame(ACTOR, src)
    level = config.noise_level * src.dynamics.noise
    scale = level * row(ACTOR, "noise") * row(ACTOR, "scale")
    frame = frame + scale * jax.random.normal(key, frame.shape)
    return jnp.clip(frame, -config.observation_clip, config.observation_clip)


def critic_frame(config: EnvConfig, src: Sources) -> jax.Array:
    """Privileged frame [89], without noise."""
    frame = _frame(CRITIC, src)
    return jnp.clip(frame, -config.observation_clip, config.observation_clip)


# ---------------------------------------------------------------------------------------- history


def append_frame(history: jax.Array, frame: jax.Array) -> jax.Array:
    """Appends `frame` [W] to `history` [K, W], oldest first."""
    return jnp.concatenate([history[1:], frame[None]])


# ----------------------------------------------------------------------------------------- mirror


@functools.lru_cache(maxsize=8)
def mirror_map(table: tuple[Component, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(permutation, sign) such that frame[permutation] * sign is the mirrored robot's frame."""
    joints, joint_sign = robot_lib.mirror_joints()
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
