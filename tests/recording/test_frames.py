"""Frames: recorded while running, tied to their states, and never lost with a finished step."""

from __future__ import annotations

import builtins
import copy
import gc
import pickle
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drawing import Drawing, drawn
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import RecordEpisodes, Recording, recover_recording, verify_recording
from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.cli import app
from tupli_mcap.doctor import examine
from tupli_mcap.errors import FormatError, MissingExtraError, RecordingError, TupliError
from tupli_mcap.journal.file import journal_path
from tupli_mcap.messages.images.pictures import decode_picture, encode_picture
from tupli_mcap.recording import rewrite_recording
from tupli_mcap.schema import FilterEQ
from tupli_mcap.storage import FileStorage
from tupli_mcap.vector import RecordEpisodes as RecordVector


def record(path: Path, lengths: list[int], env: Any = None, **options: Any) -> None:
    """Episodes of so many steps; those below the environment's own length are cut short."""
    with RecordEpisodes(env or Drawing(), path, attachments={}, **{"frames": True, **options}) as recorder:
        for length in lengths:
            recorder.reset(seed=length)
            for t in range(length):
                recorder.step(t % 3)


def states_of(episode: Any) -> list[Any]:
    return [*episode.states, episode.final_state]


def check(path: Path, every: int = 1) -> int:
    """Frames show the states they are said to show, exactly; returns how many there are."""
    count = 0
    with Recording(path) as recording:
        assert recording.cameras == ("render",)
        for episode in recording.episodes:
            ended = episode.end != "interrupted"
            wanted = [s for s in range(len(episode) + 1) if s % every == 0 or (ended and s == len(episode))]
            assert episode.frames.steps.tolist() == wanted, episode.number
            for step, frame in zip(wanted, episode.frames, strict=True):
                np.testing.assert_array_equal(frame, drawn(states_of(episode)[step]))
            count += len(wanted)
    return count


def problems(path: Path) -> list[Any]:
    return verify_recording(path).problems


