"""Materialised columns: equal to what the recordings hold, fresh or written anew, whole or not there."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, Scripted, roll, same
from gymnasium import spaces

from tupli_mcap import F, FileStorage, RecordEpisodes, Recording, TupliDataset
from tupli_mcap.dataset import DatasetError, writing
from tupli_mcap.errors import FormatError, StorageError, TupliError
from tupli_mcap.materialized import open_columns
from tupli_mcap.recording import blocks as recording_blocks
from tupli_mcap.sampling import FIELDS, MemorySteps, RecordedSteps, SamplingError
from tupli_mcap.sampling.mapped import MAPPED_FIELDS, MappedSteps
from tupli_mcap.vector import RecordEpisodes as RecordVector

Files = Callable[[], TupliDataset]
D4RL = ("observations", "actions", "next_observations", "rewards", "terminals", "timeouts")


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1, **options: Any) -> None:
    with RecordEpisodes(env, path, **options) as recorder:
        roll(recorder, steps, seed)


def token(directory: Path) -> str:
    """Drawn anew each time that columns are written."""
    text: str = json.loads((directory / "manifest.json").read_text())["token"]
    return text


@pytest.fixture
def cart(tmp_path: Path) -> Files:
    """Two CartPole recordings of 700 steps; the last episode of each is interrupted."""
    for i, steps in enumerate((400, 300)):
        record(tmp_path / f"{i}.mcap", gym.make("CartPole-v1"), steps, i)
    return lambda: TupliDataset.from_files(str(tmp_path / "?.mcap"))


SPACES = {
    "nested": spaces.Dict(
        {
            "camera": spaces.Box(0, 255, (4, 5, 3), np.uint8),
            "joints": spaces.Tuple([spaces.Box(-1, 1, (2,), np.float16), spaces.Discrete(3, start=-1)]),
            "nothing": spaces.Box(0, 1, (0, 2), np.float32),
        }
    ),
    "variable": spaces.Dict(
        {
            "word": spaces.Text(8),
            "at": spaces.Box(-1, 1, (), np.float32),
            "walk": spaces.Sequence(spaces.Box(0, 1, (2,), np.float32)),
        }
    ),
}


@pytest.mark.parametrize("block", [400, recording_blocks.BLOCK_BYTES], ids=["small blocks", "one block"])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("filtered", [False, True])
def test_columns_are_what_the_recordings_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, space: str, filtered: bool, block: int
) -> None:
    for i in range(2):
        record(
            tmp_path / f"{i}.mcap",
            Sampler(SPACES[space], spaces.MultiDiscrete([3, 4])),
            25,
            i,
            record_info=True,
        )
    chosen = F("action.0") != 1 if filtered else None
    plain = TupliDataset.from_files(str(tmp_path / "?.mcap")).with_tuple_filter(chosen)
    mapped = TupliDataset.from_files(str(tmp_path / "?.mcap")).with_tuple_filter(chosen)
    monkeypatch.setattr(recording_blocks, "BLOCK_BYTES", block)
    assert mapped.materialize(tmp_path / "columns") is mapped
    for place in D4RL:
        assert same(mapped.convert_to_d4rl_format()[place], plain.convert_to_d4rl_format()[place]), place
    assert same(mapped.observations, plain.observations)
    assert same(mapped.next_states, plain.next_states)
    assert len(mapped) == len(plain) > 20
    assert all(same(a.state, b.state) and a.info == b.info for a, b in zip(mapped, plain, strict=True))
    assert [len(item.tuples) for item in mapped.episodes] == [len(item.tuples) for item in plain.episodes]


@pytest.mark.parametrize("filter", [None, F("state.0") > 0])
def test_rows_in_any_order(cart: Files, tmp_path: Path, filter: Any) -> None:
    dataset = cart().with_tuple_filter(filter)
    recorded = {
        "states": dataset.observations,
        "next_states": dataset.next_states,
        "actions": dataset.actions,
    }
    recorded |= {"rewards": dataset.rewards, "terminals": dataset.terminals, "timeouts": dataset.timeouts}
    dataset.materialize(tmp_path / "columns")
    steps = MappedSteps(tmp_path / "columns")
    rows = np.random.default_rng(3).integers(0, len(steps), 500)
    found = steps.read(MAPPED_FIELDS, rows)
    for field, column in recorded.items():
        assert same(found[field], column[rows]), field
        found[field][:1] = 0  # one's own
    frame = dataset.convert_to_dataframe()
    assert same(found["steps"], frame["step"].to_numpy()[rows])
    if filter is None:
        files = [Recording(tmp_path / f"{i}.mcap").read(fields=["times"]).times for i in range(2)]
        assert same(found["times"], np.concatenate(files)[rows])
    follows = np.diff(frame["episode"].to_numpy()) + np.diff(frame["step"].to_numpy()) == 1
    follows &= np.diff(frame["episode"].to_numpy()) == 0
    assert np.array_equal(steps.breaks, np.flatnonzero(np.append(~follows, True)))
    assert steps.read(["states"], rows[:0])["states"].shape == (0, 4)
    assert steps.read(["next_states"], rows[:0])["next_states"].shape == (0, 4)
    with pytest.raises(SamplingError, match="expected fields from states, .* found 'state'"):
        steps.read(["state"], rows)


def test_rows_that_follow_each_other(cart: Files, tmp_path: Path) -> None:
    loaded = cart()
    columns = (*loaded.convert_to_numpy(mark_cuts=False), loaded.next_states.copy())
    wanted = dict(zip(FIELDS, columns, strict=False))
    fields = tuple(wanted)
    loaded.load()
    n = len(loaded)
    shuffled = np.arange(n)
    shuffled[3:5] = 4, 3
    runs = [np.arange(n), np.arange(7, n - 2), np.arange(1), np.array([0, 0, 2]), shuffled]
    kinds = {
        MappedSteps: cart().materialize(tmp_path / "columns"), MemorySteps: loaded, RecordedSteps: cart(),
    }  # fmt: skip
    for kind, dataset in kinds.items():
        steps = dataset.steps
        assert type(steps) is kind
        for rows in runs:
            found = steps.read(fields, rows)
            for field, column in found.items():
                assert same(column, wanted[field][rows]), (kind, field)
                column[:] = 0  # one's own: the next ones are what they were
        for beyond in (np.arange(n + 1), np.arange(n, n + 2)):
            with pytest.raises(IndexError, match=rf"{n}"):
                steps.read(fields[:5], beyond)


@pytest.mark.parametrize("of", [None, F("state.0") > 0])
def test_windows_and_samples_are_of_the_columns(cart: Files, tmp_path: Path, of: Any) -> None:
    recorded, mapped = cart().with_tuple_filter(of), cart().with_tuple_filter(of)
    mapped.materialize(tmp_path / "columns")
    assert isinstance(mapped.steps, MappedSteps)
    for name in ("episode_lengths", "breaks", "open_ends"):
        assert np.array_equal(getattr(mapped.steps, name), getattr(recorded.steps, name)), name
    assert mapped.steps.identity == recorded.steps.identity
    assert pickle.loads(pickle.dumps(mapped)).steps.identity == recorded.steps.identity
    rows = np.arange(len(recorded))[::-1]
    for field in FIELDS:
        assert same(mapped.steps.read([field], rows), recorded.steps.read([field], rows)), field
    windows = mapped.windows(4, stride=3)
    assert len(windows) == len(recorded.windows(4, stride=3)) > 20


def test_anybody_can_load_them(cart: Files, tmp_path: Path) -> None:
    dataset = cart().materialize(tmp_path / "columns")
    for name, column in (("state", dataset.observations), ("reward", dataset.rewards)):
        loaded = np.load(tmp_path / "columns" / f"{name}.npy", mmap_mode="r")
        assert isinstance(loaded, np.memmap)
        assert same(np.asarray(loaded), column)
    ids = np.load(tmp_path / "columns" / "episode_id.npy")
    assert [text.decode() for text in ids] == [header.id for header in dataset.preview()]


def test_mapped_columns_are_not_read_into_memory(cart: Files, tmp_path: Path) -> None:
    dataset = cart().materialize(tmp_path / "columns")
    dataset.load()
    states = dataset.observations
    assert type(states) is np.ndarray
    assert not states.flags.owndata
    with pytest.raises(ValueError, match="read-only"):
        states[0] = 0
    own, *_ = dataset.convert_to_numpy()
    own[0] = 0
    assert dataset.observations[0].any()


def test_fresh_columns_are_used_as_they_are(cart: Files, tmp_path: Path) -> None:
    directory = tmp_path / "columns"
    first = cart().with_tuple_filter(F("reward") > 0).materialize(directory)
    written = token(directory)
    second = cart().with_tuple_filter(F("reward") > 0).materialize(directory)
    first.materialize(directory, verify=True)
    assert token(directory) == written
    assert same(first.next_states, second.next_states)
    assert "700" in repr(second) and len(second) == 700


def changed_filter(dataset: TupliDataset, _: Path) -> TupliDataset:
    return dataset.with_tuple_filter(F("action") == 1)


def fewer_episodes(dataset: TupliDataset, _: Path) -> TupliDataset:
    return dataset.with_episode_filter(F("n_tuples") > 15)


def more_episodes(dataset: TupliDataset, directory: Path) -> TupliDataset:
    record(directory / "0.mcap", gym.make("CartPole-v1"), 50, 9, mode="a")
    return dataset


def another_file(dataset: TupliDataset, directory: Path) -> TupliDataset:
    record(directory / "2.mcap", gym.make("CartPole-v1"), 50, 9)
    return TupliDataset.from_files(str(directory / "?.mcap"))


def touched(dataset: TupliDataset, directory: Path) -> TupliDataset:
    os.utime(directory / "0.mcap", ns=(1, 1))
    return dataset


@pytest.mark.parametrize("change", [changed_filter, fewer_episodes, more_episodes, another_file, touched])
def test_stale_columns_are_written_anew(
    cart: Files, tmp_path: Path, change: Callable[[TupliDataset, Path], TupliDataset]
) -> None:
    directory = tmp_path / "columns"
    cart().materialize(directory)
    written = token(directory)
    dataset = change(cart(), tmp_path)
    expected = dataset.convert_to_d4rl_format()
    dataset.materialize(directory)
    assert token(directory) != written
    assert same(dataset.convert_to_d4rl_format(), expected)


def test_columns_go_when_the_episodes_change(cart: Files, tmp_path: Path) -> None:
    dataset = cart().materialize(tmp_path / "columns")
    before = dataset.observations
    record(tmp_path / "0.mcap", gym.make("CartPole-v1"), 50, 9, mode="a")
    assert same(dataset.observations, before)  # until the episodes are listed anew, as everywhere
    dataset.preview()
    assert len(dataset.observations) == 750
    assert dataset.observations.flags.owndata
    assert same(MappedSteps(tmp_path / "columns").whole("states"), before)


def test_filters_of_a_dataset_do_not_see_its_columns(cart: Files, tmp_path: Path) -> None:
    dataset = cart().materialize(tmp_path / "columns")
    right = dataset.with_tuple_filter(F("action") == 1)
    assert right.observations.flags.owndata
    assert same(right.observations, dataset.observations[dataset.actions == 1])


def test_a_function_is_fresh_for_its_own_dataset_only(cart: Files, tmp_path: Path) -> None:
    directory = tmp_path / "columns"
    dataset = cart().with_tuple_filter(lambda step: step.action == 1).materialize(directory)
    written = token(directory)
    assert same(dataset.materialize(directory).actions, np.ones(len(dataset), np.int64))
    assert token(directory) == written
    cart().with_tuple_filter(lambda step: step.action == 1).materialize(directory)
    again = token(directory)
    assert again != written
    cart().materialize(directory)
    assert token(directory) != again
    assert len(np.load(directory / "action.npy")) == 700


def test_recordings_of_several_dtypes(tmp_path: Path) -> None:
    for i, dtype in enumerate((np.int16, np.int32)):
        space = spaces.Box(-1000, 1000, (2,), dtype)
        record(tmp_path / f"{i}.mcap", Scripted(lambda n, t=dtype: np.array([n, -n], t), space), 25)
    plain, mapped = (TupliDataset.from_files(str(tmp_path / "?.mcap")) for _ in range(2))
    mapped.materialize(tmp_path / "columns")
    assert mapped.observations.dtype == np.int32
    assert same(mapped.convert_to_d4rl_format(), plain.convert_to_d4rl_format())


def test_vector_recordings_and_storages(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    path = tmp_path / "lab" / "recordings" / "v.mcap"
    path.parent.mkdir(parents=True)
    with RecordVector(gym.make_vec("CartPole-v1", num_envs=3), path) as env:
        env.reset(seed=1)
        env.action_space.seed(1)
        for _ in range(200):
            env.step(env.action_space.sample())
    long = F("n_tuples") > 12
    plain = TupliDataset(storage).with_episode_filter(long)
    mapped = TupliDataset(storage).with_episode_filter(long).materialize(tmp_path / "columns")
    assert len(plain) > 100
    assert same(mapped.convert_to_d4rl_format(), plain.convert_to_d4rl_format())
    written = token(tmp_path / "columns")
    victim = plain.preview()[0].id
    storage.delete_episode(victim)
    fewer = TupliDataset(storage).with_episode_filter(long).materialize(tmp_path / "columns")
    assert token(tmp_path / "columns") != written
    assert len(fewer.preview()) == len(plain.preview())
    assert victim not in {header.id for header in fewer.preview()}


def test_recordings_behind_a_url(tmp_path: Path) -> None:
    path = tmp_path / "0.mcap"
    record(path, gym.make("CartPole-v1"), 100)
    written = []
    for change in (0, 0, 50):
        if change:
            record(path, gym.make("CartPole-v1"), change, mode="a")
        dataset = TupliDataset.from_files(f"file://{path}").materialize(tmp_path / "columns")
        assert same(dataset.observations, Recording(path).read().states)
        written.append(token(tmp_path / "columns"))
    assert written[0] == written[1] != written[2]


def test_a_recording_that_is_still_written(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "0.mcap") as env:
        roll(env, 100)
        dataset = TupliDataset.from_files(tmp_path / "0.mcap")
        dataset.preview()
        env.step(env.action_space.sample())
        expected = dataset.convert_to_d4rl_format()
        headers = dataset._query.headers
        dataset._query.refresh = lambda: headers  # type: ignore[method-assign]  # listed a step ago
        dataset.materialize(tmp_path / "columns")
        assert len(dataset) == 100
        assert same(dataset.convert_to_d4rl_format(), expected)
    written = token(tmp_path / "columns")
    TupliDataset.from_files(tmp_path / "0.mcap").materialize(tmp_path / "columns")
    assert token(tmp_path / "columns") != written


def test_copies_in_other_processes(cart: Files, tmp_path: Path) -> None:
    dataset = cart().materialize(tmp_path / "columns")
    steps = MappedSteps(tmp_path / "columns")
    there = pickle.loads(pickle.dumps(dataset))
    assert not there.observations.flags.owndata
    assert same(there.next_states, dataset.next_states)
    copied = pickle.dumps(steps)
    assert len(copied) < 1000
    assert same(pickle.loads(copied).whole("states"), dataset.observations)
    cart().with_tuple_filter(F("action") == 1).materialize(tmp_path / "columns")
    assert len(pickle.loads(pickle.dumps(dataset)).observations) == 700  # from the recordings
    with pytest.raises(StorageError, match="written anew since; materialize the dataset again"):
        pickle.loads(copied)
    assert len(steps.read(["states"], np.arange(700))["states"]) == 700  # mapped before


# --- what may go wrong ---


def test_nothing_to_materialize(cart: Files, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="expected episodes to materialize, found none"):
        cart().with_episode_filter(F("n_tuples") > 1000).materialize(tmp_path / "columns")
    with pytest.raises(DatasetError, match="expected the path of a directory for the columns, found None"):
        cart().materialize(None)
    assert not (tmp_path / "columns").exists()
    none = cart().with_tuple_filter(F("reward") > 2).materialize(tmp_path / "columns")
    assert none.observations.shape == (0, 4)
    assert len(none) == 0 == len(none.next_states)
    with pytest.raises(StorageError, match="holds no columns; write them with"):
        MappedSteps(tmp_path / "nowhere")


def test_a_directory_of_something_else_is_left_alone(cart: Files, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "state.npy").write_bytes(b"mine")
    with pytest.raises(StorageError, match="expected an empty directory .* found 'state.npy' in it"):
        cart().materialize(other)
    (other / "state.npy").rename(other / "manifest.json")
    with pytest.warns(UserWarning, match="expected a manifest"):
        with pytest.raises(StorageError, match="holds a manifest.json of something else"):
            cart().materialize(other)
    assert (other / "manifest.json").read_bytes() == b"mine"
    with pytest.raises(StorageError, match="cannot be read|cannot be written"):
        cart().materialize(tmp_path / "0.mcap")


def edited(directory: Path, change: Callable[[Any], object]) -> None:
    manifest = json.loads((directory / "manifest.json").read_text())
    change(manifest)
    (directory / "manifest.json").write_text(json.dumps(manifest))


def cut(directory: Path) -> None:
    os.truncate(directory / "state.npy", 500)


def unnamed(directory: Path) -> None:
    edited(directory, lambda manifest: manifest["files"].pop("state.npy"))


def missing(directory: Path) -> None:
    (directory / "action.npy").unlink()


def of_objects(directory: Path) -> None:
    path = directory / "state.npy"
    np.save(path, np.array([{"a": 1}] * 700, object), allow_pickle=True)
    edited(directory, lambda manifest: manifest["files"]["state.npy"].update(size=path.stat().st_size))


def another_shape(directory: Path) -> None:
    path = directory / "state.npy"
    np.save(path, np.zeros((1400, 2), np.float32))
    edited(directory, lambda manifest: manifest["files"]["state.npy"].update(size=path.stat().st_size))


def huge(directory: Path) -> None:
    edited(directory, lambda manifest: manifest.update(steps=1 << 60))


def no_array(directory: Path) -> None:
    path = directory / "state.npy"
    path.write_bytes(b"x" * path.stat().st_size)


def newer(directory: Path) -> None:
    edited(directory, lambda manifest: manifest.update(version=9))


def no_spaces(directory: Path) -> None:
    edited(directory, lambda manifest: manifest["spaces"].update(observation_space='{"type":"Os"}'))


def breaks_descend(directory: Path) -> None:
    np.save(directory / "break.npy", np.load(directory / "break.npy")[::-1].copy())


def a_break_less(directory: Path) -> None:
    breaks = np.load(directory / "break.npy")
    breaks[-1] -= 1
    np.save(directory / "break.npy", breaks)


def lengths_differ(directory: Path) -> None:
    np.save(directory / "episode_length.npy", np.load(directory / "episode_length.npy") + 1)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut, r"state.npy: expected \d+ bytes, found 500"),
        (unnamed, "expected a file state.npy in the manifest"),
        (missing, "action.npy is missing"),
        (of_objects, "expected an array of numbers"),
        (another_shape, r"expected <f4 of shape \(700, 4\)"),
        (huge, "expected .* of shape"),
        (no_array, "expected a .npy file"),
        (newer, "expected columns of version 1, found 9; update tupli-mcap"),
        (no_spaces, "manifest.json"),
        (breaks_descend, "breaks that ascend"),
        (a_break_less, "expected a break at every end of an episode"),
        (lengths_differ, "expected 700 steps of all episodes"),
    ],
)
def test_defects_are_format_errors(
    cart: Files, tmp_path: Path, damage: Callable[[Path], None], words: str
) -> None:
    directory = tmp_path / "columns"
    cart().materialize(directory)
    damage(directory)
    with pytest.raises(FormatError, match=words):
        MappedSteps(directory)
    with pytest.warns(UserWarning, match="materialize the dataset again; this is done now"):
        mended = cart().materialize(directory)
    assert same(mended.observations, cart().observations)


def test_changed_bytes_are_seen_by_their_digests(cart: Files, tmp_path: Path) -> None:
    directory = tmp_path / "columns"
    cart().materialize(directory, verify=True)
    with (directory / "state.npy").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x55")
    MappedSteps(directory)
    with pytest.raises(FormatError, match="state.npy: expected the SHA-256"):
        open_columns(directory, verify=True)
    with pytest.warns(UserWarning, match="this is done now"):
        mended = cart().materialize(directory, verify=True)
    assert same(mended.observations, cart().observations)


def test_damaged_values_of_variable_size(tmp_path: Path) -> None:
    record(tmp_path / "0.mcap", Sampler(SPACES["variable"], spaces.Discrete(2)), 25)
    TupliDataset.from_files(tmp_path / "0.mcap").materialize(tmp_path / "columns")
    path = tmp_path / "columns" / "state_word.values.bin"
    original = path.read_bytes()
    for at in range(0, len(original), 7):
        path.write_bytes(original[:at] + bytes([original[at] ^ 0xFF]) + original[at + 1 :])
        try:
            words = MappedSteps(tmp_path / "columns").whole("states")["word"]
        except FormatError:
            continue
        assert all(isinstance(word, str) for word in words)
    path.write_bytes(original)
    offsets = np.load(tmp_path / "columns" / "state_word.offsets.npy")
    offsets[3] = 1 << 40
    np.save(tmp_path / "columns" / "state_word.offsets.npy", offsets)
    with pytest.raises(FormatError, match="expected ascending offsets"):
        MappedSteps(tmp_path / "columns").read(["states"], np.array([3]))


def test_a_full_disk(cart: Files, tmp_path: Path) -> None:
    directory = tmp_path / "columns"
    cart().with_tuple_filter(F("action") == 1).materialize(directory)
    written = token(directory)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, hard))  # EFBIG, as ENOSPC from the same call
    try:
        with pytest.raises(StorageError, match="columns cannot be written to .*columns: .*; raise the limit"):
            cart().materialize(directory)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert token(directory) == written
    assert not list(directory.glob(".writing*"))
    assert len(MappedSteps(directory)) < 700


def forked(run: Callable[[], object]) -> int:
    """A child that does this; it leaves as if killed, with no handler and no `finally` run after."""
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            run()
            os._exit(0)
        os._exit(1)
    return child


def test_a_killed_writer_leaves_the_old_columns_or_none(
    cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "columns"
    for old in (False, True):
        if old:
            cart().with_tuple_filter(F("action") == 1).materialize(directory)
        with monkeypatch.context() as patched:
            patched.setattr(writing.StepsWriter, "finish", lambda self: os.kill(os.getpid(), signal.SIGKILL))
            child = forked(lambda: cart().materialize(directory))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        assert list(directory.glob(".writing*"))
        found = open_columns(directory)
        assert (found is not None) == old
    assert same(cart().materialize(directory).observations, cart().observations)
    assert not list(directory.glob(".writing*"))


def test_killed_while_files_are_put_into_place(
    cart: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "columns"
    cart().with_tuple_filter(F("action") == 1).materialize(directory)
    real, calls = Path.replace, []

    def replace(path: Path, target: Path) -> Path:
        calls.append(path)
        if len(calls) == 5:
            raise OSError(errno.EIO, "gone")
        return real(path, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(StorageError, match="gone"):
        cart().materialize(directory)
    monkeypatch.undo()
    assert open_columns(directory) is None
    assert same(cart().materialize(directory).observations, cart().observations)


def test_two_at_once(cart: Files, tmp_path: Path) -> None:
    directory = tmp_path / "columns"
    datasets, errors = [cart() for _ in range(4)], []

    def run(dataset: TupliDataset) -> None:
        try:
            dataset.materialize(directory)
        except TupliError as err:
            errors.append(err)

    threads = [threading.Thread(target=run, args=[dataset]) for dataset in datasets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    tokens = {dataset._query._mapped.opened.manifest.token for dataset in datasets}  # type: ignore[union-attr]
    assert tokens == {token(directory)}
    assert all(same(dataset.observations, cart().observations) for dataset in datasets)


def test_readers_meet_whole_columns_only(cart: Files, tmp_path: Path) -> None:
    """One process writes two queries in turn; another one opens what is there, again and again."""
    directory = tmp_path / "columns"
    lengths = {700, int((cart().actions == 1).sum())}
    cart().materialize(directory)

    def write() -> None:
        for i in range(8):
            cart().with_tuple_filter(None if i % 2 else F("action") == 1).materialize(directory)

    child, seen = forked(write), set()
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        found = open_columns(directory)
        if found is not None:
            assert len(found.terminal) == len(found.step) == found.manifest.steps
            seen.add(len(found.terminal))
        time.sleep(0.002)
    assert ended[1] == 0
    assert seen == lengths


def test_memory_is_bounded(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (128, 128, 3), np.uint8)
    frame = np.random.default_rng(1).integers(0, 255, (128, 128, 3), np.uint8)
    record(tmp_path / "0.mcap", Scripted(lambda n: np.roll(frame, n), space, length=1500), 1500)
    script = (
        "import resource, sys\nfrom tupli_mcap import TupliDataset\nimport tupli_mcap.dataset.writing\n"
        "peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "d = TupliDataset.from_files(sys.argv[1]); d.preview(); before = peak()\n"
        "d.materialize(sys.argv[2])\nprint(peak() - before)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "0.mcap"), str(tmp_path / "columns")]
    grown = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert 1500 * frame.nbytes > 70 << 20
    assert grown < 50 << 10  # KiB
