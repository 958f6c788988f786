"""The first state of a training that starts from a policy: `train --start-from`."""

import functools
import math
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
from jax.sharding import Mesh

from kslc_jax import train_step
from kslc_jax.checkpoint_format import identity
from kslc_jax.config import Config, ConfigError
from kslc_jax.curriculum import Curriculum
from kslc_jax.fingerprint import changes, fingerprint
from kslc_jax.networks import Params
from kslc_jax.policy import policy_name
from kslc_jax.train_step import TrainState
from kslc_jax.training import devices
from kslc_jax.training.checkpoint_process import LocalStorage


def from_policy(
    path: Path,
    config: Config,
    init: Callable[[], TrainState],
    storage: LocalStorage,
    mesh: Mesh | None,
) -> tuple[Callable[[], TrainState], dict[str, str]]:
    """`init` with a policy's networks and curriculum, and a note of their origin."""
    start = functools.partial(train_step.start_from, config)
    like = jax.eval_shape(init)
    step = 0

    def chosen() -> tuple[Params, Curriculum]:
        nonlocal step
        policy = storage.load_policy(path)
        step = policy.step
        theirs, ours = (identity(c.physics.robot) for c in (policy.config, config))
        if theirs != ours:
            raise ConfigError(
                f"cannot start from {path}: it is of the robot {theirs['name']}, not of "
                f"{ours['name']}, or its joints have another order"
            )
        if policy.config.physics.robot != config.physics.robot and (
            changed := changes(policy.robot or {}, fingerprint(config.physics.robot))
        ):
            warnings.warn(f"{path} was trained with another robot: {changed}", stacklevel=2)
        if not math.isclose(policy.config.control_dt, config.control_dt):
            steps = f"{policy.config.control_dt:g} s, this training one of {config.control_dt:g} s"
            warnings.warn(f"{path} was trained with a control step of {steps}", stacklevel=2)
        try:
            jax.eval_shape(start, like, policy.params, policy.curriculum)
        except ValueError as error:
            raise ConfigError(
                f"cannot start from {path}: it has {error}, see network and env.frames in its "
                "config"
            ) from error
        return policy.params, policy.curriculum

    params, curriculum = devices.from_first(chosen, (like.learner.params, like.curriculum))

    def begin() -> TrainState:
        state = start(init(), params, curriculum)
        return state if mesh is None else devices.place(mesh, state)

    return begin, {"start_from": f"{policy_name(path)}, train step {step}"}
