"""Where a replay goes: a file, the native viewer, a browser."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tupli_mcap.errors import RecordingError
from tupli_mcap.recording.replacing import replacing
from tupli_mcap.viewer.binary import run_quietly, viewer_program
from tupli_mcap.viewer.plan import Plan

__all__ = ["to_file"]


def to_file(plans: Iterable[Plan], target: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Writes a `.rrd` with its blueprint; it is there as a whole or not at all.

    Raises:
        RecordingError: it exists and `force` is False, or the system refuses.
    """
    goal = Path(target)
    if goal.exists() and not force:
        raise RecordingError(f"{goal} exists already; choose another name, or replace it with --force")
    if not goal.parent.is_dir():
        raise RecordingError(
            f"{goal} cannot be written: there is no directory {str(goal.parent)!r}; make it first"
        )
    with replacing(goal) as (_, temporary):
        several = list(plans)
        if len(several) == 1:
            _write(several[0], temporary, several[0].blueprint)
        else:
            _write_all(several, temporary)
    return goal


def _write_all(plans: Sequence[Plan], path: Path) -> None:
    """Several Rerun recordings in one file."""
    program = viewer_program()
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as folder:
        parts = [Path(folder) / f"{i}.rrd" for i in range(len(plans))]
        arranged: set[str] = set()
        for plan, part in zip(plans, parts, strict=True):
            _write(plan, part, None if plan.application in arranged else plan.blueprint)
            arranged.add(plan.application)
        run_quietly(program, "rrd", "merge", *map(str, parts), "-o", str(path))


def _write(plan: Plan, path: Path, blueprint: Any) -> None:
    stream = plan.new_stream()
    try:
        stream.save(path, default_blueprint=blueprint)
        plan.send(stream)
        stream.flush()
    finally:
        stream.disconnect()
