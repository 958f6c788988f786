"""One rollout: T control steps of N environments under the sampled policy.

Numbers that are not finite are masked here, so that one broken environment costs its own sample.
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
    """One rollout, [T, N, ...]. Frames are stored once; windows are gathered at update time."""

    action: jax.Array  # [T, N, 16]
    mean: jax.Array  # [T, N, 16]
    log_prob: jax.Array  # [T, N]
    value: jax.Array  # [T, N]
    age: jax.Array  # [T, N] int, control steps since the reset
    frame: jax.Array  # [T, N, 59] newest actor frame at each step
    privileged: jax.Array  # [T, N, 89] newest critic frame
    outcome: Outcome  # [T, N]


def collect(
    config: Config,
    params: Params,
    envs: EnvState,
    curriculum: Curriculum,
    key: jax.Array,
    simulate: Callable[..., PhysicsState] = physics.step,
) -> tuple[EnvState, Trajectory]:
    """T control steps of N environments under the sampled policy; `simulate` as in `env.step`."""

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
    """One control step of N environments, as it comes out: a row of the trajectory, [N]."""
    key_act, key_env = jax.random.split(key)
    dist = networks.policy(config, params, envs.history)
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
        outcome=outcome,
    )


def finite(tree: object) -> jax.Array:
    """[] bool: no number of the tree is NaN or infinite."""
    leaves = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    flags = jnp.stack([jnp.all(jnp.isfinite(x)) for x in leaves]).astype(jnp.float32)
    # A dot product, which XLA computes once: it would fuse a chain of ands into the select of every
    # leaf that depends on it, for twice the instructions and twice the time to compile.
    return jnp.dot(flags, jnp.ones_like(flags)) == len(leaves)


def broken_state(state: EnvState) -> EnvState:
    """A state without a number in it, whose physics is sure to break: `env.step` makes of it a new
    episode."""
    blank = jax.tree.map(jnp.zeros_like, state)
    physics = blank.physics.replace(qvel=jnp.full_like(blank.physics.qvel, jnp.nan))
    return blank.replace(physics=physics)


def or_new_episode(state: EnvState) -> EnvState:
    """The state of ONE environment, or a blank where a number in it is not finite."""
    return maths.tree_where(finite(state), state, broken_state(state))


def mask_broken(state: EnvState, out: Outcome) -> tuple[EnvState, Outcome]:
    """What a step of ONE environment gave. Where any number is not finite the step counts as
    broken: it is worth nothing, and a new episode follows."""
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
    """Gathers the histories [B, K, W] that were seen at flat indices t * N + n.

    Frames [T, N, W] are kept once, behind those of the `history` [N, K, W] at the start; what is
    older than the episode is zero, as after a reset.
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
