"""Runs: what a recording says of the run it is of, and annotations: what is said about episodes afterwards."""

from __future__ import annotations

import datetime
import json
import os
import re
import resource
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
from command_line import unprivileged
from counting import calls, grows
from environments import Winning
from gymnasium import spaces
from mcap.reader import make_reader
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import (
    EpisodeWriter,
    F,
    FileStorage,
    FilterLT,
    FormatError,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliDataset,
    TupliEnvWrapper,
    write_rollout,
)
from tupli_mcap.cli.app import app
from tupli_mcap.errors import FilterError, SpaceError
from tupli_mcap.jsonvalue import spelled
from tupli_mcap.recording import (
    Run,
    annotate_episodes,
    edit_runs,
    merge_recordings,
    rewrite_recording,
    undo_annotation,
    undo_edit,
    verify_recording,
)
from tupli_mcap.recording.about.run import RecordedRuns
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.edit.rewrite import carry_runs
from tupli_mcap.schema.times import local_text, time_ns
from tupli_mcap.storage.listing import listed_of
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes

SCHEMAS = Path(__file__).parents[2] / "schemas"
LONG_AGO = "2020-01-01"


def record(path: Path, episodes: int = 3, **options: Any) -> Path:
    with RecordEpisodes(gym.make("CartPole-v1"), path, **options) as env:
        env.action_space.seed(0)
        for seed in range(episodes):
            env.reset(seed=seed)
            ended = False
            while not ended:
                _, _, terminal, timeout, _ = env.step(env.action_space.sample())
                ended = terminal or timeout
        return env.path


def check_schema(path: Path, name: str) -> Any:
    document = json.loads(Recording(path).read_attachment(f"{name}.json"))
    jsonschema.validate(document, json.loads((SCHEMAS / f"{name}.schema.json").read_text()))
    return document


