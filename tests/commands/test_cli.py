"""The command line: what each command prints, and the one line and exit code of each failure."""

from __future__ import annotations

import functools
import json
import math
import os
import pty
import re
import select
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import Result, fails, ok, run
from environments import Scripted
from golden_files import place as golden
from gymnasium.envs.classic_control import CartPoleEnv
from mcap.writer import Writer
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner
from waiting import wait_for

import tupli_mcap
from tupli_mcap import (
    EpisodeData,
    FileStorage,
    RecordEpisodes,
    Recording,
    TupliEnvWrapper,
    trust,
    write_recording,
)
from tupli_mcap.cli import app
from tupli_mcap.cli.output import number, numbers, when
from tupli_mcap.environment import EnvironmentRecord
from tupli_mcap.errors import RecordingError, bytes_of
from tupli_mcap.recording.describe.description import space_lines
from tupli_mcap.schema import ArtifactMetadata, EpisodeMetadataCallback, RLTuple
from tupli_mcap.spaces.labels import Labels
from tupli_mcap.spaces.leaves import NameRegistry, flatten_space
from tupli_mcap.storage.catalog.place import catalog_path
from tupli_mcap.storage.listing import by_run, listed_of
from tupli_mcap.storage.verify import verify_paths
from tupli_mcap.wrappers.rollout import record_rollouts

TOOL = Path(sys.executable).with_name("tupli-mcap")


