"""Recordings made without an environment: episodes given as values."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from tupli_mcap import jsonvalue
from tupli_mcap.errors import StepError
from tupli_mcap.messages.episodes import END_NAMES, INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.episodes import ResetFacts, seed_number
from tupli_mcap.recording.write.options import Mode, RecordOptions
from tupli_mcap.recording.write.recorders.infos import InfoRecorder, entries_of, metadata_json
from tupli_mcap.recording.write.recorders.single import SingleRecorder
from tupli_mcap.recording.write.work import Work
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import exact_flag, shorten


@dataclass
class EpisodeData:
    """An episode as sequences of one value a step.

    Attributes:
        states, actions, rewards: values of the spaces, nested as they are; `actions[i]` was chosen on `states[i]`.
        terminals, timeouts: bools; only the last one may be true. Without one, the episode ends as "interrupted".
        final_state: the state after the last step; None if it is not known.
        seed, options: of the reset that began the episode; None if there was none.
        metadata: of the episode, as JSON can hold them.
        infos: a dict for each step; None if there are none.
    """

    states: Sequence[Any]
    actions: Sequence[Any]
    rewards: Sequence[Any]
    terminals: Sequence[Any]
    timeouts: Sequence[Any]
    final_state: Any = None
    seed: int | None = None
    options: dict[str, Any] | None = None
    metadata: Mapping[str, Any] = field(default_factory=dict)
    infos: Sequence[Mapping[str, Any]] | None = None


def write_recording(
    path: str | os.PathLike[str],
    episodes: Iterable[EpisodeData],
    *,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    reward_space: gym.Space[Any] | None = None,
    benchmark_id: str = "",
    attachments: Mapping[str, tuple[str, bytes]] | None = None,
    mode: Mode = "x",
    compression: str = "zstd",
) -> None:
    """Records episodes that exist as values, exactly, as `RecordEpisodes` does.

        episode = EpisodeData(states=[state, state], actions=[action, action], rewards=[0.0, 1.0],
                              terminals=[False, True], timeouts=[False, False], final_state=final_state)
        write_recording("a.mcap", [episode], observation_space=observation_space, action_space=action_space)

    Args:
        path: the recording.
        episodes: are written one after the other.
        observation_space, action_space, reward_space: Gymnasium spaces of one step; by default a reward is a number.
        benchmark_id, attachments, mode, compression: as `tupli_mcap.RecordEpisodes` takes them.

    Raises:
        RecordingError: the file exists (mode "x"), or cannot be written.
        SpaceError: a space cannot be recorded.
        StepError: an episode without steps, of unequal columns, with values that cannot be stored exactly, or with a
            flag before its last step.
    """
    spaces = StepLayout(observation_space, action_space, reward_space)
    options = RecordOptions(
        compression=compression, mode=mode, benchmark_id=benchmark_id, attachments=attachments
    )
    writer = RecordingWriter(path, options, keep_empty=True)
    recorder = SingleRecorder(writer, spaces, InfoRecorder(True))
    work = Work()
    work.recorders.append(recorder)
    try:
        writer.check_spaces(spaces, 1, vector=False)
        for episode in episodes:
            with work:  # what was recorded before stays if a step is refused
                _write(recorder, episode)
    finally:
        work.close()


def _write(recorder: SingleRecorder, episode: EpisodeData) -> None:
    if not hasattr(episode, "states"):
        raise StepError(f"expected an episode as EpisodeData, found {shorten(episode)}")
    columns = (episode.states, episode.actions, episode.rewards, episode.terminals, episode.timeouts)
    found = [_length(column) for column in columns]
    n = found[0]
    if not n or set(found) != {n}:
        raise StepError(
            f"expected as many states, actions, rewards, terminals and timeouts, at least one each, found {found}"
        )
    if episode.infos is not None and _length(episode.infos) != n:
        raise StepError(f"expected an info for each of {n} steps, or None, found {_length(episode.infos)}")
    end, seed = _end(episode, n - 1), seed_number(episode.seed)
    options = "" if episode.options is None else jsonvalue.dumps(episode.options, fallback=repr)
    recorder.reset(episode.states[0], ResetFacts(seed, None, options, "{}", time.time_ns()))
    for i in range(n):
        if i + 1 < n:
            after = episode.states[i + 1]
        else:
            after = episode.states[i] if episode.final_state is None else episode.final_state
        recorder.put(episode.actions[i], after, episode.rewards[i], episode.terminals[i], episode.timeouts[i])
        if episode.infos is not None and episode.infos[i]:
            recorder.put_info(entries_of(episode.infos[i], "infos"))
    recorder.metadata = metadata_json(episode.metadata, "metadata")
    recorder.end(end, has_final_state=episode.final_state is not None)


def _length(column: Any) -> int | None:
    """The number of values; None of what has no length."""
    try:
        return len(column)
    except TypeError:
        return None


def _end(episode: EpisodeData, last: int) -> int:
    end = INTERRUPTED
    for step, flags in enumerate(zip(episode.terminals, episode.timeouts, strict=True)):
        terminal, timeout = exact_flag(flags[0], "terminal"), exact_flag(flags[1], "timeout")
        end = TERMINAL if terminal else TIMEOUT if timeout else INTERRUPTED
        if end != INTERRUPTED and step < last:
            raise StepError(
                f"expected terminal and timeout to be false before the last step, {last}, found {END_NAMES[end]} "
                f"at step {step}; make an episode of the steps up to it, and another one of those after it"
            )
    return end
