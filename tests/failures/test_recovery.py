"""Recordings whose writer died: every finished step is there, to the bit."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from abandoned import abandon, cart_pole, killed
from counting import calls, grows
from environments import Sampler, Scripted, roll
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from mcap.reader import make_reader
from typer.testing import CliRunner

from tupli_mcap import (
    FormatError,
    RecordEpisodes,
    Recording,
    RecordingError,
    journal_path,
    recover_recording,
    verify_recording,
)
from tupli_mcap.cli.app import app
from tupli_mcap.journal.committed import CommittedRows
from tupli_mcap.journal.file import JournalContents, RowArea, read_journal
from tupli_mcap.journal.logs import checksum
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.records import BODY, RECORD_HEADER, iter_records, with_crc
from tupli_mcap.messages.episodes import EpisodeStart
from tupli_mcap.recording.recover import from_journal as recover
from tupli_mcap.vector import RecordEpisodes as RecordVector

BOX = spaces.Box(-1, 1, (4,), np.float32)


def test_appending_finishes_what_a_killed_writer_left(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, 100)
    found = Recording(path)
    before = found.read()
    assert (len(before), found.complete, found.episodes[-1].end) == (100, False, "interrupted")
    with cart_pole(path, mode="a") as env:
        roll(env, 50)
    recording = Recording(path)
    assert recording.complete
    assert np.array_equal(recording.read().states[:100], before.states)
    assert recording.n_steps == 150
    assert not journal_path(path).exists()


def test_an_open_file_does_not_say_where_its_journal_is(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, 100)
    with path.open("rb") as file:
        told = pytest.warns(
            UserWarning, match="steps not yet in a chunk cannot be recovered .*open it by its path"
        )
        with told, Recording(file) as recording:
            assert 0 < recording.n_steps < 100


def test_what_lies_between_fields_is_recovered_as_it_was_recorded(tmp_path: Path) -> None:
    """And not as it was in the memory of who recovers."""
    space = spaces.Dict({"flags": spaces.Box(0, 1, (5,), np.int8), "x": spaces.Box(-1, 1, (2,), np.float64)})
    path, copy = tmp_path / "r.mcap", tmp_path / "copy.mcap"
    with RecordEpisodes(Sampler(space, space), path) as env:
        roll(env, 20)
        shutil.copy(journal_path(path), journal_path(copy))
        shutil.copy(path, copy)
    with path.open("rb") as file:
        wanted = [message.data for _, _, message in make_reader(file).iter_messages(topics=["/step"])]
    for _ in range(20):
        for size in range(1000, 10_000, 100):
            np.full(size, 255, np.uint8)  # for whoever takes this memory next
        with Recording(copy) as recording:
            rows = next(
                rows for rows in recording._contents.tail if rows.channel == recording._topics["/step"]
            )
        size = len(rows.data) // 20
        assert [rows.data[i * size + RECORD_HEADER.size : (i + 1) * size] for i in range(20)] == wanted


def test_appending_does_little_for_each_chunk_that_is_there(tmp_path: Path) -> None:
    def append(path: Path, steps: int) -> None:
        env = Sampler(BOX, spaces.Discrete(3), length=1000)
        with RecordEpisodes(
            env, path, chunk_size=100, attachments={}, mode="a" if path.exists() else "x"
        ) as env:
            roll(env, steps)

    def done(count: int) -> tuple[int, int]:
        path = tmp_path / f"{count}.mcap"
        append(path, count)
        with Recording(path) as recording:
            chunks = len(recording._contents.table)
        return calls(lambda: append(path, 1)), chunks

    (few, some), (many, more) = done(200), done(800)
    assert (many - few) / (more - some) < 50
    assert verify_recording(tmp_path / "800.mcap").problems == []


def test_a_journal_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "fast").mkdir()
    path = tmp_path / "r.mcap"
    abandon(path, lambda p: cart_pole(p, journal_dir=tmp_path / "fast"), 10)
    assert [p.suffix for p in (tmp_path / "fast").iterdir()] == [".journal"]
    assert Recording(path).n_steps == 10


def test_a_missing_journal_is_said(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, 100)
    whole = Recording(path).read().states
    journal_path(path).unlink()
    with pytest.warns(UserWarning, match=r"has no journal r\.mcap\.journal beside it"):
        recording = Recording(path)
    kept = recording.read().states
    assert 0 < len(kept) < 100
    assert np.array_equal(kept, whole[: len(kept)])


def test_a_stale_journal_of_another_recording_is_left_alone(tmp_path: Path) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    abandon(first, cart_pole, 100)
    abandon(second, cart_pole, 77)
    shutil.copy(journal_path(second), journal_path(first))
    with pytest.warns(UserWarning, match=r"a\.mcap\.journal is the journal of another recording"):
        recording = Recording(first)
    assert 0 < recording.n_steps < 100


UNREADABLE: dict[str, Callable[[bytes], bytes]] = {
    "a flipped bit": lambda data: data[:40] + bytes([data[40] ^ 1]) + data[41:],
    "a later version": lambda data: b"TMCAPJ2\0" + data[8:],
    "nothing": lambda _: b"",
    "a part": lambda data: data[: len(data) // 2],
}


@pytest.mark.parametrize("steps", [100, 10])  # with chunks in the file, and without
@pytest.mark.parametrize("how", UNREADABLE)
def test_a_journal_that_cannot_be_read_is_not_taken_for_none(how: str, steps: int, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, steps)
    whole = Recording(path).read().states
    journal_path(path).write_bytes(UNREADABLE[how](journal_path(path).read_bytes()))
    before = {item.name: item.read_bytes() for item in tmp_path.iterdir()}
    with pytest.raises(
        FormatError, match=r"its journal cannot be read .*: steps that .*; keep it, and update"
    ):
        Recording(path)
    with pytest.raises(FormatError, match="its journal cannot be read"):
        cart_pole(path, mode="a")
    report = verify_recording(path)
    (problem,) = report.errors
    assert (report.ok, problem.kind) == (False, "journal")
    assert "its journal cannot be read" in problem.message
    assert "tupli-mcap recover" in problem.advice
    assert "append" not in "".join(p.message + p.advice for p in report.problems)
    assert {item.name: item.read_bytes() for item in tmp_path.iterdir()} == before

    found = recover_recording(path, attached := tmp_path / "new.mcap")
    assert (found.journal, found.saved) == ("damaged", steps == 100)
    assert "the journal cannot be read" in found.notes[0]
    assert CliRunner().invoke(app, ["recover", str(path), "--force"]).exit_code == (steps == 10)
    with Recording(attached) as recording:
        kept = recording.n_steps
        assert (kept > 0) == (steps == 100)
        assert kept == 0 or np.array_equal(recording.read().states, whole[:kept])
    assert {item.name: item.read_bytes() for item in tmp_path.iterdir() if item.name in before} == before


def test_beside_a_finished_recording_no_journal_matters(tmp_path: Path) -> None:
    """But it is kept: it may be that of a recording which was renamed."""
    path = tmp_path / "r.mcap"
    with cart_pole(path) as env:
        roll(env, 10)
    journal_path(path).write_bytes(b"of another version")
    assert verify_recording(path).problems == []
    with (
        pytest.warns(UserWarning, match=r"r\.mcap\.journal could not be read: .* is kept as r\.mcap\."),
        cart_pole(path, mode="a") as env,
    ):
        roll(env, 5)
    assert Recording(path).n_steps == 15
    (kept,) = tmp_path.glob("*.journal")
    assert kept.read_bytes() == b"of another version"


@pytest.mark.parametrize("finished", [True, False])
def test_a_later_format_is_neither_recovered_nor_judged(finished: bool, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    if finished:
        with cart_pole(path) as env:
            roll(env, 300)
    else:
        abandon(path, cart_pole, 300)
    metadata, data = dict(Recording(path).metadata), path.read_bytes()
    old, new = (with_crc({**metadata, "format_version": n})["crc"].encode() for n in "13")
    key = b"format_version" + (1).to_bytes(4, "little")
    assert data.count(key + b"1") == 1 + finished  # at both ends
    path.write_bytes(data.replace(key + b"1", key + b"3").replace(old, new))
    for place in (path, tmp_path / "header.mcap"):  # in the second one the header is damaged
        if place != path:
            data = path.read_bytes()
            place.write_bytes(data[:12] + b"\xff" + data[13:])
        names = sorted(item.name for item in tmp_path.iterdir())
        with pytest.raises(
            FormatError, match=r"expected format version '1' or '2', found '3'; update tupli-mcap"
        ):
            recover_recording(place)
        told = CliRunner().invoke(app, ["recover", str(place)])
        assert (told.exit_code, told.output.count("update tupli-mcap")) == (1, 1)
        problem = verify_recording(place).problems[-1]
        assert (problem.message, problem.advice) == (
            "expected format version '1' or '2', found '3'",
            "update tupli-mcap",
        )
        assert sorted(item.name for item in tmp_path.iterdir()) == names
    assert [p.advice for p in verify_recording(path).problems] == ["update tupli-mcap"]
    with pytest.raises(FormatError, match="update tupli-mcap"):
        cart_pole(path, mode="a")


@pytest.mark.sampled(0, keep=["485"])
@pytest.mark.parametrize("stride", [97, 485])
def test_a_finished_recording_that_was_cut_off(tmp_path: Path, stride: int) -> None:
    path = tmp_path / "r.mcap"
    with cart_pole(path) as env:
        roll(env, 300)
    whole = Recording(path).read().states
    data = path.read_bytes()
    counts = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        for size in range(0, len(data), stride):
            path.write_bytes(data[:size])
            try:
                found = Recording(path).read().states
            except FormatError:
                continue
            kept = 0 if found is None else len(found)
            assert kept == 0 or np.array_equal(found, whole[:kept])
            counts.append(kept)
    assert counts == sorted(counts)
    assert counts[-1] > 100


def test_a_forked_child_neither_records_nor_holds_the_file(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    env = cart_pole(path)
    roll(env, 5)
    pid = os.fork()
    if pid == 0:
        try:
            env.step(0)
        except RecordingError:
            env.close()
            os._exit(42)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 42
    roll(env, 5)
    env.close()
    assert Recording(path).n_steps == 10


def test_a_full_disk_is_one_clear_error_and_the_rest_stays(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys, gymnasium as gym\n"
        "from tupli_mcap import RecordEpisodes, RecordingError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "env = RecordEpisodes(gym.make('CartPole-v1'), sys.argv[1], chunk_size=20_000, compression='none')\n"
        "env.reset(seed=1); env.step(0)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))\n"
        "n = 1\n"
        "try:\n"
        "    while True:\n"
        "        n += 1\n"
        "        _, _, a, b, _ = env.step(0)\n"
        "        if a or b: env.reset()\n"
        "except RecordingError as err:\n"
        "    print(n, err)\n"
        "try:\n"
        "    env.close()\n"
        "except RecordingError:\n"
        "    pass\n"
    )
    path = tmp_path / "r.mcap"
    child = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, timeout=60
    )
    taken, message = child.stdout.split(" ", 1)
    assert "could not write" in message
    assert "stays readable" in message
    assert Recording(path).n_steps == int(taken)


def test_what_the_image_thread_cannot_write_is_raised(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys, numpy as np\n"
        "from gymnasium import spaces\n"
        "from environments import Sampler\n"
        "from tupli_mcap import RecordEpisodes, RecordingError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "env = Sampler(spaces.Box(0, 255, (80, 80, 3), np.uint8), spaces.Discrete(2), length=10**9)\n"
        "env = RecordEpisodes(env, sys.argv[1], compression='none')\n"
        "env.reset(seed=1); env.step(0)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))\n"
        "n = 1\n"
        "try:\n"
        "    while True:\n"
        "        n += 1\n"
        "        env.step(0)\n"
        "except RecordingError as err:\n"
        "    print(n, err)\n"
        "try:\n"
        "    env.close()\n"
        "except RecordingError:\n"
        "    pass\n"
    )
    path = tmp_path / "r.mcap"
    child = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=Path(__file__).parents[1] / "support",
    )
    assert child.stdout, child.stderr
    taken, message = child.stdout.split(" ", 1)
    assert "could not write" in message
    recording = Recording(path)
    assert int(taken) - 1 <= recording.n_steps <= int(taken)
    assert recording.read().states.shape[1:] == (80, 80, 3)


def test_vector_recordings_are_finished_by_append(tmp_path: Path) -> None:
    def make(path: Path, **kwargs: Any) -> Any:
        envs = gym.vector.SyncVectorEnv([lambda: Sampler(BOX, spaces.Discrete(9)) for _ in range(2)])
        return RecordVector(envs, path, chunk_size=1000, **kwargs)

    path = tmp_path / "r.mcap"
    pid = os.fork()
    if pid == 0:
        env = make(path)
        env.reset(seed=1)
        for _ in range(50):
            env.step(env.action_space.sample())
        os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)
    before = Recording(path)
    states = before.read().states
    with make(path, mode="a") as env:
        env.reset()
        env.step(env.action_space.sample())
    after = Recording(path)
    assert after.complete
    assert np.array_equal(after.read(episodes=range(len(before.index))).states, states)
    assert after.n_steps == before.n_steps + 2


def test_nothing_is_recorded_after_a_full_disk(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys, gymnasium as gym\n"
        "from tupli_mcap import RecordEpisodes, RecordingError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "env = RecordEpisodes(gym.make('CartPole-v1'), sys.argv[1], chunk_size=20_000, compression='none')\n"
        "env.reset(seed=1); env.step(0); done = 1\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))\n"
        "for _ in range(4000):\n"
        "    try:\n"
        "        _, _, a, b, _ = env.step(0); done += 1\n"
        "        if a or b: env.reset()\n"
        "    except RecordingError:\n"
        "        pass\n"
        "print(done)\n"
        "try: env.close()\n"
        "except RecordingError: pass\n"
    )
    path = tmp_path / "r.mcap"
    child = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, str(path)], capture_output=True, text=True, timeout=60
    )
    assert int(child.stdout) > 500
    assert 0 <= Recording(path).n_steps - int(child.stdout) <= 1


def test_finishing_removes_the_journal_of_the_killed(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    pid = os.fork()
    if pid == 0:
        env = cart_pole(path)
        roll(env, 5)
        os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)
    assert journal_path(path).exists()
    cart_pole(path, mode="a").close()
    assert not journal_path(path).exists()
    assert (Recording(path).complete, Recording(path).n_steps) == (True, 5)


def test_a_recording_that_names_any_file_as_its_journal_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, precious = tmp_path / "r.mcap", tmp_path / "precious.txt"
    with monkeypatch.context() as forged:
        forged.setattr("tupli_mcap.recording.write.place.journal_in", lambda *_: precious)
        with cart_pole(path, journal_dir=tmp_path) as env:
            roll(env, 5)
        abandon(tmp_path / "killed.mcap", lambda p: cart_pole(p, journal_dir=tmp_path), 100)
    precious.write_text("precious")
    with pytest.raises(FormatError, match=r"expected its journal at an absolute path that ends in .*journal"):
        cart_pole(path, mode="a")
    with pytest.warns(UserWarning, match="expected its journal at an absolute path"):
        assert Recording(tmp_path / "killed.mcap").n_steps > 0
    with pytest.raises(FormatError, match="recover it into a new file"):
        cart_pole(tmp_path / "killed.mcap", mode="a")
    assert precious.read_text() == "precious"
    assert Recording(path).n_steps == 5


def test_appending_cuts_nothing_good_off_behind_damage(tmp_path: Path) -> None:
    path = tmp_path / "my run.mcap"
    pid = os.fork()
    if pid == 0:
        env = cart_pole(path)
        roll(env, 300)
        os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)
    data = path.read_bytes()
    first = Recording(path)._contents.table[0]
    at = int(first["offset"]) + int(first["length"]) - 20
    path.write_bytes(data[:at] + bytes([data[at] ^ 255]) + data[at + 1 :])
    with (
        pytest.warns(
            UserWarning,
            match="of /step are left out, because steps before them are missing: the file is damaged",
        ),
        pytest.raises(
            RecordingError, match=r"appending would lose \d+ message\(s\) of /step.*recover '.*/my run.mcap'"
        ),
    ):
        cart_pole(path, mode="a")
    assert len(path.read_bytes()) == len(data)
    report = recover_recording(path, tmp_path / "whole.mcap")
    assert report.steps > 200
    with cart_pole(tmp_path / "whole.mcap", mode="a") as env:
        roll(env, 5)
    assert Recording(tmp_path / "whole.mcap").n_steps == report.steps + 5


@pytest.mark.parametrize("times", [1, 3, 5])
def test_what_a_writer_does_while_its_journal_is_read_makes_nothing_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    """Rows may have gone to the file since; their episodes keep their seeds and their metadata."""
    path, seeds = tmp_path / "r.mcap", iter(range(1000))
    env = RecordEpisodes(
        Sampler(BOX, spaces.Discrete(3), length=5), path, metadata_callback=Numbered(), chunk_size=1000
    )

    def record(episodes: int) -> None:
        for _ in range(episodes):
            env.reset(seed=next(seeds))
            for _ in range(5):
                env.step(0)

    def read(place: Path, only: Any = None) -> Any:
        found = real(place, only)
        if len(done) < times:
            done.append(only is None)
            record(20)
        return found

    real, done = recover.read_journal, list[bool]()
    monkeypatch.setattr(recover, "read_journal", read)
    record(10)
    with Recording(path) as recording:
        assert done == [True, True, True, False, False][:times]
        assert 50 <= recording.n_steps <= 50 + 100 * times
        assert [episode.seed for episode in recording.episodes] == list(range(len(recording.index)))
        assert all(episode.metadata == {"steps": 5} for episode in recording.episodes if len(episode) == 5)
    env.close()


class Numbered:
    """A metadata callback that counts steps."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._steps = 0

    def __call__(self, rl_tuple: Any) -> dict[str, Any]:
        self._steps += 1
        return {"steps": self._steps}


