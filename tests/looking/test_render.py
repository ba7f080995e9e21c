"""Frames made after the fact: the environment rebuilt, replayed, compared at every step, and drawn."""

from __future__ import annotations

import builtins
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import gymnasium as gym
import numpy as np
import pytest
from command_line import run
from cryptography.hazmat.primitives import serialization as ser
from cryptography.hazmat.primitives.asymmetric import ed25519
from drawing import Drawing, Drifting, drawn
from environments import Sampler
from PIL import Image

from tupli_mcap import RecordEpisodes, Recording, verify_recording
from tupli_mcap.environment import EnvironmentRecord
from tupli_mcap.errors import MissingExtraError, RecordingError, UntrustedError
from tupli_mcap.recording import rewrite_recording
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.recording.sign.sign import sign_recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.reexecute import render
from tupli_mcap.reexecute.movie import indexed
from tupli_mcap.signing import SigningKey
from tupli_mcap.storage.sidecar import Sidecar
from tupli_mcap.vector import RecordEpisodes as RecordVector


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    gym.register("tests/Drifting-v0", Drifting)
    gym.register("tests/Blank-v0", "drawing:Blank")
    yield
    for name in ("tests/Drifting-v0", "tests/Blank-v0"):
        del gym.registry[name]


def roll(
    env: gym.Env[Any, Any], episodes: int, steps: int = 25, seeds: Callable[[int], Any] = lambda k: k
) -> None:
    env.action_space.seed(3)
    for k in range(episodes):
        env.reset(seed=seeds(k))
        for _ in range(steps):
            *_, terminal, timeout, _ = env.step(env.action_space.sample())
            if terminal or timeout:
                break


def recorded(path: Path, env: gym.Env[Any, Any] | None = None, episodes: int = 3, **options: Any) -> Path:
    with RecordEpisodes(env or gym.make("tests/Drifting-v0", render_mode=None), path, **options) as recorder:
        roll(recorder, episodes)
    return path


def shows(path: Path, numbers: list[int], every: int = 1) -> None:
    """The frames of these episodes, and no others, show their states."""
    with Recording(path) as recording:
        for episode in recording.episodes:
            n = len(episode)
            wanted = (
                [s for s in range(n + 1) if s % every == 0 or s == n] if episode.number in numbers else []
            )
            assert episode.frames.steps.tolist() == wanted
            states = [*episode.states, episode.final_state]
            for step, frame in zip(wanted, episode.frames, strict=True):
                np.testing.assert_array_equal(frame, drawn(states[step]))
    assert verify_recording(path).problems == []


def a_key(path: Path) -> SigningKey:
    key = ed25519.Ed25519PrivateKey.generate()
    path.write_bytes(key.private_bytes(ser.Encoding.PEM, ser.PrivateFormat.PKCS8, ser.NoEncryption()))
    return SigningKey(path)


REAL = [
    "CartPole-v1",
    "Pendulum-v1",
    "MountainCar-v0",
    "Acrobot-v1",
    "FrozenLake-v1",
    "Taxi-v3",
    "CliffWalking-v1",
]


