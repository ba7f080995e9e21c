"""Films of recorded pictures: nothing is executed for them."""

from __future__ import annotations

import base64
import re
import resource
from pathlib import Path
from typing import Any

import av
import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import RecordEpisodes, Recording, RecordingError
from tupli_mcap.cli.app import app
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.reexecute import film


class Camera(gym.Env[Any, Any]):
    """Its state is a picture of one grey, darker by 40 a step."""

    metadata = {"render_modes": ["rgb_array"]}
    action_space = spaces.Discrete(2)
    render_mode = "rgb_array"

    def __init__(self, shape: tuple[int, ...] = (20, 30, 3)) -> None:
        self.observation_space = spaces.Dict(
            wrist=spaces.Box(0, 255, shape, np.uint8), pose=spaces.Box(-1, 1, (2,), np.float32)
        )

    def seen(self) -> Any:
        shape = self.observation_space["wrist"].shape
        return {"wrist": np.full(shape, 250 - 40 * self.t, np.uint8), "pose": np.zeros(2, np.float32)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.seen(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        return self.seen(), 0.0, self.t == 5, False, {}

    def render(self) -> Any:
        return np.full((16, 16, 3), 10 * self.t, np.uint8)


def record(path: Path, env: gym.Env[Any, Any], episodes: int = 2, **options: Any) -> Path:
    with RecordEpisodes(env, path, capture_env=None, **options) as recorded:
        for _ in range(episodes):
            recorded.reset()
            while not recorded.step(0)[2]:
                pass
    return path


def shown(path: Path) -> list[int]:
    """The mean brightness of each picture."""
    if path.suffix == ".gif":
        with Image.open(path) as image:
            found = []
            for i in range(getattr(image, "n_frames", 1)):
                image.seek(i)
                found.append(round(float(np.asarray(image.convert("RGB")).mean())))
            return found
    with av.open(str(path)) as container:
        return [round(float(frame.to_ndarray(format="rgb24").mean())) for frame in container.decode(video=0)]


@pytest.mark.parametrize("kind", [".mp4", ".gif"])
@pytest.mark.parametrize("shape", [(20, 30, 3), (20, 30, 1)])
def test_of_an_image_in_the_states(kind: str, shape: tuple[int, ...], tmp_path: Path) -> None:
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", Camera(shape)))[1]
    assert episode.video(tmp_path / f"film{kind}").pictures == 6
    np.testing.assert_allclose(shown(tmp_path / f"film{kind}"), [250, 210, 170, 130, 90, 50], atol=6)


def test_a_fast_gif_ends_with_the_last_picture(tmp_path: Path) -> None:
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", Camera()))[1]
    episode.video(tmp_path / "film.gif", fps=200)  # of which a GIF shows every fourth picture
    np.testing.assert_allclose(shown(tmp_path / "film.gif"), [250, 90, 50], atol=3)


@pytest.mark.parametrize("rows", [20, 720])
def test_it_says_how_its_colours_are_stored(rows: int, tmp_path: Path) -> None:
    tupli_mcap.open(record(tmp_path / "r.mcap", Camera((rows, 30, 3))))[1].video(tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as container:
        read = container.streams.video[0].codec_context
        told = read.colorspace, read.color_primaries, read.color_trc
    assert told == (6, 1, 13)  # SMPTE 170M, as PyAV converts; BT.709 and sRGB, as pictures have it


@pytest.mark.parametrize("kind", [".mp4", ".gif"])
def test_of_which_the_disk_takes_no_more(kind: str, tmp_path: Path) -> None:
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", Camera()))[1]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))  # EFBIG, as ENOSPC from the same call
    try:
        with pytest.raises(RecordingError, match=rf"^{tmp_path}/film{kind} cannot be written: File too"):
            episode.video(tmp_path / f"film{kind}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]


def test_of_a_camera_or_of_an_image_by_choice(tmp_path: Path) -> None:
    recording = Recording(record(tmp_path / "r.mcap", Camera(), frames=True))
    episodes = list(recording.episodes)
    assert film(episodes, tmp_path / "a.gif").pictures == 12
    np.testing.assert_allclose(shown(tmp_path / "a.gif"), [0, 10, 20, 30, 40, 50] * 2, atol=3)
    for i, name in enumerate(["state['wrist']", "state.wrist", "wrist"]):
        assert film(episodes[:1], tmp_path / f"b{i}.gif", camera=name, fps=5).pictures == 6
    with pytest.raises(RecordingError, match="it has render, state"):
        film(episodes, tmp_path / "c.gif", camera="front")


@pytest.mark.parametrize(
    ("frames", "every", "rate"), [(True, 1, 50), (2, 1, 25), (2, 2, 12.5), (True, 4, 12.5)]
)
def test_frames_of_some_steps_take_as_long_as_those_of_all(
    tmp_path: Path, frames: int, every: int, rate: float
) -> None:
    env = gym.make("CartPole-v1", render_mode="rgb_array", max_episode_steps=9)
    episode = tupli_mcap.open(record_until_timeout(tmp_path / "r.mcap", env, frames))[0]
    episode.video(tmp_path / "film.mp4", every=every)
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert float(container.streams.video[0].average_rate or 0) == rate


def record_until_timeout(path: Path, env: gym.Env[Any, Any], frames: int) -> Path:
    with RecordEpisodes(env, path, frames=frames) as recorded:
        recorded.reset(seed=1)
        for step in range(9):
            recorded.step(step % 2)
    return path


def test_some_pictures_of_a_size(tmp_path: Path) -> None:
    recording = Recording(record(tmp_path / "r.mcap", Camera(), frames=True))
    episodes = list(recording.episodes)
    assert film(episodes, tmp_path / "a.gif", every=3).pictures == 6
    np.testing.assert_allclose(shown(tmp_path / "a.gif"), [0, 30, 50] * 2, atol=3)
    film(episodes, tmp_path / "b.gif", width=40)
    sizes = []
    for name in ("a.gif", "b.gif"):
        with Image.open(tmp_path / name) as image:
            sizes.append(image.size)
    assert sizes[0][0] >= 240 and sizes[0][0] % recording.frames(0)[0].shape[1] == 0
    assert sizes[1][0] == 40
    assert repr(film(episodes, every=np.int64(3)).pictures) == "6"  # type: ignore[arg-type]
    for wrong in (
        {"every": 0},
        {"width": 0},
        {"every": 1.5},
        {"every": "2"},
        {"width": 40.5},
        {"width": "40"},
    ):
        with pytest.raises(RecordingError, match="expected every >= 1 and a width"):
            film(episodes, tmp_path / "c.gif", **wrong)  # type: ignore[arg-type]
    words = ["render", str(tmp_path / "r.mcap"), "-e", "all", "--width", "40", "--every", "3"]
    told = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "d.gif"), "--camera", "state['wrist']"])
    assert "d.gif: 6 recorded pictures\n" in told.output and "r.mcap: episode 0, return " in told.output
    with Image.open(tmp_path / "d.gif") as image:
        assert image.size[0] == 40
    told = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "e.gif"), "--camera", "front"])
    assert (told.exit_code, "it has render, state" in told.output) == (1, True)
    for fps in (4, 20):
        told = CliRunner().invoke(app, [*words, "--fps", str(fps), "-o", str(tmp_path / f"{fps}.gif")])
        with Image.open(tmp_path / f"{fps}.gif") as image:
            assert (told.exit_code, image.info["duration"]) == (0, 1000 // fps)
    told = CliRunner().invoke(app, [*words, "-o", str(tmp_path / "f.gif"), "--rerun", "--fps", "9"])
    assert (told.exit_code, "--fps is for recorded pictures" in told.output) == (2, True)


@pytest.mark.parametrize("kind", [".mp4", ".gif"])
@pytest.mark.parametrize("seconds", [900, 1e-300, 1e300])
def test_of_steps_that_last_longer_or_shorter_than_films_hold(
    seconds: float, kind: str, tmp_path: Path
) -> None:
    path = record(tmp_path / "r.mcap", Camera(), 1)
    add_attachments(path, {"labels.json": ("application/json", b'{"step_seconds": %r}' % seconds)})
    episode = tupli_mcap.open(path)[0]
    assert episode.recording.labels.step_seconds == seconds
    episode.video(tmp_path / f"film{kind}")
    assert shown(tmp_path / f"film{kind}")[0] == 250


@pytest.mark.parametrize(("kind", "shape"), [(".mp4", (1, 60_000, 3)), (".gif", (1, 70_000, 3))])
def test_pictures_larger_than_films_hold_are_refused(
    kind: str, shape: tuple[int, ...], tmp_path: Path
) -> None:
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", Camera(shape), 1))[0]
    with pytest.raises(
        RecordingError, match=f"that {kind} can hold, found {shape[1]} x 1 pixels; give another"
    ):
        episode.video(tmp_path / f"film{kind}")
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]
    assert episode.video(tmp_path / f"film{kind}", width=320).pictures == 6


