"""Every reward term against numbers worked out by hand. Unclear equations of the paper are tested
as printed and as this package reads them."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from states import CRITIC, MIRROR, joints, make_command, make_gait, make_signals

from kslc_jax import ppo, rewards, robot
from kslc_jax.commands import Command
from kslc_jax.config import PPOConfig, RewardConfig, RewardWeights, preset
from kslc_jax.gait import GaitState
from kslc_jax.signals import Signals

DT = 0.01
KSLC = preset("paper").rewards
HG = preset("baseline").rewards
LATERAL = dataclasses.replace(KSLC, lateral_distance=True)
MID_SWING = dataclasses.replace(KSLC, clearance_mid_swing=True)
LEAN = dataclasses.replace(KSLC, lean_per_speed=0.1)
LOOSE = dataclasses.replace(
    KSLC, momentum_scale=10.0, clearance_width=0.03, base_height_kernel=30.0
)

# Humanoid-Gym's table, typed in by hand.
HUMANOID_GYM = {
    "joint_pos": 1.6,
    "feet_clearance": 1.0,
    "feet_contact_number": 1.2,
    "feet_air_time": 1.0,
    "foot_slip": -0.05,
    "feet_distance": 0.2,
    "knee_distance": 0.2,
    "feet_contact_forces": -0.01,
    "tracking_lin_vel": 1.2,
    "tracking_ang_vel": 1.1,
    "vel_mismatch_exp": 0.5,
    "low_speed": 0.2,
    "track_vel_hard": 0.5,
    "default_joint_pos": 0.5,
    "orientation": 1.0,
    "base_height": 0.2,
    "base_acc": 0.2,
    "action_smoothness": -0.002,
    "torques": -1e-5,
    "dof_vel": -5e-4,
    "dof_acc": -1e-7,
    "collision": -1.0,
}


def names(cls: type) -> set[str]:
    return {f.name for f in dataclasses.fields(cls)}


def make_inputs(**changes: Any) -> rewards.Inputs:
    """Inputs of a robot that stands at rest under a zero command, with named changes.

    `vx` is the commanded forward speed. Other names are fields of signals, gait, command or Inputs.
    """
    if "vx" in changes:
        changes["velocity"] = [changes.pop("vx"), 0.0, 0.0]

    def take(cls: type) -> dict[str, Any]:
        return {n: changes.pop(n) for n in names(cls) & set(changes)}

    parts = (
        make_signals(**take(Signals)),
        make_gait(**take(GaitState)),
        make_command(**take(Command)),
    )
    rest = dict(
        reference=np.zeros(16),
        action=np.zeros(16),
        last_action=np.zeros(16),
        last_last_action=np.zeros(16),
        last_joint_vel=np.zeros(16),
        last_base_velocity=np.zeros(6),
        v_max=3.5,
    )
    assert set(changes) <= set(rest), f"unknown: {set(changes) - set(rest)}"
    arrays = {name: jnp.asarray(value, jnp.float32) for name, value in {**rest, **changes}.items()}
    return rewards.Inputs(*parts, **arrays)


@functools.partial(jax.jit, static_argnums=0)
def evaluate(cfg: RewardConfig, x: rewards.Inputs):
    return rewards.evaluate(cfg, robot.load(), DT, x)


def value(cfg: RewardConfig, term: str, x: rewards.Inputs) -> float:
    return float(rewards.TERMS[term](cfg, robot.load(), DT, x))


# term, config, changes, expected. e^-1 = 0.367879, e^-2 = 0.135335, e^-5 = 0.006738.
CASES: list[tuple[str, RewardConfig, dict[str, Any], float]] = [
    # |L| = 5, scale 5: 1 - e^1; |L| = 15: 1 - e^3; |L| = 100: 1 - e^20, floor -20.
    ("angular_momentum", KSLC, {}, 0.0),
    ("angular_momentum", KSLC, {"angular_momentum": [3.0, 0.0, 4.0]}, -1.7182818),
    ("angular_momentum", KSLC, {"angular_momentum": [0.0, -15.0, 0.0]}, -19.085537),
    ("angular_momentum", KSLC, {"angular_momentum": [0.0, 0.0, 100.0]}, -20.0),
    ("angular_momentum", KSLC, {"angular_momentum": [0.0, 0.0, 1e6]}, -20.0),
    # |L| = 5, scale 10: 1 - e^0.5.
    ("angular_momentum", LOOSE, {"angular_momentum": [3.0, 0.0, 4.0]}, -0.64872127),
    # Feet at 0.05: height is base z. Error 0.01: e^-1.
    ("base_height", KSLC, {}, 1.0),
    ("base_height", KSLC, {"base_pos": [5.0, 5.0, 0.90]}, 0.36787944),
    # g = 0.5: target 0.89 (1 - 0.05 / 2) = 0.86775, error 0.01; backwards the same.
    ("base_height", KSLC, {"vx": 1.75, "base_pos": [0, 0, 0.87775]}, 0.36787944),
    ("base_height", KSLC, {"vx": -1.75, "base_pos": [0, 0, 0.87775]}, 0.36787944),
    # g is |vx| divided by v_max: 1 / 2.
    ("base_height", KSLC, {"vx": 1.0, "v_max": 2.0, "base_pos": [0, 0, 0.85775]}, 0.36787944),
    # g at most 1: target 0.8455.
    ("base_height", KSLC, {"vx": 5.0, "base_pos": [0, 0, 0.8455]}, 1.0),
    # Kernel 30, error 0.1: e^-3.
    ("base_height", LOOSE, {"base_pos": [0, 0, 0.79]}, 0.04978707),
    # Fixed target: error 0.01225, e^-1.225.
    ("base_height", HG, {"vx": 1.75, "base_pos": [0, 0, 0.87775]}, 0.29375770),
    # In flight the height is measured from the floor; the feet do not matter.
    (
        "base_height",
        HG,
        {"stance": [False, False], "foot_pos": [[0, 0.15, 0.2], [0, -0.15, 0.3]]},
        1.0,
    ),
    # A swing foot in the air does not count; two stance feet give the mean: 0.06 - 0.05 = 0.01.
    (
        "base_height",
        HG,
        {"stance": [True, False], "foot_pos": [[0, 0.15, 0.05], [0, -0.15, 0.3]]},
        1.0,
    ),
    (
        "base_height",
        HG,
        {"foot_pos": [[0, 0.15, 0.05], [0, -0.15, 0.07]], "base_pos": [0, 0, 0.91]},
        0.36787944,
    ),
    # Only swing feet count. Target 0.06 (1 + g), width 0.01.
    ("feet_clearance", KSLC, {"swing_height": [0.06, 0.06]}, 0.0),
    ("feet_clearance", KSLC, {"swing_height": [0.06, 0.06], "stance": [False, True]}, 1.0),
    ("feet_clearance", KSLC, {"swing_height": [0.06, 0.05], "stance": [True, False]}, 0.36787944),
    ("feet_clearance", KSLC, {"swing_height": [0.06, 0.07], "stance": [False] * 2}, 1.36787944),
    # g = 1: 0.12; g = 0.5: 0.09.
    (
        "feet_clearance",
        KSLC,
        {"vx": 3.5, "swing_height": [0.11, 0], "stance": [False, True]},
        0.36787944,
    ),
    (
        "feet_clearance",
        KSLC,
        {"vx": 1.75, "swing_height": [0.10, 0], "stance": [False, True]},
        0.36787944,
    ),
    ("feet_clearance", KSLC, {"swing_height": [1.0, 0], "stance": [False, True]}, 0.0),
    # Width 0.03, error 0.03.
    ("feet_clearance", LOOSE, {"swing_height": [0.09, 0], "stance": [False, True]}, 0.36787944),
    # At mid-swing sin = -1: 2 x 1. A twelfth of a cycle after touchdown of the other foot sin =
    # 0.5: 2 x 0.25. At lift-off sin = 0: 0.
    (
        "feet_clearance",
        MID_SWING,
        {"swing_height": [0.06, 0], "stance": [False, True], "clock": [-1.0, 0.0]},
        2.0,
    ),
    (
        "feet_clearance",
        MID_SWING,
        {"swing_height": [0, 0.07], "stance": [True, False], "clock": [0.5, 0.8660254]},
        0.5 * 0.36787944,
    ),
    (
        "feet_clearance",
        MID_SWING,
        {"swing_height": [0.06, 0], "stance": [False, True], "clock": [0.0, 1.0]},
        0.0,
    ),
    # HG: a window of +-0.01 around 0.06 at every speed.
    ("feet_clearance", HG, {"swing_height": [0.069, 0], "stance": [False, True]}, 1.0),
    ("feet_clearance", HG, {"swing_height": [0.071, 0], "stance": [False, True]}, 0.0),
    ("feet_clearance", HG, {"swing_height": [0.049, 0], "stance": [False, True]}, 0.0),
    (
        "feet_clearance",
        HG,
        {"vx": 3.5, "swing_height": [0.055, 0.06], "stance": [False] * 2},
        2.0,
    ),
    # n = 0.5: e^-1 - 0.2 * 0.5; n = 1: e^-2 - 0.2 * 0.5 (clip); n = 0.25: e^-0.5 - 0.05.
    ("joint_pos", HG, {}, 1.0),
    ("joint_pos", HG, {"joint_pos": joints(left_knee=0.3, right_elbow_pitch=-0.4)}, 0.26787944),
    ("joint_pos", HG, {"joint_pos": joints(left_knee=0.6, right_knee=0.8)}, 0.03533528),
    ("joint_pos", HG, {"joint_pos": joints(left_knee=0.15, right_knee=0.2)}, 0.55653066),
    (
        "joint_pos",
        HG,
        {"joint_pos": joints(left_knee=-0.1), "reference": joints(left_knee=-0.6)},
        0.26787944,
    ),
    (
        "joint_pos",
        HG,
        {"joint_pos": joints(left_knee=0.5), "joint_vel": np.full(16, 9.0)},
        0.26787944,
    ),
    # KSLC at rest equals HG. At the speed limit (legs 12, arms 7 rad/s) the error counts e^-1:
    # n = 0.5 * 0.367879 = 0.183940; e^(-2 n) - 0.2 n = 0.692201 - 0.036788.
    ("joint_pos", KSLC, {"joint_pos": joints(left_knee=0.3, right_knee=0.4)}, 0.26787944),
    (
        "joint_pos",
        KSLC,
        {"joint_pos": joints(left_knee=0.5), "joint_vel": joints(left_knee=-12.0)},
        0.65541268,
    ),
    (
        "joint_pos",
        KSLC,
        {"joint_pos": joints(left_elbow_pitch=0.5), "joint_vel": joints(left_elbow_pitch=7.0)},
        0.65541268,
    ),
    (  # the speed of another joint does not matter
        "joint_pos",
        KSLC,
        {"joint_pos": joints(left_knee=0.5), "joint_vel": joints(right_knee=12.0)},
        0.26787944,
    ),
    # e^2 = 0.1^2 + 0.2^2 = 0.05: e^-0.25. Vertical speed does not count.
    (
        "tracking_lin_vel",
        KSLC,
        {"velocity": [1.0, 0.5, 0.3], "base_linvel": [1.1, 0.3, 2.0]},
        0.77880078,
    ),
    # e^2 = 0.04: e^-0.2.
    (
        "tracking_ang_vel",
        KSLC,
        {"velocity": [1.0, 0.5, 0.5], "base_angvel": [1.0, 2.0, 0.3]},
        0.81873075,
    ),
    # vz 0.2: e^-0.4 = 0.670320; |w_xy| 0.5: e^-2.5 = 0.082085; mean.
    (
        "vel_mismatch_exp",
        KSLC,
        {"base_linvel": [3.0, 3.0, -0.2], "base_angvel": [0.3, 0.4, 5.0]},
        0.37620252,
    ),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [0.9, 0, 0]}, -1.0),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [1.1, 0, 0]}, 1.2),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [2.3, 0, 0]}, 1.2),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [2.5, 0, 0]}, 0.0),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [-2.0, 0, 0]}, -2.0),
    ("low_speed", KSLC, {"vx": 2.0, "base_linvel": [0.0, 2.0, 0]}, -2.0),
    ("low_speed", KSLC, {"vx": -0.3, "base_linvel": [-0.3, 0, 0]}, 1.2),
    ("low_speed", KSLC, {"vx": -0.3, "base_linvel": [-0.1, 0, 0]}, -1.0),
    ("low_speed", KSLC, {"vx": 0.05, "base_linvel": [-1.0, 0, 0]}, 0.0),
    ("low_speed", KSLC, {"velocity": [0.0, 0.3, 0.0], "base_linvel": [1.0, 0, 0]}, 0.0),
    # The mean error counts, not the present one. It is |(0.06, -0.08)| = 0.1: e^-1.
    (
        "tracking_mean_vel",
        KSLC,
        {"velocity": [1.0, 0, 0.5], "mean_error": [0.06, -0.08], "base_linvel": [9, 9, 9]},
        0.36787944,
    ),
    # v_max half way from 0.5 to 2.5 m/s: 0.5. At the start of the curriculum: 0.
    ("tracking_mean_vel", KSLC, {"v_max": 1.5}, 0.5),
    ("tracking_mean_vel", KSLC, {"v_max": 0.5}, 0.0),
    # e_xy = 0.5, e_yaw = 0.2: (e^-5 + e^-2) / 2 - 0.2 * 0.7 = 0.0710366 - 0.14.
    (
        "track_vel_hard",
        KSLC,
        {
            "velocity": [1.0, 0.0, 0.5],
            "base_linvel": [0.7, 0.4, 9.0],
            "base_angvel": [9.0, 9.0, 0.3],
        },
        -0.06896338,
    ),
    ("track_vel_hard", KSLC, {}, 1.0),
    ("feet_contact_number", KSLC, {}, 1.0),
    ("feet_contact_number", KSLC, {"stance": [True, False], "foot_contact": [True, True]}, 0.35),
    ("feet_contact_number", KSLC, {"stance": [True, False], "foot_contact": [False, True]}, -0.3),
    ("feet_air_time", KSLC, {"landed_air_time": [0.3, 0.0]}, 0.3),
    ("feet_air_time", KSLC, {"landed_air_time": [0.7, 0.2]}, 0.7),  # 0.5 + 0.2
    # sqrt(0.5) for the left foot; with the right foot in contact too, sqrt(1) more.
    (
        "foot_slip",
        KSLC,
        {"foot_vel": [[0.3, 0.4, 5.0], [0.6, 0.8, 0.0]], "foot_contact": [True, False]},
        0.70710678,
    ),
    ("foot_slip", KSLC, {"foot_vel": [[0.3, 0.4, 5.0], [0.6, 0.8, 0.0]]}, 1.70710678),
    ("feet_contact_forces", KSLC, {"foot_force": [900.0, 650.0]}, 200.0),
    ("feet_contact_forces", KSLC, {"foot_force": [1200.0, 701.0]}, 401.0),
    # 0.05 too close or too far: (e^-5 + 1) / 2. Height does not count.
    ("feet_distance", KSLC, {}, 1.0),
    ("feet_distance", KSLC, {"foot_pos": [[0, 0.1, 0.05], [0, -0.05, 0.05]]}, 0.50336897),
    ("feet_distance", KSLC, {"foot_pos": [[0, 0.3, 0.05], [0, -0.25, 0.05]]}, 0.50336897),
    ("feet_distance", KSLC, {"foot_pos": [[0.3, 0.2, 0.05], [0, -0.2, 0.4]]}, 1.0),
    # 0.6 ahead and 0.3 sideways: 0.6708 in the plane, (1 + e^-17.08) / 2; 0.3 lateral, 1.
    ("feet_distance", KSLC, {"foot_pos": [[0.6, 0.15, 0.05], [0, -0.15, 0.05]]}, 0.50000002),
    ("feet_distance", LATERAL, {"foot_pos": [[0.6, 0.15, 0.05], [0, -0.15, 0.05]]}, 1.0),
    # Heading +y: sideways is the x axis.
    (
        "feet_distance",
        LATERAL,
        {"foot_pos": [[-0.3, 0.6, 0.05], [0, 0, 0.05]], "base_euler": [0, 0, np.pi / 2]},
        1.0,
    ),
    (
        "feet_distance",
        LATERAL,
        {"foot_pos": [[-0.15, 0.6, 0.05], [0, 0, 0.05]], "base_euler": [0, 0, np.pi / 2]},
        0.50336897,
    ),
    # Heading 45 degrees to the left: sideways is (-1, 1) / sqrt 2.
    (
        "feet_distance",
        LATERAL,
        {"foot_pos": [[-0.212132, 0.212132, 0.05], [0, 0, 0.05]], "base_euler": [0, 0, np.pi / 4]},
        1.0,
    ),
    # 0.01 outside 0.2 to 0.25: (1 + e^-1) / 2.
    ("knee_distance", KSLC, {}, 1.0),
    ("knee_distance", KSLC, {"knee_pos": [[0, 0.13, 0.4], [0, -0.13, 0.4]]}, 0.68393972),
    ("knee_distance", KSLC, {"knee_pos": [[0, 0.095, 0.4], [0, -0.095, 0.4]]}, 0.68393972),
    ("knee_distance", LATERAL, {"knee_pos": [[0.3, 0.12, 0.4], [0, -0.1, 0.4]]}, 1.0),
    # norm(roll, yaw) = 0.15, 0.05 over: e^-5 - 0.01 * 0.15.
    (
        "default_joint_pos",
        KSLC,
        {"joint_pos": joints(left_leg_roll=0.09, left_leg_yaw=-0.12)},
        0.00523795,
    ),
    (
        "default_joint_pos",
        KSLC,
        {"joint_pos": joints(right_leg_roll=0.09, right_leg_yaw=0.12)},
        0.00523795,
    ),
    # The norms of the two sides add up: 0.06 + 0.05 = 0.11; e^-1 - 0.01 sqrt(0.0061).
    (
        "default_joint_pos",
        KSLC,
        {"joint_pos": joints(left_leg_roll=0.06, right_leg_yaw=0.05)},
        0.36709842,
    ),
    (
        "default_joint_pos",
        dataclasses.replace(KSLC, default_pose_margin=0.11),
        {"joint_pos": joints(left_leg_roll=0.06, right_leg_yaw=0.05)},
        0.99921898,
    ),
    ("default_joint_pos", KSLC, {"joint_pos": joints(left_knee=0.3, left_elbow_pitch=0.4)}, 0.995),
    # (e^(-10 * 0.1) + e^(-20 * 0.05)) / 2.
    (
        "orientation",
        KSLC,
        {"base_euler": [0.03, -0.07, 2.0], "gravity": [0.03, 0.04, -0.998749]},
        0.36787944,
    ),
    # A forward lean of 0.2 rad: (e^-2 + e^(-20 sin 0.2)) / 2. With 0.1 rad per m/s allowed, it is
    # free at 2 m/s.
    (
        "orientation",
        KSLC,
        {"vx": 2.0, "base_euler": [0, 0.2, 0], "gravity": [0.1986693, 0, -0.980067]},
        0.07707253,
    ),
    (
        "orientation",
        LEAN,
        {"vx": 2.0, "base_euler": [0, 0.2, 0], "gravity": [0.1986693, 0, -0.980067]},
        1.0,
    ),
    # |change| = 0.3: e^-0.9.
    (
        "base_acc",
        KSLC,
        {"base_velocity": [1.1, 0, 0, 0, 0.2, 0], "last_base_velocity": [1, 0, -0.2, 0, 0, 0]},
        0.40656966,
    ),
    ("collision", KSLC, {}, 0.0),
    ("collision", KSLC, {"torso_contact": True}, 1.0),
    # 0.5 + 0.1 * 2. `restless` adds 0.5 * (0.6^2 + 0.8^2), and half of that at v_max 1.5.
    *(
        (
            "stand_still",
            dataclasses.replace(KSLC, restless=restless),
            {
                "moving": False,
                "v_max": v_max,
                "joint_pos": joints(left_knee=0.3, right_knee=0.4),
                "joint_vel": joints(left_knee=2.0),
                "action": joints(left_knee=0.1, right_knee=-0.8),
                "last_action": joints(left_knee=0.7),
            },
            value,
        )
        for restless, v_max, value in ((0.0, 3.5, 0.7), (0.5, 3.5, 1.2), (0.5, 1.5, 0.95))
    ),
    # `shuffle` adds 2 * (1 - 1 / e) to 0.1 * 2 for feet that move at `shuffle_speed`, here the root
    # of 0.3^2 + 0.4^2 + 0.1^2, and half of that at v_max 1.5.
    *(
        (
            "stand_still",
            dataclasses.replace(KSLC, shuffle=2.0, shuffle_speed=0.26**0.5),
            {
                "moving": False,
                "v_max": v_max,
                "joint_vel": joints(left_knee=2.0),
                "foot_vel": [[0.3, 0.0, 0.4], [0.0, -0.1, 0.0]],
            },
            value,
        )
        for v_max, value in ((3.5, 1.464241), (1.5, 0.832121))
    ),
    (
        "stand_still",
        KSLC,
        {
            "joint_pos": joints(left_knee=0.3, right_knee=0.4),
            "action": joints(left_knee=1.0),
        },
        0.0,
    ),
    # Actions 0.2, 0.5, 1: 0.5^2 + (1 + 0.2 - 1)^2 + 0.05 * 1. Constant -2: 0.05 * 2.
    (
        "action_smoothness",
        KSLC,
        {
            "action": joints(left_knee=1.0, right_knee=-2.0),
            "last_action": joints(left_knee=0.5, right_knee=-2.0),
            "last_last_action": joints(left_knee=0.2, right_knee=-2.0),
        },
        0.44,
    ),
    ("torques", KSLC, {"torque": joints(left_knee=3.0, right_elbow_pitch=-4.0)}, 25.0),
    ("dof_vel", KSLC, {"joint_vel": joints(left_knee=1.0, right_elbow_pitch=-2.0)}, 5.0),
    # (0.2 / 0.01)^2 + (0.1 / 0.01)^2.
    (
        "dof_acc",
        KSLC,
        {
            "joint_vel": joints(left_knee=0.5, right_knee=-0.1),
            "last_joint_vel": joints(left_knee=0.3),
        },
        500.0,
    ),
    # Sum of the shares above 0.9 of the limit, each at most 1. First 12/12, 11.4/12 and 7.7/7: 0.1
    # + 0.05 + 0.2; then half the limit: 0; then 30/12: 1.
    (
        "dof_vel_limits",
        KSLC,
        {"joint_vel": joints(left_knee=12.0, right_knee=-11.4, left_elbow_pitch=7.7)},
        0.35,
    ),
    ("dof_vel_limits", KSLC, {"joint_vel": joints(left_knee=6.0)}, 0.0),
    ("dof_vel_limits", KSLC, {"joint_vel": joints(left_knee=30.0)}, 1.0),
]


@pytest.mark.parametrize("mode", ["eager", "jit"])
@pytest.mark.parametrize(
    ("term", "cfg", "changes", "expected"),
    CASES,
    ids=[f"{i}-{case[0]}" for i, case in enumerate(CASES)],
)
def test_term_by_hand(term, cfg, changes, expected, mode):
    x = make_inputs(**changes)
    got = value(cfg, term, x) if mode == "eager" else float(evaluate(cfg, x)[1][term])
    assert got == pytest.approx(expected, rel=3e-5, abs=1e-6)


def test_every_term_has_a_case():
    assert {case[0] for case in CASES} == set(rewards.TERMS)


# --------------------------------------------------------------------------------- weights and sum


def test_terms_and_weights_are_one_to_one():
    assert names(RewardWeights) == set(rewards.TERMS)
    assert all(name == term.__name__ for name, term in rewards.TERMS.items())


@pytest.mark.parametrize("name", ["paper", "baseline", "baseline-laptop"])
def test_weights_are_humanoid_gyms(name):
    """The paper adds angular momentum. All other terms that HG's table lacks are off."""
    weights = dataclasses.asdict(preset(name).rewards.weights)
    assert {k: weights.pop(k) for k in HUMANOID_GYM} == HUMANOID_GYM
    assert weights.pop("angular_momentum") == (0.05 if name == "paper" else 0.0)
    assert not any(weights.values())


