"""The config's schema: frozen dataclasses with checks; what follows from a value is a property."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from kslc_jax.errors import UserError

NUM_JOINTS = 16

Range = tuple[float, float]

Fidelity = Literal["train", "high"]


class ConfigError(UserError):
    """A config value that cannot work; the message names the field and the fix."""


def require(ok: bool, message: str) -> None:
    if not ok:
        raise ConfigError(message)


COUNTER = 2**31
"""Steps, samples and seeds are 32-bit integers in the compiled train step."""


def require_seed(seed: int, name: str = "seed") -> None:
    require(0 <= seed < COUNTER, f"{name} must not be negative, nor above 2^31")


def _check_numbers(name: str, value: object) -> None:
    """Every number is finite, and every integer one that a shape can hold."""
    if dataclasses.is_dataclass(value):
        for f in dataclasses.fields(value):
            _check_numbers(f"{name}.{f.name}".lstrip("."), getattr(value, f.name))
    elif isinstance(value, tuple):
        for part in value:
            _check_numbers(name, part)
    elif isinstance(value, int | float):
        require(abs(value) < 2**62, f"{name}: {value} is out of bounds")


def _check_range(name: str, value: Range) -> None:
    require(value[0] <= value[1], f"{name}: lower bound {value[0]} is above upper bound {value[1]}")


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation of one control step."""

    fidelity: ClassVar[Fidelity] = "train"

    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: pure XLA, any device. mujoco: C MuJoCo on all CPU cores behind one callback, faster on
    a CPU (docs/performance.md). auto: mjx on an accelerator, mujoco without one."""
    timestep: float = 0.005
    """Physics step [s]; the PD torque is recomputed at each one."""
    decimation: int = 2
    """Physics steps per control step."""
    iterations: int = 4
    """Newton iterations of the contact solver; below 4 contact explodes on this robot."""
    ls_iterations: int = 5
    """Line-search iterations of the contact solver."""
    threads: int = 0
    """CPU threads of the mujoco engine; 0 takes all that this process may use. Does not change
    results."""

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


@dataclass(frozen=True)
class HighFidelity(PhysicsConfig):
    """Evaluation in full C MuJoCo: 1 ms, converged solver, and what robot.load("high") adds."""

    fidelity: ClassVar[Fidelity] = "high"

    engine: Literal["auto", "mjx", "mujoco"] = "mujoco"
    timestep: float = 0.001
    decimation: int = 10
    iterations: int = 100
    ls_iterations: int = 50

    def __post_init__(self):
        super().__post_init__()
        require(self.engine == "mujoco", "high fidelity needs physics.engine mujoco")


@dataclass(frozen=True)
class EnvConfig:
    """Actions, observations and episodes."""

    num_envs: int = 4096
    episode_seconds: float = 24.0
    action_scale: float = 0.25
    """Joint target [rad] = default + scale * action (HG)."""
    action_clip: float = 18.0
    observation_clip: float = 18.0
    action_delay: float = 0.5
    """Largest share of the previous action mixed into this one (HG)."""
    action_noise: float = 0.02
    """Multiplicative action noise (HG)."""
    noise_level: float = 0.6
    """Scales all observation noise (HG); 0 switches it off."""
    frames: int = 15
    """Frames of actor history (paper, Table I)."""
    privileged_frames: int = 3
    """Frames of critic history (paper, Table I)."""
    arms: Literal["free", "held"] = "free"
    """held: arm actions are ignored and the arms servo to zero (ablation, baseline); the gait's
    reference must then not move them."""
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
    """Sampling of commanded velocity and heading. The range of vx is the curriculum's."""

    vy: Range = (-0.3, 0.3)
    heading: Range = (-3.14, 3.14)
    resample_seconds: float = 8.0
    """A command holds this long at most."""
    shortest_seconds: float = 0.0
    """A command holds this long at least, drawn uniformly; 0: always `resample_seconds` (HG)."""
    dead_zone: float = 0.2
    """Commands whose planar norm is at most this become zero [m/s] (HG)."""
    heading_gain: float = 0.5
    max_yaw_rate: float = 1.0
    stand_fraction: float = 0.0
    """Share of commands that are 'stand still'."""
    forward_fraction: float = 0.0
    """Share of commands that are straight ahead (no vy, heading as it is)."""
    slow_fraction: float = 0.0
    """Share of commands whose vx is drawn up to `slow_speed` only: in a wide range slow commands
    are rare."""
    slow_speed: float = 1.0
    """Fastest of those [m/s]."""
    top_fraction: float = 0.0
    """Share of commands whose vx is drawn from the top `curriculum.v_step` of the range. Stops from
    the top speed and starts to it are rare otherwise."""
    narrow_speed: float = 0.0
    """Forward speed [m/s] at which vy and heading changes have shrunk to nothing; 0: never."""
    stand_still: bool = False
    """A zero command hides the gait clock and asks for both feet on the ground (HG marches)."""

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
        require(
            0 <= self.shortest_seconds <= self.resample_seconds,
            "command.shortest_seconds must lie in [0, command.resample_seconds]",
        )


