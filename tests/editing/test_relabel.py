"""Recordings with other rewards or actions, and what a recording says that it was made of."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
from environments import Sampler, same
from golden_files import NAMES, place
from gymnasium import spaces
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import EpisodeWriter, RecordEpisodes, Recording, RecordingError, StepError, jsonvalue
from tupli_mcap.cli.app import app
from tupli_mcap.dataset import DatasetError
from tupli_mcap.recording import (
    merge_recordings,
    recover_recording,
    say_made_of,
    split_recording,
    verify_recording,
)
from tupli_mcap.recording.edit.merge import Excerpt
from tupli_mcap.recording.edit.relabel import relabel_excerpts
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes

SCHEMA = Path(__file__).parents[2] / "schemas" / "made_of.schema.json"


def record(path: Path, seeds: int = 4, env: Any = None, **options: Any) -> Path:
    with RecordEpisodes(env or gym.make("CartPole-v1"), path, chunk_size=500, **options) as recorded:
        recorded.action_space.seed(1)
        for seed in range(seeds):
            recorded.reset(seed=seed)
            ended = False
            while not ended:
                _, _, terminal, timeout, _ = recorded.step(recorded.action_space.sample())
                ended = terminal or timeout
    return path


def test_rewards_change_and_all_else_stays(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", record_info=True, name="ppo", metadata={"lr": 1})
    ds = tupli_mcap.open(source)
    ds[1].annotate(good=True)
    new = tupli_mcap.open(source).map(lambda episode: np.arange(len(episode)) - 0.5, tmp_path / "new.mcap")
    before, after = Recording(source), Recording(new)
    for old, made in zip(before.episodes, after.episodes, strict=True):
        np.testing.assert_array_equal(made.rewards, np.arange(len(old)) - 0.5)
        assert made.return_ == sum(np.arange(len(old)) - 0.5)
        for name in ("states", "actions", "terminals", "timeouts", "next_states"):
            np.testing.assert_array_equal(getattr(made, name), getattr(old, name))
        assert (made.seed, made.metadata, made.end, made.start_time, made.infos) == (
            old.seed, old.metadata, old.end, old.start_time, old.infos,
        )  # fmt: skip
        assert made.run == old.run
    np.testing.assert_array_equal(after.read(fields=["times"]).times, before.read(fields=["times"]).times)
    assert after.uuid != before.uuid
    assert verify_recording(new).ok
    said = after.made_of
    jsonschema.validate(said, json.loads(SCHEMA.read_text()))
    assert said is not None
    assert (said["how"], said["fields"], said["sources"][0]["uuid"]) == ("map", ["rewards"], before.uuid)
    assert "test_rewards_change_and_all_else_stays" in said["function"]
    assert "made of" in CliRunner().invoke(app, ["info", str(new)]).output


def test_actions_and_rewards_of_some_episodes_of_several_recordings(tmp_path: Path) -> None:
    paths = [record(tmp_path / f"{i}.mcap", name=f"w{i}") for i in range(2)]
    ds = tupli_mcap.open(paths).filter("seed >= 2")
    new = ds.map(
        lambda episode: {"actions": 1 - episode.actions, "rewards": episode.rewards * 2},
        tmp_path / "deep" / "new.mcap",
        fields=["actions", "rewards"],
    )
    after = tupli_mcap.open(new)
    assert len(after) == 4
    np.testing.assert_array_equal(after.read().actions, 1 - ds.read().actions)
    np.testing.assert_array_equal(after.returns, 2 * ds.returns)
    assert [episode.run.name for episode in after] == ["w0", "w0", "w1", "w1"]
    said = Recording(new).made_of
    assert said is not None
    assert (said["how"], said["query"], said["fields"]) == ("map", "seed >= 2", ["actions", "rewards"])
    assert [Path(one["name"]).name for one in said["sources"]] == ["0.mcap", "1.mcap"]
    assert verify_recording(new).ok


def test_the_function_sees_the_episodes_of_the_sources(tmp_path: Path) -> None:
    paths = [record(tmp_path / f"{i}.mcap", name=f"w{i}") for i in range(2)]
    seen = []

    def same_rewards(episode: Any) -> Any:
        seen.append(episode.id)
        return episode.rewards

    ds = tupli_mcap.open(paths).filter("seed != 0")
    ds.map(same_rewards, tmp_path / "new.mcap")
    assert seen == [episode.id for episode in ds]


def test_of_a_vector_environment_with_a_dict_of_actions(tmp_path: Path) -> None:
    class Arm(gym.Env[Any, Any]):
        observation_space = spaces.Box(-1, 1, (2,), np.float32)
        action_space = spaces.Dict(grip=spaces.Discrete(2), joint=spaces.Box(-1, 1, (3,), np.float32))
        t = 0

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            self.t = 0
            return np.zeros(2, np.float32), {}

        def step(self, action: Any) -> Any:
            self.t += 1
            return np.full(2, self.t / 10, np.float32), 1.0, self.t == 4, False, {}

    env = gym.vector.SyncVectorEnv([Arm] * 2)
    with RecordVectorEpisodes(env, tmp_path / "v.mcap") as recorded:
        recorded.reset(seed=0)
        recorded.action_space.seed(0)
        for _ in range(15):
            recorded.step(recorded.action_space.sample())

    def still(episode: Any) -> Any:
        return {**episode.actions, "joint": np.zeros_like(episode.actions["joint"])}

    new = tupli_mcap.open(tmp_path / "v.mcap").map(still, tmp_path / "n.mcap", fields=["actions"])
    before, after = tupli_mcap.open(tmp_path / "v.mcap").read(), tupli_mcap.open(new).read()
    assert not after.actions["joint"].any()
    np.testing.assert_array_equal(after.actions["grip"], before.actions["grip"])
    np.testing.assert_array_equal(after.states, before.states)
    assert verify_recording(new).ok


def test_of_steps_that_differ_in_size(tmp_path: Path) -> None:
    space = spaces.Dict(
        note=spaces.Text(30), see=spaces.Box(0, 255, (4, 4, 3), np.uint8), x=spaces.Box(-1, 1, (2,))
    )
    actions = spaces.Tuple([spaces.Text(9), spaces.Discrete(3)])
    source = record(tmp_path / "r.mcap", env=Sampler(space, actions))
    before = tupli_mcap.open(source)
    new = before.map(lambda episode: np.arange(len(episode)) * 2.0, tmp_path / "rewards.mcap")
    after = tupli_mcap.open(new)
    np.testing.assert_array_equal(after[1].rewards, np.arange(7) * 2.0)
    assert after.returns.tolist() == [42.0] * 4
    assert same(after.read().states, before.read().states)
    assert same(after.read().actions, before.read().actions)
    assert verify_recording(new).ok
    named = before.map(lambda e: (["left"] * len(e), e.actions[1]), tmp_path / "a.mcap", fields=["actions"])
    assert set(tupli_mcap.open(named).read().actions[0]) == {"left"}
    assert same(tupli_mcap.open(named).read().actions[1], before.read().actions[1])
    with pytest.raises(StepError):
        before.map(lambda e: ([5] * len(e), e.actions[1]), tmp_path / "b.mcap", fields=["actions"])
    with pytest.raises(RecordingError, match="expected 7 actions"):
        before.map(lambda e: (["left"], e.actions[1]), tmp_path / "b.mcap", fields=["actions"])
    assert not (tmp_path / "b.mcap").exists()


def reversed_arrays(column: Any) -> Any:
    """The column with its arrays in the opposite order; lists, of values of variable size, likewise."""
    if isinstance(column, dict):
        return {key: reversed_arrays(part) for key, part in column.items()}
    return tuple(map(reversed_arrays, column)) if isinstance(column, tuple) else column[::-1]


@pytest.mark.sampled(14)
@pytest.mark.parametrize("name", NAMES)
def test_states_of_every_kind_of_recording(name: str, tmp_path: Path) -> None:
    before = Recording(place(name, tmp_path))
    relabel_excerpts(
        [Excerpt(before, before.index)],
        tmp_path / "new.mcap",
        lambda e: reversed_arrays(e.all_states),
        ["states"],
    )
    after = Recording(tmp_path / "new.mcap")
    for old, new in zip(before.episodes, after.episodes, strict=True):
        assert same(new.all_states, reversed_arrays(old.all_states))
        assert (new.final_state is None) == (old.final_state is None)
        for field in ("actions", "rewards", "terminals", "timeouts", "seed", "end", "return_"):
            assert same(getattr(new, field), getattr(old, field))
        assert jsonvalue.dumps([new.metadata, new.infos]) == jsonvalue.dumps([old.metadata, old.infos])
    np.testing.assert_array_equal(after.read(fields=["times"]).times, before.read(fields=["times"]).times)
    found = verify_recording(tmp_path / "new.mcap")
    assert found.ok, found.problems


def test_states_with_the_final_one(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap")
    ds = tupli_mcap.open(source)
    clipped = ds.map(
        lambda e: e.all_states.clip(-0.5, 0.5), tmp_path / "clipped.mcap", fields=["observations"]
    )
    for old, new in zip(ds, tupli_mcap.open(clipped), strict=True):
        np.testing.assert_array_equal(new.states, old.states.clip(-0.5, 0.5))
        np.testing.assert_array_equal(new.next_states[-1], old.final_state.clip(-0.5, 0.5))
        assert len(old.all_states) == len(old) + 1
    both = ds.map(
        lambda e: {"observations": e.all_states * 2, "rewards": e.rewards},
        tmp_path / "both.mcap",
        fields=["rewards", "states"],
    )
    np.testing.assert_array_equal(tupli_mcap.open(both).read().states, 2 * ds.read().states)
    with pytest.raises(RecordingError, match=r"states of episode 0 of shape .* map episode\.all_states"):
        ds.map(lambda e: e.states, tmp_path / "n.mcap", fields=["states"])


@pytest.mark.parametrize(
    ("function", "fields"),
    [
        (lambda episode: episode.rewards[1:], ["rewards"]),
        (lambda episode: ["a"] * len(episode), ["rewards"]),
        (lambda episode: {"actions": episode.actions}, ["actions"]),
        (lambda episode: np.full(len(episode), 0.5), ["actions"]),
        (lambda episode: episode.states, ["states"]),
        (lambda episode: episode.rewards, ["rewards", "actions"]),
    ],
)
def test_refuses_what_does_not_fit(function: Any, fields: list[str], tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap")
    with pytest.raises(RecordingError):
        tupli_mcap.open(source).map(function, tmp_path / "n.mcap", fields=fields)
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]


def test_rewards_may_be_named(tmp_path: Path) -> None:
    ds = tupli_mcap.open(record(tmp_path / "r.mcap"))
    new = ds.map(lambda episode: {"rewards": episode.rewards * 2}, tmp_path / "n.mcap")
    np.testing.assert_array_equal(tupli_mcap.open(new).read().rewards, 2 * ds.read().rewards)


def test_replaces_nothing_by_itself(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap")
    for folder in (tmp_path, f"{tmp_path}/new/"):
        with pytest.raises(DatasetError, match="is a directory"):
            tupli_mcap.open(source).map(lambda episode: episode.rewards, folder)
    other = record(tmp_path / "other.mcap")
    with pytest.raises(DatasetError, match="exists"):
        tupli_mcap.open(source).map(lambda episode: episode.rewards, other)
    with pytest.raises(DatasetError, match="is one of the recordings themselves"):
        tupli_mcap.open(source).map(lambda episode: episode.rewards, source, overwrite=True)


def test_values_that_would_change_are_refused(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (1,), np.uint8)
    source = record(tmp_path / "r.mcap", 1, Sampler(space, spaces.Discrete(2)))
    dataset, wrong = tupli_mcap.open(source), tmp_path / "wrong.mcap"
    n = len(dataset[0].all_states)
    masked = np.ma.MaskedArray(np.ones((n, 1), np.uint8), mask=np.ones((n, 1)))
    for made in (np.full((n, 1), -1, np.int8), np.full((n, 1), -0.0), np.full((n, 1), 256), masked):
        with pytest.raises(RecordingError, match=r"that uint8 holds exactly, found .* cast them"):
            dataset.map(lambda episode, made=made: made, wrong, fields=["states"])
    assert not wrong.exists()
    same_values = dataset.map(lambda episode: episode.all_states.astype(float), wrong, fields=["states"])
    assert np.array_equal(tupli_mcap.open(same_values)[0].all_states, dataset[0].all_states)


def test_a_name_or_a_field_that_is_missing_is_named(tmp_path: Path) -> None:
    dataset = tupli_mcap.open(record(tmp_path / "r.mcap", 1))
    with pytest.raises(RecordingError, match=r"found a dict of actions; pass fields=\['actions'\]"):
        dataset.map(lambda episode: {"actions": episode.actions}, tmp_path / "new.mcap")
    source = tmp_path / "r.mcap"
    for verb in (
        dataset.save,
        lambda path: dataset.map(lambda episode: episode.rewards, path),
        lambda path: dataset.trim(slice(1, None), path),
        lambda path: merge_recordings([source], path),
        lambda path: split_recording(source, path, episodes=1),
        lambda path: recover_recording(source, path),
    ):
        with pytest.raises(
            RecordingError, match=r"expected a name that ends in \.mcap, found .*good; add \.mcap"
        ):
            verb(tmp_path / "good")
        assert not (tmp_path / "good").exists()


@pytest.mark.parametrize(
    "space", [spaces.Box(-9, 9, (), np.float32), spaces.Dict({"a": spaces.Box(-9, 9, (), np.float16)})]
)
def test_rewards_of_a_space_may_be_lists(space: Any, tmp_path: Path) -> None:
    named = isinstance(space, spaces.Dict)
    with EpisodeWriter(
        tmp_path / "r.mcap", spaces.Discrete(2), spaces.Discrete(2), reward_space=space
    ) as writer:
        writer.begin()
        for _ in range(3):
            writer.step(0, 1, {"a": np.float16(1)} if named else np.float32(1))
    column: Any = {"a": [1.5, -2, 0.25]} if named else [1.5, -2, 0.25]
    path = tupli_mcap.open(tmp_path / "r.mcap").map(lambda _: column, tmp_path / "new.mcap")
    rewards = Recording(path).read(["rewards"]).rewards
    np.testing.assert_array_equal(rewards["a"] if named else rewards, [1.5, -2, 0.25])
    assert Recording(path).returns.tolist() == [-0.25]
    assert verify_recording(path).problems == []


def test_says_of_which_recordings_it_was_made(tmp_path: Path) -> None:
    paths = [record(tmp_path / f"{i}.mcap") for i in range(2)]
    merge_recordings(paths, tmp_path / "all.mcap")
    both = tupli_mcap.open(paths).filter("seed = 1").save(tmp_path / "both.mcap")
    said = Recording(both).made_of
    assert said is not None
    assert (said["how"], "seed" in said["query"]) == ("filter", True)
    some = tupli_mcap.open(tmp_path / "all.mcap").filter("seed = 1").save(tmp_path / "some.mcap")
    said = Recording(some).made_of
    assert said is not None
    jsonschema.validate(said, json.loads(SCHEMA.read_text()))
    assert (said["how"], said["earlier"][0]["how"]) == ("filter", "merge")
    assert len(said["earlier"][0]["sources"]) == 2
    assert "seed" in said["query"]
    assert Recording(paths[0]).made_of is None


def test_sources_are_named_without_folders_and_queries(tmp_path: Path) -> None:
    recording = Recording(record(tmp_path / "r.mcap"))
    recording.name = "https://host/data/x.mcap?X-Amz-Signature=SECRET/3"
    ((_, data),) = say_made_of([recording], "merge").values()
    assert json.loads(data)["sources"][0]["name"] == "x.mcap"
    assert recording.run.name == "x"


_FUNCTIONS = """
import numpy as np

