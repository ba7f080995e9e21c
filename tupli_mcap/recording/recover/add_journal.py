"""What the journal of an unfinished recording adds to what is good in the file: rows by number, wherever a hole is."""

from __future__ import annotations

import bisect
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.journal.committed import (
    CommittedRows,
    committed_records,
    rows_among,
    running_record,
    size_behind,
)
from tupli_mcap.journal.file import FRAMES_AREA, JournalContents, read_journal, recorded_journal
from tupli_mcap.journal.rows import RowDeriver
from tupli_mcap.messages.episodes import EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.contents import step_channels
from tupli_mcap.recording.recover.evidence import Gathered, Piece
from tupli_mcap.recording.recover.segments import Channels, messages
from tupli_mcap.recording.recover.unfinished import STEPS_IN_JOURNAL, belongs, define, misplaced_journal
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["add_journal"]


def add_journal(gathered: Gathered) -> None:
    """Reads the journal of an unfinished recording, and takes the rows that the file does not have."""
    if gathered.tail.finished or gathered.source.path is None:
        return
    path = gathered.source.path
    # a journal is made before the channels
    no_step = not gathered.channels and not gathered.damages
    try:
        path = recorded_journal(path, gathered.metadata or {})
        journal = read_journal(path)
    except FileNotFoundError:
        if no_step:
            return
        gathered.journal = "missing"
        elsewhere = misplaced_journal(gathered.source.path, gathered.metadata or {})
        if elsewhere is not None:
            gathered.notes.append(f"{elsewhere} is its journal: rename that to {path.name} and recover again")
        return
    except (OSError, FormatError) as err:
        gathered.journal = "damaged"
        gathered.notes.append(f"the journal cannot be read ({err}): {STEPS_IN_JOURNAL}; it is left as it is")
        return
    if not _belongs(gathered, journal):
        if no_step:
            return
        gathered.journal = "stale"
        gathered.notes.append(f"the journal {path.name} belongs to another recording")
        return
    gathered.journal = "used"
    try:
        _merge(gathered, journal)
    except FormatError as err:
        gathered.journal = "damaged"
        gathered.notes.append(f"the journal is damaged ({err})")


def _belongs(gathered: Gathered, journal: JournalContents) -> bool:
    """Whether the journal has the recording's uuid, or, where that is lost, one that the damaged bytes hold."""
    uuid = str(journal.info.get("uuid"))
    if gathered.metadata is not None:
        return belongs(journal.info, gathered.metadata)
    for damage in gathered.damages:
        data = gathered.source.read(damage.offset, min(damage.end - damage.offset, 1 << 16))
        if len(uuid) == 32 and uuid.encode() in data:
            gathered.metadata = {"uuid": uuid}
            return True
    return False


def _merge(gathered: Gathered, journal: JournalContents) -> None:
    define(gathered.schemas, gathered.channels, journal, gathered.source.name)
    steps = step_channels(gathered.channels, gathered.source.name)
    if not steps:
        return
    layout = StepLayout.from_metadata(steps[0].metadata)
    channels = Channels.of(gathered, layout)
    for name in journal.areas:
        if name in ("events", "info") or name.startswith(FRAMES_AREA):
            _add_log(gathered, journal, name)
    starts = _starts(gathered, channels)
    gathered.final_lost = journal.torn and bool(journal.info.get("vector"))
    for env, channel in enumerate(channels.steps):
        if layout.constant:
            state, known = _add_rows(gathered, journal, layout, env, channel, starts)
        else:
            known = _add_log(gathered, journal, f"steps/{env}").get(channel, 0)
            state = running_record(journal, f"steps/{env}", _stop(gathered, channel), layout)
            known = known if state is None else max(known, _stop(gathered, channel))
        stop = _stop(gathered, channel)
        for leaf in layout.images:
            image = channels.images[leaf.name][env]
            pending = None
            if image is not None:
                dtype = layout.image_messages[leaf.name].dtype
                committed = CommittedRows(journal, f"{leaf.name}/{env}", 0, dtype, image, rewritten=True)
                pending = _add_images(gathered, committed, leaf, image, min(stop, known))
                pending = pending if known >= stop else None
            state = None if state is None or pending is None else state + pending
        if state is not None:
            gathered.states[env] = state
    if size_behind(journal) > gathered.source.size:
        gathered.states.clear()  # an end may be missing, and what runs be the episode after it


