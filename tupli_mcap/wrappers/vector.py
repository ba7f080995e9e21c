"""`RecordEpisodes` for `gymnasium.vector` environments: a stream of episodes for each sub-environment, in one file."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space, iterate

from tupli_mcap import jsonvalue
from tupli_mcap.errors import SpaceError, StepError, warn
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Step
from tupli_mcap.recording.about.success import tells_success, with_success
from tupli_mcap.recording.write.episodes import ResetFacts, seed_number
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.recording.write.recorders.autoreset import Autoreset
from tupli_mcap.recording.write.recorders.infos import check_infos, final_infos_of, infos_of
from tupli_mcap.recording.write.recorders.vector import VectorRecorder
from tupli_mcap.recording.write.work import ASKING, BEGUN, DONE
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import shorten
from tupli_mcap.wrappers.base import EpisodeWrapper, drawn_seed, metadata_of, reset_callback


class RecordEpisodes(EpisodeWrapper[gym.vector.VectorEnv[Any, Any, Any]], gym.vector.VectorWrapper):
    """Records every sub-environment of a vector environment (Sync, Async, custom) into the MCAP file `path`.

    Arguments are those of `tupli_mcap.RecordEpisodes`, and `autoreset_mode`. The file describes the first
    sub-environment; if that is in another process, as far as `gymnasium.make_vec` knows it. Each sub-environment gets
    a copy of the metadata callback. With `max_bytes` or `max_seconds`, a new file begins as soon as the old one is full
    and no sub-environment is within an episode; if one always is, at the next `reset` of all. If a step raises, the
    running episodes end as interrupted, and a `reset` of all must follow: some may have taken the step.

    Args:
        autoreset_mode: "NextStep", "SameStep" or "Disabled"; by default what the environment declares
            (`env.metadata["autoreset_mode"]`). If it declares nothing, final states in its infos are taken for
            same-step autoreset, and without them next-step autoreset is assumed, with a warning. A batch that
            contradicts the mode is refused. With "SameStep" given, episodes without a final state in an info are
            recorded without one.
    """

    _is_vector = True
    env: gym.vector.VectorEnv[Any, Any, Any]
    _recorder: VectorRecorder

    def _prepare(
        self, env: gym.vector.VectorEnv[Any, Any, Any], options: RecordOptions
    ) -> tuple[StepLayout, int]:
        if options.reward_space is not None and options.reward_space.shape is None:
            raise SpaceError(
                f"reward: expected a space of arrays for a vector environment, found {options.reward_space}"
            )
        self._autoreset = Autoreset.of(env, options.autoreset_mode)
        n = env.num_envs
        given = options.metadata_callback
        self._callbacks = None if given is None else [copy.deepcopy(given) for _ in range(n)]
        self._texts = ["{}"] * n
        self._states: list[Any] = []
        self._watches = options.has_callbacks
        watch = [RecordEpisodes._watch] * options.has_callbacks + [RecordEpisodes._film] * bool(options.every)
        self._parts = (*watch, RecordEpisodes._end, RecordEpisodes._go_on)
        self._is_ale = type(env.unwrapped).__module__ == "ale_py.vector_env"
        spaces = StepLayout(env.single_observation_space, env.single_action_space, options.reward_space)
        # the environment's own `observation_space` may be that of one sub-environment, as EnvPool's is
        self._observations = batch_space(spaces.observation_space, n)
        self._actions = batch_space(spaces.action_space, n)
        return spaces, n

    def _recorder_of(self, writer: RecordingWriter) -> VectorRecorder:
        return VectorRecorder(
            writer, self._spaces, self.num_envs, self._autoreset, self._infos, derives_episodes=self._plain
        )

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        work.state = BEGUN
        try:
            result = self.env.step(actions)
            told: Any = result
            states, rewards, terminals, timeouts, infos = told
        except BaseException:  # some sub-environments may have taken the step
            self._recorder.refuse()
            work.state = DONE
            raise
        if self._is_ale and "final_obs" in infos:
            # of those that ended, the other infos are of the reset, and no `final_info` says so
            infos = {**infos, "final_info": {}}
            told = states, rewards, terminals, timeouts, infos
        if infos is None:
            told = states, rewards, terminals, timeouts, {}
        try:
            stepped = self._recorder.put(actions, states, rewards, terminals, timeouts, infos)
        except StepError:
            work.state = DONE
            raise
        except BaseException as err:
            self._writer.stop(err)
            raise
        refusal = self._finish_step((stepped, actions), told)
        work.finish()
        if self._autoreset.doubt:
            doubt, self._autoreset.doubt = self._autoreset.doubt, ""
            warn(doubt)
        if refusal is not None:
            raise refusal
        return result

    def _film(self, taken: Any, result: Any) -> None:
        if self._frames is not None:
            _, _, terminals, timeouts, _ = result
            ended = np.logical_or(terminals, timeouts)
            self._frames.step_batch(
                self._recorder, taken[0], ended, self.env.render, same_step=self._autoreset.mode == "SameStep"
            )

    def _end(self, taken: Any, result: Any) -> None:
        """The ends of the episodes that the batch has ended."""
        _, _, terminals, _, infos = result
        recorder, texts, ended = self._recorder, self._texts, self._recorder.ended
        finals: list[dict[str, Any]] = []
        if ended and infos and tells_success(infos):
            texts, finals = list(texts), final_infos_of(infos, ended, self.num_envs)
            for i, info in zip(ended, finals, strict=True):
                texts[i] = with_success(texts[i], info)
        if self._watches or texts is not self._texts:
            recorder.note_metadata(texts)
        recorder.finish(terminals, infos)
        if self._callbacks is not None:
            self._work.ask(self._forget, ended)
        for info in finals:
            self._work.ask(self._check_flag, self.path, info)

    def _go_on(self, taken: Any, result: Any) -> None:
        """Flushes and syncs if that is due, and begins a new file if this one is full."""
        self._writer.after_steps()
        if self.rotation.is_due(self._writer) and not self._recorder.is_running:
            self._rotate(result[0])

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        work = self._work
        if work.state:
            work.refuse()
        seeds = self._seeds_of(seed)
        # before the environment takes any out; the mask is for the vector environment, not its sub-environments
        given = None if options is None else {key: options[key] for key in options if key != "reset_mask"}
        told = "" if given is None else jsonvalue.dumps_any(given)
        mask = None if options is None else options.get("reset_mask")
        mask = None if mask is None else np.array(mask, dtype=np.bool_)
        work.state = ASKING
        try:
            unseeded = [getattr(env.unwrapped, "_np_random", 0) is None for env in self._sub_environments()]
            result = self.env.reset(seed=seed, options=options)  # type: ignore[arg-type]
            states, infos = result
            facts = self._facts(seeds, unseeded, told, infos)
            if self._watches:
                self._states = self._each_state(states)
            work.go_on()
            if mask is None and self.rotation.is_due(self._writer):
                self._rotate(states)
            self._recorder.reset(states, facts, mask)
            if self._frames is not None:
                self._frames.start_batch(
                    np.ones(self.num_envs, np.bool_) if mask is None else mask, self.env.render
                )
            if self._watches:
                work.ask(self._forget, range(self.num_envs) if mask is None else np.flatnonzero(mask))
        except BaseException as err:
            if work.is_whole_after(err):  # the running episodes are over, whatever the environments did
                work.state = BEGUN
                self._recorder.refuse()
                work.state = DONE
            else:
                self._writer.stop(err)
            raise
        work.finish()
        return result

    def _sub_environments(self) -> list[Any]:
        """The sub-environments in this process; the seeds that others draw are unknown."""
        envs = getattr(self.env.unwrapped, "envs", None)
        return list(envs) if isinstance(envs, list | tuple) else []

    def _seeds_of(self, seed: Any) -> list[int | None]:
        """The seed of each sub-environment; StepError if there is not one for each."""
        n = self.num_envs
        if seed is None or isinstance(seed, int | np.integer):
            return [None if seed is None else int(seed) + i for i in range(n)]
        try:
            seeds = list(seed)
        except TypeError:
            seeds = []
        if len(seeds) != n:
            raise StepError(
                f"seed: expected an integer, None, or a list of {n} of these, found {shorten(seed)}"
            )
        return [seed_number(one) for one in seeds]

    def _facts(
        self, seeds: Sequence[int | None], unseeded: list[bool], options: str, infos: Any
    ) -> list[ResetFacts]:
        n, now = self.num_envs, time.time_ns()
        facts = []
        for i, info in enumerate(infos_of(check_infos(infos, n), range(n), n)):
            text = jsonvalue.dumps_any(info) if info else "{}"
            drawn = None
            if seeds[i] is None and i < len(unseeded) and unseeded[i]:
                drawn = drawn_seed(self._sub_environments()[i])
            facts.append(ResetFacts(seeds[i], drawn, options, text, now))
        return facts

    def _watch(self, taken: Any, result: Any) -> None:
        """Calls the callbacks with a batch, and records its infos."""
        (stepped, actions), ask, before = taken, self._work.ask, self._states
        self._states = ask(self._each_state, result[0])
        self._recorder.put_infos(stepped, ask(self._asked, before, stepped, actions, result))

    def _each_state(self, states: Any) -> list[Any]:
        """A copy: the environments may reuse their arrays."""
        return copy.deepcopy(list(iterate(self._observations, states)))

    def _asked(self, before: Any, stepped: Any, actions: Any, result: Any) -> list[dict[str, Any]]:
        """The infos to record, by sub-environment; puts metadata into `_texts`."""
        _, rewards, terminals, timeouts, infos = result
        entries: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        chosen = list(iterate(self._actions, actions))
        taken, n = np.flatnonzero(stepped).tolist(), self.num_envs
        found = dict(zip(taken, infos_of(infos, taken, n), strict=True))
        if self._autoreset.mode == "SameStep" and (ended := self._recorder.ended):
            found.update(zip(ended, final_infos_of(infos, ended, n), strict=True))
        for i, info in found.items():
            step = Step(before[i], chosen[i], rewards[i], bool(terminals[i]), bool(timeouts[i]), info)
            step.env = i
            entries[i] = self._entries(step)
            if self._callbacks is not None:
                reward = step.reward if np.ndim(step.reward) else float(step.reward)
                self._texts[i] = metadata_of(self._callbacks[i], step._replace(reward=reward))
        return entries

    def _forget(self, chosen: Any) -> None:
        for i in chosen:
            if self._callbacks is not None:
                reset_callback(self._callbacks[i])
            self._texts[i] = "{}"