def tool(*args: object, cwd: Path, **environment: str) -> Result:
    """The installed command in a process of its own."""
    done = subprocess.run(
        [TOOL, *map(str, args)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    return Result(done.returncode, done.stdout, done.stderr)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUPLI_MCAP_STORAGE", raising=False)
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "cartpole.mcap"
    record_rollouts("CartPole-v1", path, steps=200, seed=1)
    return path


class Return(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.total = 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.total += float(tuple.reward)
        return {"cum_eps_reward": self.total, "is_expert": self.total > 20}


class Wind(gym.Wrapper[Any, Any, Any, Any]):
    """In no registry: such an environment is pickled."""


class Reach(CartPoleEnv):
    """Of no registered id either: only its class has a name."""


def fill(root: Path) -> tuple[str, str]:
    """A storage of two benchmarks (a registered environment and a pickled one), an artifact and 3 + 2 episodes."""
    ids = []
    storage = FileStorage(root)
    for env, name, episodes in (
        (gym.make("CartPole-v1"), "pole", 3),
        (Wind(gym.make("CartPole-v1")), "wind", 2),
    ):
        with TupliEnvWrapper(env, storage=storage, metadata_callback=Return()) as wrapped:
            ids.append(wrapped.store(name=name, description=f"about {name}"))
            wrapped.action_space.seed(1)
            for seed in range(episodes):
                wrapped.reset(seed=seed)
                while not any(wrapped.step(wrapped.action_space.sample())[2:4]):
                    pass
    storage.store_artifact(b"a,b\n", ArtifactMetadata(name="wind.csv", description="the wind"))
    storage.close()
    return ids[0], ids[1]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    root = tmp_path_factory.mktemp("storages") / "lab"
    return root, *fill(root)


@pytest.fixture
def lab(filled: tuple[Path, str, str], here: Path) -> tuple[Path, str, str]:
    """A copy of the storage, to change."""
    shutil.copytree(filled[0], here / "lab", copy_function=shutil.copy2)
    return here / "lab", filled[1], filled[2]


# --- record ---


class TestRecord:
    def test_records_real_rollouts(self, here: Path) -> None:
        out = ok("record", "CartPole-v1", "-o", "a.mcap", "--steps", 300, "--seed", 7)
        assert re.fullmatch(
            r"a\.mcap: \d+ episodes, 300 steps, mean return [\d.]+, [\d.]+ kB in [\d.]+ s\n", out
        )
        with Recording("a.mcap") as recording:
            assert recording.n_steps == 300
            assert recording.episodes[0].seed == 7
            assert recording.benchmark.record.name == "CartPole-v1"
        ok("record", "CartPole-v1", "-o", "b.mcap", "--steps", 300, "--seed", 7)
        with Recording("a.mcap") as first, Recording("b.mcap") as second:
            np.testing.assert_array_equal(first.read().states, second.read().states)

    def test_summary_as_json(self, here: Path) -> None:
        told = run("record", "CartPole-v1", "-o", "a.mcap", "--steps", 50, "--json").json
        assert (told["path"], told["steps"]) == ("a.mcap", 50)
        assert told["size"] == Path("a.mcap").stat().st_size

    def test_vector_environments(self, here: Path) -> None:
        told = run("record", "CartPole-v1", "-o", "v.mcap", "--steps", 301, "--num-envs", 3, "--json").json
        with Recording("v.mcap") as recording:
            assert recording.num_envs == 3
            assert recording.n_steps == told["steps"]
            assert 301 <= told["steps"] < 304
            assert len(recording) == told["episodes"]
            assert recording.benchmark.record.name == "CartPole-v1"

    def test_a_directory_gets_a_new_file_each_time(self, here: Path) -> None:
        made = [
            run("record", "CartPole-v1", "-o", "new/runs/", "--steps", 10, "--json").json["path"]
            for _ in range(2)
        ]
        assert sorted(made) == made
        assert [Recording(path).n_steps for path in made] == [10, 10]
        assert "ends in .mcap, or a directory, found new.d" in fails("record", "CartPole-v1", "-o", "new.d")

    def test_modes(self, here: Path) -> None:
        ok("record", "CartPole-v1", "-o", "a.mcap", "--steps", 40)
        before = Path("a.mcap").read_bytes()
        assert fails("record", "CartPole-v1", "-o", "a.mcap") == (
            "a.mcap exists and is not overwritten; choose another path, or --mode a to append, "
            "--mode w to replace; a directory gets a new file each time"
        )
        assert Path("a.mcap").read_bytes() == before
        told = run("record", "CartPole-v1", "-o", "a.mcap", "--steps", 30, "--mode", "a", "--json").json
        assert told["steps"] == 30
        with Recording("a.mcap") as recording:
            assert recording.n_steps == 70
        ok("record", "CartPole-v1", "-o", "a.mcap", "--steps", 30, "--mode", "w")
        with Recording("a.mcap") as recording:
            assert recording.n_steps == 30
        for n in (20, 40):
            ok("record", "CartPole-v1", "-o", "new.mcap", "--steps", 20, "--mode", "a")
            with Recording("new.mcap") as recording:
                assert recording.n_steps == n
                assert recording.benchmark.record.name == "CartPole-v1"

    def test_compression_and_infos(self, here: Path) -> None:
        ok("record", "FrozenLake-v1", "-o", "a.mcap", "--steps", 30, "--compression", "none", "--record-info")
        with Recording("a.mcap") as recording:
            info = recording.episodes[0].infos[0]
            assert set(info) == {"prob"}
        assert run("info", "a.mcap", "--json").json["compression"] == pytest.approx(1, abs=0.2)

    @pytest.mark.parametrize("envs", [1, 3])
    def test_policies(self, here: Path, envs: int) -> None:
        Path(f"policy_of_{envs}.py").write_text(
            "def push(state):\n    assert state.shape == (4,)\n    return int(state[2] > 0)\n"
        )
        args = ("-o", "a.mcap", "--steps", 300, "--num-envs", envs, "--policy", f"policy_of_{envs}:push")
        ok("record", "CartPole-v1", *args)
        with Recording("a.mcap") as recording:
            columns = recording.read()
            np.testing.assert_array_equal(columns.actions, columns.states[:, 2] > 0)

    @pytest.mark.parametrize(
        ("args", "ran"),
        [
            (["CartPole-v1"], []),
            (["CartPole-v1", "--policy", "left:act"], ["ran_left"]),
            (["left:CartPole-v1"], ["ran_left"]),
        ],
    )
    def test_files_that_lie_here_replace_no_installed_module(
        self, here: Path, args: list[str], ran: list[str]
    ) -> None:
        for name in ("pygame", "PIL", "left"):
            Path(f"{name}.py").write_text(f"open('ran_{name}', 'w').close()\ndef act(state): return 0\n")
        done = tool("record", *args, "-o", "a.mcap", "--steps", "3", "--frames", cwd=here)
        assert (done.code, done.err) == (0, "")
        assert [path.name for path in here.glob("ran_*")] == ran

    def test_policies_that_do_not_import(self, here: Path) -> None:
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "no_such_module:act")
        assert line == (
            "the policy 'no_such_module:act' cannot be imported: "
            "ModuleNotFoundError: No module named 'no_such_module'"
        )
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "math:no_such_function")
        assert line.startswith("the policy 'math:no_such_function' cannot be imported: AttributeError: ")
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "math:pi")
        assert line == "the policy 'math:pi' must be a function, found float"
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "math", code=2)
        assert line.startswith("Invalid value for '--policy': expected module:function, found 'math'; see ")
        assert not Path("a.mcap").exists()

    def test_policies_that_exit(self, here: Path) -> None:
        Path("script.py").write_text("raise SystemExit\n")
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "script:act")
        assert line == "the policy 'script:act' cannot be imported: SystemExit"
        Path("leaving.py").write_text("import sys\ndef act(state):\n    sys.exit(0)\n")
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "leaving:act")
        assert line == "the policy or the environment failed at step 0: SystemExit: 0"

    def test_policies_that_fail(self, here: Path) -> None:
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "math:factorial")
        assert line.startswith("the policy or the environment failed at step 0: TypeError: ")
        assert not Path("a.mcap").exists()
        Path("tiring.py").write_text("left = [0] * 9\ndef act(state):\n    return left.pop()\n")
        line = fails("record", "CartPole-v1", "-o", "a.mcap", "--policy", "tiring:act")
        assert line == (
            "the policy or the environment failed at step 9: IndexError: pop from empty list; "
            "a.mcap holds the steps before it"
        )
        with Recording("a.mcap") as recording:
            assert recording.n_steps == 9

    @pytest.mark.parametrize("envs", [1, 2])
    def test_environments_that_cannot_be_closed(self, here: Path, envs: int) -> None:
        name = f"sticking_{envs}"
        Path(f"{name}.py").write_text(
            "import gymnasium as gym\n"
            "from gymnasium.envs.classic_control import CartPoleEnv\n"
            "class Stuck(CartPoleEnv):\n    def close(self):\n        raise RuntimeError('no window')\n"
            f"gym.register('Stuck{envs}-v0', Stuck)\n"
            "def act(state):\n    raise KeyError('left')\n"
        )
        args = ("record", f"{name}:Stuck{envs}-v0", "--num-envs", envs, "--steps", 10)
        told = "a.mcap is finished, but the environment failed when it was closed: RuntimeError: no window"
        done = run(*args, "-o", "a.mcap")
        assert (done.code, done.err) == (0, f"warning: {told}\n")
        with Recording("a.mcap") as recording:
            assert recording.n_steps == 10
        done = run(*args, "-o", "b.mcap", "--policy", f"{name}:act")
        assert done.code == 1
        assert "error: the policy or the environment failed at step 0: KeyError: 'left'" in done.err
        assert not Path("b.mcap").exists()

    def test_environments_that_cannot_be_made(self, here: Path) -> None:
        line = fails("record", "NoSuchEnvironment-v0", "-o", "a.mcap")
        assert line.startswith("the environment 'NoSuchEnvironment-v0' cannot be made: NameNotFound: ")
        line = fails("record", "no_such_module:Env-v0", "-o", "a.mcap", "--num-envs", 2)
        assert line.startswith(
            "the environment 'no_such_module:Env-v0' cannot be made: ModuleNotFoundError: "
        )
        assert not Path("a.mcap").exists()

    def test_places_that_cannot_be_written(self, here: Path) -> None:
        Path("file").touch()
        line = fails("record", "CartPole-v1", "-o", "file/a.mcap")
        assert (
            line
            == "file/a.mcap cannot be recorded to: Not a directory; choose a path whose directories are directories"
        )
        line = fails("record", "CartPole-v1", "-o", "/proc/a.mcap")
        assert line.startswith("/proc/a.mcap cannot be recorded to: ")

    @pytest.mark.parametrize(
        ("args", "line"),
        [
            ((), "Missing option '--output' / '-o'"),
            (("-o", "a.mcap", "--steps", "0"), "Invalid value for '--steps'"),
            (("-o", "a.mcap", "--steps", "many"), "Invalid value for '--steps'"),
            (("-o", "a.mcap", "--num-envs", "0"), "Invalid value for '--num-envs'"),
            (("-o", "a.mcap", "--mode", "r"), "Invalid value for '--mode'"),
            (("-o", "a.mcap", "--compression", "gzip"), "Invalid value for '--compression'"),
        ],
    )
    def test_usage(self, here: Path, args: Sequence[str], line: str) -> None:
        found = fails("record", "CartPole-v1", *args, code=2)
        assert found.startswith(line)
        assert found.endswith("see tupli-mcap record --help")

    def test_the_library_refuses_no_steps(self, here: Path) -> None:
        with pytest.raises(RecordingError, match="expected at least 1 step, .* found steps=0, episodes=None"):
            record_rollouts("CartPole-v1", "a.mcap", steps=0)

    def test_a_rollout_of_episodes_ends_with_the_last_one(self, here: Path) -> None:
        run("record", "CartPole-v1", "-o", "a.mcap", "--episodes", "3", "--seed", "1")
        with Recording(here / "a.mcap") as recording:
            assert [episode.end for episode in recording] == ["terminal"] * 3
        summary = record_rollouts("CartPole-v1", "b.mcap", episodes=4, num_envs=3, seed=1)
        with Recording(here / "b.mcap") as recording:
            ends = [episode.end for episode in recording]
            assert ends.count("terminal") in (4, 5, 6) and len(ends) == summary.episodes
            assert recording.n_steps == summary.steps
        assert record_rollouts("CartPole-v1", "c.mcap", steps=5, episodes=2, seed=1).steps == 5

    def test_progress_grows_to_the_end(self, here: Path) -> None:
        told: list[int] = []
        record_rollouts("CartPole-v1", "a.mcap", steps=1000, progress=told.append)
        assert told == sorted(told)
        assert told[-1] == 1000
        assert 100 <= len(told) <= 400

    def test_a_full_disk_keeps_what_was_recorded(self, here: Path) -> None:
        limit = (
            "import resource, os, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000)); "
        )
        program = [
            sys.executable,
            "-c",
            limit + "os.execv(sys.argv[1], sys.argv[1:])",
            TOOL,
            "record",
            "CartPole-v1",
        ]
        done = subprocess.run(
            [*program, "-o", "a.mcap", "--steps", "1000000"],
            capture_output=True,
            text=True,
            cwd=here,
            check=False,
        )
        assert (done.returncode, done.stdout) == (1, "")
        assert re.fullmatch(r"error: a\.mcap: could not write .*; what was recorded .*\n", done.stderr)
        (told,) = run("ls", "a.mcap", "--json").json
        assert told["state"] == "unfinished"
        assert told["steps"] > 20_000

    def test_ctrl_c_while_the_words_are_read(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupted(*_: Any) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(TyperGroup, "parse_args", interrupted)
        result = CliRunner().invoke(app, ["ls"])
        assert (result.exit_code, result.stderr) == (130, "interrupted; nothing was changed\n")

    @pytest.mark.parametrize(
        ("words", "extras"),
        [
            ("record CartPole-v1 -o a.mcap --frames --live rerun", "frames,rerun"),
            ("record CartPole-v1 -o a.mcap --frames --live foxglove://127.0.0.1:1", "frames,foxglove"),
            ("view https://example.org/a.mcap", "rerun,remote"),
            ("plot http://127.0.0.1:1/ a.mcap", "plot,remote"),
            ("render s3://some/a.mcap -o a.mp4", "video,remote"),
            ("render s3://some/a.mcap -o a.gif", "frames,remote"),
        ],
    )
    def test_all_missing_extras_are_named_at_once(
        self, words: str, extras: str, here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for module in ("PIL", "rerun", "foxglove", "av", "matplotlib", "obstore", "httpx"):
            monkeypatch.setitem(sys.modules, module, None)
        told = fails(*words.split())
        assert f"needs the extras {' and '.join(extras.split(','))}: pip install" in told
        assert f"[{extras}]" in told and not list(here.iterdir())

    def test_ctrl_c_while_the_commands_are_imported(self) -> None:
        program = """if True:
            import sys
            class Interrupted:
                def find_spec(self, name, *_):
                    if name == "typer":
                        raise KeyboardInterrupt
            sys.meta_path.insert(0, Interrupted())
            from tupli_mcap.cli import main
            main()
        """
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (130, "interrupted; nothing was changed\n")

    def test_ctrl_c_keeps_what_was_recorded(self, here: Path) -> None:
        args = [TOOL, "record", "CartPole-v1", "-o", "a.mcap", "--steps", "100000000"]
        with subprocess.Popen(args, stderr=subprocess.PIPE, text=True, cwd=here) as process:
            wait_for(lambda: (here / "a.mcap").exists() and (here / "a.mcap").stat().st_size >= 100_000)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=120)
        with Recording("a.mcap") as recording:
            assert recording.complete
            assert recording.n_steps > 0
            held = f"{len(recording):,} episodes, {recording.n_steps:,} steps"
        assert (process.returncode, err) == (130, f"interrupted; a.mcap holds {held}\n")

    @pytest.mark.parametrize(("limits", "files"), [((), 1), (("--max-bytes", 20_000), 3)])
    def test_ctrl_c_says_what_is_safe(self, here: Path, limits: tuple[object, ...], files: int) -> None:
        policy = f"stopping_in_{files}"
        Path(f"{policy}.py").write_text(
            "left = [0] * 20_000\n"
            "def act(state):\n"
            "    if not left: raise KeyboardInterrupt\n"
            "    return left.pop()\n"
        )
        if files == 1:
            Path("a_0001.mcap").write_text("not of this recording")
        args = ("-o", "a.mcap", "--steps", 30_000, "--policy", f"{policy}:act", *limits)
        result = run("record", "CartPole-v1", *args)
        paths = [Path("a.mcap"), *(Path(f"a_{i:04}.mcap") for i in range(1, files))]
        episodes = sum(item["episodes"] for item in run("ls", *paths, "--json").json)
        held = "a.mcap holds" if files == 1 else f"{here / 'a.mcap'} to a_0002.mcap hold"
        assert (result.code, result.out) == (130, "")
        assert result.err == f"interrupted; {held} {episodes:,} episodes, 20,000 steps\n"

    def test_ctrl_c_names_the_file_in_a_directory(self, here: Path) -> None:
        Path("into_directory.py").write_text(
            "left = [0] * 30\n"
            "def act(state):\n"
            "    if not left: raise KeyboardInterrupt\n"
            "    return left.pop()\n"
        )
        ok("record", "CartPole-v1", "-o", "runs/", "--steps", 50)
        earlier = {*Path("runs").iterdir()}
        result = run("record", "CartPole-v1", "-o", "runs/", "--policy", "into_directory:act")
        (path,) = {*Path("runs").iterdir()} - earlier
        held = f"{len(Recording(path))} episodes, 30 steps"
        assert (result.code, result.err) == (130, f"interrupted; {path} holds {held}\n")

    def test_ctrl_c_before_anything_is_recorded(self, here: Path) -> None:
        Path("early.py").write_text("def act(state):\n    raise KeyboardInterrupt\n")
        args = ("record", "CartPole-v1", "-o", "a.mcap", "--policy", "early:act")
        result = run(*args)
        assert (result.code, result.out, result.err) == (130, "", "interrupted; nothing was recorded\n")
        assert list(here.glob("a.mcap*")) == []


# --- ls, info, episodes ---


class TestLook:
    def test_ls_lists_files_and_directories(self, here: Path, cartpole: Path) -> None:
        (here / "deep").mkdir()
        shutil.copy(cartpole, here / "deep" / "b.mcap")
        shutil.copy(cartpole, here / "a.mcap")
        header, *rows = ok("ls").splitlines()
        assert header.split() == [
            "RECORDING", "RUN", "ENVIRONMENT", "EPISODES", "STEPS", "RETURN", "STARTED", "SIZE", "STATE",
        ]  # fmt: skip
        assert [row.split()[0] for row in rows] == ["a.mcap", "deep/b.mcap"]
        with Recording(cartpole) as recording:
            mean = f"{recording.index['return'].mean():.2f}".removesuffix(".00")
            expected = [str(len(recording)), "200", mean]
        assert rows[0].split()[1:6] == ["a", "CartPole-v1", *expected]
        assert rows[0].split()[-1] == "complete"
        (told,) = run("ls", "deep", "--json").json
        assert told["recording"] == "deep/b.mcap"
        assert (told["steps"], told["state"], told["error"]) == (200, "complete", None)

    def test_ls_has_a_row_for_each_run(self, here: Path) -> None:
        for name in ("a", "b"):
            record_rollouts("CartPole-v1", f"{name}.mcap", name=name, steps=20_000, max_bytes=20_000)
        files = [[str(path) for path in sorted(here.glob(f"{name}*.mcap"))] for name in "ab"]
        names = [[Path(path).name for path in one] for one in files]
        assert min(map(len, names)) > 2
        dataset = tupli_mcap.open([*names[0]])
        rows = run("ls", "--json").json
        assert [(row["run"], row["recording"], row["paths"], row["files"]) for row in rows] == [
            (name, f"{name}.mcap", one, len(one)) for name, one in zip("ab", names, strict=True)
        ]
        row = rows[0]
        with Recording("a.mcap") as first:
            assert (row["started"], row["state"]) == (first.run.started, "complete")
        assert (row["episodes"], row["steps"]) == (len(dataset), 20_000)
        assert row["return"] == pytest.approx(dataset.returns.mean())
        assert row["size"] == sum(Path(name).stat().st_size for name in names[0])
        header, line, _ = ok("ls").splitlines()
        assert header.split()[:3] == ["RECORDING", "FILES", "RUN"]
        assert line.split()[:3] == ["a.mcap", str(len(names[0])), "a"]
        # the files in any order, and as a server lists them
        assert run("ls", *reversed(names[0]), "--json").json == [row]
        (served,) = by_run(listed_of(dataset.headers))
        assert (served.files, served.episodes, served.steps, served.size) == (
            len(names[0]), len(dataset), 20_000, None,
        )  # fmt: skip
        last = tupli_mcap.open(names[0][-1])
        last[0].annotate(success=True)
        (tagged,) = run("ls", *names[0], "--filter", "metadata.success", "--json").json
        assert (tagged["paths"], tagged["episodes"], tagged["success"]) == ([names[0][-1]], 1, 1)
        (tagged,) = run("ls", *names[0], "--columns", "success,paths", "--json").json
        assert tagged == {"success": 1, "paths": names[0]}
        assert f"100% of 1 {len(names[0])} " in " ".join(
            ok("ls", *names[0], "--columns", "success,files,run").split()
        )
        assert "did you mean 'recording'" in fails("ls", "--columns", "file", code=2)
        assert "(your own: run.metadata.lr)" in fails("ls", "--columns", "run,lr", code=2)

    def test_ls_shows_the_split_where_a_run_has_one(self, here: Path) -> None:
        record_rollouts("CartPole-v1", "a.mcap", name="ppo", steps=20)
        assert "SPLIT" not in ok("ls")
        record_rollouts("CartPole-v1", "b.mcap", name="ppo", steps=20, split="eval")
        header, first, second = ok("ls").splitlines()
        assert (header.split()[-1], second.split()[-1]) == ("SPLIT", "eval")
        assert not first.endswith("eval")

    def test_ls_names_a_file_with_episodes_before_one_without(self, here: Path) -> None:
        record_rollouts("CartPole-v1", "z.mcap", name="z", steps=2000)
        Path("a.mcap").write_bytes(Path("z.mcap").read_bytes()[:3000])  # a copy that was cut off
        (told,) = json.loads(run("ls", "--json").out)["result"]
        assert (told["paths"], told["steps"], told["state"]) == (["z.mcap", "a.mcap"], 2000, "incomplete")

    def test_ls_counts_the_chosen_episodes(self, here: Path) -> None:
        for name in ("a", "b"):
            record_rollouts("CartPole-v1", f"runs/{name}.mcap", name=name, episodes=4, seed=ord(name))
        returns = [tupli_mcap.open(f"runs/{name}.mcap").returns for name in "ab"]
        told = run("ls", "runs", "--episodes", "0,2", "--json").json
        assert [(row["run"], row["episodes"], row["return"]) for row in told] == [
            (name, 2, found[[0, 2]].mean()) for name, found in zip("ab", returns, strict=True)
        ]
        (told,) = run("ls", "runs", "--episodes", "best", "--columns", "run,return", "--json").json
        assert told == {"run": "ab"[np.argmax([max(found) for found in returns])], "return": np.max(returns)}
        (told,) = run(
            "ls", "runs", "-e", "0-3", "--filter", f"return < {np.min(returns) + 0.5}", "--json"
        ).json
        assert told["return"] == np.min(returns)
        assert "no episode 9; choose from 0 to 3" in fails("ls", "runs", "--episodes", "9")

    def test_ls_counts_no_episode_of_a_run_twice(self, here: Path) -> None:
        record_rollouts("CartPole-v1", "a.mcap", steps=20_000, max_bytes=20_000)
        names = sorted(path.name for path in here.glob("*.mcap"))
        ok(
            "filter",
            "a.mcap",
            "--filter",
            "steps > 20",
            "-o",
            "best.mcap",
            "--sort",
            "-return",
            "--limit",
            20,
        )
        ok("merge", *names, "-o", "all.mcap")
        ok("split", "a.mcap", "-o", "split.mcap", "--episodes", 100)
        shutil.copytree(".", "copy")
        for path in Path("copy").glob("[!a]*.mcap"):
            path.unlink()
        Path("copy/all.mcap").unlink()
        rows = {row["recording"]: row["paths"] for row in run("ls", "--json").json}
        assert rows == {
            "a.mcap": names,
            "all.mcap": ["all.mcap"],
            "best.mcap": ["best.mcap"],
            "copy/a.mcap": [f"copy/{name}" for name in names],
            "split.mcap": sorted(path.name for path in here.glob("split*.mcap")),
        }
        assert len(rows["split.mcap"]) > 1

    def test_names_with_the_marks_of_urls(self, here: Path, cartpole: Path) -> None:
        (here / "lab#2").mkdir()
        path = shutil.copy(cartpole, here / "lab#2" / "what? run#3.mcap")
        (told,) = run("ls", path.parent, "--json").json
        assert told["recording"] == str(path)
        assert run("info", path.parent, "--json").json["path"] == str(path.parent)
        assert "lab#2" in ok("info", path.parent)
        assert "run#3.mcap" in repr(tupli_mcap.open(path))

    def test_ls_of_nothing(self, here: Path) -> None:
        assert ok("ls") == "no recordings\n"
        assert run("ls", "--json").json == []

    def test_ls_says_what_it_could_not_read_and_goes_on(self, here: Path, cartpole: Path) -> None:
        shutil.copy(cartpole, "good.mcap")
        Path("bad.mcap").write_bytes(b"nonsense")
        result = run("ls", ".", "gone.mcap")
        assert result.code == 1
        assert [line.split()[0] for line in result.out.splitlines()] == ["RECORDING", "good.mcap"]
        first, second = result.err.splitlines()
        assert first.startswith("error: bad.mcap: expected an MCAP file, found b'nonsense'")
        missing = "gone.mcap does not exist; give a recording (.mcap) or a directory of them"
        assert second == f"error: {missing} (here: bad.mcap, good.mcap)"
        as_json = run("ls", "bad.mcap", "--json")
        assert as_json.code == 1
        assert json.loads(as_json.out)["result"][0]["error"].startswith("bad.mcap: expected an MCAP file")

    def test_ls_leaves_out_deleted_episodes(self, lab: tuple[Path, str, str]) -> None:
        with FileStorage(lab[0]) as storage:
            storage.delete_episode(storage.list_episodes()[0].id)
        assert sum(item["episodes"] for item in run("ls", "lab", "--json").json) == 4

    def test_ls_leaves_out_the_folders_of_a_storage(self, lab: tuple[Path, str, str]) -> None:
        told = run("ls", "lab", "--json").json
        paths = [Path(row["recording"]) for row in told]
        assert all(path.exists() and path.parts[:2] == ("lab", "recordings") for path in paths)
        _, *rows = ok("ls", "lab").splitlines()
        assert [row.split()[0] for row in rows] == [f"lab/…/{path.name}" for path in paths]
        _, *rows = ok("ls", "lab", "--columns", "paths").splitlines()
        assert rows == [str(path) for path in paths]

    def test_ls_tells_a_live_recording_from_a_killed_one(self, here: Path) -> None:
        env = RecordEpisodes(gym.make("CartPole-v1"), "a.mcap")
        env.reset(seed=1)
        env.step(0)
        assert run("ls", "a.mcap", "--json").json[0]["state"] == "recording"
        for name in ("a.mcap", "a.mcap.journal"):
            shutil.copy(name, f"b{name[1:]}")
        (told,) = run("ls", "b.mcap", "--json").json
        assert (told["state"], told["episodes"], told["steps"]) == ("unfinished", 1, 1)
        assert "did not finish it; all steps of its chunks and its journal are shown" in ok("info", "b.mcap")
        Path("b.mcap.journal").unlink()
        told = run("info", "b.mcap").out  # with a warning
        assert re.search(
            r"did not finish it and its journal is missing; the steps of its chunks\s+are shown", told
        )
        assert json.loads(run("ls", "b.mcap", "--json").out)["result"][0]["state"] == "incomplete"
        env.close()

    def test_recover_names_the_episode_that_lost_its_final_state(self, here: Path) -> None:
        two = gym.spaces.Discrete(2)
        with tupli_mcap.EpisodeWriter("a.mcap", two, two, num_envs=2) as writer:
            for env, name in enumerate("bc"):
                writer.begin(env=env)
                writer.step(0, 0, 0.0, env=env)
                for end in (".mcap", ".mcap.journal"):
                    shutil.copy(f"a{end}", f"{name}{end}")
        assert "  lost: the final state of episode 0\n" in ok("recover", "--in-place", "b.mcap")
        assert "  lost: the final state of episodes 0, 1\n" in ok("recover", "--in-place", "c.mcap")

    def test_info(self, cartpole: Path, here: Path) -> None:
        out = ok("info", cartpole)
        facts = dict(re.split(r"\s{2,}", line, maxsplit=1) for line in out.split("\n\n")[0].splitlines())
        assert facts["recording"] == str(cartpole)
        assert facts["state"] == "complete"
        assert facts["environment"] == "CartPole-v1"
        assert facts["benchmark"] == "none"
        assert facts["action"] == "one of 2: 0 Push cart to the left, 1 Push cart to the right"
        assert facts["observation"] == "4 numbers (float32)"
        assert re.search(r"^ +Cart Position +-4\.8 … 4\.8\n +Cart Velocity +-inf … inf$", out, re.MULTILINE)
        assert re.search(r"compressed \d+\.\d : 1", facts["size"])
        assert "/step           tupli_mcap/msg/Step" in out
        assert "benchmark.json" in out

    def test_info_says_how_many_episodes_were_left_out(self, cartpole: Path, here: Path) -> None:
        with Recording(cartpole) as recording:
            last = len(recording) - 1
        assert "left out" not in ok("info", cartpole)
        assert run("info", cartpole, "--json").json["left_out"] == 0
        ok("filter", cartpole, "--episodes", "1", "-o", "one.mcap")
        assert f"\nleft out     {last} episodes: deleted, lost, or not chosen for this file\n" in ok(
            "info", "one.mcap"
        )
        assert run("info", "one.mcap", "--json").json["left_out"] == last

    def test_info_counts_deleted_episodes(self, cartpole: Path, here: Path) -> None:
        shutil.copy(cartpole, "a.mcap")
        assert "\ndeleted " not in ok("info", "a.mcap")
        ok("delete", "a.mcap", "-e", "0,2")
        assert "\ndeleted      2 episodes; see tupli-mcap restore, compact\n" in ok("info", "a.mcap")
        assert run("info", "a.mcap", "--json").json["deleted"] == 2
        ok("compact", "a.mcap")
        assert "\ndeleted " not in ok("info", "a.mcap")

    def test_info_tells_runs_by_what_differs(self, here: Path) -> None:
        for split in ("train", "eval"):
            settings = {"lr": 0.5, "seed": len(split)}
            with RecordEpisodes(
                gym.make("CartPole-v1"), "a.mcap", mode="a", name="ppo", split=split, metadata=settings
            ) as env:
                env.reset(seed=1)
                env.step(0)
        out = ok("info", "a.mcap")
        assert "\nruns         ppo (train, 1 episode, seed=5), ppo (eval, 1 episode, seed=4)\n" in out
        assert "\nsettings     lr=0.5\n" in out

    def test_filter_takes_the_first_of_all(self, cartpole: Path, here: Path) -> None:
        ok("filter", cartpole, "--sort", "-return", "--limit", 1, "-o", "best.mcap")
        with Recording("best.mcap") as best, Recording(cartpole) as recording:
            assert best.returns.tolist() == [recording.returns.max()]
            assert best.made_of["query"] == "sort: return, descending; head: 1"
        assert "to copy all episodes, merge them" in fails("filter", cartpole, "-o", "all.mcap", code=2)

    def test_info_counts_frames(self, cartpole: Path, here: Path) -> None:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        with RecordEpisodes(env, here / "f.mcap", frames=2) as recorded:
            recorded.reset(seed=1)
            for _ in range(4):
                recorded.step(0)
        assert "\nframes       3 of render\n" in ok("info", "f.mcap")
        assert "\nframes " not in ok("info", cartpole)

    def test_info_of_infos_and_seeds(self, here: Path) -> None:
        def score(step: tupli_mcap.Step) -> dict[str, Any]:
            return {"logp": -0.5, "step": float(step.state[0]), "name": "x"}

        env = gym.make("CartPole-v1", max_episode_steps=5)
        with RecordEpisodes(env, here / "i.mcap", step_callback=score) as recorded:
            for seed in (1, 2, 2):
                recorded.reset(seed=seed)
                while not any(recorded.step(0)[2:4]):
                    pass
        out = ok("info", "i.mcap")
        assert re.search(r"^seeds +2 different$", out, re.M) and re.search(
            r"^infos +logp, name, step$", out, re.M
        )
        assert re.search(r"^info\.logp .* -0\.500 +-0\.500$", out, re.M) and "info.step" in out
        assert "info.name" not in out and "\ninfos that are not shown: name\n" in out
        facts = json.loads(ok("info", "i.mcap", "--json", "--episodes", "1,2"))["result"]
        assert (facts["info_keys"], facts["seeds"]) == (["logp", "name", "step"], 1)
        with RecordEpisodes(env, here / "j.mcap", step_callback=lambda step: {"force": 1}) as recorded:
            recorded.reset(seed=1)
            recorded.step(0)
        assert re.search(r"^infos +force, logp, name, step$", ok("info", "."), re.M)
        assert run("info", ".", "--filter", "steps = 1", "--json").json["info_keys"] == ["force"]

    def test_info_of_numbers_within_infos(self, here: Path) -> None:
        info = {
            "many": np.ones(17),
            "contact": {"left": np.array([1.5, -2])},
            "part": np.arange(6),
            "force": 1,
            "took": np.timedelta64(3, "s"),
        }
        with RecordEpisodes(
            gym.make("CartPole-v1"), here / "i.mcap", step_callback=lambda step: info
        ) as recorded:
            recorded.reset(seed=1)
            recorded.step(0)
        out = ok("info", "i.mcap")
        names = re.findall(r"^(info\.\S+) ", out, re.M)
        contact = ["info.contact.left[0]", "info.contact.left[1]"]
        assert names == ["info.force", *contact, "info.part[0]", "info.part[1]", "info.part[2]"]
        assert "\ninfos that are not shown: many, part, took\n" in out

    def test_info_of_several_is_of_one_dataset(self, here: Path, cartpole: Path) -> None:
        shutil.copy(cartpole, here / "a.mcap")
        record_rollouts("CartPole-v1", "deep/b.mcap", steps=50, seed=9)
        below, several, pattern = (
            run("info", *sources, "--json").json
            for sources in ((".",), ("a.mcap", "deep"), ("**/*.mcap", "a.mcap"))
        )
        assert (several["episodes"], several["steps"]) == (len(tupli_mcap.open(".")), 250)
        assert (below.pop("path"), below.pop("paths")) == (".", ["."])
        assert (several.pop("path"), several.pop("paths")) == (None, ["a.mcap", "deep"])
        assert several == below
        assert below["ends"].keys() == run("info", "a.mcap", "--json").json["ends"].keys()
        assert sum(below["ends"].values()) == below["episodes"]
        assert pattern["episodes"] == below["episodes"]  # each counts once
        out = ok("info", "a.mcap", "deep/b.mcap", "--episodes", "0")
        assert re.search(r"^sources +a\.mcap, deep/b\.mcap\nrecordings +2$", out, re.M)
        assert re.search(r"^episodes +2 ", out, re.M)
        assert ok("info", "**/*.mcap").startswith("pattern ")
        assert fails("info", "a.mcap", "gone.mcap").startswith("gone.mcap does not exist")

    def test_the_advice_to_finish_a_recording_can_be_typed(self, here: Path) -> None:
        folder = here / "my runs"
        folder.mkdir()
        args = ("tag", golden("unfinished", folder), "--episodes", "all", "good=true")
        command = fails(*args).partition("finish it with: ")[2]
        ok(*shlex.split(command)[1:])
        ok(*args)

    def test_info_names_a_run_of_several_files_once(self, here: Path) -> None:
        record_rollouts("CartPole-v1", "a.mcap", steps=20_000, max_bytes=20_000)
        told = run("info", ".", "--json").json
        assert told["recordings"] > 1 and told["runs"] == ["a"]

    def test_info_of_infos_whose_keys_are_no_texts(self, here: Path) -> None:
        keys: dict[Any, float] = {1: 2.0, "x": 1.0, 0: 3.0, None: 4.0}
        with RecordEpisodes(
            gym.make("CartPole-v1"), here / "i.mcap", step_callback=lambda step: keys
        ) as recorded:
            recorded.reset(seed=1)
            recorded.step(0)
        out = ok("info", "i.mcap")
        assert re.search(r"^infos +0, 1, None, x$", out, re.M) and "info.0" in out

    def test_info_as_json(self, cartpole: Path, here: Path) -> None:
        told = run("info", cartpole, "--json").json
        with Recording(cartpole) as recording:
            assert told["uuid"] == recording.uuid
            assert told["episodes"] == len(recording) == sum(told["ends"].values())
            assert told["returns"]["mean"] == pytest.approx(recording.index["return"].mean())
            assert told["lengths"]["max"] == recording.index["length"].max()
        (steps,) = [channel for channel in told["channels"] if channel["topic"] == "/step"]
        assert steps["messages"] == 200

    @pytest.mark.parametrize(
        ("returns", "said"),
        [
            ([2.0, math.nan, 4.0], "mean 3, std 1, from 2 to 4; NaN in 1 episode, left out"),
            ([math.nan, math.nan], "NaN in every episode"),
        ],
    )
    def test_info_of_returns_that_are_no_numbers(self, here: Path, returns: list[float], said: str) -> None:
        rewards = iter(returns)
        env = gym.wrappers.TransformReward(gym.make("CartPole-v1"), lambda _: next(rewards))
        with RecordEpisodes(env, "r.mcap") as recorder:
            for _ in returns:
                recorder.reset(seed=1)
                recorder.step(0)
        assert f"return       {said}\n" in ok("info", "r.mcap")
        assert run("info", "r.mcap", "--json").json["returns"]["nan"] == returns.count(math.nan)

    @pytest.mark.parametrize(
        ("returns", "told", "row", "mean"),
        [
            (
                [2.0, math.nan, 4.0],
                "mean return 3 (NaN in 1 episode, left out)",
                "3 3 3 {} complete NaN in 1 episode, left out",
                3,
            ),
            (
                [math.nan, math.nan],
                "return NaN in every episode",
                "2 2 {} complete NaN in every episode",
                None,
            ),
            ([2.0, 4.0], "mean return 3", "2 2 3 {} complete", 3),
        ],
    )
    def test_means_of_returns_that_are_no_numbers(
        self,
        here: Path,
        monkeypatch: pytest.MonkeyPatch,
        returns: list[float],
        told: str,
        row: str,
        mean: object,
    ) -> None:
        rewards = iter(returns * 2)

        def make(**_: Any) -> gym.Env[Any, Any]:
            env = gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 1)
            return gym.wrappers.TransformReward(env, lambda _: next(rewards))

        gym.register("tests/Rewarded-v0", make, disable_env_checker=True)
        try:
            said = ok("record", "tests/Rewarded-v0", "-o", "r.mcap", "--steps", len(returns))
            as_json = run(
                "record", "tests/Rewarded-v0", "-o", "s.mcap", "--steps", len(returns), "--json"
            ).json
        finally:
            gym.registry.pop("tests/Rewarded-v0")
        assert f"{len(returns)} steps, {told}, " in said
        size = bytes_of(Path("r.mcap").stat().st_size)
        told_row = ok("ls", "r.mcap", "--columns", "recording,episodes,steps,return,size,state").splitlines()[
            1
        ]
        assert " ".join(told_row.split()) == f"r.mcap {row.format(size)}"
        monkeypatch.setenv("COLUMNS", "76")
        assert ok("ls", "r.mcap").splitlines()[1].startswith("r.mcap ")  # the note is what is cut
        (listed,) = run("ls", "r.mcap", "--json").json
        for facts in (as_json, listed):
            assert (facts["return"], facts["return_nan"]) == (mean, sum(map(math.isnan, returns)))

    def test_info_of_some_episodes(self, cartpole: Path, here: Path) -> None:
        with Recording(cartpole) as recording:
            lengths = recording.index["length"]
        chosen = lengths[lengths > 20]
        told = run("info", cartpole, "--filter", "steps > 20", "--json").json
        assert (told["episodes"], told["steps"]) == (len(chosen), chosen.sum())
        assert told["returns"]["min"] == told["lengths"]["min"] == chosen.min()
        assert sum(told["ends"].values()) == len(chosen)
        whole = run("info", cartpole, "--json").json
        assert (told["size"], told["channels"]) == (whole["size"], whole["channels"])
        assert told["started"] >= whole["started"]
        out = ok("info", cartpole, "--episodes", "1-2,best")
        assert re.search(rf"^steps +{lengths[[1, 2, lengths.argmax()]].sum()},", out, re.MULTILINE)
        shutil.copy(cartpole, "a.mcap")
        for options in (["--episodes", "0-2"], ["--filter", "episode < 3"]):
            assert run("info", ".", *options, "--json").json["steps"] == lengths[:3].sum()
        assert "has no episode that" in fails("info", cartpole, "--filter", "steps > 999")

    def test_the_least_and_the_most_are_in_one_form(self, here: Path) -> None:
        ok("record", "CartPole-v1", "-o", "a.mcap", "--steps", 100, "--seed", 3)
        steps = ok("info", "a.mcap").split("\n\n")[2].splitlines()[1:]
        for column in (-1, -2):
            assert {len(line.split()[column].partition(".")[2]) for line in steps} == {3}

    def test_the_environment_has_one_name(self, here: Path) -> None:
        with RecordEpisodes(Reach(), "a.mcap") as env:
            env.reset(seed=1)
            env.step(0)
        (name,) = run("info", ".", "--json").json["environments"]
        assert run("info", "a.mcap", "--json").json["environment"] == name
        assert run("ls", "a.mcap", "--json").json[0]["environment"] == name

    def test_the_columns_of_ls_as_json(self, cartpole: Path, here: Path) -> None:
        (told,) = run("ls", cartpole, "--columns", "Steps,return", "--json").json
        assert list(told) == ["steps", "return"]
        listed = re.search(r"Columns are\s(.*?)\.", ok("ls", "--help"), re.DOTALL)
        assert listed is not None
        names = ",".join(re.findall(r"\w+", listed[1]))
        assert ",".join(run("ls", cartpole, "--columns", names, "--json").json[0]) == names
        assert told["steps"] == 200

    def test_an_unknown_column_of_episodes_tells_what_is_meant(self, here: Path) -> None:
        ok("record", "CartPole-v1", "-o", "a.mcap", "--set", "lr=0.1")
        said = fails("episodes", "a.mcap", "--columns", "metadata.lr", code=2)
        assert "no episode has metadata.lr (did you mean 'run.metadata.lr'?)" in said

    def test_named_columns_stay_without_values(self, cartpole: Path, here: Path) -> None:
        names = ["run", "settings", "tags", "split", "run.metadata.lr"]
        title, _ = ok("ls", cartpole, "--columns", ",".join(names)).splitlines()
        assert title.split() == ["RUN", "SETTINGS", "TAGS", "SPLIT", "RUN.METADATA.LR"]
        title, *_ = ok("episodes", cartpole, "--columns", "seed,created_by,run.split").splitlines()
        assert title.lower().split() == ["seed", "created_by", "run.split"]
        assert "SPLIT" not in ok("ls", cartpole)

    def test_both_lists_take_quoted_parts_of_a_column(self, here: Path) -> None:
        with RecordEpisodes(Reach(), "a.mcap", metadata={"opt": {"v1.0": 3}}) as env:
            env.reset(seed=1)
            env.step(0)
        key = 'run.metadata.opt."v1.0"'
        for command in ("ls", "episodes"):
            assert run(command, "a.mcap", "--columns", key, "--json").json == [{key: 3}]
        assert "needs a name at character 13" in fails("ls", "a.mcap", "--columns", "run.metadata.", code=2)

    def test_ls_takes_the_other_names_of_columns(self, cartpole: Path, here: Path) -> None:
        ok("record", "CartPole-v1", "-o", "short.mcap", "--steps", 5)
        for key, other in (("steps", "n_tuples"), ("return", "episode_return")):
            listed = run(
                "ls", cartpole, "short.mcap", "--columns", other, "--sort", f"-{other}", "--json"
            ).json
            named = run("ls", cartpole, "short.mcap", "--columns", key, "--sort", f"-{key}", "--json").json
            assert [row[other] for row in listed] == [row[key] for row in named]

    def test_doctor_of_some_episodes(self, cartpole: Path, here: Path) -> None:
        with Recording(cartpole) as recording:
            lengths = recording.index["length"]
        for which, steps in (("best", lengths.max()), ("1,3-4", lengths[[1, 3, 4]].sum())):
            assert run("doctor", cartpole, "--episodes", which, "--json").json["steps"] == steps
        assert "no episode 999" in fails("doctor", cartpole, "--episodes", "999")
        assert "found 'x'" in fails("doctor", cartpole, "--episodes", "x", code=2)

    def test_verify_of_some_episodes(self, cartpole: Path, here: Path) -> None:
        with Recording(cartpole) as recording:
            lengths = recording.index["length"]
        args = ("verify", cartpole, "--rerun", "--filter", "steps > 20")
        (replay,) = run(*args, "--json").json["reruns"]
        assert replay["certificate"]["chosen"]["episodes"] == (lengths > 20).sum()
        (replay,) = run("verify", cartpole, "--rerun", "--episodes", "best,0-2", "--json").json["reruns"]
        assert replay["certificate"]["chosen"]["episodes"] in (3, 4)
        shutil.copy(cartpole, "a.mcap")
        ok("record", "CartPole-v1", "-o", "b.mcap", "--steps", 5)
        told = run("verify", ".", "--rerun", "--filter", "steps > 20", "--json").json
        assert [item["path"] for item in told["reruns"]] == ["a.mcap"]
        none = run("verify", cartpole, "--rerun", "--filter", "steps > 999")
        assert (none.code, none.err.count("\n")) == (1, 1)
        assert "no episode was run again" in none.err
        assert run("verify", cartpole, "--rerun", "--filter", "steps > 999", "--json").err == none.err
        assert "go with --rerun" in fails("verify", cartpole, "--filter", "steps > 20", code=2)

    def test_ls_prints_the_first_so_many(self, here: Path) -> None:
        for i, steps in enumerate((3, 9, 6)):
            ok("record", "CartPole-v1", "-o", f"{i}.mcap", "--steps", steps)
        best = ("ls", "--sort", "-steps", "--limit", 2)
        assert [item["steps"] for item in run(*best, "--json").json] == [9, 6]
        assert [line.split()[0] for line in ok(*best).splitlines()[1:]] == ["1.mcap", "2.mcap"]
        assert len(run("ls", "--limit", 7, "--json").json) == 3

    def test_info_of_an_empty_recording(self, here: Path) -> None:
        spaces = gym.make("CartPole-v1")
        write_recording(
            "empty.mcap", [], observation_space=spaces.observation_space, action_space=spaces.action_space
        )
        assert "not known before the first step" in ok("info", "empty.mcap")
        assert run("info", "empty.mcap", "--json").json["returns"] is None
        assert ok("episodes", "empty.mcap") == "no episodes\n"

    def test_info_of_nested_spaces_has_a_line_for_each_part(self, here: Path) -> None:
        ok("record", "Blackjack-v1", "-o", "a.mcap", "--steps", 20)
        lines = ok("info", "a.mcap").splitlines()
        at = lines.index("observation  state[0]: one of 32: 0 … 31")
        assert [line.strip() for line in lines[at + 1 : at + 3]] == [
            "state[1]: one of 11: 0 … 10",
            "state[2]: one of 2: 0 … 1",
        ]
        said = run("info", "a.mcap", "--json").json["observation_space"]
        assert said == "Tuple(Discrete(32), Discrete(11), Discrete(2))"

    @pytest.mark.parametrize(
        ("space", "said"),
        [
            (gym.spaces.Box(-1, 1, (3, 2), np.float32), ["3 x 2 numbers, each -1 … 1 (float32)"]),
            (gym.spaces.Box(0, 255, (8, 8, 3), np.uint8), ["8 x 8 x 3 numbers, each 0 … 255 (uint8)"]),
            (gym.spaces.Box(0.5, np.inf, (), np.float64), ["1 number, 0.5 … inf (float64)"]),
            (
                gym.spaces.Box(-np.arange(99, dtype=np.float32), np.float32(7), dtype=np.float32),
                ["99 numbers, of -98 … 7 (float32)"],
            ),
            (gym.spaces.Box(-0.0, 1, (2,), np.float32), ["2 numbers, each 0 … 1 (float32)"]),
            (gym.spaces.Box(0, 1, (0,), np.float32), ["0 numbers (float32)"]),
            (
                gym.spaces.MultiDiscrete([3, 30], start=[1, 0]),
                ["2 numbers", "state[0]  1 … 3", "state[1]  0 … 29"],
            ),
            (gym.spaces.MultiBinary(4), ["4 numbers, each 0 … 1"]),
            (gym.spaces.Discrete(1, start=7), ["one of 1: 7"]),
        ],
    )
    def test_spaces_are_written_to_be_read(self, space: gym.Space[Any], said: list[str]) -> None:
        leaves = flatten_space(space, "state", NameRegistry())
        assert space_lines(leaves, Labels.none(), {leaf.name: leaf.dtype for leaf in leaves}) == said

    def test_episodes_of_several_recordings_say_which(self, here: Path) -> None:
        for name, run_name in (("a", "ppo"), ("b", "sac"), ("c", "sac")):
            with RecordEpisodes(gym.make("CartPole-v1"), f"{name}.mcap", name=run_name) as env:
                env.reset(seed=1)
                env.step(0)
        head, *rows = (line.split() for line in ok("episodes", "a.mcap", "b.mcap").splitlines())
        assert head[:3] == ["ID", "RUN", "STEPS"] and [row[1] for row in rows] == ["ppo", "sac"]
        head, *rows = (line.split() for line in ok("episodes", "a.mcap", "b.mcap", "c.mcap").splitlines())
        assert head[1] == "RECORDING" and [row[1] for row in rows] == ["a.mcap", "b.mcap", "c.mcap"]

    def test_patterns(self, cartpole: Path, here: Path) -> None:
        for name in ("x/a", "y/b"):
            Path(name).parent.mkdir()
            shutil.copy(cartpole, f"{name}.mcap")
        assert [item["recording"] for item in run("ls", "*/*.mcap", "--json").json] == [
            "x/a.mcap",
            "y/b.mcap",
        ]
        assert run("episodes", "?/b.mcap").code == 0
        assert "found none" not in run("plot", "x/*.mcap", "-o", "x.png").err and Path("x.png").exists()
        assert fails("ls", "*.mcap") == "no file matches '*.mcap'; give the path of a recording (.mcap)"

    def test_info_says_which_dtype_is_stored(self, here: Path) -> None:
        space = gym.spaces.Dict(q=gym.spaces.Box(-np.inf, np.inf, (7,), np.float32))
        env = Scripted(lambda step: {"q": np.full(7, 0.1)}, space)
        with pytest.warns(UserWarning, match="float64"), RecordEpisodes(env, "r.mcap") as recorder:
            recorder.reset()
            recorder.step(0)
        assert "observation  state.q: 7 numbers (float64, declared float32)\n" in ok("info", "r.mcap")

    def test_info_of_texts_counts_their_characters(self, here: Path) -> None:
        space = gym.spaces.Dict({"say": gym.spaces.Text(20), "bit": gym.spaces.Text(1, charset="01")})
        states = [{"say": "up", "bit": "1"}]
        episode = EpisodeData(states, [0], [1.0], [True], [False])
        write_recording("r.mcap", [episode], observation_space=space, action_space=gym.spaces.Discrete(2))
        out = ok("info", "r.mcap")
        assert "observation  state.bit: Text(1..1, 2 characters)\n" in out
        assert "             state.say: Text(1..20, 62 characters)\n" in out

    def test_episodes_of_a_file(self, cartpole: Path, here: Path) -> None:
        header, *rows = ok("episodes", cartpole).splitlines()
        assert header.split() == ["EPISODE", "STEPS", "RETURN", "END", "SEED", "ENDED"]
        with Recording(cartpole) as recording:
            assert [int(row.split()[1]) for row in rows] == recording.index["length"].tolist()
            long = int((recording.index["length"] > 20).sum())
        assert len(run("episodes", cartpole, "--filter", "n_tuples > 20", "--json").json) == long
        assert len(run("episodes", cartpole, "--limit", 2, "--json").json) == 2
        assert ok("episodes", cartpole, "--filter", "n_tuples > 1000") == "no episodes\n"
        shown = re.search(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[+-]\d\d:\d\d", rows[0])
        assert shown is not None
        then = sum(shown[0] in row for row in rows)  # in the same second
        assert len(run("episodes", cartpole, "--filter", f'ended = "{shown[0]}"', "--json").json) == then
        later = f'created_at >= "{shown[0][:19]}" and ended <= "today"'
        assert len(run("episodes", cartpole, "--filter", later, "--json").json) == len(rows)
        assert "expected a time, such as" in fails("episodes", cartpole, "--filter", "ended > 5", code=2)

    def test_episodes_by_number_and_by_word(self, cartpole: Path, here: Path) -> None:
        def numbers(*words: object) -> list[int]:
            return [each["episode"] for each in run("episodes", *words, "--json").json]

        returns = [each["return"] for each in run("episodes", cartpole, "--json").json]
        best = returns.index(max(returns))
        assert numbers(cartpole, "--episodes", "best") == [best]
        assert numbers(cartpole, "-e", "2-3,0", "--sort", "-episode") == [3, 2, 0]
        (here / "runs").mkdir()
        shutil.copy(cartpole, here / "runs")
        assert numbers("runs", "--episodes", "best", "--limit", 5) == [best]
        assert "no episode" in fails("episodes", cartpole, "--episodes", "999")

    def test_episodes_of_a_storage(self, filled: tuple[Path, str, str], here: Path) -> None:
        told = run("episodes", filled[0], "--json").json
        assert len(told) == 5
        assert {item["benchmark_id"] for item in told} == set(filled[1:])
        assert len(ok("episodes", filled[0], "--limit", 3).splitlines()) == 4

    def test_values_json_has_no_word_for(self, here: Path) -> None:
        class Odd(Return):
            def __call__(self, tuple: RLTuple) -> dict[str, Any]:
                return {"score": float("nan"), "at": np.float32(0.5), "name": "a\nb\x1b[31m"}

        with RecordEpisodes(gym.make("CartPole-v1"), "a.mcap", metadata_callback=Odd()) as env:
            env.reset()
            env.step(0)
        (told,) = run("episodes", "a.mcap", "--json").json
        assert told["metadata"] == {"score": None, "at": 0.5, "name": "a\nb\x1b[31m"}
        out = ok("episodes", "a.mcap")
        assert r"score=nan, at=0.5, name=a\nb\x1b[31m" in out  # nothing in a file moves the cursor


# --- what is no recording ---


def foreign(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="other")
        schema = writer.register_schema("thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing", "json", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"{}")
        writer.finish()


def without_crc(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file, enable_crcs=False)
        writer.start(profile="ros2")
        writer.finish()


def with_a_topic_twice(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for encoding in ("json", "cdr"):
            writer.register_channel("/tf", encoding, 0)
        writer.finish()


def truncated(path: Path) -> None:
    record_rollouts("CartPole-v1", path, steps=50)
    path.write_bytes(path.read_bytes()[:40])


BAD_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, r"bad\.mcap does not exist; give the path of a recording \(\.mcap\)"),
    "empty": (Path.touch, r"bad\.mcap is empty; expected an MCAP recording"),
    "text": (
        lambda path: path.write_text("hello, world"),
        r"bad\.mcap: expected an MCAP file, found b'hello, w.*",
    ),
    "truncated": (truncated, r"bad\.mcap: the file is cut off or damaged before its first step.*"),
    "foreign": (foreign, r"bad\.mcap is an MCAP file, but no tupli_mcap recording .*"),
    "without CRC": (without_crc, r"bad\.mcap is an MCAP file, but no tupli_mcap recording .*"),
    "topic twice": (with_a_topic_twice, r"bad\.mcap is an MCAP file, but no tupli_mcap recording .*"),
    "directory": (Path.mkdir, r"bad\.mcap is a directory; .*"),
}


