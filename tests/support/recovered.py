"""Compares recovery in memory, as readers do it, with `recover_recording` on an unfinished recording."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from environments import same

from tupli_mcap import FormatError, Recording, journal_path, jsonvalue, recover_recording
from tupli_mcap.journal.committed import committed_records
from tupli_mcap.journal.file import LogArea, read_journal
from tupli_mcap.recording.episode import Episode

__all__ = ["compared", "differences", "everything"]

_NEW = ("rewritten", "next_episode", "journal", "replaced", "crc")  # metadata of a file that is written anew


def differences(path: Path, directory: Path, *, killed: bool = False) -> list[str]:
    """The differences between recovery in memory and `recover_recording` on a recording.

    `recover_recording` also finds good data after damage or missing rows: then only the steps that both must have are
    compared. After a kill, there is no such data, and both find the same. (Damage may still be in several places: a
    partly written uncompressed chunk has readable records.)
    """
    target = directory / "recovered once.mcap"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            opened = Recording(path)
        except FormatError:  # before its first step, or of a journal that cannot be read
            return []
        report = recover_recording(path, target, overwrite=True)
    with opened as recording:
        if report.target is None:
            return [] if recording.n_steps == 0 else [f"{recording.n_steps} steps are not recovered"]
        more = bool(report.cut or report.lost or report.steps_lost or _is_behind_a_gap(path, recording))
        if killed and more:
            return [f"after a kill: {report}"]
        more = more or any(place.offset + place.size < path.stat().st_size for place in report.damaged)
        with Recording(target) as recovered:
            if more and not killed:
                return _of_steps(recording, recovered)
            return compared(recording, recovered)


def compared(recording: Recording, recovered: Recording) -> list[str]:
    """The differences between an unfinished recording and a recovered file."""
    return [*_about(recording, recovered), *_of_episodes(recording, recovered)]


def _is_behind_a_gap(path: Path, recording: Recording) -> bool:
    """Whether the journal holds records behind missing ones."""
    try:
        journal = read_journal(journal_path(path))
    except (OSError, FormatError):
        return False
    if journal.info.get("uuid") != recording.uuid:
        return False
    return any(
        records.numbers[-1] >= recording._store.count(channel)
        for name, area in journal.areas.items()
        if isinstance(area, LogArea)
        for channel, records in committed_records(journal, name).items()
    )


def everything(episode: Episode, recording: Recording) -> dict[str, Any]:
    """Everything in a file about an episode, with the times of its rows."""
    row = recording.index[episode.position]
    first, length = int(row["first_row"]), int(row["length"])
    top = f"/env_{episode.env}" if recording.is_vector else ""
    rows = {
        topic: _times(recording, channel, first, length)
        for topic, channel in recording._topics.items()
        if topic == f"{top}/step" or topic.startswith(f"{top}/image/")
    }
    shown = {camera: recording.frames(episode.position, camera) for camera in recording.cameras}
    return {
        "env": episode.env,
        "first_row": first,
        "return": episode.return_,
        "end": episode.end,
        "start": episode.start,
        "final_state": jsonvalue.dumps(episode.final_state),
        "metadata": jsonvalue.dumps(episode.metadata),
        "times": (int(row["start_time"]), int(row["end_time"])),
        # of several sub-environments, others' starts may lie between
        "resets": [] if recording.is_vector else recording.resets_before(episode.position),
        "steps": _steps(episode),
        "infos": jsonvalue.dumps(episode.infos),
        "row times": rows,
        "frames": {
            camera: [(int(step), tuple(frames.encoded(i))) for i, step in enumerate(frames.steps)]
            for camera, frames in shown.items()
        },
    }


def _steps(episode: Episode) -> list[str]:
    """The steps without their infos, exact."""
    return [jsonvalue.dumps(list(step)[:5]) for step in episode]


def _times(recording: Recording, channel: int, first: int, count: int) -> list[int]:
    """log_time (ns) of rows of a channel."""
    found = []
    for span in recording._store.spans(channel, first, count):
        data, records = recording._store.records(span.chunk)
        found += [
            int.from_bytes(data[at + 15 : at + 23], "little")
            for at, _ in records[span.begin : span.end].tolist()
        ]
    return found


def _held(recording: Recording, episode: Episode, times: tuple[int, int]) -> tuple[int, int]:
    """The times of a start and an end, not before those of the rows that they follow here."""
    row, held = recording.index[episode.position], []
    for time, topic, name in zip(
        times, ("/episode_start", "/episode_end"), ("start_row", "end_row"), strict=True
    ):
        at = int(row[name])
        before = _times(recording, recording._topics[topic], at - 1, 1) if at else [0]
        held.append(max(time, *before))
    return held[0], held[1]


def _about(recording: Recording, recovered: Recording) -> list[str]:
    """Differences in the metadata of the files."""
    one, other = (
        {key: value for key, value in found.metadata.items() if key not in _NEW}
        for found in (recording, recovered)
    )
    differ = [] if one == other else [f"metadata: {one} and {other}"]
    one, other = (
        {name: found.read_attachment(name) for name in found.attachments} for found in (recording, recovered)
    )
    return differ if one == other else [*differ, f"attachments: {list(one)} and {list(other)}"]


def _of_steps(recording: Recording, recovered: Recording) -> list[str]:
    """Steps that recovery in memory has, and that are not in the recovered file, or are others."""
    others = _steps_before(recovered)
    mine = {
        (episode.number, i): step for episode in recording.episodes for i, step in enumerate(_steps(episode))
    }
    return [f"step {key} differs" for key, step in mine.items() if step != others.get(key)]


def _of_episodes(recording: Recording, recovered: Recording) -> list[str]:
    numbers = [[episode.number for episode in found.episodes] for found in (recording, recovered)]
    if numbers[0] != numbers[1]:
        return [f"episodes {numbers[0]} and {numbers[1]}"]
    differ = []
    for episode, again in zip(recording.episodes, recovered.episodes, strict=True):
        one, other = everything(episode, recording), everything(again, recovered)
        # what is made in memory comes after what is there; a file that is written anew has all in the order of time
        other["times"] = _held(recording, episode, other["times"])
        differ += [
            f"{name} of episode {episode.number}: {one[name]!r:.200} and {other[name]!r:.200}"
            for name in one
            if not same(one[name], other[name])
        ]
    return differ


def _steps_before(recovered: Recording) -> dict[tuple[int, int], str]:
    """Every step, by the episode and step number that it had before."""
    found = {}
    for episode in recovered.episodes:
        origin = episode.metadata.get("recovered", {"episode": episode.number, "first_step": 0})
        for i, step in enumerate(_steps(episode)):
            found[origin["episode"], origin["first_step"] + i] = step
    return found
