"""Recovery in memory: the journal first, then the file's valid prefix; what the writer could not finish is derived.

Nothing is written. Repeating it changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.messages.layout import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.chunks import IN_MEMORY, ChunkStore
from tupli_mcap.recording.container import CHUNK_ROWS, Rows
from tupli_mcap.recording.contents import RECORDING_METADATA, Contents, check_metadata, step_channels
from tupli_mcap.recording.events import INTERRUPTED, EpisodeEnd, EpisodeStart, record
from tupli_mcap.recording.index import EpisodeIndex, EpisodeRow, IndexBuilder
from tupli_mcap.recording.journal import (
    JournalContents,
    LogArea,
    RowArea,
    journal_info,
    read_journal,
    recorded_journal,
)
from tupli_mcap.recording.salvage import (
    Salvage,
    committed_rows,
    image_rows,
    log_records,
    running_record,
    to_rows,
)
from tupli_mcap.recording.scan import Scan, is_ours, scan
from tupli_mcap.recording.source import Source
from tupli_mcap.recording.summary import foreign, has_summary, parse_record, records
from tupli_mcap.system import refused

__all__ = ["belongs", "define", "find_journal", "head", "misplaced_journal", "recover_contents"]


@dataclass
class _Tail:
    """What the journal adds to the file, as rows that are not in it; `pending` are states by sub-environment."""

    rows: list[Rows] = field(default_factory=list)
    pending: dict[int, bytes] = field(default_factory=dict)
    left_out: int = 0  # steps in the journal that a power loss may have torn


def head(source: Source) -> dict[str, str]:
    """The metadata of a recording, from its first records. Raises FormatError if they are missing or not ours."""
    found = scan(source, only_metadata=True)
    if RECORDING_METADATA not in found.metadata:
        if is_ours(found) or found.profile == "":
            raise FormatError(
                f"{source.name}: the file is cut off or damaged before its first step; nothing can be read from it"
            )
        raise foreign(source, f"its profile is {found.profile!r}")
    return check_metadata(source, found.metadata[RECORDING_METADATA])


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
    if journal is not None:
        define(found.schemas, found.channels, journal, source.name)
    tail = _Tail()
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
    )
    steps = step_channels(found.channels, source.name)
    if steps:
        layout = StepLayout.from_metadata(steps[0].metadata)
        if journal is not None:
            _salvage(source, found, journal, layout, [c.id for c in steps], tail)
        _complete(source, found, layout, [c.id for c in steps], tail, contents)
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

    Raises:
        RecordingError: it is there and the system refuses to give it: without it steps would be missing.
    """
    if source.path is None:
        return None
    metadata = head(source)
    try:
        path = recorded_journal(source.path, metadata)
        return read_journal(path)
    except (FileNotFoundError, FormatError) as err:
        return err
    except OSError as err:
        raise RecordingError(
            f"{source.name} was not finished, and its journal {path.name} cannot be read: {refused(err)}"
        ) from err


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
        return f"{source.name}: its journal cannot be read ({err})"
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


def _table(found: Scan, memory: list[Rows]) -> np.ndarray[Any, Any]:
    extra = [
        (IN_MEMORY + i, 0, len(rows.data), rows.first, len(rows.offsets), 0, 0, rows.channel, 0, 0)
        for i, rows in enumerate(memory)
    ]
    return np.array([*found.chunks, *extra], CHUNK_ROWS)


def _salvage(
    source: Source, found: Scan, journal: JournalContents, layout: StepLayout, steps: list[int], tail: _Tail
) -> None:
    """Takes the rows and records the file does not have out of the journal."""
    store = ChunkStore(source, _table(found, tail.rows), [bytes(r.data) for r in tail.rows], 1 << 24)
    counts = dict(found.counts)
    for env, channel in enumerate(steps):
        first = counts.get(channel, 0)
        if layout.constant:
            area = _rows_area(journal, "steps")
            salvage = Salvage(journal, area, env, layout.step_message.dtype, channel)
            last = None
            if first:
                span = next(iter(store.spans(channel, first - 1, 1)))
                last = store.rows(span.chunk, layout.step_message.dtype)[span.begin]
            rows, _ = committed_rows(salvage, first, channel, last)
            total = first + (0 if rows is None else len(rows.offsets))
            tail.left_out += salvage.left_out
            following = salvage.following(total - 1, layout.state_end)
            if following is not None:
                tail.pending[env] = following
        else:
            log = _log_area(journal, f"steps/{env}")
            entries = [e for e in log_records(journal, log, {channel: first}) if e[0] == channel]
            rows = to_rows(entries)[0] if entries else None
            total = first + len(entries)
            state = running_record(journal, log, total, layout)
            if state is not None:
                tail.pending[env] = state
        if rows is not None:
            tail.rows.append(rows)
        _salvage_images(found, journal, layout, env, total, tail)
    for name in ("events", "info"):
        if name in journal.areas:
            tail.rows += to_rows(log_records(journal, _log_area(journal, name), counts))