def only(**weights: float) -> RewardConfig:
    zero = dict.fromkeys(rewards.TERMS, 0.0)
    return dataclasses.replace(KSLC, weights=RewardWeights(**{**zero, **weights}))


def test_reward_is_the_weighted_sum_times_dt():
    """0.01 (1.2 * 1 - 1e-5 * 100^2 - 1 * 1): perfect tracking, a torque of 100 N m, and a fall."""
    cfg = only(tracking_lin_vel=1.2, torques=-1e-5, collision=-1.0)
    x = make_inputs(torque=joints(left_knee=100.0), torso_contact=True)
    reward, raw = rewards.evaluate(cfg, robot.load(), 0.01, x)
    assert float(reward) == pytest.approx(0.01 * (1.2 - 0.1 - 1.0), rel=1e-5)
    assert set(raw) == set(rewards.TERMS)
    assert float(raw["torques"]) == pytest.approx(1e4)  # unweighted
    assert float(raw["feet_air_time"]) == 0.0 and float(raw["base_height"]) == pytest.approx(1.0)
    half, _ = rewards.evaluate(cfg, robot.load(), 0.005, x)
    assert float(half) == pytest.approx(0.5 * float(reward), rel=1e-5)


def test_reward_is_never_negative_unless_asked():
    cfg = only(tracking_lin_vel=1.2, torques=-1e-5)
    x = make_inputs(torque=joints(left_knee=400.0))  # 1.2 - 1.6
    assert float(rewards.evaluate(cfg, robot.load(), DT, x)[0]) == 0.0
    free = dataclasses.replace(cfg, only_positive=False)
    assert float(rewards.evaluate(free, robot.load(), DT, x)[0]) == pytest.approx(-0.004, rel=1e-4)


