"""Finds the journal of an unfinished recording, checks that it is its own, and reads it beside a live writer."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from tupli_mcap.errors import FormatError, RecordingError, os_reason
from tupli_mcap.journal.file import EVENT_AREAS, JournalContents, journal_info, read_journal, recorded_journal
from tupli_mcap.mcap.records import has_summary
from tupli_mcap.mcap.source import Source
from tupli_mcap.recording.recover.prefix import head

STEPS_IN_JOURNAL = "steps that are not yet in a chunk are nowhere else"
KEEP_JOURNAL = (
    "keep it, and update tupli-mcap if a later version recorded this; tupli-mcap recover writes what the file itself "
    "holds to a new one"
)
_ATTEMPTS = 100


def find_journal(source: Source) -> JournalContents | Exception | None:
    """The journal of an unfinished recording, or the error that makes it useless; None if there can be none.

    Its logs are those of a moment at which the file had the size that `source` has afterwards. So every row that a live
    writer moved to the file up to then has its episode's start.

    Raises:
        RecordingError: it is there and the system refuses to read it: steps would be missing.
        FormatError: it is there and cannot be read; or the writer kept changing the file.
    """
    if source.path is None:
        return None
    metadata = head(source)
    try:
        path = recorded_journal(source.path, metadata)
    except FormatError as err:
        return err
    journal = _read(source, path)
    for _ in range(_ATTEMPTS):
        source.refresh()
        size = source.size
        if not isinstance(journal, JournalContents):
            return journal
        later = _read(source, path, only=EVENT_AREAS)
        source.refresh()
        if source.size == size and isinstance(later, JournalContents) and later.info == journal.info:
            areas, data = {**journal.areas, **later.areas}, {**journal.data, **later.data}
            return journal._replace(areas=areas, data=data)
        if has_summary(source):
            return journal
    raise FormatError(f"{source.name} was written to while it was read; read it again")


def _read(source: Source, path: Path, only: Collection[str] | None = None) -> JournalContents | Exception:
    try:
        return read_journal(path, only)
    except FileNotFoundError as err:
        return err
    except FormatError as err:
        raise _unreadable(source.name, err) from err
    except OSError as err:
        raise RecordingError(
            f"{source.name} was not finished, and its journal {path.name} cannot be read: {os_reason(err)}"
        ) from err


def _unreadable(name: str, err: FormatError) -> FormatError:
    """The error for an unfinished recording whose journal is there and cannot be read: damaged, or of a later version.

    Such a journal must not count as missing: it may hold steps that are nowhere else, and a later version of this
    package may read it, or the user may have a copy.
    """
    return FormatError(
        f"{name} was not finished, and its journal cannot be read ({err}): {STEPS_IN_JOURNAL}; {KEEP_JOURNAL}"
    )


def belongs(info: Mapping[str, Any], metadata: Mapping[str, str]) -> bool:
    """Whether the journal with this `info` belongs to the recording with these metadata.

    `rewritten` must agree too: a rewritten recording keeps its UUID, but not its row numbers.
    """
    return all(info.get(key, "") == metadata.get(key, "") for key in ("uuid", "rewritten"))


def misplaced_journal(path: Path, metadata: Mapping[str, str]) -> Path | None:
    """The journal beside a recording that was renamed without it; None if it is in its place, or cannot be found."""
    expected = recorded_journal(path, metadata)
    for candidate in (expected, *sorted(Path(os.path.realpath(path)).parent.glob("*.journal"))):
        with contextlib.suppress(OSError, FormatError):
            if belongs(journal_info(candidate), metadata):
                return None if candidate == expected else candidate
    return None
