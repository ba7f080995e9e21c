"""Metadata models: benchmarks, artifacts, episodes and their tuples, as PyTupli names them."""

from __future__ import annotations

import datetime
import uuid
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Self

from pydantic import BaseModel, Field, PrivateAttr

from tupli_mcap.errors import StorageError


def _fresh(data: Mapping[str, Any]) -> dict[str, Any]:
    """The fields a new item gets unless the caller gives them: id, time (UTC), and who may see it."""
    created_by = data.get("created_by")
    fields = {
        "id": uuid.uuid4().hex,
        "created_at": datetime.datetime.now(datetime.UTC).isoformat(),
        "published_in": [] if created_by is None else [created_by],
    }
    return {**fields, **data}


class DBItem(BaseModel):
    """What every stored item has. `created_at` is ISO 8601; `published_in` names groups."""

    id: str
    created_by: str
    published_in: list[str] = Field(default_factory=list)
    created_at: str

    @classmethod
    def create_new(cls, **data: Any) -> Self:
        """A new item with a random id, created now, visible to its creator; `data` are the other fields."""
        return cls(**_fresh(data))


class ArtifactMetadata(BaseModel):
    """What a user says about an artifact; `benchmark_id` is None where it belongs to no single benchmark."""

    name: str
    description: str = ""
    benchmark_id: str | None = None
    extra: dict[str, Any] = Field(default_factory=dict)


class ArtifactMetadataItem(DBItem, ArtifactMetadata):
    """A stored artifact; `hash` is the SHA-256 of its bytes in lower-case hexadecimal digits."""

    hash: str
    encoding: str = "utf-8"


class BenchmarkMetadata(BaseModel):
    """What a user says about a benchmark."""

    name: str
    description: str = ""
    difficulty: str | None = None
    version: str | None = None
    extra: dict[str, Any] = Field(default_factory=dict)


class BenchmarkQuery(BaseModel):
    """A benchmark on its way into a storage: `serialized` is its environment as text, `hash` its identity."""

    hash: str
    serialized: str
    metadata: BenchmarkMetadata


class BenchmarkHeader(DBItem):
    """A stored benchmark without its environment, of which it has the name: the Gymnasium id, or else the class."""

    hash: str
    metadata: BenchmarkMetadata
    environment: str = ""
    _stored_metadata: BenchmarkMetadata | None = PrivateAttr(None)

    @property
    def stored_metadata(self) -> BenchmarkMetadata:
        """The metadata that it was stored with, which its id is made of; `metadata` may have been edited since."""
        return self._stored_metadata or self.metadata

    def edited(self, changes: Mapping[str, Any]) -> Self:
        """The same benchmark with other metadata, by name of the field."""
        made = self.model_copy(update={"metadata": self.metadata.model_copy(update=dict(changes))})
        made._stored_metadata = self.stored_metadata
        return made


class Benchmark(BenchmarkHeader):
    """A stored benchmark with its environment as text."""

    serialized: str


class RLTuple(BaseModel):
    """One step: `state` is the observation that `action` was chosen on.

    Values are kept as they are given: arrays stay arrays, of the same dtype. Two tuples are equal if their values are:
    arrays where shapes and elements agree, a NaN where the other one has a NaN too.
    """

    state: Any
    action: Any
    reward: Any
    info: dict[Any, Any] = Field(default_factory=dict)
    terminal: bool = False
    timeout: bool = False

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and _equal(self.__dict__, other.__dict__)

    @classmethod
    def from_env_step(
        cls,
        obs: Any,
        action: Any,
        reward: Any,
        terminated: bool,
        truncated: bool,
        info: dict[Any, Any],
    ) -> Self:
        """A tuple from what a step took and gave.

        `obs` is the observation the action was chosen on. Nothing is copied or converted (the flags become
        plain bools): the tuple holds the caller's objects. Override it to convert them.
        """
        # Validation would copy `info` and refuse a NumPy flag; it is also most of what a step would cost.
        return cls.model_construct(
            state=obs,
            action=action,
            reward=reward,
            info=info,
            terminal=bool(terminated),
            timeout=bool(truncated),
        )


def _equal(a: Any, b: Any) -> bool:
    """Whether two values are the same, through dicts and lists, where `==` of arrays would be an array."""
    if a is b:
        return True
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_equal(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        alike = isinstance(a, list) == isinstance(b, list) and len(a) == len(b)
        return alike and all(map(_equal, a, b))
    if getattr(a, "shape", ()) != getattr(b, "shape", ()):
        return False
    if object in (getattr(a, "dtype", None), getattr(b, "dtype", None)):
        return _equal(a.tolist(), b.tolist())
    same = (a == b) | ((a != a) & (b != b))
    return bool(same.all() if hasattr(same, "all") else same)


class Episode(BaseModel):
    """An episode built by hand, on its way into a storage."""

    benchmark_id: str
    metadata: dict[str, Any]
    tuples: list[RLTuple]


class EpisodeHeader(DBItem):
    """A stored episode without its tuples.

    `end` is `terminal`, `timeout` or `interrupted` ("" where unknown); `episode_return` is the sum of its
    rewards, None where they are no numbers; `env` counts sub-environments from 0 and `episode` the episodes
    of one recording; `recording` is its path relative to the storage, with forward slashes. `run` is what the recording
    says of its run: name, metadata, tags, split, environment, started and ended (ISO 8601 in UTC), and more.
    """

    benchmark_id: str
    metadata: dict[str, Any]
    n_tuples: int
    terminated: bool
    timeout: bool
    end: str = ""
    episode_return: float | None = None
    seed: int | None = None
    env: int = 0
    episode: int = 0
    recording: str = ""
    run: dict[str, Any] = Field(default_factory=dict)


_HEADER_FIELDS = set(EpisodeHeader.model_fields)
_NEW, _SET = EpisodeHeader.__new__, object.__setattr__


def unchecked_header(values: dict[str, Any]) -> EpisodeHeader:
    """A header with `values`, one for each of its fields; the dict becomes the header's.

    Built without validation, and without `model_construct`: they would cost more than the rest of listing episodes.
    """
    made = _NEW(EpisodeHeader)
    _SET(made, "__pydantic_fields_set__", _HEADER_FIELDS)  # all of them are: nothing is ever added to it
    _SET(made, "__pydantic_extra__", None)
    _SET(made, "__pydantic_private__", None)
    _SET(made, "__dict__", values)
    return made


class EpisodeItem(Episode, EpisodeHeader):
    """A stored episode with its tuples."""

    @classmethod
    def create_new(cls, **data: Any) -> Self:
        """A new item with the length and end of `data["tuples"]` (`RLTuple`s or dicts of their fields).

        Raises:
            StorageError: There are no tuples.
        """
        tuples = data.get("tuples")
        if not tuples:
            raise StorageError("an episode needs at least one tuple, found none")
        last = tuples[-1] if isinstance(tuples[-1], RLTuple) else RLTuple.model_validate(tuples[-1])
        derived = {
            "n_tuples": len(tuples),
            "terminated": last.terminal,
            "timeout": last.timeout,
            "end": "terminal" if last.terminal else "timeout" if last.timeout else "interrupted",
        }
        return cls(**_fresh({**derived, **data}))


class EpisodeMetadataCallback(ABC):
    """Makes the metadata of an episode while it is recorded.

    It is called with every step; the dict returned at the last one becomes the episode's metadata.
    """

    @abstractmethod
    def reset(self) -> None:
        """Forget the episode that has just ended."""

    @abstractmethod
    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        """The metadata of the episode up to and including this step."""
