"""Kills clients of a server and breaks their connections, while they record, push and pull.

    python tools/client_faults.py --rounds 100 --seed 1

In each round, one or two processes record to a server, or one pushes or pulls a directory, through a proxy that
refuses, resets, stalls, answers 503, flips bits, or is down for a while. The processes are killed at a random moment,
or end by themselves. Then another process uses the server again, or repeats the push or pull, over a good connection.
After that:

- each step whose `step()` returned is on the server, exact, and no episode is there twice;
- nothing waits to be sent, and no recording has failed or waited for the server;
- what was pushed or pulled is there once and unchanged, and every file is whole.

Exit code 1 at a finding.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import struct
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from between import Between, Fault, between
from serving import PASSWORD, serving

from tupli_mcap import FileStorage, TupliEnvWrapper, verify_recording
from tupli_mcap.errors import StorageError
from tupli_mcap.schema import F, FilterEQ
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient, TupliStorage
from tupli_mcap.storage.benchmark_json import unpack
from tupli_mcap.storage.exchange import copy_episodes

_STEP = struct.Struct("<III")  # episode, steps that have returned, whether it has ended
_KINDS = ("record", "record", "push", "pull")
_FAULTS = ("pass", "pass", "refuse", "reset", "reset", "5xx", "flip", "flip up", "stall")


class Told(gym.Env[Any, Any]):
    """An environment whose states identify themselves: (token, episode, step)."""

    observation_space = gym.spaces.Box(0, 1 << 40, (3,), np.int64)
    action_space = gym.spaces.Discrete(1 << 30)

    def __init__(self, token: int) -> None:
        self.token, self.episode, self.steps = token, 0, 0

    def _state(self) -> Any:
        return np.array([self.token, self.episode, self.steps], np.int64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode, self.steps = seed or 0, 0
        return self._state(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._state(), float(self.steps), self.steps >= length(self.episode), False, {}


def length(episode: int) -> int:
    """The number of steps of an episode."""
    return 5 + episode * 37 % 60


# --- the processes that are killed ---


def record(url: str, token: int, ledger: str, seed: int) -> None:
    """Records until it is told to stop; writes down each step that has returned."""
    rng = random.Random(seed)
    client = TupliAPIClient(url)
    env = TupliEnvWrapper(Told(token), client, chunk_size=rng.choice([4096, 1 << 18]))
    env.store(name=f"token {token}")
    notes = os.open(ledger, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    print("ready", flush=True)
    for episode in range(rng.randrange(20, 400)):
        env.reset(seed=episode)
        done, steps = False, 0
        while not done:
            before = time.monotonic()
            _, _, done, _, _ = env.step(episode)
            if time.monotonic() - before > 20:
                raise SystemExit("a step waited for the server")
            steps += 1
            os.write(notes, _STEP.pack(episode, steps, done))
            if rng.random() < 0.002:
                time.sleep(0.01)
        if rng.random() < 0.1:
            with contextlib.suppress(StorageError):
                client.count_episodes()
        if rng.random() < 0.03:
            env.deactivate_recording()
            env.activate_recording()
    env.close()


CHILD = [sys.executable, str(Path(__file__).resolve()), "--child"]
CLI = [sys.executable, "-W", "ignore", "-c", "from tupli_mcap.cli import main; main()"]


# --- what must hold ---


def noted(ledger: Path) -> dict[int, tuple[int, bool]]:
    """By episode, the steps that have returned, and whether it has ended."""
    found: dict[int, tuple[int, bool]] = {}
    data = ledger.read_bytes() if ledger.exists() else b""
    for at in range(0, len(data) - len(data) % _STEP.size, _STEP.size):
        episode, steps, ended = _STEP.unpack_from(data, at)
        found[episode] = (steps, bool(ended))
    return found


def recorded_wrong(client: TupliStorage, token: int, ledger: Path) -> Iterator[str]:
    """Sentences on recorded steps that the server lacks, or has wrongly."""
    ids = [h.id for h in client.list_benchmarks() if h.metadata.name == f"token {token}"]
    found: dict[int, list[Any]] = {}
    for item in client.list_episodes(F("benchmark_id").isin(ids), include_tuples=True) if ids else []:
        found.setdefault(int(item.seed or 0), []).append(item)
    for episode, (steps, ended) in noted(ledger).items():
        items = found.get(episode, [])
        if len(items) != 1:
            yield f"token {token}: expected episode {episode} once, found it {len(items)} times"
        elif len(items[0].tuples) < steps or (ended and items[0].end != "terminal"):
            yield f"token {token}: episode {episode} has {len(items[0].tuples)} of {steps} steps, {items[0].end}"
    for episode, items in found.items():
        states = [tuple(map(int, each.state)) for each in items[0].tuples]
        if states != [(token, episode, i) for i in range(len(states))]:
            yield f"token {token}: episode {episode} is not what it was"


def copied_wrong(one: TupliStorage, other: TupliStorage, uri: str) -> Iterator[str]:
    """Sentences on differences between two storages of a benchmark."""
    of_it = FilterEQ(key="benchmark_id", value=uri)
    items: list[list[Any]] = [
        list(storage.list_episodes(of_it, include_tuples=True)) for storage in (one, other)
    ]
    first, second = (sorted(of_one, key=lambda item: item.id) for of_one in items)
    if [item.id for item in first] != [item.id for item in second]:
        yield f"expected {len(first)} episodes, found {len(second)}"
    elif any(a.tuples != b.tuples for a, b in zip(first, second, strict=True)):
        yield "episodes have other contents"
    digests = {unpack(storage.load_benchmark(uri).serialized).record.digest for storage in (one, other)}
    if len(digests) > 1:
        yield "the benchmark has another environment"
    if isinstance(other, FileStorage):
        for path in other.root.rglob("*.mcap"):
            if not verify_recording(path).ok:
                yield f"{path.name} is not whole"


# --- a round ---


class Rounds:
    """Runs rounds against one server."""

    def __init__(self, url: str, proxy: Between, folder: Path) -> None:
        self.proxy, self.folder = proxy, folder
        self._set(folder / "mine")
        self.direct = TupliAPIClient(url)
        self.direct.login("admin", PASSWORD)

    def _set(self, place: Path) -> None:
        for each in ("CONFIG", "DATA", "CACHE"):
            os.environ[f"TUPLI_MCAP_{each}_DIR"] = str(place / each)

    def run(self, number: int, rng: random.Random) -> list[str]:
        """Runs a round; returns what went wrong."""
        place = self.folder / str(number)
        self._set(place)
        kind = rng.choice(_KINDS)
        with TupliAPIClient(self.proxy.url) as client:
            client.login("admin", PASSWORD)
        return list(getattr(self, kind)(number, place, rng))

    def record(self, number: int, place: Path, rng: random.Random) -> Iterator[str]:
        tokens = [number * 10 + i for i in range(rng.choice([1, 1, 2]))]
        commands = [
            [*CHILD, "record", self.proxy.url, str(token), str(place / f"{token}.ledger"), str(rng.random())]
            for token in tokens
        ]
        yield from self._broken(commands, rng, ready=True)
        with TupliAPIClient(self.proxy.url) as client:
            client.login("admin", PASSWORD)
            client.flush(everything=True)
            if client.waiting():
                yield f"{len(client.waiting())} recordings wait"
        for token in tokens:
            yield from recorded_wrong(self.direct, token, place / f"{token}.ledger")

    def push(self, number: int, place: Path, rng: random.Random) -> Iterator[str]:
        uri = self._lab(place / "lab", number)
        yield from self._broken([[*CLI, "push", str(place / "lab"), "--url", self.proxy.url]], rng)
        with FileStorage(place / "lab") as lab, TupliAPIClient(self.proxy.url) as client:
            client.login("admin", PASSWORD)
            copy_episodes(lab, client, benchmark_id=uri)
            yield from copied_wrong(lab, self.direct, uri)

    def pull(self, number: int, place: Path, rng: random.Random) -> Iterator[str]:
        uri = self._lab(place / "lab", number)
        with FileStorage(place / "lab") as lab, FileStorage(place / "pulled") as pulled:
            copy_episodes(lab, self.direct, benchmark_id=uri)
            command = [*CLI, "pull", uri, "--storage", str(place / "pulled"), "--url", self.proxy.url]
            yield from self._broken([command], rng)
            with TupliAPIClient(self.proxy.url) as client:
                client.login("admin", PASSWORD)
                copy_episodes(client, pulled, benchmark_id=uri)
                yield from copied_wrong(lab, pulled, uri)

    def _lab(self, path: Path, number: int) -> str:
        """A directory with three recordings of a benchmark."""
        with FileStorage(path) as lab:
            env = TupliEnvWrapper(Told(number), lab)
            uri = env.store(name=f"lab {number}")
            for episode in range(12):
                env.reset(seed=episode)
                while not env.step(episode)[2]:
                    pass
                if episode % 4 == 3:
                    env.deactivate_recording()
                    env.activate_recording()
                    env._path = None  # another file
            env.close()
        return uri

    def _broken(self, commands: list[list[str]], rng: random.Random, *, ready: bool = False) -> Iterator[str]:
        """Runs processes over a bad connection, and kills them at a random moment; yields their errors."""
        processes = [
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            for command in commands
        ]
        for process in processes if ready else ():
            process.stdout.readline()  # type: ignore[union-attr]
        self.proxy.drop()
        self.proxy.faults.extend(
            Fault(rng.choice(_FAULTS), int(10 ** rng.uniform(1, 5))) for _ in range(rng.randrange(12))
        )
        away = rng.random() < 0.3
        if away:
            self.proxy.go_away()
        deadline = rng.choice([rng.uniform(0, 2), rng.uniform(0, 8), 600.0])
        threading.Timer(rng.uniform(0, 3), self.proxy.come_back).start() if away else None
        threading.Timer(rng.uniform(1, 4), self.proxy.release).start()
        begun = time.monotonic()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - (time.monotonic() - begun)))
        ended = [process.poll() for process in processes]
        for process in processes:
            process.kill()
        said = [process.communicate()[1] for process in processes]
        while away and not self.proxy.listens:
            time.sleep(0.01)
        self.proxy.faults.clear()
        self.proxy.drop()
        for code, text in zip(ended, said, strict=True):
            if ready and code not in (None, 0):
                yield f"a recorder has ended with {code}: {text}"
            elif "Traceback" in text:
                yield f"a traceback: {text}"


def campaign(rounds: int, seed: int, folder: Path) -> Iterator[tuple[int, list[str]]]:
    """Runs rounds; yields what went wrong in each."""
    warnings.simplefilter("ignore")
    with serving(Settings(folder / "served")) as url, between(url) as proxy:
        all_rounds = Rounds(url, proxy, folder)
        for number in range(1, rounds + 1):
            yield number, all_rounds.run(number, random.Random(f"{seed} {number}"))


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        url, token, ledger, seed = sys.argv[3:]
        record(url, int(token), ledger, hash(seed))
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, wrong in campaign(chosen.rounds, chosen.seed, Path(folder)):
            bad += bool(wrong)
            for line in wrong:
                print(f"round {number}: {line}", flush=True)
    print(f"{chosen.rounds} rounds, {bad} with findings")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
