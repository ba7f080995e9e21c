"""`FileStorage`: a storage in a directory."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel
from sqlalchemy import Connection

from tupli_mcap.errors import NotFoundError, RecordingError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.annotate import user_name
from tupli_mcap.remote import check_local, is_url, shown
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
)
from tupli_mcap.storage.atomic import Lock, fill, os_errors, read_model, refusals_told, write_bytes
from tupli_mcap.storage.base import TupliStorage, check_given, no_such
from tupli_mcap.storage.bundles import export_episodes, read_bundle, write_bundle
from tupli_mcap.storage.catalog.queries import count_episodes, path_to_declare, plan_of
from tupli_mcap.storage.files.artifacts import ArtifactFiles
from tupli_mcap.storage.files.benchmarks import BenchmarkFiles
from tupli_mcap.storage.files.recordings import RecordingFiles
from tupli_mcap.storage.files.sync import SyncedCatalog
from tupli_mcap.storage.from_values import record_each, write_episodes

if TYPE_CHECKING:
    from tupli_mcap.signing import SigningKey

_T = TypeVar("_T")
_Names = TypeVar("_Names")


def _several(names: _Names) -> _Names:
    """StorageError for one text: its letters would count as names, of which there are none."""
    if isinstance(names, str):
        raise StorageError(
            f"expected a list of ids or recordings, found one text, {names!r:.80}; give [{names!r:.80}]"
        )
    return names


def _checked(key: str) -> str:
    path_to_declare(key)
    return key


class _Settings(BaseModel):
    version: Literal[1] = 1
    declared_keys: list[Annotated[str, AfterValidator(_checked)]] = []


@refusals_told
class FileStorage(TupliStorage):
    """A storage in the directory `root` (`storage_base_dir` is PyTupli's name for it), which the first write makes.

    Any number of threads and processes may use one directory at once. The files alone count: recordings that are copied
    into the directory are found, and those that are removed from it are gone.

    Raises:
        StorageError: `root` is something else than a directory, or cannot be read.
        FormatError: its `storage.json` is damaged.
    """

    def __init__(
        self,
        root: str | os.PathLike[str] = "_local_storage",
        *,
        storage_base_dir: str | os.PathLike[str] | None = None,
    ) -> None:
        place = root if storage_base_dir is None else storage_base_dir
        if is_url(os.fspath(place)):
            raise StorageError(
                f"expected the directory of a storage, found {shown(os.fspath(place))!r:.200}; "
                "TupliAPIClient takes the address of a server"
            )
        if not os.fspath(place):
            raise StorageError(
                "expected the directory of a storage, found an empty text; name this directory as '.'"
            )
        # Absolute: the working directory may change while something is recorded.
        self.root = Path(place).absolute()
        try:
            with os_errors("cannot use the storage", self.root), contextlib.suppress(FileNotFoundError):
                os.scandir(self.root).close()
        except ValueError as err:  # a NUL in it
            raise StorageError(
                f"cannot use the storage {str(self.root)!r}: {err}; choose another path"
            ) from err
        self._lock = Lock(self.root / ".lock")
        self.import_lock = Lock(self.root / ".import.lock")  # so that two imports do not copy one file twice
        self._benchmarks = BenchmarkFiles(self.root / "benchmarks", self._lock)
        self._artifacts = ArtifactFiles(self.root / "artifacts", self._lock)
        self._catalog = SyncedCatalog(self.root, self._settings().declared_keys)
        self._recordings = RecordingFiles(self.root, self._lock, self._catalog)

    def close(self) -> None:
        """Release the catalog; the storage can still be used, and opens it again."""
        self._catalog.close()

    def __reduce__(self) -> tuple[type[FileStorage], tuple[Path]]:
        return type(self), (self.root,)  # each process opens the catalog itself

    def __repr__(self) -> str:
        return f"FileStorage({str(self.root)!r})"

    # --- benchmarks ---

    def store_benchmark(self, benchmark_query: BenchmarkQuery) -> BenchmarkHeader:
        return self._benchmarks.store(benchmark_query)

    def load_benchmark(self, uri: str) -> Benchmark:
        return self._benchmarks.load(uri)

    def edit_benchmark(
        self, uri: str, *, name: str | None = None, description: str | None = None, dry_run: bool = False
    ) -> BenchmarkHeader:
        """Gives a benchmark another name or description, which lists, filters and bundles then show.

        Its id, its episodes and its stored metadata stay; the edit keeps the user's name and the time.

        Raises:
            NotFoundError: There is no such benchmark.
            StorageError: Nothing is given, or it cannot be written.
        """
        given = {"name": name, "description": description}
        changes = {key: value for key, value in given.items() if value is not None}
        return self._benchmarks.edit(uri, changes, user_name(), dry_run=dry_run)

    def undo_benchmark_edit(self, uri: str, *, dry_run: bool = False) -> BenchmarkHeader:
        """Undoes the last edit of a benchmark.

        Raises:
            NotFoundError: There is no such benchmark.
            StorageError: There is no edit, or it cannot be written.
        """
        return self._benchmarks.undo_edit(uri, dry_run=dry_run)

    def list_benchmarks(self, filter: BaseFilter | str | None = None) -> list[BenchmarkHeader]:
        return self._benchmarks.list(filter)

    def delete_benchmark(self, uri: str, *, episodes: bool = False) -> int:
        with self._lock:
            if not self._benchmarks.exists(uri):  # its episodes then stay, too
                raise no_such("benchmark", uri)
            directory = self.root / "recordings" / uri
            deleted, emptied = set[str](), set[Path]()
            if episodes:
                self._recordings.refuse_live(uri)
                # again: those of a copy are listed once those of the other file are deleted
                of_it = FilterEQ(key="benchmark_id", value=uri)
                while (headers := self._catalog.headers(of_it)) and self._recordings.delete(headers):
                    deleted.update(header.id for header in headers)
                    emptied.update(self.root / header.recording for header in headers)
            self._benchmarks.delete(uri)
            self._recordings.remove_emptied(emptied.union(directory.glob("*.mcap")))
            self._recordings.remove_directory(directory)
            return len(deleted)

    def beginning_recording(self) -> AbstractContextManager[object]:
        return self._lock

    def publish_benchmark(self, uri: str, publish_in: str = "global") -> None:
        self._benchmarks.publish(uri, publish_in)

    # --- artifacts ---

    def store_artifact(self, artifact: bytes, metadata: ArtifactMetadata) -> ArtifactMetadataItem:
        return self._artifacts.store(artifact, metadata)

    def load_artifact(self, uri: str, **kwargs: Any) -> bytes:
        return self._artifacts.load(uri)

    def list_artifacts(self, filter: BaseFilter | str | None = None) -> list[ArtifactMetadataItem]:
        return self._artifacts.list(filter)

    def artifact_users(self, uri: str) -> list[str]:
        self._artifacts.path(uri)  # is there one?
        return [
            header.id for header in self.list_benchmarks() if uri in self._benchmarks.artifacts(header.id)
        ]

    def delete_artifact(self, uri: str, *, force: bool = False) -> None:
        with self._lock:  # no benchmark that needs it may come in between
            users = [] if force else self.artifact_users(uri)
            if users:
                raise StorageError(
                    f"artifact {uri} is needed by benchmark {', '.join(users)}; delete that first, "
                    "or pass force=True"
                )
            self._artifacts.delete(uri)

    def publish_artifact(self, uri: str, publish_in: str = "global") -> None:
        self._artifacts.publish(uri, publish_in)

    # --- episodes ---

    def record_episodes(self, episodes: Iterable[Episode]) -> list[EpisodeHeader]:
        return record_each(episodes, self._record)

    def _record(self, benchmark_id: str, episodes: Sequence[Episode]) -> list[EpisodeHeader]:
        benchmark = self.load_benchmark(benchmark_id)
        path = self.new_recording_path(benchmark_id)
        with os_errors("cannot record", path), fill(path) as temporary:
            write_episodes(temporary, episodes, benchmark)
        with self._lock:
            if not self._benchmarks.exists(benchmark_id):  # deleted meanwhile, with its episodes
                path.unlink()
                raise NotFoundError(f"benchmark {benchmark_id} was deleted while an episode was recorded")
            self.ingest(path)
            return self._recordings.of_recording(path)

    def list_headers(
        self, filter: BaseFilter | str | None, limit: int | None, offset: int, sort: str | None
    ) -> list[EpisodeHeader]:
        return self._catalog.headers(filter, limit=limit, offset=offset, sort=sort)

    def count_episodes(self, filter: BaseFilter | str | None = None) -> int:
        return self.ask(lambda connection: count_episodes(connection, filter))

    def ask(self, question: Callable[[Connection], _T]) -> _T:
        """The result of a function of a connection to the up-to-date catalog, such as those of `catalog.queries`."""
        return self._catalog.ask(question)

    @property
    def skipped(self) -> dict[str, str]:
        """The recordings that the last query left out, and why: unreadable ones, and copies of others."""
        return self._catalog.skipped

    @property
    def unreadable(self) -> dict[str, str]:
        """The recordings that the last query could not read, and why."""
        return self._catalog.unreadable

    def explain(self, filter: BaseFilter | str | None) -> str:
        """The SQL that a filter over episodes becomes, and SQLite's plan for it."""
        return self.ask(lambda connection: plan_of(connection, filter))

    def delete_episode(self, uri: str) -> None:
        if not self._recordings.delete([self._recordings.header(uri)]):
            raise NotFoundError(f"episode {uri} was deleted by somebody else meanwhile")

    def delete_episodes(self, filter: BaseFilter | str) -> int:
        check_given(filter)
        return self._recordings.delete(self._catalog.headers(filter))

    def delete_numbers(
        self, by_recording: Mapping[tuple[str, str], Collection[int]], *, dry_run: bool = False
    ) -> int:
        # The recordings may be copies of others, which the catalog does not list.
        return self._recordings.delete_numbers(by_recording, dry_run=dry_run)

    def deleted_episodes(self, recordings: Collection[str] | None = None) -> list[str]:
        """The ids of deleted episodes that can be restored, because `compact` has not freed their space.

        `recordings`: only those at these paths below `root`.
        """
        return self._recordings.deleted(_several(recordings))

    def restore_episodes(
        self, ids: Iterable[str] | None = None, recordings: Collection[str] | None = None
    ) -> int:
        """Restores deleted episodes, by default all that `deleted_episodes` names; returns their number.

        Other ids are ignored. `recordings`: only those at these paths below `root`.
        """
        only, given = _several(recordings), _several(ids)
        wanted = set(self._recordings.deleted(only) if given is None else given)
        return self._recordings.restore(wanted, only)

    def publish_episode(self, uri: str, publish_in: str = "global") -> None:
        self._recordings.publish(self._recordings.header(uri), publish_in)

    # --- recordings ---

    def new_recording_path(self, benchmark_id: str, name: str = "") -> Path:
        self._benchmarks.header(benchmark_id)
        return self._recordings.new_path(benchmark_id, name)

    def ingest(self, path: Path) -> None:
        self._recordings.ingest(path)

    def recording_path(self, recording: str) -> Path:
        """The file of a recording that a header names.

        Raises:
            NotFoundError: there is none.
        """
        return self._recordings.path(recording)

    def open_recording(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        path = self._recordings.path(recording)
        try:
            return Recording(path)
        except RecordingError as err:
            if path.exists():
                raise
            raise NotFoundError(f"recording {recording!r} was deleted meanwhile") from err

    def declare_key(self, key: str) -> None:
        self._catalog.declare_key(key)
        with self._lock, os_errors("cannot declare a key in", self.root):
            settings = self._settings()
            if key not in settings.declared_keys:
                settings.declared_keys.append(key)
                write_bytes(self.root / "storage.json", settings.model_dump_json(indent=2).encode())

    def declared_keys(self) -> list[str]:
        """The metadata keys that are indexed."""
        return self._settings().declared_keys

    def reindex(self) -> None:
        """Rebuild the catalog from the recordings."""
        self._catalog.reindex()

    def compact(self, recordings: Collection[str] | None = None) -> int:
        """Rewrite recordings that hold deleted episodes, and remove the temporary files of killed processes; returns
        the number of bytes freed, which is below 0 if new files are larger (an unfinished one gets its index).

        Recordings that are being written are left alone. Episodes that stay keep their ids. `recordings`: only those
        at these paths below `root`.
        """
        return self._recordings.compact(_several(recordings))

    # --- sharing ---

    def bundle(
        self,
        benchmark_id: str,
        target: str | os.PathLike[str],
        filter: BaseFilter | str | None = None,
        *,
        sign: SigningKey | None = None,
    ) -> Path:
        """Write one file that holds a benchmark, its artifacts and its episodes, see `write_bundle`."""
        check_local(target)
        return write_bundle(self, benchmark_id, Path(target), filter, sign)

    def export(self, target: str | os.PathLike[str], filter: BaseFilter | str | None = None) -> Path:
        """Write episodes of one benchmark, those that match a filter, into one file; see `export_episodes`."""
        check_local(target)
        export_episodes(self, Path(target), filter)
        return Path(target)

    def import_bundle(
        self,
        path: str | os.PathLike[str],
        *,
        trust: bool = False,
        require_signature: bool = False,
        signers: Sequence[str] = (),
        name: str = "",
    ) -> str:
        """Import a file that `bundle` wrote, or any other recording, see `read_bundle`; returns the benchmark's id,
        or an empty text if it has none."""
        if is_url(os.fspath(path)):
            raise StorageError(
                f"expected a local path, found {shown(os.fspath(path))!r:.200}; tupli-mcap import fetches it"
            )
        imported = read_bundle(
            self, Path(path), trust=trust, require_signature=require_signature, signers=signers, name=name
        )
        return imported.benchmark_id

    def _settings(self) -> _Settings:
        return read_model(_Settings, self.root / "storage.json", "the settings of a storage")
