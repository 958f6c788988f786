"""A training over several devices, of one process or of many: who holds what, who tells whom.

Environments [N, ...] are split over a mesh of one axis; networks, optimiser, curriculum and
counters are on every device. The train step is the same program: `jit` with these shardings puts in
what the devices have to tell each other, and its numbers are those of one device up to the order of
sums. docs/scaling.md counts what is told.

Several processes run the same program side by side. What only one of them can know goes through
`agree`, `on_first` and `from_first`, which all of them call at the same point: so they take the
same turns, and none waits for one that has gone.
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
"""Seconds that processes wait for each other outside of train steps, say for one that compiles."""

T = TypeVar("T")


def join(
    coordinator: str | None = None, processes: int | None = None, index: int | None = None
) -> None:
    """Makes this process one of many, before JAX does anything else. Under Slurm, Open MPI,
    Kubernetes and on TPU pods JAX finds out by itself: no argument is needed.

    Args:
      coordinator: host:port that process 0 listens on and all others can reach.
      processes: how many there are.
      index: which one this is, from 0.

    Raises:
      ConfigError: it is not to be.
    """
    with contextlib.suppress(AttributeError):  # older ones have no such switch
        jax.config.update("jax_enable_preemption_service", False)  # the loop handles SIGTERM
    try:
        jax.distributed.initialize(coordinator, processes, index)
    except (RuntimeError, ValueError, OSError) as error:
        where = coordinator or "what this machine's scheduler says"
        raise ConfigError(f"--coordinator: cannot join by {where}: {first_line(error)}") from error


def splits(config: Config, count: int) -> bool:
    """Whether environments and minibatches come out even over so many devices."""
    return config.env.num_envs % count == 0 and config.minibatch_size % count == 0


def choose(config: Config, wanted: int | None = None) -> list[jax.Device]:
    """The devices to train on: `wanted` of each process. Without, as many accelerators of each as
    the batch splits evenly over, and one where the physics or the device is a CPU."""
    there = jax.devices()
    held = Counter(d.process_index for d in there)
    least = min(held.values())
    if wanted is not None and not 1 <= wanted <= least:
        raise ConfigError(f"--devices: {wanted} of {least} {there[0].platform} devices")
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
    """The mesh of `choose`'s devices; None for one device of one process, which needs none."""
    chosen = choose(config, wanted)
    return mesh(config, chosen) if several() or len(chosen) > 1 else None


def mesh(config: Config, devices: Sequence[jax.Device] | None = None) -> Mesh:
    """All devices of all processes, or those given, in a row; ConfigError if they cannot share."""
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
    """Where each array of a training lives, as a tree of `like`'s structure."""
    everywhere = NamedSharding(mesh, PartitionSpec())
    split = NamedSharding(mesh, PartitionSpec(AXIS))
    placed = jax.tree.map(lambda _: everywhere, like)
    return placed.replace(env=jax.tree.map(lambda _: split, like.env))


def place(mesh: Mesh, state: TrainState) -> TrainState:
    """`state`, which any device may hold, as `make`'s train step takes it. Each process gives the
    same numbers and keeps what is for its devices."""

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
    """`train_step.make` over a mesh: (init, train_step), both jitted; train_step donates."""

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
    """Another process gave up, and says why."""


def several() -> bool:
    """Whether this process is one of many."""
    return jax.process_count() > 1


def is_first() -> bool:
    """Whether it is the one that reads, writes and speaks."""
    return jax.process_index() == 0


_meetings = itertools.count()


def meet() -> None:
    """Waits until all processes are here. XLA's own collectives wait for less than a minute."""
    if several():
        everyone = set(range(jax.process_count()))
        name = f"kslc_jax {next(_meetings)}"
        multihost.sync_global_processes(name, timeout=WAIT, processes=everyone)


def agree(*flags: bool) -> list[bool]:
    """Each flag, set where any process has it set."""
    if not several():
        return list(flags)
    meet()
    return multihost_utils.process_allgather(np.asarray(flags)).any(axis=0).tolist()


def on_first(do: Callable[[], T]) -> T | None:
    """What `do()` gives in the first process, once it is done; None in the others. Where it fails,
    they raise Elsewhere."""
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
    """The tree of arrays that `make()` gives in the first process, in each; on the host where there
    are several. `like` has its structure, shapes and types."""
    made = on_first(make)
    if not several():
        return cast(T, made)
    blank = jax.tree.map(_blank, like)
    tree = blank if made is None else jax.tree.map(host_array, made)
    # As bytes: numbers are summed over the processes, which would make +0 of -0.
    sent = np.frombuffer(b"".join(x.tobytes() for x in jax.tree.leaves(tree)), np.uint8)
    got = np.asarray(multihost_utils.broadcast_one_to_all(sent))
    ends = np.cumsum([x.nbytes for x in jax.tree.leaves(blank)])
    parts = iter(np.split(got, ends[:-1]))

    def leaf(blank: np.ndarray, like: Any) -> Any:
        numbers = np.frombuffer(next(parts).tobytes(), blank.dtype).reshape(blank.shape)
        return typed(numbers, like)

    return jax.tree.map(leaf, blank, like)


def _blank(like: Any) -> np.ndarray:
    """Zeros of an array's shape and type, of a typed key's data."""
    like = jax.eval_shape(jax.random.key_data, like) if is_key(like) else like
    return np.zeros(like.shape, like.dtype)


def whole(state: TrainState) -> TrainState:
    """`state` as one process can read it: where there are several, gathered on a device of each."""
    if not several():
        return state
    sharding = jax.tree.leaves(state)[0].sharding
    everywhere = NamedSharding(sharding.mesh, PartitionSpec())
    gathered = jax.jit(lambda s: s, out_shardings=everywhere)(state)
    return jax.tree.map(lambda x: x.addressable_data(0), gathered)


def leave(code: int) -> int:
    """The exit code of a process that has failed alone. One of several ends here and now: the usual
    end would wait for the others, who wait for it. That it is gone ends them too."""
    if several():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code
