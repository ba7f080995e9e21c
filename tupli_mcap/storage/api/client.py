"""`TupliAPIClient`: a storage on a server."""

from __future__ import annotations

import base64
import contextlib
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from tupli_mcap import jsonvalue
from tupli_mcap.environment import sha256
from tupli_mcap.errors import FormatError, StorageError, TupliError
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    BaseFilter,
    Benchmark,
    BenchmarkHeader,
    BenchmarkQuery,
    Episode,
    EpisodeHeader,
    FilterEQ,
    bound,
)
from tupli_mcap.schema.facts import path_in
from tupli_mcap.storage.api.answers import Shared, SignInError, UnreachableError, as_told
from tupli_mcap.storage.api.outbox import Outbox, Waiting, outbox_of
from tupli_mcap.storage.api.people import People
from tupli_mcap.storage.api.recordings import Recordings
from tupli_mcap.storage.api.session import Session, pages
from tupli_mcap.storage.api.upload import Tell
from tupli_mcap.storage.base import (
    TupliStorage,
    anew,
    check_given,
    episode_id,
    is_episode_id,
    no_such,
    published_in,
)
from tupli_mcap.storage.benchmark_json import plain
from tupli_mcap.storage.downloads import fetched
from tupli_mcap.storage.from_values import record_each, write_episodes
from tupli_mcap.storage.texts import is_hash

_Model = TypeVar("_Model", bound=BaseModel)


