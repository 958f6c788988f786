"""Time of each part of a train step: a table, a bar chart, and the profiler's trace.

Several programs are timed in turn. If one program contains another, the difference of their times
is the time of the rest. No part has the copies between the parts, so the sum may differ from the
time of the whole step. `unaccounted` is this difference.

  python -m benchmarks.parts [--preset laptop] [--engines mujoco mjx] [--out docs/profile.png]
  python -m benchmarks.parts --trace runs/trace     # for xprof, Perfetto or TensorBoard
  python -m benchmarks.parts --trace runs/trace --out docs/timeline.png     # and as a picture
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import tyro

from benchmarks import throughput, timeline, timing
from kslc_jax import networks, ppo, rollout, train_step
from kslc_jax.config import Config, preset
from kslc_jax.training import profiling

matplotlib.use("Agg")

import matplotlib.pyplot as plt

PARTS = ("physics", "rest of rollout", "GAE and samples", "windows", "gradient steps")


def timed(config: Config) -> dict[str, Callable[[], Any]]:
    """The programs to time. `split` computes the parts from their times."""
    state = train_step.make(config)[0]()

    def roll(state):
        params, key = state.learner.params, state.key
        return rollout.collect(config, params, state.env, state.curriculum, key)

    def make_samples(state, envs, traj):
        last_value = networks.value(config, state.learner.params, envs.privileged_history)
        return train_step.samples_of(config, traj, last_value)

    def update(state, traj, samples):
        return run_update(state, samples, train_step.observer(config, state.env, traj))

    def update_on_same_windows(state, traj, samples):
        rows = jnp.arange(config.minibatch_size)
        env = state.env
        actor = rollout.windows(env.history, traj.frame, traj.age)(rows)
        critic = rollout.windows(env.privileged_history, traj.privileged, traj.age)(rows)
        apply = train_step.policy_at(config, lambda _: (actor, critic), traj.velocity)
        return run_update(state, samples, apply)

    def run_update(state, samples, apply):
        constants = train_step.rollout_constants(config, state)
        return ppo.update(config.ppo, apply, constants, state.learner, samples, state.key)

    def program(fn: Callable, *args: Any) -> Callable[[], Any]:
        jitted = jax.jit(fn)
        return lambda: jax.block_until_ready(jitted(*args))

    envs, traj = jax.jit(roll)(state)
    samples = jax.jit(make_samples)(state, envs, traj)
    return {
        "physics": throughput.physics_only(config),
        "rollout": throughput.rollout(config),
        "samples": program(make_samples, state, envs, traj),
        "update": program(update, state, traj, samples),
        "update without windows": program(update_on_same_windows, state, traj, samples),
        "whole": throughput.training(config),
    }


def split(seconds: dict[str, float]) -> dict[str, float]:
    """Medians of `timed` -> seconds of each part of `PARTS`, `unaccounted` and `whole`."""
    parts = dict(
        zip(
            PARTS,
            (
                seconds["physics"],
                seconds["rollout"] - seconds["physics"],
                seconds["samples"],
                seconds["update"] - seconds["update without windows"],
                seconds["update without windows"],
            ),
            strict=True,
        )
    )
    whole = seconds["whole"]
    return {**parts, "unaccounted": whole - sum(parts.values()), "whole": whole}


def draw(results: dict[str, dict[str, float]], title: str, out: Path) -> None:
    """One stacked bar per engine [s]."""
    figure, axis = plt.subplots(figsize=(9, 1.2 + 0.9 * len(results)))
    rows = np.arange(len(results))
    wholes = np.array([parts["whole"] for parts in results.values()])
    left = np.zeros(len(results))
    for i, part in enumerate((*PARTS, "unaccounted")):
        widths = np.array([max(parts[part], 0.0) for parts in results.values()])
        color = f"C{i}" if part in PARTS else "lightgrey"
        axis.barh(rows, widths, left=left, color=color, label=part)
        for row in rows[widths > 0.04 * wholes]:
            text = f"{widths[row]:.2f}\n{widths[row] / wholes[row]:.0%}"
            axis.text(left[row] + widths[row] / 2, row, text, ha="center", va="center", fontsize=8)
        left += widths
    axis.set_yticks(rows, list(results))
    axis.set_xlabel("seconds of a train step")
    axis.set_title(title, fontsize=10)
    axis.legend(ncols=6, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.35), frameon=False)
    figure.savefig(out, dpi=130, bbox_inches="tight")
    plt.close(figure)


def trace(config: Config, folder: Path) -> None:
    """Writes the profiler's trace of one train step, which is already compiled."""
    run = throughput.training(config)
    run()
    with profiling.trace(str(folder)):
        run()
    print(f"wrote {folder}; {profiling.how_to_open(folder)}")


@dataclass(frozen=True)
class Args:
    """Seconds of each part of a train step."""

    preset: str = "laptop"
    """Preset that gives the sizes."""
    repeats: int = 5
    """Timed calls of each part."""
    engines: tuple[str, ...] = ("mujoco", "mjx")
    """Physics engines to compare."""
    out: Path | None = None
    """Picture of the parts, one bar per engine; with --trace, a timeline of the threads."""
    json: Path | None = None
    """File for the numbers."""
    trace: Path | None = None
    """Folder for a trace of one train step on the first engine, in place of the table."""


def main(args: Args) -> None:
    """Prints a table, or writes a trace."""
    base = preset(args.preset)
    if args.trace is not None:
        trace(timing.on_engine(base, args.engines[0]), args.trace)
        if args.out is not None:
            title = f"one train step of the {args.preset} preset, {args.engines[0]} engine"
            timeline.draw(timeline.read(args.trace), title, args.out)
        return
    results = {}
    for engine in args.engines:
        config = timing.on_engine(base, engine)
        results[engine] = split(timing.medians(timing.in_turn(timed(config), args.repeats)))
        for part, seconds in results[engine].items():
            share = seconds / results[engine]["whole"]
            print(f"{engine:8} {part:16} {seconds:7.3f} s   {share:6.1%}")
    if args.out is not None:
        title = f"{args.preset} preset: {base.env.num_envs} environments, {base.batch_size} samples"
        draw(results, title, args.out)
    timing.report({"preset": args.preset, "seconds": results}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
