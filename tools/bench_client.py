"""Measures recording 1,000 short episodes to a server, beside PyTupli, which sends a JSON document per episode.

    python tools/bench_client.py [--episodes 1000] [--rounds 3]

Both sides are a client and a server process on this machine. They record the same rollout, CartPole-v1 with episodes of
22 steps, through their own `TupliEnvWrapper`. The time ends when a query finds the last episode.

PyTupli's side is PyTupli 1.2.9, client and server as they are on PyPI, with two changes in the server's process.
mongomock-motor replaces MongoDB: it keeps documents in the memory of that process, so it is faster than a real one.
argon2 hashes passwords, because passlib's bcrypt does not work with today's bcrypt. It needs the extra `bench`, and
`pip install --no-deps pytupli==1.2.9`.

Our side is `tupli-mcap serve` with SQLite and a directory.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

STEPS = 22
PASSWORD = "correct horse battery staple"


def roll(env: Any, episodes: int) -> None:
    """Keeps the pole up for 22 steps, in each of some episodes."""
    for seed in range(episodes):
        state, _ = env.reset(seed=seed)
        done = False
        while not done:
            state, _, terminated, truncated, _ = env.step(np.int64(state[2] + state[3] > 0))
            done = terminated or truncated


def make() -> gym.Env[Any, Any]:
    return gym.make("CartPole-v1", max_episode_steps=STEPS)


def signed_in(url: str) -> Any:
    from tupli_mcap.storage import TupliAPIClient

    client = TupliAPIClient(url)
    client.login("admin", PASSWORD)
    return client


def pytupli_signed_in(url: str) -> Any:
    import keyring
    import keyring.backend
    from pytupli.storage import TupliAPIClient

    class Memory(keyring.backend.KeyringBackend):
        priority = 1.0
        kept: dict[str, str] = {}  # noqa: RUF012 - one in a process

        def get_password(self, service: str, username: str) -> str | None:
            return self.kept.get(username)

        def set_password(self, service: str, username: str, password: str) -> None:
            self.kept[username] = password

        def delete_password(self, service: str, username: str) -> None:
            self.kept.pop(username, None)

    keyring.set_keyring(Memory())
    client = TupliAPIClient()
    client.login("admin", PASSWORD, url)
    return client


def rollout(url: str, episodes: int) -> float:
    """Our wrapper records a rollout."""
    from tupli_mcap import TupliEnvWrapper
    from tupli_mcap.schema import FilterEQ

    client = signed_in(url)
    env = TupliEnvWrapper(make(), client)
    env.store(name=f"cart {time.time_ns()}")
    begun = time.perf_counter()
    roll(env, episodes)
    env.close()
    found = client.count_episodes(FilterEQ(key="benchmark_id", value=env.id))
    return _taken(begun, found, episodes)


def pytupli_rollout(url: str, episodes: int) -> float:
    """PyTupli's wrapper records a rollout."""
    from pytupli.benchmark import TupliEnvWrapper
    from pytupli.schema import FilterEQ

    client = pytupli_signed_in(url)
    env = TupliEnvWrapper(make(), storage=client)
    env.store(name=f"cart {time.time_ns()}")
    begun = time.perf_counter()
    roll(env, episodes)
    found = len(client.list_episodes(FilterEQ(key="benchmark_id", value=env.id)))
    return _taken(begun, found, episodes)


def at_once(url: str, episodes: int) -> float:
    """Episodes built by hand, stored by one call of our client."""
    from tupli_mcap import schema

    client = signed_in(url)
    given = by_hand(schema, client, episodes)
    begun = time.perf_counter()
    client.record_episodes(given)
    found = client.count_episodes(schema.FilterEQ(key="benchmark_id", value=given[0].benchmark_id))
    return _taken(begun, found, episodes)


def one_by_one(url: str, episodes: int) -> float:
    """Episodes built by hand, each stored by a call of our client."""
    from tupli_mcap import schema

    client = signed_in(url)
    given = by_hand(schema, client, episodes)
    begun = time.perf_counter()
    for episode in given:
        client.record_episode(episode)
    found = client.count_episodes(schema.FilterEQ(key="benchmark_id", value=given[0].benchmark_id))
    return _taken(begun, found, episodes)


def pytupli_by_hand(url: str, episodes: int) -> float:
    """Episodes built by hand, each stored by a call of PyTupli's client."""
    from pytupli import schema

    client = pytupli_signed_in(url)
    given = by_hand(schema, client, episodes)
    begun = time.perf_counter()
    for episode in given:
        client.record_episode(episode)
    found = len(client.list_episodes(schema.FilterEQ(key="benchmark_id", value=given[0].benchmark_id)))
    return _taken(begun, found, episodes)