class TupliAPIClient(People, Recordings, TupliStorage):
    """A storage on the server at `url`: `tupli-mcap serve` starts one.

    Without a URL, it is the server in TUPLI_MCAP_URL, of the last `login` or `set_url`, or on this machine. Recordings
    are written to this machine's disk first and sent in the background, so recording never waits for the server, nor
    fails if it is down. Before a query, the client sends everything that this process has recorded: finished
    recordings, and the ended episodes of growing ones; and what earlier processes left. So it does at exit. The next
    program sends what this one could not. Thread-safe; a copy in another process opens its own connections.

    Args:
        sends_left: False leaves what earlier processes could not send to the next client.

    Raises:
        StorageError: the URL is no web server's; later, the server does not answer, or refuses.
    """

    def __init__(self, url: str | None = None, *, sends_left: bool = True) -> None:
        self._sends_left = sends_left
        self._session = Session(url)
        self._benchmarks: dict[str, Benchmark] = {}  # that are there, as far as is known
        if self._session.known_user is not None:
            _ = self._outbox

    @property
    def _outbox(self) -> Outbox:
        return outbox_of(self._session, sends_left=self._sends_left)  # of who is signed in now

    @property
    def url(self) -> str:
        """The server's address."""
        return self._session.url

    @property
    def username(self) -> str:
        """The signed-in user; empty if nobody is signed in."""
        return self._session.username

    def set_url(self, url: str) -> None:
        """Use another server from now on, also in new clients without a URL. Recordings for the old server are still
        sent there."""
        session = Session(url)
        session.tokens.use(session.url)
        self.close()
        self.__init__(url, sends_left=self._sends_left)  # type: ignore[misc]

    def waiting(self) -> list[Waiting]:
        """The recordings on this machine, by this process or others, that the server does not have yet."""
        return self._outbox.waiting()

    def waiting_elsewhere(self) -> dict[tuple[str, str], int]:
        """The number of recordings that wait for other servers and users, by (address, name)."""
        return self._outbox.waiting_elsewhere()

    def flush(self, *, everything: bool = False, tell: Tell = lambda _: None) -> None:
        """Wait until the server has everything that this process has recorded, and what earlier ones left; of growing
        recordings, the ended episodes.

        everything: also try again what the server has refused of earlier ones, and raise why. tell: called with the
            number of bytes just sent.

        Raises:
            StorageError: the server does not answer, or refuses a recording, which then stays on this machine.
        """
        self._outbox.flush(everything=everything, tell=tell)

    def close(self) -> None:
        """Close the connections."""
        self._session.close()

    def __reduce__(self) -> tuple[Callable[..., TupliAPIClient], tuple[str]]:
        return partial(type(self), sends_left=self._sends_left), (self.url,)

    def __repr__(self) -> str:
        return f"TupliAPIClient({self.url!r})"

    # --- benchmarks ---

    def store_benchmark(self, benchmark_query: BenchmarkQuery) -> BenchmarkHeader:
        plain(benchmark_query.metadata)
        told = {**dict(benchmark_query), "metadata": benchmark_query.metadata.model_dump()}
        stored = as_told(BenchmarkHeader, self._session.ask("POST", "/v1/benchmarks", told, repeat=True))
        self._note(Benchmark(**{**dict(stored), "serialized": benchmark_query.serialized}))
        return stored

    def load_benchmark(self, uri: str) -> Benchmark:
        found = as_told(Benchmark, self._session.ask("GET", f"/v1/benchmarks/{_hash(uri, 'benchmark')}"))
        self._note(found)
        return found

    def _note(self, benchmark: Benchmark) -> None:
        """Keeps what recording needs while the server is down: the benchmark, and the user's name."""
        self._benchmarks[benchmark.id] = benchmark
        _ = self._outbox

    def list_benchmarks(self, filter: BaseFilter | str | None = None) -> list[BenchmarkHeader]:
        return self._listed("/v1/benchmarks/list", BenchmarkHeader, _listing(filter, BenchmarkHeader))

    def delete_benchmark(self, uri: str, *, episodes: bool = False) -> int:
        self.flush()
        self._benchmarks.pop(uri, None)
        return self._count("DELETE", f"/v1/benchmarks/{_hash(uri, 'benchmark')}", episodes=episodes)

    def publish_benchmark(self, uri: str, publish_in: str = "global") -> None:
        self._publish("benchmarks", _hash(uri, "benchmark"), publish_in)

    def unpublish_benchmark(self, uri: str, unpublish_from: str) -> None:
        """Take a benchmark away from a group."""
        self._unpublish("benchmarks", _hash(uri, "benchmark"), unpublish_from)

    # --- artifacts ---

    def store_artifact(self, artifact: bytes, metadata: ArtifactMetadata) -> ArtifactMetadataItem:
        if not isinstance(artifact, bytes | bytearray | memoryview):
            raise StorageError(f"expected the bytes of an artifact, found {type(artifact).__name__}")
        told = jsonvalue.dumps_plain(metadata.model_dump())
        headers = {"Artifact-Metadata": base64.b64encode(told.encode()).decode()}
        response = self._session.ask(
            "POST", "/v1/artifacts", content=bytes(artifact), headers=headers, repeat=True
        )
        return as_told(ArtifactMetadataItem, response)

    def load_artifact(self, uri: str, **kwargs: Any) -> bytes:
        path, unless_here = f"/v1/artifacts/{_hash(uri, 'artifact')}", {"If-None-Match": f'"{uri}"'}
        self._session.send("GET", path, headers=unless_here)  # whether it is there, and may be read
        with fetched(uri, lambda start: self._session.stream(path, start)) as kept:
            data = kept.read_bytes()
        if sha256(data) != uri:
            kept.unlink(missing_ok=True)
            raise FormatError(f"{kept} was damaged, and is deleted; try again")
        return data

    def list_artifacts(self, filter: BaseFilter | str | None = None) -> list[ArtifactMetadataItem]:
        return self._listed(
            "/v1/artifacts/list", ArtifactMetadataItem, _listing(filter, ArtifactMetadataItem)
        )

    def artifact_users(self, uri: str) -> list[str]:
        return as_told(list[str], self._session.ask("GET", f"/v1/artifacts/{_hash(uri, 'artifact')}/users"))

    def delete_artifact(self, uri: str, *, force: bool = False) -> None:
        self._session.ask("DELETE", f"/v1/artifacts/{_hash(uri, 'artifact')}", force=force)

    def publish_artifact(self, uri: str, publish_in: str = "global") -> None:
        self._publish("artifacts", _hash(uri, "artifact"), publish_in)

    def unpublish_artifact(self, uri: str, unpublish_from: str) -> None:
        """Take an artifact away from a group."""
        self._unpublish("artifacts", _hash(uri, "artifact"), unpublish_from)

    # --- episodes ---

    def record_episodes(self, episodes: Iterable[Episode]) -> list[EpisodeHeader]:
        return record_each(episodes, self._record)

    def _record(self, benchmark_id: str, episodes: Sequence[Episode]) -> list[EpisodeHeader]:
        benchmark = self._benchmarks.get(benchmark_id) or self.load_benchmark(benchmark_id)
        with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
            path = Path(folder) / "episodes.mcap"
            write_episodes(path, episodes, benchmark)
            name = self.send(path).name
        return self._episodes(FilterEQ(key="recording", value=name))

    def list_headers(
        self, filter: BaseFilter | str | None, limit: int | None, offset: int, sort: str | None
    ) -> list[EpisodeHeader]:
        self.flush()
        # a page of a sorted list cannot be found if the last episode of the page before is deleted meanwhile
        return anew(lambda: self._episodes(filter, limit=limit, offset=offset, sort=sort))

    def _episodes(self, filter: BaseFilter | str | None, **page: Any) -> list[EpisodeHeader]:
        given = {name: value for name, value in page.items() if value is not None}
        return self._listed("/v1/episodes/list", EpisodeHeader, {**_listing(filter, EpisodeHeader), **given})

    def count_episodes(self, filter: BaseFilter | str | None = None) -> int:
        self.flush()
        told = _listing(filter, EpisodeHeader)
        return as_told(int, self._session.ask("POST", "/v1/episodes/count", told, repeat=True))

    def delete_episode(self, uri: str) -> None:
        self.flush()
        self._session.ask("DELETE", f"/v1/episodes/{_episode(uri)}")

    def delete_episodes(self, filter: BaseFilter | str) -> int:
        check_given(filter)
        self.flush()
        told = _listing(filter, EpisodeHeader)
        return self._count("POST", "/v1/episodes/delete", told)

    def deletable(self, filter: BaseFilter) -> int:
        told = {**_listing(filter, EpisodeHeader), "dry_run": True}
        return self._count("POST", "/v1/episodes/delete", told, repeat=True)

    def deleted_episodes(self) -> set[str]:
        """The ids of your episodes that were deleted on the server, where others of their recording are left: sent
        again, they stay deleted."""
        found = as_told(dict[str, list[int]], self._session.ask("GET", "/v1/episodes/deleted"))
        return {episode_id(uuid, number) for uuid, numbers in found.items() for number in numbers}

    def publish_episode(self, uri: str, publish_in: str = "global") -> None:
        self.flush()
        self._publish("episodes", _episode(uri), publish_in)

    def unpublish_episode(self, uri: str, unpublish_from: str) -> None:
        """Take an episode away from a group."""
        self._unpublish("episodes", _episode(uri), unpublish_from)

    def publish_episodes(self, filter: BaseFilter | str, publish_in: str = "global") -> int:
        """Let a group see every episode of yours that matches a filter; returns how many."""
        return self._publish_all(filter, publish_in, published=True)

    def unpublish_episodes(self, filter: BaseFilter | str, unpublish_from: str) -> int:
        """Take every episode that matches a filter away from a group; returns how many."""
        return self._publish_all(filter, unpublish_from, published=False)

    def _publish_all(self, filter: BaseFilter | str, group: str, *, published: bool) -> int:
        self.flush()
        told = {**_listing(filter, EpisodeHeader), "group": group, "published": published}
        return self._count("POST", "/v1/episodes/publish", told, repeat=True)

    def share(
        self,
        benchmark: str | None = None,
        filter: BaseFilter | str | None = None,
        group: str = "global",
        *,
        published: bool = True,
        dry_run: bool = False,
    ) -> Shared:
        """Let a group see what is yours: of a benchmark, itself, its artifacts and your episodes of it; with a filter,
        only the episodes that match; without a benchmark, your episodes that match. All of it, or nothing.

        Args:
            benchmark: its id. published: False takes these episodes away from the group, and without a filter the
                benchmark, too. Artifacts stay: other benchmarks may need them. dry_run: change nothing.

        Raises:
            NotFoundError: there is no such benchmark.
            StorageError: there is nothing to publish or to take away, or you may not publish in the group.
        """
        self.flush()
        told = {**_listing(filter, EpisodeHeader), "group": group, "published": published, "dry_run": dry_run}
        if benchmark is not None:
            told["benchmark"] = _hash(benchmark, "benchmark")
        return as_told(Shared, self._session.ask("POST", "/v1/share", told, repeat=True))

    # --- recordings ---

    def new_recording_path(self, benchmark_id: str, name: str = "") -> Path:
        known = _hash(benchmark_id, "benchmark") in self._benchmarks
        if not known and not self.list_benchmarks(FilterEQ(key="id", value=benchmark_id)):
            raise no_such("benchmark", benchmark_id)
        return self._outbox.new_path(benchmark_id, name)

    def ingest(self, path: Path) -> None:
        self._outbox.send(path)

    def declare_key(self, key: str) -> None:
        path_in(key, EpisodeHeader)
        self._session.ask("POST", "/v1/episodes/keys", {"key": key})

    # --- signing in ---

    def login(self, username: str, password: str, url: str | None = None) -> None:
        """Sign in; this machine remembers it until `logout`."""
        if url is not None:
            self.set_url(url)
        try:
            self._session.sign_in(username, password)
        except TupliError as err:
            raise type(err)(f"Login failed: {err}") from err
        _ = self._outbox

    def logout(self) -> None:
        """Send everything that was recorded, then sign out, here and on the server. What cannot be sent now waits for
        the next sign-in."""
        with contextlib.suppress(UnreachableError, SignInError):
            self.flush()
        self._session.sign_out()

    # --- helpers ---

    def _listed(self, path: str, model: type[_Model], told: dict[str, Any]) -> list[_Model]:
        return [as_told(model, item) for item in pages(self._session, path, told)]

    def _count(self, method: str, path: str, told: Any = None, **options: Any) -> int:
        """How many episodes the server changed; 0 if an earlier attempt changed them and its answer was lost."""
        answer = self._session.ask(method, path, told, **options)
        return 0 if answer is None else as_told(dict[str, int], answer)["episodes"]

    def _publish(self, kind: str, uri: str, group: str) -> None:
        published_in([], group)
        self._session.ask("PUT", f"/v1/{kind}/{uri}/published", group=group)

    def _unpublish(self, kind: str, uri: str, group: str) -> None:
        self._session.ask("DELETE", f"/v1/{kind}/{uri}/published", group=group)


def _listing(filter: BaseFilter | str | None, model: Any) -> dict[str, Any]:
    """A filter as the server takes it, checked here first."""
    return {"filter": None if filter is None else bound(filter, model).model_dump(mode="json")}


def _hash(uri: str, kind: str) -> str:
    """An id for a path. NotFoundError for a text that cannot be an id."""
    if not is_hash(uri):
        raise no_such(kind, uri)
    return uri


def _episode(uri: str) -> str:
    if not is_episode_id(uri):
        raise no_such("episode", uri)
    return uri
