"""PPO with a KL-adaptive learning rate. Knows no environment: arrays in, a new Learner out."""

from collections.abc import Callable

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax

from kslc_jax.config import PPOConfig
from kslc_jax.networks import ACTING, Gaussian, Params


@flax.struct.dataclass
class Learner:
    """Everything an update changes."""

    params: Params
    average: Params  # of the parameters that the policy acts with, see PPOConfig.average
    opt_state: optax.OptState
    learning_rate: jax.Array  # []
    rate_ceiling: jax.Array  # [] what the learning rate may reach; lowered after bad numbers


@flax.struct.dataclass
class Samples:
    """What PPO needs of each step of a rollout, [T, N, ...] or any leading axes."""

    index: jax.Array  # [] int, names the observation for `PolicyAtIndex`
    action: jax.Array  # [16]
    mean: jax.Array  # [16] of the policy that acted
    log_prob: jax.Array  # [] of the action under it
    value: jax.Array  # []
    advantage: jax.Array  # []
    target: jax.Array  # [] value target
    valid: jax.Array  # [] bool, False: not to be learnt from


@flax.struct.dataclass
class RolloutConstants:
    """What all samples of a rollout share."""

    log_std: jax.Array  # [16] of the policy that acted
    entropy_coef: jax.Array  # [] weight of the entropy bonus in their update


CEILING_GROWTH = 1.02
"""Factor on the ceiling of the learning rate per update: a halved one is whole after 36."""

PolicyAtIndex = Callable[[Params, jax.Array], tuple[Gaussian, jax.Array, jax.Array]]
"""(params, indices [B]) -> (action distribution, values [B], squared error of the estimated
velocity [B], zero without an estimator) at those observations."""


def optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam on clipped gradients; the learning rate is applied outside, it adapts."""
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam())


def init(config: PPOConfig, params: Params) -> Learner:
    """Learner before the first update."""
    rate = jnp.asarray(config.learning_rate, jnp.float32)
    ceiling = jnp.asarray(config.learning_rate_bounds[1], jnp.float32)
    return Learner(params, acting(params), optimizer(config).init(params), rate, ceiling)


def acting(params: Params) -> Params:
    """The part of the parameters that a policy acts with."""
    return {name: params[name] for name in ACTING if name in params}


def deployed(learner: Learner) -> Params:
    """The networks as a policy uses them: the actor is the average over the last updates."""
    return {**learner.params, **learner.average}


def gae(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    done: jax.Array,
    truncated: jax.Array,
    gamma: float,
    lam: float,
) -> tuple[jax.Array, jax.Array]:
    """Generalised advantage estimation for ONE environment (Schulman et al. 2016).

    delta_t = r_t + gamma V_{t+1} (1 - done_t) - V_t
    A_t = delta_t + gamma lam (1 - done_t) A_{t+1}

    A time-out is not a failure: there r_t gains gamma V_t in place of the value it was cut from
    (Humanoid-Gym; the state after the cut is gone).

    Args:
      reward, value, done, truncated: [T]; `done` is terminated or truncated.
      last_value: [] V_T.
      gamma, lam: discount and GAE factor.

    Returns:
      (advantage [T], value target [T]).
    """
    chex.assert_equal_shape([reward, value, done, truncated])
    reward = reward + gamma * value * truncated
    going = 1.0 - done.astype(value.dtype)
    next_value = jnp.append(value[1:], last_value)
    delta = reward + gamma * next_value * going - value

    def back(carry: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, going_t = x
        advantage = delta_t + gamma * lam * going_t * carry
        return advantage, advantage

    _, advantage = jax.lax.scan(back, jnp.zeros_like(last_value), (delta, going), reverse=True)
    return advantage, advantage + value


def loss(
    config: PPOConfig,
    apply: PolicyAtIndex,
    constants: RolloutConstants,
    params: Params,
    batch: Samples,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate + clipped value loss - entropy bonus + error of the velocity estimate, over
    the valid samples of `batch`."""
    dist, value, estimate_error = apply(params, batch.index)
    weight = batch.valid / jnp.maximum(jnp.sum(batch.valid), 1)

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(x * weight)

    ratio = jnp.exp(dist.log_prob(batch.action) - batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

    near = batch.value + jnp.clip(value - batch.value, -config.clip, config.clip)
    errors = jnp.maximum(jnp.square(value - batch.target), jnp.square(near - batch.target))
    value_loss = mean(errors)

    entropy, estimate_loss = dist.entropy(), mean(estimate_error)
    total = policy_loss + config.value_coef * value_loss - constants.entropy_coef * entropy
    total += config.estimate_coef * estimate_loss
    info = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "estimate_loss": estimate_loss,
        "entropy": entropy,
        "kl": mean(dist.kl_from(Gaussian(batch.mean, constants.log_std))),
        "clip_share": mean(jnp.abs(ratio - 1.0) > config.clip),
    }
    return total, info