@pytest.mark.sampled(10)
@pytest.mark.filterwarnings("ignore:.*has no journal")
@pytest.mark.parametrize("kind", BAD_FILES)
@pytest.mark.parametrize(
    "command",
    [("info",), ("trust",), ("import", "--storage", "lab"), ("bundle", "-o", "out.mcap")],
    ids=lambda c: c[0],
)
def test_files_that_are_no_recording(here: Path, kind: str, command: tuple[str, ...]) -> None:
    make, line = BAD_FILES[kind]
    make(Path("bad.mcap"))
    assert re.search(line, fails(command[0], "bad.mcap", *command[1:]))
    assert not Path("out.mcap").exists()


@pytest.mark.filterwarnings("ignore:.*has no journal")
@pytest.mark.parametrize(
    "command",
    [
        "ls X",
        "info X",
        "episodes X",
        "verify X",
        "doctor X",
        "plot X -o new.html",
        "render X -o new.gif",
        "view X --save new.rrd",
        "tag X -e 0 good=true",
        "edit X --name new",
        "filter X --filter 'return > 0' -o new.mcap",
        "delete X -e 0",
        "restore X",
        "trim X --steps 1: -o new.mcap",
        "merge X -o new.mcap",
        "split X -o new.mcap --episodes 1",
        "recover X",
        "compact X",
        "compact --storage X",
        "push X",
        "list-episodes --storage X",
        "export --storage X -o new.mcap",
        "import run.mcap --storage X",
    ],
)
def test_an_empty_path_is_not_this_directory(command: str, cartpole: Path, here: Path) -> None:
    shutil.copy(cartpole, here / "run.mcap")
    before = (here / "run.mcap").read_bytes()
    result = run(*("" if word == "X" else word for word in shlex.split(command)))
    assert result.code == 1
    assert "found an empty text" in result.out + result.err
    assert [path.name for path in here.iterdir()] == ["run.mcap"]
    assert (here / "run.mcap").read_bytes() == before


