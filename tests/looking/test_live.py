"""Rollouts shown while they are recorded: by real viewers, and by viewers that are missing, stopped or killed."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import fcntl
import gc
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler
from gymnasium import spaces
from mcap_ros2._dynamic import generate_dynamic
from receiving import answers, receiver, url
from typer.testing import CliRunner
from waiting import free_port, wait_for

from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.cli.app import app
from tupli_mcap.errors import MissingExtraError, RecordingError
from tupli_mcap.journal.file import journal_path
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes
from tupli_mcap.viewer.live import session
from tupli_mcap.viewer.live.follow import Follower, follow
from tupli_mcap.viewer.live.new_rows import NewSteps
from tupli_mcap.viewer.live.rerun_panels import LivePanels
from tupli_mcap.viewer.live.target import parse_target

MIXED = spaces.Dict(
    {
        "cam": spaces.Box(0, 255, (6, 5, 3), np.uint8),
        "x": spaces.Box(-1, 1, (2,), np.float64),
        "mode": spaces.Discrete(3),
    }
)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may need longer for the rest of a view than closing waits for it."""
    monkeypatch.setattr(session, "_FAREWELL", 120.0)


def roll(env: gym.Env[Any, Any], steps: int, pause: float = 0.0, seed: int = 1) -> None:
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(steps):
        *_, terminal, timeout, _ = env.step(env.action_space.sample())
        if terminal or timeout:
            env.reset()
        if pause:
            time.sleep(pause)


def roll_until(env: Any, condition: Callable[[], bool]) -> None:
    env.reset(seed=1)
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        if np.all(np.logical_or(*env.step(env.action_space.sample())[2:4])):
            env.reset()
        time.sleep(0.01)


def roll_until_shown(env: Any, out: Path) -> None:
    """Until a receiver is sent steps; what of them share an axis is decided by a hundred."""
    roll_until(env, lambda: out.exists() and out.stat().st_size > 20_000)


def said(capfd: pytest.CaptureFixture[str], so_far: list[str]) -> list[str]:
    """What the process that shows a rollout has told the user up to now."""
    so_far += [line for line in capfd.readouterr().err.splitlines() if line.startswith("tupli-mcap:")]
    return so_far


def assert_exact(path: Path, steps: int) -> None:
    """The recording is the one that a rollout without a viewer gives."""
    plain = path.with_name(f"plain-{path.name}")
    with RecordEpisodes(gym.make("CartPole-v1"), plain) as env:
        roll(env, steps)
    with Recording(path) as found, Recording(plain) as wanted:
        assert found.complete
        for one, other in zip(found.episodes, wanted.episodes, strict=True):
            assert one.states.tobytes() == other.states.tobytes()
            assert (one.actions.tolist(), one.seed, one.end) == (
                other.actions.tolist(),
                other.seed,
                other.end,
            )


def shown(path: Path, entity: str, component: str = "Scalars:scalars") -> tuple[Any, Any]:
    """(rows, values) that a receiver was sent."""
    from rerun.chunk import RrdReader

    rows: list[int] = []
    values: list[Any] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is streamed has no footer
        reader = RrdReader(path)
    for chunk in reader.stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            rows += batch.column("step").to_pylist()
            values += batch.column(component).to_pylist()
    return np.array(rows), values