@pytest.mark.parametrize(("v_max", "cost"), [(0.5, 0.0), (1.5, 2.5), (2.5, 5.0)])
def test_a_fall_costs_once_and_beside_the_clip(v_max, cost):
    """0.01 * 1.2 for perfect tracking, less 5 in the step of the fall, once the range has grown."""
    cfg = dataclasses.replace(only(tracking_lin_vel=1.2), fall=5.0)
    for dt in (0.01, 0.005):
        upright, fallen = (
            float(rewards.evaluate(cfg, robot.load(), dt, x)[0])
            for x in (make_inputs(torso_contact=down, v_max=v_max) for down in (False, True))
        )
        assert upright == pytest.approx(1.2 * dt) and fallen == pytest.approx(1.2 * dt - cost)


def test_marching_at_command_0_still_earns_something():
    """Below zero every behaviour is worth the same, and standing cannot be learnt. A foot swings at
    1 m/s, and the actions have the noise of the middle of a training: deviation 0.4."""
    rng = np.random.default_rng(0)
    action, last, before = 0.4 * rng.normal(size=(3, 16))
    total, terms = evaluate(
        preset("laptop").rewards,
        make_inputs(
            moving=False,
            v_max=4.5,
            foot_vel=[[0.9, 0.0, 0.4], [0.0, 0.0, 0.0]],
            foot_contact=[False, True],
            joint_vel=joints(left_leg_pitch=3.0, left_knee=4.0),
            joint_pos=joints(left_leg_pitch=0.3, left_knee=-0.5, left_ankle_pitch=0.2),
            action=action,
            last_action=last,
            last_last_action=before,
        ),
    )
    assert float(total) > 0.01 and float(terms["stand_still"]) > 3.0


