"""Starts, ends and final states that are made of rows, and of what lies between them in the journal."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from abandoned import killed
from environments import Sampler, Scripted, same
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import RecordEpisodes, Recording, journal_path, recover_recording, verify_recording
from tupli_mcap.journal import file as journals
from tupli_mcap.journal.committed import CommittedRows
from tupli_mcap.journal.file import JournalContents, read_journal
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.records import HOLE
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.vector import RecordEpisodes as RecordVector

BOX = spaces.Box(-1, 1, (4,), np.float32)
ACTIONS = spaces.Discrete(9)
FACTS = ["episode", "env", "first_row", "length", "return", "end"]


def copied(path: Path, place: Path, *, lost: bool = True) -> Path:
    """A copy of a recording that is written, and of its journal; `lost`: without starts, ends and final states."""
    shutil.copy(path, place)
    shutil.copy(journal_path(path), journal_path(place))
    if lost:
        write_area(place, "events", bytes(8))
    return place


def write_area(path: Path, name: str, data: bytes) -> None:
    """Writes over the beginning of an area of a recording's journal."""
    with journals._open(journal_path(path)) as file:
        _, _, offsets = journals._read_header(journal_path(path), file)
    with journal_path(path).open("r+b") as file:
        file.seek(offsets[name])
        file.write(data)


def ways(path: Path) -> list[Callable[[], Path]]:
    """What an unfinished recording is read by, each with the same facts; the last one finishes it."""

    def recovered() -> Path:
        report = recover_recording(path, overwrite=True)
        assert (report.steps_lost, report.lost) == (0, [])
        return Path(report.target or "")

    def appended() -> Path:
        with Recording(path) as recording:
            n, many = recording.num_envs, recording.is_vector
        if many:
            RecordVector(SyncVectorEnv([lambda: Sampler(BOX, ACTIONS)] * n), path, mode="a").close()
        else:
            RecordEpisodes(Sampler(BOX, ACTIONS), path, mode="a").close()
        assert verify_recording(path).ok
        return path

    return [lambda: path, recovered, appended]


def assert_like(path: Path, whole: Path, *, firsts: int) -> None:
    """The episodes are those of the whole recording; of the first ones, time and seed of the reset are lost."""
    with Recording(path) as recording, Recording(whole) as wanted:
        found, index = recording.index, wanted.index
        assert len(found) == len(index) >= firsts
        assert (found[FACTS] == index[FACTS]).all()
        times = [wanted.read(episodes=[i], fields=["times"]).times for i in range(len(index))]
        assert (found["start_time"][:firsts] == [each[0] for each in times[:firsts]]).all()
        assert (found["start_time"][firsts:] == index["start_time"][firsts:]).all()
        lasts = np.array([each[-1] for each in times])
        assert (found["end_time"] == lasts).all() or not firsts
        assert ((lasts <= found["end_time"]) & (found["end_time"] <= index["end_time"])).all()
        for i in range(len(index)):
            assert same(recording.final_state(i), wanted.final_state(i)), i
            assert recording.episodes[i].seed == (None if i < firsts else wanted.episodes[i].seed)
            assert recording.episode_metadata(i) == {}


