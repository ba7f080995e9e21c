"""Datasets for d3rlpy: in memory, or read as they are sampled.

An episode of d3rlpy is a sequence of consecutive steps. A tuple filter that leaves out steps of an episode cuts it into
several. Observations are an array, or a list of the arrays in a Dict or Tuple space; d3rlpy makes float32 of batches.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.dataset import Dataset, SavedColumns, TupliDataset
from tupli_mcap.dataset.items import SamplingError, Steps
from tupli_mcap.errors import missing_extra

try:
    from d3rlpy.constants import ActionSpace
    from d3rlpy.dataset import (
        BasicTransitionPicker,
        Episode,
        MDPDataset,
        ReplayBuffer,
        Signature,
        Transition,
        TransitionMiniBatch,
    )
except ImportError as err:
    raise missing_extra("tupli_mcap.torch.d3rlpy needs d3rlpy", "d3rlpy") from err

_FIELDS = ("states", "actions", "rewards")


def mdp_dataset(dataset: Dataset | TupliDataset | SavedColumns, **options: Any) -> MDPDataset:
    """The whole dataset in memory, as d3rlpy's MDPDataset; `options` are its other arguments.

    Raises:
        SamplingError: it is no dataset, or an empty one, or d3rlpy has no such spaces.
    """
    steps = _steps_of(dataset)
    kind, size = _actions_of(steps)
    rows = np.arange(len(steps))
    columns = steps.read([*_FIELDS, "terminals"], rows)
    cut = np.zeros(len(rows), np.bool_)
    cut[steps.breaks] = True
    return MDPDataset(
        observations=_observations(columns["states"]),
        actions=_two_dimensional(columns["actions"]),
        rewards=_two_dimensional(columns["rewards"]).astype(np.float32),
        terminals=columns["terminals"].astype(np.float32),
        timeouts=(cut & ~columns["terminals"]).astype(np.float32),
        **{"action_space": kind, "action_size": size, **options},
    )


def replay_buffer(dataset: Dataset | TupliDataset | SavedColumns, **options: Any) -> RecordedReplayBuffer:
    """A replay buffer that reads transitions when they are sampled, and keeps only the rewards (4 bytes a step).

    The same random numbers give the same batches as `mdp_dataset`. A batch of transitions is read at once;
    trajectories, and transitions of another picker than d3rlpy's basic one, are read episode by episode.

    Args:
        options: `transition_picker` and `trajectory_slicer` of d3rlpy's ReplayBuffer, ...

    Raises:
        SamplingError: it is no dataset, or an empty one, or d3rlpy has no such spaces.
    """
    return RecordedReplayBuffer(_steps_of(dataset), **options)


def _steps_of(dataset: Dataset | TupliDataset | SavedColumns) -> Steps:
    if not hasattr(dataset, "steps"):
        raise SamplingError(f"expected a dataset, such as tupli_mcap.open(path), found {dataset!r:.80}")
    return dataset.steps


class _Episodes(Sequence[Episode]):
    def __init__(self, buffer: RecordedBuffer) -> None:
        self._buffer = buffer

    def __len__(self) -> int:
        return len(self._buffer.firsts)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        return self._buffer.episode(range(len(self))[i])


class RecordedBuffer:
    """Recorded transitions by number, as d3rlpy's `BufferProtocol`; read-only."""

    def __init__(self, steps: Steps) -> None:
        rows = np.arange(len(steps))
        self.steps = steps
        flags = steps.read(["rewards", "terminals"], rows)
        self.rewards = _two_dimensional(flags["rewards"]).astype(np.float32)
        firsts, terminated = np.concatenate([[0], steps.breaks[:-1] + 1]), flags["terminals"][steps.breaks]
        sizes = steps.breaks - firsts + 1
        listed = (
            sizes > ~terminated
        )  # d3rlpy lists no episode without a transition: a single step that is no terminal
        self.firsts, self.sizes, self.terminated = firsts[listed], sizes[listed], terminated[listed]
        self.transition_ends = np.cumsum(self.sizes - ~self.terminated)
        one = steps.read(["states", "actions"], rows[:1])
        states = _observations(one["states"])
        self.signatures = (
            _signature(states if isinstance(states, list) else [states]),
            _signature([_two_dimensional(one["actions"])]),
            _signature([self.rewards[:1]]),
        )

    def append(self, episode: Any, index: int) -> None:
        """Refused: always raises SamplingError."""
        raise SamplingError(
            "this buffer of recorded steps is read-only; add steps to another, and join both in a MixedReplayBuffer"
        )

    @property
    def episodes(self) -> Sequence[Episode]:
        """The episodes that have a transition; each is read on access."""
        return _Episodes(self)

    def episode(self, number: int) -> Episode:
        """An episode, read now; nothing keeps it."""
        rows = self.firsts[number] + np.arange(self.sizes[number])
        columns = self.steps.read(["states", "actions"], rows)
        states, actions = _observations(columns["states"]), _two_dimensional(columns["actions"])
        return Episode(states, actions, self.rewards[rows], bool(self.terminated[number]))

    @property
    def transition_count(self) -> int:
        """The number of transitions of all episodes."""
        return int(self.transition_ends[-1]) if len(self.transition_ends) else 0

    def __len__(self) -> int:
        return self.transition_count

    def __getitem__(self, index: int) -> tuple[Episode, int]:
        number, place = self.places(np.array([range(len(self))[index]]))
        return self.episode(int(number[0])), int(place[0])

    def places(self, indices: Array) -> tuple[Array, Array]:
        """The episode of each transition, and its place in it: int64, as `indices`."""
        numbers = self.transition_ends.searchsorted(indices, side="right")
        before = self.transition_ends[numbers] - (self.sizes - ~self.terminated)[numbers]
        return numbers, indices - before

    def transitions(self, indices: Array) -> list[Transition]:
        """Transitions as `BasicTransitionPicker` makes them, read together."""
        numbers, places = self.places(indices)
        rows = self.firsts[numbers] + places
        last = self.firsts[numbers] + self.sizes[numbers] - 1
        over = rows == last  # then the episode is terminated
        both = np.concatenate([rows, np.minimum(rows + 1, last)])
        columns = self.steps.read(["states", "actions"], both)
        states, actions = _observations(columns["states"]), _two_dimensional(columns["actions"])
        for part in [*(states if isinstance(states, list) else [states]), actions]:
            part[len(rows) :][over] = 0
        n = len(rows)
        return [
            Transition(
                observation=_row(states, i),
                action=actions[i],
                reward=self.rewards[rows[i]],
                next_observation=_row(states, n + i),
                next_action=actions[n + i],
                terminal=float(over[i]),
                interval=1,
                rewards_to_go=self.rewards[rows[i] : last[i] + 1],
            )
            for i in range(n)
        ]