class TestRealEnvironments:
    @pytest.mark.sampled(3)
    @pytest.mark.parametrize("name", REAL)
    def test_the_frames_are_those_that_recording_would_have_taken(self, tmp_path: Path, name: str) -> None:
        name = name if name in gym.registry else name[:-1] + str(int(name[-1]) + 1)
        for file, mode in (("with", "rgb_array"), ("without", None)):
            options = {"frames": mode is not None, "attachments": None}
            env = gym.make(name, render_mode=mode)
            with RecordEpisodes(env, tmp_path / f"{file}.mcap", **options) as recorder:  # type: ignore[arg-type]
                roll(recorder, 2, 6, seeds=lambda k: None if k else 5)
        report = render(tmp_path / "without.mcap", tmp_path / "new.mcap")
        assert (report.ok, report.divergence, len(report.episodes)) == (True, None, 2)
        with Recording(tmp_path / "with.mcap") as wanted, Recording(tmp_path / "new.mcap") as found:
            for a, b in zip(wanted.episodes, found.episodes, strict=True):
                assert a.frames.steps.tolist() == b.frames.steps.tolist() == list(range(len(a) + 1))
                for one, other in zip(a.frames, b.frames, strict=True):
                    np.testing.assert_array_equal(one, other)
        assert verify_recording(tmp_path / "new.mcap").problems == []

    def test_sub_environments(self, tmp_path: Path) -> None:
        envs = gym.make_vec("tests/Drifting-v0", 3, vectorization_mode="sync", render_mode=None)
        with RecordVector(envs, tmp_path / "r.mcap") as recorder:
            recorder.reset(seed=4)
            for _ in range(15):
                recorder.step(recorder.action_space.sample())
        report = render(tmp_path / "r.mcap", tmp_path / "new.mcap", episodes=[1, 3, 5])
        assert report.ok
        shows(tmp_path / "new.mcap", [1, 3, 5])
        with Recording(tmp_path / "new.mcap") as recording:
            assert {"/env_0/camera/render", "/env_2/frame/render"} <= set(recording._topics)


