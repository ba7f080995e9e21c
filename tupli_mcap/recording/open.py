"""Opening a recording: by its summary, or by recovery in memory."""

from __future__ import annotations

import time

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import read_attachment, read_metadata
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.summary import check_magic, foreign, has_summary, read_summary
from tupli_mcap.recording.contents import RECORDING_METADATA, REPEATED_METADATA, Contents, check_metadata
from tupli_mcap.recording.index import INDEX_NAME, EpisodeIndex
from tupli_mcap.recording.limits import check_chunks

_ATTEMPTS = 5
_PAUSE = 0.01  # seconds: a writer begins, ends or goes on within that


def read_contents(source: Source) -> Contents:
    """Reads a finished file by its summary, another by recovery; anew if a writer changes it meanwhile.

    Raises:
        FormatError: no MCAP file, no recording of ours, or damaged.
    """
    for _ in range(_ATTEMPTS):
        size = source.size
        try:
            return _read_contents(source)
        except FormatError:
            source.refresh()
            if source.size == size and (source.path is None or not is_locked(source.path)):
                raise
        time.sleep(_PAUSE)
    return _read_contents(source)


def _read_contents(source: Source) -> Contents:
    if not has_summary(source):
        check_magic(source)
        from tupli_mcap.recording.recover.find_journal import find_journal
        from tupli_mcap.recording.recover.unfinished import recover_contents

        journal = find_journal(source)  # a writer that closed in between has left a summary, and no journal
        if not has_summary(source):
            return recover_contents(source, journal)
    summary = read_summary(source)
    # the one at the end where it is there, so that all that is read here lies at the end of the file
    place = summary.metadata.get(REPEATED_METADATA, summary.metadata.get(RECORDING_METADATA))
    if place is None:
        raise foreign(source, f"it has no metadata {RECORDING_METADATA!r}")
    metadata = check_metadata(source, read_metadata(source, place))
    if INDEX_NAME not in summary.attachments:
        raise FormatError(
            f"{source.name}: the recording has no episode index {INDEX_NAME!r}; recover it into a new file"
        )
    attachment = summary.attachments.pop(INDEX_NAME)
    index = EpisodeIndex.decode(read_attachment(source, attachment), source.name)
    if len(index.chunks) != summary.chunks:
        raise FormatError(
            f"{source.name}: the episode index lists {len(index.chunks)} chunks, the summary {summary.chunks}"
        )
    check_chunks(index.chunks, attachment.offset, source.name)
    return Contents(
        metadata,
        summary.schemas,
        summary.channels,
        summary.attachments,
        [place for place in summary.metadata.values() if place.offset < attachment.offset],
        index.chunks,
        index=index,
        data_end=attachment.offset,
    )
