"""All commands of the package: the modules that run through `cli.run`."""

import importlib
from collections.abc import Callable
from pathlib import Path

import kslc_jax

COMMANDS = sorted(
    path.stem
    for path in Path(kslc_jax.__file__).parent.glob("*.py")
    if "return cli.run(" in path.read_text()
)


def main(name: str) -> Callable[[list[str]], int]:
    return importlib.import_module(f"kslc_jax.{name}").main
