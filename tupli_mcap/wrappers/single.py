"""`RecordEpisodes`: a Gymnasium wrapper that records every step of one environment."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from tupli_mcap import jsonvalue
from tupli_mcap.environment import autoresets_of
from tupli_mcap.errors import RecordingError, StepError
from tupli_mcap.messages.episodes import TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Step
from tupli_mcap.recording.about.success import names_success, with_success
from tupli_mcap.recording.write.episodes import ResetFacts, seed_number
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.recording.write.recorders.single import SingleRecorder
from tupli_mcap.recording.write.work import ASKING, BEGUN, DONE
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.wrappers.base import EpisodeWrapper, drawn_seed, metadata_of, reset_callback


class RecordEpisodes(EpisodeWrapper[gym.Env[Any, Any]], gym.Wrapper[Any, Any, Any, Any]):
    """Records the episodes of `env` into the MCAP file `path`.

    The policy sees what it would see without a recorder: the same objects are passed on and returned, and none is
    copied for the environment, so an action that it changes in place is recorded as changed. A step is safe, whatever
    happens to the process, as soon as `step()` has returned. A reset in mid-episode, `close()`, garbage collection
    and the end of the interpreter end the running episode as "interrupted". So does a step of the environment that
    raises, which may have been taken in part: a reset must follow.

    Args:
        env: any environment whose spaces are Gymnasium's own.
        path: the recording (.mcap), or a directory, in which a new file is named by run or environment, and time.
            Missing directories are made.
        mode: if the file exists, "x" refuses, "w" replaces it, and "a" continues it. "a" also makes a missing file.
        metadata_callback: called with every step (an RLTuple); the dict it returns at the last one is the episode's
            metadata. If it has a `reset()`, that is called before each episode. If the info of the step that ends an
            episode has `is_success` or `success` (a bool, 0, 1, or an array of one of these), the metadata gets that as
            `success`, unless the callback sets it.
        record_info: False, True (everything), a list of names, or a function from an info to what is recorded.
        step_callback: called with every Step; returns entries to record with its info (log-probabilities, say).
        compression: "zstd", "lz4" or "none".
        reward_space: for rewards that are arrays.
        benchmark_id: the benchmark that the episodes belong to.
        capture_env: what to store of the environment. "spec": the EnvSpec (id, arguments, wrappers) if it has one,
            the names of its classes, versions of packages. "pickle": its pickle instead of the EnvSpec; this is code,
            which runs without a question for the user who recorded it. None: nothing, and no names from its
            documentation. No other environment is made; `verify --rerun` finds out whether a spec rebuilds it.
        attachments: name -> (media type, bytes), written before the first step instead of what `capture_env` says.
        labels: names for viewers and plots, by leaf: {"state": ["x", "angle"], "action": ["left", "right"]}, one for
            each dimension, or for each value of a Discrete. By default those in the environment's documentation. Names
            of columns, such as "observations", mean the same leaves.
        flush_seconds: write chunks at least this often (seconds), full or not.
        journal_dir: where the journal goes, if not beside the recording (a local disk for a network path).
        chunk_size: bytes of a chunk before compression.
        durability: what survives a power loss or a crash of the system; a killed process loses nothing in any case.
            "os": what the system happened to have written. "chunk": every chunk; each waits for the disk. "step":
            every step; each `step()` waits for the disk (0.1 to 20 ms).
        frames: True records what `env.render()` gives for every state; a number n does so for every n-th state and
            the last one. The environment must be made with render_mode="rgb_array".
        frame_format: "png" (exact) or "jpeg" (faster; smaller for photographs, not for drawings).
        image_format: how images in states are stored, exactly in both cases. "raw": pixels, which the chunk's
            compression makes small. "png": each image, and each frame of a stack, as a PNG (extra `frames`): smaller
            for photographs, larger for drawn screens, and 4 to 35 times slower to record.
        stack_size: how many frames an observation stacks; each of them is then stored once. By default what
            `FrameStackObservation`, or another wrapper with `stack_size` or `num_stack`, says in this process.
        live: shows the rollout while it is recorded. "rerun": starts the viewer if none listens at 127.0.0.1:9876.
            "rerun+http://host:port/proxy": a viewer that is running. "foxglove" or "foxglove://127.0.0.1:8765": a
            server to which Foxglove connects. A missing, slow or closed viewer changes nothing about the recording.
        max_bytes, max_seconds: continue in another file (run_0001.mcap, run_0002.mcap, … after run.mcap) when the
            file has this many bytes, or was open this long, and no episode is running: an episode is always in one
            file. `path` is the current file, `paths` are all of them. Mode "a" continues the last one.
        name: what the run is called, such as "ppo-seed3"; new files in a directory are named by it. A recording that is
            continued with the same `name`, `metadata`, `tags` and `split`, or none of them, goes on with its run; with
            others, the new episodes are of a new run.
        metadata: what was tried, such as {"algo": "ppo", "lr": 3e-4}.
        tags: words for the run.
        split: "train", "eval" or another word.
        capture: what to store about this process. "all": its command line, git commit, host, versions of Python and
            packages. "versions": only these. "none": nothing.
        autoreset_mode: of a vector environment; see `tupli_mcap.vector.RecordEpisodes`.

    Raises:
        SpaceError: a space cannot be recorded; the message has the path of the leaf.
        MissingExtraError: the extra that `live` needs is not installed.
        RecordingError: the file exists, is being written, or cannot be written; a new one does not end in .mcap; or it
            is a vector environment.
        StepError: in `step` and `reset`, a value cannot be stored exactly. The episode ends before it, everything
            recorded is safe, and a reset must follow.

    Not thread-safe. A forked child cannot go on recording; the parent can.
    """

    _is_vector = False
    env: gym.Env[Any, Any]
    _recorder: SingleRecorder

    def _prepare(self, env: gym.Env[Any, Any], options: RecordOptions) -> tuple[StepLayout, int | None]:
        if options.autoreset_mode is not None:
            raise RecordingError(
                "autoreset_mode: expected None for a single environment, which your loop resets, found "
                f"{options.autoreset_mode!r:.80}"
            )
        self._base = env.unwrapped
        self._metadata_callback = options.metadata_callback
        self._watches = options.has_callbacks or bool(options.every)
        self._parts = (RecordEpisodes._watch, RecordEpisodes._end, RecordEpisodes._go_on)
        self._stepped = True  # so that the callback is reset: another recorder may have used it
        self._state: Any = None
        self._autoresets = autoresets_of(env)
        return StepLayout(env.observation_space, env.action_space, options.reward_space), None

    def _recorder_of(self, writer: RecordingWriter) -> SingleRecorder:
        return SingleRecorder(writer, self._spaces, self._infos, derives_episodes=self._plain)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The spec of the inner environment, without this recorder."""
        return self.env.spec

    @property
    def closed(self) -> bool:
        """True once the recording is finished."""
        return self._writer.closed

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        work.state = BEGUN
        try:
            result = self.env.step(action)
            state, reward, terminal, timeout, _ = result
        except BaseException:  # the environment may have taken a part of the step
            self._recorder.refuse()
            work.state = DONE
            raise
        try:
            # looked up as an attribute, which is faster than as a method
            put = self._recorder.put
            put(action, state, reward, terminal, timeout)
            if self._plain:
                if not (terminal or timeout):
                    work.state = DONE
                    return result
                if self._recorder.step_index and not names_success(result[4]):
                    self._note_autoreset()
                    self._recorder.leave_end(TERMINAL if terminal else TIMEOUT)
                    work.state = DONE
                    return result
        except StepError:
            self._recorder.refuse()
            work.state = DONE
            raise
        except BaseException as err:  # a full disk, Ctrl-C
            self._writer.stop(err)
            raise
        refusal = self._finish_step(action, result)
        work.finish()
        if refusal is not None:
            raise refusal
        return result

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        number = seed_number(seed)
        told = "" if options is None else jsonvalue.dumps_any(options)  # before the environment takes any out
        work.state = ASKING
        unseeded = seed is None and getattr(self._base, "_np_random", 0) is None
        try:
            result = self.env.reset(seed=seed, options=options)
            state, info = result
            has_facts = seed is not None or options is not None or info or unseeded
            if self._plain and not has_facts and not self.rotation.is_due(self._writer):
                work.go_on()
                if self._recorder.begin_next(state):
                    work.finish()
                    return result
                work.state = ASKING
            facts = ResetFacts(
                number,
                drawn_seed(self.env) if unseeded else None,
                told,
                jsonvalue.dumps_any(dict(info) if isinstance(info, Mapping) else info) if info else "{}",
                time.time_ns(),
            )
            if self._watches:
                self._state = copy.deepcopy(state)
            work.go_on()
            if self.rotation.is_due(self._writer):
                self._rotate(state)
            self._recorder.reset(state, facts)
            self._start_frames()
            if self._stepped:
                work.ask(self._reset_callback)
        except BaseException as err:
            # the state of the environment is unknown: the running episode is over
            if work.is_whole_after(err):
                work.state = BEGUN
                self._recorder.forget_reset()
                if self._frames is not None:
                    self._frames.forget(0)
                work.state = DONE
            else:
                self._writer.stop(err)
            raise
        work.finish()
        return result

    def _start_frames(self) -> None:
        if self._frames is not None:
            self._frames.start(0, self.env.render)

    def _watch(self, action: Any, result: Any) -> None:
        """Calls the callbacks, and records infos and frames of a step."""
        if not self._watches:
            return
        state, reward, terminal, timeout, info = result
        ask = self._work.ask
        before, self._state = self._state, ask(copy.deepcopy, state)  # the environment may reuse its arrays
        if self._recorder.step_index == 0:  # a step that was a reset
            self._start_frames()
            return
        self._stepped = True
        taken = Step(before, action, reward, terminal, timeout, info)
        if self._infos is not None:
            self._recorder.put_info(ask(self._entries, taken))
        if self._metadata_callback is not None:
            self._recorder.metadata = ask(metadata_of, self._metadata_callback, taken)
        if self._frames is not None:
            number, step = self._recorder.running
            self._frames.step(0, number, step, bool(terminal or timeout), self.env.render)

    def _end(self, action: Any, result: Any) -> None:
        """Ends the episode after its last step."""
        _, _, terminal, timeout, info = result
        # the flag of a step that was a reset ends nothing
        if (terminal or timeout) and self._recorder.step_index:
            self._note_autoreset()
            self._recorder.metadata = with_success(self._recorder.metadata, info)
            self._recorder.end(TERMINAL if terminal else TIMEOUT)
            self._work.ask(self._reset_callback)
            self._work.ask(self._check_flag, self.path, info)

    def _note_autoreset(self) -> None:
        """Tells the recorder whether the step after this end is a reset."""
        if self._autoresets:
            self._recorder.resets_itself = any(layer.autoreset for layer in self._autoresets)

    def _reset_callback(self) -> None:
        self._stepped = False
        if self._metadata_callback is not None:
            reset_callback(self._metadata_callback)

    def _go_on(self, action: Any, result: Any) -> None:
        """Goes on in another file if this one is full, and syncs to the disk if `durability` asks for it."""
        state, _, terminal, timeout, _ = result
        if (terminal or timeout) and self._recorder.running[0] < 0 and self.rotation.is_due(self._writer):
            self._rotate(state)
        self._writer.after_steps()

    def _when_closed(self) -> None:
        if self._stepped:  # the episode was interrupted
            self._reset_callback()
