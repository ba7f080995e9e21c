"""Merges several recordings into one."""

from __future__ import annotations

import contextlib
import heapq
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap import files
from tupli_mcap.arrays import Array
from tupli_mcap.environment import DOCUMENT_NAME, PICKLE_NAME, EnvironmentRecord
from tupli_mcap.errors import RecordingError, SpaceError, taken, warn
from tupli_mcap.journal.derive import LAST_ROW
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.source import OpenFiles
from tupli_mcap.messages.images.codecs import png_leaves
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.topics import INFO, Topics, parse
from tupli_mcap.recording.about.annotations import ANNOTATIONS_NAME
from tupli_mcap.recording.about.described import MADE_OF_NAME
from tupli_mcap.recording.about.run import RUN_NAME
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.edit.assemble import Assembler, copying, replacing
from tupli_mcap.recording.edit.copy_episodes import EpisodeCopier, NewValues, Trim
from tupli_mcap.recording.edit.rewrite import (
    all_camera_channels,
    carry_runs,
    define,
    new_metadata,
    say_made_of,
    warn_of_signatures,
)
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import STATEMENTS
from tupli_mcap.recording.write.options import check_name
from tupli_mcap.remote import shown_name
from tupli_mcap.spaces.labels import LABELS_MEDIA_TYPE, LABELS_NAME, common_labels

_MOST_TURNS = 100
_SPACES = ("observation_space", "action_space", "reward_space")


class MergeReport(NamedTuple):
    """The result of a merge, or of a dry run.

    Attributes:
        held: number of rows whose time was raised to that of the row ahead. Only frames that were rendered after the
            end of their episode can need it.
        copied: number of chunks that were copied unchanged.
        size: of the file (bytes); 0 if nothing was written.
    """

    path: Path
    recordings: int
    episodes: int
    steps: int
    held: int = 0
    copied: int = 0
    size: int = 0


class UnmergeableError(RecordingError):
    """The recordings cannot be merged."""


class Excerpt(NamedTuple):
    """Some episodes of a recording: rows of its index, in order.

    Attributes:
        trims: by number, the steps that stay of an episode.
        values: new values of steps.
        alone: the new recording tells nothing of the recording's other episodes, not even how many there are.
    """

    recording: Recording
    rows: Array
    trims: Mapping[int, Trim] = MappingProxyType({})
    values: NewValues | None = None
    alone: bool = False

    @property
    def next_episode(self) -> int:
        """The least number that a further episode may have."""
        return (
            int(self.rows["episode"].max()) + 1 if self.alone else self.recording.file.contents.next_episode
        )


def merge_recordings(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    *,
    compression: str = "zstd",
    overwrite: bool = False,
    dry_run: bool = False,
    positions: Callable[[Recording], Array] | None = None,
) -> MergeReport:
    """Writes one recording, with a new UUID, of the episodes of several, in the order of their times.

    It keeps infos, frames, images, final states, metadata, runs and attachments, but no signature and no certificate,
    which would not fit; it warns of the first, and of a recording that was made of another one. Each step has the infos
    that were recorded of it. Episodes get new numbers, times stay. Recordings that were made at the same time, that
    took turns a hundred times, or that have different numbers of sub-environments, become different sub-environments;
    their episodes are numbered one recording after the other, and their runs tell them apart. The environment is that
    of the first recording; labels on which recordings differ are left out.

    Args:
        sources: paths of the recordings.
        target: path of the new one.
        compression: "zstd", "lz4" or "none".
        overwrite: replace a target that exists.
        dry_run: only check and report.
        positions: returns the positions of the episodes to merge; by default of all.

    Raises:
        SpaceError: they have different spaces or dtypes.
        RecordingError: one cannot be read, has an episode that another one has, or belongs to another benchmark;
            attachments of one name differ; the target exists (without `overwrite`) or cannot be written.
        FormatError: one is damaged.
    """
    check_name(target)
    target = Path(target)
    if isinstance(sources, str | os.PathLike) or not isinstance(sources, Iterable):
        raise RecordingError(f"expected a list of recordings to merge, found {sources!r:.80}")
    with contextlib.ExitStack() as stack:
        some_open = OpenFiles(copies=True)  # they may be more than can be open at once
        opened = [stack.enter_context(Recording(some_open.file(source))) for source in sources]
        check_target(target, opened, overwrite=overwrite)
        excerpts = [
            Excerpt(one, one.index if positions is None else one.index[positions(one)]) for one in opened
        ]
        parts = [(len(excerpt.rows), int(excerpt.rows["length"].sum())) for excerpt in excerpts]
        if not any(episodes for episodes, _ in parts):
            raise RecordingError("expected recordings with episodes to merge, found none")
        recordings = sum(episodes > 0 for episodes, _ in parts)
        warn_of_signatures(opened)
        _warn_of_repeated(opened)
        report = MergeReport(target, recordings, *(sum(counts) for counts in zip(*parts, strict=True)))
        if dry_run:
            check_mergeable(excerpts)
            return report
        with replacing(target, overwrite=overwrite) as (fd, _):
            merged = merge_excerpts(excerpts, Container(fd, str(target), compression))
    return report._replace(held=merged.held, copied=merged.copied, size=target.stat().st_size)


