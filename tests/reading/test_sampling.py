"""Random access to steps, against the episodes read one by one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import same
from sampled import SPACES, at, record

from tupli_mcap import Recording, TupliDataset
from tupli_mcap.dataset.items import FIELDS

PADDINGS = [("none", 1, 0), ("none", 3, 2), ("repeat", 2, 3), ("zero", 1, 1)]


def naive(paths: list[Path]) -> list[list[dict[str, Any]]]:
    """The steps of each episode, one by one."""
    found = []
    for path in paths:
        with Recording(path) as recording:
            for i in range(len(recording)):
                columns = recording.read(episodes=[i], fields=FIELDS)
                rows = range(len(columns))
                found.append([{name: at(getattr(columns, name), row) for name in FIELDS} for row in rows])
    return found


def naive_windows(
    lengths: list[int], length: int, stride: int, pad: str, history: int
) -> Iterator[tuple[int, list[int], list[bool]]]:
    """The episode, the rows of the steps in it, and which of them are there, window by window."""
    first = 0
    for episode, steps in enumerate(lengths):
        for start in range(0, steps, stride):
            start += history if pad == "none" else 0
            wanted = range(start - history, start + length)
            inside = [0 <= row < steps for row in wanted]
            if pad != "none" or all(inside):
                yield episode, [first + min(max(row, 0), steps - 1) for row in wanted], inside
        first += steps


@pytest.fixture(scope="module", params=SPACES)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    directory = tmp_path_factory.mktemp(request.param)
    space = SPACES[request.param]
    return [record(directory / f"{i}.mcap", space, 150 + i, seed=i) for i in range(3)]


@pytest.mark.parametrize("cache_bytes", [1 << 29, 4096])
def test_any_steps_in_any_order(recorded: list[Path], cache_bytes: int) -> None:
    expected = [step for episode in naive(recorded) for step in episode]
    steps = TupliDataset.from_files(recorded).with_cache(cache_bytes).steps
    rows = np.random.default_rng(0).integers(0, len(expected), 300)
    columns = steps.read(FIELDS, rows)
    for place, row in enumerate(rows):
        for name in FIELDS:
            assert same(at(columns[name], place), expected[row][name]), (name, row)


@pytest.mark.sampled(8)
@pytest.mark.parametrize(
    ("pad", "stride", "history"), [("none", 1, 0), ("none", 3, 2), ("repeat", 2, 3), ("zero", 1, 1)]
)
def test_windows_against_the_episodes(recorded: list[Path], pad: Any, stride: int, history: int) -> None:
    episodes = naive(recorded)
    steps = [step for episode in episodes for step in episode]
    windows = TupliDataset.from_files(recorded).windows(4, stride, pad, history, fields=["states", "rewards"])
    expected = list(naive_windows([len(e) for e in episodes], 4, stride, pad, history))
    assert len(windows) == len(expected)
    batch = windows[:]
    for i, (episode, rows, inside) in enumerate(expected):
        one = windows[i - len(expected)]
        assert one.episodes == batch.episodes[i] == episode
        assert one.mask.tolist() == batch.mask[i].tolist() == inside
        for place, (row, real) in enumerate(zip(rows, inside, strict=True)):
            if real or pad == "repeat":
                assert same(at(one.states, place), steps[row]["states"])
                assert same(at(at(batch.states, i), place), steps[row]["states"])
            else:
                assert one.rewards[place] == 0


def test_loaded_windows_are_those_of_the_recordings(recorded: list[Path]) -> None:
    recordings, loaded = TupliDataset.from_files(recorded), TupliDataset.from_files(recorded)
    loaded.load()
    assert type(loaded.steps) is not type(recordings.steps)
    for made in (
        lambda d: d.windows(3, pad="repeat", fields=FIELDS),
        lambda d: d.windows(3, fields=FIELDS),
        lambda d: d.transitions(2),
    ):
        found, expected = made(loaded)[5:90].asdict(), made(recordings)[5:90].asdict()
        assert found.keys() == expected.keys()
        assert all(same(found[name], expected[name]) for name in found)