def test_what_recovery_makes_keeps_the_order_of_time(tmp_path: Path) -> None:
    """The end that is made for one sub-environment is not before that of another."""
    path = tmp_path / "r.mcap"

    def vector(path: Path, **kwargs: Any) -> Any:
        makers = [lambda i=i: Sampler(BOX, spaces.Discrete(3), length=3 + i) for i in range(3)]
        return RecordVector(SyncVectorEnv(makers), path, **kwargs)

    def run(path: Path) -> Any:
        env = vector(path)
        env.reset(seed=1)
        for _ in range(11):
            env.step(env.action_space.sample())
        os.kill(os.getpid(), 9)

    abandon(path, run, 0)
    vector(path, mode="a").close()
    assert verify_recording(path).ok


def test_the_journal_of_a_renamed_recording_is_kept(tmp_path: Path) -> None:
    path, kept = tmp_path / "r.mcap", tmp_path / "kept.mcap"
    abandon(path, cart_pole, 7)
    path.rename(kept)
    with (
        pytest.warns(UserWarning, match="journal of another recording and is kept as"),
        cart_pole(path) as env,
    ):
        roll(env, 5)
    (journal,) = tmp_path.glob("*.journal")
    with pytest.warns(UserWarning, match=rf"{journal.name} is its journal: rename that to kept"):
        assert Recording(kept).n_steps == 0
    journal.rename(journal_path(kept))
    assert (Recording(kept).n_steps, Recording(path).n_steps) == (7, 5)