@pytest.mark.parametrize(
    "ask",
    [
        FileStorage,
        tupli_mcap.open,
        lambda place: tupli_mcap.open([place]),
        tupli_mcap.restore_episodes,
        lambda place: list(verify_paths([place])),
    ],
)
def test_in_python_neither(ask: Callable[[str], Any], cartpole: Path, here: Path) -> None:
    shutil.copy(cartpole, here / "run.mcap")
    with pytest.raises(tupli_mcap.TupliError, match="found an empty text"):
        ask("")


@pytest.mark.parametrize("kind", ["empty", "text", "truncated", "foreign"])
def test_episodes_of_files_that_are_no_recording(here: Path, kind: str) -> None:
    make, line = BAD_FILES[kind]
    make(Path("bad.mcap"))
    assert re.search(line, fails("episodes", "bad.mcap"))


def test_a_file_cut_off_later_is_read_up_to_there(here: Path, cartpole: Path) -> None:
    Path("cut.mcap").write_bytes(cartpole.read_bytes()[:-2000])
    result = run("ls", "cut.mcap", "--json")
    assert result.code == 0
    assert result.err.startswith(
        "warning: cut.mcap was not finished and has no journal cut.mcap.journal beside it"
    )
    assert result.err.count("\n") == 1
    (told,) = json.loads(result.out)["result"]
    assert (told["state"], told["error"]) == ("incomplete", None)


