"""Actor and critic: ELU networks over stacked frames; diagonal Gaussian with a free deviation."""

from typing import Any, cast

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import observations
from kslc_jax import robot as robot_lib
from kslc_jax.config import NUM_JOINTS, Config

Params = dict[str, Any]
"""{'actor': flax params, 'critic': flax params, 'log_std': [16]}"""

_LOG_2PI = 1.8378770664093453


class MLP(nn.Module):
    """Dense layers with ELU between them, over the flattened last two axes [..., K, W]."""

    hidden: tuple[int, ...]
    outputs: int

    @nn.compact
    def __call__(self, frames: jax.Array) -> jax.Array:
        x = frames.reshape(*frames.shape[:-2], -1)
        for size in self.hidden:
            x = nn.elu(nn.Dense(size)(x))
        return nn.Dense(self.outputs)(x)


@flax.struct.dataclass
class Gaussian:
    """Diagonal Gaussian over actions."""

    mean: jax.Array  # [..., 16]
    log_std: jax.Array  # [16]

    def sample(self, key: jax.Array) -> jax.Array:
        """One action [..., 16]."""
        return self.mean + jnp.exp(self.log_std) * jax.random.normal(key, self.mean.shape)

    def log_prob(self, action: jax.Array) -> jax.Array:
        """Log density of `action` [..., 16], summed over its components."""
        z = (action - self.mean) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * jnp.square(z) - self.log_std - 0.5 * _LOG_2PI, axis=-1)

    def entropy(self) -> jax.Array:
        """Differential entropy, the same for every mean."""
        return jnp.sum(self.log_std + 0.5 * (1.0 + _LOG_2PI))

    def kl_from(self, old: "Gaussian") -> jax.Array:
        """KL(old || self) [...]."""
        variance_ratio = jnp.exp(2.0 * (old.log_std - self.log_std))
        distance = jnp.square((self.mean - old.mean) * jnp.exp(-self.log_std))
        per_joint = self.log_std - old.log_std + 0.5 * (variance_ratio + distance - 1.0)
        return jnp.sum(per_joint, axis=-1)


def _actor(config: Config) -> MLP:
    return MLP(config.network.actor, NUM_JOINTS)


def _critic(config: Config) -> MLP:
    return MLP(config.network.critic, 1)


def init(config: Config, key: jax.Array) -> Params:
    """Fresh parameters."""
    key_actor, key_critic = jax.random.split(key)
    history = jnp.zeros((config.env.frames, observations.ACTOR_WIDTH))
    privileged = jnp.zeros((config.env.privileged_frames, observations.CRITIC_WIDTH))
    return {
        "actor": _actor(config).init(key_actor, history)["params"],
        "critic": _critic(config).init(key_critic, privileged)["params"],
        "log_std": jnp.full(NUM_JOINTS, jnp.log(config.network.init_std), jnp.float32),
    }


def policy(config: Config, params: Params, history: jax.Array) -> Gaussian:
    """Action distribution for actor histories [..., K, 59].

    With `network.symmetric`, mean(o) = (f(o) + M f(M o)) / 2 for the mirror map M: a mirrored robot
    gets the mirrored action, exactly.
    """

    def f(x: jax.Array) -> jax.Array:
        return cast(jax.Array, _actor(config).apply({"params": params["actor"]}, x))

    if not config.network.symmetric:
        return Gaussian(f(history), log_std(config, params))
    frame_permutation, frame_sign = observations.mirror_map(observations.ACTOR)
    joints, sign = robot_lib.mirror_joints()
    both = f(jnp.stack([history, history[..., frame_permutation] * frame_sign]))
    mean = 0.5 * (both[0] + both[1][..., joints] * sign)
    return Gaussian(mean, log_std(config, params))


def log_std(config: Config, params: Params) -> jax.Array:
    """Log deviation [16] of the policy; the same for both sides if it is symmetric."""
    free = params["log_std"]
    if not config.network.symmetric:
        return free
    joints, _ = robot_lib.mirror_joints()
    return 0.5 * (free + free[joints])


def value(config: Config, params: Params, privileged: jax.Array) -> jax.Array:
    """State value [...] for critic histories [..., Kp, 89]."""
    out = cast(jax.Array, _critic(config).apply({"params": params["critic"]}, privileged))
    return out[..., 0]
