"""Storages of many recordings: what is opened when, and catalogs that several processes make."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from waiting import wait_for

from tupli_mcap import EpisodeData, F, FileStorage, RecordEpisodes, Recording, write_recording
from tupli_mcap.storage.catalog import entries
from tupli_mcap.storage.listing import scan

RECORDINGS, EPISODES = 12, 5


def add(root: Path, number: int, episodes: int = EPISODES) -> Path:
    """A recording of short episodes."""
    path = root / "recordings" / f"b{number % 3}" / f"r{number:03}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    state = np.zeros((1, 2), np.float32)
    write_recording(
        path,
        [
            EpisodeData(
                state, [0], [1.5], [True], [False], state[0], metadata={"score": score, "text": "ü\x00"}
            )
            for score in range(episodes)
        ],
        observation_space=spaces.Box(-1, 1, (2,)),
        action_space=spaces.Discrete(2),
        benchmark_id=f"b{number % 3}",
    )
    return path


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for number in range(RECORDINGS):
        add(tmp_path / "lab", number)
    return tmp_path / "lab"


def listed(storage: FileStorage) -> list[dict[str, Any]]:
    return [header.model_dump() for header in storage.list_episodes()]


_WATCHED = """
import json, sys
opened = []
def hook(event, args):
    if event == "open" and str(args[0]).endswith(".mcap"):
        opened.append(str(args[0]))
sys.addaudithook(hook)
from tupli_mcap import F, FileStorage
with FileStorage(sys.argv[1]) as storage:
    found = len(storage.list_episodes(F("metadata.score") == 2))
    count = storage.count_episodes()
