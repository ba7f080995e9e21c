"""Steps of recordings of every origin, of many files, in other threads and processes, and what is refused."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from abandoned import abandon, cart_pole
from environments import Sampler, roll, same
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from test_sampling import naive

import tupli_mcap
from tupli_mcap import F, FileStorage, RecordEpisodes, Recording, TupliDataset
from tupli_mcap.dataset import open_columns
from tupli_mcap.dataset.columns.saved import save_columns
from tupli_mcap.dataset.items import FIELDS, ListedEpisodes, RecordedSteps, SamplingError, Windows, steps_of
from tupli_mcap.dataset.sources import FilesSource
from tupli_mcap.errors import NotFoundError, SpaceError
from tupli_mcap.recording import EpisodeData, write_recording
from tupli_mcap.vector import RecordEpisodes as RecordVector

IMAGE = spaces.Dict({"eye": spaces.Box(0, 255, (3, 4, 3), np.uint8), "x": spaces.Box(0, 1, (2,))})


def check(steps: Any, paths: list[Path], seed: int = 0) -> None:
    """Whether random rows are those of the episodes read one by one."""
    expected = [step for episode in naive(paths) for step in episode]
    assert len(steps) == len(expected)
    rows = np.random.default_rng(seed).integers(0, len(expected), 60)
    columns = steps.read(FIELDS, rows)
    for place, row in enumerate(rows.tolist()):
        for name in FIELDS:
            assert same(_at(columns[name], place), expected[row][name]), (name, row)


def _at(column: Any, row: int) -> Any:
    if isinstance(column, dict):
        return {key: _at(part, row) for key, part in column.items()}
    return column[row]


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("cache_bytes", [1 << 20, 0])
def test_vector_environments(tmp_path: Path, mode: AutoresetMode, cache_bytes: int) -> None:
    lengths = [4, 7, 5]
    envs = SyncVectorEnv(
        [lambda n=n: Sampler(IMAGE, spaces.Discrete(3), n) for n in lengths], autoreset_mode=mode
    )
    path = tmp_path / "v.mcap"
    with RecordVector(envs, path, chunk_size=2000) as recorder:
        recorder.reset(seed=3)
        for _ in range(60):
            recorder.step(recorder.action_space.sample())
    check(TupliDataset.from_files(path).with_cache(cache_bytes).steps, [path])


def test_steps_of_a_killed_recorder_and_of_one_at_work(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    abandon(path, cart_pole, 130)
    assert not Recording(path).complete
    check(TupliDataset.from_files(path).steps, [path])
    copied = pickle.loads(pickle.dumps(steps_of(Recording(path))))
    check(copied, [path])
    live = tmp_path / "live.mcap"
    with cart_pole(live) as env:
        roll(env, 100)
        steps = TupliDataset.from_files(live).steps
        expected = naive([live])
        roll(env, 300)  # the last episode goes on, chunks are written
        columns = steps.read(["states", "next_states"], np.arange(len(steps)))
    rows = [step for episode in expected for step in episode]
    assert [row.tolist() for row in columns["states"]] == [step["states"].tolist() for step in rows]
    others = np.setdiff1d(np.arange(len(rows)), steps.open_ends)
    assert all(same(columns["next_states"][i], rows[i]["next_states"]) for i in others.tolist())


@pytest.mark.parametrize("space", [IMAGE, spaces.Text(5)])
def test_episodes_that_went_on_since_they_were_listed(tmp_path: Path, space: spaces.Space[Any]) -> None:
    """What follows their last listed step is known by now: to the recordings as to columns made of them."""
    paths = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    with contextlib.ExitStack() as stack:
        envs = [
            stack.enter_context(RecordEpisodes(Sampler(space, spaces.Discrete(3), 9), path)) for path in paths
        ]
        for env in envs:
            roll(env, 30)
        source = FilesSource(paths)
        headers = source.episodes(None)
        for env in envs:
            for _ in range(3):
                env.step(env.action_space.sample())
        lengths = [header.n_tuples for header in headers]
        assert lengths == [9, 9, 9, 3] * 2
        steps = RecordedSteps(
            [ListedEpisodes.of(str(path), headers[4 * i : 4 * i + 4]) for i, path in enumerate(paths)],
            source.open,
        )
        kinds = [steps, pickle.loads(pickle.dumps(steps))]
        if space is IMAGE:
            save_columns(tmp_path / "columns", steps, headers, None)
            kinds.append(open_columns(tmp_path / "columns").steps)
        expected = [step for n, episode in zip(lengths, naive(paths), strict=True) for step in episode[:n]]
        for kind in kinds:
            assert len(kind) == len(expected) == 60
            assert len(kind.open_ends) == 0
            columns = kind.read(["states", "next_states"], np.arange(60)[::-1])
            for place, step in enumerate(reversed(expected)):
                for name, column in columns.items():
                    assert same(_at(column, place), step[name]), (type(kind), name, place)


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_other_compressions(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(
        Sampler(IMAGE, spaces.Discrete(3)), path, compression=compression, chunk_size=2000
    ) as env:
        roll(env, 50)
    for cache_bytes in (0, 1 << 20):
        check(steps_of(Recording(path), cache_bytes=cache_bytes), [path])


def test_recordings_of_different_dtypes(tmp_path: Path) -> None:
    """A leaf that is an image in one and an array in the other, names in another order, and a wider float."""
    small = spaces.Dict(a=spaces.Box(0, 255, (2, 2, 3), np.uint8), b=spaces.Box(0, 1, (), np.float32))
    wide = spaces.Dict(a=spaces.Box(-300, 300, (2, 2, 3), np.int16), b=spaces.Box(0, 1, (), np.float64))
    paths = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    for path, space in zip(paths, (small, wide), strict=True):
        with RecordEpisodes(Sampler(space, spaces.Discrete(3)), path) as env:
            roll(env, 20)
    for cache_bytes in (0, 1 << 20):
        steps = TupliDataset.from_files(paths).with_cache(cache_bytes).steps
        columns = steps.read(["states", "next_states"], np.array([0, 39, 20, 6]))
        whole = TupliDataset.from_files(paths)
        for name, expected in (("states", whole.observations), ("next_states", whole.next_states)):
            for leaf, dtype in (("a", np.int16), ("b", np.float64)):
                assert columns[name][leaf].dtype == dtype
                assert same(columns[name][leaf], expected[leaf][[0, 39, 20, 6]])


def test_spaces_that_do_not_fit(tmp_path: Path) -> None:
    paths = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    for path, n in zip(paths, (2, 3), strict=True):
        with RecordEpisodes(Sampler(spaces.Box(0, 1, (n,)), spaces.Discrete(3)), path) as env:
            roll(env, 8)
    with pytest.raises(SpaceError, match=r"state: expected float32 of shape \(2,\) as in .*0.mcap, found"):
        TupliDataset.from_files(paths).windows(2)


@pytest.mark.parametrize("other", [spaces.Box(0, 1, (3,)), spaces.Text(5), spaces.Dict(a=spaces.Discrete(3))])
def test_only_the_fields_that_are_read_must_fit(tmp_path: Path, other: spaces.Space[Any]) -> None:
    paths = [tmp_path / "0.mcap", tmp_path / "1.mcap"]
    for path, space in zip(paths, (spaces.Box(0, 1, (2,)), other), strict=True):
        with RecordEpisodes(Sampler(space, spaces.Discrete(3)), path) as env:
            roll(env, 20)
    for order in (paths, paths[::-1]):
        dataset = tupli_mcap.open(order)
        found = dataset.read(["rewards", "actions"])
        rewards = np.concatenate([Recording(path).read(fields=["rewards"]).rewards for path in order])
        assert same(found.rewards, rewards) and found.states is None
        assert same(dataset.windows(1, fields=["rewards"])[:].rewards[:, 0], rewards)
        assert same(dataset.transitions(fields=["rewards"])[:].rewards, rewards)
        assert same(dataset.delta_windows({"reward": [0]})[:].values["reward"][:, 0], rewards)
        assert dataset.stats(["rewards"])["rewards"].count == 40
        for use in (
            lambda dataset: dataset.read(["next_states"]),
            lambda dataset: dataset.windows(2),
            lambda dataset: dataset.transitions(fields=["next_states"]),
            lambda dataset: dataset.delta_windows({"state": [0]}),
            lambda dataset: dataset.stats(["states"]),
        ):
            with pytest.raises(SpaceError, match=r"state.*: expected .* as in .*.mcap, found"):
                use(dataset)


def test_many_files_keep_few_open(tmp_path: Path) -> None:
    source = tmp_path / "source.mcap"
    with RecordEpisodes(Sampler(spaces.Box(0, 1, (3,)), spaces.Discrete(3)), source, chunk_size=500) as env:
        roll(env, 40)
    names = [shutil.copy(source, tmp_path / f"{i}.mcap") for i in range(200)]
    listed = [ListedEpisodes(str(name), np.array([1, 3]), np.array([7, 7])) for name in names]
    before = len(list(Path("/proc/self/fd").iterdir()))
    steps = RecordedSteps(listed, Recording, cache_bytes=0, threads=4)
    assert len(steps) == 200 * 14 and len(list(Path("/proc/self/fd").iterdir())) <= before + 1
    rows = np.random.default_rng(0).permutation(len(steps))
    found = steps.read(["states"], rows)["states"]
    assert len(list(Path("/proc/self/fd").iterdir())) <= before + 64 + 4
    (one,) = (Recording(source).read(episodes=[1, 3], fields=["states"]).states,)
    assert np.array_equal(found, np.tile(one, (200, 1))[rows])


def test_more_recordings_than_a_process_may_have_open(tmp_path: Path) -> None:
    """`windows` needs few at once; `save` needs all, and the limit that was set can be raised."""
    for i in range(100):
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "many" / f"{i}.mcap", capture="none") as env:
            roll(env, 5)
    code = (
        "import resource, sys, tupli_mcap\n"
        "limit = 80 if sys.argv[1] == 'windows' else resource.getrlimit(resource.RLIMIT_NOFILE)[1]\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (80, limit))\n"
        "ds = tupli_mcap.open(sys.argv[2])\n"
        "assert len(ds.windows(1)) == ds.n_steps\n"
        "if sys.argv[1] == 'save': ds.save(sys.argv[3])\n"
    )
    for use in ("windows", "save"):
        saved = tmp_path / "all.mcap"
        subprocess.run([sys.executable, "-c", code, use, tmp_path / "many", saved], check=True, timeout=120)
    with Recording(saved) as recording:
        assert recording.n_steps == 500


def test_one_field_may_be_given_as_a_text(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(Sampler(spaces.Box(0, 1, (3,)), spaces.Discrete(3)), path) as env:
        roll(env, 40)
    dataset = TupliDataset.from_files(path)
    rows = np.array([0, 5])
    recorded = dataset.steps.read("rewards", rows)
    dataset.load()
    assert list(recorded) == ["rewards"]
    assert np.array_equal(dataset.steps.read("rewards", rows)["rewards"], recorded["rewards"])


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    directory = tmp_path_factory.mktemp("library")
    paths = [directory / f"{i}.mcap" for i in range(3)]
    for i, path in enumerate(paths):
        with RecordEpisodes(Sampler(IMAGE, spaces.Discrete(3), 6 + i), path, chunk_size=1500) as env:
            roll(env, 60, seed=i)
    return paths


def _digest(items: Any) -> list[float]:
    batch = items[np.arange(0, len(items), 7)]
    return [float(batch.rewards.sum()), float(batch.states["eye"].sum()), float(batch.states["x"].sum())]


@pytest.mark.parametrize(("method", "cache_bytes"), [("fork", 0), ("fork", 1 << 20), ("spawn", 1 << 20)])
def test_other_processes(library: list[Path], method: str, cache_bytes: int) -> None:
    windows = TupliDataset.from_files(library).with_cache(cache_bytes).windows(3, pad="repeat")
    expected = _digest(windows)
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert pool.map(_digest, [windows] * 4, chunksize=1) == [expected] * 4


def test_a_child_of_a_process_that_reads_in_threads(library: list[Path]) -> None:
    """Its locks may be held by threads that it has not."""
    windows = TupliDataset.from_files(library).with_cache(0, threads=2).windows(3)
    expected, stop = _digest(windows), threading.Event()

    def read() -> None:
        while not stop.is_set():
            _digest(windows)

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    try:
        for _ in range(5):
            child = multiprocessing.get_context("fork").Process(target=_exit_if, args=(windows, expected))
            child.start()
            child.join(30)
            assert child.exitcode == 7
    finally:
        stop.set()
        for reader in readers:
            reader.join()


def _exit_if(windows: Any, expected: list[float]) -> None:
    os._exit(7 if _digest(windows) == expected else 1)


def test_threads_read_the_same(library: list[Path]) -> None:
    for cache_bytes in (0, 30_000, 1 << 20):
        windows = TupliDataset.from_files(library).with_cache(cache_bytes, threads=2).windows(3)
        with ThreadPoolExecutor(6) as pool:
            found = list(pool.map(lambda _, items=windows: _digest(items), range(24)))
        assert found == [_digest(TupliDataset.from_files(library).windows(3))] * 24


def test_the_same_from_a_storage_and_after_load(library: list[Path], tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    storage = FileStorage(tmp_path / "lab")
    for path in library:
        shutil.copy(path, storage.root / path.name)
    dataset = TupliDataset(storage)
    check_same = [
        dataset.transitions()[:].asdict(),
        TupliDataset.from_files(library).transitions()[:].asdict(),
    ]
    assert len(dataset) == len(check_same[0]["rewards"]) == 180
    dataset.load()
    loaded = dataset.transitions()[:].asdict()
    assert all(same(loaded[name], check_same[0][name]) for name in loaded)


def test_memory_stays_in_the_budget(tmp_path: Path) -> None:
    """Images of 24 MB, read at random with a budget of 4 MB."""
    path = tmp_path / "r.mcap"
    with RecordEpisodes(
        Sampler(spaces.Box(0, 255, (100, 80, 3), np.uint8), spaces.Discrete(3), 50), path
    ) as env:
        roll(env, 1000)
    steps = steps_of(Recording(path), cache_bytes=4 << 20, threads=2)
    windows = TupliDataset.from_files(path).with_cache(4 << 20).windows(2)
    for items in np.random.default_rng(0).integers(0, len(windows), (30, 4)):
        assert windows[items].states.shape == (4, 2, 100, 80, 3)
    steps.read(["states", "rewards"], np.arange(0, 1000, 50))
    for found in (steps, windows.source):
        held = sum(rows._held is not None for rows in found._rows)
        assert found._cache._bytes <= 4 << 20 and held == 1  # the columns of everything but the images


def test_a_file_that_changes(tmp_path: Path) -> None:
    path, other = tmp_path / "r.mcap", tmp_path / "o.mcap"
    for name, seed in ((path, 1), (other, 2)):
        with RecordEpisodes(Sampler(spaces.Box(0, 1, (3,)), spaces.Discrete(3)), name) as env:
            roll(env, 50, seed=seed)
    dataset = TupliDataset.from_files(path)
    steps = dataset.steps
    shutil.copy(other, path)
    with pytest.raises(
        NotFoundError, match="was written anew: the file was changed afterwards; open it again"
    ):
        steps.read(["states"], np.arange(10))
    listed = ListedEpisodes(str(path), np.array([0, 99]), np.array([7, 7]))
    with pytest.raises(NotFoundError, match="episode 99 was listed, but is missing or shorter"):
        RecordedSteps([listed], Recording)
    longer = ListedEpisodes(str(path), np.array([0]), np.array([8]))
    with pytest.raises(NotFoundError, match="episode 0 was listed, but is missing or shorter"):
        RecordedSteps([longer], Recording)


NUMBERS = "expected numbers from 0 to 152 in one dimension, found"
COUNT = "that is an integer from"
FIELD = "expected fields from states, .*, found"
BAD: list[tuple[Callable[[TupliDataset], Any], str]] = [
    (lambda d: d.windows(99), "expected windows of at most 8 steps, which the longest episode has, found 99"),
    (lambda d: d.windows(4, history=5), "expected windows of at most 8 steps, .* found 9"),
    (lambda d: d.windows(0), f"expected a length of windows {COUNT} 1, found 0"),
    (
        lambda d: d.windows(1 << 63),
        "expected a length of windows of at most 281474976710656, found 9223372036854",
    ),
    (
        lambda d: d.windows(2, history=1 << 47),
        "expected windows of at most 8 steps, .* found 140737488355330",
    ),
    (lambda d: d.windows(2, fields=5), "expected fields from states, .*, found 5"),
    (lambda d: d.windows(2)[[[1], [2, 3]]], rf"{NUMBERS} \[\[1\], \[2, 3\]\]"),
    (lambda d: d.windows(2.5), f"expected a length of windows {COUNT} 1, found 2.5"),
    (lambda d: d.windows(2, True), f"expected a stride {COUNT} 1, found True"),
    (lambda d: d.windows(2, pad="x"), "expected pad to be one of 'none', 'repeat', 'zero', found 'x'"),
    (lambda d: d.windows(2, history=-1), f"expected a number of earlier steps {COUNT} 0, found -1"),
    (lambda d: d.windows(2, fields=["velocity"]), f"{FIELD} 'velocity'"),
    (lambda d: d.windows(2)[[0.5]], rf"{NUMBERS} \[0.5\]"),
    (lambda d: d.windows(2)[[[1]]], rf"{NUMBERS} \[\[1\]\]"),
    (lambda d: d.windows(2)["a"], f"{NUMBERS} 'a'"),
    (lambda d: d.steps.read(["infos"], np.array([1])), f"{FIELD} 'infos'"),
    (lambda d: d.transitions(0), f"expected a number of steps {COUNT} 1, found 0"),
    (lambda d: d.transitions(1, 1.5), "expected a discount from 0 to 1, found 1.5"),
    (lambda d: d.transitions(1, float("nan")), "expected a discount from 0 to 1, found nan"),
    (lambda d: d.transitions(fields=["speeds"]), f"{FIELD} 'speeds'"),
    (lambda d: d.delta_windows({}), "expected deltas such as .*, found {}"),
    (lambda d: d.delta_windows({"speed": [0]}), "expected deltas of state, .*, found 'speed'"),
    (lambda d: d.delta_windows({"state": []}), r"expected numbers, at least one, .* 'state', found \[\]"),
    (lambda d: d.delta_windows({"state": 3}), "expected numbers, at least one, .* 'state', found 3"),
    (lambda d: d.delta_windows({"state": ["a"]}), "expected numbers, at least one, as deltas of 'state'"),
    (lambda d: d.delta_windows({"state": [0.5]}), "of 'state' that are whole steps, found 0.5"),
    (
        lambda d: d.delta_windows({"state": [0]}, "days"),
        "expected unit to be one of 'steps', 'seconds', 'clock'",
    ),
    (lambda d: d.delta_windows({"state": [1]}, "seconds"), "expected a known time of a step, found None"),
    (
        lambda d: d.delta_windows({"state": [0, 0.03]}, "seconds", step_seconds=0.02),
        "expected deltas of 'state' that are whole steps of 0.02 s, found 0.03",
    ),
    (lambda d: d.with_episode_filter(F("n_tuples") > 99).transitions(), "found an empty dataset"),
    (lambda d: d.with_tuple_filter(F("reward") > 99).windows(1), "found an empty dataset"),
    (
        lambda d: d.delta_windows({"state": [0]}, "seconds", step_seconds="1"),
        "expected a known time of a step, found '1'",
    ),
    (lambda d: d.episode_values("n_tuples"), "expected an expression, such as .*, found 'n_tuples'"),
    (lambda d: Windows(d, 2), "expected steps, such as dataset.steps, found "),
    (lambda d: steps_of("run.mcap"), "expected a Recording, found 'run.mcap'"),
    (lambda d: d.with_cache(-1), f"expected a budget in bytes {COUNT} 0, found -1"),
    (lambda d: d.with_cache(1, 0), f"expected a number of threads {COUNT} 1, found 0"),
]


@pytest.mark.parametrize(("ask", "message"), BAD)
def test_what_means_nothing(library: list[Path], ask: Callable[[TupliDataset], Any], message: str) -> None:
    with pytest.raises(SamplingError, match=message):
        ask(TupliDataset.from_files(library))


def test_numbers_beyond_everything(library: list[Path]) -> None:
    """More steps than an episode has are as many as it has."""
    dataset = TupliDataset.from_files(library)
    far, near = dataset.transitions(1 << 40, 0.9)[:], dataset.transitions(8, 0.9)[:]
    assert same(far.asdict(), near.asdict())
    for unit, far_away in (("steps", 2.0**80), ("seconds", 1e300), ("clock", 1e300)):
        windows = dataset.delta_windows({"state": [-far_away, far_away]}, unit, step_seconds=0.5)
        ends = dataset.delta_windows({"state": [-8, 8]})
        assert same(windows[:].values, ends[:].values) and not windows[:].masks["state"].any()
    with pytest.raises(IndexError, match="expected numbers from 0 to 152, found"):
        dataset.windows(2)[np.array([2**64 - 1], np.uint64)]
    assert [*ends[0].asdict()] == ["values", "masks", "steps", "episodes"]


def test_numbers_that_are_not_there(library: list[Path]) -> None:
    dataset = TupliDataset.from_files(library)
    windows = dataset.windows(2)
    with pytest.raises(IndexError, match="expected a number from 0 to 152, found 10000"):
        windows[10_000]
    with pytest.raises(IndexError, match="expected numbers from 0 to 152, found -999"):
        windows[[1, -999]]
    for row in (180, -1):
        with pytest.raises(IndexError, match=f"expected steps from 0 to 179, found {row}"):
            dataset.steps.read(["states"], np.array([3, row]))


def test_rewards_that_cannot_be_summed(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    episode = EpisodeData([0, 1], [0, 0], ["good", "bad"], [False, True], [False, False], 0)
    write_recording(
        path,
        [episode],
        observation_space=spaces.Discrete(2),
        action_space=spaces.Discrete(2),
        reward_space=spaces.Text(9),
    )
    dataset = TupliDataset.from_files(path)
    assert dataset.transitions()[:].rewards == ["good", "bad"] and dataset.windows(2)[0].rewards == [
        "good",
        "bad",
    ]
    with pytest.raises(
        SamplingError, match="expected rewards that can be summed, found some of variable size"
    ):
        dataset.transitions(2)


def test_seconds_that_recordings_say_and_times_recorded(tmp_path: Path) -> None:
    path = tmp_path / "c.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        roll(env, 80)
        (step_seconds,) = (env.unwrapped.tau,)
    dataset = TupliDataset.from_files(path)
    assert Recording(path).labels.step_seconds == pytest.approx(step_seconds)
    said = dataset.delta_windows({"state": [-step_seconds, 0.0]}, "seconds")[:]
    expected = dataset.delta_windows({"state": [-1, 0]})[:]
    assert same(said["state"], expected["state"]) and same(said.masks["state"], expected.masks["state"])
    times = dataset.steps.read(["times"], np.arange(80))["times"]
    ends = dataset.steps.breaks
    for step in range(80):
        first, last = max([-1, *ends[ends < step]]) + 1, min(ends[ends >= step])
        deltas = [float(times[row] - times[step]) / 1e9 for row in range(first, last + 1)]
        found = dataset.delta_windows({"time": [*deltas, -60.0, 60.0]}, "clock")[step]
        assert np.abs(found["time"][:-2] - times[first : last + 1]).max() <= 200_000  # ns, of the tolerance
        assert found["time"][-2:].tolist() == [times[first], times[last]]
        assert found.masks["time"].tolist() == [True] * len(deltas) + [False] * 2


def test_a_recording_that_is_open_stays_open(library: list[Path]) -> None:
    with Recording(library[0]) as recording, library[0].open("rb") as file:
        steps = steps_of(recording)
        assert len(recording.read(episodes=[1])) == 6
        check(steps, library[:1])
        of_file = steps_of(Recording(file))
        check(of_file, library[:1])
    check(steps, library[:1])  # it opens the path itself


@pytest.mark.parametrize("cache_bytes", [0, 1 << 22])
def test_stacks_of_frames(tmp_path: Path, cache_bytes: int) -> None:
    path = tmp_path / "s.mcap"
    env = gym.wrappers.FrameStackObservation(
        Sampler(spaces.Box(0, 255, (9, 8), np.uint8), spaces.Discrete(3)), 4
    )
    with RecordEpisodes(env, path, chunk_size=4000) as recorder:
        roll(recorder, 40)
    steps = TupliDataset.from_files(path).with_cache(cache_bytes).steps
    check(steps, [path])
    check(pickle.loads(pickle.dumps(steps)), [path])


def test_a_url_that_every_process_opens_for_itself(tmp_path: Path) -> None:
    path = tmp_path / "u.mcap"
    with RecordEpisodes(Sampler(IMAGE, spaces.Discrete(3)), path, chunk_size=2000) as env:
        roll(env, 50)
    for cache_bytes in (0, 1 << 20):
        steps = TupliDataset.from_files(path.as_uri()).with_cache(cache_bytes).steps
        check(steps, [path])
        check(pickle.loads(pickle.dumps(steps)), [path])
        windows = TupliDataset.from_files(path.as_uri()).with_cache(cache_bytes).windows(3)
        expected = _digest(windows)
        with multiprocessing.get_context("fork").Pool(1) as pool:
            assert pool.map(_digest, [windows]) == [expected]


def test_a_compacted_storage_is_read_by_copies_and_after_load(tmp_path: Path) -> None:
    storage, path = FileStorage(tmp_path / "lab"), tmp_path / "lab/run.mcap"
    with RecordEpisodes(Sampler(spaces.Box(0, 1, (3,)), spaces.Discrete(3), 5), path) as env:
        roll(env, 15)
    dataset = TupliDataset(storage).with_episode_filter("episode >= 1")
    others = tupli_mcap.open(path).filter("episode >= 1")
    windows, expected = dataset.windows(2), others.windows(2)[0].states
    tupli_mcap.open(path).filter("episode < 1").delete()
    assert storage.compact() > 0
    for copied in (pickle.loads(pickle.dumps(dataset)), pickle.loads(pickle.dumps(others))):
        np.testing.assert_array_equal(copied.windows(2)[0].states, expected)
    with pytest.raises(NotFoundError, match=r"list the episodes again with load\(\)$"):
        pickle.loads(pickle.dumps(windows))[0]
    dataset.load()
    again = pickle.loads(pickle.dumps(dataset.windows(2, fields=["next_states"])))[0]
    np.testing.assert_array_equal(again.next_states[0], expected[1])


def test_a_copy_of_loaded_windows_reads_the_recordings(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        roll(env, 100)
    dataset = TupliDataset.from_files(path)
    dataset.load()
    windows = dataset.windows(4)
    copied = pickle.loads(pickle.dumps(windows))
    assert copied.identity == windows.identity
    assert np.array_equal(copied[:].states, windows[:].states)
    assert isinstance(copied.source, RecordedSteps)