@dataclass(frozen=True)
class GaitConfig:
    """Gait clock and reference motion."""

    cycle_time: float = 0.64
    """Seconds per gait cycle at the start of the curriculum (HG)."""
    double_support: float = 0.1
    """Both feet stand where abs(sin(phase)) is below this (HG)."""
    double_support_at_speed: float = 0.1
    """What `double_support` turns into at `full_speed`, with the square of the speed. Below zero it
    is flight: no foot stands where abs(sin(phase)) is below its size."""
    reference_scale: float = 0.17
    """Amplitude of the hip and ankle reference [rad]; the knee's is twice that (HG)."""
    reference_speed_gain: float = 0.0
    """Relative growth of the leg reference at `full_speed` (paper, Eq. 8: longer strides)."""
    full_speed: float = 3.5
    """Commanded speed [m/s] at which speed-dependent references are fully grown."""
    stride_sweep: float = 0.0
    """Hip reference amplitude [rad] at `full_speed`: the leg lands in front of the body and leaves
    the ground behind it."""
    arm_swing: float = 0.0
    """Shoulder reference amplitude [rad] at `full_speed`, against the same side's leg."""
    arm_swing_slow: float = 0.0
    """The same at the slowest walk."""
    elbow_bend: float = 0.0
    """Elbow flexion reference [rad] at `full_speed`."""
    cycle_follows_speed: bool = False
    """True: slow commands keep `cycle_time`, only the fastest use the curriculum's. The cycle of a
    command then changes whenever the range grows."""
    cycle_from_speed: float = 0.0
    """Above 0: a command's cycle depends on its speed alone. Up to this speed [m/s] it is
    `cycle_time`; from there each `curriculum.v_step` shortens it by `curriculum.cycle_factor`, as
    the curriculum does (Eq. 10), and never below the curriculum's cycle."""
    random_phase: bool = False
    """Episodes start at a random gait phase (HG: phase 0)."""

    def __post_init__(self):
        require(self.cycle_time > 0, "gait.cycle_time must be positive")
        require(0 <= self.double_support < 1, "gait.double_support must lie in [0, 1)")
        require(
            -1 < self.double_support_at_speed < 1,
            "gait.double_support_at_speed must lie in (-1, 1)",
        )
        require(self.full_speed > 0, "gait.full_speed must be positive")


@dataclass(frozen=True)
class RandomizeConfig:
    """Domain randomisation, sampled anew every episode. A range of one value is 'off'."""

    friction: Range = (0.1, 2.0)
    """Foot friction; averaged with the ground's as PhysX does (HG)."""
    ground_friction: float = 0.6
    base_mass: Range = (-5.0, 5.0)
    """Added to the base link [kg] (HG)."""
    base_com: Range = (0.0, 0.0)
    """Shift of the base link's centre of mass, each axis [m]."""
    kp: Range = (1.0, 1.0)
    """Factor on the position gains, per joint."""
    kd: Range = (1.0, 1.0)
    """Factor on the velocity gains, per joint."""
    motor_strength: Range = (1.0, 1.0)
    """Factor on the available torque, per joint."""
    joint_friction: Range = (0.0, 0.0)
    """Coulomb friction of the joints [N m]."""
    link_mass: Range = (1.0, 1.0)
    """Factor on the mass and inertia of each link."""
    link_com: Range = (0.0, 0.0)
    """Shift of each link's centre of mass, each axis [m]."""
    hand_mass: Range = (0.0, 0.0)
    """Added to the last link of each arm, at its centre of mass [kg]."""
    noise: Range = (1.0, 1.0)
    """Factor on sensor noise, action noise and action delay of an episode."""
    push_seconds: float = 4.0
    """Time between pushes; 0: none (HG)."""
    push_velocity: float = 0.2
    """Largest push, x and y [m/s] (HG)."""
    push_angular: float = 0.4
    """Largest push, each axis [rad/s] (HG)."""
    push_adds: bool = True
    """True adds the push to the base's velocity; False sets the velocity to it, as HG does, which
    at 3.5 m/s is running into a wall."""

    def __post_init__(self):
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if isinstance(value, tuple):
                _check_range(f"randomize.{f.name}", value)
        require(self.base_mass[0] > -20, "randomize.base_mass: the base link has 21 kg to lose")
        for name in (
            "kp",
            "kd",
            "motor_strength",
            "friction",
            "joint_friction",
            "noise",
            "hand_mass",
        ):
            require(getattr(self, name)[0] >= 0, f"randomize.{name} must not be negative")
        require(self.link_mass[0] > 0, "randomize.link_mass must be positive")


