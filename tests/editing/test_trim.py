"""Recordings of which steps at the ends of episodes are left out."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
import web_server
from damaged import chunks, hit
from environments import Winning, same
from golden_files import NAMES, place
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import EpisodeWriter, RecordEpisodes, Recording, RecordingError, doctor
from tupli_mcap.cli.app import app
from tupli_mcap.dataset import DatasetError
from tupli_mcap.recording import Episode, annotate_episodes, rewrite_recording, verify_recording
from tupli_mcap.recording.edit.merge import Excerpt
from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.recording.edit.trim import trims_of
from tupli_mcap.reexecute.starts import plan_episodes

ROOT = Path(__file__).parents[2]


def record(path: Path, seeds: tuple[int | None, ...] = (0, 1, None, None)) -> Path:
    """Episodes of CartPole, by seed; None goes on with the random stream."""
    with RecordEpisodes(gym.make("CartPole-v1"), path, name="ppo") as recorded:
        recorded.action_space.seed(1)
        for seed in seeds:
            recorded.reset(seed=seed)
            ended = False
            while not ended:
                _, _, terminal, timeout, _ = recorded.step(recorded.action_space.sample())
                ended = terminal or timeout
    return path


def steps_of(episode: Episode) -> list[Any]:
    return [
        (step.state, step.action, step.reward, step.terminal, step.timeout, step.info) for step in episode
    ]


def test_no_picture_is_read_to_say_what_stays(tmp_path: Path) -> None:
    """Those of an episode may not fit into memory."""
    path, picture = tmp_path / "r.mcap", np.zeros((8, 8, 3), np.uint8)
    with EpisodeWriter(path, gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), gym.spaces.Discrete(2)) as writer:
        writer.begin()
        for i in range(5):
            writer.step(picture, 0, float(i))
    for chunk in chunks(path, "/image/state"):
        hit(path, chunk)
    assert trims_of(Recording(path), {0: slice(2, 5)})[0].episode_return == 9


@pytest.mark.sampled(14)
@pytest.mark.parametrize("name", NAMES)
def test_what_stays_is_what_it_was(name: str, tmp_path: Path) -> None:
    """Of every kind of recording: values, times, infos and frames of the steps that stay, and the state after them."""
    before = Recording(place(name, tmp_path))
    kept = {e.number: slice(1, -1) for e in before.episodes if len(e) >= 3 and e.number % 3 != 1}
    kept |= {e.number: slice(1, None) for e in before.episodes if len(e) >= 3 and e.number % 3 == 1}
    after = Recording(before.trim(lambda e: kept.get(e.number, slice(None)), tmp_path / "new.mcap"))
    for old, new in zip(before.episodes, after.episodes, strict=True):
        start, stop, _ = kept.get(old.number, slice(None)).indices(len(old))
        assert new.number == old.number
        assert same(steps_of(new), steps_of(old)[start:stop])
        whole_end = stop == len(old)
        assert same(new.final_state, old.final_state if whole_end else old[stop].state)
        assert new.end == (old.end if whole_end else "interrupted")
        assert new.seed == (old.seed if start == 0 else None)
        times = before.read(episodes=[old.position], fields=["times"]).times
        np.testing.assert_array_equal(
            after.read(episodes=[new.position], fields=["times"]).times, times[start:stop]
        )
        assert new.start_time == (old.start_time if start == 0 else times[start - 1])
        assert new.metadata == old.metadata
        frames = [(s - start, i) for i, s in enumerate(old.frames.steps.tolist()) if start <= s <= stop]
        assert new.frames.steps.tolist() == [step for step, _ in frames]
        for i, (_, at) in enumerate(frames):
            np.testing.assert_array_equal(new.frames[i], old.frames[at])
    found = verify_recording(tmp_path / "new.mcap")
    assert found.ok, found.problems


def test_says_where_it_comes_from_and_what_no_reset_leads_to(tmp_path: Path) -> None:
    ds = tupli_mcap.open(record(tmp_path / "r.mcap"))
    new = ds.trim(
        lambda e: slice(2 if e.number == 1 else 0, -2 if e.number == 2 else None), tmp_path / "n.mcap"
    )
    after = Recording(new)
    assert [plan.how for plan in plan_episodes(after, captured=False)[0]] == [
        "seeded", "unknown", "follows", "unknown",
    ]  # fmt: skip
    assert after.returns.tolist() == [float(len(episode)) for episode in after]
    assert [episode.run.name for episode in after] == ["ppo"] * 4
    said = after.made_of
    jsonschema.validate(said, json.loads((ROOT / "schemas" / "made_of.schema.json").read_text()))
    assert said is not None
    lengths = [len(episode) for episode in ds]
    assert said["steps"] == {"1": [2, lengths[1]], "2": [0, lengths[2] - 2]}
    assert not [finding.check for finding in doctor.examine(new).findings if finding.check == "missing-reset"]


class Three(Winning):
    """Wins at its third step."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.left = 3
        return 0, {}

    def step(self, action: Any) -> Any:
        self.left -= 1
        return 1, 1.0, not self.left, False, {} if self.left else {self.key: True}


