"""Checkpoints of a whole training, and policies loaded from them.

A checkpoint holds four orbax items, each usable without the others:

- ``params``  the networks, all that a policy needs;
- ``core``    optimiser, learning rate, curriculum, key and step;
- ``env``     the environments; with it a resumed run equals an uninterrupted one bit for bit;
- ``meta``    JSON: schema version, config, metrics of that step, checksums.

Nothing is ever unpickled: arrays are raw numbers, everything else is JSON.
"""

import contextlib
import itertools
import json
import shutil
import time
import zlib
from collections.abc import Callable, Generator
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
from kslc_jax import robot as robot_lib
from kslc_jax.config import Config
from kslc_jax.curriculum import Curriculum
from kslc_jax.runtime import first_line
from kslc_jax.train_step import TrainState

FOLDER = "checkpoints"
SNAPSHOTS = "snapshots"
POLICIES = Path(__file__).parent / "policies"
BEST_METRIC = "score"

SCHEMA_VERSION = 2
"""Of a checkpoint's items; raise it with every change of the tree of `TrainState`, and say below
what the older ones lack."""

OLDER_POLICIES = (1,)
"""Schemas of which only the policy is still read. 1: no ceiling of the learning rate."""


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, damaged or of another config; the message says which."""


def is_key(x: Any) -> bool:
    """Whether an array, or its shape, is one of typed random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def host_array(x: jax.Array) -> np.ndarray:
    """An array's numbers on the host; those of a typed key are its key data."""
    return np.asarray(jax.random.key_data(x) if is_key(x) else x)


def typed(numbers: np.ndarray, like: Any) -> Any:
    """An array on the host as what `host_array` made it of: key data become keys again."""
    return jax.random.wrap_key_data(jnp.asarray(numbers)) if is_key(like) else numbers


def checksum(tree: Any) -> int:
    """CRC-32 of all numbers of a tree: orbax itself reads flipped bits without a word."""
    crc = 0
    for leaf in jax.tree.leaves(tree):
        crc = zlib.crc32(host_array(leaf).tobytes(), crc)
    return crc


def _checked_meta(meta: Any, whole: bool) -> dict[str, Any]:
    """The meta item, if it is as it was written, of this robot and of a schema that is read, for
    going on with the `whole` training or for the policy alone; CheckpointError if not."""
    schema = meta.get("schema", 1)
    if schema in OLDER_POLICIES and whole:
        raise CheckpointError(
            f"it has checkpoint schema {schema}, this kslc_jax goes on from {SCHEMA_VERSION}: use "
            "the version that wrote it (versions.json), or begin a new training with --start-from"
        )
    if schema not in (*OLDER_POLICIES, SCHEMA_VERSION):
        raise CheckpointError(
            f"it has checkpoint schema {schema}, this kslc_jax reads {SCHEMA_VERSION}: "
            "use the version that wrote it, see versions.json"
        )
    _compare(meta.get("checksums", {}), "meta", zlib.crc32(_text(meta)))
    ours = _robot()
    theirs = meta.get("robot", ours)  # the first schema had none
    if theirs != ours:
        raise CheckpointError(f"it is of another robot, {theirs!r:.80}, not of {ours['name']}")
    return meta


def _robot() -> dict[str, Any]:
    """What a policy's actions mean: the robot's name and the order of its joints."""
    robot = robot_lib.load()
    return {"name": robot.name, "joints": list(robot.joint_names)}


def _meta(config: Config, metrics: dict[str, float], parts: dict[str, Any]) -> dict[str, Any]:
    """The meta item that goes with the other items of a checkpoint."""
    meta = {
        "schema": SCHEMA_VERSION,
        "robot": _robot(),
        "config": config_lib.to_dict(config),
        "metrics": metrics,
    }
    sums = {name: checksum(part) for name, part in parts.items()}
    return {**meta, "checksums": {**sums, "meta": zlib.crc32(_text(meta))}}


def _text(meta: dict[str, Any]) -> bytes:
    """What the checksum of a meta item is taken over: all of it but the checksums."""
    return json.dumps({k: v for k, v in meta.items() if k != "checksums"}, sort_keys=True).encode()


def _compare(stored: dict[str, int], item: str, found: int) -> None:
    """CheckpointError if `item` has another checksum than stored; older checkpoints have none."""
    if stored.get(item, found) != found:
        raise CheckpointError(f"the numbers of '{item}' are not those that were written")


