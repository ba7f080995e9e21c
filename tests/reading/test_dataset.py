"""Datasets: filters, arrays, batches and samples, over files and over storages."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
import threading
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import run
from environments import Sampler, Scripted, roll, same

import tupli_mcap
from tupli_mcap import progress
from tupli_mcap.arrays import Array
from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.dataset import (
    BaseTupleParser,
    DatasetError,
    NumpyTupleParser,
    TensorflowTupleParser,
    TorchTupleParser,
    TupliDataset,
    sources,
)
from tupli_mcap.dataset.columns import load
from tupli_mcap.dataset.curate import trim
from tupli_mcap.errors import (
    FilterError,
    FormatError,
    MissingExtraError,
    RecordingError,
    SpaceError,
    StorageError,
    TupliError,
)
from tupli_mcap.recording import EpisodeData, write_recording
from tupli_mcap.schema import Episode, EpisodeItem, EpisodeMetadataCallback, F, FilterEQ, RLTuple
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.listing import list_recordings
from tupli_mcap.vector import RecordEpisodes as RecordVector
from tupli_mcap.wrappers import RecordEpisodes

Taken = list[tuple[Any, ...]]


class Return(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.total = 0.0

    def reset(self) -> None:
        self.total = 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.total += float(tuple.reward)
        return {"score": self.total, "good": self.total > 20}


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1, **options: Any) -> Taken:
    with RecordEpisodes(env, path, **options) as recorder:
        return roll(recorder, steps, seed)


def column(taken: Taken, place: int) -> Array:
    return np.array([step[place] for step in taken])


@pytest.fixture
def cart(tmp_path: Path) -> tuple[TupliDataset, Taken]:
    """Two CartPole recordings and their 700 steps; the last episode of each is interrupted."""
    taken = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 400, 1, metadata_callback=Return())
    taken += record(tmp_path / "b.mcap", gym.make("CartPole-v1"), 300, 2, metadata_callback=Return())
    return TupliDataset.from_files(str(tmp_path / "*.mcap")), taken


@pytest.fixture(params=[1, load._BLOCK_BYTES], ids=["episode by episode", "at once"])
def blocks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(load, "_BLOCK_BYTES", request.param)
    return int(request.param)


# --- columns ---


def test_cartpole_comes_back_exactly(cart: tuple[TupliDataset, Taken], blocks: int) -> None:
    dataset, taken = cart
    states, actions, rewards, terminals, timeouts = dataset.convert_to_numpy(mark_cuts=False)
    assert (states.dtype, actions.dtype, rewards.dtype) == (np.float32, np.int64, np.float64)
    assert terminals.dtype == timeouts.dtype == np.bool_
    for place, found in enumerate((states, actions, rewards, terminals, timeouts)):
        np.testing.assert_array_equal(found, column(taken, place))
    np.testing.assert_array_equal(dataset.next_states, column(taken, 5))
    assert len(dataset) == 700 == len(dataset.tuples)


def test_the_recorded_dtype_wins_over_the_declared_one(tmp_path: Path) -> None:
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    with pytest.warns(UserWarning, match="float64"):
        taken = record(tmp_path / "a.mcap", Scripted(lambda step: np.array([0.1, step]), space), 25)
    states, *_ = TupliDataset.from_files(tmp_path / "a.mcap").convert_to_numpy()
    assert states.dtype == np.float64
    np.testing.assert_array_equal(states, column(taken, 0))


def test_dict_observations_are_nested_columns(tmp_path: Path, blocks: int) -> None:
    space = gym.spaces.Dict(
        {
            "camera": gym.spaces.Box(0, 255, (4, 5, 3), np.uint8),
            "joints": gym.spaces.Tuple(
                [gym.spaces.Box(-1, 1, (2,), np.float64), gym.spaces.Discrete(3, start=-1)]
            ),
        }
    )
    taken = record(tmp_path / "a.mcap", Sampler(space, gym.spaces.MultiDiscrete([3, 4])), 30)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    d4rl = dataset.convert_to_d4rl_format()
    for name, place in (("observations", 0), ("next_observations", 5)):
        states = d4rl[name]
        assert list(states) == ["camera", "joints"]
        np.testing.assert_array_equal(states["camera"], [step[place]["camera"] for step in taken])
        assert isinstance(states["joints"], tuple)
        np.testing.assert_array_equal(states["joints"][0], [step[place]["joints"][0] for step in taken])
        np.testing.assert_array_equal(states["joints"][1], [step[place]["joints"][1] for step in taken])
    assert all(same(item.state, step[0]) for item, step in zip(dataset.tuples, taken, strict=True))
    front = dataset.with_tuple_filter((F("state.joints.1") == -1) & (F("action.0") < 2))
    wanted = [s for s in taken if s[0]["joints"][1] == -1 and s[1][0] < 2]
    assert 0 < len(front) == len(wanted) < 30
    assert all(same(item.state, step[0]) for item, step in zip(front.tuples, wanted, strict=True))


def test_text_observations_are_lists(tmp_path: Path, blocks: int) -> None:
    space = gym.spaces.Dict({"word": gym.spaces.Text(8), "at": gym.spaces.Box(-1, 1, (), np.float32)})
    env = Sampler(space, gym.spaces.Sequence(gym.spaces.Box(0, 1, (2,), np.float32), stack=True))
    taken = record(tmp_path / "a.mcap", env, 30)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    states, actions, *_ = dataset.convert_to_numpy()
    assert states["word"] == [step[0]["word"] for step in taken]
    assert states["at"].shape == (30,)
    assert all(same(a, step[1]) for a, step in zip(actions, taken, strict=True))
    assert dataset.next_states["word"] == [step[5]["word"] for step in taken]
    assert same(dataset.tuples[3].state["at"], np.asarray(taken[3][0]["at"]))
    word = taken[11][0]["word"]
    found = dataset.with_tuple_filter(F("state.word") == word)
    assert set(found.observations["word"]) == {word}
    assert [item.state["word"] for item in found.tuples] == [word] * len(found)


def test_next_states_never_cross_episodes(cart: tuple[TupliDataset, Taken], blocks: int) -> None:
    dataset, taken = cart
    d4rl = dataset.convert_to_d4rl_format()
    np.testing.assert_array_equal(d4rl["next_observations"], column(taken, 5))
    ends = np.flatnonzero(d4rl["terminals"])
    assert len(ends) > 10
    inner = np.ones(700, bool)
    inner[ends] = False
    inner[[399, 699]] = False
    np.testing.assert_array_equal(
        d4rl["next_observations"][inner], d4rl["observations"][np.flatnonzero(inner) + 1]
    )
    assert (d4rl["next_observations"][ends[:-1]] != d4rl["observations"][ends[:-1] + 1]).any(axis=1).all()


def test_terminals_and_timeouts_are_kept_apart(tmp_path: Path) -> None:
    env = gym.make("MountainCar-v0", max_episode_steps=40)
    record(tmp_path / "a.mcap", env, 100)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    d4rl = dataset.convert_to_d4rl_format()
    assert list(d4rl) == ["observations", "actions", "next_observations", "rewards", "terminals", "timeouts"]
    assert not d4rl["terminals"].any()
    assert np.flatnonzero(d4rl["timeouts"]).tolist() == [39, 79, 99], "the last one is an interruption"
    assert np.flatnonzero(dataset.timeouts).tolist() == [39, 79]
    raw = dataset.convert_to_d4rl_format(mark_cuts=False)
    assert np.flatnonzero(raw["timeouts"]).tolist() == [39, 79]


def test_cuts_by_a_tuple_filter_are_marked(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", Sampler(gym.spaces.Discrete(9), gym.spaces.Discrete(2), length=6), 18)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap").with_tuple_filter(F("step").isin([0, 1, 3, 4]))
    *_, terminals, timeouts = dataset.convert_to_numpy()
    assert len(terminals) == 12
    assert not terminals.any()
    assert timeouts.tolist() == [False, True] * 6
    *_, terminals, timeouts = (
        dataset.with_tuple_filter(None).with_tuple_filter(F("step") > 3).convert_to_numpy()
    )
    assert terminals.tolist() == [False, True, False, True, False, False]
    assert timeouts.tolist() == [False, False, False, False, False, True]


def test_episodes_by_flags_are_the_recorded_ones(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    *_, terminals, timeouts = dataset.convert_to_numpy()
    ends = np.flatnonzero(terminals | timeouts)
    assert np.diff(ends, prepend=-1).tolist() == [header.n_tuples for header in dataset.preview()]


def test_an_unknown_final_state_repeats_the_last_one(tmp_path: Path) -> None:
    episodes = [EpisodeData([0, 1, 2], [0] * 3, [1.0] * 3, [False] * 3, [False] * 3) for _ in range(2)]
    write_recording(
        tmp_path / "a.mcap",
        episodes,
        observation_space=gym.spaces.Discrete(5),
        action_space=gym.spaces.Discrete(2),
    )
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    assert dataset.next_states.tolist() == [1, 2, 2, 1, 2, 2]


def test_infos_are_dicts(tmp_path: Path) -> None:
    env = Scripted(lambda step: step, gym.spaces.Discrete(50), info=lambda step: {"wind": step / 2}, length=5)
    record(tmp_path / "a.mcap", env, 12, record_info=True)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    assert [info["wind"] for info in dataset.infos] == [0.5, 1, 1.5, 2, 2.5] * 2 + [0.5, 1]
    assert dataset.tuples[1].info == {"wind": 1.0}
    strong = dataset.with_tuple_filter(F("info.wind") > 2)
    assert strong.observations.tolist() == [4, 4]
    assert strong.infos == [{"wind": 2.5}] * 2


def test_gymnasiums_names(tmp_path: Path) -> None:
    env = Scripted(lambda step: step, gym.spaces.Discrete(50), length=5)
    record(tmp_path / "a.mcap", env, 12)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    assert dataset.observations is dataset.states and dataset.next_observations is dataset.next_states
    assert dataset.terminations is dataset.terminals and dataset.truncations is dataset.timeouts
    for names in (
        ("state", "states", "observation", "observations"),
        ("next_state", "next_states", "next_observation", "next_observations"),
        ("terminal", "terminals", "terminated", "terminations"),
        ("timeout", "timeouts", "truncated", "truncations"),
        ("action", "actions"),
        ("reward", "rewards"),
    ):
        found = [len(dataset.with_tuple_filter(F(name).isin([True, 3]))) for name in names]
        assert found == found[:1] * len(names), names


# --- one array from several recordings ---


def make(path: Path, states: list[Any], space: gym.Space[Any], action: gym.Space[Any] | None = None) -> Path:
    n = len(states)
    actions = [0] * n if action is None else [action.sample() for _ in range(n)]
    write_recording(
        path,
        [EpisodeData(states, actions, [1.0] * n, [False] * n, [False] * n)],
        observation_space=space,
        action_space=action or gym.spaces.Discrete(2),
    )
    return path


def test_dtypes_are_widened_where_nothing_is_lost(tmp_path: Path) -> None:
    narrow = [np.array([0.25], np.float32)] * 2
    wide = [np.array([0.1])] * 3
    a = make(tmp_path / "a.mcap", narrow, gym.spaces.Box(-1, 1, (1,), np.float32))
    b = make(tmp_path / "b.mcap", wide, gym.spaces.Box(-1, 1, (1,), np.float64))
    for order in ([a, b], [b, a]):
        found = TupliDataset.from_files(order).observations
        assert found.dtype == np.float64
        assert sorted(found[:, 0].tolist()) == [0.1, 0.1, 0.1, 0.25, 0.25]


@pytest.mark.parametrize(
    ("other", "states", "words"),
    [
        (gym.spaces.Box(-1, 1, (3,), np.float32), np.zeros(3, np.float32), r"float32 of shape \(3,\)"),
        (gym.spaces.Box(-1, 1, (2,), np.int32), np.zeros(2, np.int32), r"int32 of shape \(2,\)"),
        (gym.spaces.Box(0, 1, (2,), np.bool_), np.zeros(2, np.bool_), "bool of shape"),
        (gym.spaces.Text(5), "word", "found Text in"),
        (gym.spaces.Dict(a=gym.spaces.Discrete(3)), {"a": 1}, r"found state\.a in"),
    ],
    ids=["shape", "kind", "bool", "variable", "structure"],
)
def test_what_does_not_fit_into_one_array_is_named(
    tmp_path: Path, other: gym.Space[Any], states: Any, words: str
) -> None:
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    a = make(tmp_path / "a.mcap", [np.zeros(2, np.float32)] * 2, space)
    b = make(tmp_path / "b.mcap", [states] * 2, other)
    dataset = TupliDataset.from_files([a, b])
    assert len(dataset.preview()) == 2, "listing needs no common space"
    with pytest.raises(SpaceError, match=f"state.*a.mcap.*{words}.*b.mcap.*by a filter of run.env"):
        dataset.load()


def test_int64_and_uint64_do_not_become_floats(tmp_path: Path) -> None:
    a = make(tmp_path / "a.mcap", [np.int64(1)], gym.spaces.Box(-9, 9, (), np.int64))
    b = make(tmp_path / "b.mcap", [np.uint64(1)], gym.spaces.Box(0, 9, (), np.uint64))
    with pytest.raises(SpaceError, match=r"int64 of shape .* uint64 of shape"):
        TupliDataset.from_files([a, b]).load()


# --- filters ---


def test_expressions_and_functions_choose_the_same_steps(
    cart: tuple[TupliDataset, Taken], blocks: int
) -> None:
    dataset, taken = cart
    by_columns = dataset.with_tuple_filter((F("state[0]") > 0) & (F("action") == 1))
    by_function = dataset.with_tuple_filter(lambda t: t.state[0] > 0 and t.action == 1)
    wanted = [step for step in taken if step[0][0] > 0 and step[1] == 1]
    assert 0 < len(wanted) < 700
    for found in (by_columns, by_function):
        np.testing.assert_array_equal(found.convert_to_numpy()[0], column(wanted, 0))
        np.testing.assert_array_equal(found.convert_to_d4rl_format()["next_observations"], column(wanted, 5))
        assert len(found) == len(wanted)
    assert len(dataset) == 700


def test_tuple_filters_narrow(cart: tuple[TupliDataset, Taken], blocks: int) -> None:
    dataset, taken = cart
    asked: list[RLTuple] = []
    right = dataset.with_tuple_filter(F("action") == 1)
    both = right.with_tuple_filter(lambda t: asked.append(t) or t.state[0] > 0).with_tuple_filter(
        "state.2 < 0"
    )  # type: ignore[func-returns-value]
    wanted = [step for step in taken if step[1] == 1 and step[0][0] > 0 and step[0][2] < 0]
    assert 0 < len(wanted) < 700
    np.testing.assert_array_equal(both.convert_to_numpy()[0], column(wanted, 0))
    assert len(asked) == len(right), "a function is asked about steps that earlier filters chose"
    assert re.search(r'steps where F\("action"\) == 1 and .*<lambda> and F\("state.2"\) < 0', repr(both))
    assert len(both.with_tuple_filter(None)) == 700


def test_steps_count_within_their_episode(cart: tuple[TupliDataset, Taken], blocks: int) -> None:
    dataset, _ = cart
    starts = dataset.with_tuple_filter(F("step") == 0)
    assert len(starts) == len(dataset.preview())
    assert [len(item.tuples) for item in starts.episodes] == [1] * len(starts)
    assert len(dataset.with_tuple_filter(F("next_state.0") > 1e9)) == 0


def test_a_function_sees_an_rltuple(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    seen: list[RLTuple] = []
    len(dataset.with_tuple_filter(lambda t: not seen.append(t)))  # type: ignore[func-returns-value]
    assert all(isinstance(item, RLTuple) for item in seen)
    assert all(same(item.state, step[0]) for item, step in zip(seen, taken, strict=True))
    assert {type(item.reward) for item in seen} == {float}
    assert {type(item.terminal) for item in seen} == {bool}


def test_a_pickled_dataset_reads_the_same(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    left = dataset.with_tuple_filter(filter_fcn=F("action") == 0)
    left.load()
    copy = pickle.loads(pickle.dumps(left))
    assert len(copy) == len(left)
    assert np.array_equal(copy.observations, left.observations)


def test_episode_filters_narrow(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    good = dataset.with_episode_filter(F("metadata.good") == True)  # noqa: E712
    assert {header.metadata["good"] for header in good.preview()} == {True}
    bad = dataset.with_episode_filter(F("metadata.good") == False)  # noqa: E712
    assert len(bad.preview()) + len(good.preview()) == len(dataset.preview())
    assert len(good) + len(bad) == 700
    first = good.with_episode_filter("episode < 10").with_episode_filter("env == 0")
    assert first.preview() == [header for header in good.preview() if header.episode < 10]
    assert good.with_episode_filter(F("metadata.good") == False).preview() == []  # noqa: E712
    assert len(good.with_episode_filter(None)) == 700
    with pytest.raises(FilterError, match="expected a filter, such as"):
        good.with_episode_filter(True)  # type: ignore[arg-type]
    cut = dataset.with_episode_filter(F("end") == "interrupted")
    assert [header.recording[-6:] for header in cut.preview()] == ["a.mcap", "b.mcap"]


def test_filters_are_checked_at_once(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    with pytest.raises(FilterError, match=r"unknown key 'nonsense'.*metadata"):
        dataset.with_episode_filter(F("nonsense") == 1)
    with pytest.raises(FilterError, match="unknown key 'score'"):
        dataset.with_benchmark_filter(F("score") == 1)
    with pytest.raises(FilterError, match=r"unknown key 'obs'.*state"):
        dataset.with_tuple_filter(F("obs") == 1)
    with pytest.raises(FilterError, match="expected a filter, such as"):
        dataset.with_episode_filter(True)  # type: ignore[arg-type]
    with pytest.raises(FilterError, match="expected a function of one tuple or an expression"):
        dataset.with_tuple_filter(3)  # type: ignore[arg-type]


@pytest.mark.parametrize("key", ["metadata.goood", "run.metadata.goood"])
def test_metadata_that_no_episode_has_is_an_error(
    cart: tuple[TupliDataset, Taken], lab: FileStorage, key: str
) -> None:
    store(lab, "CartPole-v1", 5)
    for dataset in (cart[0], TupliDataset(lab)):
        wrong = dataset.with_episode_filter(F(key) > 0)
        for read in (wrong.preview, wrong.load, wrong.convert_to_numpy, lambda wrong=wrong: len(wrong)):
            with pytest.raises(FilterError, match=f"no episode has {key}"):
                read()
    with pytest.raises(FilterError, match=r"did you mean 'good'\?"):
        cart[0].with_episode_filter("metadata.goood > 0").preview()


def test_a_tuple_filter_that_does_not_fit_says_so(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    with pytest.raises(FilterError, match=r"'state\.7' names no number: .* state\[0\] to state\[3\]"):
        len(dataset.with_tuple_filter(F("state.7") > 0))
    with pytest.raises(FilterError, match="expected True or False from a tuple filter"):
        dataset.with_tuple_filter(lambda t: t.state > 0).load()
    with pytest.raises(ZeroDivisionError, match="by zero"):
        dataset.with_tuple_filter(lambda t: 1 / 0 > 0).load()


def test_filters_that_leave_nothing(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    none = dataset.with_tuple_filter(F("reward") > 5)
    assert [array.shape for array in none.convert_to_numpy()] == [(0, 4), (0,), (0,), (0,), (0,)]
    assert [array.dtype for array in none.convert_to_numpy()[:2]] == [np.float32, np.int64]
    assert [item.tuples for item in none.episodes] == [[]] * len(none.episodes)
    empty = dataset.with_episode_filter(F("n_tuples") > 10_000)
    assert (len(empty), empty.preview(), list(empty.tuples), list(empty.episodes)) == (0, [], [], [])
    assert [len(array) for array in empty.convert_to_numpy()] == [0] * 5
    assert empty.sample_episodes(3) == []
    assert list(empty.as_batch_generator(8)) == []
    assert len(empty.convert_to_d4rl_format()["next_observations"]) == 0


# --- laziness and consistency ---


def test_nothing_is_read_before_it_is_needed(
    cart: tuple[TupliDataset, Taken], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = cart
    asked: list[tuple[str, ...]] = []
    original = load._read_block
    monkeypatch.setattr(load, "_read_block", lambda *args: asked.append(tuple(args[3])) or original(*args))
    good = dataset.with_episode_filter(F("metadata.score") > 20)
    good.preview()
    assert len(good) > 0
    assert len(good.episodes) > 0
    assert asked == []
    assert len(good.rewards) == len(good.rewards)
    assert asked == [("rewards",)] * 2, "one field of each recording, once"
    asked.clear()
    assert len(good.with_tuple_filter(F("action") == 1).rewards) > 0
    assert asked == [("rewards", "actions", "terminals")] * 2
    asked.clear()
    good.load()
    good.convert_to_numpy()
    assert asked == [("states", "actions", "terminals", "timeouts")] * 2


def test_only_the_asked_episodes_are_read(
    cart: tuple[TupliDataset, Taken], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = cart
    read: list[int] = []
    original = load._read_block
    monkeypatch.setattr(load, "_read_block", lambda *args: read.extend(args[1]) or original(*args))
    chosen = dataset.with_episode_filter(F("episode").isin([2, 5]))
    chosen.load()
    assert read == [2, 5, 2, 5]
    read.clear()
    assert len(dataset.sample_episodes(1)[0].tuples) > 0
    assert len(read) == 1


def test_memory_is_bounded_by_what_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    space = gym.spaces.Box(-np.inf, np.inf, (20_000,), np.float64)
    env = Scripted(lambda step: np.full(20_000, float(step)), space, length=10)
    record(tmp_path / "a.mcap", env, 200)  # 32 MB
    monkeypatch.setattr(load, "_BLOCK_BYTES", 1 << 20)
    monkeypatch.setattr(sources, "_CACHE_BYTES", 1 << 20)
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    tracemalloc.start()
    try:
        assert dataset.rewards.sum() == 200
        assert len(dataset.with_tuple_filter(F("state.7") == 4).rewards) == 20
        _, peak = tracemalloc.get_traced_memory()
        assert peak < 8 << 20
        dataset.load()
        assert tracemalloc.get_traced_memory()[1] > 32 << 20, "or this measures nothing"
    finally:
        tracemalloc.stop()


def test_converted_arrays_are_the_callers_own(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    dataset.load()
    first = dataset.convert_to_numpy()
    for array in first:
        array[:] = 0
    assert dataset.convert_to_numpy()[2].all()
    with pytest.raises(ValueError, match="read-only"):
        dataset.rewards[0] = 5
    with pytest.raises(ValueError, match="read-only"):
        dataset.tuples[0].state[0] = 5


def test_values_of_variable_size_are_the_callers_own(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    space = gym.spaces.Sequence(gym.spaces.Box(0, 9, (2,)), stack=True)
    states = [np.full((i % 3, 2), i, np.float32) for i in range(5)]
    infos = [{"near": list(range(i))} for i in range(5)]
    none = [False] * 5
    data = EpisodeData(states, [0] * 5, [0.0] * 5, none, none, infos=infos)
    write_recording(path, [data], observation_space=space, action_space=gym.spaces.Discrete(2))
    dataset = TupliDataset.from_files(path)
    dataset.load()
    windows = dataset.windows(2, pad="repeat", fields=["states", "infos"])
    changes: list[Callable[[], Any]] = [
        lambda: windows[1].states[0].fill(7),
        lambda: windows[1].infos["near"][0].append(7),
        lambda: windows[4].states[0].fill(7),
        lambda: dataset.convert_to_numpy()[0][1].fill(7),
        lambda: next(dataset.as_batch_generator(5, parser=NumpyTupleParser))[0][1].fill(7),
    ]
    for change in changes:
        change()
        assert same(windows[1].states, states[1:3]) and windows[1].infos == {"near": [[0], [0, 1]]}
        assert same(list(dataset.states), states)


def test_a_derived_dataset_is_another_one(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    dataset.load()
    left = dataset.with_tuple_filter(F("action") == 0)
    right = dataset.with_tuple_filter(F("action") == 1)
    assert len(left) + len(right) == len(dataset) == 700
    assert not left.actions.any()
    assert right.actions.all()
    assert left.with_episode_filter(F("episode") == 0).preview() != left.preview()


def test_a_recording_that_grows(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    env = RecordEpisodes(Sampler(gym.spaces.Discrete(9), gym.spaces.Discrete(2), length=1000), path)
    env.reset(seed=1)
    for _ in range(5):
        env.step(0)
    dataset = TupliDataset.from_files(path)
    assert [header.end for header in dataset.preview()] == ["interrupted"]
    for _ in range(5):
        env.step(1)
    assert dataset.convert_to_numpy()[1].tolist() == [0] * 5, "what was listed"
    dataset.load()
    assert dataset.actions.tolist() == [0] * 5 + [1] * 5
    env.close()
    assert len(dataset) == 10


def test_an_episode_is_found_without_a_copy_of_all_numbers(tmp_path: Path) -> None:
    """Going through all of them would take time with the square of their number."""
    n, path = 10_000, tmp_path / "a.mcap"
    with tupli_mcap.EpisodeWriter(path, gym.spaces.Discrete(2), gym.spaces.Discrete(2)) as writer:
        for _ in range(n):
            writer.begin()
            writer.step(0, 0, 0.0)
            writer.end(0)
    dataset = tupli_mcap.open(path)
    assert dataset[0].number == 0
    tracemalloc.start()
    try:
        assert dataset[n // 2].number == n // 2
        assert tracemalloc.get_traced_memory()[1] < 4 * n
    finally:
        tracemalloc.stop()


def test_episodes_of_a_recording_that_grows_are_saved(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path, chunk_size=2000) as env:
        roll(env, 300)
        before = tupli_mcap.open(path)[:-1]
        lengths, rewards = before.lengths, [episode.rewards for episode in before]
        roll(env, 300)  # its steps go from the journal to chunks behind the end of the file that was opened
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            before.save(tmp_path / "saved.mcap")
    with tupli_mcap.Recording(tmp_path / "saved.mcap") as saved:
        assert saved.lengths.tolist() == lengths.tolist()
        assert same(saved.read(["rewards"]).rewards, np.concatenate(rewards))


def test_an_episode_that_grows_is_trimmed_as_it_is_by_then(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    env = RecordEpisodes(Sampler(gym.spaces.Discrete(9), gym.spaces.Discrete(2), length=1000), path)
    env.reset(seed=1)
    for _ in range(5):
        env.step(0)
    dataset = tupli_mcap.open(path)
    assert dataset.lengths.tolist() == [5]
    for _ in range(15):
        env.step(1)
    report = trim(dataset, slice(8, -2), tmp_path / "new.mcap", dry_run=True)
    assert (report.steps, report.left_out) == (10, 10)
    assert tupli_mcap.open(dataset.trim(slice(8, -2), tmp_path / "new.mcap")).lengths.tolist() == [10]
    assert len(dataset[0]) == len(dataset[0].states) == 20
    assert dataset.read(["actions"]).actions.tolist() == [0] * 5, "what was listed"
    env.close()


def test_a_listed_episode_that_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    record(path, gym.make("CartPole-v1"), 100)
    dataset = TupliDataset.from_files(path)
    dataset.preview()
    record(path, gym.make("CartPole-v1"), 5, mode="w")
    with pytest.raises(StorageError, match=r"another recording was listed.*load\(\)"):
        dataset.convert_to_numpy()
    dataset.load()
    assert len(dataset) == 5


def test_episodes_asked_for_before_a_new_listing(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    taken = record(path, gym.make("CartPole-v1"), 50)
    dataset = TupliDataset.from_files(path)
    episodes = dataset.episodes
    record(path, gym.make("CartPole-v1"), 50, mode="a")
    assert len(dataset.preview()) > len(episodes)
    steps = [item for episode in episodes for item in episode.tuples]
    assert all(same(item.state, step[0]) for item, step in zip(steps, taken, strict=True))


# --- tuples and episodes ---


def test_tuples_are_a_sequence(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    tuples = dataset.tuples
    assert same(tuples[-1].state, taken[-1][0])
    assert [t.action for t in tuples[10:20:3]] == [step[1] for step in taken[10:20:3]]
    assert len(tuples[5:][5:]) == 690
    assert repr(tuples[:3]) == "<3 tuples>"
    with pytest.raises(IndexError, match="expected an index of tuples from 0 to 699, found 700"):
        tuples[700]
    assert [t.reward for t in dataset] == [1.0] * 700


def test_episodes_carry_their_steps(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    episodes = dataset.episodes
    assert all(isinstance(item, EpisodeItem) for item in episodes)
    steps = [item for episode in episodes for item in episode.tuples]
    assert all(same(item.state, step[0]) for item, step in zip(steps, taken, strict=True))
    assert [len(item.tuples) for item in episodes] == [header.n_tuples for header in dataset.preview()]
    assert episodes[-1].id == dataset.preview()[-1].id
    assert [item.id for item in episodes[1:3]] == [header.id for header in dataset.preview()[1:3]]
    assert "tuples" in episodes[0].model_dump()
    with pytest.raises(IndexError, match="expected an index of episodes from 0"):
        episodes[1000]


# --- batches, samples, seeds ---


def test_batches_hold_every_step_once(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    batches = list(dataset.as_batch_generator(64))
    assert [len(batch) for batch in batches] == [64] * 10 + [60]
    assert all(isinstance(item, RLTuple) for batch in batches for item in batch)
    np.testing.assert_array_equal([item.state for batch in batches for item in batch], column(taken, 0))
    shuffled = [item.state for batch in dataset.as_batch_generator(64, shuffle=True) for item in batch]
    assert not np.array_equal(shuffled, column(taken, 0))
    assert sorted(map(tuple, np.array(shuffled).tolist())) == sorted(map(tuple, column(taken, 0).tolist()))


def test_batches_of_arrays(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    for batch in dataset.as_batch_generator(100, parser=NumpyTupleParser):
        assert [len(array) for array in batch] == [100] * 5
        batch[0][:] = 0
    np.testing.assert_array_equal(dataset.observations, column(taken, 0))


def test_seeds_make_draws_repeat(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    np.random.seed(0)
    before = np.random.get_state()[1].copy()  # type: ignore[index, union-attr]

    def draw(of: TupliDataset) -> list[Any]:
        sample = [item.id for item in of.sample_episodes(5)]
        return [sample, [t.state.tolist() for b in of.as_batch_generator(50, shuffle=True) for t in b]]

    dataset.set_seed(7)
    first, second = draw(dataset), draw(dataset)
    assert first != second
    dataset.set_seed(7)
    assert draw(dataset) == first
    assert draw(dataset.with_tuple_filter(None)) == first, "a derived dataset starts from the same seed"
    dataset.set_seed(8)
    assert draw(dataset) != first
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # type: ignore[index]


def test_samples_are_whole_episodes(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, taken = cart
    dataset.set_seed(3)
    items = dataset.with_tuple_filter(F("step") == 0).sample_episodes(1000)
    assert sorted(item.id for item in items) == sorted(header.id for header in dataset.preview())
    assert [item.id for item in items] != [header.id for header in dataset.preview()]
    assert sum(len(item.tuples) for item in items) == 700
    place = {header.id: header for header in dataset.preview()}
    firsts = {step[0].tobytes() for step in taken}
    for item in items:
        assert len(item.tuples) == place[item.id].n_tuples
        assert item.tuples[0].state.tobytes() in firsts


def test_numbers_that_make_no_sense(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    with pytest.raises(DatasetError, match="batch size that is an integer from 1, found 0"):
        dataset.as_batch_generator(0)
    with pytest.raises(DatasetError, match="number of episodes that is an integer from 0, found -1"):
        dataset.sample_episodes(-1)
    with pytest.raises(DatasetError, match=r"seed that is an integer from 0, found 1\.5"):
        dataset.set_seed(1.5)  # type: ignore[arg-type]
    assert issubclass(DatasetError, TupliError)


# --- parsers and frames ---


def test_a_parser_of_ones_own(cart: tuple[TupliDataset, Taken]) -> None:
    class Floats(BaseTupleParser):
        @classmethod
        def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> tuple[Any, ...]:
            return NumpyTupleParser.parse_lists(
                obs, list(act), np.array(rew, np.float32).tolist(), term, trunc
            )

    dataset, _ = cart
    states, actions, rewards, *_ = dataset.convert_to_tensors(Floats)
    assert (states.dtype, actions.dtype, rewards.dtype) == (np.float32, np.int64, np.float64)
    with pytest.raises(NotImplementedError, match="BaseTupleParser has no parse_lists"):
        dataset.convert_to_tensors(BaseTupleParser)


def test_torch_tensors(cart: tuple[TupliDataset, Taken]) -> None:
    torch = pytest.importorskip("torch")
    dataset, taken = cart
    states, actions, rewards, terminals, timeouts = dataset.convert_to_tensors(TorchTupleParser)
    assert [t.dtype for t in (states, actions, rewards)] == [torch.float32, torch.int64, torch.float64]
    assert terminals.dtype == timeouts.dtype == torch.bool
    np.testing.assert_array_equal(states.numpy(), column(taken, 0))


@pytest.mark.parametrize(
    ("module", "parser", "install"),
    [
        ("torch", TorchTupleParser, r"pip install .*\[torch\]"),
        ("tensorflow", TensorflowTupleParser, "pip install tensorflow"),
    ],
)
def test_missing_libraries_are_named(
    cart: tuple[TupliDataset, Taken], monkeypatch: pytest.MonkeyPatch, module: str, parser: Any, install: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=install):
        cart[0].convert_to_tensors(parser)


def test_missing_pandas_is_named(cart: tuple[TupliDataset, Taken], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[pandas\]"):
        cart[0].convert_to_dataframe()


def test_dataframe(cart: tuple[TupliDataset, Taken]) -> None:
    pytest.importorskip("pandas")
    dataset, taken = cart
    frame = dataset.with_tuple_filter(F("step") < 2).convert_to_dataframe()
    assert list(frame.columns[:2]) == ["episode", "step"]
    assert len(frame) == 2 * len(dataset.preview())
    assert frame["step"].tolist() == [0, 1] * len(dataset.preview())
    assert frame["episode"].tolist() == sorted([*range(len(dataset.preview()))] * 2)
    assert frame["rewards"].dtype == np.float64
    assert frame["terminals"].dtype == np.bool_
    np.testing.assert_array_equal(frame["observations"][0], taken[0][0])
    np.testing.assert_array_equal(frame["next_observations"][0], taken[0][5])


# --- files ---


def test_where_files_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "deep" / "er").mkdir(parents=True)
    for name in ("b.mcap", "a.mcap", "deep/c.mcap", "deep/er/d [1].mcap"):
        record(tmp_path / name, gym.make("CartPole-v1"), 10)
    monkeypatch.chdir(tmp_path)

    def names(files: Any) -> list[str]:
        headers = TupliDataset.from_files(files).preview()
        return list(dict.fromkeys(Path(header.recording).name for header in headers))

    assert names("*.mcap") == ["a.mcap", "b.mcap"]
    assert names("**/*.mcap") == ["a.mcap", "b.mcap", "c.mcap", "d [1].mcap"]
    assert names(["b.mcap", Path("a.mcap"), "b.mcap"]) == ["b.mcap", "a.mcap"]
    assert names("deep/er/d [1].mcap") == ["d [1].mcap"]
    assert names(tmp_path / "deep" / "c.mcap") == ["c.mcap"]
    assert names([tmp_path / "deep", "a.mcap"]) == ["c.mcap", "d [1].mcap", "a.mcap"]


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no file matches .*runs/\*\.mcap"):
        TupliDataset.from_files(str(tmp_path / "runs/*.mcap"))
    with pytest.raises(RecordingError, match=r"x\.mcap does not exist; give"):
        TupliDataset.from_files(tmp_path / "x.mcap")
    with pytest.raises(RecordingError, match="expected at least one recording, found none"):
        TupliDataset.from_files(tmp_path)
    with pytest.raises(RecordingError, match="expected a path, found an empty text"):
        TupliDataset.from_files("")
    with pytest.raises(RecordingError, match="expected at least one recording"):
        TupliDataset.from_files([])
    with pytest.raises(RecordingError, match="expected the path of a recording or a pattern, found 3"):
        TupliDataset.from_files([3])  # type: ignore[list-item]
    (tmp_path / "bad.mcap").write_bytes(b"not this")
    with pytest.raises(FormatError, match=r"bad\.mcap"):
        TupliDataset.from_files(tmp_path / "bad.mcap").preview()
    with pytest.raises(StorageError, match=r"expected the directory of a storage.*tupli_mcap.open"):
        TupliDataset("runs/*.mcap")
    with pytest.raises(StorageError, match=r"there is no storage at '.*typo'"):
        TupliDataset(tmp_path / "typo")
    assert not (tmp_path / "typo").exists()
    assert TupliDataset(tmp_path).storage.root == tmp_path  # type: ignore[union-attr]


def test_a_copied_recording_counts_once(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 50)
    (tmp_path / "copy.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    dataset = TupliDataset.from_files(str(tmp_path / "*.mcap"))
    with pytest.warns(UserWarning, match=r"copy\.mcap holds \d+ episodes of .*a\.mcap again"):
        assert len(dataset) == 50


def test_urls(tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    taken = record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 50)
    dataset = TupliDataset.from_files((tmp_path / "a.mcap").as_uri())
    np.testing.assert_array_equal(dataset.observations, column(taken, 0))


def test_benchmarks_of_files(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 20)
    record(tmp_path / "b.mcap", gym.make("MountainCar-v0"), 20)
    dataset = TupliDataset.from_files(str(tmp_path / "*.mcap"))
    assert [header.metadata.name for header in dataset.benchmarks] == ["CartPole-v1", "MountainCar-v0"]
    cars = dataset.with_benchmark_filter(F("metadata.name") == "MountainCar-v0")
    assert [header.metadata.name for header in cars.benchmarks] == ["MountainCar-v0"]
    assert cars.observations.shape == (20, 2)
    with pytest.raises(SpaceError, match=r"state: expected float32 of shape \(4,\)"):
        dataset.load()


def test_vector_recordings(tmp_path: Path, blocks: int) -> None:
    envs = RecordVector(gym.make_vec("CartPole-v1", num_envs=4), tmp_path / "a.mcap")
    envs.reset(seed=1)
    envs.action_space.seed(1)
    for _ in range(100):
        envs.step(envs.action_space.sample())
    envs.close()
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    assert {header.env for header in dataset.preview()} == {0, 1, 2, 3}
    second = dataset.with_episode_filter(F("env") == 1)
    by_hand = [step.state for e in range(len(dataset.preview())) for step in _steps(dataset, e, 1)]
    np.testing.assert_array_equal(second.observations, by_hand)
    assert sum(len(dataset.with_episode_filter(F("env") == i)) for i in range(4)) == len(dataset)


def _steps(dataset: TupliDataset, episode: int, env: int) -> Iterator[RLTuple]:
    item = dataset.episodes[episode]
    return iter(item.tuples if item.env == env else [])


# --- storages ---


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[FileStorage]:
    with FileStorage(tmp_path / "lab") as storage:
        yield storage


def store(storage: FileStorage, name: str, steps: int, seed: int = 1) -> tuple[str, Taken]:
    with TupliEnvWrapper(gym.make(name), storage, metadata_callback=Return()) as env:
        uri = env.store(name=name)
        taken = roll(env, steps, seed)
    return uri, taken


def test_a_storage_by_benchmark(lab: FileStorage) -> None:
    cart, taken = store(lab, "CartPole-v1", 300)
    car, _ = store(lab, "MountainCar-v0", 250)
    dataset = TupliDataset(lab, info={"who": "me"})
    assert dataset.storage is lab
    assert len(dataset) == 550
    assert {header.id for header in dataset.benchmarks} == {cart, car}
    carts = dataset.with_benchmark_filter(FilterEQ(key="id", value=cart))
    assert carts.info == {"who": "me"}
    assert [header.id for header in carts.benchmarks] == [cart]
    np.testing.assert_array_equal(carts.convert_to_numpy()[0], column(taken, 0))
    good = carts.with_episode_filter(F("metadata.score") > 20)
    assert {header.benchmark_id for header in good.preview()} == {cart}
    assert all(item.metadata["score"] > 20 for item in good.episodes)
    named = dataset.with_benchmark_filter(F("metadata.name") == "MountainCar-v0")
    assert carts.with_benchmark_filter(F("metadata.name") == "MountainCar-v0").preview() == []
    assert named.observations.shape == (250, 2)
    assert dataset.with_benchmark_filter(F("metadata.name") == "nobody").preview() == []
    with pytest.raises(SpaceError, match="by a filter of run.environment or benchmark_id"):
        dataset.load()


def test_a_dataset_follows_its_storage(lab: FileStorage) -> None:
    uri, _ = store(lab, "CartPole-v1", 100)
    dataset = TupliDataset(lab).with_benchmark_filter(FilterEQ(key="id", value=uri))
    dataset.load()
    assert len(dataset) == len(dataset.rewards) == 100
    gone = dataset.preview()[0]
    lab.delete_episode(gone.id)
    assert len(dataset) == len(dataset.rewards) == 100, "until it is asked to list anew"
    assert gone.id not in {header.id for header in dataset.preview()}
    assert len(dataset) == len(dataset.rewards) == len(dataset.tuples) == 100 - gone.n_tuples
    store(lab, "CartPole-v1", 50, seed=2)
    dataset.load()
    assert len(dataset) == len(dataset.rewards) == 150 - gone.n_tuples
    files = TupliDataset.from_files(str(lab.root / "**" / "*.mcap"))
    assert len(files) == len(dataset), "what a storage has deleted stays deleted"


def test_episodes_built_by_hand(lab: FileStorage) -> None:
    uri, _ = store(lab, "CartPole-v1", 30)
    tuples = [RLTuple(state=[0.5, i], action=1, reward=i, terminal=i == 2) for i in range(3)]
    lab.record_episode(Episode(benchmark_id=uri, metadata={"hand": True}, tuples=tuples))
    made = TupliDataset(lab).with_episode_filter(F("metadata.hand") == True)  # noqa: E712
    assert made.observations.tolist() == [[0.5, 0], [0.5, 1], [0.5, 2]]
    assert made.rewards.tolist() == [0, 1, 2]
    assert made.terminals.tolist() == [False, False, True]


# --- display and progress ---


def test_repr_says_what_is_known(cart: tuple[TupliDataset, Taken]) -> None:
    dataset, _ = cart
    assert repr(dataset) == "<TupliDataset of 2 files: not listed yet>"
    n = len(dataset.preview())
    assert repr(dataset) == f"<TupliDataset of 2 files: {n} episodes, 700 steps>"
    right = dataset.with_tuple_filter(F("action") == 1)
    right.preview()
    assert '700 steps before the filter of steps; steps where F("action") == 1' in repr(right)
    assert f"{len(right)} of 700 steps" in repr(right)


def test_the_table_in_notebooks(tmp_path: Path) -> None:
    class Named(Return):
        def __call__(self, tuple: RLTuple) -> dict[str, Any]:
            return {"note": "<script>" + "x" * 200}

    record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 1000, metadata_callback=Named())
    dataset = TupliDataset.from_files(tmp_path / "a.mcap")
    table = dataset._repr_html_()
    assert table.count("<tr>") == 21
    assert "1,000 steps" in table
    assert f"… {len(dataset.preview()) - 20} more" in table
    assert "&lt;script&gt;" in table
    assert "<script>" not in table
    assert "x" * 150 not in table


def test_a_bar_after_a_second(
    cart: tuple[TupliDataset, Taken], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset, _ = cart
    dataset.load()
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    dataset.with_tuple_filter(None).load()
    assert capsys.readouterr() == ("", ""), "nobody is looking"
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich believe in a terminal
    threads = set(threading.enumerate())
    dataset.with_tuple_filter(None).load()
    out, err = capsys.readouterr()
    assert out == ""
    assert "Loading" in err
    assert set(threading.enumerate()) == threads


@pytest.mark.parametrize(
    ("work", "what"),
    [
        (lambda root: tupli_mcap.open(root).headers, "reading recordings"),
        (lambda root: list(list_recordings([root])), "reading recordings"),
        (lambda root: tupli_mcap.plots.report(root), "measuring recordings"),
        (lambda root: tupli_mcap.merge_recordings(sorted(root.glob("?.mcap")), root / "m.mcap"), "writing"),
        (lambda root: tupli_mcap.open(root).filter("episode > 2").save(root / "f.mcap"), "writing"),
        (lambda root: tupli_mcap.recover_recording(root / "a.mcap"), "recovering"),
        (lambda root: delete_and_compact(root), "writing"),
        (lambda root: show("delete", root, "--filter", "episode > 2"), "reading recordings"),
        (lambda root: show("tag", root, "--episodes", "all", "good=true"), "changing recordings"),
        (lambda root: show("edit", root, "--set", "lr=1"), "changing recordings"),
    ],
    ids=["open", "ls", "plot", "merge", "filter", "recover", "compact", "delete", "tag", "edit"],
)
def test_whatever_takes_long_shows_a_bar(
    work: Callable[[Path], Any],
    what: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in "ab":
        record(tmp_path / f"{name}.mcap", gym.make("CartPole-v1"), 400)
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_PAUSE", 0.0)
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich believe in a terminal
    work(tmp_path)
    lines = [line for line in capsys.readouterr().err.split("\r") if what in line]
    assert len(lines) > 2, "it moves"


def test_the_bar_of_a_few_episodes_knows_how_much_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "a.mcap", gym.make("CartPole-v1"), 400)
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_PAUSE", 0.0)
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    tupli_mcap.open(tmp_path / "a.mcap")[::5].save(tmp_path / "b.mcap")
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    done, total = re.findall(r"([\d.]+)/([\d.]+) (?:bytes|kB)", plain)[-1]
    assert 0.8 * float(total) <= float(done) <= 1.2 * float(total)


def show(*args: object) -> None:
    """Runs a command, and shows what it writes beside its output."""
    print(run(*args).err, end="", file=sys.stderr)


def delete_and_compact(root: Path) -> None:
    tupli_mcap.open(root / "a.mcap").filter("episode > 2").delete()
    FileStorage(root).compact()


def test_one_bar_shows_of_those_of_several_threads() -> None:
    program = (
        "import threading\n"
        "from tupli_mcap import progress\n"
        "progress._PATIENCE, progress._visible = 0.0, lambda: True\n"
        "bars = [progress.Progress(9, 'reading files', in_bytes=False) for _ in range(4)]\n"
        "threads = [threading.Thread(target=bar.advance, args=(1,)) for bar in bars]\n"
        "for thread in threads: thread.start()\n"
        "for thread in threads: thread.join()\n"
        "print(len(progress._shown))\n"
        "for bar in bars: bar.close()\n"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout == "1\n"


def test_a_bar_is_not_drawn_for_each_of_many_steps(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich believe in a terminal
    with progress.progress(100_000, "counting") as bar:
        began = time.monotonic()
        for _ in range(100_000):
            bar.advance(1)
        took = time.monotonic() - began
    assert 1 <= capsys.readouterr().err.count("counting") <= 10 * took + 4
