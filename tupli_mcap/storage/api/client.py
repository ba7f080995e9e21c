"""`TupliAPIClient`: a storage on a server."""

from __future__ import annotations

import base64
import re
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from tupli_mcap import jsonvalue
from tupli_mcap.environment import sha256
from tupli_mcap.errors import FormatError, NotFoundError, StorageError, TupliError
from tupli_mcap.recording import Recording, write_recording
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    BaseFilter,
    Benchmark,
    BenchmarkHeader,
    BenchmarkQuery,
    Episode,
    EpisodeHeader,
    EpisodeItem,
    FilterEQ,
    bound,
)
from tupli_mcap.schema.facts import path_in
from tupli_mcap.storage.api.sending import Outbox, outbox_of, send_file
from tupli_mcap.storage.api.session import Session, pages
from tupli_mcap.storage.atomic import fill, os_errors
from tupli_mcap.storage.base import TupliStorage, anew, published_in
from tupli_mcap.storage.benchmark_json import declared_spaces, plain, recording_attachments
from tupli_mcap.storage.from_values import episode_data, episode_spaces
from tupli_mcap.storage.listing import with_tuples
from tupli_mcap.storage.texts import is_hash

__all__ = ["TupliAPIClient"]

_EPISODE_ID: Final = re.compile(r"[0-9a-f]{32}-(0|[1-9][0-9]{0,9})")


