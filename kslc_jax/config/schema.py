"""All settings of a training in one value, and the checks between its groups."""

from __future__ import annotations

from dataclasses import dataclass, field

from kslc_jax.config.checks import COUNTER, check_numbers, require, require_seed
from kslc_jax.config.env import CommandConfig, EnvConfig, GaitConfig, RandomizeConfig
from kslc_jax.config.learning import CurriculumConfig, NetworkConfig, PPOConfig, RunConfig
from kslc_jax.config.physics import PhysicsConfig
from kslc_jax.config.rewards import RewardConfig


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
        check_numbers("", self)
        require_seed(self.seed)
        self._check_durations()
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

    def _check_durations(self) -> None:
        """Raises ConfigError for a duration of half a control step or less, or of 2^31 or more."""
        for name, seconds in {
            "env.episode_seconds": self.env.episode_seconds,
            "command.resample_seconds": self.command.resample_seconds,
            "command.shortest_seconds": self.command.shortest_seconds
            or self.command.resample_seconds,
            "randomize.push_seconds": self.randomize.push_seconds or self.control_dt,
        }.items():
            steps = seconds / self.control_dt
            require(
                0.5 < steps < COUNTER,
                f"{name}: {seconds} s are {steps:.2g} control steps; 1 to 2^31 are allowed",
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
