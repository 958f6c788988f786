"""Reward terms: small pure functions of one environment's `Inputs`, and their weighted sum.

Every term returns its unweighted value, which is logged. Terms are Humanoid-Gym's (HG) unless they
name an equation of the paper, or say "ours". "As read": the printed equation is open or cannot
work, and docs/fidelity.md gives our reading.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax.commands import Command, speed_share
from kslc_jax.config import RewardConfig
from kslc_jax.gait import GaitState
from kslc_jax.maths import norm, quat_rotate_inverse
from kslc_jax.robot import Robot
from kslc_jax.signals import Signals


@flax.struct.dataclass
class Inputs:
    """Inputs of the reward terms. `last_*` are values of the control step before."""

    signals: Signals
    gait: GaitState
    command: Command
    reference: jax.Array  # [n] rad
    action: jax.Array  # [n] as applied: delayed and noisy
    last_action: jax.Array  # [n]
    last_last_action: jax.Array  # [n]
    last_joint_vel: jax.Array  # [n] rad/s
    last_base_velocity: jax.Array  # [6] world, m/s and rad/s
    v_max: jax.Array  # [] m/s, upper end of the commanded range


Term = Callable[[RewardConfig, Robot, float, Inputs], jax.Array]
"""(config, robot, control step [s], inputs) -> unweighted value []."""


# ------------------------------------------------------------------- paper: angular momentum, Eq. 4


def angular_momentum(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Eq. 4 as read: clip(1 - exp(|L| / scale), c1, 0). It is 0 at rest and falls with |L|."""
    exponent = norm(x.signals.angular_momentum) / cfg.momentum_scale
    # The cap on the exponent prevents an overflow of exp. The clip acts beyond it anyway.
    exponent = jnp.minimum(exponent, jnp.log(1.0 - cfg.momentum_floor))
    return jnp.clip(1.0 - jnp.exp(exponent), cfg.momentum_floor, 0.0)


# -------------------------------------------------------------- paper: velocity-related, Eq. 6 to 8


