"""Merged, split and filtered recordings: everything comes along, exact, and chunks are copied where they can be."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from counting import grows, tallied
from environments import Sampler, same
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from typer.testing import CliRunner

from tupli_mcap import (
    EpisodeWriter,
    F,
    FilterError,
    RecordEpisodes,
    Recording,
    RecordingError,
    SpaceError,
    merge_recordings,
    open as open_dataset,
    split_recording,
    verify_recording,
)
from tupli_mcap.cli.app import app
from tupli_mcap.dataset import DatasetError
from tupli_mcap.dataset.curate import filter_dataset
from tupli_mcap.errors import NotFoundError
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.recording import annotate_episodes, rewrite_recording, undo_annotation
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.edit import merge
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes as RecordVector

SPACES = {  # all of them come along in a merge; of other edits, each has some
    "box": spaces.Box(-9, 9, (40,), np.float64),
    "text": spaces.Dict({"note": spaces.Text(300), "x": spaces.Discrete(5)}),
    "stack": spaces.Box(0, 255, (20, 20), np.uint8),
    "last stack": spaces.Box(0, 255, (20, 18), np.uint8),
    "image": spaces.Dict({"see": spaces.Box(0, 255, (20, 20, 3), np.uint8), "x": spaces.Box(-1, 1, (2,))}),
}


class Sampled(gym.Env[Any, Any]):
    """Samples of a space, in episodes of 1 to 9 steps, some cut short; pictures where they are wanted."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, kind: str, render_mode: str | None = None) -> None:
        self.observation_space, self.action_space = SPACES[kind], spaces.Discrete(9)
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(1 << 30)))
        self._left = int(self.np_random.integers(1, 10))
        return self.observation_space.sample(), {"left": self._left}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._left -= 1
        ends = self._left == 0
        info = {"left": self._left, "height": self._left / 2, "note": "n" * self._left}
        return (
            self.observation_space.sample(),
            float(self.np_random.normal()),
            ends and action < 5,
            ends,
            info,
        )

    def render(self) -> Any:
        return np.full((8, 8, 3), self._left * 20, np.uint8)


