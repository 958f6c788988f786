"""Checkpoint I/O. With several processes, a child of process 0 does it.

In a JAX cluster each save and each restore of orbax waits for all processes. If one process fails,
the others wait for ever. So process 0 starts a child process that belongs to no cluster. The two
exchange numpy arrays. Orbax's `MultiprocessingOptions(active_processes={0})` is no way out: with
the handler of composite checkpoints, a save still waited for the other process (orbax 0.12.8).
"""

import contextlib
import dataclasses
import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np

from kslc_jax import policy as policy_lib
from kslc_jax import runtime, train_step
from kslc_jax.checkpoint_format import CheckpointError, host_array, typed
from kslc_jax.config import Config
from kslc_jax.policy import Policy
from kslc_jax.runtime import first_line
from kslc_jax.train_step import TrainState
from kslc_jax.training import stopping
from kslc_jax.training.checkpoint import Store


class CheckpointStore(Protocol):
    """The part of `Store` that a training needs."""

    def steps(self) -> list[int]: ...
    def save(self, state: TrainState, config: Config, metrics: dict[str, float]) -> None: ...
    def wait(self) -> None: ...
    def restore(self, like: TrainState, warn: Callable[[str], None]) -> TrainState: ...
    def close(self) -> None: ...


class LocalStorage:
    """Reads and writes checkpoints and policies in this process."""

    def open(self, run_dir: Path, config: Config) -> CheckpointStore:
        """Opens the checkpoints of a run folder."""
        return Store(run_dir, config.run.keep)

    def save_policy(self, policy: Policy, folder: Path) -> None:
        """Does the same as `policy_lib.save_policy`."""
        policy_lib.save_policy(policy, folder)

    def load_policy(self, path: Path) -> Policy:
        """Does the same as `policy_lib.load_policy`."""
        return policy_lib.load_policy(path)

    def close(self) -> None:
        """Does nothing: there is no child process to end."""


class ChildProcessStorage(LocalStorage):
    """Reads and writes in a child process. A failure there raises a CheckpointError here."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,))
        self._process.start()
        theirs.close()

    def open(self, run_dir: Path, config: Config) -> CheckpointStore:
        self._ask("open", run_dir, config)
        return self

    def steps(self) -> list[int]:
        """Does the same as `Store.steps`. The methods below match those of `Store`, too."""
        return self._ask("steps")

    def save(self, state: TrainState, config: Config, metrics: dict[str, float]) -> None:
        self._ask("save", jax.tree.map(host_array, state), config, metrics)

    def wait(self) -> None:
        self._ask("wait")

    def restore(self, like: TrainState, warn: Callable[[str], None]) -> TrainState:
        numbers, warnings = self._ask("restore")
        for warning in warnings:
            warn(warning)
        return jax.tree.map(typed, numbers, like)

    def save_policy(self, policy: Policy, folder: Path) -> None:
        self._ask("save_policy", _on_host(policy), folder)

    def load_policy(self, path: Path) -> Policy:
        return self._ask("load_policy", path)

    def close(self) -> None:
        """Waits until the child has written its last save."""
        self._pipe.close()
        self._process.join()

    def _ask(self, what: str, *args: Any) -> Any:
        try:
            self._pipe.send((what, args))
            answer, failure = self._pipe.recv()
        except (OSError, EOFError) as error:
            raise CheckpointError("the process that saves checkpoints has died") from error
        if failure is not None:
            raise CheckpointError(failure)
        return answer


def _on_host(policy: Policy) -> Policy:
    params, curriculum = jax.tree.map(np.asarray, (policy.params, policy.curriculum))
    return dataclasses.replace(policy, params=params, curriculum=curriculum)


class _Server:
    """The requests that the child answers. A method has the name of its request."""

    save_policy = staticmethod(policy_lib.save_policy)

    def open(self, run_dir: Path, config: Config) -> None:
        self.store = Store(run_dir, config.run.keep)
        self.like = jax.eval_shape(lambda: train_step.init(config, 0))

    def steps(self) -> list[int]:
        return self.store.steps()

    def save(self, numbers: TrainState, config: Config, metrics: dict[str, float]) -> None:
        self.store.save(jax.tree.map(typed, numbers, self.like), config, metrics)

    def wait(self) -> None:
        self.store.wait()

    def restore(self) -> tuple[TrainState, list[str]]:
        warnings: list[str] = []
        state = self.store.restore(self.like, warnings.append)
        return jax.tree.map(host_array, state), warnings

    def load_policy(self, path: Path) -> Policy:
        return _on_host(policy_lib.load_policy(path))


def _serve(pipe: Connection) -> None:
    """The child's main function. It answers requests until the parent closes the pipe or dies."""
    runtime.prepare(gl=False)
    runtime.quiet()
    jax.config.update("jax_platforms", "cpu")  # the training uses the accelerator
    for number in stopping.SIGNALS:  # terminals and schedulers signal the child, too
        signal.signal(number, signal.SIG_IGN)
    server = _Server()
    with contextlib.suppress(EOFError, OSError):
        while True:
            what, args = pipe.recv()
            try:
                pipe.send((getattr(server, what)(*args), None))
            except Exception as error:
                pipe.send((None, first_line(error)))
    if hasattr(server, "store"):
        with contextlib.suppress(CheckpointError):
            server.store.close()
