"""What a recording that is made of others carries: their runs, their annotations, and which ones they are."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.recording.about.annotations import ANNOTATIONS_MEDIA_TYPE, ANNOTATIONS_NAME, Annotations
from tupli_mcap.recording.about.described import MADE_OF_NAME, MAX_MADE_OF
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns, Run, file_name
from tupli_mcap.recording.recording import Recording

_MADE_OF_MEDIA_TYPE: Final = "application/json"


def carry_runs(parts: Sequence[tuple[Recording, Array, int]]) -> dict[str, tuple[str, bytes]]:
    """The attachments `run.json` and `annotations.json` of a recording made of `parts`.

    Args:
        parts: (recording, rows of its index, shift of their episode numbers), in the order of the episodes in the new
            recording.
    """
    runs: list[Run] = []
    places: list[int] = []
    annotations = Annotations()
    several = len({recording.uuid for recording, _, _ in parts}) > 1  # files whose names are lost
    for recording, rows, shift in parts:
        said_runs = recording.runs if several else recording.recorded_runs.runs
        at = np.searchsorted(recording.index["episode"], rows["episode"]).tolist()
        for place in (recording.run_places[i] for i in at):
            run = said_runs[place]
            if run not in runs:
                runs.append(run)
            places.append(runs.index(run))
        kept = set(rows["episode"].tolist())
        for said in recording.annotations.said:
            numbers = [number + shift for number in said.episodes if number in kept]
            if numbers:
                annotations.said.append(said._replace(episodes=numbers))
    spans = [(len(list(same)), place) for place, same in itertools.groupby(places)]
    found = {}
    if runs and runs != [Run()]:
        carried = RecordedRuns(runs, spans if len(runs) > 1 else ())
        found[RUN_NAME] = (RUN_MEDIA_TYPE, carried.to_json())
    if annotations.said:
        found[ANNOTATIONS_NAME] = (ANNOTATIONS_MEDIA_TYPE, annotations.to_json())
    return found


def say_made_of(sources: Iterable[Recording], how: str, **facts: Any) -> dict[str, tuple[str, bytes]]:
    """The attachment that names the sources of a new recording.

    Args:
        how: "merge", "filter", "map", "trim".
        facts: other facts: the query, the function's name, the steps.
    """
    sources = list(sources)
    document = {
        "how": how,
        **facts,
        "sources": [
            {
                # without the folder, or the rest of a URL, which are private
                "name": file_name(recording.name),
                "uuid": recording.uuid,
                "episodes": len(recording),
                "sha256": hashlib.sha256(
                    bytes.fromhex(recording.uuid) + recording.index.tobytes()
                ).hexdigest(),
            }
            for recording in sources
        ],
    }
    earlier = [said for recording in sources if (said := _said(recording)) is not None]
    data = json.dumps({**document, "earlier": earlier} if earlier else document).encode()
    if len(data) > MAX_MADE_OF:
        data = json.dumps(document).encode()
    return {MADE_OF_NAME: (_MADE_OF_MEDIA_TYPE, data)}


def _said(recording: Recording) -> dict[str, Any] | None:
    try:
        return recording.made_of
    except FormatError:  # damage of this attachment does not concern the steps
        return None
