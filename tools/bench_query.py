"""Measures queries for 1% of 9,000 short episodes on a server: bytes, seconds to the first byte, and the server's
memory.

`python tools/bench_query.py` records CartPole on a server of its own. It queries as `POST /v1/query`, as datasets and
as `pull` do. A proxy counts the bytes of all connections in both directions. Exits with 1 if a figure misses its limit.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import httpx
import numpy as np
import psutil
from gymnasium import spaces

import tupli_mcap
from tupli_mcap import (
    EpisodeData,
    F,
    Recording,
    TupliAPIClient,
    TupliDataset,
    TupliEnvWrapper,
    write_recording,
)
from tupli_mcap.remote import source
from tupli_mcap.schema import EpisodeMetadataCallback

PASSWORD = "bench-password"
PROGRAM = str(Path(sys.executable).with_name("tupli-mcap"))
MOST_SENT = 0.02  # of the file
MOST_MS = 100  # to the first byte, at best
MOST_MEMORY = 10 << 20  # of the server, for each query at a time
CHOSEN = F("metadata.chosen") == True  # noqa: E712 - an expression


class Hundredth(EpisodeMetadataCallback):
    """Chooses every hundredth episode."""

    count = 0

    def reset(self) -> None:
        pass

    def __call__(self, tuple: Any) -> dict[str, Any]:
        if tuple.terminal or tuple.timeout:
            self.count += 1
        return {"chosen": self.count % 100 == 1}


class Counter:
    """A proxy that counts bytes."""

    def __init__(self, port: int) -> None:
        self.sent = 0
        self._to = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            near, _ = self._listening.accept()
            far = socket.create_connection(("127.0.0.1", self._to))
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._hand_on, args=(one, other), daemon=True).start()

    def _hand_on(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(1 << 16):
                self.sent += len(data)
                other.sendall(data)
            other.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def served(directory: Path) -> Iterator[tuple[int, psutil.Process]]:
    """The port of a server, and its process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [PROGRAM, "serve", str(directory), "--port", str(port)]
    environment = {**os.environ, "TUPLI_MCAP_ADMIN_PASSWORD": PASSWORD}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL) as process:
        try:
            while True:
                with contextlib.suppress(OSError):
                    socket.create_connection(("127.0.0.1", port)).close()
                    break
                time.sleep(0.1)
            yield port, psutil.Process(process.pid)
        finally:
            process.terminate()


def record(client: TupliAPIClient, episodes: int) -> tuple[str, int]:
    """CartPole on a server; the benchmark's id, and the size of the recording."""
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage=client, metadata_callback=Hundredth())
    uri = env.store(name="cartpole")
    env.activate_recording()
    env.action_space.seed(0)
    for i in range(episodes):
        env.reset(seed=i)
        done = False
        while not done:
            *_, terminal, timeout, _ = env.step(env.action_space.sample())
            done = terminal or timeout
    env.close()
    client.flush()
    (name,) = {header.recording for header in client.list_episodes()}
    return uri.id if hasattr(uri, "id") else uri, client.open_recording(name).size


