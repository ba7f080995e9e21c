"""`tupli_mcap.open`: datasets of episodes, narrowed, put in order, read, and handed on."""

from __future__ import annotations

import gc
import json
import os
import pickle
import re
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll
from gymnasium import spaces
from IPython.core.completer import IPCompleter, provisionalcompleter
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import (
    Dataset,
    Episode,
    F,
    FileStorage,
    FilterError,
    Recording,
    RecordingError,
    TupliDataset,
    TupliError,
)
from tupli_mcap.cli.app import app
from tupli_mcap.dataset import open_columns
from tupli_mcap.errors import MissingExtraError, NotFoundError
from tupli_mcap.jsonvalue import loads
from tupli_mcap.schema import EpisodeMetadataCallback

SPACE = spaces.Box(-1, 1, (1,), np.float32)
FIELDS = ["states", "next_states", "times", "infos"]
OWN = ["metadata.side", "metadata.count", "metadata.success", "info.tag"]


class Notes(EpisodeMetadataCallback):
    """Metadata that differ from episode to episode."""

    def __init__(self, side: str) -> None:
        self.side, self.count = side, -1

    def reset(self) -> None:
        self.count += 1

    def __call__(self, tuple: Any) -> dict[str, Any]:
        return {"side": self.side, "count": self.count, "success": self.count % 3 == 0}


def record(path: Path, seed: int, episodes: int) -> Path:
    env = gym.make("CartPole-v1")
    with tupli_mcap.RecordEpisodes(
        env, path, metadata_callback=Notes(path.stem), step_callback=lambda step: {"tag": int(step.action)}
    ) as recorder:
        recorder.action_space.seed(seed)
        for i in range(episodes):
            recorder.reset(seed=seed + i)
            over = False
            while not over:
                *_, terminal, timeout, _ = recorder.step(recorder.action_space.sample())
                over = terminal or timeout
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for k, name in enumerate(("a", "b", "c")):
        record(folder / f"{name}.mcap", 100 * k, 12)
    return folder


@pytest.fixture
def dataset(runs: Path) -> Dataset:
    return tupli_mcap.open(runs)


def ids(dataset: Dataset) -> list[str]:
    return [episode.id for episode in dataset]


def test_a_dataset_knows_its_spaces(dataset: Dataset, tmp_path: Path) -> None:
    env = gym.make("CartPole-v1")
    for some in (dataset, dataset.filter("return > 1e9"), dataset[3:4]):
        assert (some.observation_space, some.action_space) == (env.observation_space, env.action_space)
    with pytest.raises(RecordingError, match=r"lab'\) has no episode, so its spaces are not known"):
        _ = tupli_mcap.open(FileStorage(tmp_path / "lab")).action_space


def test_a_dataset_is_closed_like_a_file(runs: Path) -> None:
    def open_files() -> set[str]:
        links = Path("/proc/self/fd").iterdir()
        return {path.name for link in links if (path := Path(os.path.realpath(link))).parent == runs}

    with tupli_mcap.open(runs) as dataset:
        episode, other = dataset[0], dataset[20].id
        assert len(dataset.windows(2)[:3].states) == 3 and {"a.mcap", "b.mcap"} <= open_files()
    gc.collect()
    assert open_files() == {"a.mcap"}  # which the episode needs
    assert len(episode.states) == len(episode) and dataset[20].id == other  # opened again


def test_a_path_is_opened_by_open(runs: Path) -> None:
    with pytest.raises(TupliError, match=r"^tupli_mcap\.open\('.*a\.mcap'\) makes a dataset of it$"):
        Dataset(runs / "a.mcap")  # type: ignore[arg-type]


def test_everything_that_can_be_opened(runs: Path, tmp_path: Path) -> None:
    everything = ids(tupli_mcap.open(runs))
    assert len(everything) == 36
    assert ids(tupli_mcap.open(str(runs / "*.mcap"))) == everything
    assert ids(tupli_mcap.open([runs / "a.mcap", str(runs / "[bc].mcap")])) == everything
    assert ids(tupli_mcap.open([runs])) == everything
    assert ids(tupli_mcap.open([FileStorage(runs), runs / "a.mcap"])) == everything
    with pytest.raises(
        TupliError, match=r"found <Dataset .*; open a server by itself, and join datasets with \+"
    ):
        tupli_mcap.open([tupli_mcap.open(runs)])
    with pytest.raises(TupliError, match=r"found the server http://lab:8080; open a server by itself"):
        tupli_mcap.open(["http://lab:8080", runs])
    assert ids(tupli_mcap.open(FileStorage(runs))) == everything
    assert ids(tupli_mcap.open(runs / "a.mcap")) == everything[:12]
    with Recording(runs / "a.mcap") as recording:
        assert ids(tupli_mcap.open(recording)) == everything[:12]
        assert ids(tupli_mcap.open([recording, runs / "c.mcap"])) == [*everything[:12], *everything[24:]]
    dataset = tupli_mcap.open(runs)
    assert tupli_mcap.open(dataset) is dataset
    assert len(tupli_mcap.open(tmp_path)) == 0  # a directory without recordings
    assert list(runs.iterdir()) == [*sorted(runs.glob("*.mcap"))]  # looking writes nothing


def test_a_name_may_begin_with_a_tilde(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(runs / "a.mcap", "~a.mcap")
    assert len(tupli_mcap.open("~a.mcap")) == len(tupli_mcap.open(["~a.mcap"])) == 12
    with pytest.raises(TupliError, match=r"~b\.mcap does not exist"):
        tupli_mcap.open("~b.mcap")
    monkeypatch.setenv("HOME", str(runs))
    assert len(tupli_mcap.open("~/a.mcap")) == 12


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere.mcap", "nowhere.mcap does not exist; give a recording"),
        ("nowhere/", "nowhere does not exist; give a recording"),
        ("nowhere*.mcap", "no file matches"),
        (3, "expected a path, a pattern"),
        ([3], "expected paths, patterns"),
        ([], "expected at least one recording"),
    ],
)
def test_what_cannot_be_opened(source: Any, message: str) -> None:
    with pytest.raises(TupliError, match=message):
        tupli_mcap.open(source)


def test_a_file_object_has_no_place(runs: Path) -> None:
    with (
        (runs / "a.mcap").open("rb") as file,
        Recording(file) as recording,
        pytest.raises(TupliError, match="opened as a file object"),
    ):
        tupli_mcap.open(recording)


def test_seeds_of_any_size_are_compared_exactly(tmp_path: Path) -> None:
    seeds = [None, 3, 2**127 - 1, 2**127 - 2, 2**64]
    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "seeds.mcap") as env:
        for seed in seeds:
            env.reset(seed=seed)
            env.step(0)
    drawn = Recording(tmp_path / "seeds.mcap")[0].seed
    assert drawn is not None and drawn >= 2**64  # as NumPy draws them: it is a seed, too
    for opened in (tupli_mcap.open(tmp_path), tupli_mcap.open(FileStorage(tmp_path))):
        table = opened.to_pandas("episodes")
        assert table["seed"].tolist() == [drawn, *seeds[1:]]
        for seed in seeds[1:]:
            assert [episode.seed for episode in opened.filter(f"seed = {seed}")] == [seed]
        assert len(opened.filter(f"seed > {2**127 - 2} and seed < {2**127}")) == 1
        assert opened.sort("seed")[0].seed == 3


def test_an_index_gives_an_episode_or_a_dataset(dataset: Dataset) -> None:
    everything = ids(dataset)
    assert isinstance(dataset[3], Episode) and dataset[3].id == everything[3]
    assert dataset[-1].id == everything[-1]
    assert dataset[np.int64(5)].id == everything[5]
    assert ids(dataset[-5:]) == everything[-5:]
    assert ids(dataset[[30, 2, -1]]) == [everything[30], everything[2], everything[-1]]
    mask = dataset.lengths > 20
    assert ids(dataset[mask]) == np.array(everything)[mask].tolist()
    assert ids(dataset[10:20][::-2]) == everything[10:20][::-2]
    assert len(dataset[[]]) == 0
    for wrong in (36, -37, [36], [-37]):
        with pytest.raises(IndexError, match="expected"):
            dataset[wrong]  # type: ignore[call-overload]
    for odd in ("first", 1.5, [[1]], [[1], [2, 3]], None, [True, None]):
        with pytest.raises(TupliError, match="expected a number, a slice"):
            dataset[odd]  # type: ignore[call-overload]


def test_a_mask_may_be_of_pandas_and_has_a_flag_for_each_episode(dataset: Dataset) -> None:
    pandas = pytest.importorskip("pandas")
    table = dataset.to_pandas("episodes")
    assert ids(dataset[table["steps"] > 20]) == ids(dataset[dataset.lengths > 20])
    some = pandas.Series([True, pandas.NA, False] * 12, dtype="boolean")
    for mask in (some, some.array, some.fillna(False), some[::-1], some.sample(frac=1, random_state=0)):
        assert ids(dataset[mask]) == ids(dataset[::3]) == table[some]["id"].tolist()
    for wrong in ([True], some[:7], np.ones(37, bool)):
        with pytest.raises(TupliError, match=f"expected a mask of 36 episodes, found one of {len(wrong)}$"):
            dataset[wrong]
    with pytest.raises(TupliError, match="or a mask of 36 episodes"):
        dataset[some.astype(object)]  # as pandas refuses it


@pytest.mark.parametrize(
    ("text", "test"),
    [
        ("return > 20", lambda e: e.return_ > 20),
        ("steps > 20 and metadata.success", lambda e: len(e) > 20 and e.metadata["success"]),
        ("n_tuples > 20 or episode_return < 12", lambda e: len(e) > 20 or e.return_ < 12),
        ('metadata.side == "b"', lambda e: e.metadata["side"] == "b"),
        ('metadata.count in [1, 4] and not end == "timeout"', lambda e: e.metadata["count"] in (1, 4)),
        ("seed >= 200", lambda e: e.seed >= 200),
    ],
)
def test_filters_find_what_a_loop_finds(
    runs: Path, dataset: Dataset, text: str, test: Callable[[Episode], bool]
) -> None:
    wanted = [episode.id for episode in dataset if test(episode)]
    assert 0 < len(wanted) < 36
    assert ids(dataset.filter(text)) == wanted  # listed already
    assert (
        ids(tupli_mcap.open(runs).filter(text))
        == ids(tupli_mcap.open(FileStorage(runs)).filter(text))
        == wanted
    )
    assert ids(dataset.filter(test)) == wanted
    shuffled = dataset.sample(36, seed=1)
    assert sorted(ids(shuffled.filter(text))) == sorted(wanted)


