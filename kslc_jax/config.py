"""Every number that a user may change, as frozen, checked dataclasses, and the named presets.

Imports no JAX: a config can be read, checked and printed before anything heavy starts. One value
lives in one place; what follows from it is a property. `rewards.weights` holds one field per reward
term of `kslc_jax.rewards.TERMS`.

Sources: "paper" is Zhang et al., KSLC (Tables I and II, Eq. 2 to 10); "HG" is Humanoid-Gym, which
the paper builds on and which settles what the paper leaves open. Each departure is explained in
docs/fidelity.md.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import typing
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

SCHEMA_VERSION = 1
NUM_JOINTS = 16

Range = tuple[float, float]


class ConfigError(ValueError):
    """A config value that cannot work; the message names the field and the fix."""


def _check(ok: bool, message: str) -> None:
    if not ok:
        raise ConfigError(message)


def _check_range(name: str, value: Range) -> None:
    _check(value[0] <= value[1], f"{name}: lower bound {value[0]} is above upper bound {value[1]}")


@dataclass(frozen=True)
class PhysicsConfig:
    """Simulation of one control step."""

    fidelity: ClassVar[Literal["train", "high"]] = "train"

    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """mjx: pure XLA, any device. mujoco: C MuJoCo on all CPU cores behind one callback, over twice
    as fast on a CPU. auto: mjx on an accelerator, mujoco without one."""
    timestep: float = 0.005
    """Physics step [s]; the PD torque is recomputed at each one."""
    decimation: int = 2
    """Physics steps per control step."""
    iterations: int = 4
    """Newton iterations of the contact solver; below 4 contact explodes on this robot."""
    ls_iterations: int = 5
    """Line-search iterations of the contact solver."""
    threads: int = 0
    """CPU threads of the mujoco engine; 0 takes all cores. Does not change results."""

    def __post_init__(self):
        _check(self.timestep > 0, "physics.timestep must be positive")
        _check(self.decimation >= 1, "physics.decimation must be at least 1")
        _check(self.iterations >= 1, "physics.iterations must be at least 1")
        _check(self.ls_iterations >= 1, "physics.ls_iterations must be at least 1")
        _check(self.threads >= 0, "physics.threads must be 0 (all cores) or more")

    @property
    def control_dt(self) -> float:
        """Seconds per control step."""
        return self.timestep * self.decimation


@dataclass(frozen=True)
class HighFidelity(PhysicsConfig):
    """Evaluation in full C MuJoCo: 1 ms, converged solver, and what robot.load("high") adds."""

    fidelity: ClassVar[Literal["train", "high"]] = "high"

    engine: Literal["auto", "mjx", "mujoco"] = "mujoco"
    timestep: float = 0.001
    decimation: int = 10
    iterations: int = 100
    ls_iterations: int = 50

    def __post_init__(self):
        super().__post_init__()
        _check(self.engine == "mujoco", "high fidelity needs physics.engine mujoco")


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
    """held: arm actions are ignored and the arms servo to zero (ablation, baseline)."""
    reset_joint_noise: float = 0.1
    """Initial joint angles are default + U(-x, x) [rad] (HG)."""

    def __post_init__(self):
        _check(self.num_envs >= 1, "env.num_envs must be at least 1")
        _check(self.episode_seconds > 0, "env.episode_seconds must be positive")
        _check(self.frames >= 1, "env.frames must be at least 1")
        _check(self.privileged_frames >= 1, "env.privileged_frames must be at least 1")
        _check(0 <= self.action_delay <= 1, "env.action_delay must lie in [0, 1]")


@dataclass(frozen=True)
class CommandConfig:
    """Sampling of commanded velocity and heading. The range of vx is the curriculum's."""

    vy: Range = (-0.3, 0.3)
    heading: Range = (-3.14, 3.14)
    resample_seconds: float = 8.0
    dead_zone: float = 0.2
    """Commands whose planar norm is at most this become zero [m/s] (HG)."""
    heading_gain: float = 0.5
    max_yaw_rate: float = 1.0
    stand_fraction: float = 0.0
    """Share of commands that are 'stand still'."""
    forward_fraction: float = 0.0
    """Share of commands that are straight ahead (no vy, heading as it is)."""
    narrow_speed: float = 0.0
    """Forward speed [m/s] at which vy and heading changes have shrunk to nothing; 0: never."""
    stand_still: bool = False
    """Zero command stops the gait clock and asks for both feet on the ground (HG marches)."""

    def __post_init__(self):
        _check_range("command.vy", self.vy)
        _check_range("command.heading", self.heading)
        _check(self.resample_seconds > 0, "command.resample_seconds must be positive")
        _check(
            0 <= self.stand_fraction + self.forward_fraction <= 1,
            "command.stand_fraction + command.forward_fraction must lie in [0, 1]",
        )


