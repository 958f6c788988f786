"""Settings of the learning: curriculum, networks, PPO and the run."""

from __future__ import annotations

from dataclasses import dataclass

from kslc_jax.config.checks import Range, check_range, require


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
    """Most falls per minute under commands in the top `v_step`, and soon after. 1e9: any number."""
    falls_after: float = 0.0
    """`top_falls` also counts falls and minutes up to this time [s] after a command at the top:
    many robots fall when they brake."""
    settle_seconds: float = 0.0
    """A command is "settled" from this time [s] after its change on. Only settled commands count
    for tracking. A robot needs time to reach a new speed, and more in a wider range."""
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
    """Factor on the initial weights of the actor's output layer. Near 0 the untrained policy holds
    the default pose."""
    symmetric: bool = False
    """True: the networks commute with left-right mirroring. A mirrored robot gets the mirrored
    action and the same value. They need half the work of free networks of the same size."""
    even_inputs: bool = False
    """True: roll, pitch and joint speeds are multiplied before the first layer. Then all
    values of a frame vary by similar amounts. Without it the networks are slow to learn balance:
    roll and pitch are the smallest of their inputs."""
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
    value_per_command: bool = False
    """True: the value of a state is that of holding its present command for ever. A new command
    then ends the sum of rewards, as a time-out does. The next command is random, so its value is
    noise to the policy. The policy is then also not paid for being ready for the next command.
    False: the value expects new commands (HG)."""
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
    """Share of its old value that the moving average of the actor's parameters keeps per update.
    The saved policy has this average. 0: the saved policy has the newest parameters."""
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
        check_range("ppo.learning_rate_bounds", self.learning_rate_bounds)
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
