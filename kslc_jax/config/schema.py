"""Schema of the config: frozen dataclasses with checks. Derived values are properties."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from kslc_jax.errors import UserError

Range = tuple[float, float]

Fidelity = Literal["train", "high"]

XBOT_L = "xbot_l"
"""The robot of the paper. Presets are made for it."""


class ConfigError(UserError):
    """A config value cannot work. The message names the field and says what is allowed."""


def require(ok: bool, message: str) -> None:
    """Raises ConfigError with `message` if not `ok`."""
    if not ok:
        raise ConfigError(message)


COUNTER = 2**31
"""Upper limit of steps, samples and seeds: the train step counts in 32-bit integers."""


def require_seed(seed: int, name: str = "seed") -> None:
    """Raises ConfigError if `seed` does not lie in [0, 2^31)."""
    require(0 <= seed < COUNTER, f"{name} must lie in [0, 2^31), not {seed}")


def _check_numbers(name: str, value: object) -> None:
    """Raises ConfigError for numbers that are not finite, or too large for an array shape."""
    if dataclasses.is_dataclass(value):
        for f in dataclasses.fields(value):
            _check_numbers(f"{name}.{f.name}".lstrip("."), getattr(value, f.name))
    elif isinstance(value, tuple):
        for part in value:
            _check_numbers(name, part)
    elif isinstance(value, int | float):
        require(abs(value) < 2**62, f"{name}: {value} is too large or not finite")


def _check_range(name: str, value: Range) -> None:
    """Raises ConfigError if the lower bound is above the upper one."""
    require(value[0] <= value[1], f"{name}: lower bound {value[0]} is above upper bound {value[1]}")


@dataclass(frozen=True)
class TerrainConfig:
    """Uneven ground. All sizes 0, the default: the flat floor.

    Every episode draws one kind among those whose size is not 0, its size, and its direction
    (kslc_jax/ground.py)."""

    rough: float = 0.0
    """Largest height of random waves [m], up and down."""
    slope: float = 0.0
    """Largest inclination of a plane [degrees]."""
    stairs: float = 0.0
    """Largest height of a stair's step [m]."""
    flat: float = 0.2
    """Share of episodes on flat ground."""
    least: float = 0.0
    """Smallest size that an episode draws, as a share of the largest one. 1: always the largest."""
    full_from: float = 0.0
    """Sizes grow with the curriculum's v_max, and have their full range from this v_max [m/s] on.
    0: from the start."""
    critic_sees: bool = True
    """True: the critic's frame has the ground below the feet and its slope. The actor's frame never
    has them. False: both networks have the shapes of a training on the flat floor
    (--start-from)."""

    def __post_init__(self):
        require(0 <= self.rough <= 0.5, "physics.terrain.rough must lie in [0, 0.5] m")
        require(0 <= self.slope <= 30, "physics.terrain.slope must lie in [0, 30] degrees")
        require(0 <= self.stairs <= 0.3, "physics.terrain.stairs must lie in [0, 0.3] m")
        require(0 <= self.flat < 1, "physics.terrain.flat must lie in [0, 1)")
        require(0 <= self.least <= 1, "physics.terrain.least must lie in [0, 1]")
        require(self.full_from >= 0, "physics.terrain.full_from must not be negative")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds of uneven ground whose size is not 0."""
        return tuple(kind for kind in GROUNDS if getattr(self, kind))

    @property
    def fixed(self) -> bool:
        """True if all episodes have ground of one kind and one size."""
        return len(self.kinds) == 1 and self.flat == 0 and self.least == 1 and not self.full_from


GROUNDS = ("rough", "slope", "stairs")
"""Kinds of uneven ground: fields of `TerrainConfig`."""


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation of one control step."""

    fidelity: ClassVar[Fidelity] = "train"

    robot: str = XBOT_L
    """Name of a shipped robot, or path of the description of another one (docs/own_robot.md)."""
    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: pure XLA, any device. mujoco: C MuJoCo on the CPU cores, called back from JAX; faster on
    a CPU (docs/performance.md). auto: mjx if JAX has an accelerator, else mujoco."""
    timestep: float = 0.005
    """Physics step [s]. The PD torque is recomputed at each one."""
    decimation: int = 2
    """Physics steps per control step."""
    iterations: int = 4
    """Newton iterations of the contact solver. With fewer than 4 this robot's contacts explode."""
    ls_iterations: int = 5
    """Line-search iterations of the contact solver."""
    threads: int = 0
    """CPU threads of the mujoco engine; 0: all CPUs that this process may use. Does not change
    results."""
    terrain: TerrainConfig = TerrainConfig()

    def __post_init__(self):
        require(self.timestep > 0, "physics.timestep must be positive")
        require(self.decimation >= 1, "physics.decimation must be at least 1")
        require(self.iterations >= 1, "physics.iterations must be at least 1")
        require(self.ls_iterations >= 1, "physics.ls_iterations must be at least 1")
        require(0 <= self.threads <= 1024, "physics.threads must lie in [0, 1024]; 0: all cores")

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.decimation

    @property
    def uneven(self) -> TerrainConfig | None:
        """The terrain; None if it is the flat floor."""
        return self.terrain if self.terrain.kinds else None