def _split(state: TrainState) -> dict[str, Any]:
    return {
        "params": state.learner.params,
        "core": {
            "opt_state": state.learner.opt_state,
            "learning_rate": state.learner.learning_rate,
            "rate_ceiling": state.learner.rate_ceiling,
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
        rate_ceiling=core["rate_ceiling"],
    )
    return TrainState(learner, parts["env"], core["curriculum"], core["key"], core["step"])


def _abstract(tree: Any) -> Any:
    """Shapes with an explicit sharding, so that a checkpoint restores on any device count."""
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def _clear_away(folder: Path) -> None:
    """Removes what failed saves left in a folder; their threads may go on writing for a moment."""
    for _ in range(10):
        for path in folder.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(path, ignore_errors=True)
        time.sleep(0.1)


class Store:
    """The checkpoints of one run folder: the latest `keep` and the best by `score`."""

    def __init__(self, run_dir: Path, keep: int = 3):
        policies = ocp.checkpoint_managers
        self.folder = run_dir.resolve() / FOLDER
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
        """Starts writing `state` in the background; CheckpointError if it cannot."""
        step = int(state.step)
        if step in self.steps():
            return
        parts = _split(state)
        items = {name: ocp.args.StandardSave(part) for name, part in parts.items()}
        meta = _meta(config, metrics, parts)
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

    @contextlib.contextmanager
    def _writing(self) -> Generator[None]:
        """After a failure: one CheckpointError, and a manager that has cleared the half-written
        checkpoint away. The old one would raise again at each later call."""
        try:
            yield
        except Exception as error:
            with contextlib.suppress(Exception):
                self._manager.close()
            _clear_away(self.folder)
            self._manager = ocp.CheckpointManager(self.folder, options=self._options)
            full = "No space left" in str(error)
            why = "no space left on the disk" if full else first_line(error)
            raise CheckpointError(
                f"could not save a checkpoint: {why}; those before it are whole"
            ) from error

    def restore(self, like: TrainState, warn: Callable[[str], None]) -> TrainState:
        """The latest whole checkpoint, as the type of `like` (arrays or their abstract shapes).

        A damaged one is reported through `warn`, put aside, and the one before it is taken.
        """
        steps, bad = self.steps(), {}
        for step in reversed(steps):
            try:
                state = self._restore(step, like)
            except Exception as error:  # damaged metadata can lead orbax anywhere
                bad[step] = first_line(error)
                continue
            self._put_aside(bad, step, warn)
            return state
        if not steps:
            raise CheckpointError(f"no checkpoint in {self.folder}")
        why = bad[steps[-1]]
        raise CheckpointError(f"no readable checkpoint in {self.folder}; the latest: {why}")

    def _put_aside(self, bad: dict[int, str], used: int, warn: Callable[[str], None]) -> None:
        """Renames what is in the way of the steps to come."""
        for step, why in bad.items():
            names = (f"damaged-{step}" + "-again" * i for i in itertools.count())
            aside = next(p for p in map(self.folder.joinpath, names) if not p.exists())
            (self.folder / str(step)).rename(aside)
            warn(f"checkpoint {step} is damaged ({why}), kept as {aside.name}; {used} is used")
        if bad:
            self._manager.reload()

    def _restore(self, step: int, like: TrainState) -> TrainState:
        parts = _split(like)
        items = {name: ocp.args.StandardRestore(_abstract(part)) for name, part in parts.items()}
        only_meta = ocp.args.Composite(meta=ocp.args.JsonRestore())
        meta = _checked_meta(self._manager.restore(step, args=only_meta)["meta"], whole=True)
        restored = self._manager.restore(step, args=ocp.args.Composite(**items))
        sums = meta.get("checksums", {})
        for name in items:
            _compare(sums, name, checksum(restored[name]))
        return _join({name: restored[name] for name in items}, like)

    def close(self) -> None:
        """Waits for writes and lets go of the folder."""
        self.wait()
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
    folder = checkpoint_folder(Path(path_or_name))
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
        try:
            meta = reader.restore(folder, args=ocp.args.Composite(meta=ocp.args.JsonRestore()))
            meta = _checked_meta(meta["meta"], whole=False)
            config = config_lib.from_dict(meta["config"])
            reached = meta["metrics"]
            step = int(reached.get("step", folder.name if folder.name.isdigit() else 0))
            curriculum = curriculum_lib.init(config).replace(
                v_max=jnp.asarray(reached["curriculum/v_max"]),
                cycle_time=jnp.asarray(reached["curriculum/cycle_time"]),
            )
            like = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
            args = ocp.args.Composite(params=ocp.args.StandardRestore(_abstract(like)))
            params = reader.restore(folder, args=args)["params"]
            _compare(meta.get("checksums", {}), "params", checksum(params))
        except Exception as error:  # damaged metadata can lead orbax anywhere
            raise CheckpointError(
                f"{folder} is no readable checkpoint: {first_line(error)}"
            ) from error
    finite = all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    if not finite:
        raise CheckpointError(f"{folder}: the parameters hold NaN or infinity")
    return Policy(config, params, curriculum, step)


def policy_of(config: Config, state: TrainState) -> Policy:
    """The policy that a training has got to."""
    return Policy(config, state.learner.params, state.curriculum, int(state.step))


def save_policy(policy: Policy, folder: Path) -> None:
    """Writes what `load_policy` reads and nothing else; CheckpointError if it cannot."""
    reached = policy.curriculum
    metrics = {
        "step": policy.step,
        "curriculum/v_max": float(reached.v_max),
        "curriculum/cycle_time": float(reached.cycle_time),
    }
    meta = _meta(policy.config, metrics, {"params": policy.params})
    items = {"params": ocp.args.StandardSave(policy.params), "meta": ocp.args.JsonSave(meta)}
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as writer:
        try:
            writer.save(folder.resolve(), args=ocp.args.Composite(**items))
        except (OSError, ValueError) as error:
            _clear_away(folder.parent)
            raise CheckpointError(f"cannot write {folder}: {first_line(error)}") from error


def checkpoint_folder(path: Path) -> Path:
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
    steps = _steps(root)
    if not steps:
        raise CheckpointError(f"no checkpoint in {root}")
    return max(steps, key=lambda p: int(p.name)).resolve()


def has_checkpoints(run_dir: Path) -> bool:
    """Whether there is anything in a run folder to go on from."""
    folder = run_dir / FOLDER
    return folder.is_dir() and bool(_steps(folder))


def _steps(folder: Path) -> list[Path]:
    """The whole checkpoints in a folder, in any order."""
    return [p for p in folder.iterdir() if p.name.isdigit() and (p / "params").is_dir()]
