"""Annotations: statements about episodes, made after they were recorded; kept as `annotations.json`.

Each annotation gives values to some episodes. A later value of a key replaces an earlier one and the recorded one. A
value of null removes the key.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Self

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, RecordingError, plural

ANNOTATIONS_NAME: Final = "annotations.json"
ANNOTATIONS_MEDIA_TYPE: Final = "application/json"
MAX_ANNOTATIONS: Final = 1 << 26  # bytes of `annotations.json`


class Annotation(NamedTuple):
    """One statement about the episodes with these numbers, `by` a user, `at` a time (ISO 8601 in UTC)."""

    episodes: list[int]
    values: dict[str, Any]
    by: str
    at: str


class Annotations:
    """The annotations of a recording, in their order."""

    def __init__(self, said: Sequence[Annotation] = ()) -> None:
        self.said = said
        self._of_episode: dict[int, list[Annotation]] = {}
        for annotation in said:
            for number in dict.fromkeys(annotation.episodes):
                self._of_episode.setdefault(number, []).append(annotation)

    def __repr__(self) -> str:
        return f"<{plural(len(self.said), 'annotation')} of {plural(len(self._of_episode), 'episode')}>"

    def of(self, episode: int) -> Sequence[Annotation]:
        """The annotations of the episode with this number, the earliest first."""
        return self._of_episode.get(episode, ())

    def applied(self, episode: int, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """An episode's metadata with its annotations applied."""
        found = dict(metadata)
        for annotation in self.of(episode):
            for key, value in annotation.values.items():
                if value is None:
                    found.pop(key, None)
                else:
                    found[key] = value
        return found

    def to_json(self) -> bytes:
        """The content of `annotations.json`; raises RecordingError if JSON cannot hold a value, or they are too
        many."""
        try:
            data = jsonvalue.dumps_plain([annotation._asdict() for annotation in self.said]).encode()
        except (TypeError, ValueError) as err:
            raise RecordingError(f"annotation: {err}") from err
        if len(data) > MAX_ANNOTATIONS:
            raise RecordingError(f"annotations: expected at most {MAX_ANNOTATIONS} bytes, found {len(data)}")
        return data

    @classmethod
    def from_json(cls, data: bytes, where: str) -> Self:
        """The annotations in `data`; raises FormatError if it is something else."""
        document = jsonvalue.loads_at(where, data)
        if not isinstance(document, list) or not all(map(_is_annotation, document)):
            raise FormatError(f"{where}: expected a list of annotations, see annotations.schema.json")
        return cls([Annotation(**one) for one in document])


def _is_annotation(value: object) -> bool:
    if not isinstance(value, dict) or value.keys() != set(Annotation._fields):
        return False
    numbers = value["episodes"]
    return (
        isinstance(numbers, list)
        and all(type(number) is int and 0 <= number < 1 << 32 for number in numbers)
        and isinstance(value["values"], dict)
        and all(isinstance(key, str) for key in value["values"])
        and isinstance(value["by"], str)
        and isinstance(value["at"], str)
    )