@dataclass(frozen=True)
class GaitConfig:
    """Gait clock and reference motion."""

    cycle_time: float = 0.64
    """Seconds per gait cycle at the start of the curriculum (HG)."""
    double_support: float = 0.1
    """Both feet stand where abs(sin(phase)) is below this (HG)."""
    reference_scale: float = 0.17
    """Amplitude of the hip and ankle reference [rad]; the knee's is twice that (HG)."""
    reference_speed_gain: float = 0.0
    """Relative growth of the leg reference at `full_speed` (paper, Eq. 8: longer strides)."""
    full_speed: float = 3.5
    """Commanded speed [m/s] at which speed-dependent references are fully grown."""
    arm_swing: float = 0.0
    """Shoulder reference amplitude [rad] at `full_speed`, against the same side's leg."""
    elbow_bend: float = 0.0
    """Elbow flexion reference [rad] at `full_speed`."""
    cycle_follows_speed: bool = False
    """True: slow commands keep `cycle_time`, only the fastest use the curriculum's."""
    random_phase: bool = False
    """Episodes start at a random gait phase (HG: phase 0)."""

    def __post_init__(self):
        _check(self.cycle_time > 0, "gait.cycle_time must be positive")
        _check(0 <= self.double_support < 1, "gait.double_support must lie in [0, 1)")
        _check(self.full_speed > 0, "gait.full_speed must be positive")


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
        for name in ("kp", "kd", "motor_strength", "friction"):
            _check(getattr(self, name)[0] >= 0, f"randomize.{name} must not be negative")


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
    speed_limit_margin: float = 0.9
    """Share of the joint speed limit above which dof_vel_limits counts."""

    def __post_init__(self):
        _check(self.momentum_scale > 0, "rewards.momentum_scale must be positive")
        _check(self.momentum_floor < 0, "rewards.momentum_floor must be negative")
        _check(self.clearance_width > 0, "rewards.clearance_width must be positive")


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
    smoothing: float = 0.95
    """Moving averages keep this share per update."""
    min_updates: int = 40
    """Updates between two changes."""

    def __post_init__(self):
        _check(0 < self.cycle_factor <= 1, "curriculum.cycle_factor must lie in (0, 1]")
        _check(self.v_step > 0, "curriculum.v_step must be positive")
        _check(
            self.v_min <= self.v_start <= self.v_limit,
            "curriculum needs v_min <= v_start <= v_limit",
        )
        _check(0 <= self.smoothing < 1, "curriculum.smoothing must lie in [0, 1)")


@dataclass(frozen=True)
class NetworkConfig:
    """Actor and critic: separate ELU networks; state-independent standard deviation (HG)."""

    actor: tuple[int, ...] = (512, 256, 128)
    critic: tuple[int, ...] = (768, 256, 128)
    init_std: float = 1.0
    symmetric: bool = False
    """Actor equivariant under left-right mirroring by construction."""

    def __post_init__(self):
        _check(all(n > 0 for n in self.actor + self.critic), "network sizes must be positive")
        _check(self.init_std > 0, "network.init_std must be positive")


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
    entropy_coef: float = 0.001
    max_grad_norm: float = 1.0
    learning_rate: float = 1e-5
    """Start of the adaptive schedule (Table I); it rises at once."""
    learning_rate_bounds: Range = (1e-5, 1e-2)
    desired_kl: float = 0.01
    learning_rate_factor: float = 1.5

    def __post_init__(self):
        for name in ("rollout_steps", "minibatches", "epochs"):
            _check(getattr(self, name) >= 1, f"ppo.{name} must be at least 1")
        _check(0 <= self.gamma <= 1, "ppo.gamma must lie in [0, 1]")
        _check(0 <= self.lam <= 1, "ppo.lam must lie in [0, 1]")
        _check_range("ppo.learning_rate_bounds", self.learning_rate_bounds)