@pytest.mark.parametrize("target", [None, "film.mp4", "film.gif"])
def test_a_notebook_shows_it(target: str | None, tmp_path: Path) -> None:
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", Camera()))[0]
    made = episode.video(None if target is None else tmp_path / target)
    page = made._repr_html_()
    kind, content = re.search(r'src="data:([a-z]+/[a-z0-9]+);base64,([^"]+)"', page).groups()  # type: ignore[union-attr]
    assert kind == ("image/gif" if target == "film.gif" else "video/mp4")
    assert page.startswith("<img" if target == "film.gif" else "<video")
    copy = tmp_path / f"copy{made.kind}"
    copy.write_bytes(base64.b64decode(content))
    assert len(shown(copy)) == made.pictures == 6
    assert made.path == (None if target is None else tmp_path / target)
    assert made.path is None or made.path.read_bytes() == copy.read_bytes()
    assert len(repr(made)) < 200


def test_of_a_stack_its_newest_frame(tmp_path: Path) -> None:
    class Gray(Camera):
        def __init__(self) -> None:
            self.observation_space = spaces.Box(0, 255, (20, 30), np.uint8)

        def seen(self) -> Any:
            return np.full((20, 30), 250 - 40 * self.t, np.uint8)

    env = gym.wrappers.FrameStackObservation(Gray(), 4)
    episode = tupli_mcap.open(record(tmp_path / "r.mcap", env))[0]
    episode.video(tmp_path / "film.gif")
    np.testing.assert_allclose(shown(tmp_path / "film.gif"), [250, 210, 170, 130, 90, 50], atol=3)


def test_refuses_what_has_no_meaning(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", gym.make("CartPole-v1"), 1)
    with pytest.raises(RecordingError, match="without pictures"):
        Recording(path).episodes[0].video(tmp_path / "x.gif")
    episode = Recording(record(tmp_path / "c.mcap", Camera())).episodes[0]
    for name in ("x.txt", "c.mcap"):
        with pytest.raises(RecordingError, match="expected a name"):
            episode.video(tmp_path / name)
    episode.video(tmp_path / "x.gif")
    with pytest.raises(RecordingError, match="exists"):
        episode.video(tmp_path / "x.gif")
    episode.video(tmp_path / "x.gif", overwrite=True)


def test_command(tmp_path: Path) -> None:
    path = record(tmp_path / "r.mcap", Camera())
    done = CliRunner().invoke(app, ["render", str(path), "-o", str(tmp_path / "f.gif"), "--episodes", "all"])
    assert done.exit_code == 0, done.output
    assert "12 recorded pictures" in done.output
    assert len(shown(tmp_path / "f.gif")) == 12
    again = CliRunner().invoke(app, ["render", str(path), "-o", str(tmp_path / "g.gif"), "--rerun"])
    assert again.exit_code == 1
    assert "carries no environment" in again.output