print(json.dumps([opened, found, count]))
"""


def opened_by_a_new_process(root: Path) -> tuple[list[str], int, int]:
    """The recordings that it opens to answer queries, and what it finds."""
    done = subprocess.run(
        [sys.executable, "-c", _WATCHED, str(root)], capture_output=True, text=True, check=True
    )
    opened, found, count = json.loads(done.stdout)
    return sorted({Path(path).name for path in opened}), found, count


def test_a_cold_open_opens_what_has_changed_only(root: Path) -> None:
    names = [f"r{number:03}.mcap" for number in range(RECORDINGS)]
    assert opened_by_a_new_process(root) == (names, RECORDINGS, RECORDINGS * EPISODES)
    assert opened_by_a_new_process(root) == ([], RECORDINGS, RECORDINGS * EPISODES)
    add(root, 77)
    (root / "recordings" / "b0" / "r000.mcap").unlink()
    os.utime(root / "recordings" / "b1" / "r001.mcap", ns=(1, 1))
    assert opened_by_a_new_process(root)[0] == ["r001.mcap", "r077.mcap"]
    assert opened_by_a_new_process(root) == ([], RECORDINGS, RECORDINGS * EPISODES)


# Other processes read from the first recording on, on any machine.
_AT_ONCE = (
    "from tupli_mcap.storage.catalog import entries\n"
    "entries._TRIAL, entries._WORTH = -1.0, -1.0\nentries.os.sched_getaffinity = lambda _: {0, 1}\n"
)


class TestReadAhead:
    def make(self, root: Path, monkeypatch: pytest.MonkeyPatch, workers: int) -> list[dict[str, Any]]:
        """What the storage lists when its catalog was made with so many processes."""
        with monkeypatch.context() as patch:
            patch.setattr(entries, "_TRIAL", -1.0 if workers else math.inf)
            patch.setattr(entries, "_WORTH", -1.0)
            patch.setattr(os, "sched_getaffinity", lambda _: set(range(workers)))
            with FileStorage(root) as storage:
                storage.declare_key("metadata.score")
                storage.reindex()
                plan = storage.explain(F("metadata.score") == 2)
                assert "USING INDEX" in plan or "USING COVERING INDEX" in plan
                return listed(storage)

    def test_it_changes_nothing(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with FileStorage(root) as storage:
            storage.delete_episode(storage.list_episodes()[3].id)
            storage.publish_episode(storage.list_episodes()[4].id, "team")
        here = self.make(root, monkeypatch, 0)
        assert len(here) == RECORDINGS * EPISODES - 1
        assert here[0]["metadata"]["text"] == "ü\x00"
        assert self.make(root, monkeypatch, 2) == here

    def test_other_processes_read(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        names = [item.relative for item in scan(root)]
        monkeypatch.setattr(entries, "_TRIAL", -1.0)
        monkeypatch.setattr(entries, "_WORTH", -1.0)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
        read = list(entries.read_ahead(root, [*names, "missing.mcap"]))
        assert read[-1] is None
        for name, entry in zip(names, read, strict=False):
            with entries.entry_of(root, name) as expected:
                assert entry == expected._replace(rows=list(expected.rows))

    def test_what_is_wrong_is_said(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (root / "recordings" / "b0" / "r000.mcap").write_bytes(b"nothing")
        copy = root / "recordings" / "b2" / "z.mcap"
        copy.write_bytes((root / "recordings" / "b1" / "r001.mcap").read_bytes())
        for workers in (0, 2):
            with pytest.warns(UserWarning, match="skipped a recording") as said:
                found = self.make(root, monkeypatch, workers)
            texts = sorted({str(one.message) for one in said})
            assert len(texts) == 2
            assert any("r000.mcap" in text for text in texts)
            assert any("z.mcap holds episodes of recordings/b1/r001.mcap again" in text for text in texts)
            assert len(found) == (RECORDINGS - 1) * EPISODES

    def test_what_warns_warns_here(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with RecordEpisodes(gym.make("CartPole-v1"), root.parent / "r.mcap") as env:
            env.reset(seed=1)
            env.step(0)
            shutil.copy(env.path, root / "recordings" / "b0" / "alone.mcap")  # without its journal
        for workers in (0, 2):
            with pytest.warns(UserWarning, match=r"alone\.mcap"):
                self.make(root, monkeypatch, workers)

    def test_processes_that_are_killed(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        names = [item.relative for item in scan(root)]
        reading = entries._read_elsewhere(root, names * 4, 2)
        first = next(reading)
        assert first is not None
        assert first.uuid
        for process in multiprocessing.active_children():
            process.kill()
        rest = list(reading)
        assert len(rest) == 4 * len(names) - 1
        assert rest[-1] is None
        assert multiprocessing.active_children() == []

        begin = entries._read_elsewhere

        def killed(*arguments: Any) -> Iterator[Any]:
            for entry in begin(*arguments):
                for process in multiprocessing.active_children():
                    process.kill()
                yield entry

        monkeypatch.setattr(entries, "_read_elsewhere", killed)
        assert len(self.make(root, monkeypatch, 2)) == RECORDINGS * EPISODES

    def test_they_end_with_the_process_that_started_them(self, root: Path) -> None:
        code = (
            f"import sys, os, signal, multiprocessing\nfrom pathlib import Path\n{_AT_ONCE}"
            "reading = entries.read_ahead(Path(sys.argv[1]), sys.argv[2:])\nnext(reading)\n"
            "print(*(child.pid for child in multiprocessing.active_children()), flush=True)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        names = [item.relative for item in scan(root)]
        done = subprocess.run(
            [sys.executable, "-c", code, root, *names], capture_output=True, text=True, timeout=60
        )
        pids = [int(pid) for pid in done.stdout.split()]
        assert len(pids) == 2
        wait_for(lambda: not any(is_running(pid) for pid in pids))

    def test_ctrl_c_is_one_interrupt(self, root: Path) -> None:
        code = (
            f"import sys, os, signal, multiprocessing\nfrom pathlib import Path\n{_AT_ONCE}"
            "from tupli_mcap import FileStorage\nbegin = entries._read_elsewhere\n"
            "def interrupted(*arguments):\n"
            "    for entry in begin(*arguments):\n"
            "        print(*(child.pid for child in multiprocessing.active_children()), flush=True)\n"
            "        os.killpg(os.getpid(), signal.SIGINT)\n"
            "        yield entry\n"
            "entries._read_elsewhere = interrupted\n"
            "FileStorage(sys.argv[1]).count_episodes()\n"
        )
        process = subprocess.Popen(
            [sys.executable, "-c", code, root],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        output, errors = process.communicate(timeout=120)
        assert errors.count("Traceback") == 1
        assert errors.rstrip().endswith("KeyboardInterrupt")
        wait_for(lambda: not any(is_running(int(pid)) for pid in output.split()))
        with FileStorage(root) as storage:
            assert storage.count_episodes() == RECORDINGS * EPISODES

    def test_a_script_is_not_run_again(self, root: Path, tmp_path: Path) -> None:
        script = tmp_path / "script.py"
        script.write_text(
            f"import sys\nfrom tupli_mcap import FileStorage\n{_AT_ONCE}"
            "print('once')\nprint(FileStorage(sys.argv[1]).count_episodes())\nprint(__file__, __spec__)\n"
        )
        expected = ["once", str(RECORDINGS * EPISODES), str(script), "None"]
        run = [sys.executable, script, root]
        done = subprocess.run(run, capture_output=True, text=True, check=True, timeout=60)
        assert (done.stdout.split(), done.stderr) == (expected, "")

    @pytest.mark.sampled(0)  # a short run of tools/concurrency.py has some
    def test_several_processes_at_once(self, root: Path) -> None:
        code = (
            f"import sys\nfrom tupli_mcap import FileStorage\n{_AT_ONCE}"
            "with FileStorage(sys.argv[1]) as storage:\n"
            "    storage.reindex()\n    print(storage.count_episodes())\n"
        )
        run = [sys.executable, "-c", code, str(root)]
        processes = [
            subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)
        ]
        outputs = [process.communicate(timeout=120) for process in processes]
        assert outputs == [(f"{RECORDINGS * EPISODES}\n", "")] * 2
        with FileStorage(root) as storage:
            assert len(listed(storage)) == RECORDINGS * EPISODES


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_headers_are_like_any_other_model(root: Path) -> None:
    with FileStorage(root) as storage:
        one, other = storage.list_episodes()[:2]
        again = type(one).model_validate(one.model_dump())
        assert one == again
        assert repr(one) == repr(again)
        assert one.model_fields_set == again.model_fields_set
        changed = one.model_copy(update={"env": 7})
        changed.metadata = {"new": 1}
        assert (one.env, changed.env, other.metadata["score"], one.metadata["score"]) == (0, 7, 1, 0)


def test_a_copy_under_a_new_uuid_is_no_copy(root: Path) -> None:
    """What the benchmark fills storages with."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tools.bench.library import fill, template

    data = template(root.parent / "template.mcap", 20)
    fill(root, data, 3)
    with FileStorage(root) as storage:
        assert storage.count_episodes() == RECORDINGS * EPISODES + 3 * 20
        assert storage.count_episodes(F("metadata.score") == 19) == 3
    found = {Recording(path).uuid for path in root.glob("recordings/?/*.mcap")}
    assert len(found) == 3
    assert all(uuid.UUID(one) for one in found)