def base_height(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Eq. 6 as read: exp(-beta |h - (1 - gamma g) target|); HG's form has gamma = 0.

    h [m] is the height of the base above the soles of the stance feet.
    """
    stance = x.gait.stance.astype(jnp.float32)
    feet = jnp.sum(x.signals.foot_pos[:, 2] * stance) / jnp.maximum(jnp.sum(stance), 1.0)
    # In a flight phase of the clock there is no stance foot: h is then above the floor.
    sole = jnp.where(jnp.any(x.gait.stance), feet - robot.sole_drop, 0.0)
    height = x.signals.base_pos[2] - sole
    drop = cfg.base_height_drop * speed_share(x.command, x.v_max) if cfg.velocity_rewards else 0.0
    target = cfg.base_height_target * (1.0 - drop)
    return jnp.exp(-cfg.base_height_kernel * jnp.abs(height - target))


def feet_clearance(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Eq. 7 as read: sum over the swing feet of exp(-|h - (1 + gain g) target| / width).

    h [m] is the swing height. With `clearance_mid_swing` each foot is weighted with
    2 sin^2(2 pi phase). HG's form counts the swing feet with |h - target| < width.
    """
    swing = ~x.gait.stance
    if not cfg.velocity_rewards:
        near = jnp.abs(x.gait.swing_height - cfg.clearance_target) < cfg.clearance_width
        return jnp.sum(near & swing).astype(jnp.float32)
    gain = cfg.clearance_speed_gain * speed_share(x.command, x.v_max)
    error = jnp.abs(x.gait.swing_height - cfg.clearance_target * (1.0 + gain))
    mid_swing = 2.0 * jnp.square(x.gait.clock[0]) if cfg.clearance_mid_swing else 1.0
    return jnp.sum(jnp.exp(-error / cfg.clearance_width) * swing * mid_swing)


def joint_pos(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Eq. 8 as read: exp(-kernel n) - penalty clip(n, 0, c2), with n = |w (q - reference)|.

    w = exp(-|joint speed| / speed limit) for each joint; HG's form has w = 1.
    """
    error = x.signals.joint_pos - x.reference
    if cfg.velocity_rewards:
        error = error * jnp.exp(-jnp.abs(x.signals.joint_vel) / robot.speed_limit)
    n = norm(error)
    penalty = cfg.joint_pos_penalty * jnp.clip(n, 0.0, cfg.joint_pos_clip)
    return jnp.exp(-cfg.joint_pos_kernel * n) - penalty


# ----------------------------------------------------------------------------------- HG: tracking


def tracking_lin_vel(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """exp(-sigma |xy velocity error|^2), base frame. At most 1; the curriculum is gated on it."""
    error = x.signals.base_linvel[:2] - x.command.velocity[:2]
    return jnp.exp(-cfg.tracking_sigma * jnp.sum(jnp.square(error)))


def tracking_ang_vel(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """exp(-sigma (yaw-rate error)^2)."""
    error = x.signals.base_angvel[2] - x.command.velocity[2]
    return jnp.exp(-cfg.tracking_sigma * jnp.square(error))


def vel_mismatch_exp(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Mean of exp(-10 vz^2) and exp(-5 |roll and pitch rate|), base frame."""
    vertical = jnp.exp(-10.0 * jnp.square(x.signals.base_linvel[2]))
    return 0.5 * (vertical + jnp.exp(-5.0 * norm(x.signals.base_angvel[:2])))


def low_speed(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Compares vx with the commanded vx, base frame. s is the ratio of their sizes.

    -1 if s < 0.5, 0 if s > 1.2, else 1.2; -2 if the signs differ. 0 for commands up to 0.1 m/s.
    """
    speed, command = x.signals.base_linvel[0], x.command.velocity[0]
    share = jnp.abs(speed) / jnp.maximum(jnp.abs(command), 1e-6)
    value = jnp.where(share < 0.5, -1.0, jnp.where(share > 1.2, 0.0, 1.2))
    value = jnp.where(jnp.sign(speed) != jnp.sign(command), -2.0, value)
    return value * (jnp.abs(command) > 0.1)


def track_vel_hard(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sharp kernels of the velocity errors, minus 0.2 times the errors.

    The linear part has a gradient at any distance.
    """
    linear = norm(x.signals.base_linvel[:2] - x.command.velocity[:2])
    angular = jnp.abs(x.signals.base_angvel[2] - x.command.velocity[2])
    kernels = 0.5 * (jnp.exp(-10.0 * linear) + jnp.exp(-10.0 * angular))
    return kernels - 0.2 * (linear + angular)


def tracking_mean_vel(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """exp(-10 |mean xy velocity error|), times `_exactness` (ours).

    The mean is over about one gait cycle. Within a stride the speed varies more than the errors of
    the mean speed that this term must detect. Each moment's velocity is compared with the command
    of that moment. A mean velocity would lag behind a new command, and pay a robot to overshoot it.
    """
    exact = jnp.exp(-10.0 * norm(x.gait.mean_error))
    return exact * _exactness(cfg, x)


def _exactness(cfg: RewardConfig, x: Inputs) -> jax.Array:
    """Factor [] that grows from 0 to 1 while v_max grows from `exact_from` to `exact_full`.

    Terms that demand exactness or caution would hinder a policy that cannot walk yet.
    """
    grown = (x.v_max - cfg.exact_from) / (cfg.exact_full - cfg.exact_from)
    return jnp.clip(grown, 0.0, 1.0)


# --------------------------------------------------------------------------------------- HG: feet


def feet_contact_number(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Mean over the feet: 1 if contact and clock agree, else -0.3."""
    return jnp.mean(jnp.where(x.signals.foot_contact == x.gait.stance, 1.0, -0.3))


def feet_air_time(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum of the air times [s] of the feet that just landed, at most `longest_air_time` each."""
    return jnp.sum(jnp.clip(x.gait.landed_air_time, 0.0, cfg.longest_air_time))


def foot_slip(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum over the feet in contact of the square root of their planar speed [m/s]."""
    speed = norm(x.signals.foot_vel[:, :2])
    return jnp.sum(jnp.sqrt(speed) * x.signals.foot_contact)


def feet_contact_forces(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum of the foot forces [N] above `max_contact_force`, at most `contact_force_range` each."""
    excess = x.signals.foot_force - cfg.max_contact_force
    return jnp.sum(jnp.clip(excess, 0.0, cfg.contact_force_range))


def _spread(cfg: RewardConfig, x: Inputs, points: jax.Array, bounds: tuple[float, float]):
    """1 while the distance of two points [2, 3] lies within `bounds` [m].

    Outside it is 0.5 + 0.5 exp(-100 d); d [m] is the distance to the nearer bound, at most 0.5.
    The distance of the points is planar, or with `lateral_distance` across the heading.
    """
    apart = points[0] - points[1]
    lateral = jnp.abs(_heading_frame(x, apart)[1])
    distance = lateral if cfg.lateral_distance else norm(apart[:2])
    near = jnp.clip(distance - bounds[0], -0.5, 0.0)
    far = jnp.clip(distance - bounds[1], 0.0, 0.5)
    return 0.5 * (jnp.exp(-100.0 * jnp.abs(near)) + jnp.exp(-100.0 * jnp.abs(far)))


def _heading_frame(x: Inputs, vector: jax.Array) -> jax.Array:
    """Rotates a world vector [3] into the frame that is turned by the robot's yaw."""
    half = 0.5 * x.signals.base_euler[2]
    zero = jnp.zeros(())
    return quat_rotate_inverse(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)]), vector)


def feet_distance(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Keeps the distance of the feet within `feet_distance`, see `_spread`."""
    return _spread(cfg, x, x.signals.foot_pos, cfg.feet_distance)


def knee_distance(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Keeps the distance of the knees within `knee_distance`, see `_spread`."""
    return _spread(cfg, x, x.signals.knee_pos, cfg.knee_distance)


# ------------------------------------------------------------------------------------ HG: posture


def default_joint_pos(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """exp(-100 (x - default_pose_margin)), at most 1, minus 0.01 |joint angles|.

    x [rad] is the size of (roll, yaw) of the left leg plus that of the right leg.
    """
    q = x.signals.joint_pos
    legs = sum(norm(q[np.array(robot.roll_and_yaw(side), int)]) for side in ("left", "right"))
    return jnp.exp(-100.0 * jnp.clip(legs - cfg.default_pose_margin, 0.0, 50.0)) - 0.01 * norm(q)


def orientation(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Mean of exp(-10 (|roll| + |pitch - lean|)) and exp(-20 |g_xy - (sin lean, 0)|).

    lean [rad] is `lean_per_speed` times the commanded |vx|. g is the unit vector of gravity in the
    base frame.
    """
    lean = cfg.lean_per_speed * jnp.abs(x.command.velocity[0])
    roll, pitch = x.signals.base_euler[0], x.signals.base_euler[1] - lean
    upright = jnp.stack([jnp.sin(lean), jnp.zeros(())])
    tilt = norm(x.signals.gravity[:2] - upright)
    return 0.5 * (jnp.exp(-10.0 * (jnp.abs(roll) + jnp.abs(pitch))) + jnp.exp(-20.0 * tilt))


def base_acc(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """exp(-3 |dv|). dv [6] is the change of the base's velocity over one control step.

    Its linear part is in m/s, its angular part in rad/s, both in the world frame.
    """
    return jnp.exp(-3.0 * norm(x.signals.base_velocity - x.last_base_velocity))


def collision(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """1 if the torso touches the ground, else 0."""
    return x.signals.torso_contact.astype(jnp.float32)


def stand_still(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """|q| + 0.1 |dq| + e (restless |da|^2 + shuffle (1 - exp(-|v| / shuffle_speed))) (ours).

    q [rad] are the joint angles, dq [rad/s] their speeds, da the change of the action, v [m/s] the
    velocities of both feet, and e is `_exactness`. The term is 0 while the command is to move.

    Action changes are squared. Exploration noise then adds a constant on average, so changes of the
    mean action still count. Moving feet cost, because a robot that shuffles them creeps. The noise
    is large in early training and would dominate the term. So these two grow with the range of
    commands.

    The cost of the feet has a bound. Without one, the total of a robot that steps is below zero.
    With `only_positive` it is then 0 whatever the robot does, so the robot cannot learn to stand.
    With |v|^2 in place of |v|, a robot that trembles would pay nearly the whole cost. It would save
    little by calmer feet, and the last few cm/s would cost nothing.
    """
    moved = norm(x.signals.joint_pos) + 0.1 * norm(x.signals.joint_vel)
    unquiet = cfg.restless * _action_change(x)
    feet = norm(x.signals.foot_vel.reshape(-1))
    unquiet += cfg.shuffle * (1.0 - jnp.exp(-feet / cfg.shuffle_speed))
    return jnp.where(x.command.moving, 0.0, moved + unquiet * _exactness(cfg, x))


# ------------------------------------------------------------------------------------- HG: effort


def action_smoothness(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Squared first and second differences of the action, plus 0.05 times its L1 norm."""
    second = jnp.sum(jnp.square(x.action + x.last_last_action - 2.0 * x.last_action))
    return _action_change(x) + second + 0.05 * jnp.sum(jnp.abs(x.action))


def _action_change(x: Inputs) -> jax.Array:
    """Sum of squared changes of the action since the control step before."""
    return jnp.sum(jnp.square(x.action - x.last_action))


def torques(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum of squared joint torques [N m]: motor torque minus joint friction."""
    return jnp.sum(jnp.square(x.signals.torque))


def dof_vel(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum of squared joint speeds [rad/s]."""
    return jnp.sum(jnp.square(x.signals.joint_vel))


def dof_acc(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum of squared joint accelerations [rad/s^2], from the speeds of two control steps."""
    return jnp.sum(jnp.square((x.signals.joint_vel - x.last_joint_vel) / dt))


def dof_vel_limits(cfg: RewardConfig, robot: Robot, dt: float, x: Inputs) -> jax.Array:
    """Sum over the joints of (speed / limit - `speed_limit_margin`), each within [0, 1] (ours)."""
    over = jnp.abs(x.signals.joint_vel) / robot.speed_limit - cfg.speed_limit_margin
    return jnp.sum(jnp.clip(over, 0.0, 1.0))


TERMS: dict[str, Term] = {
    term.__name__: term
    for term in (
        angular_momentum,
        base_height,
        feet_clearance,
        joint_pos,
        tracking_lin_vel,
        tracking_ang_vel,
        vel_mismatch_exp,
        low_speed,
        track_vel_hard,
        tracking_mean_vel,
        feet_contact_number,
        feet_air_time,
        foot_slip,
        feet_contact_forces,
        feet_distance,
        knee_distance,
        default_joint_pos,
        orientation,
        base_acc,
        collision,
        stand_still,
        action_smoothness,
        torques,
        dof_vel,
        dof_acc,
        dof_vel_limits,
    )
}


def evaluate(
    cfg: RewardConfig, robot: Robot, dt: float, x: Inputs
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """(reward [], unweighted value of every term).

    The reward is the weighted sum times `dt`. With `only_positive` it is at least 0 (HG). A fall
    then costs `fall` times `_exactness` (ours). A robot that brakes earns little, so without this
    cost it loses little by a fall. In early training the cost would teach the robot to shuffle.
    """
    raw = {name: term(cfg, robot, dt, x) for name, term in TERMS.items()}
    total = dt * sum(getattr(cfg.weights, name) * value for name, value in raw.items())
    total = jnp.maximum(total, 0.0) if cfg.only_positive else total
    return total - cfg.fall * _exactness(cfg, x) * x.signals.torso_contact, raw
