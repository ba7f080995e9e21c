"""Rewrites a recording with fewer episodes or other attachments; episode numbers, times and values stay.

Also what every recording made of others carries: metadata, channels, runs, annotations, and which ones they are.
"""

from __future__ import annotations

import hashlib
import heapq
import itertools
import json
import os
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError, plural, warn
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.images.codecs import image_codecs, png_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.about.annotations import (
    ANNOTATIONS_MEDIA_TYPE,
    ANNOTATIONS_NAME,
    Annotation,
    Annotations,
)
from tupli_mcap.recording.about.described import MADE_OF_NAME, MAX_MADE_OF
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns, Run, file_name
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.contents import first_metadata
from tupli_mcap.recording.edit.assemble import Assembler, copying, replacing
from tupli_mcap.recording.edit.copy_episodes import EpisodeCopier, NewFrames
from tupli_mcap.recording.episode import reward_getter
from tupli_mcap.recording.index import chosen_numbers
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, stays_signed
from tupli_mcap.recording.write.options import check_attachments, check_benchmark_id
from tupli_mcap.remote import check_local, shown_name


def rewrite_recording(
    source: Recording,
    target: str | os.PathLike[str],
    *,
    episodes: Sequence[int] | None = None,
    attachments: Mapping[str, tuple[str, bytes]] | None = None,
    benchmark_id: str | None = None,
    compression: str = "zstd",
    frames: NewFrames | None = None,
    overwrite: bool = True,
) -> None:
    """Writes `target` (replaced in one rename) from `source`; it keeps the UUID.

    Args:
        source: an open recording.
        target: path of the file, which may be the source's own.
        episodes: numbers of the episodes to keep (all by default).
        attachments: name -> (media type, bytes), added to the source's or replacing them.
        benchmark_id: replaces the source's.
        compression: "zstd", "lz4" or "none".
        frames: new frames of a camera, which may be a new one.
        overwrite: replace a target that exists.

    Chunks before the first row that is left out are copied unchanged, if their compression is the wanted one. A
    signature stays if nothing it covers changes, and is left out otherwise.

    Raises:
        RecordingError: there is no such episode, or the target cannot be written.
        FormatError: the source is damaged.
    """
    if not isinstance(source, Recording):
        raise RecordingError(
            f"expected an open recording, found {source!r:.80}; pass tupli_mcap.Recording(...)"
        )
    check_local(target)
    check_attachments(attachments)
    if benchmark_id is not None:
        check_benchmark_id(benchmark_id)
    if episodes is not None:
        episodes = chosen_numbers(source.index, episodes, source.name)
    target = Path(target)
    metadata = kept_metadata(source)
    if benchmark_id is not None:
        metadata["benchmark_id"] = benchmark_id
    same = episodes is None and benchmark_id in (None, source.benchmark_id) and frames is None
    with replacing(target, overwrite=overwrite) as (fd, _):
        container = Container(fd, str(target), compression)
        write(source, container, metadata, episodes, attachments or {}, frames, signed=same)


def rewrite_in_place(
    source: Recording, path: Path, episodes: Sequence[int], *, compression: str = "zstd"
) -> None:
    """Writes the file of `source`, whose lock the caller holds, anew with fewer episodes. Warns if it removes a
    signature; raises as `rewrite_recording` does."""
    if SIGNATURE_NAME in source.attachments:
        warn(f"{path}: its signature covers the episodes that are removed, and is left out")
    with replacing(path, held=True) as (fd, _):
        container = Container(fd, str(path), compression)
        write(source, container, kept_metadata(source), episodes, {}, signed=False)


def warn_of_signatures(sources: Iterable[Recording]) -> None:
    """Warns, once for all of them, if sources of a new recording are signed: it will not be."""
    signed = [source.name for source in sources if SIGNATURE_NAME in source.attachments]
    if len(signed) == 1:
        warn(f"{shown_name(signed[0])} is signed; what is made of it is not")
    elif signed:
        others = plural(len(signed) - 1, "other recording")
        warn(f"{shown_name(signed[0])} and {others} are signed; what is made of them is not")


def kept_metadata(source: Recording) -> dict[str, str]:
    """The metadata of a rewritten recording, which keeps its UUID."""
    metadata = {key: value for key, value in source.metadata.items() if key not in ("journal", "replaced")}
    metadata["next_episode"] = str(source.file.contents.next_episode)
    metadata["rewritten"] = uuid.uuid4().hex
    return metadata


