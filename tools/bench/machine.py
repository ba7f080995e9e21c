"""On what was measured, and which versions."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

from tools.bench.fleet import ROOT, NoAnswerError, Process

OWN = ("numpy", "gymnasium", "torch", "matplotlib", "ale-py")


def about() -> dict[str, Any]:
    """The machine, the time, and this project's commit."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / (1 << 30):.0f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "commit": _commit(),
        "load": round(os.getloadavg()[0], 1),
        "packages": {name: version for name in OWN if (version := _version(name))},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


def _commit() -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip()


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def contenders(processes: dict[str, Process]) -> dict[str, Any]:
    """Versions and notes of each, or why it does not take part."""
    found: dict[str, Any] = {}
    for name, process in processes.items():
        try:
            found[name] = process.ask("versions")
        except NoAnswerError as err:
            found[name] = {"versions": {}, "note": str(err)}
    return found
