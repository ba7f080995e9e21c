"""Files that take their place as a whole: what a link that somebody prepared, a full disk or a kill does to them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    files,
    merge_recordings,
    recover_recording,
    rewrite_recording,
)
from tupli_mcap.cli.app import app
from tupli_mcap.recording.edit.attach import add_attachments

HOLDER = """
import sys, time
from pathlib import Path
from tupli_mcap import files
with files.replacing(Path(sys.argv[1])) as new:
    new.write_bytes(b"half of it")
    print("ready", flush=True)
    time.sleep(600)
"""


@contextlib.contextmanager
def writer(goal: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has written half of a file; it is killed in the end."""
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(goal)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
    return path


def _rewrite(path: Path) -> None:
    with Recording(path) as recording:
        rewrite_recording(recording, path.with_name("out.mcap"))


def _record(path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), path.with_name("out.mcap")) as env:
        env.reset(seed=0)
        env.step(0)


WRITES: dict[str, Callable[[Path], object]] = {
    "record": _record,
    "rewrite": _rewrite,
    "merge": lambda path: merge_recordings([path], path.with_name("out.mcap")),
    "recover": lambda path: recover_recording(path, path.with_name("out.mcap")),
    "attach": lambda path: add_attachments(path, {"a": ("text/plain", b"a")}),
    "bytes": lambda path: files.write_bytes(path.with_name("out.mcap"), b"new"),
}


@pytest.mark.parametrize("name", WRITES)
def test_no_link_that_somebody_prepared_is_followed(recording: Path, tmp_path: Path, name: str) -> None:
    precious = tmp_path / "precious"
    precious.write_bytes(b"precious data")
    for goal in ("out.mcap", "r.mcap"):
        for foreseen in (f".{goal}.{os.getpid()}.tmp", f"{goal}.journal.tmp"):
            (tmp_path / foreseen).symlink_to(precious)
    WRITES[name](recording)
    assert precious.read_bytes() == b"precious data"
    out = tmp_path / "out.mcap"
    assert not out.is_symlink()
    assert name == "attach" or out.stat().st_size
    assert list(tmp_path.glob("*.journal")) == []


def test_a_file_is_the_old_one_or_the_new_one(tmp_path: Path) -> None:
    goal = tmp_path / "file"
    with pytest.raises(ValueError, match="broken off"), files.replacing(goal) as new:
        new.write_bytes(b"half")
        raise ValueError("broken off")
    assert list(tmp_path.iterdir()) == []
    files.write_bytes(goal, b"first", overwrite=False)
    with pytest.raises(FileExistsError, match=r"file'$"):
        files.write_bytes(goal, b"second", overwrite=False)
    assert goal.read_bytes() == b"first"
    files.write_bytes(goal, b"second")
    assert goal.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [goal]


def test_a_directory_takes_its_place_as_a_whole(tmp_path: Path) -> None:
    goal = tmp_path / "directory"
    for text in ("first", "second"):
        with contextlib.suppress(FileExistsError), files.replacing(goal, overwrite=False) as new:
            new.mkdir()
            (new / "file").write_text(text)
            assert text == "second" or not goal.exists()
    assert (goal / "file").read_text() == "first"
    assert list(tmp_path.iterdir()) == [goal]


def test_nobody_else_can_look_into_what_is_being_written(tmp_path: Path) -> None:
    with files.replacing(tmp_path / "file") as new:
        assert stat.S_IMODE(new.parent.stat().st_mode) == 0o700
        new.write_bytes(b"")


