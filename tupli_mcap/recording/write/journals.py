"""Where the journal of a recording lies, and what other writers have left there."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tupli_mcap.errors import FormatError
from tupli_mcap.journal.file import journal_aside, journal_in, journal_info, journal_path, owner_among


def journal_place(path: Path, directory: str | os.PathLike[str] | None, uuid: str) -> Path:
    """Where the journal of a new recording goes: beside it, or into a directory."""
    return journal_path(path) if directory is None else journal_in(os.path.realpath(directory), path, uuid)


def is_left(path: Path, uuid: str) -> bool:
    """Whether a recording that was at this path has left its journal beside it."""
    return any(owner_among(place, [uuid]) for place in _beside(path, uuid))


def remove_left(path: Path, uuid: str) -> None:
    """Removes the journal that a recording which was at this path has left beside it."""
    for place in _beside(path, uuid):
        _remove_of(place, uuid)


def _beside(path: Path, uuid: str) -> tuple[Path, Path]:
    place = journal_path(path)
    return place, journal_aside(place, uuid)


def _remove_of(place: Path, uuid: str) -> None:
    with contextlib.suppress(OSError):
        if owner_among(place, [uuid]):
            place.unlink()


def remove_unstarted(path: Path, uuid: str) -> None:
    """Removes the journal of a recording that was to replace that of `uuid` at a path, if it is there: it never had a
    step."""
    place = journal_path(path)
    with contextlib.suppress(OSError, FormatError):
        if uuid and journal_info(place).get("replaces") == uuid:
            place.unlink()


def remove_of_killed(place: Path, uuid: str) -> None:
    """Removes what a killed writer left of its journal, and of one that was not in its place yet."""
    _remove_of(place, uuid)
    remove_unnamed(place)


def remove_unnamed(place: Path) -> None:
    """Removes a journal that was not in its place yet."""
    with contextlib.suppress(OSError):
        place.with_name(f"{place.name}.tmp").unlink()
