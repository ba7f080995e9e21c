"""`manifest.json`: what the columns of a directory are, where they came from, and their digests."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.source import open_regular
from tupli_mcap.system import refused

__all__ = ["MANIFEST", "FileEntry", "Manifest", "SourceFile"]

MANIFEST = "manifest.json"
_VERSION = 1
_MOST_BYTES = 64 << 20
_Count = Field(ge=0, lt=1 << 62)


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True)


class FileEntry(_Model):
    """A file: `dtype` as NumPy writes it ("<f4") and `shape` of an array, its `size` in bytes, and the SHA-256 of the
    whole file. A file of bare bytes (`.bin`) has the dtype "|u1" and the shape (size,)."""

    dtype: str
    shape: tuple[int, ...]
    size: int = _Count
    sha256: str


class SourceFile(_Model):
    """A recording that steps were read from, as it was then; `mtime_ns` is 0 where nobody knows it (URLs)."""

    name: str
    uuid: str
    size: int
    mtime_ns: int

    @property
    def stamp(self) -> tuple[int, int]:
        """What changes when the file does."""
        return self.size, self.mtime_ns


class Manifest(_Model):
    """Everything about a directory of columns but the columns.

    token: 32 hex digits, drawn anew at each writing. identity: a digest of which steps these are. spaces: the spaces,
    dtypes and nesting of the steps, as in the metadata of a recording's step channel. message: where there are leaves
    of variable size, the ros2msg definition of a step; the values of such a leaf are CDR of its field. filters: the
    query, as JSON; `tuple_function` names a filter that was a function. recordings: in the order their episodes come
    in. files: by name.
    """

    format: Literal["tupli_mcap columns"] = "tupli_mcap columns"
    version: int = _VERSION
    library: str
    token: str = Field(pattern="^[0-9a-f]{32}$")
    identity: str
    steps: int = _Count
    episodes: int = _Count
    breaks: int = _Count
    spaces: dict[str, str]
    message: str | None = None
    filters: dict[str, Any]
    tuple_function: str | None = None
    recordings: list[SourceFile]
    files: dict[str, FileEntry]

    def to_bytes(self) -> bytes:
        return self.model_dump_json(indent=1).encode()

    @classmethod
    def read(cls, directory: Path) -> Manifest:
        """The manifest of a directory.

        Raises:
            FileNotFoundError: there is none.
            FormatError: it is none, or of a version this one does not know.
            StorageError: the system refuses.
        """
        path = directory / MANIFEST
        try:
            with os.fdopen(open_regular(path), "rb") as file:
                data = file.read(_MOST_BYTES + 1)
        except FileNotFoundError:
            raise
        except OSError as err:
            raise StorageError(f"{path} cannot be read: {refused(err)}") from err
        if len(data) > _MOST_BYTES:
            raise FormatError(f"{path}: expected at most {_MOST_BYTES} bytes, found more")
        try:
            _check_version(json.loads(data), path)
            return cls.model_validate_json(data)
        except (ValidationError, ValueError, RecursionError) as err:
            raise FormatError(
                f"{path}: expected a manifest of columns, found something else ({_first_line(err)})"
            ) from err

    def layout(self, directory: Path) -> StepLayout:
        """The layout of the steps.

        Raises:
            FormatError: the spaces are none that could be recorded.
        """
        try:
            return StepLayout.from_metadata(self.spaces)
        except FormatError as err:
            raise FormatError(f"{directory / MANIFEST}: {err}") from err


def _check_version(value: object, path: Path) -> None:
    version = value.get("version") if isinstance(value, dict) else None
    if type(version) is int and version > _VERSION:
        raise FormatError(
            f"{path}: expected columns of version {_VERSION}, found {version}; update tupli-mcap"
        )


def _first_line(err: Exception) -> str:
    if isinstance(err, ValidationError):
        first = err.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"[:200]
    return str(err).splitlines()[0][:200] if str(err) else type(err).__name__