def _warn_of_repeated(sources: Sequence[Recording]) -> None:
    """Warns of recordings that were made of others among them. They may have other steps, so this is no error."""
    names = {source.uuid: shown_name(source.name) for source in sources}
    for source in sources:
        if of := sorted(names[uuid] for uuid in source.source_uuids & names.keys()):
            more = f" and {len(of) - 1} more" if len(of) > 1 else ""
            warn(
                f"{shown_name(source.name)} was made of {of[0]}{more}, and both are merged: their episodes are there "
                "twice; unless you want that, leave one of them out"
            )


def merge_excerpts(
    excerpts: Sequence[Excerpt],
    container: Container,
    without: Collection[str] = (),
    made: Mapping[str, Any] = MappingProxyType({"how": "merge"}),
    attachments: Mapping[str, tuple[str, bytes]] = MappingProxyType({}),
) -> Assembler:
    """Writes a recording of at least one excerpt, as `merge_recordings` does.

    Args:
        without: fields to leave out: "states", "actions", "infos", "frames".
        made: what `made_of.json` says about how it was made, besides the sources, trims and fields that are left out.
        attachments: name -> (media type, bytes), added to those of the recordings or replacing them.

    Raises:
        SpaceError: they have different spaces or dtypes.
        RecordingError, FormatError: as `merge_recordings`.
    """
    sources, carried = check_mergeable(excerpts, without)
    now, first = time.time_ns(), sources[0].recording
    turns = _turns(sources)
    lanes = _lanes(sources, turns=len(turns))
    if lanes is not None:
        turns = [(i, np.arange(len(source.rows))) for i, source in enumerate(sources)]
    numbered, next_episode = _numbered(sources, turns)
    codec = None if "infos" in without else _common_infos(sources)
    target = Assembler(container)
    trims = _new_trims(sources, turns, numbered)
    facts = {"without": sorted(without)} if without else {"how": "trim", "steps": trims} if trims else {}
    parts = [source.rows if source.alone else None for source in sources]
    said = say_made_of([source.recording for source in sources], parts=parts, **{**made, **facts})
    carried = {**carried, **carry_runs(numbered), **said, **attachments}
    target.begin(new_metadata(first, next_episode), carried, now)
    for source in sources:
        file = source.recording.file
        target.copy_metadata(file.source, file.contents.metadata_indexes)
    if lanes is None and not without and not _new_infos(first, codec):
        define(first, target)
    envs = _num_envs(sources, lanes)
    for source in sources:
        _define_missing(source.recording, container, envs, codec, without)
    container.define_channels()
    episodes, infos = [], []
    with copying([(source.recording.file, source.rows) for source in sources], container.name):
        for (i, _), (recording, rows, shift) in zip(turns, numbered, strict=True):
            lane = lanes[i] if lanes is not None else None
            channels = _channels(recording, container, lane)
            cameras = {
                name: [(channels[pictures], channels[pairs]) for pictures, pairs in pairs_of]
                for name, pairs_of in all_camera_channels(recording, container).items()
                if "frames" not in without
            }
            layout = recording.layout.without(without) if without else None
            copier = EpisodeCopier(
                recording, target, cameras, channels=channels, shift=shift, first_env=lane, layout=layout,
                infos=_new_infos(recording, codec), trims=sources[i].trims, values=sources[i].values,
            )  # fmt: skip
            episodes += copier.copy(rows)
            infos.append(copier.infos(rows))
        target.add_episodes(episodes)
        if lanes is not None:
            _add_infos(target, infos)
    target.finish(now)
    if target.held:
        warn(
            f"the times of {target.held:,} merged rows were raised to that of the row ahead, which was later"
        )
    return target


