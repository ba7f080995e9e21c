"""Runs and annotations of a recording that is made of others."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.recording.about.annotations import ANNOTATIONS_MEDIA_TYPE, ANNOTATIONS_NAME, Annotations
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns, Run
from tupli_mcap.recording.recording import Recording


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
