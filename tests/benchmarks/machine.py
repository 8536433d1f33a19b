"""What the figures were measured on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

__all__ = ["describe", "peak_rss_mb"]

ROOT = Path(__file__).parents[2]
LIBRARIES = (
    "bayesdist",
    "numpy",
    "scipy",
    "numba",
    "emcee",
    "arviz",
    "astropy",
    "pyarrow",
    "jax",
    "numpyro",
)
FLAGS = ("avx2", "fma", "avx512f")


def _cpuinfo() -> dict[str, str]:
    """First processor's entries where the system tells them (Linux)."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return {}
    lines = (line.partition(":") for line in text.split("\n\n")[0].splitlines())
    return {key.strip(): value.strip() for key, _, value in lines}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        if name == "bayesdist":
            import bayesdist

            return bayesdist.__version__
        return None


def _revision() -> str | None:
    def git(*words: str) -> str:
        run = subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=True, timeout=20
        )
        return run.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None


def describe() -> dict[str, Any]:
    """Processor, memory, system, versions, date and revision; None for what is not known.

    `load` is the mean number of busy processes before the start: other work spoils the figures.
    """
    info = _cpuinfo()
    flags = info.get("flags", info.get("Features", "")).split()
    try:
        ram = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        cores = len(os.sched_getaffinity(0))
    except (AttributeError, ValueError, OSError):
        ram, cores = None, os.cpu_count()
    return {
        "cpu": info.get("model name") or platform.processor() or platform.machine(),
        "cores": cores,
        "flags": {name: name in flags for name in FLAGS} if flags else None,
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
        "ram_gib": None if ram is None else round(ram, 1),
        "os": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "libraries": {name: _version(name) for name in LIBRARIES},
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "revision": _revision(),
    }


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far, in MB (1e6 bytes)."""
    try:
        # getrusage would count what the parent held before it became this process
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        kib = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        return int(kib) * 1024 / 1e6
    except (OSError, StopIteration):
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if platform.system() == "Darwin" else peak * 1024 / 1e6