def last_card(path: Path) -> str:
    """What a receiver was told last of the rollout as a whole."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == "/card"]
    batches = sorted(
        (c.to_record_batch() for c in chunks), key=lambda b: b.column("rerun.controls.RowId")[0].as_py()
    )
    return str(batches[-1].column("TextDocument:text").to_pylist()[-1][0])


# ---- what is looked at

ENDED = ["episode", "env", "first_row", "length", "return"]
EPISODES = ("/episode_start", "/episode_end", "/final_state")


class Looker:
    """Follows what a recorder records from now on, where there is anything."""

    def __init__(self, env: Any) -> None:
        writer = env._writer
        self._place = writer.path, writer.place.uuid, writer.container.position
        self.follower: Follower | None = None

    def look(self) -> tuple[list[NewSteps], list[Any]]:
        """New steps, and ends as lists of what they say."""
        is_over = not is_locked(self._place[0])
        self.follower = self.follower or follow(*self._place)
        if self.follower is None:
            return [], []
        self.follower.is_over = is_over
        steps, ended = self.follower.look()
        return steps, ended[ENDED].tolist()

    def events(self) -> list[tuple[str, int, bytes]]:
        """New messages, with their topics."""
        self.look()
        assert self.follower is not None
        channels = self.follower.channels
        return [(channels[c].topic, time_ns, message) for c, time_ns, message in self.follower.events(10**6)]


def followed(path: Path, inner: gym.Env[Any, Any], num_envs: int, **options: Any) -> tuple[Any, Looker]:
    """A recorder and who follows it; of sub-environments, if `num_envs` is not 0."""
    if num_envs:
        vector = gym.vector.SyncVectorEnv([lambda: copy.deepcopy(inner)] * num_envs)
        env: Any = RecordVectorEpisodes(vector, path, **options)
    else:
        env = RecordEpisodes(inner, path, **options)
    return env, Looker(env)


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    "space", [MIXED, spaces.Text(8), spaces.Box(-1, 1, (3,))], ids=["mixed", "text", "box"]
)
@pytest.mark.parametrize("num_envs", [0, 3], ids=["single", "vector"])
@pytest.mark.parametrize(
    ("told", "chunk_size"), [(False, 4000), (True, 4000), (True, 2**18)], ids=["at-once", "chunks", "told"]
)
def test_a_follower_sees_what_is_recorded(
    space: gym.Space[Any], num_envs: int, told: bool, chunk_size: int, tmp_path: Path
) -> None:
    """At any moment: a thread of its own looks, as fast as it can."""
    path, done = tmp_path / "r.mcap", threading.Event()
    seen: list[tuple[NewSteps, dict[int, Any]]] = []
    ended: list[Any] = []
    env, looker = followed(path, Sampler(space, space), num_envs, chunk_size=chunk_size)
    env._recorder.derives_episodes = told

    def watch() -> None:
        last = False
        while not last:
            last = done.is_set()
            found, ends = looker.look()
            ended.extend(ends)
            for new in found:
                images = {}
                if looker.follower and looker.follower.layout.images:
                    images = looker.follower.images(0, new.env, range(new.first, new.first + len(new)))
                seen.append((new, images))
            time.sleep(0.0005)  # else it keeps the interpreter for 5 ms after each look

    thread = threading.Thread(target=watch)
    thread.start()
    env.reset(seed=1)
    try:
        for i in range(1000):
            if i % 20 == 0:
                time.sleep(0.005)  # or the other thread may see little of it
            *_, terminal, timeout, _ = env.step(env.action_space.sample())
            if not num_envs and (terminal or timeout):
                env.reset()
        until_closing = len(ended)
    finally:
        env.close()
        done.set()
        thread.join()
    with Recording(path) as recording:
        layout = recording.layout
        firsts = recording.index["first_row"].tolist()
        episodes = list(zip(recording.episodes, firsts, strict=True))
        assert sorted(ended) == recording.index[ENDED].tolist()
        assert until_closing > 10
        rows = {(e.env, first + i): (e, i) for e, first in episodes for i in range(len(e))}
        assert {new.env for new, _ in seen} == set(range(num_envs or 1))
        assert sum(len(new) for new, _ in seen if new.env == 0) > 100
        assert sum(len(images) for _, images in seen) > 5 or space is not MIXED
        for new, images in seen:
            for i, (number, at) in enumerate(zip(new.facts.episode, new.facts.step, strict=True)):
                episode, step = rows[new.env, new.first + i]
                assert (number, at) == (episode.number, step)
                if new.rows is not None:
                    for leaf in layout.step_leaves[:-1]:
                        column = episode.states if leaf in layout.state else episode.actions
                        assert (
                            new.rows[leaf.name][i].tobytes() == np.asarray(leaf.get(column)[step]).tobytes()
                        )
            for row, record in images.items():
                episode, step = rows[new.env, row]
                assert record["data"].tobytes() == episode.states["cam"][step].tobytes()


@pytest.mark.parametrize("ending", ["closed", "killed"])
def test_earlier_sessions_are_not_shown(ending: str, tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    env = RecordEpisodes(gym.make("CartPole-v1"), path)
    roll(env, 50)
    if ending == "closed":
        env.close()
    else:
        shutil.copy(journal_path(path), tmp_path / "r.journal")
        shutil.copy(path, tmp_path / "left.mcap")
        env.close()
        (tmp_path / "left.mcap").replace(path)
        (tmp_path / "r.journal").replace(journal_path(path))
    with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
        looker = Looker(env)
        assert looker.look() == ([], [])
        env.reset(seed=3)
        for _ in range(5):
            env.step(0)
        ((new,), ended) = looker.look()
    assert (new.first, new.facts.step.tolist(), ended) == (50, [0, 1, 2, 3, 4], [])


def test_a_file_that_will_be_replaced_is_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        roll(env, 50)
    with RecordEpisodes(gym.make("CartPole-v1"), path, mode="w") as env:
        looker = Looker(env)
        env.reset(seed=3)
        assert looker.look() == ([], [])
        env.step(0)
        ((new,), _) = looker.look()
    assert (new.first, len(new)) == (0, 1)


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.parametrize("num_envs", [0, 2])
@pytest.mark.parametrize("chunk_size", [200, 2**18])
def test_an_end_is_seen_before_anything_follows_it(
    every: int, num_envs: int, chunk_size: int, tmp_path: Path
) -> None:
    """Not only at the next reset: until then a policy may be trained, or an environment take its time."""
    path, space = tmp_path / "r.mcap", spaces.Box(-1, 1, (3,))
    env, looker = followed(path, Sampler(space, space, 3), num_envs, chunk_size=chunk_size)
    found, ended, over = [], 0, False
    env.reset(seed=1)
    for i in range(100):
        if over and not num_envs:
            env.reset(seed=2 if i > 50 and i % 2 else None)
        *_, terminal, timeout, _ = env.step(env.action_space.sample())
        over = bool(np.any(terminal | timeout))
        ended += over * (num_envs or 1)
        if (i + 1) % every == 0:
            for _ in range(2):  # at the first look the recorder may be about to write it
                found += looker.look()[1]
            assert len(found) == ended
            assert looker.follower is not None
            assert looker.follower.episodes == ended
    env.close()
    found += looker.look()[1]
    with Recording(path) as recording:
        assert sorted(found) == recording.index[ENDED].tolist()


@pytest.mark.parametrize("num_envs", [0, 2])
@pytest.mark.parametrize("options", [{}, {"chunk_size": 200}, {"record_info": True}], ids=str)
def test_every_start_and_end_is_seen_once(num_envs: int, options: Any, tmp_path: Path) -> None:
    path, space = tmp_path / "r.mcap", spaces.Box(-1, 1, (3,))
    env, looker = followed(path, Sampler(space, space, 3), num_envs, **options)
    found: list[tuple[str, int, bytes]] = []
    env.reset(seed=1)
    for i in range(200):
        *_, terminal, timeout, _ = env.step(env.action_space.sample())
        if not num_envs and (terminal or timeout):
            env.reset(seed=3 if i % 4 == 0 else None)
        if i % 20 in (10, 11):
            found += looker.events()
        if i % 20 in (5, 15):
            env.flush()
        if i % 50 == 40:  # the first one's start is taken back
            env.reset(seed=4)
            found += looker.events()
            env.reset(seed=5)
    env.close()
    found += looker.events()
    wanted = in_file(path)
    for topic in EPISODES:
        assert [one for name, _, one in found if name == topic] == [
            one for name, _, one in wanted if name == topic
        ]
    assert all(key in wanted for key in found if key[0] == "/episode_start")


def test_infos_do_not_come_between_ends_and_who_wants_the_newest(tmp_path: Path) -> None:
    env, looker = followed(tmp_path / "r.mcap", Told(7), 0, record_info=True)
    with env:
        roll(env, 700)
        events = looker.events()
    assert sum(topic == "/info" for topic, _, _ in events) == 700
    assert {topic for topic, _, _ in events[-200:]} == set(EPISODES)


# ---- Rerun


def test_the_overview_counts_all_episodes(tmp_path: Path) -> None:
    import rerun as rr

    space = spaces.Box(-1, 1, (3,))
    with RecordEpisodes(Sampler(space, space, 1), tmp_path / "r.mcap") as env:
        roll(env, 6_000)  # more than are looked at together
        follower = follow(env.path, env._writer.place.uuid, 0)
        assert follower is not None
        panels = LivePanels("many")
        assert panels.decide(follower)
        stream = rr.RecordingStream("many")
        stream.save(tmp_path / "r.rrd")
        panels.declare(stream)
        panels.send(stream, follower)
        stream.flush()
    assert "6,000 episodes" in last_card(tmp_path / "r.rrd")


def test_rerun_is_sent_what_is_recorded(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    with (
        receiver(port, tmp_path / "r.rrd"),
        RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port)) as env,
    ):
        roll(env, 300, 0.002)
    assert_exact(path, 300)
    rows, values = shown(tmp_path / "r.rrd", "/state")
    with Recording(path) as recording:
        states = recording.read().states
        lengths = recording.index["length"]
    breaks = np.isnan(values).all(axis=1)
    assert len(rows[~breaks]) == 300
    assert np.array_equal(np.array(values, np.float32)[~breaks], states[rows[~breaks]])
    assert rows[breaks].tolist() == np.cumsum(lengths)[:-1].tolist()  # lines break where an episode begins
    assert last_card(tmp_path / "r.rrd").split("\n")[2] == "recorded"  # it is over, and stays in the window


@pytest.mark.parametrize(
    ("returns", "told"),
    [
        ([2.0, np.nan, 4.0], "3 episodes; the last 3: mean return 3 (NaN in 1 episode, left out)"),
        ([np.nan, np.nan], "2 episodes; the last 2: return NaN in every episode"),
    ],
)
def test_the_mean_return_leaves_nan_out(returns: list[float], told: str, tmp_path: Path) -> None:
    port, rewards = free_port(), iter(returns)
    env = gym.wrappers.TransformReward(gym.make("CartPole-v1"), lambda _: next(rewards))
    with (
        receiver(port, tmp_path / "r.rrd"),
        RecordEpisodes(env, tmp_path / "r.mcap", live=url(port)) as recorder,
    ):
        for _ in returns:
            recorder.reset(seed=1)
            recorder.step(0)
    assert told in last_card(tmp_path / "r.rrd")


class Lucky(gym.Wrapper[Any, Any, Any, Any]):
    """Every third episode succeeds, as the info of its last step says; each has one step."""

    episodes = 0

    def step(self, action: Any) -> Any:
        state, reward, _, _, info = self.env.step(action)
        self.episodes += 1
        return state, reward, True, False, {**info, "is_success": self.episodes % 3 == 0}


def test_the_share_of_successes_is_told(tmp_path: Path) -> None:
    port = free_port()
    with (
        receiver(port, tmp_path / "r.rrd"),
        RecordEpisodes(Lucky(gym.make("CartPole-v1")), tmp_path / "r.mcap", live=url(port)) as recorder,
    ):
        for _ in range(12):
            recorder.reset(seed=1)
            recorder.step(0)
    assert "success 33% of the last 12 that say it" in last_card(tmp_path / "r.rrd")


def test_images_and_sub_environments_come_to_rerun(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    inner = gym.vector.SyncVectorEnv([lambda: Sampler(MIXED, MIXED)] * 2)
    with receiver(port, tmp_path / "r.rrd"), RecordVectorEpisodes(inner, path, live=url(port)) as env:
        roll_until_shown(env, tmp_path / "r.rrd")
        for _ in range(250):
            env.step(env.action_space.sample())
            time.sleep(0.02)
    for number in range(2):
        rows, values = shown(tmp_path / "r.rrd", f"/env_{number}/state/cam", "Image:buffer")
        with Recording(path) as recording:
            cams = np.concatenate([e.states["cam"] for e in recording.episodes if e.env == number])
        assert len(rows) > 1  # how many depends on how busy the machine is
        for row, value in zip(rows, values, strict=True):
            assert np.array(value[0], np.uint8).tobytes() == cams[row].tobytes()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("axis", [0, -1])
@pytest.mark.parametrize("shape", [(8, 6), (8, 6, 3), (1, 2)])
def test_stacks_of_frames_come_to_rerun(shape: tuple[int, ...], axis: int, tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    screen = Sampler(spaces.Box(0, 255, shape, np.uint8), spaces.Discrete(3))
    stack = gym.wrappers.FrameStackObservation(screen, 4)
    space = spaces.Box(0, 255, (*shape, 4) if axis else (4, *shape), np.uint8)
    inner = gym.wrappers.TransformObservation(stack, lambda frames: np.moveaxis(frames, 0, axis), space)
    with receiver(port, tmp_path / "r.rrd"), RecordEpisodes(inner, path, live=url(port)) as env:
        roll_until_shown(env, tmp_path / "r.rrd")
        roll(env, 250, 0.02)
    rows, buffers = shown(tmp_path / "r.rrd", "/state", "Image:buffer")
    with Recording(path) as recording:
        assert recording.layout.stacks  # type: ignore[union-attr]
        states = recording.read().states
    assert len(rows) > 1  # how many depends on how busy the machine is
    for row, (buffer,) in zip(rows, buffers, strict=True):
        d, c, b, a = np.moveaxis(states[row], axis, 0)
        picture = np.concatenate(
            [np.concatenate(pair, axis=1) for pair in ((a, b), (c, d))]
        )  # the newest first
        assert np.array_equal(np.array(buffer, np.uint8).reshape(picture.shape), picture)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_rollout_with_a_camera_is_another_application(tmp_path: Path) -> None:
    from rrd import Rrd

    found = set()
    for frames in (False, True):
        path, port = tmp_path / str(frames) / "r.mcap", free_port()
        path.parent.mkdir()
        inner = gym.make("CartPole-v1", render_mode="rgb_array")
        with receiver(port, path.with_suffix(".rrd")):
            with RecordEpisodes(inner, path, live=url(port), frames=frames) as env:
                roll(env, 100, 0.01)
        (entry,) = Rrd(path.with_suffix(".rrd")).recordings
        found.add(entry.application_id)
    assert len(found) == 2


class Told(gym.Wrapper[Any, Any, Any, Any]):
    """Says something of each step; a sub-environment's episodes are over after `length` steps."""

    def __init__(self, length: int) -> None:
        super().__init__(gym.make("Pendulum-v1", max_episode_steps=length))
        self._number = 0

    def step(self, action: Any) -> Any:
        *rest, _ = self.env.step(action)
        self._number += 1
        return *rest, {
            "number": self._number,
            "half": self._number / 2,
            "word": "yes",
            7: 1,
            "of": {"a": np.ones(2)},
        }


