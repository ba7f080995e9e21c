"""Users of a failing server: they note what was acknowledged, and compare it with the server afterwards.

A request that succeeded has happened. A failed one may have happened: until it is repeated, its item has one of two
states, and no third one. It may still be running when the next request is sent, so a user sends the opposite request
only when the server is idle (`rested`).
"""

from __future__ import annotations

import contextlib
import hashlib
import random
import secrets
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from gymnasium import spaces
from persons import Person, announced, cart_benchmark

from tupli_mcap import EpisodeData, write_recording

__all__ = ["Thing", "UnexpectedError", "User"]

_LATER = (410, 423, 429, 460, 500, 502, 503, 504)
_WAIT = 10.0  # seconds until a request counts as failed


class UnexpectedError(Exception):
    """The server refused a request that it should accept."""


class _NotNowError(Exception):
    """A request got no answer, or "try again later"."""


class Thing:
    """An item that a user stored, or tried to: a recording with `count` episodes, or an artifact.

    here, shown: the possible values of whether it is stored, and published. name: the server's name of it.
    """

    def __init__(self, data: bytes, count: int = 0) -> None:
        self.data, self.count, self.name = data, count, ""
        self.digest = hashlib.sha256(data).hexdigest()
        self.here, self.shown = {False}, {False}
        self.open = ""  # what was asked for, and may still be at work