def _stop(gathered: Gathered, channel: int) -> int:
    """The row after the last one that is here."""
    pieces = gathered.pieces.get(channel)
    return pieces[-1].stop if pieces else 0


def _piece(gathered: Gathered, first: int, rows: int, data: bytes) -> Piece:
    return Piece(first, rows, len(data), gathered.loaded.add(data))


def _add_log(gathered: Gathered, journal: JournalContents, name: str) -> dict[int, int]:
    """Takes the records of a log; returns the row after its last one, by channel."""
    logs = committed_records(journal, name)
    for channel, records in logs.items():
        runs = rows_among(records, gathered.lacks(channel, records.numbers))
        gathered.add(
            channel, [_piece(gathered, rows.first, len(rows.offsets), bytes(rows.data)) for rows in runs]
        )
    return {channel: records.end for channel, records in logs.items()}


def _starts(gathered: Gathered, channels: Channels) -> dict[tuple[int, int], int]:
    """First rows of episodes, by sub-environment and number."""
    found = {}
    if channels.start is not None and gathered.pieces.get(channels.start):
        for _, _, body in messages(gathered.store(), channels.start):
            try:
                start = EpisodeStart.decode(body)
            except FormatError:
                continue
            found[start.env, start.episode] = start.first_row
    return found


def _add_rows(
    gathered: Gathered,
    journal: JournalContents,
    layout: StepLayout,
    env: int,
    channel: int,
    starts: dict[tuple[int, int], int],
) -> tuple[bytes | None, int]:
    """Takes the steps of a sub-environment; returns its running state, and the row after the last one committed."""
    dtype = layout.step_message.dtype
    committed = CommittedRows(journal, "steps", env, dtype, channel)
    pieces = []
    for rows in rows_among(committed, gathered.lacks(channel, committed.numbers)):
        first = int(rows["#sequence"][0])
        last = _row_before(gathered, channel, first, dtype)
        RowDeriver(*last).fill(rows)
        begun = starts.get((env, int(rows["episode"][0])))
        if begun is not None and begun <= first:
            same = int(np.argmin(np.append(rows["episode"] == rows["episode"][0], False)))
            rows["step"][:same] = first - begun + np.arange(same)
        pieces.append(_piece(gathered, first, len(rows), rows.view(np.uint8).tobytes()))
    gathered.add(channel, pieces)
    stop = _stop(gathered, channel)
    finals = {(env, hole.row): hole for hole in committed.finals(layout.state_end) if hole.row <= stop}
    gathered.finals |= finals
    if layout.images and (env, stop) in finals:  # the image that is running is the next state's
        return None, committed.end
    return committed.following(stop - 1, layout.state_end), committed.end


def _row_before(gathered: Gathered, channel: int, first: int, dtype: np.dtype[Any]) -> tuple[int, int, int]:
    """Episode, step and time (ns) of the row before one, where it is here."""
    pieces = gathered.pieces.get(channel, [])
    at = bisect.bisect_left(pieces, first, key=lambda piece: piece.stop)
    if at == len(pieces) or pieces[at].stop != first:
        return -1, -1, 0
    row = np.frombuffer(gathered.loaded[pieces[at].number], dtype)[-1]
    return int(row["episode"]), int(row["step"]), int(row["#log_time"])


def _add_images(
    gathered: Gathered, committed: CommittedRows, leaf: Leaf, channel: int, stop: int
) -> bytes | None:
    """Takes the images of steps before `stop`; returns the running state's."""
    pieces = []
    wanted = gathered.lacks(channel, committed.numbers) & (committed.numbers < stop)
    for rows in rows_among(committed, wanted):
        rows["#publish_time"] = rows["#log_time"]
        first = int(rows["#sequence"][0])
        pieces.append(_piece(gathered, first, len(rows), rows.view(np.uint8).tobytes()))
    gathered.add(channel, pieces)
    running = committed.row(stop)
    data: bytes | None = None if running is None else leaf.as_values(running["data"]).tobytes()
    return data