def _add_infos(target: Assembler, infos: Iterable[Iterator[tuple[int, bytes]]]) -> None:
    """Adds the infos of all sources, (log_time, body) of each, in the order of their times."""
    for channel in target.container.channels.values():
        if channel.topic == INFO:
            target.add_messages(channel.id, heapq.merge(*infos, key=itemgetter(0)))


def _num_envs(sources: Sequence[Excerpt], lanes: Sequence[int] | None) -> int | None:
    """How many sub-environments the merged recording has; None if it is not of a vector environment."""
    if lanes is not None:
        return max(lane + source.recording.num_envs for lane, source in zip(lanes, sources, strict=True))
    first = sources[0].recording
    return first.num_envs if first.is_vector else None


def check_mergeable(
    excerpts: Sequence[Excerpt], without: Collection[str] = ()
) -> tuple[list[Excerpt], dict[str, tuple[str, bytes]]]:
    """The excerpts with episodes, in the order of their times, and the attachments. Raises as `merge_excerpts` does."""
    sources = sorted((e for e in excerpts if len(e.rows)), key=lambda e: int(e.rows["start_time"].min()))
    _check_alike(sources, without)
    return sources, _attachments([source.recording for source in sources])


def _lanes(sources: Sequence[Excerpt], turns: int) -> list[int] | None:
    """The sub-environment that the first one of each source becomes; None if all keep their numbers.

    A channel holds one episode after the other, in the order of their times. So episodes that were recorded at the same
    time need different channels: recordings that overlap become different sub-environments, and one that begins
    when another one has ended takes its place. So do recordings that alternate too often: each turn of a recording
    ends a chunk and reads all of its infos.
    """
    alike = len({(recording.is_vector, recording.num_envs) for recording, *_ in sources}) == 1
    if alike and turns < max(_MOST_TURNS, len(sources) + 1) and not _overlap(sources):
        return None
    free: list[int] = []  # by sub-environment, when its last episode ends
    lanes = []
    for recording, rows, *_ in sources:  # in the order in which they begin
        begin, n = int(rows["start_time"].min()), recording.num_envs
        at = 0
        while any(end > begin for end in free[at : at + n]):
            at += 1
        free[at : at + n] = [int(rows["end_time"].max())] * n
        lanes.append(at)
    return lanes


def _overlap(sources: Sequence[Excerpt]) -> bool:
    """Whether two recordings have episodes that were recorded at the same time."""
    which = np.repeat(np.arange(len(sources)), [len(source.rows) for source in sources])
    start, end = (np.concatenate([s.rows[name] for s in sources]) for name in ("start_time", "end_time"))
    order = np.lexsort((end, start))
    which, start, latest = which[order], start[order], np.maximum.accumulate(end[order])
    group = np.concatenate([[0], np.cumsum(start[1:] >= latest[:-1])])
    return bool((np.diff(which)[np.diff(group) == 0] != 0).any())


