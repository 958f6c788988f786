"""A usual setup without JAX: rsl_rl's PPO on torch, with C MuJoCo in worker processes.

rsl_rl is the learner of Humanoid-Gym, on which the paper builds. Algorithm and coefficients are the
same as ours. Each worker process steps its Gymnasium environments one by one and writes to shared
memory.
"""

import contextlib
import io
import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from benchmarks.gym_env import XBot
from kslc_jax import observations, physics, processors
from kslc_jax.config import Config


def _widths(config: Config) -> dict[str, int]:
    """Widths of the columns of the shared table, which has one row per environment."""
    robot = physics.robot_for(config.physics)
    return {
        "policy": config.env.frames * observations.actor_width(robot),
        "critic": config.env.privileged_frames
        * observations.critic_width(robot, config.env.critic_memory),
        "action": robot.count,
        "reward": 1,
        "done": 1,
        "time_out": 1,
    }


def _columns(config: Config, raw: Any) -> dict[str, np.ndarray]:
    """Views of the shared memory, by name: [N, width]."""
    widths = _widths(config)
    table = np.frombuffer(raw, np.float32).reshape(config.env.num_envs, -1)
    parts = np.split(table, np.cumsum(list(widths.values()))[:-1], axis=1)
    return dict(zip(widths, parts, strict=True))


def _work(config: Config, raw: Any, rows: range, pipe: Connection) -> None:
    """A worker. It steps its environments after each message, until the pipe closes."""
    columns = _columns(config, raw)
    envs = {row: XBot(config, seed=row) for row in rows}

    def show(row: int, obs: dict[str, np.ndarray]) -> None:
        for name, history in obs.items():
            columns[name][row] = history.ravel()

    for row, env in envs.items():
        show(row, env.reset()[0])
    pipe.send(None)
    with contextlib.suppress(EOFError):
        while True:
            pipe.recv()
            for row, env in envs.items():
                obs, reward, ended, cut, _ = env.step(columns["action"][row].astype(np.float64))
                if ended or cut:
                    obs, _ = env.reset()
                show(row, obs)
                columns["reward"][row] = reward
                columns["done"][row], columns["time_out"][row] = ended or cut, cut
            pipe.send(None)


class Workers(VecEnv):
    """All environments as one vectorised environment for rsl_rl."""

    device = "cpu"

    def __init__(self, config: Config, processes: int | None = None):
        self.cfg = {}
        self.num_envs = config.env.num_envs
        self.num_actions = _widths(config)["action"]
        self.max_episode_length = config.episode_steps
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        context = multiprocessing.get_context("spawn")
        raw = context.RawArray("f", self.num_envs * sum(_widths(config).values()))
        self._columns = {n: torch.from_numpy(x) for n, x in _columns(config, raw).items()}
        self._pipes = []
        for part in np.array_split(np.arange(self.num_envs), processes or processors.usable()):
            ours, theirs = context.Pipe()
            rows = range(part[0], part[-1] + 1)
            context.Process(target=_work, args=(config, raw, rows, theirs), daemon=True).start()
            self._pipes.append(ours)
        self._wait()

    def _wait(self) -> None:
        for pipe in self._pipes:
            pipe.recv()

    def get_observations(self) -> TensorDict:
        obs = {name: self._columns[name].clone() for name in ("policy", "critic")}
        return TensorDict(obs, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        self._columns["action"].copy_(actions)
        for pipe in self._pipes:
            pipe.send(None)
        self._wait()
        reward, done, time_out = (
            self._columns[name][:, 0].clone() for name in ("reward", "done", "time_out")
        )
        return self.get_observations(), reward, done, {"time_outs": time_out}


def _settings(config: Config) -> dict[str, Any]:
    """Our networks and coefficients as settings of rsl_rl."""
    network = {"class_name": "MLPModel", "activation": "elu"}
    gaussian = {"class_name": "GaussianDistribution", "init_std": config.network.init_std}
    ppo = config.ppo
    return {
        "num_steps_per_env": ppo.rollout_steps,
        "save_interval": 1,
        "obs_groups": {"actor": ["policy"], "critic": ["critic"]},
        "actor": {**network, "hidden_dims": config.network.actor, "distribution_cfg": gaussian},
        "critic": {**network, "hidden_dims": config.network.critic},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.minibatches,
            "clip_param": ppo.clip,
            "gamma": ppo.gamma,
            "lam": ppo.lam,
            "value_loss_coef": ppo.value_coef,
            "entropy_coef": ppo.entropy_coef,
            "learning_rate": ppo.learning_rate,
            "max_grad_norm": ppo.max_grad_norm,
            "desired_kl": ppo.desired_kl,
            "rnd_cfg": None,
            "symmetry_cfg": None,
        },
    }


def make(config: Config) -> Callable[[], None]:
    """A function that trains one iteration: a rollout and its update."""
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints its networks
        runner = OnPolicyRunner(Workers(config), _settings(config))

    def run() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            runner.learn(1)

    return run