def test_filters_narrow_one_after_the_other(runs: Path) -> None:
    dataset = tupli_mcap.open(runs)
    narrow = dataset.filter(F("return") > 15).filter('metadata.side == "b"').filter("metadata.success")
    assert "not listed yet" in repr(narrow)
    together = dataset.filter('return > 15 and metadata.side == "b" and metadata.success')
    assert 0 < len(narrow) < 12 and ids(narrow) == ids(together)
    assert len(dataset) == 36


@pytest.mark.parametrize("wrong", ["retrun > 3", "metdata.success", "n_steps == 3"])
def test_a_wrong_key_says_what_is_meant(dataset: Dataset, wrong: str) -> None:
    with pytest.raises(FilterError, match="did you mean"):
        dataset.filter(wrong)
    for some in (dataset, dataset[:0]):
        with pytest.raises(FilterError, match="did you mean"):
            some.sort(wrong.split()[0])


def test_a_wrong_attribute_says_what_is_meant(runs: Path, dataset: Dataset) -> None:
    episode = dataset[0]
    for thing, wrong, meant in (
        (dataset, "retruns", "returns"), (episode, "sates", "states"), (episode, "observation", "states"),
        (episode.recording, "episods", "episodes"), (episode.run, "nme", "name"), (dataset.read(), "action", "actions"),
        (episode.recording, "with_benchmark_filter", "filter"),
        (dataset, "length", "n_steps"), (dataset.windows(2)[0], "reward", "rewards"),
        (TupliDataset(FileStorage(runs)), "laod", "load"),
    ):  # fmt: skip
        with pytest.raises(AttributeError, match=rf"no attribute '{wrong}' \(did you mean '{meant}'\?\)"):
            getattr(thing, wrong)
    with pytest.raises(
        FilterError, match=r"unknown key 'return': it is of episodes, which filter\(\.\.\.\) of a"
    ):
        dataset.filter_steps("return > 3").read()
    with pytest.raises(IndexError, match="^an empty dataset has no episode 0$"):
        dataset[:0][0]
    with pytest.raises(
        TupliError, match="^expected values for the episodes, such as success=True, found none$"
    ):
        dataset.annotate()
    with pytest.raises(TupliError, match="^expected episodes to draw, found none"):
        dataset[:0].plot()
    for wrong, meant in (
        ("restore", "restore_episodes"),
        ("compact", "compact"),
        ("rename", "edit_runs"),
        ("check", "examine"),
        ("report", "plot"),
    ):
        with pytest.raises(AttributeError, match=rf"no attribute '{wrong}' \(.*{meant}\("):
            getattr(dataset, wrong)
    with pytest.raises(AttributeError, match="'_sates'$"):
        _ = episode._sates  # type: ignore[attr-defined]
    with pytest.raises(FilterError, match="did you mean 'name'"):
        dataset.split(0.5, by="run.nme")
    with pytest.raises(
        FilterError, match=r"no episode has run\.success \(did you mean 'metadata\.success'\?\)"
    ):
        dataset.sort("run.success")


def test_an_error_within_a_property_is_not_taken_for_a_wrong_name(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Dataset, "lengths", property(lambda ds: ds.headers.nothing))
    with pytest.raises(AttributeError, match="'ShortList' object has no attribute 'nothing'"):
        _ = dataset.lengths


