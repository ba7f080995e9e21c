#!/usr/bin/env python
"""Writes the golden recordings of `tests/golden`: one per feature, with what its environment returned beside it.

Run it when the format changes, in the commit that changes it: `python tools/make_golden.py [DIRECTORY]`.
Clock and UUID are fixed, so that two runs write the same bytes where nothing is compressed.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import hashlib
import itertools
import shutil
import tempfile
import uuid
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final
from unittest import mock

import gymnasium as gym
import numpy as np
import zstandard
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, TransformObservation

from tupli_mcap import EpisodeWriter, RecordEpisodes, jsonvalue, vector as recorded_vector
from tupli_mcap.environment import EnvironmentRecord
from tupli_mcap.recording import (
    EpisodeData,
    Recording,
    annotate_episodes,
    journal_path,
    rewrite_recording,
    write_recording,
)
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple

DIRECTORY = Path(__file__).parents[1] / "tests" / "golden"
COLUMNS = ("states", "actions", "rewards", "terminals", "timeouts", "infos")
START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000
BOOT = "00000000-0000-0000-0000-000000000000"  # none of any machine: what is not shown to be whole does not count
BOOT_ID = "tupli_mcap.recording.write.writer.boot_id"

PLAIN: Final[dict[str, Any]] = {"compression": "none", "attachments": {}, "capture": "none"}
"""The options of recordings whose bytes are the same everywhere."""

Log = dict[str, Any]
Observe = Callable[[int, int], Any]
POLE = spaces.Box(
    np.array([-4.8, -np.inf, -0.25, -np.inf], np.float32), np.array([4.8, np.inf, 0.25, np.inf], np.float32)
)


@contextlib.contextmanager
def made_up_world(number: int) -> Iterator[None]:
    """Fixed UUIDs and versions, and a clock that advances at each call."""
    clock = itertools.count(START_NS, STEP_NS)
    known = uuid.UUID(int=number)
    with (
        mock.patch("time.time_ns", side_effect=clock),
        mock.patch("uuid.uuid4", return_value=known),
        mock.patch("tupli_mcap.mcap.container.library", return_value="tupli-mcap 1"),
        mock.patch(BOOT_ID, return_value=BOOT),
        mock.patch("tupli_mcap.recording.contents.library", return_value="tupli-mcap 1"),
    ):
        yield


class Played(gym.Env[Any, Any]):
    """Episodes from a formula, and a log of them; `ends` has the length and the end of each."""

    def __init__(
        self,
        observation_space: gym.Space[Any],
        observe: Observe,
        ends: Sequence[tuple[int, str]],
        action_space: gym.Space[Any] | None = None,
        reward: Callable[[int], Any] = lambda t: t / 4 - 0.5,
        info: Callable[[int], dict[str, Any]] = lambda _: {},
    ) -> None:
        self.observation_space = observation_space
        self.action_space = spaces.Discrete(3, start=-1) if action_space is None else action_space
        self._observe, self._ends, self._reward, self._info = observe, ends, reward, info
        self.log: list[Log] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.log = [log for log in self.log if log["states"]]
        self._number, self._t = len(self.log), 0
        # a NumPy integer, as a vector environment hands it on
        info = {"episode": np.int64(self._number)} if self._number else {}
        self._state = self._observe(self._number, 0)
        self._begin(seed, options, info)
        return self._state, info

    def _begin(self, seed: int | None, options: Any, info: dict[str, Any]) -> None:
        log = {"seed": seed, "options": options, "reset_info": info, "end": "interrupted"}
        self.log.append({**log, **{name: [] for name in COLUMNS}})

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.log[-1]["end"] != "interrupted":  # another episode, without a reset
            self._begin(None, None, {})
        log, before = self.log[-1], self._state
        self._t += 1
        self._state = self._observe(self._number, self._t)
        length, end = self._ends[self._number % len(self._ends)]
        terminal, timeout = (self._t == length and end == name for name in ("terminal", "timeout"))
        reward, info = self._reward(self._t), self._info(self._t)
        for name, value in zip(COLUMNS, (before, action, reward, terminal, timeout, info), strict=True):
            log[name].append(copy.deepcopy(value))
        log["final_state"] = copy.deepcopy(self._state)
        log["end"] = "terminal" if terminal else "timeout" if timeout else "interrupted"
        return self._state, reward, terminal, timeout, info


class Painted(Played):
    """Played, with pictures of a formula."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def render(self) -> Any:
        return painting(self._number, self._t)