@pytest.mark.parametrize("cfg", [KSLC, HG], ids=["kslc", "hg"])
def test_total_is_the_table_applied_to_the_raw_terms(cfg):
    x = make_inputs(
        vx=2.0,
        base_linvel=[1.7, 0.1, 0.1],
        swing_height=[0.07, 0.0],
        stance=[False, True],
        joint_pos=joints(left_knee=-0.2),
        angular_momentum=[1.0, 2.0, 2.0],
    )
    total, raw = evaluate(cfg, x)
    table = {**HUMANOID_GYM, "angular_momentum": 0.05 if cfg is KSLC else 0.0}
    assert float(total) == pytest.approx(
        0.01 * sum(weight * float(raw[name]) for name, weight in table.items()), rel=1e-4
    )
    assert float(total) > 0.03


# --------------------------------------------------- the paper's equations: as printed, as read


def test_equation_2_and_table_1_sign_of_the_momentum_factor():
    """Printed: 0.05 in the text, -0.05 in Table I. Only the positive factor gives a penalty."""
    momenta = [0.0, 3.0, 5.0, 10.0]
    paid = [
        0.05 * value(KSLC, "angular_momentum", make_inputs(angular_momentum=[0, 0, m]))
        for m in momenta
    ]
    np.testing.assert_allclose(paid, [0.0, -0.0411059, -0.0859141, -0.3194528], atol=1e-6)
    assert KSLC.weights.angular_momentum == 0.05
    literal = [-np.exp(m) for m in momenta]
    assert np.all(np.diff(-0.05 * np.array(literal)) > 0)  # Table I rewards more momentum


