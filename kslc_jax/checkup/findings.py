"""Faults of a robot: one line each, with the field to change. XBot-L has none."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from kslc_jax import motors
from kslc_jax.checkup import statics
from kslc_jax.config import Config
from kslc_jax.robot import Robot

SAG = 0.15
"""Largest angle [rad] by which standing may bend a hip or a knee; XBot-L's knees: 0.105. An H1 with
unitree_rl_gym's gains sinks by 0.25 rad in its knees; that is too much."""

ANKLES = 0.3
"""Largest stiffness of both ankles together, as a share of m g h: the weight times the height of
the centre of mass. With a share of 1 a rigid robot stands without control. XBot-L, 0.08, and a G1
with 0.14 learnt to walk; a G1 with 0.37, and with straighter knees, learnt to stand."""

SCALE = (0.03, 1.5)
"""Torque of one action as a share of the largest torque. XBot-L's: 0.59 at the hips; 0.15 at the
ankles, 0.044 without `env.least_torque`."""

LIGHT = 0.001
"""Mass [kg] below which a link is too light."""

STIFF = 1.0
"""kd x timestep / inertia from which a joint without armature is hard to simulate."""

UNEQUAL = 0.05
"""Largest relative difference of the numbers of a left and a right joint; XBot-L's ankles differ
more in mass, so masses below `SMALL` do not count."""

SMALL = 0.01
"""Share of the robot's mass below which a link's mass is not compared."""

DEEP = 0.002
"""Depth [m] from which shapes that overlap at home count."""

BEYOND = 0.05
"""Angle [rad] by which the reference motion may leave the range of a joint."""

UNFELT = 0.1
"""Largest share of contacts at high fidelity that training does not feel."""

AGREEMENT = 1e-4
"""Largest difference [rad] between the joint angles of the two engines."""


@dataclass(frozen=True)
class Finding:
    """A thing that looks wrong."""

    field: str  # of the description, or "mjcf"
    text: str


@dataclass(frozen=True)
class Patient:
    """A robot at both fidelities, and the laptop preset for it."""

    train: Robot
    high: Robot
    config: Config

    def both(self, values: np.ndarray) -> Iterator[tuple[str, float]]:
        """(names, larger value) of each joint and its partner."""
        for i, j in enumerate(self.train.anatomy.permutation):
            if i <= j:
                names = dict.fromkeys(self.train.joint_names[k] for k in (i, j))
                yield ", ".join(names), float(max(values[i], values[j]))


def weak_gains(x: Patient) -> Iterator[Finding]:
    """Hips and knees that give way while the robot stands. Ankles should be soft."""
    robot = x.train
    sags = np.abs(statics.standing_torque(robot)) / robot.kp
    roles = robot.anatomy.roles.items()
    firm = [joint for role, joint in roles if "hip" in role or "knee" in role]
    sags[~np.isin(np.arange(robot.count), firm)] = 0
    for names, value in x.both(sags):
        if value > SAG:
            yield Finding(
                "motors: kp", f"{names}: standing bends it by {value:.2f} rad, at most {SAG:g}"
            )


def stiff_ankles(x: Patient) -> Iterator[Finding]:
    """Ankles on which a robot learns to stand, not to step."""
    share = statics.ankle_share(x.train)
    if share > ANKLES:
        yield Finding(
            "motors: kp",
            f"the ankles' stiffness is {share:.2f} m g h (at 1 a rigid robot stands without "
            f"control): it may learn to stand, not to step; soften them (at most {ANKLES:g}; "
            "XBot-L: 0.08)",
        )


def weak_motors(x: Patient) -> Iterator[Finding]:
    """Motors that cannot hold the robot on one leg, which takes twice the torque."""
    torques = 2 * np.abs(statics.standing_torque(x.train))
    for names, value in x.both(torques / x.train.effort_limit):
        if value > 1:
            yield Finding(
                "motors: effort",
                f"{names}: standing on one leg takes {value:.1f} times the largest torque",
            )


def action_scale(x: Patient) -> Iterator[Finding]:
    """Actions that do nothing, or that saturate the motors."""
    scale = motors.action_scale(x.config.env, x.train)
    low, high = SCALE
    for names, value in x.both(x.train.kp * scale / x.train.effort_limit):
        if not low <= value <= high:
            yield Finding(
                "motors: kp, effort",
                f"{names}: an action of 1 takes {value:.2g} of the largest torque, "
                f"not {low:g} to {high:g}",
            )


def masses(x: Patient) -> Iterator[Finding]:
    """Links of no mass."""
    links = x.train.mj_model.body_mass[x.train.joint_body_ids]
    for names, value in x.both(-links):
        if -value < LIGHT:
            yield Finding(
                "mjcf: inertial", f"{names}: the link weighs {-1000 * value:.2g} g: give it a mass"
            )


def armature(x: Patient) -> Iterator[Finding]:
    """Fast joints without rotor inertia."""
    robot = x.train
    ratio = robot.kd * x.config.physics.timestep / robot.joint_inertia
    ratio[robot.mj_model.dof_armature[6:] > 0] = 0
    for names, value in x.both(ratio):
        if value > STIFF:
            yield Finding(
                "motors: armature",
                f"{names}: no armature, and kd x {1000 * x.config.physics.timestep:g} ms is "
                f"{value:.1f} times the inertia: give the rotor's, or lower kd",
            )


