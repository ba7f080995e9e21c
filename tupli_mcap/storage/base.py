"""The contract of a storage of benchmarks, artifacts and episodes: a directory or a server."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import re
import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, overload

from tupli_mcap import files
from tupli_mcap.errors import FilterError, NotFoundError, SaysWhatIsMeant, StorageError
from tupli_mcap.recording import Episode as RecordedEpisode, Recording
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
    FilterIN,
)
from tupli_mcap.schema.facts import path_in
from tupli_mcap.schema.times import time_ns

TupliStorageError = StorageError
"""The name this error has in PyTupli."""


LOCAL_USER = "local_storage"
"""The creator of all items in a directory; also the only group that sees them."""
_ATTEMPTS = 5
_EPISODE_ID = re.compile(r"[0-9a-f]{32}-(0|[1-9][0-9]{0,9})")
_MOST_IDS = 10_000  # in one filter; a server takes twice as many
_T = TypeVar("_T")
_Item = TypeVar("_Item", BenchmarkHeader, ArtifactMetadataItem)


def check_given(filter: BaseFilter | str | None) -> None:
    """Raises FilterError if there is no filter: elsewhere, that means everything."""
    if filter is None:
        raise FilterError(
            'expected a filter of the episodes to delete, found None; "episode >= 0" is one of all'
        )


class TupliStorage(SaysWhatIsMeant, ABC):
    """Stores benchmarks, artifacts and episodes and finds them again.

    An unknown id (`uri`) of any form raises NotFoundError; ids are compared, never used as paths. A filter, an
    expression or its text, sees the fields of the listed headers (`id`, `metadata.score`); None lists everything. A
    wrong filter raises FilterError, a damaged file FormatError, a recording that cannot be opened RecordingError. Every
    other failure is a StorageError.
    """

    def close(self) -> None:
        """Release files and connections; closing twice is fine."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- benchmarks ---

    @abstractmethod
    def store_benchmark(self, benchmark_query: BenchmarkQuery) -> BenchmarkHeader:
        """Store a benchmark. Its id is its hash: storing the same content again returns the stored benchmark."""

    @abstractmethod
    def load_benchmark(self, uri: str) -> Benchmark:
        """A stored benchmark with its environment as text; nothing of it is executed."""

    @abstractmethod
    def list_benchmarks(self, filter: BaseFilter | str | None = None) -> list[BenchmarkHeader]:
        """The benchmarks that match a filter, oldest first."""

    @abstractmethod
    def delete_benchmark(self, uri: str, *, episodes: bool = False) -> int:
        """Delete a benchmark, and with `episodes` its episodes too; returns their number. Artifacts stay.

        Raises:
            StorageError: somebody records episodes that shall be deleted; nothing is deleted.
        """

    @abstractmethod
    def publish_benchmark(self, uri: str, publish_in: str = "global") -> None:
        """Make a benchmark visible to a group."""

    # --- artifacts ---

    @abstractmethod
    def store_artifact(self, artifact: bytes, metadata: ArtifactMetadata) -> ArtifactMetadataItem:
        """Store bytes. Their id is their SHA-256: storing the same bytes again returns the stored artifact."""

    @abstractmethod
    def load_artifact(self, uri: str, **kwargs: Any) -> bytes:
        """The bytes of an artifact; FormatError if they do not have their hash. `kwargs` are for other storages."""

    @abstractmethod
    def list_artifacts(self, filter: BaseFilter | str | None = None) -> list[ArtifactMetadataItem]:
        """The artifacts that match a filter, oldest first."""

    @abstractmethod
    def artifact_users(self, uri: str) -> list[str]:
        """The ids of the benchmarks that need an artifact. Raises NotFoundError if there is no such artifact."""

    @abstractmethod
    def delete_artifact(self, uri: str, *, force: bool = False) -> None:
        """Delete an artifact.

        Raises:
            StorageError: A benchmark needs it and `force` is not given.
        """

    @abstractmethod
    def publish_artifact(self, uri: str, publish_in: str = "global") -> None:
        """Make an artifact visible to a group."""

    # --- episodes ---

    def record_episode(self, episode: Episode) -> EpisodeHeader:
        """Store an episode that was made from values, as a recording of its own.

        Give many episodes to `record_episodes` together: they become one recording, which is stored, listed and read
        many times faster.
        """
        return self.record_episodes([episode])[0]

    @abstractmethod
    def record_episodes(self, episodes: Iterable[Episode]) -> list[EpisodeHeader]:
        """Store episodes that were made from values (historic data, no environment).

        States, actions and rewards may be arrays, numbers, flags, texts, lists, or dicts and tuples of them;
        spaces are inferred from the values. Each benchmark must be stored.

        Raises:
            SpaceError: Values of one kind differ in structure from step to step, or have no space.
        """

    @overload
    def list_episodes(
        self,
        filter: BaseFilter | str | None = None,
        include_tuples: Literal[False] = False,
        *,
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeHeader]: ...

    @overload
    def list_episodes(
        self,
        filter: BaseFilter | str | None,
        include_tuples: Literal[True],
        *,
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeItem]: ...

    @overload
    def list_episodes(
        self,
        filter: BaseFilter | str | None = None,
        *,
        include_tuples: Literal[True],
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeItem]: ...

    @overload
    def list_episodes(
        self,
        filter: BaseFilter | str | None = None,
        include_tuples: bool = False,
        *,
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeHeader] | list[EpisodeItem]: ...

    def list_episodes(
        self,
        filter: BaseFilter | str | None = None,
        include_tuples: bool = False,
        *,
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeHeader] | list[EpisodeItem]:
        """The episodes that match a filter; EpisodeItems with tuples if asked.

        Args:
            limit: at most so many, after the first `offset`.
            sort: return, steps, success, ended, end, seed, env, episode, recording, or a key of the metadata such as
                metadata.score; -return puts the largest first. Episodes with equal values are in the order of their
                recordings, as all are by default; those without a value come last. In metadata, numbers come before
                texts, and lists and objects are no values. By a key that is not declared, episodes whose metadata have
                numbers such as 1e300, or a NUL, come last too; by one that is, texts are compared by 500 characters.
                A server sorts all again for each page of such a list: declare the key (`declare_key`), or give a limit.

        Raises:
            FilterError: the filter or the order names an unknown key, or one that has no order.
        """
        check_page(limit, offset)
        check_order(sort)
        if not include_tuples:
            return self.list_headers(filter, limit, offset, sort)
        return anew(
            lambda: list(with_tuples(self.list_headers(filter, limit, offset, sort), self.open_recording))
        )

    @abstractmethod
    def list_headers(
        self, filter: BaseFilter | str | None, limit: int | None, offset: int, sort: str | None
    ) -> list[EpisodeHeader]:
        """What `list_episodes` lists, which has checked the arguments."""

    @abstractmethod
    def count_episodes(self, filter: BaseFilter | str | None = None) -> int:
        """The number of episodes that match a filter."""

    @abstractmethod
    def delete_episode(self, uri: str) -> None:
        """Delete one episode."""

    @abstractmethod
    def delete_episodes(self, filter: BaseFilter | str) -> int:
        """Delete every episode that matches a filter; returns their number.

        Raises:
            FilterError: there is no filter, or it names an unknown field.
        """

    def delete_numbers(
        self, by_recording: Mapping[tuple[str, str], Collection[int]], *, dry_run: bool = False
    ) -> int:
        """Delete episodes by their numbers; returns how many were still there, or would be deleted.

        Args:
            by_recording: numbers of episodes, by the name that headers give their recording, and by its UUID.
            dry_run: delete nothing.
        """
        ids = [episode_id(uuid, n) for (_, uuid), numbers in by_recording.items() for n in numbers]
        count = 0
        for start in range(0, len(ids), _MOST_IDS):
            wanted = FilterIN(key="id", value=ids[start : start + _MOST_IDS])
            count += self.deletable(wanted) if dry_run else self.delete_episodes(wanted)
        return count

    def deletable(self, filter: BaseFilter) -> int:
        """How many episodes `delete_episodes` would delete; raises as it does."""
        return self.count_episodes(filter)

    @abstractmethod
    def publish_episode(self, uri: str, publish_in: str = "global") -> None:
        """Make an episode visible to a group."""

    # --- recordings ---

    def flush(self) -> None:
        """Wait until the storage has everything that this process has recorded; a directory has it at once."""

    @abstractmethod
    def new_recording_path(self, benchmark_id: str, name: str = "") -> Path:
        """An unused path for a new recording of a stored benchmark; `name` is part of it."""

    def beginning_recording(self) -> AbstractContextManager[object]:
        """A lock to hold from looking up a benchmark until its new recording is open, so that nobody deletes the
        benchmark in between."""
        return nullcontext()

    @abstractmethod
    def ingest(self, path: Path) -> None:
        """Catalogue a recording that was written to `new_recording_path`, or has grown.

        A finished recording without episodes is removed.
        """

    @abstractmethod
    def open_recording(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        """The recording that an `EpisodeHeader.recording` names; the caller closes it.

        `episodes` are the numbers of those that will be read (None: all); the recording may lack the others.

        Raises:
            NotFoundError: there is no such recording.
            RecordingError, FormatError: it cannot be opened, or is damaged.
        """

    @abstractmethod
    def declare_key(self, key: str) -> None:
        """Index an episode metadata key (`metadata.score`), so that filters on it stay fast. Doing it twice is fine.
        FilterError if there is no such key of headers."""


def check_page(limit: int | None, offset: int) -> None:
    """Raises StorageError unless both are numbers of episodes, or there is no limit."""
    for name, number in (("limit", 0 if limit is None else limit), ("offset", offset)):
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 1 << 63:
            raise StorageError(f"expected {name} to be an integer from 0, found {number!r:.80}")


def check_order(sort: str | None) -> None:
    """Raises FilterError unless it is None, or a text that names a key of episodes."""
    if sort is not None:
        if not isinstance(sort, str):
            raise FilterError(f"expected a key to sort by, such as 'return' or '-return', found {sort!r:.80}")
        path_in(sort.removeprefix("-"), EpisodeHeader)


def by_recording(headers: Iterable[EpisodeHeader]) -> dict[str, list[EpisodeHeader]]:
    """Episodes by the names of their recordings."""
    found: dict[str, list[EpisodeHeader]] = {}
    for header in headers:
        found.setdefault(header.recording, []).append(header)
    return found


def numbers_by_file(headers: Iterable[EpisodeHeader]) -> dict[tuple[str, str], list[int]]:
    """Numbers of episodes by the name and the UUID of their recording, as `TupliStorage.delete_numbers` takes them."""
    found: dict[tuple[str, str], list[int]] = {}
    for header in headers:
        found.setdefault((header.recording, uuid_of(header)), []).append(header.episode)
    return found


def each_opened(
    headers: Iterable[EpisodeHeader], open_recording: Callable[[str, Sequence[int]], Recording]
) -> Iterator[tuple[EpisodeHeader, RecordedEpisode]]:
    """The episodes of headers; a recording is open while those of its episodes are given that follow each other.
    NotFoundError if an episode was deleted meanwhile."""
    for name, same in itertools.groupby(headers, key=lambda header: header.recording):
        group = list(same)
        with open_recording(name, [header.episode for header in group]) as recording:
            positions = {int(number): i for i, number in enumerate(recording.index["episode"])}
            for header in group:
                if header.episode not in positions:
                    raise NotFoundError(f"episode {header.id} was deleted meanwhile")
                yield header, recording.episodes[positions[header.episode]]


def with_tuples(
    headers: Sequence[EpisodeHeader], open_recording: Callable[[str, Sequence[int]], Recording]
) -> Iterator[EpisodeItem]:
    """The episodes of headers, each with its tuples; see `each_opened`.

    A tuple's values have the type of the space's own samples; the info is empty if none was recorded.
    """
    for header, episode in each_opened(headers, open_recording):
        # Header and steps are valid already.
        yield EpisodeItem.model_construct(**dict(header), tuples=episode.tuples)


def oldest_first(items: Iterable[_Item]) -> list[_Item]:
    """Sorts benchmarks or artifacts by the time of their creation."""
    return sorted(items, key=age)


def age(item: BenchmarkHeader | ArtifactMetadataItem) -> tuple[int, str]:
    """What a benchmark or an artifact is sorted by: its time in nanoseconds, and its id."""
    return time_ns(item.created_at) or 0, item.id


def new_name(name: str = "") -> str:
    """The name of a new recording's file: time (UTC), a given name, and random digits."""
    now = datetime.datetime.now(datetime.UTC)
    named = files.as_file_name(name)
    return f"{now:%Y%m%dT%H%M%S}-{named}{'-' if named else ''}{secrets.token_hex(6)}.mcap"


def published_in(groups: Sequence[str], group: str) -> list[str]:
    """The groups that see an item, with `group` added. StorageError if `group` is no name of a group."""
    if not isinstance(group, str) or not group or not group.isprintable():
        raise StorageError(f"expected the name of a group to publish in, found {group!r:.80}")
    return [*groups, *([] if group in groups else [group])]


def episode_id(uuid: str, episode: int) -> str:
    """The id of an episode: its recording's UUID and its number."""
    return f"{uuid}-{episode}"


def is_episode_id(uri: object) -> bool:
    """Whether a value has the form of such an id."""
    return isinstance(uri, str) and _EPISODE_ID.fullmatch(uri) is not None


def no_such(kind: str, uri: object) -> NotFoundError:
    """The error for an id that nothing of a kind (benchmark, artifact, episode) has."""
    return NotFoundError(
        f"there is no {kind} with id {str(uri)[:80]!r}; list_{kind}s() (tupli-mcap list-{kind}s) names them all"
    )


def uuid_of(header: EpisodeHeader) -> str:
    """The UUID of the recording that an episode is of."""
    return header.id.rpartition("-")[0]


def anew(read: Callable[[], _T]) -> _T:
    """Calls a function that lists and reads; calls it again if a listed item was deleted before it was read.
    NotFoundError if this happened five times."""
    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(NotFoundError):
            return read()
    return read()
