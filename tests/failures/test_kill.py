"""Processes killed at every kind of moment lose no finished step. `tools/kill.py` does this at length."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import Scripted
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from killing.chain import lives, moments_of
from killing.check import Found, problems_of
from killing.kinds import KINDS
from killing.moments import MOMENTS, die

from tupli_mcap import (
    EpisodeWriter,
    RecordEpisodes,
    Recording,
    StepError,
    files,
    journal_path,
    recover_recording,
)
from tupli_mcap.journal.file import Journal
from tupli_mcap.mcap.lock import FileLock
from tupli_mcap.messages.topics import parse
from tupli_mcap.recording.write.chunks import ChunkWriter
from tupli_mcap.recording.write.recorders.vector import VectorRecorder
from tupli_mcap.recording.write.rows.vector import VectorRows
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.vector import RecordEpisodes as RecordVector


def _chains() -> list[tuple[str, list[str]]]:
    """Each kind, killed twice; each moment comes up once, in a recording that is new or goes on, as it needs it."""
    possible = {kind: moments_of(kind, appends=True) for kind in KINDS}
    of_kind: dict[str, str] = {}
    targets = [name for name in MOMENTS if name != "any time"]
    for name in sorted(targets, key=lambda name: sum(name in names for names in possible.values())):
        of_kind[next(kind for kind in KINDS if kind not in of_kind and name in possible[kind])] = name
    chains = []
    for i, kind in enumerate(KINDS):
        general, target = ["any time", "any line", "stores"][i % 3], of_kind.get(kind)
        if target is not None and MOMENTS[target].appends:
            chains.append((kind, ["step", target]))
        else:
            chains.append((kind, [general] if target is None else [target, general]))
    return chains


@pytest.mark.sampled(8)
@pytest.mark.parametrize(("kind", "moments"), _chains())
def test_a_killed_process_loses_no_finished_step(tmp_path: Path, kind: str, moments: list[str]) -> None:
    for death in lives(kind, moments, 7, tmp_path):
        assert death.problems == [], death.moment
        assert death.killed, f"{death.moment} never came"


@pytest.mark.parametrize(
    ("breakage", "kind", "moment"),
    [
        ("commit before the data", "box", "stores"),
        ("forget the pending state", "box", "stores"),
        ("events taken off first", "box", "flush"),
        ("chunks late", "large", "stores"),
    ],
)
def test_a_broken_recorder_is_found_out(tmp_path: Path, breakage: str, kind: str, moment: str) -> None:
    found: list[str] = []
    for seed in range(20):
        (tmp_path / str(seed)).mkdir()
        for death in lives(kind, [moment, moment], seed, tmp_path / str(seed), breakage):
            found += death.problems
        if found:
            return
    pytest.fail(f"{breakage}: nothing was found in 40 kills")


def _episode() -> tuple[Found, dict[str, Any]]:
    states = [np.full(2, i, np.float32) for i in range(4)]
    told = [(i, states[i + 1], 0.5, i == 2, False, {"t": 0.1 * i}) for i in range(3)]
    steps = [(states[i], i, 0.5, i == 2, False, {"t": 0.1 * i}) for i in range(3)]
    found = Found(0, 0, "terminal", 1.5, 3, None, {"r": 1}, steps, states[3], {}, (1, 2))
    wanted = {"reset": (states[0], 3, None, {"r": 1}), "steps": told, "certain": 3}
    return found, {**wanted, "vector": False, "infos": True}


def _changed_state(found: Found) -> None:
    found.steps[1][0][0] = np.nextafter(found.steps[1][0][0], np.float32(9))


def _reordered(found: Found) -> None:
    found.steps[0], found.steps[1] = found.steps[1], found.steps[0]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda found: found.steps.pop(), "3 steps were finished, 2 are there"),
        (lambda found: found.steps.append(found.steps[0]), "4 are there"),
        (_changed_state, "state of step 1 differs"),
        (_reordered, "action of step 0 differs"),
        (lambda found: found.final.__setitem__(0, 0), "the final state differs"),
        (lambda found: setattr(found, "end", "interrupted"), "it ended interrupted"),
        (lambda found: setattr(found, "total", 1.25), "its return is 1.25"),
        (lambda found: setattr(found, "seed", None), "its seed is None"),
    ],
)
def test_the_check_sees_what_is_wrong(change: Callable[[Found], Any], problem: str) -> None:
    found, told = _episode()
    assert problems_of(found, **told) == []
    found = copy.deepcopy(found)
    change(found)
    assert any(problem in text for text in problems_of(found, **told))


def in_a_process_that_dies(record: Callable[[], Any]) -> None:
    """Forks; the child must kill itself while it records."""
    pid = os.fork()
    if pid == 0:
        try:
            record()
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -9


def test_an_end_under_same_step_autoreset_keeps_its_own_final_state(tmp_path: Path) -> None:
    def record() -> None:
        maker = lambda: Scripted(  # noqa: E731
            lambda i: np.array([i], np.float32), spaces.Box(0, 9, (1,), np.float32), length=3
        )
        envs = SyncVectorEnv([maker], autoreset_mode=AutoresetMode.SAME_STEP)
        VectorRecorder.finish = lambda self, *_: self._any_ended and die()  # type: ignore[method-assign]
        env = RecordVector(envs, tmp_path / "r.mcap")
        env.reset(seed=1)
        for _ in range(3):
            env.step(env.action_space.sample())

    in_a_process_that_dies(record)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert (len(episode), episode.end) == (3, "terminal")
    assert episode.final_state.tolist() == [3]


def test_a_final_state_of_a_step_that_was_not_finished_is_not_taken(tmp_path: Path) -> None:
    """Under same-step autoreset it is there before the step is."""

    def record() -> None:
        maker = lambda: Scripted(  # noqa: E731
            lambda i: np.array([i], np.float32), spaces.Box(0, 9, (1,), np.float32), length=3
        )
        env = RecordVector(
            SyncVectorEnv([maker], autoreset_mode=AutoresetMode.SAME_STEP), tmp_path / "r.mcap"
        )
        env.reset(seed=1)
        for _ in range(2):
            env.step(env.action_space.sample())
        VectorRows.put = lambda *_, **__: die()  # type: ignore[method-assign]
        env.step(env.action_space.sample())

    in_a_process_that_dies(record)
    recover_recording(tmp_path / "r.mcap", tmp_path / "recovered.mcap")
    for name in ("r.mcap", "recovered.mcap"):
        (episode,) = Recording(tmp_path / name).episodes
        assert (len(episode), episode.end) == (2, "interrupted")
        assert episode.final_state.tolist() == [2]


def test_images_stay_with_their_steps_when_a_killed_recording_goes_on(tmp_path: Path) -> None:
    path, space = tmp_path / "r.mcap", spaces.Box(0, 255, (4, 4, 3), np.uint8)

    def make(mode: Any) -> RecordEpisodes:
        env = Scripted(lambda i: np.full((4, 4, 3), i, np.uint8), space, length=100)
        return RecordEpisodes(env, path, mode=mode, chunk_size=1000, compression="none")

    def record() -> None:
        start = ChunkWriter.start

        def start_and_die(self: ChunkWriter, chunks: Any) -> Callable[[], None]:
            finish = start(self, chunks)
            assert parse(self._container.channels[chunks[0].channel].topic).kind == "image"
            return lambda: (finish(), die())  # type: ignore[func-returns-value]

        ChunkWriter.start = start_and_die  # type: ignore[method-assign]
        env = make("x")
        env.reset(seed=1)
        while True:
            env.step(0)

    in_a_process_that_dies(record)
    with make("a") as env:
        env.reset(seed=1)
        env.step(0)
    for episode in Recording(path).episodes:
        assert episode.states[:, 0, 0, 0].tolist() == list(range(len(episode)))
        assert episode.final_state[0, 0, 0] == len(episode)


def test_nothing_of_a_killed_writer_stays_behind(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"

    def make(mode: Any) -> RecordEpisodes:
        env = Scripted(lambda i: np.array([i], np.float32), spaces.Box(0, 9, (1,), np.float32))
        return RecordEpisodes(env, path, mode=mode)

    def record() -> None:
        Journal.close = lambda *_, **__: die()  # type: ignore[method-assign]
        env = make("x")
        env.reset(seed=1)
        env.step(0)
        env.close()

    in_a_process_that_dies(record)
    assert Recording(path).complete
    make("a").close()
    assert [file.name for file in tmp_path.iterdir()] == ["r.mcap"]
    assert Recording(path).n_steps == 1


def _count(path: Path, mode: Any) -> RecordEpisodes:
    env = Scripted(lambda i: np.array([i], np.float32), spaces.Box(0, 99, (1,), np.float32), length=50)
    return RecordEpisodes(env, path, mode=mode)


def _take(env: RecordEpisodes, steps: int) -> None:
    env.reset(seed=1)
    for _ in range(steps):
        env.step(0)


def _with_journal_only(path: Path) -> None:
    RecordingWriter.cut = lambda _: die()  # type: ignore[method-assign]
    _take(_count(path, "x"), 1)


def _with_steps(path: Path) -> None:
    env = _count(path, "x")  # closed if nobody held it
    _take(env, 7)
    die()


def _as_soon_as_it_is_there(path: Path) -> None:
    publish = FileLock.publish

    def publish_and_die(self: FileLock) -> None:
        publish(self)
        die()

    FileLock.publish = publish_and_die  # type: ignore[method-assign]
    _take(_count(path, "w"), 1)


@pytest.mark.parametrize("first", [_with_journal_only, _with_steps])
@pytest.mark.parametrize("replacements", [1, 2])
@pytest.mark.parametrize("mode", ["w", "a"])
def test_the_journal_of_what_was_replaced_goes_though_the_replacing_was_killed(
    tmp_path: Path, first: Callable[[Path], None], replacements: int, mode: str
) -> None:
    path = tmp_path / "r.mcap"
    in_a_process_that_dies(lambda: first(path))
    uuid = Recording(path).uuid
    for _ in range(replacements):
        in_a_process_that_dies(lambda: _as_soon_as_it_is_there(path))
        assert journal_path(path).exists()
        with Recording(path) as recording:
            assert (recording.metadata["replaced"], recording.n_steps) == (uuid, 1)
            uuid = recording.uuid
    report = recover_recording(path, tmp_path / "recovered.mcap")
    assert (report.journal, report.notes) == ("used", [])
    with Recording(tmp_path / "recovered.mcap") as recovered:
        assert "replaced" not in recovered.metadata
    (tmp_path / "recovered.mcap").unlink()
    with _count(path, mode) as env:
        _take(env, 3)
    assert Recording(path).n_steps == (4 if mode == "a" else 3)
    assert [file.name for file in tmp_path.iterdir()] == ["r.mcap"]


@pytest.mark.parametrize("mode", ["w", "a"])
def test_the_journal_of_what_was_renamed_stays_though_its_successor_was_killed(
    tmp_path: Path, mode: str
) -> None:
    path, kept = tmp_path / "r.mcap", tmp_path / "kept.mcap"
    in_a_process_that_dies(lambda: _with_steps(path))
    path.rename(kept)
    in_a_process_that_dies(lambda: _as_soon_as_it_is_there(path))
    with pytest.warns(UserWarning, match="is kept as"), _count(path, mode) as env:
        _take(env, 3)
    (journal,) = tmp_path.glob("*.journal")
    journal.rename(journal_path(kept))
    assert (Recording(kept).n_steps, Recording(path).n_steps) == (7, 3)


@pytest.mark.parametrize("mode", ["w", "a"])
def test_a_recording_that_never_took_the_place_of_another_leaves_nothing(tmp_path: Path, mode: str) -> None:
    """Its journal was in its place, and it was not."""
    path = tmp_path / "r.mcap"
    with _count(path, "x") as env:
        _take(env, 7)

    def die_before_the_file_is_there() -> None:
        env = _count(path, "w")
        FileLock.publish = lambda _: die()  # type: ignore[method-assign]
        _take(env, 1)

    in_a_process_that_dies(die_before_the_file_is_there)
    assert journal_path(path).exists()
    assert Recording(path).n_steps == 7
    with _count(path, mode) as env:
        _take(env, 3)
    assert Recording(path).n_steps == (10 if mode == "a" else 3)
    assert [file.name for file in tmp_path.iterdir() if not files.is_temporary(file.name)] == ["r.mcap"]


@pytest.mark.parametrize("vector", [False, True])
def test_a_replacing_file_is_in_its_place_though_its_first_step_was_refused(
    tmp_path: Path, vector: bool
) -> None:
    path, ones = tmp_path / "r.mcap", np.ones(2, np.int64)

    def make() -> Any:
        space = spaces.Dict({"a": spaces.Discrete(3)})
        return Scripted(lambda i: np.array([i], np.float32), spaces.Box(0, 99, (1,), np.float32), space)

    def record() -> None:
        env = SyncVectorEnv([make, make]) if vector else make()
        recorded = (RecordVector if vector else RecordEpisodes)(env, path, mode="w")
        recorded.reset()
        with pytest.raises(StepError, match="expected an entry for each of"):
            recorded.step({"a": ones, "b": ones} if vector else {"a": 1, "b": 1})
        recorded.reset()
        recorded.step({"a": ones if vector else 1})
        die()

    with _count(path, "x") as before:
        _take(before, 7)
    in_a_process_that_dies(record)
    assert Recording(path).n_steps == (2 if vector else 1)


def test_episodes_are_in_the_place_of_what_they_replace_though_the_first_was_refused(tmp_path: Path) -> None:
    path, states, flags = tmp_path / "r.mcap", np.zeros((4, 1), np.float32), np.array([0, 1, 0, 1], np.bool_)

    def record() -> None:
        space = spaces.Box(0, 99, (1,), np.float32)
        writer = EpisodeWriter(path, space, spaces.Discrete(3), mode="w")
        columns = states, np.zeros(4, np.int64), np.zeros(4), flags, np.zeros(4, np.bool_)
        with pytest.raises(StepError, match="expected shape"):
            writer.episodes(*columns, np.zeros((2, 3), np.float32))
        writer.episodes(*columns, np.zeros((2, 1), np.float32))
        die()

    with _count(path, "x") as before:
        _take(before, 7)
    in_a_process_that_dies(record)
    assert Recording(path).n_steps == 4
