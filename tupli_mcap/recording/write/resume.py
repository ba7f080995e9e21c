"""Going on with a recording: its tail (index, summary) is cut off, everything before it stays as it is."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tupli_mcap.environment import DOCUMENT_NAME, PICKLE_NAME
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.journal.file import journal_info, journal_path, recorded_journal
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.records import CHUNK_HEAD, check_magic, has_summary, read_attachment
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.messages.images.codecs import image_codecs
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import parse
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns, Run
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY
from tupli_mcap.recording.contents import RECORDING_METADATA, Contents, step_channels
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.opened import read_contents
from tupli_mcap.recording.recover.evidence import head, metadata_at
from tupli_mcap.recording.recover.from_journal import belongs, misplaced_journal
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.recording.write.place import RecordingPlace

_MOST_EPISODES = 1 << 31  # their numbers have 32 bits, and as many may follow


def resume(
    path: Path, options: RecordOptions, format_version: str, place: RecordingPlace, container: Container
) -> tuple[Contents, IndexBuilder, StepLayout | None, dict[str, tuple[str, bytes]]]:
    """Reads what a file (already locked) holds: a finished one, or one whose writer was killed. Sets `place` and
    `container` to go on behind it.

    Returns:
        What the file holds, the index of its episodes, its layout (None if it has no step), and attachments that are
        added, or replaced, with the first step.

    Raises:
        FormatError: the file is no recording.
        RecordingError: it belongs to another benchmark, is signed, or has no room for further episodes.
    """
    with contextlib.closing(PathSource(path)) as source:
        check_magic(source)
        if not has_summary(source):
            _check_journal(path, head(source))
        contents = read_contents(source)
        asked, found = options.benchmark_id, contents.metadata.get("benchmark_id", "")
        if asked and asked != found:
            raise RecordingError(
                f"{path} holds episodes of benchmark {found or 'none'!r}, not {asked!r}; record to another file"
            )
        if SIGNATURE_NAME in contents.attachments:
            raise RecordingError(
                f"{path} is signed, and appending would make its signature invalid; record to another file"
            )
        if contents.next_episode > _MOST_EPISODES:
            raise RecordingError(
                f"{path}: expected numbers of episodes up to {_MOST_EPISODES}, found {contents.next_episode - 1}; "
                "record to another file"
            )
        _check_nothing_behind(path, contents, source)
        _check_aligned(path, contents)
        _restore_place(place, path, options, contents)
        restore_container(container, contents, source)
        container.position = contents.data_end
        episodes, given = IndexBuilder(contents.index), options.attachments or {}
        runs = _more_runs(given, contents, source, episodes.count)
    known = set(contents.attachments)
    # The two halves of an environment: one that was lost is not made up for by half of another environment.
    parts = {DOCUMENT_NAME, PICKLE_NAME}
    known |= parts if known & parts else set()
    if episodes.count:  # the run that begins now says nothing of these
        known.add(RUN_NAME)
    arriving = {name: a for name, a in given.items() if name not in known} | runs
    steps = step_channels(container.channels, source.name)
    if not steps:
        if contents.metadata["format_version"] < format_version:
            raise RecordingError(
                f"{path} was begun in format version {contents.metadata['format_version']}, holds no step, and "
                f"cannot hold what needs version {format_version}; record to another file"
            )
        return contents, episodes, None, arriving
    layout = StepLayout.from_metadata(steps[0].metadata)
    container.codecs = image_codecs(layout, container.channels)
    return contents, episodes, layout, arriving


def _check_journal(path: Path, metadata: Mapping[str, str]) -> None:
    """Refuses to finish a recording without the steps that only its journal holds, where that is to be found.

    And to take the journal from another copy of the recording, which still needs it.
    """
    misplaced = misplaced_journal(path, metadata)
    if misplaced is not None:
        raise RecordingError(
            f"{path} was renamed without its journal {misplaced}, whose steps would be lost; "
            f"rename that to {journal_path(path).name} first"
        )
    if "journal" not in metadata:
        return
    with contextlib.suppress(OSError, FormatError):
        info = journal_info(Path(metadata["journal"]))
        owner = Path(str(info.get("recording", "")))
        if belongs(info, metadata) and owner != Path(os.path.realpath(path)) and _is_same(owner, metadata):
            raise RecordingError(
                f"{path} is a copy of {owner}, which still needs the journal {metadata['journal']} that both name; "
                "finish that one first (recover it, or append to it)"
            )


def _is_same(path: Path, metadata: Mapping[str, str]) -> bool:
    """Whether the file at a path is a copy of the same recording."""
    with contextlib.suppress(RecordingError, FormatError):  # gone: this one was moved; or damaged
        return metadata_at(path).get("uuid") == metadata["uuid"]
    return False


def _check_nothing_behind(path: Path, contents: Contents, source: Source) -> None:
    """What lies behind the end is cut off: the torn record of a killed writer, but not good rows behind damage."""
    if contents.complete or source.size == contents.data_end:
        return
    from tupli_mcap.recording.recover.damaged import gather, read_file_end
    from tupli_mcap.recording.recover.from_journal import add_journal

    evidence = gather(source, read_file_end(source))
    add_journal(evidence)
    for channel in contents.channels:
        kept = int(contents.table["rows"][contents.table["channel"] == channel].sum())
        found = sum(stop - first for first, stop in evidence.ranges(channel))
        if found > kept:
            raise RecordingError(
                f"{path} is damaged at offset {contents.data_end}: appending would lose {found - kept} "
                f"message(s) of {contents.channels[channel].topic} behind it; {_recover(path)} "
                "writes all that is whole to a new file, which can be appended to"
            )


def _check_aligned(path: Path, contents: Contents) -> None:
    """New rows must go on where the old ones end.

    A power loss, or a lost journal, may leave steps without images, or frames without the steps that they show.
    """
    counts: dict[int, int] = {}
    for number, rows in contents.table[["channel", "rows"]].tolist():
        counts[number] = counts.get(number, 0) + rows
    topics = {channel.topic: channel.id for channel in contents.channels.values()}
    for name in topics:
        topic = parse(name)
        if topic is not None and topic.kind == "image":
            pictures, rows = name, topic.topics.step
        elif topic is not None and topic.kind == "frame":
            pictures, rows = topic.topics.camera(topic.name), name
        else:
            continue
        found, expected = (counts.get(topics.get(each, 0), 0) for each in (pictures, rows))
        if found != expected:
            raise RecordingError(
                f"{path} lost its end: expected {expected} pictures in {pictures}, found {found}; "
                f"{_recover(path)} writes what is whole to a new file, which can be appended to"
            )


def _recover(path: Path) -> str:
    """The command that saves what is whole."""
    return f'"tupli-mcap recover {shlex.quote(str(path))}"'


def _more_runs(
    attachments: Mapping[str, tuple[str, bytes]], contents: Contents, source: Source, episodes: int
) -> dict[str, tuple[str, bytes]]:
    """`run.json` with the run that begins now, behind some episodes; empty if it goes on with the last one, or the one
    that is there is damaged. Episodes of a file without one are of a run of which nothing is known."""
    given, recorded = attachments.get(RUN_NAME), contents.attachments.get(RUN_NAME)
    if given is None or not (recorded or episodes):
        return {}
    earlier = RecordedRuns([Run()])
    try:
        if recorded is not None:
            earlier = RecordedRuns.from_json(read_attachment(source, recorded), f"{source.name}: {RUN_NAME}")
    except FormatError:
        return {}
    run = RecordedRuns.from_json(given[1], RUN_NAME).runs[-1]
    runs = earlier.followed_by(run, episodes)
    return {} if runs is earlier else {RUN_NAME: (RUN_MEDIA_TYPE, runs.to_json())}


def _restore_place(place: RecordingPlace, path: Path, options: RecordOptions, contents: Contents) -> None:
    """The file says where its journal is; a reader would look for it there."""
    place.uuid = contents.metadata["uuid"]
    place.rewritten = contents.metadata.get("rewritten", "")
    place.replaced = contents.metadata.get("replaced", "")
    recorded, given = contents.metadata.get("journal"), options.journal_dir
    if given is not None and (recorded is None or Path(given).resolve() != Path(recorded).parent):
        raise RecordingError(
            f"{path}: its journal belongs {'beside it' if recorded is None else f'at {recorded}'}, not into "
            f"{given}; leave journal_dir out when appending"
        )
    if recorded is not None:
        place.journal = recorded_journal(path, contents.metadata)


def restore_container(
    container: Container, contents: Contents, source: Source, left_out: Sequence[tuple[int, int]] = ()
) -> None:
    """Lets a container go on behind what a file holds; its position is the caller's to set.

    Args:
        container, contents, source: the container, and the file.
        left_out: (offset, length) of records of the file that the container does not get; those behind them move ahead.

    Raises:
        FormatError: the file's channels are not numbered from 1, or a chunk is of none of them.
        RecordingError: another program has added something behind the episode index, where the file is cut off.
    """

    def moved(offset: int) -> int:
        return offset - sum(length for at, length in left_out if at < offset)

    places = [(each.offset, each.name) for each in contents.attachments.values()]
    places += [(each.offset, each.name) for each in contents.metadata_indexes]
    behind = [name for offset, name in places if offset > contents.data_end]
    if behind:
        raise RecordingError(
            f"{source.name}: another program has added {behind[0]!r:.80} behind the episode index, where it would be "
            f"lost; {_recover(Path(source.name))} writes all episodes and what was added to a new file"
        )
    container.schemas = dict(sorted(contents.schemas.items()))
    container.channels = dict(sorted(contents.channels.items()))
    if list(container.channels) != list(range(1, len(container.channels) + 1)):
        raise FormatError(
            f"{source.name}: expected channels numbered from 1, found {list(container.channels)}"
        )
    unknown = set(contents.table["channel"].tolist()) - container.channels.keys()
    if unknown:
        raise FormatError(
            f"{source.name}: expected chunks of channels {list(container.channels)}, "
            f"found one of channel {min(unknown)}"
        )
    container.counts = dict.fromkeys(container.channels, 0)
    container.attachment_indexes = [replace(a, offset=moved(a.offset)) for a in contents.attachments.values()]
    container.metadata_indexes = [replace(m, offset=moved(m.offset)) for m in contents.metadata_indexes]
    container.metadata = {RECORDING_METADATA: contents.metadata}
    for row in contents.table[contents.table["offset"] < IN_MEMORY].tolist():
        head = source.read(row[0], CHUNK_HEAD.size)
        _, _, start, end, *_ = CHUNK_HEAD.unpack(head)
        container.note_chunk((moved(row[0]), *row[1:]), start, end)
