"""Saved columns: what is read by number of them is what it is of the recordings, and defects are one clear error."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, Scripted, roll, same
from gymnasium import spaces
from hypothesis import given, strategies as st
from test_sampling_properties import FEW, Library, dataset_of, libraries

import tupli_mcap
from tupli_mcap import F, FileStorage, RecordEpisodes, TupliDataset, files
from tupli_mcap.dataset import DatasetError, SavedColumns, open_columns
from tupli_mcap.dataset.access import RandomAccess
from tupli_mcap.dataset.columns import saved
from tupli_mcap.dataset.items import FIELDS, MemorySteps, SamplingError
from tupli_mcap.errors import FormatError, StorageError, TupliError
from tupli_mcap.recording import EpisodeData, write_recording
from tupli_mcap.vector import RecordEpisodes as RecordVector

__all__ = ["libraries"]  # a fixture

Files = Callable[[], TupliDataset]


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1, **options: Any) -> None:
    with RecordEpisodes(env, path, **options) as recorder:
        roll(recorder, steps, seed)


def columns_of(dataset: TupliDataset, directory: Path) -> SavedColumns:
    dataset.save_columns(directory)
    return open_columns(directory)


def check(columns: SavedColumns, dataset: TupliDataset) -> None:
    """Whether all steps are those of a dataset, in any order and as runs, with what is known of them."""
    steps, expected = columns.steps, dataset.steps
    assert type(steps) is not type(expected)
    assert len(columns) == len(steps) == len(expected) > 0
    assert steps.identity == expected.identity
    for name in ("episode_lengths", "breaks", "open_ends"):
        assert np.array_equal(getattr(steps, name), getattr(expected, name)), name
    shuffled = np.random.default_rng(3).integers(0, len(steps), 500)
    for rows in (shuffled, np.arange(len(steps)), shuffled[:0]):
        assert same(steps.read(FIELDS, rows), expected.read(FIELDS, rows))
    starts = shuffled[shuffled < len(steps) - 5]
    assert same(steps.read_runs(FIELDS, starts, 5), expected.read_runs(FIELDS, starts, 5))
    assert columns.preview() == dataset.preview()


@pytest.fixture
def cart(tmp_path: Path) -> Files:
    """Two CartPole recordings of 700 steps; the last episode of each is interrupted."""
    for i, steps in enumerate((400, 300)):
        record(tmp_path / f"{i}.mcap", gym.make("CartPole-v1"), steps, i)
    return lambda: TupliDataset.from_files(str(tmp_path / "?.mcap"))


# --- equal to the recordings ---


@pytest.fixture(scope="module")
def saved_libraries(
    libraries: list[tuple[Library, Path]], tmp_path_factory: pytest.TempPathFactory
) -> list[dict[bool, tuple[TupliDataset, SavedColumns]]]:
    """Each library with and without a tuple filter, as recordings and as columns; without those of no step."""
    found = []
    for _, directory in libraries:
        pairs = {}
        for filtered in (False, True):
            dataset = dataset_of(directory, filtered=filtered)
            if len(dataset):
                goal = tmp_path_factory.mktemp("columns") / "saved"
                pairs[filtered] = dataset, columns_of(dataset, goal)
        found.append(pairs)
    return found


def test_names_that_are_longer_than_file_systems_take(tmp_path: Path) -> None:
    space = spaces.Dict({f"{'a' * 300}{i}": spaces.Box(-1, 1, (2,)) for i in range(2)})
    record(tmp_path / "r.mcap", Sampler(space, spaces.Discrete(2)), 20)
    dataset = TupliDataset.from_files(tmp_path / "r.mcap")
    check(columns_of(dataset, tmp_path / "columns"), dataset)


@FEW
@given(number=st.integers(0, 7), data=st.data())
def test_items_are_those_of_the_recordings(
    saved_libraries: list[dict[bool, tuple[TupliDataset, SavedColumns]]], number: int, data: st.DataObject
) -> None:
    pairs = saved_libraries[number]
    dataset, columns = pairs[data.draw(st.sampled_from(sorted(pairs)))]
    length, stride, history = (data.draw(st.integers(low, 4)) for low in (1, 1, 0))
    pad = data.draw(st.sampled_from(["none", "repeat", "zero"]))
    deltas = st.lists(st.integers(-4, 4), min_size=1, max_size=4)
    around = {key: data.draw(deltas) for key in ("state", "reward", "next_state")}
    makers: list[Callable[[RandomAccess], Any]] = [
        lambda d: d.windows(length, stride, pad, history, fields=FIELDS),
        lambda d: d.transitions(length, 0.5),
        lambda d: d.delta_windows(around),
    ]
    for make in makers:
        try:
            expected = make(dataset)
        except SamplingError as err:
            with pytest.raises(SamplingError, match=re.escape(str(err))):
                make(columns)
            continue
        found = make(columns)
        assert found.identity == expected.identity
        assert same(found[:].asdict(), expected[:].asdict())
        numbers = data.draw(st.lists(st.integers(-len(expected), len(expected) - 1), max_size=9))
        assert same(found[numbers].asdict(), expected[numbers].asdict())
        assert same(found[0].asdict(), expected[0].asdict())
        for by in ("steps", "episodes"):
            drawn, wanted = (
                items.sampler(9, by=by, weights=F("n_tuples"), seed=5) for items in (found, expected)
            )
            assert np.array_equal(drawn.draw(2), wanted.draw(2))


SPACES = {
    "nested": spaces.Dict(
        {
            "camera": spaces.Box(0, 255, (4, 5, 3), np.uint8),
            "joints": spaces.Tuple([spaces.Box(-1, 1, (2,), np.float16), spaces.Discrete(3, start=-1)]),
            "nothing": spaces.Box(0, 1, (0, 2), np.float32),
            "Flag!": spaces.MultiBinary(3),
        }
    ),
    "one": spaces.Box(-1, 1, (), np.float32),
}


@pytest.mark.parametrize("block", [400, saved._BLOCK_BYTES], ids=["small blocks", "one block"])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("filter", [None, F("action.0") != 1])
def test_steps_of_any_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, space: str, filter: Any, block: int
) -> None:
    for i in range(2):
        record(tmp_path / f"{i}.mcap", Sampler(SPACES[space], spaces.MultiDiscrete([3, 4])), 25, i)
    monkeypatch.setattr(saved, "_BLOCK_BYTES", block)
    dataset = TupliDataset.from_files(str(tmp_path / "?.mcap")).with_tuple_filter(filter)
    check(columns_of(dataset, tmp_path / "columns"), dataset)


@pytest.mark.parametrize("filter", [None, F("state.0") > 0])
def test_steps_that_are_loaded_or_in_a_small_cache(cart: Files, tmp_path: Path, filter: Any) -> None:
    dataset = cart().with_tuple_filter(filter)
    loaded = cart().with_tuple_filter(filter)
    loaded.load()
    assert isinstance(loaded.steps, MemorySteps)
    check(columns_of(loaded, tmp_path / "loaded"), dataset)
    check(columns_of(dataset.with_cache(0), tmp_path / "cached"), dataset)
    for name in (path.name for path in (tmp_path / "loaded").iterdir()):
        assert (tmp_path / "loaded" / name).read_bytes() == (tmp_path / "cached" / name).read_bytes()


def test_recordings_of_several_dtypes(tmp_path: Path) -> None:
    """A leaf that is an image in one and an array in the other, and a wider float."""
    small = spaces.Dict(a=spaces.Box(0, 255, (2, 2, 3), np.uint8), b=spaces.Box(0, 1, (), np.float32))
    wide = spaces.Dict(a=spaces.Box(-300, 300, (2, 2, 3), np.int16), b=spaces.Box(0, 1, (), np.float64))
    for i, space in enumerate((small, wide)):
        record(tmp_path / f"{i}.mcap", Sampler(space, spaces.Discrete(3)), 20)
    dataset = TupliDataset.from_files(str(tmp_path / "?.mcap"))
    columns = columns_of(dataset, tmp_path / "columns")
    check(columns, dataset)
    assert np.load(tmp_path / "columns" / "state_a.npy").dtype == np.int16


def test_vector_recordings_and_storages(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    path = tmp_path / "lab" / "recordings" / "v.mcap"
    path.parent.mkdir(parents=True)
    with RecordVector(gym.make_vec("CartPole-v1", num_envs=3), path) as env:
        env.reset(seed=1)
        env.action_space.seed(1)
        for _ in range(200):
            env.step(env.action_space.sample())
    dataset = TupliDataset(storage).with_episode_filter(F("n_tuples") > 12)
    columns = columns_of(dataset, tmp_path / "columns")
    check(columns, dataset)
    storage.delete_episode(dataset.preview()[0].id)  # columns stay what they were
    assert (
        len(columns.preview())
        == len(open_columns(tmp_path / "columns").preview())
        == len(dataset.preview()) + 1
    )


def test_a_recording_that_is_still_written(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "0.mcap") as env:
        roll(env, 100)
        dataset = TupliDataset.from_files(tmp_path / "0.mcap")
        dataset.preview()
        env.step(env.action_space.sample())
        columns = columns_of(dataset, tmp_path / "columns")
        assert len(columns) == 100
        assert same(columns.steps.read(FIELDS, np.arange(100)), dataset.steps.read(FIELDS, np.arange(100)))


def test_facts_about_episodes(tmp_path: Path) -> None:
    """Weights, headers and the seconds of a step are those of the dataset, odd values too."""
    metadata = [{"score": 3.5, "odd": float("nan")}, {"score": float("inf"), "$tag": [None, "\ud800"]}]
    write_recording(
        tmp_path / "0.mcap",
        [
            EpisodeData([0, 1], [0, 0], [float("nan"), 1.0], [False, True], [False] * 2, 0, metadata=found)
            for found in metadata
        ],
        observation_space=spaces.Discrete(2),
        action_space=spaces.Discrete(2),
    )
    dataset = TupliDataset.from_files(tmp_path / "0.mcap")
    columns = columns_of(dataset, tmp_path / "columns")
    assert repr(columns.preview()) == repr(dataset.preview())  # NaN is no other NaN
    assert columns.episode_values(F("metadata.score")).tolist() == [3.5, float("inf")]
    drawn = columns.windows(1).sampler(9, by="episodes", weights=F("metadata.score") < 4, seed=0).draw(0)
    assert set(drawn.tolist()) == {0, 1}
    assert "2 episodes, 4 steps" in repr(columns)


def test_seconds_are_those_of_the_labels(cart: Files, tmp_path: Path) -> None:
    columns = columns_of(cart(), tmp_path / "columns")
    around = {"state": [-0.02, 0.0], "time": [0.02]}
    expected = cart().delta_windows(around, "seconds")[:]
    assert same(columns.delta_windows(around, "seconds")[:].asdict(), expected.asdict())


def test_anybody_can_load_them(cart: Files, tmp_path: Path) -> None:
    cart().save_columns(tmp_path / "new" / "columns")
    dataset, directory = cart(), tmp_path / "new" / "columns"
    for name, column in (("state", dataset.observations), ("reward", dataset.rewards)):
        loaded = np.load(directory / f"{name}.npy", mmap_mode="r")
        assert isinstance(loaded, np.memmap)
        assert same(np.asarray(loaded), column)
    breaks = np.load(directory / "break.npy")
    assert same(np.load(directory / "next_state.npy"), dataset.next_states[breaks])
    assert json.loads((directory / "manifest.json").read_text())["steps"] == 700


def test_columns_are_mapped_and_items_are_ones_own(cart: Files, tmp_path: Path) -> None:
    columns = columns_of(cart(), tmp_path / "columns")
    held = columns.steps._columns["states"]  # type: ignore[attr-defined]
    assert type(held) is np.ndarray and isinstance(held.base, np.memmap) and not held.flags.writeable
    for rows in (np.arange(5), np.array([3, 1])):
        for column in columns.steps.read(FIELDS, rows).values():
            column[:] = 0
    assert same(columns.transitions()[:].asdict(), cart().transitions()[:].asdict())
    for beyond in (np.arange(701), np.array([700, 3])):
        for field in ("states", "next_states"):
            with pytest.raises(IndexError, match="700"):
                columns.steps.read([field], beyond)
    with pytest.raises(SamplingError, match="expected fields from states, .* found 'velocity'"):
        columns.steps.read(["velocity"], beyond)


# --- in other processes ---


def _digest(items: Any) -> float:
    return float(items[:].states.sum())


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_other_processes(cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: Any) -> None:
    monkeypatch.chdir(tmp_path)
    cart().save_columns("columns")
    windows = open_columns("columns").windows(3)
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert pool.map(_digest, [windows]) == [_digest(cart().windows(3))]


def test_a_copy_maps_the_same_columns_or_none(
    cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    windows = columns_of(cart(), Path("columns")).windows(4)
    copied = pickle.dumps(windows.source)
    monkeypatch.chdir("/")
    assert len(copied) < 1000
    assert same(pickle.loads(pickle.dumps(windows))[:].asdict(), windows[:].asdict())
    (tmp_path / "columns").rename(tmp_path / "old")
    with pytest.raises(StorageError, match="holds no columns; write them with"):
        pickle.loads(copied)
    cart().with_tuple_filter(F("action") == 1).save_columns(tmp_path / "columns")
    with pytest.raises(StorageError, match="held before, found others; open them anew"):
        pickle.loads(copied)
    assert len(windows[:].states)  # mapped before


def test_columns_of_an_opened_dataset(cart: Files, tmp_path: Path) -> None:
    """Sorted, filtered, without some steps, and read within another budget."""
    cart()
    dataset = tupli_mcap.open(tmp_path).with_cache(1 << 20, threads=1)
    dataset = dataset.filter("steps > 10").sort("return").filter_steps("action = 1")
    assert (dataset.steps.cache_bytes, dataset.steps.threads) == (1 << 20, 1)  # type: ignore[attr-defined]
    dataset.save_columns(tmp_path / "columns")
    columns = open_columns(tmp_path / "columns")
    assert columns.preview() == dataset.headers
    assert same(columns.windows(3, pad="repeat")[:].asdict(), dataset.windows(3, pad="repeat")[:].asdict())
    assert np.array_equal(columns.steps.episode_lengths, dataset.lengths)
    with pytest.raises(SamplingError, match="expected a budget in bytes"):
        dataset.with_cache(-1)


@pytest.mark.parametrize("workers", [0, 2])
def test_torch_loaders_give_the_same_batches(cart: Files, tmp_path: Path, workers: int) -> None:
    torch = pytest.importorskip("torch")
    from tupli_mcap.torch import Episodes, MapDataset, StreamDataset, collate

    columns = columns_of(cart(), tmp_path / "columns")

    def batches(source: RandomAccess) -> list[Any]:
        found = []
        kinds = [source.windows(5, pad="zero"), source.transitions(2), Episodes(source.steps)]
        for items in kinds[: 1 if workers else 3]:  # workers take long to start
            generator = torch.Generator().manual_seed(1)
            options = {"num_workers": workers, "collate_fn": collate}
            exact = torch.utils.data.DataLoader(
                MapDataset(items), batch_size=64, shuffle=True, generator=generator, **options
            )
            stream = torch.utils.data.DataLoader(
                StreamDataset(items, 64, shuffle=False), batch_size=None, **options
            )
            found += [
                [{k: v.numpy() for k, v in batch.items()} for batch in part] for part in (exact, stream)
            ]
        return found

    assert same(batches(columns), batches(cart()))


# --- what may go wrong ---


def test_what_cannot_be_saved(cart: Files, tmp_path: Path) -> None:
    goal = tmp_path / "columns"
    for none in (cart().with_episode_filter(F("n_tuples") > 1000), cart().with_tuple_filter(F("reward") > 2)):
        with pytest.raises(DatasetError, match="expected steps to save, found none; choose"):
            none.save_columns(goal)
    with pytest.raises(DatasetError, match="expected the path of a directory of columns, found None"):
        cart().save_columns(None)  # type: ignore[arg-type]
    record(tmp_path / "words.mcap", Sampler(spaces.Dict(word=spaces.Text(8)), spaces.Discrete(2)), 9)
    with pytest.raises(DatasetError, match=r"values of a fixed size, found state\.word of Text"):
        TupliDataset.from_files(tmp_path / "words.mcap").save_columns(goal)
    with pytest.raises(StorageError, match="columns cannot be saved to .*0.mcap/x.*; choose"):
        cart().save_columns(tmp_path / "0.mcap" / "x")
    assert not goal.exists() and not files.left_in(tmp_path)


def test_metadata_that_are_nested_too_deep(tmp_path: Path) -> None:
    deep: dict[str, Any] = {}
    for _ in range(63):
        deep = {"a": deep}
    episode = EpisodeData([0], [0], [0.0], [True], [False], 0, metadata=deep)
    spaces_of = {"observation_space": spaces.Discrete(2), "action_space": spaces.Discrete(2)}
    write_recording(tmp_path / "0.mcap", [episode], **spaces_of)
    with pytest.raises(DatasetError, match="its metadata cannot be saved: expected at most 64 levels"):
        TupliDataset.from_files(tmp_path / "0.mcap").save_columns(tmp_path / "columns")


def test_nothing_is_ever_replaced(cart: Files, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("nowhere")
    cart().save_columns(tmp_path / "columns")
    before = (tmp_path / "columns" / "manifest.json").stat()
    for name in ("empty", "link", "columns", "0.mcap"):
        with pytest.raises(
            StorageError,
            match=f"expected an unused path for columns, but .*{name} exists; choose another one",
        ):
            cart().with_tuple_filter(F("action") == 1).save_columns(tmp_path / name)
    assert (tmp_path / "columns" / "manifest.json").stat() == before
    assert not list((tmp_path / "empty").iterdir())


def test_somebody_who_was_quicker_stays(cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    goal, write = tmp_path / "columns", saved._write

    def late(*given: Any) -> None:
        write(*given)
        goal.mkdir()

    monkeypatch.setattr(saved, "_write", late)
    with pytest.raises(StorageError, match="columns cannot be saved to .*File exists"):
        cart().save_columns(goal)
    assert list(goal.iterdir()) == []


def test_a_full_disk(cart: Files, tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, hard))  # EFBIG, as ENOSPC from the same call
    try:
        with pytest.raises(StorageError, match="columns cannot be saved to .*columns.*; raise the limit"):
            cart().save_columns(tmp_path / "columns")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.mcap", "1.mcap"]


def test_a_killed_process_leaves_no_columns(
    cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = saved._write

    def killed(*given: Any) -> None:
        write(*given)
        os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(saved, "_write", killed)
    child = os.fork()
    if child == 0:
        try:
            cart().save_columns(tmp_path / "columns")
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert not (tmp_path / "columns").exists()
    (left,) = files.left_in(tmp_path)
    assert files.remove_left([left]) > 700 * 4 * 4 and not left.exists()


def test_memory_is_bounded(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (128, 128, 3), np.uint8)
    frame = np.random.default_rng(1).integers(0, 255, (128, 128, 3), np.uint8)
    record(tmp_path / "0.mcap", Scripted(lambda n: np.roll(frame, n), space, length=1500), 1500)
    script = (
        "import re, sys\nfrom tupli_mcap import TupliDataset\n"
        "peak = lambda: int(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])\n"
        "d = TupliDataset.from_files(sys.argv[1]).with_cache(8 << 20)\nd.steps; before = peak()\n"
        "d.save_columns(sys.argv[2])\nprint(peak() - before)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "0.mcap"), str(tmp_path / "columns")]
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert 1500 * frame.nbytes > 70 << 20
    assert grown < 60 << 10  # KiB


# --- defects ---


def edited(directory: Path, change: Callable[[Any], object]) -> None:
    manifest = json.loads((directory / "manifest.json").read_text())
    change(manifest)
    (directory / "manifest.json").write_text(json.dumps(manifest))


def array(name: str, change: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Saves something else of an array in its place."""

    def damage(directory: Path) -> None:
        found = change(np.load(directory / f"{name}.npy"))
        np.save(directory / f"{name}.npy", found, allow_pickle=True)

    return damage


