"""The profiler's trace of one train step as a picture: what each of XLA's threads does, when.

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
    """One operation of the compiled program, of those that consist of no others."""

    thread: int
    kind: str  # one of COLORS
    start: float  # s
    end: float  # s


def kind(name: str) -> str:
    """Of an XLA operation's name; only C MuJoCo's physics is an operation by itself."""
    if "callback" in name:
        return "physics"
    return "matrix products" if name.startswith(("dot", "custom-call")) else "other operations"


def read(folder: Path) -> list[Operation]:
    """Operations of the latest trace in `folder`, seconds from the start of the first."""
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
    """Thread-seconds of each kind."""
    total = dict.fromkeys(COLORS, 0.0)
    for op in operations:
        total[op.kind] += op.end - op.start
    return total


def draw(operations: list[Operation], title: str, out: Path) -> None:
    """A row for each thread that does more than a hundredth of it all, a color for each kind, with
    thread-seconds in the legend."""
    rows: dict[int, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    busy: dict[int, float] = defaultdict(float)
    for op in operations:
        rows[op.thread][op.kind].append((op.start, op.end - op.start))
        busy[op.thread] += op.end - op.start
    threads = [thread for thread in sorted(rows) if busy[thread] > 0.01 * sum(busy.values())]
    figure, axis = plt.subplots(figsize=(9, 1.4 + 0.5 * len(threads)))
    for row, thread in enumerate(threads):
        for kind, spans in rows[thread].items():
            axis.broken_barh(spans, (row - 0.4, 0.8), color=COLORS[kind], lw=0)
    for kind, total in seconds(operations).items():
        axis.barh(0, 0, color=COLORS[kind], label=f"{kind}, {total:.2f} s")
    axis.set_yticks(range(len(threads)), [f"thread {i + 1}" for i in range(len(threads))])
    axis.set_xlabel("seconds from the start of the train step")
    axis.set_title(title, fontsize=10)
    axis.legend(ncols=3, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.3), frameon=False)
    figure.savefig(out, dpi=130, bbox_inches="tight")
    plt.close(figure)