@pytest.mark.parametrize(
    "command", [("info",), ("verify", "--rerun"), ("render", "-o", "x.gif"), ("doctor",), ("tag", "a=1")]
)
def test_an_empty_choice_of_episodes_is_refused(command: tuple[str, ...], cartpole: Path, here: Path) -> None:
    """As from a variable of a shell that is not set."""
    path = shutil.copy(cartpole, here / "r.mcap")
    assert "expected numbers of episodes such as '3,7-9'" in fails(*command, path, "-e", "", code=2)
    assert not (here / "x.gif").exists()


@pytest.mark.parametrize(
    "command",
    [("delete",), ("edit", "--name", "x"), ("tag", "a=1"), ("trim", "--steps", "1:", "-o", "x.mcap")],
)
def test_changing_episodes_of_which_none_matches(
    command: tuple[str, ...], cartpole: Path, here: Path
) -> None:
    (here / "runs").mkdir()
    path = Path(shutil.copy(cartpole, here / "runs" / "r.mcap"))
    before = path.read_bytes()
    for place in ("runs", "runs/r.mcap"):
        told = fails(*command, place, "--filter", "steps > 9999")
        assert told == f"there is no episode that matches steps > 9999 in {place}"
        assert "no episode has metadata.lost" in fails(*command, place, "--filter", "metadata.lost", code=2)
    assert path.read_bytes() == before
    assert not (here / "x.mcap").exists()