def manifest(**changes: Any) -> Callable[[Path], None]:
    return lambda directory: edited(directory, lambda found: found.update(changes))


def a_space(text: str) -> Callable[[Path], None]:
    return lambda directory: edited(directory, lambda found: found["spaces"].update(observation_space=text))


def longer(directory: Path) -> None:
    with (directory / "state.npy").open("ab") as file:
        file.write(b"more")


def a_pipe(directory: Path) -> None:
    (directory / "state.npy").unlink()
    os.mkfifo(directory / "state.npy")


def pickled(directory: Path) -> None:
    (directory / "state.npy").write_bytes(pickle.dumps(np.zeros(3)))


def ends_at(numbers: list[int]) -> Callable[[Any], Any]:
    return lambda breaks: np.concatenate([breaks[: -len(numbers)], np.array(numbers, np.int64)])


def first(numbers: list[int]) -> Callable[[Any], Any]:
    return lambda lengths: lengths + np.pad(np.array(numbers, np.int64), (0, len(lengths) - len(numbers)))


SHAPE = r"state.npy: expected float32 of shape \(700, 4\) in C order, and nothing after it, found"
DEFECTS: list[tuple[Callable[[Path], object], str]] = [
    (lambda d: os.truncate(d / "state.npy", 500), r"state.npy: expected a .npy file of float32 .*found"),
    (lambda d: os.truncate(d / "state.npy", 0), r"state.npy: expected a .npy file of float32 .*found"),
    (lambda d: os.truncate(d / "state.npy", 20), r"state.npy: expected a .npy file of float32 .*found"),
    (lambda d: (d / "action.npy").unlink(), "action.npy: expected a file, found none"),
    (longer, f"{SHAPE} float32"),
    (a_pipe, "state.npy: expected a file, found none"),
    (pickled, "state.npy: expected a .npy file"),
    (array("state", lambda _: np.array([{"a": 1}] * 700, object)), "state.npy: expected a .npy file"),
    (array("state", lambda _: np.zeros((1400, 2), np.float32)), f"{SHAPE} float32 of shape"),
    (array("state", lambda found: found.astype(">f4")), f"{SHAPE} >f4"),
    (array("state", lambda found: np.asfortranarray(found)), f"{SHAPE} float32"),
    (
        array("terminal", lambda found: found.astype(np.uint8)),
        r"terminal.npy: expected bool of shape \(700,\)",
    ),
    (
        array("break", lambda found: found[::-1].copy()),
        "break.npy: expected numbers of steps that ascend to 699",
    ),
    (
        array("break", lambda found: np.append(-5, found[1:])),
        "break.npy: expected numbers of steps that ascend",
    ),
    (array("break", ends_at([700])), "break.npy: expected numbers of steps that ascend to 699"),
    (array("break", ends_at([-1 << 63, 699])), "break.npy: expected numbers of steps that ascend to 699"),
    (array("break", ends_at([698])), "episode_length.npy: expected episodes that end at a break"),
    (array("episode_length", lambda found: found + 1), "episode_length.npy: expected 700 steps of all"),
    (array("episode_length", first([1, -1])), "episode_length.npy: expected episodes that end at a break"),
    (array("episode_length", first([-99, 99])), "episode_length.npy: expected episodes that end at a break"),
    (
        array("episode_length", first([1 << 62] * 4)),
        "episode_length.npy: expected episodes that end at a break",
    ),
    (manifest(steps=1 << 60), "state.npy: expected float32 of shape"),
    (manifest(steps=0), "manifest.json: expected a manifest of columns, version 1, found steps:"),
    (manifest(version=9), "manifest.json: expected a manifest of columns, version 1, found version:"),
    (manifest(identity=3), "manifest.json: expected a manifest of columns, version 1, found identity:"),
    (lambda d: (d / "manifest.json").write_bytes(b"\xff{"), "manifest.json: expected a manifest of columns"),
    (
        lambda d: (d / "manifest.json").write_text("[" * 99999),
        "manifest.json: expected a manifest of columns",
    ),
    (a_space('{"type":"Os"}'), "manifest.json: expected spaces, found"),
    (a_space("[" * 99999), "manifest.json: expected spaces, found"),
]


