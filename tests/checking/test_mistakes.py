"""A wrong argument is told in one error that says what is expected, before anything is written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import roll

import tupli_mcap
from tupli_mcap import FileStorage, RecordEpisodes, Recording, RecordingError, TupliAPIClient, TupliError
from tupli_mcap.dataset import TupliDataset
from tupli_mcap.doctor import examine
from tupli_mcap.recording import (
    annotate_episodes,
    edit_runs,
    finish_recording,
    recover_recording,
    rewrite_recording,
    verify_recording,
)
from tupli_mcap.recording.sign.carried_code import untrust
from tupli_mcap.reexecute import certify, film, render
from tupli_mcap.schema import format_filter, parse_filter
from tupli_mcap.viewer import blueprint

Call = Callable[[Any], object]
NAMES = {"too long": "x" * 5000 + ".mcap", "with a NUL": "a\0.mcap"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory with a recording of two episodes, the working directory."""
    monkeypatch.chdir(tmp_path)
    with RecordEpisodes(gym.make("CartPole-v1", max_episode_steps=5), "a.mcap") as env:
        roll(env, 10)
    return tmp_path


def files_in(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


@pytest.mark.parametrize(
    "numbers", ["01", [0.5], [True, False], np.array([True, False]), 1, [None]], ids=lambda each: repr(each)
)
@pytest.mark.parametrize(
    "call",
    [
        lambda numbers: rewrite_recording(Recording("a.mcap"), "b.mcap", episodes=numbers),
        lambda numbers: certify("a.mcap", episodes=numbers),
        lambda numbers: render("a.mcap", "b.gif", episodes=numbers),
        lambda numbers: annotate_episodes("a.mcap", {"x": 1}, numbers),
        lambda numbers: tupli_mcap.restore_episodes(
            "a.mcap", [*numbers, "x"] if isinstance(numbers, str) else numbers
        ),
        lambda numbers: blueprint("a.mcap", [*numbers, "x"] if isinstance(numbers, str) else numbers),
    ],
    ids=["rewrite", "certify", "render", "annotate", "restore", "blueprint"],
)
def test_numbers_of_episodes_that_are_none(here: Path, call: Call, numbers: Any) -> None:
    with pytest.raises(RecordingError, match=r"expected numbers of episodes, such as \[3, 7\], found"):
        call(numbers)
    assert files_in(here) == ["a.mcap"]


@pytest.mark.parametrize("url", ["https://lab/x.mcap", "s3://bucket/x.mcap"])
@pytest.mark.parametrize(
    "call",
    [
        lambda url: tupli_mcap.open("a.mcap").save(url),
        lambda url: tupli_mcap.open("a.mcap").map(lambda episode: episode.rewards, url),
        lambda url: tupli_mcap.open("a.mcap").trim(slice(1, 3), url),
        lambda url: tupli_mcap.open("a.mcap").save_columns(url),
        lambda url: tupli_mcap.merge_recordings(["a.mcap"], url),
        lambda url: tupli_mcap.split_recording("a.mcap", url, episodes=1),
        lambda url: tupli_mcap.recover_recording("a.mcap", url),
        lambda url: rewrite_recording(Recording("a.mcap"), url),
    ],
    ids=["save", "map", "trim", "columns", "merge", "split", "recover", "rewrite"],
)
def test_nothing_is_written_to_a_url(here: Path, call: Call, url: str) -> None:
    with pytest.raises(RecordingError, match="x.mcap: expected a local path to write to, found a URL"):
        call(url)
    assert files_in(here) == ["a.mcap"]


def test_a_storage_of_files_is_at_no_url(here: Path) -> None:
    with pytest.raises(TupliError, match="found 'http://lab:8080'; TupliAPIClient takes the address"):
        FileStorage("http://lab:8080")
    with FileStorage(here / "lab") as storage:
        for write in (storage.export, lambda target: storage.bundle("0", target)):
            with pytest.raises(RecordingError, match="expected a local path to write to, found a URL"):
                write("s3://bucket/x.mcap")


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize(
    "call",
    [
        tupli_mcap.open,
        Recording,
        verify_recording,
        tupli_mcap.recover_recording,
        recover_recording,
        tupli_mcap.restore_episodes,
        lambda name: annotate_episodes(name, {"x": 1}),
        blueprint,
        TupliDataset,
        lambda name: tupli_mcap.open("a.mcap").save(name),
        lambda name: tupli_mcap.open("a.mcap").save_columns(name),
        lambda name: rewrite_recording(Recording("a.mcap"), name),
        lambda name: tupli_mcap.merge_recordings(["a.mcap"], name),
        lambda name: RecordEpisodes(gym.make("CartPole-v1"), name),
        untrust,
        lambda name: tupli_mcap.open("a.mcap").plot().save(name.replace(".mcap", ".png")),
        lambda name: Recording("a.mcap").view(save=name.replace(".mcap", ".rrd")),
        finish_recording,
    ],
)
def test_names_that_no_file_can_have(here: Path, call: Call, name: str) -> None:
    with pytest.raises(TupliError):
        call(name)
    assert files_in(here) == ["a.mcap"]


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: rewrite_recording("a.mcap", "b.mcap"), r"pass tupli_mcap.Recording\(...\)"),  # type: ignore[arg-type]
        (lambda: rewrite_recording(Recording("a.mcap"), "b.mcap", episodes=[7]), "a.mcap has no episode 7"),
        (lambda: certify("a.mcap", env="CartPole-v1"), "env: expected an environment"),  # type: ignore[arg-type]
        (lambda: film("a.mcap"), "expected episodes to film, such as recording.episodes"),  # type: ignore[arg-type]
        (lambda: edit_runs("a.mcap", metadata=["x"]), "metadata: expected a dict"),  # type: ignore[arg-type]
        (lambda: annotate_episodes("a.mcap", ["x"]), "expected a dict of values"),  # type: ignore[arg-type]
        (
            lambda: tupli_mcap.open("a.mcap")[0].annotate(success="no"),
            "success to be true or false, found 'no'",
        ),
        (
            lambda: tupli_mcap.open("a.mcap").annotate(is_success=0.7),
            "is_success to be true or false, found 0.7",
        ),
        (
            lambda: tupli_mcap.open("a.mcap").annotate(success=np.array([True])),
            r"success to be true or false, found array\(\[ True\]\)",
        ),
        (lambda: tupli_mcap.open("a.mcap").filter(np.array([True, False])), r"by a mask: dataset\[mask\]"),  # type: ignore
        (lambda: blueprint("a.mcap", form="side"), "form: expected one of joined, apart, compare"),  # type: ignore
        (lambda: blueprint(None), "expected a recording, its path or a dataset, found None"),  # type: ignore[arg-type]
        (lambda: tupli_mcap.open("a.mcap").map("rewards", "b.mcap"), "expected a function of an episode"),  # type: ignore
        (
            lambda: tupli_mcap.open("a.mcap").loader(batch_size=99, drop_last=True),
            "at least 99 items for one full",
        ),
        (lambda: TupliDataset.from_files("a.mcap").convert_to_tensors("torch"), "expected a parser"),  # type: ignore
        (lambda: parse_filter(None), "expected a filter as a text"),  # type: ignore[arg-type]
        (lambda: format_filter("x > 1"), "expected a filter, such as"),  # type: ignore[arg-type]
        (lambda: recover_recording(""), "expected a path, found an empty text"),
        (lambda: tupli_mcap.open("http://["), "expected an address, found 'http://\\['"),
        (lambda: Recording("http://["), "expected an address, found 'http://\\['"),
        (lambda: Recording("s3://["), "expected an address, found 's3://\\['"),
        (lambda: TupliAPIClient("http://["), "expected the address of a server"),
        (
            lambda: TupliAPIClient("http://a:pw@lab"),
            "without a user or a query",
        ),
        (lambda: TupliAPIClient(5), "expected the address of a server"),  # type: ignore[arg-type]
        (lambda: examine("http://["), "expected an address"),
    ],
)
def test_values_of_other_kinds(here: Path, call: Callable[[], object], match: str) -> None:
    with pytest.raises(TupliError, match=match):
        call()
    assert files_in(here) == ["a.mcap"]


def test_a_name_of_a_benchmark_that_is_no_text(here: Path) -> None:
    with FileStorage(here / "lab") as storage:
        uri = tupli_mcap.TupliEnvWrapper(gym.make("CartPole-v1"), storage).store("cartpole")
        for name in (5, "\udcff"):
            with pytest.raises(TupliError, match="expected a name or a description of the benchmark"):
                storage.edit_benchmark(uri, name=name)  # type: ignore[arg-type]
