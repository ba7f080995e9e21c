"""Episodes that are derived from rows: as if every start and end had been written when it happened.

The oracle is the same rollout, recorded by a recorder that writes them at once.
"""

from __future__ import annotations

import json
import random
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import same
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import RecordEpisodes, Recording, verify_recording
from tupli_mcap.errors import RecordingError, StepError
from tupli_mcap.journal.derive import EpisodeDeriver
from tupli_mcap.recording.write.recorders.single import SingleRecorder
from tupli_mcap.recording.write.rows.single import SingleRows
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes

EXACT = ("first_row", "length", "return", "seed", "final_row", "episode", "env", "end", "has_seed")


class Uneven(gym.Env[Any, Any]):
    """Episodes of 1 to 9 steps; rewards that do not add up exactly; now and then an info at the reset, or a success."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float64)
    action_space = gym.spaces.Discrete(5)

    def __init__(self, infos: float = 0.0) -> None:
        self.infos = infos

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(1, 10))
        return self._state(), {"told": 1} if self.np_random.random() < self.infos else {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.left -= 1
        done, timeout = self.left <= 0, bool(self.np_random.random() < 0.3)
        info = {"success": not timeout} if done and self.np_random.random() < self.infos else {}
        return self._state(), float(self.np_random.random()), done and not timeout, done and timeout, info

    def _state(self) -> Any:
        self.newest = self.np_random.uniform(-1, 1, 3)
        return self.newest


def at_once(env: Any) -> Any:
    """A recorder that writes every start and end when it happens."""
    env._recorder.derives_episodes = False
    return env


def told(path: Path) -> list[Any]:
    """What a recording says of its episodes, but for the times."""
    with Recording(path) as recording:
        facts = [recording.index[name].tolist() for name in EXACT]
        facts += [
            (e.seed, e.options, e.reset_info, e.metadata, e.end, e.states, e.rewards, e.final_state)
            for e in recording.episodes
        ]
        starts, ends = recording.index["start_time"], recording.index["end_time"]
        assert (starts <= ends).all()
        return facts


def rollout(env: Any, moves: int, seed: int, look: Callable[[int], None] = lambda i: None) -> None:
    """Steps, and resets of every kind at every time."""
    chance = random.Random(seed)
    env.reset(seed=seed)
    done = False
    for i in range(moves):
        kind = chance.random()
        if (done and kind < 0.9) or kind < 0.01:
            kind = chance.random()
            if kind < 0.05:
                env.reset(seed=chance.randrange(100))
            elif kind < 0.08:
                env.reset(options={"level": i})
            else:
                env.reset()
            done = False
        elif kind < 0.012:
            env.flush()
        elif kind < 0.014:
            with pytest.raises(StepError):
                env.unwrapped.broken = True
                env.step(np.zeros(2))  # no action of a Discrete
            env.reset()
            done = False
        else:
            _, _, terminal, timeout, _ = env.step(np.int64(chance.randrange(5)))
            done = terminal or timeout
        look(i)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("infos", [0.0, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_one_environment(tmp_path: Path, seed: int, infos: float) -> None:
    """Halves of a few dozen rows, so that episodes, holes and settlements fall on every place of them."""
    mine, oracle = tmp_path / "mine.mcap", tmp_path / "oracle.mcap"
    for path, wrap in ((mine, lambda env: env), (oracle, at_once)):
        with wrap(RecordEpisodes(Uneven(infos), path, chunk_size=2000 + 300 * seed)) as env:
            rollout(env, 3000, seed)
    assert same(told(mine), told(oracle))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("infos", [0.0, 0.01])
@pytest.mark.parametrize("seed", range(3))
def test_sub_environments(tmp_path: Path, seed: int, infos: float) -> None:
    mine, oracle = tmp_path / "mine.mcap", tmp_path / "oracle.mcap"
    for path, wrap in ((mine, lambda env: env), (oracle, at_once)):
        inner = SyncVectorEnv([lambda: Uneven(infos)] * 3)
        with wrap(RecordVectorEpisodes(inner, path)) as env:
            chance = random.Random(seed)
            env.reset(seed=seed)
            for _ in range(2500):
                if chance.random() < 0.003:
                    env.reset(seed=chance.choice([None, 5]))
                if chance.random() < 0.01:  # other episodes go on, or have just ended or begun
                    mask = np.array([chance.random() < 0.5 for _ in range(3)])
                    mask[chance.randrange(3)] = True
                    env.reset(options={"reset_mask": mask})
                if chance.random() < 0.003:
                    env.flush()
                env.step(np.array([chance.randrange(5) for _ in range(3)]))
    assert sorted(told(mine)[: len(EXACT)], key=str) != []
    with Recording(mine) as a, Recording(oracle) as b:
        assert len(a.episodes) == len(b.episodes) > 1000
        for name in EXACT:
            if name != "final_row":  # of several that end at once
                assert same(a.index[name].tolist(), b.index[name].tolist()), name
        for x, y in zip(a.episodes, b.episodes, strict=True):
            for name in (
                "seed",
                "options",
                "reset_info",
                "metadata",
                "end",
                "states",
                "rewards",
                "final_state",
            ):
                assert same(getattr(x, name), getattr(y, name)), name


@pytest.mark.sampled(0, keep=["400-0", "400-3"])
@pytest.mark.parametrize("num_envs", [0, 3])
@pytest.mark.parametrize("steps", [400, 800])
def test_a_copy_at_any_time_is_whole(tmp_path: Path, steps: int, num_envs: int) -> None:
    """The file and its journal hold every finished step, start, end and final state at any time."""
    path, oracle = tmp_path / "r.mcap", tmp_path / "oracle.mcap"
    copied = tmp_path / "copied.mcap"
    chance, lengths, wanted = random.Random(7), [], []

    def look(i: int) -> None:
        if chance.random() > 0.03:
            return
        for source, kept in ((path, lengths), (oracle, wanted)):
            shutil.copy(source, copied)
            shutil.copy(f"{source}.journal", f"{copied}.journal")
            kept.append(told(copied)) if source.exists() else None

    if num_envs:
        envs = [
            RecordVectorEpisodes(SyncVectorEnv([Uneven] * num_envs), path, chunk_size=2000),
            at_once(RecordVectorEpisodes(SyncVectorEnv([Uneven] * num_envs), oracle, chunk_size=2000)),
        ]
    else:
        envs = [
            RecordEpisodes(Uneven(), path, chunk_size=2000),
            at_once(RecordEpisodes(Uneven(), oracle, chunk_size=2000)),
        ]
    for env in envs:
        env.reset(seed=3)
    done = False
    for i in range(steps):
        for env in envs:
            if done:
                env.reset()
            else:
                action = np.full(num_envs, i % 5) if num_envs else np.int64(i % 5)
                _, _, terminal, timeout, _ = env.step(action)
        done = not num_envs and not done and bool(terminal or timeout)
        look(i)
    assert len(lengths) >= steps // 50
    for mine, theirs in zip(lengths, wanted, strict=True):
        assert same(mine[:3], theirs[:3])  # first rows, lengths, returns
        assert same([e[4:] for e in mine[len(EXACT) :]], [e[4:] for e in theirs[len(EXACT) :]])
    for env in envs:
        env.close()


def test_it_is_used(tmp_path: Path) -> None:
    """No start of an unseeded episode is in the journal before its rows go to a chunk."""
    with RecordEpisodes(Uneven(), tmp_path / "r.mcap") as env:
        env.reset(seed=1)
        for _ in range(200):
            _, _, terminal, timeout, _ = env.step(0)
            if terminal or timeout:
                env.reset()
        rows, events = env._writer.rows, env._writer.events
        assert isinstance(rows, SingleRows) and rows.events is events
        assert events is not None and sum(events.sequences.values()) == 1
        assert env._writer.next_episode > 10
    with Recording(tmp_path / "r.mcap") as recording:
        assert len(recording.episodes) > 10
        assert json.dumps(recording.index["episode"].tolist()) == json.dumps(
            [*range(len(recording.episodes))]
        )


def test_returns_are_sums_in_the_order_of_the_steps() -> None:
    """However the rows come: rounding shows any other order."""
    rng = np.random.default_rng(1)
    dtype = np.dtype(
        [
            ("#sequence", "<u4"), ("#log_time", "<u8"), ("episode", "<u4"), ("reward", "<f8"), ("terminal", "?"),
            ("timeout", "?"), ("pad", "u1", (64,)),
        ]
    )  # fmt: skip
    rows = np.zeros(500, dtype)
    rows["#sequence"], rows["reward"] = (
        np.arange(500),
        rng.normal(size=500) * 10.0 ** rng.integers(-8, 8, 500),
    )
    rows["terminal"][-1] = True
    total = 0.0
    for reward in rows["reward"].tolist():
        total += reward
    for parts in ([500], [1, 499], [100, 0, 250, 150]):
        episodes, at = EpisodeDeriver(1, 44), 0
        for count in parts:
            found = episodes.derive(rows[None, at : at + count], {0: bytes(1)} if at + count == 500 else None)
            at += count
        assert found.ends["return"].tolist() == [total]
        assert found.ends["length"].tolist() == [500]


def test_a_clock_that_is_set_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hole of an episode is not older than its steps, or it would not count: also at the start of a half."""
    now = [10**18]

    def earlier() -> int:
        now[0] -= 1000
        return now[0]

    path, copied = tmp_path / "r.mcap", tmp_path / "copied.mcap"
    with RecordEpisodes(Uneven(), path, chunk_size=1000) as env:
        finals = []
        monkeypatch.setattr("time.time_ns", earlier)
        env.reset(seed=1)
        for _ in range(120):
            state, _, terminal, timeout, _ = env.step(0)
            if terminal or timeout:
                finals.append(state)
                env.reset()
                shutil.copy(path, copied)
                shutil.copy(f"{path}.journal", f"{copied}.journal")
                with Recording(copied) as recording:
                    assert same([e.final_state for e in recording.episodes], finals)
        assert len(finals) > 10