@pytest.mark.parametrize(("damage", "words"), DEFECTS)
def test_defects_are_format_errors(
    cart: Files, tmp_path: Path, damage: Callable[[Path], object], words: str
) -> None:
    cart().save_columns(tmp_path / "columns")
    damage(tmp_path / "columns")
    with pytest.raises(FormatError, match=f"{words}.*; save the columns anew"):
        open_columns(tmp_path / "columns")


def test_spaces_of_variable_size_and_odd_headers(cart: Files, tmp_path: Path) -> None:
    cart().save_columns(tmp_path / "columns")
    edited(tmp_path / "columns", lambda found: found["episodes"].__setitem__(0, '{"id": 3}'))
    columns = open_columns(tmp_path / "columns")
    assert same(columns.transitions()[:].asdict(), cart().transitions()[:].asdict())
    with pytest.raises(FormatError, match="manifest.json: expected headers of episodes, found id: .*anew"):
        columns.preview()
    record(tmp_path / "words.mcap", Sampler(spaces.Text(8), spaces.Discrete(2)), 9)
    of_words = TupliDataset.from_files(tmp_path / "words.mcap").steps.layout
    assert of_words is not None
    edited(tmp_path / "columns", lambda found: found.update(spaces=of_words.to_metadata()))
    with pytest.raises(FormatError, match="expected spaces of values of a fixed size, found others"):
        open_columns(tmp_path / "columns")


def test_where_no_columns_are(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for name in ("nowhere", ".", "file"):
        with pytest.raises(StorageError, match="holds no columns; write them with dataset.save_columns"):
            open_columns(tmp_path / name)
    with pytest.raises(DatasetError, match="expected the path of a directory of columns, found 3"):
        open_columns(3)  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore::UserWarning")  # of NumPy: a header that Python 2 may have written
@pytest.mark.parametrize("name", ["state.npy", "manifest.json"])
def test_any_changed_byte_gives_columns_or_a_clear_error(cart: Files, tmp_path: Path, name: str) -> None:
    directory = tmp_path / "columns"
    cart().save_columns(directory)
    original = (directory / name).read_bytes()
    rng, refusals = np.random.default_rng(0), []
    for at in [*range(128), *rng.integers(0, len(original), 200).tolist()]:
        changed = bytearray(original)
        changed[at] ^= int(rng.integers(1, 256))
        (directory / name).write_bytes(changed)
        try:
            columns = open_columns(directory)
            assert columns.windows(3)[:].states.shape[1:] == (3, 4)
            columns.preview()
        except TupliError as err:
            refusals.append(str(err))
    assert len(refusals) > 60 and all(name in refusal for refusal in refusals)
