"""Repeats train steps from the dump of a failed training, and prints the first bad numbers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import rollout, train_step
from kslc_jax.config import Config
from kslc_jax.env import EnvState
from kslc_jax.rollout import Trajectory
from kslc_jax.train_step import TrainState
from kslc_jax.training import recovery

Step = tuple[EnvState, EnvState, Trajectory]
"""(environments after masking, environments before masking, row of the trajectory)."""

Roll = Callable[[TrainState, EnvState, jax.Array], Step]
"""One control step: (state, environments, key) -> Step."""


def bad_leaves(tree: Any) -> dict[str, np.ndarray]:
    """Leaves with non-finite numbers: name -> array of bools, True at these numbers."""
    found = {}
    for path, leaf in jax.tree.leaves_with_path(tree):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            bad = ~np.isfinite(np.asarray(leaf))
            if bad.any():
                found[jax.tree_util.keystr(path, simple=True, separator=".")] = bad
    return found


def replay(path: Path, steps: int) -> None:
    """Runs up to `steps` train steps of a dump; prints the first bad numbers and stops there."""
    config, state = recovery.read_dump(path)
    _, step = train_step.make(config)
    roll = _roller(config)
    for _ in range(steps):
        number = int(state.step) + 1
        said = [f"before: {_count(name, bad)}" for name, bad in bad_leaves(_parts(state)).items()]
        said += _first_in_rollout(roll, config, state)
        state, metrics = step(state)
        after = {**_parts(state), "metrics": metrics}
        said += [f"after: {_count(name, bad)}" for name, bad in bad_leaves(after).items()]
        if said:
            print(f"train step {number} is the first with a number that is not finite:")
            print("\n".join(f"  {line}" for line in said))
            return
        print(f"train step {number}: all finite, {float(metrics['ppo/skipped']):.0%} skipped")


def _parts(state: TrainState) -> dict[str, Any]:
    """The parts of the state that a train step changes."""
    return {"learner": state.learner, "curriculum": state.curriculum, "env": state.env}


def _count(name: str, bad: np.ndarray) -> str:
    return f"{name}, {int(bad.sum())} of {bad.size}"


def _roller(config: Config) -> Roll:
    """Makes the function of one control step."""

    @jax.jit
    def one(state: TrainState, envs: EnvState, key: jax.Array) -> Step:
        params, curriculum = state.learner.params, state.curriculum
        raw, traj = rollout.control_step(config, params, envs, curriculum, key)
        return jax.vmap(rollout.mask_broken)(raw, traj.outcome)[0], raw, traj

    return one


def _first_in_rollout(roll: Roll, config: Config, state: TrainState) -> list[str]:
    """The bad fields and their environments, in the first control step that has any."""
    envs = jax.vmap(rollout.or_new_episode)(state.env)
    keys = jax.random.split(train_step.step_keys(state)[0], config.ppo.rollout_steps)
    for t, key in enumerate(keys):
        envs, raw, traj = roll(state, envs, key)
        rows = {
            name: np.asarray(bad.reshape(len(bad), -1).any(1))
            for name, bad in bad_leaves({"rollout": traj, "env": raw}).items()
        }
        broken = np.asarray(traj.outcome.broken)
        if broken.any():
            rows["physics diverged"] = broken
        if rows:
            where = f"control step {t + 1} of {len(keys)}"
            return [f"{where}: {name}, environments {_some(bad)}" for name, bad in rows.items()]
    return []


def _some(bad: np.ndarray, shown: int = 5) -> str:
    """The first `shown` indices of True, and the number of the others."""
    indices = bad.nonzero()[0]
    more = f" and {len(indices) - shown} more" if len(indices) > shown else ""
    return ", ".join(map(str, indices[:shown])) + more