@pytest.mark.parametrize("begun", ["seeded", "plain"])
def test_broken_off_as_an_episode_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: str) -> None:
    """Ctrl-C after the last step is in the journal: nothing more is accepted, and the episode is whole."""
    path = tmp_path / "r.mcap"
    env = RecordEpisodes(Uneven(), path)
    env.reset(seed=1)
    ends = 1 if begun == "seeded" else 5

    def broken(self: SingleRecorder, end: int, leave: Any = SingleRecorder.leave_end) -> None:
        nonlocal ends
        ends -= 1
        if not ends:
            raise KeyboardInterrupt
        leave(self, end)

    monkeypatch.setattr(SingleRecorder, "leave_end", broken)
    steps = 0
    with pytest.raises(KeyboardInterrupt):
        while True:
            steps += 1
            _, _, terminal, timeout, _ = env.step(0)
            if terminal or timeout:
                env.reset()
    state = env.unwrapped.newest
    for go_on in (env.reset, lambda: env.step(0)):
        with pytest.raises(RecordingError, match="broke off"):
            go_on()
    env.close()
    with Recording(path) as recording:
        assert recording.n_steps == steps
        assert len(recording.episodes) == (1 if begun == "seeded" else 5)
        assert recording.episodes[-1].end in ("terminal", "timeout")
        assert same(recording.episodes[-1].final_state, state)
    assert verify_recording(path).ok


def test_a_flush_that_failed_after_an_end(tmp_path: Path) -> None:
    """Nothing more is accepted, a reset neither, and every step before is there."""
    path = tmp_path / "r.mcap"
    env = RecordEpisodes(Uneven(), path)
    env.reset(seed=1)
    steps, ends = 0, 0
    while ends < 5:
        steps += 1
        _, _, terminal, timeout, _ = env.step(0)
        if terminal or timeout:
            ends += 1
            if ends < 5:
                env.reset()
    state = env.unwrapped.newest
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, hard))
    try:
        with pytest.raises(RecordingError, match="could not write"):
            env.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    for go_on in (env.reset, lambda: env.step(0)):
        with pytest.raises(RecordingError, match="could not write"):
            go_on()
    env.close()  # the file may grow again
    with Recording(path) as recording:
        assert (recording.n_steps, len(recording.episodes)) == (steps, 5)
        assert recording.episodes[-1].end in ("terminal", "timeout")
        assert same(recording.episodes[-1].final_state, state)
