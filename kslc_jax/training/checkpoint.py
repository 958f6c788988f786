"""Checkpoints of a whole training. `checkpoint_format` describes their content."""

import contextlib
import itertools
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import orbax.checkpoint as ocp

from kslc_jax import config as config_lib
from kslc_jax import files, ppo, train_step
from kslc_jax.checkpoint_format import (
    CheckpointError,
    abstract,
    changed_robot,
    checked_metadata,
    checksum,
    clear_away,
    forget_where,
    metadata,
    owner,
    require_checksum,
)
from kslc_jax.config import Config
from kslc_jax.fingerprint import fingerprint
from kslc_jax.policy import Policy
from kslc_jax.runtime import first_line
from kslc_jax.train_step import TrainState

BEST_METRIC = "score"
"""The metric that selects the best checkpoint."""

ENVIRONMENTS = "env"
"""The item with the environments, which is most of a checkpoint."""


def _split(state: TrainState) -> dict[str, Any]:
    return {
        "params": ppo.deployed(state.learner),
        "core": {
            "trained": ppo.acting(state.learner.params),
            "opt_state": state.learner.opt_state,
            "learning_rate": state.learner.learning_rate,
            "rate_ceiling": state.learner.rate_ceiling,
            "curriculum": state.curriculum,
            "key": state.key,
            "step": state.step,
        },
        ENVIRONMENTS: state.env,
    }


def _join(parts: dict[str, Any], like: TrainState) -> TrainState:
    core = parts["core"]
    learner = like.learner.replace(
        params={**parts["params"], **core["trained"]},
        average=ppo.acting(parts["params"]),
        opt_state=core["opt_state"],
        learning_rate=core["learning_rate"],
        rate_ceiling=core["rate_ceiling"],
    )
    return TrainState(learner, parts[ENVIRONMENTS], core["curriculum"], core["key"], core["step"])


class Store:
    """The checkpoints of one run folder. It keeps the latest `keep`, and the best by `score`."""

    def __init__(self, run_dir: Path, keep: int = 3):
        policies = ocp.checkpoint_managers
        self.folder = run_dir.resolve() / files.CHECKPOINTS
        best = policies.BestN(
            n=1, get_metric_fn=lambda m: m[BEST_METRIC], keep_checkpoints_without_metrics=False
        )
        self._options = ocp.CheckpointManagerOptions(
            preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(keep), best]),
            cleanup_tmp_directories=True,
        )
        self._manager = ocp.CheckpointManager(self.folder, options=self._options)

    def steps(self) -> list[int]:
        """Train steps that have a checkpoint, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, state: TrainState, config: Config, metrics: dict[str, float]) -> None:
        """Starts to write `state` in the background; CheckpointError if that fails."""
        step = int(state.step)
        if step in self.steps():
            return
        parts = _split(state)
        items = {name: ocp.args.StandardSave(part) for name, part in parts.items()}
        meta = metadata(config, metrics, parts, fingerprint(config.physics.robot))
        with self._writing():
            saved = self._manager.save(
                step,
                args=ocp.args.Composite(**items, meta=ocp.args.JsonSave(meta)),
                metrics={BEST_METRIC: metrics.get(BEST_METRIC, 0.0)},
                force=True,
            )
            if not saved:
                raise OSError(f"orbax refused to save step {step} in {self.folder}")

    def wait(self) -> None:
        """Blocks until the last save is on disk; CheckpointError if it failed."""
        with self._writing():
            self._manager.wait_until_finished()
        with contextlib.suppress(OSError):  # orbax may be removing an old checkpoint
            forget_where(self.folder)

    @contextlib.contextmanager
    def _writing(self) -> Generator[None]:
        """Turns any failure into a CheckpointError.

        After a failure it removes the incomplete checkpoint and makes a new manager: the old one
        would raise again at each later call.
        """
        try:
            yield
        except Exception as error:
            with contextlib.suppress(Exception):
                self._manager.close()
            clear_away(self.folder)
            self._manager = ocp.CheckpointManager(self.folder, options=self._options)
            full = "No space left" in str(error)
            why = "no space left on the disk" if full else first_line(error)
            raise CheckpointError(
                f"could not save a checkpoint: {why}; those before it are whole"
            ) from error

    def restore(self, like: TrainState, warn: Callable[[str], None]) -> TrainState:
        """Reads the latest checkpoint that is not damaged.

        A damaged checkpoint is renamed, and the one before it is read instead.

        Args:
          like: gives the shapes and types: arrays, or their abstract shapes.
          warn: called for each damaged checkpoint, and for each reason of `_restore`.

        Raises:
          CheckpointError: there is no readable checkpoint.
        """
        steps, bad = self.steps(), {}
        carried = not any((self.folder / f"{step}" / ENVIRONMENTS).is_dir() for step in steps)
        for step in reversed(steps):
            try:
                state, reasons = self._restore(step, like, carried)
            except Exception as error:  # damaged metadata can lead orbax anywhere
                bad[step] = first_line(error)
                continue
            self._put_aside(bad, step, warn)
            for reason in reasons:
                warn(
                    f"{reason}; from here on numbers differ from those of an uninterrupted training"
                )
            return state
        if not steps:
            raise CheckpointError(f"no checkpoint in {self.folder}")
        why = bad[steps[-1]]
        raise CheckpointError(f"no readable checkpoint in {self.folder}; the latest: {why}")

    def _put_aside(self, bad: dict[int, str], used: int, warn: Callable[[str], None]) -> None:
        """Renames the damaged checkpoints: the training will save the same steps again."""
        for step, why in bad.items():
            names = (f"damaged-{step}" + "-again" * i for i in itertools.count())
            aside = next(p for p in map(self.folder.joinpath, names) if not p.exists())
            (self.folder / str(step)).rename(aside)
            warn(f"checkpoint {step} is damaged ({why}), kept as {aside.name}; {used} is used")
        if bad:
            self._manager.reload()

    def _restore(self, step: int, like: TrainState, carried: bool) -> tuple[TrainState, list[str]]:
        """(state, reasons why the training goes on differently from an uninterrupted one).

        `carried`: the run was copied without environments. All robots then begin new episodes.
        """
        parts, reasons = _split(like), []
        if carried:
            del parts[ENVIRONMENTS]
            reasons.append(f"checkpoint {step} has no environments, all robots begin new episodes")
        items = {name: ocp.args.StandardRestore(abstract(part)) for name, part in parts.items()}
        only_meta = ocp.args.Composite(meta=ocp.args.JsonRestore())
        folder = self.folder / str(step)
        meta = checked_metadata(self._manager.restore(step, args=only_meta)["meta"], True, folder)
        restored = self._manager.restore(step, args=ocp.args.Composite(**items))
        sums = meta.get("checksums", {})
        for name in items:
            require_checksum(sums, name, checksum(restored[name]))
        if changed := changed_robot(meta, folder):
            reasons.append(f"the robot has changed since checkpoint {step}: {changed}")
        found = {name: restored[name] for name in items}
        if carried:
            config = config_lib.from_dict(meta["config"], owner(folder))
            key, done, reached = (found["core"][name] for name in ("key", "step", "curriculum"))
            found[ENVIRONMENTS] = train_step.new_episodes(config, key, done, reached)
        return _join(found, like), reasons

    def close(self) -> None:
        """Waits for the last save and closes the folder."""
        self.wait()
        self._manager.close()


def policy_of(config: Config, state: TrainState) -> Policy:
    """The present policy of a training."""
    params, step = ppo.deployed(state.learner), int(state.step)
    return Policy(config, params, state.curriculum, step, fingerprint(config.physics.robot))
