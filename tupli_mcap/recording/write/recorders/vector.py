"""Episodes of a vector environment: one stream a sub-environment, under every autoreset mode (`autoreset`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector.utils import batch_space

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import StepError
from tupli_mcap.journal.derive import StartedEpisode
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.about.success import tells_success
from tupli_mcap.recording.write.episodes import ResetFacts, plain_reset
from tupli_mcap.recording.write.recorders.autoreset import Autoreset
from tupli_mcap.recording.write.recorders.infos import (
    InfoRecorder,
    check_infos,
    final_states,
    infos_of,
    reset_infos_of,
)
from tupli_mcap.recording.write.recorders.single import copy_of, decide_layout
from tupli_mcap.recording.write.rows.contract import BatchStore
from tupli_mcap.recording.write.rows.variable import each_of, final_encoder
from tupli_mcap.recording.write.rows.vector import VectorRows
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import exact_flags, number_array

_BOOL, _FLOAT = np.dtype(np.bool_), np.dtype(np.float64)


class VectorRecorder:
    """Records the episodes of `num_envs` sub-environments, for a `Work` that is marked while any of this runs.

    `spaces` are those of one of them.
    """

    def __init__(
        self,
        writer: RecordingWriter,
        spaces: StepLayout,
        num_envs: int,
        autoreset: Autoreset,
        infos: InfoRecorder | None,
        *,
        derives_episodes: bool = False,
    ) -> None:
        self.derives_episodes = derives_episodes and autoreset.is_plain
        self._deriving: VectorRows | None = None  # the rows, while starts and ends are derived from them
        self.writer = writer
        self._spaces = spaces
        self._n = num_envs
        self._autoreset = autoreset
        self._infos = infos
        self._observations = batch_space(spaces.observation_space, num_envs)
        self._actions = batch_space(spaces.action_space, num_envs)
        self._first: Any = None
        self._facts: list[ResetFacts | None] = [None] * num_envs
        self._earlier: list[list[ResetFacts]] = [[] for _ in range(num_envs)]  # resets that no step followed
        self._waiting = set(range(num_envs))  # those without an episode: their next step begins one
        self._episodes: list[StartedEpisode | None] = [None] * num_envs
        numbers = np.zeros((num_envs, 2), "<u4")  # of the running episodes: number, steps so far
        self._episode_numbers, self._lengths = numbers[:, 0], numbers[:, 1]
        self._numbers = numbers.view("<u8")[:, 0]  # both
        self._ones = np.ones(num_envs, "<u4")
        self._totals: Array = np.zeros(num_envs)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._any_ended = False
        self._everybody = np.ones(num_envs, dtype=np.bool_)
        self._shape, self._none = (num_envs,), bytes(num_envs)
        self._reward_shape = (num_envs, *spaces.reward[0].shape)
        self._texts = ["{}"] * num_envs
        self._was_reset = False
        self._refused = False
        self._has_place = False  # the file has a step, so that what it replaces is gone
        # of a final state that is in no row, as it follows `episode` and `env` in `/final_state`; set by `_begin`
        self._encode_final: Callable[[Any], bytes]
        self._final_rows: dict[int, int] = {}  # of final states that are in no row of steps
        self._late: list[tuple[int, int]] = []  # ends that wait for the batch after them

    # ---- resets

    def reset(self, states: Any, facts: Sequence[ResetFacts], mask: Array | None = None) -> None:
        """All sub-environments, or those in `mask`, start over; running episodes end as interrupted. StepError if a
        state cannot be stored exactly, or after `refuse` if `mask` leaves some out, whose states nobody knows."""
        if self.writer.closed:
            raise self.writer.why_stopped()
        if self._refused and mask is not None and not mask.all():
            raise StepError(
                "the step before this reset could not be recorded; call env.reset() without a reset_mask to go on"
            )
        self._derive_pending()
        chosen = range(self._n) if mask is None else np.flatnonzero(mask)
        ended = self._ended.copy()
        self._end([(int(i), INTERRUPTED) for i in chosen])
        for i in map(int, chosen):
            # a reset without a step is no episode, but one without a seed goes on with its random stream
            before, self._facts[i] = self._facts[i], facts[i]
            if not facts[i].goes_on:
                self._earlier[i] = []
            elif before:
                self._earlier[i].append(before)
            ended[i] = False
        self.writer.sync_step()  # before the running states are written over
        self._ended, self._any_ended = ended, bool(ended.any())
        self._was_reset = True
        self._refused = False
        if self.writer.vector is None:
            self._first = copy_of(states)
            return
        self.writer.vector.put_state(states, mask)
        self.writer.sync_step()

    def _each(self, space: Any, batch: Any) -> list[Any]:
        return each_of(space, batch, self._n)

    # ---- steps

    def put(
        self, actions: Any, states: Any, rewards: Any, terminals: Any, timeouts: Any, infos: Any
    ) -> Array:
        """Records a batch; returns which sub-environments took a step (bool, `num_envs`). StepError if something cannot
        be stored exactly; nothing of this batch is recorded."""
        if self.writer.closed:
            raise self.writer.why_stopped()
        if not self._was_reset or self._refused:
            refused = "the step before this one could not be recorded"
            raise StepError(
                f"{refused if self._refused else 'there was no reset yet'}; call env.reset() to go on"
            )
        resets = self._autoreset
        try:
            if not (rewards.__class__ is np.ndarray and rewards.dtype is _FLOAT):
                rewards = number_array(rewards, _FLOAT, self._reward_shape, "reward")
            terminals, timeouts = self._flag("terminal", terminals), self._flag("timeout", timeouts)
            if infos.__class__ is not dict:
                infos = check_infos(infos, self._n)
            store = self.writer.vector or self._begin(actions, states, rewards)
            done = terminals | timeouts
            flags = done.tobytes()
            any_done = flags != self._none
            if any_done:
                terminals, timeouts = self._plain(terminals, timeouts, done, flags)
            if any_done and infos and self._deriving and tells_success(infos):
                self._stop_deriving()  # ends have metadata, which rows do not tell
            finals = self._finals(done, states, infos) if any_done and (infos or not resets.is_plain) else {}
            holes = self._ended if self._any_ended and resets.mode == "NextStep" else None
            active = None if holes is None else ~holes
            ended = done & active if any_done and active is not None else done
            if holes is not None and (resets.is_assumed or ended.tobytes() != flags):
                self._check_resets(holes, done, rewards)
            # the whole batch is checked, then episodes are started, then it is written: recorded or refused as one
            final_states = {i: self._encode_final(state) for i, state in finals.items()} if finals else None
            batch = store.check(actions, states, rewards, terminals, timeouts, active)
            if self._waiting:
                self._start(store, active)
            if final_states:
                self._put_finals(final_states)
            store.put(batch, self._numbers, ends=any_done)
            if not self._has_place:
                self.writer.take_place()
                self._has_place = True
        except StepError:
            self.refuse()
            raise
        self._count_step(rewards, ended, active, infos, any_done=any_done)
        return self._everybody if active is None else active

    def _count_step(
        self, rewards: Array, ended: Array, active: Array | None, infos: Any, *, any_done: bool
    ) -> None:
        """Updates the state of each sub-environment after a batch."""
        if not self._deriving:
            totals = (
                rewards if rewards.ndim == 1 else rewards.reshape(self._n, -1).sum(axis=1, dtype=np.float64)
            )
            self._totals += totals if active is None else totals * active
        self._ended = ended
        if any_done:
            self._autoreset.has_ended = True
        if active is None:
            self._lengths += self._ones
            self._any_ended = any_done
            return
        self._lengths += active
        self._any_ended = any_done and bool(np.count_nonzero(ended))
        if self._deriving:
            self._begin_derived(~active, infos)
        else:
            self._note_resets(~active, infos)

    def _flag(self, name: str, values: Any) -> Array:
        if values.__class__ is np.ndarray and values.dtype is _BOOL and values.shape == self._shape:
            flag: Array = values
            return flag
        return exact_flags(values, self._shape, name, "true or false of each sub-environment")

    def _plain(self, terminals: Array, timeouts: Array, done: Array, flags: bytes) -> tuple[Array, Array]:
        """The flags of a batch with bytes of 0 and 1, as those of `done`; a bool made by a view may hold any byte."""
        given = terminals.tobytes(), timeouts.tobytes()
        if given in ((flags, self._none), (self._none, flags)):
            return terminals, timeouts
        return terminals & done, timeouts & done

    def running(self, i: int) -> tuple[int, int]:
        """The number of the running episode of a sub-environment and its steps so far; (-1, 0) if there is none."""
        episode = self._episodes[i]
        return (-1, 0) if episode is None else (episode.number, int(self._lengths[i]))

    @property
    def ended(self) -> list[int]:
        """The sub-environments whose episodes the batch just put has ended."""
        return self._ended.nonzero()[0].tolist() if self._any_ended else []

    def note_metadata(self, texts: Sequence[str]) -> None:
        """The metadata (JSON texts) of the running episodes, by sub-environment."""
        self._texts = list(texts)

    def finish(self, terminals: Any, infos: Mapping[str, Any]) -> None:
        """Ends the episodes that ended in the batch just put; `infos` are that batch's."""
        if not self._any_ended or self._deriving:
            return
        same_step = self._autoreset.mode == "SameStep"
        ends = [(i, TERMINAL if terminals[i] else TIMEOUT) for i in self.ended]
        if self._autoreset.is_assumed:
            self._late = ends
        else:
            self._end(ends, known=not same_step)
        if same_step:
            self._note_resets(self._ended, infos)
            self._any_ended = False

    def put_infos(self, stepped: Array, entries: Sequence[Mapping[str, Any]]) -> None:
        """Records infos of the batch just put."""
        if self._infos is None:
            return
        for i in np.flatnonzero(stepped).tolist():
            episode = self._episodes[i]
            if episode is not None:
                self._infos.put(self.writer, episode.number, int(self._lengths[i]) - 1, entries[i])

    def _begin(self, actions: Any, states: Any, rewards: Array) -> BatchStore:
        spaces, known, first = self._spaces, self.writer.layout, self._first
        if spaces.constant:
            layout = decide_layout(spaces, [first, states], [actions], [rewards], known, batch=self._shape)
        else:
            firsts = [*self._each(self._observations, first), *self._each(self._observations, states)]
            each = self._each(self._actions, actions)
            layout = decide_layout(spaces, firsts, each, list(np.atleast_1d(rewards)), known)
        self._encode_final = final_encoder(layout)
        schema = None if self._infos is None else self._infos.codec.schema()
        self.writer.begin(layout, self._n, vector=True, info_schema=schema)
        store = self.writer.vector
        assert store is not None
        store.put_state(self._first)
        if self.derives_episodes and isinstance(store, VectorRows) and store.holds_episodes:
            self._deriving, store.events = store, self.writer.events
        self._first = None
        return store

    def _finals(self, done: Array, states: Any, infos: Any) -> dict[int, Any]:
        """The final states of a same-step autoreset, which may show only now."""
        resets = self._autoreset
        found = (
            final_states(infos, done, lambda batch: self._each(self._observations, batch)) if infos else {}
        )
        if found and resets.mode != "SameStep":
            after = self._each(self._observations, states)
            changed = any(
                self._encode_final(state) != self._encode_final(after[i]) for i, state in found.items()
            )
            resets.note_finals(changed=changed)
        if resets.mode != "SameStep":
            resets.note_ends(known=True)
            return {}
        missing = [i for i in done.nonzero()[0].tolist() if i not in found]
        if missing and not resets.needs_no_finals:
            raise StepError(
                f"expected the final state of sub-environment {missing[0]}, whose episode ended under same-step "
                'autoreset, in infos["final_obs"], found none; if nobody knows it, pass '
                'autoreset_mode="SameStep"; if the next step resets, "NextStep"'
            )
        resets.note_ends(known=not missing)
        return found

    def _check_resets(self, holes: Array, done: Array, rewards: Array) -> None:
        late, self._late = self._late, []
        try:
            self._autoreset.check_resets(holes, done, rewards)
        except StepError:
            self._end(late, known=False)
            raise
        self._end(late)

    def _start(self, store: BatchStore, active: Array | None) -> None:
        """Starts the episodes of the sub-environments that wait for one and take a step."""
        waiting = sorted(i for i in self._waiting if active is None or active[i])
        if not waiting:
            return
        writer, counts, facts_of = self.writer, store.row_counts(), self._facts
        for i in waiting:
            facts, facts_of[i] = facts_of[i], None
            if facts is None:  # stepped on after an end, without a reset
                facts = plain_reset(time.time_ns(), continued=True)
            for earlier in self._earlier[i]:
                writer.add_reset(i, counts[i], earlier)
            self._earlier[i] = []
            self._episodes[i] = episode = writer.start_episode(i, counts[i], facts)
            if self._deriving:
                self._deriving.begin_episode(episode)
        first = writer.next_episode - len(waiting)
        self._episode_numbers[waiting] = range(first, writer.next_episode)
        self._lengths[waiting] = 0
        self._totals[waiting] = 0.0
        self._waiting.difference_update(waiting)

    # ---- episodes derived from rows

    def _begin_derived(self, holes: Array, infos: Mapping[str, Any]) -> None:
        """The episodes that begin with the batch just put, which was a reset to these sub-environments."""
        begun, writer = holes.nonzero()[0], self.writer
        first, writer.next_episode = writer.next_episode, writer.next_episode + len(begun)
        self._episode_numbers[begun] = np.arange(first, writer.next_episode)
        self._lengths[begun] = 0
        self._waiting.difference_update(begun.tolist())
        if infos and any(infos_of(infos, begun.tolist(), self._n)):
            self._stop_deriving()
            self._note_resets(holes, infos)

    def _stop_deriving(self) -> None:
        """From here on starts and ends are written as they happen, for rows do not hold all that they say."""
        self._derive_pending()
        if self._deriving:
            self._deriving.events = None
        self._deriving, self.derives_episodes = None, False

    def _derive_pending(self) -> None:
        """Writes the ends and starts that were put off, so that all is as if each had been written when it happened."""
        late, self._late = self._late, []
        self._end(late)
        store, events = self._deriving, self.writer.events
        if store is None or events is None:
            return
        now = time.time_ns()
        for i, (number, total) in enumerate(zip(*store.derive_pending(self._ended), strict=True)):
            self._episodes[i], self._totals[i] = events.running.get(number), total
            if self._episodes[i] is not None or i in self._waiting:
                continue
            self._waiting.add(i)
            if not self._ended[i]:  # begun, and no step yet
                self.writer.next_episode -= 1
                self._facts[i] = plain_reset(now)

    def _put_finals(self, finals: dict[int, bytes]) -> None:
        """Ahead of the steps: the states that these bring are the next episodes' first ones."""
        running = [(i, episode) for i in finals if (episode := self._episodes[i]) is not None]
        if running:
            row = self.writer.put_final_states([(episode, finals[i]) for i, episode in running])
            self._final_rows.update((i, row + k) for k, (i, _) in enumerate(running))

    def _note_resets(self, holes: Array, infos: Mapping[str, Any]) -> None:
        of = reset_infos_of if self._autoreset.mode == "SameStep" else infos_of
        plain, chosen = plain_reset(time.time_ns()), holes.nonzero()[0].tolist()
        found = of(infos, chosen, self._n) if infos else [{}] * len(chosen)
        for i, info in zip(chosen, found, strict=True):
            self._facts[i] = plain._replace(info=jsonvalue.dumps_any(info)) if info else plain

    # ---- ends

    def _end(self, ends: Iterable[tuple[int, int]], *, known: bool = True) -> None:
        """Ends the running episodes of sub-environments: (sub-environment, how). `known`: the running states are their
        final ones."""
        writer, final_rows, now = self.writer, self._final_rows, None
        store = writer.vector
        for i, how in ends:
            episode, self._episodes[i] = self._episodes[i], None
            text, self._texts[i] = self._texts[i], "{}"
            if episode is None:
                continue
            self._waiting.add(i)
            now = time.time_ns() if now is None else now
            facts = episode, how, int(self._lengths[i]), float(self._totals[i])
            if i in final_rows:
                writer.end_episode(*facts, None, text, final_rows.pop(i), now)
            else:
                state = store.pending_state(i) if known and store is not None else None
                writer.end_episode(*facts, state, text, -1, now)

    @property
    def is_running(self) -> bool:
        """True if a sub-environment is within an episode."""
        if self._deriving:
            return bool((self._lengths > 0).any() and not self._ended.all())
        return any(episode is not None for episode in self._episodes)

    def go_on_from(self, before: VectorRecorder, states: Any) -> None:
        """Takes over from the recorder of the file before, between episodes, with the sub-environments at `states`."""
        before._derive_pending()
        self.derives_episodes = before.derives_episodes
        self.writer.layout = before.writer.layout
        self.writer.lost_streams = set(range(self._n))
        self._facts, self._earlier = before._facts, before._earlier
        self._ended, self._any_ended = before._ended, before._any_ended
        self._was_reset, self._refused = before._was_reset, before._refused
        self._first = copy_of(states)

    def refuse(self) -> None:
        """After a batch that could not be stored: running episodes end before it, and a reset must follow."""
        self._refused = True
        self._final_rows.clear()
        self.writer.lost_streams.update(range(self._n))
        if not self.writer.closed:
            self._derive_pending()
            self._end([(i, INTERRUPTED) for i in range(self._n) if self._lengths[i]])
        # nobody knows the random streams, nor what resets without a step have made of them
        self._facts, self._earlier = [None] * self._n, [[] for _ in range(self._n)]

    def close(self) -> None:
        """Ends the running episodes as interrupted and closes the recording."""
        if self.writer.closed:
            return
        self._derive_pending()
        self._end([(i, INTERRUPTED) for i in range(self._n)])
        self._refused = True
        self.writer.close()
