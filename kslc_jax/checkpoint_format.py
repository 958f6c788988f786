"""The parts that checkpoints and stored policies share: items, schema, checksums, metadata.

A checkpoint holds four orbax items, each usable without the others:

- ``params``  the networks, all that a policy needs: the actor as it is used, averaged;
- ``core``    the actor as it is trained, optimiser, learning rate, curriculum, key and step;
- ``env``     the environments; with it a resumed run equals an uninterrupted one bit for bit;
- ``meta``    JSON: schema version, robot and its numbers, config, metrics of that step, checksums.

Nothing is ever unpickled: arrays are raw numbers, everything else is JSON.
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

SCHEMA_VERSION = 3
"""Of a checkpoint's items; raise it with every change of the tree of `TrainState`, and say below
what the older ones lack."""

OLDER_POLICIES = (1, 2)
"""Schemas of which only the policy is still read. 1: no ceiling of the learning rate. 2: no average
of the actor, no time of the next command, no sums of the curriculum's top."""


ROBOT_NUMBERS = "robot_numbers"
"""Entry of a meta item: the `fingerprint` of the robot. Older checkpoints have none."""


class CheckpointError(UserError, RuntimeError):
    """A checkpoint that is missing, damaged or of another config; the message says which."""


def is_key(x: Any) -> bool:
    """True if an array, or its shape, is one of typed random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def host_array(x: jax.Array) -> np.ndarray:
    """An array's numbers on the host; those of a typed key are its key data."""
    return np.asarray(jax.random.key_data(x) if is_key(x) else x)


def typed(numbers: np.ndarray, like: Any) -> Any:
    """Inverse of `host_array`: key data become keys again, as in `like`."""
    return jax.random.wrap_key_data(jnp.asarray(numbers)) if is_key(like) else numbers


def checksum(tree: Any) -> int:
    """CRC-32 of all numbers of a tree. Orbax itself does not notice flipped bits."""
    crc = 0
    for leaf in jax.tree.leaves(tree):
        crc = zlib.crc32(host_array(leaf).tobytes(), crc)
    return crc


def checked_metadata(meta: Any, whole: bool) -> dict[str, Any]:
    """Returns the meta item. CheckpointError if it is damaged, of another robot, or of a schema
    that cannot be read: for resuming the `whole` training, or for the policy alone."""
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
    ours = _robot(_robot_name(meta))
    theirs = meta.get("robot", ours)  # the first schema had none
    if theirs != ours:
        raise CheckpointError(f"it is of another robot, {theirs!r:.80}, not of {ours['name']}")
    return meta


def changed_robot(meta: dict[str, Any]) -> str:
    """The numbers in which the robot of a meta item differs now from the stored ones, in one line.

    It is empty if there are none, or if no numbers were stored.
    """
    numbers = meta.get(ROBOT_NUMBERS)
    return changes(numbers, fingerprint(_robot_name(meta))) if numbers else ""


def _robot_name(meta: dict[str, Any]) -> str:
    """`physics.robot` of the stored config; before the field existed, there was one robot."""
    return meta["config"].get("physics", {}).get("robot", robot_lib.XBOT_L)


def _robot(name: str) -> dict[str, Any]:
    """The robot's name and the order of its joints, which give a policy's actions their meaning."""
    robot = robot_lib.load(name=name)
    return {"name": robot.name, "joints": list(robot.joint_names)}


def metadata(
    config: Config,
    metrics: dict[str, float],
    parts: dict[str, Any],
    numbers: Fingerprint | None = None,
) -> dict[str, Any]:
    """The meta item that goes with the other items of a checkpoint; `numbers` are those of the
    robot that was trained, None if unknown."""
    meta = {
        "schema": SCHEMA_VERSION,
        "robot": _robot(config.physics.robot),
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
    """CheckpointError if `item` has another checksum than stored; older checkpoints have none."""
    if stored.get(item, found) != found:
        raise CheckpointError(f"the numbers of '{item}' are not those that were written")


def abstract(tree: Any) -> Any:
    """Shapes with an explicit sharding, so that a checkpoint restores on any device count."""
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)


def clear_away(folder: Path) -> None:
    """Removes the remains of failed saves in a folder; their threads may still write a moment."""
    for _ in range(10):
        for path in folder.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(path, ignore_errors=True)
        time.sleep(0.1)


def has_checkpoints(run_dir: Path) -> bool:
    """True if a run folder holds a checkpoint to resume from."""
    folder = run_dir / files.CHECKPOINTS
    return folder.is_dir() and bool(whole_checkpoints(folder))


def whole_checkpoints(folder: Path) -> list[Path]:
    """The whole checkpoints in a folder, in any order."""
    return [p for p in folder.iterdir() if p.name.isdigit() and (p / "params").is_dir()]
