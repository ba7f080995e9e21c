"""Images of states as PNG: every pixel comes back, viewers see pictures, and damage is found."""

from __future__ import annotations

import io
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation
from mcap.reader import make_reader
from PIL import Image

from tupli_mcap import FormatError, RecordEpisodes, Recording, RecordingError
from tupli_mcap.journal.committed import even_rows
from tupli_mcap.mcap.container import Rows
from tupli_mcap.messages.images.codecs import PngCodec
from tupli_mcap.messages.images.pictures import decode_pixels
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.edit.merge import merge_recordings
from tupli_mcap.recording.edit.repair.recover import recover_recording
from tupli_mcap.recording.edit.rewrite import rewrite_recording
from tupli_mcap.recording.write import writer
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.reexecute.render import render
from tupli_mcap.vector import RecordEpisodes as RecordVector

SPACE = spaces.Dict(
    {
        "grey": spaces.Box(0, 255, (7, 5, 1), np.uint8),
        "seen": spaces.Box(0, 255, (80, 90, 3), np.uint8),
        "mask": spaces.Box(0, 255, (6, 6, 4), np.uint8),
        "x": spaces.Box(-1, 1, (2,)),
    }
)


def play(env: gym.Env[Any, Any], steps: int) -> list[Any]:
    states = []
    state, _ = env.reset(seed=1)
    for _ in range(steps):
        states.append(state)
        state, _, terminal, timeout, _ = env.step(env.action_space.sample())
        if terminal or timeout:
            state, _ = env.reset()
    return states