def by_hand(schema: Any, client: Any, episodes: int) -> list[Any]:
    """Episodes of a benchmark that nobody can rebuild, in the models of either side."""
    metadata = schema.BenchmarkMetadata(name=f"by hand {time.time_ns()}")
    query = schema.BenchmarkQuery(hash=str(time.time_ns()), serialized='{"by": "hand"}', metadata=metadata)
    uri = client.store_benchmark(query).id
    rng = np.random.default_rng(0)

    def tuples() -> list[Any]:
        states = rng.normal(size=(STEPS, 4)).tolist()
        return [
            schema.RLTuple(
                state=state, action=i % 2, reward=1.0, info={}, terminal=i == STEPS - 1, timeout=False
            )
            for i, state in enumerate(states)
        ]

    return [schema.Episode(benchmark_id=uri, metadata={}, tuples=tuples()) for _ in range(episodes)]


def _taken(begun: float, found: int, episodes: int) -> float:
    taken = time.perf_counter() - begun
    if found != episodes:
        raise SystemExit(f"expected {episodes} episodes, found {found}")
    return taken


def steps_alone(_: str, episodes: int) -> float:
    """The rollout without any recording."""
    begun = time.perf_counter()
    roll(make(), episodes)
    return time.perf_counter() - begun


# --- processes ---


def serve_pytupli(port: int) -> None:
    """PyTupli's server, with a MongoDB in memory. Does not return."""
    import motor.motor_asyncio
    import uvicorn
    from mongomock_motor import AsyncMongoMockClient
    from passlib.context import CryptContext

    motor.motor_asyncio.AsyncIOMotorClient = AsyncMongoMockClient
    from pytupli.server.db.db_handler import MongoDBHandler
    from pytupli.server.management import authorization

    async def ping(self: Any) -> int:
        return 1

    MongoDBHandler.ping = ping
    authorization.pwd_context = CryptContext(schemes=["argon2"])
    from pytupli.server.main import app

    uvicorn.run(app, host="127.0.0.1", port=port, log_level="warning")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextlib.contextmanager
def running(command: list[str], port: int, **variables: str) -> Iterator[str]:
    """Starts a server process; yields its address once it answers."""
    url = f"http://127.0.0.1:{port}"
    process = subprocess.Popen(command, env={**os.environ, **variables}, stdout=subprocess.DEVNULL)
    try:
        while True:
            with contextlib.suppress(OSError):
                urllib.request.urlopen(url, timeout=1).close()
                break
            if process.poll() is not None:
                raise SystemExit(f"{command} has ended")
            time.sleep(0.05)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def measured(kind: Callable[[str, int], float], url: str, episodes: int) -> float:
    """Measures one kind in a process of its own."""
    command = [sys.executable, __file__, "--run", kind.__name__, "--url", url, "--episodes", str(episodes)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout)


KINDS = (steps_alone, rollout, pytupli_rollout, at_once, one_by_one, pytupli_by_hand)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3, help="of which the median counts")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("--url", default="", help=argparse.SUPPRESS)
    parser.add_argument("--serve-pytupli", type=int, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    kinds = {kind.__name__: kind for kind in KINDS}
    if chosen.serve_pytupli:
        serve_pytupli(chosen.serve_pytupli)
        return
    if chosen.run:
        print(kinds[chosen.run](chosen.url, chosen.episodes))
        return
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        places = {f"TUPLI_MCAP_{each}_DIR": str(Path(folder) / each) for each in ("CONFIG", "DATA", "CACHE")}
        os.environ.update(places)
        port, other = free_port(), free_port()
        serve = [sys.executable, "-c", "from tupli_mcap.cli import main; main()", "serve", f"{folder}/served"]
        mine = stack.enter_context(
            running([*serve, "--port", str(port)], port, TUPLI_MCAP_ADMIN_PASSWORD=PASSWORD)
        )
        command = [sys.executable, __file__, "--serve-pytupli", str(other)]
        theirs = stack.enter_context(running(command, other, API_SECRET_KEY="x" * 40, DB_ADMIN_PW=PASSWORD))
        times: dict[str, list[float]] = {name: [] for name in kinds}
        for _ in range(chosen.rounds):
            for name, kind in kinds.items():
                url = theirs if name.startswith("pytupli") else mine
                times[name].append(measured(kind, url, chosen.episodes))
    sys.exit(not report(times, chosen.episodes))


def report(times: dict[str, list[float]], episodes: int) -> bool:
    """Prints the figures; returns whether they are within the limits."""
    median = {name: statistics.median(each) for name, each in times.items()}
    print(f"{episodes} episodes of {STEPS} steps, stored and found: seconds, median and all")
    for kind in KINDS:
        name, each = kind.__name__, ", ".join(f"{seconds:.2f}" for seconds in times[kind.__name__])
        print(f"  {name:16}{median[name]:7.2f}   {each:24}  {(kind.__doc__ or '').rstrip('.')}")
    whole = median["pytupli_rollout"] / median["rollout"]
    steps = median["steps_alone"]
    recording = (median["pytupli_rollout"] - steps) / (median["rollout"] - steps)
    print(f"recording a rollout: PyTupli's takes {recording:.1f} times as long (must reach: 20);")
    print(f"  the environment's own steps included, {whole:.1f} times")
    print(
        f"built by hand: {median['pytupli_by_hand'] / median['at_once']:.1f} times as long as at once, ",
        end="",
    )
    print(f"{median['pytupli_by_hand'] / median['one_by_one']:.1f} times as long as one by one")
    return recording >= 20


if __name__ == "__main__":
    main()
