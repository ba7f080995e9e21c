"""The sources of a dataset's episodes: a storage, or files."""

from __future__ import annotations

import contextlib
import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from pydantic import ValidationError

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import FormatError, RecordingError, TupliError, plural, warn
from tupli_mcap.mcap.source import PathSource, begins_with, head_of, most_open
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.progress import progress
from tupli_mcap.recording import Columns, Episode, Recording
from tupli_mcap.remote import in_home, is_url, path_of, shown_name
from tupli_mcap.schema import (
    BaseFilter,
    BenchmarkHeader,
    BenchmarkMetadata,
    EpisodeHeader,
    FilterIN,
    compile_predicate,
)
from tupli_mcap.schema.models import unchecked_header
from tupli_mcap.schema.times import iso_utc, iso_utc_each
from tupli_mcap.storage import TupliStorage
from tupli_mcap.storage.base import by_recording, episode_id, uuid_of
from tupli_mcap.storage.benchmark_json import restored
from tupli_mcap.storage.listing import recordings_at
from tupli_mcap.storage.sidecar import Notes, home_of

if TYPE_CHECKING:
    from tupli_mcap.storage import FileStorage

_CACHE_BYTES = 64 << 20  # a dataset reads each chunk once, or twice where two blocks share it


class DatasetError(TupliError, ValueError):
    """An invalid request to a dataset: batches without steps, a negative seed."""


