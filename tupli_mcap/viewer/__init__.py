"""Recordings in the Rerun viewer: their data, a blueprint made from their spaces, and where both go."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tupli_mcap.recording import Recording
from tupli_mcap.viewer.choice import Source, chosen_from
from tupli_mcap.viewer.plan import Form, plans_of
from tupli_mcap.viewer.sdk import ViewerError, rerun_sdk
from tupli_mcap.viewer.targets import to_file

__all__ = ["Form", "ViewerError", "blueprint", "save", "send"]


def save(
    sources: Source | Sequence[Source],
    target: str | os.PathLike[str],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    force: bool = False,
) -> Path:
    """Writes episodes and their blueprint into a `.rrd` file, which `rerun FILE` opens.

    Args:
        sources: a recording, its path or URL, a storage's directory, or several of them.
        episodes: "best", "worst", "first", "last", "all", "3,7,9", or numbers; all by default.
        filter: only episodes that it is true of.
        form: "joined" on one timeline, "split" into a Rerun recording each, or "compare" in the same plots.
        force: replace a file that exists.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        RecordingError: the file exists, or there is no such episode.
        FormatError: a recording is damaged; no file is left.
    """
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        return to_file(plans_of(chosen, form), target, force=force)


def blueprint(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
) -> Any:
    """The blueprint that `save` would write, a `rerun.blueprint.Blueprint`."""
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        return next(iter(plans_of(chosen, form))).blueprint


def send(recording: Recording, stream: Any = None, episodes: str | Sequence[int] | None = None) -> Any:
    """Sends episodes, joined on one timeline, and their blueprint into a `rerun.RecordingStream`.

    Without a stream, it makes one, which is returned either way: `stream.save(...)` before, or give it a sink.
    """
    rerun_sdk()
    with chosen_from(recording, episodes, None) as chosen:
        for plan in plans_of(chosen, "joined"):
            stream = plan.new_stream() if stream is None else stream
            stream.send_blueprint(plan.blueprint)
            plan.send(stream)
    return stream
