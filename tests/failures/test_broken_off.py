"""Ctrl-C at any moment of a recorder's life: what was returned is in the file, exactly, and the file opens."""

from __future__ import annotations

import contextlib
import errno
import gc
import itertools
import os
import random
import weakref
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Scripted
from gymnasium import spaces
from interruptions import SCENARIOS, Counting, interrupted

from tupli_mcap import RecordEpisodes, Recording, RecordingError, StepError, verify_recording
from tupli_mcap.vector import RecordEpisodes as RecordVector

KINDS: dict[str, tuple[gym.Space[Any], Any]] = {
    "box": (spaces.Box(-1, 1, (3,), np.float32), lambda n: np.full(3, n, np.float32)),
    "text": (spaces.Text(50, min_length=0), lambda n: "x" * n),
    "image": (spaces.Box(0, 255, (4, 4, 3), np.uint8), lambda n: np.full((4, 4, 3), n, np.uint8)),
}


class BreakAt:
    """Raises KeyboardInterrupt at the `line`-th line of the package that is run."""

    def __init__(self, line: int) -> None:
        self.left = line

    def __call__(self, frame: Any, event: str, arg: Any) -> Any:
        if frame.f_back is not None and frame.f_back.f_code.co_name == "__del__":
            return None  # of a recording that was read before: nobody would see the exception
        return self.local if "tupli_mcap" in frame.f_code.co_filename else None

    def local(self, frame: Any, event: str, arg: Any) -> Any:
        if event == "line" and frame.f_code.co_name != "__del__":
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt
        return self.local


def scripted(kind: str) -> gym.Env[Any, Any]:
    space, observe = KINDS[kind]
    return Scripted(observe, space, length=4)


# a file whose opening is interrupted twice is closed with its last reference
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", SCENARIOS)
def test_anywhere(tmp_path: Path, name: str) -> None:
    """A sample of `python tools/interruptions.py`: once, and again while that is handled."""
    events = 12_000
    moments = random.Random(name).sample(range(1, events), 4)
    for at, again in zip(moments, (0, 0, 1, 3), strict=True):
        directory = tmp_path / str(at)
        directory.mkdir()
        interrupted(name, directory, at, again, go_on=at % 2 == 1)


def transitions(path: Path) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    for episode in Recording(path).episodes:
        states = [step.state for step in episode] + [episode.final_state]
        found += list(itertools.pairwise(states))
    return found


def _number(state: Any) -> int:
    return int(np.asarray(state).flat[0])


def test_the_next_session_goes_on(tmp_path: Path) -> None:
    class Full:
        def __call__(self, *_: Any) -> None:
            raise KeyboardInterrupt

    path = tmp_path / "r.mcap"
    env = RecordEpisodes(scripted("box"), path, chunk_size=400)
    env.reset()
    env.step(0)
    env._writer.container.add_chunk = Full()  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        env.flush()
    for use in (env.reset, lambda: env.step(0), env.flush):
        with pytest.raises(RecordingError, match="every finished step is safe"):
            use()  # type: ignore[operator]
    env.close()
    with RecordEpisodes(scripted("box"), path, mode="a") as env:
        env.reset()
        env.step(0)
    assert [len(episode) for episode in Recording(path).episodes] == [1, 1]


def test_a_reset_that_fails_ends_the_episode(tmp_path: Path) -> None:
    class Fails(gym.Wrapper[Any, Any, Any, Any]):
        fail = False

        def reset(self, **kwargs: Any) -> Any:
            result = self.env.reset(**kwargs)
            if self.fail:
                raise RuntimeError("no answer")
            return result

    inner = Fails(scripted("box"))
    with RecordEpisodes(inner, tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
        inner.fail = True
        with pytest.raises(RuntimeError, match="no answer"):
            env.reset()
        inner.fail = False
        with pytest.raises(StepError, match="call env.reset"):
            env.step(0)
        env.reset()
        env.step(0)
    episodes = Recording(tmp_path / "r.mcap").episodes
    assert [(e.states[:, 0].tolist(), e.final_state[0], e.end) for e in episodes] == [
        ([0.0], 1.0, "interrupted")
    ] * 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, TimeoutError])
