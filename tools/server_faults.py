"""Kills a server, its database and its object store while users work, and breaks their connections.

    python tools/server_faults.py --kills 300 --seed 1 --engine postgresql [--only database]

Three users store, fetch, publish and delete recordings and artifacts at the same time, through a proxy that refuses,
resets, stalls, answers 503 and flips bits. At a random moment, the server is killed, its PostgreSQL crashes, or its
object store (SeaweedFS) is killed; a while later it is back. A store that is back resets some connections, and answers
some with 503. Every tenth kill hits a server that upgrades the tables of the first version. After each:

- everything acknowledged is there, whole and exact, and nothing that was deleted;
- a request without an answer has happened completely, or not at all, and not twice;
- repeating it has the same effect as one request;
- each stored file is named by the database or waits to be deleted, and no named file is missing; after the next start,
  nothing waits.

Exit code 1 at a finding.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
from sqlalchemy import select

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import buckets
import postgres
from acknowledged import User
from between import Between, Fault, between
from first_tables import fill_first
from persons import Person
from serving import PASSWORD

from tupli_mcap.schema import F
from tupli_mcap.server import run
from tupli_mcap.server.database import Database, pending
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FILE, ITEM, UPLOAD
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.texts import unescape_text

ENGINES = ("sqlite", "postgresql")
VICTIMS = ("server", "database", "bucket")
_FAULTS = ("pass", "pass", "refuse", "reset", "reset", "5xx", "flip", "flip up", "stall")
_OWN = {"secret", "uploads", "making", "server.sqlite", "server.sqlite-wal", "server.sqlite-shm"}
_USERS = ("ann", "bob", "eve")
_PENDING = 3.0  # seconds


class Server:
    """A server process that can be restarted on the same port after a kill."""

    def __init__(self, settings: Settings, environment: dict[str, str]) -> None:
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["__main__", "tupli_mcap.server.run"])
        self._settings, self._environment = settings, environment
        self.port = 0

    def launch(self) -> None:
        """Starts it, and does not wait."""
        told, tells = self._context.Pipe(False)
        arguments = (self._settings, self.port, self._environment, tells)
        self._process = self._context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        self._told = told

    def start(self) -> None:
        """Starts it, and waits until it is ready."""
        self.launch()
        while not self._told.poll(0.1):
            assert self._process.is_alive(), "the server has not started"
        self.url = self._told.recv()
        self.port = int(self.url.rpartition(":")[2])
        self.wait()

    def wait(self) -> None:
        """Waits until it is ready."""
        end = time.monotonic() + 120
        while time.monotonic() < end:
            assert self._process.is_alive(), "the server has ended"
            with contextlib.suppress(httpx.TransportError):
                if httpx.get(f"{self.url}/ready", verify=False, timeout=60).status_code == 200:
                    return
            time.sleep(0.02)
        raise TimeoutError("the server is not ready")

    def kill(self) -> None:
        self._process.kill()
        self._process.join()


def _serve(settings: Settings, port: int, environment: dict[str, str], tells: Any) -> None:
    os.environ.update(environment)
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 2)  # its log
    run.run(settings, run.Listening(port=port), lambda url, _: tells.send(url))


class Campaign:
    """Kills the server, and checks it after each kill."""

    def __init__(self, engine: str, folder: Path, seed: int, stack: contextlib.ExitStack) -> None:
        self._folder, self._stack, self._seed = folder, stack, seed
        self.cluster: postgres.Cluster | None = None
        self.store: Between | None = None
        self._bucket: buckets.StoredBucket | None = None
        # What waits to be deleted is deleted at a start soon after, instead of a day later. By then, the object store
        # has finished what a killed server was sending.
        settings = Settings(folder / "served", pending_seconds=_PENDING, access_seconds=1 << 20)
        environment = {"TUPLI_MCAP_ADMIN_PASSWORD": PASSWORD}
        if engine == "postgresql":
            self.cluster = stack.enter_context(postgres.cluster())
            self._bucket = stack.enter_context(buckets.stored_bucket())
            self.store = stack.enter_context(between(self._bucket.address))
            environment |= {key: value for key, value in os.environ.items() if key.startswith("AWS_")}
            environment["AWS_ENDPOINT_URL"] = self.store.url
            settings = replace(settings, database=self._database(), blobs=self._bucket.url)
        self._settings, self._environment = settings, environment
        self._server = Server(settings, environment)
        self._server.start()
        stack.callback(lambda: self._server.kill())
        self._proxy = stack.enter_context(between(self._server.url))
        self._admin = Person(self._server.url, "admin")
        for name in _USERS:
            self._admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
        self._users = [User(self._server.url, name, folder, f"{seed} {name}") for name in _USERS]
        for user in self._users:
            user.person.url = self._proxy.url
        self.counts: Counter[str] = Counter()

    def _database(self) -> str:
        assert self.cluster is not None
        return self._stack.enter_context(self.cluster.database())

    def run(self, kills: int, victims: Sequence[str] = ()) -> Iterator[tuple[int, str, list[str]]]:
        """Yields the number of each kill, what was killed, and what was wrong after it. victims: what to kill; all if
        none is named."""
        some = victims or (("server", "server", "database", "bucket") if self.cluster else ("server",))
        number = 0
        while number < kills:
            number += 1
            rng = random.Random(f"{self._seed} {number}")
            if number % 10 == 0:
                yield number, "migration", list(self._migrate(number, rng))
                continue
            most = min(3, kills - number + 1, 10 - number % 10)
            hit = [rng.choice(some) for _ in range(rng.randint(1, most))]
            number += len(hit) - 1
            yield number, " and ".join(hit), list(self._break(hit, rng))
        yield kills, "the last start", list(self._last())

    def _break(self, victims: Sequence[str], rng: random.Random) -> Iterator[str]:
        stop = threading.Event()
        with ThreadPoolExecutor() as pool:
            at_work = [pool.submit(user.work, stop) for user in self._users]
            try:
                for victim in victims:
                    self._hit(victim, rng)
            finally:
                stop.set()
                self._proxy.faults.clear()
                if self.store is not None:
                    self.store.faults.clear()
                self._proxy.release()
        for each in at_work:
            each.result()
        self._server.wait()
        yield from self._compare(again=rng.random() < 0.5)

    def _hit(self, victim: str, rng: random.Random) -> None:
        for _ in range(rng.choice((0, 0, 3, 8))):
            self._proxy.faults.append(Fault(rng.choice(_FAULTS), int(10 ** rng.uniform(1, 5.5))))
        time.sleep(rng.uniform(0.05, 0.8))
        self.counts[victim] += 1
        getattr(self, f"_kill_{victim}")(rng.choice((0, rng.uniform(0, 0.5))))
        if victim == "bucket" and self.store is not None:
            for _ in range(rng.choice((0, 4, 12))):
                self.store.faults.append(Fault(rng.choice(("5xx", "reset")), int(10 ** rng.uniform(1, 5.5))))
        time.sleep(rng.uniform(0, 0.2))

    # --- what is killed ---

    def _kill_server(self, seconds: float) -> None:
        self._server.kill()
        time.sleep(seconds)
        self._server.start()

    def _kill_database(self, seconds: float) -> None:
        assert self.cluster is not None
        self.cluster.stop("immediate")
        time.sleep(seconds)
        self.cluster.start()

    def _kill_bucket(self, seconds: float) -> None:
        assert self._bucket is not None
        self._bucket.stop()
        time.sleep(seconds)
        self._bucket.start()

    # --- what must hold ---

    def _rest(self) -> None:
        """Waits until the server has no other request."""
        while "tupli_mcap_requests_running 1.0" not in self._admin.call("GET", "/metrics").text:
            time.sleep(0.02)

    def _compare(self, again: bool) -> Iterator[str]:
        self._rest()
        for user in self._users:
            user.rested()
            if again:
                user.settle()
            yield from user.compare(self._server.url, _USERS[_USERS.index(user.person.name) - 1])
            yield from user.wrong
            user.wrong.clear()
        yield from self._files(waiting=True)

    def _last(self) -> Iterator[str]:
        """What is wrong after a start without users."""
        yield from self._compare(again=True)
        time.sleep(_PENDING + 1)
        self._server.kill()
        self._server.start()
        yield from self._compare(again=False)
        yield from self._files(waiting=False)
        self.counts["requests"] = sum(user.done for user in self._users)
        self.counts["not answered"] = sum(user.failed for user in self._users)

    def _files(self, waiting: bool) -> Iterator[str]:
        """Files that nothing names, and named files that are missing; `waiting`: some may wait to be deleted."""
        with contextlib.closing(Database(self._url)) as database, database.reading() as connection:
            named = {unescape_text(place) for place in connection.execute(select(FILE.c.place)).scalars()}
            of_artifacts = select(ITEM.c.id).where(ITEM.c.kind == "artifact")
            named |= {f"artifacts/{uri}" for uri in connection.execute(of_artifacts).scalars()}
            wait = set(pending(connection, seconds=0))
            uploads = set(connection.execute(select(UPLOAD.c.id)).scalars())
        kept = set(self._names())
        yield from (f"{name} is named, and not there" for name in named - kept)
        yield from (f"{name} is there, and nothing names it" for name in kept - named - wait)
        if not waiting:
            yield from (f"{name} still waits" for name in wait)
            own = self._settings.own
            yield from (f"the server has left {each.name}" for each in own.iterdir() if each.name not in _OWN)
            left = {
                each.name for each in (*(own / "uploads").iterdir(), *(own / "making").iterdir())
            } - uploads
            yield from (f"the file {name} is nobody's" for name in left)

    @property
    def _url(self) -> str:
        return self._settings.database or f"sqlite:///{self._settings.own / 'server.sqlite'}"

    def _names(self) -> Iterator[str]:
        """The names of all files that are kept."""
        if self._bucket is not None:
            yield from self._bucket.names()
            return
        root = self._settings.directory
        for path in root.rglob("*"):
            name = path.relative_to(root).as_posix()
            if path.is_file() and not name.startswith("server/"):
                yield name

    # --- migrations ---

    def _migrate(self, number: int, rng: random.Random) -> Iterator[str]:
        """Kills a server, or its database, while it upgrades the first version's tables."""
        settings = replace(self._settings, directory=self._folder / f"first{number}", blobs="", database="")
        settings.own.mkdir(parents=True)
        with contextlib.ExitStack() as stack:
            url = f"sqlite:///{settings.own / 'server.sqlite'}"
            if self.cluster:
                url = stack.enter_context(self.cluster.database(empty=True))
            fill_first(url)
            server = Server(replace(settings, database=url), self._environment)
            server.launch()
            time.sleep(rng.uniform(0, 0.4))
            self.counts["migration"] += 1
            if self.cluster and rng.random() < 0.5:
                self._kill_database(rng.uniform(0, 0.2))
            server.kill()
            server.start()
            with contextlib.closing(Database(url)) as database, database.reading() as connection:
                if (found := queries.count_episodes(connection, F("metadata.score") == 1)) != 2:
                    yield f"{found} of 2 episodes of the first version are there"
            server.kill()
        if self.cluster:
            self._server.wait()


def campaign(
    engine: str, kills: int, seed: int, folder: Path, victims: Sequence[str] = ()
) -> Iterator[tuple[int, str, list[str]]]:
    """Runs kills; yields the number of each, what was killed, and what was wrong then."""
    with contextlib.ExitStack() as stack:
        made = Campaign(engine, folder, seed, stack)
        yield from made.run(kills, victims)
        yield 0, ", ".join(f"{count} {what}" for what, count in made.counts.items()), []


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--engine", choices=ENGINES, default="sqlite")
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=VICTIMS, help="kill nothing else; the last two need postgresql")
    chosen = parser.parse_args()
    if chosen.only not in (None, "server") and chosen.engine != "postgresql":
        parser.error(f"--only {chosen.only} needs --engine postgresql")
    victims = [chosen.only] if chosen.only else []
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for number, what, wrong in campaign(chosen.engine, chosen.kills, chosen.seed, Path(folder), victims):
            bad += bool(wrong)
            if number % 10 == 0:
                print(f"{number} ({time.strftime('%H:%M:%S')})", flush=True)
            for line in wrong:
                print(f"{number}, {what}: {line}", flush=True)
    print(f"{what}\n{chosen.kills} kills, {bad} with findings")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