class TestRecording:
    @pytest.mark.parametrize("every", [1, 2, 4, 100])
    def test_every_frame_shows_its_state(self, tmp_path: Path, every: int) -> None:
        path = tmp_path / "r.mcap"
        record(path, [6, 3, 6, 6, 1], frames=every if every > 1 else True)
        assert check(path, every) >= 8
        assert problems(path) == []

    @pytest.mark.parametrize("chunk_size", [1, 100, 1500])
    def test_whatever_the_chunks_are(self, tmp_path: Path, chunk_size: int) -> None:
        path = tmp_path / "r.mcap"
        record(path, [6, 4, 6], chunk_size=chunk_size)
        assert check(path) == 7 + 5 + 7
        assert problems(path) == []

    def test_times_are_those_of_rendering(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6, 6])
        with Recording(tmp_path / "r.mcap") as recording:
            for episode in recording.episodes:
                times = recording.read(episodes=[episode.number], fields=["times"]).times
                assert episode.start_time <= episode.frames.times[0] <= times[0]
                assert (episode.frames.times[1:] >= times).all()
                assert (episode.frames.times[1:-1] <= times[1:]).all()
                assert episode.frames.encoded(2).time_ns == episode.frames.times[2]

    def test_resets_without_a_step_leave_nothing(self, tmp_path: Path) -> None:
        with RecordEpisodes(Drawing(), tmp_path / "r.mcap", attachments={}, frames=True) as env:
            for seed in range(4):
                env.reset(seed=seed)
            env.step(1)
            env.reset()
            env.reset()
            env.step(2)
        assert check(tmp_path / "r.mcap") == 4

    def test_an_episode_that_goes_on_without_a_reset_starts_at_the_last_frame(self, tmp_path: Path) -> None:
        with RecordEpisodes(Drawing(2), tmp_path / "r.mcap", attachments={}, frames=True) as env:
            env.reset(seed=1)
            for _ in range(4):
                env.step(1)
        with Recording(tmp_path / "r.mcap") as recording:
            assert [e.frames.steps.tolist() for e in recording.episodes] == [[0, 1, 2], [0, 1, 2]]
        check(tmp_path / "r.mcap")

    def test_an_environment_that_resets_itself(self, tmp_path: Path) -> None:
        env = gym.wrappers.Autoreset(Drawing(2))
        with RecordEpisodes(env, tmp_path / "r.mcap", attachments={}, frames=True) as recorder:
            recorder.reset(seed=1)
            for _ in range(8):
                recorder.step(1)
        assert check(tmp_path / "r.mcap") == 3 + 3 + 3

    def test_appending_goes_on(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        record(path, [6, 2])
        record(path, [6], mode="a")
        record(path, [6], mode="a", frames=False)
        with Recording(path) as recording:
            assert [len(e.frames) for e in recording.episodes] == [7, 3, 7, 0]
        assert problems(path) == []
        record(tmp_path / "later.mcap", [6], frames=False)
        record(tmp_path / "later.mcap", [6, 6], mode="a")
        with Recording(tmp_path / "later.mcap") as recording:
            assert [len(e.frames) for e in recording.episodes] == [0, 7, 7]
        assert problems(tmp_path / "later.mcap") == []

    def test_jpeg_is_close(self, tmp_path: Path) -> None:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        with RecordEpisodes(env, tmp_path / "r.mcap", frames=3, frame_format="jpeg") as recorder:
            recorder.reset(seed=1)
            for _ in range(6):
                recorder.step(0)
            last = env.render()
        with Recording(tmp_path / "r.mcap") as recording:
            frames = recording.episodes[0].frames
            assert frames.steps.tolist() == [0, 3, 6]
            assert frames.encoded(-1).form == "jpeg"
            assert frames[-1].shape == (400, 600, 3)
            assert np.abs(frames[-1].astype(int) - last).mean() < 1
        assert problems(tmp_path / "r.mcap") == []

    def test_what_is_returned_is_what_the_environment_returned(self, tmp_path: Path) -> None:
        plain = gym.make("CartPole-v1")
        with RecordEpisodes(
            gym.make("CartPole-v1", render_mode="rgb_array"), tmp_path / "r.mcap", frames=5
        ) as env:
            np.testing.assert_array_equal(env.reset(seed=3)[0], plain.reset(seed=3)[0])
            for _ in range(8):
                np.testing.assert_array_equal(env.step(1)[0], plain.step(1)[0])


class TestVector:
    """Sub-environments: each has a channel of its own."""

    @pytest.mark.parametrize("every", [1, 3])
    @pytest.mark.parametrize("mode", list(AutoresetMode))
    def test_every_frame_shows_its_state(self, tmp_path: Path, mode: AutoresetMode, every: int) -> None:
        envs = SyncVectorEnv([lambda n=n: Drawing(4 + n) for n in range(3)], autoreset_mode=mode)  # type: ignore[misc]
        with RecordVector(envs, tmp_path / "r.mcap", attachments={}, frames=every) as recorder:
            recorder.reset(seed=5)
            for _ in range(20):
                *_, terminals, timeouts, _ = recorder.step(recorder.action_space.sample())
                if mode == AutoresetMode.DISABLED and (terminals | timeouts).any():
                    recorder.reset(options={"reset_mask": terminals | timeouts})
        with Recording(tmp_path / "r.mcap") as recording:
            assert recording.cameras == ("render",)
            assert {episode.env for episode in recording.episodes} == {0, 1, 2}
            for episode in recording.episodes:
                ended = episode.end != "interrupted"
                steps = [
                    s for s in range(len(episode) + 1) if s % every == 0 or (ended and s == len(episode))
                ]
                if mode == AutoresetMode.SAME_STEP and ended:
                    steps = [s for s in steps if s < len(episode)]  # it is gone when it can be drawn
                assert episode.frames.steps.tolist() == steps
                for step, frame in zip(steps, episode.frames, strict=True):
                    np.testing.assert_array_equal(frame, drawn(states_of(episode)[step]))
        assert problems(tmp_path / "r.mcap") == []

    def test_of_other_processes(self, tmp_path: Path) -> None:
        envs = AsyncVectorEnv([Drawing, Drawing])
        with RecordVector(envs, tmp_path / "r.mcap", frames=True) as recorder:
            recorder.reset(seed=5)
            for _ in range(9):
                recorder.step(np.array([0, 2]))
        assert check(tmp_path / "r.mcap") == 2 * (7 + 3)
        report = recover_recording(tmp_path / "r.mcap", tmp_path / "new.mcap")
        assert report.intact
        assert check(tmp_path / "new.mcap") == 20
        assert problems(tmp_path / "new.mcap") == []

    def test_no_pictures(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(RecordingError, match="render_mode='rgb_array', found None"):
            RecordVector(SyncVectorEnv([lambda: Drawing(render_mode=None)]), tmp_path / "r.mcap", frames=True)
        recorder = RecordVector(
            SyncVectorEnv([Drawing] * 2), tmp_path / "r.mcap", attachments={}, frames=True
        )
        monkeypatch.setattr(SyncVectorEnv, "render", lambda self: [drawn([1.0])])
        with pytest.raises(RecordingError, match="for each of 2 sub-environments, found list of 1"):
            recorder.reset(seed=1)
        recorder.close()


class TestBadInput:
    @pytest.mark.parametrize("mode", [None, "human", "ansi"])
    def test_an_environment_without_pictures(self, tmp_path: Path, mode: str | None) -> None:
        with pytest.raises(RecordingError, match=r"render_mode='rgb_array', found .*gymnasium\.make\("):
            RecordEpisodes(Drawing(render_mode=mode), tmp_path / "r.mcap", frames=True)
        assert not (tmp_path / "r.mcap").exists()

    @pytest.mark.parametrize("frames", [-1, 1.5, "all", None])
    def test_other_numbers(self, tmp_path: Path, frames: Any) -> None:
        with pytest.raises(RecordingError, match="frames: expected True, False, or a number of steps"):
            RecordEpisodes(Drawing(), tmp_path / "r.mcap", frames=frames)

    def test_another_format(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError, match="frame_format: expected 'png' or 'jpeg', found 'gif'"):
            RecordEpisodes(Drawing(), tmp_path / "r.mcap", frames=True, frame_format="gif")  # type: ignore[arg-type]

    def test_no_picture(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The step is recorded all the same."""
        env = RecordEpisodes(Drawing(), tmp_path / "r.mcap", attachments={}, frames=True)
        env.reset(seed=1)
        env.step(1)
        monkeypatch.setattr(Drawing, "render", lambda self: np.zeros((4, 4)))
        with pytest.raises(
            RecordingError, match=r"a picture \(uint8, height x width x 3\), found float64 of shape"
        ):
            env.step(1)
        env.close()
        with Recording(tmp_path / "r.mcap") as recording:
            assert len(recording.episodes[0]) == 2
            assert recording.episodes[0].frames.steps.tolist() == [0, 1]

    def test_without_pillow(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        record(tmp_path / "r.mcap", [2])
        real = builtins.__import__

        def without(name: str, *args: Any, **kwargs: Any) -> Any:
            if name.partition(".")[0] == "PIL":
                raise ImportError(name)
            return real(name, *args, **kwargs)

        monkeypatch.setattr(builtins, "__import__", without)
        with pytest.raises(MissingExtraError, match=r"pip install .*\[frames\]"):
            RecordEpisodes(Drawing(), tmp_path / "x.mcap", frames=True)
        with Recording(tmp_path / "r.mcap") as recording:
            frames = recording.episodes[0].frames
            assert frames.encoded(0).data.startswith(b"\x89PNG")
            with pytest.raises(MissingExtraError, match=r"pip install .*\[frames\]"):
                frames[0]


class TestReading:
    @pytest.mark.parametrize("made", [copy.copy, copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
    def test_copies_open_the_file_themselves(self, tmp_path: Path, made: Any) -> None:
        record(tmp_path / "r.mcap", [3])
        with Recording(tmp_path / "r.mcap") as recording:
            copied = made(recording.frames(0))
            np.testing.assert_array_equal(copied[1], recording.frames(0)[1])
            del copied
            gc.collect()
            assert len(list(recording.frames(0))) == 4

    @pytest.mark.parametrize("index", [[0, 2], np.array([0, 2]), None, "0"])
    def test_what_is_no_index(self, tmp_path: Path, index: Any) -> None:
        record(tmp_path / "r.mcap", [3])
        with Recording(tmp_path / "r.mcap") as recording:
            with pytest.raises(RecordingError, match="expected a frame's number or a slice, found"):
                recording.frames(0)[index]
            with pytest.raises(RecordingError, match="expected an episode's number or a slice, found"):
                recording.episodes[index]

    def test_another_process_reads_them(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [3])
        with Recording(tmp_path / "r.mcap") as recording, (tmp_path / "f.pickle").open("wb") as file:
            pickle.dump(recording.frames(0), file)
            expected = sum(int(frame.sum()) for frame in recording.frames(0))
        code = "import pickle; print(sum(int(f.sum()) for f in pickle.load(open('f.pickle', 'rb'))))"
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
        assert done.stdout == f"{expected}\n", done.stderr

    def test_a_recording_without_frames(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [3], frames=False)
        with Recording(tmp_path / "r.mcap") as recording:
            assert recording.cameras == ()
            assert len(recording.episodes[0].frames) == 0
            assert list(recording.episodes[0].frames) == []
            with pytest.raises(IndexError, match="no frames: record with frames=True"):
                recording.episodes[0].frames[0]
            with pytest.raises(RecordingError, match="`tupli-mcap render` makes frames"):
                recording.frames(0, "render")

    def test_a_sequence(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6], frames=2)
        with Recording(tmp_path / "r.mcap") as recording:
            frames = recording.episodes[0].frames
            np.testing.assert_array_equal(frames[-1], frames.of_step(6))
            np.testing.assert_array_equal(frames[1:3][1], frames.of_step(4))
            assert frames[1:].steps.tolist() == [2, 4, 6]
            with pytest.raises(RecordingError, match="has no frame of step 3; it has 0, 2, 4, 6$"):
                frames.of_step(3)
            with pytest.raises(
                RecordingError, match="expected one of its cameras, found 'front'; it has render"
            ):
                recording.frames(0, "front")

    def test_tables_have_a_column_of_them_if_asked(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6])
        dataset = tupli_mcap.open(tmp_path)
        shown = dataset.read(["frames"]).frames
        assert "frames" not in dataset.to_pandas()
        np.testing.assert_array_equal(np.stack(list(dataset.to_pandas(frames=True)["frames"])), shown)
        np.testing.assert_array_equal(dataset.to_arrow(frames=True)["frames"].to_pylist(), shown)
        with Recording(tmp_path / "r.mcap") as recording:
            assert len(recording.to_pandas(frames=True)["frames"][0].shape) == 3
        with pytest.raises(TupliError, match="expected the level 'steps' for frames"):
            dataset.to_pandas("episodes", frames=True)

    def test_one_frame_decodes_one_chunk(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6] * 10, chunk_size=500)
        with Recording(tmp_path / "r.mcap") as recording:
            loaded: list[int] = []
            real = recording._store._read
            recording._store._read = lambda i: loaded.append(i) or real(i)  # type: ignore[method-assign,func-returns-value]
            recording.episodes[7].frames[3]
            camera = recording._topics["/camera/render"]
            chunks = recording._store.table["channel"][loaded] == camera
            assert chunks.sum() == 1
            assert (recording._store.table["channel"] == camera).sum() > 5

    @pytest.mark.parametrize(
        "data", [b"", b"\x89PNG\r\n\x1a\n", b"GIF89a" + bytes(50), encode_picture(drawn([1.0]), "png")[:60]]
    )
    def test_bytes_that_are_no_picture(self, data: bytes) -> None:
        with pytest.raises(FormatError, match="here: expected a PNG or a JPEG, found b(?!.*BytesIO)"):
            decode_picture(data, "here")

    @pytest.mark.parametrize("side", [9_000, 20_000])
    def test_a_picture_that_claims_to_be_huge(self, tmp_path: Path, side: int) -> None:
        Image.new("1", (side, side)).save(tmp_path / "bomb.png")
        with pytest.raises(FormatError, match=f"here: .*({side}|{side * side})"):
            decode_picture((tmp_path / "bomb.png").read_bytes(), "here")

    def test_other_readers_decode_them(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6, 2])
        with Recording(tmp_path / "r.mcap") as recording:
            states = {
                (e.number, s): state for e in recording.episodes for s, state in enumerate(states_of(e))
            }
        pictures, pairs = [], []
        with (tmp_path / "r.mcap").open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, message, decoded in reader.iter_decoded_messages(
                ["/camera/render", "/frame/render"]
            ):
                if channel.topic == "/frame/render":
                    pairs.append((message.sequence, message.log_time, decoded.episode, decoded.step))
                    continue
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == message.log_time
                assert (decoded.header.frame_id, decoded.format) == ("render", "png")
                pictures.append((message.sequence, message.log_time, decode_picture(bytes(decoded.data), "")))
        assert len(pictures) == 10
        for (row, time, picture), pair in zip(
            sorted(pictures, key=lambda p: p[0]), sorted(pairs), strict=True
        ):
            assert (row, time) == pair[:2]
            np.testing.assert_array_equal(picture, drawn(states[pair[2:]]))

    def test_rerun_reads_them_without_a_warning(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6, 2])
        rerun = Path(sys.executable).with_name("rerun")
        command = [
            rerun,
            "mcap",
            "convert",
            "--application-id",
            "t",
            tmp_path / "r.mcap",
            "-o",
            tmp_path / "r.rrd",
        ]
        done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        assert "WARN" not in done.stdout + done.stderr


KILLED = textwrap.dedent(
    """
    import os, signal, sys
    sys.path[:0] = [{tests!r}]
    from drawing import Drawing
    from tupli_mcap import RecordEpisodes
    env = RecordEpisodes(Drawing(), {path!r}, attachments={{}}, frames={every}, chunk_size={chunk}, mode={mode!r})
    for episode in range({episodes}):
        env.reset(seed=episode)
        for t in range(6):
            env.step(t % 3)
    env.reset(seed=99)
    for t in range(4):
        env.step(1)
    os.kill(os.getpid(), signal.SIGKILL)
    """
)


KILLED_VECTOR = textwrap.dedent(
    """
    import os, signal, sys
    sys.path[:0] = [{tests!r}]
    import numpy as np
    from drawing import Drawing
    from gymnasium.vector import SyncVectorEnv
    from tupli_mcap.vector import RecordEpisodes
    envs = SyncVectorEnv([Drawing, Drawing])
    env = RecordEpisodes(envs, {path!r}, attachments={{}}, frames=True, chunk_size=500)
    env.reset(seed=3)
    for t in range(6 + 1 + 6 + 1 + 3):
        env.step(np.array([t % 3, 1]))
    os.kill(os.getpid(), signal.SIGKILL)
    """
)


class TestKilled:
    def kill(
        self, path: Path, *, every: int = 1, chunk: int = 2000, episodes: int = 5, mode: str = "x"
    ) -> None:
        facts = {"tests": str(Path(__file__).parents[1] / "support"), "path": str(path), "every": every}
        code = KILLED.format(**facts, chunk=chunk, episodes=episodes, mode=mode)
        done = subprocess.run([sys.executable, "-c", code], timeout=60, check=False, stderr=subprocess.PIPE)
        assert done.returncode == -signal.SIGKILL, done.stderr.decode()

    @pytest.mark.sampled(2)
    @pytest.mark.parametrize(("every", "chunk"), [(1, 2000), (1, 10), (3, 300), (2, 1 << 18)])
    def test_no_frame_of_a_finished_step_is_lost(self, tmp_path: Path, every: int, chunk: int) -> None:
        path = tmp_path / "r.mcap"
        self.kill(path, every=every, chunk=chunk)
        with Recording(path) as recording:
            assert not recording.complete
            assert [len(e) for e in recording.episodes] == [6] * 5 + [4]
        before = check(path, every)
        assert [p for p in problems(path) if p.severity == "error"] == []
        self.kill(path, every=every, chunk=chunk, episodes=2, mode="a")
        assert check(path, every) > before
        record(path, [6], mode="a", frames=every)
        with Recording(path) as recording:
            assert recording.complete
            assert [len(e) for e in recording.episodes] == [6] * 5 + [4] + [6] * 2 + [4, 6]
        check(path, every)
        assert problems(path) == []

    def test_of_sub_environments(self, tmp_path: Path) -> None:
        path = tmp_path / "r.mcap"
        code = KILLED_VECTOR.format(tests=str(Path(__file__).parents[1] / "support"), path=str(path))
        done = subprocess.run([sys.executable, "-c", code], timeout=60, check=False, stderr=subprocess.PIPE)
        assert done.returncode == -signal.SIGKILL, done.stderr.decode()
        before = check(path)
        assert before == 2 * (7 + 7 + 4)
        with RecordVector(
            SyncVectorEnv([Drawing] * 2), path, attachments={}, mode="a", frames=True
        ) as recorder:
            recorder.reset(seed=1)
            recorder.step(np.array([0, 2]))
        assert check(path) == before + 4
        assert problems(path) == []

    def test_recover_keeps_them(self, tmp_path: Path) -> None:
        self.kill(tmp_path / "r.mcap")
        report = recover_recording(tmp_path / "r.mcap", tmp_path / "new.mcap")
        assert (report.frames_lost, report.steps_lost) == (0, 0)
        assert check(tmp_path / "new.mcap") == check(tmp_path / "r.mcap") == 40
        assert problems(tmp_path / "new.mcap") == []

    def test_frames_of_steps_that_are_lost_are_not_shown(self, tmp_path: Path) -> None:
        """Without its journal: frames are in chunks already, their steps are not; no later episode gets them."""
        path = tmp_path / "r.mcap"
        self.kill(path, chunk=700, episodes=8)
        journal_path(path).unlink()
        with pytest.warns(UserWarning, match="no journal"), Recording(path) as recording:
            found = len(recording)
            assert 0 < found < 9
            shown = int(recording._cameras._table("render", 0).episodes.max())
            assert shown >= recording.episodes[-1].number
        with pytest.warns(UserWarning, match="no journal"):
            record(path, [6, 6], mode="a")
        with Recording(path) as recording:
            assert recording.episodes[found].number > shown
            for episode in recording.episodes:
                for step, frame in zip(episode.frames.steps.tolist(), episode.frames, strict=True):
                    if step < len(episode) or episode.final_state is not None:
                        np.testing.assert_array_equal(frame, drawn(states_of(episode)[step]))
            assert len(recording.episodes[-1].frames) == 7
        assert {p.severity for p in problems(path)} <= {"note"}


class TestRewriting:
    def test_a_part_of_the_episodes(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6, 3, 6, 2], chunk_size=600)
        with Recording(tmp_path / "r.mcap") as recording:
            rewrite_recording(recording, tmp_path / "new.mcap", episodes=[0, 3])
        assert check(tmp_path / "new.mcap") == 7 + 3
        assert problems(tmp_path / "new.mcap") == []

    def test_the_same_frames_in_the_same_place(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6, 3, 6])
        with Recording(tmp_path / "r.mcap") as recording:
            rewrite_recording(recording, tmp_path / "new.mcap")
            with Recording(tmp_path / "new.mcap") as other:
                for a, b in zip(recording.episodes, other.episodes, strict=True):
                    assert a.frames.times.tolist() == b.frames.times.tolist()
                    assert [a.frames.encoded(i) for i in range(len(a.frames))] == [
                        b.frames.encoded(i) for i in range(len(b.frames))
                    ]


class TestStorages:
    """What hands recordings on knows of frames."""

    def roll(self, env: gym.Env[Any, Any], episodes: int) -> None:
        for seed in range(episodes):
            env.reset(seed=seed)
            for t in range(6):
                env.step(t % 3)

    def test_bundles_and_compacted_storages(self, tmp_path: Path) -> None:
        with FileStorage(tmp_path / "lab") as storage:
            known = None
            for _ in range(2):
                env = TupliEnvWrapper(
                    Drawing(), storage=storage, benchmark_id=known, frames=True, compression="none"
                )
                if known is None:
                    env.store(name="walk")
                    known = env.id
                self.roll(env, 3)
                env.close()
            assert known is not None
            storage.bundle(known, tmp_path / "bundle.mcap")
            assert check(tmp_path / "bundle.mcap") == 6 * 7
            assert problems(tmp_path / "bundle.mcap") == []
            assert storage.delete_episodes(FilterEQ(key="seed", value=1)) == 2
            assert storage.compact() > 0
            for path in (tmp_path / "lab").rglob("*.mcap"):
                assert check(path) == 2 * 7
                assert problems(path) == []
            storage.bundle(known, tmp_path / "less.mcap")
        assert check(tmp_path / "less.mcap") == 4 * 7
        with FileStorage(tmp_path / "other") as storage:
            storage.import_bundle(tmp_path / "bundle.mcap", trust=True)
            (path,) = (tmp_path / "other").rglob("*.mcap")
            assert check(path) == 6 * 7

    def test_the_doctor_finds_nothing(self, tmp_path: Path) -> None:
        record(tmp_path / "r.mcap", [6] * 8)
        record(tmp_path / "plain.mcap", [6] * 8, frames=False)
        found, plain = (examine([str(tmp_path / name)]).to_dict() for name in ("r.mcap", "plain.mcap"))
        assert found["episodes"] == plain["episodes"] == 8
        assert [f["check"] for f in found["findings"]] == [f["check"] for f in plain["findings"]]

    def test_the_record_command(self, tmp_path: Path) -> None:
        path = str(tmp_path / "r.mcap")
        arguments = ["record", "CartPole-v1", "-o", path, "--steps", "30", "--frames"]
        result = CliRunner().invoke(app, [*arguments, "--every", "4"])
        assert result.exit_code == 0, result.output
        with Recording(path) as recording:
            for episode in recording.episodes:
                assert set(range(0, len(episode) + 1, 4)) <= set(episode.frames.steps.tolist())
        result = CliRunner().invoke(app, ["record", "CartPole-v1", "-o", path, "--every", "4"])
        assert (result.exit_code, "give --frames too" in result.stderr) == (2, True)


class TestDamage:
    def damaged(self, tmp_path: Path, topic: str) -> Path:
        """A recording of 20 episodes in which one chunk of a channel, in the middle, is damaged."""
        path = tmp_path / "r.mcap"
        record(path, [6] * 20, chunk_size=400, compression="none")
        with Recording(path) as recording:
            table = recording._store.table
            chunks = table[table["channel"] == recording._topics[topic]]
            at = int(chunks[len(chunks) // 2]["offset"])
        data = bytearray(path.read_bytes())
        data[at + 100] ^= 0xFF
        path.write_bytes(data)
        return path

    @pytest.mark.parametrize("topic", ["/camera/render", "/frame/render"])
    def test_whole_frames_are_kept(self, tmp_path: Path, topic: str) -> None:
        path = self.damaged(tmp_path, topic)
        assert any(p.severity == "error" for p in problems(path))
        report = recover_recording(path, tmp_path / "new.mcap")
        assert report.steps_lost == 0
        with Recording(tmp_path / "new.mcap") as recording:
            kept = 0
            for episode in recording.episodes:
                for step, frame in zip(episode.frames.steps.tolist(), episode.frames, strict=True):
                    np.testing.assert_array_equal(frame, drawn(states_of(episode)[step]))
                    kept += 1
        assert report.frames_lost > 0
        assert kept + report.frames_lost == 140
        assert problems(tmp_path / "new.mcap") == []

    def test_frames_follow_the_pieces_of_an_episode(self, tmp_path: Path) -> None:
        path = self.damaged(tmp_path, "/step")
        report = recover_recording(path, tmp_path / "new.mcap")
        assert report.steps_lost > 0
        with Recording(tmp_path / "new.mcap") as recording:
            for episode in recording.episodes:
                states = states_of(episode)
                for step, frame in zip(episode.frames.steps.tolist(), episode.frames, strict=True):
                    if states[step] is not None:
                        np.testing.assert_array_equal(frame, drawn(states[step]))
                assert len(episode.frames) == len(episode) + 1
        assert problems(tmp_path / "new.mcap") == []

    @pytest.mark.parametrize("what", ["format", "frame_id", "stamp", "picture", "step", "episode"])
    def test_verify_finds_what_does_not_fit(self, tmp_path: Path, what: str) -> None:
        """Written so by a writer that is wrong: all checksums are right."""
        path = tmp_path / "r.mcap"
        record(path, [6, 3], compression="none")
        with Recording(path) as recording:
            rewrite_wrongly(recording, tmp_path / "new.mcap", what)
        found = [p for p in problems(tmp_path / "new.mcap") if p.severity == "error"]
        assert [p.kind for p in found] == ["frame"] * len(found)
        assert found, what


def rewrite_wrongly(recording: Recording, target: Path, what: str) -> None:
    """A copy in which one message of the frames is another."""
    from tupli_mcap.recording.edit.copy_episodes import EpisodeCopier

    real = EpisodeCopier._messages

    def messages(self: Any, channel: int, first: int, count: int) -> Any:
        for row, (time, body) in enumerate(real(self, channel, first, count), first):
            changed = bytearray(body)
            if row == 2 and channel == self._topics["/camera/render"]:
                at = {"format": body.index(b"png"), "frame_id": body.index(b"render"), "stamp": 4}
                at["picture"] = body.index(b"PNG")
                if what in at:
                    changed[at[what]] ^= 1
            elif row == 2 and channel == self._topics["/frame/render"]:
                if what == "step":
                    changed[4:8] = (1).to_bytes(4, "little")
                elif what == "episode":
                    changed[0:4] = (1).to_bytes(4, "little")
            yield time, bytes(changed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EpisodeCopier, "_messages", messages)
        rewrite_recording(recording, target)  # compressed anew, so that no chunk is copied


def test_recording_costs_nothing_when_it_is_off(tmp_path: Path) -> None:
    """The same functions take the step as if there were no frames."""
    with RecordEpisodes(Drawing(), tmp_path / "r.mcap", attachments={}) as env:
        env.reset(seed=1)
        env.step(1)
        assert env._frames is None
        assert env._plain
        assert env._watches is False
    with Recording(tmp_path / "r.mcap") as recording:
        assert not any("/frame/" in topic or "/camera/" in topic for topic in recording._topics)