@pytest.mark.parametrize("vector", [False, True])
def test_a_step_broken_off_in_the_environment_is_followed_by_a_reset(
    tmp_path: Path, vector: bool, error: type[BaseException]
) -> None:
    """The environment may have moved on: the next step would be one from a state to the one after the next."""

    class Broken(gym.Wrapper[Any, Any, Any, Any]):
        breaks = False

        def step(self, action: Any) -> Any:
            result = self.env.step(action)
            if self.breaks:
                raise error
            return result

    inner, path = Broken(scripted("box")), tmp_path / "r.mcap"
    env: Any = (
        RecordVector(gym.vector.SyncVectorEnv([lambda: inner]), path)
        if vector
        else RecordEpisodes(inner, path)
    )
    action = env.action_space.sample()
    with env:
        env.reset()
        env.step(action)
        inner.breaks = True
        with pytest.raises(error):
            env.step(action)
        inner.breaks = False
        with pytest.raises(StepError, match="could not be recorded; call env.reset"):
            env.step(action)
        env.reset()
        env.step(action)
    assert [[_number(x) for x in step] for step in transitions(path)] == [[0, 1], [0, 1]]
    assert [episode.end for episode in Recording(path).episodes] == ["interrupted"] * 2


def counted(path: Path, **options: Any) -> tuple[RecordEpisodes, Counting]:
    inner = Counting()
    return RecordEpisodes(inner, path, attachments={}, **options), inner


def test_a_callback_that_survives_a_flush_in_vain_does_not_go_on(tmp_path: Path) -> None:
    """The rows of the half were noted as written."""

    def flush(_: Any) -> dict[str, Any]:
        if len(taken) == 10:
            env._writer.container.add_chunk = refuse  # type: ignore[method-assign]
            with pytest.raises(RecordingError, match="disk"):
                env.flush()
            del env._writer.container.add_chunk
        return {}

    def refuse(*_: Any) -> None:
        raise RecordingError("no room on the disk")

    taken: list[int] = []
    env, _ = counted(tmp_path / "r.mcap", step_callback=flush)
    env.reset()
    with pytest.raises(RecordingError, match="no room on the disk"):
        for i in range(20):
            if env.step(0)[2]:
                env.reset()
            taken.append(i)
    assert len(taken) == 10
    env.close()
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.n_steps == 11  # the one that was refused is there, too
        assert verify_recording(tmp_path / "r.mcap").ok


@pytest.mark.parametrize("when", ["callback", "environment", "reset"])
def test_nothing_is_recorded_once_it_was_closed_from_within(tmp_path: Path, when: str) -> None:
    def close(_: Any = None) -> dict[str, Any]:
        if len(taken) == 10:
            env.close()
        return {}

    class Closing(Counting):
        def step(self, action: Any) -> Any:
            if when == "environment":
                close()
            return super().step(action)

        def reset(self, **kwargs: Any) -> Any:
            if when == "reset" and len(taken) >= 10:
                env.close()
            return super().reset(**kwargs)

    taken: list[int] = []
    options = {"step_callback": close} if when == "callback" else {}
    env: Any = RecordEpisodes(Closing(), tmp_path / "r.mcap", attachments={}, **options)
    env.reset()
    with pytest.raises(RecordingError, match="is closed"):
        for i in range(20):
            if env.step(0)[2]:
                env.reset()
            taken.append(i)
    for use in (env.reset, lambda: env.step(0), env.flush):
        with pytest.raises(RecordingError, match="is closed"):
            use()
    with Recording(tmp_path / "r.mcap") as recording:
        assert len(taken) <= recording.n_steps <= len(taken) + 1


def test_a_recorder_that_the_disk_refused_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap")
    env.reset(seed=0)
    env.step(0)

    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as context:
        context.setattr(os, "pwritev", refuse)
        with contextlib.suppress(RecordingError):  # nobody keeps the error
            env.close()
        with pytest.raises(RecordingError, match="No space left"):
            env.step(0)
    wrapper = weakref.ref(env)
    del env
    gc.collect()
    assert wrapper() is None
