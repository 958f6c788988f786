"""One rollout: T control steps of N environments, with actions sampled from the policy.

It masks steps with non-finite numbers. So one broken environment loses only its own samples.
"""

import functools
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp

from kslc_jax import env, maths, networks, physics
from kslc_jax.config import Config
from kslc_jax.curriculum import Curriculum
from kslc_jax.env import EnvState, Outcome
from kslc_jax.networks import Params
from kslc_jax.physics import PhysicsState


@flax.struct.dataclass
class Trajectory:
    """One rollout, [T, N, ...]. Each frame is stored once; the update gathers windows of them."""

    action: jax.Array  # [T, N, n]
    mean: jax.Array  # [T, N, n]
    log_prob: jax.Array  # [T, N]
    value: jax.Array  # [T, N]
    age: jax.Array  # [T, N] int, control steps since the reset, before the step
    frame: jax.Array  # [T, N, W] newest actor frame, before the step
    privileged: jax.Array  # [T, N, W] newest critic frame, before the step
    velocity: jax.Array | None  # [T, N, 3] estimate that the actor read, see networks.estimate
    outcome: Outcome  # [T, N]


def collect(
    config: Config,
    params: Params,
    envs: EnvState,
    curriculum: Curriculum,
    key: jax.Array,
    simulate: Callable[..., PhysicsState] = physics.step,
) -> tuple[EnvState, Trajectory]:
    """Runs T control steps of N environments. Masks broken steps. `simulate` as in `env.step`."""

    def one(envs: EnvState, key: jax.Array) -> tuple[EnvState, Trajectory]:
        new, traj = control_step(config, params, envs, curriculum, key, simulate)
        new, outcome = jax.vmap(mask_broken)(new, traj.outcome)
        return new, traj.replace(outcome=outcome)

    return jax.lax.scan(one, envs, jax.random.split(key, config.ppo.rollout_steps))


def control_step(
    config: Config,
    params: Params,
    envs: EnvState,
    curriculum: Curriculum,
    key: jax.Array,
    simulate: Callable[..., PhysicsState] = physics.step,
) -> tuple[EnvState, Trajectory]:
    """One control step of N environments, unmasked. The trajectory is one row, [N, ...]."""
    key_act, key_env = jax.random.split(key)
    velocity = networks.estimate(config, params, envs.history)
    dist = networks.policy(config, params, envs.history, velocity)
    action = dist.sample(key_act)
    keys = jax.random.split(key_env, config.env.num_envs)
    step = functools.partial(env.step, simulate=simulate)
    new, outcome = jax.vmap(step, (None, 0, 0, 0, None))(config, envs, action, keys, curriculum)
    return new, Trajectory(
        action=action,
        mean=dist.mean,
        log_prob=dist.log_prob(action),
        value=networks.value(config, params, envs.privileged_history),
        age=envs.time,
        frame=envs.history[:, -1],
        privileged=envs.privileged_history[:, -1],
        velocity=velocity,
        outcome=outcome,
    )


def finite(tree: object) -> jax.Array:
    """[] bool, True if no float in the tree is NaN or infinite."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    flags = jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]).astype(jnp.float32)
    # XLA computes a dot product once. It would fuse a chain of ands into the select of each leaf
    # that depends on it: twice the instructions and twice the compile time.
    return jnp.dot(flags, jnp.ones_like(flags)) == len(leaves)


def broken_state(state: EnvState) -> EnvState:
    """A state of zeros with NaN velocities. The next `env.step` finds the physics broken, and so
    starts a new episode."""
    blank = jax.tree.map(jnp.zeros_like, state)
    physics = blank.physics.replace(qvel=jnp.full_like(blank.physics.qvel, jnp.nan))
    return blank.replace(physics=physics)


def or_new_episode(state: EnvState) -> EnvState:
    """The state of ONE environment, or `broken_state` if a number in it is not finite."""
    return maths.tree_where(finite(state), state, broken_state(state))


def mask_broken(state: EnvState, out: Outcome) -> tuple[EnvState, Outcome]:
    """Masks a step of ONE environment if a number in it is not finite, or if it is broken already.

    The masked outcome is all zero, except that `terminated` and `broken` are True. A new episode
    follows.
    """
    whole = finite(state)
    broken = out.broken | ~whole | ~finite(out)
    lost = ~whole | (broken & ~(out.terminated | out.truncated))
    nothing = jax.tree.map(jnp.zeros_like, out)
    nothing = nothing.replace(terminated=jnp.ones((), bool), broken=jnp.ones((), bool))
    return (
        maths.tree_where(lost, broken_state(state), state),
        maths.tree_where(broken, nothing, out),
    )


def windows(
    history: jax.Array, frame: jax.Array, age: jax.Array
) -> Callable[[jax.Array], jax.Array]:
    """Returns a function that gathers the histories [B, K, W] at flat indices t * N + n [B].

    Args:
      history: [N, K, W] histories at the start of the rollout.
      frame: [T, N, W] newest frame before each step.
      age: [T, N] control steps since the reset. Frames older than the episode become zero, as after
        a reset.
    """
    num_envs, frames, _ = history.shape
    before = jnp.swapaxes(history[:, :-1], 0, 1)
    rows = jnp.concatenate([before, frame]).reshape(-1, frame.shape[-1])
    ages = age.reshape(-1)
    back = jnp.arange(frames)

    def gather(index: jax.Array) -> jax.Array:
        window = rows[index[:, None] + back * num_envs]
        known = frames - 1 - back <= ages[index][:, None]
        return jnp.where(known[..., None], window, 0.0)

    return gather