def wanted_steps(dataset: Dataset) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Those that the tests below choose, found by a loop."""
    return np.array(
        [
            step.state[0] > 0 and (info["tag"] == 1 or number < 3)
            for episode in dataset
            for number, (step, info) in enumerate(zip(episode.tuples, episode.infos or (), strict=True))
        ]
    )


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize(
    "narrow",
    [
        lambda d: d.filter_steps("state[0] > 0 and (info.tag = 1 or step < 3)"),
        lambda d: d.filter_steps(F("states[0]") > 0).filter_steps((F("info.tag") == 1) | (F("step") < 3)),
        lambda d: d.filter_steps("info.tag = 1 or step < 3").filter_steps(lambda step: step.state[0] > 0),
    ],
)
def test_steps_are_chosen(runs: Path, narrow: Callable[[Dataset], Dataset], mixed: bool) -> None:
    whole = tupli_mcap.open(runs)
    if mixed:  # the episodes of a recording do not follow each other, and one is there twice
        whole = whole[[*np.random.default_rng(0).permutation(len(whole)), 4]]
    chosen, wanted, everything = narrow(whole), wanted_steps(whole), whole.read(["rewards", *FIELDS])
    assert 0 < wanted.sum() < len(wanted)
    assert len(chosen) == len(whole) and "before the filter of steps; steps where" in repr(chosen)
    for _ in range(2):  # the second time with what the first one has found
        found = chosen.read(FIELDS)
        for field in ("states", "next_states", "times"):
            np.testing.assert_array_equal(found[field], everything[field][wanted])
        assert found.infos == [everything.infos[i] for i in np.flatnonzero(wanted)]
    of = np.repeat(np.arange(len(whole)), whole.lengths)[wanted]
    np.testing.assert_array_equal(found.episode_lengths, np.bincount(of, minlength=len(whole)))
    np.testing.assert_array_equal(chosen.lengths, found.episode_lengths)
    assert chosen.n_steps == wanted.sum() and f"{wanted.sum():,} of {len(wanted):,} steps" in repr(chosen)
    np.testing.assert_array_equal(chosen.transitions()[:].states, found.states)
    runs_of_two = np.flatnonzero(
        wanted[1:] & wanted[:-1] & (np.diff(np.repeat(whole.lengths.cumsum(), whole.lengths)) == 0)
    )
    windows = chosen.windows(2, fields=["states", "info.tag"])
    np.testing.assert_array_equal(windows[:].states[:, 0], everything.states[runs_of_two])
    np.testing.assert_array_equal(
        windows[:].infos["tag"][:, 1], [everything.infos[i + 1]["tag"] for i in runs_of_two]
    )
    np.testing.assert_allclose(chosen.stats()["state"].mean, found.states.mean(axis=0), rtol=1e-5, atol=1e-7)


def test_chosen_steps_are_those_of_pytuplis_filter(runs: Path) -> None:
    torch, test = pytest.importorskip("torch"), "state[0] > 0 and step > 2"
    chosen = tupli_mcap.open(runs).filter_steps(test)
    tuples = TupliDataset.from_files(str(runs / "*.mcap")).with_tuple_filter(test)
    table, other = chosen.to_pandas(), tuples.convert_to_dataframe()
    for name in ("episode", "step", "reward"):
        assert table[name].tolist() == other[name if name != "reward" else "rewards"].tolist()
    assert chosen.steps.identity == tuples.steps.identity
    (batch,) = chosen.loader(length=2, batch_size=10_000, shuffle=False)
    assert torch.equal(batch["states"], torch.from_numpy(tuples.windows(2)[:].states))
    with Recording(runs / "b.mcap") as recording:
        assert (
            recording.filter_steps(test).n_steps
            == tupli_mcap.open(runs / "b.mcap").filter_steps(test).n_steps
        )
    # episodes are narrowed beside their steps, and stay whole
    best = chosen.filter("return > 20").sort("return", descending=True).head(3)
    assert ids(best) == ids(tupli_mcap.open(runs).sort("return", descending=True).head(3))
    assert len(best[0]) > best.lengths[0] == len(best.head(1).read().rewards)
    assert best.to_pandas("episodes")["steps"].tolist() == [len(episode) for episode in best]


def test_an_empty_choice_of_steps(dataset: Dataset) -> None:
    with pytest.warns(UserWarning, match=r"no step has info.tga \(did you mean 'info.tag'\?\)"):
        none = dataset.filter_steps("info.tga > 1")
        assert none.n_steps == 0
    assert none.read().states.shape == (0, 4) and len(none.to_pandas()) == 0
    assert not none.lengths.any() and len(none) == len(none.lengths) == 36
    with pytest.raises(TupliError, match="found an empty dataset"):
        none.windows(1)
    with pytest.raises(TupliError, match="expected steps to take statistics of, found none"):
        none.stats()


def test_what_needs_whole_episodes_refuses_chosen_steps(dataset: Dataset, tmp_path: Path) -> None:
    chosen = dataset.filter_steps("reward > 0")
    for ask in (
        lambda: chosen.save(tmp_path / "new.mcap"),
        lambda: chosen.map(lambda episode: episode.rewards, tmp_path / "new.mcap"),
        lambda: chosen.trim(slice(1, None), tmp_path / "new.mcap"),
        lambda: chosen.annotate(success=True),
        lambda: chosen.head(2).delete(),
        lambda: chosen.plot(),
        lambda: chosen + dataset,
        lambda: dataset + chosen,
    ):
        with pytest.raises(
            TupliError, match=r"expected whole episodes, found <Dataset .*steps where .*reward"
        ):
            ask()
    for wrong in ("return > 3", "sate > 1", 3):
        with pytest.raises(FilterError, match="unknown key|expected a function of one tuple"):
            dataset.filter_steps(wrong)  # type: ignore[arg-type]
    assert len(tupli_mcap.open(dataset)) == 36 and not list(tmp_path.iterdir())


def test_keys(dataset: Dataset) -> None:
    keys = dataset.keys
    assert {"return", "steps", "ended", "end", "seed", "metadata.success", "metadata.side"} <= set(keys)
    assert not {"episode_return", "n_tuples", "created_at"} & set(keys)


def test_keys_can_be_written_in_filters(tmp_path: Path) -> None:
    odd = ["a b.c", "x y", "ä-1", '"', ""]
    with tupli_mcap.RecordEpisodes(
        gym.make("CartPole-v1"), tmp_path / "r.mcap", metadata=dict.fromkeys(odd, 1)
    ) as env:
        env.reset()
        env.step(0)
    dataset = tupli_mcap.open(tmp_path)
    keys = [key for key in dataset.keys if "metadata" in key]
    assert {'run.metadata."a b.c"', 'run.metadata."x y"', "run.metadata.ä-1"} < set(keys)
    for key in keys:
        assert len(dataset.filter(f"{key} = 1")) == len(dataset.sort(key)) == len(dataset.split(1, by=key)[0])
    with pytest.raises(FilterError, match=r"did you mean 'run\.metadata\.\"a b\.c\"'\?"):
        dataset.sort('metadata."a b.c"')
    with pytest.raises(FilterError, match=r"did you mean '\"a b\.c\"'\?"):
        dataset.sort("run.metadata.a b.c")


def test_keys_of_values_in_dicts(tmp_path: Path) -> None:
    settings = {"opt": {"lr": 1e-3, "v1.0": 2}, "algo": "ppo"}
    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", metadata=settings) as env:
        roll(env, 5)
    dataset = tupli_mcap.open(tmp_path)
    found = [key for key in dataset.keys if key.startswith("run.metadata.")]
    assert found == ["run.metadata.algo", 'run.metadata.opt."v1.0"', "run.metadata.opt.lr"]
    assert set(found) < set(dataset.to_pandas("episodes"))
    with pytest.raises(FilterError, match=r"no episode has run\.metadata\.opt\.lrr \(did you mean 'lr'\?\)"):
        dataset.filter("run.metadata.opt.lrr < 1")
    with pytest.raises(FilterError, match=r"did you mean 'run\.metadata\.opt\.lr'\?"):
        dataset.sort("metadata.opt.lr")


def test_sort_keeps_equal_ones_in_order(dataset: Dataset) -> None:
    for descending in (False, True):
        found = dataset.sort("metadata.side", descending=descending)
        sides = [episode.metadata["side"] for episode in found]
        assert sides == sorted(sides, reverse=descending)
        assert [e.number for e in found] == [*range(12)] * 3
    returns = dataset.sort("return", descending=True).returns
    assert (np.diff(returns) <= 0).all()
    assert ids(dataset.sort(lambda episode: episode.seed)) == ids(dataset.sort("seed"))


def test_what_has_no_value_comes_last(dataset: Dataset) -> None:
    def value(episode: Episode) -> float | None:
        return {0: None, 1: float("nan")}.get(episode.number, float(-episode.number))

    for descending in (False, True):
        numbers = [episode.number for episode in dataset[:12].sort(value, descending=descending)]
        assert numbers[-2:] == [0, 1]
        assert numbers[:-2] == sorted(range(2, 12), reverse=not descending)
    with pytest.raises(TupliError, match=r"write sort\('return', descending=True\)"):
        dataset.sort("-return")
    with pytest.raises(TupliError, match="cannot sort"):
        dataset.sort(lambda episode: episode.number if episode.env else "text" if episode.number else 1)


def test_head_and_sample(dataset: Dataset) -> None:
    assert ids(dataset.head(3)) == ids(dataset)[:3]
    assert len(dataset.head(100)) == 36
    assert ids(dataset.head()) == ids(dataset)[:5]
    one, same, other = dataset.sample(9, seed=1), dataset.sample(9, seed=1), dataset.sample(9, seed=2)
    assert ids(one) == ids(same) != ids(other)
    assert len(set(ids(one))) == 9
    for wrong in (-1, 1.5, True, "3"):
        with pytest.raises(TupliError, match="expected a number of episodes"):
            dataset.head(wrong)  # type: ignore[arg-type]


def test_a_split_stays_when_episodes_are_added(runs: Path, dataset: Dataset) -> None:
    train, test = dataset.split(0.7, seed=3)
    assert sorted(ids(train) + ids(test)) == sorted(ids(dataset))
    assert 15 < len(train) < 34
    few, others = tupli_mcap.open([runs / "a.mcap", runs / "c.mcap"]).split(0.7, seed=3)
    assert set(ids(few)) <= set(ids(train)) and set(ids(others)) <= set(ids(test))
    assert ids(dataset.split(0.7, seed=4)[0]) != ids(train)
    assert len(dataset.split(1.0)[1]) == len(dataset.split(0.0)[0]) == 0
    with pytest.raises(TupliError, match="expected a fraction .*; for three parts, split one of two again"):
        dataset.split([0.8, 0.1, 0.1])  # type: ignore[arg-type]
    with pytest.raises(TupliError, match="expected a fraction"):
        dataset.split(1.5)


@pytest.mark.filterwarnings("ignore:all episodes are on one side")  # ids of runs are random
@pytest.mark.parametrize("by", ["run", "metadata.side", "metadata.count"])
def test_a_split_keeps_together_what_belongs_together(dataset: Dataset, by: str) -> None:
    def value(episode: Episode) -> Any:
        return episode.recording.uuid if by == "run" else episode.metadata[by.partition(".")[2]]

    sides = [{value(episode) for episode in part} for part in dataset.split(0.5, seed=1, by=by)]
    assert not sides[0] & sides[1]
    assert len(sides[0] | sides[1]) == (12 if by == "metadata.count" else 3)


@pytest.mark.parametrize("seed", range(4))
def test_reading_gives_the_episodes_in_their_order(dataset: Dataset, seed: int) -> None:
    found = dataset.sample(10, seed=seed)
    columns = found.read(
        ["states", "actions", "rewards", "terminals", "timeouts", "next_states", "times", "infos"]
    )
    assert columns.episode_lengths.tolist() == [len(episode) for episode in found]
    first = 0
    for episode in found:
        steps = slice(first, first + len(episode))
        for field in ("states", "actions", "rewards", "terminals", "timeouts", "next_states"):
            assert np.array_equal(getattr(columns, field)[steps], getattr(episode, field))
        assert (np.diff(columns.times[steps]) >= 0).all()
        assert columns.infos[steps] == [info or {} for info in episode.infos or []]
        first += len(episode)
    assert found.n_steps == first == len(columns)


def test_no_episode_has_no_steps(dataset: Dataset, tmp_path: Path) -> None:
    none = dataset.filter("steps > 100000")
    assert len(none) == none.n_steps == len(none.read()) == 0
    assert (none.read().states.shape, none.read().states.dtype) == ((0, 4), np.float32)
    assert none.to_pandas("episodes").empty and none.to_pandas().empty
    assert list(none.to_pandas()) == list(dataset.head(1).to_pandas().drop(columns=OWN))
    assert len(tupli_mcap.open(tmp_path).read()) == 0  # of no recording at all


def test_gymnasiums_names(dataset: Dataset) -> None:
    columns = dataset[:3].read(["observations", "terminations", "truncations", "next_observations"])
    episode = dataset[0]
    n = len(episode)
    assert np.array_equal(columns.observations[:n], episode.observations)
    assert np.array_equal(columns.terminations[:n], episode.terminations)
    assert np.array_equal(columns.truncations[:n], episode.truncations)
    assert np.array_equal(columns.next_observations[:n], episode.next_observations)
    assert episode.observations is episode.states and columns.actions is None
    assert episode.final_observation is episode.final_state
    step = episode[-1]
    assert (step.terminated, step.truncated) == (step.terminal, step.timeout) == (True, False)
    assert np.array_equal(step.observation, step.state)
    assert len(dataset.filter("truncated")) == 0 and len(dataset.filter("not truncated")) == len(dataset)
    for ended in ("terminal", "terminations", "terminated"):
        assert len(dataset.filter(ended)) == len(dataset)
    for cut in ("timeout", "truncations", "timeouts = true"):
        assert len(dataset.filter(cut)) == 0
    windows = dataset.windows(4, fields=["observations", "rewards"])
    assert windows[0].states.shape == (4, 4)
    for wrong in ("rewrads", "observatoins", "x"):
        with pytest.raises(TupliError, match="expected fields from"):
            dataset.read(wrong)
        with pytest.raises(TupliError, match="expected fields from"):
            episode.recording.read(fields=[wrong])
        with pytest.raises(TupliError, match="expected fields from"):
            dataset.windows(4, fields=[wrong])
    with pytest.raises(TupliError, match="expected fields from rewards, .*, found 'terminations'$"):
        dataset.map(lambda e: e.terminals, "x.mcap", fields=["terminations"])
    with pytest.raises(TupliError, match="did you mean .rewards."):
        dataset.read("rewrads")


def test_columns_are_found_by_name_as_in_a_dict(dataset: Dataset) -> None:
    columns = dataset.read(["states", "rewards"])
    assert columns["states"] is columns["observations"] is columns.states
    assert [*columns.asdict()] == ["episode_lengths", "states", "rewards"]
    assert "observations" in columns and "actions" not in columns
    with pytest.raises(TypeError, match="not iterable"):
        list(columns)
    assert columns["state"] is columns["observation"] is columns.states
    for name in ("actions", "sates"):
        with pytest.raises(KeyError, match=f"expected one of .*states, rewards, found '{name}'"):
            columns[name]


def test_ipython_completes_the_names_of_columns(dataset: Dataset) -> None:
    columns, window = dataset.read(["states", "rewards"]), dataset.windows(4)[0]
    completer = IPCompleter(namespace={"columns": columns, "window": window}, use_jedi=False)
    with provisionalcompleter():
        for text, wanted in (('columns["s', {"states"}), ('window["', set(window.asdict()))):
            assert {found.text for found in completer.completions(text, len(text))} == wanted


def test_windows_and_transitions_stay_within_episodes(dataset: Dataset) -> None:
    found = dataset.filter("steps > 12").sample(6, seed=2)
    windows, columns = found.windows(8), found.read()
    ends = np.cumsum(columns.episode_lengths)
    starts = [
        s for end, n in zip(ends, columns.episode_lengths, strict=True) for s in range(end - n, end - 7)
    ]
    assert len(windows) == len(starts)
    for i, start in enumerate(starts):
        assert np.array_equal(windows[i].states, columns.states[start : start + 8])
    assert len(found.transitions()) == found.n_steps


def test_a_loader_in_one_call(dataset: Dataset) -> None:
    pytest.importorskip("torch")
    loader = dataset.loader(length=8, batch_size=16, fields=["states", "actions"], seed=1)
    first, again = (
        next(iter(loader)),
        next(iter(dataset.loader(length=8, batch_size=16, fields=["states"], seed=1))),
    )
    assert first["states"].shape == (16, 8, 4) and first["actions"].shape == (16, 8)
    assert (first["states"] == again["states"]).all()
    in_order = next(iter(dataset.loader(batch_size=5, shuffle=False)))
    assert np.array_equal(in_order["states"].numpy(), dataset[0].states[:5])
    for wrong, length, said in (
        ("batch", 3, r"'batch' \(did you mean 'batch_size'\?\)"),
        ("stride", None, "'stride': it needs a length"),
        ("n_step", 3, "'n_step': it is of single transitions"),
    ):
        with pytest.raises(TypeError, match=r"^loader\(\) got an unexpected argument " + said):
            dataset.loader(length=length, **{wrong: 3})


def test_statistics_are_those_of_numpy(dataset: Dataset) -> None:
    states = dataset.read(["states"]).states.astype(np.float64)
    found = dataset.stats()
    assert len(repr(found)) < 800
    assert set(found) == {"state", "action", "reward"}
    state = found["state"]
    assert found["states"] is found["observations"] is state and "observation" in found
    assert state.count.tolist() == [len(states)] * 4
    np.testing.assert_allclose(state.mean, states.mean(axis=0), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(state.std, states.std(axis=0), rtol=1e-6)
    assert np.array_equal(state.min, states.min(axis=0)) and np.array_equal(state.max, states.max(axis=0))
    for q, values in state.quantiles.items():
        np.testing.assert_allclose(values, np.quantile(states, q, axis=0), rtol=1e-6, atol=1e-9)
    assert found["rewards"].mean.shape == ()
    assert np.array_equal(dataset.stats(["observations"])["states"].mean, state.mean)
    with pytest.raises(TupliError, match="found none"):
        dataset.head(0).stats()


def test_pandas(dataset: Dataset) -> None:
    pytest.importorskip("pandas")
    found = dataset.sample(5, seed=1)
    steps, episodes, columns = found.to_pandas(), found.to_pandas("episodes"), found.read()
    assert len(steps) == found.n_steps and len(episodes) == 5
    names = [name for name in steps if str(name).startswith("state")]
    assert len(names) == 4
    assert np.array_equal(steps[names].to_numpy(), columns.states)
    assert np.array_equal(steps["reward"], columns.rewards)
    assert steps.groupby("episode")["reward"].sum().tolist() == episodes["return"].tolist()
    assert steps.groupby("episode")["step"].max().tolist() == (episodes["steps"] - 1).tolist()
    assert episodes["id"].tolist() == ids(found)
    assert episodes["metadata.side"].tolist() == [episode.metadata["side"] for episode in found]
    assert set(steps["id"]) == set(ids(found))
    assert episodes["run.id"].tolist() == [episode.run.id for episode in found]
    assert [str(time) for time in episodes["run.started"]] == [
        episode.run.started.replace("T", " ") for episode in found
    ]
    assert set(episodes["run.environment"]) == {"CartPole-v1"}
    infos = [info or {} for episode in found for info in episode.infos or []]
    assert steps["info.tag"].tolist() == [info["tag"] for info in infos]
    with pytest.raises(TupliError, match="expected the level"):
        found.to_pandas("rows")  # type: ignore[arg-type]


def test_a_time_that_a_table_cannot_hold_is_missing(tmp_path: Path) -> None:
    """`run.json` of a file from elsewhere may say anything as the start of the run."""
    pytest.importorskip("pandas")
    said = (
        "2026-11-23T03:31:07+01:00",
        "2026-11-23",
        "2261-12-31",
        "9999-01-01",
        "0001-01-01",
        "soon",
        "2026-13-01",
    )
    space = gym.spaces.Discrete(2)
    for i, started in enumerate(said):
        run = json.dumps({"runs": [{"id": str(i), "started": started}]}).encode()
        attachments = {"run.json": ("application/json", run)}
        with tupli_mcap.EpisodeWriter(
            tmp_path / f"{i}.mcap", space, space, attachments=attachments
        ) as writer:
            writer.begin()
            writer.step(0, 0, 0.0, True)
    started = tupli_mcap.open(tmp_path).to_pandas("episodes")["run.started"]
    assert [str(time) for time in started[:3]] == [
        "2026-11-23 02:31:07+00:00",
        "2026-11-23 00:00:00+00:00",
        "2261-12-31 00:00:00+00:00",
    ]
    assert started[3:].isna().all()


@pytest.mark.skipif(sys.platform == "darwin", reason="its file systems take no such names")
def test_a_table_of_files_with_names_of_any_bytes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    path = tmp_path / os.fsdecode(b"r\xf6hre.mcap")
    with tupli_mcap.EpisodeWriter(path, SPACE, SPACE) as writer:
        writer.begin()
        writer.step(SPACE.sample(), SPACE.sample(), 0.0, True)
    found = tupli_mcap.open(path)
    assert found.to_pandas("episodes")[["recording", "run"]].to_numpy().tolist() == [[str(path), path.stem]]
    assert found.to_pandas()["run"].tolist() == [path.stem]
    assert found.to_arrow("episodes").num_rows == found.to_arrow().num_rows == 1


def test_whole_numbers_of_a_table_stay_whole(tmp_path: Path) -> None:
    for name, metadata in (("a", {"n": 2**60 + 1}), ("b", {})):
        with tupli_mcap.RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / f"{name}.mcap", metadata=metadata
        ) as env:
            env.reset()
            env.step(0)
    table = tupli_mcap.open(tmp_path).to_pandas("episodes")
    assert table["run.metadata.n"].dropna().tolist() == [2**60 + 1]
    assert table["run.metadata.n"].isna().tolist() == [False, True]


def test_metadata_in_dicts_are_columns_named_as_in_filters(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    options = {"opt": {"lr": 1e-3, "v1.0": {"betas": [0.9, 0.99]}}, "empty": {}}
    with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", SPACE, SPACE, metadata=options) as writer:
        for metadata in ({"goal": {"x": 1, "near": True}}, {"goal": {"x": 2}}, {"goal": "none"}):
            writer.begin(metadata=metadata)
            writer.step([0], [0], 1.0, True)
    dataset = tupli_mcap.open(tmp_path)
    table = dataset.to_arrow("episodes").to_pydict()
    wanted = {
        "run.metadata.opt.lr": [1e-3] * 3,
        'run.metadata.opt."v1.0".betas': [[0.9, 0.99]] * 3,
        "metadata.goal.x": [1, 2, None],
        "metadata.goal.near": [True, None, None],
        "metadata.goal": [None, None, "none"],
    }
    assert {name: column for name, column in table.items() if "metadata" in name} == wanted
    assert {name for name in dataset.to_pandas() if "metadata" in name} == {*wanted} - {*list(wanted)[:2]}
    for key, (first, _, last) in wanted.items():
        assert isinstance(first, list) or len(dataset.filter(F(key) == (first or last))) > 0


def test_tables_have_no_columns_of_what_is_left_out(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", SPACE, SPACE) as writer:
        for key, reward in (("a", 1.0), ("b", 2.0)):
            writer.begin(metadata={key: 1, "both": reward})
            writer.step([0], [0], reward, True, info={key: 1})
    dataset = tupli_mcap.open(tmp_path)
    for found in (dataset.filter("return > 1"), dataset[1:], dataset.filter_steps("reward > 1")):
        own = {name for name in found.to_pandas() if "metadata" in name or "info" in name}
        assert own == {"info.b", "metadata.b", "metadata.both"}
        table = found.to_arrow()
        assert own <= {*table.column_names} and table["metadata.both"].to_pylist() == [2.0]
        assert table["episode"].to_pylist() == [len(found) - 1]


def test_flags_that_only_some_episodes_have_are_nullable(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", SPACE, SPACE) as writer:
        for success in (True, None, np.False_):
            writer.begin(metadata={} if success is None else {"success": success, "all": True})
            for _ in range(2):
                writer.step([0], [0], 1.0, info={} if success is None else {"touches": success})
            writer.end([0])
    dataset = tupli_mcap.open(tmp_path)
    episodes, steps = dataset.to_pandas("episodes"), dataset.to_pandas()
    for table, name in ((episodes, "metadata.success"), (steps, "metadata.success"), (steps, "info.touches")):
        column = table[name]
        assert column.dtype == "boolean" and column.mean() == 0.5
        assert column.isna().sum() == len(table) / 3
        assert column.fillna(False).sum() == len(table[column]) == len(table) / 3
        assert (~column).sum() == len(table) / 3
    assert dataset.sort("episode")[[0, 2]].to_pandas("episodes")["metadata.all"].dtype == bool
    pytest.importorskip("pyarrow")
    assert dataset.to_arrow("episodes")["metadata.success"].to_pylist() == [True, None, False]


@pytest.mark.parametrize("missing", ["pandas", "pyarrow"])
def test_the_extra_of_arrow_is_named(dataset: Dataset, monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"needs pandas and pyarrow: pip install .*\[arrow\]"):
        dataset.to_arrow()


def test_arrow(dataset: Dataset) -> None:
    pytest.importorskip("pyarrow")
    table = dataset.head(2).to_arrow("episodes")
    assert table.column("steps").to_pylist() == dataset.head(2).lengths.tolist()


@pytest.mark.parametrize("which", ["return > 20", 'metadata.side == "a"'])
def test_saving_keeps_what_belongs_to_the_episodes(dataset: Dataset, which: str, tmp_path: Path) -> None:
    chosen = dataset.filter(which)
    target = chosen.save(tmp_path / "sub" / "good.mcap")
    saved = tupli_mcap.open(target)
    assert len(saved) == len(chosen) and saved.n_steps == chosen.n_steps
    by_seed = {episode.seed: episode for episode in chosen}
    for episode in saved:
        source = by_seed[episode.seed]
        assert np.array_equal(episode.states, source.states)
        assert episode.metadata == source.metadata and episode.infos == source.infos
    with pytest.raises(TupliError, match="exists"):
        chosen.save(target)
    assert len(tupli_mcap.open(chosen.head(1).save(target, overwrite=True))) == 1
    assert sorted(path.name for path in target.parent.iterdir()) == ["good.mcap"]
    with pytest.raises(TupliError, match="found none"):
        chosen.head(0).save(tmp_path / "none.mcap")


def test_a_pickled_copy_reads_the_same(dataset: Dataset) -> None:
    found = dataset.sample(4, seed=1)
    assert np.array_equal(found.steps.read(["rewards"], np.arange(3))["rewards"], found.read().rewards[:3])
    copy = pickle.loads(pickle.dumps(found))
    assert ids(copy) == ids(found)
    assert np.array_equal(copy.read().states, found.read().states)
    assert np.array_equal(copy.steps.read(["rewards"], np.arange(9))["rewards"], found.read().rewards[:9])


def test_what_is_shown_is_short(runs: Path) -> None:
    dataset = tupli_mcap.open(runs)
    assert len(repr(dataset)) < 200 and "not listed yet" in repr(dataset)
    shown = dataset._repr_html_()
    assert (
        "36 episodes" in shown
        and f"<td>{dataset[0].run.name}</td><td>{dataset.headers[0].recording}</td>" in shown
    )
    assert "36 episodes" in repr(dataset)


def test_lists_are_shown_by_their_first_entries(dataset: Dataset) -> None:
    headers, tuples = dataset.headers, dataset[0].tuples
    assert repr(headers) == f"[{', '.join(map(repr, list(headers[:3])))}, … (36 in all)]"
    assert repr(tuples).endswith(f"… ({len(dataset[0])} in all)]") and len(repr(tuples)) < 1000
    assert repr(headers[:2]) == repr(list(headers[:2])) and isinstance(headers, list)
    assert repr(dataset[0].recording.file) == f"<OpenFile {str(dataset[0].recording.path)!r}: 5 channels>"


def test_success_is_a_key(dataset: Dataset, runs: Path) -> None:
    good = dataset.filter("metadata.success")
    for test in ("success", "success == true", F("success"), "success != false"):
        assert ids(dataset.filter(test)) == ids(good)
        assert [header.id for header in TupliDataset(runs).with_episode_filter(test).preview()] == ids(good)
    assert {episode.success for episode in dataset.sort("success", descending=True)[: len(good)]} == {True}
    assert len(dataset.filter("success = null")) == 0 and "success" in dataset.keys
    assert dataset.headers[0].success is dataset[0].success is True
    with pytest.raises(
        FilterError, match="'success' is true or false or null: expected such a value, found 'no'"
    ):
        dataset.filter("success = 'no'")


def test_a_key_by_itself_is_a_flag(dataset: Dataset, runs: Path) -> None:
    good = dataset.filter("metadata.success")
    assert 0 < len(good) < len(dataset)
    assert ids(dataset.filter(F("metadata.success"))) == ids(good)
    assert dataset.filter_steps(F("terminal")).n_steps == len(dataset)
    chosen = TupliDataset(runs).with_episode_filter(F("metadata.success"))
    assert [header.id for header in chosen.preview()] == ids(good)


@pytest.mark.parametrize(
    ("test", "told"),
    [
        ("state > 1", 'names no element: name one of them: state."Cart Position", '),
        ("state.Pole > 1", "names no element (did you mean 'state.\"Pole Angle\"'?): name one"),
        ("observation.x > 1", 'name one of them: observation."Cart Position", '),
        ("state.Pole Angle > 1", 'a name with a blank is put in quotes: state."Pole Angle"'),
        ("state[9] > 1", "have state[0] to state[3]"),
    ],
)
def test_a_key_of_no_element_names_those_there_are(dataset: Dataset, test: str, told: str) -> None:
    with pytest.raises(FilterError, match=re.escape(told)):
        dataset.filter_steps(test).read()


def test_a_header_says_what_an_episode_says(dataset: Dataset) -> None:
    header, episode = dataset.headers[3], dataset[3]
    assert (header.steps, header.return_) == (episode.n_steps, episode.return_)
    told = (
        f"<EpisodeHeader 3 of {header.recording}: {header.steps} steps, return {header.return_:g}, terminal>"
    )
    assert repr(header) == str(header) == told


def test_an_episode_gives_pytuplis_tuples(dataset: Dataset) -> None:
    episode = dataset[2]
    wanted = tupli_mcap.TupliDataset(episode.recording.path.parent).episodes[2]  # type: ignore[union-attr]
    assert episode.tuples == wanted.tuples
    assert ids(dataset)[2] == wanted.id


def test_a_recording_does_what_a_dataset_does(runs: Path) -> None:
    dataset = tupli_mcap.open(runs / "a.mcap")
    with Recording(runs / "a.mcap") as recording:
        assert recording[3] == dataset[3] and recording[-1] == dataset[-1]
        assert [episode.id for episode in recording] == ids(recording.dataset) == ids(dataset)
        for narrow in (
            lambda x: x.filter("return > 20"),
            lambda x: x.sort("return", descending=True),
            lambda x: x.head(3),
            lambda x: x.sample(4, seed=2),
            lambda x: x.split(0.5, seed=1)[0],
            lambda x: x[2:9:3],
            lambda x: x[x.returns > 20],
            lambda x: x + x[:2],
        ):
            assert ids(narrow(recording)) == ids(narrow(dataset))
        assert (recording.n_steps, recording.keys) == (dataset.n_steps, dataset.keys)
        assert np.array_equal(recording.lengths, dataset.lengths)
        assert np.array_equal(
            recording.windows(5, stride=2)[3].states, dataset.windows(5, stride=2)[3].states
        )
        assert np.array_equal(recording.transitions(2, 0.9)[4].states, dataset.transitions(2, 0.9)[4].states)
        assert recording.stats()["rewards"].count == dataset.n_steps
        around = {"state": [-1, 0]}
        assert np.array_equal(
            recording.delta_windows(around)[5]["state"], dataset.delta_windows(around)[5]["state"]
        )
        assert recording.headers == dataset.headers
        assert np.array_equal(recording.episode_values(F("steps")), dataset.lengths)
        assert len(recording.with_cache(1 << 20).windows(5)) == len(dataset.windows(5))
        of_dataset = recording.dataset._repr_html_()
        assert recording._repr_html_() == of_dataset.replace("<p>Dataset of", "<p>Recording of") != of_dataset
    with (runs / "a.mcap").open("rb") as file, Recording(file) as recording:
        assert recording[3] == dataset[3] and "12 episodes" in recording._repr_html_()
        with pytest.raises(TupliError, match="open it by its path or URL"):
            recording.head(3)


def test_the_dataset_of_a_tupli_dataset(runs: Path, tmp_path: Path) -> None:
    chosen = TupliDataset(runs).with_episode_filter("return > 20").with_tuple_filter("step >= 3")
    made = tupli_mcap.open(chosen)
    wanted = tupli_mcap.open(runs).filter("return > 20").filter_steps("step >= 3")
    assert ids(made) == ids(wanted) and np.array_equal(made.read().states, wanted.read().states)
    assert len(made.loader(length=3)) == len(wanted.loader(length=3))
    saved = TupliDataset(runs).with_episode_filter("return > 20").dataset.save(tmp_path / "s.mcap")
    assert (Recording(saved).made_of or {})["query"] == "return > 20"


@pytest.mark.parametrize(
    ("of", "name", "hint"),
    [
        (tupli_mcap, "vecotr", "did you mean 'vector'?"),
        (tupli_mcap, "opne", "did you mean 'open'?"),
        (tupli_mcap, "load_dataset", "did you mean 'open'?"),
        (tupli_mcap, "merge", "did you mean 'merge_recordings'?"),
        (None, "best", "sort('return', descending=True).head(5) has the best five episodes"),
        (None, "total_episodes", "len(dataset) counts its episodes"),
        (None, "len", "len(dataset) counts its episodes"),
        (None, "select", "filter('return > 100') chooses episodes"),
        (None, "env_id", "each episode's run has it: [episode.run.environment for episode in dataset]"),
        (None, "push", "save() it, then TupliAPIClient(url).push(path) sends the file"),
        (None, "to_csv", "to_pandas('steps').to_csv(path) writes a row for each step"),
        (None, "with_tuple_filter", "filter_steps('reward > 0') chooses steps"),
        (None, "runs", "each episode has its run: [episode.run for episode in dataset]"),
        (None, "episodes", "it is a sequence of them: dataset[3], for episode in dataset"),
        (None, "to_polars", "to_arrow() gives a table for pyarrow, Polars, DuckDB"),
        (None, "train_test_split", "split(0.8, seed=0) gives the training and the test episodes"),
        (Episode, "tags", "run.tags has those of its run, metadata what was noted about it"),
        (Episode, "total_reward", "return_ is the sum of its rewards"),
        (Episode, "plot", "a dataset has it, of one episode too: dataset[3:4].plot()"),
        (Episode, "env_id", "run.environment is the id of its environment"),
        (Recording, "sequences", "windows(8) has sequences of 8 steps"),
        (TupliDataset, "loader", "its dataset has it: .dataset.loader"),
    ],
)
def test_a_missing_name_says_what_to_take(of: Any, name: str, hint: str, runs: Path) -> None:
    dataset = tupli_mcap.open(runs)
    things = {
        None: dataset,
        Episode: dataset[0],
        Recording: dataset.example,
        TupliDataset: TupliDataset(runs),
    }
    of = things.get(of, of)
    with pytest.raises(AttributeError, match=rf"no attribute '{name}' \({re.escape(hint)}\)"):
        getattr(of, name)


def test_a_recording_changes_as_a_dataset_does(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 0, 3)
    with Recording(path) as recording:
        recording.annotate(success=True, episodes=7)
        assert all(episode.success and episode.metadata["episodes"] == 7 for episode in recording)
        with pytest.raises(TupliError, match="expected values for the episodes"):
            recording.annotate()
        recording.save_columns(tmp_path / "columns")
        assert len(open_columns(tmp_path / "columns").steps) == recording.n_steps
        assert recording.delete(dry_run=True) == 3
        assert all(episode.success for episode in tupli_mcap.open(path))
        assert recording.delete() == 3
    assert len(tupli_mcap.open(path)) == 0


def test_the_episodes_of_two_datasets(runs: Path, tmp_path: Path) -> None:
    every = tupli_mcap.open(runs)
    a, b = every.filter('metadata.side == "a"'), tupli_mcap.open(runs / "b.mcap")
    joined = a + b
    assert ids(joined) == ids(a) + ids(b)
    assert ids(joined + a.head(3)) == ids(joined)
    assert ids(joined.sort("return")) != ids(joined)
    assert np.array_equal(joined.read().states, np.concatenate([a.read().states, b.read().states]))
    assert np.array_equal(pickle.loads(pickle.dumps(joined)).read().rewards, joined.read().rewards)
    assert len(tupli_mcap.open(joined.save(tmp_path / "joined.mcap"))) == len(joined)
    parts = tupli_mcap.open(runs / "a.mcap")[5:] + tupli_mcap.open(runs / "a.mcap")[:5]
    assert ids(parts) == ids(a[5:]) + ids(a[:5])
    with pytest.raises(TypeError, match="unsupported operand"):
        a + 3  # type: ignore[operator]


def test_different_recordings_of_one_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for seed, folder in enumerate(("one", "two")):
        (tmp_path / folder).mkdir()
        monkeypatch.chdir(tmp_path / folder)
        found.append(tupli_mcap.open(record(Path("r.mcap"), seed, 2)).head(2))
        assert len(found[-1]) == 2
    with pytest.raises(TupliError, match="different recordings called 'r.mcap'"):
        found[0] + found[1]


def test_the_working_directory_may_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    for seed, folder in enumerate((one, two)):
        folder.mkdir()
        record(folder / "r.mcap", seed, 2)
    monkeypatch.chdir(one)
    datasets = [tupli_mcap.open(place) for place in ("r.mcap", ".", "*.mcap", ["r.mcap"])]
    with Recording("r.mcap") as recording:
        expected = recording.read().states
        monkeypatch.chdir(two)
        recording.annotate(good=True)
        assert recording.name == "r.mcap"
    for dataset in datasets:
        assert {header.recording for header in dataset.headers} == {"r.mcap"}
        assert all(episode.metadata["good"] for episode in dataset)
        assert np.array_equal(dataset.read().states, expected)
    assert datasets[0].head(1).delete() == 1
    assert [len(tupli_mcap.open(folder)) for folder in (one, two)] == [1, 2]


def test_what_a_notebook_shows_of_an_episode(dataset: Dataset) -> None:
    shown = dataset[0]._repr_html_()
    assert f"<td>{dataset[0].return_:g}</td>" in shown
    episode = dataset[0]
    episode.__dict__["metadata"] = {"side": "<script>"}
    assert "<script>" not in episode._repr_html_() and "&lt;script&gt;" in episode._repr_html_()


def test_a_step_callback_is_told_the_sub_environment(tmp_path: Path) -> None:
    envs = gym.make_vec("CartPole-v1", 3, "sync")
    callback = lambda step: {"env": step.env, "unpacked": len(step)}  # noqa: E731
    with tupli_mcap.vector.RecordEpisodes(envs, tmp_path / "r.mcap", step_callback=callback) as recorder:
        recorder.reset(seed=1)
        for _ in range(40):
            recorder.step(recorder.action_space.sample())
    found = [(episode.env, info) for episode in tupli_mcap.open(tmp_path) for info in episode.infos or []]
    assert {env for env, _ in found} == {0, 1, 2}
    assert all(info == {"env": env, "unpacked": 6} for env, info in found)


def test_what_was_saved_beside_its_source_hides_nothing(tmp_path: Path) -> None:
    """Episodes keep their ids: those that are in both files count once."""
    record(tmp_path / "run.mcap", 1, 6)
    tupli_mcap.open(tmp_path / "run.mcap").head(2).save(tmp_path / "best.mcap")
    with pytest.warns(UserWarning, match=r"best.mcap holds 2 episodes of .*run.mcap again; they"):
        assert len(tupli_mcap.open(tmp_path)) == 6


def test_a_directory_may_hold_other_files(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", 1, 3)
    (tmp_path / "other.mcap").write_bytes(b"not this")
    with pytest.warns(UserWarning, match=r"other\.mcap.*; it is left out"):
        assert len(tupli_mcap.open(tmp_path)) == 3
    with pytest.raises(TupliError, match="other.mcap"):
        len(tupli_mcap.open(tmp_path / "*.mcap"))


def test_what_is_being_recorded_is_there_as_far_as_it_has_come(tmp_path: Path) -> None:
    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap") as env:
        env.reset(seed=1)
        env.step(0)
        env.step(1)
        for source in (tmp_path, tmp_path / "run.mcap", [tmp_path]):
            (episode,) = tupli_mcap.open(source)
            assert (len(episode), episode.end) == (2, "interrupted")


def test_metadata_that_no_episode_has(dataset: Dataset, runs: Path) -> None:
    for text in ("metadata.sucess", "metadata.sucess > 3", 'metadata.side == "a" and metadata.sucess'):
        for each in (dataset, tupli_mcap.open(runs), tupli_mcap.open(FileStorage(runs))):
            with pytest.raises(
                FilterError, match=r"no episode has metadata.sucess \(did you mean 'success'\?\)"
            ):
                len(each.filter(text))
    with pytest.raises(FilterError, match=r"no episode has metadata.sucess"):
        dataset.sort("metadata.sucess")
    assert len(dataset.filter("metadata.count > 1000")) == 0


@pytest.mark.parametrize("looked_at", [False, True])
@pytest.mark.parametrize("stored", [False, True])
def test_what_only_episodes_left_out_have_is_known(
    runs: Path, tmp_path: Path, looked_at: bool, stored: bool
) -> None:
    shutil.copy(runs / "a.mcap", tmp_path)
    first, *others = tupli_mcap.open(tmp_path)
    first.annotate(checked=7)
    rest = tupli_mcap.open(FileStorage(tmp_path) if stored else tmp_path).filter(f"id != '{first.id}'")
    assert not looked_at or len(rest) == len(others)
    assert len(rest.filter("metadata.checked > 5")) == 0
    assert len(rest.sort("metadata.checked")) == len(rest.split(1, by="metadata.checked")[0])
    typed = rest.filter("not metadata.chekced")
    assert not looked_at or len(typed) == len(others)
    with pytest.raises(FilterError, match=r"no episode has metadata.chekced \(did you mean 'checked'\?\)"):
        len(typed.filter("steps > 100000"))


def test_steps_of_an_episode(dataset: Dataset) -> None:
    episode = dataset[1]
    steps = list(episode)
    for i in (0, 3, -1):
        assert np.array_equal(episode[i].state, steps[i].state)
        assert episode[i][1:] == steps[i][1:]
    with pytest.raises(IndexError, match="expected a step from 0 to"):
        episode[len(episode)]
    with pytest.raises(TupliError, match="expected a step's number or a slice"):
        episode["states"]  # type: ignore[call-overload]


def test_an_episode_is_the_same_however_it_was_opened(dataset: Dataset, runs: Path) -> None:
    again = tupli_mcap.open(runs / "b.mcap")
    assert again[2] == dataset[14] != dataset[15]
    assert again[2] in list(dataset) and len({again[2], dataset[14]}) == 1


def test_statistics_that_the_caller_changes(dataset: Dataset) -> None:
    scale = dataset.stats()["state"]
    scale.std[scale.std < 1] = 1  # so that a constant value can be divided by it
    scale.quantiles[0.5][:] = 0
    again = dataset.stats()["state"]
    assert (again.std < 1).any() and again.quantiles[0.5].any()


def test_statistics_of_what_follows_have_a_name_of_their_own(dataset: Dataset) -> None:
    found = dataset.stats(["states", "next_states"])
    assert set(found) == {"state", "next_state"}
    next_states = dataset.read(["next_states"]).next_states
    np.testing.assert_allclose(
        found["next_states"].mean, next_states.mean(axis=0, dtype=np.float64), rtol=1e-6
    )
    for field in ("terminals", "times"):
        with pytest.raises(TupliError, match="expected fields from states, actions, rewards, next_states"):
            dataset.stats([field])


def test_what_cannot_be_saved_there(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(TupliError, match="is a directory; give the path of a file"):
        dataset.save(tmp_path)
    with pytest.raises(TupliError, match="is a directory; give the path of a file"):
        dataset.save(f"{tmp_path}/new/")
    assert not (tmp_path / "new").exists()
    copy = dataset.head(5).save(tmp_path / "copy.mcap")
    with pytest.raises(TupliError, match="is one of the recordings themselves"):
        tupli_mcap.open(copy).head(1).save(copy, overwrite=True)
    assert len(tupli_mcap.open(copy)) == 5


def test_tables_fit_each_other(dataset: Dataset) -> None:
    pytest.importorskip("pandas")
    found = dataset.sort("return", descending=True).head(4)
    steps, episodes = found.to_pandas(), found.to_pandas("episodes")
    joined = steps.merge(episodes, on="episode", suffixes=("", "_of_episode"))
    assert len(joined) == found.n_steps
    assert (joined["id"] == joined["id_of_episode"]).all()
    assert episodes["seed"].tolist() == [episode.seed for episode in found]
    assert str(episodes["seed"].dtype) == "Int64"


def test_images_and_large_arrays_come_to_arrow(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    space = gym.spaces.Dict(
        {
            "cam": gym.spaces.Box(0, 255, (4, 5, 3), np.uint8),
            "depth": gym.spaces.Box(0, 9, (16, 32, 1)),
            "x": gym.spaces.Box(-1, 1, (2,)),
        }
    )
    with tupli_mcap.RecordEpisodes(Sampler(space, gym.spaces.Discrete(2)), tmp_path / "r.mcap") as env:
        roll(env, 12)
    dataset = tupli_mcap.open(tmp_path)
    table = dataset.to_arrow()
    cams = dataset.read(["states"]).states["cam"]
    assert np.array_equal(np.array(table.column("state.cam").to_pylist(), np.uint8), cams)
    assert str(table.schema.field("state.cam").type.value_type.value_type.value_type) == "uint8"
    frame = dataset.to_pandas()
    assert len([name for name in frame if "state" in name]) == 4
    assert np.array_equal(np.stack(list(frame["state.depth"])), dataset.read().states["depth"])
    assert frame["state.depth"][0].shape == (16, 32, 1)
    found = dataset.stats()
    assert set(found) == {"state.depth", "state.x", "action", "reward"}
    assert found["observations.x"] is found["states.x"] is found["state.x"]
    with pytest.raises(KeyError, match=r"found 'state.dept' \(did you mean 'state.depth'\?\)"):
        found["state.dept"]


def test_columns_without_a_common_type_come_to_arrow_as_json(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with tupli_mcap.EpisodeWriter(
        tmp_path / "r.mcap", gym.spaces.Discrete(2), gym.spaces.Discrete(2)
    ) as writer:
        for seed, fact in ((2**63, 1), (3, "x")):
            writer.begin(seed=seed, metadata={"fact": fact, "large": 2**64})
            writer.step(0, 0, 1.0, True, info={"fact": fact, "map": np.zeros((seed % 3 + 1, 2))})
    dataset = tupli_mcap.open(tmp_path)
    episodes = dataset.to_arrow("episodes").to_pydict()
    assert episodes["seed"] == ["9223372036854775808", "3"]
    assert (
        episodes["metadata.fact"] == ["1", '"x"']
        and episodes["metadata.large"] == ["18446744073709551616"] * 2
    )
    steps = dataset.to_arrow().to_pydict()
    assert steps["info.fact"] == ["1", '"x"']
    assert [len(value) for value in steps["info.map"]] == [2**63 % 3 + 1, 1]


def test_what_arrow_has_no_type_for_comes_as_json(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    values = {"complex": 1j, "array": np.array([1j, 2]), "text": "a\ud800", "wide": np.longdouble(0.5)}
    text = gym.spaces.Text(2, charset="a\ud800")
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", text, gym.spaces.Discrete(2)) as writer:
        for _ in range(2):
            writer.begin(metadata=values)
            writer.step("a\ud800", 0, 1.0, True, info=values)
    dataset = tupli_mcap.open(tmp_path)
    assert (
        dataset.to_pandas()["info.text"].tolist() == dataset.to_pandas()["state"].tolist() == ["a\ud800"] * 2
    )
    for table in (dataset.to_arrow().to_pydict(), dataset.to_arrow("episodes").to_pydict()):
        own = {name.rpartition(".")[2]: column for name, column in table.items() if column[0] == column[1]}
        assert [loads(value) for value in own["complex"]] == [1j, 1j]
        assert loads(own["array"][0]).tolist() == [1j, 2] and loads(own["text"][1]) == "a\ud800"
        assert float(own["wide"][0]) == 0.5


def test_an_empty_leaf_has_statistics(tmp_path: Path) -> None:
    space = gym.spaces.Box(0, 1, (2, 0), np.float32)
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", space, gym.spaces.Discrete(2)) as writer:
        writer.begin()
        writer.step(np.zeros((2, 0), np.float32), 1, 1.0, True)
    assert tupli_mcap.open(tmp_path).stats()["states"].mean.shape == (2, 0)


def test_a_fraction_of_numpy_and_values_that_have_no_order(dataset: Dataset) -> None:
    assert [each.n_steps for each in dataset.split(np.float64(0.5))] == [
        each.n_steps for each in dataset.split(0.5)
    ]
    with pytest.raises(TupliError, match="cannot sort by"):
        dataset.sort(lambda episode: np.array([1, 2]))


def test_tensors_are_recorded_as_arrays(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    value = torch.tensor([0.125, -1 / 3], requires_grad=True)
    with tupli_mcap.RecordEpisodes(
        gym.make("CartPole-v1"), tmp_path / "r.mcap", step_callback=lambda step: {"logp": value}
    ) as env:
        env.reset(seed=1)
        env.step(0)
    (info,) = tupli_mcap.open(tmp_path)[0].infos or []
    assert info is not None and np.array_equal(info["logp"], value.detach().numpy())


@pytest.mark.parametrize(
    ("name", "episode", "step", "window"),
    [
        ("obs", "states", "state", "states"),
        ("act", "actions", "action", "actions"),
        ("acts", "actions", "action", "actions"),
        ("rews", "rewards", "reward", "rewards"),
        ("dones", "terminals", "terminal", "terminals"),
    ],
)
def test_names_of_other_libraries_are_understood_well_enough_to_name_ours(
    runs: Path, name: str, episode: str, step: str, window: str
) -> None:
    dataset = tupli_mcap.open(runs)
    first = dataset[0]
    for item, meant in ((first, episode), (next(iter(first)), step), (dataset.windows(2)[0], window)):
        with pytest.raises(AttributeError, match=rf"no attribute '{name}' \(did you mean '{meant}'\?\)"):
            getattr(item, name)
    with pytest.raises(
        AttributeError, match=rf"no attribute '{name}' \(read\(\) gives .*: read\(\).{episode}\)"
    ):
        getattr(dataset, name)
    for read in (dataset.read, dataset.transitions):
        with pytest.raises(TupliError, match=rf"found '{name}' \(did you mean '{episode}'\?\)"):
            read(fields=[name])
    with pytest.raises(TupliError, match=rf"found '{name}' \(did you mean '{step}'\?\)"):
        dataset.delta_windows({name: [0]})


def test_fields_of_items_have_gymnasium_s_names_too(dataset: Dataset) -> None:
    states = dataset.windows(3)[0].states
    assert np.array_equal(dataset.windows(3)[0].observations, states)
    transition = dataset.transitions()[0]
    assert np.array_equal(transition.next_observations, transition.next_states)
    around = dataset.delta_windows({"observations": [0, 1, 2], "action": [0], "truncations": [0]})[0]
    assert list(around.values) == ["observations", "action", "truncations"]
    assert np.array_equal(around["observations"], states)
    assert np.array_equal(dataset.delta_windows({"observation": [0]})[0]["observation"], states[:1])
    assert np.array_equal(dataset.delta_windows({"state": [0]})[0]["observations"], states[:1])
    with pytest.raises(KeyError, match="expected one of observations, action, truncations, found 'reward'"):
        around["reward"]
    assert "rewards: 1.0; " in repr(transition) and "terminals: False" in repr(transition)
    assert "states: float32 (3, 4)" in repr(dataset.windows(3)[0]) and len(repr(around)) < 500


def test_another_recording_of_the_same_name_is_not_taken_for_the_listed_one(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 0, 3)
    dataset, opened = tupli_mcap.open(path), tupli_mcap.open(path)[0]
    assert len(dataset) == 3
    path.unlink()
    record(path, 7, 3)
    with pytest.raises(tupli_mcap.RecordingError, match="is another recording now; open it again"):
        opened.annotate(success=True)
    for use in (
        lambda: dataset[0],
        lambda: list(dataset),
        lambda: dataset.read(),
        lambda: dataset.windows(2),
        lambda: dataset.save(tmp_path / "s.mcap"),
        lambda: dataset.map(lambda episode: episode.rewards, tmp_path / "s.mcap"),
        lambda: dataset.trim(slice(1), tmp_path / "s.mcap"),
        lambda: dataset.filter(lambda episode: True),
        lambda: dataset.plot(),
    ):
        with pytest.raises(tupli_mcap.TupliError, match=r"another recording was listed.* open it again"):
            use()
    assert not (tmp_path / "s.mcap").exists()
    assert len(Recording(path).annotations.said) == 0


def test_what_is_gone_is_not_left_out_silently(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 0, 4)
    dataset = tupli_mcap.open(path)
    windows, listed = pickle.dumps(dataset.windows(2)), pickle.dumps(dataset)
    tupli_mcap.open(path)[[3]].delete()
    FileStorage(tmp_path).compact()
    dataset = pickle.loads(listed)  # which opens the file anew
    for use in (
        lambda: dataset[3],
        lambda: [episode.seed for episode in dataset],
        lambda: dataset.save(tmp_path / "s.mcap"),
        lambda: dataset[[3]].save(tmp_path / "s.mcap"),
    ):
        with pytest.raises(tupli_mcap.TupliError, match="episode 3 was listed, but is missing"):
            use()
    assert [episode.seed for episode in dataset[:3]] == [0, 1, 2]
    with pytest.raises(tupli_mcap.TupliError, match="was written anew: the file was changed afterwards"):
        pickle.loads(windows)[0]


def test_equal_values_of_other_types_stay_on_one_side(tmp_path: Path) -> None:
    for k, value in enumerate((1, 1.0)):
        with tupli_mcap.EpisodeWriter(tmp_path / f"{k}.mcap", SPACE, SPACE) as writer:
            writer.begin(metadata={"task": value})
            writer.step(np.zeros(1, np.float32), np.zeros(1, np.float32), 0.0)
    dataset = tupli_mcap.open(tmp_path)
    for seed in range(8):
        with pytest.warns(UserWarning, match=r"all episodes are on one side of split\(by='metadata.task'\)"):
            assert {len(part) for part in dataset.split(0.5, seed=seed, by="metadata.task")} == {0, 2}


def test_what_chose_the_episodes_is_noted_where_they_were_listed_before(runs: Path, tmp_path: Path) -> None:
    dataset = tupli_mcap.open(runs)
    assert len(dataset)
    saved = dataset.filter("seed < 200").filter("return > 0").save(tmp_path / "s.mcap")
    made = Recording(saved).made_of
    assert made is not None
    assert (made["how"], made["query"]) == ("filter", "seed < 200; return > 0")


def has_steps(episode: Episode) -> bool:
    return len(episode) > 0


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize("one", [False, True])
def test_all_that_chose_the_episodes_is_noted_in_order(
    listed: bool, one: bool, runs: Path, tmp_path: Path
) -> None:
    dataset = tupli_mcap.open(sorted(runs.rglob("*.mcap"))[0] if one else runs)
    if listed:
        assert len(dataset)
    first, second, third = F("steps") > 0, F("return") > 0, F("episode") >= 0

    def noted(chosen: Dataset) -> tuple[str, str | None]:
        made = Recording(chosen.save(tmp_path / "s.mcap", overwrite=True)).made_of
        assert made is not None
        return made["how"], made.get("query")

    narrowed = dataset.filter(first).sort("return", descending=True).filter(second)
    words = "steps > 0; sort: return, descending; return > 0"
    assert noted(narrowed) == ("filter", words)
    assert noted(narrowed.filter(has_steps).head(9)[:-1]) == (
        "filter",
        f"{words}; filter: {__name__}.has_steps; head: 9; index: [:-1]",
    )
    assert noted(narrowed.sample(3, seed=0).filter(third)) == (
        "filter",
        f"{words}; sample: 3, seed 0; episode >= 0",
    )
    told = CliRunner().invoke(app, ["info", str(tmp_path / "s.mcap")]).output
    assert f"by filter ({words}; sample: 3, seed 0; episode >= 0" in " ".join(told.split())
    assert noted(dataset[[1, 2]]) == ("filter", "index: [1, 2]")
    assert noted(dataset.split(0.5, seed=3)[0]) == ("filter", "split: 0.5, seed 3, first part")
    either = dataset.filter(first).head(1) + dataset.filter(second)
    assert noted(either) == ("filter", "(steps > 0; head: 1) + (return > 0)")
    assert noted(dataset.head(2) + dataset) == ("filter", "(head: 2) + (all)")
    assert noted(dataset) == ("filter" if one else "merge", None)


def test_two_continued_copies_are_told_apart(tmp_path: Path) -> None:
    first, second = record(tmp_path / "a.mcap", 0, 2), tmp_path / "b.mcap"
    shutil.copy(first, second)
    for path, seed in ((first, 10), (second, 20)):
        with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
            env.reset(seed=seed)
            env.step(0)
    with pytest.warns(
        UserWarning,
        match=r"b.mcap \(3 episodes, \d+ steps\) and .*a.mcap \(.*\) are copies of one recording, but .*both "
        r"went on; .*: 3 episodes of .*b.mcap left out; open it by itself",
    ):
        assert tupli_mcap.open(tmp_path).headers[-1].seed == 10
    assert tupli_mcap.open(second).headers[-1].seed == 20


@pytest.mark.parametrize("names", ["ab", "ba"])
def test_a_whole_recording_counts_before_a_copy_that_was_cut_off(tmp_path: Path, names: str) -> None:
    whole, cut = (tmp_path / f"{name}.mcap" for name in names)
    with tupli_mcap.EpisodeWriter(whole, SPACE, SPACE, chunk_size=1000) as writer:
        for seed in range(4):
            writer.begin(seed=seed)
            for i in range(50):
                writer.step(np.zeros(1, np.float32), np.zeros(1, np.float32), 1.0, i == 49)
            writer.end()
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    with pytest.warns(UserWarning, match="was not finished and has no journal"):
        part = tupli_mcap.open(cut).headers
    assert 1 < len(part) < 4 and part[-1].end == "interrupted"
    with (
        pytest.warns(UserWarning, match="no journal"),
        pytest.warns(UserWarning, match="left out") as warned,
    ):
        headers = tupli_mcap.open(tmp_path).headers
    assert {(header.recording, header.end, header.n_tuples) for header in headers} == {
        (str(whole), "terminal", 50)
    }
    (said,) = (str(one.message) for one in warned if "left out" in str(one.message))
    assert (
        said.startswith(f"{cut} ({len(part)} episodes, ") and f" and {whole} (4 episodes, 200 steps)" in said
    )
    assert "one was cut off" in said and f"{len(part)} episodes of {cut} left out" in said


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda dataset: tupli_mcap.open(""), "found an empty text"),
        (lambda dataset: tupli_mcap.EpisodeWriter("", SPACE, SPACE), "found an empty text"),
        (lambda dataset: dataset.split(0.5, by=3), "expected by=KEY"),
        (lambda dataset: dataset.sample(1, seed=-1), "expected a seed that is an integer from 0"),
        (lambda dataset: dataset.sample(1, seed=1.5), "expected a seed that is an integer from 0"),  # type: ignore[arg-type]
        (lambda dataset: dataset.split(0.5, seed=None), "expected a seed that is an integer from 0"),  # type: ignore[arg-type]
        (lambda dataset: dataset.loader(seed=2**70), "a seed of at most"),
        (lambda dataset: dataset.loader(num_workers=-1), "a number of workers that is an integer from 0"),
        (lambda dataset: dataset[[0, 0, 1]].save("twice.mcap"), "expected each episode once"),
        (lambda dataset: dataset.loader(batch_size=1.5), "a batch size that is an integer from 1"),
    ],
)
def test_what_means_nothing_is_one_error(dataset: Dataset, ask: Callable[[Dataset], Any], said: str) -> None:
    with pytest.raises(TupliError, match=said):
        ask(dataset)
    assert len(next(iter(dataset.loader(batch_size=np.int64(4), seed=np.int64(4))))["rewards"]) == 4


def test_a_recording_beside_those_it_was_made_of_is_named(tmp_path: Path) -> None:
    for name in "ab":
        record(tmp_path / f"{name}.mcap", 0, 2)
    tupli_mcap.open(tmp_path / "a.mcap").trim(slice(0, 3), tmp_path / "trimmed.mcap")
    with pytest.warns(
        UserWarning, match=r"trimmed.mcap was made of .*a.mcap, and both are here: .* count twice; unless"
    ):
        assert len(tupli_mcap.open(tmp_path)) == 6
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(tupli_mcap.open([tmp_path / "b.mcap", tmp_path / "trimmed.mcap"])) == 4


def test_of_a_recording_and_its_filtered_copy_the_recording_is_named_as_the_source(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", 0, 3)
    source = tupli_mcap.open(tmp_path / "a.mcap")
    source[:2].save(tmp_path / "chosen.mcap")
    source.trim(slice(0, 3), tmp_path / "trimmed.mcap")
    names = [tmp_path / f"{name}.mcap" for name in ("a", "chosen", "trimmed")]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert len(tupli_mcap.open(names)) == 6
    texts = [str(one.message) for one in said]
    assert any(f"trimmed.mcap was made of {names[0]}, and both are here" in text for text in texts), texts


def test_numbers_of_infos_keep_their_digits_in_tables(tmp_path: Path) -> None:
    with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", SPACE, SPACE) as writer:
        writer.begin()
        for value in (np.int64(2**60 + 1), None, 2**60 + 3):
            info = {} if value is None else {"id": value, "wave": 1 + 2j}
            writer.step([0], [0], reward=0.0, info=info, timeout=value == 2**60 + 3)
        writer.end([0])
    dataset = tupli_mcap.open(tmp_path)
    table = dataset.to_pandas()
    assert table["info.id"].dtype == "Int64" and table["info.id"].dropna().tolist() == [2**60 + 1, 2**60 + 3]
    assert table["info.wave"].tolist() == [1 + 2j, None, 1 + 2j]
    assert dataset.to_arrow()["info.id"].to_pylist() == [2**60 + 1, None, 2**60 + 3]
    assert dataset.to_arrow()["info.wave"].to_pylist()[1] is None


def test_reprs_are_short(tmp_path: Path) -> None:
    image = spaces.Dict(
        {"camera": spaces.Box(0, 255, (48, 48, 3), np.uint8), "joints": spaces.Box(-1, 1, (2,))}
    )
    with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", image, SPACE) as writer:
        writer.begin()
        for _ in range(2):
            writer.step(image.sample(), SPACE.sample(), 1.0, False, False)
        writer.end(image.sample())
        assert repr(writer) == f"<EpisodeWriter of '{tmp_path}/run.mcap'>"
    assert repr(writer).endswith("run.mcap': closed>")
    dataset = tupli_mcap.open(tmp_path / "run.mcap")
    (drawn,) = TupliDataset.from_files(tmp_path / "run.mcap").sample_episodes(1)
    assert "RLTuple" not in repr(drawn) + str(drawn)
    dataset[0].annotate(success=True)
    (step, _), (item, _) = dataset[0], dataset[0].tuples
    for shown in (repr(step), repr(item), str(item)):
        assert "'camera': <uint8 (48, 48, 3)>, 'joints': array([" in shown and "reward=1.0" in shown
        assert len(shown) < 300 and "\n" not in shown
    assert (
        repr(dataset.steps)
        == repr(TupliDataset.from_files(tmp_path / "run.mcap").steps)
        == "<2 steps of 1 episode>"
    )
    assert repr(Recording(tmp_path / "run.mcap").annotations) == "<1 annotation of 1 episode>"
    TupliDataset.from_files(tmp_path / "run.mcap").save_columns(tmp_path / "columns")
    assert repr(tupli_mcap.dataset.open_columns(tmp_path / "columns").steps) == "<2 steps of 1 episode>"


def test_a_recorded_nan_is_not_missing_in_arrow(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    space = gym.spaces.Dict({"x": gym.spaces.Box(-9, 9, (1,)), "depth": gym.spaces.Box(0, 9, (501,))})
    nan = {"x": np.full(1, np.nan, np.float32), "depth": np.full(501, np.nan, np.float32)}
    infos = [{"force": np.nan, "list": [np.nan, 1.0]}, {"force": 1.5}, {}]
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", space, gym.spaces.Discrete(2)) as writer:
        for metadata in ({"score": np.nan}, {}):
            writer.begin(metadata=metadata)
            for i, info in enumerate(infos):
                writer.step(nan, 0, np.nan if i else 1.0, info=info)
            writer.end()
    dataset = tupli_mcap.open(tmp_path)
    table = dataset.to_arrow()
    missing = {name: table[name].null_count for name in table.column_names}
    assert {name: count for name, count in missing.items() if count} == {
        "seed": 6, "info.force": 2, "info.list": 4, "metadata.score": 3,
    }  # fmt: skip
    for name in ("state.x[0]", "state.depth"):
        assert np.isnan(table[name].to_pylist()).all()
    assert np.isnan(table["reward"].to_pylist()).tolist() == [False, True, True] * 2
    assert str(table["info.force"].to_pylist()) == "[nan, 1.5, None, nan, 1.5, None]"
    assert str(table["info.list"][0].as_py()) == "[nan, 1.0]"
    assert str(dataset.to_arrow("episodes")["metadata.score"].to_pylist()) == "[nan, None]"
    frame = dataset.to_pandas()
    assert frame["info.force"].dtype == frame["metadata.score"].dtype == np.float64
    assert frame["info.force"].isna().sum() == 4


@pytest.mark.parametrize(
    ("test", "found"),
    [
        ("= 8", "8"),
        ("!= 8", "9n"),
        ("< 9", "8"),
        (">= 0", "89"),
        ("in [8]", "8"),
        ("not in [8]", "9nm"),
        ("= null", "n"),
    ],
)
def test_null_is_a_value_and_a_missing_one_is_not(tmp_path: Path, test: str, found: str) -> None:
    """A seed that an episode does not have is null; metadata that it does not have are missing."""
    with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", SPACE, SPACE) as writer:
        for seed, metadata in ((8, {"x": 8}), (9, {"x": 9}), (None, {"x": None}), (None, {})):
            writer.begin(seed=seed, metadata=metadata)
            writer.step(np.zeros(1, np.float32), np.zeros(1, np.float32), 0.0, terminal=True)
            writer.end()
    dataset = tupli_mcap.open(tmp_path)
    for lazily in (True, False):
        if not lazily:
            assert len(dataset) == 4
        assert [e.episode for e in dataset.filter(f"metadata.x {test}").headers] == [
            "89nm".index(c) for c in found
        ]
        of_seed = found.replace("m", "") + ("m" if "n" in found else "")
        assert [e.episode for e in dataset.filter(f"seed {test}").headers] == [
            "89nm".index(c) for c in of_seed
        ]


@pytest.mark.parametrize("change", [lambda ds: ds.annotate(good=True), lambda ds: ds.undo_annotation()])
def test_a_recording_that_took_the_place_of_another_is_not_annotated(
    change: Callable[[Dataset], object], tmp_path: Path
) -> None:
    path = record(tmp_path / "r.mcap", 0, 3)
    listed = tupli_mcap.open(path)
    assert len(listed) == 3
    shutil.move(record(tmp_path / "other.mcap", 0, 3), path)
    tupli_mcap.open(path).annotate(note="mine")
    with pytest.raises(NotFoundError, match="another recording was listed"):
        change(listed)
    assert [episode.metadata.get("note") for episode in tupli_mcap.open(path)] == ["mine"] * 3
    assert not any("good" in episode.metadata for episode in tupli_mcap.open(path))


def test_an_array_of_values_is_not_noted_with_each_episode(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 0, 3)
    dataset = tupli_mcap.open(path)
    with pytest.raises(
        RecordingError, match="^big: expected one value for all episodes, found an array of 3"
    ):
        dataset.annotate(big=dataset.returns > 20)
    assert not any("big" in episode.metadata for episode in tupli_mcap.open(path))
    dataset[:1].annotate(goal=np.array([5.0]))  # of one episode, it is the same
    dataset.annotate(goal=np.arange(2.0))
    assert [episode.metadata["goal"] for episode in dataset] == [[0.0, 1.0]] * 3