class Score(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.count = 0
        self.reset()

    def reset(self) -> None:
        self.steps = 0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.steps += 1
        self.count += self.steps == 1
        return {"score": self.count, "steps": self.steps}


def record(
    path: Path, kind: str = "box", *, steps: int = 150, seed: int = 1, frames: int = 0, **options: Any
) -> Path:
    options = {
        "attachments": {},
        "chunk_size": 2000,
        "metadata_callback": Score(),
        "record_info": True,
        **options,
    }
    inner: gym.Env[Any, Any] = Sampled(kind, "rgb_array")
    if "stack" in kind:  # each frame is stored once
        inner = gym.wrappers.FrameStackObservation(inner, 3)
    if kind == "last stack":
        moved = spaces.Box(0, 255, (20, 18, 3), np.uint8)
        inner = gym.wrappers.TransformObservation(inner, lambda frames: np.moveaxis(frames, 0, -1), moved)
    env = RecordEpisodes(inner, path, frames=frames, **options)
    with env:
        env.action_space.seed(seed)
        env.reset(seed=seed, options={"at": seed})
        for _ in range(steps):
            _, _, terminal, timeout, _ = env.step(env.action_space.sample())
            if terminal or timeout:
                env.reset()
    return path


def times_of(recording: Recording) -> list[list[int]]:
    """The times (ns) of the steps, by episode."""
    return [recording.read(episodes=[i], fields=["times"]).times.tolist() for i in range(len(recording))]


def record_vector(path: Path, *, steps: int = 150, seed: int = 1, mode: Any = "x") -> Path:
    venv = SyncVectorEnv([lambda: Sampled("image")] * 2, autoreset_mode=AutoresetMode.NEXT_STEP)
    options: Any = {"attachments": {}, "record_info": True, "metadata_callback": Score(), "mode": mode}
    with RecordVector(venv, path, **options) as env:
        env.action_space.seed(seed)
        env.reset(seed=seed)
        for _ in range(steps):
            env.step(env.action_space.sample())
    return path


def facts(recording: Recording, numbers: Sequence[int] | None = None) -> list[dict[str, Any]]:
    """All there is about the episodes, but their numbers and rows."""
    return [
        {
            "env": e.env, "end": e.end, "return": e.return_, "seed": e.seed, "options": e.options,
            "reset_info": e.reset_info, "metadata": e.metadata, "final": e.final_state,
            "steps": [tuple(step) for step in e], "continued": e.start.continued,
            "frames": [(int(step), e.frames.encoded(i).data) for i, step in enumerate(e.frames.steps)],
        }
        for e in recording.episodes
        if numbers is None or e.number in numbers
    ]  # fmt: skip


def chunks_of(path: Path) -> list[bytes]:
    """The chunk records of a recording, as they are in the file."""
    with Recording(path) as recording:
        source = PathSource(path)
        found = [source.read(int(row["offset"]), int(row["length"])) for row in recording._contents.table]
        source.close()
        return found


def assert_sound(path: Path) -> None:
    report = verify_recording(path)
    assert report.problems == []
    assert report.ok


def steps_of(paths: Sequence[Path]) -> list[Any]:
    """Steps with their infos; entries with a typed field come first, in the order of these fields."""
    steps = [step for path in paths for fact in facts(Recording(path)) for step in fact["steps"]]
    return [(*step[:5], dict(sorted((step[5] or {}).items()))) for step in steps]


class TestMerge:
    @pytest.mark.parametrize("kind", SPACES)
    def test_everything_comes_along(self, tmp_path: Path, kind: str) -> None:
        paths = [record(tmp_path / f"{i}.mcap", kind, seed=i, frames=3 * (i % 2)) for i in range(3)]
        report = merge_recordings(paths, tmp_path / "all.mcap")
        assert_sound(report.path)
        opened = [Recording(path) for path in paths]
        with Recording(report.path) as merged:
            assert same(facts(merged), [fact for one in opened for fact in facts(one)])
            assert len({merged.uuid, *(one.uuid for one in opened)}) == 4
            assert [e.number for e in merged.episodes] == list(range(len(merged)))
            times = [t for one in opened for t in one.read(fields=["times"]).times.tolist()]
            assert merged.read(fields=["times"]).times.tolist() == times
            assert (report.episodes, report.steps, report.held) == (len(merged), merged.n_steps, 0)
            assert merged.metadata["next_episode"] == str(len(merged))
        assert report.size == report.path.stat().st_size
        first = chunks_of(paths[0])
        copied = sum(chunk in chunks_of(report.path) for chunk in first)
        assert copied >= report.copied > 1

    def test_warns_of_what_is_merged_with_its_sources(self, tmp_path: Path) -> None:
        paths = [record(tmp_path / f"{i}.mcap", seed=i, steps=20) for i in range(2)]
        merge_recordings(paths, tmp_path / "all.mcap")
        for dry_run in (True, False):
            with pytest.warns(
                UserWarning, match=r"all.mcap was made of .*0.mcap and 1 more, and both are merged"
            ):
                merge_recordings([*paths, tmp_path / "all.mcap"], tmp_path / "more.mcap", dry_run=dry_run)

    @pytest.mark.parametrize("formats", [("raw", "png"), ("png", "raw")])
    def test_images_of_another_format(self, tmp_path: Path, formats: tuple[str, str]) -> None:
        paths = [
            record(tmp_path / f"{i}.mcap", "image", seed=i, image_format=form)
            for i, form in enumerate(formats)
        ]
        report = merge_recordings(paths, tmp_path / "all.mcap")
        assert_sound(report.path)
        with Recording(report.path) as merged:
            assert same(facts(merged), [fact for path in paths for fact in facts(Recording(path))])

    def test_vector_recordings(self, tmp_path: Path) -> None:
        paths = [record_vector(tmp_path / f"{i}.mcap", seed=i) for i in range(2)]
        report = merge_recordings(paths, tmp_path / "all.mcap")
        assert_sound(report.path)
        with Recording(report.path) as merged:
            expected = [fact for path in paths for fact in facts(Recording(path))]
            for env in range(2):
                mine = [fact for fact in facts(merged) if fact["env"] == env]
                assert same(mine, [fact for fact in expected if fact["env"] == env])

    def test_they_come_in_the_order_of_their_times(self, tmp_path: Path) -> None:
        first, second = record(tmp_path / "b.mcap", seed=1), record(tmp_path / "a.mcap", seed=2)
        report = merge_recordings([second, first], tmp_path / "all.mcap")
        with Recording(report.path) as merged:
            assert same(facts(merged), facts(Recording(first)) + facts(Recording(second)))

    @pytest.mark.sampled(0, keep=["text", "image"])
    @pytest.mark.parametrize("kind", ["box", "text", "image", "stack"])
    def test_recordings_appended_in_turns_keep_their_times(self, tmp_path: Path, kind: str) -> None:
        """A day of each: no time is before one ahead of it if episodes are in the order of their times."""
        a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
        days = [(a, 1), (b, 2), (a, 3), (a, 4), (b, 5)]
        for path, seed in days:
            record(path, kind, seed=seed, steps=40, frames=3, mode="a" if path.exists() else "x")
        opened = [Recording(path) for path in (a, b)]
        found = [fact for one in opened for fact in facts(one)]
        times = [moments for one in opened for moments in times_of(one)]
        order = sorted(range(len(found)), key=lambda i: times[i][0])
        assert order != list(range(len(found)))
        report = merge_recordings([b, a], tmp_path / "all.mcap")
        assert report.held == 0
        assert_sound(report.path)
        with Recording(report.path) as merged:
            assert same(facts(merged), [found[i] for i in order])
            assert times_of(merged) == [times[i] for i in order]
            assert [e.number for e in merged.episodes] == list(range(len(merged)))
            assert merged.metadata["next_episode"] == str(len(merged))
            assert int(merged.index["end_time"].max()) == max(
                int(one.index["end_time"].max()) for one in opened
            )

    def test_recordings_that_take_too_many_turns_become_sub_environments(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("tupli_mcap.recording.edit.merge._MOST_TURNS", 2)
        a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
        for path, seed in ((a, 1), (b, 2), (a, 3)):
            record(path, seed=seed, steps=40, mode="a" if path.exists() else "x")
        report = merge_recordings([a, b], tmp_path / "all.mcap")
        assert report.held == 0
        assert_sound(report.path)
        with Recording(report.path) as merged:
            assert same(
                facts(merged), facts(Recording(a)) + [{**fact, "env": 1} for fact in facts(Recording(b))]
            )

    def test_vector_recordings_appended_in_turns(self, tmp_path: Path) -> None:
        a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
        for path, seed in ((a, 1), (b, 2), (a, 3)):
            record_vector(path, seed=seed, steps=30, mode="a" if path.exists() else "x")
        with Recording(a) as one, Recording(b) as other:
            times = sorted(
                one.read(fields=["times"]).times.tolist() + other.read(fields=["times"]).times.tolist()
            )
        report = merge_recordings([a, b], tmp_path / "all.mcap")
        assert report.held == 0
        assert_sound(report.path)
        with Recording(report.path) as merged:
            assert sorted(merged.read(fields=["times"]).times.tolist()) == times

    @pytest.mark.sampled(0, keep=["box", "last stack"])
    @pytest.mark.parametrize("kind", SPACES)
    def test_recordings_made_at_the_same_time(self, tmp_path: Path, kind: str) -> None:
        """Parallel workers keep their times: each is a sub-environment, and the next pair takes their places."""
        paths = [tmp_path / f"{i}.mcap" for i in range(4)]
        for pair in (paths[:2], paths[2:]):
            inner: list[Any] = [Sampled(kind, "rgb_array") for _ in pair]
            if "stack" in kind:
                inner = [gym.wrappers.FrameStackObservation(env, 3) for env in inner]
            envs = [
                RecordEpisodes(env, path, name=path.stem, attachments={}, record_info=True, frames=3)
                for env, path in zip(inner, pair, strict=True)
            ]
            for env in envs:
                env.reset(seed=1)
            for _ in range(60):
                for env in envs:
                    if any(env.step(0)[2:4]):
                        env.reset()
            for env in envs:
                env.close()
        report = merge_recordings(paths, tmp_path / "all.mcap")
        assert report.held == 0
        assert_sound(report.path)
        opened = [Recording(path) for path in paths]
        with Recording(report.path) as merged:
            assert (merged.num_envs, merged.is_vector) == (2, True)
            wanted = [{**fact, "env": i % 2} for i, one in enumerate(opened) for fact in facts(one)]
            assert same(facts(merged), wanted)
            assert times_of(merged) == [moments for one in opened for moments in times_of(one)]
            found = [e for one in opened for e in one.episodes]
            for name in ("start_time", "end_time"):
                assert [getattr(e, name) for e in merged.episodes] == [getattr(e, name) for e in found]
            assert [e.run.name for e in merged.episodes] == [e.run.name for e in found]
            assert {e.run.name for e in merged.episodes if e.env == 0} == {"0", "2"}

    def test_single_and_vector_recordings(self, tmp_path: Path) -> None:
        single, vector = record(tmp_path / "i.mcap", "image"), record_vector(tmp_path / "v.mcap")
        report = merge_recordings([vector, single], tmp_path / "all.mcap")
        assert_sound(report.path)
        with Recording(report.path) as merged:
            assert merged.num_envs == 2
            assert same(facts(merged), facts(Recording(single)) + facts(Recording(vector)))
        again = merge_recordings(
            [report.path, record(tmp_path / "j.mcap", "image", seed=5)], tmp_path / "b.mcap"
        )
        assert_sound(again.path)

    def test_a_vector_and_a_single_one_at_the_same_time(self, tmp_path: Path) -> None:
        """One has infos, the other frames; final states of a vector environment are there before its steps."""
        venv = SyncVectorEnv([lambda: Sampled("image")] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
        with (
            RecordVector(venv, tmp_path / "v.mcap", attachments={}, record_info=True) as vector,
            RecordEpisodes(
                Sampled("image", "rgb_array"), tmp_path / "s.mcap", attachments={}, frames=2
            ) as single,
        ):
            vector.reset(seed=1)
            single.reset(seed=2)
            for _ in range(40):
                vector.step(vector.action_space.sample())
                if any(single.step(0)[2:4]):
                    single.reset()
        report = merge_recordings([tmp_path / "v.mcap", tmp_path / "s.mcap"], tmp_path / "all.mcap")
        assert report.held == 0
        assert_sound(report.path)
        with (
            Recording(report.path) as merged,
            Recording(tmp_path / "v.mcap") as v,
            Recording(tmp_path / "s.mcap") as s,
        ):
            assert merged.num_envs == 3
            wanted = facts(v) + [{**fact, "env": 2} for fact in facts(s)]
            for fact in wanted:  # who has no infos has them empty beside others
                fact["steps"] = [(*step[:5], step[5] or None) for step in fact["steps"]]
            found = facts(merged)
            for fact in found:
                fact["steps"] = [(*step[:5], step[5] or None) for step in fact["steps"]]
            assert same(found, wanted)
            assert times_of(merged) == times_of(v) + times_of(s)

    def test_other_infos_are_kept_beside_each_other(self, tmp_path: Path) -> None:
        infos: list[Any] = [["height"], True, ["left", "height"], False]
        paths = [record(tmp_path / f"{i}.mcap", record_info=one, seed=i) for i, one in enumerate(infos)]
        venv = SyncVectorEnv([lambda: Sampled("box")] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
        with RecordVector(venv, tmp_path / "v.mcap", attachments={}, record_info=True) as vector:
            vector.reset(seed=1)
            for _ in range(20):
                vector.step(vector.action_space.sample())
        for sources in (paths, paths[1:], [*paths, tmp_path / "v.mcap"]):
            merged = merge_recordings(sources, tmp_path / "all.mcap", overwrite=True).path
            assert_sound(merged)
            found, wanted = steps_of([merged]), steps_of(sources)
            assert same(found, wanted)

    def test_merged_again_appended_and_filtered(self, tmp_path: Path) -> None:
        paths = [record(tmp_path / f"{i}.mcap", seed=i) for i in range(3)]
        merge_recordings(paths[:2], tmp_path / "two.mcap")
        merge_recordings([tmp_path / "two.mcap", paths[2]], tmp_path / "all.mcap")
        before = sum(len(Recording(path)) for path in paths)
        record(tmp_path / "all.mcap", seed=5, mode="a")
        assert_sound(tmp_path / "all.mcap")
        with Recording(tmp_path / "all.mcap") as recording:
            assert len(recording) > before
            assert [e.number for e in recording.episodes] == list(range(len(recording)))

    @pytest.mark.parametrize("parts", [False, True])
    def test_an_annotation_stays_one(self, tmp_path: Path, parts: bool) -> None:
        """Also of recordings that took turns, or were parts of one: --undo takes it back from all of its episodes."""
        paths = [tmp_path / f"{name}.mcap" for name in "ab"]
        for turn in range(6):
            record(paths[turn % 2], steps=20, seed=turn, mode="a")
        for place, note in ((0, {"good": 1}), (1, {"other": 1}), (0, {"oops": 1})):
            annotate_episodes(paths[place], note)
        numbers = Recording(paths[0]).index["episode"].tolist()
        count = len(numbers)
        if parts:
            middle = count // 2
            split_recording(paths.pop(0), tmp_path / "part.mcap", episodes=middle + 1)
            paths += [tmp_path / "part_0001.mcap", tmp_path / "part.mcap"]
        merged = merge_recordings(paths, tmp_path / "all.mcap").path
        assert [next(iter(said.values)) for said in Recording(merged).annotations.said] == [
            "good",
            "other",
            "oops",
        ]
        undone = undo_annotation(merged)
        assert (undone.values, len(undone.episodes)) == ({"oops": 1}, count)
        assert sum("good" in episode.metadata for episode in open_dataset(merged)) == count
        assert not any("oops" in episode.metadata for episode in open_dataset(merged))

    def test_attachments(self, tmp_path: Path) -> None:
        one = record(tmp_path / "1.mcap", attachments={"a": ("text/plain", b"1"), "c": ("text/plain", b"3")})
        two = record(tmp_path / "2.mcap", attachments={"b": ("text/plain", b"2"), "c": ("text/plain", b"3")})
        merge_recordings([one, two], tmp_path / "all.mcap")
        with Recording(tmp_path / "all.mcap") as merged:
            found = {name: merged.read_attachment(name) for name in merged.attachments}
        assert found.pop("run.json")
        assert found.pop("made_of.json")
        assert found == {"a": b"1", "b": b"2", "c": b"3"}
        other = record(tmp_path / "3.mcap", attachments={"c": ("text/plain", b"?")})
        with pytest.raises(RecordingError, match=r"3\.mcap: its attachment 'c' differs"):
            merge_recordings([one, other], tmp_path / "no.mcap")
        assert not (tmp_path / "no.mcap").exists()

    def test_the_environment_comes_along(self, tmp_path: Path) -> None:
        paths = []
        for i in range(2):
            env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / f"{i}.mcap")
            with env:
                env.reset(seed=i)
                env.step(0)
            paths.append(env.path)
        merge_recordings(paths, tmp_path / "all.mcap")
        with Recording(tmp_path / "all.mcap") as merged:
            made = merged.benchmark.make_env()
            assert made.spec is not None
            assert made.spec.id == "CartPole-v1"

    def test_messages_are_found_once_not_for_each_episode(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The starts of all episodes lie in one chunk: each is taken without looking at the others."""
        listed = 0

        class Places(np.ndarray[Any, Any]):
            def tolist(self) -> Any:
                nonlocal listed
                listed += len(self)
                return super().tolist()

        def records(self: ChunkStore, *args: Any, **options: Any) -> Any:
            data, places = found(self, *args, **options)
            return data, places.view(Places)

        def places_listed(episodes: int) -> int:
            nonlocal listed
            path = tmp_path / f"{episodes}.mcap"
            with RecordEpisodes(
                Sampler(spaces.Box(-1, 1, (2,)), spaces.Discrete(2), length=1), path, attachments={}
            ) as env:
                for seed in range(episodes):
                    env.reset(seed=seed)
                    env.step(0)
            listed = 0
            merge_recordings([path], tmp_path / f"{episodes} merged.mcap")
            return listed

        found = ChunkStore.records
        monkeypatch.setattr(ChunkStore, "records", records)
        assert grows(places_listed, 100) < 1.2

    def test_what_does_not_fit_is_refused(self, tmp_path: Path) -> None:
        one, text = record(tmp_path / "1.mcap"), record(tmp_path / "t.mcap", "text")
        benchmark = record(tmp_path / "b.mcap", benchmark_id="b" * 64)
        copy = tmp_path / "copy.mcap"
        copy.write_bytes(one.read_bytes())
        goal = tmp_path / "all.mcap"
        for others, kind, words in (
            (
                [one, text],
                SpaceError,
                r"t\.mcap: expected the observation_space of .*1\.mcap, Box.*, found Dict",
            ),
            ([one, benchmark], RecordingError, "expected a recording of benchmark none"),
            ([one, one], RecordingError, r"1\.mcap holds episode 0 of .*1\.mcap again"),
            (one, RecordingError, "expected a list of recordings to merge, found PosixPath"),
            ([one, copy], RecordingError, r"copy\.mcap holds episode 0 of .*1\.mcap again"),
            ([], RecordingError, "expected recordings with episodes to merge, found none"),
        ):
            with pytest.raises(kind, match=words):
                merge_recordings(others, goal)
            assert not goal.exists()
        with pytest.raises(RecordingError, match="is one of the recordings themselves"):
            merge_recordings([one, benchmark], one, overwrite=True)
        with pytest.raises(RecordingError, match="exists; choose another path"):
            merge_recordings([one], text)


def test_more_recordings_than_may_be_open_at_once(tmp_path: Path) -> None:
    """Of writers at the same time, whose infos are mixed; not compressed, so that they are mapped; and unfinished."""
    runs, copied = tmp_path / "runs", tmp_path / "copied"
    box, one = spaces.Box(-1, 1, (3,), np.float32), np.ones(3, np.float32)
    for first in range(0, 180, 20):
        with ExitStack() as stack:
            writers = {
                i: stack.enter_context(
                    EpisodeWriter(runs / f"{i:03}.mcap", box, box, compression="none" if i % 2 else "zstd")
                )
                for i in range(first, first + 20)
            }
            for writer in writers.values():
                writer.begin()
            for k in range(3):
                for i, writer in writers.items():
                    writer.step(one, one, float(i), terminated=k == 2, info={"n": i})
            if first == 160:  # as if its writers were killed
                shutil.copytree(runs, copied)
    sources = sorted(map(str, copied.glob("*.mcap")))
    few, merged, saved = (tmp_path / f"{name}.mcap" for name in ("few", "merged", "saved"))
    code = (
        "import resource, sys, tupli_mcap\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))\n"
        "tupli_mcap.merge_recordings(sys.argv[3:], sys.argv[1])\n"
        "tupli_mcap.open(sys.argv[3:]).save(sys.argv[2])\n"
    )
    subprocess.run([sys.executable, "-c", code, merged, saved, *sources], check=True, timeout=120)
    merge_recordings(sources, few)
    for many in (merged, saved):
        with Recording(few) as expected, Recording(many) as found:
            assert len(found) == len(sources) == 180
            assert found.read(["infos"]).infos == expected.read(["infos"]).infos
            assert same(found.read().rewards, expected.read().rewards)

    def replace_first(recording: Recording) -> np.ndarray:
        shutil.copy(sources[1], tmp_path / "other")
        (tmp_path / "other").replace(sources[0])
        return np.arange(len(recording))

    with pytest.raises(NotFoundError, match=r"000\.mcap was written anew meanwhile; start again$"):
        merge.merge_recordings(sources, tmp_path / "x.mcap", positions=replace_first)


class TestSplit:
    @pytest.mark.sampled(0, keep=["stack", "image"])
    @pytest.mark.parametrize("kind", SPACES)
    def test_by_episodes(self, tmp_path: Path, kind: str) -> None:
        path = record(tmp_path / "run.mcap", kind, frames=2)
        parts = split_recording(path, tmp_path / "part.mcap", episodes=12)
        names = [part.path.name for part in parts]
        assert names == ["part.mcap", *(f"part_{i:04}.mcap" for i in range(1, len(names)))]
        found: list[Any] = []
        for part in parts:
            assert_sound(part.path)
            with Recording(part.path) as recording:
                assert (len(recording), recording.n_steps) == (part.episodes, part.steps)
                assert [recording.episodes[i].number for i in (0, -1)] == [part.first, part.last]
                found += facts(recording)
                made_of = recording.made_of
                assert made_of is not None
                assert (made_of["how"], made_of["sources"][0]["name"]) == ("split", "run.mcap")
        with Recording(path) as recording:
            assert same(found, facts(recording))
        assert {part.episodes for part in parts[:-1]} == {12}
        assert parts[0].copied > 0
        assert len({Recording(part.path).uuid for part in parts}) == len(parts) > 2

    def test_missing_directories_are_made(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        merge_recordings([path], tmp_path / "a" / "all.mcap")
        split_recording(path, tmp_path / "b" / "c" / "part.mcap", episodes=3)
        assert (tmp_path / "a" / "all.mcap").is_file()
        assert (tmp_path / "b" / "c" / "part_0001.mcap").is_file()

    def test_by_bytes(self, tmp_path: Path) -> None:
        path = record(tmp_path / "run.mcap", steps=1500, record_info=False)
        parts = split_recording(path, tmp_path / "part.mcap", max_bytes=100_000)
        assert len(parts) > 3
        assert all(part.size < 130_000 for part in parts)
        assert sum(part.steps for part in parts) == 1500
        merge_recordings([part.path for part in parts], tmp_path / "all.mcap")
        assert same(facts(Recording(tmp_path / "all.mcap")), facts(Recording(path)))

    def test_vector_recordings(self, tmp_path: Path) -> None:
        path = record_vector(tmp_path / "run.mcap")
        for part in split_recording(path, tmp_path / "part.mcap", episodes=20):
            assert_sound(part.path)
            numbers = range(part.first, part.last + 1)
            assert same(facts(Recording(part.path)), facts(Recording(path), numbers))

    def test_nothing_is_replaced(self, tmp_path: Path) -> None:
        path = record(tmp_path / "run.mcap")
        (tmp_path / "part_0003.mcap").write_bytes(b"mine")
        with pytest.raises(RecordingError, match=r"part_0003\.mcap exists; choose another path"):
            split_recording(path, tmp_path / "part.mcap", episodes=5)
        with pytest.raises(RecordingError, match=r"run\.mcap exists; choose another path$"):
            split_recording(path, path, episodes=5)
        for limits in (
            {},
            {"episodes": 1.5},
            {"episodes": "5"},
            {"max_bytes": 0},
            {"episodes": 1, "max_bytes": 9},
        ):
            with pytest.raises(RecordingError, match="either a number of episodes or of bytes"):
                split_recording(path, tmp_path / "new.mcap", **limits)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["part_0003.mcap", "run.mcap"]


class TestFilter:
    @pytest.mark.sampled(0, keep=["box", "text"])
    @pytest.mark.parametrize("kind", SPACES)
    def test_what_it_is_true_of_comes_along(self, tmp_path: Path, kind: str) -> None:
        path = record(tmp_path / "run.mcap", kind, frames=2)
        report = filter_dataset(
            open_dataset(path), tmp_path / "some.mcap", "metadata.score < 20 and n_tuples > 2"
        )
        assert_sound(report.path)
        with Recording(path) as recording, Recording(report.path) as kept:
            numbers = [e.number for e in recording.episodes if e.metadata["score"] < 20 and len(e) > 2]
            assert [e.number for e in kept.episodes] == numbers
            assert same(facts(kept), facts(recording, numbers))
            assert kept.uuid == recording.uuid
            assert (report.episodes, report.left_out) == (len(numbers), len(recording) - len(numbers))

    def test_an_annotation_of_others_stays_behind(self, tmp_path: Path) -> None:
        path = record(tmp_path / "a.mcap")
        annotate_episodes(path, {"note": "private"}, [0])
        copies = [
            open_dataset(path)[1:].save(tmp_path / "some.mcap"),
            open_dataset(path)[1:].trim(slice(1), tmp_path / "trimmed.mcap"),
            *(part.path for part in split_recording(path, tmp_path / "part.mcap", episodes=1)[1:3]),
        ]
        for copy in copies:
            assert list(Recording(copy).annotations.said) == []
            assert b"private" not in copy.read_bytes()

    def test_chunks_of_steps_are_read_once_not_for_each_episode(self, tmp_path: Path) -> None:
        path = record(tmp_path / "run.mcap", steps=400, chunk_size=100_000)
        some = open_dataset(path)[::2]
        assert len(some) > 2 * len(chunks_of(path))
        with tallied(ChunkStore, "rows", lambda _, chunk, *rest, **options: chunk) as read:
            target = some.save(tmp_path / "some.mcap")
        assert read and len(read) <= len(chunks_of(path))
        assert_sound(target)

    @pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
    def test_chunks_before_the_first_change_are_copied(self, tmp_path: Path, compression: str) -> None:
        path = record(tmp_path / "run.mcap", steps=400, compression=compression)
        with Recording(path) as recording:
            last = recording.episodes[-1].metadata["score"]
            steps = recording._topics["/step"]
            channels = recording._contents.table["channel"].tolist()
            numbers = [e.number for e in recording.episodes if e.metadata["score"] < last]
            target = tmp_path / "some.mcap"
            rewrite_recording(recording, target, episodes=numbers, compression=compression)
        assert_sound(target)
        there = set(chunks_of(target))
        mine = [
            chunk in there
            for chunk, channel in zip(chunks_of(path), channels, strict=True)
            if channel == steps
        ]
        assert len(mine) > 10
        assert all(mine[:-2])
        assert not mine[-1]

    def test_the_first_of_them_in_an_order(self, tmp_path: Path) -> None:
        paths = [record(tmp_path / f"{name}.mcap", steps=200) for name in "ab"]
        dataset = open_dataset(paths)
        best = dataset.filter("n_tuples > 2").sort("metadata.score", descending=True).head(4)
        report = filter_dataset(
            dataset, tmp_path / "best.mcap", "n_tuples > 2", sort="-metadata.score", limit=4
        )
        kept = open_dataset(report.path)
        assert kept.made_of[str(report.path)]["query"] == (
            "n_tuples > 2; sort: metadata.score, descending; head: 4"
        )
        assert (report.episodes, report.left_out) == (4, len(dataset) - 4)
        assert sorted(kept.returns) == sorted(best.returns)
        assert [e.end_time for e in kept] == sorted(e.end_time for e in best)

    def test_episodes_that_are_named(self, tmp_path: Path) -> None:
        path, target = record(tmp_path / "run.mcap", steps=200), tmp_path / "some.mcap"
        dataset = open_dataset(path)
        command = ["filter", str(path), "-o", str(target), "--force"]
        for more, chosen, query in (
            (["--episodes", "1,3-4"], dataset[[1, 3, 4]], "episodes 1,3-4"),
            (["-e", "best"], dataset.sort("return", descending=True).head(1), "episodes best"),
            (
                ["-e", "2-9", "--filter", "n_tuples > 2"],
                dataset[2:10].filter("n_tuples > 2"),
                "n_tuples > 2, e",
            ),
        ):
            result = CliRunner().invoke(app, [*command, *more])
            assert result.exit_code == 0, result.output
            with Recording(target) as kept:
                assert [e.id for e in kept.episodes] == [e.id for e in chosen]
                assert str(kept.made_of["query"]).startswith(query)
        refused = CliRunner().invoke(app, command)
        assert (refused.exit_code, "expected --filter, --episodes or --limit" in refused.stderr) == (2, True)

    def test_damage_is_not_handed_on(self, tmp_path: Path) -> None:
        path = record(tmp_path / "run.mcap", steps=400)
        data = bytearray(path.read_bytes())
        with Recording(path) as recording:
            row = recording._contents.table[3]
        data[int(row["offset"]) + int(row["length"]) // 2] ^= 1
        path.write_bytes(data)
        with pytest.raises(RecordingError.__base__ or Exception, match="damaged|does not fit|cannot be"):
            filter_dataset(open_dataset(path), tmp_path / "some.mcap", "n_tuples > 0")
        assert not (tmp_path / "some.mcap").exists()

    def test_errors(self, tmp_path: Path) -> None:
        path, other = record(tmp_path / "run.mcap"), record(tmp_path / "other.mcap")
        with pytest.raises(RecordingError, match=r"expected an episode that matches .*n_tuples"):
            filter_dataset(open_dataset(path), tmp_path / "no.mcap", F("n_tuples") > 99)
        with pytest.raises(FilterError, match="colour"):
            filter_dataset(open_dataset(path), tmp_path / "no.mcap", "colour = 3")
        with pytest.raises(DatasetError, match="is one of the recordings themselves"):
            filter_dataset(open_dataset(path), path, "n_tuples > 1", overwrite=True)
        with pytest.raises(DatasetError, match="exists; choose another path"):
            filter_dataset(open_dataset(path), other, "n_tuples > 1")
        assert (
            filter_dataset(open_dataset(path), other, "n_tuples > 1", overwrite=True).size
            == other.stat().st_size
        )


def test_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for i in range(2):
        record(Path(f"{i}.mcap"), seed=i)

    def run(*arguments: str, code: int = 0) -> str:
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == code, done.output
        return done.output

    said = json.loads(run("merge", "0.mcap", "1.mcap", "-o", "all.mcap", "--dry-run", "--json"))["result"]
    assert (said["dry_run"], said["recordings"], said["steps"], said["size"]) == (True, 2, 300, 0)
    assert not Path("all.mcap").exists()
    assert "300 steps" in run("merge", "0.mcap", "1.mcap", "-o", "all.mcap")
    assert "exists" in run("merge", "0.mcap", "1.mcap", "-o", "all.mcap", code=1)
    run("merge", "0.mcap", "1.mcap", "-o", "all.mcap", "--force")
    dry = json.loads(run("split", "all.mcap", "-o", "part.mcap", "--episodes", "30", "--dry-run", "--json"))[
        "result"
    ]
    assert not Path("part.mcap").exists()
    assert "part_0001.mcap" in run("split", "all.mcap", "-o", "part.mcap", "--episodes", "30")
    assert [Path(part["path"]).exists() for part in dry["recordings"]] == [True] * len(dry["recordings"])
    assert "either --episodes or --max-bytes" in run("split", "all.mcap", "-o", "x.mcap", code=2)
    kept = json.loads(run("filter", "all.mcap", "--filter", "n_tuples > 3", "-o", "some.mcap", "--json"))[
        "result"
    ]
    assert (kept["path"], kept["episodes"]) == ("some.mcap", len(Recording("some.mcap")))
    assert "would write" in run(
        "filter", "all.mcap", "--filter", "n_tuples > 3", "-o", "none.mcap", "--dry-run"
    )
    assert not Path("none.mcap").exists()
    run("filter", "all.mcap", "--filter", "colour = 1", "-o", "none.mcap", code=2)
    record(Path("text.mcap"), "text")
    refused = ["filter", "0.mcap", "text.mcap", "--filter", "steps > 0", "-o", "none.mcap"]
    assert "only recordings of the same spaces" in run(*refused, code=1)
    assert run(*refused, "--dry-run", code=1) == run(*refused, code=1)


def test_vectorised_copies_of_an_environment_are_no_other_one(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """CartPole steps its copies by a class of its own, of which no EnvSpec tells."""
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "one.mcap") as env:
        env.reset(seed=0)
        env.step(0)
    with RecordVector(gym.make_vec("CartPole-v1", num_envs=2), tmp_path / "two.mcap") as envs:
        envs.reset(seed=0)
        envs.step(np.zeros(2, np.int64))
    with RecordEpisodes(gym.make("CartPole-v1", max_episode_steps=9), tmp_path / "other.mcap") as env:
        env.reset(seed=0)
        env.step(0)
    for first, second in (("one", "two"), ("two", "one")):
        merge_recordings(
            [tmp_path / f"{first}.mcap", tmp_path / f"{second}.mcap"], tmp_path / f"{first}_m.mcap"
        )
    assert not [warning for warning in recwarn if "another environment" in str(warning.message)]
    with pytest.warns(UserWarning, match=r"other.mcap carries another environment than .*one.mcap"):
        merge_recordings([tmp_path / "one.mcap", tmp_path / "other.mcap"], tmp_path / "m.mcap")


@pytest.mark.parametrize("change", ["save", "map", "trim"])
def test_of_a_dataset_whose_file_was_removed_since(tmp_path: Path, change: str) -> None:
    """An open file stays readable, and another one may be replaced."""
    dataset = open_dataset(record(tmp_path / "run.mcap"))
    wanted = dataset[0].rewards.tolist()
    (tmp_path / "run.mcap").unlink()
    target = record(tmp_path / "out.mcap", seed=2)
    given: dict[str, list[Any]] = {
        "save": [],
        "map": [lambda episode: episode.rewards],
        "trim": [slice(None)],
    }
    getattr(dataset, change)(*given[change], target, overwrite=True)
    assert open_dataset(target)[0].rewards.tolist() == wanted
