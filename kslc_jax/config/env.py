"""Settings of the environment: episodes, commands, the gait, and how robots differ."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from kslc_jax.config.checks import Range, check_range, require


@dataclass(frozen=True)
class EnvConfig:
    """Actions, observations and episodes."""

    num_envs: int = 4096
    """Robots that are simulated in parallel (paper, Table I)."""
    episode_seconds: float = 24.0
    """Time limit of an episode [s] (HG)."""
    action_scale: float = 0.25
    """Joint target [rad] = default + scale * action (HG)."""
    least_torque: float = 0.0
    """Least torque of an action of 1, as a share of the joint's largest torque. A joint whose servo
    is too soft for that has a larger scale than `action_scale`. Else exploration would hardly show
    what its motor can do. 0: one scale for all joints (HG)."""
    action_clip: float = 18.0
    """Actions are clipped to [-x, x] (HG)."""
    observation_clip: float = 18.0
    """Observations are clipped to [-x, x] (HG)."""
    action_delay: float = 0.5
    """Largest share of the previous action that is mixed into the present one (HG)."""
    action_noise: float = 0.02
    """Relative standard deviation of multiplicative action noise (HG)."""
    noise_level: float = 0.6
    """Factor on all observation noise (HG); 0: no noise."""
    frames: int = 15
    """Frames of actor history (paper, Table I)."""
    privileged_frames: int = 3
    """Frames of critic history (paper, Table I)."""
    critic_memory: bool = False
    """True: the critic's frame has eight more values than the paper's: the wanted vx and vy, the
    mean velocity error along x and y, and the air time and swing height of each foot. Rewards of
    the next steps depend on them."""
    arms: Literal["free", "held"] = "free"
    """free: the policy moves the arms. held: arm actions are ignored and servos keep the arms in
    the home pose (ablation, baseline). The gait's reference must then not move the arms."""
    reset_joint_noise: float = 0.1
    """Initial joint angles are default + U(-x, x) [rad] (HG)."""

    def __post_init__(self):
        require(self.num_envs >= 1, "env.num_envs must be at least 1")
        require(self.episode_seconds > 0, "env.episode_seconds must be positive")
        require(self.frames >= 1, "env.frames must be at least 1")
        require(self.privileged_frames >= 1, "env.privileged_frames must be at least 1")
        require(0 <= self.action_delay <= 1, "env.action_delay must lie in [0, 1]")
        require(self.action_clip > 0, "env.action_clip must be positive")
        require(self.observation_clip > 0, "env.observation_clip must be positive")
        for name in ("least_torque", "action_noise", "noise_level", "reset_joint_noise"):
            require(getattr(self, name) >= 0, f"env.{name} must not be negative")


