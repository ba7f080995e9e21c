"""Recordings, and the page that shows them, served on a port of this machine."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import uvicorn
from fastapi import FastAPI
from serving import running

import tupli_mcap
from tupli_mcap.page.app import create_app
from tupli_mcap.page.directory import shelf_of

EVIL = "<script>document.title='pwned'</script>\"'><img src=x onerror=document.title='pwned'>"
"""A text that changes the title of a page that lets it act."""


@contextlib.contextmanager
def browsing(path: Path) -> Iterator[str]:
    """The address of `tupli-mcap browse` on a path."""
    with serving_app(create_app(shelf_of(path))) as address:
        yield address


@contextlib.contextmanager
def serving_app(app: FastAPI) -> Iterator[str]:
    """Serves an application in a thread; yields its address."""
    with running(uvicorn.Config(app, host="127.0.0.1", port=0, log_level="warning")) as address:
        yield address


def carts(root: Path, seeds: int = 2, episodes: int = 12) -> None:
    """Runs of CartPole that get better: ppo-seed0, ppo-seed1, …"""
    for seed in range(seeds):
        run: dict[str, Any] = {"name": f"ppo-seed{seed}", "metadata": {"lr": 3e-4}, "tags": ["baseline"]}
        with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), root / f"ppo{seed}.mcap", **run) as env:
            rng = np.random.default_rng(seed)
            for number in range(episodes):
                state, _ = env.reset(seed=100 * seed + number)
                ended = False
                while not ended:
                    chosen = int(state[2] + 0.3 * state[3] > 0)
                    action = chosen if rng.random() < number / episodes else int(rng.integers(2))
                    state, _, terminated, truncated, _ = env.step(action)
                    ended = terminated or truncated


def robot(path: Path, episodes: int = 2, text: str = "open the drawer", images: bool = True) -> None:
    """Episodes of a robot with a camera, joints and an instruction, and `text` wherever a file can carry one."""
    spaces = gym.spaces
    parts: dict[str, Any] = {"joints": spaces.Box(-3.2, 3.2, (3,), np.float32), text: spaces.Text(400)}
    if images:
        parts["wrist"] = spaces.Box(0, 255, (24, 32, 3), np.uint8)
    writer = tupli_mcap.EpisodeWriter(
        path,
        spaces.Dict(parts),
        spaces.Discrete(3),
        name=text,
        metadata={"note": text, text: 1},
        tags=[text],
        labels={"action": ("stay", text[:100], "go")},
    )
    with writer:
        for number in range(episodes):
            writer.begin(seed=number, options={"o": text}, metadata={"task": text, "success": number == 0})
            for i in range(20):
                values = {"joints": np.full(3, i / 20, np.float32), text: text[:400]}
                if images:
                    values["wrist"] = np.full((24, 32, 3), 10 * i, np.uint8)
                writer.step(
                    values,
                    i % 3,
                    reward=i / 10,
                    terminal=i == 19,
                    info={"force": 0.5 * i + 1e-9, "said": text},
                )
            writer.end(values)
