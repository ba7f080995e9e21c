"""Recovery in memory: the journal first, then the file's valid prefix; what the writer could not finish is derived.

Nothing is written. Repeating it changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tupli_mcap.errors import FormatError, RecordingError, os_reason
from tupli_mcap.journal.committed import (
    CommittedRecords,
    CommittedRows,
    committed_records,
    rows_of,
    running_record,
    size_behind,
    torn_rows,
)
from tupli_mcap.journal.file import (
    FRAMES_AREA,
    JournalContents,
    journal_info,
    read_journal,
    recorded_journal,
)
from tupli_mcap.journal.rows import RowDeriver, even_rows
from tupli_mcap.mcap.records import parse_record, records
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.summary import has_summary
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.contents import Contents, step_channels
from tupli_mcap.recording.recover.episodes import Unwritten, chunk_table, complete
from tupli_mcap.recording.recover.prefix import Scan, head, scan

__all__ = [
    "KEEP_JOURNAL",
    "STEPS_IN_JOURNAL",
    "add_unwritten",
    "belongs",
    "define",
    "find_journal",
    "misplaced_journal",
    "recover_contents",
]

STEPS_IN_JOURNAL = "steps that are not yet in a chunk are nowhere else"
KEEP_JOURNAL = (
    "keep it, and update tupli-mcap if a later version recorded this; tupli-mcap recover writes what the file itself "
    "holds to a new one"
)
_EVENTS = ("events", "info")
_ATTEMPTS = 100


def recover_contents(source: Source, journal: JournalContents | Exception | None) -> Contents:
    """The contents of a recording that has no summary.

    `journal` is what `find_journal` found. It must be read before the chunks are: a live writer moves rows from there
    to here.

    Raises:
        FormatError: it is no recording of ours, or its first records are damaged.
    """
    metadata = head(source)
    found = scan(source)
    if isinstance(journal, Exception):
        if found.channels:  # defined when the journal is there: without them no step has been taken
            _check_unchanged(source)
            warnings.warn(_missing(source, metadata, journal), UserWarning, stacklevel=6)
        journal = None
    elif journal is not None and not belongs(journal.info, metadata):
        if found.channels:
            warnings.warn(_foreign_journal(source, metadata), UserWarning, stacklevel=6)
        journal = None  # a stale journal of another recording with this name is not ours to merge
    defined = set(found.channels)
    if journal is not None:
        define(found.schemas, found.channels, journal, source.name)
    tail = Unwritten()
    end = found.end
    if found.unindexed is not None:
        tail.rows.append(found.unindexed)
        found.counts[found.unindexed.channel] = found.counts.get(found.unindexed.channel, 0) + len(
            found.unindexed.offsets
        )
    contents = Contents(
        metadata,
        found.schemas,
        found.channels,
        found.attachments,
        found.metadata_indexes,
        complete=False,
        data_end=end,
        undefined=sorted(set(found.channels) - defined),
    )
    steps = step_channels(found.channels, source.name)
    if steps:
        layout = StepLayout.from_metadata(steps[0].metadata)
        if journal is not None:
            # under same-step autoreset; and it is not known what else of that step was lost
            tail.final_lost = journal.torn and bool(journal.info.get("vector"))
            add_unwritten(source, found, journal, layout, [c.id for c in steps], tail)
            missing = size_behind(journal) - found.end
            if missing > 0:  # with ends and final states: what runs may be the episode after them
                warnings.warn(_older(source, missing), UserWarning, stacklevel=6)
                tail.pending.clear()
        complete(source, found, layout, [c.id for c in steps], tail, contents)
        if tail.left_out and journal is not None and journal.torn:
            warnings.warn(_torn(source, tail.left_out), UserWarning, stacklevel=6)
    return contents


def _check_unchanged(source: Source) -> None:
    """Raises FormatError if the writer has made the journal since it was looked for, or finished the file."""
    source.refresh()
    if has_summary(source) or isinstance(find_journal(source), JournalContents):
        raise FormatError(f"{source.name} was changed while it was read; read it again")


def find_journal(source: Source) -> JournalContents | Exception | None:
    """The journal of an unfinished recording, or why it is of no use; None where there can be none.

    Its events are as they were when the file had the size that `source` knows of afterwards: rows that a live writer
    has moved to the file since the journal was read have their episodes.

    Raises:
        RecordingError: it is there and the system refuses to give it: without it steps would be missing.
        FormatError: it is there and cannot be read; or the writer was too fast.
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
        later = _read(source, path, only=_EVENTS)
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

    It is never taken for a missing one: it may hold steps that are nowhere else, and a later version of this package,
    or a copy of it, may read them.
    """
    return FormatError(
        f"{name} was not finished, and its journal cannot be read ({err}): {STEPS_IN_JOURNAL}; {KEEP_JOURNAL}"
    )


def belongs(info: Mapping[str, Any], metadata: Mapping[str, str]) -> bool:
    """Whether a journal, by what it says of itself, is that of a recording with these rows.

    A rewritten recording keeps its UUID, but not its row numbers.
    """
    return all(info.get(key, "") == metadata.get(key, "") for key in ("uuid", "rewritten"))


def misplaced_journal(path: Path, metadata: Mapping[str, str]) -> Path | None:
    """The journal of a recording that lies beside it under another name: the recording was renamed without it.

    None if it is in its place, or not to be found.
    """
    expected = recorded_journal(path, metadata)
    for candidate in (expected, *sorted(Path(os.path.realpath(path)).parent.glob("*.journal"))):
        with contextlib.suppress(OSError, FormatError):
            if belongs(journal_info(candidate), metadata):
                return None if candidate == expected else candidate
    return None


def _missing(source: Source, metadata: Mapping[str, str], err: Exception) -> str:
    if not isinstance(err, FileNotFoundError):
        return f"{source.name}: its journal is not looked for ({err})"
    expected = Path(str(err.filename))
    elsewhere = None if source.path is None else misplaced_journal(source.path, metadata)
    if elsewhere is not None:
        what = f"{elsewhere} is its journal: rename that to {expected.name}"
    elif "journal" in metadata:
        what = f"its journal was {expected}: bring that back"
    else:
        what = "keep the two files together"
    return (
        f"{source.name} was not finished and has no journal {expected.name} beside it: steps not "
        f"yet in a chunk cannot be recovered; {what}"
    )


def _foreign_journal(source: Source, metadata: Mapping[str, str]) -> str:
    found = None if source.path is None else recorded_journal(source.path, metadata)
    return (
        f"{source.name} was not finished, and {found} is the journal of another recording: it is left alone, and "
        "steps not yet in a chunk cannot be recovered"
    )


def _older(source: Source, missing: int) -> str:
    return (
        f"{source.name} ends {missing} bytes before what its journal has left to it: ends of episodes and final states "
        "are missing. A copy of a recording that is being made needs the journal first, and then the file"
    )


def _gap(source: Source, topic: str, steps: int) -> str:
    return (
        f"{source.name}: of the last {steps} step(s) of {topic} the first are missing, and all are left out: the file "
        "is damaged, or was copied before its journal (of a recording that is being made, copy the journal first)"
    )


def _torn(source: Source, steps: int) -> str:
    return (
        f"{source.name}: the machine that recorded it has been started anew since, or this is another one: {steps} "
        "step(s) in its journal cannot be shown to be whole and are left out; on the machine and boot that recorded "
        'it, they can be read: finish the recording there, with "tupli-mcap recover" or by appending to it'
    )


def define(
    schemas: dict[int, Schema], channels: dict[int, Channel], journal: JournalContents, name: str
) -> None:
    """Adds the schemas and channels that the journal defines to those known; `name` is the recording's.

    What the journal defines is under its checksum, what the file defines outside of chunks is not.
    """
    where = f"{name}: journal"
    try:
        texts = [bytes.fromhex(text) for text in dict(journal.info.get("definitions", {})).values()]
    except (TypeError, ValueError) as err:
        raise FormatError(f"{where}: expected definitions of channels in hexadecimal digits: {err}") from err
    for text in texts:
        for opcode, offset, body in records(text, 0, where):
            if opcode == Opcode.SCHEMA:
                schema: Schema = parse_record(opcode, body, offset, where)
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel: Channel = parse_record(opcode, body, offset, where)
                channels[channel.id] = channel


def add_unwritten(
    source: Source,
    found: Scan,
    journal: JournalContents,
    layout: StepLayout,
    steps: list[int],
    tail: Unwritten,
) -> None:
    """Takes the rows and records the file does not have out of the journal.

    `steps` are the channels of the first sub-environments: of images and steps, those of these only.
    """
    store = ChunkStore(source, chunk_table(found, tail.rows), [bytes(r.data) for r in tail.rows], 1 << 24)
    counts = dict(found.counts)
    topics = {channel.topic: channel.id for channel in found.channels.values()}
    for env, channel in enumerate(steps):
        first = counts.get(channel, 0)
        if layout.constant:
            committed = CommittedRows(journal, "steps", env, layout.step_message.dtype, channel)
            taken = rows_of(committed, first)
            deriver = RowDeriver()
            if first:
                span = next(iter(store.spans(channel, first - 1, 1)))
                last = store.rows(span.chunk, layout.step_message.dtype)[span.begin]
                deriver = RowDeriver(int(last["episode"]), int(last["step"]), int(last["#log_time"]))
            deriver.fill(taken)
            rows = even_rows(channel, first, taken.view(np.uint8).tobytes(), taken)
            total, known = first + len(taken), committed.end
            tail.left_out += torn_rows(committed, first)
            holes = {
                (env, hole.row): hole for hole in committed.finals(layout.state_end) if hole.row <= total
            }
            tail.finals |= holes
            following = committed.following(total - 1, layout.state_end)
            # behind a hole, the image that was running is the next state's
            if following is not None and not (layout.images and (env, total) in holes):
                tail.pending[env] = following
        else:
            records = committed_records(journal, f"steps/{env}").get(channel, CommittedRecords(channel, {}))
            rows = rows_of(records, first)
            total, known = first + len(rows.offsets), records.end
            state = running_record(journal, f"steps/{env}", total, layout)
            if state is not None:
                tail.pending[env], known = state, max(known, total)
        if total > first:
            tail.rows.append(rows)
        if known > total and not journal.torn:
            warnings.warn(
                _gap(source, found.channels[channel].topic, known - total), UserWarning, stacklevel=7
            )
        mine = Topics.of_step(found.channels[channel].topic)
        images = [topics.get(mine.image(leaf.name)) for leaf in layout.images]
        _salvage_images(found, journal, layout, env, images, total, known, tail)
    for name in journal.areas:
        if name in _EVENTS or name.startswith(FRAMES_AREA):
            for channel, records in committed_records(journal, name, counts).items():
                rows = rows_of(records, counts.get(channel, 0))
                tail.rows += [rows] if len(rows.offsets) else []


def _salvage_images(
    found: Scan,
    journal: JournalContents,
    layout: StepLayout,
    env: int,
    channels: list[int | None],
    steps: int,
    known: int,
    tail: Unwritten,
) -> None:
    """Takes the images of the rows before `steps`, of each leaf from its channel.

    Where the journal does not know a step as committed (`known` is the row after those), its image may be another one:
    in a journal that was read or copied before the file, a reset has written over it since.
    """
    for leaf, channel in zip(layout.images, channels, strict=True):
        if channel is None:
            raise FormatError(
                f"expected a channel for the images of {leaf.name!r}, sub-environment {env}, found none"
            )
        dtype, first = layout.image_messages[leaf.name].dtype, found.counts.get(channel, 0)
        # resets write over them
        committed = CommittedRows(journal, f"{leaf.name}/{env}", 0, dtype, channel, rewritten=True)
        images = rows_of(committed, first)[: max(0, min(steps, known) - first)]
        images["#publish_time"] = images["#log_time"]
        if len(images):
            tail.rows.append(even_rows(channel, first, images.view(np.uint8).tobytes(), images))
        pending = committed.row(steps)
        # where the file is ahead, a live writer may have been writing over that row while it was read
        if pending is None or known < steps or first > steps:
            tail.pending.pop(env, None)
        elif env in tail.pending:
            tail.pending[env] += leaf.as_values(pending["data"]).tobytes()