def test_a_writer_leaves_the_journal_of_another_one_alone(tmp_path: Path) -> None:
    """A recording is renamed while it is written, and another one begins at its path."""
    path, moved = tmp_path / "r.mcap", tmp_path / "moved.mcap"
    first = cart_pole(path)
    roll(first, 3)
    path.rename(moved)
    second = cart_pole(path)
    with pytest.warns(UserWarning, match="is kept as"):
        roll(second, 4)
    first.close()
    assert [p.name for p in tmp_path.glob("*.journal")] == ["r.mcap.journal"]
    assert Recording(path).n_steps == 4
    second.close()
    assert Recording(moved).n_steps == 3
    assert list(tmp_path.glob("*.journal")) == []


def test_a_running_episode_has_its_state_while_its_steps_go_into_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between a reader's first looks at the journal and at the file, a chunk is written."""
    path, left = tmp_path / "r.mcap", [100]
    scripted = Scripted(lambda step: np.full(4, step, np.float32), BOX, length=1000)
    with RecordEpisodes(scripted, path, chunk_size=1000) as env:
        env.reset()
        env.step(0)

        def read(*told: Any) -> JournalContents:
            found = read_journal(*told)
            for _ in range(left.pop() if left else 0):
                env.step(0)
            return found

        monkeypatch.setattr(recover, "read_journal", read)
        with Recording(path) as recording:
            (episode,) = recording.episodes
            assert episode.final_state is not None
            assert set(episode.final_state) == {episode.n_steps}
            assert 90 < episode.n_steps <= 101