@pytest.mark.parametrize("num_envs", [0, 12])
def test_numbers_among_infos_come_to_rerun(num_envs: int, tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    options: Any = {"record_info": True, "live": url(port)}
    with receiver(port, tmp_path / "r.rrd"):
        if num_envs:
            inner = gym.vector.SyncVectorEnv([lambda: Told(7)] * num_envs)
            env: Any = RecordVectorEpisodes(inner, path, **options)
        else:
            env = RecordEpisodes(Told(7), path, **options)
        with env:
            roll_until_shown(env, tmp_path / "r.rrd")
            env.reset(seed=1)
            for _ in range(200):
                *_, timeout, _ = env.step(env.action_space.sample())
                if not num_envs and timeout:
                    env.reset()
                time.sleep(0.005)
    with Recording(path) as recording:
        first = [e for e in recording.episodes if e.env == 0]
        wanted = [info["half"] for episode in first for info in episode.infos or ()]
        root = "/env_0" if num_envs else ""
    rows, values = shown(tmp_path / "r.rrd", "/info/half")
    found = [(row, half) for row, (half,) in zip(rows, values, strict=True) if not np.isnan(half)]
    assert len(found) > 10
    assert all(wanted[row] == half for row, half in found)
    assert len(shown(tmp_path / "r.rrd", f"{root}/return")[0]) > 10
    assert len(shown(tmp_path / "r.rrd", "/info/7")[0]) > 10  # a key that is no text
    assert not len(shown(tmp_path / "r.rrd", "/info/word")[0])
    assert len(shown(tmp_path / "r.rrd", r"/info/of.a\[1\]")[0]) > 10


def test_sub_environments_of_short_episodes_stay_beside_the_others(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    inner = gym.vector.SyncVectorEnv([lambda: Told(500), lambda: Told(1)])
    with receiver(port, tmp_path / "r.rrd"), RecordVectorEpisodes(inner, path, live=url(port)) as env:
        roll_until_shown(env, tmp_path / "r.rrd")
        env.reset(seed=1)
        for _ in range(500):
            env.step(env.action_space.sample())
            time.sleep(0.004)
    with Recording(path) as recording:
        steps = [sum(len(e) for e in recording.episodes if e.env == i) for i in range(2)]
    assert steps[0] - steps[1] > 240  # each of its steps is followed by a reset
    found = (shown(tmp_path / "r.rrd", f"/env_{i}/return") for i in range(2))
    long, short = (rows[~np.isnan(values)[:, 0]] for rows, values in found)  # lines break between episodes
    assert (np.diff(long) > 0).all() and (np.diff(short) > 0).all()
    assert abs(long[-1] - short[-1]) <= 100


def test_the_newest_steps_are_a_heat_map_in_rerun(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    inner = Sampler(spaces.Box(-1, 1, (60,)), spaces.Discrete(3))
    with receiver(port, tmp_path / "r.rrd"), RecordEpisodes(inner, path, live=url(port)) as env:
        roll_until_shown(env, tmp_path / "r.rrd")
        roll(env, 600, 0.002)
    rows, tensors = shown(tmp_path / "r.rrd", "/state/heat_map", "Tensor:data")
    with Recording(path) as recording:
        assert rows[-1] == recording.index["length"].sum() - 1
        states = recording.read().states[-400:]
    (tensor,) = tensors[-1]
    assert tensor["shape"] == [60, 400]
    found = np.array(tensor["buffer"]).reshape(60, 400).T
    # colours only stretch, by as much as earlier states went further
    for dimension in range(60):
        assert np.corrcoef(found[:, dimension], states[:, dimension])[0, 1] > 0.999999
    assert 0 <= found.min() < 0.1 < 0.9 < found.max() <= 1


def test_frames_come_to_rerun(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    with receiver(port, tmp_path / "r.rrd"):
        inner = gym.make("CartPole-v1", render_mode="rgb_array")
        with RecordEpisodes(inner, path, frames=5, live=url(port)) as env:
            roll_until_shown(env, tmp_path / "r.rrd")
            roll(env, 100, 0.02)
    rows, blobs = shown(tmp_path / "r.rrd", "/camera/render", "EncodedImage:blob")
    with Recording(path) as recording:
        pictures: dict[int, list[bytes]] = {}  # a final state comes at the row of the next first one
        for episode, first in zip(recording.episodes, recording.index["first_row"].tolist(), strict=True):
            found = episode.frames
            for i, step in enumerate(found.steps.tolist()):
                pictures.setdefault(first + step, []).append(found.encoded(i).data)
    assert len(rows)  # how many is up to how often the process looks
    for row, blob in zip(rows.tolist(), blobs, strict=True):
        assert bytes(blob[0]) in pictures[row]


def test_the_command_records_live(tmp_path: Path) -> None:
    port = free_port()
    client = Client(port)
    command = ["record", "CartPole-v1", "-o", str(tmp_path / "r.mcap"), "--seed", "1", "--steps", "3000"]
    done = CliRunner().invoke(app, [*command, "--live", f"foxglove://127.0.0.1:{port}"])
    assert done.exit_code == 0, done.output
    client.join()
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.n_steps == 3000
    done = CliRunner().invoke(
        app, ["record", "CartPole-v1", "-o", str(tmp_path / "n.mcap"), "--live", "rviz"]
    )
    assert done.exit_code == 1
    assert "live: expected 'rerun', 'foxglove'" in done.output


def test_without_a_viewer_that_is_told_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, told = tmp_path / "r.mcap", []
    with RecordEpisodes(gym.make("CartPole-v1"), path, live=url(free_port())) as env:
        roll_until(env, lambda: bool(said(capfd, told)))
        roll(env, 200, 0.02)
    assert len(said(capfd, told)) == 1
    assert "no Rerun viewer answers at" in told[0]
    with Recording(path) as recording:
        assert recording.complete


def test_a_viewer_may_come_later_be_killed_and_come_back(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, port, told = tmp_path / "r.mcap", free_port(), []
    with RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port)) as env:
        roll_until(env, lambda: bool(said(capfd, told)))
        with receiver(port, tmp_path / "a.rrd") as process:
            roll_until_shown(env, tmp_path / "a.rrd")
            os.killpg(process.pid, signal.SIGKILL)
            roll(env, 100, 0.02)
        with receiver(port, tmp_path / "b.rrd"):
            roll_until_shown(env, tmp_path / "b.rrd")
            roll(env, 100, 0.01)
            steps = env._writer.rows.count  # type: ignore[union-attr]
            env.close()
    assert len(said(capfd, told)) == 1
    rows, _ = shown(tmp_path / "b.rrd", "/state")
    assert len(rows) > 50
    assert rows.max() == steps - 1
    with Recording(path) as recording:
        assert (recording.complete, recording.n_steps) == (True, steps)


@pytest.mark.timeout(120)
def test_a_viewer_that_stops_taking_data_holds_nothing_up(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    with receiver(port, tmp_path / "r.rrd") as process:
        env = RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port))
        roll_until_shown(env, tmp_path / "r.rrd")
        os.killpg(process.pid, signal.SIGSTOP)
        roll(env, 3000)
        env.close()
        os.killpg(process.pid, signal.SIGKILL)
    with Recording(path) as recording:
        assert recording.complete
        assert recording.n_steps > 3000


def test_a_viewer_that_is_busy_at_the_end_gets_the_rest(tmp_path: Path) -> None:
    """The rest is more than a connection takes ahead of a viewer that reads nothing."""
    path, port = tmp_path / "r.mcap", free_port()
    env = Sampler(spaces.Box(0, 255, (900, 900, 3), np.uint8), spaces.Discrete(2))
    with receiver(port, tmp_path / "r.rrd") as process:
        recorder = RecordEpisodes(env, path, live=url(port))
        roll_until_shown(recorder, tmp_path / "r.rrd")
        os.killpg(process.pid, signal.SIGSTOP)
        roll(recorder, 1)
        threading.Timer(2, os.killpg, (process.pid, signal.SIGCONT)).start()
        recorder.close()
    with Recording(path) as recording:
        steps = recording.n_steps
    rows, _ = shown(tmp_path / "r.rrd", "/state", "Image:buffer")
    assert rows.max() == steps - 1


def test_something_else_listens_at_the_viewers_port(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, port, told = tmp_path / "r.mcap", free_port(), []
    with (
        socket.create_server(("127.0.0.1", port)),
        RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port)) as env,
    ):
        roll(env, 300, 0.002)
        assert env._live is not None
        process = env._live.process
        env.close()
        process.wait(60)
    assert len(said(capfd, told)) == 1
    assert f"what listens at {url(port)} takes nothing" in told[0]
    assert_exact(path, 300)


@pytest.fixture
def nobody_at_the_default_port() -> Iterator[None]:
    """For one test at a time, whichever process runs it."""
    with (Path(tempfile.gettempdir()) / "tupli-mcap-tests-9876").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        if answers(9876):
            pytest.skip("a Rerun viewer runs on this machine")
        yield


@pytest.mark.usefixtures("nobody_at_the_default_port")
def test_no_display_to_start_a_viewer_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live="rerun") as env:
        roll(env, 300)
    (told,) = said(capfd, [])
    assert "there is no display to start a Rerun viewer on; start one" in told
    assert_exact(tmp_path / "r.mcap", 300)


