"""Finds the journal of an unfinished recording, beside a live writer too, and adds the rows that its file lacks."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError, os_reason
from tupli_mcap.journal.committed import (
    Committed,
    CommittedRows,
    RowDeriver,
    committed_records,
    even_rows,
    rows_among,
    rows_of,
    running_record,
    size_behind,
    torn_rows,
)
from tupli_mcap.journal.file import (
    EVENT_AREAS,
    FRAMES_AREA,
    JournalContents,
    journal_info,
    read_journal,
    recorded_journal,
)
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import parse_record, records
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.episodes import EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.contents import step_channels
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore, RecordedChannels, decoded, head
from tupli_mcap.spaces.leaves import Leaf

STEPS_IN_JOURNAL = "steps that are not yet in a chunk are nowhere else"
KEEP_JOURNAL = (
    "keep it, and update tupli-mcap if a later version recorded this; tupli-mcap recover writes what the file itself "
    "holds to a new one"
)
_ATTEMPTS = 100
_WHOLE = 3  # attempts at a whole journal, which may be large
_Taken = TypeVar("_Taken", Array, Rows)


def find_journal(source: Source) -> JournalContents | Exception:
    """The journal of an unfinished recording, or the error that makes it useless.

    Its logs are those of a moment at which the file had the size that `source` has afterwards. So every row that a live
    writer moved to the file up to then has its episode's start. So are its steps, unless the writer is faster than the
    reader: then the last one may be in the file only, and the state after it is not known.

    Raises:
        RecordingError: it is there and the system refuses to read it: steps would be missing.
        FormatError: it is there and cannot be read; or the writer kept changing the file.
    """
    if source.path is None:
        return RecordingError("an open file, or a URL, does not say what lies beside it; open it by its path")
    metadata = head(source)
    try:
        path = recorded_journal(source.path, metadata)
    except FormatError as err:
        return err
    journal: JournalContents | None = None
    for attempt in range(_ATTEMPTS):
        size = source.size
        found = _read(source, path, None if attempt < _WHOLE else EVENT_AREAS)
        source.refresh()
        if not isinstance(found, JournalContents):
            return found
        if journal is None or attempt < _WHOLE:
            journal = found
        if source.size == size and found.info == journal.info:
            areas, data = {**journal.areas, **found.areas}, {**journal.data, **found.data}
            return journal._replace(areas=areas, data=data)
    raise FormatError(f"{source.name} was written to while it was read; read it again")


def _read(source: Source, path: Path, only: Collection[str] | None = None) -> JournalContents | Exception:
    try:
        return read_journal(path, only)
    except FileNotFoundError as err:
        return err
    except FormatError as err:
        # of a later version, or damaged: it must not count as missing, for the user may have another version, or a copy
        raise FormatError(
            f"{source.name} was not finished, and its journal cannot be read ({err}): {STEPS_IN_JOURNAL}; "
            f"{KEEP_JOURNAL}"
        ) from err
    except OSError as err:
        raise RecordingError(
            f"{source.name} was not finished, and its journal {path.name} cannot be read: {os_reason(err)}"
        ) from err


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


def add_journal(evidence: Evidence) -> None:
    """Reads the journal of an unfinished recording and takes the rows that the file lacks.

    Raises nothing for a missing or damaged journal: `evidence.journal` and `evidence.notes` say it.
    """
    if evidence.file_end.finished or evidence.source.path is None:
        return
    path = evidence.source.path
    # a writer makes the journal before the channels
    no_step = not evidence.channels and not evidence.damages
    try:
        path = recorded_journal(path, evidence.metadata or {})
        journal = read_journal(path)
    except FileNotFoundError:
        if no_step:
            return
        evidence.journal = "missing"
        elsewhere = misplaced_journal(evidence.source.path, evidence.metadata or {})
        if elsewhere is not None:
            evidence.notes.append(f"{elsewhere} is its journal: rename that to {path.name} and recover again")
        return
    except (OSError, FormatError) as err:
        evidence.journal = "damaged"
        evidence.notes.append(f"the journal cannot be read ({err}): {STEPS_IN_JOURNAL}; it is left as it is")
        return
    if not _belongs(evidence, journal):
        if no_step:
            return
        evidence.journal = "stale"
        evidence.notes.append(f"the journal {path.name} belongs to another recording")
        return
    evidence.journal = "used"
    try:
        take_journal(evidence, journal)
    except FormatError as err:
        evidence.journal = "damaged"
        evidence.notes.append(f"the journal is damaged ({err})")


def _belongs(evidence: Evidence, journal: JournalContents) -> bool:
    """Whether the journal has the recording's uuid, or, if that is lost, one that the damaged bytes hold."""
    uuid = str(journal.info.get("uuid"))
    if evidence.metadata is not None:
        return belongs(journal.info, evidence.metadata)
    for damage in evidence.damages:
        data = evidence.source.read(damage.offset, min(damage.end - damage.offset, 1 << 16))
        if len(uuid) == 32 and uuid.encode() in data:
            evidence.metadata = {"uuid": uuid}
            return True
    return False


