"""Stacks of frames: each frame is stored once, and every stack comes back exactly, whatever the environment does."""

from __future__ import annotations

import io
import shutil
from collections import deque
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation, TransformObservation
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image

from tupli_mcap import (
    FormatError,
    RecordEpisodes,
    Recording,
    TupliDataset,
    jsonvalue,
    open as open_recordings,
)
from tupli_mcap.arrays import Array
from tupli_mcap.dataset import open_columns
from tupli_mcap.journal.committed import even_rows
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.images.codecs import StackCodec
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.edit.merge import merge_recordings
from tupli_mcap.recording.edit.repair.recover import recover_recording
from tupli_mcap.recording.edit.rewrite import rewrite_recording
from tupli_mcap.vector import RecordEpisodes as RecordVector

H, W = 30, 20


class Screen(gym.Env[Any, Any]):
    """Noise of `shape`, episodes of 23 steps."""

    def __init__(self, shape: tuple[int, ...] = (H, W), *, as_dict: bool = False) -> None:
        picture = spaces.Box(0, 255, shape, np.uint8)
        self.observation_space = (
            spaces.Dict({"see": picture, "x": spaces.Box(-1, 1, (2,))}) if as_dict else picture
        )
        self.action_space = spaces.Discrete(3)
        self._random = np.random.default_rng(3)

    def _observe(self) -> Any:
        def picture(space: spaces.Box) -> Array:
            return self._random.integers(0, 256, space.shape).astype(np.uint8)

        if isinstance(self.observation_space, spaces.Dict):
            return {"see": picture(self.observation_space["see"]), "x": np.zeros(2, np.float32)}  # type: ignore[arg-type]
        return picture(self.observation_space)  # type: ignore[arg-type]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._t = 0
        return self._observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._t += 1
        return self._observe(), 1.0, self._t == 23, False, {}


