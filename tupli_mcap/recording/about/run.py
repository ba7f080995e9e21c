"""The run of a recording: its name, its settings, the version of its code; kept as `run.json`.

A run is one start of a program. All files of a series belong to the same run.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePath, PurePosixPath
from typing import Any, Final, NamedTuple, Self
from urllib.parse import urlsplit

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, RecordingError, SaysWhatIsMeant
from tupli_mcap.schema.times import iso_utc

RUN_NAME: Final = "run.json"
RUN_MEDIA_TYPE: Final = "application/json"
MAX_RUN: Final = 1 << 26  # bytes of `run.json`
_MAX_GIVEN: Final = 1 << 20  # bytes of one run, as a user gives it
_LISTS: Final = ("tags", "command")
_TEXTS: Final = ("id", "name", "split", "environment", "started", "ended", "host")
OF_STORAGE: Final = re.compile(r"\d{8}T\d{6}-(?:(?P<name>.+)-)?[0-9a-f]{12}(?:_\d{4,})?")
"""What a storage calls the files of a recording, see `storage.base.new_name`; further ones of a series end in their
number."""


@dataclass(frozen=True)
class Run(SaysWhatIsMeant):
    """A run. Parts that are not known are empty.

    Attributes:
        id: 32 hex digits, the same in all files of the run.
        name: given by the user, else that of the file.
        metadata: given by the user: the algorithm, its settings.
        tags: words given by the user.
        split: "train", "eval" or another word.
        environment: the Gymnasium id, else the class.
        started, ended: ISO 8601 in UTC.
        command: the arguments of the process.
        git: `commit` and `dirty` of the program's directory, or of the working directory if the program is installed.
        versions: of Python and of packages.
        host: the machine's name.
    """

    id: str = ""
    name: str = ""
    metadata: dict[str, Any] = field(default_factory=dict)
    tags: tuple[str, ...] = ()
    split: str = ""
    environment: str = ""
    started: str = ""
    ended: str = ""
    command: tuple[str, ...] = ()
    git: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    host: str = ""

    @classmethod
    def given(
        cls, name: str | None, metadata: Mapping[str, Any] | None, tags: Sequence[str], split: str
    ) -> Self:
        """A run with the parts that a user gives; paths in the metadata become texts. Raises RecordingError if a part
        has another type, or JSON cannot hold it."""
        words = None if isinstance(tags, str) or not isinstance(tags, Iterable) else tuple(tags)
        if words is None or not all(isinstance(tag, str) and tag for tag in words):
            raise RecordingError(f"tags: expected a list of words, found {tags!r:.80}")
        for what, text in (("name", "" if name is None else name), ("split", split)):
            if not isinstance(text, str) or len(text) > 1000:
                raise RecordingError(
                    f"{what}: expected a text of at most 1000 characters, found {text!r:.80}"
                )
        if metadata is not None and not (isinstance(metadata, Mapping) and all(map(_is_text, metadata))):
            raise RecordingError(
                f"metadata: expected a dict with texts as keys (for a Namespace, vars(args)), found {metadata!r:.80}"
            )
        try:
            plain = _plain(dict(metadata or {}))
            jsonvalue.dumps_plain(plain, name="metadata")
        except (TypeError, ValueError) as err:
            raise RecordingError(f"metadata of the run: {err}") from err
        run = cls(name=name or "", metadata=plain, tags=words, split=split)
        size = len(RecordedRuns([run]).to_json())
        if size > _MAX_GIVEN:
            raise RecordingError(f"metadata of the run: expected at most {_MAX_GIVEN} bytes, found {size}")
        return run

    @classmethod
    def of_document(cls, document: object, where: str) -> Self:
        """A run from the JSON value in `run.json`; unknown keys are ignored. Raises FormatError if it is no run."""
        if not isinstance(document, dict):
            raise FormatError(f"{where}: expected a run as a JSON object, found {document!r:.80}")
        said = {key: document[key] for key in cls.__dataclass_fields__ if key in document}
        for key, value in said.items():
            if key in _TEXTS:
                good = isinstance(value, str)
            elif key in _LISTS:
                good = isinstance(value, list) and all(isinstance(text, str) for text in value)
                said[key] = tuple(value) if good else value
            else:
                good = isinstance(value, dict) and all(map(_is_text, value))
            if not good:
                raise FormatError(f"{where}: found {value!r:.80} as the {key} of a run; see run.schema.json")
        return cls(**said)

    def as_dict(self) -> dict[str, Any]:
        """The parts that filters see (`run.name`, `run.metadata.lr`), as plain values: all but command and versions."""
        return {
            key: list(value) if key in _LISTS else value
            for key, value in vars(self).items()
            if key not in ("command", "versions")
        }

    def known_as(self, name: str, environment: str, started_ns: int, ended_ns: int) -> Self:
        """The same run, its empty parts filled from facts about its file; times are in ns."""
        return replace(
            self,
            name=self.name or name,
            environment=self.environment or environment,
            started=self.started or (iso_utc(started_ns) if started_ns else ""),
            ended=iso_utc(ended_ns) if ended_ns else "",
        )


def file_name(name: str) -> str:
    """The last part of a path, or of a URL without its query."""
    path = urlsplit(name).path if "://" in name else name
    return PurePosixPath(path).name


def name_after(file: str) -> str:
    """The name of a run that has none: that of its file, without what a storage puts around it."""
    stem = PurePosixPath(file_name(file)).stem
    made = OF_STORAGE.fullmatch(stem)
    return (made["name"] if made else None) or stem


class RecordedRuns(NamedTuple):
    """The runs of a recording's episodes.

    Attributes:
        runs: several if the recording was made of others, or other runs were appended to it.
        spans: (number of episodes, index in `runs`) in the order of the index; episodes beyond the last span belong to
            the last run.
        before: (index in `runs`, earlier version) of edited runs, the latest last.
    """

    runs: Sequence[Run]
    spans: Sequence[tuple[int, int]] = ()
    before: Sequence[tuple[int, Run]] = ()

    def places(self, episodes: int) -> list[int]:
        """The index in `runs` of each episode's run."""
        each = itertools.chain.from_iterable(itertools.repeat(place, count) for count, place in self.spans)
        found = list(itertools.islice(each, episodes))
        return found + [len(self.runs) - 1] * (episodes - len(found))

    def followed_by(self, run: Run, episodes: int) -> Self:
        """These runs of so many episodes, and the one that begins now.

        It goes on with the last one if it is of the same environment, where both are known, and the user gives it
        nothing at all, or the same metadata, tags and split with the same name or none. The same as before an edit of
        that run counts too.
        """
        last, earlier = self.runs[-1], [was for place, was in self.before if place == len(self.runs) - 1]
        known = (Run(), last, *earlier)
        alike = run.environment == last.environment or not (run.environment and last.environment)
        if alike and any(_given(replace(run, name=run.name or each.name)) == _given(each) for each in known):
            return self
        places = itertools.groupby(self.places(episodes))
        spans = [(len(list(same)), place) for place, same in places]
        return self._replace(runs=[*self.runs, run], spans=spans)

    def to_json(self) -> bytes:
        """The content of `run.json`: all parts that are not empty, without `ended`, which follows from the episodes;
        raises RecordingError if JSON cannot hold the metadata, or they are too large."""
        document: dict[str, Any] = {"runs": [_document(run) for run in self.runs]}
        if self.spans:
            document["spans"] = [list(span) for span in self.spans]
        if self.before:
            document["before"] = [{"place": place, **_document(run)} for place, run in self.before]
        try:
            data = jsonvalue.dumps_plain(document).encode()
        except (TypeError, ValueError) as err:
            raise RecordingError(f"metadata of the run: {err}") from err
        if len(data) > MAX_RUN:
            raise RecordingError(
                f"{RUN_NAME} of {len(self.runs):,} runs: expected at most {MAX_RUN} bytes, found {len(data)}; "
                "merge fewer recordings, or give runs shorter metadata"
            )
        return data

    @classmethod
    def from_json(cls, data: bytes, where: str) -> Self:
        """The runs in `data`; raises FormatError unless it is as `to_json` makes it."""
        document = jsonvalue.loads_at(where, data)
        runs = document.get("runs") if isinstance(document, dict) else None
        if not isinstance(runs, list) or not runs:
            raise FormatError(f"{where}: expected at least one run, found {document!r:.80}")
        spans = document.get("spans", [])
        if not isinstance(spans, list) or not all(_is_span(span, len(runs)) for span in spans):
            raise FormatError(f"{where}: found {spans!r:.80} as the spans of runs; see run.schema.json")
        before = document.get("before", [])
        if not isinstance(before, list):
            raise FormatError(f"{where}: expected a list of what runs were before, found {before!r:.80}")
        return cls(
            [Run.of_document(run, where) for run in runs],
            [(span[0], span[1]) for span in spans],
            [(_place(run, len(runs), where), Run.of_document(run, where)) for run in before],
        )