@pytest.mark.parametrize("command", [("edit", "--name", "x"), ("compact",), ("tag", "--undo"), ("info",)])
def test_a_file_that_does_not_exist(command: tuple[str, ...], here: Path) -> None:
    assert "no.mcap does not exist; give" in fails(*command, "no.mcap")


def test_what_may_be_meant_by_a_path_that_does_not_exist(here: Path, cartpole: Path) -> None:
    (here / "runs").mkdir()
    shutil.copy(cartpole, "runs/ppo.mcap")
    for path, meant in (
        ("runs/pop.mcap", "runs/ppo.mcap"),
        ("rnus/ppo.mcap", "runs/ppo.mcap"),
        ("rnus", "runs"),
    ):
        for command in ("ls", "info", "episodes", "compact", "push"):
            assert fails(command, path).endswith(f" (did you mean '{meant}'?)")
    for name in "abcd":
        shutil.copy(cartpole, f"runs/{name}.mcap")
    assert fails("ls", "runs/dreamer.mcap").endswith(" (in runs: a.mcap, b.mcap, c.mcap and 2 more)")
    assert fails("ls", "elsewhere/x.mcap").endswith(" or a directory of them")


def test_episodes_of_what_is_missing(here: Path) -> None:
    missing = "bad.mcap does not exist; give a recording (.mcap) or a directory of them"
    assert fails("episodes", "bad.mcap") == missing


# --- storages ---


