"""Facts about a recording that are not in the recording: `<name>.mcap.json` beside it.

Deleting an episode or publishing one must not rewrite gigabytes, nor touch a file that is being written.

Episodes of several recordings are deleted as a whole:

1. `deleting.json` in the storage's directory is written, which names them all: from then on they are gone.
2. They are noted in one sidecar after another.
3. `deleting.json` is removed.

Whoever finds one reads the sidecars as if they said it too; the next one who deletes or compacts goes on at 2.

Another recording may take the place of one (`mode="w"`), and has episodes of the same numbers. So:

4. A sidecar, and each entry of `deleting.json`, names the UUID of the recording that it is about. Who appends to a
   recording, or compacts it, keeps its UUID.
5. What is about another recording than the one that is there does not count, and the next note takes its place.
6. What names no recording (earlier versions wrote that) counts for one that was begun before it was written, as the
   file's time tells: what is recorded in the place of another is begun after all notes about that. Written again, it
   names the recording.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field, PrivateAttr, ValidationError

from tupli_mcap.errors import FormatError
from tupli_mcap.storage.atomic import os_errors, write_bytes
from tupli_mcap.storage.texts import escape_text, first_defect, unescape_text

__all__ = ["Deletion", "Notes", "Sidecar", "sidecar_path", "storage_of"]

DELETING = "deleting.json"
EpisodeNumber = Annotated[int, Field(ge=0, lt=1 << 32)]
RecordingUuid = Annotated[str, Field(pattern="^([0-9a-f]{32})?$")]


class Sidecar(BaseModel):
    """uuid: of the recording that this is about; empty if it names none. deleted: numbers of the episodes that are
    gone. published_in: groups that see an episode, by its number."""

    version: Literal[1] = 1
    uuid: RecordingUuid = ""
    deleted: set[EpisodeNumber] = Field(default_factory=set)
    published_in: dict[EpisodeNumber, list[str]] = Field(default_factory=dict)
    _written_ns: int = PrivateAttr(0)

    @classmethod
    def read(cls, recording: Path) -> Sidecar:
        """What lies beside a recording, whichever it is about; an empty one if there is none.

        Raises:
            FormatError: The file is no sidecar.
        """
        path = sidecar_path(recording)
        try:
            data, written_ns = _content(path)
            found = cls() if data is None else cls.model_validate_json(data)
        except ValidationError as err:
            raise FormatError(f"{path}: expected facts about a recording: {first_defect(err)}") from err
        found._written_ns = written_ns
        return found

    def is_about(self, metadata: Mapping[str, str]) -> bool:
        """Whether it counts for the recording that has these metadata."""
        if self.uuid:
            return self.uuid == metadata.get("uuid")
        return int(metadata.get("created_ns", "0")) <= self._written_ns

    def is_empty(self) -> bool:
        """Whether it says nothing."""
        return not (self.deleted or self.published_in)

    def write(self, recording: Path) -> None:
        """Write it beside the recording; an empty one is removed."""
        path = sidecar_path(recording)
        with os_errors("cannot write", path):
            if self.is_empty():
                path.unlink(missing_ok=True)
            else:
                write_bytes(path, self.model_dump_json(indent=2).encode())


class Deletion(BaseModel):
    """A deletion that is being done: numbers of the episodes that are gone, by recording (path below the root), and the
    UUIDs of these recordings."""

    version: Literal[1] = 1
    deleted: dict[str, set[EpisodeNumber]] = Field(default_factory=dict)
    uuids: dict[str, RecordingUuid] = Field(default_factory=dict)
    _written_ns: int = PrivateAttr(0)

    @classmethod
    def read(cls, root: Path) -> Deletion:
        """The deletion that a storage is in the middle of; an empty one if there is none.

        Raises:
            FormatError: The file is something else.
        """
        path = root / DELETING
        try:
            data, written_ns = _content(path)
            named = cls() if data is None else cls.model_validate_json(data)
        except ValidationError as err:
            raise FormatError(f"{path}: expected episodes to delete: {first_defect(err)}; delete it") from err
        found = cls(
            deleted={unescape_text(name): numbers for name, numbers in named.deleted.items()},
            uuids={unescape_text(name): uuid for name, uuid in named.uuids.items()},
        )
        found._written_ns = written_ns
        return found

    def of(self, relative: str) -> Sidecar:
        """What it says of the recording at a path below the root, as a sidecar would."""
        found = Sidecar(uuid=self.uuids.get(relative, ""), deleted=self.deleted.get(relative, set()))
        found._written_ns = self._written_ns
        return found

    def stamp(self, relative: str) -> tuple[int, ...]:
        """Numbers that change with what is noted about a recording. (Hashes of texts differ between processes.)"""
        numbers = self.deleted.get(relative)
        return () if numbers is None else (int(self.uuids.get(relative) or "0", 16), *sorted(numbers))

    def write(self, root: Path) -> None:
        """Write it into the storage's directory; an empty one is removed."""
        path = root / DELETING
        named = Deletion(
            deleted={escape_text(name): numbers for name, numbers in self.deleted.items()},
            uuids={escape_text(name): uuid for name, uuid in self.uuids.items()},
        )
        with os_errors("cannot write", path):
            if named.deleted:
                write_bytes(path, named.model_dump_json(indent=2).encode())
            else:
                path.unlink(missing_ok=True)


class Notes(NamedTuple):
    """What is noted at a recording's path, whichever recording it is about.

    It is read before the recording is opened: what was deleted may be taken out of both meanwhile.
    """

    deleting: Sidecar
    beside: Sidecar

    @classmethod
    def read(cls, recording: Path, root: Path | None = None) -> Notes:
        """`root` is the directory of the recording's storage, by default what its place tells.

        Raises:
            FormatError: A file with notes holds something else.
        """
        recording = recording.absolute()
        root = storage_of(recording) if root is None else root.absolute()
        # first: who finishes it notes everything beside the recordings before he removes it
        deleting = Deletion.read(root).of(recording.relative_to(root).as_posix())
        return cls(deleting, Sidecar.read(recording))

    @property
    def deleted(self) -> set[int]:
        """The numbers of all episodes that are noted as deleted."""
        return self.deleting.deleted | self.beside.deleted

    def about(self, metadata: Mapping[str, str]) -> Sidecar:
        """What counts for the recording that has these metadata."""
        found = Sidecar(uuid=metadata.get("uuid", ""))
        for said in self:
            if said.is_about(metadata):
                found.deleted |= said.deleted
                found.published_in.update(said.published_in)
        return found


def _content(path: Path) -> tuple[bytes | None, int]:
    """What is in a file and when that was written (ns); None if there is none."""
    with os_errors("cannot read", path):
        try:
            with path.open("rb") as file:
                return file.read(), os.fstat(file.fileno()).st_mtime_ns
        except FileNotFoundError:
            return None, 0


def storage_of(recording: Path) -> Path:
    """The directory of the storage that a recording seems to be in: it lies there, or below `recordings/<id>`."""
    above = recording.parent.parent
    return above.parent if above.name == "recordings" else recording.parent


def sidecar_path(recording: Path) -> Path:
    """Where the sidecar of a recording lies."""
    return recording.with_name(recording.name + ".json")
