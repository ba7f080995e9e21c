"""Simulates power losses: after one, each sector is as it was at the last sync, or at any moment since.

`record` keeps the bytes of file and journal after every step, and which of these moments were synced. `crash` makes a
possible disk, and `check` compares the steps on it with those that the environment returned.
"""

from __future__ import annotations

import io
import random
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from environments import Sampler, same
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import FormatError, RecordEpisodes, Recording
from tupli_mcap.journal import file as journals
from tupli_mcap.recording import journal_path
from tupli_mcap.recording.write import writer
from tupli_mcap.vector import RecordEpisodes as RecordVector

KINDS: dict[str, Any] = {
    "box": spaces.Box(-1, 1, (4,), np.float32),
    "text": spaces.Dict({"note": spaces.Text(30), "x": spaces.Discrete(5)}),
    "image": spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": spaces.Box(-1, 1, (1,))}),
    "large": spaces.Dict({"x": spaces.Discrete(5), "y": spaces.Box(-1, 1, (600,))}),
    "frames": spaces.Box(0, 255, (80, 80, 3), np.uint8),
    "vector": spaces.Box(-1, 1, (4,), np.float32),
    "info": spaces.Box(-1, 1, (4,), np.float32),
}
SECTOR = 512
OTHER_BOOT = "00000000-0000-0000-0000-000000000000"
Step = tuple[Any, Any, Any, bool, bool, Any]  # state, action, reward, terminal, timeout, next state


@dataclass
class Moment:
    """Bytes of the file and of the journal (None: not there), and steps returned so far by sub-environment."""

    file: bytes
    journal: bytes | None
    steps: list[int]


@dataclass
class Story:
    """The moments of a recording, the last one synced by each of them, and the truth by sub-environment."""

    path: Path
    durability: str
    moments: list[Moment] = field(default_factory=list)
    synced_file: list[int] = field(default_factory=list)
    synced_journal: list[int] = field(default_factory=list)
    truth: list[list[Step]] = field(default_factory=list)


def record(path: Path, kind: str, durability: str, steps: int, chunk_size: int = 2000) -> Story:
    """Records `steps` steps of one of KINDS, and remembers every moment. The recording is left open."""
    story = Story(path, durability)
    live = journal_path(path)
    last = {"file": -1, "journal": -1}

    def note(counts: list[int]) -> None:
        held = live.read_bytes() if live.exists() else None
        story.moments.append(Moment(path.read_bytes(), held, counts))
        story.synced_file.append(last["file"])
        story.synced_journal.append(last["journal"])

    real_file, real_journal = writer.sync_file, journals.Journal.sync

    def sync_file(fd: int, name: str) -> None:
        real_file(fd, name)
        note(list(counts))  # what is there now is on the disk
        last["file"] = len(story.moments) - 1

    def sync_journal(journal: Any) -> None:
        real_journal(journal)
        note(list(counts))
        if live.exists():
            last["journal"] = len(story.moments) - 1

    space, actions = KINDS[kind], spaces.Discrete(9)
    n = 3 if kind == "vector" else 1
    counts = [0] * n
    story.truth = [[] for _ in range(n)]
    options: Any = {"chunk_size": chunk_size, "durability": durability, "attachments": {}, "capture": "none"}
    with (
        mock.patch.object(writer, "sync_file", sync_file),
        mock.patch.object(journals.Journal, "sync", sync_journal),
        mock.patch.object(writer, "boot_id", return_value=OTHER_BOOT),
    ):
        env: Any
        if kind == "vector":
            envs = [Sampler(space, actions, length=5 + i) for i in range(n)]
            env = RecordVector(SyncVectorEnv([lambda e=e: e for e in envs]), path, **options)
        else:
            env = RecordEpisodes(Sampler(space, actions), path, record_info=kind == "info", **options)
        state, _ = env.reset(seed=1)
        resets = [False] * n
        for t in range(steps):
            action = env.action_space.sample()
            after, reward, terminal, timeout, _ = env.step(action)
            for i in range(n):
                if n == 1:
                    step = (state, action, reward, terminal, timeout, after)
                else:
                    step = (state[i], action[i], reward[i], bool(terminal[i]), bool(timeout[i]), after[i])
                if not resets[i]:
                    story.truth[i].append(step)
                    counts[i] += 1
                resets[i] = n > 1 and (step[3] or step[4])
            state = np.array(after) if n > 1 else after
            note(list(counts))
            if t == steps // 2:
                env.flush()
                note(list(counts))
            if n == 1 and (terminal or timeout or t % 17 == 16):
                state, _ = env.reset()
        note(list(counts))
        env._finalizer.detach()
        env._writer.abandon()  # the power goes
    return story


