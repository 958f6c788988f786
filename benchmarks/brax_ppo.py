"""A thin adapter: Brax's PPO, as released, on our environment and networks.

Loop, storage and loss are those of Brax's `ppo.train`. Environment, engine, networks, batch,
minibatches, epochs and coefficients are ours. These differences remain:

- Brax stores two whole observation histories per sample: before and after the step.
- Brax estimates and normalises advantages in every minibatch, with the present critic. Ours does it
  once for the whole batch.
- Brax updates observation statistics, which nothing uses here.
- Brax has no curriculum, no masking of broken samples, and no metrics of reward terms. Only our
  training does this work.
"""

import threading
from collections.abc import Callable
from typing import Any

import brax.envs
import jax
import jax.numpy as jnp
from brax.training import distribution
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_train
from brax.training.networks import FeedForwardNetwork

from benchmarks import brax_on_new_jax
from kslc_jax import curriculum as curriculum_lib
from kslc_jax import env, networks, observations, physics
from kslc_jax.config import Config

brax_on_new_jax.prepare()


class Adapter(brax.envs.Env):
    """Our environment with Brax's interface. It resets itself, so Brax's wrapper must not."""

    def __init__(self, config: Config):
        self.config, self.robot = config, physics.robot_for(config.physics)
        self.curriculum = curriculum_lib.init(config)

    def reset(self, rng: jax.Array) -> brax.envs.State:
        key, key_reset = jax.random.split(rng)
        state = env.reset(self.config, key_reset, self.curriculum)
        zero = jnp.zeros(())
        info = {"key": key, "truncation": zero, "episode_done": zero, "episode_metrics": {}}
        return brax.envs.State(state, _observe(state), zero, zero, {}, info)

    def step(self, state: brax.envs.State, action: jax.Array) -> brax.envs.State:
        key, key_step = jax.random.split(state.info["key"])
        new, out = env.step(self.config, state.pipeline_state, action, key_step, self.curriculum)
        done = (out.terminated | out.truncated).astype(jnp.float32)
        truncated = out.truncated.astype(jnp.float32)
        info = {**state.info, "key": key, "truncation": truncated, "episode_done": done}
        obs = _observe(new)
        return state.replace(pipeline_state=new, obs=obs, reward=out.reward, done=done, info=info)

    @property
    def observation_size(self) -> Any:
        frames = self.config.env.frames, self.config.env.privileged_frames
        widths = _widths(self.config)
        return {"state": frames[0] * widths[0], "privileged_state": frames[1] * widths[1]}

    @property
    def action_size(self) -> int:
        return self.robot.count

    @property
    def backend(self) -> str:
        return self.config.physics.engine


def _observe(state: env.EnvState) -> dict[str, jax.Array]:
    """Flat observations, as Brax needs them."""
    history, privileged = state.history, state.privileged_history
    return {"state": history.reshape(-1), "privileged_state": privileged.reshape(-1)}


def _wrap(adapter: Adapter, **_: Any) -> brax.envs.Env:
    return brax.envs.training.VmapWrapper(adapter)


def _widths(config: Config) -> tuple[int, int]:
    """Widths of an actor frame and of a critic frame."""
    robot = physics.robot_for(config.physics)
    memory = config.env.critic_memory
    return observations.actor_width(robot), observations.critic_width(robot, memory)


def _network_factory(config: Config) -> Callable[..., brax_networks.PPONetworks]:
    """Our actor and critic with Brax's interface."""
    robot, widths = physics.robot_for(config.physics), _widths(config)

    def stacked(obs: jax.Array, width: int) -> jax.Array:
        return obs.reshape(*obs.shape[:-1], -1, width)

    def policy(_, params, obs):
        dist = networks.policy(config, params, stacked(obs["state"], widths[0]))
        return dist.mean, jnp.broadcast_to(jnp.exp(dist.log_std), dist.mean.shape)

    def value(_, params, obs):
        history = stacked(obs["privileged_state"], widths[1])
        return networks.value(config, params, history)

    def part(*names: str) -> Callable[[jax.Array], networks.Params]:
        return lambda key: {name: networks.init(config, key)[name] for name in names}

    def factory(*_: Any, **__: Any) -> brax_networks.PPONetworks:
        return brax_networks.PPONetworks(
            FeedForwardNetwork(part("actor", "log_std"), policy),
            FeedForwardNetwork(part("critic"), value),
            distribution.NormalDistribution(robot.count),
        )

    return factory


def make(config: Config, most_calls: int) -> Callable[[], None]:
    """A function that does one train step of `ppo.train`. It works at most `most_calls` times.

    `ppo.train` runs in a separate thread. It waits after each step, in its progress callback.
    """
    go, done = threading.Semaphore(0), threading.Semaphore(0)
    failures: list[Exception] = []

    def progress(*_: Any) -> None:
        done.release()
        go.acquire()

    def train() -> None:
        go.acquire()
        try:
            brax_train.train(
                environment=Adapter(config),
                wrap_env_fn=_wrap,
                network_factory=_network_factory(config),
                num_timesteps=most_calls * config.batch_size,
                num_evals=most_calls + 1,
                run_evals=False,
                progress_fn=progress,
                episode_length=config.episode_steps,
                num_envs=config.env.num_envs,
                unroll_length=config.ppo.rollout_steps,
                batch_size=config.env.num_envs // config.ppo.minibatches,
                num_minibatches=config.ppo.minibatches,
                num_updates_per_batch=config.ppo.epochs,
                discounting=config.ppo.gamma,
                gae_lambda=config.ppo.lam,
                clipping_epsilon=config.ppo.clip,
                clipping_epsilon_value=config.ppo.clip,
                vf_loss_coefficient=2.0 * config.ppo.value_coef,
                entropy_cost=config.ppo.entropy_coef,
                max_grad_norm=config.ppo.max_grad_norm,
                learning_rate=config.ppo.learning_rate,
                learning_rate_schedule="ADAPTIVE_KL",
                learning_rate_schedule_min_lr=config.ppo.learning_rate_bounds[0],
                learning_rate_schedule_max_lr=config.ppo.learning_rate_bounds[1],
                desired_kl=config.ppo.desired_kl,
                seed=config.seed,
            )
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=train, daemon=True)
    thread.start()

    def run() -> None:
        go.release()
        while not done.acquire(timeout=0.1):
            if not thread.is_alive():
                raise RuntimeError(f"Brax stopped within {most_calls} train steps") from (
                    failures[0] if failures else None
                )

    return run
