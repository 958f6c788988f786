"""Hand-made states: one robot that stands upright at rest, with named changes."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import curriculum, networks, observations, robot
from kslc_jax.commands import Command
from kslc_jax.config import Config
from kslc_jax.gait import GaitState
from kslc_jax.policy import Policy
from kslc_jax.signals import Signals

BIPED = str(Path(__file__).parent / "data" / "biped.toml")
"""A small biped that differs from XBot-L in all that code may take for granted."""

XBOT = robot.load()
ACTOR, CRITIC = observations.actor_table(XBOT), observations.critic_table(XBOT)
MIRROR = XBOT.anatomy.permutation, XBOT.anatomy.sign
"""q[MIRROR[0]] * MIRROR[1] is the mirrored joint vector of XBot-L."""


def _fill(cls: type, defaults: dict[str, Any], changes: dict[str, Any]) -> Any:
    unknown = set(changes) - {f.name for f in dataclasses.fields(cls)}
    assert not unknown, f"{cls.__name__} has no {unknown}"
    return cls(**{name: _array(value) for name, value in {**defaults, **changes}.items()})


def _array(value: Any) -> Any:
    value = np.asarray(value)
    return jnp.asarray(value, bool if value.dtype == bool else jnp.float32)


def make_signals(**changes: Any) -> Signals:
    """Base height 0.89 m, feet 0.3 m and knees 0.22 m apart, both feet on the ground."""
    defaults = dict(
        joint_pos=np.zeros(16),
        joint_vel=np.zeros(16),
        torque=np.zeros(16),
        base_pos=[0.0, 0.0, 0.89],
        base_euler=np.zeros(3),
        base_linvel=np.zeros(3),
        base_angvel=np.zeros(3),
        base_velocity=np.zeros(6),
        gravity=[0.0, 0.0, -1.0],
        foot_pos=[[0.0, 0.15, 0.05], [0.0, -0.15, 0.05]],
        foot_vel=np.zeros((2, 3)),
        knee_pos=[[0.0, 0.11, 0.4], [0.0, -0.11, 0.4]],
        foot_force=[260.0, 260.0],
        foot_contact=[True, True],
        angular_momentum=np.zeros(3),
        torso_contact=False,
    )
    return _fill(Signals, defaults, changes)


def make_gait(**changes: Any) -> GaitState:
    """Phase 0: the clock has both feet on the ground, and both feet touch it."""
    defaults = dict(
        phase=0.0,
        contact=[True, True],
        lift_z=[0.05, 0.05],
        air_time=[0.0, 0.0],
        landed_air_time=[0.0, 0.0],
        swing_height=[0.0, 0.0],
        mean_error=[0.0, 0.0],
        stance=[True, True],
        clock=[0.0, 1.0],
    )
    return _fill(GaitState, defaults, changes)


def make_command(**changes: Any) -> Command:
    """Zero velocity; the clock runs."""
    start = dict(velocity=np.zeros(3), heading=0.0, moving=True, wanted=np.zeros(2), turns=True)
    if "velocity" in changes:  # the wanted one, unless the test names another
        start["wanted"] = np.asarray(changes["velocity"])[:2]
    return _fill(Command, start, changes)


def random_params(config: Config, scale: float = 1.0) -> networks.Params:
    """Random parameters, also biases. `networks.init` would compile dozens of small programs."""
    shapes = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
    rng = np.random.default_rng(0)

    def draw(x: jax.ShapeDtypeStruct) -> np.ndarray:
        fan_in = x.shape[0] if len(x.shape) == 2 else 4.0
        return (scale * rng.normal(size=x.shape) / np.sqrt(fan_in)).astype(x.dtype)

    return jax.tree.map(draw, shapes)


def still_policy(config: Config, step: int = 0) -> Policy:
    """A policy that asks for the default pose whatever it sees."""
    shapes = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
    params = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    return Policy(config, params, curriculum.init(config), step)


def joints(**values: float) -> np.ndarray:
    """Joint vector [16] with the given values at the named joints; the order is typed by hand."""
    order = [
        *("left_leg_roll", "left_leg_yaw", "left_leg_pitch", "left_knee"),
        *("left_ankle_pitch", "left_ankle_roll"),
        *("right_leg_roll", "right_leg_yaw", "right_leg_pitch", "right_knee"),
        *("right_ankle_pitch", "right_ankle_roll"),
        *("left_shoulder_pitch", "left_elbow_pitch", "right_shoulder_pitch", "right_elbow_pitch"),
    ]
    out = np.zeros(16)
    for name, value in values.items():
        out[order.index(name)] = value
    return out