def check(path: Path, states: list[Any]) -> None:
    with Recording(path) as recording:
        assert recording.metadata["format_version"] == "2"
        for threads in (1, 2):
            found = recording.read(threads=threads).states
            for key in SPACE:
                assert np.array_equal(found[key], np.array([state[key] for state in states]))
    assert verify_recording(path).ok


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_every_pixel_comes_back(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(
        Sampler(SPACE, spaces.Discrete(2), length=9), path, image_format="png", compression=compression
    ) as env:
        states = play(env, 80)
    check(path, states)
    with path.open("rb") as file:
        shown = list(make_reader(file).iter_messages(topics=["/image/state_seen"]))
    assert len(shown) == 80
    for state, (schema, channel, message) in zip(states, shown, strict=True):
        assert schema is not None and schema.name == "sensor_msgs/msg/CompressedImage"
        assert channel.metadata["codec"] == "png"
        picture = Image.open(io.BytesIO(message.data[message.data.index(b"\x89PNG") :]))
        assert np.array_equal(np.asarray(picture), state["seen"])


def test_killed_appended_rewritten_and_repaired(tmp_path: Path) -> None:
    path, killed = tmp_path / "r.mcap", tmp_path / "killed.mcap"
    env = RecordEpisodes(Sampler(SPACE, spaces.Discrete(2), length=9), path, image_format="png")
    states = play(env, 60)
    shutil.copy(path, killed)
    shutil.copy(f"{path}.journal", f"{killed}.journal")
    env.close()
    check(killed, states)
    with RecordEpisodes(Sampler(SPACE, spaces.Discrete(2), length=9), killed, mode="a") as env:
        states += play(env, 30)  # in the format that the file has
    check(killed, states)
    rewritten, damaged, repaired = (
        tmp_path / f"{name}.mcap" for name in ("rewritten", "damaged", "repaired")
    )
    with Recording(killed) as recording:
        rewrite_recording(recording, rewritten)
    check(rewritten, states)
    damaged.write_bytes(killed.read_bytes()[:-100])
    recover_recording(damaged, repaired)
    check(repaired, states)


def test_a_file_without_steps_keeps_its_version(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    writer.RecordingWriter(path, RecordOptions(), keep_empty=True).close()
    with pytest.raises(RecordingError, match="begun in format version 1, holds no step"):
        RecordEpisodes(Sampler(SPACE, spaces.Discrete(2), length=9), path, mode="a", image_format="png")
    with RecordEpisodes(Sampler(SPACE, spaces.Discrete(2), length=9), path, mode="a") as env:
        play(env, 3)
    with Recording(path) as recording:
        assert recording.metadata["format_version"] == "1"


def test_rendered_frames_can_be_added(tmp_path: Path) -> None:
    path, target = tmp_path / "r.mcap", tmp_path / "seen.mcap"

    def make() -> gym.Env[Any, Any]:
        return gym.wrappers.AddRenderObservation(gym.make("CartPole-v1", render_mode="rgb_array"))

    with RecordEpisodes(make(), path, image_format="png", attachments={}) as env:
        states = play(env, 4)
    render(path, target, env=make())
    with Recording(target) as recording:
        assert recording.cameras == ("render",)
        assert np.array_equal(recording.read().states, np.array(states))
    assert verify_recording(target).ok


def test_sub_environments(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    inner = SyncVectorEnv([lambda: Sampler(SPACE, spaces.Discrete(2), length=50)] * 2)
    env = RecordVector(inner, path, image_format="png")
    states, _ = env.reset(seed=1)
    taken = []
    for _ in range(30):
        taken.append(states["seen"].copy())
        states = env.step(env.action_space.sample())[0]
    env.close()
    with Recording(path) as recording:
        for i in range(2):
            assert np.array_equal(recording.episodes[i].states["seen"], np.array(taken)[:, i])


def test_another_format_is_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="image_format: expected 'raw' or 'png', found 'jpeg'"):
        RecordEpisodes(Sampler(SPACE, SPACE, length=3), tmp_path / "r.mcap", image_format="jpeg")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def encoded_rows(layout: StepLayout, pixels: Any) -> tuple[PngCodec, Any, Rows]:
    """A codec, rows of a journal, and what the codec makes of them."""
    (leaf,) = layout.images
    image = layout.image_messages["state"]
    rows = np.zeros(len(pixels), image.dtype)
    rows["fixed"] = np.frombuffer(image.body[8:], np.uint8)
    rows["#opcode"], rows["#length"] = 5, image.dtype.itemsize - 9
    rows["data"] = pixels
    codec = PngCodec(leaf, image)
    return codec, rows, codec.encode(even_rows(1, rows.tobytes(), rows))


def test_a_chunk_of_other_pictures_is_a_format_error() -> None:
    layout = StepLayout(spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Discrete(2))
    image = layout.image_messages["state"]
    codec, rows, encoded = encoded_rows(layout, np.random.default_rng(0).integers(0, 256, (3, 4, 5, 3)))
    data = bytes(encoded.data)
    found = np.frombuffer(codec.decode(data, 3), image.dtype)
    assert np.array_equal(found["data"], rows["data"])
    assert codec.encode(encoded) is encoded
    with pytest.raises(FormatError, match="expected 2 images, found more"):
        codec.decode(data, 2)
    with pytest.raises(FormatError, match="expected 4 images, found 3"):
        codec.decode(data, 4)
    with pytest.raises(FormatError, match="at most"):
        codec.decode(data, 1 << 40)
    other = StepLayout(spaces.Box(0, 255, (5, 4, 3), np.uint8), spaces.Discrete(2))
    with pytest.raises(FormatError, match="expected a PNG of"):
        PngCodec(other.images[0], other.image_messages["state"]).decode(data, 3)
    for at in range(0, len(data), 3):
        broken = bytearray(data)
        broken[at] ^= 0x41
        try:
            pixels = np.frombuffer(codec.decode(bytes(broken), 3), image.dtype)
        except FormatError:
            continue
        assert len(pixels) == 3


def test_a_chunk_of_other_stacks_is_a_format_error() -> None:
    layout = StepLayout(spaces.Box(0, 255, (3, 4, 5), np.uint8), spaces.Discrete(2), stacks=["state"])
    frames = np.random.default_rng(0).integers(0, 256, (8, 4, 5))
    codec, rows, encoded = encoded_rows(layout, [frames[i : i + 3] for i in range(6)])
    data = bytes(encoded.data)
    found = np.frombuffer(codec.decode(data, 6), rows.dtype)
    assert np.array_equal(found["data"], rows["data"])
    assert codec.encode(encoded) is encoded
    first, second, third = (int(at) for at in encoded.offsets[:3])
    with pytest.raises(FormatError, match="expected 3 frames in the first picture, found 1"):
        codec.decode(data[second:], 5)
    with pytest.raises(FormatError, match="expected 7 images, found 6"):
        codec.decode(data, 7)
    for height in (3, 7, 16):  # no frame, and more than there are
        _, _, wrong = encoded_rows(
            StepLayout(spaces.Box(0, 255, (height, 5, 1), np.uint8), spaces.Discrete(2)),
            np.zeros((1, height, 5, 1)),
        )
        with pytest.raises(FormatError, match=f"expected a PNG of L, 5 x 1 to 3 times 4 .* 5 x {height}$"):
            codec.decode(data[first:second] + bytes(wrong.data) + data[third:], 6)
    for at in range(0, len(data), 3):
        broken = bytearray(data)
        broken[at] ^= 0x41
        try:
            found = np.frombuffer(codec.decode(bytes(broken), 6), rows.dtype)
        except FormatError:
            continue
        assert len(found) == 6


def png_of(depth: int, kind: int, size: tuple[int, int], row: bytes) -> bytes:
    """A PNG of `depth` bits a channel; `kind` is 0 for grey, 2 for RGB, 6 for RGBA. All rows are the same."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        )

    head = struct.pack(">IIBBBBB", *size, depth, kind, 0, 0, 0)
    pixels = zlib.compress((b"\0" + row) * size[1])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("kind", "channels", "depth"), [(0, 1, 2), (0, 1, 4), (0, 1, 16), (2, 3, 16), (6, 4, 16)]
)
def test_a_picture_of_another_depth_is_refused(kind: int, channels: int, depth: int) -> None:
    """Pillow gives 8 bits of each: those that are lost must not be lost in silence."""
    shape = 2, 4, channels
    good = png_of(8, kind, (4, 2), bytes(4 * channels))
    assert np.array_equal(decode_pixels(good, shape), np.zeros(shape, np.uint8))
    other = png_of(depth, kind, (4, 2), bytes(4 * channels * depth // 8))
    with pytest.raises(FormatError, match="^expected a PNG of"):
        decode_pixels(other, shape)


def test_a_stamp_comes_back_whatever_it_says() -> None:
    layout = StepLayout(spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Discrete(2))
    codec, rows, _ = encoded_rows(layout, np.zeros((2, 4, 5, 3), np.uint8))
    rows["sec"], rows["nanosec"] = (1 << 31) - 1, (1 << 32) - 1  # more seconds together than 31 bits hold
    encoded = codec.encode(even_rows(1, rows.tobytes(), rows))
    found = np.frombuffer(codec.decode(bytes(encoded.data), 2), rows.dtype)
    for name in ("sec", "nanosec", "data"):
        assert np.array_equal(found[name], rows[name])


class Seen(gym.ObservationWrapper[Any, Any, Any]):
    """An image beside a stack."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        picture = spaces.Box(0, 255, (6, 5, 3), np.uint8)
        self.observation_space = spaces.Dict({"last": env.observation_space, "seen": picture})

    def observation(self, observation: Any) -> Any:
        return {"last": observation, "seen": np.repeat(observation[-1][:6, :5, None], 3, axis=2)}


def beside(path: Path, **options: Any) -> RecordEpisodes:
    space = spaces.Box(0, 255, (8, 7), np.uint8)
    return RecordEpisodes(
        Seen(FrameStackObservation(Sampler(space, spaces.Discrete(2), length=9), 4)),
        path,
        attachments={},
        **options,
    )


def formats(path: Path) -> dict[str, str]:
    with Recording(path) as recording:
        channels = recording._contents.channels.values()
        return {c.metadata["leaf"]: c.metadata.get("codec", "raw") for c in channels if "leaf" in c.metadata}


def test_a_leaf_keeps_its_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Earlier versions left stacks as they are; such recordings go on, and none is made of two formats."""
    path, register = tmp_path / "old.mcap", writer.register_channels
    with monkeypatch.context() as patch:
        patch.setattr(writer, "register_channels", lambda *given: register(*given[:-1], {"state_seen"}))
        with beside(path, image_format="png") as env:
            states = play(env, 40)
    old = {"state_last": "raw", "state_seen": "png"}
    assert formats(path) == old
    for form in ("png", "raw"):
        with beside(path, mode="a", image_format=form) as env:
            states += play(env, 30)
    with beside(tmp_path / "new.mcap", image_format="png") as env:
        more = play(env, 20)
    assert formats(tmp_path / "new.mcap") == {"state_last": "png", "state_seen": "png"}
    rewritten, repaired, merged = (tmp_path / f"{name}.mcap" for name in ("rewritten", "repaired", "merged"))
    with Recording(path) as recording:
        rewrite_recording(recording, rewritten)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(path.read_bytes()[:-100])
    recover_recording(damaged, repaired)
    merge_recordings([path, tmp_path / "new.mcap"], merged)
    for one in (path, rewritten, repaired, merged):
        assert formats(one) == old
        expected = states + more if one is merged else states
        with Recording(one) as recording:
            found = recording.read().states
            for key in ("last", "seen"):
                assert np.array_equal(found[key], np.array([state[key] for state in expected]))
        assert verify_recording(one).ok
