"""Actor, critic and velocity estimator: ELU networks over stacked frames.

The policy is a diagonal Gaussian. Its standard deviation is a parameter, independent of the state.
"""

from dataclasses import dataclass
from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import observations
from kslc_jax import robot as robot_lib
from kslc_jax.config import Config
from kslc_jax.robot import Robot

Params = dict[str, Any]
"""{'actor': flax params, 'critic': flax params, 'log_std': [n]}, and 'estimator': flax params if
the config has one."""

ACTING = ("actor", "estimator", "log_std")
"""Names of the parameters that a policy needs to act. Only training needs the critic."""

ESTIMATED = 3
"""Outputs of the estimator: the base's velocity, base frame, scaled as in the critic's frame."""

EVEN_GAINS = {"base_euler": (8.0, 8.0, 1.0), "joint_vel": 4.0}
"""Factors on components of a frame, see `NetworkConfig.even_inputs`. Of a robot that runs at all
speeds, roll and pitch vary by 0.06 and 0.12, joint speeds by 0.05 to 0.25, last actions by 1.4."""

_LOG_2PI = 1.8378770664093453
_HALF = 0.5**0.5
"""sqrt(1/2). With this factor the sum and the difference of two values keep their variance."""


class MLP(nn.Module):
    """Dense layers with ELU between them. The input is flattened over its last two axes."""

    hidden: tuple[int, ...]
    outputs: int
    out_scale: float

    @nn.compact
    def __call__(self, frames: jax.Array, *beside: jax.Array) -> jax.Array:
        """Outputs [..., O] for frames [..., K, W] and additional inputs `beside`, each [..., V]."""
        x = jnp.concatenate([_flat(frames), *beside], axis=-1)
        for size in self.hidden:
            x = nn.elu(nn.Dense(size)(x))
        return nn.Dense(self.outputs, kernel_init=_kernel_init(self.out_scale))(x)


@dataclass(frozen=True, eq=False)
class Parity:
    """Orthonormal bases of the even (M x = x) and odd (M x = -x) vectors [W] of a mirror map M."""

    even: np.ndarray  # [W, E]
    odd: np.ndarray  # [W, W - E]


def parity(permutation: np.ndarray, sign: np.ndarray) -> Parity:
    """Bases for the mirror map v -> v[permutation] * sign, which must be its own inverse."""
    eye = np.eye(len(sign), dtype=np.float32)
    mirror = eye[permutation] * sign[:, None]

    def basis(projected: np.ndarray) -> np.ndarray:
        # The projections of a unit vector and its mirror image differ only in sign: keep the first.
        kept = projected[:, np.arange(len(sign)) <= permutation]
        norm = np.linalg.norm(kept, axis=0)
        return kept[:, norm > 0] / norm[norm > 0]

    return Parity(basis(eye + mirror), basis(eye - mirror))


