"""Numbers gone bad: when a training goes back to a checkpoint, and what it leaves when it gives up.

Single environments are `train_step`'s business: it masks them and starts them anew. This file is
about what that cannot mend: updates that are never finite, parameters that are not.
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
"""Train steps in a row without one finite update, after which a training goes back."""

ALL_SKIPPED = 0.9999
"""Share of skipped gradient steps from which all were: a float32 mean of ones may be below 1."""

ATTEMPTS = 3
"""Times that it goes back to the same checkpoint before it gives up."""

CAUTION = 0.5
"""Factor on the learning rate at each of them."""


class NumbersError(UserError, RuntimeError):
    """Numbers that go bad however often the training goes back."""

    exit_code = 1


class NonFiniteState(Exception):
    """Carries what is wrong, and the state before the first bad train step."""

    def __init__(self, why: str, before: TrainState):
        super().__init__(why)
        self.before = before


@jax.jit
def _copy(state: TrainState) -> TrainState:
    """One program; one for each of a hundred leaves would keep a GPU waiting."""
    return jax.tree.map(jnp.copy, state)


class NumericsCheck:
    """Tells from the metrics of each train step if a training's numbers are good."""

    def __init__(self, state: TrainState):
        self._bad_steps = 0
        self._finite = True
        self._before = state

    @property
    def good(self) -> bool:
        """Whether the last train step learnt something, from numbers that are all finite."""
        return self._bad_steps == 0

    @property
    def finite(self) -> bool:
        """True if the learner and the curriculum are finite; only such states are saved."""
        return self._finite

    def before(self, state: TrainState) -> None:
        """Keeps a copy, for the step donates `state`; during bad steps the one before them."""
        if self.good:
            self._before = _copy(state)

    def after(self, metrics: dict[str, float]) -> None:
        """Counts bad train steps in a row."""
        self._finite = metrics["finite"] == 1.0
        learnt = metrics["ppo/skipped"] < ALL_SKIPPED
        self._bad_steps = 0 if self._finite and learnt else self._bad_steps + 1

    def require_good(self) -> None:
        """NonFiniteState where going on has no point."""
        if not self._finite:
            raise NonFiniteState("the learner or the curriculum is not finite", self._before)
        if self._bad_steps == PATIENCE:
            raise NonFiniteState(f"not one finite gradient in {PATIENCE} train steps", self._before)


def leave(config: Config, path: Path, state: TrainState) -> str:
    """Writes a state with `dump`; returns what to do with it, or why it was not written."""
    try:
        dump(path, config, state)
    except OSError as error:
        return f"{path} could not be written ({error.strerror})"
    return f"see where: python -m kslc_jax.doctor replay {shlex.quote(str(path))}"


def with_lower_rate(state: TrainState, attempt: int) -> TrainState:
    """`state` with a lower learning rate, which may not rise at once, and, so that not all comes
    again, other random draws."""
    rate = state.learner.learning_rate * CAUTION**attempt
    # A copy: a train step donates its state, which may not hold one buffer twice.
    learner = state.learner.replace(learning_rate=rate, rate_ceiling=jnp.copy(rate))
    return state.replace(learner=learner, key=jax.random.fold_in(state.key, attempt))


def dump(path: Path, config: Config, state: TrainState) -> None:
    """Writes a state and its config as one npz, for `python -m kslc_jax.doctor replay`."""
    arrays: dict[str, Any] = {
        jax.tree_util.keystr(where): host_array(x) for where, x in jax.tree.leaves_with_path(state)
    }
    arrays["config"] = np.asarray(json.dumps(config_lib.to_dict(config)))
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_dump(path: Path) -> tuple[Config, TrainState]:
    """Config and state of a dump; CheckpointError if it is none."""

    def leaf(where: Any, like: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(where)
        x = jnp.asarray(typed(arrays[name], like))
        if (x.shape, x.dtype) != (like.shape, like.dtype):
            raise ValueError(f"{name} is {x.dtype}{x.shape}, not {like.dtype}{like.shape}")
        return x

    try:
        with np.load(path, allow_pickle=False) as arrays:
            config = config_lib.from_dict(json.loads(str(arrays["config"])))
            like = jax.eval_shape(lambda: train_step.init(config, 0))
            return config, jax.tree.map_with_path(leaf, like)
    except Exception as error:  # zip, JSON, config: whatever a wrong file leads to
        raise CheckpointError(f"{path} is no dump of a training: {first_line(error)}") from error