def test_equation_4_as_printed_and_as_read():
    """Printed: clip(-exp(|L|), c1, c2). The paper does not give c1 and c2."""
    momenta = np.array([0.0, 1.0, 5.0, 15.0])
    literal = -np.exp(momenta)
    np.testing.assert_allclose(literal, [-1.0, -2.7182818, -148.41316, -3269017.4], rtol=1e-6)
    assert np.all(
        literal <= -1.0
    )  # the penalty is 1 at rest, and 3 million at an angular momentum of 15 kg m^2/s
    ours = [
        value(KSLC, "angular_momentum", make_inputs(angular_momentum=[m, 0, 0])) for m in momenta
    ]
    # 1 - e^0, 1 - e^0.2, 1 - e^1, 1 - e^3
    np.testing.assert_allclose(ours, [0.0, -0.2214028, -1.7182818, -19.085537], rtol=1e-5)


def test_equation_4_floor_is_reached_at_5_ln_21():
    x = 5.0 * np.log(21.0)  # 15.2226 kg m^2/s
    just, over = (make_inputs(angular_momentum=[0, m, 0]) for m in (x - 0.1, x + 0.1))
    assert -20.0 < value(KSLC, "angular_momentum", just) < -19.5
    assert value(KSLC, "angular_momentum", over) == pytest.approx(-20.0, rel=1e-6)