def test_replacing_a_recording_removes_its_journal(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, 7)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cart_pole(path, mode="w").close()  # without a step
        assert Recording(path).n_steps == 7
        with cart_pole(path, mode="w") as env:
            roll(env, 3)
    assert Recording(path).n_steps == 3
    assert list(tmp_path.iterdir()) == [path]


def test_infos_of_lost_steps_are_not_those_of_new_ones(tmp_path: Path) -> None:
    """The journal had the steps, and the file their infos."""
    path = tmp_path / "a.mcap"

    def make(path: Path, **kwargs: Any) -> RecordEpisodes:
        env = Scripted(
            lambda step: np.zeros(4, np.float32), BOX, info=lambda step: {"text": "x" * 999}, length=3
        )
        return RecordEpisodes(env, path, mode="a", **kwargs)

    abandon(path, lambda path: make(path, record_info=True, chunk_size=3000), 30)
    journal_path(path).unlink()
    with pytest.warns(UserWarning, match="no journal"), Recording(path) as recording:
        kept = len(recording)
    with pytest.warns(UserWarning, match="no journal"), make(path) as env:
        roll(env, 30)
    with Recording(path) as recording:
        assert len(recording) == kept + 10
        assert [info for episode in recording.episodes[kept:] for info in episode.infos or []] == [None] * 30
        assert recording.episodes[-1].number >= 10
    report = verify_recording(path)
    assert report.ok
    assert [problem.severity for problem in report.problems] == ["note"]