@pytest.mark.parametrize("several", [False, True])
def test_who_loses_the_end_has_no_recorded_success(several: bool, tmp_path: Path) -> None:
    paths = []
    for name in ("a", "b")[: 1 + several]:
        paths.append(tmp_path / f"{name}.mcap")
        with RecordEpisodes(Three(), paths[-1]) as recorded:
            for _ in range(3):
                recorded.reset()
                while not recorded.step(1)[2]:
                    pass
    annotate_episodes(paths[0], {"success": False, "note": "seen"}, [2])
    cut = {0: slice(1, None), 1: slice(0, 1), 2: slice(0, 1)}
    new = tupli_mcap.open(paths).trim(lambda e: cut[e.number], tmp_path / "n.mcap")
    known = [{"success": True}, {}, {"success": False, "note": "seen"}]
    assert [e.metadata for e in tupli_mcap.open(paths[0])] == [{"success": True}] * 2 + known[2:]
    assert [e.metadata for e in Recording(new)] == known + [{"success": True}, {}, {}] * several
    assert verify_recording(new).ok


def test_of_a_part_of_several_recordings(tmp_path: Path) -> None:
    paths = [record(tmp_path / f"{i}.mcap") for i in range(2)]
    ds = tupli_mcap.open(paths).filter("seed == 1")
    new = tupli_mcap.open(ds.trim(slice(3, -3), tmp_path / "deep" / "n.mcap"))
    assert [len(episode) for episode in new] == [len(episode) - 6 for episode in ds]
    assert same([steps_of(episode) for episode in new], [steps_of(episode)[3:-3] for episode in ds])
    merged = Recording(tmp_path / "deep" / "n.mcap")
    assert verify_recording(merged.path).ok
    said = merged.made_of
    jsonschema.validate(said, json.loads((ROOT / "schemas" / "made_of.schema.json").read_text()))
    assert [one["name"] for one in said["sources"]] == ["0.mcap", "1.mcap"]
    assert said["steps"] == {str(e.number): [3, len(e) + 3] for e in merged}
    assert (said["how"], said["query"]) == ("trim", "seed == 1")
    one = tupli_mcap.open(paths[0]).head(2).trim(slice(3, -3), tmp_path / "one.mcap")
    assert (Recording(one).made_of or {})["query"] == "head: 2"


def test_info_says_the_digests_of_the_sources_and_alike_trims_once(tmp_path: Path) -> None:
    new = tupli_mcap.open(record(tmp_path / "r.mcap")).trim(slice(2, 9), tmp_path / "n.mcap")
    said = Recording(new).made_of
    assert said is not None
    told = " ".join(CliRunner().invoke(app, ["info", str(new)]).output.split())
    digest = said["sources"][0]["sha256"][:12]
    assert f"r.mcap (sha256 {digest}) by trim to steps 2:9 of episodes 0, 1, 2, 3" in told


def test_a_part_says_nothing_of_the_trims_of_others(tmp_path: Path) -> None:
    """Who may read only these must not learn how many others there are, and how long."""
    new = tupli_mcap.open(record(tmp_path / "r.mcap")).trim(slice(2, 9), tmp_path / "n.mcap")
    rewrite_recording(Recording(new), tmp_path / "some.mcap", episodes=[1])
    whole, some = Recording(new).made_of, Recording(tmp_path / "some.mcap").made_of
    assert whole is not None
    assert some == {**whole, "steps": {"1": [2, 9]}}
    again = tupli_mcap.open(new).trim(slice(1, 4), tmp_path / "again.mcap")
    with Recording(again) as source:
        part = Excerpt(source, source.index[1:2], alone=True)
        (tmp_path / "sent.mcap").write_bytes(b"".join(stream_excerpts(contextlib.nullcontext([part]))))
    assert Recording(tmp_path / "sent.mcap").made_of is None


def test_info_says_how_many_trims_it_does_not_show(tmp_path: Path) -> None:
    ds = tupli_mcap.open(record(tmp_path / "r.mcap"))
    new = ds.trim(lambda e: slice(0, 9 - e.number), tmp_path / "n.mcap")
    told = " ".join(CliRunner().invoke(app, ["info", str(new)]).output.split())
    assert "by trim to steps 0:9 of episode 0; 0:8 of episode 1; 0:7 of episode 2; others of 1 more" in told


