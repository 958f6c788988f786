"""A trained policy: acting, loading, saving. Imports no training code."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from kslc_jax import config as config_lib
from kslc_jax import curriculum as curriculum_lib
from kslc_jax import files, networks, observations
from kslc_jax import robot as robot_lib
from kslc_jax.checkpoint_format import (
    ROBOT_NUMBERS,
    CheckpointError,
    abstract,
    changed_robot,
    checked_metadata,
    checksum,
    clear_away,
    forget_where,
    keep_robot,
    metadata,
    owner,
    require_checksum,
    whole_checkpoints,
)
from kslc_jax.config import Config
from kslc_jax.curriculum import Curriculum
from kslc_jax.fingerprint import Fingerprint
from kslc_jax.runtime import first_line

POLICIES = Path(__file__).parent / "policies"
"""Folder of the policies that are shipped with the package."""


@flax.struct.dataclass
class PolicyState:
    """Memory of a running policy."""

    history: jax.Array  # [K, W]


@dataclass(frozen=True)
class Policy:
    """A trained actor. `act` is pure and may be jitted and vmapped."""

    config: Config
    params: networks.Params
    curriculum: Curriculum  # progress of the training: v_max and gait cycle
    step: int
    robot: Fingerprint | None = None  # numbers of the trained robot; None: unknown

    def init(self) -> PolicyState:
        """Memory before the first frame."""
        width = observations.actor_width(robot_lib.load(name=self.config.physics.robot))
        return PolicyState(jnp.zeros((self.config.env.frames, width)))

    def act(self, state: PolicyState, frame: jax.Array) -> tuple[PolicyState, jax.Array]:
        """(new state, deterministic action [n]) for the newest actor frame [W]."""
        history = observations.append_frame(state.history, frame)
        return PolicyState(history), self.act_on(history)

    def act_on(self, history: jax.Array) -> jax.Array:
        """Deterministic action [n] for a whole history [K, W]."""
        return networks.policy(self.config, self.params, history).mean


def load_policy(path_or_name: str | Path) -> Policy:
    """Loads a policy from a run folder or a checkpoint folder, or a shipped policy by its name.

    If the robot has changed since the training, a Python warning names the changed numbers.

    Raises:
      CheckpointError: there is no policy, or it cannot be read.
    """
    folder = checkpoint_folder(Path(path_or_name))
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as reader:
        try:
            meta = reader.restore(folder, args=ocp.args.Composite(meta=ocp.args.JsonRestore()))
            meta = checked_metadata(meta["meta"], False, folder)
            config = config_lib.from_dict(meta["config"], owner(folder))
            reached = meta["metrics"]
            step = int(reached.get("step", folder.name if folder.name.isdigit() else 0))
            curriculum = curriculum_lib.init(config).replace(
                v_max=jnp.asarray(reached["curriculum/v_max"], jnp.float32),
                cycle_time=jnp.asarray(reached["curriculum/cycle_time"], jnp.float32),
            )
            like = jax.eval_shape(lambda: networks.init(config, jax.random.key(0)))
            args = ocp.args.Composite(params=ocp.args.StandardRestore(abstract(like)))
            params = reader.restore(folder, args=args)["params"]
            require_checksum(meta.get("checksums", {}), "params", checksum(params))
            trained = meta.get(ROBOT_NUMBERS)
            changed = changed_robot(meta, folder)
        except Exception as error:  # damaged metadata can lead orbax anywhere
            raise CheckpointError(
                f"{folder} is no readable checkpoint: {first_line(error)}"
            ) from error
    finite = all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    if not finite:
        raise CheckpointError(f"{folder}: the parameters hold NaN or infinity")
    if changed:
        name = policy_name(path_or_name)
        text = f"{name}: the robot has changed since the training of this policy: {changed}"
        warnings.warn(text, stacklevel=2)
    return Policy(config, params, curriculum, step, trained)


def save_policy(policy: Policy, folder: Path) -> None:
    """Writes the items that `load_policy` reads; CheckpointError if that fails.

    A user's robot is copied into the folder, except in a run folder, which has a copy.
    """
    reached = policy.curriculum
    metrics = {
        "step": policy.step,
        "curriculum/v_max": float(reached.v_max),
        "curriculum/cycle_time": float(reached.cycle_time),
    }
    meta = metadata(policy.config, metrics, {"params": policy.params}, policy.robot)
    items = {"params": ocp.args.StandardSave(policy.params), "meta": ocp.args.JsonSave(meta)}
    with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as writer:
        try:
            writer.save(folder.resolve(), args=ocp.args.Composite(**items))
            forget_where(folder)
            keep_robot(policy.config, owner(folder.absolute()))
        except (OSError, ValueError) as error:
            clear_away(folder.parent)
            raise CheckpointError(f"cannot write {folder}: {first_line(error)}") from error


def policy_name(path_or_name: str | Path) -> str:
    """The name of a policy in published results: without the folders of this machine.

    A run, a stored policy and a shipped policy have the name of `files.run_name`. A checkpoint has
    the name of its run.
    """
    path = Path(path_or_name).resolve()
    if path.name.isdigit() and path.parent.name in (files.CHECKPOINTS, files.SNAPSHOTS):
        path = path.parent
    run = path.parent if path.name in (files.CHECKPOINTS, files.SNAPSHOTS) else path
    return files.run_name(run)


def checkpoint_folder(path: Path) -> Path:
    """The folder of one checkpoint; in a run folder, of the latest one.

    Args:
      path: run folder, checkpoint folder, or name of a shipped policy.

    Raises:
      CheckpointError: there is no checkpoint.
    """
    if not path.exists() and (POLICIES / path).is_dir():
        path = POLICIES / path
    if not path.is_dir():
        shipped = sorted(p.name for p in POLICIES.glob("*") if p.is_dir())
        names = f" (shipped: {', '.join(shipped)})" if shipped else ""
        raise CheckpointError(f"no run, checkpoint or shipped policy called '{path}'{names}")
    if (path / "params").is_dir():
        return path.resolve()
    root = path / files.CHECKPOINTS if (path / files.CHECKPOINTS).is_dir() else path
    steps = whole_checkpoints(root)
    if not steps:
        raise CheckpointError(f"no checkpoint in {root}{files.seeds_hint(path)}")
    return max(steps, key=lambda p: int(p.name)).resolve()