def test_killed_again_while_appending_nothing_changes(tmp_path: Path) -> None:
    """Wherever the appending process came with what it took from the journal."""

    def recorder(path: Path, **kwargs: Any) -> Any:
        envs = gym.vector.SyncVectorEnv(
            [lambda i=i: Sampler(spaces.Text(9), spaces.Discrete(9), length=50 + i) for i in range(3)]
        )
        return RecordVector(envs, path, **kwargs)

    def told(path: Path) -> list[Any]:
        with Recording(path) as recording:
            return [(e.number, e.env, e.end, len(e), e.start_time, e.end_time) for e in recording.episodes]

    first = tmp_path / "first.mcap"

    def record() -> Any:
        env = recorder(first)
        env.reset(seed=1)
        for _ in range(20):
            env.step(env.action_space.sample())
        return env

    killed(record)
    known = told(first)
    assert [how for _, _, how, *_ in known] == ["interrupted"] * 3
    for chunks in range(8):
        path = tmp_path / f"{chunks}.mcap"
        for source, target in ((first, path), (journal_path(first), journal_path(path))):
            shutil.copy(source, target)

        def append(path: Path = path, chunks: int = chunks) -> Any:
            left, real = [chunks], Container.add_chunk

            def add_chunk(self: Container, rows: Any) -> None:
                if not left[0]:
                    os.kill(os.getpid(), signal.SIGKILL)
                left[0] -= 1
                real(self, rows)

            Container.add_chunk = add_chunk  # type: ignore[method-assign]
            return recorder(path, mode="a")

        killed(append)
        assert told(path) == known
        recorder(path, mode="a").close()
        assert told(path) == known


