"""The reading path: runs of rows, chunks that are mapped, checksums, threads."""

from __future__ import annotations

import mmap
import os
import struct
import subprocess
import sys
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll, same
from hypothesis import given, settings, strategies as st

from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import CHUNK_ROWS
from tupli_mcap.mcap.records import crc32
from tupli_mcap.mcap.source import PathSource, open_source
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore
from tupli_mcap.recording.columns.gather import do_all
from tupli_mcap.vector import RecordEpisodes as RecordVector

FIELDS = ("states", "actions", "rewards", "terminals", "timeouts", "next_states", "times")


@pytest.fixture(scope="module")
def vector(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Some 200 episodes of five CartPoles, whose steps are mixed in several chunks."""
    path = tmp_path_factory.mktemp("vector") / "v.mcap"
    with RecordVector(gym.make_vec("CartPole-v1", num_envs=5), path, chunk_size=4096) as env:
        env.reset(seed=1)
        env.action_space.seed(1)
        for _ in range(900):
            env.step(env.action_space.sample())
    return Recording(path)


@pytest.fixture(scope="module")
def by_episode(vector: Recording) -> list[Any]:
    """The columns of each episode, read on its own."""
    return [vector.read(episodes=[i], fields=FIELDS, threads=1) for i in range(len(vector))]


@settings(max_examples=40)
@given(data=st.data())
def test_episodes_in_any_order(vector: Recording, by_episode: list[Any], data: st.DataObject) -> None:
    some = st.lists(st.integers(0, len(vector) - 1), max_size=60)
    chosen = data.draw(st.one_of(some, st.just(list(range(len(vector)))), some.map(sorted)))
    fields = data.draw(st.lists(st.sampled_from(FIELDS), min_size=1, unique=True))
    found = vector.read(episodes=chosen, fields=fields, threads=data.draw(st.integers(1, 2)))
    for field in FIELDS:
        parts = [getattr(by_episode[i], field) for i in chosen]
        if field not in fields:
            assert getattr(found, field) is None
        elif parts:
            assert same(getattr(found, field), np.concatenate(parts))
        else:
            assert len(getattr(found, field)) == 0


@pytest.mark.sampled(6)
@pytest.mark.parametrize("shape", [(), (1,), (1, 1), (3,), (2, 0, 3), (2, 3)])
@pytest.mark.parametrize("steps", [20, 3000])
def test_values_of_any_shape(tmp_path: Path, shape: tuple[int, ...], steps: int) -> None:
    space = gym.spaces.Dict({"a": gym.spaces.Box(-9, 9, shape, np.float16), "b": gym.spaces.MultiBinary(5)})
    env = Sampler(space, gym.spaces.Box(0, 9, shape, np.int16))
    with RecordEpisodes(env, tmp_path / "a.mcap", chunk_size=4096) as recorder:
        taken = roll(recorder, steps)
    columns = Recording(tmp_path / "a.mcap").read()
    assert same(columns.states["a"], np.array([step[0]["a"] for step in taken]))
    assert same(columns.states["b"], np.array([step[0]["b"] for step in taken]))
    assert same(columns.actions, np.array([step[1] for step in taken]))


def record(path: Path, steps: int = 500, **options: Any) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), path, **options) as env:
        roll(env, steps)


def test_rows_that_are_not_compressed_are_not_copied(tmp_path: Path) -> None:
    for compression in ("none", "zstd"):
        record(tmp_path / f"{compression}.mcap", compression=compression)
    plain, packed = (Recording(tmp_path / f"{name}.mcap") for name in ("none", "zstd"))
    chunk = plain._store.chunks(plain._step_channels[0])[0]
    rows = plain._store.rows(chunk, plain.layout.step_message.dtype)
    held = rows
    while isinstance(held, np.ndarray):
        held = held.base
    assert isinstance(held.obj, mmap.mmap)
    columns = plain.read(fields=FIELDS[:6])
    assert same(columns.states, packed.read().states)
    columns.states[:] = 0  # one's own
    plain.close()
    assert rows["#channel"].all()  # what is held stays


def test_damage_in_rows_that_are_not_compressed(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", compression="none")
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    row = Recording(tmp_path / "a.mcap")._store.table[0]
    data[int(row["offset"]) + int(row["length"]) // 2] ^= 1
    (tmp_path / "a.mcap").write_bytes(data)
    for _ in range(2):
        with pytest.raises(FormatError, match="its CRC differs"):
            Recording(tmp_path / "a.mcap").read()


def test_records_that_are_no_rows(tmp_path: Path) -> None:
    """All that a row begins with is looked at: its opcode, length and channel."""
    (tmp_path / "empty").touch()
    table, dtype = np.zeros(1, CHUNK_ROWS), np.dtype([("record", "V31"), ("x", "<u4")])
    table["offset"], table["rows"], table["channel"] = IN_MEMORY, 3, 0x0107
    good = struct.pack("<BQH20xI", 5, 26, 0x0107, 9) * 3

    def rows(data: bytes) -> Any:
        return ChunkStore(PathSource(tmp_path / "empty"), table, [data], 0).rows(0, dtype)

    assert rows(good)["x"].tolist() == [9, 9, 9]
    table["rows"] = 0
    assert rows(b"")["x"].tolist() == []
    table["rows"] = 3
    for row in range(3):
        for at in range(12):
            data = bytearray(good)
            data[35 * row + at] ^= 0x40
            if at == 11:  # the sequence
                assert rows(bytes(data))["x"].tolist() == [9, 9, 9]
                continue
            with pytest.raises(FormatError, match="chunk 0 holds records that are not rows of its channel"):
                rows(bytes(data))


def test_a_file_that_grows_is_mapped_anew(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(bytes(range(100)))
    source = PathSource(path)
    first = source.view(10, 5)
    with path.open("ab") as file:
        file.write(b"more")
    with pytest.raises(FormatError, match="expected 4 bytes at offset 100, found the end of the file at 100"):
        source.view(100, 4)
    source.refresh()
    assert bytes(source.view(100, 4)) == b"more"
    assert bytes(first) == bytes(range(10, 15))


def test_the_end_of_the_interpreter_is_quiet(tmp_path: Path) -> None:
    """A source may outlive what its module imports, if other packages keep modules (EnvPool does)."""
    path = tmp_path / "a"
    program = """
import ctypes, sys, types
from pathlib import Path
kept = sys.modules["kept"] = types.ModuleType("kept")
from tupli_mcap.mcap import source
kept.sources = [source.PathSource(Path(sys.argv[1])), source.open_source(open(sys.argv[1], "rb"))]
for module in (kept, source):
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(module))
"""
    path.write_bytes(b"any")
    ended = subprocess.run(
        [sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True
    )
    assert ended.stderr == ""


@pytest.mark.parametrize("kind", ["path", "file"])
def test_several_threads_read_one_file(tmp_path: Path, kind: str) -> None:
    content = os.urandom(9 << 20)
    (tmp_path / "a").write_bytes(content)
    file = (tmp_path / "a").open("rb")
    source = open_source(tmp_path / "a" if kind == "path" else file)

    def check(seed: int) -> bool:
        random = np.random.default_rng(seed)
        for size in (1, 1000, 300_000, 5 << 20):
            at = int(random.integers(0, len(content) - size))
            expected = content[at : at + size]
            if source.read(at, size) != expected or bytes(source.view(at, size)) != expected:
                return False
        return True

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(check, range(12)))
    with pytest.raises(FormatError, match="found the end"):
        source.read(len(content) - 1, 2)
    source.close()
    file.close()


def test_tasks_are_done_once_by_several_threads() -> None:
    met, done = threading.Barrier(3), list[int]()
    names = set[str]()

    def task(number: int) -> None:
        if number < 3:
            met.wait(30)  # which three threads at work at a time do
        names.add(threading.current_thread().name)
        done.append(number)

    do_all([lambda number=number: task(number) for number in range(200)], 3)
    assert sorted(done) == list(range(200))
    assert threading.current_thread().name in names
    assert len(names) == 3


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_of_a_task_ends_the_others(threads: int) -> None:
    done = list[int]()

    def task(number: int) -> None:
        done.append(number)
        raise FormatError(f"chunk {number} is damaged")

    with pytest.raises(FormatError, match=r"chunk \d+ is damaged"):
        do_all([lambda number=number: task(number) for number in range(200)], threads)
    assert len(done) <= threads


def test_checksums_are_those_of_zlib() -> None:
    for size in (0, 1, 7, 8, 63, 4096, 6000, 100_001):
        data = os.urandom(size)
        assert crc32(data) == zlib.crc32(data)
        assert crc32(memoryview(data)[size // 3 :], 5) == zlib.crc32(data[size // 3 :], 5)