def _place(earlier: object, runs: int, where: str) -> int:
    """Of which of so many runs this is an earlier version."""
    place = earlier.get("place", 0) if isinstance(earlier, dict) else 0
    if not _is_place(place, runs):
        raise FormatError(f"{where}: found {place!r:.80} as the place of an earlier run; see run.schema.json")
    return int(place)


def _given(run: Run) -> str:
    """What a user has given, as one text."""
    return jsonvalue.dumps_plain([run.name, run.metadata, run.tags, run.split])


def _document(run: Run) -> dict[str, Any]:
    return {key: value for key, value in vars(run).items() if value and key != "ended"}


def _plain(value: Any, levels: int = jsonvalue.MAX_DEPTH) -> Any:
    if levels and isinstance(value, dict):
        return {key: _plain(inner, levels - 1) for key, inner in value.items()}
    if levels and type(value) in (list, tuple):
        return type(value)(_plain(inner, levels - 1) for inner in value)
    return str(value) if isinstance(value, PurePath) else value


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_place(place: object, runs: int) -> bool:
    return type(place) is int and 0 <= place < runs


def _is_span(span: object, runs: int) -> bool:
    if not isinstance(span, list) or len(span) != 2 or type(span[0]) is not int:
        return False
    return 0 <= span[0] < 1 << 32 and _is_place(span[1], runs)