def git(folder: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def command(*words: str) -> str:
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    return result.output


class TestRun:
    def test_says_what_was_given_and_what_the_process_is(self, tmp_path: Path) -> None:
        path = record(
            tmp_path / "r.mcap",
            name="ppo-3",
            metadata={"lr": 3e-4, "net": [64, 64]},
            tags=["a", "b"],
            split="train",
        )
        run = Recording(path).run
        assert (run.name, run.metadata, run.tags, run.split) == (
            "ppo-3", {"lr": 3e-4, "net": [64, 64]}, ("a", "b"), "train",
        )  # fmt: skip
        assert run.environment == "CartPole-v1"
        assert run.command == tuple(sys.orig_argv)
        assert run.versions["numpy"] == np.__version__
        assert len(run.id) == 32
        assert LONG_AGO < run.started < run.ended
        check_schema(path, "run")
        assert verify_recording(path).ok

    def test_keeps_secrets_in_addresses_out(self, tmp_path: Path) -> None:
        program = (
            "import gymnasium as gym, tupli_mcap\n"
            "with tupli_mcap.RecordEpisodes(gym.make('CartPole-v1'), 'r.mcap') as env:  # ://me:this@stays\n"
            "    env.reset(); env.step(0)\n"
        )
        words = {
            "https://ann:SECRET@lab/x.mcap?s=SECRET": "https://lab/x.mcap",
            "--data=s3://a:SECRET@b/x": "--data=s3://b/x",
            "data=['http://a:SECRET@b/x']": "data=['http://b/x']",
            "https://ann:SECRET SECRET@lab/x": "https://lab/x",
            "what? #3": "what? #3",
            "a@b:c": "a@b:c",
        }
        subprocess.run([sys.executable, "-c", program, *words], cwd=tmp_path, check=True)
        command = Recording(tmp_path / "r.mcap").run.command
        assert command[2:] == (program, *words.values())

    @pytest.mark.parametrize("capture", ["none", "versions"])
    def test_keeps_the_process_out(self, capture: Any, tmp_path: Path) -> None:
        run = Recording(record(tmp_path / "r.mcap", capture=capture, name="x")).run
        assert (run.name, run.command, run.git, run.host) == ("x", (), {}, "")
        assert bool(run.versions) == (capture == "versions")

    def test_names_the_commit_of_the_program(self, tmp_path: Path) -> None:
        (tmp_path / "program.py").write_text(
            "import gymnasium as gym, tupli_mcap\n"
            "env = tupli_mcap.RecordEpisodes(gym.make('CartPole-v1'), 'r.mcap', mode='w')\n"
            "env.reset(); env.step(0); env.close()\n"
            "print(tupli_mcap.Recording('r.mcap').run.git)\n"
        )

        def program() -> str:
            words = [sys.executable, "program.py"]
            return subprocess.run(words, cwd=tmp_path, check=True, capture_output=True, text=True).stdout

        git(tmp_path, "init", "-q")
        git(tmp_path, "add", "program.py")
        git(tmp_path, "commit", "-qm", "one")
        commit = git(tmp_path, "rev-parse", "HEAD")
        assert program() == str({"commit": commit, "dirty": False}) + "\n"
        with (tmp_path / "program.py").open("a") as file:
            file.write("# changed\n")
        assert "'dirty': True" in program()

    def test_names_the_commit_of_the_working_directory_for_an_installed_program(self, tmp_path: Path) -> None:
        words = [
            str(Path(sys.executable).parent / "tupli-mcap"),
            "record",
            "CartPole-v1",
            "--steps",
            "1",
            "-o",
        ]

        subprocess.run([*words, "a.mcap"], cwd=tmp_path, check=True)
        assert Recording(tmp_path / "a.mcap").run.git == {}, "the environment may be in a repository"
        git(tmp_path, "init", "-q")
        git(tmp_path, "commit", "-q", "--allow-empty", "-m", "one")
        subprocess.run([*words, "b.mcap"], cwd=tmp_path, check=True)
        assert Recording(tmp_path / "b.mcap").run.git["commit"] == git(tmp_path, "rev-parse", "HEAD")

    def test_has_no_commit_where_the_working_directory_was_deleted(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "gone").mkdir()
        monkeypatch.chdir(tmp_path / "gone")
        (tmp_path / "gone").rmdir()
        assert Recording(record(tmp_path / "a.mcap")).run.git == {}

    def test_without_a_name_has_that_of_the_file(self, tmp_path: Path) -> None:
        assert Recording(record(tmp_path / "walk.mcap")).run.name == "walk"
        golden = Path(__file__).parents[1] / "golden" / "constant_zstd.mcap"
        old = Recording(golden).run
        assert (old.name, old.metadata, old.id) == ("constant_zstd", {}, "")

    def test_is_the_same_in_all_files_of_a_series(self, tmp_path: Path) -> None:
        with RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "r.mcap", max_bytes=8000, chunk_size=1000, name="long"
        ) as env:
            for seed in range(60):
                env.reset(seed=seed)
                while not env.step(0)[2]:
                    pass
            paths = env.paths
        assert len(paths) > 1
        assert len({Recording(path).run.id for path in paths}) == 1

    def test_names_the_file_in_a_directory(self, tmp_path: Path) -> None:
        (tmp_path / "runs").mkdir()
        assert record(tmp_path / "runs", name="a/b c").name.startswith("a_b_c_20")

    @pytest.mark.parametrize(
        ("name", "start"),
        [(".baseline", "baseline_20"), ("../ppo", "_ppo_20"), ("-v.-x", "v.-x_20"), ("..", "run_20"), ("-", "run_20")],
    )  # fmt: skip
    def test_names_no_hidden_file_or_option(self, name: str, start: str, tmp_path: Path) -> None:
        (tmp_path / "runs").mkdir()
        path = record(tmp_path / "runs", name=name)
        assert path.name.startswith(start)
        assert Recording(path).run.name == name
        assert len(TupliDataset(tmp_path / "runs")) > 0

    @pytest.mark.parametrize(
        "options",
        [{"name": 3}, {"tags": "abc"}, {"tags": [3]}, {"metadata": [1]}, {"metadata": {"f": object()}},
         {"split": None}, {"capture": "some"}],
    )  # fmt: skip
    def test_refuses_what_is_no_run(self, options: dict[str, Any], tmp_path: Path) -> None:
        with pytest.raises(RecordingError):
            record(tmp_path / "r.mcap", **options)
        assert not list(tmp_path.iterdir())

    def test_of_a_vector_environment(self, tmp_path: Path) -> None:
        env = gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
        with RecordVectorEpisodes(env, tmp_path / "v.mcap", name="two", metadata={"n": 2}) as recorded:
            recorded.reset(seed=0)
            for _ in range(40):
                recorded.step(np.zeros(2, np.int64))
        assert Recording(tmp_path / "v.mcap").episodes[0].run.metadata == {"n": 2}

    @pytest.mark.parametrize("kind", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
    def test_names_the_environment_that_functions_make(self, kind: Any, tmp_path: Path) -> None:
        env = gym.wrappers.vector.RecordEpisodeStatistics(kind([lambda: gym.make("CartPole-v1")] * 2))
        with RecordVectorEpisodes(env, tmp_path) as recorded:
            recorded.reset(seed=0)
            recorded.step(np.zeros(2, np.int64))
        (path,) = tmp_path.iterdir()
        assert path.name.startswith("CartPole-v1_")
        assert Recording(path).run.environment == "CartPole-v1"

    def test_the_files_of_a_storage_are_called_by_run_and_time(self, tmp_path: Path) -> None:
        for name in ("../../ppo seed 3", None):
            env = TupliEnvWrapper(gym.make("CartPole-v1"), FileStorage(tmp_path / "lab"), name=name)
            env.store("cart")
            env.reset(seed=1)
            env.step(0)
            env.close()
        names = [path.name for path in sorted((tmp_path / "lab" / "recordings").rglob("*.mcap"))]
        assert [re.sub(r"[0-9a-f]{12}\.mcap$|^\d{8}T\d{6}", "", name) for name in names] == [
            "-_.._ppo_seed_3-",
            "-cart-",
        ]

    @pytest.mark.filterwarnings("ignore:all episodes are on one side")  # ids of runs are random
    def test_in_filters_of_files_and_of_a_storage(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path / "lab")
        for i, rate in enumerate((1e-4, 1e-2)):
            told: dict[str, Any] = {"name": f"ppo-{i}", "metadata": {"lr": rate}, "tags": ["ppo", f"try-{i}"]}
            record(tmp_path / f"{i}.mcap", **told)
            env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, **told)
            env.store("cart")
            for seed in range(3):
                env.reset(seed=seed)
                env.step(0)
            env.close()
        for source in (tmp_path / "*.mcap", storage):
            ds = tupli_mcap.open(source)
            assert len(ds) == 6
            assert {episode.run.name for episode in ds.filter("run.metadata.lr < 1e-3")} == {"ppo-0"}
            assert (
                len(ds.filter("run.name = 'ppo-1' and run.started > '1d ago' and run.ended <= '2999-01-01'"))
                == 3
            )
            assert len(ds.filter(f"run.started < '{LONG_AGO}'")) == 0
            for key in (F("run.started"), F("run.ended")):
                for then in (
                    datetime.datetime(2020, 1, 1),
                    datetime.datetime(2020, 1, 1, tzinfo=datetime.UTC),
                ):
                    assert len(ds.filter((key > then) & (key > then.date()))) == 6
                    assert len(ds.filter(FilterLT(key=key.key, value=then))) == 0
            for text in (
                "run.tags = 'try-1'",
                "'try-1' in run.tags",
                "run.tags in ['try-1', 'x']",
                "run.tags != 'try-0'",
            ):
                assert {episode.run.name for episode in ds.filter(text)} == {"ppo-1"}
            assert len(ds.filter("run.tags = 'ppo'")) == 6
            assert {"run.name", "run.metadata.lr", "run.started"} <= set(ds.keys)
            sides = ds.split(0.5, by="run")
            for side in sides:
                assert len(side) % 3 == 0
            with pytest.raises(FilterError, match="did you mean 'lr'"):
                ds.filter("run.metadata.lrr > 3")
            with pytest.raises(FilterError, match="did you mean 'started'"):
                ds.filter("run.startd = 'x'")
            with pytest.raises(FilterError, match="is a time"):
                ds.filter("run.started > 3")

    def test_of_each_episode_stays_when_recordings_are_merged(self, tmp_path: Path) -> None:
        paths = [record(tmp_path / f"{i}.mcap", name=f"worker-{i}") for i in range(3)]
        annotate_episodes(paths[1], {"success": True}, [0, 2])
        merge_recordings(paths, tmp_path / "all.mcap")
        merged = Recording(tmp_path / "all.mcap")
        assert [episode.run.name for episode in merged.episodes] == [f"worker-{i // 3}" for i in range(9)]
        assert [episode.metadata.get("success") for episode in merged.episodes] == [
            None, None, None, True, None, True, None, None, None,
        ]  # fmt: skip
        check_schema(tmp_path / "all.mcap", "run")
        rewrite_recording(merged, tmp_path / "some.mcap", episodes=[1, 5, 6])
        some = Recording(tmp_path / "some.mcap")
        assert [episode.run.name for episode in some.episodes] == ["worker-0", "worker-1", "worker-2"]
        assert [episode.metadata for episode in some.episodes] == [{}, {"success": True}, {}]
        assert len(tupli_mcap.open(tmp_path / "some.mcap").filter("run.name = 'worker-2'")) == 1
        assert verify_recording(tmp_path / "some.mcap").ok

    def test_of_many_runs_are_carried_in_time_that_grows_with_them(self, tmp_path: Path) -> None:
        recording = of_many_runs(tmp_path / "r.mcap", [{"name": f"run-{i}"} for i in range(200)])

        def carried(runs: int) -> int:
            return calls(lambda: carry_runs([(recording, recording.index[:runs], 0)]))

        assert len(recording.recorded_runs.runs) == 200
        assert grows(carried, 50) < 1.3

    def test_of_many_runs_are_read_back_and_merged(self, tmp_path: Path) -> None:
        about = [{"name": f"run-{i}", "metadata": {"notes": f"{i} " * 2000}} for i in range(300)]
        first = of_many_runs(tmp_path / "a.mcap", about[:200])
        second = of_many_runs(tmp_path / "b.mcap", about[200:])
        assert first.attachments["run.json"].size > 1 << 20
        merge_recordings([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "all.mcap")
        with Recording(tmp_path / "all.mcap") as merged:
            assert [(run.name, run.metadata) for run in merged.runs] == [
                (run["name"], run["metadata"]) for run in about
            ]
            assert merged.run_places == list(range(300))
        assert len(second.runs) == 100
        assert verify_recording(tmp_path / "all.mcap").ok
        chosen = tupli_mcap.open(tmp_path / "all.mcap").filter("run.name = 'run-299'")
        assert [header.episode for header in chosen.headers] == [299]

    def test_of_more_runs_than_a_recording_holds_are_refused(self, tmp_path: Path) -> None:
        long = Run(metadata={"notes": "n" * (1 << 20)})
        with pytest.raises(
            RecordingError, match=r"run\.json of 64 runs: expected at most 67108864 bytes, found"
        ):
            RecordedRuns([long] * 64).to_json()
        with pytest.raises(
            RecordingError, match="metadata of the run: expected at most 1048576 bytes, found"
        ):
            record(tmp_path / "r.mcap", metadata=long.metadata)
        path = record(tmp_path / "r.mcap")
        add_attachments(path, {"run.json": ("application/json", b" " * ((64 << 20) + 1))})
        with Recording(path) as recording:
            assert len(recording.read().rewards) > 0
            with pytest.raises(
                FormatError, match=r"run\.json: expected at most 67108864 bytes, found 67108865"
            ):
                _ = recording.runs

    def test_of_the_episodes_that_ls_chooses(self, tmp_path: Path) -> None:
        paths = [
            record(tmp_path / f"{i}.mcap", 1, name=f"w{i}", tags=[f"tag{i}"], metadata={"lr": i, "gamma": 1})
            for i in range(3)
        ]
        path = str(tmp_path / "all.mcap")
        merge_recordings(paths, path)

        def told(filter: str) -> list[list[Any]]:
            words = ["--filter", filter, "--columns", "run,tags,episodes,settings,size", "--json"]
            return [list(row.values()) for row in json.loads(command("ls", path, *words))["result"]]

        size = Path(path).stat().st_size
        first, second = (
            ["w1", ["tag1"], 1, {"lr": 1, "gamma": 1}],
            ["w2", ["tag2"], 1, {"lr": 2, "gamma": 1}],
        )
        assert told('run.name = "w1"') == [[*first, size]]
        assert told('run.name != "w0"') == [[*first, size], [*second, None]]  # the file counts once
        served = list(listed_of(tupli_mcap.open(path).filter('run.name != "w0"').headers))
        assert [[row.name, list(row.tags), row.episodes, row.settings] for row in served] == [first, second]

    def test_can_be_edited(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", metadata={"lr": 1, "old": 2})
        before = Recording(path)
        edit_runs(path, name="dry", dry_run=True)
        assert Recording(path).run == before.run
        edit_runs(path, name="better", metadata={"lr": 2, "old": None}, tags=["x"], split="eval")
        after = Recording(path)
        assert (after.run.name, after.run.metadata, after.run.tags, after.run.split) == (
            "better", {"lr": 2}, ("x",), "eval",
        )  # fmt: skip
        assert (after.uuid, after.run.id, after.run.started) == (
            before.uuid,
            before.run.id,
            before.run.started,
        )
        np.testing.assert_array_equal(after.read().states, before.read().states)
        assert verify_recording(path).ok

    def test_keeps_what_was_recorded_as_none(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", metadata={"target_kl": None, "old": None})
        edit_runs(path, name="better", metadata={"lr": 2, "old": None})
        assert Recording(path).run.metadata == {"target_kl": None, "lr": 2}

    @pytest.mark.parametrize(
        "data",
        [b"{", b"[]", b'{"runs": []}', b'{"runs": [3]}', b'{"runs": [{"name": 3}]}', b'{"runs": [{"tags": "a"}]}',
         b'{"runs": [{}], "spans": [[1, 1]]}', b'{"runs": [{}], "spans": [[true, 0]]}', b"\xff",
         b'{"runs": [{}], "before": [{"place": 1}]}', b'{"runs": [{}], "before": [3]}'],
    )  # fmt: skip
    def test_that_is_damaged_is_said(self, data: bytes, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        add_attachments(path, {"run.json": ("application/json", data)})
        recording = Recording(path)
        assert recording.read().states.shape[1:] == (4,)
        with pytest.raises(FormatError, match=r"run\.json"):
            _ = recording.run
        assert not verify_recording(path).ok

    def test_with_paths_in_its_metadata(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", metadata={"out": Path("a/b"), "more": [{"in": Path("c")}]})
        assert Recording(path).run.metadata == {"out": "a/b", "more": [{"in": "c"}]}


class TestEdits:
    def test_can_be_taken_back(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", name="ppo", metadata={"lr": 1}, tags=["a"])
        command("edit", str(path), "--name", "sac", "--set", "lr=2", "--set", "seed=3")
        command("edit", str(path), "--tag", "b", "--split", "eval")
        assert Recording(path).run.tags == ("b",)
        told = command("edit", str(path), "--undo", "--dry-run")
        assert [line.split(maxsplit=1)[0] for line in told.splitlines()] == [
            "would",
            "run",
            "tags",
            "settings",
        ]
        (run,) = undo_edit(path)
        assert (run.name, run.tags, run.split, run.metadata) == ("sac", ("a",), "", {"lr": 2, "seed": 3})
        assert "ppo" in command("edit", str(path), "--undo")
        again = Recording(path).run
        assert (again.name, again.metadata, again.started) == ("ppo", {"lr": 1}, run.started)
        with pytest.raises(RecordingError, match="there is no edit to undo"):
            undo_edit(path)
        assert CliRunner().invoke(app, ["edit", str(path), "--undo", "--name", "x"]).exit_code == 2
        for number in range(30):
            edit_runs(path, name=f"{number}")
        document = json.loads(Recording(path).read_attachment("run.json"))
        jsonschema.validate(document, json.loads((SCHEMAS / "run.schema.json").read_text()))
        assert len(document["before"]) == 20

    def test_of_several_runs_change_those_that_are_chosen(self, tmp_path: Path) -> None:
        path = tmp_path / "all.mcap"
        runs = [{"name": f"w{i}", "metadata": {"lr": i}} for i in range(3)]
        merge_recordings([record(tmp_path / f"{i}.mcap", 2, **runs[i]) for i in range(3)], path)

        def names() -> list[str]:
            return [run.name for run in Recording(path).runs]

        told = json.loads(
            command("edit", str(path), "--filter", "run.metadata.lr > 0", "--name", "x", "--json")
        )["result"]
        assert [(one["path"], one["run"]["metadata"]) for one in told] == [
            (str(path), {"lr": i}) for i in (1, 2)
        ]
        assert names() == ["w0", "x", "x"]
        check_schema(path, "run")
        edit_runs(path, [0, 1], metadata={"lr": None, "gamma": 1})
        assert [run.metadata for run in Recording(path).runs] == [{"gamma": 1}, {"gamma": 1}, {"lr": 2}]
        record(path, 1, mode="a", name="w2", metadata={"lr": 2})  # as the last one was given
        assert names() == ["w0", "x", "x"]
        rewrite_recording(Recording(path), tmp_path / "some.mcap", episodes=[3, 4])
        assert [run.name for run in undo_edit(tmp_path / "some.mcap")] == ["x", "w2"]
        assert [run.metadata for run in undo_edit(path, [1])] == [{"lr": 1}]
        told = json.loads(command("edit", str(path), "--undo", "--json"))["result"]
        assert [one["run"]["name"] for one in told] == ["w0", "w1", "w2"]
        assert [(run.name, run.metadata) for run in Recording(path).runs] == [
            (run["name"], run["metadata"]) for run in runs
        ]
        with pytest.raises(RecordingError, match="there is no edit to undo"):
            undo_edit(path)
        with pytest.raises(RecordingError, match="expected places of its 3 runs, from 0, found 3"):
            edit_runs(path, [0, 3], name="x")
        with pytest.raises(
            RecordingError, match=r"expected places in Recording\.runs, found \[True, False\]"
        ):
            edit_runs(path, [True, False], name="x")
        edit_runs(path, tags=iter(["a"]))  # type: ignore[arg-type]
        assert [run.tags for run in Recording(path).runs] == [("a",)] * 3
        assert verify_recording(path).ok

    def test_before_there_were_places_are_of_the_only_run(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", 1, name="new")
        document = json.loads(Recording(path).read_attachment("run.json"))
        document["before"] = [{"name": "old"}]
        add_attachments(path, {"run.json": ("application/json", json.dumps(document).encode())})
        record(path, 1, mode="a", name="other")
        assert [run.name for run in undo_edit(path)] == ["old"]


class TestAnnotations:
    def test_a_dataset_sees_those_that_were_made_through_it(self, tmp_path: Path) -> None:
        ds = tupli_mcap.open(record(tmp_path / "r.mcap"))
        best = ds.sort("return").head(1)
        best[0].annotate(good=True)
        assert [episode.id for episode in ds.filter("metadata.good")] == [best[0].id]
        assert len(best.filter("metadata.good")) == 1

    @pytest.mark.parametrize(
        ("word", "value"), [("True", True), ("false", False), ("1e3", 1000.0), ("yes", "yes")]
    )
    def test_of_the_command_line(self, word: str, value: Any, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        assert f"good={spelled(value)}\n" in command("tag", str(path), f"good={word}", "--episode", "0")
        assert Recording(path).episodes[0].metadata["good"] is value or value not in (True, False)
        assert re.search(
            r"^annotated +once by .+, 20.+: 1 episode$", command("info", str(path)), re.MULTILINE
        )
        assert "annotated" not in command("info", str(path), "--episodes", "1")

    def test_count_more_than_what_was_recorded(self, tmp_path: Path) -> None:
        class Callback(tupli_mcap.EpisodeMetadataCallback):
            def reset(self) -> None: ...

            def __call__(self, tuple: Any) -> dict[str, Any]:
                return {"score": 1, "success": False}

        path = record(tmp_path / "r.mcap", metadata_callback=Callback())
        ds = tupli_mcap.open(path)
        ds[1].annotate(success=True, note="gripper slipped")
        assert ds[1].metadata == {"score": 1, "success": True, "note": "gripper slipped"}
        assert ds[0].metadata == {"score": 1, "success": False}
        assert (ds[0].success, ds[1].success) == (False, True)
        ds[0].annotate(success=None)
        assert ds[0].success is None and ds[0].undo_annotation().values == {"success": None}
        again = tupli_mcap.open(path)
        assert [episode.number for episode in again.filter("metadata.success")] == [1]
        assert Recording(path).recorded_metadata(1) == {"score": 1, "success": False}
        annotate_episodes(path, {"note": None, "score": 2.5})
        assert [episode.metadata for episode in Recording(path).episodes] == [
            {"score": 2.5, "success": False},
            {"score": 2.5, "success": True},
            {"score": 2.5, "success": False},
        ]
        (first, last) = Recording(path).annotations.said
        assert (first.episodes, last.episodes) == ([1], [0, 1, 2])
        assert LONG_AGO < first.at <= last.at
        check_schema(path, "annotations")
        assert undo_annotation(path).values == {"note": None, "score": 2.5}
        assert Recording(path).episodes[1].metadata["note"] == "gripper slipped"
        assert verify_recording(path).ok

    def test_are_taken_back_in_python(self, tmp_path: Path) -> None:
        for name in ("a", "b", "c"):
            record(tmp_path / f"{name}.mcap")
        dataset = tupli_mcap.open([tmp_path / "a.mcap", tmp_path / "b.mcap"])
        dataset.annotate(good=True)
        episode = dataset[0]
        episode.annotate(note="gripper slipped")
        assert episode.metadata == dataset.headers[0].metadata == {"good": True, "note": "gripper slipped"}
        assert episode.undo_annotation().values == {"note": "gripper slipped"}
        assert episode.metadata == dataset.headers[0].metadata == {"good": True}
        assert [last.values for last in tupli_mcap.open(tmp_path).undo_annotation()] == [{"good": True}] * 2
        assert {len(episode.metadata) for episode in tupli_mcap.open(tmp_path)} == {0}
        with pytest.raises(RecordingError, match="expected an annotation to take back, found none"):
            tupli_mcap.open(tmp_path).undo_annotation()
        annotate_episodes(tmp_path / "a.mcap", {"good": False})
        with Recording(tmp_path / "a.mcap") as recording:
            assert recording.undo_annotation(dry_run=True) == recording.undo_annotation()
            assert [one.metadata for one in recording.episodes] == [{}] * len(recording)

    def test_are_seen_by_a_storage(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path / "lab")
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
        env.store("cart")
        for seed in range(3):
            env.reset(seed=seed)
            env.step(0)
        env.close()
        assert len(storage.list_episodes()) == 3
        (path,) = (tmp_path / "lab").rglob("*.mcap")
        annotate_episodes(path, {"good": True}, [2])
        assert [header.metadata for header in storage.list_episodes()] == [{}, {}, {"good": True}]
        assert [header.episode for header in tupli_mcap.open(storage).filter("metadata.good").headers] == [2]

    def test_do_not_touch_steps(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        with path.open("rb") as file:
            before = [(message.sequence, message.data) for _, _, message in make_reader(file).iter_messages()]
        annotate_episodes(path, {"x": 1})
        with path.open("rb") as file:
            assert [(m.sequence, m.data) for _, _, m in make_reader(file).iter_messages()] == before

    @pytest.mark.parametrize(
        ("values", "episodes"), [({"x": 1}, [7]), ({}, [0]), ({"x": 1}, []), ({"x": object()}, [0])]
    )
    def test_refuse_what_has_no_meaning(self, values: Any, episodes: Any, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        before = path.read_bytes()
        with pytest.raises(RecordingError):
            annotate_episodes(path, values, episodes)
        with pytest.raises(RecordingError, match="no annotation"):
            undo_annotation(path)
        assert path.read_bytes() == before

    def test_of_several_people_at_once_are_all_kept_or_refused(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")

        def annotate(i: int) -> bool:
            try:
                annotate_episodes(path, {f"key{i}": i})
            except RecordingError:  # another one is writing
                return False
            return True

        with ThreadPoolExecutor(4) as people:
            kept = list(people.map(annotate, range(40)))
        assert any(kept)
        with Recording(path) as recording:
            found = {int(key[3:]) for key in recording.episodes[0].metadata if key.startswith("key")}
        assert found == {i for i, is_kept in enumerate(kept) if is_kept}

    def test_wait_for_the_end_of_the_recording(self, tmp_path: Path) -> None:
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
            env.reset()
            env.step(0)
            with pytest.raises(RecordingError):
                annotate_episodes(tmp_path / "r.mcap", {"x": 1})

    def test_take_a_signature_away_and_are_covered_by_one(self, tmp_path: Path) -> None:
        from signing_keys import write_key

        from tupli_mcap.errors import SignatureError
        from tupli_mcap.recording.sign.sign import sign_recording, verify_signature

        key = write_key(tmp_path / "id")
        path = record(tmp_path / "r.mcap")
        sign_recording(path, key)
        with pytest.warns(UserWarning, match="its signature .* left out"):
            annotate_episodes(path, {"x": 1})
        assert "signature.ed25519" not in Recording(path).attachments
        sign_recording(path, key)
        said = Recording(path).read_attachment("annotations.json")
        assert verify_signature(Recording(path)).public_key == key.public_key
        add_attachments(path, {"annotations.json": ("application/json", said.replace(b'"x":1', b'"x":2'))})
        with pytest.raises(SignatureError, match="annotations.json. was changed after signing"):
            verify_signature(Recording(path))

    @pytest.mark.parametrize(
        "data",
        [
            b"{}",
            b"[3]",
            b'[{"episodes": [-1], "values": {}, "by": "", "at": ""}]',
            b'[{"episodes": [0], "values": {"$dict": [[1, 2]]}, "by": "", "at": ""}]',
            b"\xff",
        ],
    )
    def test_that_are_damaged_are_said(self, data: bytes, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        add_attachments(path, {"annotations.json": ("application/json", data)})
        with pytest.raises(FormatError, match=r"annotations\.json"):
            _ = Recording(path).annotations
        assert not verify_recording(path).ok


@pytest.mark.parametrize("record_info", [False, True])
@pytest.mark.parametrize("key", ["is_success", "success"])
def test_success_is_understood(key: str, record_info: bool, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(Winning(key), path, record_info=record_info) as env:
        for action in (1, 0, 1, 1):
            env.reset()
            env.step(action)
    found = [episode.metadata for episode in Recording(path).episodes]
    assert found == [{"success": True}, {"success": False}, {"success": True}, {"success": True}]
    assert verify_recording(path).ok
    (listed,) = json.loads(command("ls", str(path), "--json"))["result"]
    assert listed["success"] == 0.75
    assert "75%" in command("ls", str(path))
    assert "75%" in command("info", str(path))


FLAGS = [
    (np.array([True]), True), (np.array(1.0), True), (np.array([[0]]), False), (np.float32(1), True), (1, True),
    (0.7, None), (np.array([1, 1]), None), (np.array([0.5]), None), ("yes", None),
]  # fmt: skip


class Telling(Winning):
    """Its episodes end with these flags, one after the other; each has a step before that says nothing."""

    def __init__(self, flags: list[Any]) -> None:
        super().__init__()
        self.left, self.steps = flags * 2, 0

    def step(self, action: Any) -> Any:
        self.steps += 1
        ends = self.steps % 2 == 0
        return 1, 1.0, ends, False, {self.key: self.left.pop(0)} if ends else {}


@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("kind", ["plain", "infos", "sb3", "vector", "writer", "writer of many"])
def test_what_counts_as_success(kind: str, tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    path, flags = tmp_path / "r.mcap", [flag for flag, _ in FLAGS]
    if kind.startswith("writer"):
        with EpisodeWriter(path, Winning.observation_space, Winning.action_space) as writer:
            for flag in flags:
                writer.begin()
                writer.step(0, 1, 1.0)
                if kind == "writer":
                    writer.step(0, 1, 1.0, True, info={"success": flag})
                else:
                    zero = np.zeros(1, np.int64)
                    writer.steps(zero, zero, np.ones(1), np.ones(1, bool), infos=[{"success": flag}])
                writer.end(1)
    elif kind == "vector":
        # a vector environment makes one array of what its sub-environments say
        for flag in flags:
            made = gym.vector.SyncVectorEnv([partial(Telling, [flag])] * 2)
            with RecordVectorEpisodes(made, path, mode="a") as recorded:
                recorded.reset()
                recorded.step(np.zeros(2, np.int64))
                recorded.step(np.zeros(2, np.int64))
    else:
        env: Any
        if kind == "sb3":
            dummy = pytest.importorskip("stable_baselines3.common.vec_env").DummyVecEnv
            from tupli_mcap.sb3 import VecRecordEpisodes

            env = VecRecordEpisodes(dummy([lambda: Telling(flags)]), path)
        else:
            env = RecordEpisodes(Telling(flags), path, record_info=kind == "infos")
        env.reset()
        for i in range(2 * len(flags)):
            env.step(np.array([0]) if kind == "sb3" else 0)
            if i % 2 and kind != "sb3":
                env.reset()
        env.close()
    found = [episode.metadata for episode in Recording(path).episodes if not episode.env]
    assert found == [{} if said is None else {"success": said} for _, said in FLAGS]
    told = [str(one.message) for one in recwarn if "success" in str(one.message)]
    assert len(told) == (4 if kind == "vector" else 1)  # one a recorder
    assert told[0].startswith(f"{path}: expected True, False, 0, 1, or an array of one of these in the info")
    assert "0.7" in told[0] and "; the episode gets no success" in told[0]


@pytest.mark.filterwarnings("error")
def test_a_warning_that_is_an_error_loses_nothing(tmp_path: Path) -> None:
    with RecordEpisodes(Telling([0.7, True]), tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
        with pytest.raises(UserWarning, match="is_success=0.7"):
            env.step(0)
        env.reset()
        env.step(0)
        env.step(0)
    assert [episode.metadata for episode in Recording(env.path).episodes] == [{}, {"success": True}]


@pytest.mark.parametrize("kind", ["single", "sb3", *gym.vector.AutoresetMode])
@pytest.mark.parametrize("record_info", [False, True])
def test_an_interrupted_episode_has_no_success(kind: Any, record_info: bool, tmp_path: Path) -> None:
    class Always(Winning):
        """Its infos say it at every step of an episode of three."""

        steps = 0

        def reset(self, **kwargs: Any) -> Any:
            self.steps = 0
            return super().reset(**kwargs)

        def step(self, action: Any) -> Any:
            self.steps += 1
            return 1, 1.0, self.steps == 3, False, {"is_success": True}

    path, action = tmp_path / "r.mcap", np.array([1])
    options: dict[str, Any] = {"record_info": record_info}
    env: Any
    if kind == "single":
        env, action = RecordEpisodes(Always(), path, **options), 1
    elif kind == "sb3":
        dummy = pytest.importorskip("stable_baselines3.common.vec_env").DummyVecEnv
        from tupli_mcap.sb3 import VecRecordEpisodes

        env = VecRecordEpisodes(dummy([Always]), path, **options)
    else:
        env = RecordVectorEpisodes(gym.vector.SyncVectorEnv([Always], autoreset_mode=kind), path, **options)
    env.reset()
    for _ in range(3):
        env.step(action)
    if kind != "sb3" and kind != gym.vector.AutoresetMode.SAME_STEP:
        env.reset()
    env.step(action)
    env.close()
    found = [(episode.end, episode.metadata) for episode in Recording(path).episodes]
    assert found == [("terminal", {"success": True}), ("interrupted", {})]


@pytest.mark.parametrize("autoreset", list(gym.vector.AutoresetMode))
@pytest.mark.parametrize("record_info", [False, True])
def test_success_of_sub_environments_is_understood(autoreset: Any, record_info: bool, tmp_path: Path) -> None:
    class Sometimes(Winning):
        """Its first two episodes say nothing."""

        episodes = 0

        def step(self, action: Any) -> Any:
            self.episodes += 1
            info = {} if self.episodes < 3 else {"is_success": bool(action)}
            return 1, 1.0, True, False, info

    env = gym.vector.SyncVectorEnv([Sometimes, Sometimes], autoreset_mode=autoreset)
    with RecordVectorEpisodes(env, tmp_path / "v.mcap", record_info=record_info) as recorded:
        recorded.reset(seed=0)
        for _ in range(12):
            _, _, terminals, _, _ = recorded.step(np.array([1, 0]))
            if autoreset == gym.vector.AutoresetMode.DISABLED:
                recorded.reset(options={"reset_mask": terminals})
    recording = Recording(tmp_path / "v.mcap")
    assert len(recording) >= 10
    for env_number in (0, 1):
        found = [episode.metadata for episode in recording.episodes if episode.env == env_number]
        assert found == [{}] * 2 + [{"success": env_number == 0}] * (len(found) - 2)
    assert verify_recording(tmp_path / "v.mcap").ok


class TestCommands:
    def test_ls_filters_sorts_and_chooses_columns(self, tmp_path: Path) -> None:
        for i in range(3):
            record(
                tmp_path / f"{i}.mcap",
                episodes=i + 1,
                name=f"run-{i}",
                metadata={"lr": 10.0**-i},
                tags=["a", "b"],
            )
        lines = command("ls", str(tmp_path), "--sort", "-episodes", "--columns", "run,episodes").splitlines()
        assert [line.split() for line in lines] == [
            ["RUN", "EPISODES"], ["run-2", "3"], ["run-1", "2"], ["run-0", "1"],
        ]  # fmt: skip
        lines = command(
            "ls", str(tmp_path), "--sort", "-settings", "--columns", "settings,tags,split"
        ).splitlines()
        assert [line.split()[0] for line in lines] == ["SETTINGS", "lr=1", "lr=0.1", "lr=0.01"]
        lines = command(
            "ls",
            str(tmp_path),
            "--sort",
            "-run.metadata.lr",
            "--columns",
            "run,run.metadata.lr,run.metadata.x",
        ).splitlines()
        assert [line.split() for line in lines] == [
            ["RUN", "RUN.METADATA.LR", "RUN.METADATA.X"], ["run-0", "1.0"], ["run-1", "0.1"], ["run-2", "0.01"],
        ]  # fmt: skip
        found = json.loads(command("ls", str(tmp_path), "--columns", "run.metadata.lr,Run", "--json"))[
            "result"
        ]
        assert found[0] == {"run.metadata.lr": 1, "run": "run-0"}
        shown = command("episodes", str(tmp_path / "0.mcap"), "--columns", "run,run.tags").splitlines()
        assert [line.split() for line in shown] == [["RUN", "RUN.TAGS"], ["run-0", "a,", "b"]]
        found = json.loads(
            command("ls", str(tmp_path), "--filter", "run.metadata.lr < 0.5 and seed = 0", "--json")
        )["result"]
        assert [(one["run"], one["episodes"]) for one in found] == [("run-1", 1), ("run-2", 1)]
        for text, meant in (
            ("name = 'x'", "run.name"),
            ("run.metadata.lrr = 3", "lr"),
            ("run.nam = 3", "name"),
        ):
            for listing in ("ls", "episodes"):
                wrong = CliRunner().invoke(app, [listing, str(tmp_path), "--filter", text])
                assert wrong.exit_code != 0
                assert wrong.output.count(f"did you mean {meant!r}") == 1
        for numbers, text, here, below in (
            ("0", "100% of 1", "100% (1 of 3 episodes say it)", "100% (1 of 6 episodes say it)"),
            ("1-2", "33%", "33%", "33% (3 of 6 episodes say it)"),
        ):
            command(
                "tag",
                str(tmp_path / "2.mcap"),
                "--episodes",
                numbers,
                f"success={json.dumps(numbers == '0')}",
            )
            assert text in command("ls", str(tmp_path / "2.mcap"), "--columns", "success")
            assert f"{here}\n" in command("info", str(tmp_path / "2.mcap"))
            assert f"{below}\n" in command("info", str(tmp_path))
        with pytest.raises(RecordingError, match="is a directory; give one file"):
            edit_runs(tmp_path, name="x")
        dated = CliRunner().invoke(app, ["ls", str(tmp_path), "--sort", "date"])
        assert "did you mean 'started'" in dated.output
        (tmp_path / "empty").mkdir()
        assert command("ls", str(tmp_path / "empty"), "--filter", "return > 3") == "no recording matches\n"
        wrong = CliRunner().invoke(app, ["ls", str(tmp_path), "--sort", "retrn"])
        assert wrong.exit_code == 2
        assert "did you mean 'return'" in wrong.output

    def test_a_filter_for_what_no_run_has_says_what_is_meant(self, tmp_path: Path) -> None:
        for seed in range(2):
            record(tmp_path / f"{seed}.mcap", 1, name=f"ppo-seed{seed}", split="train")
        for key, wrong, right in (
            ("run.name", "ppo-sed1", "ppo-seed1"),
            ("run.split", "trian", "train"),
            ("run.environment", "CartPole-v0", "CartPole-v1"),
        ):
            for words in (("ls",), ("episodes",), ("episodes", "--sort", "return"), ("episodes", "--json")):
                for text in (f'{key} = "{wrong}"', f'steps > 0 and {key} in ["{wrong}"]'):
                    done = CliRunner().invoke(app, [*words, str(tmp_path), "--filter", text])
                    assert done.exit_code == 0
                    assert done.stderr == f"warning: no {key} is '{wrong}' (did you mean '{right}'?)\n"
        for text, kinds in (
            ("run.name = 3", "run.name is a text, such as ppo-seed0, and never a number"),
            ("run.name in [true]", "run.name is a text, such as ppo-seed0, and never true or false"),
        ):
            done = CliRunner().invoke(app, ["ls", str(tmp_path), "--filter", text])
            assert done.stderr == f"warning: {kinds}\n"
        for line in (
            "ls -e best", "episodes -e best", "info", "info -e best", "doctor", "doctor -e best", "tag a=1",
            "tag a=1 -e best", "delete", "verify --rerun", "plot -o x.png", "view --save x.rrd", "render -o x.gif",
            "filter -o x.mcap", "filter -e best -o x.mcap", "trim --steps 1: -o x.mcap",
            "trim -e best --steps 1: -o x.mcap",
        ):  # fmt: skip
            name, *words = line.split()
            given = [name, str(tmp_path), *words, "--filter"]
            done = CliRunner().invoke(app, [*given, "run.name = 'ppo-sed1'"])
            hint = "warning: no run.name is 'ppo-sed1' (did you mean 'ppo-seed1'?)\n"
            assert done.stderr.startswith(hint), line
            done = CliRunner().invoke(app, [*given, "metadata.color = 1"])
            assert (done.exit_code, done.stderr.count("no episode has metadata.color")) == (2, 1), line
        far = CliRunner().invoke(
            app, ["ls", str(tmp_path), "--filter", "run.name = 'sac' or run.name = 'ppo-seed1' and steps < 0"]
        )
        assert (far.stdout, far.stderr) == ("no recording matches\n", "")

    def test_info_leaves_out_bounds_that_say_nothing(self, tmp_path: Path) -> None:
        states, actions = np.zeros((3, 4)), np.zeros(3, np.int64)
        write_rollout(tmp_path / "w.mcap", states, actions, np.ones(3))
        told = command("info", str(tmp_path / "w.mcap"))
        assert re.search(
            r"^observation +4 numbers \(float64\)\naction +1 number \(int64\)$", told, re.MULTILINE
        )

    def test_filter_takes_a_directory(self, tmp_path: Path) -> None:
        for i in range(2):
            record(tmp_path / "runs" / f"{i}.mcap", episodes=i + 2, name=f"run-{i}")
        target = str(tmp_path / "o.mcap")
        words = "filter", str(tmp_path / "runs"), "--filter", "run.name in ['run-0', 'run-1']", "-o", target
        assert command(*words, "--dry-run").startswith(f"would write {target}: 5 episodes")
        assert not Path(target).exists()
        command(*words)
        assert {e.run.name for e in Recording(target).episodes} == {"run-0", "run-1"}
        again = CliRunner().invoke(app, words)
        assert again.exit_code == 1
        assert "o.mcap exists; choose another path, or pass --force" in again.output
        command(*words, "--force")

    def test_tag_and_edit(self, tmp_path: Path, capsys: Any) -> None:
        path = str(record(tmp_path / "r.mcap"))
        command("tag", path, "--episodes", "0,2", "success=true", "note=gripper slipped", "grade=1.5")
        assert Recording(path).episodes[2].metadata == {
            "success": True,
            "note": "gripper slipped",
            "grade": 1.5,
        }
        command("tag", path, "--filter", "metadata.grade > 1", "grade=", "--dry-run")
        assert Recording(path).episodes[0].metadata["grade"] == 1.5
        command("tag", path, "--filter", "metadata.grade > 1", "grade=")
        assert "grade" not in Recording(path).episodes[0].metadata
        command("tag", path, "--undo")
        assert Recording(path).episodes[0].metadata["grade"] == 1.5
        command("tag", path, "--episodes", "0", "much=1e400")
        assert Recording(path).episodes[0].metadata["much"] == "1e400"
        long = "a " * 150  # no file may have such a name
        command("tag", path, "--episodes", "0", f"note={long}")
        assert Recording(path).episodes[0].metadata["note"] == long
        wrong = CliRunner().invoke(app, ["edit", path, f"note={long}"])
        assert "is no recording; to change metadata of the run, give --set note=a a" in wrong.output
        wrong = CliRunner().invoke(app, ["edit", path, "lr=0.5"])
        assert "lr=0.5 is no recording; to change metadata of the run, give --set lr=0.5" in wrong.output
        command(
            "edit",
            path,
            "--name",
            "best",
            "--set",
            "lr=0.5",
            "--set",
            "algo=ppo",
            "--tag",
            "x",
            "--split",
            "eval",
        )
        run = Recording(path).run
        assert (run.name, run.metadata, run.tags, run.split) == (
            "best",
            {"lr": 0.5, "algo": "ppo"},
            ("x",),
            "eval",
        )
        other = str(record(tmp_path / "other.mcap"))
        command("edit", path, other, "--split", "train")
        assert {Recording(one).run.split for one in (path, other)} == {"train"}
        unsaid = CliRunner().invoke(app, ["tag", path, "x=1"])
        assert "--episodes all" in unsaid.output
        assert "x" not in Recording(path).episodes[0].metadata
        for words in (
            ["tag", path],
            ["tag", path, "x=1"],
            ["tag", "x=1"],
            ["edit", path],
            ["edit", path, "--set", "novalue"],
        ):
            assert CliRunner().invoke(app, words).exit_code == 2

    def test_tag_in_a_directory(self, tmp_path: Path) -> None:
        for name, count in (("a", 1), ("deep/b", 3), ("c", 0)):
            record(tmp_path / "runs" / f"{name}.mcap", count)
        runs = str(tmp_path / "runs")
        told = command("tag", runs, "--filter", "episode >= 1", "late=true")
        assert told == f"{runs}/deep/b.mcap: 2 episodes annotated: late=true\n"
        data = tupli_mcap.open(runs)
        assert [e.metadata.get("late") for e in data] == [None, None, True, True]
        assert CliRunner().invoke(app, ["tag", runs, "--filter", "episode > 9", "late=true"]).exit_code == 1
        sweep = record(tmp_path / "lr=0.1" / "run.mcap", 1)
        command("tag", str(sweep.parent), "--episodes", "all", "good=true")
        assert Recording(sweep).episodes[0].metadata == {"good": True}
        told = f"{runs}/deep/b.mcap: took late=true back from 2 episodes\n"
        assert command("tag", runs, "--undo", "--dry-run") == told.replace("took", "would take")
        assert CliRunner().invoke(app, ["tag", runs, "--undo", "--episodes", "1"]).exit_code == 2
        none = CliRunner().invoke(app, ["tag", runs, "--undo", "--filter", 'recording ~ "a.mcap"'])
        assert (none.exit_code, none.output) == (1, f"error: there is no note to take back in {runs}\n")
        assert command("tag", runs, "--undo") == told
        assert not any(e.metadata for e in tupli_mcap.open(runs))
        assert CliRunner().invoke(app, ["tag", runs, "--undo"]).exit_code == 1

    def test_annotating_a_dataset(self, tmp_path: Path) -> None:
        for name, count in (("a", 1), ("deep/b", 3)):
            record(tmp_path / f"{name}.mcap", count)
        everything = tupli_mcap.open(tmp_path)
        late = everything.filter("episode >= 1")
        late.annotate(late=True, note=("a", 1))
        expected = [{}, {}, {"late": True, "note": ["a", 1]}, {"late": True, "note": ["a", 1]}]
        assert [header.metadata for header in tupli_mcap.open(tmp_path).headers] == expected
        assert [header.metadata for header in late.headers] == expected[2:]
        assert [episode.metadata for episode in late] == expected[2:]
        everything.annotate(note=None)
        assert [header.metadata for header in everything.filter("metadata.late = true").headers] == [
            {"late": True}
        ] * 2
        assert len(Recording(tmp_path / "deep/b.mcap").annotations.said) == 2
        late[:0].annotate(x=1)  # of no episode
        for values in ({}, {"x": object()}):
            with pytest.raises(
                RecordingError,
                match=r"^expected values for the episodes|^annotation\['x'\] is .* no exact JSON form",
            ):
                late.annotate(**values)

    def test_annotating_all_recordings_of_a_dataset_or_none(self, tmp_path: Path) -> None:
        whole, cut = record(tmp_path / "a.mcap"), record(tmp_path / "b.mcap")
        cut.write_bytes(cut.read_bytes()[:-300])  # not finished
        with pytest.warns(UserWarning, match=r"b\.mcap"):
            dataset = tupli_mcap.open(tmp_path)
            _ = dataset.headers
        with pytest.raises(RecordingError, match=r"b\.mcap is not finished"):
            dataset.annotate(good=True)
        assert not any(episode.metadata for episode in Recording(whole))

    def test_edit_in_a_directory(self, tmp_path: Path) -> None:
        paths = [
            record(tmp_path / "runs" / f"{name}.mcap", count) for name, count in (("a", 1), ("deep/b", 3))
        ]
        command("edit", str(tmp_path / "runs"), str(paths[0]), "--split", "eval")
        command("edit", str(tmp_path / "runs"), "--filter", "episode >= 1", "--tag", "long")
        said = [(run.split, run.tags) for path in paths for run in Recording(path).runs]
        assert said == [("eval", ()), ("eval", ("long",))]
        command("edit", str(paths[0]), "--undo")  # which was edited once, although it was named twice
        assert [run.split for run in Recording(paths[0]).runs] == [""]
        edit = ["edit", str(tmp_path / "runs")]
        assert CliRunner().invoke(app, [*edit, "--filter", "episode > 9", "--tag", "x"]).exit_code == 1
        command(*edit, "--undo", "--filter", "episode >= 1")
        command(*edit, "--undo")  # a.mcap has no edit any more
        assert [run for path in paths for run in Recording(path).recorded_runs.before] == []
        assert [run.split for path in paths for run in Recording(path).runs] == ["", ""]
        none = CliRunner().invoke(app, [*edit, "--undo"])
        assert (none.exit_code, none.output) == (1, f"error: there is no edit to take back in {edit[1]}\n")

    @pytest.mark.parametrize("dry", [(), ("--dry-run",)])
    @pytest.mark.parametrize("words", ["tag --episodes all good=true", "edit --name x"])
    def test_all_recordings_are_changed_or_none(
        self, words: str, dry: tuple[str, ...], tmp_path: Path
    ) -> None:
        paths = [record(tmp_path / f"{name}.mcap") for name in "abcd"]
        paths[1].write_bytes(paths[1].read_bytes()[:-300])  # not finished
        damaged = bytearray(paths[2].read_bytes())
        damaged[-400:-300] = bytes(100)
        paths[2].write_bytes(damaged)
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        verb, *rest = words.split()
        with RecordEpisodes(gym.make("CartPole-v1"), paths[3], mode="a"):  # finished, but somebody appends
            result = CliRunner().invoke(app, [verb, *map(str, paths), *rest, *dry])
        assert result.exit_code == 1
        told = result.stderr.splitlines()[-1]
        assert told.startswith("error: nothing was changed: ")
        for said in ("b.mcap is not finished", "c.mcap: ", "d.mcap is being recorded by another writer"):
            assert told.count(said) == 1
        assert "a.mcap" not in told
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
        command(verb, str(paths[0]), str(paths[3]), *rest, *dry)
        assert (paths[0].read_bytes() == before["a.mcap"]) == bool(dry)

    def test_a_full_disk_ends_it_and_what_was_changed_is_named(self, tmp_path: Path) -> None:
        paths = [record(tmp_path / f"{name}.mcap") for name in "ab"]
        with RecordEpisodes(gym.make("CartPole-v1"), paths[1], mode="a") as env:
            for seed in range(50):
                env.reset(seed=seed)
                while not any(env.step(seed % 2)[2:4]):
                    pass
        before = paths[1].read_bytes()
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        limit = paths[0].stat().st_size + 2000
        assert limit < len(before)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))  # EFBIG, as ENOSPC from the same call
        try:
            result = CliRunner().invoke(app, ["tag", *map(str, paths), "--episodes", "all", "good=true"])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert result.exit_code == 1
        assert result.stderr.startswith(f"error: {paths[1]}") and "File too large" in result.stderr
        assert result.stderr.endswith(f"; changed before that: {paths[0]}\n")
        assert Recording(paths[0]).annotations.said and paths[1].read_bytes() == before

    def test_a_recording_is_named_as_it_was_given(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = record(tmp_path / "a.mcap")
        monkeypatch.chdir(tmp_path)
        words = ["tag", "a.mcap", "--episodes", "0", "good=true"]
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a"):
            refused = CliRunner().invoke(app, words)
        assert refused.stderr.startswith("error: a.mcap is being recorded by another writer")
        path.write_bytes(path.read_bytes()[:-300])
        refused = CliRunner().invoke(app, words)
        assert refused.stderr.splitlines()[-1].startswith("error: a.mcap is not finished")

    @pytest.mark.parametrize("dry", [(), ("--dry-run",)])
    def test_what_may_not_be_written_is_said_first(self, dry: tuple[str, ...], tmp_path: Path) -> None:
        path, locked, closed = (record(tmp_path / name / "r.mcap") for name in ("a", "b", "c"))
        before = path.read_bytes()
        locked.chmod(0o444)
        closed.parent.chmod(0o555)
        done = unprivileged("edit", path, locked, closed, "--name", "x", *dry)
        assert done.returncode == 1
        assert [done.stderr.count(str(one)) for one in (path, locked, closed)] == [0, 1, 1]
        assert done.stderr.count("Permission denied") == 2
        assert path.read_bytes() == before

    def test_record_says_what_run_it_is(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        command(
            "record", "CartPole-v1", "-o", "runs/", "--steps", "20", "--name", "rnd", "--set", "policy=random",
            "--tag", "a", "--split", "eval", "--capture", "none",
        )  # fmt: skip
        (path,) = Path("runs").iterdir()
        assert path.name.startswith("rnd_20")
        run = Recording(path).run
        assert (run.name, run.metadata, run.tags, run.split, run.command) == (
            "rnd", {"policy": "random"}, ("a",), "eval", (),
        )  # fmt: skip
        assert "policy=random" in command("info", str(path))

    def test_info_of_a_directory(self, tmp_path: Path) -> None:
        for i in range(2):
            annotate_episodes(record(tmp_path / f"{i}.mcap", name=f"run-{i}"), {"success": i == 0, "k": 1})
        text = command("info", str(tmp_path))
        for expected in ("run-0, run-1", "CartPole-v1", "6 (6 terminal)", "50%", "3 different", "k, success"):
            assert expected in text
        found = json.loads(command("info", str(tmp_path), "--json"))["result"]
        assert (found["recordings"], found["episodes"], found["success"]) == (2, 6, 0.5)

    def test_episodes_of_several_files_in_order(self, tmp_path: Path) -> None:
        paths = [str(record(tmp_path / f"{i}.mcap", name=f"run-{i}")) for i in range(2)]
        found = json.loads(command("episodes", *paths, "--sort", "-return", "--limit", "3", "--json"))[
            "result"
        ]
        returns = [one["return"] for one in found]
        assert len(returns) == 3
        assert returns == sorted(returns, reverse=True)
        assert found[0]["run"]["name"] in ("run-0", "run-1")

    def test_episodes_shows_the_columns_that_are_asked_for(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap", name="a run", metadata={"lr": 0.001})
        keys = "episode,steps,run.metadata.lr"
        found = json.loads(command("episodes", str(path), "--columns", keys, "--json"))["result"]
        lengths = tupli_mcap.open(path).lengths.tolist()
        assert found == [
            {"episode": i, "steps": steps, "run.metadata.lr": 0.001} for i, steps in enumerate(lengths)
        ]
        lines = command("episodes", str(path), "--columns", keys).splitlines()
        assert lines[0].split() == ["EPISODE", "STEPS", "RUN.METADATA.LR"]
        assert [line.split() for line in lines[1:]] == [
            [str(i), str(steps), "0.001"] for i, steps in enumerate(lengths)
        ]
        times = "ended,run.started,run.ended"
        shown = command("episodes", str(path), "--columns", times).splitlines()[-1]
        (*_, told) = json.loads(command("episodes", str(path), "--columns", times, "--json"))["result"]
        assert shown.split("  ") == [local_text(time_ns(told[key]) or 0) for key in times.split(",")]
        for wrong, message in (("metadata.none", "no episode has metadata.none"), ("retrun", "'return'")):
            result = CliRunner().invoke(app, ["episodes", str(path), "--columns", wrong])
            assert result.exit_code and message in f"{result.output}{result.exception}"


def of_many_runs(path: Path, runs: list[dict[str, Any]]) -> Recording:
    """A recording with an episode of each run."""
    with EpisodeWriter(path, spaces.Discrete(2), spaces.Discrete(2)) as writer:
        for _ in runs:
            writer.begin()
            writer.step(0, 0, 1.0, True)
    document = {"runs": runs, "spans": [[1, place] for place in range(len(runs))]}
    add_attachments(path, {"run.json": ("application/json", json.dumps(document).encode())})
    return Recording(path)


class TestOfStrangers:
    """What a file says that somebody made to do harm."""

    def put(self, path: Path, name: str, document: Any) -> Path:
        add_attachments(path, {name: ("application/json", json.dumps(document).encode())})
        return path

    def test_spans_take_no_memory(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        self.put(
            path, "run.json", {"runs": [{}, {"name": "b"}], "spans": [[1, 0], [2**32 - 1, 1], [2**32 - 1, 0]]}
        )
        assert Recording(path).run_places == [0, 1, 1]
        assert [header.run["name"] for header in tupli_mcap.open(path).headers] == ["r", "b", "b"]

    def test_without_its_run_a_recording_stays_readable(self, tmp_path: Path) -> None:
        path = self.put(record(tmp_path / "r.mcap"), "run.json", "junk")
        with pytest.warns(UserWarning, match=r"run\.json"):
            assert len(tupli_mcap.open(path).read().rewards) > 0
        for look in (["info"], ["ls"], ["plot", "-o", str(tmp_path / "p.png")]):
            assert "run.json" in command(*look, str(path))
        with pytest.warns(UserWarning, match=r"run\.json"):
            Recording(path).replay(save=tmp_path / "r.rrd")
        storage = FileStorage(tmp_path)
        with pytest.warns(UserWarning, match=r"run\.json"):
            assert len(storage.list_episodes()) == 3

    def test_metadata_are_never_others_than_those_that_were_said(self, tmp_path: Path) -> None:
        path = self.put(record(tmp_path / "r.mcap"), "annotations.json", "junk")
        recording = Recording(path)
        assert len(recording.read().rewards) > 0
        with pytest.raises(FormatError, match=r"annotations\.json"):
            _ = recording.episodes[0].metadata
        with pytest.raises(FormatError, match=r"annotations\.json"):
            len(tupli_mcap.open(path).filter("metadata.good"))

    def test_commands_show_odd_values(self, tmp_path: Path) -> None:
        path = record(tmp_path / "r.mcap")
        array = {"$numpy": {"dtype": "<f8", "shape": [2], "data": "AAAAAAAAAAAAAAAAAAAAAA=="}}
        self.put(path, "run.json", {"runs": [{"git": {"commit": "a\u001b[31m", "dirty": array}}]})
        assert "\x1b" not in command("info", str(path))
        self.put(path, "run.json", {"runs": [{"metadata": {"$dict": [[1, 2]]}}]})
        with pytest.raises(FormatError, match="metadata of a run"):
            _ = Recording(path).run


def test_a_value_that_is_called_success_is_no_success(tmp_path: Path) -> None:
    class Callback(tupli_mcap.EpisodeMetadataCallback):
        def reset(self) -> None: ...

        def __call__(self, tuple: Any) -> dict[str, Any]:
            return {"outcome": "success"}

    path = tmp_path / "r.mcap"
    with RecordEpisodes(Winning(), path, metadata_callback=Callback()) as env:
        env.reset()
        env.step(1)
    assert Recording(path).episodes[0].metadata == {"outcome": "success", "success": True}


def test_keys_are_texts(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap")
    endless: list[Any] = []
    endless.append(endless)
    with pytest.raises(
        RecordingError, match="^metadata of the run: expected at most 64 levels of nesting, found more"
    ):
        record(tmp_path / "x.mcap", metadata={"x": endless})
    with pytest.raises(
        RecordingError, match=r"^metadata of the run: metadata\['x'\]\[1\] is a builtins.object, "
    ):
        record(tmp_path / "x.mcap", metadata={"x": [1, object()]})
    refused = CliRunner().invoke(app, ["tag", str(path), "--episodes", "all", "success=no"])
    assert refused.exit_code == 1 and "expected success to be true or false, found 'no'" in refused.output
    for change in (
        lambda: edit_runs(path, metadata={(1, 2): 2}),  # type: ignore[dict-item]
        lambda: annotate_episodes(path, {1: 2}),  # type: ignore[dict-item]
        lambda: annotate_episodes(path, {"a": 2}, [1.9]),  # type: ignore[list-item]
    ):
        with pytest.raises(RecordingError, match="expected"):
            change()


def test_each_run_of_a_file_is_shown_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "both.mcap"
    for seed in (0, 1):
        record(path, 3, mode="a", name=f"ppo-seed{seed}", metadata={"lr": 0.5, "seed": seed})
    first, second = Recording(path).runs
    assert first.started < first.ended < second.started < second.ended
    assert len(tupli_mcap.open(path).filter(f'run.ended < "{second.started}"')) == 3
    told = json.loads(command("info", str(path), "--filter", 'run.name = "ppo-seed1"', "--json"))["result"]
    assert told["runs"] == [
        {"name": "ppo-seed1", "split": "", "episodes": 3, "metadata": {"lr": 0.5, "seed": 1}}
    ]
    assert told["run"]["name"] == "ppo-seed1"
    assert "ppo-seed0 (3 episodes, seed=0), ppo-seed1 (" in command("info", str(path))
    # of two runs with one place, RUN says which is which, also where there is little room
    monkeypatch.setenv("COLUMNS", "80")
    assert [line.split()[1] for line in command("ls", str(path)).splitlines()] == [
        "RUN",
        "ppo-seed0",
        "ppo-seed1",
    ]
    assert command("episodes", str(path), "--limit", "4").splitlines()[0].split()[:2] == ["EPISODE", "RUN"]
    record(tmp_path / "other.mcap", 1, name="other")
    title, line = command("episodes", str(tmp_path), "-e", "last").splitlines()
    assert title.split()[:2] == ["ID", "RUN"]
    assert line.split()[1] == "other"


def test_a_recording_that_is_appended_to_has_each_run(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    for given in ({"name": "one", "metadata": {"lr": 1}}, {"name": "one", "metadata": {"lr": 1}}, {}):
        record(path, 2, mode="a", **given)
    assert [run.name for run in Recording(path).runs] == ["one"]  # the same goes on
    edit_runs(path, metadata={"lr": 1.5})
    record(path, 1, mode="a", name="one", metadata={"lr": 1})  # as it was given
    pid = os.fork()
    if pid == 0:
        env = RecordEpisodes(gym.make("CartPole-v1"), path, mode="a", name="killed", metadata={"lr": 3})
        env.reset(seed=1)
        env.step(1)
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    record(path, 2, mode="a", name="two", metadata={"lr": 2})
    with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a", metadata={"lr": float("nan")}):
        pass  # without a step
    dataset = tupli_mcap.open(path)
    assert [episode.run.metadata["lr"] for episode in dataset] == [1.5] * 7 + [3] + [2] * 2
    assert len(dataset.filter("run.name = 'two'")) == 2
    assert verify_recording(path).ok
    listed = json.loads(CliRunner().invoke(app, ["ls", str(path), "--json"]).output)["result"]
    assert [(row["run"], row["settings"]["lr"]) for row in listed] == [
        ("one", 1.5),
        ("killed", 3),
        ("two", 2),
    ]
    before = path.read_bytes()
    with pytest.raises(SpaceError, match="records a single environment, found a vector environment of 1"):
        RecordVectorEpisodes(gym.make_vec("CartPole-v1", 1), path, mode="a", name="wrong").reset()
    assert path.read_bytes() == before  # what is refused changes nothing


@pytest.mark.parametrize(
    ("given", "names"), [({"name": "two", "metadata": {"lr": 2}}, ["r", "r", "two"]), ({}, ["r", "r", "r"])]
)
def test_what_is_appended_says_nothing_of_episodes_without_a_run(
    given: dict[str, Any], names: list[str], tmp_path: Path
) -> None:
    path = record(tmp_path / "r.mcap", 2, capture="none")
    record(path, 1, mode="a", **given)
    dataset = tupli_mcap.open(path)
    assert [episode.run.name for episode in dataset] == names
    assert [bool(episode.run.command) for episode in dataset] == [False, False, "two" in names]
    assert verify_recording(path).ok


def test_episodes_without_a_run_take_none_along(tmp_path: Path) -> None:
    """Who may read only these must not learn of the run of the others."""
    path = record(tmp_path / "r.mcap", 2, capture="none")
    record(path, 1, mode="a", name="secret", metadata={"lr": 1})
    rewrite_recording(Recording(path), tmp_path / "some.mcap", episodes=[0])
    some = Recording(tmp_path / "some.mcap")
    assert ("run.json" in some.attachments, [run.name for run in some.runs]) == (False, ["some"])
    assert b"secret" not in (tmp_path / "some.mcap").read_bytes()


def test_an_append_that_was_killed_leaves_nothing_that_looks_damaged(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 1, name="one")
    annotate_episodes(path, {"good": True})
    for name in ("two", "three"):
        if (pid := os.fork()) == 0:
            env = RecordEpisodes(gym.make("CartPole-v1"), path, mode="a", name=name)
            env.reset(seed=1)
            env.step(1)
            os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(pid, 0)
        record(path, 0, mode="a")  # finishes it
    assert [problem.message for problem in verify_recording(path).problems] == []
    assert [episode.run.name for episode in Recording(path).episodes] == ["one", "two", "three"]


def test_a_damaged_run_does_not_keep_anybody_from_appending(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 1)
    add_attachments(path, {"run.json": ("application/json", b"no JSON")})
    record(path, 1, mode="a", name="two")
    assert [episode.seed for episode in Recording(path).episodes] == [0, 0]


@pytest.mark.parametrize("name", ["one", None])
def test_the_parts_of_a_run_are_one_run_again(name: str | None, tmp_path: Path) -> None:
    record(tmp_path / "r.mcap", 6, name=name)
    parts = [
        part.path for part in tupli_mcap.split_recording(tmp_path / "r.mcap", tmp_path / "p.mcap", episodes=2)
    ]
    merged = tmp_path / "m.mcap"
    merge_recordings(parts, merged)
    assert len(Recording(merged).runs) == 1
    assert [run.name for run in edit_runs(merged, name="x")] == ["x"]
    edit_runs(parts[0], name="edited")
    merge_recordings(parts, merged, overwrite=True)
    assert [run.name for run in Recording(merged).runs] == ["edited", name or "p_0001"]


def test_compacted_it_keeps_its_edits(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", 3, name="one")
    edit_runs(path, name="better")
    tupli_mcap.open(path)[:1].delete()
    with tupli_mcap.FileStorage(tmp_path) as storage:
        assert storage.compact() > 0
    record(path, 1, mode="a", name="one")  # as it was given
    assert [run.name for run in Recording(path).runs] == ["better"]
    assert [run.name for run in undo_edit(path)] == ["one"]
