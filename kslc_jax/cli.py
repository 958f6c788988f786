"""Parts that all commands share: parsing, errors in one line, exit codes, safe output.

A command module imports neither JAX nor MuJoCo at its top, so that `--help` is quick.
"""

import contextlib
import io
import re
import sys
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from kslc_jax import runtime, streams
from kslc_jax.errors import UserError

A = TypeVar("A")


class UsageError(UserError):
    """A command line cannot be read. The message names the option and the value."""


Paths = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(metavar="PATH [PATH ...]", help_behavior_hint="(at least one)"),
]
"""Paths on a command line. The command itself checks that there is at least one."""


# ----------------------------------------------------------------------------------------- parsing

LONGEST = 30
"""Largest number of digits of a whole number on a command line, far above any real bound."""


def whole_number(text: str) -> int:
    """The integer of a text such as `60000000`, `60_000_000` or `60e6`; ValueError otherwise."""
    try:
        number = Decimal(text)
        if number.is_finite() and number.adjusted() < LONGEST and number == int(number):
            return int(number)
    except InvalidOperation:
        pass
    raise ValueError(f"{text!r} is not a whole number, such as 2048, 60_000_000 or 60e6")


_registry = ConstructorRegistry()


@_registry.primitive_rule
def _integers(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
    """The rule by which tyro reads all integer options, also within tuples and unions."""
    if info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: whole_number(words[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


def parse(name: str, kind: type[A], argv: list[str] | None, text: str | None, **more: Any) -> A:
    """Reads the command line of `python -m kslc_jax.NAME` into a `kind`.

    `text` is the introduction of its `--help`. UsageError if the command line cannot be read.
    """
    prog, said = f"python -m kslc_jax.{name}", io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                kind, args=argv, description=text, prog=prog, registry=_registry, **more
            )
    except SystemExit as stop:
        if "Unrecognized options" in said.getvalue():  # the box names the options that there are
            print(said.getvalue(), end="", file=sys.stderr)
        elif stop.code:
            raise UsageError(_message(said.getvalue())) from None
        raise


def _message(box: str) -> str:
    """The message in a box of tyro, in one line: the text between its title and its first rule."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)  # without colours
    lines = [line.strip("│ ") for line in plain.splitlines()[1:]]
    rules = [number for number, line in enumerate(lines) if line and not line.strip("─-")]
    begin = 1 if rules[:1] == [0] else 0  # without UTF-8 a rule follows the title, too
    end = next((number for number in rules if number >= begin), len(lines))
    # For an option that may be None, tyro first says why the value is not None.
    text = re.sub(r": no type matching .*<class '\w+'>: ", ": ", " ".join(lines[begin:end]))
    return text.removeprefix("Error parsing ")


# ----------------------------------------------------------------------------------------- running


def run(do: Callable[[], int | None], needs_output: bool = True) -> int:
    """Runs a command; returns its exit code. Afterwards hooks and options are those of before.

    Args:
      do: does the command's work; returns its exit code, None for 0. A UserError prints one line
        and gives its own exit code.
      needs_output: True: the command fails if its output cannot be written, as on a full disk.
        Output without a reader (a closed pipe or terminal) is no failure.
    """
    streams.open_missing()
    # A program ends after its command. Libraries may then still report errors, which stay silent.
    hooks = contextlib.nullcontext() if runtime.is_program() else runtime.own_hooks()
    with hooks, runtime.own_numerics(), streams.lasting() as output:
        runtime.prepare(gl=False)
        runtime.quiet()
        try:
            code = do() or 0
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            code = error.exit_code
    if needs_output and code == 0 and output.failure:
        with contextlib.suppress(OSError):  # both outputs may lie on the full disk
            print(f"error: cannot write the output: {output.failure.strerror}", file=sys.stderr)
        return 2
    return code