@pytest.mark.parametrize("time_ns", [2**63, 2**64 - 1])
def test_times_that_no_index_holds_are_refused(time_ns: int, tmp_path: Path) -> None:
    """Of steps that are in the journal only, and that a clock beyond the year 2262 was set for."""
    path = tmp_path / "r.mcap"
    abandon(path, cart_pole, 10)
    with Recording(path) as recording:
        dtype = recording.layout.step_message.dtype
    journal, data = journal_path(path), bytearray(journal_path(path).read_bytes())
    found = read_journal(journal).data["steps"].tobytes()
    rows = np.frombuffer(bytearray(found), dtype)
    rows["#log_time"][rows["#log_time"] > 0] = time_ns
    at = data.index(found)
    data[at : at + len(found)] = rows.tobytes()
    journal.write_bytes(data)
    for read in (Recording, recover_recording, lambda path: cart_pole(path, mode="a")):
        with pytest.raises(FormatError, match=r"times? before 2\^63 ns"):
            read(path)
    (problem,) = verify_recording(path).errors
    assert "before 2^63 ns" in problem.message


def move_starts(journal: Path) -> None:
    """Lets the starts in a journal say that their episodes begin a row later."""
    data, found = bytearray(journal.read_bytes()), read_journal(journal)
    events = found.data["events"].tobytes()
    base = data.index(events) + 64
    channel = found.info["channels"][3]
    for start, end, number, _, _ in iter_records(
        memoryview(events)[64 : 64 + int.from_bytes(events[:8], "little")]
    ):
        if number == channel:
            record = memoryview(data)[base + start : base + end]
            told = EpisodeStart.decode(record[BODY:])
            record[BODY:] = told._replace(first_row=told.first_row + 1).encode()
            record[23:31] = checksum(record).to_bytes(8, "little")
    journal.write_bytes(data)