@dataclass(frozen=True)
class RunConfig:
    """The host's side of a training: length, logs, checkpoints; changes no number of it."""

    steps: int = 737_000_000
    """Environment steps in all (paper's base: 3001 iterations of 4096 x 60)."""
    log_every: int = 1
    """Train steps per logged record."""
    checkpoint_minutes: float = 5.0
    keep: int = 3
    """Latest checkpoints kept, beside the best one."""

    def __post_init__(self):
        _check(self.steps >= 1, "run.steps must be at least 1")
        _check(self.log_every >= 1, "run.log_every must be at least 1")
        _check(self.checkpoint_minutes > 0, "run.checkpoint_minutes must be positive")
        _check(self.keep >= 1, "run.keep must be at least 1")


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
        _check(self.seed >= 0, "seed must not be negative")
        _check(
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


# --------------------------------------------------------------------------------------- presets


def _override(config: Any, **changes: Any) -> Any:
    """`dataclasses.replace`, where a dict value replaces fields of a nested config."""
    new = {
        name: _override(getattr(config, name), **value) if isinstance(value, dict) else value
        for name, value in changes.items()
    }
    return dataclasses.replace(config, **new)


_PAPER = Config()

# Humanoid-Gym as the paper compares against: fixed rewards, arms held, no KSLC terms, fixed cycle,
# commands up to the paper's top speed from the start.
_BASELINE = _override(
    _PAPER,
    env={"arms": "held"},
    rewards={"velocity_rewards": False, "weights": {"angular_momentum": 0.0}},
    curriculum={"velocity": False, "cycle": False, "v_start": 3.5},
)

# Learns fast on two CPU cores. What it changes and why: docs/fidelity.md, "The laptop preset".
_LAPTOP_LEARNER: dict[str, Any] = {
    "env": {"num_envs": 2048, "frames": 5},
    "network": {"actor": (256, 128, 64), "critic": (256, 128, 64), "init_std": 0.6},
    "ppo": {
        "rollout_steps": 24,
        "minibatches": 4,
        "epochs": 5,
        "entropy_coef": 0.003,
        "learning_rate": 1e-3,
        "learning_rate_bounds": (1e-5, 1e-3),
    },
    "run": {"steps": 40_000_000},
}

_LAPTOP = _override(
    _override(_PAPER, **_LAPTOP_LEARNER),
    network={"symmetric": True},
    command={
        "stand_fraction": 0.1,
        "forward_fraction": 0.2,
        "narrow_speed": 4.0,
        "stand_still": True,
    },
    gait={
        "reference_speed_gain": 1.0,
        "arm_swing": 0.5,
        "elbow_bend": 1.0,
        "cycle_follows_speed": True,
        "random_phase": True,
    },
    rewards={
        "base_height_kernel": 30.0,
        "clearance_width": 0.03,
        "max_contact_force": 1400.0,
        "lateral_distance": True,
        "lean_per_speed": 0.03,
        "weights": {
            "tracking_lin_vel": 1.6,
            "track_vel_hard": 0.8,
            "dof_vel_limits": -0.5,
            "stand_still": -0.3,
        },
    },
)

_DEBUG = _override(
    _LAPTOP,
    env={"num_envs": 16, "frames": 3},
    network={"actor": (32, 16), "critic": (32, 16)},
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

# The paper's ablations: one switch each, on any preset.
ABLATIONS: dict[str, dict[str, Any]] = {
    "arms": {"env": {"arms": "held"}},
    "angular-momentum": {"rewards": {"weights": {"angular_momentum": 0.0}}},
    "velocity-rewards": {"rewards": {"velocity_rewards": False}},
    "velocity-curriculum": {"curriculum": {"velocity": False, "v_start": 3.5}},
    "cycle-curriculum": {"curriculum": {"cycle": False}},
}


def _lookup(kind: str, name: str, table: dict[str, Any]) -> Any:
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


# ---------------------------------------------------------------------------------------- storage


def to_dict(config: Config) -> dict[str, Any]:
    """Plain nested dict for JSON, with the schema version."""
    return {"schema": SCHEMA_VERSION, **dataclasses.asdict(config)}


def from_dict(data: dict[str, Any]) -> Config:
    """Inverse of `to_dict`; ConfigError names a missing, unknown or mistyped field."""
    _check(isinstance(data, dict), "config: not a JSON object")
    data = dict(data)
    schema = data.pop("schema", None)
    _check(
        schema == SCHEMA_VERSION,
        f"config: schema version {schema}, this kslc_jax reads version {SCHEMA_VERSION}",
    )
    return _build(Config, data, "config")


def _build(cls: type, data: Any, where: str) -> Any:
    _check(isinstance(data, dict), f"{where}: expected an object, got {type(data).__name__}")
    resolved = typing.get_type_hints(cls)
    hints = {f.name: resolved[f.name] for f in dataclasses.fields(cls)}
    unknown = set(data) - set(hints)
    _check(not unknown, f"{where}: unknown field {', '.join(sorted(unknown))}")
    missing = set(hints) - set(data)
    _check(not missing, f"{where}: missing field {', '.join(sorted(missing))}")
    return cls(**{name: _value(hints[name], data[name], f"{where}.{name}") for name in hints})


def _value(hint: Any, value: Any, where: str) -> Any:
    """One field's value, checked against its annotation."""
    wrong = f"{where}: {json.dumps(value, default=str)} is not a valid value"
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, where)
    if origin is Literal:
        _check(value in typing.get_args(hint), wrong)
        return value
    if origin is tuple:
        _check(isinstance(value, list | tuple), wrong)
        args = typing.get_args(hint)
        _check(args[-1] is Ellipsis or len(value) == len(args), wrong)
        return tuple(_value(args[0], v, where) for v in value)
    if hint is float:
        _check(isinstance(value, int | float) and not isinstance(value, bool), wrong)
        return float(value)
    _check(isinstance(value, hint) and (hint is bool or not isinstance(value, bool)), wrong)
    return value