@pytest.mark.parametrize(
    ("speed", "height", "printed", "read"),
    [
        (3.5, 0.89, 1.9e-37, 0.0116796),  # e^-84.55; e^(-100 * 0.0445)
        (3.5, 0.8455, 1.6e-35, 1.0),  # e^-80.1; on target
        (3.5, 0.0445, 1.0, 1.6e-35),  # the printed form wants the base 4.45 cm above the ground
        (0.0, 0.89, 2.2e-39, 1.0),  # e^-89: target 0
    ],
)
def test_equation_6_as_printed_and_as_read(speed, height, printed, read):
    """Printed: exp(-100 |h - 0.05 * 0.89 g|). Its target is at most 4.45 cm."""
    literal = np.exp(-100.0 * abs(height - 0.05 * 0.89 * speed / 3.5))
    assert literal == pytest.approx(printed, rel=0.05)
    ours = value(KSLC, "base_height", make_inputs(vx=speed, base_pos=[0, 0, height]))
    assert ours == pytest.approx(read, rel=1e-3, abs=1e-30)


@pytest.mark.parametrize(
    ("speed", "height", "printed", "read"),
    [
        (3.5, 0.12, 0.06, 1.0),
        (3.5, 0.06, 0.0, 0.0024788),  # e^-6
        (3.5, 1.0, 0.94, 0.0),  # printed: a very high kick earns the most
        (0.0, 0.06, 0.06, 1.0),
        (0.0, 1.0, 1.0, 0.0),
    ],
)
def test_equation_7_as_printed_and_as_read(speed, height, printed, read):
    """Printed: xi (h - 0.06 g). It is linear in the height, without an upper bound."""
    assert height - 0.06 * speed / 3.5 == pytest.approx(printed, abs=1e-9)
    x = make_inputs(vx=speed, swing_height=[height, 0.0], stance=[False, True])
    assert value(KSLC, "feet_clearance", x) == pytest.approx(read, rel=1e-3, abs=1e-9)