class TestOutput:
    def test_everything_else_is_copied(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", record_info=True)
        add_attachments(path, {"notes.txt": ("text/plain", b"kept")})
        render(path, tmp_path / "new.mcap", episodes=[1])
        shows(tmp_path / "new.mcap", [1])
        with Recording(path) as old, Recording(tmp_path / "new.mcap") as new:
            assert old.uuid == new.uuid
            assert list(old.attachments) == list(new.attachments)
            assert new.read_attachment("notes.txt") == b"kept"
            for a, b in zip(old.episodes, new.episodes, strict=True):
                np.testing.assert_array_equal(a.states, b.states)
                assert (a.seed, a.infos, a.end, a.start_time) == (b.seed, b.infos, b.end, b.start_time)
            times = old.read(episodes=[1], fields=["times"]).times
            assert new.episodes[1].frames.times.tolist() == [old.episodes[1].start_time, *times]

    def test_frames_that_are_there_stay_or_are_replaced(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", gym.make("tests/Drifting-v0", render_mode="rgb_array"), frames=4)
        render(path, tmp_path / "new.mcap", episodes=[1], width=6)
        with Recording(tmp_path / "new.mcap") as recording:
            assert [len(e.frames) for e in recording.episodes] == [3, 7, 3]
            assert recording.episodes[1].frames[0].shape == (4, 6, 3)
            assert recording.episodes[2].frames[0].shape == (8, 12, 3)
        assert verify_recording(tmp_path / "new.mcap").problems == []

    def test_every_and_order(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", episodes=4)
        report = render(path, tmp_path / "new.mcap", episodes=[3, 0], every=4, frame_format="png")
        assert [(e.episode, e.steps, e.frames, e.whole) for e in report.episodes] == [
            (3, 6, 3, True),
            (0, 6, 3, True),
        ]
        assert (report.frames, report.fps, report.width, report.height) == (6, 2.5, 12, 8)
        shows(tmp_path / "new.mcap", [0, 3], every=4)

    def test_a_rendered_recording_can_be_rendered_and_appended_to(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        render(path, tmp_path / "one.mcap", episodes=[0])
        render(tmp_path / "one.mcap", tmp_path / "two.mcap", episodes=[2])
        shows(tmp_path / "two.mcap", [0, 2])
        env = gym.make("tests/Drifting-v0", render_mode="rgb_array")
        recorded(tmp_path / "two.mcap", env, 1, mode="a", frames=True)
        shows(tmp_path / "two.mcap", [0, 2, 3])

    def test_a_signature_is_left_out(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        sign_recording(path, a_key(tmp_path / "key"))
        report = render(path, tmp_path / "new.mcap")
        assert report.signature_left_out
        with Recording(tmp_path / "new.mcap") as recording:
            assert SIGNATURE_NAME not in recording.attachments
        shows(tmp_path / "new.mcap", [0, 1, 2])
        assert not render(path, tmp_path / "new.gif").signature_left_out

    def test_deleted_episodes_stay_out(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        Sidecar(uuid=metadata_at(path)["uuid"], deleted={1}).write(path)
        render(path, tmp_path / "new.mcap")
        with Recording(tmp_path / "new.mcap") as recording:
            assert [e.number for e in recording.episodes] == [0, 2]
        shows(tmp_path / "new.mcap", [0, 2])

    def test_steps_that_last_longer_than_films_hold(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        add_attachments(path, {"labels.json": ("application/json", b'{"step_seconds": 900}')})
        assert render(path, tmp_path / "film.gif", episodes=[0]).fps == 1 / 600

    @pytest.mark.parametrize("width", [None, 31])
    def test_mp4(self, tmp_path: Path, width: int | None) -> None:
        path = recorded(tmp_path / "r.mcap", gym.make("CartPole-v1"), 2)
        report = render(path, tmp_path / "film.mp4", width=width)
        with av.open(str(tmp_path / "film.mp4")) as film:
            stream = film.streams.video[0]
            rate = stream.average_rate
            pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
        assert len(pictures) == report.frames
        assert rate == report.fps == 50
        assert pictures[0].shape == ((400, 600, 3) if width is None else (22, 32, 3))
        if width is None:
            render(path, tmp_path / "new.mcap", episodes=[0])
            with Recording(tmp_path / "new.mcap") as recording:
                for one, other in zip(recording.episodes[0].frames, pictures, strict=False):
                    assert np.abs(one.astype(int) - other).mean() < 2

    def test_gif(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", episodes=2)
        report = render(path, tmp_path / "film.gif", episodes=[1, 0])
        with Image.open(tmp_path / "film.gif") as film:
            assert (film.size, film.n_frames) == ((12, 8), report.frames)  # type: ignore[attr-defined]
            assert film.info["duration"] == 100

    def test_a_gif_of_few_colours_is_exact(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", gym.make("CartPole-v1"), 1)
        render(path, tmp_path / "film.gif")
        render(path, tmp_path / "new.mcap", episodes=[0])
        with Recording(tmp_path / "new.mcap") as recording, Image.open(tmp_path / "film.gif") as film:
            frames = list(recording.episodes[0].frames)
            shown = []
            for i in range(film.n_frames):  # type: ignore[attr-defined]
                film.seek(i)  # equal frames are one that lasts longer, and the last one does anyway
                shown += [np.asarray(film.convert("RGB"))] * (film.info["duration"] // 20)
        assert len(shown) == len(frames) + 50
        np.testing.assert_array_equal(shown[: len(frames)], frames)

    @pytest.mark.parametrize("shape", [(400, 600), (1, 90_000), (90_000, 1), (60, 90), (5, 7), (1, 1)])
    @pytest.mark.parametrize("colours", [1, 2, 255, 256, 257, 30_000])
    def test_images_of_at_most_256_colours(self, shape: tuple[int, int], colours: int) -> None:
        rng = np.random.default_rng(colours)
        for _ in range(2):
            of_all = np.sort(
                rng.integers(0, 255, (colours, 3), np.uint8), axis=0
            )  # a curve through the colours
            picture = of_all[rng.integers(0, colours, shape)]
            image = indexed(picture)
            found = np.asarray(image.convert("RGB"))
            assert (image.mode, found.shape) == ("P", picture.shape)
            if len(np.unique(picture @ np.array([1 << 16, 1 << 8, 1]))) <= 256:
                np.testing.assert_array_equal(found, picture)
            else:
                assert np.abs(found.astype(int) - picture).mean() < 2

    def test_a_fast_environment_keeps_its_pace_in_a_gif(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(Drawing.metadata, "render_fps", 200)
        report = render(recorded(tmp_path / "r.mcap"), tmp_path / "film.gif")
        assert (report.fps, report.frames) == (200, 21)
        with Image.open(tmp_path / "film.gif") as film:
            assert (film.n_frames, film.info["duration"]) == (6, 20)  # type: ignore[attr-defined]


class TestDivergence:
    def test_the_first_step_that_differs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = recorded(tmp_path / "r.mcap")
        monkeypatch.setenv("DRIFT", "3")  # the state after the fourth step is another one
        report = render(path, tmp_path / "new.mcap", episodes=[1, 2])
        assert not report.ok
        assert report.divergence is not None
        assert (report.divergence.episode, report.divergence.step, report.divergence.leaf) == (1, 4, "state")
        with Recording(path) as recording:
            state = recording.episodes[1].states[4]
            assert report.divergence.expected == str(state[0])
            assert float(report.divergence.found) == state[0] + 1e-12
        assert [(e.episode, e.frames, e.whole) for e in report.episodes] == [(1, 4, False)]
        with Recording(tmp_path / "new.mcap") as recording:
            assert [e.frames.steps.tolist() for e in recording.episodes] == [[], [0, 1, 2, 3], []]
            for step, frame in enumerate(recording.episodes[1].frames):
                np.testing.assert_array_equal(frame, drawn(recording.episodes[1].states[step]))
        assert verify_recording(tmp_path / "new.mcap").problems == []

    def test_nothing_is_written_if_nothing_agrees(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        for kind in (".mcap", ".mp4", ".gif"):
            report = render(path, tmp_path / f"new{kind}", env=Seeded())
            assert (report.path, report.frames) == (None, 0)
            assert report.divergence is not None
            assert report.divergence.step == 0
            assert not (tmp_path / f"new{kind}").exists()

    def test_the_final_state_counts(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = recorded(tmp_path / "r.mcap")
        monkeypatch.setenv("DRIFT", "5")
        report = render(path, tmp_path / "new.gif", episodes=[0])
        assert report.divergence is not None
        assert (report.divergence.step, report.frames) == (6, 6)

    def test_an_episode_that_others_go_on_from(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """It is replayed too, and that it differs is why the chosen one cannot be rendered."""
        path = tmp_path / "r.mcap"
        with RecordEpisodes(gym.make("tests/Drifting-v0", render_mode=None), path) as env:
            roll(env, 3, seeds=lambda k: None if k else 7)
        render(path, tmp_path / "good.mcap", episodes=[2])
        shows(tmp_path / "good.mcap", [2])
        monkeypatch.setenv("DRIFT", "2")
        report = render(path, tmp_path / "new.mcap", episodes=[2])
        assert report.divergence is not None
        assert (report.divergence.episode, report.divergence.step, report.ok) == (0, 3, False)

    def test_episodes_that_nobody_can_replay_are_skipped(self, tmp_path: Path) -> None:
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
            roll(env, 3, 99, seeds=lambda k: 7 if k == 2 else None)
        with Recording(tmp_path / "r.mcap") as recording:
            rewrite_recording(recording, tmp_path / "part.mcap", episodes=[1, 2])
        report = render(tmp_path / "part.mcap", tmp_path / "new.mcap")
        assert [(s.kind, s.first, s.episodes) for s in report.skipped] == [("no_predecessor", 1, 1)]
        assert (report.ok, report.divergence) == (False, None)
        assert [e.episode for e in report.episodes if e.whole] == [2]


class Seeded(Drawing):
    """Starts elsewhere."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return super().reset(seed=None if seed is None else seed + 1)


class TestTrust:
    def test_what_would_run_is_said_and_nothing_is(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = recorded(tmp_path / "r.mcap", Drawing(), capture_env="pickle")
        render(path, tmp_path / "mine.mcap")  # this user made it
        shows(tmp_path / "mine.mcap", [0, 1, 2])
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "stranger"))
        monkeypatch.setattr("pickle.loads", lambda *_: pytest.fail("it was run"))
        monkeypatch.setattr("tupli_mcap.environment._build.load", lambda *_: pytest.fail("it was run"))
        with pytest.raises(
            UntrustedError, match="bytes of pickled Python code .* run `tupli-mcap trust FILE`"
        ):
            render(path, tmp_path / "new.mcap")
        code, out, err = run("render", path, "-o", tmp_path / "new.mcap")
        assert (code, out) == (1, "")
        assert err.startswith("error: rebuilding the environment")
        assert "pass --trust or run `tupli-mcap trust FILE`" in err
        assert not (tmp_path / "new.mcap").exists()
        monkeypatch.undo()
        assert run("render", path, "-o", tmp_path / "new.mcap", "--trust", "--episodes", "all")[0] == 0
        shows(tmp_path / "new.mcap", [0, 1, 2])


class TestBadInput:
    def test_no_environment(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", attachments={})
        with pytest.raises(RecordingError, match="carries no environment"):
            render(path, tmp_path / "new.mcap")

    def test_an_environment_that_draws_nothing(self, tmp_path: Path) -> None:
        space = gym.spaces.Discrete(3)
        told = "cannot be rendered with render_mode='rgb_array'"
        path = recorded(tmp_path / "r.mcap", Sampler(space, space), capture_env="pickle")
        with pytest.raises(RecordingError, match=f"{told}: its render_mode is None"):
            render(path, tmp_path / "new.mcap")
        spec = gym.spec("tests/Blank-v0")
        record = EnvironmentRecord("Blank", spec=json.loads(spec.to_json()))
        attachments = {"benchmark.json": ("application/json", record.to_json())}
        path = recorded(tmp_path / "plain.mcap", gym.make(spec), attachments=attachments)
        with pytest.raises(RecordingError, match=f"'Blank' {told}: TypeError.*render_mode"):
            render(path, tmp_path / "new.mcap")
        assert not (tmp_path / "new.mcap").exists()

    def test_a_renderer_that_fails(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = recorded(tmp_path / "r.mcap")
        monkeypatch.setattr(Drawing, "render", lambda self: 1 / 0)
        with pytest.raises(RecordingError, match="at step 0 of episode 0 it fails with ZeroDivisionError"):
            render(path, tmp_path / "new.mcap", env=Drawing())
        monkeypatch.setattr(Drawing, "render", lambda self: None)
        with pytest.raises(
            RecordingError, match=r"episode 0, step 0: expected render\(\) to return a picture"
        ):
            render(path, tmp_path / "new.mcap", env=Drawing())
        assert [item.name for item in tmp_path.iterdir()] == ["r.mcap"]

    def test_targets(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        (tmp_path / "old.gif").write_bytes(b"old")
        cases = [
            ("old.gif", "exists; choose another path"),
            ("r.mcap", "is the recording itself, which is never overwritten"),
            ("new.avi", r"ends in \.mcap, \.mp4 or \.gif"),
            ("none/new.gif", "there is no directory"),
        ]
        for name, message in cases:
            with pytest.raises(RecordingError, match=message):
                render(path, tmp_path / name)
        with pytest.raises(RecordingError, match="never overwritten"):
            render(path, path, overwrite=True)
        assert (tmp_path / "old.gif").read_bytes() == b"old"
        assert render(path, tmp_path / "old.gif", overwrite=True).ok
        assert (tmp_path / "old.gif").read_bytes().startswith(b"GIF")

    def test_numbers(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap")
        with pytest.raises(RecordingError, match="has no episode 3; choose from 0 to 2"):
            render(path, tmp_path / "new.mcap", episodes=[0, 3])
        with pytest.raises(RecordingError, match="expected every >= 1"):
            render(path, tmp_path / "new.mcap", every=0)

    def test_without_pyav_and_without_pillow(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = recorded(tmp_path / "r.mcap")
        real, missing = builtins.__import__, {"av"}

        def without(name: str, *args: Any, **kwargs: Any) -> Any:
            if name in missing:
                raise ImportError(name)
            return real(name, *args, **kwargs)

        monkeypatch.setattr(builtins, "__import__", without)
        with pytest.raises(MissingExtraError, match=r"pip install .*\[video\]"):
            render(path, tmp_path / "film.mp4")
        assert render(path, tmp_path / "film.gif").ok
        missing.add("PIL")
        with pytest.raises(MissingExtraError, match=r"pip install .*\[frames\]"):
            render(path, tmp_path / "again.gif")


class TestCommandLine:
    def test_a_film_of_the_best_episode(self, tmp_path: Path) -> None:
        path = recorded(tmp_path / "r.mcap", gym.make("CartPole-v1"), 3)
        with Recording(path) as recording:
            best = max(recording.episodes, key=lambda e: e.return_)
        code, out, err = run("render", path, "-o", tmp_path / "best.gif", "--width", 60)
        assert (code, err) == (0, "")
        assert f"best.gif: {len(best) + 1} frames of 1 episode, 60 x 40, 50 a second" in out
        assert out.splitlines()[1] == f"{path}: episode {best.number}, return {best.return_:.0f}"
        code, out, _ = run(
            "render", path, "-o", tmp_path / "best.gif", "--episodes", "0,2", "--force", "--json"
        )
        assert code == 0
        assert [episode["episode"] for episode in json.loads(out)["result"]["episodes"]] == [0, 2]

    def test_the_best_episode_of_a_storage(self, tmp_path: Path) -> None:
        lengths = {"one": 5, "two": 9}
        (tmp_path / "runs").mkdir()
        for name, steps in lengths.items():
            env = gym.make("tests/Drifting-v0", render_mode=None, max_episode_steps=steps)
            recorded(tmp_path / "runs" / f"{name}.mcap", env)
        with Recording(tmp_path / "runs" / "two.mcap") as recording:
            returns = {"two": recording.index["return"].max()}
        with Recording(tmp_path / "runs" / "one.mcap") as recording:
            returns["one"] = recording.index["return"].max()
        best = max(returns, key=lambda name: returns[name])
        code, out, err = run("render", tmp_path / "runs", "-o", tmp_path / "new.mcap")
        assert (code, err) == (0, "")
        with Recording(tmp_path / "new.mcap") as new:
            found = [episode for episode in new.episodes if len(episode.frames)]
            assert [(episode.return_, len(episode.frames)) for episode in found] == [
                (returns[best], lengths[best] + 1)
            ]
        files = [tmp_path / "runs" / f"{name}.mcap" for name in lengths]
        again = run("render", *files, "-o", tmp_path / "new.mcap", "--force")[1]
        first, second = (re.sub(r"in \d+\.\d s", "", text) for text in (out, again))
        assert first == second
        with Recording(tmp_path / "new.mcap") as new:
            assert max(episode.return_ for episode in new.episodes if len(episode.frames)) == returns[best]
        code, out, err = run("render", tmp_path / "runs", "-o", tmp_path / "all.mcap", "--episodes", "all")
        assert (code, out) == (1, "")
        assert "found episodes of 2 (one.mcap, two.mcap); give the path of one of them" in err
        assert not (tmp_path / "all.mcap").exists()

    @pytest.mark.parametrize(
        ("drift", "frames", "kept"),
        [("2", "3 frames", "the 3 before it are kept"), ("0", "1 frame", "the one before it is kept")],
    )
    def test_a_divergence_is_said_and_its_frames_are_kept(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drift: str, frames: str, kept: str
    ) -> None:
        path = recorded(tmp_path / "r.mcap")
        monkeypatch.setenv("DRIFT", drift)
        code, out, err = run("render", path, "-o", tmp_path / "new.mcap", "--episodes", "1")
        assert code == 1
        assert f"new.mcap: {frames} of 1 episode" in out
        assert f"error: episode 1 diverges at step {int(drift) + 1}: state[0] is " in err
        assert f"no frames from there on, {kept}" in err
        with Recording(tmp_path / "new.mcap") as recording:
            assert len(recording.episodes[1].frames) == int(drift) + 1

    @pytest.mark.parametrize(
        ("args", "code", "message"),
        [
            (["--episodes", "9"], 1, "has no episode 9; choose from 0 to 2"),
            (["--episodes", "all of them"], 2, "expected numbers of episodes"),
            (["--filter", "n_tuples > 99"], 1, "has no episode that"),
            (["--every", "0"], 2, "--every"),
        ],
    )
    def test_errors(self, tmp_path: Path, args: list[str], code: int, message: str) -> None:
        path = recorded(tmp_path / "r.mcap")
        found, out, err = run("render", path, "-o", tmp_path / "new.mcap", *args)
        assert (found, out) == (code, "")
        assert message in err
        assert not (tmp_path / "new.mcap").exists()