class MirrorMLP(nn.Module):
    """An MLP that commutes with the mirror map M: f(M x) = M f(x), for all weights.

    Hidden units form pairs, one unit for each side of the robot, and M swaps the two. A linear map
    commutes with M if and only if it maps even vectors to even ones and odd vectors to odd ones. So
    each dense layer consists of two layers of half the width: half the work of a free layer.
    """

    hidden: tuple[int, ...]
    inputs: Parity
    outputs: Parity
    out_scale: float
    beside: tuple[Parity, ...] = ()

    @nn.compact
    def __call__(self, frames: jax.Array, *beside: jax.Array) -> jax.Array:
        """Outputs [..., O] for frames [..., K, W] and additional inputs `beside`, each [..., V]."""
        even, odd = _flat(frames @ self.inputs.even), _flat(frames @ self.inputs.odd)
        for extra, basis in zip(beside, self.beside, strict=True):
            even = jnp.concatenate([even, extra @ basis.even], axis=-1)
            odd = jnp.concatenate([odd, extra @ basis.odd], axis=-1)
        for size in self.hidden:
            even, odd = nn.Dense(size // 2)(even), nn.Dense(size // 2, use_bias=False)(odd)
            left, right = nn.elu((even + odd) * _HALF), nn.elu((even - odd) * _HALF)
            even, odd = (left + right) * _HALF, (left - right) * _HALF
        init = _kernel_init(self.out_scale)
        out = nn.Dense(self.outputs.even.shape[1], kernel_init=init)(even) @ self.outputs.even.T
        width = self.outputs.odd.shape[1]
        if width:
            out += nn.Dense(width, use_bias=False, kernel_init=init)(odd) @ self.outputs.odd.T
        return out


def _kernel_init(scale: float) -> nn.initializers.Initializer:
    """Initial weights that give outputs of deviation `scale` for inputs of unit variance."""
    return nn.initializers.variance_scaling(scale**2, "fan_in", "truncated_normal")


def _flat(frames: jax.Array) -> jax.Array:
    """[..., K, W] -> [..., K * W]."""
    return frames.reshape(*frames.shape[:-2], -1)


@flax.struct.dataclass
class Gaussian:
    """Diagonal Gaussian over actions."""

    mean: jax.Array  # [..., n]
    log_std: jax.Array  # [n]

    def sample(self, key: jax.Array) -> jax.Array:
        """One action [..., n]."""
        return self.mean + jnp.exp(self.log_std) * jax.random.normal(key, self.mean.shape)

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Log density of `action` [..., n], summed over its components."""
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * jnp.square(z) - self.log_std - 0.5 * _LOG_2PI, axis=-1)

    def entropy(self) -> jax.Array:
        """Differential entropy []; it does not depend on the mean."""
        return jnp.sum(self.log_std + 0.5 * (1.0 + _LOG_2PI))

    def kl_from(self, old: "Gaussian") -> jax.Array:
        """KL(old || self) [...]."""
        variance_ratio = jnp.exp(2.0 * (old.log_std - self.log_std))
        distance = jnp.square((self.mean - old.mean) * jnp.exp(-self.log_std))
        per_joint = self.log_std - old.log_std + 0.5 * (variance_ratio + distance - 1.0)
        return jnp.sum(per_joint, axis=-1)


def _robot(config: Config) -> Robot:
    return robot_lib.load(name=config.physics.robot, terrain=config.physics.uneven)


def input_gain(config: Config, table: observations.Table) -> np.ndarray:
    """Factors [W] on the values of a frame before the first layer of every network."""
    gains = EVEN_GAINS if config.network.even_inputs else {}
    parts = [np.broadcast_to(gains.get(c.name, 1.0), (c.width,)) for c in table]
    return np.concatenate(parts).astype(np.float32)


def _seen_by_actor(config: Config, history: jax.Array) -> jax.Array:
    return history * input_gain(config, observations.actor_table(_robot(config)))


def _actor(config: Config) -> nn.Module:
    scale, robot = config.network.init_mean, _robot(config)
    if not config.network.symmetric:
        return MLP(config.network.actor, robot.count, scale)
    beside = (mirrored_velocity(),) if config.network.estimator else ()
    inputs, outputs = mirrored_frame(observations.actor_table(robot), robot), mirrored_joints(robot)
    return MirrorMLP(config.network.actor, inputs, outputs, scale, beside)


def _estimator(config: Config) -> nn.Module:
    if not config.network.symmetric:
        return MLP(config.network.estimator, ESTIMATED, 1.0)
    robot = _robot(config)
    inputs = mirrored_frame(observations.actor_table(robot), robot)
    return MirrorMLP(config.network.estimator, inputs, mirrored_velocity(), 1.0)


def mirrored_frame(table: observations.Table, robot: Robot) -> Parity:
    """Bases for a frame [W]."""
    return parity(*observations.mirror_map(table, robot))


def mirrored_joints(robot: Robot) -> Parity:
    """Bases for the joint vector [n]."""
    return parity(robot.anatomy.permutation, robot.anatomy.sign)


def mirrored_velocity() -> Parity:
    """Bases for a velocity [3] in the base frame."""
    return parity(np.arange(ESTIMATED), np.array(observations.POLAR))


def _critic(config: Config) -> nn.Module:
    if not config.network.symmetric:
        return MLP(config.network.critic, 1, 1.0)
    robot = _robot(config)
    inputs = mirrored_frame(observations.critic_table(robot, config.env.critic_memory), robot)
    return MirrorMLP(config.network.critic, inputs, parity(np.zeros(1, int), np.ones(1)), 1.0)


def init(config: Config, key: jax.Array) -> Params:
    """Random initial parameters."""
    key_actor, key_critic = jax.random.split(key)
    robot = _robot(config)
    beside = (jnp.zeros(ESTIMATED),) if config.network.estimator else ()
    history = jnp.zeros((config.env.frames, observations.actor_width(robot)))
    width = observations.critic_width(robot, config.env.critic_memory)
    privileged = jnp.zeros((config.env.privileged_frames, width))
    params = {
        "actor": _actor(config).init(key_actor, history, *beside)["params"],
        "critic": _critic(config).init(key_critic, privileged)["params"],
        "log_std": jnp.full(robot.count, jnp.log(config.network.init_std), jnp.float32),
    }
    if config.network.estimator:
        key_estimator = jax.random.fold_in(key_actor, 1)
        params["estimator"] = _estimator(config).init(key_estimator, history)["params"]
    return params


def policy(
    config: Config, params: Params, history: jax.Array, velocity: jax.Array | None = None
) -> Gaussian:
    """Action distribution for actor histories [..., K, W].

    With an estimator, the actor also reads the base's `velocity` [..., 3], as `estimate` returns
    it. None: it is estimated here. No gradient flows from the actor into the estimator.
    """
    beside = ()
    if config.network.estimator:
        velocity = estimate(config, params, history) if velocity is None else velocity
        beside = (jax.lax.stop_gradient(velocity),)
    seen = _seen_by_actor(config, history)
    mean = cast(jax.Array, _actor(config).apply({"params": params["actor"]}, seen, *beside))
    return Gaussian(mean, log_std(config, params))


def estimate(config: Config, params: Params, history: jax.Array) -> jax.Array | None:
    """Estimated velocity of the base [..., 3] for actor histories [..., K, W].

    It is scaled as in the critic's frame. None without an estimator.
    """
    if not config.network.estimator:
        return None
    seen = _seen_by_actor(config, history)
    return cast(jax.Array, _estimator(config).apply({"params": params["estimator"]}, seen))


def log_std(config: Config, params: Params) -> jax.Array:
    """Log standard deviation [n] of the policy; equal on both sides if it is symmetric."""
    free = params["log_std"]
    if not config.network.symmetric:
        return free
    return 0.5 * (free + free[_robot(config).anatomy.permutation])


def value(config: Config, params: Params, privileged: jax.Array) -> jax.Array:
    """State value [...] for critic histories [..., Kp, W]."""
    table = observations.critic_table(_robot(config), config.env.critic_memory)
    seen = privileged * input_gain(config, table)
    out = cast(jax.Array, _critic(config).apply({"params": params["critic"]}, seen))
    return out[..., 0]