def take_journal(evidence: Evidence, journal: JournalContents) -> None:
    """Takes rows that the file lacks, and the running states, from its journal.

    With `evidence.strict` it takes the rows that continue those in the file (`rows_of`), else all that are missing.

    FormatError if the journal is damaged, or lacks an area.
    """
    define(evidence, journal)
    steps = step_channels(evidence.channels, evidence.source.name)
    if steps:
        layout = StepLayout.from_metadata(steps[0].metadata)
        take_rows(evidence, journal, layout, RecordedChannels.of(evidence, layout))


def take_rows(
    evidence: Evidence, journal: JournalContents, layout: StepLayout, channels: RecordedChannels
) -> None:
    """As `take_journal`, when the channels are known; takes the steps of `channels`, which may be those of the first
    sub-environments only."""
    in_file = {channel: evidence.stop(channel) for channel in evidence.pieces} if evidence.strict else {}
    for name in journal.areas:
        if name in EVENT_AREAS or name.startswith(FRAMES_AREA):
            _take_log(evidence, journal, name, in_file)
    # Under same-step autoreset the state may be the next episode's, and a power loss may have taken the final state.
    evidence.final_lost = journal.torn and bool(journal.info.get("vector"))
    taking = _Steps(evidence, journal, layout, channels)
    for env in range(len(channels.steps)):
        taking.take(env)
    if size_behind(journal) > evidence.good_end:
        evidence.states.clear()  # ends may be missing: a running state may belong to a later episode


def define(evidence: Evidence, journal: JournalContents) -> None:
    """Adds the schemas and channels that the journal defines to those known.

    The journal's definitions replace those of the file: they have a checksum, definitions outside of chunks have none.
    """
    where = f"{evidence.source.name}: journal"
    try:
        texts = [bytes.fromhex(text) for text in dict(journal.info.get("definitions", {})).values()]
    except (TypeError, ValueError) as err:
        raise FormatError(f"{where}: expected definitions of channels in hexadecimal digits: {err}") from err
    for text in texts:
        for opcode, offset, body in records(text, 0, where):
            if opcode == Opcode.SCHEMA:
                schema: Schema = parse_record(opcode, body, offset, where)
                evidence.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel: Channel = parse_record(opcode, body, offset, where)
                evidence.channels[channel.id] = channel


def _missing(
    evidence: Evidence, channel: int, committed: Committed[_Taken], stop: int | None = None
) -> list[_Taken]:
    """The committed rows before `stop` to take, in runs of consecutive ones."""
    if evidence.strict:
        rows = rows_of(committed, evidence.stop(channel), stop)
        return [] if rows is None else [rows]
    wanted = evidence.lacks(channel, committed.numbers)
    return rows_among(committed, wanted if stop is None else wanted & (committed.numbers < stop))


def _take_log(
    evidence: Evidence, journal: JournalContents, name: str, in_file: Mapping[int, int]
) -> dict[int, int]:
    """Takes the records of a log, without the first `in_file` of each channel; returns the row after its last one, by
    channel."""
    logs = committed_records(journal, name, in_file)
    for channel, committed in logs.items():
        evidence.add_rows(channel, _missing(evidence, channel, committed))
    return {channel: committed.end for channel, committed in logs.items()}


def _take_tables(evidence: Evidence, channel: int, tables: Iterable[Array]) -> None:
    """Takes tables of completed rows."""
    evidence.add_rows(channel, [even_rows(channel, rows.view(np.uint8).tobytes(), rows) for rows in tables])