class RecordedReplayBuffer(ReplayBuffer):  # type: ignore[misc]  # untyped
    """A `ReplayBuffer` of recorded steps; see `replay_buffer`."""

    def __init__(self, steps: Steps, **options: Any) -> None:
        kind, size = _actions_of(steps)
        buffer = RecordedBuffer(steps)
        observation, action, reward = buffer.signatures
        given = {
            "observation_signature": observation,
            "action_signature": action,
            "reward_signature": reward,
            "action_space": kind,
            "action_size": size,
        }
        super().__init__(buffer, **{**given, **options})

    def sample_transition(self) -> Transition:
        """A transition, drawn at random."""
        if type(self._transition_picker) is not BasicTransitionPicker:
            return super().sample_transition()
        return self._buffer.transitions(np.array([np.random.randint(self.transition_count)]))[0]

    def sample_transition_batch(self, batch_size: int) -> TransitionMiniBatch:
        """A batch of transitions, read together."""
        if type(self._transition_picker) is not BasicTransitionPicker:
            return super().sample_transition_batch(batch_size)
        drawn = np.array([np.random.randint(self.transition_count) for _ in range(batch_size)])
        return TransitionMiniBatch.from_transitions(self._buffer.transitions(drawn))


def _actions_of(steps: Steps) -> tuple[ActionSpace, int]:
    """d3rlpy's kind of the action space, and its size."""
    if steps.layout is None or not len(steps):
        raise SamplingError("expected at least one step, found an empty dataset; look at its filters")
    space = steps.layout.action_space
    found = str(space)
    if isinstance(space, spaces.Discrete) and space.start == 0:
        # that is the space of the first recording, and another one may have more actions
        actions = steps.read(["actions"], np.arange(len(steps)))["actions"]
        if actions.min() >= 0:
            return ActionSpace.DISCRETE, max(int(space.n), int(actions.max()) + 1)
        found = f"the action {actions.min()}"
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return ActionSpace.CONTINUOUS, space.shape[0]
    raise SamplingError(
        f"expected Discrete actions from 0, or a Box of one dimension, found {found}: d3rlpy supports no others"
    )


def _observations(column: Any) -> Any:
    """An array, or a list of the arrays in a nested column."""
    parts = list(_arrays(column))
    return parts[0] if isinstance(column, np.ndarray) else parts


def _arrays(column: Any) -> Iterator[Array]:
    if isinstance(column, dict | tuple):
        for part in column.values() if isinstance(column, dict) else column:
            yield from _arrays(part)
    elif isinstance(column, np.ndarray):
        yield _two_dimensional(column)
    else:
        raise SamplingError("expected states of a fixed size, found some that vary: d3rlpy takes only arrays")


def _two_dimensional(column: Array) -> Array:
    return column[:, None] if column.ndim == 1 else column


def _signature(parts: Sequence[Array]) -> Signature:
    return Signature(dtype=[part.dtype for part in parts], shape=[part.shape[1:] for part in parts])


def _row(states: Any, i: int) -> Any:
    return [part[i] for part in states] if isinstance(states, list) else states[i]
