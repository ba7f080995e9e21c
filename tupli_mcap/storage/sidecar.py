"""Sidecars: `<name>.mcap.json` beside a recording notes its deleted and published episodes.

To delete or publish an episode must not rewrite gigabytes, nor touch a file that is being written.

Episodes of several recordings are deleted together:

1. `deleting.json` in the storage's directory is written and names them all: from then on they are deleted.
2. They are noted in one sidecar after the other.
3. `deleting.json` is removed.

A reader that finds `deleting.json` treats its entries like notes in sidecars. The next process that deletes or compacts
goes on at 2.

Another recording may replace one (`mode="w"`), with episodes of the same numbers. So:

4. A sidecar, and each entry of `deleting.json`, names the UUID of its recording. A recording that is appended to or
   compacted keeps its UUID.
5. A note about another recording than the one at the path does not count, and the next note replaces it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, Field

from tupli_mcap.errors import RecordingError
from tupli_mcap.storage.atomic import os_errors, read_model, remove, write_bytes
from tupli_mcap.storage.texts import escape_text, unescape_text

DELETING = "deleting.json"
EpisodeNumber = Annotated[int, Field(ge=0, lt=1 << 32)]
RecordingUuid = Annotated[str, Field(pattern="^([0-9a-f]{32})?$")]


class Sidecar(BaseModel):
    """The notes beside a recording.

    Attributes:
        uuid: of the recording; empty if there are no notes.
        deleted: numbers of deleted episodes.
        published_in: by number of an episode, the groups that see it.
    """

    version: Literal[1] = 1
    uuid: RecordingUuid = ""
    deleted: set[EpisodeNumber] = Field(default_factory=set)
    published_in: dict[EpisodeNumber, list[str]] = Field(default_factory=dict)

    @classmethod
    def read(cls, recording: Path) -> Sidecar:
        """The sidecar at a recording's path, about any recording; an empty one if there is none.
        FormatError if the file is no sidecar."""
        return read_model(cls, sidecar_path(recording), "facts about a recording")

    def is_about(self, metadata: Mapping[str, str]) -> bool:
        """Whether it counts for the recording with these metadata."""
        return self.uuid == metadata.get("uuid")

    def is_empty(self) -> bool:
        """Whether it has no notes."""
        return not (self.deleted or self.published_in)

    def write(self, recording: Path) -> None:
        """Write it beside the recording; an empty one is removed."""
        path = sidecar_path(recording)
        with os_errors("cannot write", path):
            if self.is_empty():
                remove(path)
            else:
                write_bytes(path, self.model_dump_json(indent=2).encode())


class Deletion(BaseModel):
    """A deletion that is going on: numbers of the deleted episodes, by recording (path below the root), and the UUIDs
    of these recordings."""

    version: Literal[1] = 1
    deleted: dict[str, set[EpisodeNumber]] = Field(default_factory=dict)
    uuids: dict[str, RecordingUuid] = Field(default_factory=dict)

    @classmethod
    def read(cls, root: Path) -> Deletion:
        """The deletion that is going on in a storage; an empty one if there is none.
        FormatError if the file is something else."""
        named = read_model(cls, root / DELETING, "episodes to delete", "; delete it")
        return cls(
            deleted={unescape_text(name): numbers for name, numbers in named.deleted.items()},
            uuids={unescape_text(name): uuid for name, uuid in named.uuids.items()},
        )

    def of(self, relative: str) -> Sidecar:
        """The part about the recording at a path below the root, as a sidecar."""
        return Sidecar(uuid=self.uuids.get(relative, ""), deleted=self.deleted.get(relative, set()))

    def stamp(self, relative: str) -> tuple[int, ...]:
        """Numbers that change with the notes about a recording; not a hash of text, which differs between processes."""
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
    """The notes at a recording's path, about any recording.

    Read them before the recording is opened: compacting removes deleted episodes from both.
    """

    deleting: Sidecar
    beside: Sidecar

    @classmethod
    def read(cls, recording: Path, root: Path | None = None) -> Notes:
        """`root` is the directory of the recording's storage; by default, it follows from the recording's path.
        FormatError if a file with notes holds something else."""
        recording = recording.absolute()
        root = storage_of(recording) if root is None else root.absolute()
        # `deleting.json` first: whoever finishes a deletion writes the sidecars, and only then removes `deleting.json`
        deleting = Deletion.read(root).of(recording.relative_to(root).as_posix())
        return cls(deleting, Sidecar.read(recording))

    @property
    def deleted(self) -> set[int]:
        """The numbers of all episodes that are noted as deleted."""
        return self.deleting.deleted | self.beside.deleted

    def about(self, metadata: Mapping[str, str]) -> Sidecar:
        """The notes that count for the recording with these metadata."""
        found = Sidecar(uuid=metadata.get("uuid", ""))
        for said in self:
            if said.is_about(metadata):
                found.deleted |= said.deleted
                found.published_in.update(said.published_in)
        return found


def storage_of(recording: Path) -> Path:
    """The directory of the storage that a recording seems to be in: its own directory, or that of `recordings/<id>`."""
    above = recording.parent.parent
    return above.parent if above.name == "recordings" else recording.parent


def home_of(recording: Path) -> tuple[Path, str]:
    """The directory of the storage that a recording seems to be in, and its path below it.
    RecordingError if its name does not end in .mcap: no storage lists such a file."""
    if recording.suffix != ".mcap":
        raise RecordingError(f"expected a recording whose name ends in .mcap, found {recording}; rename it")
    path = recording.absolute()
    root = storage_of(path)
    return root, path.relative_to(root).as_posix()


def sidecar_path(recording: Path) -> Path:
    """The path of a recording's sidecar: beside the file itself, where the path is a symbolic link to it."""
    if os.path.islink(recording):  # noqa: PTH114 - not an error for a long name
        recording = Path(os.path.realpath(recording))
    return recording.with_name(recording.name + ".json")