class User:
    """Stores, publishes, fetches and deletes things, by one thread."""

    def __init__(self, url: str, name: str, folder: Path, seed: str) -> None:
        self.person = Person(url, name)
        self.things: list[Thing] = []
        self.done = self.failed = 0
        self.wrong: list[str] = []
        self._rng = random.Random(seed)
        self._folder = folder
        self._recorded: list[str] = []
        self._benchmark: str = self.person.ask("POST", "/v1/benchmarks", cart_benchmark())["id"]

    def work(self, stop: threading.Event) -> None:
        """Sends random requests until it is told to stop."""
        while not stop.is_set():
            with self._noted():
                self._step()

    def rested(self) -> None:
        """Notes that no request so far is still running."""
        for thing in self.things:
            thing.open = ""

    def settle(self) -> None:
        """Repeats requests whose effect is unknown."""
        for thing in self.things:
            with self._noted():
                if len(thing.here) > 1:
                    self._delete(thing) if self._rng.random() < 0.5 else self._store(thing)
                if len(thing.shown) > 1 and thing.here == {True}:
                    self._show(thing, self._rng.random() < 0.5)

    @contextlib.contextmanager
    def _noted(self) -> Iterator[None]:
        try:
            yield
            self.done += 1
        except _NotNowError:
            self.failed += 1
        except (UnexpectedError, httpx.InvalidURL, KeyError, ValueError) as err:
            self.wrong.append(f"{self.person.name}: {err!r}")

    def _step(self) -> None:
        there = [thing for thing in self.things if thing.here == {True} and not thing.open]
        unsure = [thing for thing in self.things if thing.open]
        kind = self._rng.choice(("store", "store", "fetch", "show", "delete", "delete", "again", "record"))
        if kind == "again" and unsure:
            self._again(self._rng.choice(unsure))
        elif kind == "record":
            self._record()
        elif kind == "store" or not there:
            self._store(self._made())
        elif kind == "fetch":
            self._fetch(self._rng.choice(there))
        elif kind == "show":
            self._show(self._rng.choice(there), self._rng.random() < 0.6)
        elif len(there) > 3:
            self._delete(self._rng.choice(there))

    def _again(self, thing: Thing) -> None:
        if thing.open == "store":
            self._store(thing)
        elif thing.open == "delete":
            self._delete(thing)
        else:
            self._show(thing, thing.open == "publish")

    def _made(self) -> Thing:
        rng = np.random.default_rng(self._rng.randrange(1 << 32))
        if self._rng.random() < 0.3:
            thing = Thing(rng.bytes(int(10 ** self._rng.uniform(1.3, 5.5))))
        else:
            thing = self._recording(rng)
        self.things.append(thing)
        return thing

    def _recording(self, rng: np.random.Generator) -> Thing:
        count, steps = self._rng.randrange(1, 6), int(10 ** self._rng.uniform(0, 3))
        path = self._folder / f"{secrets.token_hex(8)}.mcap"
        episodes = [
            EpisodeData(
                rng.uniform(-1, 1, (steps, 17)).astype(np.float32), rng.integers(0, 2, steps), np.ones(steps),
                np.zeros(steps, bool), np.arange(steps) == steps - 1, np.zeros(17, np.float32),
            )
            for _ in range(count)
        ]  # fmt: skip
        write_recording(
            path, episodes, observation_space=spaces.Box(-1, 1, (17,)), action_space=spaces.Discrete(2)
        )
        thing = Thing(path.read_bytes(), count)
        path.unlink()
        return thing

    # --- requests ---

    def _call(
        self, method: str, path: str, told: Any = None, *, may: tuple[int, ...] = (), **more: Any
    ) -> Any:
        try:
            answer = self.person.call(method, path, told, timeout=_WAIT, **more)
        except httpx.TransportError as err:
            raise _NotNowError from err
        if answer.status_code in _LATER and answer.status_code not in may:
            raise _NotNowError
        if answer.status_code >= 300 and answer.status_code not in may:
            raise UnexpectedError(f"{method} {path}: {answer.status_code}: {answer.text[:300]}")
        return answer

    def _store(self, thing: Thing) -> None:
        if not thing.data:
            return  # it is gone for good
        if False in thing.here:  # stored anew, it is published nowhere
            thing.shown |= {False}
        thing.here |= {True}
        with _asking(thing, "store"):
            if thing.count:
                thing.name = self._send(thing.data)
            else:
                headers = {"Artifact-Metadata": "eyJuYW1lIjogIngifQ=="}  # {"name": "x"}
                self._call("POST", "/v1/artifacts", headers=headers, content=thing.data)
                thing.name = thing.digest
        thing.here = {True}

    def _send(self, data: bytes) -> str:
        """Stores a recording, in several requests."""
        answer = self._call("POST", "/v1/uploads", headers=announced(data))
        place, size = answer.headers.get("Location"), self._rng.choice((len(data), len(data) // 3 + 1))
        while "Recording" not in answer.headers:
            start = int(answer.headers["Upload-Offset"])
            told = {"headers": {"Upload-Offset": str(start)}, "content": data[start : start + size]}
            answer = self._call("PATCH", place, may=(409,), **told)
        return str(answer.headers["Recording"])

    def _fetch(self, thing: Thing) -> None:
        path = f"/v1/artifacts/{thing.digest}"
        if thing.count:
            told = self._call("POST", "/v1/tickets", {"recording": thing.name}).json()
            if (told["digest"], told["episodes"], told["whole"]) != (thing.digest, thing.count, True):
                raise UnexpectedError(f"{thing.name} is told to be {told}")
            path = told["path"]
        if self._call("GET", path).content != thing.data:
            raise _NotNowError  # a bit was turned over on the way, which its digest shows

    def _show(self, thing: Thing, shown: bool) -> None:
        thing.shown |= {shown}
        with _asking(thing, "publish" if shown else "unpublish"):
            if thing.count:
                told = {"filter": _of(thing), "group": "global", "published": shown}
                changed = self._call("POST", "/v1/episodes/publish", told).json()["episodes"]
                if changed != thing.count:
                    raise UnexpectedError(
                        f"{changed} of {thing.count} episodes of {thing.name} were published"
                    )
            else:
                method = "PUT" if shown else "DELETE"
                self._call(method, f"/v1/artifacts/{thing.digest}/published", params={"group": "global"})
        thing.shown = {shown}

    def _delete(self, thing: Thing) -> None:
        if not thing.name:
            return  # nobody knows what to delete: it is stored again first
        unsure = False in thing.here
        thing.here |= {False}
        with _asking(thing, "delete"):
            if thing.count:
                deleted = self._call("POST", "/v1/episodes/delete", {"filter": _of(thing)}).json()["episodes"]
                if deleted != thing.count and not (unsure and deleted == 0):
                    raise UnexpectedError(f"{deleted} of {thing.count} episodes of {thing.name} were deleted")
            else:
                self._call("DELETE", f"/v1/artifacts/{thing.digest}", may=(404,) if unsure else ())
        thing.here, thing.shown, thing.data = {False}, {False}, b""

    def _record(self) -> None:
        """Stores an episode by PyTupli's route: a request that is not tried again."""
        steps = [{"state": [0.0, 1.0], "action": 1, "reward": 1.0}] * 3
        told = {"benchmark_id": self._benchmark, "metadata": {}, "tuples": steps}
        self._recorded.append(self._call("POST", "/episodes/record", told).json()["id"])

    # --- afterwards ---

    def compare(self, url: str, other: str) -> Iterator[str]:
        """Differences from what was acknowledged, as this user and another one see it over a good connection."""
        me, them = Person(url, self.person.name), Person(url, other)
        artifacts, recordings = _artifacts(me, self.person.name), _recordings(me, self.person.name)
        shown = _artifacts(them, self.person.name) | _recordings(them, self.person.name)
        digests: dict[str, str] = {}
        known = {thing.name: thing.digest for thing in self.things}
        for name in recordings:
            digest = known.get(name) or me.ask("POST", "/v1/tickets", {"recording": name})["digest"]
            if digest in digests:
                yield f"{name} and {digests[digest]} have the same bytes"
            digests[digest] = name
        for thing in self.things:
            name = thing.name or digests.get(thing.digest, "")
            found = digests.pop(thing.digest, None) is not None if thing.count else thing.digest in artifacts
            told = f"{self.person.name}: {name or thing.digest}"
            if found not in thing.here:
                yield f"{told}: expected to be there: {thing.here}, found {found}"
            if found and thing.count and recordings[name] != thing.count:
                yield f"{told}: {recordings[name]} of {thing.count} episodes are there"
            seen, may = shown.get(name, 0), thing.shown if found else {False}
            if seen not in (0, max(1, thing.count)) or bool(seen) not in may:
                yield f"{told}: expected to be published: {thing.shown}, found {seen} of {thing.count}"
            if found and thing.data and self._rng.random() < 0.2 and _content(me, thing, name) != thing.data:
                yield f"{told}: has other bytes"
        yield from (f"{self.person.name}: {name} was never stored" for name in digests.values())
        ids = {each["id"] for each in _episodes(me, "benchmark_id", self._benchmark)}
        yield from (f"{self.person.name}: episode {uri} is lost" for uri in set(self._recorded) - ids)


@contextlib.contextmanager
def _asking(thing: Thing, what: str) -> Iterator[None]:
    """Wraps requests that may still be running if they get no answer."""
    before, thing.open = thing.open, what
    yield
    thing.open = before


def _of(thing: Thing) -> dict[str, Any]:
    return {"type": "EQ", "key": "recording", "value": thing.name}


def _episodes(person: Person, key: str, value: str) -> list[dict[str, Any]]:
    told = {"filter": {"type": "EQ", "key": key, "value": value}}
    found: list[dict[str, Any]] = []
    while True:
        page = person.ask("POST", "/v1/episodes/list", told)
        found += page["items"]
        if page["next"] is None:
            return found
        told["cursor"] = page["next"]


def _recordings(person: Person, owner: str) -> dict[str, int]:
    """Recordings of an owner that belong to no benchmark, and how many episodes are listed of each."""
    of = (each["recording"] for each in _episodes(person, "created_by", owner) if not each["benchmark_id"])
    return dict(Counter(of))


def _artifacts(person: Person, owner: str) -> dict[str, int]:
    told = {"filter": {"type": "EQ", "key": "created_by", "value": owner}}
    return dict(Counter(each["id"] for each in person.ask("POST", "/v1/artifacts/list", told)["items"]))


def _content(person: Person, thing: Thing, name: str) -> bytes:
    path = f"/v1/artifacts/{thing.digest}"
    if thing.count:
        path = person.ask("POST", "/v1/tickets", {"recording": name})["path"]
    return person.call("GET", path).content
