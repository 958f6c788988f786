"""The parts that checkpoints and stored policies share: items, schema, checksums, metadata.

A checkpoint holds four orbax items. Each can be read without the others:

- ``params``  the networks of a policy; the actor is the one that acts, averaged over updates;
- ``core``    the actor in training, optimiser, learning rate, curriculum, key and step;
- ``env``     the environments; with them a resumed run equals an uninterrupted one bit for bit;
- ``meta``    JSON: schema version, robot and its numbers, config, metrics of that step, checksums.

Reading never unpickles anything: arrays are raw numbers, everything else is JSON.
"""

import json
import shutil
import time
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kslc_jax import config as config_lib
from kslc_jax import files
from kslc_jax import robot as robot_lib
from kslc_jax.config import Config
from kslc_jax.errors import UserError
from kslc_jax.fingerprint import Fingerprint, changes, fingerprint
from kslc_jax.robots import copying

SCHEMA_VERSION = 8
"""Version of a checkpoint's items. Raise it when you change the tree of `TrainState`, and note
below the parts that the older schemas lack."""

OLDER_POLICIES = (1, 2, 3, 4, 5, 6, 7)
"""Older schemas: only their policy can still be read. 1 lacks the ceiling of the learning rate. 2
lacks the average of the actor, the time of the next command, and the curriculum's sums of commands
at the top. 3 lacks the shifts of the soles, the uneven ground and the disturbances. 4 lacks the
time of the last command at the top. 5 lacks the wanted command, and calls the air time of a landed
foot `landing`. 6 has the mean velocity in place of its error. 7 lacks `turns` of the command."""

COMMITTED = "Checkpoint commit was successful\n"
"""Content of the files `commit_success.txt`."""

ROBOT_NUMBERS = "robot_numbers"
"""Entry of a meta item: the `fingerprint` of the robot. Older checkpoints lack it."""


class CheckpointError(UserError, RuntimeError):
    """A checkpoint is missing, damaged or of another config, or it cannot be written."""


def is_key(x: Any) -> bool:
    """True if `x`, an array or an abstract shape, consists of typed random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def host_array(x: jax.Array) -> np.ndarray:
    """The numbers of an array on the host; for a typed key, its key data."""
    return np.asarray(jax.random.key_data(x) if is_key(x) else x)


def typed(numbers: np.ndarray, like: Any) -> Any:
    """Inverse of `host_array`: if `like` is a typed key, the numbers become keys again."""
    return jax.random.wrap_key_data(jnp.asarray(numbers)) if is_key(like) else numbers


def checksum(tree: Any) -> int:
    """CRC-32 of all numbers of a tree. Orbax itself does not detect flipped bits."""
    crc = 0
    for leaf in jax.tree.leaves(tree):
        crc = zlib.crc32(host_array(leaf).tobytes(), crc)
    return crc


def checked_metadata(meta: Any, whole: bool, folder: Path) -> dict[str, Any]:
    """Checks a meta item and returns it.

    Args:
      meta: the item.
      whole: True to resume the training, False to read the policy alone.
      folder: of the checkpoint or the policy.

    Raises:
      CheckpointError: the item is damaged, of another robot, or of a schema that cannot be read.
    """
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
    require_checksum(meta.get("checksums", {}), "meta", zlib.crc32(_text(meta)))
    ours = identity(_robot_name(meta, folder))
    theirs = meta.get("robot", ours)  # the first schema lacks this entry
    if theirs != ours:
        raise CheckpointError(f"it is of another robot, {theirs!r:.80}, not of {ours['name']}")
    return meta


def changed_robot(meta: dict[str, Any], folder: Path) -> str:
    """The changes of a meta item's robot since the save, in one line.

    The text is empty if nothing changed, or if the item stores no numbers of the robot.
    """
    numbers = meta.get(ROBOT_NUMBERS)
    return changes(numbers, fingerprint(_robot_name(meta, folder))) if numbers else ""


def _robot_name(meta: dict[str, Any], folder: Path) -> str:
    """The robot of the stored config. Configs without the field `physics.robot` are of XBot-L."""
    stored = meta["config"].get("physics", {}).get("robot", config_lib.XBOT_L)
    return config_lib.find_robot(stored, owner(folder))


def owner(folder: Path) -> Path:
    """The run folder of a checkpoint or a snapshot; the folder itself for any other policy."""
    in_run = folder.parent.name in (files.CHECKPOINTS, files.SNAPSHOTS)
    return folder.parents[1] if in_run else folder


def keep_robot(config: Config, folder: Path, anew: bool = False) -> None:
    """Copies a user's robot into a run folder or the folder of a policy.

    A copy that is there stays, unless `anew`.
    """
    robot = config.physics.robot
    there = (folder / files.ROBOT / Path(robot).name).is_file()
    if config_lib.is_description(robot) and (anew or not there):
        copying.copy(robot, folder / files.ROBOT)


def identity(name: str) -> dict[str, Any]:
    """The robot's name and its joint order, which defines the components of an action."""
    robot = robot_lib.load(name=name)
    return {"name": robot.name, "joints": list(robot.joint_names)}


def metadata(
    config: Config,
    metrics: dict[str, float],
    parts: dict[str, Any],
    numbers: Fingerprint | None = None,
) -> dict[str, Any]:
    """The meta item of a checkpoint.

    Args:
      config: of the training.
      metrics: of the train step.
      parts: the other items; their checksums go into the meta item.
      numbers: fingerprint of the trained robot; None if unknown.
    """
    meta = {
        "schema": SCHEMA_VERSION,
        "robot": identity(config.physics.robot),
        "config": config_lib.to_dict(config),
        "metrics": metrics,
    }
    if numbers:
        meta[ROBOT_NUMBERS] = numbers
    sums = {name: checksum(part) for name, part in parts.items()}
    return {**meta, "checksums": {**sums, "meta": zlib.crc32(_text(meta))}}


def _text(meta: dict[str, Any]) -> bytes:
    """The part of a meta item that its checksum covers: everything but the checksums."""
    return json.dumps({k: v for k, v in meta.items() if k != "checksums"}, sort_keys=True).encode()


def require_checksum(stored: dict[str, int], item: str, found: int) -> None:
    """CheckpointError if the stored checksum of `item` differs from `found`.

    Older checkpoints have no checksums and always pass.
    """
    if stored.get(item, found) != found:
        raise CheckpointError(f"the numbers of '{item}' are not those that were written")


def abstract(tree: Any) -> Any:
    """Shapes of a tree, with a sharding on one device: so any number of devices can restore it."""
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def clear_away(folder: Path) -> None:
    """Removes the remains of failed saves in a folder.

    It tries for a second, because threads of the failed save may still write.
    """
    for _ in range(10):
        for path in folder.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(path, ignore_errors=True)
        time.sleep(0.1)


def forget_where(folder: Path) -> None:
    """Removes the absolute path from the files `commit_success.txt` that orbax writes.

    Orbax only checks that they exist. People pass policies on, and the path is private.
    """
    for note in folder.rglob("commit_success.txt"):
        if note.read_bytes() != COMMITTED.encode():
            note.write_text(COMMITTED)


def has_checkpoints(run_dir: Path) -> bool:
    """True if a run folder holds a checkpoint to resume from."""
    folder = run_dir / files.CHECKPOINTS
    return folder.is_dir() and bool(whole_checkpoints(folder))


def whole_checkpoints(folder: Path) -> list[Path]:
    """The complete checkpoints in a folder, in any order."""
    return [p for p in folder.iterdir() if p.name.isdigit() and (p / "params").is_dir()]
