"""`RecordEpisodes` for `gymnasium.vector` environments: one episode stream a sub-environment, in one file."""

from __future__ import annotations

import copy
import os
import time
import warnings
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import iterate

from tupli_mcap import jsonvalue
from tupli_mcap.errors import RecordingError, SpaceError, StepError
from tupli_mcap.journal.seals import Durability
from tupli_mcap.messages.images.pictures import FrameFormat, ImageFormat
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.episode import Step
from tupli_mcap.recording.write.autoreset import Autoreset
from tupli_mcap.recording.write.frames import VectorFrames
from tupli_mcap.recording.write.infos import InfoRecorder, entries_of
from tupli_mcap.recording.write.options import CaptureEnv, Mode, RecordInfo, RecordOptions, StepCallback
from tupli_mcap.recording.write.rotation import Rotation
from tupli_mcap.recording.write.vector import VectorRecorder
from tupli_mcap.recording.write.vector_infos import final_info_of, info_of
from tupli_mcap.recording.write.work import ASKING, BEGUN, DONE, Work
from tupli_mcap.recording.write.writer import RecordingWriter, ResetFacts
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.wrappers.benchmark import Captured
from tupli_mcap.wrappers.labels import with_labels
from tupli_mcap.wrappers.seeds import drawn_seed
from tupli_mcap.wrappers.single import check_kind, close_recordings, live_session, metadata_of
from tupli_mcap.wrappers.stacks import format_version, with_stacks

__all__ = ["RecordEpisodes"]