def home_range(x: Patient) -> Iterator[Finding]:
    """Home outside the range of a joint."""
    lower, upper = x.train.reference_range
    for names, value in x.both(np.maximum(lower, -upper)):
        if value > 0.001:
            yield Finding("home", f"{names}: home is {value:.2f} rad outside the range")


def asymmetry(x: Patient) -> Iterator[Finding]:
    """Numbers that differ between left and right."""
    robot = x.train
    partner, sign = robot.anatomy.permutation, robot.anatomy.sign
    ranges = np.stack([robot.joint_lower, robot.joint_upper])
    mirrored = np.where(sign > 0, ranges[:, partner], -ranges[::-1, partner])
    links = robot.mj_model.body_mass[robot.joint_body_ids]
    links = np.where(links > SMALL * robot.total_mass, links, 0)
    numbers = {
        "motors: kp": robot.kp,
        "motors: kd": robot.kd,
        "motors: effort": robot.effort_limit,
        "motors: speed": robot.speed_limit,
        "motors: armature": robot.mj_model.dof_armature[6:],
        "mjcf: inertial": links,
    }
    for field, values in numbers.items():
        largest = np.maximum(np.maximum(values, values[partner]), 1e-9)
        for names, value in x.both(np.abs(values - values[partner]) / largest):
            if value > UNEQUAL:
                yield Finding(field, f"{names}: left and right differ by {value:.0%}")
    for names, value in x.both(np.abs(ranges - mirrored).max(axis=0)):
        if value > UNEQUAL:
            yield Finding(
                "mjcf: range", f"{names}: the ranges are no mirror images, by {value:.2f} rad"
            )


def balance(x: Patient) -> Iterator[Finding]:
    """Home poses that tip over."""
    if off := statics.off_balance(x.train):
        place = "in front of the toes" if off > 0 else "behind the heels"
        yield Finding(
            "home", f"the centre of mass is {100 * abs(off):.1f} cm {place}: bend hips or ankles"
        )


def overlaps(x: Patient) -> Iterator[Finding]:
    """Shapes inside each other or inside the ground at home, at high fidelity."""
    model = x.high.mj_model
    pose = statics.on_the_ground(x.high)
    deepest: dict[tuple[str, str], float] = {}
    for contact in statics.posed(x.high, pose).contact:
        names = statics.link_names(x.high, contact)
        deepest[names] = max(deepest.get(names, 0.0), -float(contact.dist))
    for (a, b), depth in deepest.items():
        if depth > DEEP:
            other = "the ground" if a == "world" else a
            yield Finding("home", f"{b} is {1000 * depth:.0f} mm inside {other} at home")
    limbs = statics.limb_of_bodies(x.high)
    for pair in model.exclude_signature:
        a, b = pair >> 16, pair & 0xFFFF
        if "trunk" not in (limbs[a], limbs[b]) and limbs[a] != limbs[b]:
            yield Finding(
                "home",
                f"{model.body(a).name} and {model.body(b).name} overlap at home, so they never "
                "touch: move them apart",
            )


def reference(x: Patient) -> Iterator[Finding]:
    """A reference motion that the robot cannot follow, or that does not lift the feet."""
    for names, value in x.both(statics.out_of_range(x.config, x.train)):
        if value > BEYOND:
            yield Finding(
                "home, config: gait",
                f"{names}: the reference motion leaves the range by {value:.2f} rad",
            )
    for names, value in x.both(statics.reference_speed(x.config, x.train) / x.train.speed_limit):
        if value > 1:
            yield Finding(
                "config: gait",
                f"{names}: the reference motion asks for {value:.2f} times its largest speed: make "
                "the gait's swing or sweep smaller, or its cycle longer",
            )
    lift, target = statics.foot_lift(x.config, x.train), x.config.rewards.clearance_target
    if lift < target / 2:
        yield Finding(
            'config: "gait.reference_scale"',
            f"the reference motion lifts the foot by {100 * lift:.1f} cm, the target is "
            f"{100 * target:.1f} cm: bend the knees more at home, or raise it from "
            f"{x.config.gait.reference_scale:g}",
        )


STATIC: tuple[Callable[[Patient], Iterator[Finding]], ...] = (
    weak_gains,
    stiff_ankles,
    weak_motors,
    action_scale,
    masses,
    armature,
    home_range,
    asymmetry,
    balance,
    overlaps,
    reference,
)
"""Checks that need no simulation."""


def contacts(missed: int, there: int) -> list[Finding]:
    """Contacts that training does not feel, of all (see `statics.unfelt`)."""
    if missed <= UNFELT * there:
        return []
    text = f"training does not feel {missed} of {there} contacts of two limbs in random poses"
    return [Finding("mjcf: geom", f"{text}: give the links shapes that are nearer to capsules")]


def passive(fall: float, seconds: float) -> list[Finding]:
    """A robot that stands without a policy has no reason to step."""
    if math.isfinite(fall):
        return []
    text = f"it stands for {seconds:g} s without a policy: it will learn to stand, not to step"
    return [Finding("motors: kp", f"{text}; soften the ankles")]


def engines(apart: float) -> list[Finding]:
    """Engines that disagree."""
    if apart <= AGREEMENT:
        return []
    return [Finding("motors", f"the engines are {apart:.1e} rad apart: look at armature and kd")]