def test_starts_that_are_wrong_are_not_each_looked_for_in_all_rows(tmp_path: Path) -> None:
    """Each says that its episode of two steps begins with the second one: the rows know better."""

    def done(episodes: int) -> int:
        path = tmp_path / f"{episodes}.mcap"

        def run(path: Path) -> None:
            env = RecordEpisodes(Sampler(spaces.Text(3), spaces.Discrete(3), length=2), path, attachments={})
            for seed in range(episodes):
                env.reset(seed=seed)
                env.step(0)
                env.step(0)
            os.kill(os.getpid(), 9)

        abandon(path, run, 0)
        move_starts(journal_path(path))
        with Recording(path) as recording:
            assert [len(episode) for episode in recording.episodes] == [2] * episodes
            assert len(recording.read()) == 2 * episodes
        return calls(lambda: Recording(path).close())

    assert grows(done, 40) < 1.3


def test_a_journal_of_fewer_channels_is_refused() -> None:
    dtype = np.dtype([(f"#{name}", "<u8") for name in ("opcode", "channel", "log_time", "sequence")])
    area = RowArea("steps", dtype.itemsize, rows=4, channels=0)
    contents = JournalContents({}, {"steps": area}, {"steps": np.empty(0, np.uint8)})
    with pytest.raises(FormatError, match="'steps': expected more than 0 blocks of rows, found 0"):
        CommittedRows(contents, "steps", 0, dtype, 1)


@pytest.mark.sampled(0, keep=["205-box", "205-images"])
@pytest.mark.parametrize(
    "space",
    [BOX, spaces.Dict({"x": BOX, "see": spaces.Box(0, 255, (4, 5, 3), np.uint8)})],
    ids=["box", "images"],
)
@pytest.mark.parametrize("stride", [41, 205])
def test_definitions_that_only_the_journal_has_left_are_written_again(
    tmp_path: Path, stride: int, space: gym.Space[Any]
) -> None:
    """After a power loss the file may end before its channels, which are written before anything else."""
    path, place = tmp_path / "r.mcap", tmp_path / "cut.mcap"
    env = RecordEpisodes(Sampler(space, spaces.Discrete(3), length=4), path, attachments={})
    env.reset(seed=1)
    env.step(0)
    file, journal = path.read_bytes(), journal_path(path).read_bytes()
    env.close()
    first = file.index(b"tupli_mcap/msg/Step") - 15  # the first Schema record
    for end in range(first, len(file), stride):
        place.write_bytes(file[:end])
        journal_path(place).write_bytes(journal)
        with RecordEpisodes(
            Sampler(space, spaces.Discrete(3), length=4), place, mode="a", attachments={}
        ) as again:
            again.reset(seed=2)
            again.step(1)
        report = verify_recording(place)
        assert report.ok, (end, report.problems)
        with Recording(place) as recording:
            assert recording.n_steps == 2
