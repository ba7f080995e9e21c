"""New files: of threads that write one path, one does; of files that belong together, all are made or none is."""

from __future__ import annotations

import resource
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium as gym
import pytest

import tupli_mcap
from tupli_mcap import RecordEpisodes, Recording, TupliError, merge_recordings, recover_recording
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.split import split_recording
from tupli_mcap.viewer.foxglove_layout import write_layout

AT_ONCE = 4


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in "ab":
        with RecordEpisodes(
            gym.make("CartPole-v1", render_mode="rgb_array"), tmp_path / f"{name}.mcap", frames=True
        ) as env:
            for seed in range(3):
                env.reset(seed=seed)
                for _ in range(5):
                    env.step(0)
    return tmp_path


WRITES: dict[str, Callable[[Path, Path], object]] = {
    "save": lambda place, new: tupli_mcap.open(place / "a.mcap").save(new),
    "save several": lambda place, new: tupli_mcap.open([place / "a.mcap", place / "b.mcap"]).save(new),
    "trim": lambda place, new: tupli_mcap.open(place / "a.mcap").trim(slice(1, None), new),
    "trim several": lambda place, new: tupli_mcap.open([place / "a.mcap", place / "b.mcap"]).trim(slice(1, None), new),
    "map": lambda place, new: tupli_mcap.open(place / "a.mcap").map(lambda episode: episode.rewards, new),
    "merge": lambda place, new: merge_recordings([place / "a.mcap", place / "b.mcap"], new),
    "split": lambda place, new: split_recording(place / "a.mcap", new, episodes=3),
    "recover": lambda place, new: recover_recording(place / "a.mcap", new),
    "film": lambda place, new: tupli_mcap.open(place / "a.mcap")[0].video(new.with_suffix(".gif")),
    "layout": lambda place, new: write_layout(place / "a.mcap", new.with_suffix(".json")),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITES)
def test_one_of_several_at_once_writes(name: str, place: Path) -> None:
    start = threading.Barrier(AT_ONCE)

    def write(_: int) -> str:
        start.wait()
        try:
            WRITES[name](place, place / "new.mcap")
        except TupliError as err:
            return str(err)
        return ""

    with ThreadPoolExecutor(AT_ONCE) as pool:
        said = list(pool.map(write, range(AT_ONCE)))
    assert said.count("") == 1, said
    assert all("exists" in each or "made by somebody else meanwhile" in each for each in said if each)
    assert not [path for path in place.iterdir() if path.name.startswith(".")]


def test_a_file_that_comes_meanwhile_stays(place: Path) -> None:
    new = place / "new.mcap"

    def come(episode: tupli_mcap.Episode) -> object:
        new.write_bytes(b"somebody's")
        return episode.rewards

    dataset = tupli_mcap.open(place / "a.mcap")
    with pytest.raises(TupliError, match=r"new\.mcap was made by somebody else meanwhile"):
        dataset.map(come, new)
    assert new.read_bytes() == b"somebody's"
    dataset.map(come, new, overwrite=True)
    assert len(Recording(new)) == 3
    with pytest.raises(TupliError, match=r"a\.mcap/b\.mcap cannot be written: File exists"):
        with replacing(place / "a.mcap" / "b.mcap", overwrite=False):
            pass


def test_a_part_that_cannot_be_written_leaves_none(tmp_path: Path) -> None:
    path, parts = tmp_path / "all.mcap", tmp_path / "parts"
    with RecordEpisodes(gym.make("MountainCar-v0"), path) as env:
        for steps in (3, 199, 3):
            env.reset(seed=steps)
            for _ in range(steps):
                env.step(1)
    sizes = [part.size for part in split_recording(path, tmp_path / "first" / "part.mcap", episodes=1)]
    assert sizes[0] + 500 < sizes[1]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (sizes[0] + 500, hard))  # EFBIG, as ENOSPC from the same call
    try:
        with pytest.raises(TupliError, match=r"part_0001\.mcap: could not write .*File too large"):
            split_recording(path, parts / "part.mcap", episodes=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(parts.iterdir()) == []
    assert len(split_recording(path, parts / "part.mcap", episodes=1)) == 3
