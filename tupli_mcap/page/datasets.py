"""Datasets: the recordings of one benchmark, or of one environment if they have no benchmark."""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Final, NamedTuple

from sqlalchemy import ColumnElement, Connection, and_, func, select, true

from tupli_mcap.errors import FilterError, NotFoundError
from tupli_mcap.page.shelf import Shelf
from tupli_mcap.schema import BenchmarkHeader, EpisodeHeader, FilterEQ, format_filter
from tupli_mcap.schema.times import time_ns
from tupli_mcap.storage.catalog.tables import RECORDING, TALLY
from tupli_mcap.storage.catalog.tallies import Tally, recordings_seen, tallies
from tupli_mcap.storage.listing import LIVE
from tupli_mcap.storage.texts import escape_text, is_hash, unescape_text

_PLAIN: Final = re.compile(r"\w[\w.@:+ -]{0,100}(/\w[\w.@:+ -]{0,100}){0,3}", re.ASCII)
_NAMELESS: Final = "-"
_UNNAMED: Final = "Recordings without an environment"


class Audience(NamedTuple):
    """A number of episodes of one owner, and the groups that see them, as far as the reader may know of these."""

    owner: str
    published_in: list[str]
    episodes: int

    @property
    def groups(self) -> list[str]:
        """The groups without the owner's own; `private` if no other sees them."""
        return [group for group in self.published_in if group != self.owner] or ["private"]


@dataclass(frozen=True)
class Dataset:
    """The facts of a dataset that the catalog has without reading its episodes. They are sums over its files: an
    episode that two files have, which lists show once, counts twice.

    key: its name in addresses. benchmark: None for recordings without one, or if the reader may not see it.
    recordings, audiences: empty only for a benchmark without recordings.
    """

    key: str
    benchmark_id: str
    environment: str
    benchmark: BenchmarkHeader | None
    recordings: Sequence[Tally]
    audiences: Sequence[Audience]

    @property
    def name(self) -> str:
        """The name of the benchmark, else of the environment, else of the run if there is only one."""
        named = self.benchmark.metadata.name if self.benchmark else ""
        runs = {str(run.get("name", "")) for run in self.runs}
        only = next(iter(runs)) if len(runs) == 1 else ""
        unnamed = f"benchmark {self.benchmark_id[:8]}" if self.benchmark_id else only or _UNNAMED
        return named or self.environment or unnamed

    def has_of(self, user: str) -> bool:
        """Whether its benchmark or some of its episodes are a user's."""
        owners = {part.owner for part in self.audiences}
        return user in owners or (self.benchmark is not None and self.benchmark.created_by == user)

    @property
    def description(self) -> str:
        return self.benchmark.metadata.description if self.benchmark else ""

    @property
    def owners(self) -> list[str]:
        """The owner of the benchmark, else those of its episodes."""
        return sorted({part.owner for part in self._shared})

    @property
    def seen_by(self) -> list[str]:
        """The groups in which the benchmark is published, else those in which any of its episodes is."""
        return sorted({group for part in self._shared for group in part.groups})

    @property
    def _shared(self) -> Sequence[Audience]:
        header = self.benchmark
        return [Audience(header.created_by, header.published_in, 0)] if header else self.audiences

    @property
    def episodes(self) -> int:
        return sum(item.episodes for item in self.recordings)

    @property
    def steps(self) -> int:
        return sum(item.steps for item in self.recordings)

    @property
    def size(self) -> int | None:
        """The size of the files (bytes); None if the reader may not see all episodes of one. Those that were deleted on
        a server nobody may see, and its file still has them."""
        sizes = [item.size for item in self.recordings if item.size is not None]
        return sum(sizes) if len(sizes) == len(self.recordings) else None

    @property
    def return_mean(self) -> float | None:
        """The mean over the episodes whose return is a number."""
        known = sum(item.returns for item in self.recordings)
        return sum(item.return_sum or 0.0 for item in self.recordings) / known if known else None

    @property
    def return_least(self) -> float | None:
        return min((r.return_least for r in self.recordings if r.return_least is not None), default=None)

    @property
    def return_most(self) -> float | None:
        return max((r.return_most for r in self.recordings if r.return_most is not None), default=None)

    @property
    def success(self) -> tuple[int, int]:
        """The number of successes, and the number of episodes that have `success`."""
        return sum(item.succeeded for item in self.recordings), sum(item.told for item in self.recordings)

    @property
    def first(self) -> int:
        """When its first episode ended (ns); for a benchmark without episodes, when it was stored."""
        return min((item.first for item in self.recordings), default=self._stored)

    @property
    def last(self) -> int:
        return max((item.last for item in self.recordings), default=self._stored)

    @property
    def _stored(self) -> int:
        return (time_ns(self.benchmark.created_at) or 0) if self.benchmark else 0

    @property
    def live(self) -> bool:
        """Whether a process is writing to one of its recordings."""
        return any(item.mixed == LIVE for item in self.recordings)

    @cached_property
    def runs(self) -> list[dict[str, Any]]:
        """The runs of its recordings, in the order of their files."""
        return [run for item in self.recordings for run in item.runs]

    def holds(self, words: Sequence[str]) -> bool:
        """Whether each of the words (lower case) is in its names, description, owner or tags."""
        said = [self.name, self.description, self.environment, self.benchmark_id]
        said += self.owners
        for run in self.runs:
            said += [str(run.get("name", "")), *map(str, run.get("tags", ()))]
        text = "\n".join(said).lower()
        return all(word in text for word in words)

    def facts(self) -> dict[str, Any]:
        """The facts of it that go into JSON."""
        succeeded, told = self.success
        return {
            "key": self.key,
            "name": self.name,
            "description": self.description,
            "environment": self.environment,
            "benchmark_id": self.benchmark_id or None,
            "owner": self.owners[0] if len(self.owners) == 1 else None,
            "owners": self.owners,
            "published_in": sorted({group for part in self._shared for group in part.published_in}),
            "recordings": len(self.recordings),
            "episodes": self.episodes,
            "steps": self.steps,
            "bytes": self.size,
            "return": {"mean": self.return_mean, "min": self.return_least, "max": self.return_most},
            "success": succeeded / told if told else None,
            "first_ns": self.first,
            "last_ns": self.last,
            "live": self.live,
        }


