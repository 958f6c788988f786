"""PPO with a KL-adaptive learning rate. It knows no environment: arrays in, a new Learner out.

`Samples` hold an index in place of each observation, and `PolicyAtIndex` evaluates the networks at
such indices. The reason is memory: an observation is a window of the last K frames, so a copy per
sample would store each frame up to K times. The rollout stores each frame once. `PolicyAtIndex`
gathers the windows of one minibatch at a time (`rollout.windows`).
"""

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
    """State that an update changes."""

    params: Params
    average: Params  # average of the acting parameters, see PPOConfig.average
    opt_state: optax.OptState
    learning_rate: jax.Array  # []
    rate_ceiling: jax.Array  # [] upper limit of the learning rate; lowered after non-finite values


@flax.struct.dataclass
class Samples:
    """Data of each rollout step for PPO, with leading axes [T, N] or others."""

    index: jax.Array  # [] int, index of the observation, see the module docstring
    action: jax.Array  # [n]
    mean: jax.Array  # [n] of the policy that acted
    log_prob: jax.Array  # [] of the action, under that policy
    value: jax.Array  # [] of the critic at the rollout
    advantage: jax.Array  # []
    target: jax.Array  # [] value target
    valid: jax.Array  # [] bool, False: the loss ignores this sample


@flax.struct.dataclass
class RolloutConstants:
    """Values that all samples of a rollout share."""

    log_std: jax.Array  # [n] of the policy that acted
    entropy_coef: jax.Array  # [] weight of the entropy bonus in the update


CEILING_GROWTH = 1.02
"""Growth of the learning-rate ceiling per update. After one halving it is back in 36 updates."""

PolicyAtIndex = Callable[[Params, jax.Array], tuple[Gaussian, jax.Array, jax.Array]]
"""(params, indices [B]) -> (action distribution, values [B], squared errors [B] of the estimated
velocity). The errors are zero without an estimator. See the module docstring."""


def optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam on clipped gradients. `gradient_step` applies the learning rate, because it adapts."""
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
    """The parameters that are saved as a policy: acting parameters averaged over updates."""
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

    A time-out is not a failure. At a time-out, gamma V_t is added to r_t: it stands for
    gamma V_{t+1}, because the state after the time-out is not kept (Humanoid-Gym). With
    `value_per_command` the same is done where a command ends.

    Args:
      reward, value, done, truncated: [T]; `done` is terminated or truncated.
      last_value: [] V_T, value of the state after the last step.
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
    count: jax.Array,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """(loss [], metrics): the share of `batch` in the mean over `count` [] valid samples.

    The loss is the clipped surrogate + clipped value loss - entropy bonus + squared error of the
    velocity estimate.
    """
    dist, value, estimate_error = apply(params, batch.index)
    weight = batch.valid / count

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(x * weight)

    ratio = jnp.exp(dist.log_prob(batch.action) - batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))

    near = batch.value + jnp.clip(value - batch.value, -config.clip, config.clip)
    errors = jnp.maximum(jnp.square(value - batch.target), jnp.square(near - batch.target))
    value_loss = mean(errors)

    entropy = dist.entropy() * jnp.sum(weight)
    estimate_loss = mean(estimate_error)
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
    """Lowers the rate [] if KL > 2 desired, and raises it if 0 < KL < desired / 2.

    The result lies within the configured bounds, and below the ceiling where the bounds allow it.
    """
    rate = jnp.where(kl > 2.0 * config.desired_kl, rate / config.learning_rate_factor, rate)
    slow = (kl > 0.0) & (kl < 0.5 * config.desired_kl)
    rate = jnp.where(slow, rate * config.learning_rate_factor, rate)
    return jnp.clip(jnp.minimum(rate, ceiling), *config.learning_rate_bounds)


PIECE = 1536
"""Samples whose gradient a CPU computes at once. The layers of so few samples stay in its caches.
`python -m benchmarks.throughput --pieces` measures what that saves."""


def pieces(size: int) -> int:
    """Number of equal pieces, of `PIECE` samples or more, in which a CPU takes `size` samples.

    Several devices take them whole: a minibatch splits evenly among them, a piece of it need not.
    """
    if jax.default_backend() != "cpu" or jax.device_count() > 1:
        return 1
    return max(n for n in range(1, max(size // PIECE, 1) + 1) if size % n == 0)


def gradient(
    config: PPOConfig,
    apply: PolicyAtIndex,
    constants: RolloutConstants,
    params: Params,
    batch: Samples,
) -> tuple[Params, dict[str, jax.Array]]:
    """Gradient of the loss over one minibatch, and the metrics; the sum over its `pieces`."""
    count = jnp.maximum(jnp.sum(batch.valid), 1)

    def of(piece: Samples) -> tuple[Params, dict[str, jax.Array]]:
        slope = jax.grad(loss, argnums=3, has_aux=True)
        return slope(config, apply, constants, params, piece, count)

    number = pieces(batch.index.shape[0])
    if number == 1:
        return of(batch)
    parts = jax.tree.map(lambda x: x.reshape(number, -1, *x.shape[1:]), batch)
    like = jax.eval_shape(of, jax.tree.map(lambda x: x[0], parts))
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    total, _ = jax.lax.scan(lambda t, p: (jax.tree.map(jnp.add, t, of(p)), None), zero, parts)
    return total


def gradient_step(
    config: PPOConfig,
    apply: PolicyAtIndex,
    constants: RolloutConstants,
    learner: Learner,
    batch: Samples,
) -> tuple[Learner, dict[str, jax.Array]]:
    """One Adam step on one minibatch.

    A non-finite gradient changes nothing; the metric `skipped` is then 1.
    """
    grads, info = gradient(config, apply, constants, learner.params, batch)
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
    """All epochs over the samples [B, ...] of one rollout.

    Each epoch shuffles them and takes one gradient step per minibatch. Returns the new learner and
    the mean metrics.
    """
    ceiling = jnp.minimum(CEILING_GROWTH * learner.rate_ceiling, config.learning_rate_bounds[1])
    learner = learner.replace(rate_ceiling=ceiling)
    samples = samples.replace(advantage=normalised(samples.advantage, samples.valid))
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
    """Updates the exponential average with the newest parameters.

    Equal parameters leave the average as it is, to the last bit.
    """
    if config.average == 0:
        return newest
    gain = 1.0 - config.average
    return jax.tree.map(lambda a, b: a + gain * (b - a), average, newest)


def normalised(advantage: jax.Array, valid: jax.Array) -> jax.Array:
    """Scales to zero mean and unit deviation over the valid samples of the whole batch (HG)."""
    mean = jnp.mean(advantage, where=valid)
    std = jnp.std(advantage, where=valid)
    return (advantage - mean) / (std + 1e-8)