def test_steps_that_are_left_out_break_the_lines(tmp_path: Path) -> None:
    """What comes faster than it can be shown is thinned to the newest; no line joins what is not next to each other."""
    path, port = tmp_path / "r.mcap", free_port()
    with receiver(port, tmp_path / "r.rrd"):
        with RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port), chunk_size=4096) as env:
            roll_until_shown(env, tmp_path / "r.rrd")
            roll(env, 6000)
    rows, values = shown(tmp_path / "r.rrd", "/state")
    with Recording(path) as recording:
        states = recording.read().states
    order = np.argsort(rows, kind="stable")
    rows, table = rows[order], np.array(values, np.float32)[order]
    missing = np.isnan(table).all(axis=1)
    assert len(rows) < len(states)
    assert np.array_equal(table[~missing], states[rows[~missing]])
    shown_next_to = np.diff(rows) > 1
    assert (missing[1:] | ~shown_next_to).all()
    assert rows.max() == len(states) - 1


@pytest.mark.usefixtures("nobody_at_the_default_port")
def test_a_viewer_that_cannot_start_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":77")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    told: list[str] = []
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live="rerun") as env:
        roll_until(env, lambda: bool(said(capfd, told)))
    (line,) = said(capfd, told)
    assert "Rerun viewer" in line