def test_a_file_is_as_open_as_its_directory_is(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        files.write_bytes(tmp_path / "file", b"")
        files.write_bytes(tmp_path / "key", b"", permissions=0o600)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600


def _compact(path: Path) -> None:
    tupli_mcap.open(path)[0].delete()
    with FileStorage(path.parent) as storage:
        assert storage.compact()


def _write_anew(path: Path) -> None:
    with Recording(path) as recording:
        rewrite_recording(recording, path)


@pytest.mark.parametrize("change", [_compact, _write_anew, WRITES["attach"]])
@pytest.mark.parametrize("permissions", [0o600, 0o664])
def test_a_changed_recording_is_as_open_as_it_was(tmp_path: Path, change: Any, permissions: int) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        for seed in range(2):
            env.reset(seed=seed)
            env.step(0)
    path.chmod(permissions)
    before = path.stat().st_ino
    change(path)
    assert stat.S_IMODE(path.stat().st_mode) == permissions
    assert path.stat().st_ino != before


def test_an_error_names_the_file_and_not_the_temporary_one(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none/file'$"):
        files.write_bytes(tmp_path / "none" / "file", b"")
    (tmp_path / "directory").mkdir()
    with pytest.raises(IsADirectoryError, match="directory"):
        files.write_bytes(tmp_path / "directory", b"")
    assert [path.name for path in tmp_path.iterdir()] == ["directory"]


# --- what killed processes leave


def test_what_a_killed_process_left_is_told_from_what_is_in_use(tmp_path: Path) -> None:
    below = tmp_path / "below"
    below.mkdir()
    with writer(below / "file") as process:
        (temporary,) = below.iterdir()
        assert files.is_temporary(temporary.name)
        assert files.left_in(below) == [] == list(files.left_below(tmp_path))
        assert files.remove_left([temporary]) == 0
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert files.left_in(below) == [temporary] == list(files.left_below(tmp_path))
    assert files.remove_left(files.left_in(below)) == len(b"half of it")
    assert list(below.iterdir()) == []


def test_a_file_is_held_even_if_somebody_looks_at_it_as_it_is_made(tmp_path: Path) -> None:
    path = files.temporary_path(tmp_path)
    path.mkdir()
    (path / "new").touch()
    own, other = (os.open(path, os.O_RDONLY) for _ in range(2))
    fcntl.flock(other, fcntl.LOCK_SH)
    assert files.left_in(tmp_path) == [path]  # somebody else looks, too
    looked = threading.Timer(0.1, os.close, [other])
    looked.start()
    files.hold(own)
    looked.join()
    assert files.left_in(tmp_path) == []
    os.close(own)
    assert files.left_in(tmp_path) == [path]


def test_a_file_that_was_just_made_is_left_alone(tmp_path: Path) -> None:
    """Its writer is about to take the lock."""
    made = [files.temporary_path(tmp_path) for _ in range(2)]
    made[0].mkdir()
    made[1].touch()
    assert files.left_in(tmp_path) == []
    for path in made:
        os.utime(path, (time.time() - 3600,) * 2)
    assert files.left_in(tmp_path) == sorted(made)


@pytest.mark.parametrize("command", ["filter", "merge", "split", "recover"])
def test_who_writes_a_recording_removes_what_is_left_beside_it(
    recording: Path, tmp_path: Path, command: str
) -> None:
    place = tmp_path / "made"
    place.mkdir()
    left, held = (files.temporary_path(place) for _ in range(2))
    for path in (left, held):
        path.write_bytes(b"half of it")
    more = {"filter": ["--episodes", "0"], "split": ["--episodes", "1"]}.get(command, [])
    with held.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        words = [command, str(recording), *more, "-o", str(place / "new.mcap")]
        done = CliRunner().invoke(app, words)
        assert (done.exit_code, left.exists(), held.exists()) == (0, False, True), done.stderr


def test_files_of_other_names_are_left_alone(tmp_path: Path) -> None:
    left = ["r.mcap.journal.tmp"]
    others = [".0123456789abcdef.tmp", ".settings.tmp", "r.tmp", "r.mcap", "tmp"]
    for name in (*left, *others):
        (tmp_path / name).write_bytes(b"x")
    link = files.temporary_path(tmp_path)
    link.symlink_to(tmp_path / "r.mcap")
    assert [path.name for path in files.left_in(tmp_path)] == sorted(left)
    assert files.remove_left(tmp_path.iterdir()) == len(left)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, link.name])


def test_commands_name_and_remove_what_is_left(recording: Path, tmp_path: Path) -> None:
    storage = tmp_path / "lab"
    places = [tmp_path, storage, storage / "recordings"]
    places[2].mkdir(parents=True)
    with writer(tmp_path / "a"), writer(storage / "a"), writer(places[2] / "a"):
        in_use = {path for place in places for path in place.glob(".*.tmp")}
        assert len(in_use) == 3
        for path in (recording, storage):
            assert "left by a process" not in run("verify", path)
        run("compact", "--storage", storage)
        merge_recordings([recording], tmp_path / "out.mcap")
        assert {path for place in places for path in place.glob(".*.tmp")} == in_use
    for where, names in ((recording, places[:1]), (storage, places[1:]), (tmp_path, places)):
        said = run("verify", where)
        for path in in_use:
            assert (path.name in said.replace("\n  ", "")) == (path.parent in names)
    assert (
        run("compact", "--storage", storage, "--dry-run")
        == "would remove 2 temporary files of killed processes\n"
    )
    assert run("compact", "--storage", storage) == "compacted 0 recordings, freed 20 B\n"
    assert not any((*storage.glob(".*.tmp"), *places[2].glob(".*.tmp")))
    recover_recording(recording, tmp_path / "again.mcap")
    assert not any(tmp_path.glob(".*.tmp"))


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_journal_that_is_not_in_its_place_yet_is_in_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map of a journal keeps its lock."""
    found = []
    monkeypatch.setattr(
        "tupli_mcap.journal.file.Journal.publish",
        lambda self, **_: found.extend([self._temporary.exists(), *files.left_in(tmp_path)]),
    )
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        env.reset(seed=0)
        env.step(0)
    assert found == [True]
