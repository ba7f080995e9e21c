"""Power losses: what was synced survives, and what was not is left out rather than wrong."""

from __future__ import annotations

import errno
import os
import random
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, Scripted
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from power_loss import KINDS, OTHER_BOOT, check, crash, record

from tupli_mcap import (
    FileStorage,
    FormatError,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliEnvWrapper,
    recover_recording,
    verify_recording,
)
from tupli_mcap.journal.file import RowArea
from tupli_mcap.recording import journal_path
from tupli_mcap.recording.write import writer
from tupli_mcap.vector import RecordEpisodes as RecordVector


@pytest.mark.sampled(6)
@pytest.mark.parametrize("durability", ["step", "chunk", "os"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_was_synced_survives(kind: str, durability: str, tmp_path: Path) -> None:
    story = record(tmp_path / "live.mcap", kind, durability, 40, 300_000 if kind == "frames" else 2000)
    rng = random.Random(f"{kind} {durability}")
    place = tmp_path / "r.mcap"
    kept = []
    for _ in range(6 if kind == "frames" else 15):
        at = rng.randrange(len(story.moments))
        kept.append(check(story, place, crash(story, at, place, rng)))
    if durability != "os":
        assert max(kept) > 0
        assert all(crash(story, len(story.moments) - 1, place, rng))


def test_in_step_durability_all_that_returned_is_there(tmp_path: Path) -> None:
    story = record(tmp_path / "live.mcap", "box", "step", 40)
    place, rng = tmp_path / "r.mcap", random.Random(1)
    for at, moment in enumerate(story.moments):
        if moment.steps[0]:
            needed = crash(story, at, place, rng)
            assert check(story, place, needed) >= moment.steps[0] == needed[0]
    assert needed == [40]


@pytest.mark.parametrize("kind", ["box", "text", "image"])
def test_cut_at_every_byte(kind: str, tmp_path: Path) -> None:
    """The file or the journal ends early: what is read is true, and what both hold is all there."""
    story = record(tmp_path / "live.mcap", kind, "step", 30, 1000)
    last = story.moments[-1]
    place = tmp_path / "r.mcap"
    assert last.journal is not None
    counts = []
    journal_path(place).write_bytes(last.journal)
    step = 37 if kind == "box" else 97
    for size in [*range(0, len(last.file), step), len(last.file)]:
        place.write_bytes(last.file[:size])
        counts.append(check(story, place, [0]))
    assert counts[-1] == 30
    journal_path(place).unlink()
    alone = check(story, place, [0])
    for size in range(0, min(len(last.journal), 12_000), 151):
        journal_path(place).write_bytes(last.journal[:size])
        with pytest.raises(FormatError, match="journal"):
            Recording(place)
        report = recover_recording(place, tmp_path / "recovered.mcap", overwrite=True)
        assert (report.journal, report.steps) == ("damaged", alone)


def test_without_seals_only_what_shows_to_be_whole_counts(tmp_path: Path) -> None:
    story = record(tmp_path / "live.mcap", "large", "os", 4, 30_000)
    place = tmp_path / "r.mcap"
    place.write_bytes(story.moments[-1].file)
    journal_path(place).write_bytes(story.moments[-1].journal or b"")
    with pytest.warns(UserWarning, match=r"was restarted afterwards.*1 step\(s\) in its journal.*left out"):
        assert Recording(place).n_steps == 3  # in the file: there was a flush


def test_ends_whose_steps_a_power_loss_took_are_no_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that may be torn are left out; ends have checksums, and stay in the file that somebody appends to."""
    monkeypatch.setattr(writer, "boot_id", lambda: OTHER_BOOT)
    path, place = tmp_path / "live.mcap", tmp_path / "r.mcap"

    def play(path: Path, episodes: int, **options: Any) -> RecordEpisodes:
        env = Sampler(spaces.Box(-1, 1, (200,), np.float64), spaces.Discrete(2), length=7)
        recorder = RecordEpisodes(env, path, chunk_size=20_000, **options)
        for seed in range(episodes):
            recorder.reset(seed=seed)
            while not any(recorder.step(recorder.action_space.sample())[2:4]):
                pass
        return recorder

    live = play(path, 6)
    shutil.copy(path, place)
    shutil.copy(journal_path(path), journal_path(place))
    live.close()
    with pytest.warns(UserWarning, match="was restarted afterwards"):
        left = Recording(place).lengths.tolist()
    assert 1 < len(left) < 6 and left[-1] < 7  # one episode was cut, and others are gone
    with pytest.warns(UserWarning, match="was restarted afterwards"):
        play(place, 2, mode="a").close()
    with Recording(place) as recording:
        assert recording.lengths.tolist() == [*left, 7, 7]
        assert recording.episodes[len(left) - 1].end == "interrupted"
    report = verify_recording(place)
    assert report.ok
    assert {problem.kind for problem in report.problems} == {"episode", "final_state"}


def test_small_rows_are_shown_to_be_whole_by_those_after_them(tmp_path: Path) -> None:
    story = record(tmp_path / "live.mcap", "box", "os", 30, 30_000)
    place = tmp_path / "r.mcap"
    place.write_bytes(story.moments[-1].file)
    journal_path(place).write_bytes(story.moments[-1].journal or b"")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert 29 <= Recording(place).n_steps <= 30


def test_on_the_same_boot_every_row_counts(tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    env = RecordEpisodes(gym.make("CartPole-v1"), path)
    env.reset(seed=1)
    for _ in range(5):
        env.step(0)
    copy = tmp_path / "copy.mcap"
    shutil.copy(path, copy)
    shutil.copy(journal_path(path), journal_path(copy))
    env.close()
    assert Recording(copy).n_steps == 5


def test_a_disk_that_does_not_sync_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(fd: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", durability="chunk")
    env.reset(seed=1)
    env.step(0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fdatasync", refuse)
        with pytest.raises(
            RecordingError, match=r"r\.mcap.*: could not be synced to the disk: Input/output error"
        ):
            env.close()
    assert Recording(tmp_path / "r.mcap").n_steps == 1


def test_durability_costs_syncs_where_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    real_file, real_journal, real_directory = writer.sync_file, writer.Journal.sync, writer.sync_directory
    monkeypatch.setattr(writer, "sync_file", lambda *a: (synced.append("file"), real_file(*a))[1])
    monkeypatch.setattr(
        writer, "sync_directory", lambda *a: (synced.append("directory"), real_directory(*a))[1]
    )
    monkeypatch.setattr(writer.Journal, "sync", lambda *a: (synced.append("journal"), real_journal(*a))[1])
    counts: dict[str, list[str]] = {}
    for durability in ("os", "chunk", "step"):
        env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / f"{durability}.mcap", durability=durability)
        env.reset(seed=1)
        for _ in range(5):
            env.step(0)
        before = list(synced)
        env.close()
        counts[durability] = [*before, "|", *synced[len(before) :]]
        synced.clear()
    assert counts["os"] == ["|"]
    first = ["journal", "journal", "file", "directory"]
    assert counts["chunk"][: len(first) + 1] == [*first, "|"]
    assert counts["step"][: len(first)] == first
    assert (
        counts["step"][len(first) : counts["step"].index("|")] == ["journal"] * 6
    )  # at the reset, and at each step
    assert counts["chunk"][-2:] == counts["step"][-2:] == ["file", "directory"]


def test_every_recorder_takes_it(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage, durability="chunk")
    env.store(name="pole")
    env.reset(seed=1)
    env.step(0)
    env.close()
    assert len(storage.list_episodes()) == 1
    with pytest.raises(
        RecordingError, match=r"durability: expected one of \['os', 'chunk', 'step'\], found 'disk'"
    ):
        wrong: Any = "disk"
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", durability=wrong)


def test_a_damaged_seal_is_not_passed_on(tmp_path: Path) -> None:
    """A flipped bit in a record of the journal ends what is read of it, on any boot."""
    path = tmp_path / "live.mcap"
    env = RecordEpisodes(gym.make("CartPole-v1"), path)
    env.reset(seed=123456789)
    env.step(0)
    data = bytearray(journal_path(path).read_bytes())
    at = data.index(b"123456789")
    data[at] ^= 1
    copy = tmp_path / "copy.mcap"
    shutil.copy(path, copy)
    journal_path(copy).write_bytes(data)
    env.close()
    episode = Recording(copy).episodes[0:1]
    assert [e.seed for e in episode] == [None]
    with pytest.raises(FormatError, match="cut off or damaged"):
        copy.write_bytes(path.read_bytes()[:100])
        Recording(copy)


def counting(size: int, length: int = 10**9) -> gym.Env[Any, Any]:
    space = spaces.Box(-1, 1e9, (size,), np.float32)
    return Scripted(lambda n: np.full(size, n, np.float32), space, length=length)


def opened(path: Path, kind: str, **options: Any) -> Any:
    if kind == "single":
        return RecordEpisodes(counting(100), path, chunk_size=8000, **options)
    return RecordVector(SyncVectorEnv([lambda: counting(100)] * 2), path, **options)


@pytest.mark.parametrize("kind", ["single", "vector"])
def test_a_row_that_was_being_written_over_does_not_pass_for_the_old_one(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file lost its last chunks, and some sectors of the journal are as they were a while before."""
    monkeypatch.setattr(writer, "boot_id", lambda: OTHER_BOOT)
    path, place = tmp_path / "live.mcap", tmp_path / "r.mcap"
    env = opened(path, kind)
    env.reset(seed=1)
    files, journals = {}, {}
    env.step(env.action_space.sample())
    area = env._writer.journal.area("steps", RowArea)
    start, size = env._writer.journal.offsets["steps"], area.row_size
    for n in range(1, 2 * area.rows + 12):
        if n < 12:
            env.flush()
            files[n] = path.read_bytes()
        if n >= 2 * area.rows - 1:
            journals[n] = journal_path(path).read_bytes()
        env.step(env.action_space.sample())
    before = journals[2 * area.rows - 1]
    for n, file in files.items():
        now = journals[2 * area.rows + n]
        cut = -(-(start + n * size + 60) // 512) * 512  # behind the sector that the row begins in
        for journal in (now, before[:cut] + now[cut:], now[:cut] + before[cut:]):
            place.write_bytes(file)
            journal_path(place).write_bytes(journal)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                recording = Recording(place)
            for episode in recording.episodes:
                assert (
                    episode.states[:, -1].tolist()
                    == episode.states[:, 0].tolist()
                    == list(range(len(episode)))
                )
    env.close()


def test_no_final_state_is_made_of_the_next_episodes_first_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under same-step autoreset, the row that ends an episode reached the disk, and its final state did not."""
    monkeypatch.setattr(writer, "boot_id", lambda: OTHER_BOOT)
    path, place = tmp_path / "live.mcap", tmp_path / "r.mcap"
    envs = SyncVectorEnv([lambda: counting(2, 3)], autoreset_mode=AutoresetMode.SAME_STEP)
    env = RecordVector(envs, path, durability="step")
    env.reset(seed=1)
    for _ in range(2):
        env.step(env.action_space.sample())
    before = journal_path(path).read_bytes()
    at = env._writer.journal.offsets["events"]  # type: ignore[union-attr]
    shutil.copy(path, place)
    env.step(env.action_space.sample())
    journal_path(place).write_bytes(journal_path(path).read_bytes()[:at] + before[at:])
    with Recording(place) as recording:
        (episode,) = recording.episodes
        assert (len(episode), episode.end, episode.final_state) == (3, "terminal", None)
    env.close()


def test_the_running_state_of_a_variable_layout_outlives_a_switch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "boot_id", lambda: OTHER_BOOT)
    path, place = tmp_path / "live.mcap", tmp_path / "r.mcap"
    env = RecordEpisodes(
        Scripted(lambda n: f"{n:0100}", spaces.Text(100)), path, durability="step", chunk_size=500
    )
    env.reset(seed=1)
    for n in range(1, 9):
        env.step(0)
        shutil.copy(path, place)
        shutil.copy(journal_path(path), journal_path(place))
        (episode,) = Recording(place).episodes
        assert (len(episode), episode.final_state) == (n, f"{n:0100}")
    env.close()
