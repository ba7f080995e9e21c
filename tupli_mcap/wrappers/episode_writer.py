"""`EpisodeWriter`: records episodes without an environment, step by step."""

from __future__ import annotations

import copy
import functools
import os
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Final

import gymnasium as gym
import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.errors import RecordingError, SaysWhatIsMeant, StepError, by_words, plural, warn
from tupli_mcap.messages.images.pictures import ImageFormat
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.about.success import FlagCheck
from tupli_mcap.recording.edit.attach import held
from tupli_mcap.recording.edit.rewrite import rewrite_in_place
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.recording.write.episodes import ResetFacts, seed_number
from tupli_mcap.recording.write.options import Capture, Durability, Mode, RecordOptions, check_attachments
from tupli_mcap.recording.write.recorders.infos import entries_of, metadata_json
from tupli_mcap.recording.write.rotation import Rotation
from tupli_mcap.recording.write.work import BEGUN, DONE, Work
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import exact_flags, shorten
from tupli_mcap.spaces.labels import Labels, is_time
from tupli_mcap.wrappers.base import Recorder, called_by_class
from tupli_mcap.wrappers.described import format_version, with_labels, with_run, with_stacks
from tupli_mcap.wrappers.streams import Stream, Streams

_MOST: Final = 65_000  # streams, each with a channel of its own, of which a file has at most 65,535


