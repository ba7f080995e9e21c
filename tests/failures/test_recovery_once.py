"""Recovery in memory and `recover_recording` give the same episodes of what a writer left: one way to think of it."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from golden_files import EARLIER, GOLDEN, UNFINISHED, place
from power_loss import KINDS, crash, record
from recovered import compared, differences

from tupli_mcap import Recording, journal_path, recover_recording


@pytest.mark.parametrize("name", UNFINISHED)
def test_of_golden_recordings(name: str, tmp_path: Path) -> None:
    assert differences(place(name, tmp_path), tmp_path, killed=True) == []


@pytest.mark.parametrize(("folder", "name"), EARLIER)
def test_of_those_of_earlier_writers(folder: str, name: str, tmp_path: Path) -> None:
    assert differences(place(name, tmp_path, GOLDEN / folder), tmp_path, killed=True) == []


@pytest.mark.parametrize(
    "name", ["constant_zstd", "dict_with_images", "vector_same_step", "vector_variable", "frames"]
)
def test_of_a_finished_recording_that_was_cut_off(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    data = path.read_bytes()
    for size in range(len(data) - 1, 0, -len(data) // 12):
        path.write_bytes(data[:size])
        assert differences(path, tmp_path) == [], size


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", UNFINISHED)
def test_of_an_unfinished_one_that_was_cut_off(name: str, tmp_path: Path) -> None:
    """With the journal, and without it."""
    path = place(name, tmp_path)
    data = path.read_bytes()
    for size in range(len(data) - 1, 0, -len(data) // 9):
        path.write_bytes(data[:size])
        assert differences(path, tmp_path) == [], size
    journal_path(path).unlink()
    path.write_bytes(data)
    assert differences(path, tmp_path) == []


@pytest.mark.sampled(2)
@pytest.mark.parametrize("durability", ["step", "os"])
@pytest.mark.parametrize("kind", KINDS)
def test_after_a_power_loss(kind: str, durability: str, tmp_path: Path) -> None:
    story = record(tmp_path / "live.mcap", kind, durability, 40, 300_000 if kind == "frames" else 2000)
    rng, disk = random.Random(f"{kind} {durability}"), tmp_path / "r.mcap"
    for _ in range(3 if kind == "frames" else 12):
        at = rng.randrange(len(story.moments))
        crash(story, at, disk, rng)
        assert differences(disk, tmp_path) == [], at


def test_a_difference_is_seen(tmp_path: Path) -> None:
    path, target = place("constant_zstd", tmp_path), tmp_path / "recovered.mcap"
    data = path.read_bytes()
    with Recording(path) as whole:
        recover_recording(path, target)
        with Recording(target) as recovered:
            assert compared(whole, recovered) == []
        cut = tmp_path / "cut.mcap"
        for left in (0.45, 0.4):
            cut.write_bytes(data[: int(len(data) * left)])
            recover_recording(cut, target, overwrite=True)
            with Recording(target) as recovered:
                assert compared(whole, recovered)