@dataclass(frozen=True)
class CommandConfig:
    """Sampling of commanded velocity and heading. The curriculum sets the range of vx."""

    vy: Range = (-0.3, 0.3)
    """Range of the commanded sideways velocity [m/s]."""
    heading: Range = (-3.14, 3.14)
    """Range of the commanded heading [rad], world frame."""
    resample_seconds: float = 8.0
    """Longest time [s] that a command holds."""
    shortest_seconds: float = 0.0
    """Shortest time [s] that a command holds. The time is uniform from here to `resample_seconds`.
    0: always `resample_seconds` (HG)."""
    dead_zone: float = 0.2
    """Commanded vx and vy become zero if their norm [m/s] is at most this (HG)."""
    acceleration: float = 0.0
    """Largest change of the commanded vx and vy [m/s^2]. The command that the robot gets approaches
    the wanted one at this rate: no robot can stop at once. 0: it jumps (HG)."""
    heading_gain: float = 0.5
    """Commanded yaw rate per heading error [1/s] (HG)."""
    max_yaw_rate: float = 1.0
    """Largest commanded yaw rate [rad/s] (HG)."""
    stand_fraction: float = 0.0
    """Share of commands with zero velocity."""
    forward_fraction: float = 0.0
    """Share of commands straight ahead: vy is 0 and the heading stays."""
    slow_fraction: float = 0.0
    """Share of commands with vx up to `slow_speed` only. Slow commands are rare in a wide range
    otherwise."""
    slow_speed: float = 1.0
    """Largest vx [m/s] of the `slow_fraction`."""
    top_fraction: float = 0.0
    """Share of commands with vx from the top `curriculum.v_step` of the range. Changes from and to
    the top speed are rare otherwise."""
    brake_fraction: float = 0.0
    """After a command in the upper half of the range, this share of the next commands brakes: one
    half means "stand", the other half goes backwards as fast as the range allows. Such changes are
    rare otherwise."""
    narrow_speed: float = 0.0
    """vy and heading changes shrink linearly with |vx| and are 0 from this speed [m/s] on. 0: they
    never shrink."""
    stand_still: bool = False
    """True: a zero command means "stand": the gait clock is off, and both feet should be on the
    ground. False: the robot marches in place (HG)."""

    def __post_init__(self):
        check_range("command.vy", self.vy)
        check_range("command.heading", self.heading)
        for name in ("resample_seconds", "heading_gain", "max_yaw_rate"):
            require(getattr(self, name) > 0, f"command.{name} must be positive")
        require(
            0 <= self.stand_fraction + self.forward_fraction <= 1,
            "command.stand_fraction + command.forward_fraction must lie in [0, 1]",
        )
        require(
            0 <= self.slow_fraction + self.top_fraction <= 1,
            "command.slow_fraction + command.top_fraction must lie in [0, 1]",
        )
        require(self.slow_speed > 0, "command.slow_speed must be positive")
        require(self.acceleration >= 0, "command.acceleration must not be negative")
        require(0 <= self.brake_fraction <= 1, "command.brake_fraction must lie in [0, 1]")
        require(
            0 <= self.shortest_seconds <= self.resample_seconds,
            "command.shortest_seconds must lie in [0, command.resample_seconds]",
        )


@dataclass(frozen=True)
class GaitConfig:
    """Gait clock and reference motion of the joints."""

    cycle_time: float = 0.64
    """Gait cycle [s] at the start of the curriculum (HG)."""
    double_support: float = 0.1
    """The clock wants both feet on the ground while abs(sin(2 pi phase)) is below this (HG)."""
    double_support_at_speed: float = 0.1
    """Value of `double_support` at `full_speed`. It changes with the square of the speed. Negative
    values mean flight: the clock wants no foot on the ground while abs(sin(2 pi phase)) is below
    their size."""
    reference_scale: float = 0.17
    """Amplitude of the hip and ankle reference [rad]. The knee's is twice as large (HG)."""
    reference_speed_gain: float = 0.0
    """Relative growth of `reference_scale` from speed 0 to `full_speed` (longer strides, Eq. 8)."""
    full_speed: float = 3.5
    """Commanded speed [m/s] from which speed-dependent settings have their full size."""
    stride_sweep: float = 0.0
    """Amplitude [rad] at `full_speed` of a hip reference with which the leg lands in front of the
    body and leaves the ground behind it."""
    arm_swing: float = 0.0
    """Amplitude [rad] of the shoulder reference at `full_speed`, opposite to its side's leg."""
    arm_swing_slow: float = 0.0
    """Amplitude [rad] of the shoulder reference at commanded speed 0."""
    elbow_bend: float = 0.0
    """Elbow flexion [rad] of the reference at `full_speed`."""
    cycle_follows_speed: bool = False
    """True: the cycle falls linearly with speed, from `cycle_time` at 0 to the curriculum's cycle
    at v_max. The cycle of a command then changes whenever the range grows."""
    cycle_from_speed: float = 0.0
    """Above 0: the cycle of a command depends on its speed only. Up to this speed [m/s] it is
    `cycle_time`. Each further `curriculum.v_step` multiplies it by `curriculum.cycle_factor`, as
    the curriculum does (Eq. 10). It is never shorter than the curriculum's cycle."""
    random_phase: bool = False
    """True: episodes start at a random gait phase. False: at phase 0 (HG)."""

    def __post_init__(self):
        require(self.cycle_time > 0, "gait.cycle_time must be positive")
        require(0 <= self.double_support < 1, "gait.double_support must lie in [0, 1)")
        require(
            -1 < self.double_support_at_speed < 1,
            "gait.double_support_at_speed must lie in (-1, 1)",
        )
        require(self.full_speed > 0, "gait.full_speed must be positive")