class EpisodeWriter(Recorder, SaysWhatIsMeant):
    """Records episodes without an environment: of robots, teleoperation, simulators.

        with EpisodeWriter("run.mcap", observation_space, action_space) as writer:
            writer.begin(metadata={"operator": "Ann"})
            writer.step(state, action, reward, terminal, timeout)  # and so on
            writer.end(final_state)

    A step is (state, action, reward, terminal, timeout); `state` is the observation that `action` was chosen on. It is
    safe, whatever happens to the process, as soon as `step()` has returned. An episode that still runs at `close()`, at
    garbage collection or at the end of the interpreter ends as "interrupted", without a final state.

    Args:
        path: the recording (.mcap), or a directory, in which a new file is named by run and time. Missing directories
            are made.
        observation_space, action_space, reward_space: Gymnasium spaces of one step; by default a reward is a number.
        num_envs: None for one stream of episodes, or the number of streams in the file, like the sub-environments of a
            vector environment. Each stream runs an episode of its own; `env` in the calls selects the stream.
        environment: what the episodes are of, such as "ur5-cell-2": `ls` and filters (`run.environment`) name it, and
            a page puts recordings of one environment together.
        step_seconds: time that a step takes (s), such as `1 / 50`: viewers, films and windows in seconds go by it.
        labels: this and all further arguments are those of `tupli_mcap.RecordEpisodes`.

    Raises:
        SpaceError: a space cannot be recorded; the message has the path of the leaf.
        RecordingError: the file exists, is being written, or cannot be written.

    Not thread-safe. A forked child cannot go on recording; the parent can.
    """

    _elsewhere: ClassVar = by_words(
        {
            "start start_episode begin_episode reset": "begin() starts an episode",
            "add add_step append record_step write": "step() records a step",
            "end_episode finish stop": "end() ends the episode",
            "abort cancel": "discard() drops the episode",
        }
    )

    @called_by_class
    def __init__(
        self,
        path: str | os.PathLike[str],
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        *,
        reward_space: gym.Space[Any] | None = None,
        num_envs: int | None = None,
        labels: Mapping[str, Sequence[str]] | None = None,
        attachments: Mapping[str, tuple[str, bytes]] | None = None,
        compression: str = "zstd",
        mode: Mode = "x",
        benchmark_id: str = "",
        flush_seconds: float | None = None,
        journal_dir: str | os.PathLike[str] | None = None,
        chunk_size: int = 256 * 1024,
        durability: Durability = "os",
        image_format: ImageFormat = "raw",
        stack_size: int | None = None,
        max_bytes: int | None = None,
        max_seconds: float | None = None,
        name: str | None = None,
        metadata: Mapping[str, Any] | None = None,
        tags: Sequence[str] = (),
        split: str = "",
        environment: str = "",
        step_seconds: float | None = None,
        capture: Capture = "all",
    ) -> None:
        if num_envs is not None and not (isinstance(num_envs, int | np.integer) and 0 < num_envs <= _MOST):
            raise RecordingError(
                f"num_envs: expected a number from 1 to {_MOST} or None, found {num_envs!r:.80}"
            )
        if not isinstance(environment, str):
            raise RecordingError(f"environment: expected a name, found {environment!r:.80}")
        if not (step_seconds is None or is_time(step_seconds)):
            raise RecordingError(
                f"step_seconds: expected a time above 0, or None, found {step_seconds!r:.80}"
            )
        check_attachments(attachments)
        spaces = with_stacks(None, StepLayout(observation_space, action_space, reward_space), stack_size)
        spaces.to_metadata()
        given = with_labels(attachments or {}, spaces, labels, Labels({}, {}, step_seconds))
        options = RecordOptions(
            compression=compression, mode=mode, benchmark_id=benchmark_id, capture_env=None, attachments=given,
            flush_seconds=flush_seconds, journal_dir=journal_dir, chunk_size=chunk_size, durability=durability,
            image_format=image_format, stack_size=stack_size, max_bytes=max_bytes, max_seconds=max_seconds, name=name,
            metadata=metadata, tags=tags, split=split, capture=capture,
        )  # fmt: skip
        options = replace(options, attachments=with_run(given, options, environment))
        self._spaces, self._num_envs = spaces, None if num_envs is None else int(num_envs)
        self.rotation = Rotation(path, options, format_version(spaces, image_format), name or environment)
        self._work = Work()
        self._check_flag = FlagCheck()
        self._discarded: dict[tuple[Path, str], list[int]] = {}  # numbers, by file and UUID
        self._compression, self._is_plain = compression, options.is_plain
        writer = self.rotation.open_first()
        try:
            self._record_to(writer)
            writer.check_spaces(spaces, self._num_envs or 1, vector=num_envs is not None)
            self._finalizer = weakref.finalize(self, _close, self._work, self._discarded, compression)
        except BaseException:
            writer.close()
            raise

    def _record_to(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._streams = Streams(writer, self._spaces, self._num_envs)
        self._work.recorders.append(self._streams)

    @property
    def closed(self) -> bool:
        """True once the recording is finished."""
        return self._writer.closed

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {str(self.path)!r}{': closed' if self.closed else ''}>"

    def begin(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
        metadata: Mapping[str, Any] | None = None,
        env: int = 0,
    ) -> None:
        """Begins an episode.

        Args:
            seed, options: what a simulator was reset with.
            metadata: of the episode; `end` may add to it. They are written when the episode ends: one that a kill ends
                has none.
            env: in which stream.

        Raises:
            StepError: the last episode of this stream still runs: no flag has ended it.
            RecordingError: the metadata is no dict of JSON values.
        """
        self._between(env)
        number = seed_number(seed)
        told = "" if options is None else jsonvalue.dumps_any(options)
        facts = ResetFacts(number, None, told, "{}", time.time_ns())
        entries = _metadata(metadata)
        with self._work:
            self._next(env).begin(facts, entries)

    def _next(self, env: int) -> Stream:
        """The stream, ready for its next episode, if need be in the next file."""
        self._streams.streams[env].end()
        if self.rotation.is_due(self._writer) and not self._streams.is_running:
            self._go_on()
        return self._streams.streams[env]

    def _go_on(self) -> None:
        """Goes on in the next file."""
        before, left = self._streams, self._writer
        self._record_to(self._work.ask(self.rotation.open_next))
        self._writer.layout = left.layout
        before.close()
        self._work.recorders.remove(before)

    def step(
        self,
        state: Any = None,
        action: Any = None,
        reward: Any = None,
        terminal: bool = False,
        timeout: bool = False,
        *,
        info: Mapping[str, Any] | None = None,
        env: int = 0,
        observation: Any = None,
        terminated: bool | None = None,
        truncated: bool | None = None,
    ) -> None:
        """Records a step: the observation, the action that was chosen on it, and what came of it.

        Args:
            terminal, timeout: the step ended the episode; pass the state after it to `end`.
            info: entries to record with it: numbers, texts, arrays, and lists and dicts of them.
            env: in which stream.
            observation, terminated, truncated: Gymnasium's names of state, terminal, timeout.

        Raises:
            StepError: no episode is running, or a value cannot be stored exactly; nothing of this step is recorded, and
                the episode goes on.
        """
        stream = self._ready(env)
        if observation is not None:
            state = one_of("state", state, "observation", observation)
        if terminated is not None:
            terminal = one_of("terminal", terminal or None, "terminated", terminated)
        if truncated is not None:
            timeout = one_of("timeout", timeout or None, "truncated", truncated)
        entries = entries_of(info, "info") if info else None
        work = self._work
        work.state = BEGUN
        try:
            stream.put(state, action, reward, terminal, timeout)
            if entries:
                stream.put_infos([entries])
            if not self._is_plain:
                self._writer.after_steps()
        except StepError:
            work.state = DONE
            raise
        except BaseException as err:
            self._writer.stop(err)
            raise
        work.finish()
        if entries and (terminal or timeout):
            self._check_flag(self.path, entries)

    def steps(
        self,
        states: Any,
        actions: Any,
        rewards: Any,
        terminals: Any = None,
        timeouts: Any = None,
        *,
        infos: Sequence[Mapping[str, Any]] | None = None,
        env: int = 0,
    ) -> None:
        """Records several steps of the running episode, from NumPy arrays whose first axis is time.

        Args:
            states, actions, rewards: arrays of shape (steps, *leaf shape), nested as the spaces are.
            terminals, timeouts: by default false; only the last step may have one of them set.
            infos: a dict for each step.

        Raises:
            StepError: as `step`; also for flags before the last step, and for arrays of unequal length. Nothing of this
                call is recorded, and the episode goes on.
        """
        stream = self._ready(env)
        n = count_of(rewards)
        flags = flags_of(terminals, (n,), "terminals"), flags_of(timeouts, (n,), "timeouts")
        early = np.flatnonzero((flags[0] | flags[1])[:-1])
        if len(early):
            raise StepError(f"expected no flag before the last step, {n - 1}, found one at step {early[0]}")
        if infos is not None and len(infos) != n:
            raise StepError(f"infos: expected one for each of {n} steps, found {len(infos)}")
        _check_lengths(n, "step", states=states, actions=actions, rewards=rewards)
        entries = [entries_of(info, "info") for info in infos or ()]
        if n:
            with self._work:
                stream.put_many(states, actions, rewards, *flags, entries)
                self._writer.after_steps()
            if entries and stream.over is not None:
                self._check_flag(self.path, entries[-1])

    def episodes(
        self,
        states: Any,
        actions: Any,
        rewards: Any,
        terminals: Any,
        timeouts: Any,
        final_states: Any = None,
        *,
        env: int = 0,
    ) -> None:
        """Records whole episodes, which lie one after another along the first axis of all arrays (NumPy's).

        A process that is killed meanwhile loses steps that are not yet recorded, and final states of those that are.

        Args:
            states, actions, rewards: as for `steps`, of all episodes.
            terminals, timeouts: an episode ends where one of them is set, the last one at the last step.
            final_states: the state after each episode, along the first axis of arrays; None: not known.
            env: in which stream.

        Raises:
            StepError: as `step`; also if an episode is running, and for arrays of unequal length. Of the episodes of
                this call only those ahead of the one that is refused may be recorded.
        """
        self._between(env)
        n = count_of(rewards)
        flags = flags_of(terminals, (n,), "terminals"), flags_of(timeouts, (n,), "timeouts")
        stops = np.flatnonzero(flags[0] | flags[1]) + 1
        if not n or stops[-1:] != n:
            raise StepError(
                "expected whole episodes, found no flag at the last step; steps() records a part of one"
            )
        _check_lengths(n, "step", states=states, actions=actions, rewards=rewards)
        _check_lengths(len(stops), "episode", final_states=final_states)
        with self._work:
            self._next(env).put_episodes(states, actions, rewards, *flags, stops, final_states)
            self._writer.after_steps()

    def end(
        self,
        final_state: Any = None,
        *,
        metadata: Mapping[str, Any] | None = None,
        env: int = 0,
        final_observation: Any = None,
    ) -> None:
        """Ends the running episode as the flags of its last step say, or as "interrupted" if neither is set. An episode
        without steps is not recorded.

        Args:
            final_state: the observation after the last step; None: not known.
            metadata: added to that of `begin`.
            env: in which stream.
            final_observation: Gymnasium's name of final_state.

        Raises:
            StepError: no episode is running, or the state cannot be stored exactly; the episode is still running then.
        """
        stream = self._running(env)
        final_state = one_of("final_state", final_state, "final_observation", final_observation)
        entries = _metadata(metadata)
        with self._work:
            stream.end(final_state, entries)
            self._writer.sync_step()

    def discard(self, *, env: int = 0) -> None:
        """Drops the running episode: it will not be in the finished file, and its number is not used again.

        Its steps may be in the file already, so `close()` writes the file anew without them. If the process is killed
        before that, the episode stays as an interrupted one, with `discarded` true in its metadata.

        Raises:
            StepError: no episode is running.
        """
        stream = self._running(env)
        with self._work:
            number = stream.discard()
            if number is not None:
                place = self._writer.place
                self._discarded.setdefault((place.file, place.uuid), []).append(number)
            self._writer.sync_step()

    def close(self) -> None:
        """Ends running episodes as interrupted, and finishes the recording. Calling it twice is fine.

        Raises:
            RecordingError: the disk refuses; everything that was recorded is safe.
        """
        _close(self._work, self._discarded, self._compression)
        self._finalizer.detach()

    def _stream(self, env: int) -> Stream:
        if self._work.state or self._writer.closed:
            self._work.refuse()
        streams = self._streams.streams
        if env.__class__ is int and 0 <= env < len(streams):
            return streams[env]
        if isinstance(env, bool) or not isinstance(env, int | np.integer) or not 0 <= env < len(streams):
            more = "; pass num_envs for several streams" if self._num_envs is None else ""
            raise StepError(f"env: expected a stream from 0 to {len(streams) - 1}, found {env!r:.40}{more}")
        return streams[env]

    def _between(self, env: int) -> None:
        """StepError if an episode runs in this stream that no flag has ended."""
        stream = self._stream(env)
        if stream.is_running and stream.over is None:
            raise StepError(f"an episode is running{_in(self._num_envs, env)}; call end() or discard() first")

    def _ready(self, env: int) -> Stream:
        stream = self._stream(env)
        if not stream.is_running or stream.over is not None:
            ended = "the step before has ended the episode" if stream.is_running else "no episode is running"
            raise StepError(f"{ended}{_in(self._num_envs, env)}; call begin() first")
        return stream

    def _running(self, env: int) -> Stream:
        stream = self._stream(env)
        if not stream.is_running:
            raise StepError(f"no episode is running{_in(self._num_envs, env)}; call begin() first")
        return stream


def _in(num_envs: int | None, env: int) -> str:
    return "" if num_envs is None else f" in stream {env}"


def one_of(name: str, given: Any, other: str, value: Any) -> Any:
    """The argument that was given under either of two names; StepError if both are given."""
    if given is not None and value is not None:
        raise StepError(f"expected {name} or {other}, which mean the same, found both")
    return value if given is None else given


def count_of(rewards: Any) -> int:
    """The number of steps that these are the rewards of; StepError if they are no array or list."""
    try:
        return len(rewards)
    except TypeError:
        found = shorten(rewards)
        raise StepError(f"rewards: expected an array of one for each step, found {found}") from None


def flags_of(given: Any, shape: tuple[int, ...], name: str) -> Array:
    """The given flags as bools, by default false; StepError if they are no flags."""
    expected = f"flags of shape {shape}, true or false"
    return np.zeros(shape, np.bool_) if given is None else exact_flags(given, shape, name, expected)


def _check_lengths(count: int, of: str, **columns: Any) -> None:
    """StepError unless all arrays of nested dicts and tuples have an entry for each of `count` steps or episodes."""

    def check(name: str, array: Any) -> None:
        try:
            found = len(array)
        except TypeError:
            raise StepError(f"{name}: expected an array of {count} entries, found {shorten(array)}") from None
        if found != count:
            raise StepError(f"{name}: expected one for each of {count} {of}s, found {found}")

    for name, column in columns.items():
        map_arrays(column, functools.partial(check, name))


def _metadata(given: Mapping[str, Any] | None) -> dict[str, Any]:
    """A copy of an episode's metadata, which the caller may change later; RecordingError unless JSON can hold them."""
    metadata_json(given, "metadata")
    return copy.deepcopy(entries_of(given, "metadata"))


def _close(work: Work, discarded: dict[tuple[Path, str], list[int]], compression: str) -> None:
    """Finishes the files, and rewrites those with discarded episodes without them. A file that was renamed keeps them,
    with a warning: another recording may have its path now, and must not lose episodes."""
    work.close()
    while discarded:
        (path, uuid), numbers = discarded.popitem()
        if not path.exists() or metadata_at(path).get("uuid") != uuid:
            warn(
                f"{path} was renamed or deleted while it was recorded, so its file keeps what was discarded "
                f"({plural(len(numbers), 'episode')}); delete it there: tupli-mcap delete FILE "
                "--filter 'metadata.discarded = true'"
            )
            continue
        with held(path), Recording(path) as recording:
            kept = [number for number in recording.index["episode"].tolist() if number not in numbers]
            if kept:
                rewrite_in_place(recording, path, kept, compression=compression)
            else:
                path.unlink()