def listener(port: int) -> int:
    """The process group of the Rerun viewer that was started for a port."""
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (place / "cmdline").read_bytes().split(b"\0")
            if b"--bind" in words and str(port).encode() in words:
                return os.getpgid(int(place.name))
    raise ProcessLookupError


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="Xvfb is not installed")
@pytest.mark.usefixtures("nobody_at_the_default_port")
def test_a_viewer_is_started_and_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = subprocess.Popen(["Xvfb", ":78", "-screen", "0", "800x600x24"], stderr=subprocess.DEVNULL)
    monkeypatch.setenv("DISPLAY", ":78")
    try:
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live="rerun") as env:
            roll_until(env, lambda: answers(9876))
        assert answers(9876)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(listener(9876), signal.SIGKILL)
        screen.terminate()
        screen.wait()


# ---- Foxglove


class Client:
    """Foxglove's WebSocket protocol, as far as it takes to listen to everything."""

    def __init__(self, port: int) -> None:
        self.channels: dict[int, dict[str, Any]] = {}
        self._topics: set[str] = set()  # listened to
        self.messages: list[tuple[str, int, bytes]] = []
        self._port = port
        self._over = False  # nobody will answer any more
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        with contextlib.suppress(aiohttp.ClientError):  # the rollout may be over before we have asked for it
            asyncio.run(self._listen())

    async def _listen(self) -> None:
        async with aiohttp.ClientSession() as session:
            place = f"ws://127.0.0.1:{self._port}"
            while not answers(self._port) and not self._over:
                await asyncio.sleep(0.05)
            async with session.ws_connect(
                place, protocols=("foxglove.sdk.v1", "foxglove.websocket.v1")
            ) as ws:
                async for message in ws:
                    if message.type is aiohttp.WSMsgType.TEXT:
                        found = message.json()
                        if found["op"] == "advertise":
                            new = {channel["id"]: channel for channel in found["channels"]}
                            self.channels |= new
                            await asyncio.sleep(0.1)  # else too early for the server
                            wanted = [{"id": i, "channelId": i} for i in new]
                            await ws.send_json({"op": "subscribe", "subscriptions": wanted})
                            self._topics |= {channel["topic"] for channel in new.values()}
                    elif message.type is aiohttp.WSMsgType.BINARY and message.data[0] == 1:
                        number = int.from_bytes(message.data[1:5], "little")
                        time_ns = int.from_bytes(message.data[5:13], "little")
                        self.messages.append((self.channels[number]["topic"], time_ns, message.data[13:]))

    def wait(self) -> None:
        """Until it listens to the starts and ends of episodes."""
        wait_for(lambda: self._topics >= set(EPISODES))
        time.sleep(0.2)  # for the server to hear of it

    def join(self) -> None:
        """Once the rollout is over: until all has come that was sent."""
        self._over = True
        self._thread.join(120)