def test_refuses_to_leave_nothing(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap")
    for steps, message in (
        (slice(600, None), "expected a step of episode 0 to stay, found none"),
        (slice(0, 0), "expected a step of episode 0 to stay, found none"),
        (slice(None, None, 2), "expected consecutive steps, found a stride of 2"),
        (slice(0, 9, 0), "expected a slice of steps, found .*step cannot be zero"),
        (slice(0, 4.5), "expected a slice of steps, found .*must be integers"),
    ):
        with pytest.raises(RecordingError, match=message):
            Recording(source).trim(steps, tmp_path / "n.mcap")
    with pytest.raises(DatasetError, match="one of the recordings themselves"):
        Recording(source).trim(slice(1, None), source, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]


def test_commands_of_files_directories_and_urls(tmp_path: Path) -> None:
    first, second = (record(tmp_path / "runs" / name) for name in ("a.mcap", "b.mcap"))
    target = tmp_path / "n.mcap"
    n_steps = [Recording(path).n_steps for path in (first, second)]
    with web_server.serving() as server:
        server.files["/b.mcap"] = second.read_bytes()
        for sources in ([first.parent], [first, second], [first, server.url("/b.mcap")]):
            words = [
                "trim",
                *map(str, sources),
                "--steps",
                "2:",
                "--filter",
                'recording ~ "A.MCAP"',
                "-o",
                str(target),
            ]
            dry = CliRunner().invoke(app, [*words, "--force", "--dry-run", "--json"])
            done = CliRunner().invoke(app, [*words, "--force", "--json"])
            assert done.exit_code == 0, done.output
            told = json.loads(done.output)["result"]
            assert {**told, "dry_run": True, "size": 0} == json.loads(dry.output)["result"]
            assert (told["episodes"], told["steps"], told["left_out"]) == (8, sum(n_steps) - 8, 8)
            assert Recording(target).n_steps == sum(n_steps) - 8
            said = tupli_mcap.open(target).made_of[str(target)]
            assert said == Recording(target).made_of
            assert [one["name"] for one in said["sources"]] == ["a.mcap", "b.mcap"]
            assert list(said["steps"].values()) == [[2, len(episode)] for episode in tupli_mcap.open(first)]
            words = ["filter", *map(str, sources), "--filter", "seed == 1", "-o", str(target), "--force"]
            assert CliRunner().invoke(app, words).exit_code == 0
            assert [episode.seed for episode in Recording(target)] == [1, 1]


def test_command(tmp_path: Path) -> None:
    source, target = record(tmp_path / "r.mcap"), tmp_path / "n.mcap"
    words = ["trim", str(source), "--steps", "2:-1", "--episodes", "0,2", "-o", str(target)]
    steps = Recording(source).n_steps - 6
    done = CliRunner().invoke(app, [*words, "--dry-run"])
    assert done.output.split() == f"would write {target}: 4 episodes, {steps:,} steps".split()
    assert not target.exists()
    assert f"{steps:,} steps" in CliRunner().invoke(app, words).output
    assert Recording(target).n_steps == steps
    assert "exists" in CliRunner().invoke(app, words).output
    assert CliRunner().invoke(app, [*words, "--force"]).exit_code == 0
    assert (
        "expected a step of episode 0 to stay, found none of its"
        in CliRunner().invoke(app, [*words[:3], "900:", *words[4:], "--force"]).output
    )
    for wrong in ("2", "a:b", "1:2:3"):
        assert CliRunner().invoke(app, [*words[:3], wrong, *words[4:]]).exit_code == 2


@pytest.mark.parametrize(
    "rewards",
    [[0.1] * 9, [-0.0], [1e308, 1e308, -1e308], [np.inf, -np.inf, 1.0], [0.1, 1e16, -1e16, 3.0]],
    ids=["rounded", "minus zero", "overflow", "infinite", "large"],
)
def test_the_return_is_what_a_recorder_adds_up(rewards: list[float], tmp_path: Path) -> None:
    state = gym.spaces.Box(-1, 1, (1,), np.float32)
    with EpisodeWriter(tmp_path / "a.mcap", state, gym.spaces.Discrete(2)) as writer:
        writer.begin()
        for reward in rewards:
            writer.step(np.zeros(1, np.float32), 0, reward)
        writer.end()
    recorded = tupli_mcap.open(tmp_path / "a.mcap")
    same_rewards = recorded.map(lambda episode: episode.rewards, tmp_path / "b.mcap")
    assert repr(tupli_mcap.open(same_rewards).returns) == repr(recorded.returns)