def painting(episode: int, t: int) -> Any:
    return np.arange(2 * 5 * 3, dtype=np.uint8).reshape(2, 5, 3) + np.uint8(40 * episode + 7 * t)


def stored_png(picture: Any, form: str = "png") -> bytes:
    """A PNG that is not compressed: what a compressor writes changes with its version."""
    height, width, channels = picture.shape
    lines = b"".join(b"\0" + row.tobytes() for row in picture)
    size = len(lines).to_bytes(2, "little")
    complement = bytes(255 - byte for byte in size)
    data = b"\x78\x01\x01" + size + complement + lines + zlib.adler32(lines).to_bytes(4, "big")
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big")
    head += b"\x08" + {1: b"\0", 3: b"\x02"}[channels] + bytes(3)  # 8 bits: grey, or RGB
    chunks = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    parts = (
        len(b).to_bytes(4, "big") + name + b + zlib.crc32(name + b).to_bytes(4, "big") for name, b in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


class Score(EpisodeMetadataCallback):
    """The return of the episode, and values that JSON cannot hold."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.total = 0.0

    def __call__(self, rl_tuple: RLTuple) -> dict[str, Any]:
        self.total += rl_tuple.reward
        return {"score": self.total, "good": self.total > 0, "odd": [float("nan"), "ä", None]}


def expected(env: Played, number: int = 0, *, infos: Callable[[Log], Any] = lambda _: None) -> list[Log]:
    """The episodes an environment played, as a recording should give them back."""
    episodes = [{**log, "env": number, "metadata": {}} for log in env.log if log["states"]]
    for episode in episodes:
        episode["return"] = float(sum(np.sum(reward) for reward in episode["rewards"]))
        episode["infos"] = infos(episode)
    return episodes


def roll(
    recorder: gym.Env[Any, Any], env: Played, lengths: Sequence[int], actions: Callable[[int], Any]
) -> None:
    """Resets and steps; a length below the episode's own leaves it interrupted."""
    for k, length in enumerate(lengths):
        recorder.reset(seed=[7, None, 2**70][k % 3], options={"level": (k, "hard")} if k == 1 else None)
        for t in range(length):
            recorder.step(actions(t))


def action(t: int) -> Any:
    return np.int64(t % 3 - 1)


def pole(episode: int, t: int) -> Any:
    return np.array([t / 8, -t / 4, episode, 0.0 if t else -0.0], np.float32)


# ---- one function a feature: writes `path`, returns what is expected of it


def constant(path: Path, compression: str) -> list[Log]:
    env = Played(POLE, pole, [(3, "terminal"), (4, "timeout"), (9, "terminal")])
    record = EnvironmentRecord("Pole-v0", spec={"id": "Pole-v0"}, versions={"gymnasium": "1.0"})
    attachments = {
        "benchmark.json": ("application/json", record.to_json()),
        "note": ("text/plain", b"golden"),
    }
    with RecordEpisodes(
        env, path, compression=compression, metadata_callback=Score(), benchmark_id="b" * 64,
        attachments=attachments, capture="none", chunk_size=400,
    ) as recorder:  # fmt: skip
        roll(recorder, env, [3, 4, 2], action)
    episodes = expected(env)
    for episode in episodes:
        total = episode["return"]
        episode["metadata"] = {"score": total, "good": total > 0, "odd": [float("nan"), "ä", None]}
    return episodes


def stacked(path: Path, axis: int = 0, **options: Any) -> list[Log]:
    def observe(episode: int, t: int) -> Any:
        return np.arange(6, dtype=np.uint8).reshape(2, 3) + np.uint8(40 * episode + 7 * t)

    env = Played(spaces.Box(0, 255, (2, 3), np.uint8), observe, ENDS)
    window: gym.Env[Any, Any] = FrameStackObservation(env, 3)
    if axis:
        window = TransformObservation(
            window, lambda frames: np.moveaxis(frames, 0, axis), spaces.Box(0, 255, (2, 3, 3), np.uint8)
        )
    with RecordEpisodes(window, path, **PLAIN, chunk_size=400, **options) as recorder:
        roll(recorder, env, [3, 4, 2], action)
    episodes = expected(env)
    for episode in episodes:
        frames = [episode["states"][0]] * 2 + [*episode["states"], episode["final_state"]]
        windows = [np.stack(frames[i : i + 3], axis) for i in range(len(frames) - 2)]
        *episode["states"], episode["final_state"] = windows
    return episodes


def png_images(path: Path) -> list[Log]:
    env = Played(CAMERA, picture, ENDS)
    with (
        mock.patch("tupli_mcap.messages.images.codecs.encode_pixels", stored_png),
        RecordEpisodes(env, path, image_format="png", **PLAIN, chunk_size=400) as recorder,
    ):
        roll(recorder, env, [3, 4, 2], action)
    return expected(env)


def png_stacks(path: Path) -> list[Log]:
    with mock.patch("tupli_mcap.messages.images.codecs.encode_pixels", stored_png):
        return stacked(path, image_format="png")


def dict_with_images(path: Path) -> list[Log]:
    space = spaces.Dict(
        [
            ("camera", spaces.Box(0, 255, (4, 6, 3), np.uint8)),
            ("Depth Map", spaces.Box(0, 255, (3, 2, 1), np.uint8)),
            ("nested", spaces.Tuple((spaces.Box(-1, 1, (2,), np.float16), spaces.MultiBinary([2, 2])))),
            ("none", spaces.Box(0, 1, (0, 3))),
            ((1, "key"), spaces.Discrete(5, start=2)),
            ("1-key", spaces.Box(-10, 10, (), np.int16)),
        ]
    )

    def observe(episode: int, t: int) -> Any:
        return {
            "camera": np.arange(72, dtype=np.uint8).reshape(4, 6, 3) + np.uint8(10 * t + episode),
            "Depth Map": np.full((3, 2, 1), 20 * episode + t, np.uint8),
            "nested": (np.array([t / 8, np.nan], np.float16), np.array([[t % 2, 1], [0, 1]], np.int8)),
            "none": np.empty((0, 3), np.float32),
            (1, "key"): np.int64(2 + t % 5),
            "1-key": np.int16(-t),
        }

    actions = spaces.Tuple((spaces.Discrete(2), spaces.Box(-1, 1, (2, 2), np.float64)))
    env = Played(space, observe, [(3, "terminal"), (5, "timeout")], actions)
    with RecordEpisodes(env, path, **PLAIN, chunk_size=300) as recorder:
        roll(recorder, env, [3, 5, 2], lambda t: (np.int64(t % 2), np.full((2, 2), t / 3)))
    return expected(env)


def variable(path: Path) -> list[Log]:
    item = spaces.Dict([("where", spaces.Box(0, 1, (2,), np.float16)), ("name", spaces.Text(3))])
    pick = spaces.OneOf([spaces.Discrete(3), spaces.Text(4), spaces.Box(0, 1, (3,), np.float64)])
    space = spaces.Dict(  # pairs keep their order, which a dict would not
        [
            ("graph", spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3))),
            ("items", spaces.Sequence(item)),
            ("pick", pick),
            ("stack", spaces.Sequence(spaces.Box(0, 9, (2,), np.int32), stack=True)),
            ("text", spaces.Text(8, charset="ab\0\x1aä\ud800😀")),
            ("camera", spaces.Box(0, 255, (2, 3, 4), np.uint8)),
        ]
    )

    def observe(episode: int, t: int) -> Any:
        nodes = np.arange(2 * t, dtype=np.float32).reshape(t, 2) / 8
        full = (np.arange(t), np.arange(2 * t, dtype=np.int32).reshape(t, 2))
        edges, links = (
            full if t > 1 else (None, None) if t else (np.empty(0, np.int64), np.empty((0, 2), np.int32))
        )
        picks = [(np.int64(0), np.int64(2)), (np.int64(1), "ok"), (np.int64(2), np.array([t / 3, 0.0, 1.0]))]
        return {
            "graph": spaces.GraphInstance(nodes, edges, links),
            "items": tuple({"where": np.array([k / 4, t], np.float16), "name": "é" * k} for k in range(t)),
            "pick": picks[t % 3],
            "stack": np.full((t, 2), episode, np.int32),
            "text": ["", "a\0b", "\x1a0000", "ä\ud800😀"][t % 4],
            "camera": np.full((2, 3, 4), 16 * t + episode, np.uint8),
        }

    env = Played(space, observe, [(4, "terminal"), (3, "timeout")])
    with RecordEpisodes(env, path, **PLAIN, chunk_size=700) as recorder:
        roll(recorder, env, [4, 3, 2], action)
    return expected(env)


