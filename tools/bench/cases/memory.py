"""Memory: of recording and reading long recordings, and of a DataLoader's worker over a very large one."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from tools.bench.fleet import ROOT, environment
from tools.bench.measure import Run, check
from tools.bench.targets import Target, at_most


def _peak(run: Run, code: str, *arguments: Any) -> float:
    """What a process says that runs `code` (a script, or its text): the peak of its memory (MiB)."""
    return float(json.loads(_ran(run, code, *arguments).splitlines()[-1])["peak"])


# VmHWM, not ru_maxrss: that one keeps what the process was before it became another program.
_RECORD = """
import sys, json
from pathlib import Path
from tools.bench.contenders.ours import Ours
from tools.bench.workloads import WORKLOADS
path, steps = Path(sys.argv[1]), int(sys.argv[2])
Ours().record(WORKLOADS["long"], path, steps // 1000)
print(json.dumps({"peak": int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) / 1024}))
"""
_READ = """
import sys, json
from tupli_mcap import Recording
with Recording(sys.argv[1], cache_bytes=32 << 20) as recording:
    total = sum(float(episode.rewards.sum()) + len(episode.states) for episode in recording.episodes)
print(json.dumps({"peak": int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) / 1024}))
"""


def bounded(run: Run) -> Iterator[Target]:
    """Ten times the steps: what recording, and reading episode after episode, need more at their peak."""
    sizes = run.part(300_000, 10_000), run.part(3_000_000, 100_000)
    paths = [run.fresh(f"memory-{steps}.mcap") for steps in sizes]
    for what, code in (("recording", _RECORD), ("reading episodes, 32 MiB of cache", _READ)):
        extra = [(steps,) if code is _RECORD else () for steps in sizes]
        small, large = (_peak(run, code, path, *more) for path, more in zip(paths, extra, strict=True))
        note = f"{large:.0f} MiB at {sizes[1]:,} steps; {small:.0f} at {sizes[0]:,}"
        limit = 32 if code is _READ else 16
        yield at_most(f"memory of {what}: growth with ten times the steps", limit, large - small, note, "MiB")
    for path in paths:
        path.unlink()


def loader_worker(run: Run) -> Iterator[Target]:
    """What `tools/loader_memory.py` says: a worker that reads windows of a recording of 10 GiB of images."""
    gib = 0.2 if run.quick else 10
    said = _ran(run, "tools/loader_memory.py", "--gib", gib, "--batches", run.part(100, 20), "--limit", 1e9)
    above = [float(mib) for mib in re.findall(r"batches: (-?\d+) MiB", said)]
    check(len(above) == 2, f"loader_memory.py says {said!r}")
    note = f"{gib:g} GiB; {above[0]:.0f} streaming, {above[1]:.0f} by number"
    yield at_most("memory of a DataLoader's worker, above its imports", 200, max(above), note, "MiB")


def _ran(run: Run, code: str, *arguments: Any) -> str:
    done = subprocess.run(
        [sys.executable, *(["-c", code] if "\n" in code else [code]), *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment(run.directory),
        timeout=200,
        check=False,
    )
    check(done.returncode == 0, f"exits with {done.returncode}: {done.stderr[-300:]}")
    return done.stdout
