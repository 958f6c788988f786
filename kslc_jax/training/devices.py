"""A training over several devices, of one process or of several.

Environments [N, ...] are split over a mesh with one axis. Networks, optimiser, curriculum and
counters are replicated on every device. The train step is the same program: `jit` with these
shardings adds the communication. Its numbers equal those of one device, except for the order of
sums. docs/scaling.md counts the communication.

Several processes run the same program side by side. Some facts are known to one process only, for
example a signal. Processes exchange them through `agree`, `on_first` and `from_first`. All
processes call these at the same point of the program. So they take the same branches, and no
process waits for one that has ended.
"""

import contextlib
import itertools
import os
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from orbax.checkpoint import multihost

from kslc_jax import physics, train_step
from kslc_jax.checkpoint_format import host_array, is_key, typed
from kslc_jax.config import Config, ConfigError
from kslc_jax.errors import UserError
from kslc_jax.runtime import first_line
from kslc_jax.train_step import Metrics, TrainState

AXIS = "env"

WAIT = 3600
"""Time [s] for which processes wait for each other outside of train steps, as for a compilation."""

T = TypeVar("T")


def join(
    coordinator: str | None = None, processes: int | None = None, index: int | None = None
) -> None:
    """Makes this process one of several. Call it before JAX does anything else.

    Under Slurm, Open MPI, Kubernetes and on TPU pods JAX finds the arguments by itself.

    Args:
      coordinator: host:port at which process 0 listens. All others must be able to reach it.
      processes: number of processes.
      index: index of this process, from 0.

    Raises:
      ConfigError: the processes cannot be joined.
    """
    with contextlib.suppress(AttributeError):  # older JAX versions lack this option
        jax.config.update("jax_enable_preemption_service", False)  # the loop handles SIGTERM
    try:
        jax.distributed.initialize(coordinator, processes, index)
    except (RuntimeError, ValueError, OSError) as error:
        by = coordinator or "auto, with the scheduler's settings"
        why = first_line(error)
        raise ConfigError(f"--coordinator {by}: cannot join the processes: {why}") from error


def splits(config: Config, count: int) -> bool:
    """True if `count` devices can share environments and minibatches evenly."""
    return config.env.num_envs % count == 0 and config.minibatch_size % count == 0


def choose(config: Config, wanted: int | None = None) -> list[jax.Device]:
    """The devices to train on, the same number from each process.

    Args:
      config: the training's config.
      wanted: devices per process. None: as many accelerators as can share the batch evenly, but
        one if the device is a CPU or the physics runs on the CPU.

    Raises:
      ConfigError: a process has fewer devices than `wanted`, or `wanted` is below 1.
    """
    there = jax.devices()
    held = Counter(d.process_index for d in there)
    least = min(held.values())
    if wanted is not None and not 1 <= wanted <= least:
        kind = there[0].platform
        raise ConfigError(f"--devices: {wanted} asked for, a process has {least} ({kind})")
    if wanted is None:
        one = jax.default_backend() == "cpu" or physics.resolve_engine(config.physics) == "mujoco"
        counts = range(1 if one else least, 0, -1)
        wanted = next((n for n in counts if splits(config, n * len(held))), 1)
    taken: Counter[int] = Counter()
    chosen = []
    for device in there:
        taken[device.process_index] += 1
        if taken[device.process_index] <= wanted:
            chosen.append(device)
    return chosen


def pick(config: Config, wanted: int | None = None) -> Mesh | None:
    """The mesh of the devices from `choose`; None for one device of one process."""
    chosen = choose(config, wanted)
    return mesh(config, chosen) if several() or len(chosen) > 1 else None


