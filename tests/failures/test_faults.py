"""Full disks, quotas, failing disks and too many files: one clear error, and everything recorded stays.

A seeded sample of what `tools/faults.py` runs in full.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler
from faults import Faults
from faulty_recordings import WORKLOADS, Case, calls_of, cases, run_case
from faulty_storages import OPERATIONS, Lab, run_storage_case, run_trust_case, template
from gymnasium import spaces

from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    StorageError,
    TupliDataset,
    TupliEnvWrapper,
    TupliError,
)

BOX = spaces.Box(-1, 1, (3,), np.float32)


def sampler(space: gym.Space[Any] = BOX) -> gym.Env[Any, Any]:
    return Sampler(space, spaces.Discrete(3), length=5)


@pytest.mark.sampled(12)
@pytest.mark.parametrize("name", WORKLOADS)
def test_the_kth_call_of_a_rollout_fails(tmp_path: Path, name: str) -> None:
    calls = calls_of(name, tmp_path / "whole")
    every = list(cases(calls))
    said = 0
    for i, case in enumerate(random.Random(name).sample(every, 4)):
        outcome = run_case(name, tmp_path / str(i), case)
        assert outcome.hit, case
        said += outcome.said
    assert said >= 2  # what is not said is only tidying up


def test_the_harness_notices_a_step_that_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tupli_mcap.mcap.container import Container

    write = Container.write
    monkeypatch.setattr(
        Container, "write", lambda self, *data: write(self, *data) if self.position < 4000 else None
    )
    with pytest.raises((AssertionError, UserWarning), match="steps"):
        run_case("box", tmp_path, Case(-1, errno.EIO, False))


def test_an_image_chunk_that_is_refused_is_no_wrong_step(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (8, 8, 3), np.uint8)
    env = RecordEpisodes(sampler(space), tmp_path / "r.mcap", chunk_size=1000)
    env.reset()
    env.step(0)
    with Faults(tmp_path, 0, errno.ENOSPC, lasting=True)(), pytest.raises(RecordingError) as caught:
        for _ in range(50):
            env.step(0)
    assert str(caught.value).startswith(f"{tmp_path}/r.mcap: could not write ")
    assert "No space left on device; free some space there" in str(caught.value)
    with pytest.raises(RecordingError, match="No space left on device"):
        env.step(0)
    env.close()  # there is space again
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.complete
        assert recording.n_steps >= 5


def test_a_file_system_without_locks_is_said_to_be_so(tmp_path: Path) -> None:
    with (
        Faults(tmp_path, 0, errno.ENOLCK, lasting=True, kinds=frozenset({"lock"}))(),
        pytest.raises(
            RecordingError, match=r"r\.mcap cannot be locked: No locks available; the file system cannot"
        ),
    ):
        RecordEpisodes(sampler(), tmp_path / "r.mcap")
    assert not list(tmp_path.iterdir())


def test_a_disk_that_cannot_be_read_is_no_defect(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(sampler(), path) as env:
        env.reset()
        for _ in range(5):
            env.step(0)

    def read() -> None:
        with Recording(path) as recording:
            recording.read()
            list(recording.episodes[0])
            recording.read_attachment("benchmark.json")

    with Faults(tmp_path)() as whole:
        read()
    assert len(whole.calls) > 5
    for at in range(len(whole.calls)):
        with Faults(tmp_path, at, errno.EIO)() as faults:
            if faults and whole.calls[at][0] == "close":  # nothing was written
                read()
                continue
            with pytest.raises(RecordingError, match=r"r\.mcap.* Input/output error; check the disk"):
                read()


def test_a_journal_that_cannot_be_read_is_not_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    live = RecordEpisodes(sampler(), path)
    live.reset()
    for _ in range(3):
        live.step(0)
    journal = tmp_path / "r.mcap.journal"

    class OnlyTheJournal(Faults):
        def check(self, kind: str, name: str) -> None:
            if name == str(journal):
                super().check(kind, name)

    with (
        OnlyTheJournal(tmp_path, 0, errno.EMFILE)(),
        pytest.raises(
            RecordingError, match=r"its journal r\.mcap\.journal cannot be read: Too many open files"
        ),
    ):
        Recording(path)
    live.close()


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ["growing", "append", "append-text", "journal-elsewhere"])
def test_what_cannot_be_asked_about_a_file_leaves_nothing_open(tmp_path: Path, name: str) -> None:
    calls = run_case(name, tmp_path / "whole", Case(-1, errno.EIO, False)).calls
    asked = [case for case in cases(calls) if calls[case.at][0] == "stat" and not case.lasting]
    assert asked
    for i, case in enumerate(asked):
        assert run_case(name, tmp_path / str(i), case).hit, case


def test_opening_to_append_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(sampler(), path) as env:
        env.reset()
        env.step(0)
    before = path.read_bytes()
    RecordEpisodes(sampler(), path, mode="a").close()
    assert path.read_bytes() == before
    env = RecordEpisodes(sampler(), path, mode="a")
    env.reset()
    assert Recording(path).complete
    env.close()
    assert path.read_bytes() == before


_labs: list[Lab] = []


@pytest.fixture
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """A storage to be copied; made once, when a private configuration directory is there."""
    if not _labs:
        _labs.append(template(tmp_path_factory.mktemp("made")))
    return _labs[0]


@pytest.mark.sampled(10)
@pytest.mark.parametrize("name", OPERATIONS)
def test_the_kth_call_on_a_storage_fails(tmp_path: Path, lab: Lab, name: str) -> None:
    calls = run_storage_case(name, lab, tmp_path / "whole", Case(-1, errno.EIO, False)).calls
    wanted = [case for case in cases(calls) if calls[case.at][0] not in ("mkdir", "close", "stat")]
    changing = [case for case in wanted if calls[case.at][0] in ("unlink", "replace", "link")]
    # at the last change, the others are done
    case = changing[-1] if changing else random.Random(name).choice(wanted)
    assert run_storage_case(name, lab, tmp_path / "failing", case).hit, case


def test_trusting_is_all_or_nothing(tmp_path: Path) -> None:
    calls = run_trust_case(tmp_path / "whole", Case(-1, errno.EIO, False)).calls
    for i, case in enumerate(random.Random(1).sample(list(cases(calls)), 20)):
        assert run_trust_case(tmp_path / str(i), case).hit, case


def test_a_catalog_that_could_not_be_made_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", str(cache))
    (tmp_path / "lab").mkdir()
    storage = FileStorage(tmp_path / "lab")
    with (
        Faults(tmp_path, 0, errno.ENOSPC, kinds=frozenset({"replace"}))(),
        pytest.warns(UserWarning, match="No space left on device; free some space there"),
    ):
        assert storage.count_episodes() == 0
    assert [p.name for p in cache.rglob("*") if p.is_file()] == ["catalog.sqlite.lock"]
    assert list(storage.root.iterdir()) == []
    storage.close()


def test_too_many_open_files_are_no_missing_recordings(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    storage = FileStorage(tmp_path / "lab")
    for i in range(3):
        with RecordEpisodes(sampler(), storage.root / f"{i}.mcap") as env:
            env.reset()
            env.step(0)
    with FileStorage(tmp_path / "lab") as another:
        assert another.count_episodes() == 3
    (tmp_path / "lab" / "2.mcap").touch()  # to be read anew

    class Recordings(Faults):
        def check(self, kind: str, name: str) -> None:
            if name.endswith("2.mcap"):
                super().check(kind, name)

    with (
        Recordings(tmp_path, 0, errno.EMFILE, kinds=frozenset({"open"}))(),
        pytest.raises(
            StorageError, match=r"cannot list the recordings .*2\.mcap.* Too many open files; close some"
        ),
    ):
        storage.list_episodes()
    assert len(storage.list_episodes()) == 3
    storage.close()


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda d: FileStorage(d).open_recording(None), "expected the recording of an episode header"),
        (lambda d: FileStorage(d / "a\0b"), "cannot use the storage .*choose another path"),
        (
            lambda d: TupliEnvWrapper(sampler(), 5),
            "expected a storage, or the path of its directory, found 5",
        ),
        (lambda d: TupliDataset.from_files(None), "expected paths of recordings"),
        (
            lambda d: RecordEpisodes(sampler(), d / "r.mcap", record_info=5),
            "record_info: expected True, False",
        ),
        (lambda d: RecordEpisodes(sampler(), "file:///tmp/r.mcap"), "found a URL; .* and copy the file"),
        (
            lambda d: RecordEpisodes(sampler(), "http://127.0.0.1:8080"),
            r"tupli-mcap push FILE .*TupliEnvWrapper\(env, storage=TupliAPIClient\(URL\)\)",
        ),
    ],
)
def test_wrong_arguments_are_said(tmp_path: Path, use: Any, message: str) -> None:
    with pytest.raises(TupliError, match=message):
        use(tmp_path)


REAL = """
import os, resource, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import gymnasium as gym, numpy as np
from environments import Sampler, roll, same
from gymnasium import spaces
from tupli_mcap import FileStorage, RecordEpisodes, Recording, TupliError
root = Path(sys.argv[1])
space = spaces.Box(-1, 1, (20,), np.float32)
taken = []
def rollout(path, steps, **options):
    env = RecordEpisodes(Sampler(space, spaces.Discrete(3), length=50), path, attachments={{}}, **options)
    try:
        env.reset(seed=1)
        for i in range(steps):
            if i == {trouble_at}:
                {trouble}
            result = env.step(i % 3)
            taken.append(result[0].copy())
            if result[2] or result[3]:
                env.reset()
    finally:
        env.close()
{body}
"""

CHECK = """
else:
    raise SystemExit("no error")
{after}
with Recording(path) as recording:
    found = [state for e in recording.episodes for state in e.next_states]
