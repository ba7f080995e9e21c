"""Which episodes a command means."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import run

import tupli_mcap
from tupli_mcap.dataset.chosen import chosen_from
from tupli_mcap.errors import FilterError, RecordingError
from tupli_mcap.recording import Episode, EpisodeData, Recording, write_recording
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.schema import BaseFilter, F, parse_filter
from tupli_mcap.storage.sidecar import Sidecar

RETURNS = [3.0, 9.0, -2.0, 9.0, float("nan"), -2.0]


def write(path: Path, returns: list[float]) -> Path:
    episodes = [
        EpisodeData(
            states=np.zeros((2, 1), np.float32),
            actions=np.zeros(2, np.int64),
            rewards=np.array([value, 0.0]),
            terminals=np.array([False, True]),
            timeouts=np.zeros(2, np.bool_),
            metadata={"odd": bool(i % 2)},
        )
        for i, value in enumerate(returns)
    ]
    space = gym.spaces.Box(-1.0, 1.0, (1,))
    write_recording(path, episodes, observation_space=space, action_space=gym.spaces.Discrete(2))
    return path


def choose_episodes(
    recording: Recording, text: str = "all", filter: BaseFilter | None = None
) -> list[Episode]:
    with chosen_from(recording, text, filter) as chosen:
        return [item.recording.episodes[at] for item in chosen for at in item.positions]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write(tmp_path / "returns.mcap", RETURNS)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("all", [0, 1, 2, 3, 4, 5]),
        ("first", [0]),
        ("last", [5]),
        ("best", [1]),
        ("worst", [2]),
        ("3", [3]),
        (" 5, 0,5 ", [5, 0]),
        ("3-5", [3, 4, 5]),
        ("2-2,4-99,1", [2, 4, 5, 1]),
        ("Best,first,1,worst", [1, 0, 2]),
    ],
)
def test_words_and_numbers(file: Path, text: str, numbers: list[int]) -> None:
    with Recording(file) as recording:
        assert [episode.number for episode in choose_episodes(recording, text)] == numbers


def test_a_filter_is_what_the_choice_is_among(file: Path) -> None:
    with Recording(file) as recording:
        odd = parse_filter("metadata.odd = true")
        assert [e.number for e in choose_episodes(recording, filter=odd)] == [1, 3, 5]
        assert [e.number for e in choose_episodes(recording, "last,worst,best", odd)] == [5, 1]
        with pytest.raises(
            RecordingError, match=r"has no episode 2 that matches .*odd.*; choose from 3 episodes"
        ):
            choose_episodes(recording, "2", odd)
        with pytest.raises(RecordingError, match=r"has no episode that matches .*n_tuples"):
            choose_episodes(recording, "best", F("n_tuples") > 2)
        with pytest.raises(FilterError, match="length"):
            choose_episodes(recording, "all", F("length") > 2)


def delete(file: Path, numbers: set[int]) -> None:
    Sidecar(uuid=metadata_at(file)["uuid"], deleted=numbers).write(file)


def test_deleted_episodes_are_not_there(file: Path) -> None:
    delete(file, {0, 1, 4})
    with Recording(file) as recording:
        assert [e.number for e in choose_episodes(recording, "first,best,all")] == [2, 3, 5]
        with pytest.raises(RecordingError, match="has no episode 1; choose from 3 episodes between 2 and 5"):
            choose_episodes(recording, "1")
        assert [e.number for e in choose_episodes(recording, "1-4")] == [2, 3]
        with pytest.raises(RecordingError, match="has no episode 0-1; choose from"):
            choose_episodes(recording, "0-1")
        odd = F("metadata.odd") == True  # noqa: E712 - the filter's own equality
        assert [e.number for e in choose_episodes(recording, "all", odd)] == [3, 5]


@pytest.mark.parametrize(
    ("text", "numbers"), [("1-3", [1, 2, 3]), ("4 - 9999999999,0-1", [4, 5, 0, 1]), ("2-2,3", [2, 3])]
)
def test_from_one_number_to_another(file: Path, text: str, numbers: list[int]) -> None:
    with Recording(file) as recording:
        assert [episode.number for episode in choose_episodes(recording, text)] == numbers
        with pytest.raises(RecordingError, match="no episode 5-3; choose from 0 to 5"):
            choose_episodes(recording, "5-3")


def test_a_number_out_of_range_names_the_range(file: Path) -> None:
    with (
        Recording(file) as recording,
        pytest.raises(RecordingError, match=r"returns\.mcap has no episode 6; choose from 0 to 5$"),
    ):
        choose_episodes(recording, "2,6")
    delete(file, set(range(5)))
    with Recording(file) as recording, pytest.raises(RecordingError, match="choose from episode 5 only"):
        choose_episodes(recording, "0")
    delete(file, set(range(6)))
    with Recording(file) as recording, pytest.raises(RecordingError, match="has no episode$"):
        choose_episodes(recording, "all")


def test_each_number_must_exist_in_a_directory_too(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", RETURNS)
    with (
        pytest.raises(RecordingError, match=r"has no episode 9; choose from "),
        chosen_from(tmp_path, "3,9", None),
    ):
        pass
    with chosen_from(tmp_path, "4-9", None) as (chosen,):
        assert list(chosen.positions) == [4, 5]


def test_a_directory_without_recordings_is_said_to_hold_none(tmp_path: Path) -> None:
    with (
        pytest.raises(RecordingError, match=r"holds no recording \(\.mcap\)$"),
        chosen_from(tmp_path, None, None),
    ):
        pass


@pytest.mark.parametrize(
    "text", ["", "3,", "beste", "-1", "1.0", "0x1", "3-", "1-2-3", "9" * 5000, "²", "1;2"]
)
def test_other_words_are_refused(file: Path, text: str) -> None:
    with (
        Recording(file) as recording,
        pytest.raises(FilterError, match=re.escape("'3,7-9', or best, worst, first, last or all, found")),
    ):
        choose_episodes(recording, text)


@pytest.mark.parametrize(("word", "wanted"), [("best", 5.0), ("worst", -5.0)])
def test_a_return_that_is_no_number_is_neither_best_nor_worst_of_a_directory(
    tmp_path: Path, word: str, wanted: float
) -> None:
    nan = float("nan")
    for name, returns in (("a", [nan, nan]), ("b", [nan, 5.0, -5.0]), ("c", [1.0])):
        write(tmp_path / f"{name}.mcap", returns)
    with chosen_from(tmp_path, word, None) as ((recording, (position,)),):
        assert recording.index["return"][position] == wanted


@pytest.mark.parametrize("of_storage", [False, True])
def test_every_command_finds_a_recording_by_the_name_that_episodes_have(
    tmp_path: Path, of_storage: bool
) -> None:
    folder = tmp_path / "recordings" if of_storage else tmp_path
    folder.mkdir(exist_ok=True)
    for name, returns in (("a", [1.0, 2.0]), ("b", [3.0, 4.0, 5.0])):
        write(folder / f"{name}.mcap", returns)
    listed = run("episodes", tmp_path, "--json").json
    assert [one["recording"] for one in listed] == [e.recording for e in tupli_mcap.open(tmp_path).headers]
    name = listed[0]["recording"]
    assert name == ("recordings/a.mcap" if of_storage else str(folder / "a.mcap"))

    def found(command: str, *options: str) -> Any:
        return run(command, tmp_path, "--filter", f"recording = '{name}'", *options, "--json").json

    assert len(found("episodes")) == len(found("episodes", "--episodes", "all")) == 2
    assert [one["episodes"] for one in found("ls")] == [2]
    assert found("info")["episodes"] == found("doctor")["episodes"] == 2
    assert found("filter", "-o", str(tmp_path / "new.mcap"), "--dry-run")["episodes"] == 2
    assert [one["episodes"] for one in found("tag", "good=1", "--dry-run")] == [[0, 1]]
    assert [one["path"] for one in found("edit", "--split", "eval", "--dry-run")] == [str(folder / "a.mcap")]
    assert len(found("delete")["episodes"]) == 2
    assert {one.recording for one in tupli_mcap.open(tmp_path).headers} == {listed[-1]["recording"]}
