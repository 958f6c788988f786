"""`benchmarks.gpu --all`: five questions to a GPU in one run of at most eight minutes.

Each part runs in processes of its own, so that its failure ends no other part, and has a limited
time, so that those after it get theirs. Its numbers are printed when it ends. They are written to a
file of its own as they come. The parts, in their order:

- seeds: steps/s of five seeds in one program and of one seed;
- paper: steps/s of the `paper` preset; compile times;
- large: steps/s with 2 and 4 times the environments and minibatches; with --train also the time
  until commands of 3.5 m/s;
- brax: steps/s of Brax PPO and of ours, in turn;
- exact: is a training bit-exact over two runs and over a resume, in one process and in two, with
  and without XLA's deterministic operations? The cost of these in steps/s.
"""

import importlib.util
import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks import gpu_parts, timing
from benchmarks.gpu_parts import Numbers
from kslc_jax import files, runtime

Part = Literal["seeds", "paper", "large", "brax", "exact"]

GRACE = 60.0
"""All parts end at the latest so long [s] after the budget."""

TWICE = ("exact",)
"""Parts that measure twice, and so get twice the time."""

SHARE = 1.75
"""A part may take so many times its equal share of the time that is left, because most parts leave
time over."""

AS_IT_IS = "as it is"
"""Title of the numbers without an additional flag."""

DETERMINISTIC = "--xla_gpu_deterministic_ops=true"


@dataclass(frozen=True)
class Plan:
    """The parts to run, and their sizes."""

    parts: tuple[Part, ...]
    preset: str
    """Preset of all parts but `paper`."""
    paper: str
    """Preset of the part `paper`."""
    budget: float
    """No part begins after this time [s]."""
    repeats: int
    """Timed train steps."""
    train: bool
    """True: `large` also trains."""
    out: Path | None
    """Gives the files of the parts their folder and the beginning of their name."""


def run(plan: Plan) -> None:
    """Runs the parts one after the other. A part that fails is told and passed over."""
    start = time.monotonic()
    missing = [part for part in plan.parts if part == "brax" and not _installed("brax")]
    parts = [part for part in plan.parts if part not in missing]
    for part in missing:
        print(f"{part}: left out, brax is not installed", flush=True)
    with tempfile.TemporaryDirectory() as cache:
        for index, part in enumerate(parts):
            begun = time.monotonic()
            left = plan.budget - (begun - start)
            if left <= 0:
                print(f"{part}: left out, {plan.budget:.0f} s are over", flush=True)
                continue
            print(f"{part}:", flush=True)
            numbers: Numbers = {}
            failure = ""
            try:
                for numbers in _answer(part, plan, most(parts[index:], left + GRACE), cache):
                    _write(plan, part, numbers)
            except (subprocess.SubprocessError, ValueError, LookupError) as error:
                failure = f"  failed: {runtime.first_line(error)}\n"
            _show(numbers)
            print(f"{failure}  in {time.monotonic() - begun:.0f} s", flush=True)


def most(parts: Sequence[Part], left: float) -> float:
    """Most time [s] for the first of `parts`, which share `left` seconds."""
    shares = [2.0 if part in TWICE else 1.0 for part in parts]
    return min(left, SHARE * left * shares[0] / sum(shares))


def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def _write(plan: Plan, part: Part, numbers: Numbers) -> None:
    if plan.out:
        files.write_json(plan.out.with_name(f"{plan.out.stem}-{part}.json"), numbers)


def _answer(part: Part, plan: Plan, seconds: float, cache: str) -> Iterator[Numbers]:
    """The numbers of a part that may take `seconds`, as they come: the later ones have all."""
    ends = time.monotonic() + seconds
    name = plan.paper if part == "paper" else plan.preset

    def child(part: str, flags: str = "", **options: Any) -> Numbers:
        """Runs a part in a process. All share a compilation cache, as trainings do."""
        options = {"part": part, "preset": name, "repeats": plan.repeats} | options
        argv = [word for key, value in options.items() for word in (f"--{key}", str(value))]
        flags = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
        env = {"XLA_FLAGS": flags, "JAX_COMPILATION_CACHE_DIR": cache}
        return timing.child("benchmarks.gpu_parts", argv, env, ends - time.monotonic())

    if part == "exact":
        yield from _both(child)
    elif part == "large" and plan.train:
        yield child(part, **{"train-seconds": max(seconds - GRACE, 1.0)})
    else:
        yield child(part)


def _both(child: Callable[..., Numbers]) -> Iterator[Numbers]:
    """The part `exact`: two processes, without and with deterministic operations."""
    numbers: Numbers = {}
    for title, flags in ((AS_IT_IS, ""), (DETERMINISTIC, DETERMINISTIC)):
        with tempfile.TemporaryDirectory() as folder:
            first = child("exact", flags, folder=folder)
            sums, numbers["machine"] = first.pop("sums"), first.pop("machine")
            numbers[title] = first
            yield numbers
            other = child("resumed", flags, folder=folder)
        first["two processes"] = other["sums"] == sums
        first["resume in two processes"] = other["resumed"] == sums[gpu_parts.STEPS // 2 :]
        yield numbers
    rates = [numbers[title]["steps/s"] for title in (AS_IT_IS, DETERMINISTIC)]
    yield numbers | {"deterministic operations, times the steps/s": rates[1] / rates[0]}


def _show(numbers: Numbers, indent: str = "  ") -> None:
    for name, value in numbers.items():
        if name == "machine":
            continue
        if isinstance(value, dict):
            print(f"{indent}{name}:")
            _show(value, f"{indent}  ")
        else:
            text = f"{value:.5g}" if isinstance(value, float) else value
            print(f"{indent}{name}: {text}")