def in_file(path: Path) -> dict[tuple[str, int, bytes], int]:
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return {(c.topic, m.log_time, m.data): m.sequence for _, c, m in make_reader(file).iter_messages()}


@pytest.mark.sampled(1, keep=["mixed"])
@pytest.mark.parametrize("kind", ["mixed", "text", "vector"])
def test_foxglove_gets_the_messages_of_the_file(kind: str, tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    space: Any = spaces.Text(8) if kind == "text" else MIXED
    live = f"foxglove://127.0.0.1:{port}"
    if kind == "vector":
        inner = gym.vector.SyncVectorEnv([lambda: Sampler(space, space)] * 2)
        env: Any = RecordVectorEpisodes(inner, path, live=live)
    else:
        env = RecordEpisodes(Sampler(space, space), path, live=live)
    client = Client(port)
    with env:
        env.reset(seed=1)
        for i in range(200):
            *_, terminal, timeout, _ = env.step(env.action_space.sample())
            if kind != "vector" and (terminal or timeout):
                env.reset()
            if i == 0:
                client.wait()
            time.sleep(0.01)
    client.join()
    with Recording(path) as recording:
        schemas = recording._contents.schemas
        for channel in client.channels.values():
            text = next(s.data.decode() for s in schemas.values() if s.name == channel["schemaName"])
            assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
            assert channel["schema"] == text
    topics = {topic for topic, _, _ in client.messages}
    top = "/env_1" if kind == "vector" else ""
    wanted = {f"{top}/step", "/episode_start", "/episode_end", "/final_state"}
    assert topics >= (wanted if kind == "text" else {*wanted, f"{top}/image/state_cam"})
    known = in_file(path)
    timeless = {(topic, data) for topic, _, data in known}
    for topic, time_ns, data in client.messages:  # an end is shown before it is known when it will be written
        ends = topic in ("/episode_end", "/final_state")
        assert (topic, data) in timeless if ends else (topic, time_ns, data) in known
    steps = [known[m] for m in client.messages if m[0] == f"{top}/step"]
    assert len(steps) > 50
    assert steps == sorted(set(steps))
    schema = next(c for c in client.channels.values() if c["topic"] == f"{top}/step")
    decode = generate_dynamic(schema["schemaName"], schema["schema"])["tupli_mcap/Step"]
    first = decode(next(m[2] for m in client.messages if m[0] == f"{top}/step"))
    assert first.reward == (first.step + 1) / 2


@pytest.mark.parametrize("num_envs", [0, 2])
def test_foxglove_gets_ends_while_the_rollout_pauses(num_envs: int, tmp_path: Path) -> None:
    path, port, space = tmp_path / "r.mcap", free_port(), spaces.Box(-1, 1, (3,))
    env, _ = followed(path, Sampler(space, space, 4), num_envs, live=f"foxglove://127.0.0.1:{port}")
    client = Client(port)
    with env:
        env.reset(seed=1)
        env.step(env.action_space.sample())
        client.wait()
        over = False
        for _ in range(58 if num_envs else 63):
            if over and not num_envs:
                env.reset()
            over = bool(np.any(env.step(env.action_space.sample())[2:4]))
        assert over
        wanted = 16 if not num_envs else 24
        wait_for(lambda: sum(m[0] == "/episode_end" for m in client.messages) == wanted)
        assert sum(m[0] == "/final_state" for m in client.messages) == wanted
    client.join()
    known = {(topic, data): sequence for (topic, _, data), sequence in in_file(path).items()}
    for topic in EPISODES:
        found = [known[topic, data] for name, _, data in client.messages if name == topic]
        assert found == list(range(found[0], found[0] + len(found)))


@pytest.mark.sampled(0, keep=["2"])
@pytest.mark.parametrize("times", [2, 6])
def test_foxglove_gets_the_last_end_before_the_server_stops(tmp_path: Path, times: int) -> None:
    space = spaces.Box(-1, 1, (3,))
    for number in range(times):  # a server that stops at once is now and then quick enough
        path, port = tmp_path / f"{number}.mcap", free_port()
        with RecordEpisodes(Sampler(space, space, 5), path, live=f"foxglove://127.0.0.1:{port}") as env:
            client = Client(port)
            env.reset(seed=1)
            env.step(env.action_space.sample())
            client.wait()
            roll(env, 52)
        client.join()
        for topic in EPISODES:
            last = max(
                (sequence, data) for (name, _, data), sequence in in_file(path).items() if name == topic
            )
            assert [data for name, _, data in client.messages if name == topic][-1] == last[1]


def test_foxgloves_port_is_taken(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.mcap"
    with socket.create_server(("127.0.0.1", 0)) as server:
        live = f"ws://127.0.0.1:{server.getsockname()[1]}"
        with RecordEpisodes(gym.make("CartPole-v1"), path, live=live) as env:
            roll(env, 100)
    (told,) = said(capfd, [])
    assert f"live={live!r} cannot show the rollout" in told
    assert told.endswith("the recording goes on")
    assert_exact(path, 100)


# ---- whatever happens


def test_what_goes_wrong_in_a_view_ends_the_view_only(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path, port, told = tmp_path / "r.mcap", free_port(), []
    with receiver(port, tmp_path / "r.rrd"):
        with RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port)) as env:
            roll_until_shown(env, tmp_path / "r.rrd")
            with journal_path(path).open("r+b") as journal:
                journal.write(b"damaged!")
            roll_until(env, lambda: bool(said(capfd, told)))
    (line,) = told
    assert "the live view has ended (FormatError: " in line
    assert line.endswith("the recording goes on")
    with Recording(path) as recording:
        assert recording.complete


def test_the_view_of_a_killed_recorder_ends(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    code = (
        "import gymnasium as gym\nfrom tupli_mcap import RecordEpisodes\n"
        f"env = RecordEpisodes(gym.make('CartPole-v1'), {str(path)!r}, live='ws://127.0.0.1:{port}')\n"
        "env.reset(seed=1)\nenv.step(0)\nprint('begun', flush=True)\ninput()\n"
    )
    recorder = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert recorder.stdin is not None
    assert recorder.stdout is not None
    with recorder.stdin, recorder.stdout:
        recorder.stdout.readline()
        client = Client(port)
        client.wait()
        recorder.kill()
        recorder.wait()
    wait_for(lambda: not answers(port))
    client.join()
    assert [topic for topic, _, _ in client.messages].count("/step") == 1


def exit_code(child: int, seconds: float = 120.0) -> int:
    """How a process ended; one that hangs is killed, and its code is that of the signal."""
    end = time.monotonic() + seconds
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.02)
    return os.waitstatus_to_exitcode(ended[1])


def test_a_forked_child_has_no_view_and_the_parent_goes_on(tmp_path: Path) -> None:
    path, port = tmp_path / "r.mcap", free_port()
    with receiver(port, tmp_path / "r.rrd"):
        with RecordEpisodes(gym.make("CartPole-v1"), path, live=url(port)) as env:
            roll(env, 100, 0.005)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                child = os.fork()
            if child == 0:  # pragma: no cover
                with contextlib.suppress(BaseException):
                    env.close()
                    gc.collect()
                    os._exit(7)
                os._exit(1)
            assert exit_code(child) == 7
            roll(env, 100, 0.005)
    rows, _ = shown(tmp_path / "r.rrd", "/state")
    assert len(np.unique(rows)) == 200
    with Recording(path) as recording:
        assert (recording.complete, recording.n_steps) == (True, 200)


def test_a_collected_wrapper_ends_its_view(tmp_path: Path) -> None:
    env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live=f"ws://127.0.0.1:{free_port()}")
    roll(env, 50)
    assert env._live is not None
    process = env._live.process
    assert process.poll() is None
    del env
    gc.collect()
    wait_for(lambda: process.poll() is not None)
    assert_exact(tmp_path / "r.mcap", 50)