assert 0 <= len(found) - len(taken) <= 1, (len(found), len(taken))
assert all(same(a, b) for a, b in zip(found, taken))
print(len(taken), message)
"""

FAIL = """
path = root / "r.mcap"
try:
    rollout(path, {steps}, {options})
except TupliError as err:
    message = str(err)
"""


def _real(tmp_path: Path, before: str, body: str, *, trouble_at: int = -1, trouble: str = "pass") -> str:
    """Runs a rollout in a process with file systems of its own; what it printed."""
    script = tmp_path / "child.py"
    tests = str(Path(__file__).parents[1] / "support")
    script.write_text(REAL.format(tests=tests, trouble_at=trouble_at, trouble=trouble, body=body))
    disk = tmp_path / "disk"
    disk.mkdir()
    unshare = ["unshare", "-m"] if os.geteuid() == 0 else ["unshare", "-rm"]
    command = f"set -e; {before.format(disk=disk)}; exec {sys.executable} {script} {disk}"
    try:
        probe = f"mount -t tmpfs none {disk}"
        subprocess.run([*unshare, "sh", "-c", probe], check=True, capture_output=True, timeout=30)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting a file system is not permitted here")
    child = subprocess.run([*unshare, "sh", "-c", command], capture_output=True, text=True, timeout=120)
    assert child.returncode == 0, child.stderr
    return child.stdout


def test_a_disk_that_is_full_at_the_first_step(tmp_path: Path) -> None:
    body = FAIL.format(steps=5, options="") + 'else:\n    raise SystemExit("no error")\nprint(message)\n'
    body += "assert not list(root.iterdir())\nrollout(Path('/dev/shm') / f'{os.getpid()}.mcap', 5)\n"
    body += "os.unlink(f'/dev/shm/{os.getpid()}.mcap')\n"
    said = _real(tmp_path, "mount -t tmpfs -o size=256k none {disk}", body)
    assert "could not make the journal of" in said
    assert "No space left on device; free some space there, or choose another disk" in said


def test_a_disk_that_fills_up(tmp_path: Path) -> None:
    options = 'chunk_size=20_000, compression="none"'
    body = FAIL.format(steps=100_000, options=options) + CHECK.format(after="")
    said = _real(tmp_path, "mount -t tmpfs -o size=1m none {disk}", body)
    assert int(said.split()[0]) > 1000
    assert "r.mcap: could not write " in said
    assert "No space left on device; free some space there" in said


def test_a_disk_that_becomes_read_only(tmp_path: Path) -> None:
    """Emergency read-only: ext4 as after an error of the disk."""
    image = tmp_path / "image"
    if shutil.which("mkfs.ext4") is None or os.geteuid() != 0:
        pytest.skip("needs root and mkfs.ext4 for a loop-back file system")
    before = f"truncate -s 16M {image}; mkfs.ext4 -q {image}; mount -o loop {image} {{disk}}"
    options = 'chunk_size=20_000, compression="none"'
    body = FAIL.format(steps=3000, options=options) + CHECK.format(after="")
    trouble = "os.system(f'mount -o remount,abort,errors=remount-ro {root} 2>/dev/null')"
    try:
        said = _real(tmp_path, before, body, trouble_at=900, trouble=trouble)
    except AssertionError as err:
        if "mount" in str(err):
            pytest.skip("loop-back file systems are not permitted here")
        raise
    assert int(said.split()[0]) >= 900
    assert "r.mcap" in said


def test_the_size_of_files_is_limited(tmp_path: Path) -> None:
    options = 'chunk_size=20_000, compression="none"'
    body = FAIL.format(steps=100_000, options=options) + CHECK.format(after="")
    trouble = "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))"
    said = _real(tmp_path, "true", body, trouble_at=10, trouble=trouble)
    assert "File too large; raise the limit (ulimit -f)" in said


def test_all_descriptors_are_taken(tmp_path: Path) -> None:
    body = """
rollout(root / "lab" / "a.mcap", 3) if (root / "lab").mkdir() is None else None
for i in range(40):
    (root / "lab" / f"{i}.mcap").write_bytes((root / "lab" / "a.mcap").read_bytes())
storage = FileStorage(root / "lab")
resource.setrlimit(resource.RLIMIT_NOFILE, (200, 200))
held = []
try:
    while True:
        held.append(os.open("/dev/null", os.O_RDONLY))
except OSError:
    pass
for use in (
    lambda: rollout(root / "r.mcap", 3),
    lambda: Recording(root / "lab" / "a.mcap"),
    lambda: FileStorage(root / "lab").list_episodes(),
):
    try:
        use()
    except TupliError as err:
        print(err)
    else:
        raise SystemExit("no error")
for fd in held:
    os.close(fd)
rollout(root / "r.mcap", 3)
assert len(storage.list_episodes()) == 1
"""
    said = _real(tmp_path, "true", body).splitlines()
    assert len(said) == 3
    assert all("Too many open files" in line or "unable to open database file" in line for line in said), said