@dataclass(frozen=True)
class RewardWeights:
    """Weight of each reward term; every one is multiplied by the control step (HG)."""

    # Paper: Eq. 5 to 8 (alpha_p, alpha_f, alpha_b are HG's weights of the same terms), Eq. 4.
    joint_pos: float = 1.6
    feet_clearance: float = 1.0
    base_height: float = 0.2
    angular_momentum: float = 0.05
    # General rewards (HG).
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
    # Ours, off in the paper's presets.
    tracking_mean_vel: float = 0.0
    dof_vel_limits: float = 0.0
    stand_still: float = 0.0


@dataclass(frozen=True)
class RewardConfig:
    """Parameters of the reward terms; weights in `weights`."""

    weights: RewardWeights = RewardWeights()
    only_positive: bool = True
    """Clip the total at >= 0 (HG)."""
    velocity_rewards: bool = True
    """The paper's velocity-related forms (Eq. 6 to 8); False: HG's fixed ones."""
    tracking_sigma: float = 5.0
    """exp(-sigma * squared error) of the tracking terms (HG)."""
    momentum_scale: float = 5.0
    """Angular momentum [kg m^2/s] that makes Eq. 4's exponent 1."""
    momentum_floor: float = -20.0
    """c1 of Eq. 4; c2 is 0."""
    base_height_target: float = 0.89
    base_height_kernel: float = 100.0
    """beta^b of Eq. 6."""
    base_height_drop: float = 0.05
    """gamma^b of Eq. 6: relative lowering of the base at the fastest command."""
    clearance_target: float = 0.06
    """Target height of the swing foot [m] (HG)."""
    clearance_speed_gain: float = 1.0
    """Relative growth of the clearance target at the fastest command (Eq. 7)."""
    clearance_width: float = 0.01
    """Half width of HG's window, or length scale of Eq. 7's kernel as read [m]."""
    clearance_mid_swing: bool = False
    """Weighs the swing foot's height with sin^2 of the gait phase (mean over a half cycle: 1), so
    that it counts in mid-swing and not while the foot leaves the ground or comes down."""
    joint_pos_kernel: float = 2.0
    """-beta^p of Eq. 8."""
    joint_pos_penalty: float = 0.2
    """gamma^p of Eq. 8."""
    joint_pos_clip: float = 0.5
    """c2 of Eq. 8; c1 is 0."""
    max_contact_force: float = 700.0
    """Foot force [N] above which feet_contact_forces counts (HG)."""
    lateral_distance: bool = False
    """Feet and knee distance across the heading, not in the plane, so that strides are free."""
    feet_distance: Range = (0.2, 0.5)
    knee_distance: Range = (0.2, 0.25)
    lean_per_speed: float = 0.0
    """Forward lean [rad per m/s] that `orientation` takes as upright."""
    exact_from: float = 0.5
    """Upper end of the commanded range [m/s] up to which `tracking_mean_vel` and `restless` are
    nothing."""
    exact_full: float = 2.5
    """The same from where on they have their full size."""
    restless: float = 0.0
    """How much the squared changes of the action count within `stand_still`, at full size."""
    speed_limit_margin: float = 0.9
    """Share of the joint speed limit above which dof_vel_limits counts."""

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
    """Velocity range (Eq. 9) and gait cycle (Eq. 10), gated on the tracking reward."""

    velocity: bool = True
    cycle: bool = True
    v_min: float = -0.3
    """Lower end of the commanded vx [m/s] (HG)."""
    v_start: float = 0.5
    v_step: float = 0.5
    v_limit: float = 3.5
    cycle_factor: float = 0.95
    cycle_min: float = 0.48
    threshold: float = 0.8
    """lambda of Eq. 9 and 10: share of the maximal tracking reward."""
    fast_share: float = 0.6
    """Commands above this share of v_max are 'fast'."""
    fast_threshold: float = 0.7
    """Share of the maximal tracking reward that the fast commands must reach."""
    min_episode_steps: float = 1000.0
    gait_threshold: float = -1.0
    """Least mean of the `feet_contact_number` term under fast commands, which is 1 where the feet
    follow the clock and -0.3 where they do the contrary; -1: any. A shuffle can track, too."""
    top_error: float = 1e9
    """Relative error of the mean speed that commands in the top `v_step` of the range may have, for
    the range to grow: what cannot be run is not widened. 1e9: any."""
    top_error_floor: float = 2.0
    """Commands below this speed [m/s] count as if they were this fast: slow walks need not be as
    exact before there are faster ones."""
    top_falls: float = 1e9
    """Falls per minute that those commands may lead to. 1e9: any."""
    settle_seconds: float = 0.0
    """Tracking counts from this long after a change of the command: reaching it takes time, and the
    longer the wider the range is."""
    smoothing: float = 0.95
    """Moving averages keep this share per update."""
    min_updates: int = 40
    """Updates between two changes."""

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