def test_live_costs_nothing_where_it_is_not_asked_for(tmp_path: Path) -> None:
    code = (
        "import sys, gymnasium as gym\nfrom tupli_mcap import RecordEpisodes\n"
        f"env = RecordEpisodes(gym.make('CartPole-v1'), {str(tmp_path / 'r.mcap')!r})\nenv.reset()\nenv.step(0)\n"
        "import threading\nassert threading.active_count() == 1\n"
        "assert not {'tupli_mcap.viewer.live', 'rerun', 'foxglove'} & set(sys.modules)\nenv.close()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(("live", "module"), [("rerun", "rerun"), ("foxglove", "foxglove")])
def test_a_missing_extra_is_named_and_leaves_no_file(
    live: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"pip install .*\[{module}\]"):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live=live)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("live", ["", "rviz", "http://x", "ws://x:99999", "rerun+http://a:1/b", "ws://u@h:1"])
def test_a_target_that_is_none_is_refused(live: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="live: expected 'rerun', 'foxglove', .*found"):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", live=live)
    assert not list(tmp_path.iterdir())


def test_targets() -> None:
    assert parse_target("rerun") == ("rerun", "127.0.0.1", 9876, "")
    assert parse_target("rerun+http://10.0.0.2:1234/proxy").url == "rerun+http://10.0.0.2:1234/proxy"
    assert parse_target("rerun://host").url == "rerun://host:9876/proxy"
    assert (
        parse_target("foxglove")
        == parse_target("foxglove://127.0.0.1")
        == ("foxglove", "127.0.0.1", 8765, "")
    )
    assert parse_target("ws://[::1]:7000")[:3] == ("foxglove", "[::1]", 7000)