class TupliAPIClient(TupliStorage):
    """A storage on the server at `url`: `tupli-mcap serve` starts one.

    Without a URL it is that of TUPLI_MCAP_URL, of the last `login`, or of this machine. What is recorded is written
    here first and sent behind (`flush` waits for it); every question waits for it too. What a process could not send
    is sent by the next one. Usable from any thread; in another process it is opened anew.

    Raises:
        StorageError: the URL is none of a web server; later, the server does not answer or refuses.
    """

    def __init__(self, url: str | None = None) -> None:
        self._session = Session(url)
        self._outbox.send_left()

    @property
    def _outbox(self) -> Outbox:
        return outbox_of(self._session)  # of who is signed in now

    @property
    def url(self) -> str:
        """The server's address."""
        return self._session.url

    @property
    def username(self) -> str:
        """Who is signed in; empty if nobody is."""
        return self._session.username

    def set_url(self, url: str) -> None:
        """Use another server from now on."""
        self.flush()
        self.close()
        self.__init__(url)  # type: ignore[misc]

    def flush(self) -> None:
        """Wait until everything that was recorded has been stored by the server.

        Raises:
            StorageError: something could not be sent; it stays on this machine, and is tried again.
        """
        self._outbox.flush()

    def close(self) -> None:
        """Close the connections."""
        self._session.close()

    def __enter__(self) -> TupliAPIClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[type[TupliAPIClient], tuple[str]]:
        return TupliAPIClient, (self.url,)

    def __repr__(self) -> str:
        return f"TupliAPIClient({self.url!r})"

    # --- benchmarks ---

    def store_benchmark(self, benchmark_query: BenchmarkQuery) -> BenchmarkHeader:
        plain(benchmark_query.metadata)
        told = {**dict(benchmark_query), "metadata": benchmark_query.metadata.model_dump()}
        return BenchmarkHeader.model_validate(self._session.ask("POST", "/v1/benchmarks", told, repeat=True))

    def load_benchmark(self, uri: str) -> Benchmark:
        return Benchmark.model_validate(self._session.ask("GET", f"/v1/benchmarks/{_hash(uri, 'benchmark')}"))

    def list_benchmarks(self, filter: BaseFilter | None = None) -> list[BenchmarkHeader]:
        told = _listing(filter, BenchmarkHeader)
        return [BenchmarkHeader.model_validate(i) for i in pages(self._session, "/v1/benchmarks/list", told)]

    def delete_benchmark(self, uri: str, *, episodes: bool = False) -> int:
        self.flush()
        path = f"/v1/benchmarks/{_hash(uri, 'benchmark')}"
        return int(self._session.ask("DELETE", path, episodes=episodes)["episodes"])

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
        response = self._session.send(
            "POST", "/v1/artifacts", content=bytes(artifact), headers=headers, repeat=True
        )
        return ArtifactMetadataItem.model_validate(jsonvalue.loads(response.content))

    def load_artifact(self, uri: str, **kwargs: Any) -> bytes:
        data = self._session.send("GET", f"/v1/artifacts/{_hash(uri, 'artifact')}").content
        if sha256(data) != uri:
            raise FormatError(f"expected artifact {uri}, found bytes with SHA-256 {sha256(data)}")
        return data

    def list_artifacts(self, filter: BaseFilter | None = None) -> list[ArtifactMetadataItem]:
        told = _listing(filter, ArtifactMetadataItem)
        return [
            ArtifactMetadataItem.model_validate(i) for i in pages(self._session, "/v1/artifacts/list", told)
        ]

    def artifact_users(self, uri: str) -> list[str]:
        found: list[str] = self._session.ask("GET", f"/v1/artifacts/{_hash(uri, 'artifact')}/users")
        return found

    def delete_artifact(self, uri: str, *, force: bool = False) -> None:
        self._session.ask("DELETE", f"/v1/artifacts/{_hash(uri, 'artifact')}", force=force)

    def publish_artifact(self, uri: str, publish_in: str = "global") -> None:
        self._publish("artifacts", _hash(uri, "artifact"), publish_in)

    def unpublish_artifact(self, uri: str, unpublish_from: str) -> None:
        """Take an artifact away from a group."""
        self._unpublish("artifacts", _hash(uri, "artifact"), unpublish_from)

    # --- episodes ---

    def record_episode(self, episode: Episode) -> EpisodeHeader:
        return self.record_episodes([episode])[0]

    def record_episodes(self, episodes: Iterable[Episode]) -> list[EpisodeHeader]:
        given = list(episodes)
        groups: dict[str, list[int]] = {}
        for i, episode in enumerate(given):
            if not episode.tuples:
                raise StorageError(f"an episode needs at least one tuple, found none in episode {i}")
            groups.setdefault(episode.benchmark_id, []).append(i)
        headers: dict[int, EpisodeHeader] = {}
        for benchmark_id, positions in groups.items():
            name = self._record(benchmark_id, [given[i] for i in positions])
            made = self._episodes(FilterEQ(key="recording", value=name))
            headers.update(zip(positions, made, strict=True))
        return [headers[i] for i in range(len(given))]

    def _record(self, benchmark_id: str, episodes: Sequence[Episode]) -> str:
        """Stores episodes of one benchmark as a recording; returns its name."""
        benchmark = self.load_benchmark(benchmark_id)
        spaces = episode_spaces(episodes, declared_spaces(benchmark.serialized))
        path = self._outbox.new_path(benchmark_id, "")
        with os_errors("cannot record", path), fill(path) as temporary:
            write_recording(
                temporary,
                (episode_data(episode, spaces) for episode in episodes),
                observation_space=spaces[0],
                action_space=spaces[1],
                reward_space=spaces[2],
                benchmark_id=benchmark_id,
                attachments=recording_attachments(benchmark.serialized),
            )
        self._outbox.send(path)
        self.flush()
        return self._outbox.name_of(path)

    def list_episodes(
        self,
        filter: BaseFilter | None = None,
        include_tuples: bool = False,
        *,
        limit: int | None = None,
        offset: int = 0,
    ) -> list[EpisodeHeader] | list[EpisodeItem]:
        for name, number in (("limit", 0 if limit is None else limit), ("offset", offset)):
            if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 1 << 63:
                raise StorageError(f"expected {name} to be an integer from 0, found {number!r:.80}")
        self.flush()
        if not include_tuples:
            return self._episodes(filter, limit, offset)
        return anew(lambda: list(with_tuples(self._episodes(filter, limit, offset), self.open_recording)))

    def _episodes(
        self, filter: BaseFilter | None, limit: int | None = None, offset: int = 0
    ) -> list[EpisodeHeader]:
        told = {**_listing(filter, EpisodeHeader), "limit": limit, "offset": offset}
        return [EpisodeHeader.model_validate(i) for i in pages(self._session, "/v1/episodes/list", told)]

    def count_episodes(self, filter: BaseFilter | None = None) -> int:
        self.flush()
        return int(
            self._session.ask("POST", "/v1/episodes/count", _listing(filter, EpisodeHeader), repeat=True)
        )

    def delete_episode(self, uri: str) -> None:
        self.flush()
        self._session.ask("DELETE", f"/v1/episodes/{_episode(uri)}")

    def delete_episodes(self, filter: BaseFilter) -> int:
        self.flush()
        told = _listing(filter, EpisodeHeader)
        return int(self._session.ask("POST", "/v1/episodes/delete", told)["episodes"])

    def publish_episode(self, uri: str, publish_in: str = "global") -> None:
        self.flush()
        self._publish("episodes", _episode(uri), publish_in)

    def unpublish_episode(self, uri: str, unpublish_from: str) -> None:
        """Take an episode away from a group."""
        self._unpublish("episodes", _episode(uri), unpublish_from)

    def publish_episodes(self, filter: BaseFilter, publish_in: str = "global") -> int:
        """Let a group see every episode of yours that a filter is true of; returns how many."""
        return self._publish_all(filter, publish_in, published=True)

    def unpublish_episodes(self, filter: BaseFilter, unpublish_from: str) -> int:
        """Take every episode that a filter is true of away from a group; returns how many."""
        return self._publish_all(filter, unpublish_from, published=False)

    def _publish_all(self, filter: BaseFilter, group: str, *, published: bool) -> int:
        self.flush()
        told = {**_listing(filter, EpisodeHeader), "group": group, "published": published}
        return int(self._session.ask("POST", "/v1/episodes/publish", told)["episodes"])

    # --- recordings ---

    def new_recording_path(self, benchmark_id: str, name: str = "") -> Path:
        if not self.list_benchmarks(FilterEQ(key="id", value=_hash(benchmark_id, "benchmark"))):
            raise _unknown("benchmark", benchmark_id)
        return self._outbox.new_path(benchmark_id, name)

    def ingest(self, path: Path) -> None:
        self._outbox.send(path)

    def open_recording(self, recording: str) -> Recording:
        if not isinstance(recording, str):
            raise NotFoundError(
                f"expected the recording of an episode header, such as 'recordings/…/….mcap', found {recording!r:.80}"
            )
        ticket = self._session.ask("POST", "/v1/tickets", {"recording": recording}, repeat=True)
        if ticket["whole"]:
            return Recording(self.url + ticket["path"])
        with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
            path = Path(folder) / recording.rpartition("/")[2]
            path.write_bytes(self._session.send("GET", ticket["path"]).content)
            return Recording(path)  # which stays readable when its name is gone

    def push(self, path: str | Path) -> str:
        """Store a recording that lies here; returns the name that `open_recording` takes.

        Stored twice, nothing changes; stored again after it has grown, it takes the place of the earlier one.

        Raises:
            StorageError: the server refuses it: it is unfinished or empty, or its benchmark is not stored.
        """
        return send_file(self._session, Path(path))

    def declare_key(self, key: str) -> None:
        path_in(key, EpisodeHeader)
        self._session.ask("POST", "/v1/episodes/keys", {"key": key})

    # --- users, groups, roles ---

    def login(self, username: str, password: str, url: str | None = None) -> None:
        """Sign in; this machine remembers it until `logout`."""
        if url is not None:
            self.set_url(url)
        self._told("Login failed", lambda: self._session.sign_in(username, password))
        self._outbox.send_left()

    def logout(self) -> None:
        """Sign out, here and on the server."""
        self.flush()
        self._session.sign_out()

    def whoami(self) -> dict[str, Any]:
        """The name of who is signed in, and the roles held in each group."""
        found: dict[str, Any] = self._session.ask("GET", "/v1/me")
        return found

    def signup(self, username: str, password: str) -> dict[str, Any]:
        """Make a user."""
        told = {"username": username, "password": password}
        found: dict[str, Any] = self._told(
            "Signup failed", lambda: self._session.ask("POST", "/v1/users", told)
        )
        return found

    def list_users(self) -> list[dict[str, Any]]:
        """All users, with the roles that each holds in each group."""
        return list(self._session.ask("GET", "/v1/users"))

    def change_password(self, username: str, password: str, *, old: str | None = None) -> None:
        """Give a user another password; `old` is needed for one's own. All sign-ins with the old one end."""
        told = {"password": password, "old": old}
        self._session.ask("PUT", f"/v1/users/{_name(username)}/password", told)

    def delete_user(self, username: str) -> None:
        """Delete a user; what they made stays."""
        self._session.ask("DELETE", f"/v1/users/{_name(username)}")

    def create_group(self, name: str, description: str | None = None) -> dict[str, Any]:
        """Make a group that you lead."""
        told = {"name": name, "description": description}
        return dict(self._session.ask("POST", "/v1/groups", told))

    def list_groups(self) -> list[dict[str, Any]]:
        """The groups that you may know of."""
        return list(self._session.ask("GET", "/v1/groups"))

    def read_group(self, group_name: str) -> dict[str, Any]:
        """A group and its members."""
        return dict(self._session.ask("GET", f"/v1/groups/{_name(group_name)}"))

    def delete_group(self, group_name: str) -> None:
        """Delete a group."""
        self._session.ask("DELETE", f"/v1/groups/{_name(group_name)}")

    def add_group_members(self, group_name: str, members: Sequence[dict[str, Any]]) -> dict[str, Any]:
        """Give users roles in a group: `[{"user": "ann", "roles": ["member"]}]`."""
        return dict(self._session.ask("PUT", f"/v1/groups/{_name(group_name)}/members", list(members)))

    def remove_group_members(self, group_name: str, users: Sequence[str]) -> None:
        """Take users out of a group."""
        for user in users:
            self._session.ask("DELETE", f"/v1/groups/{_name(group_name)}/members/{_name(user)}")

    def create_role(self, role: str, rights: Sequence[str], description: str | None = None) -> dict[str, Any]:
        """Make a role."""
        told = {"role": role, "rights": list(rights), "description": description}
        return dict(self._session.ask("POST", "/v1/roles", told))

    def list_roles(self) -> list[dict[str, Any]]:
        """All roles."""
        return list(self._session.ask("GET", "/v1/roles"))

    def delete_role(self, role_name: str) -> None:
        """Delete a role, wherever it was given."""
        self._session.ask("DELETE", f"/v1/roles/{_name(role_name)}")

    # --- helpers ---

    def _publish(self, kind: str, uri: str, group: str) -> None:
        published_in([], group)
        self._session.ask("PUT", f"/v1/{kind}/{uri}/published", group=group)

    def _unpublish(self, kind: str, uri: str, group: str) -> None:
        self._session.ask("DELETE", f"/v1/{kind}/{uri}/published", group=group)

    @staticmethod
    def _told(what: str, ask: Any) -> Any:
        try:
            return ask()
        except TupliError as err:
            raise StorageError(f"{what}: {err}") from err


def _listing(filter: BaseFilter | None, model: Any) -> dict[str, Any]:
    """A filter, checked as a storage here would, as the server takes it."""
    return {"filter": None if filter is None else bound(filter, model).model_dump(mode="json")}


def _hash(uri: str, kind: str) -> str:
    """An id that can stand in a path. NotFoundError for what is none: nothing has it."""
    if not is_hash(uri):
        raise _unknown(kind, uri)
    return uri


def _episode(uri: str) -> str:
    if not isinstance(uri, str) or not _EPISODE_ID.fullmatch(uri):
        raise _unknown("episode", uri)
    return uri


def _unknown(kind: str, uri: object) -> NotFoundError:
    return NotFoundError(f"there is no {kind} with id {str(uri)[:80]!r}; list_{kind}s() names them all")


def _name(name: str) -> str:
    """A name in a path."""
    return quote(name, safe="")