@dataclass(frozen=True)
class HighFidelity(PhysicsConfig):
    """Physics of evaluation: C MuJoCo, 1 ms, converged solver, model of robot.load("high")."""

    fidelity: ClassVar[Fidelity] = "high"

    engine: Literal["auto", "mjx", "mujoco"] = "mujoco"
    timestep: float = 0.001
    decimation: int = 10
    iterations: int = 100
    ls_iterations: int = 50

    def __post_init__(self):
        super().__post_init__()
        require(self.engine == "mujoco", "high fidelity needs physics.engine mujoco")
        require(
            self.terrain.fixed or not self.terrain.kinds,
            "high fidelity has one height field: physics.terrain needs one kind, flat 0, least 1, "
            "full_from 0",
        )


@dataclass(frozen=True)
class EnvConfig:
    """Actions, observations and episodes."""

    num_envs: int = 4096
    """Robots that are simulated in parallel (paper, Table I)."""
    episode_seconds: float = 24.0
    """Time limit of an episode [s] (HG)."""
    action_scale: float = 0.25
    """Joint target [rad] = default + scale * action (HG)."""
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
        for name in ("action_noise", "noise_level", "reset_joint_noise"):
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
        _check_range("command.vy", self.vy)
        _check_range("command.heading", self.heading)
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
    """The clock wants both feet on the ground while abs(sin(phase)) is below this (HG)."""
    double_support_at_speed: float = 0.1
    """Value of `double_support` at `full_speed`. It changes with the square of the speed. Negative
    values mean flight: the clock wants no foot on the ground while abs(sin(phase)) is below their
    size."""
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
    """Mass added to the base link [kg] (HG)."""
    base_com: Range = (0.0, 0.0)
    """Shift of the base link's centre of mass, per axis [m]."""
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
    3.5 m/s a replaced velocity is like a wall, not like a push."""
    punch: Range = (0.0, 0.0)
    """Size [N] of a force that acts for 0.08 s at a random link in a random direction, every 4 s.
    0: no punches."""
    held_arms: float = 0.0
    """Share of the episodes in which the arms follow slow random targets in place of the actions,
    as if somebody else moved them."""

    def __post_init__(self):
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, tuple):
                _check_range(f"randomize.{f.name}", value)
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
        require(self.link_mass[0] > 0, "randomize.link_mass must be positive")
        require(self.sole[1] <= MOST_INSET, f"randomize.sole must be at most {MOST_INSET} m")
        require(0 <= self.held_arms <= 1, "randomize.held_arms must lie in [0, 1]")


@dataclass(frozen=True)
class RewardWeights:
    """Weight of each reward term. The weighted sum is multiplied by the control step [s] (HG)."""

    # Term of the paper (Eq. 4 to 8), see kslc_jax/rewards.py. The weights of Eq. 5 equal HG's.
    joint_pos: float = 1.6
    feet_clearance: float = 1.0
    base_height: float = 0.2
    angular_momentum: float = 0.05
    # Term of HG, see kslc_jax/rewards.py.
    feet_contact_number: float = 1.2
    feet_air_time: float = 1.0
    foot_slip: float = -0.05
    feet_distance: float = 0.2
    knee_distance: float = 0.2
    feet_contact_forces: float = -0.01
    tracking_lin_vel: float = 1.2
    tracking_ang_vel: float = 1.1
    vel_mismatch_exp: float = 0.5
    low_speed: float = 0.2
    track_vel_hard: float = 0.5
    default_joint_pos: float = 0.5
    orientation: float = 1.0
    base_acc: float = 0.2
    action_smoothness: float = -0.002
    torques: float = -1e-5
    dof_vel: float = -5e-4
    dof_acc: float = -1e-7
    collision: float = -1.0
    # Our own term, off in the presets `paper` and `baseline`, see kslc_jax/rewards.py.
    tracking_mean_vel: float = 0.0
    dof_vel_limits: float = 0.0
    stand_still: float = 0.0


@dataclass(frozen=True)
class RewardConfig:
    """Weights and parameters of the reward terms."""

    weights: RewardWeights = RewardWeights()
    only_positive: bool = True
    """True: the total reward of a step is at least 0 (HG)."""
    velocity_rewards: bool = True
    """True: the paper's speed-dependent forms (Eq. 6 to 8). False: HG's fixed forms."""
    tracking_sigma: float = 5.0
    """sigma in exp(-sigma * squared error) of the tracking terms (HG)."""
    momentum_scale: float = 5.0
    """Angular momentum [kg m^2/s] at which the exponent of Eq. 4 is 1."""
    momentum_floor: float = -20.0
    """c1, the lower bound of Eq. 4; c2 is 0."""
    base_height_target: float = 0.89
    """Target height of the base above the stance feet [m] (HG)."""
    base_height_kernel: float = 100.0
    """beta^b of Eq. 6 [1/m]."""
    base_height_drop: float = 0.05
    """gamma^b of Eq. 6: relative drop of the target height at the fastest command."""
    clearance_target: float = 0.06
    """Target height of the swing foot above its last contact [m] (HG)."""
    clearance_speed_gain: float = 1.0
    """Relative growth of `clearance_target` at the fastest command (Eq. 7)."""
    clearance_width: float = 0.01
    """Length scale of Eq. 7's kernel, or half width of HG's window [m]."""
    clearance_mid_swing: bool = False
    """True: weights Eq. 7 with 2 sin^2(phase), whose mean over the swing is 1. The height then
    counts in mid-swing, not while the foot lifts off or lands."""
    joint_pos_kernel: float = 2.0
    """-beta^p of Eq. 8 [1/rad]."""
    joint_pos_penalty: float = 0.2
    """gamma^p of Eq. 8."""
    joint_pos_clip: float = 0.5
    """c2, the upper bound in Eq. 8 [rad]; c1 is 0."""
    max_contact_force: float = 700.0
    """Foot force [N] above which `feet_contact_forces` counts (HG)."""
    contact_force_range: float = 400.0
    """Largest excess [N] over `max_contact_force` that counts, for each foot (HG)."""
    longest_air_time: float = 0.5
    """Largest air time [s] that `feet_air_time` counts (HG)."""
    lateral_distance: bool = False
    """True: feet and knee distance are measured across the heading, so that strides do not count.
    False: in the plane (HG)."""
    feet_distance: Range = (0.2, 0.5)
    """Allowed distance of the feet [m] (HG)."""
    knee_distance: Range = (0.2, 0.25)
    """Allowed distance of the knees [m] (HG)."""
    lean_per_speed: float = 0.0
    """Forward lean per commanded speed [rad per m/s] at which `orientation` is best."""
    exact_from: float = 0.5
    """`tracking_mean_vel` and `restless` are 0 while v_max [m/s] <= exact_from."""
    exact_full: float = 2.5
    """`tracking_mean_vel` and `restless` have full size while v_max [m/s] >= exact_full."""
    restless: float = 0.0
    """Weight of squared action changes within the term `stand_still`, at full size."""
    speed_limit_margin: float = 0.9
    """Share of the joint speed limit above which `dof_vel_limits` counts."""

    def __post_init__(self):
        require(self.momentum_scale > 0, "rewards.momentum_scale must be positive")
        require(self.momentum_floor < 0, "rewards.momentum_floor must be negative")
        require(self.clearance_width > 0, "rewards.clearance_width must be positive")
        require(self.max_contact_force >= 0, "rewards.max_contact_force must not be negative")
        require(self.exact_from < self.exact_full, "rewards.exact_from must lie below exact_full")
        _check_range("rewards.feet_distance", self.feet_distance)
        _check_range("rewards.knee_distance", self.knee_distance)


@dataclass(frozen=True)
class CurriculumConfig:
    """Growth of the velocity range (Eq. 9) and shortening of the gait cycle (Eq. 10)."""

    velocity: bool = True
    """True: the range of commanded vx grows. False: it stays at `v_start`."""
    cycle: bool = True
    """True: the gait cycle gets shorter. False: it stays at `gait.cycle_time`."""
    v_min: float = -0.3
    """Lower end of the commanded vx [m/s] (HG)."""
    v_start: float = 0.5
    """First upper end v_max of the commanded vx [m/s]."""
    v_step: float = 0.5
    """Growth of v_max per change [m/s] (Eq. 9)."""
    v_limit: float = 3.5
    """Last v_max [m/s]."""
    cycle_factor: float = 0.95
    """Factor on the gait cycle per change (Eq. 10)."""
    cycle_min: float = 0.48
    """Shortest gait cycle [s]."""
    threshold: float = 0.8
    """lambda of Eq. 9 and 10: share of the maximal tracking reward that all commands must reach."""
    fast_share: float = 0.6
    """Commands above this share of v_max are "fast"."""
    fast_threshold: float = 0.7
    """Share of the maximal tracking reward that fast commands must reach."""
    min_episode_steps: float = 1000.0
    """Mean length of episodes [control steps] that must be reached."""
    gait_threshold: float = -1.0
    """Mean of the term `feet_contact_number` that fast commands must reach. The term is 1 if both
    feet follow the clock and -0.3 if none does. A shuffling gait can track speed too; this excludes
    it. -1: no condition."""
    gait_from: float = 0.0
    """The gate looks at the gait while v_max [m/s] >= gait_from."""
    top_error: float = 1e9
    """Largest relative error of the mean speed under commands in the top `v_step` of the range. The
    range does not grow before the robot can run its top speed. 1e9: no condition."""
    top_error_from: float = 0.0
    """The gate looks at `top_error` while v_max [m/s] >= top_error_from."""
    top_error_floor: float = 2.0
    """For `top_error`, the error is divided by this speed [m/s] if the command is slower. Slow
    walking then needs less relative accuracy."""
    top_falls: float = 1e9
    """Most falls per minute under commands in the top `v_step`. 1e9: no condition."""
    falls_after: float = 0.0
    """For `top_falls`, falls also count so long [s] after such a command has ended: many robots
    fall when they brake."""
    settle_seconds: float = 0.0
    """A command is "settled" this long [s] after it changed; only settled commands count for
    tracking. A robot needs time to reach a new speed, and more in a wider range."""
    smoothing: float = 0.95
    """Share of its old value that a moving average keeps per update."""
    min_updates: int = 40
    """Smallest number of updates between two changes."""

    def __post_init__(self):
        require(0 < self.cycle_factor <= 1, "curriculum.cycle_factor must lie in (0, 1]")
        require(self.v_step > 0, "curriculum.v_step must be positive")
        require(self.v_start > 0, "curriculum.v_start must be positive")
        require(
            self.v_min <= self.v_start <= self.v_limit,
            "curriculum needs v_min <= v_start <= v_limit",
        )
        require(0 <= self.smoothing < 1, "curriculum.smoothing must lie in [0, 1)")
        require(self.top_error > 0, "curriculum.top_error must be positive")
        require(self.top_error_floor > 0, "curriculum.top_error_floor must be positive")
        require(self.top_falls >= 0, "curriculum.top_falls must not be negative")
        require(self.falls_after >= 0, "curriculum.falls_after must not be negative")


@dataclass(frozen=True)
class NetworkConfig:
    """Separate ELU networks for actor and critic; state-independent standard deviation (HG)."""

    actor: tuple[int, ...] = (512, 256, 128)
    """Widths of the actor's hidden layers (HG)."""
    critic: tuple[int, ...] = (768, 256, 128)
    """Widths of the critic's hidden layers (HG)."""
    init_std: float = 1.0
    """Initial standard deviation of the actions (HG)."""
    init_mean: float = 1.0
    """Size of the untrained actor's outputs. Near 0 the untrained policy holds the default pose."""
    symmetric: bool = False
    """True: the networks commute with left-right mirroring. A mirrored robot gets the mirrored
    action and the same value. They need half the work of free networks of the same size."""
    estimator: tuple[int, ...] = ()
    """Widths of the hidden layers of a network that estimates the base's velocity from the actor's
    history. The actor gets the history and the estimate. Empty: no estimator."""

    def __post_init__(self):
        sizes = self.actor + self.critic + self.estimator
        require(all(n > 0 for n in sizes), "network sizes must be positive")
        require(
            not self.symmetric or all(n % 2 == 0 for n in sizes),
            "network sizes must be even with network.symmetric: units come in left-right pairs",
        )
        require(self.init_std > 0, "network.init_std must be positive")


