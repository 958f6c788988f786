"""Settings of the rewards: one weight per term, and the shape of the terms."""

from __future__ import annotations

from dataclasses import dataclass

from kslc_jax.config.checks import Range, check_range, require


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
    """Target height of the base above the soles of the stance feet [m] (HG)."""
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
    """True: weights Eq. 7 with 2 sin^2(2 pi phase), whose mean over the swing is 1. The height then
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
    default_pose_margin: float = 0.1
    """Sum over the legs of the sizes of (roll, yaw) [rad] that costs nothing in `default_joint_pos`
    (HG)."""
    lean_per_speed: float = 0.0
    """Forward lean per commanded speed [rad per m/s] at which `orientation` is best."""
    exact_from: float = 0.5
    """`tracking_mean_vel`, `restless`, `shuffle`, `fall` are 0 while v_max [m/s] <= exact_from."""
    exact_full: float = 2.5
    """They have full size while v_max [m/s] >= exact_full."""
    restless: float = 0.0
    """Weight of squared action changes within the term `stand_still`, at full size."""
    shuffle: float = 0.0
    """Weight of moving feet within `stand_still`, at full size."""
    shuffle_speed: float = 0.3
    """Root of the summed squared speeds of both feet [m/s] at which the cost of moving feet is
    0.63 of `shuffle`. Faster feet cost more, up to `shuffle`."""
    speed_limit_margin: float = 0.9
    """Share of the joint speed limit above which `dof_vel_limits` counts."""
    fall: float = 0.0
    """Cost of a fall, at full size: once, not per second, and also with `only_positive`."""

    def __post_init__(self):
        require(self.momentum_scale > 0, "rewards.momentum_scale must be positive")
        require(self.momentum_floor < 0, "rewards.momentum_floor must be negative")
        require(self.clearance_width > 0, "rewards.clearance_width must be positive")
        require(self.max_contact_force >= 0, "rewards.max_contact_force must not be negative")
        require(self.shuffle_speed > 0, "rewards.shuffle_speed must be positive")
        require(self.fall >= 0, "rewards.fall must not be negative")
        require(self.exact_from < self.exact_full, "rewards.exact_from must lie below exact_full")
        check_range("rewards.feet_distance", self.feet_distance)
        check_range("rewards.knee_distance", self.knee_distance)