def _rows_area(journal: JournalContents, name: str) -> RowArea:
    area = journal.areas.get(name)
    if not isinstance(area, RowArea):
        raise FormatError(f"the journal has no rows {name!r}")
    return area


def _log_area(journal: JournalContents, name: str) -> LogArea:
    area = journal.areas.get(name)
    if not isinstance(area, LogArea):
        raise FormatError(f"the journal has no records {name!r}")
    return area


def _salvage_images(
    found: Scan, journal: JournalContents, layout: StepLayout, env: int, steps: int, tail: _Tail
) -> None:
    for leaf in layout.images:
        (step,) = (
            c.topic
            for c in found.channels.values()
            if c.topic.endswith("/step") and c.metadata.get("env") == str(env)
        )
        wanted = f"{step.removesuffix('/step')}/image/{leaf.name}"
        channel = next((c.id for c in found.channels.values() if c.topic == wanted), None)
        if channel is None:
            raise FormatError(f"expected a channel {wanted} in the journal, found none")
        dtype = layout.image_messages[leaf.name].dtype
        area = _rows_area(journal, f"{leaf.name}/{env}")
        salvage = Salvage(journal, area, 0, dtype, channel, rewritten=True)  # by resets
        rows = image_rows(salvage, found.counts.get(channel, 0), steps, channel)
        if rows is not None:
            tail.rows.append(rows)
        pending = salvage.row(steps)
        if pending is None:
            tail.pending.pop(env, None)
        elif env in tail.pending:
            tail.pending[env] += pending["data"].tobytes()


class _Episodes:
    """Starts and ends found so far, and the ends that have to be made."""

    def __init__(self, store: ChunkStore, topics: dict[str, int]) -> None:
        self.starts: dict[int, tuple[int, int, EpisodeStart]] = {}
        self.ends: dict[int, tuple[int, int, EpisodeEnd]] = {}
        self.finals: dict[int, int] = {}
        for row, (time, body) in enumerate(_messages(store, topics["/episode_start"])):
            start = EpisodeStart.decode(body)
            self.starts[start.episode] = (row, time, start)
        for row, (time, body) in enumerate(_messages(store, topics["/episode_end"])):
            end = EpisodeEnd.decode(body)
            self.ends[end.episode] = (row, time, end)
        for row, (_, body) in enumerate(_messages(store, topics["/final_state"])):
            self.finals[int.from_bytes(body[:4], "little")] = row


def _messages(store: ChunkStore, channel: int) -> Iterator[tuple[int, memoryview]]:
    for chunk in store.chunks(channel):
        data = memoryview(store.load(chunk))
        for start, end in store.messages(chunk):
            yield int.from_bytes(data[start + 15 : start + 23], "little"), data[start + BODY : end]


def _complete(
    source: Source, found: Scan, layout: StepLayout, steps: list[int], tail: _Tail, contents: Contents
) -> None:
    """Makes the missing ends of episodes, and the index."""
    topics = {c.topic: c.id for c in found.channels.values()}
    missing = [t for t in ("/episode_start", "/episode_end", "/final_state") if t not in topics]
    if missing:
        return
    store = ChunkStore(source, _table(found, tail.rows), [bytes(r.data) for r in tail.rows], 1 << 26)
    episodes = _Episodes(store, topics)
    available = [_available(store, topics, layout, found.channels[channel]) for channel in steps]
    tail.left_out += sum(map(store.count, steps)) - sum(available)
    made: list[tuple[int, int, int, bytes]] = []
    counts = {topics[t]: store.count(topics[t]) for t in ("/episode_start", "/episode_end", "/final_state")}
    for number, (_, _, end) in list(episodes.ends.items()):
        if end.env >= len(steps) or end.first_row + end.length > available[end.env]:
            del episodes.ends[number]  # its steps were lost with the end of the file
    for start, time in _unstarted(store, layout, steps, available, set(episodes.starts)):
        channel = topics["/episode_start"]
        made.append((channel, counts[channel], time, record(channel, counts[channel], time, start.encode())))
        episodes.starts[start.episode] = (counts[channel], time, start)
        counts[channel] += 1
    for number in sorted(set(episodes.starts) - set(episodes.ends)):
        _, _, start = episodes.starts[number]
        facts = _rows_of(store, layout, steps, available, start, number)
        if facts is None:
            continue  # a reset without a step is no episode
        length, total, how, end_time = facts
        if how == INTERRUPTED:  # what is there is that of a later step, which was lost
            episodes.finals.pop(number, None)
        if (
            number not in episodes.finals
            and start.env in tail.pending
            and start.first_row + length == available[start.env] == store.count(steps[start.env])
        ):
            channel = topics["/final_state"]
            body = number.to_bytes(4, "little") + start.env.to_bytes(4, "little") + tail.pending[start.env]
            made.append(
                (channel, counts[channel], end_time, record(channel, counts[channel], end_time, body))
            )
            episodes.finals[number] = counts[channel]
            counts[channel] += 1
        channel = topics["/episode_end"]
        message = EpisodeEnd(
            number, start.env, start.first_row, length, total, how, number in episodes.finals, "{}"
        )
        made.append(
            (channel, counts[channel], end_time, record(channel, counts[channel], end_time, message.encode()))
        )
        episodes.ends[number] = (counts[channel], end_time, message)
        counts[channel] += 1
    tail.rows += to_rows(made)
    contents.memory = [bytes(rows.data) for rows in tail.rows]
    contents.table = _table(found, tail.rows)
    contents.tail = tail.rows
    contents.index = _index(episodes, contents.table)