def _channels(source: Recording, container: Container, lane: int | None) -> dict[int, int]:
    """The target's ids of a source's channels, with its first sub-environment at `lane`."""
    ids = {channel.topic: channel.id for channel in container.channels.values()}
    found = {}
    for topic, channel in source.file.topics.items():
        parsed = parse(topic)
        if lane is not None and parsed is not None:
            there = Topics.of(lane + parsed.env).top + topic.removeprefix(parsed.topics.top)
        else:
            there = topic
        found[channel] = ids.get(there, 0)
    return found


def _turns(sources: Sequence[Excerpt]) -> list[tuple[int, np.ndarray]]:
    """(source, index rows) in the order of times: the episodes of a source up to the next one of another source."""
    which = np.repeat(np.arange(len(sources)), [len(source.rows) for source in sources])
    place = np.concatenate([np.arange(len(source.rows)) for source in sources])
    start = np.concatenate([source.rows["start_time"] for source in sources])
    order = np.lexsort((place, which, start))
    bounds = np.flatnonzero(np.diff(which[order])) + 1
    return [(int(which[part[0]]), np.sort(place[part])) for part in np.split(order, bounds)]


def _numbered(
    sources: Sequence[Excerpt], turns: Sequence[tuple[int, np.ndarray]]
) -> tuple[list[tuple[Recording, np.ndarray, int]], int]:
    """(recording, rows of its index, shift of its episodes' numbers) for each turn, and the next free number.
    UnmergeableError if there are not enough numbers."""
    last = {i: turn for turn, (i, _) in enumerate(turns)}
    numbered = []
    free, begun = 0, set()
    for turn, (i, places) in enumerate(turns):
        recording, rows = sources[i].recording, sources[i].rows[places]
        shift = max(0, free - int(rows["episode"].min())) if i in begun else free
        free = shift + (sources[i].next_episode if last[i] == turn else int(rows["episode"].max()) + 1)
        begun.add(i)
        numbered.append((recording, rows, shift))
    if free > 1 << 32:
        raise UnmergeableError(f"expected numbers of episodes below {1 << 32}, found {free - 1}; merge fewer")
    return numbered, free


def _new_trims(
    sources: Sequence[Excerpt],
    turns: Sequence[tuple[int, Array]],
    numbered: Sequence[tuple[Recording, Array, int]],
) -> dict[str, list[int]]:
    """By the new numbers of episodes, which of their steps stay."""
    return {
        str(number + shift): [trim.start, trim.stop]
        for (i, _), (_, rows, shift) in zip(turns, numbered, strict=True)
        for number in rows["episode"].tolist()
        if (trim := sources[i].trims.get(number)) is not None
    }


def _define_missing(
    source: Recording,
    container: Container,
    envs: int | None,
    infos: InfoCodec | None,
    without: Collection[str],
) -> None:
    """Adds the channels that earlier sources do not have; `envs` is None for a single environment."""
    info = None if infos is None or INFO not in source.file.topics else infos.schema()
    png = png_leaves(container.channels or source.file.contents.channels)  # the first recording decides
    cameras = () if "frames" in without else source.cameras
    try:
        register_channels(container, source.name, source.layout.without(without), envs, info, cameras, png)
    except RecordingError as err:
        raise UnmergeableError(str(err)) from err


def check_target(target: Path, sources: Sequence[Recording], *, overwrite: bool) -> None:
    """Raises RecordingError if the target of these sources exists (without `overwrite`), or is one of them."""
    if target.exists():
        if any(files.is_same(target, source.path) for source in sources):
            raise RecordingError(f"{target} is one of the recordings themselves; write to another path")
        if not overwrite:
            raise RecordingError(taken(target))