def checked_whole(value: object, least: int, what: str) -> int:
    """The value, if it is an integer from `least` on. DatasetError if it is something else."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise DatasetError(f"expected {what} that is an integer from {least}, found {value!r:.80}")
    return int(value)


class EpisodeSource(Protocol):
    """Lists episodes and opens their recordings."""

    def episodes(self, episode_filter: BaseFilter | None) -> list[EpisodeHeader]:
        """The episodes that match a filter; those of one recording follow each other."""
        ...

    def open(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        """The recording that a header names; the caller closes it. `episodes` as in `TupliStorage.open_recording`."""
        ...

    def home_of(self, recording: str) -> tuple[TupliStorage, str]:
        """The storage that changes the recording that a header names, and the name that the storage has for it.
        RecordingError if nothing can change it."""
        ...


class Episodes(Protocol):
    """What the modules that `Dataset` uses ask of it, where it is documented."""

    @property
    def headers(self) -> Sequence[EpisodeHeader]: ...
    @property
    def n_steps(self) -> int: ...
    @property
    def example(self) -> Recording | None: ...
    @property
    def step_numbers(self) -> Array: ...

    chosen_by: tuple[str, ...]

    def opened(self) -> Iterator[tuple[str, Recording]]: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Episode]: ...
    def filter(self, test: BaseFilter | str) -> Self: ...
    def sort(self, key: str, *, descending: bool = False) -> Self: ...
    def head(self, n: int) -> Self: ...
    def read(self, fields: Sequence[str]) -> Columns: ...


class StorageSource:
    """The episodes of a storage; with a `benchmark_filter`, those of the benchmarks that match it."""

    def __init__(self, storage: TupliStorage) -> None:
        self.storage = storage
        self.benchmark_filter: BaseFilter | None = None

    def benchmarks(self) -> list[BenchmarkHeader]:
        return self.storage.list_benchmarks(self.benchmark_filter)

    def episodes(self, episode_filter: BaseFilter | None) -> list[EpisodeHeader]:
        wanted = episode_filter
        if self.benchmark_filter is not None:
            of_benchmarks = FilterIN(key="benchmark_id", value=[header.id for header in self.benchmarks()])
            wanted = of_benchmarks if episode_filter is None else of_benchmarks & episode_filter
        return self.storage.list_episodes(wanted)

    def open(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        return self.storage.open_recording(recording, episodes)

    def home_of(self, recording: str) -> tuple[TupliStorage, str]:
        return self.storage, recording

    def __repr__(self) -> str:
        return repr(self.storage)


class FilesSource:
    """The episodes of recordings given by path or URL; with a `benchmark_filter`, those of the benchmarks that match.
    Episodes that a storage has deleted are left out.

    Args:
        files: a file, a directory, a pattern ("runs/*.mcap", "**" for any depth), a URL, or several of those; the files
            of a directory or a pattern are taken in the order of their names.
        of_directory: they are the files of a directory, where files that are no recordings are left out with a warning.

    Raises:
        RecordingError: there is no file, a pattern matches nothing, or a path does not exist.
    """

    def __init__(
        self, files: str | os.PathLike[str] | Iterable[str | os.PathLike[str]], *, of_directory: bool = False
    ) -> None:
        self._of_directory = of_directory
        self.benchmark_filter: BaseFilter | None = None
        if not isinstance(files, str | os.PathLike | Iterable):
            raise RecordingError(
                f"expected paths of recordings, a pattern or a URL, found {files!r:.80}; give some"
            )
        given = [files] if isinstance(files, str | os.PathLike) else list(files)
        names = [name for item in given for name in files_at(item)]
        if not names:
            raise RecordingError("expected at least one recording, found none; give paths or a pattern")
        self.names = list(dict.fromkeys(names))
        # by the names that are shown; of paths the absolute ones, since the working directory may change
        self._places = {
            shown_name(name): name if is_url(name) else os.path.abspath(name)  # noqa: PTH100 - links stay
            for name in self.names
        }
        self._folders: dict[Path, FileStorage] = {}

    def benchmarks(self) -> list[BenchmarkHeader]:
        matches = compile_predicate(self.benchmark_filter, BenchmarkHeader)
        found: dict[tuple[str, str], BenchmarkHeader] = {}
        for _, recording in self._each():
            header = _benchmark_header(recording)
            if matches(header):
                found.setdefault((header.id, header.metadata.name), header)
        return list(found.values())

    def episodes(self, episode_filter: BaseFilter | None) -> list[EpisodeHeader]:
        of_benchmark = compile_predicate(self.benchmark_filter, BenchmarkHeader)
        matches = compile_predicate(episode_filter, EpisodeHeader)
        listed: dict[str, list[EpisodeHeader]] = {}  # by name
        by_uuid: dict[str, str] = {}  # the names of recordings; of copies, that of the largest, which counts
        made_of: dict[str, set[str]] = {}  # by name, the UUIDs of others
        for name, recording in self._each():
            if self.benchmark_filter is not None and not of_benchmark(_benchmark_header(recording)):
                continue
            listed[name] = list(episode_headers(recording, name, deleted_of(recording)))
            by_uuid[recording.uuid] = max(
                by_uuid.get(recording.uuid, name), name, key=lambda one: len(listed[one])
            )
            made_of[name] = recording.source_uuids
        for name, uuids in made_of.items():
            if sources := sorted(by_uuid[uuid] for uuid in uuids & by_uuid.keys()):
                more = f" and {len(sources) - 1} more" if len(sources) > 1 else ""
                warn(
                    f"{name} was made of {sources[0]}{more}, and both are here: their episodes count twice; unless "
                    "you want that, leave one of them out, or move it to another directory"
                )
        return [header for header in _each_once(listed) if episode_filter is None or matches(header)]

    def _each(self) -> Iterator[tuple[str, Recording]]:
        """The recordings and the names that are shown, each open until the next one."""
        with progress(len(self._places), "reading recordings") as bar:
            for name in self._places:
                bar.advance(1)
                try:
                    recording = self.open(name)
                except TupliError as err:
                    if not self._of_directory:
                        raise
                    warn(f"{err}; it is left out")
                    continue
                with recording:
                    yield recording.name if is_url(name) else name, recording

    def open(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        place = self._places.get(recording, recording)
        # while that is the same file, the path as it was given: error messages show it
        as_given = not is_url(place) and os.path.abspath(recording) == place  # noqa: PTH100 - links stay
        return Recording(recording if as_given else place, cache_bytes=_CACHE_BYTES)

    def home_of(self, recording: str) -> tuple[TupliStorage, str]:
        if is_url(recording):
            raise RecordingError(f"{recording} cannot be changed here; download it, and open the copy")
        from tupli_mcap.storage import FileStorage  # and with it a database, which reading does not need

        root, name = home_of(Path(self._places.get(recording, recording)))
        if root not in self._folders:
            self._folders[root] = FileStorage(root)
        return self._folders[root], name

    def __repr__(self) -> str:
        return repr(shown_name(self.names[0])) if len(self.names) == 1 else f"{len(self.names)} files"


class JoinedSource:
    """The recordings of several sources, each with its wanted episodes.
    DatasetError if two sources have different recordings with the same name."""

    def __init__(self, sources: Sequence[tuple[EpisodeSource, Sequence[EpisodeHeader]]]) -> None:
        self._sources = [source for source, _ in sources]
        self._of: dict[str, tuple[EpisodeSource, str]] = {}
        for source, headers in sources:
            for header in headers:
                uuid = uuid_of(header)
                first, known = self._of.setdefault(header.recording, (source, uuid))
                if known != uuid:
                    raise DatasetError(
                        f"{first!r} and {source!r} have different recordings called {header.recording!r}; "
                        "save one of the datasets to a file, and add that"
                    )

    def episodes(self, episode_filter: BaseFilter | None) -> list[EpisodeHeader]:
        found = [source.episodes(episode_filter) for source in self._sources]
        return list({header.id: header for headers in found for header in headers}.values())

    def open(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        return self._of[recording][0].open(recording, episodes)

    def home_of(self, recording: str) -> tuple[TupliStorage, str]:
        return self._of[recording][0].home_of(recording)

    def __repr__(self) -> str:
        return " + ".join(map(repr, self._sources))


def _each_once(listed: Mapping[str, Sequence[EpisodeHeader]]) -> list[EpisodeHeader]:
    """Each episode of some files once. Of files that are copies of one recording, the largest one counts (one may have
    been cut off, or gone on), of equal ones the first; warns of what is left out."""
    sizes = {name: (len(headers), sum(one.n_tuples for one in headers)) for name, headers in listed.items()}
    counted: dict[str, EpisodeHeader] = {}
    for name in sorted(listed, key=sizes.__getitem__, reverse=True):  # stable also in reverse
        copies = [header for header in listed[name] if header.id in counted]
        if copies:
            warn(_left_out(name, copies, counted, sizes))
        for header in listed[name]:
            counted.setdefault(header.id, header)
    return [header for headers in listed.values() for header in headers if counted[header.id] is header]


def _left_out(
    name: str,
    copies: Sequence[EpisodeHeader],
    counted: Mapping[str, EpisodeHeader],
    sizes: Mapping[str, tuple[int, int]],
) -> str:
    """What to warn of where a file has episodes that count as those of another file."""
    first, many = counted[copies[0].id].recording, plural(len(copies), "episode")
    same = [(one.created_at, one.n_tuples) for one in copies]
    if same == [(counted[one.id].created_at, counted[one.id].n_tuples) for one in copies]:
        return f"{name} holds {many} of {first} again; {'they are' if len(copies) > 1 else 'it is'} left out"
    a, b = (
        f"{one} ({plural(sizes[one][0], 'episode')}, {plural(sizes[one][1], 'step')})"
        for one in (name, first)
    )
    return (
        f"{a} and {b} are copies of one recording, but one was cut off, or both went on; the larger one counts, of "
        f"equal ones the first: {many} of {name} left out; open it by itself to see them"
    )


def files_at(item: str | os.PathLike[str]) -> list[str]:
    """As `recordings_at`; `~` is the user's directory."""
    if not isinstance(item, str | os.PathLike):
        raise RecordingError(f"expected the path of a recording or a pattern, found {item!r:.80}")
    name = os.fspath(item)
    return recordings_at(name if is_url(name) else in_home(path_of(name)))