def _index(episodes: _Episodes, table: np.ndarray[Any, Any]) -> EpisodeIndex:
    builder = IndexBuilder()
    for number in sorted(episodes.ends):
        if number not in episodes.starts:
            continue
        start_row, start_time, start = episodes.starts[number]
        end_row, end_time, end = episodes.ends[number]
        seed = start.seed_number
        final = episodes.finals.get(number, -1) if end.has_final_state else -1
        row = EpisodeRow(
            end.first_row, end.length, end.episode_return, start_time, end_time, seed, start_row, end_row, final,
            number, end.env, end.end,
        )  # fmt: skip
        builder.add(row, end.metadata)
    return EpisodeIndex.decode(builder.encode(table.tobytes()), "recovered index")


def _unstarted(
    store: ChunkStore, layout: StepLayout, steps: list[int], available: list[int], known: set[int]
) -> Iterator[tuple[EpisodeStart, int]]:
    """Starts made for episodes that have steps but lost their `/episode_start` (with the journal), and their times."""
    for env, channel in enumerate(steps):
        row, last = 0, -1
        for episode, _, _, time in _step_facts(store, layout, channel, 0, available[env]):
            if episode != last and episode not in known:
                yield EpisodeStart(episode, env, row, False, False, "", "", "{}"), time
            row, last = row + 1, episode


def _available(store: ChunkStore, topics: dict[str, int], layout: StepLayout, channel: Channel) -> int:
    """Steps of a sub-environment that are whole: of which all images are there."""
    top = channel.topic.removesuffix("/step")
    images = [topics.get(f"{top}/image/{leaf.name}", 0) for leaf in layout.images]
    return min(store.count(one) for one in (channel.id, *images))


def _rows_of(
    store: ChunkStore,
    layout: StepLayout,
    steps: list[int],
    available: list[int],
    start: EpisodeStart,
    number: int,
) -> tuple[int, float, int, int] | None:
    """(length, return, end, time of the last step) of an episode without an end; None if it has no step."""
    if start.env >= len(steps):
        return None
    channel = steps[start.env]
    count = available[start.env] - start.first_row
    if count <= 0:
        return None
    total, length, last, time = 0.0, 0, (False, False), 0
    for episode, reward, flags, at in _step_facts(store, layout, channel, start.first_row, count):
        if episode != number:
            break
        total, length, last, time = total + reward, length + 1, flags, at
        if any(flags):
            break
    if not length:
        return None
    return length, total, 0 if last[0] else 1 if last[1] else 2, time


def _step_facts(
    store: ChunkStore, layout: StepLayout, channel: int, first: int, count: int
) -> Iterator[tuple[int, float, tuple[bool, bool], int]]:
    names = [leaf.name for leaf in layout.reward]
    if layout.constant:
        for span in store.spans(channel, first, count):
            rows = store.rows(span.chunk, layout.step_message.dtype)[span.begin : span.end]
            rewards = sum(rows[name].reshape(len(rows), -1).sum(axis=1, dtype=np.float64) for name in names)
            yield from zip(
                rows["episode"].tolist(),
                np.asarray(rewards).tolist(),
                zip(rows["terminal"].tolist(), rows["timeout"].tolist(), strict=True),
                rows["#log_time"].tolist(),
                strict=True,
            )
        return
    from tupli_mcap.messages.decoder import MessageDecoder

    decoder = MessageDecoder(layout)
    for span in store.spans(channel, first, count):
        data = memoryview(store.load(span.chunk))
        for start, end in store.messages(span.chunk)[span.begin : span.end]:
            values = decoder.step(data[start + BODY : end])
            reward = float(sum(np.sum(values[name]) for name in names))
            time = int.from_bytes(data[start + 15 : start + 23], "little")
            yield values["episode"], reward, (values["terminal"], values["timeout"]), time
