"""One file has one writer, one journal has one recording, and a journal is found or missed aloud."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll
from gymnasium import spaces

import tupli_mcap
from tupli_mcap import (
    RecordEpisodes,
    Recording,
    RecordingError,
    journal_path,
    recover_recording,
    rewrite_recording,
)
from tupli_mcap.arrays import Array
from tupli_mcap.mcap.lock import FileLock, LockedError, is_locked
from tupli_mcap.recording.edit.rewrite import rewrite_in_place

Names = Callable[[Path], Path]


def cart_pole(path: str | os.PathLike[str], **kwargs: Any) -> RecordEpisodes:
    return RecordEpisodes(gym.make("CartPole-v1"), path, chunk_size=3000, **kwargs)


def killed(path: Path, steps: int = 100, **kwargs: Any) -> Array:
    """Leaves a recording of a process that was killed; returns the states in it."""
    pid = os.fork()
    if pid == 0:
        try:
            env = cart_pole(path, **kwargs)  # named, or it would be closed when it is forgotten
            roll(env, steps)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        states = Recording(path).read().states
    assert len(states) == steps
    return np.asarray(states)


def itself(path: Path) -> Path:
    return path


def symbolic_link(path: Path) -> Path:
    link = path.with_name("elsewhere.mcap")
    link.symlink_to(path)
    return link


def hard_link(path: Path) -> Path:
    link = path.with_name("other.mcap")
    os.link(path, link)
    return link


def relative(path: Path) -> Path:
    return Path(os.path.relpath(path))


class TestASecondWriter:
    @pytest.mark.parametrize("name", [itself, symbolic_link, hard_link, relative])
    @pytest.mark.parametrize("first", ["x", "w", "a"])
    def test_is_refused(self, tmp_path: Path, first: Any, name: Names) -> None:
        path = tmp_path / "r.mcap"
        if first != "x":
            with cart_pole(path) as env:
                roll(env, 30)
        with cart_pole(path, mode=first) as env:
            roll(env, 20)
            also = name(path)
            for mode in ("a", "w"):
                with pytest.raises(
                    RecordingError,
                    match="is being recorded by another writer, perhaps an earlier one in this program; close it",
                ):
                    cart_pole(also, mode=mode)
            with pytest.raises(RecordingError, match="exists and is not overwritten"):
                cart_pole(also, mode="x")
            roll(env, 20)
        assert Recording(path).n_steps == {"x": 40, "w": 40, "a": 70}[first]
        assert {p.name for p in tmp_path.iterdir()} <= {"r.mcap", "elsewhere.mcap", "other.mcap"}

    def test_is_refused_between_threads(self, tmp_path: Path) -> None:
        path, won, refused = tmp_path / "r.mcap", [], []
        start = threading.Barrier(8)

        def attempt(mode: Any) -> None:
            start.wait()
            try:
                won.append(cart_pole(path, mode=mode))
            except RecordingError as err:
                refused.append(str(err))

        threads = [threading.Thread(target=attempt, args=(mode,)) for mode in "xwxwxwxw"]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (len(won), len(refused)) == (1, 7)
        assert all("another writer" in line or "exists" in line for line in refused), refused
        with won[0] as env:
            roll(env, 5)
        assert Recording(path).n_steps == 5

    def test_is_told_of_a_file_deleted_under_it(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        env = cart_pole(path)
        roll(env, 5)
        path.unlink()
        with pytest.warns(
            RuntimeWarning, match=r"r\.mcap was deleted while it is being recorded, and nothing"
        ) as told:
            env.flush()
            env.close()
        assert len(told) == 1

    def test_is_not_told_of_a_file_that_was_renamed(self, tmp_path: Path) -> None:
        env = cart_pole(tmp_path / "r.mcap")
        roll(env, 5)
        (tmp_path / "r.mcap").rename(tmp_path / "s.mcap")
        env.close()
        assert Recording(tmp_path / "s.mcap").n_steps == 5

    def test_is_not_who_only_asks(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        with cart_pole(path) as env:
            roll(env, 5)
        done = threading.Event()

        def ask() -> None:
            while not done.is_set():
                is_locked(path)

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        try:
            for _ in range(30):
                FileLock(path, "a").release()
        finally:
            done.set()
            for thread in threads:
                thread.join()

    def test_of_a_deleted_or_replaced_file_gets_the_new_one(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        with cart_pole(path) as env:
            roll(env, 30)
        held = os.open(path, os.O_RDWR)  # somebody rewrites the file meanwhile
        fcntl.flock(held, fcntl.LOCK_SH)

        def replace() -> None:
            time.sleep(0.2)
            with Recording(path) as recording:
                rewrite_in_place(recording, path, [0])
            os.close(held)

        thread = threading.Thread(target=replace)
        thread.start()
        with cart_pole(path, mode="a") as env:
            roll(env, 7)
        thread.join()
        with Recording(path) as recording:
            assert recording.n_steps == 7 + len(recording.episodes[0])

    def test_readers_of_a_replaced_file_keep_the_old_one(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        with cart_pole(path) as env:
            roll(env, 300)
        with Recording(path, cache_bytes=1) as old:
            wanted = old.read().states
            with cart_pole(path, mode="w") as env:
                roll(env, 3)
                assert np.array_equal(old.read().states, wanted)
                assert Recording(path).n_steps == 3
        assert list(tmp_path.iterdir()) == [path]


def rewrite(source: Path, target: Path) -> None:
    with Recording(source) as recording:
        rewrite_recording(recording, target)


REPLACE: dict[str, Callable[[Path, Path], Any]] = {
    "merge": lambda source, target: tupli_mcap.merge_recordings([source], target, overwrite=True),
    "save": lambda source, target: tupli_mcap.open(source).save(target, overwrite=True),
    "map": lambda source, target: tupli_mcap.open(source).map(lambda e: e.rewards, target, overwrite=True),
    "trim": lambda source, target: tupli_mcap.open(source).trim(slice(0, 1), target, overwrite=True),
    "rewrite": rewrite,
    "recover": lambda source, target: recover_recording(source, target, overwrite=True),
}


@pytest.mark.parametrize("how", REPLACE)
def test_a_recording_in_progress_is_not_replaced(tmp_path: Path, how: str) -> None:
    source, live, link = (tmp_path / f"{name}.mcap" for name in ("source", "live", "link"))
    with cart_pole(source) as env:
        roll(env, 30)
    link.symlink_to(live)
    with cart_pole(live) as env:
        roll(env, 20)
        for target in (live, link):
            with pytest.raises(LockedError, match="being recorded by another writer"):
                REPLACE[how](source, target)
        roll(env, 20)
    assert Recording(live).n_steps == 40


def test_what_replaces_a_link_replaces_the_file_it_names(tmp_path: Path) -> None:
    source, file, link = (tmp_path / f"{name}.mcap" for name in ("source", "file", "link"))
    for path, steps in ((source, 30), (file, 20)):
        with cart_pole(path) as env:
            roll(env, steps)
    link.symlink_to(file.name)
    tupli_mcap.open(source).save(link, overwrite=True)
    assert link.is_symlink() and Recording(file).n_steps == 30


class TestARecordingWithoutASteps:
    @pytest.mark.parametrize("mode", ["x", "w"])
    def test_leaves_no_file(self, tmp_path: Path, mode: Any) -> None:
        env = cart_pole(tmp_path / "r.mcap", mode=mode)
        env.reset()
        env.close()
        assert list(tmp_path.iterdir()) == []

    def test_changes_nothing_that_was_to_go_on(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        with cart_pole(path) as env:
            roll(env, 30)
        before = path.read_bytes()
        with cart_pole(path, mode="a") as env:
            env.reset()
            assert path.read_bytes() == before
        assert path.read_bytes() == before

    def test_finishes_what_a_killed_writer_left(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        states = killed(path)
        cart_pole(path, mode="a").close()
        with Recording(path) as recording:
            assert recording.complete
            assert np.array_equal(recording.read().states, states)
        assert list(tmp_path.iterdir()) == [path]


class TestOneDirectoryForJournals:
    def test_recordings_of_one_name_share_it(self, tmp_path: Path) -> None:
        fast = tmp_path / "fast"
        paths = [tmp_path / name / "r.mcap" for name in "ab"]
        for directory in (fast, *(path.parent for path in paths)):
            directory.mkdir()
        states = [killed(path, 40 + i, journal_dir=fast) for i, path in enumerate(paths)]
        live = [cart_pole(path, mode="a", journal_dir=fast) for path in paths]
        for env in live:
            roll(env, 20)
        for path in paths:
            assert Recording(path).n_steps == len(states[paths.index(path)]) + 20
        for env in live:
            env.close()
        for path, before in zip(paths, states, strict=True):
            assert np.array_equal(Recording(path).read().states[: len(before)], before)
        assert list(fast.iterdir()) == []

    def test_a_copy_does_not_take_the_journal_away(self, tmp_path: Path) -> None:
        fast, path, copy = tmp_path / "fast", tmp_path / "a.mcap", tmp_path / "b.mcap"
        fast.mkdir()
        states = killed(path, journal_dir=fast)
        shutil.copy(path, copy)
        assert np.array_equal(Recording(copy).read().states, states)
        with pytest.raises(
            RecordingError, match=r"b\.mcap is a copy of .*a\.mcap, which still needs the journal"
        ):
            cart_pole(copy, mode="a")
        cart_pole(path, mode="a").close()
        assert np.array_equal(Recording(path).read().states, states)

    def test_a_moved_recording_keeps_its_journal(self, tmp_path: Path) -> None:
        fast, path, moved = tmp_path / "fast", tmp_path / "a.mcap", tmp_path / "b.mcap"
        fast.mkdir()
        states = killed(path, journal_dir=fast)
        path.rename(moved)
        with cart_pole(moved, mode="a") as env:
            roll(env, 5)
        found = Recording(moved).read().states
        assert np.array_equal(found[:100], states)
        assert len(found) == 105

    def test_a_lost_directory_is_named(self, tmp_path: Path) -> None:
        fast, path = tmp_path / "fast", tmp_path / "a.mcap"
        fast.mkdir()
        killed(path, journal_dir=fast)
        shutil.rmtree(fast)
        with pytest.warns(UserWarning, match=r"its journal was .*fast.*: bring that back"):
            assert 0 < Recording(path).n_steps < 100

    def test_on_another_file_system(self, tmp_path: Path, other_file_system: Path) -> None:
        path = tmp_path / "a.mcap"
        states = killed(path, journal_dir=other_file_system)
        assert not journal_path(path).exists()
        with cart_pole(path, mode="a") as env:
            roll(env, 5)
        assert np.array_equal(Recording(path).read().states[:100], states)
        assert list(other_file_system.iterdir()) == []


@pytest.fixture
def other_file_system(tmp_path: Path) -> Iterator[Path]:
    """A directory on a tmpfs of its own; /dev/shm, or none, where mounting is not allowed."""
    place = tmp_path / "mounted"
    place.mkdir()
    mount = shutil.which("mount")
    if mount and subprocess.run([mount, "-t", "tmpfs", "none", place], capture_output=True).returncode == 0:
        try:
            yield place
        finally:
            subprocess.run(["umount", "-l", place], check=True)  # a journal may still be mapped
        return
    shared = Path("/dev/shm")
    if not shared.is_dir() or shared.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no other file system: mounting is not allowed, and /dev/shm is none")
    place = shared / f"tupli-mcap-{os.getpid()}"
    place.mkdir()
    try:
        yield place
    finally:
        shutil.rmtree(place)


class TestAFileAndItsJournal:
    def test_copied_together(self, tmp_path: Path) -> None:
        path, copy = tmp_path / "a.mcap", tmp_path / "elsewhere" / "a.mcap"
        copy.parent.mkdir()
        states = killed(path)
        shutil.copy(path, copy)
        shutil.copy(journal_path(path), journal_path(copy))
        for each in (copy, path):
            assert np.array_equal(Recording(each).read().states, states)
            cart_pole(each, mode="a").close()
            assert np.array_equal(Recording(each).read().states, states)

    def test_copied_alone(self, tmp_path: Path) -> None:
        path, copy = tmp_path / "a.mcap", tmp_path / "elsewhere" / "a.mcap"
        copy.parent.mkdir()
        states = killed(path)
        shutil.copy(path, copy)
        with pytest.warns(
            UserWarning, match=r"has no journal a\.mcap\.journal beside it: .*keep the two files"
        ):
            found = Recording(copy).read().states
        assert 0 < len(found) < len(states)
        assert np.array_equal(found, states[: len(found)])

    def test_renamed_together(self, tmp_path: Path) -> None:
        path, moved = tmp_path / "a.mcap", tmp_path / "b.mcap"
        states = killed(path)
        path.rename(moved)
        journal_path(path).rename(journal_path(moved))
        assert np.array_equal(Recording(moved).read().states, states)

    def test_renamed_alone_says_where_the_journal_is(self, tmp_path: Path) -> None:
        path, moved = tmp_path / "a.mcap", tmp_path / "b.mcap"
        states = killed(path)
        path.rename(moved)
        match = r"a\.mcap\.journal is its journal: rename that to b\.mcap\.journal"
        with pytest.warns(UserWarning, match=match):
            assert Recording(moved).n_steps < 100
        with pytest.raises(
            RecordingError, match=r"without its journal .*a\.mcap\.journal, whose steps would be lost"
        ):
            cart_pole(moved, mode="a")
        journal_path(path).rename(journal_path(moved))
        cart_pole(moved, mode="a").close()
        assert np.array_equal(Recording(moved).read().states, states)

    def test_of_a_link(self, tmp_path: Path) -> None:
        path, link = tmp_path / "a.mcap", tmp_path / "links" / "b.mcap"
        link.parent.mkdir()
        states = killed(path)
        link.symlink_to(path)
        assert np.array_equal(Recording(link).read().states, states)
        with cart_pole(link, mode="a") as env:
            roll(env, 5)
        assert Recording(path).n_steps == 105
        assert list(link.parent.iterdir()) == [link]

    def test_written_through_a_hard_link(self, tmp_path: Path) -> None:
        path, link = tmp_path / "a.mcap", tmp_path / "b.mcap"
        states = killed(path)
        os.link(path, link)
        with pytest.raises(RecordingError, match=r"without its journal .*a\.mcap\.journal"):
            cart_pole(link, mode="a")
        cart_pole(path, mode="a").close()
        assert np.array_equal(Recording(link).read().states, states)

    def test_in_a_directory_that_cannot_be_written(self, tmp_path: Path) -> None:
        lab = tmp_path / "lab"
        lab.mkdir()
        states = killed(lab / "a.mcap")
        before = sorted((p.name, p.stat().st_mtime_ns, p.read_bytes()) for p in lab.iterdir())
        for entry in lab.iterdir():
            entry.chmod(0o444)
        lab.chmod(0o555)
        code = (
            "import os, sys; os.getuid() or os.setuid(65534)\n"
            "import numpy, tupli_mcap, warnings; warnings.simplefilter('error')\n"
            "numpy.save(sys.stdout.buffer, tupli_mcap.Recording(sys.argv[1]).read().states)"
        )
        out = tmp_path / "states.npy"
        for directory in (tmp_path, *tmp_path.parents):
            if directory.owner() == "root" and not directory.stat().st_mode & 0o001:
                pytest.skip(f"another user cannot get into {directory}")
        with out.open("wb") as file:
            subprocess.run([sys.executable, "-c", code, lab / "a.mcap"], stdout=file, check=True, timeout=60)
        lab.chmod(0o755)
        assert np.array_equal(np.load(out), states)
        assert sorted((p.name, p.stat().st_mtime_ns, p.read_bytes()) for p in lab.iterdir()) == before

    def test_from_before_it_was_rewritten(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        killed(path)
        stale = journal_path(path).read_bytes()
        with Recording(path) as recording:
            number = int(recording.index["episode"][-1])
            rewrite_recording(recording, path, episodes=[number])
            kept = recording.episodes[-1].states
        journal_path(path).write_bytes(stale)  # the rewriter was killed before it removed the journal
        pid = os.fork()
        if pid == 0:  # a writer that is killed as its first step begins
            env = cart_pole(path, mode="a")
            env._writer.cut()
            os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(pid, 0)
        with pytest.warns(UserWarning, match="is the journal of another recording"):
            found = Recording(path)
        assert np.array_equal(found.read().states, kept)


def test_the_child_of_a_killed_writer_keeps_no_lock(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    reading, writing = os.pipe()
    writer = os.fork()
    if writer == 0:
        env = cart_pole(path)
        roll(env, 10)
        if os.fork() == 0:
            os.write(writing, b"%d" % os.getpid())
        signal.pause()
    child = int(os.read(reading, 20))
    try:
        assert is_locked(path)
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        with cart_pole(path, mode="a") as env:
            roll(env, 10)
    finally:
        os.kill(child, signal.SIGKILL)
        os.close(reading)
        os.close(writing)
    assert Recording(path).n_steps == 20


def test_numbers_of_episodes_are_not_given_twice(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(spaces.Discrete(5), spaces.Discrete(2)), path) as env:
        roll(env, 28)
    with Recording(path) as recording:
        assert recording.index["episode"].tolist() == [0, 1, 2, 3]
        rewrite_recording(recording, path, episodes=[0, 1])
    with Recording(path) as recording:  # and once more
        rewrite_recording(recording, path, episodes=[0])
    with RecordEpisodes(Sampler(spaces.Discrete(5), spaces.Discrete(2)), path, mode="a") as env:
        roll(env, 7)
    assert Recording(path).index["episode"].tolist() == [0, 4]
