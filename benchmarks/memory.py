"""Memory and speed of whole training over environments and frames; one process for each point.

`peak` is the peak memory of the process, or on an accelerator that of the device. `estimated` is
the estimate of `training.memory` before compilation. `planned` is XLA's figure after compilation.
On a CPU the peak also has the imports, the compiler and two states.

The benchmark prints and leaves out a point that does not fit: by its estimate, or because its
process dies. It draws the measured points, also when the time is over before the end.

  python -m benchmarks.memory [--num-envs 256 1024 4096 16384] [--frames 1 5 15] [--out memory.png]
  python -m benchmarks.memory --minutes 8           # begins no new point after that
  python -m benchmarks.memory --preset paper --num-envs 4096 --frames 15
"""

import contextlib
import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import tyro

from benchmarks import timing

matplotlib.use("Agg")

import matplotlib.pyplot as plt

MIB = 2**20

TOO_LARGE = 3
"""Exit code of a process whose point does not fit."""


def once(preset_name: str, num_envs: int, frames: int, repeats: int) -> dict[str, float]:
    """One point, in this process: MiB and control steps/s."""
    import jax

    from benchmarks import throughput
    from kslc_jax import train_step
    from kslc_jax.config import preset
    from kslc_jax.training import memory

    config = timing.resized(preset(preset_name), num_envs, frames)
    init, step = train_step.make(config)
    like = jax.eval_shape(init)
    memory.check(config)
    before = _peak()
    compiled = step.lower(like).compile()
    run = {"training": throughput.stepping(init, compiled)}
    seconds = timing.medians(timing.in_turn(run, repeats))["training"]
    return {
        "num_envs": num_envs,
        "frames": frames,
        "before_mib": before / MIB,
        "peak_mib": _peak() / MIB,
        "estimated_mib": memory.estimate(config) / MIB,
        "planned_mib": (memory.measured(compiled) or 0) / MIB,
        "steps_per_second": config.batch_size / seconds,
    }


def _peak() -> int:
    """Peak memory so far [bytes]."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    return stats.get("peak_bytes_in_use") or peak_of_process()


def peak_of_process() -> int:
    """Peak memory of this process [bytes]."""
    with contextlib.suppress(OSError):  # Linux; `ru_maxrss` counts the parent before the exec, too
        lines = Path("/proc/self/status").read_text().splitlines()
        (peak,) = (line.split() for line in lines if line.startswith("VmHWM:"))
        return 1024 * int(peak[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def child(args: "Args", num_envs: int, frames: int) -> dict[str, float] | None:
    """One point, in a separate process; None if it does not fit or if a signal killed it."""
    where = ["--num-envs", str(num_envs), "--frames", str(frames), "--preset", args.preset]
    try:
        return timing.child("benchmarks.memory", [*where, "--repeats", str(args.repeats), "--here"])
    except subprocess.CalledProcessError as error:
        if error.returncode != TOO_LARGE and error.returncode >= 0:
            raise
        return None


def here(args: "Args") -> int:
    """Measures the first point in this process; returns the exit code."""
    from jax.errors import JaxRuntimeError

    from kslc_jax.config import ConfigError

    with contextlib.suppress(OSError):  # if memory runs out, Linux kills this process first
        Path("/proc/self/oom_score_adj").write_text("1000")
    try:
        print(json.dumps(once(args.preset, args.num_envs[0], args.frames[0], args.repeats)))
    except (ConfigError, MemoryError, JaxRuntimeError) as error:
        if isinstance(error, JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return TOO_LARGE
    return 0


def line(point: dict[str, float]) -> str:
    """A point as text."""
    return (
        f"{point['peak_mib']:7.0f} MiB (before it compiled {point['before_mib']:.0f}; estimated "
        f"{point['estimated_mib']:.0f}, planned {point['planned_mib']:.0f}), "
        f"{point['steps_per_second']:7.0f} steps/s"
    )


def draw(points: list[dict[str, Any]], title: str, out: Path) -> None:
    """Memory and speed over environments, one line per number of frames."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4))
    for i, frames in enumerate(sorted({p["frames"] for p in points})):
        mine = [p for p in points if p["frames"] == frames]
        envs = [p["num_envs"] for p in mine]
        style = {"color": f"C{i}", "markersize": 4}
        peak = [(p["peak_mib"] - p["before_mib"]) / 1024 for p in mine]
        label = f"{frames} frame{'s' * (frames > 1)}"
        axes[0].loglog(envs, peak, "o-", label=label, **style)
        axes[0].loglog(envs, [p["estimated_mib"] / 1024 for p in mine], ":", **style)
        axes[1].semilogx(envs, [p["steps_per_second"] / 1e3 for p in mine], "o-", **style)
    axes[0].plot([], [], "k:", label="estimated before compiling")
    axes[0].set_ylabel("peak memory above that before compiling [GiB]")
    axes[0].legend(fontsize=8)
    axes[1].set_ylabel("whole training [1000 control steps/s]")
    axes[1].set_ylim(bottom=0)
    for axis in axes:
        axis.set_xlabel("environments")
        axis.grid(alpha=0.3, which="both")
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(out, dpi=130)
    plt.close(figure)


@dataclass(frozen=True)
class Args:
    """Peak memory and control steps/s of whole training."""

    preset: str = "laptop"
    """Preset that gives all other sizes."""
    num_envs: tuple[int, ...] = (256, 1024, 4096, 16384)
    """Numbers of environments."""
    frames: tuple[int, ...] = (1, 5, 15)
    """Numbers of frames in the actor history."""
    repeats: int = 1
    """Timed train steps at each point."""
    minutes: float = 60.0
    """No new point starts after this time."""
    out: Path | None = None
    """File for a picture of memory and speed."""
    json: Path | None = None
    """File for the numbers."""
    here: bool = False
    """Measure the first point in this process and print JSON."""


def main(args: Args) -> None:
    """Prints a table."""
    if args.here:
        sys.exit(here(args))
    end = time.monotonic() + 60.0 * args.minutes
    grid = [(n, frames) for frames in args.frames for n in args.num_envs]
    points = []
    for i, (num_envs, frames) in enumerate(grid):
        if time.monotonic() > end:
            print(f"{args.minutes:g} minutes are over: {len(grid) - i} points are left out")
            break
        print(f"[{i + 1}/{len(grid)}] {num_envs:6} environments, {frames:2} frames: ", end="")
        point = child(args, num_envs, frames)
        points += [point] if point else []
        print(line(point) if point else "does not fit", flush=True)
    if args.out is not None and points:
        draw(points, f"{args.preset} preset, {timing.machine()['device']}", args.out)
    timing.report({"preset": args.preset, "points": points}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
