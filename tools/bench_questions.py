"""Measures queries over a million episodes on a server: pages of filtered and sorted lists, by users who each may read
a part of the episodes. Server and clients share this machine.

    python tools/bench_questions.py [--directory DIR] [--episodes 1000000] [--database ENGINE] [--only KIND]
                                    [--clients 32] [--workers 2] [--seconds 20]

Makes the database of a server for each ENGINE, sqlite and postgresql (DIR keeps them). Sends each kind of query in
turn. Then many clients send random queries for pages of 20 episodes, each once a second. Exits with 1 if the 95th
percentile of their waiting times is above the limit.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import numpy as np
import psutil
from sqlalchemy import Connection, create_engine

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import postgres
from served import Process, served
from serving import PASSWORD

from tupli_mcap.schema import parse_filter
from tupli_mcap.server.database import audience
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FILE
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import RecordingStamp

SETTINGS = {"shared_buffers": "1GB"}  # as in docs/howto/deploy/compose.yaml
P95_MS = {"postgresql": 100.0, "sqlite": 150.0}
EACH = 10_000  # episodes of a recording
DAY_NS = 24 * 3600 * 10**9
FIRST_NS = 1_750_000_000 * 10**9  # when the first episode ended; each recording is of a day
READERS = ("ann", "bob", "cleo", "dan")
LAB = ("ann", "bob", "cleo")  # cleo has recorded nothing
KEYS = ("metadata.score", "metadata.task", "metadata.success")


# --- what there is ---


def fill(url: str, directory: Path, episodes: int) -> None:
    """Makes the database of a server with so many episodes, without their files."""
    library = Library(Settings(directory, database=url))
    library.first_password()
    with library.database.writing() as connection:
        for name in READERS:
            accounts.create_user(connection, name, accounts.hash_password(PASSWORD, 1))
        ann = accounts.caller_named(connection, "ann")
        accounts.create_group(connection, ann or nobody(), "lab", None)
        ann = accounts.caller_named(connection, "ann")
        for name in LAB[1:]:
            accounts.add_members(connection, ann or nobody(), "lab", [(name, ["contributor"])])
    rng = random.Random(0)
    for number in range(-(-episodes // EACH)):
        with library.database.writing() as connection:
            put(connection, number, rng)
    for key in KEYS:
        with library.database.writing() as connection:
            queries.declare_key(connection, key)
    library.close()


def nobody() -> Caller:
    raise SystemExit("a user is missing")


def put(connection: Connection, number: int, rng: random.Random) -> None:
    """Adds a recording. Of ten, one is private to dan or the admin, one is public, and half of the others are in
    `lab`."""
    owner = ("dan" if number % 100 == 50 else "admin") if number % 10 == 0 else ("ann", "bob")[number % 2]
    groups = [owner, *(["global"] if number % 10 == 9 else ["lab"] if rng.random() < 0.5 else [])]
    seen = audience(connection, groups)
    name, began = f"recordings/{rng.randrange(16**8):08x}.mcap", FIRST_NS + number * DAY_NS
    rows = []
    for i in range(EACH):
        score = rng.random()
        metadata = {"score": score, "success": score > 0.5, "task": f"t{rng.randrange(50)}"}
        facts = rng.randint(8, 500), "terminal", rng.uniform(0, 500), i, began + i * 8 * 10**9
        rows.append(EpisodeRow(i, 0, *facts, owner, seen, json.dumps(metadata)))
    uuid, benchmark = f"{number:032x}", f"b{number % 5}"
    run = {
        "name": f"run-{number // 4}",
        "environment": "Hopper-v5",
        "metadata": {"lr": 10.0 ** -(number % 7)},
    }
    entry = Entry(RecordingStamp(1, 2, 3), uuid, benchmark, rows, json.dumps([run]))
    queries.put_recording(connection, name, entry)
    file = {"path": name, "place": name, "created_by": owner, "uuid": uuid, "deleted": "[]"}
    connection.execute(FILE.insert().values(**file, digest="0" * 64, size=1, episodes=EACH))


@contextlib.contextmanager
def database(engine: str, directory: Path, episodes: int) -> Iterator[str]:
    """The URL of a filled database, made unless the directory has it."""
    with contextlib.ExitStack() as stack:
        filled = directory / engine
        new = not filled.exists()
        if engine == "sqlite":
            url = f"sqlite:///{directory / 'server.sqlite'}"
        else:
            place = directory / "cluster"
            place.mkdir(exist_ok=True)
            cluster = postgres.Cluster(place, **SETTINGS)
            cluster.start()
            stack.callback(cluster.stop, "fast")
            url = f"postgresql+psycopg://postgres@/bench?host={place}"
            if new:
                cluster.execute("CREATE DATABASE bench")
        if new:
            begun = time.perf_counter()
            fill(url, filled, episodes)
            print(f"{engine}: {episodes:,} episodes, listed in {time.perf_counter() - begun:.0f} s")
        if engine == "postgresql":  # autovacuum would do this some minutes later
            engine_of = create_engine(url, isolation_level="AUTOCOMMIT")
            with engine_of.connect() as connection:
                connection.exec_driver_sql("VACUUM ANALYZE")
            engine_of.dispose()
        yield url


# --- what is asked ---


class Question(NamedTuple):
    """A kind of query and its filter; `deep`: with a cursor; `sort`: on the page of episodes."""

    kind: str
    make: Callable[[random.Random], str]
    deep: bool = False
    sort: str = ""


def task(rng: random.Random) -> str:
    return f"metadata.task == 't{rng.randrange(50)}'"


def steps(rng: random.Random) -> str:
    least = rng.randint(8, 490)
    return f"steps >= {least} and steps < {least + 2}"


def day(rng: random.Random) -> str:
    began = time.gmtime(FIRST_NS // 10**9 + rng.randrange(100) * 24 * 3600)
    return f"ended == '{time.strftime('%Y-%m-%d', began)}'"


def score(rng: random.Random) -> str:
    return f"metadata.score > {rng.random()}"


QUESTIONS = (
    Question("the first page", lambda rng: ""),
    Question("a page in the middle", lambda rng: "", deep=True),
    Question("of a benchmark", lambda rng: f"benchmark_id == 'b{rng.randrange(5)}'"),
    Question("of a run", lambda rng: f"run.name == 'run-{rng.randrange(25)}'"),
    Question("of a day", day),
    Question("since a day", lambda rng: day(rng).replace("==", ">=")),
    Question("a task", task),
    Question("a task, a page in the middle", task, deep=True),
    Question("score > x", score),
    Question("score > x, the best 1%", lambda rng: f"metadata.score > {0.99 + rng.random() / 100}"),
    Question("return > x, the best 1%", lambda rng: f"return > {495 + 5 * rng.random()}"),
    Question("steps in [x, x + 2)", steps),
    Question("a task, score > x", lambda rng: f"{task(rng)} and {score(rng)}"),
    Question("a task, steps", lambda rng: f"{task(rng)} and {steps(rng)}"),
    Question("a score beyond all", lambda rng: "metadata.score > 1"),
    Question("what is never together", lambda rng: f"metadata.success == true and metadata.score < {rng.random() / 2}"),
    Question("the page, by return", lambda rng: "", sort="-return"),
    Question("the page, the newest", lambda rng: "", sort="-ended"),
    Question("the page, by score", lambda rng: "", sort="-metadata.score"),
    Question("the page, a task by return", task, sort="-return"),
)  # fmt: skip


class Reader(NamedTuple):
    """A user: the headers that sign in, for the API and for the page; and cursors of pages."""

    token: str
    cookie: str
    cursors: Sequence[str]

    @classmethod
    def signed_in(cls, url: str, name: str) -> Reader:
        with httpx.Client(base_url=url, timeout=600) as client:
            told = {"username": name, "password": PASSWORD}
            token = f"Bearer {client.post('/v1/tokens', json=told).json()['access_token']}"
            session = client.post("/sign-in", data=told).cookies["tupli_mcap_session"]
            cursors = []
            for number in range(5):
                asked = {"limit": 1, "filter": parse_filter(f"benchmark_id == 'b{number}'").to_params_dict()}
                asked["offset"] = 5000
                found = client.post("/v1/episodes/list", json=asked, headers={"Authorization": token}).json()
                cursors += [found["next"]] if found["next"] else []
        return cls(f"Authorization: {token}", f"Cookie: tupli_mcap_session={session}", cursors)

    def asks(self, question: Question, rng: random.Random) -> bytes:
        """A request."""
        text = question.make(rng)
        if question.sort:
            target = httpx.URL("/episodes", params={"format": "json", "sort": question.sort, "filter": text})
            return f"GET {target} HTTP/1.1\r\nHost: x\r\n{self.cookie}\r\n\r\n".encode()
        wanted = parse_filter(text).to_params_dict() if text else None
        told: dict[str, Any] = {"filter": wanted, "limit": 20}
        if question.deep and self.cursors:
            told["cursor"] = rng.choice(self.cursors)
        body = json.dumps(told).encode()
        head = (
            "POST /v1/episodes/list HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
            f"{self.token}\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        return head.encode() + body


async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes, what: str) -> float:
    """Times one answer (ms); prints refusals."""
    begun = time.perf_counter()
    writer.write(request)
    told = (await reader.readuntil(b"\r\n\r\n")).lower()
    answer = await reader.readexactly(int(told.partition(b"content-length: ")[2].partition(b"\r\n")[0]))
    taken = (time.perf_counter() - begun) * 1e3
    if b" 200 " not in told.split(b"\r\n")[0]:
        print(f"    {what}: refused after {taken:.0f} ms: {answer.decode():.100}")
    return taken


async def in_turn(
    server: Process, readers: Mapping[str, Reader], asked: Sequence[Question], repeats: int
) -> None:
    """Prints the time of each kind for each user, without other load."""
    print(
        f"  one client, ms, median of {repeats} (at most){'':6}" + "".join(f"{name:>18}" for name in readers)
    )
    stream = await asyncio.open_connection("127.0.0.1", server.port)
    for question in asked:
        line = f"    {question.kind:44}"
        for name, reader in readers.items():
            rng = random.Random(1)
            requests = [reader.asks(question, rng) for _ in range(repeats)]
            times = [await ask(*stream, request, f"{question.kind}, {name}") for request in requests]
            line += f"{percentile(times, 50):9.1f} ({max(times):6.1f})"
        print(line, flush=True)
    stream[1].close()


async def at_once(
    server: Process, readers: Mapping[str, Reader], asked: Sequence[Question], options: argparse.Namespace
) -> dict[str, list[float]]:
    """Runs clients that send random queries, each once a second; returns the times by kind."""
    taken: dict[str, list[float]] = {}
    end = time.perf_counter() + options.seconds

    async def client(number: int) -> None:
        rng = random.Random(number)
        reader = list(readers.values())[number % len(readers)]
        await asyncio.sleep(rng.random())  # whoever connects in the same moment gets the same process
        stream = await asyncio.open_connection("127.0.0.1", server.port)
        while (begun := time.perf_counter()) < end:
            question = rng.choice(asked)
            took = await ask(*stream, reader.asks(question, rng), question.kind)
            taken.setdefault(question.kind, []).append(took)
            await asyncio.sleep(max(0.0, 1 - (time.perf_counter() - begun)))
        stream[1].close()

    await asyncio.gather(*(client(number) for number in range(options.clients)))
    return taken


def measure(server: Process, options: argparse.Namespace) -> float:
    """Prints the times of queries; returns the 95th percentile of all of them under load."""
    readers = {name: Reader.signed_in(server.url, name) for name in ("admin", *READERS)}
    asked = [question for question in QUESTIONS if options.only in question.kind]
    asyncio.run(in_turn(server, readers, asked, options.repeats))
    if not options.clients:
        return 0.0
    before = worked(server)
    taken = asyncio.run(at_once(server, readers, asked, options))
    every = [each for times in taken.values() for each in times]
    used = (worked(server) - before) * 1e3 / len(every)
    print(f"  {options.clients} clients, each once a second: {len(every)} answers; ms, median and p95")
    print(f"    the server works {used:.1f} ms for an answer; that of PostgreSQL is not in it")
    for kind, times in (*taken.items(), ("all", every)):
        print(f"    {kind:44}{percentile(times, 50):9.1f}{percentile(times, 95):9.1f}")
    return percentile(every, 95)


def worked(server: Process) -> float:
    """The CPU time (s) of the processes of a server."""
    process = psutil.Process(server.pid)
    times = [each.cpu_times() for each in (process, *process.children(recursive=True))]
    return float(sum(each.user + each.system for each in times))


def percentile(values: Sequence[float], of: float) -> float:
    return float(np.percentile(values, of))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--directory", type=Path, help="where the databases are kept; by default a temporary one"
    )
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument("--database", choices=tuple(P95_MS), help="by default both")
    parser.add_argument("--only", default="", help="kinds of questions that have this in their names")
    parser.add_argument("--repeats", type=int, default=5, help="of each question, by one client")
    parser.add_argument("--clients", type=int, default=32, help="0 for none but the one")
    parser.add_argument("--workers", type=int, default=2, help="processes of the server")
    parser.add_argument("--seconds", type=float, default=20, help="of asking by many clients")
    options = parser.parse_args()
    os.environ["TUPLI_MCAP_ADMIN_PASSWORD"] = PASSWORD
    print(f"load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    good = True
    with tempfile.TemporaryDirectory(prefix="bench") as folder:
        directory = options.directory or Path(folder)
        directory.mkdir(parents=True, exist_ok=True)
        directory.chmod(0o755)
        for engine in [options.database] if options.database else P95_MS:
            with database(engine, directory, options.episodes) as url:
                arguments = ("--database", url, "--workers", str(options.workers))
                with served(directory / engine, *arguments) as server:
                    print(f"{engine}:")
                    p95 = measure(server, options)
            good &= p95 <= P95_MS[engine]
            print(f"  must reach: {P95_MS[engine]:.0f} ms")
    sys.exit(not good)


if __name__ == "__main__":
    main()
