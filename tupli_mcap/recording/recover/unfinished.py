"""Recovers an unfinished recording in memory: reads the journal, then the file's valid prefix, and derives the rest.

Nothing is written, and to do it again gives the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, warn
from tupli_mcap.journal.committed import size_behind
from tupli_mcap.journal.file import JournalContents, recorded_journal
from tupli_mcap.journal.logs import joined_rows
from tupli_mcap.mcap.container import CHUNK_ROWS, Rows
from tupli_mcap.mcap.records import has_summary
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.episodes import record
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import parse
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY
from tupli_mcap.recording.contents import Contents, step_channels
from tupli_mcap.recording.index import EPISODE_ROWS, EpisodeIndex, EpisodeRow, IndexBuilder
from tupli_mcap.recording.recover.episodes import IN_A_HOLE, RUNNING, PlannedEpisode, final_state, make_plan
from tupli_mcap.recording.recover.evidence import (
    Evidence,
    PackedStore,
    RecordedChannels,
    head,
    memory_entry,
    prefix,
)
from tupli_mcap.recording.recover.from_journal import belongs, find_journal, misplaced_journal, take_journal


def recover_contents(source: Source, found: JournalContents | Exception) -> Contents:
    """The contents of a recording that has no summary.

    Args:
        source: the file.
        found: the result of `find_journal`, which must come first: a live writer moves rows from the journal to the
            file.

    Raises:
        FormatError: it is no recording of this package, or its first records are damaged.
    """
    metadata = head(source)
    evidence = prefix(source)
    evidence.metadata = metadata
    defined = set(evidence.channels)
    journal: JournalContents | None = None
    if isinstance(found, Exception):
        if defined:  # without channels there is no step, and no journal
            _check_unchanged(source)
            warn(_missing(source, metadata, found))
    elif belongs(found.info, metadata):
        journal = found
    elif defined:  # stale: of another recording with this name
        place = None if source.path is None else recorded_journal(source.path, metadata)
        warn(
            f"{source.name} was not finished, and {place} is the journal of another recording: it is left alone, "
            "and steps not yet in a chunk cannot be recovered"
        )
    if journal is not None:
        take_journal(evidence, journal)
    contents = Contents(
        metadata,
        evidence.schemas,
        evidence.channels,
        evidence.attachments,
        evidence.metadata_indexes,
        complete=False,
        data_end=evidence.good_end,
        undefined=sorted(set(evidence.channels) - defined),
    )
    steps = step_channels(evidence.channels, source.name)
    if steps:
        layout = StepLayout.from_metadata(steps[0].metadata)
        channels = RecordedChannels.of(evidence, layout)
        _complete(evidence, layout, channels, contents)
        topics = {channel.id: parse(channel.topic) for channel in evidence.channels.values()}
        tellers = [number for number, topic in topics.items() if topic is not None and topic.kind == "frame"]
        if channels.info is not None and (journal is None or journal.torn):
            tellers.append(channels.info)
        contents.used_episodes = max(contents.used_episodes, _beyond(PackedStore(evidence), tellers))
        if journal is not None:
            for text in _left_out(evidence, journal, channels):
                warn(text)
    return contents


def _complete(evidence: Evidence, layout: StepLayout, channels: RecordedChannels, contents: Contents) -> None:
    """Makes the missing starts and ends of episodes, and the index."""
    if channels.start is None or channels.end is None or channels.final is None:
        return
    store = PackedStore(evidence)
    plan = make_plan(evidence, store, layout, channels)
    contents.used_episodes = max((number + 1 for number in plan.records.ignored), default=0)
    episodes = [e for e in plan.episodes if e.head and e.number == e.run.episode]
    made = _Made(store)
    starts = {e.number: (e.start.row, e.start.time) for e in episodes if e.start.row is not None}
    for e in sorted(episodes, key=lambda e: (e.start.time, e.number)):
        if e.number not in starts:
            body = e.start.start._replace(first_row=e.run.row).encode()
            starts[e.number] = made.add(channels.start, e.start.time, body)
    places: dict[int, tuple[int, int, int]] = {}  # row and time of the end, row of the final state
    for e in sorted(episodes, key=lambda e: (e.end.time, e.number)):
        row, time, final = e.end.row, e.end.time, e.final
        if final in (RUNNING, IN_A_HOLE):
            final, _ = made.add(channels.final, time, final_state(evidence, e))
        if row is None:
            row, time = made.add(channels.end, time, e.end.end._replace(first_row=e.run.row).encode())
        places[e.number] = row, time, -1 if final is None else final
    in_memory = [place for place in evidence.loaded.places if isinstance(place, Rows)]
    contents.tail = sorted([*in_memory, *made.rows()], key=lambda rows: (rows.channel, rows.first))
    entries = sorted(piece.entry for pieces in evidence.pieces.values() for piece in pieces)
    in_file = [entry for entry in entries if entry[0] < IN_MEMORY]
    extra = [
        memory_entry(i, rows.channel, rows.first, len(rows.offsets), len(rows.data))
        for i, rows in enumerate(contents.tail)
    ]
    contents.table = np.array([*in_file, *extra], CHUNK_ROWS)
    contents.index = _index(episodes, starts, places, contents.table)
    contents.endless = {e.number for e in episodes if e.end.row is None}


class _Made:
    """Messages that the writer did not write; they follow the others of their channels."""

    def __init__(self, store: PackedStore) -> None:
        self._store = store
        self._next: dict[int, tuple[int, int]] = {}  # by channel: row of the next message, time of the last
        self._records: dict[int, list[bytes]] = {}

    def add(self, channel: int, time: int, body: bytes) -> tuple[int, int]:
        """Adds a message; returns its row, and its time: `time`, or the latest of its channel if that is later.

        Channels do not affect each other, so that the result is the same after an earlier recovery was cut short.
        """
        if channel not in self._next:
            count, latest = self._store.count(channel), 0
            if count:
                ((latest, _),) = self._store.messages(channel, count - 1, 1)
            self._next[channel] = count, latest
        row, latest = self._next[channel]
        time = max(time, latest)
        self._records.setdefault(channel, []).append(record(channel, row, time, body))
        self._next[channel] = row + 1, time
        return row, time

    def rows(self) -> list[Rows]:
        """All messages."""
        return [
            joined_rows(channel, self._next[channel][0] - len(made), made, sealed=False)
            for channel, made in self._records.items()
        ]


def _beyond(store: PackedStore, channels: Iterable[int]) -> int:
    """A number above those of the episodes that the infos or frames in some channels are of, whose steps may be
    lost."""
    bodies = (body for channel in channels for _, _, body in store.all_messages(channel))
    return max((NUMBERS.unpack_from(body)[0] + 1 for body in bodies if len(body) >= NUMBERS.size), default=0)


def _index(
    episodes: list[PlannedEpisode],
    starts: dict[int, tuple[int, int]],
    places: dict[int, tuple[int, int, int]],
    table: Array,
) -> EpisodeIndex:
    builder = IndexBuilder()
    for episode in sorted(episodes, key=lambda episode: episode.number):
        (start_row, start_time), (end_row, end_time, final) = starts[episode.number], places[episode.number]
        end = episode.end.end
        row = EpisodeRow(
            episode.run.row, end.length, end.episode_return, start_time, end_time, episode.start.start.seed_number,
            start_row, end_row, final, episode.number, end.env, end.end,
        )  # fmt: skip
        builder.add(row, end.metadata)
    rows = np.frombuffer(bytes(builder.rows), EPISODE_ROWS)
    return EpisodeIndex(rows, table, bytes(builder.metadata))


def _left_out(evidence: Evidence, journal: JournalContents, channels: RecordedChannels) -> Iterator[str]:
    """Warnings that say how many steps and which records are missing, and why."""
    name = evidence.source.name
    for channel, steps in evidence.beyond.items():
        if steps and not journal.torn:
            yield (
                f"{name}: the last {steps} step(s) of {evidence.channels[channel].topic} are left out, because steps "
                "before them are missing: the file is damaged, or was copied before its journal (while a recording is "
                "made, copy the journal first)"
            )
    missing = size_behind(journal) - evidence.good_end
    if missing > 0:
        yield (
            f"{name} ends {missing} bytes before the place where its journal goes on: ends of episodes and final "
            "states are missing; while a recording is made, copy first its journal, then the file"
        )
    steps = sum(evidence.left_out.values())
    for env, channel in enumerate(channels.steps):
        images = (ids[env] for ids in channels.images.values())
        whole = min(
            (evidence.stop(image) for image in images if image is not None), default=evidence.stop(channel)
        )
        steps += max(0, evidence.stop(channel) - whole)
    if steps and journal.torn:
        yield (
            f"{name}: the machine that recorded it was restarted afterwards, or this is another machine: {steps} "
            "step(s) in its journal cannot be shown to be whole and are left out; on the machine and boot that "
            'recorded it, they can be read: finish the recording there, with "tupli-mcap recover --in-place", or by '
            "appending to it"
        )


def _check_unchanged(source: Source) -> None:
    """Raises FormatError if a writer has made the journal or finished the file in the meantime."""
    source.refresh()
    if has_summary(source) or isinstance(find_journal(source), JournalContents):
        raise FormatError(f"{source.name} was changed while it was read; read it again")


def _missing(source: Source, metadata: Mapping[str, str], err: Exception) -> str:
    if not isinstance(err, FileNotFoundError):
        return (
            f"{source.name} was not finished, and its journal is not looked for: steps not yet in a chunk cannot be "
            f"recovered ({err})"
        )
    expected = Path(str(err.filename))
    elsewhere = None if source.path is None else misplaced_journal(source.path, metadata)
    if elsewhere is not None:
        what = f"{elsewhere} is its journal: rename that to {expected.name}"
    elif "journal" in metadata:
        what = f"its journal was {expected}: bring that back"
    else:
        what = "keep the two files together, or fetch the recording again if it was cut off"
    return (
        f"{source.name} was not finished and has no journal {expected.name} beside it: steps not "
        f"yet in a chunk cannot be recovered; {what}"
    )
