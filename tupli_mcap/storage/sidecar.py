"""Facts about a recording that are not in the recording: `<name>.mcap.json` beside it.

Deleting an episode or publishing one must not rewrite gigabytes, nor touch a file that is being written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, ValidationError

from tupli_mcap.errors import FormatError
from tupli_mcap.storage.atomic import os_errors, write_bytes
from tupli_mcap.storage.common import first_defect

__all__ = ["Sidecar", "sidecar_path"]

EpisodeNumber = Annotated[int, Field(ge=0, lt=1 << 32)]


class Sidecar(BaseModel):
    """deleted: numbers of the episodes that are gone. published_in: groups that see an episode, by its
    number."""

    version: Literal[1] = 1
    deleted: set[EpisodeNumber] = Field(default_factory=set)
    published_in: dict[EpisodeNumber, list[str]] = Field(default_factory=dict)

    @classmethod
    def read(cls, recording: Path) -> Sidecar:
        """The sidecar of a recording; an empty one if there is none.

        Raises:
            FormatError: The file is no sidecar.
        """
        path = sidecar_path(recording)
        try:
            with os_errors("cannot read", path):
                return cls.model_validate_json(path.read_bytes()) if path.exists() else cls()
        except ValidationError as err:
            raise FormatError(f"{path}: expected facts about a recording: {first_defect(err)}") from err

    def write(self, recording: Path) -> None:
        """Write it beside the recording; an empty one is removed."""
        path = sidecar_path(recording)
        with os_errors("cannot write", path):
            if self.deleted or self.published_in:
                write_bytes(path, self.model_dump_json(indent=2).encode())
            else:
                path.unlink(missing_ok=True)


def sidecar_path(recording: Path) -> Path:
    """Where the sidecar of a recording lies."""
    return recording.with_name(recording.name + ".json")