class RecordEpisodes(gym.vector.VectorWrapper):
    """Records every sub-environment of a vector environment (Sync, Async, custom) into the MCAP file `path`.

    Arguments are those of `tupli_mcap.RecordEpisodes`; the environment in the file is the first sub-environment, and
    where that lives in another process, what `gymnasium.make_vec` has noted of it.
    A metadata callback is copied for each sub-environment.
    `autoreset_mode` ("NextStep", "SameStep" or "Disabled") is by default what the environment declares
    (`env.metadata["autoreset_mode"]`). Where it declares nothing, final states in its infos tell of same-step
    autoreset; without them next-step autoreset is assumed, with a warning. A batch that contradicts the mode is
    refused. With "SameStep" given, episodes whose final states are in no infos are recorded without.
    With `max_bytes` or `max_seconds`, a full file is left when no sub-environment is within an episode; where there is
    always one that is, at a `reset` of all.
    """

    def __init__(
        self,
        env: gym.vector.VectorEnv[Any, Any, Any],
        path: str | os.PathLike[str],
        *,
        metadata_callback: EpisodeMetadataCallback | None = None,
        record_info: RecordInfo = False,
        step_callback: StepCallback | None = None,
        compression: str = "zstd",
        mode: Mode = "x",
        reward_space: gym.Space[Any] | None = None,
        benchmark_id: str = "",
        capture_env: CaptureEnv = "spec",
        attachments: Mapping[str, tuple[str, bytes]] | None = None,
        labels: Mapping[str, Sequence[str]] | None = None,
        flush_seconds: float | None = None,
        journal_dir: str | os.PathLike[str] | None = None,
        chunk_size: int = 256 * 1024,
        durability: Durability = "os",
        autoreset_mode: str | None = None,
        live: str | None = None,
        frames: bool | int = False,
        frame_format: FrameFormat = "png",
        image_format: ImageFormat = "raw",
        stack_size: int | None = None,
        max_bytes: int | None = None,
        max_seconds: float | None = None,
    ) -> None:
        check_kind(env, vector=True)
        super().__init__(env)
        options = RecordOptions(
            metadata_callback=metadata_callback, record_info=record_info, step_callback=step_callback,
            compression=compression, mode=mode, reward_space=reward_space, benchmark_id=benchmark_id,
            capture_env=capture_env, attachments=attachments, labels=labels, flush_seconds=flush_seconds,
            journal_dir=journal_dir, chunk_size=chunk_size, durability=durability, frames=frames,
            frame_format=frame_format, image_format=image_format, stack_size=stack_size, live=live,
            max_bytes=max_bytes, max_seconds=max_seconds,
        )  # fmt: skip
        options.check_rendering(getattr(env, "render_mode", None))
        self._autoreset = Autoreset.of(env, autoreset_mode)
        n = env.num_envs
        self._callbacks = (
            None if metadata_callback is None else [copy.deepcopy(metadata_callback) for _ in range(n)]
        )
        self._step_callback = step_callback
        self._infos = InfoRecorder(record_info) if options.has_infos else None
        captured = Captured(env, capture_env, attachments)
        if reward_space is not None and reward_space.shape is None:
            raise SpaceError(
                f"reward: expected a space of arrays for a vector environment, found {reward_space}"
            )
        self._spaces = spaces = StepLayout(
            env.single_observation_space, env.single_action_space, reward_space
        )
        self._spaces = spaces = with_stacks(env, spaces, stack_size)
        spaces.to_metadata()
        options = replace(options, attachments=with_labels(captured, env, spaces, labels))
        self.rotation = Rotation(path, options, format_version(spaces, image_format))
        self._texts = ["{}"] * n
        self._states: list[Any] = []
        self._watches = options.has_callbacks
        parts = (
            (RecordEpisodes._watch, self._watches),
            (RecordEpisodes._film, bool(options.every)),
            (RecordEpisodes._end, True),
            (RecordEpisodes._go_on, True),
        )
        self._parts = [part for part, is_wanted in parts if is_wanted]
        self._work = work = Work()
        writer: RecordingWriter | None = None
        try:
            self._writer = writer = self.rotation.open_first()
            self._recorder = VectorRecorder(
                self._writer, spaces, n, self._autoreset, self._infos,
                leaves_to_rows=options.is_plain,
            )  # fmt: skip
            work.recorders.append(self._recorder)
            captured.trust_stored(writer)
            self._writer.check_spaces(spaces, n, vector=True)
            self._frames = VectorFrames(self._writer, n, options, work.ask) if options.every else None
            self._live = live_session(self._writer, live, env)
            self._finalizer = weakref.finalize(self, close_recordings, work, self._live)
        except BaseException:
            work.close()
            if writer is not None:
                writer.close()
            raise

    @property
    def path(self) -> Path:
        """The file that is recorded to."""
        return self.rotation.path

    @property
    def paths(self) -> list[Path]:
        """The files that this wrapper has recorded to, in their order."""
        return self.rotation.paths

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        work.state = BEGUN
        try:
            result = self.env.step(actions)
            states, rewards, terminals, timeouts, infos = result
        except Exception:  # a step that an environment refuses may be no step
            work.state = DONE
            raise
        except BaseException:  # Ctrl-C: some environments may have taken it
            self._recorder.refuse()
            work.state = DONE
            raise
        try:
            stepped = self._recorder.put(actions, states, rewards, terminals, timeouts, infos)
        except StepError:
            work.state = DONE
            raise
        except BaseException as err:
            self._writer.stop(err)
            raise
        refusal = self._finish_step(stepped, actions, result)
        work.finish()
        if self._autoreset.doubt:
            doubt, self._autoreset.doubt = self._autoreset.doubt, ""
            warnings.warn(doubt, UserWarning, stacklevel=2)
        if refusal is not None:
            raise refusal
        return result

    def _finish_step(self, stepped: Any, actions: Any, result: Any) -> BaseException | None:
        """Everything that follows a batch's rows; returns what a callback raised, which changes nothing about that."""
        work, refusal = self._work, None
        for part in self._parts:
            try:
                part(self, stepped, actions, result)
            except BaseException as err:
                if not work.is_whole_after(err):
                    self._writer.stop(err)
                    raise
                refusal = err if refusal is None else refusal
                work.state = BEGUN
        return refusal

    def _film(self, stepped: Any, actions: Any, result: Any) -> None:
        if self._frames is not None:
            _, _, terminals, timeouts, _ = result
            ended = np.logical_or(terminals, timeouts)
            self._frames.step(
                self._recorder, stepped, ended, self.env.render, same_step=self._autoreset.mode == "SameStep"
            )

    def _end(self, stepped: Any, actions: Any, result: Any) -> None:
        """The ends of the episodes that the batch has ended."""
        _, _, terminals, timeouts, infos = result
        if self._watches:
            self._recorder.note_metadata(self._texts)
        self._recorder.finish(terminals, infos)
        if self._callbacks is not None:
            self._work.ask(self._forget, np.flatnonzero(stepped & np.logical_or(terminals, timeouts)))

    def _go_on(self, stepped: Any, actions: Any, result: Any) -> None:
        """In another file, if this one is full; and with what is to be on the disk."""
        self._writer.flush_if_due()
        self._writer.sync_step()
        if self.rotation.is_due(self._writer) and not self._recorder.is_running:
            self._rotate(result[0])

    def _rotate(self, states: Any) -> None:
        """Goes on in the next file, with the environments at `states`."""
        work, before, left = self._work, self._recorder, self._writer
        writer = work.ask(self.rotation.open_next)
        recorder = VectorRecorder(
            writer, self._spaces, self.num_envs, self._autoreset, self._infos,
            leaves_to_rows=before.leaves_to_rows,
        )  # fmt: skip
        work.recorders.append(recorder)
        recorder.go_on_from(before, states)
        self._writer, self._recorder = writer, recorder
        if self._live is not None:
            self._live.go_on(writer)
        if self._frames is not None:
            self._frames.go_on(writer)
        before.close()
        work.recorders.remove(before)
        work.ask(self.rotation.finished, left.path)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        told = "" if options is None else jsonvalue.dumps_any(options)
        mask = None if options is None else options.get("reset_mask")
        mask = None if mask is None else np.array(mask, dtype=np.bool_)
        work.state = ASKING
        try:
            unseeded = [getattr(env.unwrapped, "_np_random", 0) is None for env in self._sub_environments()]
            result = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
            states, infos = result
            facts = self._facts(seed, unseeded, told, infos)
            if self._watches:
                self._states = copy.deepcopy(list(iterate(self.env.observation_space, states)))
            work.go_on()
            if mask is None and self.rotation.is_due(self._writer):
                self._rotate(states)
            self._recorder.reset(states, facts, mask)
            if self._frames is not None:
                self._frames.start(
                    np.ones(self.num_envs, np.bool_) if mask is None else mask, self.env.render
                )
            if self._watches:
                work.ask(self._forget, range(self.num_envs) if mask is None else np.flatnonzero(mask))
        except BaseException as err:
            if work.is_whole_after(err):  # wherever the environments are now: the running episodes are over
                work.state = BEGUN
                self._recorder.refuse()
                work.state = DONE
            else:
                self._writer.stop(err)
            raise
        work.finish()
        return result

    def _sub_environments(self) -> list[Any]:
        """Those in this process; of the others no drawn seed can be known."""
        envs = getattr(self.env.unwrapped, "envs", None)
        return list(envs) if isinstance(envs, list | tuple) else []

    def _facts(self, seed: Any, unseeded: list[bool], options: str, infos: Any) -> list[ResetFacts]:
        n, now = self.num_envs, time.time_ns()
        seeds: list[int | None] = [None] * n
        if isinstance(seed, int | np.integer):
            seeds = [int(seed) + i for i in range(n)]
        elif seed is not None:
            seeds = list(seed)
        facts = []
        for i in range(n):
            info = info_of(infos, i, n)
            text = jsonvalue.dumps_any(info) if info else "{}"
            drawn = None
            if seeds[i] is None and i < len(unseeded) and unseeded[i]:
                drawn = drawn_seed(self._sub_environments()[i])
            facts.append(ResetFacts(seeds[i], drawn, options, text, now))
        return facts

    def _watch(self, stepped: Any, actions: Any, result: Any) -> None:
        """Callbacks and infos of a batch."""
        ask, before = self._work.ask, self._states
        self._states = ask(self._each_state, result[0])
        self._recorder.put_infos(stepped, ask(self._asked, before, stepped, actions, result))

    def _each_state(self, states: Any) -> list[Any]:
        """A copy: the environments may reuse their arrays."""
        return copy.deepcopy(list(iterate(self.env.observation_space, states)))

    def _asked(self, before: Any, stepped: Any, actions: Any, result: Any) -> list[dict[str, Any]]:
        """What is to be recorded with the infos, by sub-environment; metadata are in `_texts` afterwards."""
        _, rewards, terminals, timeouts, infos = result
        entries: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        chosen = list(iterate(self.env.action_space, actions))
        for i in np.flatnonzero(stepped).tolist():
            info = info_of(infos, i, self.num_envs)
            if (terminals[i] or timeouts[i]) and self._autoreset.mode == "SameStep":
                info = final_info_of(infos, i, self.num_envs)
            step = Step(before[i], chosen[i], rewards[i], bool(terminals[i]), bool(timeouts[i]), info)
            entries[i] = self._entries(step)
            self._call(i, step)
        return entries

    def _entries(self, step: Step) -> dict[str, Any]:
        entries = {} if self._infos is None else self._infos.chosen(step.info)
        if self._step_callback is not None:
            entries.update(entries_of(self._step_callback(step), "step_callback: what it returns"))
        return entries

    def _call(self, i: int, step: Step) -> None:
        if self._callbacks is None:
            return
        state, action, reward, terminal, timeout, info = step
        rl_tuple = RLTuple.model_construct(
            state=state,
            action=action,
            reward=reward if np.ndim(reward) else float(reward),
            info=info,
            terminal=terminal,
            timeout=timeout,
        )
        self._texts[i] = metadata_of(self._callbacks[i], rl_tuple)

    def _forget(self, chosen: Any) -> None:
        for i in chosen:
            if self._callbacks is not None:
                self._callbacks[i].reset()
            self._texts[i] = "{}"

    def flush(self) -> None:
        """Writes everything recorded so far into chunks; the journal already protects it."""
        self._work.flush()

    def close(self, **kwargs: Any) -> None:
        """Finishes the recording, then closes the environment. Calling it twice is fine."""
        if "_finalizer" not in self.__dict__:
            return  # collected after its constructor raised: Gymnasium 1.0 closes then, and the caller's env too
        try:
            close_recordings(self._work, self._live)
            self._finalizer.detach()
        finally:
            super().close(**kwargs)

    def __enter__(self) -> RecordEpisodes:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        raise RecordingError(f"a wrapper that records to {self.path} cannot be pickled or copied; wrap there")
