"""Episodes of one environment: from resets and steps to rows, starts and ends."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from tupli_mcap.errors import StepError, brief
from tupli_mcap.journal.derive import StartedEpisode
from tupli_mcap.messages.episodes import INTERRUPTED
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.variable.codec import variable_dtypes
from tupli_mcap.recording.write.episodes import ResetFacts, plain_reset
from tupli_mcap.recording.write.recorders.infos import InfoRecorder
from tupli_mcap.recording.write.rows.contract import Put
from tupli_mcap.recording.write.rows.single import SingleRows
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import (
    check_structure,
    decide_dtype,
    exact_array,
    exact_flag,
    leaf_value,
    shorten,
)


def decide_layout(
    spaces: StepLayout,
    states: list[Any],
    actions: list[Any],
    rewards: list[Any],
    recorded: StepLayout | None,
    *,
    batch: tuple[int, ...] = (),
) -> StepLayout:
    """The layout of a recording from its first values; on append, the one the file has.

    Args:
        batch: `(n,)` if each value is a batch, of `n` sub-environments with a layout of constant size.

    Raises:
        StepError: a value whose structure, shape or kind differs from its space.
    """
    if recorded is not None:
        return recorded
    dtypes, inner = {}, {}
    for leaves, roots in ((spaces.state, states), (spaces.action, actions), (spaces.reward, rewards)):
        for leaf in leaves:
            values = [leaf_value(root, leaf) for root in roots]
            if leaf.dtype is None:
                inner[leaf.name] = variable_dtypes(leaf.space, values, leaf.path)
                continue
            default_reward = leaf.name == "reward" and spaces.reward_space is None
            arrays = [np.asanyarray(value) for value in values] if batch else values  # of tensors, too
            dtype = leaf.dtype if default_reward else decide_dtype(leaf, arrays)
            for value in values:
                exact_array(value, dtype, (*batch, *leaf.shape), leaf.path)
            dtypes[leaf.name] = dtype
    return StepLayout(
        spaces.observation_space, spaces.action_space, spaces.reward_space, dtypes, inner, spaces.stacks
    )


def copy_of(state: Any) -> Any:
    """A copy of the first state, which the environment may change later. StepError if there is none."""
    try:
        return copy.deepcopy(state)
    except Exception as err:  # somebody else's class; a tensor of PyTorch that has a gradient
        raise StepError(f"state: expected arrays, found {shorten(state)} ({brief(err)})") from err


class SingleRecorder:
    """Records one environment's episodes, for a `Work` that is marked while any of this runs.

    `put` records a step. It is re-bound by state: `_unreset`, `_first`, `_replace`, that of the rows, `_continue`,
    `_refused`, `_closed`.
    `metadata` is the running episode's (a JSON text), written when it ends.
    """

    def __init__(
        self,
        writer: RecordingWriter,
        spaces: StepLayout,
        infos: InfoRecorder | None = None,
        *,
        derives_episodes: bool = False,
    ) -> None:
        self.derives_episodes = derives_episodes
        self.metadata = "{}"
        self.writer = writer
        self._spaces = spaces
        self._infos = infos
        self._reset: tuple[Any, ResetFacts] | None = None
        self._earlier: list[ResetFacts] = []  # resets before it that no step followed
        self._episode: StartedEpisode | None = None
        self._over: int | None = None  # how the last step ended its episode, until that is written
        self._rows: SingleRows | None = None  # if episodes are derived from them
        self.resets_itself = False  # the step after this end is a reset (gymnasium.wrappers.Autoreset)
        self.put: Put = self._unreset
        writer.on_close = self._stop
        writer.start_is_droppable = lambda: self._episode is not None and self.step_index == 0

    def _stop(self) -> None:
        self.put = self._closed
        self._over = self._rows = None  # or `begin_next` would go on

    def reset(self, state: Any, facts: ResetFacts) -> None:
        """Starts an episode at `state`; a running one ends as interrupted. StepError if the state cannot be stored
        exactly."""
        if self.writer.closed:
            self._closed()
        self._derive_pending()
        if self._reset is not None or self._episode is not None:
            self._keep_start_for(facts)
            self.end(INTERRUPTED)
            self.writer.sync_step()  # before the running state is written over
        rows = self.writer.rows
        self.put = self._unreset
        if rows is None:
            check_structure(self._spaces.observation_space, state, "state")
            self._reset = (copy_of(state), facts)
            self.put = self._first
            return
        writer = self.writer
        rows.begin_episode(writer.next_episode)
        rows.put_state(state)
        self._episode = writer.start_episode(0, rows.count, facts)
        self.put = self._replace if writer.lock.replaces else rows.put
        writer.sync_step()

    def leave_end(self, end: int) -> None:
        """As `end`, after a step with a flag set and without metadata; it is written later, with many others."""
        if self._rows is None:
            self.end(end)
            return
        self._over = end
        self.put = self._continue

    def begin_next(self, state: Any) -> bool:
        """As `reset` without facts, where `leave_end` was the last call; False if it was not, and nothing is done.
        StepError if the state cannot be stored exactly."""
        over, writer, rows = self._over, self.writer, self._rows
        if over is None or rows is None or writer.lost_streams:
            return False
        number = writer.next_episode
        rows.put_next(number, state)
        writer.next_episode += 1
        self._episode = StartedEpisode(number, 0, rows.count, 0, None, -1)
        self._over = None
        self.put = rows.put
        return True

    def _derive_pending(self) -> None:
        """Writes the ends and starts that were put off, so that all is as if each had been written when it happened."""
        writer, rows, episode = self.writer, self._rows, self._episode
        if rows is None or writer.events is None or episode is None:
            return
        over, self._over = self._over, None
        if episode.start_row >= 0:  # there is nothing but its end
            if over is not None:
                self.end(over)
            return
        rows.derive_pending(over=over is not None)
        self._episode = writer.events.running.get(episode.number)
        if episode.first_row == rows.count:  # begun, and no step yet
            writer.next_episode -= 1
            facts = plain_reset(time.time_ns())
            self._episode = writer.start_episode(0, rows.count, facts)

    def _keep_start_for(self, facts: ResetFacts) -> None:
        """A reset without a step is no episode, but one without a seed goes on with its random stream."""
        if self._reset is not None:
            if facts.goes_on:
                self._earlier.append(self._reset[1])
            else:
                self._earlier = []
        elif self._episode is not None and self.step_index == 0 and facts.goes_on:
            self.writer.keep_start()
            self._episode = None

    def end(self, end: int, *, has_final_state: bool = True) -> None:
        """Ends the running episode; an episode without a step is dropped."""
        self._derive_pending()
        episode, writer = self._episode, self.writer
        metadata, self.metadata = self.metadata, "{}"
        rows = writer.rows
        if episode is None or rows is None or writer.closed:
            return
        self._episode = None
        length = rows.count - episode.first_row
        if length == 0:
            writer.drop_start()
            return
        final = rows.pending_state() if has_final_state else None
        if self._rows is not None:
            self._rows.skip_pending()
        writer.end_episode(episode, end, length, rows.total, final, metadata)
        self.put = self._continue

    def refuse(self) -> None:
        """After a step that could not be stored: the episode ends before it, and a reset must follow."""
        self._forget(self._refused)

    def forget_reset(self) -> None:
        """After a reset that failed, wherever it left the environment: the episode ends, and a reset must follow."""
        self._forget(self._unreset)

    def _forget(self, put: Put) -> None:
        """Ends the episode; nobody knows the random stream, nor what resets without a step have made of it."""
        self.end(INTERRUPTED)
        self._reset, self._earlier = None, []
        self.writer.lost_streams.add(0)
        if not self.writer.closed:
            self.put = put

    @property
    def step_index(self) -> int:
        """Steps of the running episode so far."""
        if self._episode is None or self.writer.rows is None:
            return 0
        return self.writer.rows.count - self._episode.first_row

    @property
    def running(self) -> tuple[int, int]:
        """The number of the running episode and its steps so far; (-1, 0) if there is none."""
        return (-1, 0) if self._episode is None else (self._episode.number, self.step_index)

    def put_info(self, info: Mapping[str, Any]) -> None:
        """Records the info of the step just put."""
        if self._infos is not None and self._episode is not None:
            self._infos.put(self.writer, self._episode.number, self.step_index - 1, info)

    def _first(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        assert self._reset is not None
        first, facts = self._reset
        layout = decide_layout(self._spaces, [first, state], [action], [reward], self.writer.layout)
        for flag, name in ((terminal, "terminal"), (timeout, "timeout")):
            exact_flag(flag, name)  # before there is a file
        schema = None if self._infos is None else self._infos.codec.schema()
        writer = self.writer
        writer.begin(layout, 1, vector=False, info_schema=schema)
        self._reset = None
        rows = writer.rows
        assert rows is not None
        if self.derives_episodes and isinstance(rows, SingleRows) and rows.holds_episodes:
            self._rows, rows.events = rows, writer.events
        for earlier in self._earlier:
            writer.add_reset(0, rows.count, earlier)
        self._earlier = []
        self.reset(first, facts)
        self.put(action, state, reward, terminal, timeout)

    def _replace(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """The first step in a file that replaces another one, or the one after it was refused."""
        rows = self.writer.rows
        assert rows is not None
        rows.put(action, state, reward, terminal, timeout)
        self.put = rows.put
        self.writer.take_place()

    def _continue(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """A step after an end, without a reset: another episode, which starts at the last one's final state."""
        self._derive_pending()
        if self.resets_itself:
            self.reset(state, plain_reset(time.time_ns()))
            return
        rows = self.writer.rows
        assert rows is not None
        rows.begin_episode(self.writer.next_episode)
        facts = plain_reset(0, continued=True)
        self._episode = self.writer.start_episode(0, rows.count, facts)
        self.put = rows.put
        rows.put(action, state, reward, terminal, timeout)

    def go_on_from(self, before: SingleRecorder, state: Any) -> None:
        """Takes over from the recorder of the file before, between episodes, with the environment at `state`: a step
        without a reset begins an episode there."""
        before._derive_pending()
        self.writer.layout = before.writer.layout
        self.writer.lost_streams = {0}
        self.resets_itself = before.resets_itself
        if self.resets_itself and before._episode is None:
            self.put = self._continue
            return
        facts = plain_reset(time.time_ns(), continued=True)
        self._reset = (copy_of(state), facts)
        self.put = self._first

    def _unreset(self, *_: Any) -> None:
        raise StepError("expected a reset before the first step; call env.reset()")

    def _refused(self, *_: Any) -> None:
        raise StepError(
            "the step before this one could not be recorded; call env.reset() to go on with a new episode"
        )

    def close(self) -> None:
        """Ends the running episode as interrupted and closes the recording."""
        if self.writer.closed:
            return
        self.end(INTERRUPTED)
        self.writer.close()

    def _closed(self, *_: Any) -> None:
        raise self.writer.why_stopped()