@dataclass(frozen=True)
class PPOConfig:
    """PPO with asymmetric critic and KL-adaptive learning rate (HG; paper, Table I)."""

    rollout_steps: int = 60
    """Control steps of each robot per update."""
    minibatches: int = 4
    """Minibatches per epoch."""
    epochs: int = 2
    """Passes over the samples per update."""
    gamma: float = 0.994
    """Discount factor."""
    lam: float = 0.9
    """Lambda of generalised advantage estimation (GAE)."""
    clip: float = 0.2
    """Clipping of the probability ratio and of the change of the value."""
    value_coef: float = 1.0
    """Weight of the value loss."""
    estimate_coef: float = 1.0
    """Weight of the squared error of the velocity estimate, with `network.estimator`."""
    entropy_coef: float = 0.001
    """Weight of the entropy bonus."""
    entropy_fades: bool = False
    """True: the entropy bonus falls to 0 while the curriculum goes from `v_start` to `v_limit`."""
    max_grad_norm: float = 1.0
    """The gradient is scaled down to this global norm."""
    learning_rate: float = 1e-5
    """Initial value of the adaptive learning rate (Table I). It rises at once."""
    learning_rate_bounds: Range = (1e-5, 1e-2)
    """Bounds of the adaptive learning rate (HG)."""
    desired_kl: float = 0.01
    """The learning rate adapts to this KL divergence per minibatch (HG)."""
    average: float = 0.0
    """The saved policy has a moving average of the acting parameters, which keeps this share per
    update. 0: the newest parameters."""
    learning_rate_factor: float = 1.5
    """Factor of one change of the learning rate (HG)."""

    def __post_init__(self):
        for name in ("rollout_steps", "minibatches", "epochs"):
            require(getattr(self, name) >= 1, f"ppo.{name} must be at least 1")
        require(0 <= self.gamma <= 1, "ppo.gamma must lie in [0, 1]")
        require(0 <= self.lam <= 1, "ppo.lam must lie in [0, 1]")
        for name in ("clip", "max_grad_norm", "desired_kl"):
            require(getattr(self, name) > 0, f"ppo.{name} must be positive")
        require(self.learning_rate_factor >= 1, "ppo.learning_rate_factor must be at least 1")
        require(0 <= self.average < 1, "ppo.average must lie in [0, 1)")
        _check_range("ppo.learning_rate_bounds", self.learning_rate_bounds)
        low, high = self.learning_rate_bounds
        require(low > 0, "ppo.learning_rate_bounds must be positive")
        require(low <= self.learning_rate <= high, "ppo.learning_rate must lie within its bounds")