@pytest.fixture
def ticks(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """A clock that stands until it is called."""
    now = [time.time_ns()]

    def tick() -> None:
        now[0] += 1_000_000

    monkeypatch.setattr(time, "time_ns", lambda: now[0])
    return tick


def vector(path: Path, space: spaces.Space[Any], envs: int = 3, **options: Any) -> Any:
    makers = [lambda i=i: Sampler(space, ACTIONS, length=4 + i) for i in range(envs)]
    return RecordVector(SyncVectorEnv(makers), path, **options)


@pytest.mark.sampled(0, keep=["20", "851", "852"])
@pytest.mark.parametrize("steps", [20, 850, 851, 852, 853, 854, 1600])
def test_a_vector_recording_without_its_events(tmp_path: Path, ticks: Callable[[], None], steps: int) -> None:
    """Half of the rows may be in the file: their holes are still there."""
    path = tmp_path / "r.mcap"
    env = vector(path, BOX, chunk_size=4096)
    env.reset(seed=1)
    for _ in range(steps):
        ticks()
        env.step(env.action_space.sample())
    assert env._writer.vector._area.rows == 851
    copy = copied(path, tmp_path / "copy.mcap")
    env.close()
    for way in ways(copy):
        assert_like(way(), path, firsts=3)


def single(path: Path, steps: int, length: int, chunk_size: int = 32 * 77) -> RecordEpisodes:
    """A recording that goes on, of random states and rewards."""
    rng = random.Random(3)
    env = Scripted(
        lambda step: np.array([rng.random() for _ in range(4)], np.float32),
        BOX,
        ACTIONS,
        reward=lambda step: rng.random(),
        length=length,
    )
    recorder = RecordEpisodes(env, path, chunk_size=chunk_size)
    recorder.reset(seed=1)
    for i in range(steps):
        if recorder.step(i % 9)[2]:
            recorder.reset()
    return recorder


def steps_in(journal: JournalContents, layout: StepLayout) -> CommittedRows:
    return CommittedRows(journal, "steps", 0, layout.step_message.dtype, journal.info["channels"][0][0])


@pytest.mark.sampled(8)
@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize(
    ("steps", "length"), [(57, 5), (60, 4), (100, 4), (5, 5), (60, 12), (56, 7), (57, 7), (90, 3), (63, 63)]
)
def test_a_recording_without_its_events(tmp_path: Path, steps: int, length: int, lost: bool) -> None:
    """Also where a final state, or the row after it, is the first one of the other half."""
    path = tmp_path / "r.mcap"
    env = single(path, steps, length)
    copy = copied(path, tmp_path / "copy.mcap", lost=lost)
    env.close()
    with Recording(path) as recording:
        salvage = steps_in(read_journal(journal_path(copy)), recording.layout)
        assert salvage.rows.shape == (2, 65)
        ended = recording.index[recording.index["length"] == length]
        holes = salvage.finals(recording.layout.state_end)
        assert [hole[:2] + hole[3:] for hole in holes] == [
            (episode, recording.final_state(episode).tobytes(), first + length)
            for episode, first in ended[["episode", "first_row"]].tolist()
        ]
        starts = recording.index["start_time"][1:].tolist()
        assert [hole.time_ns for hole in holes][: len(starts)] == starts
    report = recover_recording(copy, dry_run=True)
    assert (report.starts_lost, report.ends_lost, report.final_states_lost) == ([0] if lost else [], [], [])
    for way in ways(copy):
        assert_like(way(), path, firsts=int(lost))


@pytest.mark.parametrize("steps", [300, 311, 312, 313, 314, 315])
def test_holes_that_are_written_over_have_told_all(tmp_path: Path, steps: int) -> None:
    path = tmp_path / "r.mcap"
    env = single(path, steps, 5)
    copy = copied(path, tmp_path / "copy.mcap", lost=False)
    env.close()
    for way in ways(copy):
        assert_like(way(), path, firsts=0)


def test_rows_before_holes_are_shown_to_be_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power loss; what the holes keep is not taken then."""
    path = tmp_path / "r.mcap"
    env = single(path, 90, 3)
    copy = copied(path, tmp_path / "copy.mcap", lost=False)
    env.close()
    monkeypatch.setattr(journals, "boot_id", lambda: "another one")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with Recording(copy) as recording, Recording(path) as wanted:
            n = len(recording.index)
            assert 88 <= recording.n_steps <= 90
            assert (recording.index["length"][:-1] == 3).all()
            assert same(recording.read().states, wanted.read().states[: recording.n_steps])
            assert [recording.final_state(i) is None for i in range(n)][-10:] == [True] * 10


def test_killed_while_appending_nothing_changes(tmp_path: Path) -> None:
    """Steps, starts, final states and ends go to the file one after another."""
    path, again = tmp_path / "r.mcap", tmp_path / "again.mcap"
    env = single(path, 56, 7)
    copy = copied(path, tmp_path / "copy.mcap")
    env.close()
    for chunks in range(5):
        shutil.copy(copy, again)
        shutil.copy(journal_path(copy), journal_path(again))

        def append(left: int = chunks) -> Any:
            chunks, real = iter(range(left)), Container.add_chunk

            def add_chunk(self: Container, rows: Any) -> None:
                if next(chunks, None) is None:
                    os.kill(os.getpid(), signal.SIGKILL)
                real(self, rows)

            Container.add_chunk = add_chunk  # type: ignore[method-assign]
            return RecordEpisodes(Sampler(BOX, ACTIONS), again, mode="a")

        killed(append)
        for way in ways(again):
            assert_like(way(), path, firsts=1)


@pytest.mark.parametrize("field", ["#log_time", "episode", "#sequence", "terminal", "torn"])
def test_other_holes_say_nothing(tmp_path: Path, field: str) -> None:
    path = tmp_path / "r.mcap"
    env = single(path, 48, 5)
    copy = copied(path, tmp_path / "copy.mcap")
    env.close()
    layout = Recording(path).layout
    journal = read_journal(journal_path(copy))
    if field == "torn":
        torn = journal._replace(info={**journal.info, "boot": "another one"})
        assert steps_in(torn, layout).finals(layout.state_end) == []
        return
    rows = steps_in(journal, layout).rows
    after = rows["#sequence"] == HOLE
    if field == "#log_time":
        rows[field][after] = 1
    elif field == "episode":
        rows[field][after] += 1
    elif field == "#sequence":
        rows["#log_time"][after] = 0  # not committed either
        rows[field][after] = 0
    else:
        rows[field] = False
    write_area(copy, "steps", rows.tobytes())
    if field == "terminal":
        with Recording(copy) as recording:
            assert {episode.end for episode in recording.episodes} == {"interrupted"}
            assert [episode.final_state is None for episode in recording.episodes] == [True] * 9 + [False]
        return
    for way in ways(copy):
        with Recording(way()) as recording:
            assert [episode.final_state is None for episode in recording.episodes] == [True] * 9 + [False]
            for episode in recording.episodes:
                times = recording.read(episodes=[episode.position], fields=["times"]).times
                assert (episode.start_time, episode.end_time) == (times[0], times[-1])


def test_returns_are_summed_as_they_were(tmp_path: Path) -> None:
    """Bit for bit, of episodes that lie in several chunks."""
    path = tmp_path / "r.mcap"
    env = single(path, 700, 131, chunk_size=3000)
    copy = copied(path, tmp_path / "copy.mcap")
    env.close()
    assert (Recording(copy)._contents.table["channel"] == 1).sum() > 8
    for way in ways(copy):
        with Recording(way()) as recording, Recording(path) as wanted:
            assert len(wanted.index) == 6
            assert (recording.index[FACTS] == wanted.index[FACTS]).all()


def test_images_of_final_states_are_not_made_up(tmp_path: Path, ticks: Callable[[], None]) -> None:
    """The image after a last step is overwritten by the next reset."""
    path = tmp_path / "r.mcap"
    space = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": BOX})
    env = vector(path, space)
    env.reset(seed=1)
    for _ in range(20):  # ends with the hole of the first sub-environment
        ticks()
        env.step(env.action_space.sample())
    copy = copied(path, tmp_path / "copy.mcap")
    env.close()
    whole = Recording(path)
    for way in ways(copy)[:2]:
        with Recording(way()) as recording:
            assert (recording.index[FACTS] == whole.index[FACTS]).all()
            assert (recording.index["start_time"][3:] == whole.index["start_time"][3:]).all()
            lasts = {episode.env: episode.number for episode in recording.episodes}
            known = {e.number for e in recording.episodes if e.final_state is not None}
            assert known == {lasts[1], lasts[2]}  # one goes on, one ended with the last batch
            for episode, other in zip(recording.episodes, whole.episodes, strict=True):
                assert episode.final_state is None or same(episode.final_state, other.final_state)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "space",
    [BOX, spaces.Box(0, 255, (6, 5, 1), np.uint8), spaces.Dict({"x": BOX, "note": spaces.Text(3)})],
    ids=["box", "image", "text"],
)
@pytest.mark.parametrize("options", [{"flush_seconds": 0}, {"max_bytes": 1 << 30}, {}], ids=str)
def test_a_file_that_was_copied_before_its_journal(
    tmp_path: Path, space: Any, options: dict[str, Any]
) -> None:
    """No final state of another episode, and no word less than something is missing."""
    path, old = tmp_path / "r.mcap", tmp_path / "old"
    env = RecordEpisodes(Sampler(space, ACTIONS, length=3), path, attachments={}, **options)
    finals: list[Any] = []
    copies: list[Path] = []
    for episode in range(4):
        env.reset(seed=episode)
        for step in range(2 if episode == 1 else 3):  # the second one is left
            state = env.step(1)[0]
            copies.append(Path(shutil.copy(path, f"{old}{len(copies)}.mcap")))
            if step == 1 and episode % 2:
                env._writer.flush()
        finals.append(state)
    env.reset()
    copies.append(Path(shutil.copy(path, f"{old}{len(copies)}.mcap")))
    told = 0
    for each in copies:
        shutil.copy(journal_path(path), journal_path(each))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            with Recording(each) as recording:
                found = {e.number: (e.end, e.final_state) for e in recording.episodes}
        behind = any(
            "before the place where its journal goes on" in str(warning.message) for warning in caught
        )
        told += behind
        recover_recording(each, tmp_path / "mended.mcap", overwrite=True)
        with Recording(tmp_path / "mended.mcap") as mended:
            assert {e.number for e in mended.episodes} == set(found)
            both = [found, {e.number: (e.end, e.final_state) for e in mended.episodes}]
        for episodes in both:
            for number, (_, final) in episodes.items():
                assert final is None or same(final, finals[number])
        if not behind:
            assert all(final is not None for number, (_, final) in found.items() if number != 1)
    env.close()
    assert 0 < told < len(copies)


class Numbered(gym.Env[Any, Any]):
    """Observations that say which they are; episodes of three steps."""

    observation_space = spaces.Dict(
        {"n": spaces.Discrete(1 << 20), "see": spaces.Box(0, 255, (8, 8, 3), np.uint8)}
    )
    action_space = spaces.Discrete(2)

    def __init__(self) -> None:
        self.number = 0

    def observe(self) -> dict[str, Any]:
        self.number += 1
        return {"n": self.number, "see": np.full((8, 8, 3), self.number % 256, np.uint8)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.left = 3
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        return self.observe(), 1.0, self.left == 0, False, {}


@pytest.mark.parametrize("form", ["raw", "png"])
def test_images_that_a_reset_has_written_over(
    tmp_path: Path, form: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The journal is copied after the last step of an episode, the file in the middle of a later flush."""
    path, old = tmp_path / "r.mcap", tmp_path / "old.mcap"
    env = RecordEpisodes(Numbered(), path, attachments={}, image_format=form)
    env.reset()
    for _ in range(3):
        env.step(1)
    shutil.copy(journal_path(path), journal_path(old))
    env.reset()
    for _ in range(2):
        env.step(1)
    files: list[bytes] = []
    finish = Container.finish_chunks

    def spy(self: Container, *args: Any) -> None:
        finish(self, *args)
        files.append(path.read_bytes())

    monkeypatch.setattr(Container, "finish_chunks", spy)
    env._writer.flush()
    monkeypatch.undo()
    assert len(files) > 2
    for file in files:
        old.write_bytes(file)
        recover_recording(old, tmp_path / "mended.mcap", overwrite=True)
        for one in (old, tmp_path / "mended.mcap"):
            with Recording(one) as recording:
                states = recording.read().states
            assert len(states["n"]) >= 3
            assert (states["see"] == (states["n"] % 256)[:, None, None, None]).all()
    env.close()


@pytest.mark.parametrize("space", [BOX, spaces.Dict({"x": BOX, "note": spaces.Text(3)})], ids=["box", "text"])
def test_steps_between_a_file_and_its_journal_are_missed(tmp_path: Path, space: Any) -> None:
    path, old = tmp_path / "r.mcap", tmp_path / "old.mcap"
    env = RecordEpisodes(Sampler(space, ACTIONS, length=10), path, attachments={}, chunk_size=700)
    for episode in range(60):
        env.reset(seed=episode)
        for _ in range(10):
            env.step(1)
        if episode == 20:
            shutil.copy(path, old)
    shutil.copy(journal_path(path), journal_path(old))
    with pytest.warns(
        UserWarning,
        match="are left out, because steps before them are missing: the file is damaged, or was copied before",
    ):
        Recording(old).close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Recording(path).close()
    env.close()
