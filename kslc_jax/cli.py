"""What the commands share: their command line, errors in one line, exit codes.

A command module imports neither JAX nor MuJoCo at its top, so that `--help` is quick.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from kslc_jax import runtime
from kslc_jax.errors import UserError

A = TypeVar("A")

Paths = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(metavar="PATH [PATH ...]", help_behavior_hint="(at least one)"),
]
"""Paths on a command line; the command checks that there is one."""


def parse(name: str, kind: type[A], argv: list[str] | None, text: str | None, **more: Any) -> A:
    """The command line of `python -m kslc_jax.NAME` as a `kind`; `text` is its `--help`."""
    prog = f"python -m kslc_jax.{name}"
    return tyro.cli(kind, args=argv, description=text, prog=prog, **more)


def run(do: Callable[[], int | None]) -> int:
    """The exit code of a command whose work is `do()`: 0 for None. A UserError is printed in one
    line and gives its own code."""
    runtime.prepare(gl=False)
    runtime.quiet()
    try:
        return do() or 0
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
