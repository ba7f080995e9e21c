"""Recorders that are killed, in forked children."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
from environments import roll

from tupli_mcap import RecordEpisodes


def abandon(path: Path, make: Any, steps: int) -> None:
    """Records in a forked child that dies without closing anything."""
    pid = os.fork()
    if pid == 0:
        try:
            env = make(path)
            roll(env, steps)
        finally:
            os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)


def cart_pole(path: Path, **kwargs: Any) -> RecordEpisodes:
    return RecordEpisodes(gym.make("CartPole-v1"), path, chunk_size=3000, **kwargs)


def killed(work: Callable[[], Any]) -> None:
    """Runs `work` in a child that is killed at its end, if not before; what it returns is not closed."""
    pid = os.fork()
    if pid == 0:
        try:
            _held = work()
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