def all_datasets(shelf: Shelf, connection: Connection) -> list[Dataset]:
    """All datasets of a shelf, the most recently recorded first."""
    found = _grouped(
        shelf, connection, {header.id: header for header in shelf.benchmarks(connection)}, true()
    )
    return sorted(found, key=lambda dataset: (-dataset.last, dataset.name))


def find_dataset(shelf: Shelf, connection: Connection, key: str) -> Dataset:
    """A dataset by its key. NotFoundError if there is none that the reader may see."""
    benchmarks = {h.id: h for h in shelf.benchmarks(connection, FilterEQ(key="id", value=key))}
    found = _grouped(shelf, connection, benchmarks, of_dataset(key))
    if not found:
        raise NotFoundError(f"there is no dataset {key[:80]!r} here")
    return found[0]


def dataset_filter(key: str) -> str:
    """The text of a filter for the episodes of a dataset; empty for no key, or for a name that no filter can hold."""
    if not key:
        return ""
    benchmark_id, environment = _meant(key)
    try:
        of = FilterEQ(key="benchmark_id", value=benchmark_id)
        return format_filter(of if benchmark_id else FilterEQ(key="run.environment", value=environment) & of)
    except FilterError:  # a lone surrogate
        return ""


def dataset_of(shelf: Shelf, connection: Connection, header: EpisodeHeader) -> Dataset:
    found = select(RECORDING.c.benchmark_id, RECORDING.c.environment).where(of_recording(header.recording))
    benchmark_id, environment = connection.execute(found).one()
    return find_dataset(shelf, connection, _key(unescape_text(benchmark_id), unescape_text(environment)))


def of_recording(name: str) -> ColumnElement[bool]:
    """A condition on RECORDING: the recording of this name."""
    return RECORDING.c.path == escape_text(name)


def of_dataset(key: str) -> ColumnElement[bool]:
    """A condition on RECORDING: the recordings of the dataset with this key."""
    benchmark_id, environment = _meant(key)
    if benchmark_id:
        return RECORDING.c.benchmark_id == escape_text(benchmark_id)
    return and_(RECORDING.c.benchmark_id == "", RECORDING.c.environment == escape_text(environment))


