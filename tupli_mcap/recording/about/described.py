"""Runs of a recording, and the metadata and annotations of its episodes."""

from __future__ import annotations

import contextlib
import json
from functools import cached_property
from typing import Any, Final

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, TupliError, warn
from tupli_mcap.recording.about.annotations import ANNOTATIONS_NAME, MAX_ANNOTATIONS, Annotations
from tupli_mcap.recording.about.run import MAX_RUN, RUN_NAME, RecordedRuns, Run, name_after
from tupli_mcap.recording.opened import OpenedRecording

MADE_OF_NAME: Final = "made_of.json"
MAX_MADE_OF: Final = 1 << 22  # bytes of it


class DescribedRecording(OpenedRecording):
    """An open recording with its runs, metadata and annotations."""

    @property
    def run(self) -> Run:
        """The run of the recording; the first one if it was made of several. `run_of` gives the run of an episode."""
        return self.runs[0]

    @cached_property
    def runs(self) -> list[Run]:
        """The runs of the episodes; several if the recording was made of others, or other runs were appended to it.

        Raises:
            FormatError: `run.json` is damaged.
        """
        said, name = self.recorded_runs.runs, name_after(self.name)
        ended = np.zeros(len(said), np.int64)
        np.maximum.at(ended, self.run_places, self.index["end_time"])
        environment = "" if all(run.environment for run in said) else self._environment_name
        return [
            run.known_as(name, environment, self.created_ns, last)
            for run, last in zip(said, ended.tolist(), strict=True)
        ]

    @cached_property
    def run_places(self) -> list[int]:
        """The index in `runs` of each episode's run."""
        return self.recorded_runs.places(len(self.index))

    def run_of(self, i: int) -> Run:
        """The run of episode `i`."""
        return self.runs[self.run_places[i]]

    @cached_property
    def recorded_runs(self) -> RecordedRuns:
        """The runs as `run.json` has them; missing parts are empty."""
        data = self._small_attachment(RUN_NAME, MAX_RUN)
        if data is None:
            return RecordedRuns([Run()])
        return RecordedRuns.from_json(data, f"{self.name}: {RUN_NAME}")

    @property
    def _environment_name(self) -> str:
        with contextlib.suppress(TupliError):  # whoever opens the benchmark is told of damage
            return self.benchmark.record.name
        return ""

    @cached_property
    def made_of(self) -> dict[str, Any] | None:
        """Of which recordings this one was made, and how ("merge", "filter", "map", "trim", "split"): `how`, `sources`,
        and others, as `schemas/made_of.schema.json` has it; None if it says nothing.

        Raises:
            FormatError: it says something else.
        """
        data, where = self._small_attachment(MADE_OF_NAME, MAX_MADE_OF), f"{self.name}: {MADE_OF_NAME}"
        if data is None:
            return None
        try:
            document = json.loads(data)
        except (ValueError, RecursionError) as err:
            raise FormatError(f"{where}: expected JSON, found something else: {err}") from err
        if not isinstance(document, dict) or not isinstance(document.get("sources"), list):
            raise FormatError(f"{where}: expected the sources of a recording, found {document!r:.80}")
        return document

    @property
    def source_uuids(self) -> set[str]:
        """The UUIDs of the recordings that it was made of, without its own; none if what it says of them is damaged."""
        with contextlib.suppress(FormatError):
            sources = (self.made_of or {}).get("sources", [])
            return {str(one.get("uuid")) for one in sources if isinstance(one, dict)} - {self.uuid}
        return set()

    @cached_property
    def is_recorded(self) -> bool:
        """Whether its episodes are those of a run as they were recorded: it was made of no other recordings, or is one
        of the files that one was split into."""
        try:
            return self.made_of is None or self.made_of.get("how") == "split"
        except FormatError:
            return False

    @cached_property
    def annotations(self) -> Annotations:
        """The annotations of its episodes.

        Raises:
            FormatError: `annotations.json` is damaged.
        """
        data = self._small_attachment(ANNOTATIONS_NAME, MAX_ANNOTATIONS)
        if data is None:
            return Annotations()
        return Annotations.from_json(data, f"{self.name}: {ANNOTATIONS_NAME}")

    @cached_property
    def readable_runs(self) -> list[Run]:
        """`runs`; if `run.json` is damaged, a warning and one run named after the file."""
        try:
            return self.runs
        except FormatError as err:
            warn(f"{err}; the run is not known")
            return [Run().known_as(name_after(self.name), "", self.created_ns, 0)]

    @cached_property
    def readable_places(self) -> Array:
        """The index in `readable_runs` of each episode's run (int64)."""
        places = self.run_places if len(self.readable_runs) > 1 else [0] * len(self.index)
        return np.array(places, np.int64)

    def listed_runs(self) -> list[dict[str, Any]]:
        """The run of each episode, as filters see it; damage is handled as in `readable_runs`."""
        found = [run.as_dict() for run in self.readable_runs]
        return [found[place] for place in self.readable_places.tolist()]

    def episode_metadata(self, i: int) -> dict[str, Any]:
        """The metadata of episode `i`, with annotations applied."""
        number = int(self.index["episode"][i])
        return self.annotations.applied(number, self.recorded_metadata(i))

    def recorded_metadata(self, i: int) -> dict[str, Any]:
        """The metadata of episode `i` as they were recorded."""
        place = f"{self.name}: metadata of episode {self.index['episode'][i]}"
        value = jsonvalue.loads_at(place, self._metadata_text(i))
        if not isinstance(value, dict):
            raise FormatError(f"{place}: expected a JSON object, found {value!r:.80}")
        return value

    def _metadata_text(self, i: int) -> str:
        try:
            return self._contents.index.metadata_text(i)
        except FormatError as err:
            raise FormatError(f"{self.name}: {err}") from err

    def all_metadata(self) -> list[str]:
        """The metadata of all episodes as JSON texts, annotations applied; "{}" if there are none."""
        index = self._contents.index
        texts = ["{}"] * len(index.episodes)
        for i in np.flatnonzero(index.episodes["metadata_length"]).tolist():
            texts[i] = self._metadata_text(i)
        if self.annotations.said:
            for i, number in enumerate(self.index["episode"].tolist()):
                if self.annotations.of(number):
                    texts[i] = jsonvalue.dumps(self.episode_metadata(i))
        return texts