def halved(episode):
    return episode.rewards / 2

def both(episode):
    return {"rewards": -episode.rewards, "states": episode.all_states * 0}

def fails(episode):
    return [1 / (2 - episode.number)] * len(episode)
"""


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = record(tmp_path / "r.mcap"), tmp_path / "new.mcap"
    (tmp_path / "relabel_of_a_test.py").write_text(_FUNCTIONS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])

    def run(function: str, *more: str) -> Any:
        words = ["relabel", str(source), "--function", function, "-o", str(target)]
        return CliRunner().invoke(app, [*words, *more])

    before = tupli_mcap.open(source)
    done = run("relabel_of_a_test:halved", "--dry-run", "--json")
    told = {"dry_run": True, "path": str(target), "episodes": 4, "steps": before.n_steps, "size": 0}
    assert json.loads(done.output)["result"] == told
    assert not target.exists()
    assert run("relabel_of_a_test:halved").exit_code == 0
    assert tupli_mcap.open(target).returns.tolist() == (before.returns / 2).tolist()
    assert Recording(target).made_of["function"] == "relabel_of_a_test.halved"
    assert "exists" in run("relabel_of_a_test:halved").output
    done = run("relabel_of_a_test:both", "--field", "rewards", "--field", "observations", "--force", "--json")
    assert json.loads(done.output)["result"]["size"] == target.stat().st_size
    after = tupli_mcap.open(target)
    assert after.returns.tolist() == (-before.returns).tolist()
    assert not after[3].all_states.any()
    kept = target.read_bytes()
    failed = run("relabel_of_a_test:fails", "--force")
    assert "'relabel_of_a_test:fails' failed at episode 2 of" in " ".join(failed.output.split())
    assert target.read_bytes() == kept
    for function, code in (("halved", 2), (":halved", 2), ("relabel_of_a_test:absent", 1), ("no_such:f", 1)):
        assert run(function, "--force").exit_code == code
    assert "found 'foo'" in run("relabel_of_a_test:halved", "--field", "foo", "--force", "--dry-run").output
