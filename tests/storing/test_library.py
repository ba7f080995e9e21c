"""Storages of many recordings: what is opened when, and catalogs that several processes make."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import uuid
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from tupli_mcap import EpisodeData, F, FileStorage, Recording, write_recording

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


def test_what_is_wrong_is_said(root: Path) -> None:
    (root / "recordings" / "b0" / "r000.mcap").write_bytes(b"nothing")
    copy = root / "recordings" / "b2" / "z.mcap"
    copy.write_bytes((root / "recordings" / "b1" / "r001.mcap").read_bytes())
    with pytest.warns(UserWarning, match="skipped a ") as said, FileStorage(root) as storage:
        found = listed(storage)
    texts = sorted({str(one.message) for one in said})
    assert len(texts) == 2
    assert any("r000.mcap" in text for text in texts)
    assert any("z.mcap holds episodes of recordings/b1/r001.mcap again" in text for text in texts)
    assert len(found) == (RECORDINGS - 1) * EPISODES


@pytest.mark.sampled(0)  # a short run of tools/concurrency.py has some
def test_several_processes_at_once(root: Path) -> None:
    code = (
        "import sys\nfrom tupli_mcap import FileStorage\n"
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
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from tools.bench.library import fill, template

    data = template(root.parent / "template.mcap", 20)
    fill(root, data, 3)
    with FileStorage(root) as storage:
        assert storage.count_episodes() == RECORDINGS * EPISODES + 3 * 20
        assert storage.count_episodes(F("metadata.score") == 19) == 3
    found = {Recording(path).uuid for path in root.glob("recordings/?/*.mcap")}
    assert len(found) == 3
    assert all(uuid.UUID(one) for one in found)
