"""Facts about a recording that are not in the recording: `<name>.mcap.json` beside it.

Deleting an episode or publishing one must not rewrite gigabytes, nor touch a file that is being written.

Episodes of several recordings are deleted as a whole:

1. `deleting.json` in the storage's directory is written, which names them all: from then on they are gone.
2. They are noted in one sidecar after another.
3. `deleting.json` is removed.

Whoever finds one reads the sidecars as if they said it too; the next one who deletes or compacts goes on at 2.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, ValidationError

from tupli_mcap.errors import FormatError
from tupli_mcap.storage.atomic import os_errors, write_bytes
from tupli_mcap.storage.common import first_defect
from tupli_mcap.storage.rows import escape_text, unescape_text

__all__ = ["Deletion", "Sidecar", "sidecar_path"]

DELETING = "deleting.json"
EpisodeNumber = Annotated[int, Field(ge=0, lt=1 << 32)]


class Sidecar(BaseModel):
    """deleted: numbers of the episodes that are gone. published_in: groups that see an episode, by its
    number."""

    version: Literal[1] = 1
    deleted: set[EpisodeNumber] = Field(default_factory=set)
    published_in: dict[EpisodeNumber, list[str]] = Field(default_factory=dict)

    @classmethod
    def read(cls, recording: Path, root: Path | None = None) -> Sidecar:
        """What is noted about a recording; `root` is its storage's directory, by default what its place tells.

        Raises:
            FormatError: The file is no sidecar.
        """
        recording = recording.absolute()
        root = _storage_of(recording) if root is None else root.absolute()
        # first: who finishes it notes everything here before he removes it
        deleting = Deletion.read(root).deleted.get(recording.relative_to(root).as_posix(), set())
        path = sidecar_path(recording)
        try:
            data = _content(path)
            found = cls() if data is None else cls.model_validate_json(data)
        except ValidationError as err:
            raise FormatError(f"{path}: expected facts about a recording: {first_defect(err)}") from err
        found.deleted |= deleting
        return found

    def write(self, recording: Path) -> None:
        """Write it beside the recording; an empty one is removed."""
        path = sidecar_path(recording)
        with os_errors("cannot write", path):
            if self.deleted or self.published_in:
                write_bytes(path, self.model_dump_json(indent=2).encode())
            else:
                path.unlink(missing_ok=True)


class Deletion(BaseModel):
    """A deletion that is being done: numbers of the episodes that are gone, by recording (path below the root)."""

    version: Literal[1] = 1
    deleted: dict[str, set[EpisodeNumber]] = Field(default_factory=dict)

    @classmethod
    def read(cls, root: Path) -> Deletion:
        """The deletion that a storage is in the middle of; an empty one if there is none.

        Raises:
            FormatError: The file is something else.
        """
        path = root / DELETING
        try:
            data = _content(path)
            found = cls() if data is None else cls.model_validate_json(data)
        except ValidationError as err:
            raise FormatError(f"{path}: expected episodes to delete: {first_defect(err)}; delete it") from err
        return cls(deleted={unescape_text(name): numbers for name, numbers in found.deleted.items()})

    def write(self, root: Path) -> None:
        """Write it into the storage's directory; an empty one is removed."""
        path = root / DELETING
        named = Deletion(deleted={escape_text(name): numbers for name, numbers in self.deleted.items()})
        with os_errors("cannot write", path):
            if named.deleted:
                write_bytes(path, named.model_dump_json(indent=2).encode())
            else:
                path.unlink(missing_ok=True)


def _content(path: Path) -> bytes | None:
    """What is in a file; None if there is none."""
    with os_errors("cannot read", path):
        try:
            return path.read_bytes()
        except FileNotFoundError:
            return None


def _storage_of(recording: Path) -> Path:
    """The directory of the storage that a recording seems to be in: it lies there, or below `recordings/<id>`."""
    above = recording.parent.parent
    return above.parent if above.name == "recordings" else recording.parent


def sidecar_path(recording: Path) -> Path:
    """Where the sidecar of a recording lies."""
    return recording.with_name(recording.name + ".json")