def measure_memory(server: psutil.Process, client: TupliAPIClient, place: Path, transfers: int) -> bool:
    """Prints how much more memory a server takes while it cuts a recording for many slow clients at once; returns
    whether that is within the limit."""
    random, steps = np.random.default_rng(0), 2000
    episodes = [
        EpisodeData(
            random.normal(size=(steps, 32)).astype(np.float32), random.normal(size=(steps, 4)).astype(np.float32),
            np.zeros(steps), np.zeros(steps, bool), np.arange(steps) == steps - 1,
        )
        for _ in range(300)
    ]  # fmt: skip
    box = spaces.Box(-np.inf, np.inf, (32,)), spaces.Box(-np.inf, np.inf, (4,))
    write_recording(place / "large.mcap", episodes, observation_space=box[0], action_space=box[1])
    told = {"recordings": [client.push(place / "large.mcap")], "episodes": list(range(0, 300, 2))}
    token = {"Authorization": f"Bearer {client._session._token()}"}
    came: list[int] = []

    def take() -> None:
        with httpx.stream("POST", f"{client.url}/v1/query", json=told, headers=token, timeout=600) as answer:
            came.append(sum(len(piece) for piece in answer.iter_raw()))

    before = most = server.memory_info().rss
    began = time.perf_counter()
    threads = [threading.Thread(target=take) for _ in range(transfers)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        most = max(most, server.memory_info().rss)
        time.sleep(0.02)
    seconds = time.perf_counter() - began
    print(
        f"{transfers} queries at a time, each of {min(came):,} B: {(most - before) / 2**20:.0f} MiB above start, "
        f"{sum(came) / seconds / 1e6:.0f} MB/s (must reach: at most {transfers * MOST_MEMORY >> 20} MiB)"
    )
    return most - before <= transfers * MOST_MEMORY


def measure_queries(client: TupliAPIClient, counter: Counter, place: Path, uri: str, size: int) -> bool:
    """Prints what queries cost; returns whether that is within the limits."""
    parts: list[float] = []
    firsts: list[float] = []

    def cost(what: str, act: Callable[[], Any]) -> Any:
        source._blocks = source._Blocks(source.BLOCK_BYTES)
        before, began = counter.sent, time.perf_counter()
        found = act()
        seconds = time.perf_counter() - began
        sent = counter.sent - before
        parts.append(sent / size)
        print(f"{what:36} {sent:10,} B {sent / size:7.2%} of the file  {seconds:6.3f} s")
        return found

    token = {"Authorization": f"Bearer {client._session._token()}"}
    told = {"filter": CHOSEN.model_dump(mode="json")}

    def query() -> bytes:
        began = time.perf_counter()
        with httpx.stream("POST", f"{counter.url}/v1/query", json=told, headers=token) as answer:
            pieces = answer.iter_raw()
            first = next(pieces)
            firsts.append(1e3 * (time.perf_counter() - began))
            return first + b"".join(pieces)

    for _ in range(5):
        (place / "cut.mcap").write_bytes(cost("POST /v1/query", query))
    print(
        f"first byte after {min(firsts):.1f} ms (must reach: at most {MOST_MS}), at worst {max(firsts):.1f} ms"
    )
    with Recording(place / "cut.mcap") as cut:
        print(f"{len(cut)} episodes came, {cut.size / size:.2%} of the file")
    dataset = TupliDataset(client).with_episode_filter(CHOSEN)
    cost("TupliDataset(client) … .load()", dataset.load)
    some = tupli_mcap.open(counter.url).filter("metadata.chosen")
    cost("open(URL).filter(…).read()", some.read)
    cost("… .save(), of what is open", lambda: some.save(place / "saved.mcap"))
    again = tupli_mcap.open(counter.url).filter("metadata.chosen")
    cost("open(URL).filter(…).save()", lambda: again.save(place / "again.mcap"))
    chosen_of = ["--filter", "metadata.chosen", "--url", counter.url]
    command = ["pull", uri, "--storage", str(place / "lab"), *chosen_of]
    cost("tupli-mcap pull --filter", lambda: subprocess.run([PROGRAM, *command], check=True))
    print(f"at most {max(parts):.2%} of the file (must reach: at most {MOST_SENT:.0%})")
    good = max(parts) <= MOST_SENT and min(firsts) <= MOST_MS
    cost("open(URL).read(), all of it", lambda: tupli_mcap.open(counter.url).read(["rewards"]))
    return good


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=9000)
    parser.add_argument(
        "--transfers", type=int, default=32, help="queries at a time, for the server's memory"
    )
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        os.environ["TUPLI_MCAP_CONFIG_DIR"] = os.environ["TUPLI_MCAP_DATA_DIR"] = str(place / "own")
        os.environ["TUPLI_MCAP_CACHE_DIR"] = str(place / "cache")
        with served(place / "served") as (port, server):
            counter = Counter(port)
            client = TupliAPIClient(counter.url)
            client.login("admin", PASSWORD)
            uri, size = record(client, chosen.episodes)
            print(f"{chosen.episodes:,} episodes in {size:,} B")

            good = measure_queries(client, counter, place, uri, size)
            good &= measure_memory(server, client, place, chosen.transfers)
    sys.exit(not good)


if __name__ == "__main__":
    main()