def deleted_of(recording: Recording) -> set[int]:
    """The numbers of the episodes of a recording that are deleted, also of those that its file lacks since it was
    compacted; none of one at a URL."""
    if recording.path is None:
        return set()
    deleted = Notes.read(recording.path).about(recording.metadata).deleted
    with contextlib.suppress(TupliError), contextlib.closing(PathSource(recording.path)) as now:
        # after the notes, which `compact` removes when the new file is there
        if not begins_with(now, head_of(recording.file.source)):
            with Recording(recording.path) as rewritten:
                if rewritten.uuid == recording.uuid:
                    deleted |= {*recording.index["episode"].tolist()} - {*rewritten.index["episode"].tolist()}
    return deleted


def episode_headers(recording: Recording, name: str, deleted: set[int]) -> Iterator[EpisodeHeader]:
    """The headers that a storage would list; `recording` of each is the name by which the file was opened."""
    index = recording.index
    columns: list[Any] = [index[field].tolist() for field in ("episode", "env", "length", "end", "return")]
    columns += [recording.seeds, iso_utc_each(index["end_time"])]
    uuid, benchmark_id = recording.uuid, recording.benchmark_id
    for number, env, length, end, total, seed, ended, metadata, run in zip(
        *columns, recording.all_metadata(), recording.listed_runs(), strict=True
    ):
        if number in deleted:
            continue
        yield unchecked_header(
            {
                "id": episode_id(uuid, number),
                "created_by": "",
                "published_in": [],
                "created_at": ended,
                "benchmark_id": benchmark_id,
                "metadata": {} if metadata == "{}" else _metadata(metadata, name, number),
                "n_tuples": length,
                "terminated": END_NAMES[end] == "terminal",
                "timeout": END_NAMES[end] == "timeout",
                "end": END_NAMES[end],
                "episode_return": total,
                "seed": seed,
                "env": env,
                "episode": number,
                "recording": name,
                "run": run,
            }
        )


