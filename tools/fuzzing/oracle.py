"""What a recording says when everything in it is read, and whether that may be true."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import map_arrays
from tupli_mcap.dataset.items import FIELDS, steps_of
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe.description import describe

__all__ = ["Facts", "UnexpectedError", "judge", "observe"]

Facts = dict[str, Any]
COLUMNS = ("states", "actions", "rewards", "terminals", "timeouts")
MADE_WHEN_LOST = ("metadata", "seed", "options", "reset_info", "end", "return", "times", "start")


class UnexpectedError(Exception):
    """An input brought up an error of another kind; the message says at what."""


def _exact(value: Any) -> str:
    return jsonvalue.dumps_any(value)


class Reader:
    """Calls readers and keeps what they say: a value, or that it was refused."""

    def __init__(self) -> None:
        self.facts: Facts = {}
        self.refused: list[str] = []

    def ask(self, name: str, question: Callable[[], Any], allowed: type[Exception] = FormatError) -> Any:
        try:
            value = question()
        except (FormatError, allowed) as err:
            self.refused.append(f"{name}: {err}")
            return None
        except Exception as err:
            raise UnexpectedError(f"{name}: {type(err).__name__}: {err}") from err
        self.facts[name] = value
        return value


def observe(path: Path) -> tuple[Facts, list[str]]:
    """Everything a recording holds, by name, and what it refused to tell (one sentence each).

    Raises:
        UnexpectedError: something else than a FormatError came up.
    """
    reader = Reader()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        recording = reader.ask("open", lambda: Recording(path))
        if recording is not None:
            with contextlib.closing(recording):
                _read(reader, recording)
    reader.facts["open"] = recording is not None
    reader.facts["warned"] = [str(one.message) for one in said if issubclass(one.category, UserWarning)]
    odd = [
        one
        for one in said
        if not issubclass(one.category, (UserWarning, DeprecationWarning, ResourceWarning))
    ]
    if odd:
        raise UnexpectedError(
            f"{odd[0].category.__name__}: {odd[0].message} ({odd[0].filename}:{odd[0].lineno})"
        )
    return reader.facts, reader.refused


def _read(reader: Reader, recording: Recording) -> None:
    none_yet = RecordingError if not recording.num_envs else FormatError
    reader.facts["complete"] = recording.complete
    reader.ask("uuid", lambda: recording.uuid)
    reader.ask("facts", lambda: (recording.benchmark_id, recording.created_ns))
    reader.ask("library", lambda: recording.metadata.get("library"))
    reader.ask("describe", lambda: describe(recording))
    reader.ask("repr", lambda: (repr(recording), repr(recording.episodes)))
    reader.ask("spaces", lambda: _exact(recording.layout.to_metadata()), none_yet)
    for name in recording.attachments:
        reader.ask(f"attachment {name}", lambda name=name: recording.read_attachment(name))  # type: ignore[misc]
    if "benchmark.json" in recording.attachments:
        reader.ask("benchmark", lambda: recording.benchmark.record.to_json())
    reader.ask("labels", lambda: recording.labels)
    reader.ask("all metadata", recording.all_metadata)
    columns = reader.ask("columns", lambda: recording.read(fields=FIELDS))
    if columns is not None:
        reader.ask("nested", lambda: len(columns))
    reader.ask("at random", lambda: _at_random(recording, columns), none_yet)
    episodes: dict[int, Facts] = {}
    for i in range(min(len(recording), 64)):
        one = _episode(reader, recording, i)
        episodes[recording.episodes[i].number] = one
    reader.facts["episodes"] = episodes


def _at_random(recording: Recording, columns: Any) -> int:
    """Reads the steps by number, the last one first, and holds them against the columns."""
    for cache_bytes in (0, 1 << 24):  # chunk by chunk, or decoded
        steps = steps_of(recording, cache_bytes=cache_bytes, threads=1)
        found = steps.read(FIELDS, np.arange(len(steps))[::-1].copy())
        for name in FIELDS:
            if columns is not None and _flipped(found[name]) != _exact(getattr(columns, name)):
                raise UnexpectedError(f"{name} differ when they are read by number")
    return len(steps)


def _flipped(column: Any) -> str:
    """The column with its last row first."""
    return _exact(map_arrays(column, lambda part: part[::-1]))


def _episode(reader: Reader, recording: Recording, i: int) -> Facts:
    found: Facts = {}
    episode = recording.episodes[i]

    def ask(name: str, question: Callable[[], Any]) -> None:
        value = reader.ask(f"episode {i} {name}", question)
        if f"episode {i} {name}" in reader.facts:
            found[name] = reader.facts.pop(f"episode {i} {name}")
        del value

    ask("place", lambda: (episode.env, len(episode)))
    ask("repr", lambda: repr(episode))
    ask("return", lambda: _exact(episode.return_))
    ask("end", lambda: episode.end)
    ask("times", lambda: (episode.start_time, episode.end_time))
    ask("metadata", lambda: _exact(episode.metadata))
    ask("seed", lambda: episode.seed)
    ask(
        "start",
        lambda: (
            episode.start.env,
            episode.start.first_row,
            episode.start.seed_given,
            episode.start.continued,
        ),
    )
    ask("options", lambda: _exact(episode.options))
    ask("reset_info", lambda: _exact(episode.reset_info))
    ask("final_state", lambda: _exact(episode.final_state))
    ask("steps", lambda: [_exact(tuple(step[:5])) for step in episode])
    ask("infos", lambda: [_exact(info) for info in episode.infos or ()])
    if i % 4:  # those of all episodes at once are in "columns", too
        return found
    ask("next_states", lambda: _rows(recording, episode.next_states))
    ask("window", lambda: _exact(_leaves(recording, episode[1:2].states)))
    return found


def _leaves(recording: Recording, states: Any) -> list[Any]:
    return [leaf.get(states) for leaf in recording.layout.state]


def _rows(recording: Recording, states: Any) -> list[str]:
    """A text a step, so that the first ones can be compared alone."""
    columns = _leaves(recording, states)
    if not columns:
        return []
    return [_exact([column[k] if isinstance(column, list) else np.asarray(column[k]) for column in columns])
            for k in range(len(columns[0]))]  # fmt: skip


def judge(found: Facts, truth: Facts) -> Iterator[str]:
    """What in `found` is not so, where `truth` is what the undamaged file says. Nothing said is nothing wrong."""
    if not found["open"]:
        return
    names = [
        name
        for name in found
        if name.startswith("attachment ") or name in ("uuid", "facts", "spaces", "benchmark", "labels")
    ]
    for name in names:
        if name not in truth or found[name] != truth[name]:
            yield f"{name} is {found[name]!r:.200}, not {truth.get(name)!r:.200}"
    if found["complete"] and not truth["complete"]:
        yield "an unfinished recording passes for a complete one"
    if found["complete"] and len(found["episodes"]) != len(truth["episodes"]):
        yield f"a complete recording of {len(found['episodes'])} episodes, not {len(truth['episodes'])}"
    for number, episode in found["episodes"].items():
        if number not in truth["episodes"]:
            yield f"there was no episode {number}"
            continue
        for what in _episode_differs(episode, truth["episodes"][number], recovered=not found["complete"]):
            yield f"episode {number}: {what}"


def _episode_differs(found: Facts, truth: Facts, *, recovered: bool) -> Iterator[str]:
    steps, wanted = found.get("steps"), truth["steps"]
    if steps is not None and (steps != wanted[: len(steps)] or not (recovered or len(steps) == len(wanted))):
        yield f"steps {steps!r:.300} are not {wanted!r:.300}"
    lost = recovered and found.get("place", (0, 0))[1] < truth["place"][1]
    for name, value in found.items():
        if (
            name in ("steps", "repr")
            or name not in truth
            or value == truth[name]
            or (lost and name == "window")
        ):
            continue
        if (
            name == "infos"
            and recovered
            and all(a in (b, "null") for a, b in zip(value, truth[name], strict=False))
        ):
            continue
        if name == "place" and recovered and value[0] == truth[name][0] and value[1] <= truth[name][1]:
            continue
        if name == "next_states" and recovered and value[:-1] == truth[name][: len(value) - 1]:
            continue  # the last one repeats the state where the final state is lost
        if name == "final_state" and recovered and (value == "null" or lost):
            continue
        if recovered and name in MADE_WHEN_LOST and _was_made(name, value, lost):
            continue
        yield f"{name} is {value!r:.200}, not {truth[name]!r:.200}"


def _was_made(name: str, value: Any, lost: bool) -> bool:
    """True for what recovery puts in place of a lost start or end."""
    plain = {"metadata": "{}", "seed": None, "options": "null", "reset_info": "{}"}
    if name in plain:
        return bool(value == plain[name])
    return (
        name in ("times", "start")
        or (name == "return" and lost)
        or (name == "end" and value == "interrupted")
    )
