"""What only shows from one step to the next: frames that repeat, clocks that jump, rewards, flags inside."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from tupli_mcap.doctor.findings import MAX_PLACES
from tupli_mcap.doctor.gather.bounded import Extremes, Sample, runs_of_true
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.recording.blocks import Array, Block

__all__ = ["Clock", "Flags", "Frames", "Longest", "Rewards"]

_SLICE_BYTES = 1 << 20


class Longest(NamedTuple):
    """The longest run of steps that equal the one before: how many, and (episode, step) of the first of them."""

    length: int = 0
    place: tuple[int, int] = (0, 0)


class _Runs:
    """Runs of steps that equal the step before them in their episode, through blocks that end inside one."""

    def __init__(self) -> None:
        self.longest = Longest()
        self.repeated = 0
        self._open = Longest()  # the run at the end of a block that its episode goes on from

    def put(self, block: Block, equal: Array) -> None:
        """`equal[i]`: step i equals the one before; False at each episode's first step."""
        self.repeated += int(equal.sum())
        starts, lengths = runs_of_true(equal)
        carried = self._open if block.first_step else Longest()
        self._open = Longest()
        if not len(starts):
            return
        if starts[0] == 0:  # only where an episode goes on
            lengths[0] += carried.length
        at = int(np.argmax(lengths))
        for i in {at, len(starts) - 1}:
            place = carried.place if starts[i] == 0 and carried.length else block.place(int(starts[i]))
            run = Longest(int(lengths[i]), place)
            if run.length > self.longest.length:
                self.longest = run
            if not block.whole and starts[i] + lengths[i] - (carried.length if starts[i] == 0 else 0) == len(
                block
            ):
                self._open = run


class Frames(_Runs):
    """An image leaf: consecutive frames that are equal in every pixel."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__()
        self.leaf = leaf
        self._before: Array | None = None

    def put_block(self, block: Block) -> None:
        frames = block.leaves[self.leaf.name]
        flat = frames.reshape(len(frames), -1)
        equal = np.zeros(len(flat), np.bool_)
        stride = max(1, _SLICE_BYTES // max(1, flat.shape[1]))
        for start in range(1, len(flat), stride):
            stop = min(len(flat), start + stride)
            equal[start:stop] = (flat[start:stop] == flat[start - 1 : stop - 1]).all(axis=1)
        equal[block.starts] = False
        if block.first_step and self._before is not None:
            equal[0] = np.array_equal(flat[0], self._before)
        self._before = None if block.whole else flat[-1].copy()
        self.put(block, equal)


class Clock(_Runs):
    """Times from step to step inside episodes (ns): a sample, the longest, and steps at the same time."""

    def __init__(self) -> None:
        super().__init__()
        self.gaps = Sample()
        self.longest_gaps = Extremes()
        self._before: int | None = None

    def put_block(self, block: Block) -> None:
        times = block.columns.times
        gaps = np.diff(times, prepend=times[:1])
        inside = np.ones(len(times), np.bool_)
        inside[block.starts] = False
        if block.first_step and self._before is not None:
            gaps[0], inside[0] = times[0] - self._before, True
        self._before = None if block.whole else int(times[-1])
        self.put(block, inside & (gaps == 0))
        steps = np.flatnonzero(inside)
        self.gaps.put(gaps[steps])
        self.longest_gaps.put(gaps[steps], partial(_place_of, block, steps))


class Rewards:
    """One scalar reward: samples and extremes, apart for the last steps of episodes, where a bonus is usual."""

    def __init__(self, leaf: Leaf) -> None:
        self.leaf = leaf
        self.inner, self.last = Sample(), Sample()
        self.highest = {"inner": Extremes(), "last": Extremes()}
        self.lowest = {"inner": Extremes(), "last": Extremes()}

    def put(self, block: Block) -> None:
        rewards = block.leaves[self.leaf.name].astype(np.float64).reshape(-1)
        last = np.zeros(len(rewards), np.bool_)
        last[block.ends if block.whole else block.ends[:-1]] = True
        for kind, sample, mask in (("inner", self.inner, ~last), ("last", self.last, last)):
            steps = np.flatnonzero(mask & np.isfinite(rewards))
            values = rewards[steps]
            sample.put(values)
            locate = partial(_place_of, block, steps)
            self.highest[kind].put(values, locate)
            self.lowest[kind].put(-values, locate)


def _place_of(block: Block, steps: Array, i: int) -> tuple[int, int]:
    return block.place(int(steps[i]))


class Flags:
    """Terminals and timeouts: those before an episode's last step, and steps with both."""

    def __init__(self) -> None:
        self.inside = 0
        self.both = 0
        self.places: list[tuple[int, int]] = []

    def put(self, block: Block) -> None:
        flagged = block.columns.terminals | block.columns.timeouts
        self.both += int((block.columns.terminals & block.columns.timeouts).sum())
        last = np.zeros(len(flagged), np.bool_)
        last[block.ends if block.whole else block.ends[:-1]] = True
        steps = np.flatnonzero(flagged & ~last)
        self.inside += len(steps)
        self.places += [block.place(int(step)) for step in steps[: MAX_PLACES - len(self.places)]]
