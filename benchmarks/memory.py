"""Memory and speed of whole training over environments and frames; one process for each point.

`peak` is all that the process ever held, on an accelerator what the device did. `estimated` is what
`runner.check_memory` reckons before anything is compiled.

  python -m benchmarks.memory [--num-envs 256 1024 4096 16384] [--frames 1 5 15] [--out memory.png]
  python -m benchmarks.memory --preset paper --num-envs 4096 --frames 15
"""

import json
import resource
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import tyro

from benchmarks import timing

matplotlib.use("Agg")

import matplotlib.pyplot as plt

MIB = 2**20


def once(preset_name: str, num_envs: int, frames: int, repeats: int) -> dict[str, float]:
    """One point, in this process: MiB and control steps/s."""
    import jax

    from benchmarks import throughput
    from kslc_jax import runner, train_step
    from kslc_jax.config import preset

    config = timing.resized(preset(preset_name), num_envs, frames)
    estimated = runner.memory_need(config, jax.eval_shape(train_step.make(config)[0]))
    before = _peak()
    run = {"training": throughput.training(config)}
    seconds = timing.medians(timing.in_turn(run, repeats))["training"]
    return {
        "num_envs": num_envs,
        "frames": frames,
        "before_mib": before / MIB,
        "peak_mib": _peak() / MIB,
        "estimated_mib": estimated / MIB,
        "steps_per_second": config.batch_size / seconds,
    }


def _peak() -> int:
    """Largest number of bytes held so far."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    in_process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return stats.get("peak_bytes_in_use", in_process)


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
    axes[0].set_ylabel("peak memory above the imports' [GiB]")
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
    """Whose other sizes to use."""
    num_envs: tuple[int, ...] = (256, 1024, 4096, 16384)
    """Environments."""
    frames: tuple[int, ...] = (1, 5, 15)
    """Frames of actor history."""
    repeats: int = 1
    """Timed train steps at each point."""
    out: Path | None = None
    """Picture of both."""
    json: Path | None = None
    """File for the numbers."""
    here: bool = False
    """Measure the first point in this process and print JSON."""


def main(args: Args) -> None:
    """Prints a table."""
    if args.here:
        print(json.dumps(once(args.preset, args.num_envs[0], args.frames[0], args.repeats)))
        return
    points = []
    for frames in args.frames:
        for num_envs in args.num_envs:
            where = ["--num-envs", str(num_envs), "--frames", str(frames)]
            where += ["--preset", args.preset, "--repeats", str(args.repeats), "--here"]
            point = timing.child("benchmarks.memory", where)
            points.append(point)
            print(
                f"{num_envs:6} environments, {frames:2} frames: "
                f"{point['peak_mib']:7.0f} MiB (imports {point['before_mib']:.0f}, "
                f"estimated {point['estimated_mib']:.0f}), "
                f"{point['steps_per_second']:7.0f} steps/s",
                flush=True,
            )
    if args.out is not None:
        draw(points, f"{args.preset} preset, {timing.machine()['device']}", args.out)
    timing.report({"preset": args.preset, "points": points}, args.json)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