def literal_equation_8(error: np.ndarray, speed: np.ndarray) -> float:
    n = np.linalg.norm(error * np.exp(-speed))
    return np.exp(-2.0 * n) - 0.2 * np.clip(n, 0.0, 0.5)


@pytest.mark.parametrize(
    ("error", "speed", "printed", "read"),
    [
        # 0.01 e^12 = 1627.5; ours: n = 0.01 e^-1
        (0.01, -12.0, -0.1, 0.9919338),
        # 1 * e^-12 = 6.1e-6; ours: n = e^-1: e^-0.735759 - 0.2 * 0.367879
        (1.0, 12.0, 0.9999865, 0.4055656),
        # At rest both give e^-1 - 0.1.
        (0.5, 0.0, 0.2678794, 0.2678794),
    ],
)
def test_equation_8_as_printed_and_as_read(error, speed, printed, read):
    """Printed: each error times exp(-joint velocity). The velocity is in rad/s and has a sign."""
    q, dq = joints(left_knee=error), joints(left_knee=speed)
    assert literal_equation_8(q, dq) == pytest.approx(printed, rel=1e-5)
    assert value(KSLC, "joint_pos", make_inputs(joint_pos=q, joint_vel=dq)) == pytest.approx(
        read, rel=1e-5
    )