def _metadata(text: str, name: str, number: int) -> dict[str, Any]:
    place = f"{name}: metadata of episode {number}"
    value = jsonvalue.loads_at(place, text)
    if not isinstance(value, dict):
        raise FormatError(f"{place}: expected a JSON object, found {value!r:.80}")
    return value


def _benchmark_header(recording: Recording) -> BenchmarkHeader:
    """The header of a recording's benchmark; without a benchmark, the id is empty."""
    metadata, environment = BenchmarkMetadata(name=""), ""
    if DOCUMENT_NAME in recording.attachments:
        record = recording.benchmark.record
        metadata, environment = BenchmarkMetadata(name=record.name), record.name
        entry = (record.benchmark or {}).get("metadata")
        if isinstance(entry, dict):
            with contextlib.suppress(ValidationError, FormatError):  # a stranger's metadata may be anything
                metadata = BenchmarkMetadata.model_validate(restored(entry))
    return BenchmarkHeader(
        id=recording.benchmark_id,
        created_by="",
        created_at=iso_utc(recording.created_ns),
        hash=recording.benchmark_id,
        metadata=metadata,
        environment=environment,
    )


class OpenRecordings:
    """Opens recordings by name. An `Episode` keeps its recording open as long as it lives. Not thread-safe; a pickled
    copy opens them itself."""

    def __init__(self, open_recording: Callable[[str, Sequence[int]], Recording]) -> None:
        self._open = open_recording
        self._kept: OrderedDict[str, tuple[Recording, frozenset[int]]] = OrderedDict()  # with their episodes

    def __reduce__(self) -> tuple[type[OpenRecordings], tuple[Callable[..., Recording]]]:
        return OpenRecordings, (self._open,)

    def get(self, name: str, episodes: Sequence[int], needed: Sequence[int] | None = None) -> Recording:
        """The recording with at least the episodes `needed`, by default all of `episodes`.
        RecordingError if it cannot be opened."""
        kept = self._kept.get(name)
        if kept is None or not kept[1].issuperset(episodes if needed is None else needed):
            recording = self._open(name, episodes)
            self._kept[name] = recording, frozenset(recording.index["episode"].tolist())
            if len(self._kept) > most_open():
                self._kept.popitem(last=False)  # closed when nobody holds an episode of it
        self._kept.move_to_end(name)
        return self._kept[name][0]

    def forget(self) -> None:
        """Closes those of which nobody holds an episode."""
        self._kept.clear()


def place_of(recording: Recording) -> str:
    """The path or URL of a recording, by which it can be opened again; DatasetError if it has none."""
    if recording.address is None:
        raise DatasetError(f"{recording.name} was opened as a file object; open it by its path or URL")
    return recording.address


def numbers_by_recording(headers: Iterable[EpisodeHeader]) -> dict[str, list[int]]:
    """The numbers of episodes, by recording."""
    return {name: [header.episode for header in same] for name, same in by_recording(headers).items()}
