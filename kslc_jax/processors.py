"""What this process may use of its machine: processors (affinity, quota) and memory."""

import math
import os
import platform
from collections.abc import Callable
from pathlib import Path

VECTORS = ("avx512f", "avx2", "avx")
"""Flags in /proc/cpuinfo of vector instructions, the widest first. XLA chooses its code by them."""


def affine() -> int:
    """Number of CPUs that the affinity of the process allows."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def quota(root: Path = Path("/")) -> float:
    """Number of CPUs that the process's control groups and their parents allow.

    It may be a fraction. Infinity means no limit. `root` is the root of the file system.
    """
    return _least(root, "cpu", _group_quota)


def memory(root: Path = Path("/")) -> float:
    """Bytes of memory that the machine has and that the control groups allow."""
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min(there, _least(root, "memory", _group_memory))


def _least(root: Path, controller: str, limit: Callable[[Path], float]) -> float:
    """The lowest limit of the process's control groups and their parents; infinity: none.

    It reads Linux's cgroups of version 2 and 1.
    """
    least = math.inf
    for line in _read(root / "proc/self/cgroup").splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        top = root / "sys/fs/cgroup" / (controller if controllers else "")
        parts = [part for part in path.split("/") if part]
        # In a container the path may be that of the host. The container's own group is then `top`.
        groups = [top.joinpath(*parts[:depth]) for depth in range(len(parts) + 1)]
        least = min([least, *map(limit, groups)])
    return least


def _group_memory(group: Path) -> float:
    """Bytes of memory that one control group allows."""
    text = _read(group / "memory.max") or _read(group / "memory.limit_in_bytes")
    try:
        return float(text)
    except ValueError:  # "max", or the files do not exist
        return math.inf


def _group_quota(group: Path) -> float:
    """Number of CPUs that one control group allows."""
    v1 = _read(group / "cpu.cfs_quota_us"), _read(group / "cpu.cfs_period_us")
    words = _read(group / "cpu.max").split() or [word.strip() for word in v1]
    try:
        quota, period = map(float, words)
    except ValueError:  # the quota is "max", or the files do not exist
        return math.inf
    return quota / period if quota > 0 and period > 0 else math.inf


def _read(path: Path) -> str:
    """Text of a file; empty if it cannot be read."""
    try:
        return path.read_text()
    except OSError:
        return ""


def usable() -> int:
    """Number of threads that this process can run at the same time, by affinity and quota."""
    return max(1, math.ceil(min(affine(), quota())))


def model(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Name of the processor, and its widest vector instructions on Linux."""
    facts = dict(line.split("\t", 1) for line in _read(cpuinfo).splitlines() if "\t" in line)
    name, flags = (facts.get(key, "").strip("\t: ") for key in ("model name", "flags"))
    widest = next((flag for flag in VECTORS if flag in flags.split()), "")
    return ", ".join(filter(None, (name or platform.processor(), widest)))