def seen_in(
    shelf: Shelf, connection: Connection, key: str, *conditions: ColumnElement[bool]
) -> dict[str, Any]:
    """The arguments with which `find_episodes` and `count_episodes` look only at what the reader may see: of a dataset,
    unless its key is empty, and of the recordings that all conditions are true of."""
    of = and_(recordings_seen(shelf.seen), *([of_dataset(key)] if key else []), *conditions)
    return {"only": shelf.seen_episodes(connection), "of": of, "told": partial(shelf.as_told, connection)}


def _grouped(
    shelf: Shelf, connection: Connection, benchmarks: Mapping[str, BenchmarkHeader], of: ColumnElement[bool]
) -> list[Dataset]:
    """The datasets of benchmarks, and of the recordings that meet the condition `of`."""
    groups: dict[str, list[Tally]] = {uri: [] for uri in benchmarks}
    for item in tallies(connection, _seen(shelf), of, shelf.some_deleted):
        groups.setdefault(_key(item.benchmark_id, item.environment), []).append(item)
    audiences = _audiences(shelf, connection, of)
    made = []
    for key, items in groups.items():
        header = benchmarks.get(key)
        benchmark_id = header.id if header else items[0].benchmark_id
        environment = (items[0].environment if items else "") or (header.environment if header else "")
        made.append(Dataset(key, benchmark_id, environment, header, items, audiences.get(key, ())))
    return made


def _seen(shelf: Shelf) -> ColumnElement[bool]:
    return shelf.seen(TALLY.c.created_by, TALLY.c.published_in)


def _audiences(shelf: Shelf, connection: Connection, of: ColumnElement[bool]) -> dict[str, list[Audience]]:
    """The audiences of each dataset, by its key."""
    parts = (RECORDING.c.benchmark_id, RECORDING.c.environment, TALLY.c.created_by, TALLY.c.published_in)
    query = (
        select(*parts, func.sum(TALLY.c.episodes))
        .join(RECORDING, RECORDING.c.id == TALLY.c.recording_id)
        .where(_seen(shelf), of)
        .group_by(*parts)
    )
    found = [
        (
            _key(unescape_text(benchmark), unescape_text(environment)),
            unescape_text(owner),
            json.loads(groups),
            count,
        )
        for benchmark, environment, owner, groups, count in connection.execute(query)
    ]
    known = shelf.known_audiences(connection, {name for _, _, groups, _ in found for name in groups})
    counts = Counter[tuple[str, str, tuple[str, ...]]]()
    for key, owner, groups, count in found:
        counts[key, owner, tuple(known(owner, groups))] += int(count)
    made: dict[str, list[Audience]] = {}
    for (key, owner, groups), count in counts.items():
        made.setdefault(key, []).append(Audience(owner, list(groups), count))
    return made


def _key(benchmark_id: str, environment: str) -> str:
    """The key of a dataset: a benchmark's id, an environment's name, or a code (`~b…`, `~e…`) for an unusual one."""
    if is_hash(benchmark_id):
        return benchmark_id
    if not benchmark_id and not environment:
        return _NAMELESS
    if not benchmark_id and _PLAIN.fullmatch(environment) and not is_hash(environment):
        return environment
    text = (benchmark_id or environment).encode("utf-8", "surrogatepass")
    return f"~{'b' if benchmark_id else 'e'}{base64.urlsafe_b64encode(text).decode().rstrip('=')}"


def _meant(key: str) -> tuple[str, str]:
    """The benchmark id and the environment's name of a key; one of them is empty."""
    if is_hash(key):
        return key, ""
    if not key.startswith("~"):
        return "", "" if key == _NAMELESS else key
    try:
        text = base64.urlsafe_b64decode(key[2:] + "=" * (-len(key[2:]) % 4)).decode("utf-8", "surrogatepass")
    except (binascii.Error, ValueError) as err:
        raise NotFoundError(f"there is no dataset {key[:80]!r} here") from err
    return (text, "") if key[1:2] == "b" else ("", text)