def new_metadata(source: Recording, next_episode: int) -> dict[str, str]:
    """The metadata of a recording with a new UUID made of `source`."""
    version = source.metadata["format_version"]
    made = first_metadata(uuid.uuid4().hex, version, source.benchmark_id, time.time_ns())
    return {**made, "next_episode": str(next_episode)}


def return_of(layout: StepLayout, rewards: Any, steps: int) -> float:
    """The return of a column of rewards, added in the order in which a recorder adds them."""
    if layout.reward_space is None:
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.add.accumulate(np.append(0.0, rewards), dtype=np.float64)[-1])
    reward = reward_getter(layout.reward_space, rewards)
    total = 0.0
    for i in range(steps):
        total += layout.reward_total(reward(i))
    return total


def write(
    source: Recording,
    container: Container,
    metadata: Mapping[str, str],
    numbers: Sequence[int] | None,
    attachments: Mapping[str, tuple[str, bytes]],
    frames: NewFrames | None = None,
    *,
    signed: bool,
    left_out: Sequence[str] = (),
) -> None:
    """Writes some of a source's episodes, and its attachments but those in `left_out`, to a new recording.

    `signed` says that the episodes are those that were signed: then a signature stays if the attachments allow it.
    """
    kept = {name: info for name, info in source.attachments.items() if name not in attachments}
    if not (signed and stays_signed(source.attachments, attachments)):
        kept.pop(SIGNATURE_NAME, None)
    own = {
        name: (info.media_type, source.read_attachment(name))
        for name, info in kept.items()
        if name not in left_out
    }
    rows = source.index
    if numbers is not None:
        rows = rows[np.isin(rows["episode"], np.asarray(list(numbers), dtype=np.int64))]
        for name in (RUN_NAME, ANNOTATIONS_NAME):
            own.pop(name, None)  # `carry_runs` makes them anew of the episodes that stay, if there are any
        own |= carry_runs([(source, rows, 0)])
        if MADE_OF_NAME in own:
            own |= _trims_of(source, rows)
    now, target = time.time_ns(), Assembler(container)
    target.begin(metadata, {**own, **attachments}, now)
    target.copy_metadata(source.file.source, source.file.contents.metadata_indexes)
    define(source, target)
    cameras = all_camera_channels(source, container, frames) if source.num_envs else {}
    container.define_channels()
    if source.num_envs:
        copier = EpisodeCopier(source, target, cameras, frames=frames)
        with copying([(source.file, rows)], container.name):
            target.add_episodes(copier.copy(rows))
    target.finish(now)


def define(source: Recording, target: Assembler) -> None:
    """Adds the source's channels and schemas with the same ids."""
    container, contents = target.container, source.file.contents
    container.schemas, container.channels = dict(contents.schemas), dict(contents.channels)
    container.codecs = image_codecs(source.layout, contents.channels) if source.file.steps else {}
    container.counts = dict.fromkeys(contents.channels, 0)


def all_camera_channels(
    source: Recording, container: Container, new: NewFrames | None = None
) -> dict[str, list[tuple[int, int]]]:
    """By camera, then by sub-environment, the ids of its channels; those of a new camera are added."""
    cameras = source.file.cameras
    envs = range(source.num_envs)
    channels = {name: [cameras.channels(name, env) for env in envs] for name in cameras.names}
    if new is not None and new.camera not in channels:
        vector = source.num_envs if source.is_vector else None
        where = (container, source.name, source.layout, vector, None, (new.camera,))
        channels[new.camera] = register_channels(*where, png_leaves(source.file.contents.channels)).cameras
    return channels


# ---- what a recording says about those that it is made of