@dataclass(frozen=True)
class RunConfig:
    """Length, logs and checkpoints of a training. They change no number in a train step."""

    steps: int = 737_525_760
    """Environment steps of the whole training (HG: 3001 iterations of 4096 x 60)."""
    log_every: int = 1
    """Train steps per logged record."""
    checkpoint_minutes: float = 5.0
    """Minutes between checkpoints."""
    keep: int = 3
    """Number of latest checkpoints that are kept; the best one is kept too."""
    snapshots: int = 24
    """Number of policies kept during the run, evenly spaced, for learning curves of each speed."""

    def __post_init__(self):
        require(self.steps >= 1, "run.steps must be at least 1")
        require(self.log_every >= 1, "run.log_every must be at least 1")
        require(self.checkpoint_minutes > 0, "run.checkpoint_minutes must be positive")
        require(self.keep >= 1, "run.keep must be at least 1")
        require(self.snapshots >= 0, "run.snapshots must not be negative")


@dataclass(frozen=True)
class Config:
    """All settings of a training. Static: hashable, and compared by value (without `run`)."""

    seed: int = 0
    """Seed of all random numbers."""
    physics: PhysicsConfig = PhysicsConfig()
    env: EnvConfig = EnvConfig()
    command: CommandConfig = CommandConfig()
    gait: GaitConfig = GaitConfig()
    randomize: RandomizeConfig = RandomizeConfig()
    rewards: RewardConfig = RewardConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    network: NetworkConfig = NetworkConfig()
    ppo: PPOConfig = PPOConfig()
    run: RunConfig = field(default=RunConfig(), compare=False)

    def __post_init__(self):
        _check_numbers("", self)
        require_seed(self.seed)
        for name, seconds in (
            ("env.episode_seconds", self.env.episode_seconds),
            ("command.resample_seconds", self.command.resample_seconds),
            (
                "command.shortest_seconds",
                self.command.shortest_seconds or self.command.resample_seconds,
            ),
            ("randomize.push_seconds", self.randomize.push_seconds or self.control_dt),
        ):
            steps = seconds / self.control_dt
            require(
                0.5 < steps < COUNTER,
                f"{name}: {seconds} s are {steps:.2g} control steps; 1 to 2^31 are allowed",
            )
        require(
            self.batch_size < COUNTER,
            f"env.num_envs x ppo.rollout_steps: {self.batch_size} samples, the limit is 2^31",
        )
        require(
            self.env.arms == "free"
            or self.gait.arm_swing == self.gait.arm_swing_slow == self.gait.elbow_bend == 0.0,
            "env.arms: held arms cannot follow gait.arm_swing, gait.arm_swing_slow and "
            "gait.elbow_bend: set all three to 0, as --without arms does",
        )
        require(
            self.curriculum.settle_seconds < self.command.resample_seconds,
            "curriculum.settle_seconds must be below command.resample_seconds: otherwise no "
            "command settles",
        )
        require(
            self.curriculum.min_episode_steps < self.episode_steps,
            f"curriculum.min_episode_steps must be below the {self.episode_steps} steps of "
            "env.episode_seconds: no episode can be longer",
        )
        require(
            self.curriculum.cycle_min <= self.gait.cycle_time,
            "curriculum.cycle_min must not be above gait.cycle_time, the first cycle",
        )
        require(
            self.batch_size % self.ppo.minibatches == 0,
            f"ppo.minibatches: {self.ppo.minibatches} does not divide the batch of "
            f"{self.env.num_envs} envs x {self.ppo.rollout_steps} steps",
        )

    @property
    def batch_size(self) -> int:
        """Number of samples per update."""
        return self.env.num_envs * self.ppo.rollout_steps

    @property
    def minibatch_size(self) -> int:
        """Number of samples per gradient step."""
        return self.batch_size // self.ppo.minibatches

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.physics.control_dt

    @property
    def episode_steps(self) -> int:
        """Number of control steps until the time limit of an episode."""
        return round(self.env.episode_seconds / self.control_dt)

    @property
    def num_updates(self) -> int:
        """Number of train steps of a whole run, rounded up."""
        return -(-self.run.steps // self.batch_size)
