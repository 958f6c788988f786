"""`benchmarks.gpu --all`: five questions to a GPU in one run of at most eight minutes.

Each part runs in processes of its own, so that its failure ends no other part. Its numbers are
printed, and written to a file of its own, as soon as it is done. The parts, in their order:

- seeds: steps/s of five seeds in one program and of one seed; compile times;
- exact: is a training bit-exact over two runs and over a resume, in one process and in two, with
  and without XLA's deterministic operations? The cost of these in steps/s;
- paper: steps/s of the `paper` preset;
- large: steps/s with 2 and 4 times the environments and minibatches; with --train also the time
  until commands of 3.5 m/s;
- brax: steps/s of Brax PPO and of ours, in turn.
"""

import importlib.util
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks import gpu_parts, timing
from benchmarks.gpu_parts import Numbers
from kslc_jax import runtime

Part = Literal["seeds", "exact", "paper", "large", "brax"]

GRACE = 60.0
"""A part ends at the latest so long [s] after the budget."""

BRAX_SECONDS = 90.0
"""The trainings of `large` leave this time [s] to `brax`, which compiles two programs."""

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
    with tempfile.TemporaryDirectory() as cache:
        for part in plan.parts:
            left = plan.budget - (time.monotonic() - start)
            missing = part == "brax" and not _installed("brax")
            if left <= 0 or missing:
                why = "brax is not installed" if missing else f"{plan.budget:.0f} s are over"
                print(f"{part}: left out, {why}", flush=True)
                continue
            print(f"{part}:", flush=True)
            begun = time.monotonic()
            try:
                numbers = _answer(part, plan, left, cache)
            except (subprocess.SubprocessError, ValueError, LookupError) as error:
                print(f"  failed: {runtime.first_line(error)}", flush=True)
                continue
            _show(numbers)
            print(f"  in {time.monotonic() - begun:.0f} s", flush=True)
            if plan.out:
                plan.out.parent.mkdir(parents=True, exist_ok=True)
                path = plan.out.with_name(f"{plan.out.stem}-{part}.json")
                path.write_text(json.dumps(numbers, indent=1) + "\n")


def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def _answer(part: Part, plan: Plan, left: float, cache: str) -> Numbers:
    """The numbers of a part that may take `left` seconds, and `GRACE` more."""
    ends = time.monotonic() + left + GRACE
    name = plan.paper if part == "paper" else plan.preset

    def child(part: str, flags: str = "", **options: Any) -> Numbers:
        """Runs a part in a process. All share a compilation cache, as trainings do."""
        options = {"part": part, "preset": name, "repeats": plan.repeats} | options
        argv = [word for key, value in options.items() for word in (f"--{key}", str(value))]
        flags = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
        env = {"XLA_FLAGS": flags, "JAX_COMPILATION_CACHE_DIR": cache}
        return timing.child("benchmarks.gpu_parts", argv, env, ends - time.monotonic())

    if part == "exact":
        return _both(child)
    if part == "large" and plan.train:
        comes = "brax" in plan.parts[plan.parts.index("large") :] and _installed("brax")
        after = BRAX_SECONDS if comes else 0.0
        return child(part, **{"train-seconds": max(left - after, 1.0)})
    return child(part)


def _both(child: Callable[..., Numbers]) -> Numbers:
    """The part `exact`: two processes, without and with deterministic operations."""
    numbers: Numbers = {}
    for title, flags in ((AS_IT_IS, ""), (DETERMINISTIC, DETERMINISTIC)):
        with tempfile.TemporaryDirectory() as folder:
            first = child("exact", flags, folder=folder)
            other = child("resumed", flags, folder=folder)
        sums, numbers["machine"] = first.pop("sums"), first.pop("machine")
        numbers[title] = {
            "two processes": other["sums"] == sums,
            "resume in two processes": other["resumed"] == sums[gpu_parts.STEPS // 2 :],
            **first,
        }
    rates = [numbers[title]["steps/s"] for title in (AS_IT_IS, DETERMINISTIC)]
    return numbers | {"deterministic operations, times the steps/s": rates[1] / rates[0]}


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
