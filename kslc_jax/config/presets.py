"""Named configs, and the paper's ablations, which can change any of them."""

import dataclasses
import difflib
from typing import Any

from kslc_jax.config.checks import ConfigError
from kslc_jax.config.schema import Config


def _override(config: Any, **changes: Any) -> Any:
    """Like `dataclasses.replace`; a dict replaces fields of a nested config."""
    new = {
        name: _override(getattr(config, name), **value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return dataclasses.replace(config, **new)


# Fields of `Config` have the values of its oldest files. Elliptic cones came later
# (docs/fidelity_physics.md).
_PAPER = _override(Config(), physics={"cone": "elliptic", "iterations": 5, "ls_iterations": 20})

# Humanoid-Gym as the paper's baseline: fixed rewards, held arms, no KSLC terms, a fixed gait cycle,
# and commands up to the paper's top speed from the start.
_BASELINE = _override(
    _PAPER,
    env={"arms": "held"},
    rewards={"velocity_rewards": False, "weights": {"angular_momentum": 0.0}},
    curriculum={"velocity": False, "cycle": False, "v_start": 3.5},
)

# Learns fast on two CPU cores. docs/laptop_recipe.md explains each change.
_LAPTOP_LEARNER: dict[str, Any] = {
    "env": {"num_envs": 2048, "frames": 5},
    "network": {
        "actor": (384, 192, 96),
        "critic": (256, 128, 64),
        "init_std": 0.6,
        "init_mean": 0.01,
        "symmetric": True,
        "even_inputs": True,
    },
    "ppo": {
        "rollout_steps": 24,
        "minibatches": 4,
        "epochs": 5,
        "entropy_coef": 0.003,
        "learning_rate": 1e-3,
        "learning_rate_bounds": (1e-5, 1e-3),
    },
    "run": {"steps": 60_000_000},
}

_LAPTOP = _override(
    _override(_PAPER, **_LAPTOP_LEARNER),
    env={"critic_memory": True, "least_torque": 0.15},
    network={"estimator": (128, 64)},
    ppo={"entropy_fades": True, "average": 0.98, "value_per_command": True},
    command={
        "shortest_seconds": 1.0,
        "acceleration": 2.0,
        "stand_fraction": 0.15,
        "forward_fraction": 0.2,
        "slow_fraction": 0.15,
        "top_fraction": 0.15,
        "brake_fraction": 0.3,
        "narrow_speed": 4.0,
        "stand_still": True,
    },
    gait={
        "double_support_at_speed": -0.4,
        "reference_speed_gain": 1.0,
        "stride_sweep": 0.35,
        "arm_swing": 0.38,
        "arm_swing_slow": 0.25,
        "elbow_bend": 1.0,
        "cycle_from_speed": 0.5,
        "random_phase": True,
    },
    curriculum={
        "settle_seconds": 2.0,
        "v_limit": 4.0,
        "gait_threshold": 0.75,
        "top_error": 0.05,
        "top_error_from": 1.75,
        "top_error_floor": 3.0,
        "top_falls": 1.0,
        "falls_after": 4.0,
        "cycle_factor": 0.94,
        "cycle_min": 0.38,
    },
    randomize={
        "base_com": (-0.02, 0.02),
        "kp": (0.9, 1.1),
        "kd": (0.9, 1.1),
        "motor_strength": (0.9, 1.0),
        "joint_friction": (0.0, 1.0),
        "link_mass": (0.9, 1.1),
        "link_com": (-0.01, 0.01),
        "hand_mass": (0.0, 0.5),
        "sole": (0.0, 0.02),
        "punch": (0.0, 200.0),
        "noise": (0.0, 1.0),
    },
    rewards={
        "momentum_scale": 3.0,
        "base_height_kernel": 30.0,
        "base_height_drop": 0.0,
        "clearance_width": 0.03,
        "clearance_mid_swing": True,
        "clearance_speed_gain": 0.5,
        "max_contact_force": 1400.0,
        "lateral_distance": True,
        "feet_distance": (0.17, 0.5),
        "knee_distance": (0.17, 0.25),
        "lean_per_speed": 0.03,
        "default_pose_margin": 0.15,
        "fall": 5.0,
        "exact_full": 2.0,
        "shuffle": 2.0,
        "weights": {
            "feet_contact_number": 3.0,
            "feet_clearance": 0.7,
            "base_height": 0.5,
            "tracking_lin_vel": 2.0,
            "track_vel_hard": 0.8,
            "tracking_mean_vel": 4.0,
            "tracking_ang_vel": 1.5,
            "dof_acc": -3e-7,
            "dof_vel_limits": -10.0,
            "stand_still": -1.0,
        },
    },
)

_DEBUG = _override(
    _LAPTOP,
    env={"num_envs": 16, "frames": 3},
    network={"actor": (32, 16), "critic": (32, 16), "estimator": (16,)},
    ppo={"rollout_steps": 8, "minibatches": 2, "epochs": 2},
    run={"steps": 1024, "checkpoint_minutes": 0.05},
)

PRESETS: dict[str, Config] = {
    "paper": _PAPER,
    "laptop": _LAPTOP,
    "debug": _DEBUG,
    "baseline": _BASELINE,
    "baseline-laptop": _override(_BASELINE, **_LAPTOP_LEARNER),
}

# The paper's ablations: one switch each, for any preset. With held arms the gait's reference must
# not move the arms. They could not follow it, and their error in the norm of Eq. 8 would take most
# of the reward from legs that follow their reference.
ABLATIONS: dict[str, dict[str, Any]] = {
    "arms": {
        "env": {"arms": "held"},
        "gait": {"arm_swing": 0.0, "arm_swing_slow": 0.0, "elbow_bend": 0.0},
    },
    "angular-momentum": {"rewards": {"weights": {"angular_momentum": 0.0}}},
    "velocity-rewards": {"rewards": {"velocity_rewards": False}},
    "velocity-curriculum": {"curriculum": {"velocity": False, "v_start": 3.5}},
    "cycle-curriculum": {"curriculum": {"cycle": False}},
}


def _lookup(kind: str, name: str, table: dict[str, Any]) -> Any:
    """The named entry; ConfigError with the closest known name if there is none."""
    if name in table:
        return table[name]
    close = difflib.get_close_matches(name, table, n=1)
    hint = f", did you mean {close[0]!r}?" if close else ""
    raise ConfigError(f"unknown {kind} {name!r}{hint} (known: {', '.join(table)})")


def preset(name: str, without: tuple[str, ...] = ()) -> Config:
    """The named preset with the ablations in `without` applied; ConfigError on unknown names."""
    config = _lookup("preset", name, PRESETS)
    for part in without:
        config = _override(config, **_lookup("ablation", part, ABLATIONS))
    return config