def _check_alike(sources: Sequence[Excerpt], without: Collection[str]) -> None:
    first = sources[0].recording
    expected = first.layout.without(without).to_metadata()
    seen = {(first.uuid, int(number)): first for number in sources[0].rows["episode"]}
    steps = sum(int(source.rows["length"].sum()) for source in sources)
    if steps > LAST_ROW:
        raise UnmergeableError(
            f"expected at most {LAST_ROW} steps in a recording, found {steps}; merge fewer"
        )
    for other, rows, *_ in sources[1:]:
        description = other.layout.without(without).to_metadata()
        for name in _SPACES:
            if description[name] != expected[name]:
                raise SpaceError(
                    f"{other.name}: expected the {name} of {first.name}, {getattr(first.layout, name)}, found "
                    f"{getattr(other.layout, name)}; only recordings of the same spaces can be merged"
                )
        for name in sorted(expected.keys() | description.keys()):
            if description.get(name) != expected.get(name):
                raise SpaceError(
                    f"{other.name}: expected {name} as in {first.name}, {expected.get(name)!s:.200}, found "
                    f"{description.get(name)!s:.200}; steps of other layouts cannot be in one recording"
                )
        if other.benchmark_id != first.benchmark_id:
            raise UnmergeableError(
                f"{other.name}: expected a recording of benchmark {first.benchmark_id or 'none'}, as {first.name} is, "
                f"found {other.benchmark_id or 'none'}"
            )
        for number in rows["episode"].tolist():
            before = seen.setdefault((other.uuid, number), other)
            if before is not other:
                raise UnmergeableError(
                    f"{other.name} holds episode {number} of {before.name} again; leave one out"
                )


def _new_infos(recording: Recording, codec: InfoCodec | None) -> tuple[InfoCodec, InfoCodec] | None:
    """A recording's codec of infos, and the merged one's, if they differ."""
    own = recording.file.info_codec
    return None if own is None or codec is None or own.names == codec.names else (own, codec)


def _common_infos(sources: Sequence[Excerpt]) -> InfoCodec | None:
    """The codec of all infos: with a typed field for each entry that has one in a recording."""
    found = [codec for source in sources if (codec := source.recording.file.info_codec) is not None]
    return InfoCodec(list(dict.fromkeys(name for codec in found for name in codec.names))) if found else None


def _attachments(sources: Sequence[Recording]) -> dict[str, tuple[str, bytes]]:
    """The attachments of all recordings, without statements that do not fit the merged one."""
    attachments: dict[str, tuple[str, bytes]] = {}
    carried = [recording for recording in sources if DOCUMENT_NAME in recording.attachments]
    other = next((r for r in carried if not _is_same(carried[0].benchmark.record, r.benchmark.record)), None)
    if other is not None:
        warn(
            f"{other.name} carries another environment than {carried[0].name}, or another version of it; the first one "
            "is kept"
        )
    with_environment = carried[0] if carried else None
    for recording in sources:
        for name, info in recording.attachments.items():
            if name in (*STATEMENTS, RUN_NAME, ANNOTATIONS_NAME, MADE_OF_NAME) or (
                name in (DOCUMENT_NAME, PICKLE_NAME) and recording is not with_environment
            ):
                continue
            data = recording.read_attachment(name)
            if attachments.setdefault(name, (info.media_type, data))[1] != data and name != LABELS_NAME:
                raise UnmergeableError(
                    f"{recording.name}: its attachment {name!r} differs from that of an earlier recording; a merged "
                    "recording can have only one of a name"
                )
    labelled = [recording for recording in sources if LABELS_NAME in recording.attachments]
    if len({recording.read_attachment(LABELS_NAME) for recording in labelled}) > 1:
        labels = common_labels({recording.name: recording.labels for recording in labelled})
        attachments[LABELS_NAME] = LABELS_MEDIA_TYPE, labels.to_json(labelled[0].layout.leaves)
    return attachments


def _is_same(one: EnvironmentRecord, other: EnvironmentRecord) -> bool:
    """Whether they are one environment, as far as they tell: one that says nothing to rebuild it, as those that step
    many copies by themselves do, may be any of its name."""
    says = [record.spec is not None or record.pickle is not None for record in (one, other)]
    return one.digest == other.digest or (one.name == other.name and says[0] != says[1])
