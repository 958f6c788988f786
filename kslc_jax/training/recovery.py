"""Recovery from bad numbers: a training goes back to a checkpoint, or gives up and writes a dump.

`train_step` masks broken samples and gives their environments a new episode. This file handles the
rest: parameters that are not finite, and updates that learn nothing.
"""

import json
import shlex
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import config as config_lib
from kslc_jax import train_step
from kslc_jax.checkpoint_format import CheckpointError, host_array, typed
from kslc_jax.config import Config
from kslc_jax.errors import UserError
from kslc_jax.runtime import first_line
from kslc_jax.train_step import TrainState

PATIENCE = 10
"""A training goes back after this number of train steps in a row that learn nothing. It warns after
the same number of train steps in a row with many broken samples."""

ALL = 0.9999
"""Shares from this value on count as all: a float32 mean of ones may be below 1."""

MANY = 0.01
"""Share of broken samples. Larger shares count as many, see `PATIENCE`."""

ATTEMPTS = 3
"""A training goes back to the same checkpoint at most this many times, then it gives up."""

CAUTION = 0.5
"""Factor on the learning rate each time a training goes back."""


class NumbersError(UserError, RuntimeError):
    """The numbers go bad in every attempt."""

    exit_code = 1


class NonFiniteState(Exception):
    """A training cannot go on. `before` is the state before the first bad step."""

    def __init__(self, why: str, before: TrainState):
        super().__init__(why)
        self.before = before


@jax.jit
def _copy(state: TrainState) -> TrainState:
    """Copies all leaves in one program. One program per leaf would let a GPU wait."""
    return jax.tree.map(jnp.copy, state)


class NumericsCheck:
    """Decides from the metrics of each train step if the numbers are good.

    A bad train step leaves a learner or curriculum that is not finite, or learns nothing: none of
    its gradients is finite, or all of its samples are broken.
    """

    def __init__(self, state: TrainState):
        self._steps = self._bad_steps = self._many_broken = 0
        self._finite = True
        self._why = ""
        self._before = state

    @property
    def good(self) -> bool:
        """True if the last train step was not bad."""
        return self._bad_steps == 0

    @property
    def finite(self) -> bool:
        """True if the learner and the curriculum are finite; only such states are saved."""
        return self._finite

    def before(self, state: TrainState) -> None:
        """Keeps a copy of the state before a step, because the step donates `state`.

        During bad steps it keeps the copy from before the first bad one.
        """
        if self.good:
            self._before = _copy(state)

    def after(self, metrics: dict[str, float]) -> str:
        """Checks the metrics of a train step. Returns a warning; empty if there is none."""
        self._steps += 1
        self._finite = metrics["finite"] == 1.0
        self._why = _nothing_learnt(metrics)
        self._bad_steps = self._bad_steps + 1 if self._why or not self._finite else 0
        self._many_broken = self._many_broken + 1 if metrics["broken"] > MANY else 0
        if self._many_broken != PATIENCE or self._bad_steps == PATIENCE:
            return ""
        return (
            f"in each of the last {PATIENCE} train steps more than {MANY:.0%} of the samples were "
            f"broken, {metrics['broken']:.1%} in the last one: numbers that are not finite, or a "
            "physics that diverges; nothing is learnt from them (metric `broken`)"
        )

    def require_good(self) -> None:
        """NonFiniteState if the state is not finite, or the last `PATIENCE` steps were bad."""
        if not self._finite:
            raise NonFiniteState("the learner or the curriculum is not finite", self._before)
        if self._bad_steps == PATIENCE:
            raise NonFiniteState(f"{self._why} in {PATIENCE} train steps", self._before)

    def require_some_good(self) -> None:
        """NumbersError if every train step was bad; call it at the end of a training.

        Without it a training shorter than `PATIENCE` train steps would seem to succeed.
        """
        if self._steps and self._bad_steps == self._steps:
            raise NumbersError(f"{self._why} in all {self._steps} train steps: nothing is learnt")


def _nothing_learnt(metrics: dict[str, float]) -> str:
    """The reason why a train step learnt nothing; empty if it learnt."""
    if metrics["broken"] >= ALL:
        return "every sample was broken"
    return "not one finite gradient" if metrics["ppo/skipped"] >= ALL else ""


def leave(config: Config, path: Path, state: TrainState) -> str:
    """Writes a state with `dump`. Returns the command that reads it, or the reason of a failure."""
    try:
        dump(path, config, state)
    except OSError as error:
        return f"{path} could not be written ({error.strerror})"
    return f"see where: python -m kslc_jax.doctor replay {shlex.quote(str(path))}"


def with_lower_rate(state: TrainState, attempt: int) -> TrainState:
    """`state` with a lower learning rate and another random key.

    The rate becomes its own ceiling, so that it rises only slowly. The other key avoids the same
    bad numbers.
    """
    rate = state.learner.learning_rate * CAUTION**attempt
    # A copy, because a train step donates its state: no buffer may occur twice in it.
    learner = state.learner.replace(learning_rate=rate, rate_ceiling=jnp.copy(rate))
    return state.replace(learner=learner, key=jax.random.fold_in(state.key, attempt))


def dump(path: Path, config: Config, state: TrainState) -> None:
    """Writes a state and its config to an npz file, for `python -m kslc_jax.doctor replay`."""
    arrays: dict[str, Any] = {
        jax.tree_util.keystr(where): host_array(x) for where, x in jax.tree.leaves_with_path(state)
    }
    arrays["config"] = np.asarray(json.dumps(config_lib.to_dict(config)))
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_dump(path: Path) -> tuple[Config, TrainState]:
    """(config, state) of a dump; CheckpointError if the file is no dump."""

    def leaf(where: Any, like: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(where)
        x = jnp.asarray(typed(arrays[name], like))
        if (x.shape, x.dtype) != (like.shape, like.dtype):
            raise ValueError(f"{name} is {x.dtype}{x.shape}, not {like.dtype}{like.shape}")
        return x

    try:
        with np.load(path, allow_pickle=False) as arrays:
            config = config_lib.from_dict(json.loads(str(arrays["config"])), path.parent)
            like = jax.eval_shape(lambda: train_step.init(config, 0))
            return config, jax.tree.map_with_path(leaf, like)
    except Exception as error:  # a wrong file can fail as zip, as JSON, or as config
        raise CheckpointError(f"{path} is no dump of a training: {first_line(error)}") from error