def mesh(config: Config, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """A mesh with one axis of the given devices, by default all devices of all processes.

    Raises:
      ConfigError: the devices cannot share the batch evenly, or the engine runs on one device only.
    """
    devices = jax.devices() if devices is None else devices
    count = len(devices)
    if not splits(config, count):
        raise ConfigError(
            f"env.num_envs: {config.env.num_envs} environments and minibatches of "
            f"{config.minibatch_size} samples cannot be split evenly over {count} devices"
        )
    if count > 1 and physics.resolve_engine(config.physics) == "mujoco":
        raise ConfigError(f"physics.engine: mujoco runs on one device, not {count}; take mjx")
    return Mesh(np.asarray(devices), (AXIS,), axis_types=(AxisType.Auto,))


def shardings(mesh: Mesh, like: TrainState) -> TrainState:
    """The sharding of each array of a train state, as a tree with the structure of `like`."""
    everywhere = NamedSharding(mesh, PartitionSpec())
    split = NamedSharding(mesh, PartitionSpec(AXIS))
    placed = jax.tree.map(lambda _: everywhere, like)
    return placed.replace(env=jax.tree.map(lambda _: split, like.env))


def place(mesh: Mesh, state: TrainState) -> TrainState:
    """Distributes `state` over the mesh, as the train step of `make` needs it.

    The state may lie on any device. Every process passes the same numbers, and keeps the part for
    its own devices.
    """

    def put(x: jax.Array, sharding: NamedSharding) -> jax.Array:
        if isinstance(x, jax.Array) and not x.is_fully_addressable:
            return jax.device_put(x, sharding)
        numbers = host_array(x)
        placed = jax.make_array_from_callback(numbers.shape, sharding, lambda at: numbers[at])
        return jax.random.wrap_key_data(placed) if is_key(x) else placed

    return jax.tree.map(put, state, shardings(mesh, state))


def make(
    config: Config, mesh: Mesh
) -> tuple[Callable[[], TrainState], Callable[[TrainState], tuple[TrainState, Metrics]]]:
    """(init, train_step) for a mesh, as from `train_step.make`. The step donates its state."""

    def shard_index(index: jax.Array) -> jax.Array:
        split = NamedSharding(mesh, PartitionSpec(AXIS))
        return jax.lax.with_sharding_constraint(index, split)

    def step(state: TrainState) -> tuple[TrainState, Metrics]:
        return train_step.step(config, state, shard_index)

    placed = shardings(mesh, jax.eval_shape(lambda: train_step.init(config, 0)))
    everywhere: Any = NamedSharding(mesh, PartitionSpec())
    init = jax.jit(lambda seed: train_step.init(config, seed), out_shardings=placed)
    jitted = jax.jit(
        step, donate_argnums=0, in_shardings=(placed,), out_shardings=(placed, everywhere)
    )
    return lambda: init(config.seed), jitted


# ------------------------------------------------------------------------------- several processes


class Elsewhere(UserError, RuntimeError):
    """Another process failed. That process prints the reason."""


def several() -> bool:
    """True if this process is one of several."""
    return jax.process_count() > 1


def is_first() -> bool:
    """True in process 0, the only one that writes the run folder and shows progress."""
    return jax.process_index() == 0


_meetings = itertools.count()


def meet() -> None:
    """Waits until all processes have called it, at most `WAIT`.

    XLA's own collectives wait for less than a minute.
    """
    if several():
        everyone = set(range(jax.process_count()))
        name = f"kslc_jax {next(_meetings)}"
        multihost.sync_global_processes(name, timeout=WAIT, processes=everyone)


def agree(*flags: bool) -> list[bool]:
    """Each flag is True if it is True in any process."""
    if not several():
        return list(flags)
    meet()
    return multihost_utils.process_allgather(np.asarray(flags)).any(axis=0).tolist()


def on_first(do: Callable[[], T]) -> T | None:
    """Calls `do` in the first process; the others wait.

    Returns the result of `do` in the first process, None in the others. If `do` raises, the first
    process raises the same error, and the others raise Elsewhere.
    """
    result, failure = None, None
    if is_first():
        try:
            result = do()
        except Exception as error:
            failure = error
    (failed,) = agree(failure is not None)
    if failure is not None:
        raise failure
    if failed:
        raise Elsewhere("the first process gave up, see what it says")
    return result


def from_first(make: Callable[[], T], like: T) -> T:
    """Calls `make` in the first process and sends the result, a tree of arrays, to all processes.

    `like` gives the structure, shapes and types of the result. With several processes the result
    consists of arrays on the host.
    """
    made = on_first(make)
    if not several():
        return cast(T, made)
    blank = jax.tree.map(_blank, like)
    tree = blank if made is None else jax.tree.map(host_array, made)
    # Sent as bytes: the broadcast is a sum over the processes, which would turn -0 into +0.
    sent = np.frombuffer(b"".join(x.tobytes() for x in jax.tree.leaves(tree)), np.uint8)
    got = np.asarray(multihost_utils.broadcast_one_to_all(sent))
    ends = np.cumsum([x.nbytes for x in jax.tree.leaves(blank)])
    parts = iter(np.split(got, ends[:-1]))

    def leaf(blank: np.ndarray, like: Any) -> Any:
        numbers = np.frombuffer(next(parts).tobytes(), blank.dtype).reshape(blank.shape)
        return typed(numbers, like)

    return jax.tree.map(leaf, blank, like)


def _blank(like: Any) -> np.ndarray:
    """Zeros with the shape and type of an array; for a typed key, of its key data."""
    like = jax.eval_shape(jax.random.key_data, like) if is_key(like) else like
    return np.zeros(like.shape, like.dtype)


def whole(state: TrainState) -> TrainState:
    """A state that one process can read. With several processes each one gathers a full copy."""
    if not several():
        return state
    sharding = jax.tree.leaves(state)[0].sharding
    everywhere = NamedSharding(sharding.mesh, PartitionSpec())
    gathered = jax.jit(lambda s: s, out_shardings=everywhere)(state)
    return jax.tree.map(lambda x: x.addressable_data(0), gathered)


def leave(code: int) -> int:
    """Returns the exit code of a process that failed alone. One of several exits at once.

    A normal exit would wait for the other processes, which wait for this one. When this process is
    gone, the others end, too.
    """
    if several():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code