def every_dtype(path: Path) -> list[Log]:
    names = ["bool", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))]
    leaves = {name: spaces.Box(0, 1, (2,), np.dtype(name).type) for name in names}
    leaves |= {f"float{bits}": spaces.Box(-np.inf, np.inf, (3,), f"float{bits}") for bits in (16, 32, 64)}
    patterns = {2: "<u2", 4: "<u4", 8: "<u8"}

    def observe(episode: int, t: int) -> Any:
        values = {name: np.array([t % 2, 1], name) for name in names}
        for bits, payload in ((16, 0x7E01), (32, 0x7FC00123), (64, 0x7FF8000000000456)):
            raw = np.array([payload, 1 << (bits - 1), t], patterns[bits // 8])  # a NaN, -0.0, a subnormal
            values[f"float{bits}"] = raw.view(f"float{bits}")
        return {key: values[key] for key in leaves}

    env = Played(spaces.Dict(list(leaves.items())), observe, [(3, "timeout")])
    with RecordEpisodes(env, path, **PLAIN) as recorder:
        roll(recorder, env, [3, 1], action)
    return expected(env)


def widened(path: Path) -> list[Log]:
    """Values wider than declared, an array of rewards, an action given as Python numbers."""
    space = spaces.Tuple(
        (spaces.Box(-1, 1, (2,), np.float32), spaces.Sequence(spaces.Box(-1, 1, (), np.float32)))
    )
    env = Played(
        space,
        lambda episode, t: (np.array([t / 3, episode]), tuple(np.asarray(k / 3) for k in range(t))),
        [(3, "terminal")],
        reward=lambda t: np.array([t / 4, -1.0], np.float32),
    )
    reward_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    with RecordEpisodes(env, path, **PLAIN, reward_space=reward_space) as recorder:
        roll(recorder, env, [3], action)
    return expected(env)


def infos(path: Path) -> list[Log]:
    names = ["score", "Distance (m)", "missing"]

    def info(t: int) -> dict[str, Any]:
        found: dict[str, Any] = {"score": t / 4, "Distance (m)": 3, "unasked": 1}
        return {**found, "score": np.arange(t, dtype=np.int8), "missing": None} if t == 2 else found

    env = Played(POLE, pole, [(3, "terminal")], info=info)
    with RecordEpisodes(env, path, **PLAIN, record_info=names) as recorder:
        roll(recorder, env, [3, 2], action)
    return expected(
        env, infos=lambda log: [{k: v for k, v in one.items() if k in names} for one in log["infos"]]
    )


def every_info(path: Path) -> list[Log]:
    env = Played(
        POLE,
        pole,
        [(3, "timeout")],
        info=lambda t: {} if t == 1 else {"a": (t, {2.5: b"\0"}), "n": np.float32(np.nan)},
    )
    with RecordEpisodes(env, path, **PLAIN, record_info=True) as recorder:
        roll(recorder, env, [3], action)
    return expected(env, infos=lambda log: log["infos"])


def vector(
    path: Path,
    mode: gym.vector.AutoresetMode,
    space: gym.Space[Any] = POLE,
    observe: Observe = pole,
) -> list[Log]:
    envs = [Played(space, observe, [(2 + i, "terminal"), (3, "timeout")]) for i in range(3)]
    inner = gym.vector.SyncVectorEnv([lambda env=env: env for env in envs], autoreset_mode=mode)  # type: ignore[misc]
    with recorded_vector.RecordEpisodes(inner, path, **PLAIN) as recorder:
        recorder.reset(seed=11)
        for t in range(9):
            recorder.step(np.array([-1, 0, 1]) if t % 2 else np.array([1, 1, 1]))
    return [episode for i, env in enumerate(envs) for episode in expected(env, i)]


def appended(path: Path) -> list[Log]:
    env = Played(POLE, pole, [(3, "terminal"), (2, "timeout")])
    for mode, lengths in (("x", [3, 1]), ("a", [2, 2])):
        options: dict[str, Any] = {**PLAIN, "mode": mode}
        with RecordEpisodes(env, path, **options) as recorder:
            roll(recorder, env, lengths, action)
    return expected(env)


def continued(path: Path) -> list[Log]:
    """Stepped on after an end, without a reset: another episode, which starts at the final state."""
    env = Played(POLE, pole, [(2, "terminal"), (3, "timeout")])
    with RecordEpisodes(env, path, **PLAIN) as recorder:
        roll(recorder, env, [5, 3], action)
    return expected(env)


def rewritten(path: Path) -> list[Log]:
    """Episodes 0 and 2 of a recording, with another attachment."""
    with tempfile.TemporaryDirectory() as directory:
        whole = Path(directory, "whole.mcap")
        episodes = constant(whole, "none")
        with Recording(whole) as recording:
            extra = {"note": ("text/plain", b"rewritten")}
            rewrite_recording(recording, path, episodes=[0, 2], attachments=extra, compression="none")
    return [episodes[0], episodes[2]]


def described(path: Path) -> list[Log]:
    """A run with a name and settings, and two annotations."""
    env = Played(POLE, pole, [(3, "terminal"), (2, "timeout")])
    run: dict[str, Any] = {"name": "ppo-3", "metadata": {"lr": 0.001}, "tags": ["a"], "split": "train"}
    with RecordEpisodes(env, path, **PLAIN, **run) as recorder:
        roll(recorder, env, [3, 2], action)
    with mock.patch("getpass.getuser", return_value="ada"):
        annotate_episodes(path, {"success": True, "note": "first"}, [0])
        annotate_episodes(path, {"note": None})
    first, second = expected(env)
    return [{**first, "metadata": {"success": True}}, second]


def handmade(path: Path) -> list[Log]:
    """Historic data: no final state, seeds or infos."""
    env = Played(POLE, pole, [(3, "terminal")])
    roll(env, env, [3, 2], action)
    episodes = [{**episode, "seed": None, "options": None, "reset_info": {}} for episode in expected(env)]
    data = [EpisodeData(*(episode[name] for name in COLUMNS[:5]), metadata={"k": 1}) for episode in episodes]
    write_recording(path, data, observation_space=POLE, action_space=env.action_space, compression="none")
    return [
        {**e, "final_state": None, "metadata": {"k": 1}, "infos": [None] * len(e["states"])} for e in episodes
    ]


def large_seeds(path: Path) -> list[Log]:
    """Seeds beyond 64 bits, as NumPy draws them, and one within."""
    env = Played(POLE, pole, [(3, "terminal")])
    roll(env, env, [3, 2, 2], action)
    episodes = [
        {**episode, "seed": seed, "options": None, "reset_info": {}}
        for episode, seed in zip(expected(env), (2**127 - 1, 2**64, 3), strict=True)
    ]
    data = [
        EpisodeData(*(episode[name] for name in COLUMNS[:5]), seed=episode["seed"]) for episode in episodes
    ]
    write_recording(path, data, observation_space=POLE, action_space=env.action_space, compression="none")
    return [{**e, "final_state": None, "infos": [None] * len(e["states"])} for e in episodes]


def bundle(path: Path) -> list[Log]:
    """A recording that carries its environment, pickled, and an artifact."""
    env = Played(POLE, pole, [(3, "terminal")])
    artifact, code = b"time,price\n0,1.5\n", b"not a pickle; reading never finds out"
    record = EnvironmentRecord("Pole-v0", pickle=code, versions={"gymnasium": "1.0"})
    attachments = {
        "benchmark.json": ("application/json", record.to_json()),
        "env.cloudpickle": ("application/octet-stream", code),
        f"artifacts/{hashlib.sha256(artifact).hexdigest()}": ("application/octet-stream", artifact),
    }
    with RecordEpisodes(env, path, compression="none", attachments=attachments, capture="none") as recorder:
        roll(recorder, env, [3, 1], action)
    return expected(env)


def named(path: Path) -> list[Log]:
    """A recording that names its environment, and has nothing to rebuild it from."""
    env = Played(POLE, pole, [(3, "terminal")])
    record = EnvironmentRecord(
        "Pole-v0", classes=("poles:Limit", "poles:Pole"), versions={"gymnasium": "1.0"}
    )
    attachments = {"benchmark.json": ("application/json", record.to_json())}
    with RecordEpisodes(env, path, compression="none", attachments=attachments, capture="none") as recorder:
        roll(recorder, env, [3, 1], action)
    return expected(env)


def frames(path: Path) -> list[Log]:
    """A picture of every second state and of each final one; an episode that was cut short, and one appended."""
    env = Painted(POLE, pole, [(3, "terminal"), (4, "timeout"), (9, "terminal")])
    options: dict[str, Any] = {**PLAIN, "chunk_size": 300}
    with mock.patch("tupli_mcap.recording.write.recorders.frames.encode_picture", stored_png):
        for mode, lengths in (("x", [3, 4, 3]), ("a", [2])):
            with RecordEpisodes(env, path, frames=2, mode=mode, **options) as recorder:  # type: ignore[arg-type]
                roll(recorder, env, lengths, action)
    return expected(env)


def unfinished_frames(path: Path) -> list[Log]:
    with mock.patch("tupli_mcap.recording.write.recorders.frames.encode_picture", stored_png):
        return unfinished(path, Painted(POLE, pole, ENDS), frames=True)


def unfinished(path: Path, env: Played, **more: Any) -> list[Log]:
    """An unfinished recording: a file without a summary, and its journal."""
    with tempfile.TemporaryDirectory() as directory:
        live = Path(directory, path.name)
        options: dict[str, Any] = {**PLAIN, "chunk_size": 400}
        with RecordEpisodes(env, live, durability="step", **options, **more) as recorder:
            roll(recorder, env, [3, 4, 2], action)
            keep(live, path)
    return expected(env)


def keep(live: Path, path: Path) -> None:
    """Copies a recording as it is, and its journal."""
    shutil.copy(live, path)
    journal = journal_path(live).read_bytes()
    packed = zstandard.ZstdCompressor(level=19).compress(journal)  # most of it is zeros
    path.with_suffix(".mcap.journal.zst").write_bytes(packed)


class Silent(Played):
    """A reset gives no info, so that episodes are derived from rows."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        state, _ = super().reset(seed=seed, options=options)
        self.log[-1]["reset_info"] = {}
        return state, {}


def unfinished_holes(path: Path) -> list[Log]:
    """The files of a killed process, with final states in holes, and the chunks of the first steps in the file."""
    env = Silent(POLE, pole, ENDS)
    with tempfile.TemporaryDirectory() as directory, mock.patch(BOOT_ID, return_value=""):
        live = Path(directory, path.name)
        with RecordEpisodes(env, live, **PLAIN, chunk_size=400) as recorder:
            recorder.reset(seed=7)
            for length in (3, 4, 9, 3, 4, 2):
                for t in range(length):
                    recorder.step(action(t))
                if length > 2:
                    recorder.reset()
            keep(live, path)
    return expected(env)


def unfinished_streams(path: Path, space: gym.Space[Any], observe: Observe) -> list[Log]:
    """The files of a killed writer of two streams: the state after the last step is unknown."""
    env = Played(space, observe, ENDS)
    roll(env, env, [3, 4, 2], action)
    episodes = expected(env)
    with tempfile.TemporaryDirectory() as directory, mock.patch(BOOT_ID, return_value=""):
        live = Path(directory, path.name)
        options: dict[str, Any] = {"compression": "none", "chunk_size": 400, "capture": "none"}
        with EpisodeWriter(live, space, env.action_space, num_envs=2, **options) as writer:
            for k, episode in enumerate(episodes):
                writer.begin(seed=episode["seed"], options=episode["options"], metadata={"k": k}, env=k % 2)
                for step in zip(*(episode[name] for name in COLUMNS[:5]), strict=True):
                    writer.step(*step, env=k % 2)
                if k < 2:
                    writer.end(episode["final_state"], env=k % 2)
            keep(live, path)
    for k, episode in enumerate(episodes):
        told = {"reset_info": {}, "env": k % 2, "infos": [None] * len(episode["states"])}
        episode |= told | ({"metadata": {"k": k}} if k < 2 else {"final_state": None})
    return [episodes[0], episodes[2], episodes[1]]


def words(episode: int, t: int) -> str:
    return "w" * t + str(episode)


def picture(episode: int, t: int) -> Any:
    return {"camera": np.full((2, 4, 3), 16 * t + episode, np.uint8), "pole": pole(episode, t)}


CAMERA = spaces.Dict([("camera", spaces.Box(0, 255, (2, 4, 3), np.uint8)), ("pole", POLE)])
ENDS = [(3, "terminal"), (4, "timeout"), (9, "terminal")]
FEATURES: dict[str, Callable[[Path], list[Log]]] = {
    "constant_zstd": lambda path: constant(path, "zstd"),
    "constant_lz4": lambda path: constant(path, "lz4"),
    "constant_none": lambda path: constant(path, "none"),
    "dict_with_images": dict_with_images,
    "variable": variable,
    "every_dtype": every_dtype,
    "widened": widened,
    "infos": infos,
    "every_info": every_info,
    "vector_next_step": lambda path: vector(path, gym.vector.AutoresetMode.NEXT_STEP),
    "vector_same_step": lambda path: vector(path, gym.vector.AutoresetMode.SAME_STEP),
    "vector_variable": lambda path: vector(path, gym.vector.AutoresetMode.NEXT_STEP, spaces.Text(20), words),
    "appended": appended,
    "continued": continued,
    "rewritten": rewritten,
    "handmade": handmade,
    "unfinished": lambda path: unfinished(path, Played(POLE, pole, ENDS)),
    "unfinished_variable": lambda path: unfinished(path, Played(spaces.Text(20), words, ENDS)),
    "bundle": bundle,
    "unfinished_images": lambda path: unfinished(path, Played(CAMERA, picture, ENDS)),
    "frames": frames,
    "unfinished_frames": unfinished_frames,
    "stacked": stacked,
    "png_images": png_images,
    "unfinished_holes": unfinished_holes,
    "stacked_last": lambda path: stacked(path, -1),
    "png_stacks": png_stacks,
    "named": named,
    "unfinished_streams": lambda path: unfinished_streams(path, POLE, pole),
    "unfinished_streams_variable": lambda path: unfinished_streams(path, spaces.Text(20), words),
    "described": described,
    "large_seeds": large_seeds,
}


def make(name: str, directory: Path) -> None:
    """Writes the recording of a feature, and its episodes as exact JSON: by sub-environment, in order."""
    path = directory / f"{name}.mcap"
    with made_up_world(1 + list(FEATURES).index(name)):
        episodes = FEATURES[name](path)
    lines = ",\n".join(jsonvalue.dumps(episode) for episode in episodes)
    path.with_suffix(".json").write_text(f"[{lines}]\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", nargs="?", type=Path, default=DIRECTORY)
    directory = parser.parse_args().directory
    directory.mkdir(parents=True, exist_ok=True)
    for old in directory.iterdir():
        if old.is_file():  # those below are of earlier writers, and stay
            old.unlink()
    for name in FEATURES:
        make(name, directory)
    size = sum(path.stat().st_size for path in directory.iterdir() if path.is_file())
    print(f"{len(FEATURES)} recordings, {size / 1024:.0f} KiB in {directory}")


if __name__ == "__main__":
    main()