@dataclass(frozen=True)
class NetworkConfig:
    """Actor and critic: separate ELU networks; state-independent standard deviation (HG)."""

    actor: tuple[int, ...] = (512, 256, 128)
    critic: tuple[int, ...] = (768, 256, 128)
    init_std: float = 1.0
    init_mean: float = 1.0
    """Size of the untrained actor's outputs; near 0 every robot starts by holding its pose."""
    symmetric: bool = False
    """Networks that commute with left-right mirroring by construction: a mirrored robot gets the
    mirrored action and the same value. At equal sizes half the work of free ones."""
    estimator: tuple[int, ...] = ()
    """Hidden layers of a network that estimates the base's velocity from the actor's history. The
    actor reads the estimate beside the history. Empty: none."""

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
    """PPO with asymmetric critic and KL-adaptive learning rate (HG, paper Table I)."""

    rollout_steps: int = 60
    minibatches: int = 4
    epochs: int = 2
    gamma: float = 0.994
    lam: float = 0.9
    clip: float = 0.2
    value_coef: float = 1.0
    estimate_coef: float = 1.0
    """Weight of the velocity estimate's squared error, with `network.estimator`."""
    entropy_coef: float = 0.001
    entropy_fades: bool = False
    """True: the entropy bonus falls to nothing on the curriculum's way to `v_limit`."""
    max_grad_norm: float = 1.0
    learning_rate: float = 1e-5
    """Start of the adaptive schedule (Table I); it rises at once."""
    learning_rate_bounds: Range = (1e-5, 1e-2)
    desired_kl: float = 0.01
    average: float = 0.0
    """The policy that is saved averages the actor's parameters; they keep this share per update.
    0: the newest parameters."""
    learning_rate_factor: float = 1.5

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
    """The host's side of a training: length, logs, checkpoints; changes no number of it."""

    steps: int = 737_525_760
    """Environment steps in all (HG: 3001 iterations of 4096 x 60)."""
    log_every: int = 1
    """Train steps per logged record."""
    checkpoint_minutes: float = 5.0
    keep: int = 3
    """Latest checkpoints kept, beside the best one."""
    snapshots: int = 24
    """Policies kept on the way, evenly over the run, for curves of how each speed was learnt."""

    def __post_init__(self):
        require(self.steps >= 1, "run.steps must be at least 1")
        require(self.log_every >= 1, "run.log_every must be at least 1")
        require(self.checkpoint_minutes > 0, "run.checkpoint_minutes must be positive")
        require(self.keep >= 1, "run.keep must be at least 1")
        require(self.snapshots >= 0, "run.snapshots must not be negative")


@dataclass(frozen=True)
class Config:
    """Everything a training depends on. Static: hashable, compared by value."""

    seed: int = 0
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
            require(0.5 < steps < COUNTER, f"{name}: {seconds} s are {steps:.2g} control steps")
        require(
            self.batch_size < COUNTER,
            f"env.num_envs x ppo.rollout_steps: {self.batch_size} samples are more than 2^31",
        )
        require(
            self.env.arms == "free"
            or self.gait.arm_swing == self.gait.arm_swing_slow == self.gait.elbow_bend == 0.0,
            "env.arms: held arms cannot follow gait.arm_swing, gait.arm_swing_slow and "
            "gait.elbow_bend, set all to 0 (--without arms does)",
        )
        require(
            self.curriculum.settle_seconds < self.command.resample_seconds,
            "curriculum.settle_seconds must be below command.resample_seconds: no command would "
            "ever count",
        )
        require(
            self.curriculum.min_episode_steps < self.episode_steps,
            f"curriculum.min_episode_steps must be below the {self.episode_steps} steps of "
            "env.episode_seconds: no episode would ever do",
        )
        require(
            self.curriculum.cycle_min <= self.gait.cycle_time,
            "curriculum.cycle_min must not be above gait.cycle_time, where the cycle starts",
        )
        require(
            self.batch_size % self.ppo.minibatches == 0,
            f"ppo.minibatches: {self.ppo.minibatches} does not divide the batch of "
            f"{self.env.num_envs} envs x {self.ppo.rollout_steps} steps",
        )

    @property
    def batch_size(self) -> int:
        """Samples per update."""
        return self.env.num_envs * self.ppo.rollout_steps

    @property
    def minibatch_size(self) -> int:
        """Samples per gradient step."""
        return self.batch_size // self.ppo.minibatches

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.physics.control_dt

    @property
    def episode_steps(self) -> int:
        """Control steps until the time limit."""
        return round(self.env.episode_seconds / self.control_dt)

    @property
    def num_updates(self) -> int:
        """Train steps of a whole run."""
        return -(-self.run.steps // self.batch_size)