MOST_INSET = 0.04
"""Largest distance [m] by which the edge of a sole moves inwards. It leaves the sole some area."""


@dataclass(frozen=True)
class RandomizeConfig:
    """Domain randomisation, sampled at every reset. Two equal bounds mean a constant."""

    friction: Range = (0.1, 2.0)
    """Friction of the feet (HG). The contact uses the mean of foot and ground, as in PhysX."""
    ground_friction: float = 0.6
    """Friction of the ground (HG)."""
    base_mass: Range = (-5.0, 5.0)
    """Mass added to the trunk [kg] (HG: to the base link, which is XBot-L's trunk)."""
    base_com: Range = (0.0, 0.0)
    """Shift of the trunk's centre of mass, per axis of its frame [m]."""
    kp: Range = (1.0, 1.0)
    """Factor on the position gains, per joint."""
    kd: Range = (1.0, 1.0)
    """Factor on the velocity gains, per joint."""
    motor_strength: Range = (1.0, 1.0)
    """Factor on the available torque, per joint."""
    joint_friction: Range = (0.0, 0.0)
    """Coulomb friction [N m], per joint."""
    link_mass: Range = (1.0, 1.0)
    """Factor on mass and inertia, per link."""
    link_com: Range = (0.0, 0.0)
    """Shift of each link's centre of mass, per axis [m]."""
    hand_mass: Range = (0.0, 0.0)
    """Mass added to the last link of each arm, at its centre of mass [kg]."""
    sole: Range = (0.0, 0.0)
    """Distance [m] by which each contact point of a sole lies nearer to the sole's middle. It is
    then also a little higher, so that two to four points of a flat foot carry the load."""
    noise: Range = (1.0, 1.0)
    """Factor on observation noise, action noise and action delay of an episode."""
    push_seconds: float = 4.0
    """Time between pushes [s] (HG); 0: no pushes."""
    push_velocity: float = 0.2
    """Largest push [m/s], along x and y each (HG)."""
    push_angular: float = 0.4
    """Largest push [rad/s], about each axis (HG)."""
    push_adds: bool = True
    """True: a push is added to the base's velocity. False: it replaces the velocity (HG). At
    3.5 m/s a replaced velocity stops the robot almost at once."""
    punch: Range = (0.0, 0.0)
    """Size [N] of a force that acts for 0.08 s at a random link in a random direction, every 4 s.
    0: no punches."""
    held_arms: float = 0.0
    """Share of the episodes in which the arms follow slow random targets in place of the
    actions."""

    def __post_init__(self):
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, tuple):
                check_range(f"randomize.{f.name}", value)
        for name in (
            "kp",
            "kd",
            "motor_strength",
            "friction",
            "joint_friction",
            "noise",
            "hand_mass",
            "sole",
            "punch",
        ):
            require(getattr(self, name)[0] >= 0, f"randomize.{name} must not be negative")
        require(
            self.ground_friction >= 0 and self.friction[0] + self.ground_friction > 0,
            "randomize.ground_friction must not be negative, and not 0 where friction may be 0: "
            "mjx divides by the friction of a contact",
        )
        require(self.link_mass[0] > 0, "randomize.link_mass must be positive")
        require(self.sole[1] <= MOST_INSET, f"randomize.sole must be at most {MOST_INSET} m")
        require(0 <= self.held_arms <= 1, "randomize.held_arms must lie in [0, 1]")