def frames_last(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """As TensorFlow wants frames: along the last axis."""

    def move(value: Any) -> Any:
        return {**value, "see": move(value["see"])} if isinstance(value, dict) else np.moveaxis(value, 0, -1)

    space: Any = env.observation_space
    if isinstance(space, spaces.Dict):
        moved: Any = spaces.Dict(
            {**space.spaces, "see": spaces.Box(0, 255, shape_of(space["see"]), np.uint8)}
        )
    else:
        moved = spaces.Box(0, 255, shape_of(space), np.uint8)
    return TransformObservation(env, move, moved)


def shape_of(space: Any) -> tuple[int, ...]:
    """That of a stack of frames, with the frames last."""
    return (*space.shape[1:], space.shape[0])


def frames_first(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return env


BOTH = pytest.mark.parametrize("placed", [frames_first, frames_last])
FORMATS = pytest.mark.parametrize("form", ["raw", "png"])


def named(name: str, placed: Any) -> list[Any]:
    """What the layout says of one stack."""
    return [[name, "last"]] if placed is frames_last else [name]


class Odd(gym.Wrapper[Any, Any, Any, Any]):
    """Stacks that are none: now and then of other frames, skipped, repeated, or changed after they were seen."""

    def step(self, action: Any) -> Any:
        stack, *rest = self.env.step(action)
        kind = self.unwrapped._random.integers(6)  # type: ignore[attr-defined]
        if kind == 0:
            stack = stack[::-1].copy()
        elif kind == 1:
            stack[1, 0, 0] ^= 1
        elif kind == 2:
            stack[:] = stack[-1]
        elif kind == 3:
            self.env.step(action)
        return stack, *rest


def record(env: gym.Env[Any, Any], path: Path, steps: int, **options: Any) -> tuple[list[Any], list[Any]]:
    """Records; the states and the final states as the environment gave them."""
    states, finals = [], []
    with RecordEpisodes(env, path, **options) as recorder:
        recorder.action_space.seed(1)
        state, _ = recorder.reset(seed=1)
        for _ in range(steps):
            states.append(state)
            state, _, terminal, _, _ = recorder.step(recorder.action_space.sample())
            if terminal:
                finals.append(state)
                state, _ = recorder.reset()
    return states, finals


def pictures(path: Path) -> list[Array]:
    """The images as ROS tools see them: (height, width x channels)."""
    found: list[Array] = []
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, _, _, image in reader.iter_decoded_messages(topics=["/image/state"]):
            data = bytes(image.data)
            if schema is not None and schema.name == "sensor_msgs/msg/CompressedImage":
                assert image.format == "png"
                with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
                    found.append(np.asarray(picture).reshape(picture.height, -1))
            else:
                found.append(np.frombuffer(data, np.uint8).reshape(image.height, image.step))
    return found


@BOTH
@pytest.mark.parametrize("shape", [(H, W), (H, W, 3)])
def test_statistics_of_a_stack_are_those_of_its_channels(
    tmp_path: Path, placed: Any, shape: tuple[int, ...]
) -> None:
    states, _ = record(placed(FrameStackObservation(Screen(shape), 4)), tmp_path / "r.mcap", 30)
    found = open_recordings(tmp_path).stats(["states"])["state"]
    whole = np.stack(states)
    channel = (-2 if placed is frames_last else -1) % whole.ndim if len(shape) == 3 else None
    axes = tuple(axis for axis in range(whole.ndim) if axis != channel)
    for name, of in {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}.items():
        np.testing.assert_allclose(getattr(found, name), of(whole, axis=axes, keepdims=True)[0])
    assert (found.count == whole.size // found.count.size).all()


@pytest.mark.sampled(5, keep=["raw-frames_last-reset-shape0"])
@pytest.mark.parametrize("shape", [(H, W), (H, W, 1), (H, W, 3), (H, W, 4)])
@pytest.mark.parametrize("padding", ["reset", "zero"])
@BOTH
@FORMATS
def test_each_frame_is_stored_once(
    tmp_path: Path, shape: tuple[int, ...], padding: str, placed: Any, form: str
) -> None:
    path = tmp_path / "r.mcap"
    env = placed(FrameStackObservation(Screen(shape), 4, padding_type=padding))
    states, finals = record(env, path, 300, image_format=form)
    with Recording(path) as recording:
        assert recording.metadata["format_version"] == "2"
        assert np.array_equal(recording.read().states, np.array(states))
        assert np.array_equal(recording.episodes[3].final_state, finals[3])
        assert np.array_equal(recording.episodes[3][5:9].states, np.array(states[74:78]))
        assert recording.observation_space == env.observation_space
        layout = recording.layout
        assert layout is not None and layout.stacks == named("state", placed)
        image = recording._topics["/image/state"]
        assert recording._contents.channels[image].metadata.get("codec", "raw") == form
        chunks = len(recording._store.chunks(image))
        for threads in (1, 2):
            assert np.array_equal(recording.read(threads=threads).states, np.array(states))
    assert verify_recording(path).ok
    shown = pictures(path)
    frames = [len(picture) // H for picture in shown]
    episodes = 300 // 23 + 1
    assert sum(frames) <= 300 + 3 * (chunks + episodes) < 2 * 300
    assert min(frames) == 1 and max(frames) == 4
    for picture, state in zip(shown, states, strict=True):  # the newest frame is the lowest one
        newest = state[..., -1] if placed is frames_last else state[-1]
        assert np.array_equal(picture[-H:], newest.reshape(H, -1))


@BOTH
@FORMATS
def test_stacks_that_are_none_come_back_too(tmp_path: Path, placed: Any, form: str) -> None:
    path = tmp_path / "r.mcap"
    states, _ = record(placed(Odd(FrameStackObservation(Screen(), 5))), path, 400, image_format=form)
    with Recording(path) as recording:
        assert np.array_equal(recording.read().states, np.array(states))
    assert verify_recording(path).ok


@BOTH
@FORMATS
def test_leaves_of_a_dict(tmp_path: Path, placed: Any, form: str) -> None:
    path = tmp_path / "r.mcap"
    env = placed(FrameStackObservation(Screen(as_dict=True), 3))
    states, _ = record(env, path, 60, image_format=form)
    with Recording(path) as recording:
        found = recording.read().states
        assert recording.layout.stacks == named("state_see", placed)  # type: ignore[union-attr]
    assert np.array_equal(found["see"], np.array([state["see"] for state in states]))
    assert np.array_equal(found["x"], np.array([state["x"] for state in states]))


def test_without_the_wrapper_nothing_is_a_stack(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    states, _ = record(Screen((4, H, W)), path, 30)
    with Recording(path) as recording:
        assert recording.metadata["format_version"] == "1"
        assert recording.layout.stacks == []  # type: ignore[union-attr]
        assert np.array_equal(recording.read().states, np.array(states))


class Older(gym.ObservationWrapper[Any, Any, Any]):
    """A wrapper of somebody else's, which says how many frames it stacks as Gymnasium's did before 1.0."""

    def __init__(self, env: gym.Env[Any, Any], num_stack: int) -> None:
        super().__init__(env)
        self.num_stack = num_stack
        self.observation_space = spaces.Box(0, 255, (num_stack, H, W), np.uint8)
        self._frames = deque([np.zeros((H, W), np.uint8)] * num_stack, maxlen=num_stack)

    def observation(self, observation: Any) -> Any:
        self._frames.append(observation)
        return np.array(self._frames)


def test_other_processes_are_not_asked_what_they_stack(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordVector(AsyncVectorEnv([lambda: FrameStackObservation(Screen(), 4)] * 2), path) as env:
        env.reset(seed=1)
        states = env.step(env.action_space.sample())[0]
    with Recording(path) as recording:
        assert recording.layout is not None and recording.layout.stacks == []
        assert np.array_equal(recording.episodes[1].final_state, states[1])


@pytest.mark.sampled(4)
@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
@pytest.mark.parametrize("stacked", [FrameStackObservation, Older])
@BOTH
@FORMATS
def test_sub_environments(tmp_path: Path, kind: Any, stacked: Any, placed: Any, form: Any) -> None:
    path = tmp_path / "r.mcap"
    told = 4 if kind is AsyncVectorEnv else None  # which lets nobody look into its processes
    env = RecordVector(
        kind([lambda: placed(stacked(Screen(), 4))] * 3), path, image_format=form, stack_size=told
    )
    taken: list[list[Array]] = [[], [], []]
    states, _ = env.reset(seed=1)
    for t in range(200):
        for i in range(3):
            if t % 24 != 23:  # the step after an end is a reset
                taken[i].append(states[i].copy())
        states = env.step(env.action_space.sample())[0]
    env.close()
    with Recording(path) as recording:
        assert recording.layout is not None and recording.layout.stacks == named("state", placed)
        for i in range(3):
            mine = np.concatenate([e.states for e in recording.episodes if e.env == i])
            assert np.array_equal(mine, np.array(taken[i]))


def test_frames_that_ale_stacks(tmp_path: Path) -> None:
    ale = pytest.importorskip("ale_py.vector_env")
    path, states = tmp_path / "r.mcap", []
    with RecordVector(ale.AtariVectorEnv("breakout", 2), path) as env:
        state, _ = env.reset(seed=1)
        for _ in range(60):
            states.append(state[1].copy())
            state = env.step(env.action_space.sample())[0]
    with Recording(path) as recording:
        assert recording.layout is not None and recording.layout.stacks == ["state"]
        assert np.array_equal(recording.episodes[1].states, np.array(states))
        assert recording.episodes[1].env == 1


@BOTH
@FORMATS
def test_killed_appended_rewritten_and_repaired(tmp_path: Path, placed: Any, form: Any) -> None:
    path, killed = tmp_path / "r.mcap", tmp_path / "killed.mcap"
    env = RecordEpisodes(placed(FrameStackObservation(Screen(), 4)), path, chunk_size=4000, image_format=form)
    states = []
    state, _ = env.reset(seed=1)
    for t in range(100):
        states.append(state)
        state, _, terminal, _, _ = env.step(0)
        if terminal:
            state, _ = env.reset()
        if t == 60:
            shutil.copy(path, killed)
            shutil.copy(f"{path}.journal", f"{killed}.journal")
    env.close()
    torn, mended = tmp_path / "torn.mcap", tmp_path / "mended.mcap"
    shutil.copy(f"{killed}.journal", f"{torn}.journal")
    torn.write_bytes(killed.read_bytes()[:-100])
    recover_recording(torn, mended)
    for one in (killed, mended):
        with Recording(one) as recording:
            assert recording.layout.stacks == named("state", placed)  # type: ignore[union-attr]
            count = recording.n_steps
            assert count == 61 or (one is mended and count > 40)
            assert np.array_equal(recording.read().states, np.array(states[:61])[-count:])
            assert np.array_equal(recording.episodes[-1].final_state, states[61])
    more, _ = record(placed(FrameStackObservation(Screen(), 4)), killed, 50, mode="a")
    assert not Path(f"{killed}.journal").exists()
    expected = np.array(states[:61] + more)
    rewritten, repaired = tmp_path / "rewritten.mcap", tmp_path / "repaired.mcap"
    with Recording(killed) as recording:
        rewrite_recording(recording, rewritten)
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(killed.read_bytes()[:-100])
    recover_recording(damaged, repaired)
    for one in (killed, rewritten, repaired):
        with Recording(one) as recording:
            assert recording.metadata["format_version"] == "2"
            assert np.array_equal(recording.read().states, expected)
        assert verify_recording(one).ok
        assert sum(len(picture) // H for picture in pictures(one)) < 2.5 * len(expected)


@FORMATS
def test_stacks_of_two_recordings_are_merged(tmp_path: Path, form: str) -> None:
    paths, states = [tmp_path / f"{i}.mcap" for i in range(2)], []
    for path, other in zip(paths, (form, "raw"), strict=True):
        states += record(FrameStackObservation(Screen(), 4), path, 60, image_format=other, attachments={})[0]
    merge_recordings(paths, tmp_path / "all.mcap")
    with Recording(tmp_path / "all.mcap") as merged:
        assert np.array_equal(merged.read().states, np.array(states))
    assert verify_recording(tmp_path / "all.mcap").ok
    assert sum(len(picture) // H for picture in pictures(tmp_path / "all.mcap")) < 2 * len(states)


def test_a_chunk_that_holds_no_stacks_is_a_format_error() -> None:
    layout = StepLayout(spaces.Box(0, 255, (3, 4, 5), np.uint8), spaces.Discrete(2), stacks=["state"])
    (leaf,) = layout.images
    image = layout.image_messages["state"]
    codec = StackCodec(leaf, image)
    rows = np.zeros(6, image.dtype)
    rows["fixed"] = np.frombuffer(image.body[8:], np.uint8)
    rows["#opcode"], rows["#length"] = 5, image.dtype.itemsize - 9
    frames = np.random.default_rng(0).integers(0, 256, (8, 4, 5)).astype(np.uint8)
    rows["data"] = [frames[i : i + 3] for i in range(6)]
    raw = even_rows(1, rows.tobytes(), rows)
    encoded = codec.encode(raw)
    data = bytes(encoded.data)
    assert len(data) < len(raw.data) and bytes(codec.decode(data, 6)) == raw.data
    assert codec.encode(encoded) is encoded
    second = int(encoded.offsets[1])
    wrong = {
        "1 to 3 frames": data[second:],
        "found 6|found 5|in .* bytes": data + data[-(BODY + 60) :],
        "picture of 1 frames": data[: second + BODY + 28] + b"\x09" + data[second + BODY + 29 :],
    }
    for cut in range(0, len(data), 7):
        with pytest.raises(FormatError, match="expected|row"):
            codec.decode(data[:cut], 6)
    with pytest.raises(FormatError, match="row 0 expected 1 to 3 frames"):
        codec.decode(wrong["1 to 3 frames"], 5)
    for count in (5, 7):
        with pytest.raises(FormatError, match="expected"):
            codec.decode(data, count)
    with pytest.raises(FormatError, match="at most"):
        codec.decode(data, 1 << 40)
    for at in range(
        second, second + int(encoded.offsets[2]) - second
    ):  # any byte of a row: an error, or that byte
        broken = bytearray(data)
        broken[at] ^= 1
        try:
            found = np.frombuffer(codec.decode(bytes(broken), 6), image.dtype)
        except FormatError:
            continue
        assert len(found) == 6


def test_the_frames_of_a_last_axis_take_no_more_room(tmp_path: Path) -> None:
    sizes, chunks = {}, {}
    for placed in (frames_first, frames_last):
        path = tmp_path / f"{placed.__name__}.mcap"
        record(placed(FrameStackObservation(Screen(), 4)), path, 500, chunk_size=20_000)
        sizes[placed] = path.stat().st_size
        with Recording(path) as recording:
            chunks[placed] = len(recording._store.chunks(recording._topics["/image/state"]))
    record(Plain(frames_last(FrameStackObservation(Screen(), 4))), tmp_path / "whole.mcap", 500)
    assert chunks[frames_last] == chunks[frames_first] > 5
    assert sizes[frames_last] < 1.05 * sizes[frames_first]
    assert sizes[frames_last] < 0.5 * (tmp_path / "whole.mcap").stat().st_size


class Plain(gym.Env[Any, Any]):
    """Another environment, behind which no wrapper is found."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.observation_space, self.action_space = env.observation_space, env.action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self._env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        return self._env.step(action)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("shape", [(H, W), (H, W, 3)])
@pytest.mark.parametrize("frames", [3, 4, 7])
@BOTH
def test_everything_reads_as_if_it_was_stored_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...], frames: int, placed: Any
) -> None:
    stacked, whole = tmp_path / "stacked.mcap", tmp_path / "whole.mcap"
    chunk_size = 20_000 if frames == 4 else 1 << 20
    monkeypatch.setattr("tupli_mcap.recording.columns.gather._MANY_ROWS", 60)
    record(placed(FrameStackObservation(Screen(shape), frames)), stacked, 110, chunk_size=chunk_size)
    record(Plain(placed(FrameStackObservation(Screen(shape), frames))), whole, 110, chunk_size=chunk_size)
    with Recording(stacked) as one, Recording(whole) as other:
        assert one.layout.stacks == named("state", placed) and not other.layout.stacks
        assert same(one.read(threads=2).states, other.read().states)
        assert same(
            one.read(episodes=[3, 1], fields=["next_states"]).next_states,
            other.read(episodes=[3, 1], fields=["next_states"]).next_states,
        )
        shuffled = [4, 2, 0, 3, 1]
        assert same(one.read(episodes=shuffled).states, other.read(episodes=shuffled).states)
        assert same(one.final_states([2, 0]), other.final_states([2, 0]))
        for mine, theirs in zip(one.episodes, other.episodes, strict=True):
            assert same(mine.states, theirs.states)
            assert same(mine.final_state, theirs.final_state)
            assert same(mine[1:3].states, theirs[1:3].states)
            assert all(same(a.state, b.state) for a, b in zip(mine, theirs, strict=True))
    datasets = [TupliDataset.from_files(path) for path in (stacked, whole)]
    for cache_bytes in (0, 1 << 30):
        kept, other_kept = (dataset.with_cache(cache_bytes) for dataset in datasets)
        assert same(kept.windows(5)[:].states, other_kept.windows(5)[:].states)
        assert same(kept.transitions()[[50, 3]].next_states, other_kept.transitions()[[50, 3]].next_states)
    both = TupliDataset.from_files([stacked, whole])  # of two layouts
    assert same(both.observations, np.concatenate([dataset.observations for dataset in datasets]))
    assert same(both.steps.read(["states"], np.array([9, 119]))["states"], datasets[1].observations[[9, 9]])
    for number, dataset in enumerate([*datasets, both]):
        dataset.save_columns(tmp_path / f"columns {number}")
        steps = open_columns(tmp_path / f"columns {number}").steps
        rows = np.arange(len(steps))[::-1]
        for field in ("states", "next_states"):
            assert same(steps.read([field], rows)[field], dataset.steps.read([field], rows)[field])


def same(one: Any, other: Any) -> bool:
    """Equal in dtype, shape, order and every byte."""
    return (one.dtype, one.shape) == (other.dtype, other.shape) and (
        one.flags.c_contiguous,
        one.tobytes(),
    ) == (other.flags.c_contiguous, other.tobytes())


@pytest.mark.parametrize(
    ("shape", "size", "stacks"),
    [
        ((4, H, W), 4, ["state"]),
        ((H, W, 4), 4, [["state", "last"]]),
        ((H, W, 1, 4), 4, [["state", "last"]]),
        ((4, H, 4), 4, ["state"]),
        ((4, H, W, 4), 4, ["state"]),
        ((5, H, 3, 5), 5, []),  # the first axis is as long, and holds no pictures
        ((H, W, 2, 4), 4, []),
        ((H, W, 3), 4, []),
        ((H, W, 1), 1, []),
        ((H, 4), 4, []),
        ((4, 4, 257), 257, []),
    ],
)
def test_what_is_a_stack(tmp_path: Path, shape: tuple[int, ...], size: int, stacks: list[Any]) -> None:
    class Says(gym.Wrapper[Any, Any, Any, Any]):
        def __init__(self, env: gym.Env[Any, Any]) -> None:
            super().__init__(env)
            self.stack_size = size

    states, _ = record(Says(Screen(shape)), tmp_path / "r.mcap", 30)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.layout.stacks == stacks  # type: ignore[union-attr]
        assert np.array_equal(recording.read().states, np.array(states))


@pytest.mark.parametrize(
    "stacks",
    [
        "state",
        [5],
        [["state"]],
        [["state", "first"]],
        [["state", "last", "last"]],
        [["other", "last"]],
        [["state", "last"], "state"],
        [["state", "last"], ["state", "last"]],
        ["state"],
        [[np.zeros(2), "last"]],
    ],
)
def test_metadata_of_no_such_stack_are_a_format_error(stacks: Any) -> None:
    space = spaces.Box(0, 255, (300, 2, 3), np.uint8)
    metadata = StepLayout(space, spaces.Discrete(2), stacks=[["state", "last"]]).to_metadata()
    assert StepLayout.from_metadata(metadata).stacks == [["state", "last"]]
    with pytest.raises(FormatError):
        StepLayout.from_metadata({**metadata, "stacks": jsonvalue.dumps(stacks)})


@pytest.mark.parametrize("mode", gym.vector.AutoresetMode)
def test_final_states_of_sub_environments(tmp_path: Path, mode: Any) -> None:
    path = tmp_path / "r.mcap"
    finals: list[list[Array]] = [[], []]
    with RecordVector(
        SyncVectorEnv([lambda: frames_last(FrameStackObservation(Screen(), 4))] * 2, autoreset_mode=mode),
        path,
    ) as env:
        env.reset(seed=1)
        for _ in range(100):
            states, _, terminals, _, infos = env.step(env.action_space.sample())
            seen = infos.get("final_obs", states)
            for i in np.flatnonzero(terminals):
                finals[i].append(seen[i].copy())
            if mode is gym.vector.AutoresetMode.DISABLED and terminals.any():
                env.reset(options={"reset_mask": terminals})
    with Recording(path) as recording:
        for i in range(2):
            mine = [e.final_state for e in recording.episodes if e.env == i and e.end == "terminal"]
            assert len(mine) == len(finals[i]) > 3
            assert all(map(same, mine, map(np.ascontiguousarray, finals[i])))
