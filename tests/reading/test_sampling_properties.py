"""Windows, transitions, delta windows and samplers against oracles in plain Python, over any episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings, strategies as st

from tupli_mcap import F, TupliDataset
from tupli_mcap.dataset.items import SamplingError
from tupli_mcap.recording import EpisodeData, write_recording

SPACE = spaces.Box(0, 1e6, (2,), np.float64)


@dataclass
class Episode:
    """What an episode holds: the state of step i is `first + i`, its reward `rewards[i]`."""

    first: int
    rewards: list[int]
    end: str
    final_known: bool

    def __len__(self) -> int:
        return len(self.rewards)

    def terminal(self, step: int) -> bool:
        return self.end == "terminal" and step == len(self) - 1

    def next_state(self, step: int) -> int | None:
        """The state after a step, None if it was not recorded."""
        return self.first + step + 1 if step + 1 < len(self) or self.final_known else None


Library = list[list[Episode]]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Library, Path]]:
    """Some libraries of one to three recordings, and where they are."""
    found = []
    for seed in range(8):
        directory = tmp_path_factory.mktemp(f"library{seed}")
        library = list(_drawn(np.random.default_rng(seed)))
        for number, episodes in enumerate(library):
            write_recording(
                directory / f"{number}.mcap",
                map(_data, episodes),
                observation_space=SPACE,
                action_space=spaces.Discrete(9),
            )
        found.append((library, directory))
    return found


def _drawn(rng: np.random.Generator) -> Iterator[list[Episode]]:
    first = 0
    for _ in range(rng.integers(1, 4)):
        episodes = []
        for _ in range(rng.integers(1, 6)):
            rewards = rng.integers(0, 4, rng.integers(1, 8)).tolist()
            end = str(rng.choice(["terminal", "timeout", "interrupted"]))
            episodes.append(Episode(first, rewards, end, bool(rng.integers(0, 2))))
            first += 10
        yield episodes


def dataset_of(directory: Path, *, filtered: bool, cache_bytes: int = 1 << 20) -> TupliDataset:
    """All episodes of a directory; filtered: only steps with a reward."""
    dataset = TupliDataset.from_files(str(directory / "*.mcap")).with_cache(cache_bytes, threads=1)
    return dataset.with_tuple_filter(F("reward") > 0) if filtered else dataset


def _data(episode: Episode) -> EpisodeData:
    n = len(episode)
    last = [False] * (n - 1) + [True]
    none = [False] * n
    return EpisodeData(
        states=[np.full(2, episode.first + i, np.float64) for i in range(n)],
        actions=[i % 9 for i in range(n)],
        rewards=[float(reward) for reward in episode.rewards],
        terminals=last if episode.end == "terminal" else none,
        timeouts=last if episode.end == "timeout" else none,
        final_state=np.full(2, episode.first + n, np.float64) if episode.final_known else None,
        metadata={"score": episode.first // 10 % 3},
    )


def runs_of(library: Library, *, filtered: bool) -> Iterator[tuple[int, Episode, list[int]]]:
    """The runs of wanted steps that follow each other, with the place of their episode."""
    for place, episode in enumerate(episode for episodes in library for episode in episodes):
        run: list[int] = []
        for step, reward in enumerate(episode.rewards):
            if reward > 0 or not filtered:
                run.append(step)
            elif run:
                yield place, episode, run
                run = []
        if run:
            yield place, episode, run


LIBRARIES = given(
    number=st.integers(0, 7),
    filtered=st.booleans(),
    cache_bytes=st.sampled_from([1 << 20, 0]),
    data=st.data(),
)
FEW = settings(max_examples=30)


@FEW
@LIBRARIES
def test_windows(
    libraries: list[tuple[Library, Path]], number: int, filtered: bool, cache_bytes: int, data: st.DataObject
) -> None:
    library, directory = libraries[number]
    length, stride = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 3))
    history, pad = data.draw(st.integers(0, 2)), data.draw(st.sampled_from(["none", "repeat", "zero"]))
    expected = []
    for place, episode, run in runs_of(library, filtered=filtered):
        for start in range(0, len(run), stride):
            begin = start if pad == "none" else start - history
            places = list(range(begin, begin + length + history))
            inside = [0 <= i < len(run) for i in places]
            if pad == "none" and not all(inside):
                continue
            states = [episode.first + run[min(max(i, 0), len(run) - 1)] for i in places]
            if pad == "zero":
                states = [state if here else 0 for state, here in zip(states, inside, strict=True)]
            expected.append((place, inside, states))
    dataset = dataset_of(directory, filtered=filtered, cache_bytes=cache_bytes)
    if not expected:
        with pytest.raises(SamplingError, match="expected windows of at most|found an empty dataset"):
            dataset.windows(length, stride, pad, history)
        return
    windows = dataset.windows(length, stride, pad, history, fields=["states", "rewards"])
    assert len(windows) == len(expected) == windows.counts().sum()
    order = np.array(data.draw(st.lists(st.integers(0, len(expected) - 1), max_size=9)), np.int64)
    batch = windows[order]
    assert batch.states.shape == (len(order), length + history, 2) and batch.actions is None
    for i, item in enumerate(order.tolist()):
        one = windows[item]
        place, inside, states = expected[item]
        assert one.episodes == batch.episodes[i] == place
        assert one.mask.tolist() == batch.mask[i].tolist() == inside
        assert one.states[:, 0].tolist() == batch.states[i, :, 1].tolist() == states


@FEW
@LIBRARIES
def test_transitions(
    libraries: list[tuple[Library, Path]], number: int, filtered: bool, cache_bytes: int, data: st.DataObject
) -> None:
    library, directory = libraries[number]
    n, discount = data.draw(st.integers(1, 4)), data.draw(st.sampled_from([1.0, 0.5]))
    expected = [
        (place, *transition(episode, run, i, n, discount))
        for place, episode, run in runs_of(library, filtered=filtered)
        for i in range(len(run))
    ]
    dataset = dataset_of(directory, filtered=filtered, cache_bytes=cache_bytes)
    if not expected:
        with pytest.raises(SamplingError, match="found an empty dataset"):
            dataset.transitions(n, discount)
        return
    transitions = dataset.transitions(n, discount)
    batch = transitions[::-1]
    assert len(transitions) == len(expected)
    for item, wanted in enumerate(expected):
        for found, i in ((batch, len(expected) - 1 - item), (transitions[item : item + 1], 0)):
            assert (
                found.episodes[i], found.states[i, 0], found.rewards[i], found.next_states[i, 1],
                found.terminals[i], found.discounts[i], found.mask[i],
            ) == wanted  # fmt: skip
        assert transitions[item].discounts == wanted[-2]


def transition(
    episode: Episode, run: list[int], start: int, n: int, discount: float
) -> tuple[int, float, int, bool, float, bool]:
    """State, discounted sum, next state, terminal, what to bootstrap with, and whether all of it is known."""
    total, steps = 0.0, 0
    for step in run[start : start + n]:
        total += discount**steps * episode.rewards[step]
        steps += 1
    last, known = run[start + steps - 1], True
    if episode.next_state(last) is None and not episode.terminal(last):
        if steps == 1:
            known = False
        else:
            steps -= 1
            total -= discount**steps * episode.rewards[last]
            last -= 1
    after = episode.next_state(last)
    over = episode.terminal(last)
    next_state = episode.first + last if after is None else after
    return episode.first + run[start], total, next_state, over, 0.0 if over else discount**steps, known


@FEW
@LIBRARIES
def test_delta_windows(
    libraries: list[tuple[Library, Path]], number: int, filtered: bool, cache_bytes: int, data: st.DataObject
) -> None:
    library, directory = libraries[number]
    offsets = st.lists(st.integers(-4, 4), min_size=1, max_size=4)
    deltas = {"state": data.draw(offsets), "reward": data.draw(offsets), "next_state": [0]}
    unit = data.draw(st.sampled_from(["steps", "seconds"]))
    seconds = {key: [0.02 * n for n in values] for key, values in deltas.items()}
    dataset = dataset_of(directory, filtered=filtered, cache_bytes=cache_bytes)
    if not len(dataset):
        with pytest.raises(SamplingError, match="found an empty dataset"):
            dataset.delta_windows(deltas)
        return
    windows = dataset.delta_windows(
        deltas if unit == "steps" else seconds, unit, step_seconds=None if unit == "steps" else 0.02
    )
    batch, item = windows[:], 0
    for place, episode, run in runs_of(library, filtered=filtered):
        for i, step in enumerate(run):
            inside = {key: [0 <= i + d < len(run) for d in deltas[key]] for key in deltas}
            near = {key: [run[min(max(i + d, 0), len(run) - 1)] for d in deltas[key]] for key in deltas}
            after = episode.next_state(step)
            wanted = {
                "state": [episode.first + s for s in near["state"]],
                "reward": [episode.rewards[s] for s in near["reward"]],
                "next_state": [episode.first + step if after is None else after],
            }
            one = windows[item]
            assert one.episodes == batch.episodes[item] == place
            for key, values in wanted.items():
                assert batch[key][item].reshape(len(values), -1)[:, 0].tolist() == values
                assert one[key].reshape(len(values), -1)[:, -1].tolist() == values
                assert one.masks[key].tolist() == batch.masks[key][item].tolist() == inside[key]
            item += 1
    assert item == len(windows)
