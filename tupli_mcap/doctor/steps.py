"""Checks of the steps of an episode in their order: frozen cameras, reward outliers, clock jumps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import Finding, Severity, duration, share
from tupli_mcap.doctor.measurements import Measurements, Statistic, StepPlace
from tupli_mcap.errors import plural
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import Block
from tupli_mcap.spaces.leaves import Leaf

_SECOND = 10**9
_SAMPLE_SIZE = 1 << 16
_FEWEST_REWARDS = 20
_ROUNDING = 1e-9  # of the median: rewards that differ by less are equal, but for the rounding of sums
_KINDS = (  # of steps whose rewards are judged together
    "before the last steps of episodes",
    "among the last steps of episodes without a terminal",
    "among terminal steps",
)
# The standard deviation of a normal distribution is 1.4826 times its median absolute deviation. Source: B. Iglewicz and
# D. C. Hoaglin, How to Detect and Handle Outliers, ASQC 1993, chapter 3.
_MAD_TO_STD = 1.4826


class Sample:
    """Keeps every n-th of about `total` values, at most 65,536. seen: how many values were put."""

    def __init__(self, total: int) -> None:
        self._stride = max(1, -(-total // _SAMPLE_SIZE))
        self._parts: list[Array] = []
        self.seen = 0

    def put(self, values: Array) -> None:
        self._parts.append(values[-self.seen % self._stride :: self._stride].copy())
        self.seen += len(values)

    @property
    def values(self) -> Array:
        return np.concatenate(self._parts) if self._parts else np.empty(0)


class Largest:
    """Keeps the `k` largest values with their places, the largest first; of equal values, the first ones."""

    def __init__(self, k: int = 64) -> None:
        self._k = k
        self.values: list[tuple[float, StepPlace]] = []

    def put(self, values: Array, locate: Callable[[int], StepPlace]) -> None:
        least = self.values[-1][0] if len(self.values) == self._k else -np.inf
        candidates = np.flatnonzero(values > least)
        candidates = candidates[np.argsort(-values[candidates], kind="stable")[: self._k]]
        self.values += [(float(values[i]), locate(int(i))) for i in candidates]
        self.values.sort(key=lambda item: (-item[0], item[1]))
        del self.values[self._k :]

    def may_hide(self, found: int, total: int) -> bool:
        """Whether there may be more than `found` among `total` values: all that are kept are found."""
        return found == len(self.values) < total


class Frames(Statistic):
    """The images of a leaf, or the frames of a camera, of which `name` is a leaf's path or says the camera.

    images: returns the episode, step and bytes of each in a block; equal frames of a camera have equal bytes.
    seen: how many there are; repeated: how many of them equal the one before in their episode, in every pixel.
    longest: how many such there are in a row at most; place: the first of these.
    """

    def __init__(self, name: str, images: Callable[[Block], Iterator[tuple[int, int, bytes]]]) -> None:
        self.name, self._images = name, images
        self.seen = self.repeated = self.longest = self._run = 0
        self.place = self._began = (0, 0)
        self._last = (-1, b"")

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[Frames]:
        recording = measured.recording
        leaves = [cls(leaf.path, partial(_of_leaf, leaf)) for leaf in measured.layout.images]
        cameras = recording.cameras
        return [*leaves, *(cls(f"camera {one!r}", partial(_of_camera, recording, one)) for one in cameras)]

    def put(self, block: Block) -> None:
        for episode, step, image in self._images(block):
            self.seen += 1
            self._run = self._run + 1 if (episode, image) == self._last else 0
            self._last = episode, image
            self.repeated += self._run > 0
            if self._run == 1:
                self._began = episode, step
            if self._run > self.longest:
                self.longest, self.place = self._run, self._began


def _of_leaf(leaf: Leaf, block: Block) -> Iterator[tuple[int, int, bytes]]:
    steps = np.arange(len(block)) - np.repeat(block.starts, block.lengths) + block.first_step
    episodes = np.repeat(block.rows["episode"], block.lengths)
    for episode, step, image in zip(episodes.tolist(), steps.tolist(), block.leaves[leaf.name], strict=True):
        yield episode, step, image.tobytes()


def _of_camera(recording: Recording, camera: str, block: Block) -> Iterator[tuple[int, int, bytes]]:
    if block.first_step == 0:  # else the frames of this episode are known
        for episode, position in zip(block.rows["episode"].tolist(), block.positions.tolist(), strict=True):
            frames = recording.frames(position, camera)
            for i, step in enumerate(frames.steps.tolist()):
                yield episode, step, frames.encoded(i).data


def frozen_frames(measured: Measurements, *, frames: int = 30) -> Iterator[Finding]:
    """A frozen camera: `frames` or more consecutive frames of an episode are equal in every pixel.

    Images of the state and frames that were recorded beside it are checked. Shorter runs are usual, for instance after
    an action without effect, or while a game waits.
    """
    for images in measured.statistics(Frames):
        if images.longest + 1 < frames:
            continue
        count, total, places = images.repeated, images.seen, measured.places([images.place])
        length = images.longest + 1
        message = (
            f"{length:,} frames in a row are equal; {share(count, total)} of all frames repeat the one before"
        )
        advice = "check whether the camera or the renderer hung, and cut these steps out"
        path, warning = measured.path, Severity.WARNING
        yield Finding("frozen-frames", warning, path, message, advice, images.name, (), count, total, places)


class Rewards(Statistic):
    """A sample and the extremes of one scalar reward, in the steps of one kind.

    kind: which steps, as an index in `_KINDS`.
    """

    def __init__(self, leaf: Leaf, total: int, kind: int) -> None:
        self.leaf = leaf
        self.kind = kind
        self.sample = Sample(total)
        self.highest, self.lowest = Largest(), Largest()

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[Rewards]:
        leaves = [leaf for leaf in measured.layout.reward if leaf.kind != "variable" and leaf.size == 1]
        totals = (measured.steps, len(measured.rows), len(measured.rows))
        return [cls(leaf, total, kind) for leaf in leaves for kind, total in enumerate(totals)]

    def put(self, block: Block) -> None:
        rewards = block.leaves[self.leaf.name].astype(np.float64).reshape(-1)
        kinds = np.zeros(len(rewards), np.int64)
        kinds[block.ends if block.whole else block.ends[:-1]] = 1
        kinds[block.columns.terminals] = 2
        steps = np.flatnonzero((kinds == self.kind) & np.isfinite(rewards))
        self.sample.put(rewards[steps])
        self.highest.put(rewards[steps], lambda i: block.place(int(steps[i])))
        self.lowest.put(-rewards[steps], lambda i: block.place(int(steps[i])))


def reward_outliers(measured: Measurements, *, factor: float = 300) -> Iterator[Finding]:
    """Rewards further than `factor` scales from the median.

    Terminal steps, the last steps of other episodes, and all steps before are judged apart, because a reward of success
    or failure, or a bonus at the end, is usual: such rewards are outliers only among their own kind. The scale is
    1.4826 times the median absolute deviation. If most rewards are equal, up to rounding, it is the larger of the
    median's magnitude and the median of the deviations that are not 0 (if there are at least three). Nothing is found
    if the scale is 0, or below 20 rewards. Of more than 65,536 rewards, a sample gives the median and the scale.
    """
    for rewards in measured.statistics(Rewards):
        if rewards.sample.seen < _FEWEST_REWARDS:
            continue
        median, scale = _scale(rewards.sample.values)
        limit = factor * scale
        high = [(value, place) for value, place in rewards.highest.values if value - median > limit]
        low = [(-value, place) for value, place in rewards.lowest.values if median + value > limit]
        if scale == 0 or not (high or low):
            continue
        outliers = sorted(high + low, key=lambda item: (-abs(item[0] - median), item[1]))
        count, total = len(outliers), rewards.sample.seen
        places = measured.places(place for _, place in outliers)
        hidden = rewards.highest.may_hide(len(high), total) or rewards.lowest.may_hide(len(low), total)
        message = (
            f"{'at least ' if hidden else ''}{plural(count, 'reward')} {'is' if count == 1 else 'are'} further than "
            f"{factor:g} times the usual deviation ({scale:.3g}) from the median ({median:.3g}), "
            f"{_KINDS[rewards.kind]}; the furthest is {outliers[0][0]:g}"
        )
        advice = "look at these steps; if the rewards are right, clip or scale them for training"
        yield measured.finding(
            "reward-outliers", Severity.WARNING, message, advice, count, total, places, rewards.leaf
        )


def _scale(values: Array) -> tuple[float, float]:
    """The median, and the usual distance of values from it."""
    with np.errstate(over="ignore", invalid="ignore"):  # nothing is far from a median beyond all floats
        median = float(np.median(values))
        deviations = np.abs(values - median)
        deviations[deviations <= _ROUNDING * abs(median)] = 0
        spread = _MAD_TO_STD * float(np.median(deviations))
    if spread > 0:
        return median, spread
    others = deviations[deviations > 0]
    return median, max(abs(median), float(np.median(others)) if len(others) >= 3 else 0.0)


class Clock(Statistic):
    """A sample and the longest of the times (ns) from one step to the next inside episodes."""

    def __init__(self, measured: Measurements) -> None:
        self.gaps = Sample(measured.steps)
        self.longest = Largest()
        self._last = 0  # the time of the last step of the block before

    def put(self, block: Block) -> None:
        times = block.columns.times
        gaps = np.diff(times, prepend=self._last)
        inside = np.ones(len(times), np.bool_)
        inside[block.starts] = False
        inside[0] = block.first_step > 0
        self._last = int(times[-1])
        steps = np.flatnonzero(inside)
        self.gaps.put(gaps[steps])
        self.longest.put(gaps[steps], lambda i: block.place(int(steps[i])))


def clock_jump(
    measured: Measurements, *, factor: float = 1000, least_s: float = 1.0, warn_s: float = 600.0
) -> Iterator[Finding]:
    """Long pauses between two steps of an episode: at least `factor` times the median, and `least_s` seconds.

    An info, because a policy that is trained between steps pauses too. A warning from `warn_s` seconds on, which points
    to a suspended machine, or a clock that was set.
    """
    for clock in measured.statistics(Clock):
        if not clock.gaps.seen:
            continue
        median = float(np.median(clock.gaps.values))
        limit = max(factor * median, least_s * _SECOND)
        pauses = [(gap, place) for gap, place in clock.longest.values if gap >= limit]
        if not pauses:
            continue
        (longest, _), count, total = pauses[0], len(pauses), clock.gaps.seen
        more = "at least " if clock.longest.may_hide(count, total) else ""
        message = (
            f"{more}{plural(count, 'step')} came after a pause inside an episode, the longest of {duration(longest)}; "
            f"the median is {duration(median)}"
        )
        advice = "leave these episodes out if timing matters, as on a robot"
        severity = Severity.WARNING if longest >= warn_s * _SECOND else Severity.INFO
        places = measured.places(place for _, place in pauses)
        yield measured.finding("clock-jump", severity, message, advice, count, total, places)