class TestStorages:
    def test_list_benchmarks(self, filled: tuple[Path, str, str], here: Path) -> None:
        root, pole, wind = filled
        header, *rows = ok("list-benchmarks", "--storage", root).splitlines()
        assert header.split() == ["ID", "NAME", "ENVIRONMENT", "CREATED", "DESCRIPTION"]
        assert [row.split()[:2] for row in rows] == [[pole, "pole"], [wind, "wind"]]
        assert rows[0].split()[2] == "CartPole-v1"
        (told,) = run(
            "list-benchmarks", "--storage", root, "--filter", 'metadata.name = "wind"', "--json"
        ).json
        assert (told["id"], told["environment"]) == (wind, "CartPole-v1")  # a wrapper around it, pickled
        for name, count in (("CartPole-v1", 2), ("Pendulum-v1", 0)):
            chosen = f'environment = "{name}"'
            assert len(run("list-benchmarks", "--storage", root, "--filter", chosen, "--json").json) == count

    def test_list_artifacts(self, filled: tuple[Path, str, str], here: Path) -> None:
        out = ok("list-artifacts", "--storage", filled[0])
        assert "wind.csv" in out
        (told,) = run("list-artifacts", "--storage", filled[0], "--json").json
        assert told["name"] == "wind.csv"
        assert ok("list-artifacts", "--storage", filled[0], "--filter", "name = 'x'") == "no artifacts\n"

    def test_list_episodes(self, filled: tuple[Path, str, str], here: Path) -> None:
        everything = run("list-episodes", "--storage", filled[0], "--json").json
        wanted = [item for item in everything if item["metadata"]["cum_eps_reward"] > 20]
        assert 0 < len(wanted) < len(everything)
        args = ("--filter", "metadata.cum_eps_reward > 20")
        assert run("list-episodes", "--storage", filled[0], *args, "--json").json == wanted
        out = ok("list-episodes", "--storage", filled[0], *args)
        assert [line.split()[0] for line in out.splitlines()[1:]] == [item["id"] for item in wanted]

    def test_the_storage_of_the_environment(
        self, filled: tuple[Path, str, str], here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("TUPLI_MCAP_STORAGE", str(filled[0]))
        assert len(run("list-benchmarks", "--json").json) == 2
        shutil.copytree(filled[0], here / "_local_storage")
        monkeypatch.delenv("TUPLI_MCAP_STORAGE")
        assert len(run("list-benchmarks", "--json").json) == 2

    @pytest.mark.parametrize(
        "command", ["list-benchmarks", "list-artifacts", "list-episodes", "compact", "reindex"]
    )
    def test_no_storage_there(self, here: Path, command: str) -> None:
        line = "there is no storage at {!r}; give its directory with --storage or in TUPLI_MCAP_STORAGE"
        assert fails(command) == line.format("_local_storage")
        assert fails(command, "--storage", "none") == line.format("none")
        assert list(here.iterdir()) == []

    @pytest.mark.parametrize(
        ("text", "line"),
        [
            ("metadata.score >", "filter 'metadata.score >' needs a value .* at character 16, found the end"),
            ("and", "filter 'and' needs .* at character 0.*"),
            (
                "score > 1",
                r"unknown key 'score' .your own: metadata.score, run.metadata.score.; the keys are benchmark_id, .*",
            ),
            ("env > [1]", "filter 'env > \\[1\\]' needs a value .*"),
            ("env > true", ".*true.*"),
        ],
    )
    def test_filters_without_meaning(
        self, filled: tuple[Path, str, str], cartpole: Path, here: Path, text: str, line: str
    ) -> None:
        for command in (
            ("list-episodes", "--storage", filled[0]),
            ("episodes", filled[0]),
            ("episodes", cartpole),
            ("export", "--storage", filled[0], "-o", "out.mcap"),
        ):
            assert re.fullmatch(line, fails(*command, "--filter", text, code=2), re.IGNORECASE)
        assert not Path("out.mcap").exists()

    def test_compact(self, lab: tuple[Path, str, str]) -> None:
        assert ok("compact", "--storage", "lab") == "nothing to compact\n"
        with FileStorage("lab") as storage:
            storage.delete_episode(storage.list_episodes()[0].id)
        sizes = {path: path.stat().st_size for path in Path("lab").rglob("*.mcap")}
        header, row = ok("compact", "--storage", "lab", "--dry-run").splitlines()
        assert header.split() == ["RECORDING", "DELETED", "SIZE"]
        assert row.split()[1] == "1"
        assert {path: path.stat().st_size for path in Path("lab").rglob("*.mcap")} == sizes
        told = run("compact", "--storage", "lab", "--json").json
        assert told["bytes_freed"] == sum(sizes.values()) - sum(
            path.stat().st_size for path in Path("lab").rglob("*.mcap")
        )
        assert [item["deleted"] for item in told["recordings"]] == [1]
        assert run("compact", "--storage", "lab", "--dry-run", "--json").json["recordings"] == []
        assert len(run("list-episodes", "--storage", "lab", "--json").json) == 4

    def test_compact_takes_several(self, here: Path, lab: tuple[Path, str, str]) -> None:
        for name in "ab":
            record_rollouts("CartPole-v1", f"{name}.mcap", episodes=3)
        with FileStorage("lab") as storage:
            storage.delete_episode(storage.list_episodes()[0].id)
        ok("delete", "a.mcap", "b.mcap", "-e", "0")
        assert ok("compact", "a.mcap", "b.mcap", "lab").startswith("compacted 3 recordings, freed ")
        assert ok("compact", "a.mcap", "b.mcap", "lab") == "nothing to compact\n"
        Path(".lock").unlink()
        for command in ("compact", "restore"):
            assert run(command, "a.mcap").code == 0
            Path("a.txt").write_text("no recording")
            assert "a recording whose name ends in .mcap, found a.txt" in fails(command, "a.txt")
        assert not Path(".lock").exists()

    def test_looking_writes_nothing(self, lab: tuple[Path, str, str]) -> None:
        def state() -> dict[str, tuple[int, int, int]]:
            found = {str(path): path.lstat() for path in (Path("lab"), *Path("lab").rglob("*"))}
            return {name: (item.st_size, item.st_mtime_ns, item.st_ino) for name, item in found.items()}

        Path("lab/.lock").unlink()
        before, recording = state(), next(Path("lab").rglob("*.mcap"))
        for words in (
            ["episodes", "lab", "--filter", "n_tuples > 1"],
            ["list-episodes", "--storage", "lab"],
            ["list-benchmarks", "--storage", "lab"],
            ["list-artifacts", "--storage", "lab"],
            ["ls", "lab"],
            ["verify", "lab"],
            ["info", recording],
            ["episodes", recording],
            ["compact", "--dry-run", "--storage", "lab"],
            ["reindex", "--storage", "lab"],
            ["doctor", "--fail-on", "never", "lab"],
        ):
            ok(*words)
            assert state() == before, words

    def test_reindex(self, lab: tuple[Path, str, str]) -> None:
        catalog = catalog_path(Path("lab"))
        assert catalog is not None
        catalog.write_bytes(b"broken")
        assert ok("reindex", "--storage", "lab") == "lab: 5 episodes\n"
        assert run("reindex", "--storage", "lab", "--json").json == {"storage": "lab", "episodes": 5}

    def test_episodes_in_order(self, lab: tuple[Path, str, str]) -> None:
        args = ("list-episodes", "--storage", "lab", "--sort", "-steps", "--limit", 3)
        told = run(*args, "--columns", "steps,id", "--json").json
        steps = [episode["steps"] for episode in run("list-episodes", "--storage", "lab", "--json").json]
        assert [episode["steps"] for episode in told] == sorted(steps, reverse=True)[:3]
        assert list(told[0]) == ["steps", "id"]

    def test_a_damaged_recording_is_a_warning(self, lab: tuple[Path, str, str]) -> None:
        Path("lab/bad.mcap").write_bytes(b"nonsense")
        result = run("list-episodes", "--storage", "lab", "--json")
        assert result.code == 0
        assert len(json.loads(result.out)["result"]) == 5
        assert result.err.count("\n") == 1
        bad = Path("lab/bad.mcap").absolute()
        assert result.err.startswith(f"warning: skipped a recording: {bad}: expected an MCAP file")


# --- sharing ---


class TestSharing:
    def test_a_bundle_goes_round(self, lab: tuple[Path, str, str]) -> None:
        pole = lab[1]
        assert re.fullmatch(
            r"b\.mcap: 3 episodes, \d+ steps, [\d.]+ kB\n",
            ok("bundle", pole, "-o", "b.mcap", "--storage", "lab"),
        )
        dry = ok("import", "b.mcap", "--storage", "other", "--dry-run")
        assert dry.splitlines()[0] == "would import 3 of 3 episodes, 0 of 0 artifacts"
        assert not Path("other").exists()
        told = run("import", "b.mcap", "--storage", "other", "--json").json
        assert (told["benchmark_id"], told["name"], told["new_episodes"]) == (pole, "pole", 3)
        assert run("import", "b.mcap", "--storage", "other", "--json").json["new_episodes"] == 0
        dry_json = run("import", "b.mcap", "--storage", "other", "--dry-run", "--json").json
        assert (dry_json["dry_run"], dry_json["new_episodes"], dry_json["episodes"]) == (True, 0, 3)
        here = run("list-episodes", "--storage", "lab", "--filter", f'benchmark_id = "{pole}"', "--json").json
        there = run("list-episodes", "--storage", "other", "--json").json
        assert [item["id"] for item in there] == [item["id"] for item in here]

    def test_ids_may_be_short(self, lab: tuple[Path, str, str]) -> None:
        wind = lab[2]
        told = run("bundle", wind[:12], "-o", "b.mcap", "--storage", "lab", "--json").json
        assert (told["benchmark_id"], told["episodes"]) == (wind, 2)

    def test_a_bundle_of_a_filter(self, lab: tuple[Path, str, str]) -> None:
        told = run(
            "bundle", lab[1], "-o", "b.mcap", "--storage", "lab", "--filter", "seed = 1", "--json"
        ).json
        assert told["episodes"] == 1

    def test_a_bundle_of_a_recording(self, lab: tuple[Path, str, str]) -> None:
        (path,) = Path("lab/recordings", lab[2]).glob("*.mcap")
        with FileStorage("lab") as storage:
            storage.delete_episode(next(h.id for h in storage.list_episodes() if h.benchmark_id == lab[2]))
        ok("bundle", path, "-o", "b.mcap", "--storage", "lab")
        assert run("import", "b.mcap", "--storage", "other", "--json").json["episodes"] == 1
        assert fails("bundle", path, "-o", "c.mcap", "--filter", "env = 0", code=2).startswith(
            "Invalid value: --filter goes with a benchmark id, not with a file"
        )

    def test_a_bundle_of_a_plain_recording(self, here: Path, cartpole: Path) -> None:
        ok("bundle", cartpole, "-o", "b.mcap")
        with Recording("b.mcap") as copy, Recording(cartpole) as original:
            np.testing.assert_array_equal(copy.read().states, original.read().states)
            assert copy.benchmark.record.spec == original.benchmark.record.spec
        assert run("import", "b.mcap", "--storage", "lab", "--json").json["name"] == "CartPole-v1"
        with RecordEpisodes(gym.make("CartPole-v1"), "bare.mcap", attachments={}) as env:
            env.reset()
            env.step(0)
        ok("bundle", "bare.mcap", "-o", "c.mcap")
        assert ok("import", "c.mcap", "--storage", "lab") == "imported 1 of 1 episode, 0 of 0 artifacts\n"

    def test_artifacts_come_along(self, here: Path) -> None:
        from tupli_mcap.environment import capture
        from tupli_mcap.schema import BenchmarkMetadata, BenchmarkQuery
        from tupli_mcap.storage.benchmark_json import BenchmarkContent, benchmark_hash, facts_about, pack

        env = gym.make("CartPole-v1")
        metadata = BenchmarkMetadata(name="with wind")
        with FileStorage("lab") as storage:
            artifact = storage.store_artifact(b"1,2\n", ArtifactMetadata(name="wind.csv")).id
            record = capture(env)
            storage.store_benchmark(
                BenchmarkQuery(
                    hash=benchmark_hash(BenchmarkContent(record, (artifact,)), metadata),
                    serialized=pack(record, [artifact], facts_about(env)),
                    metadata=metadata,
                )
            )
            benchmark = storage.list_benchmarks()[0].id
        env.close()
        ok("bundle", benchmark, "-o", "b.mcap", "--storage", "lab")
        out = ok("import", "b.mcap", "--storage", "other")
        assert out.splitlines()[0] == "imported 0 of 0 episodes, 1 of 1 artifact"
        assert [item["id"] for item in run("list-artifacts", "--storage", "other", "--json").json] == [
            artifact
        ]

    def test_export(self, lab: tuple[Path, str, str]) -> None:
        line = fails("export", "-o", "e.mcap", "--storage", "lab")
        assert line.startswith("expected episodes of one benchmark to export, found 5 episodes of 2: ")
        chosen = ("--storage", "lab", "--filter", f'benchmark_id = "{lab[1]}"')
        dry = ok("export", "-o", "e.mcap", *chosen, "--dry-run")
        assert not Path("e.mcap").exists()
        out = ok("export", "-o", "e.mcap", *chosen)
        assert dry.startswith("would write e.mcap: ") and out.startswith(
            dry.removeprefix("would write ").strip()
        )
        told = run("export", "-o", "f.mcap", *chosen, "--dry-run", "--json").json
        assert (told["dry_run"], told["size"], told["benchmark_id"]) == (True, 0, lab[1])
        assert out.startswith("e.mcap: 3 episodes, ")

    def test_existing_files_stay(self, lab: tuple[Path, str, str]) -> None:
        Path("b.mcap").write_text("mine")
        line = "'b.mcap' exists and is not overwritten; choose another path or delete it"
        assert fails("bundle", lab[1], "-o", "b.mcap", "--storage", "lab") == line
        assert fails("export", "-o", "b.mcap", "--storage", "lab", "--filter", "seed = 1") == line
        (path,) = Path("lab/recordings", lab[1]).glob("*.mcap")
        assert fails("bundle", path, "-o", "b.mcap") == line
        assert Path("b.mcap").read_text() == "mine"

    @pytest.mark.parametrize("benchmark", ["0" * 64, "abcd", "../../etc", "/etc", "", "a\nb", "é"])
    def test_unknown_ids(self, lab: tuple[Path, str, str], benchmark: str) -> None:
        line = fails("bundle", benchmark, "-o", "b.mcap", "--storage", "lab")
        assert line.startswith("there is no benchmark with id ")
        assert line.endswith("; list_benchmarks() (tupli-mcap list-benchmarks) names them all")
        assert not Path("b.mcap").exists()

    def test_places_that_cannot_be_written(self, lab: tuple[Path, str, str]) -> None:
        Path("file").touch()
        line = fails("bundle", lab[1], "-o", "file/b.mcap", "--storage", "lab")
        assert line.startswith("cannot write the bundle 'file/b.mcap': ")
        ok("bundle", lab[1], "-o", "b.mcap", "--storage", "lab")
        line = fails("import", "b.mcap", "--storage", "file/storage")
        assert line.startswith(f"cannot use the storage '{Path('file/storage').absolute()}': ")

    def test_a_recording_without_a_benchmark(self, here: Path, cartpole: Path) -> None:
        with Recording(cartpole) as recording:
            episodes = len(recording)
        told = [
            run("import", cartpole, "--storage", "lab", *words, "--json").json
            for words in (["--dry-run"], [], [])
        ]
        assert [one["new_episodes"] for one in told] == [episodes, episodes, 0]
        assert {(one["benchmark_id"], one["name"]) for one in told} == {("", "")}
        assert [path.name for path in Path("lab/recordings").glob("*.mcap")] == [cartpole.name]
        assert (
            len(run("list-episodes", "--storage", "lab", "--filter", "benchmark_id = ''", "--json").json)
            == episodes
        )

    def test_trust(self, lab: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        (path,) = Path("lab/recordings", lab[2]).glob("*.mcap")
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(Path("config").resolve()))
        shown = run("trust", path, "--show", "--json").json
        assert (shown["kind"], shown["needs_trust"], shown["trusted"]) == ("pickle", True, False)
        assert not trust.is_trusted(shown["digest"])
        facts = dict(line.split("  ", 1) for line in ok("trust", path).splitlines() if line[0] != " ")
        assert facts["trusted"].strip() == "yes"
        assert facts["digest"].strip() == shown["digest"]
        assert trust.is_trusted(shown["digest"])
        assert run("trust", path, "--remove", "--json").json["trusted"] is False
        assert not trust.is_trusted(shown["digest"])
        assert "expected a path, found s3://lab/r.mcap" in fails("trust", "s3://lab/r.mcap", code=2)
        assert fails("trust", path, "--show", "--remove", code=2).startswith(
            "Invalid value: --show, --remove, --list and --key exclude each other"
        )

    def test_trust_is_not_needed_for_a_registered_environment(self, here: Path, cartpole: Path) -> None:
        out = ok("trust", cartpole, "--show")
        assert "the registered environment, by its spec" in out
        assert re.search(
            r"^environment +gymnasium\.\S+:CartPoleEnv \(as registered here\)$", out, re.MULTILINE
        )
        assert out.splitlines()[-1] == "trusted      not needed"

    def test_trust_judges_no_pickle(self, here: Path) -> None:
        """Functions that every pickle may use reach `eval` through their arguments alone."""
        record = EnvironmentRecord("Maze", pickle=b"c_operator\ngetitem\n.")
        carried = {"benchmark.json": ("application/json", record.to_json())}
        carried["env.cloudpickle"] = ("application/octet-stream", record.pickle or b"")
        with RecordEpisodes(gym.make("CartPole-v1"), "a.mcap", attachments=carried) as env:
            env.reset(seed=0)
            env.step(0)
        out = ok("trust", "a.mcap", "--show")
        assert re.search("^warning +loading this pickle can run any code$", out, re.MULTILINE)
        assert not re.search("known|unusual|suspicious|dangerous|harmless", out)

    def test_untrust(self, lab: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        (path,) = Path("lab/recordings", lab[2]).glob("*.mcap")
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(Path("config").resolve()))
        assert ok("trust", "--list") == "nothing is trusted\n"
        digest = run("trust", path, "--json").json["digest"]
        assert ok("trust", "--list") == f"environment  {digest}\n"
        for what in (path, digest, digest[:8]):
            ok("trust", path)
            assert run("untrust", what, "--json").json == {
                "digest": digest, "fingerprint": None, "was_trusted": True,
            }  # fmt: skip
        assert ok("untrust", path) == f"{digest} was not trusted\n"
        assert run("trust", "--list", "--json").json["digests"] == []
        assert fails("untrust", digest[:8]).startswith("no trusted environments have a digest that starts")
        assert fails("untrust", "no.mcap").startswith("no.mcap does not exist")
        assert fails("trust", code=2).startswith("Invalid value: expected a FILE, --list or --key")

    def test_import_may_trust(self, lab: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch) -> None:
        ok("bundle", lab[2], "-o", "b.mcap", "--storage", "lab")
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(Path("config").resolve()))
        digest = run("trust", "b.mcap", "--show", "--json").json["digest"]
        ok("import", "b.mcap", "--storage", "other")
        assert not trust.is_trusted(digest)
        ok("import", "b.mcap", "--storage", "other", "--trust")
        assert trust.is_trusted(digest)


# --- the program as a whole ---


LISTED = ("users", "groups", "roles", "tokens", "benchmarks", "artifacts", "episodes")
PROGRAM: Any = get_command(app)
COMMANDS = [name for name, command in PROGRAM.commands.items() if not command.hidden]


@functools.cache
def help_of(command: str) -> str:
    return ok(command, "--help")


