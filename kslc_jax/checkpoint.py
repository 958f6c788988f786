"""Checkpoints of a whole training, and policies loaded from them.

A checkpoint holds four orbax items, each usable without the others:

- ``params``  the networks, all that a policy needs;
- ``core``    optimiser, learning rate, curriculum, key and step;
- ``env``     the environments; with it a resumed run equals an uninterrupted one bit for bit;
- ``meta``    JSON: schema version, config, metrics of that step.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from kslc_jax import config as config_lib
from kslc_jax import curriculum as curriculum_lib
from kslc_jax import networks, observations
from kslc_jax.config import Config, ConfigError
from kslc_jax.curriculum import Curriculum
from kslc_jax.train_step import TrainState

FOLDER = "checkpoints"
POLICIES = Path(__file__).parent / "policies"
BEST_METRIC = "score"


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, damaged or of another config; the message says which."""


def first_line(error: Exception) -> str:
    """The first line of an error's message, cut to what fits a terminal."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


def _split(state: TrainState) -> dict[str, Any]:
    return {
        "params": state.learner.params,
        "core": {
            "opt_state": state.learner.opt_state,
            "learning_rate": state.learner.learning_rate,
            "curriculum": state.curriculum,
            "key": state.key,
            "step": state.step,
        },
        "env": state.env,
    }


def _join(parts: dict[str, Any], like: TrainState) -> TrainState:
    core = parts["core"]
    learner = like.learner.replace(
        params=parts["params"],
        opt_state=core["opt_state"],
        learning_rate=core["learning_rate"],
    )
    return TrainState(learner, parts["env"], core["curriculum"], core["key"], core["step"])


def _abstract(tree: Any) -> Any:
    """Shapes with an explicit sharding, so that a checkpoint restores on any device count."""
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


class Store:
    """The checkpoints of one run folder: the latest `keep` and the best by `score`."""

    def __init__(self, run_dir: Path, keep: int = 3):
        policies = ocp.checkpoint_managers
        self.folder = run_dir.resolve() / FOLDER
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=ocp.CheckpointManagerOptions(
                preservation_policy=policies.AnyPreservationPolicy(
                    [
                        policies.LatestN(keep),
                        policies.BestN(
                            n=1,
                            get_metric_fn=lambda m: m[BEST_METRIC],
                            keep_checkpoints_without_metrics=False,
                        ),
                    ]
                ),
                cleanup_tmp_directories=True,
            ),
        )

    def steps(self) -> list[int]:
        """Train steps that have a checkpoint, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, state: TrainState, config: Config, metrics: dict[str, float]) -> None:
        """Starts writing `state` in the background; OSError if an earlier write failed."""
        step = int(state.step)
        if step in self.steps():
            return
        items = {name: ocp.args.StandardSave(part) for name, part in _split(state).items()}
        meta = {"config": config_lib.to_dict(config), "metrics": metrics}
        saved = self._manager.save(
            step,
            args=ocp.args.Composite(**items, meta=ocp.args.JsonSave(meta)),
            metrics={BEST_METRIC: metrics.get(BEST_METRIC, 0.0)},
            force=True,
        )
        if not saved:
            raise OSError(f"orbax refused to save step {step} in {self.folder}")

    def wait(self) -> None:
        """Blocks until the last save is on disk."""
        self._manager.wait_until_finished()

    def restore(self, like: TrainState, warn: Callable[[str], None]) -> TrainState:
        """The latest whole checkpoint, as the type of `like` (arrays or their abstract shapes).

        A damaged one is reported through `warn` and the one before it is taken.
        """
        steps = self.steps()
        if not steps:
            raise CheckpointError(f"no checkpoint in {self.folder}")
        for step in reversed(steps):
            try:
                return self._restore(step, like)
            except (ValueError, OSError, KeyError, TypeError) as error:
                why = first_line(error)
                warn(f"checkpoint {step} cannot be read ({why}); trying the one before")
        raise CheckpointError(f"no readable checkpoint in {self.folder}")

    def _restore(self, step: int, like: TrainState) -> TrainState:
        items = {
            name: ocp.args.StandardRestore(_abstract(part)) for name, part in _split(like).items()
        }
        restored = self._manager.restore(step, args=ocp.args.Composite(**items))
        return _join({name: restored[name] for name in items}, like)

    def close(self) -> None:
        """Waits for writes and lets go of the folder."""
        self._manager.close()


# ----------------------------------------------------------------------------------------- policy


@flax.struct.dataclass
class PolicyState:
    """Memory of a running policy."""

    history: jax.Array  # [K, 59]


@dataclass(frozen=True)
class Policy:
    """A trained actor. `act` is pure and may be jitted and vmapped."""

    config: Config
    params: networks.Params
    curriculum: Curriculum  # where the training had got to: v_max and gait cycle
    step: int

    def init(self) -> PolicyState:
        """Memory before the first frame."""
        return PolicyState(jnp.zeros((self.config.env.frames, observations.ACTOR_WIDTH)))

    def act(self, state: PolicyState, frame: jax.Array) -> tuple[PolicyState, jax.Array]:
        """Deterministic action [16] for the newest actor frame [59]."""
        history = observations.push_history(state.history, frame)
        return PolicyState(history), self.act_on(history)

    def act_on(self, history: jax.Array) -> jax.Array:
        """Deterministic action [16] for a whole history [K, 59]."""
        return networks.policy(self.config, self.params, history).mean


def load_policy(path_or_name: str | Path) -> Policy:
    """Loads a policy from a run folder, a checkpoint folder, or by the name of a shipped one.

    Raises:
      CheckpointError: nothing there, or it cannot be read.
    """
    folder = _checkpoint_folder(Path(path_or_name))
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
        try:
            meta = reader.restore(folder, args=ocp.args.Composite(meta=ocp.args.JsonRestore()))
            config = config_lib.from_dict(meta["meta"]["config"])
            reached = meta["meta"]["metrics"]
            curriculum = curriculum_lib.init(config).replace(
                v_max=jnp.asarray(reached["curriculum/v_max"]),
                cycle_time=jnp.asarray(reached["curriculum/cycle_time"]),
            )
            like = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
            args = ocp.args.Composite(params=ocp.args.StandardRestore(_abstract(like)))
            params = reader.restore(folder, args=args)["params"]
        except (ConfigError, ValueError, OSError, KeyError, TypeError) as error:
            raise CheckpointError(
                f"{folder} is no readable checkpoint: {first_line(error)}"
            ) from error
    finite = all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    if not finite:
        raise CheckpointError(f"{folder}: the parameters hold NaN or infinity")
    return Policy(config, params, curriculum, int(folder.name) if folder.name.isdigit() else 0)


def _checkpoint_folder(path: Path) -> Path:
    """The folder of one checkpoint for a run folder, a checkpoint folder or a shipped name."""
    if not path.exists() and (POLICIES / path).is_dir():
        path = POLICIES / path
    if not path.is_dir():
        shipped = sorted(p.name for p in POLICIES.glob("*") if p.is_dir())
        names = f" (shipped: {', '.join(shipped)})" if shipped else ""
        raise CheckpointError(f"no run, checkpoint or shipped policy called '{path}'{names}")
    if (path / "params").is_dir():
        return path.resolve()
    root = path / FOLDER if (path / FOLDER).is_dir() else path
    steps = [p for p in root.iterdir() if p.name.isdigit() and (p / "params").is_dir()]
    if not steps:
        raise CheckpointError(f"no checkpoint in {root}")
    return max(steps, key=lambda p: int(p.name)).resolve()