def crash(story: Story, at: int, place: Path, rng: random.Random) -> list[int]:
    """Writes a possible disk after a power loss at moment `at`; returns the steps that must be there."""
    moments = story.moments
    synced_file, synced_journal = story.synced_file[at], story.synced_journal[at]
    if (
        story.durability == "os" and rng.random() < 0.8
    ):  # the system wrote everything at some moment, each by itself
        synced_file, synced_journal = rng.randrange(at + 1), rng.randrange(at + 1)
    place.write_bytes(_mixed([m.file for m in moments[max(0, synced_file) : at + 1]], rng, synced_file >= 0))
    held = [m.journal for m in moments[max(0, synced_journal) : at + 1] if m.journal is not None]
    target = journal_path(place)
    target.unlink(missing_ok=True)
    if held and (synced_journal >= 0 or rng.random() < 0.9):
        target.write_bytes(_mixed(held, rng, synced_journal >= 0))
    if story.durability == "os" or synced_journal < 0 or synced_file < 0:
        return [0] * len(story.truth)
    return moments[at].steps if story.durability == "step" else _in_file(story, moments[synced_file].file)


def _in_file(story: Story, data: bytes) -> list[int]:
    """Steps by sub-environment in the chunks of a file."""
    counts = [0] * len(story.truth)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with Recording(io.BytesIO(data)) as recording:
            for row in recording.index:
                counts[row["env"]] += int(row["length"])
    return counts


def _mixed(versions: list[bytes], rng: random.Random, synced: bool) -> bytes:
    """Every sector from one of the versions; the first of them is on the disk if `synced`, else nothing is."""
    versions = [b"", *versions] if not synced else versions
    size = rng.choice([len(version) for version in versions])
    eager = rng.random()  # how much of what was written since reached the disk
    found = bytearray(size)
    first, last = versions[0], versions[-1]
    for start in range(0, size, SECTOR):
        a, b = first[start : start + SECTOR], last[start : start + SECTOR]
        chosen = b if rng.random() < eager else a
        if a != b and len(versions) > 2 and rng.random() < 0.5:
            chosen = rng.choice(versions)[start : start + SECTOR]
        chosen = chosen.ljust(min(SECTOR, size - start), b"\0")[: size - start]
        found[start : start + len(chosen)] = chosen
    return bytes(found)


def check(story: Story, place: Path, needed: list[int]) -> int:
    """The number of steps found; AssertionError if one is wrong or out of order, or if a needed one is missing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            recording = Recording(place)
        except FormatError:
            assert not any(needed)
            return 0
    total = 0
    with recording:
        found: list[list[Any]] = [[] for _ in story.truth]
        for episode in recording.episodes:
            found[episode.env].append(episode)
        for i, episodes in enumerate(found):
            n = 0
            for episode in episodes:
                # a chunk may be written by the last step of an episode, before its end is
                synced = needed[i] - (story.durability == "chunk")
                n += _check_episode(story.truth[i], n, episode, must_end=n + len(episode) <= synced)
            assert n >= needed[i], f"{n} steps of {needed[i]} in sub-environment {i}"
            total += n
    return total


def _check_episode(truth: list[Step], first: int, episode: Any, *, must_end: bool) -> int:
    n = len(episode)
    for true, step in zip(truth[first : first + n], episode, strict=True):
        assert same(step.state, true[0]) and step.action == true[1] and step.reward == float(true[2])
        assert (step.terminal, step.timeout) == true[3:5]
    last = truth[first + n - 1]
    if episode.end == "interrupted":
        assert not last[3] and not last[4]
    else:
        assert (episode.end == "terminal", episode.end == "timeout") == (last[3], last[3] < last[4])
    if must_end and episode.end != "interrupted":
        assert episode.final_state is not None
    if episode.final_state is not None:
        assert same(episode.final_state, last[5])
    return n