class TestProgram:
    def test_as_a_module(self) -> None:
        words = [sys.executable, "-m", "tupli_mcap", "version"]
        told = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        assert told == ok("version")

    def test_help(self, here: Path) -> None:
        listed = ok("--help")
        assert ok() == ok("help") == listed
        for command in COMMANDS:
            assert re.search(rf"^  {command} +\S.*[^.]\.$", listed, re.MULTILINE)  # not cut to "..."
            out = help_of(command)
            assert max(map(len, out.splitlines())) <= 80
            assert not re.search(r"<(str|int|float|list|path|file)\b", out), command  # values in plain words
            assert not re.search(r"\.\.\.[]}]|\.{4}", out.splitlines()[0])  # the dots of several are typer's

    def test_everything_that_prints_has_json(self) -> None:
        assert len(COMMANDS) > 20
        for command in sorted(
            {*COMMANDS} - {"view", "replay", "browse", "serve", "help", "version"}
        ):  # which show something
            assert "--json" in help_of(command)

    @pytest.mark.sampled(4)
    @pytest.mark.parametrize("command", COMMANDS)
    def test_help_on_a_command(self, command: str, here: Path) -> None:
        assert ok("help", command) == ok(command, "-h") == help_of(command)

    def test_help_on_no_command(self, here: Path) -> None:
        assert "there is no command 'lss' (did you mean 'ls'?)" in fails("help", "lss", code=2)

    def test_the_commands_are_in_groups(self, here: Path) -> None:
        lines = ok("--help").splitlines()
        titles = [line[:-1] for line in lines if re.fullmatch(r"[A-Z]\w+:", line)]
        assert titles == [
            "Options",
            "Record",
            "Look",
            "Check",
            "Edit",
            "Share",
            "Server",
            "People",
            "Storage",
            "Help",
        ]
        assert lines[lines.index("Record:") + 1].startswith("  record ")

    @pytest.mark.parametrize("command", COMMANDS)
    def test_examples_are_meant(self, command: str, here: Path) -> None:
        """They parse: what a file or an environment says is another matter."""
        lines = help_of(command).splitlines()
        examples = [line for line in lines if line.startswith("  tupli-mcap ")]
        assert examples or command == "version"
        for line in examples:
            _, name, *words = shlex.split(line)
            assert name == command
            context = PROGRAM.make_context("tupli-mcap", [name])
            found = PROGRAM.get_command(context, name)
            assert found.make_context(name, words, parent=context).params

    def test_version(self, here: Path) -> None:
        assert ok("version") == ok("--version") == f"tupli-mcap {tupli_mcap.__version__}\n"

    def test_replay_is_view(self, here: Path) -> None:
        assert help_of("replay").replace("replay", "view") == help_of("view")

    def test_map_is_relabel(self, here: Path) -> None:
        assert help_of("map").replace("tupli-mcap map", "tupli-mcap relabel") == help_of("relabel")

    def test_usage_errors(self, here: Path) -> None:
        assert fails("lss", code=2).startswith("No such command 'lss' (did you mean 'ls'?)")
        assert fails("rm", code=2).startswith("No such command 'rm' (did you mean 'delete'?)")
        for other, meant in (
            ("select", "filter"),
            ("upload", "push"),
            ("undelete", "restore"),
            ("check", "verify"),
        ):
            assert f"No such command {other!r} (did you mean {meant!r}?)" in fails(other, code=2)
        assert fails("list-runs", code=2).startswith("No such command 'list-runs' (did you mean 'ls'?)")
        assert fails("frobnicate", code=2) == "No such command 'frobnicate'; see tupli-mcap --help"
        assert fails("ls", "--no-such-option", code=2).startswith("No such option")
        told = fails("export", "http://me:SECRET@lab/x.mcap", "-o", "x.mcap", code=2)
        assert "(http://lab/x.mcap)" in told and "SECRET" not in told
        assert fails("info", code=2) == "Missing argument 'PATH|URL'; see tupli-mcap info --help"

    def test_debug_shows_the_traceback(self, here: Path) -> None:
        for args in (("--debug", "info", "none.mcap"), ("info", "none.mcap", "--debug")):
            result = run(*args)
            assert result.code == 1
            assert "Traceback" in result.err
            assert result.err.splitlines()[-1].startswith("error: none.mcap does not exist")

    def test_bugs_are_not_disguised(self, here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def broken(*_: object) -> None:
            raise ZeroDivisionError("a bug")

        monkeypatch.setattr("tupli_mcap.storage.listing.list_recordings", broken)
        with pytest.raises(ZeroDivisionError, match="a bug"):
            run("ls")

    def test_the_installed_command(self, here: Path, cartpole: Path) -> None:
        assert re.fullmatch(r"tupli-mcap \d+\.\d+\.\d+\S*\n", tool("--version", cwd=here).out)
        assert tool("info", cartpole, "--json", cwd=here).json["steps"] == 200
        failed = tool("info", "none.mcap", cwd=here)
        assert (failed.code, failed.out) == (1, "")
        assert failed.err == "error: none.mcap does not exist; give the path of a recording (.mcap)\n"
        assert tool("info", cwd=here).code == 2

    def test_completion(self, here: Path) -> None:
        script = tool(
            "--show-completion", cwd=here, SHELL="/bin/bash", _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1"
        )
        assert script.code in (0, 2)  # without detection, the option wants the shell's name
        found = tool(
            cwd=here, _TUPLI_MCAP_COMPLETE="complete_bash", COMP_WORDS="tupli-mcap list-", COMP_CWORD="1"
        )
        assert found.out.split() == [f"list-{each}" for each in LISTED]

    def test_help_imports_nothing_heavy(self, here: Path) -> None:
        code = (
            "import sys\nfrom tupli_mcap.cli import app\n"
            "try: app(['--help'])\nexcept SystemExit: pass\n"
            "print([m for m in ('gymnasium', 'numpy', 'sqlalchemy', 'pydantic', 'mcap') if m in sys.modules])"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.splitlines()[-1] == "[]"

    def test_a_reader_that_stops_reading(self, here: Path, cartpole: Path) -> None:
        with subprocess.Popen(
            [TOOL, "episodes", cartpole], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=here
        ) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.close()
            assert process.stderr.read() == b""

    @pytest.mark.parametrize("width", [60, 80, 120])
    def test_tables_fit_the_terminal(
        self, filled: tuple[Path, str, str], here: Path, monkeypatch: pytest.MonkeyPatch, width: int
    ) -> None:
        monkeypatch.setenv("COLUMNS", str(width))
        root = filled[0]
        (path,) = (root / "recordings" / filled[1]).glob("*.mcap")
        for args in (
            ("ls", root),
            ("info", path),
            ("episodes", root),
            ("episodes", path),
            ("list-benchmarks", "--storage", root),
            ("list-artifacts", "--storage", root),
            ("trust", path),
        ):
            lines = ok(*args).splitlines()
            assert max(map(len, lines)) <= width or args[0] == "info"
            filled = ("list-", "episo", "ls") if width == 60 else ("ls",) if width == 80 else ()
            assert len({len(line) for line in lines}) > 1 or args[0][:5] in filled

    @pytest.mark.parametrize("width", [100, 110, 130])
    def test_runs_keep_their_whole_names(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, width: int
    ) -> None:
        for seed in (1, 2):
            ok("record", "CartPole-v1", "-o", f"runs-of-cartpole/ppo-seed{seed}.mcap", "--seed", str(seed))
            ok("tag", f"runs-of-cartpole/ppo-seed{seed}.mcap", "--episodes", "0", "success=true")
        monkeypatch.setenv("COLUMNS", str(width))
        title, *lines = ok("ls", "runs-of-cartpole").splitlines()
        assert "STARTED" in title
        for line, seed in zip(lines, (1, 2), strict=True):
            assert f"  ppo-seed{seed}  " in line and not line.endswith("…")

    @pytest.mark.parametrize(
        ("width", "columns", "state"),
        [
            (60, "RUN ENVIRONMENT EPISODES STEPS RETURN SUCCESS", "complete"),
            (80, "RECORDING RUN EPISODES RETURN SUCCESS", "complete"),
            (80, "RECORDING RUN EPISODES RETURN STATE", "incomplete"),
            (100, "RECORDING RUN ENVIRONMENT EPISODES STEPS RETURN SUCCESS", "complete"),
            (130, "RECORDING RUN ENVIRONMENT EPISODES STEPS RETURN SUCCESS STARTED STATE", "complete"),
            (140, "RECORDING RUN ENVIRONMENT EPISODES STEPS RETURN SUCCESS STARTED SIZE STATE", "complete"),
        ],
    )
    def test_runs_show_what_is_needed_most(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, width: int, columns: str, state: str
    ) -> None:
        ok("record", "CartPole-v1", "-o", "runs/", "--name", "ppo-seed1")
        (path,) = Path("runs").glob("*.mcap")
        ok("tag", path, "--episodes", "0", "success=true")
        if state == "incomplete":
            path.write_bytes(path.read_bytes()[:-8])
        monkeypatch.setenv("COLUMNS", str(width))
        title, line = run("ls", "runs").out.splitlines()
        assert title.split() == columns.split()
        assert " ppo-seed1 " in f" {line}"
        assert (str(path) in line) == ("RECORDING" in title)
        assert ("STARTED" in title) == bool(re.search(r" \d{4}-\d\d-\d\d \d\d:\d\d", line))

    def test_a_narrow_list_of_runs_keeps_the_names_of_files(
        self, here: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = "a-name-that-is-long_2026-11-30_00-31.mcap"[-40:]
        ok("record", "CartPole-v1", "-o", path, "--name", "a-name-that-is-long-of-an-algorithm")
        monkeypatch.setenv("COLUMNS", "80")
        title, line = ok("ls").splitlines()
        assert title.split() == ["RECORDING", "RUN", "EPISODES", "RETURN"]
        assert line.startswith(f"{path}  a-name-that-")

    @pytest.mark.parametrize("width", [100, 110, 130])
    def test_episodes_show_the_whole_names_of_their_runs(
        self, here: Path, monkeypatch: pytest.MonkeyPatch, width: int
    ) -> None:
        for seed in (1, 2):
            path = f"runs/ppo-without-normalisation-{seed}.mcap"
            ok("record", "CartPole-v1", "-o", path, "--seed", str(seed))
            ok("tag", path, "--episodes", "all", "success=true", "note=gripper slipped, and was caught again")
        monkeypatch.setenv("COLUMNS", str(width))
        title, *lines = ok("episodes", "runs").splitlines()
        assert ("ENDED" in title) == (width == 130)
        for line in lines:
            assert re.search("  ppo-without-normalisation-[12]  .* success=true", line)

    @pytest.mark.parametrize("buffered", ["", "1"])
    @pytest.mark.parametrize(
        ("words", "said"),
        [("info gone.mcap --json", "gone.mcap does not exist"), ("ls", "No space left on device")],
    )
    def test_output_that_stdout_does_not_take(self, here: Path, words: str, said: str, buffered: str) -> None:
        with Path("/dev/full").open("wb") as full:
            done = subprocess.run(
                [str(TOOL), *words.split()], stdout=full, stderr=subprocess.PIPE, text=True,
                env=os.environ | {"PYTHONUNBUFFERED": buffered}, check=False,
            )  # fmt: skip
        assert (done.returncode, done.stderr.count("\n")) == (1, 1)
        assert done.stderr.startswith(f"error: {said}")

    @pytest.mark.parametrize("columns", [None, "0"])
    def test_a_terminal_of_unknown_size_gets_whole_tables(self, cartpole: Path, columns: str | None) -> None:
        theirs, ours = pty.openpty()  # as `docker exec -t` and `script` open one: of 0 columns
        named = {} if columns is None else {"COLUMNS": columns}
        command = [str(TOOL), "episodes", str(cartpole)]
        with subprocess.Popen(command, stdout=ours, stderr=ours, env=os.environ | named) as process:
            try:
                assert process.wait(60) == 0
            finally:
                process.kill()
        title, *lines = os.read(theirs, 65536).decode().splitlines()
        os.close(ours)
        os.close(theirs)
        assert "EPISODE  STEPS  RETURN" in title and "ENDED" in title
        with Recording(cartpole) as recording:
            assert len(lines) == len(recording.index)

    @pytest.mark.parametrize("in_notebook", [False, True])  # `!tupli-mcap record …` in a cell
    def test_a_terminal_gets_a_progress_bar(self, here: Path, *, in_notebook: bool) -> None:
        pid, fd = pty.fork()
        if pid == 0:
            environment = os.environ | ({"JPY_PARENT_PID": "1"} if in_notebook else {})
            command = [str(TOOL), "record", "CartPole-v1", "-o", "a.mcap", "--steps", "30000"]
            os.execve(TOOL, command, environment)
        seen = b""
        while select.select([fd], [], [], 30)[0]:
            try:
                part = os.read(fd, 65536)
            except OSError:  # the other end has closed
                break
            if not part:
                break
            seen += part
        os.close(fd)
        assert os.waitpid(pid, 0)[1] == 0
        assert (b"/30000" in seen) != in_notebook
        assert (b"\x1b[" in seen) != in_notebook
        assert b"a.mcap: " in seen


class TestWords:
    @pytest.mark.parametrize(
        ("size", "text"),
        [
            (0, "0 B"),
            (999, "999 B"),
            (1000, "1.0 kB"),
            (18_349, "18.3 kB"),
            (999_960, "1.0 MB"),
            (2e15, "2000.0 TB"),
        ],
    )
    def test_sizes(self, size: float, text: str) -> None:
        assert bytes_of(int(size)) == text

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (None, ""),
            (0, "0"),
            (1234, "1,234"),
            (-1.5, "-1.50"),
            (1e-5, "1e-05"),
            (float("nan"), "nan"),
            (1e20, "1e+20"),
        ],
    )
    def test_numbers(self, value: float | None, text: str) -> None:
        assert number(value) == text

    def test_a_column_of_numbers_has_equal_decimals(self) -> None:
        assert numbers([1.0, 2.5, None, float("inf")]) == ["1.00", "2.50", "", "inf"]
        assert numbers([1.0, -2000.0]) == ["1", "-2,000"]

    @pytest.mark.parametrize("text", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "soon"])
    def test_times_that_no_clock_has_are_shown_as_they_are(self, text: str) -> None:
        assert when(text) == text