def test_equation_8_pays_both_sides_alike_only_as_read():
    """The mirrored joints of this robot move with opposite signs, so the printed form treats the
    sides differently: n = |0.3 e^4, 0.1 e^-2| = 16.4 on one side, |0.3 e^-4, 0.1 e^2| = 0.7389 on
    the other.
    """
    permutation, sign = MIRROR
    q, dq = joints(left_knee=-0.3, left_leg_pitch=-0.1), joints(left_knee=-4.0, left_leg_pitch=2.0)
    there = q[permutation] * sign, dq[permutation] * sign
    assert literal_equation_8(q, dq) == pytest.approx(-0.1, abs=1e-4)
    assert literal_equation_8(*there) == pytest.approx(0.1281, abs=1e-4)
    ours = [
        value(KSLC, "joint_pos", make_inputs(joint_pos=a, joint_vel=b)) for a, b in ((q, dq), there)
    ]
    assert ours[0] == pytest.approx(ours[1], rel=1e-6)


def test_learning_rate_as_printed_and_as_read():
    """Printed in Table I: 1e-5. With it as a constant, Adam could move a weight by only 0.24 in
    3001 updates of 8 steps. Read: it is the start of an adaptive rate."""
    config = PPOConfig()
    gradient_steps = 3001 * config.minibatches * config.epochs
    assert gradient_steps == 24_008
    assert gradient_steps * 1e-5 == pytest.approx(0.24, rel=1e-3)
    rate, climb = jnp.asarray(config.learning_rate), []
    assert float(rate) == pytest.approx(1e-5)
    for _ in range(20):  # a KL of 0.001 is below half of 0.01: each time x 1.5
        rate = ppo.adapt_learning_rate(config, rate, jnp.asarray(0.001))
        climb.append(float(rate))
    assert climb[0] == pytest.approx(1.5e-5, rel=1e-5)
    assert climb[7] == pytest.approx(1e-5 * 1.5**8, rel=1e-5)  # 2.6e-4
    assert climb[16] == pytest.approx(9.85261e-3, rel=1e-5) and climb[17] == pytest.approx(1e-2)


def test_velocity_rewards_switch_changes_three_terms_only():
    x = make_inputs(
        vx=2.0,
        base_linvel=[1.5, 0, 0],
        base_pos=[0, 0, 0.87],
        swing_height=[0.09, 0.0],
        stance=[False, True],
        joint_pos=joints(left_knee=-0.3),
        joint_vel=joints(left_knee=5.0),
    )
    kslc, hg = evaluate(KSLC, x)[1], evaluate(HG, x)[1]
    different = {name for name in kslc if abs(float(kslc[name]) - float(hg[name])) > 1e-6}
    assert different == {"base_height", "feet_clearance", "joint_pos"}


def test_tracking_difference_and_reward_run_over_the_same_joints():
    width = {c.name: c.width for c in CRITIC}["tracking_difference"]
    assert width == 16
    for name in robot.load().joint_names:
        x = make_inputs(joint_pos=joints(**{name.removesuffix("_joint"): 0.5}))
        assert value(HG, "joint_pos", x) == pytest.approx(0.26787944, rel=1e-5)