def carry_runs(parts: Sequence[tuple[Recording, Array, int]]) -> dict[str, tuple[str, bytes]]:
    """The attachments `run.json` and `annotations.json` of a recording made of `parts`.

    Args:
        parts: (recording, rows of its index, shift of their episode numbers), in the order of the episodes in the new
            recording.
    """
    runs: list[Run] = []
    known: dict[str, int] = {}  # by what the files say: names and times of files differ within a run
    places: list[int] = []
    said_of: dict[Recording, list[Annotation]] = {}
    several = len({recording.uuid for recording, _, _ in parts}) > 1  # files whose names are lost
    for recording, rows, shift in parts:
        said_runs = recording.runs if several else recording.recorded_runs.runs
        at = np.searchsorted(recording.index["episode"], rows["episode"]).tolist()
        of_episodes = [recording.run_places[i] for i in at]
        carried: dict[int, int] = {}
        for place in dict.fromkeys(of_episodes):
            recorded = recording.recorded_runs.runs[place]
            said = _as_text(recorded if recorded.id else said_runs[place])
            carried[place] = known.setdefault(said, len(runs))
            if carried[place] == len(runs):
                runs.append(said_runs[place])
        places += [carried[place] for place in of_episodes]
        kept = set(rows["episode"].tolist())
        said_here = said_of.setdefault(
            recording, [one._replace(episodes=[]) for one in recording.annotations.said]
        )
        for annotation, new in zip(recording.annotations.said, said_here, strict=True):
            new.episodes.extend(number + shift for number in annotation.episodes if number in kept)
    spans = [(len(list(same)), place) for place, same in itertools.groupby(places)]
    found = {}
    if runs and runs != [Run()]:
        first = parts[0][0].recorded_runs
        before = () if several else first.before
        edited = [(known.get(_as_text(first.runs[place])), was) for place, was in before]
        edits = [(place, was) for place, was in edited if place is not None]
        written = RecordedRuns(runs, spans if len(runs) > 1 else (), edits)
        found[RUN_NAME] = (RUN_MEDIA_TYPE, written.to_json())
    annotations = _in_turn(said_of.values())
    if annotations:
        found[ANNOTATIONS_NAME] = (ANNOTATIONS_MEDIA_TYPE, Annotations(annotations).to_json())
    return found


def _in_turn(lists: Iterable[Sequence[Annotation]]) -> list[Annotation]:
    """The annotations of several recordings that still have episodes, in the order of their times, for the last one is
    the one that is taken back. One that several recordings have, parts of one, stays one."""
    found: list[Annotation] = []
    for one in heapq.merge(*lists, key=attrgetter("at")):
        if found and one._replace(episodes=found[-1].episodes) == found[-1]:
            found[-1].episodes.extend(one.episodes)
        elif one.episodes:
            found.append(one)
    return found


def _as_text(run: Run) -> str:
    """What is said of a run as one text, the same whatever the order of its keys."""
    return json.dumps(json.loads(jsonvalue.dumps_plain(vars(run))), sort_keys=True)


def say_made_of(
    sources: Iterable[Recording], how: str, parts: Iterable[Array | None] = (), **facts: Any
) -> dict[str, tuple[str, bytes]]:
    """The attachment that names the sources of a new recording.

    Args:
        how: "merge", "filter", "map", "trim", "split".
        parts: of each source, rows of its index if nothing may be told of the others, else None.
        facts: other facts: the query, the function's name, the steps.
    """
    each = list(itertools.zip_longest(sources, parts))
    document = {
        "how": how,
        **facts,
        "sources": [
            {
                # without the folder, or the rest of a URL, which are private
                "name": file_name(recording.name),
                "uuid": recording.uuid,
                "episodes": len(recording.index if part is None else part),
                "sha256": hashlib.sha256(
                    bytes.fromhex(recording.uuid) + (recording.index if part is None else part).tobytes()
                ).hexdigest(),
            }
            for recording, part in each
        ],
    }
    earlier = [said for recording, part in each if part is None and (said := _said(recording)) is not None]
    data = json.dumps({**document, "earlier": earlier} if earlier else document).encode()
    if len(data) > MAX_MADE_OF:
        data = json.dumps(document).encode()
    return {MADE_OF_NAME: ("application/json", data)}


def _trims_of(source: Recording, rows: Array) -> dict[str, tuple[str, bytes]]:
    """The attachment that names the sources of a trimmed recording, with the trims of these rows of its index alone;
    nothing of another recording."""
    said = _said(source)
    if said is None or not isinstance(said.get("steps"), dict):
        return {}
    kept = set(map(str, rows["episode"].tolist()))
    steps = {number: trim for number, trim in said["steps"].items() if number in kept}
    return {MADE_OF_NAME: ("application/json", json.dumps({**said, "steps": steps}).encode())}


def _said(recording: Recording) -> dict[str, Any] | None:
    try:
        return recording.made_of
    except FormatError:  # damage of this attachment does not concern the steps
        return None
