"""Draws the profiler's trace of one train step: the work of each XLA thread over time.

python -m benchmarks.parts --engines mujoco --trace runs/trace --out docs/timeline.png
"""

import gzip
import json
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

COLORS = {"physics": "C0", "matrix products": "C4", "other operations": "C1"}
_NO_WORK = ("while", "call", "conditional", "end:")


class Operation(NamedTuple):
    """One operation of the compiled program that contains no other operations."""

    thread: int
    kind: str  # one of COLORS
    start: float  # s
    end: float  # s


def kind(name: str) -> str:
    """The kind of an XLA operation, by its name. A callback is the physics of C MuJoCo.

    The physics of MJX consists of many operations, and counts as "other operations".
    """
    if "callback" in name:
        return "physics"
    return "matrix products" if name.startswith(("dot", "custom-call")) else "other operations"


def read(folder: Path) -> list[Operation]:
    """Operations of the latest trace in `folder`. Times are in seconds from the first start."""
    latest = max(folder.glob("plugins/profile/*/*.trace.json.gz"), key=lambda p: p.stat().st_mtime)
    events = json.loads(gzip.decompress(latest.read_bytes()))["traceEvents"]
    done = [
        (e["tid"], kind(e["name"]), 1e-6 * e["ts"], 1e-6 * (e["ts"] + e["dur"]))
        for e in events
        if "hlo_op" in e.get("args", {}) and not e["name"].startswith(_NO_WORK)
    ]
    zero = min(start for _, _, start, _ in done)
    return [Operation(thread, what, t0 - zero, t1 - zero) for thread, what, t0, t1 in done]


def seconds(operations: list[Operation]) -> dict[str, float]:
    """Seconds of each kind, summed over threads."""
    total = dict.fromkeys(COLORS, 0.0)
    for op in operations:
        total[op.kind] += op.end - op.start
    return total


def draw(operations: list[Operation], title: str, out: Path) -> None:
    """Draws a row for each thread with more than 1 % of the work, and a colour for each kind.

    The legend has the seconds of each kind, summed over threads.
    """
    by_thread: dict[int, list[Operation]] = defaultdict(list)
    for op in operations:
        by_thread[op.thread].append(op)
    totals = seconds(operations)
    least = 0.01 * sum(totals.values())
    rows = [ops for _, ops in sorted(by_thread.items()) if sum(seconds(ops).values()) > least]
    figure, axis = plt.subplots(figsize=(9, 1.4 + 0.5 * len(rows)))
    for what, color in COLORS.items():
        for row, ops in enumerate(rows):
            spans = [(op.start, op.end - op.start) for op in ops if op.kind == what]
            axis.broken_barh(spans, (row - 0.4, 0.8), color=color, lw=0)
        axis.barh(0, 0, color=color, label=f"{what}, {totals[what]:.2f} s")
    axis.set_yticks(range(len(rows)), [f"thread {i + 1}" for i in range(len(rows))])
    axis.set_xlabel("seconds from the start of the train step")
    axis.set_title(title, fontsize=10)
    axis.legend(ncols=3, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.3), frameon=False)
    figure.savefig(out, dpi=130, bbox_inches="tight")
    plt.close(figure)