class _Steps:
    """Takes the steps of a journal with their images, and the running states."""

    def __init__(
        self, evidence: Evidence, journal: JournalContents, layout: StepLayout, channels: RecordedChannels
    ) -> None:
        self._evidence, self._journal = evidence, journal
        self._layout, self._channels = layout, channels
        self._store = PackedStore(evidence)  # without the steps that are taken here
        self._starts = {} if evidence.strict else _starts(self._store, self._channels)

    def take(self, env: int) -> None:
        """Takes the steps of a sub-environment."""
        channel = self._channels.steps[env]
        take = self._take_constant if self._layout.constant else self._take_variable
        state, known = take(env, channel)
        stop = self._evidence.stop(channel)
        self._evidence.beyond[channel] = max(0, known - stop)
        for leaf in self._layout.images:
            image = self._take_images(leaf, env, stop, known)
            state = None if state is None or image is None else state + image
        if state is not None:
            self._evidence.states[env] = state

    def _take_constant(self, env: int, channel: int) -> tuple[bytes | None, int]:
        """Takes steps of constant size; returns the running state, and the row after the last one committed."""
        evidence, layout = self._evidence, self._layout
        committed = CommittedRows(self._journal, "steps", env, layout.step_message.dtype, channel)
        evidence.left_out[channel] = torn_rows(committed, evidence.stop(channel))
        tables = _missing(evidence, channel, committed)
        for rows in tables:
            first = int(rows["#sequence"][0])
            RowDeriver(*self._row_before(channel, first)).fill(rows)
            first_row = self._starts.get((env, int(rows["episode"][0])))
            if first_row is not None and first_row <= first:
                same = int(np.argmin(np.append(rows["episode"] == rows["episode"][0], False)))
                rows["step"][:same] = first - first_row + np.arange(same)
            # rows of this episode behind a gap count from its first row, even if its start is lost
            first_row = int(rows["#sequence"][-1]) - int(rows["step"][-1])
            self._starts.setdefault((env, int(rows["episode"][-1])), first_row)
        _take_tables(evidence, channel, tables)
        stop = evidence.stop(channel)
        finals = {(env, hole.row): hole for hole in committed.finals(layout.state_end) if hole.row <= stop}
        evidence.finals |= finals
        if layout.images and (env, stop) in finals:  # the running image belongs to the next episode
            return None, committed.end
        return committed.following(stop - 1, layout.state_end), committed.end

    def _take_variable(self, env: int, channel: int) -> tuple[bytes | None, int]:
        """The same of steps of variable size."""
        name = f"steps/{env}"
        known = _take_log(self._evidence, self._journal, name, {}).get(channel, 0)
        stop = self._evidence.stop(channel)
        state = running_record(self._journal, name, stop, self._layout)
        return state, known if state is None else max(known, stop)

    def _row_before(self, channel: int, first: int) -> tuple[int, int, int]:
        """Episode, step and time (ns) of the row before `first`; -1, -1, 0 if the file lacks it."""
        if not first or self._evidence.lacks(channel, np.array([first - 1]))[0]:
            return -1, -1, 0
        (span,) = self._store.spans(channel, self._store.packed(channel, first - 1), 1)
        row = self._store.rows(span.chunk, self._layout.step_message.dtype)[span.begin]
        return int(row["episode"]), int(row["step"]), int(row["#log_time"])

    def _take_images(self, leaf: Leaf, env: int, steps: int, known: int) -> bytes | None:
        """Takes the images of steps before `steps`; returns the running state's image.

        `known` is the row after the last step that the journal holds as committed. Images from there on are not taken:
        the journal was read or copied before the file, and a reset may have written over them in the meantime.
        """
        evidence, channel = self._evidence, self._channels.images[leaf.name][env]
        if channel is None:
            if evidence.strict:
                raise FormatError(
                    f"expected a channel for the images of {leaf.name!r}, sub-environment {env}, found none"
                )
            return None
        dtype = self._layout.image_messages[leaf.name].dtype
        # resets write over committed images
        committed = CommittedRows(self._journal, f"{leaf.name}/{env}", 0, dtype, channel, rewritten=True)
        tables = _missing(evidence, channel, committed, min(steps, known))
        for rows in tables:
            rows["#publish_time"] = rows["#log_time"]
        in_file = evidence.stop(channel)
        _take_tables(evidence, channel, tables)
        # if the file is ahead, a live writer may have written over that row while it was read
        running = committed.row(steps) if known >= steps >= in_file else None
        if running is None:
            return None
        data: bytes = leaf.as_values(running["data"]).tobytes()
        return data


def _starts(store: PackedStore, channels: RecordedChannels) -> dict[tuple[int, int], int]:
    """First rows of episodes, by sub-environment and number."""
    starts = decoded(store, channels.start, EpisodeStart.decode, strict=False)
    return {(start.env, start.episode): start.first_row for _, _, start in starts}