def adapt_learning_rate(
    config: PPOConfig, rate: jax.Array, kl: jax.Array, ceiling: jax.Array | float = jnp.inf
) -> jax.Array:
    """Lowers the rate where KL > 2 desired, raises it where KL < desired / 2, up to the ceiling and
    within bounds."""
    rate = jnp.where(kl > 2.0 * config.desired_kl, rate / config.learning_rate_factor, rate)
    slow = (kl > 0.0) & (kl < 0.5 * config.desired_kl)
    rate = jnp.where(slow, rate * config.learning_rate_factor, rate)
    return jnp.clip(jnp.minimum(rate, ceiling), *config.learning_rate_bounds)


def gradient_step(
    config: PPOConfig,
    apply: PolicyAtIndex,
    constants: RolloutConstants,
    learner: Learner,
    batch: Samples,
) -> tuple[Learner, dict[str, jax.Array]]:
    """One minibatch. A non-finite gradient changes nothing and is counted in `skipped`."""
    grads, info = jax.grad(loss, argnums=3, has_aux=True)(
        config, apply, constants, learner.params, batch
    )
    grad_norm = optax.tree.norm(grads)
    ceiling = learner.rate_ceiling
    rate = adapt_learning_rate(config, learner.learning_rate, info["kl"], ceiling)
    updates, opt_state = optimizer(config).update(grads, learner.opt_state)
    params = jax.tree.map(lambda p, u: p - rate * u, learner.params, updates)
    finite = jnp.isfinite(grad_norm)
    new = learner.replace(params=params, opt_state=opt_state, learning_rate=rate)
    learner = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, learner)
    return learner, {**info, "grad_norm": grad_norm, "skipped": 1.0 - finite}


def update(
    config: PPOConfig,
    apply: PolicyAtIndex,
    constants: RolloutConstants,
    learner: Learner,
    samples: Samples,
    key: jax.Array,
) -> tuple[Learner, dict[str, jax.Array]]:
    """All epochs of one rollout's samples [B, ...]: shuffled, one gradient step a minibatch."""
    ceiling = jnp.minimum(CEILING_GROWTH * learner.rate_ceiling, config.learning_rate_bounds[1])
    learner = learner.replace(rate_ceiling=ceiling)
    samples = samples.replace(advantage=_normalise(samples.advantage, samples.valid))
    size = samples.index.shape[0]

    def minibatch(learner: Learner, rows: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
        batch = jax.tree.map(lambda x: x[rows], samples)
        return gradient_step(config, apply, constants, learner, batch)

    def epoch(learner: Learner, key: jax.Array) -> tuple[Learner, dict[str, jax.Array]]:
        rows = jax.random.permutation(key, size).reshape(config.minibatches, -1)
        return jax.lax.scan(minibatch, learner, rows)

    learner, info = jax.lax.scan(epoch, learner, jax.random.split(key, config.epochs))
    average = averaged(config, learner.average, acting(learner.params))
    return learner.replace(average=average), jax.tree.map(jnp.mean, info)


def averaged(config: PPOConfig, average: Params, newest: Params) -> Params:
    """The exponential average one update later."""
    keep = config.average
    return jax.tree.map(lambda a, b: keep * a + (1.0 - keep) * b, average, newest)


def _normalise(advantage: jax.Array, valid: jax.Array) -> jax.Array:
    """Zero mean and unit deviation over the valid samples of the whole batch (HG)."""
    mean = jnp.mean(advantage, where=valid)
    std = jnp.std(advantage, where=valid)
    return (advantage - mean) / (std + 1e-8)
