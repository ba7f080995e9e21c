"""Metadata models: benchmarks, artifacts, episodes and their tuples, as PyTupli names them."""

from __future__ import annotations

import datetime
import uuid
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, Self

from pydantic import BaseModel, Field, PrivateAttr

from tupli_mcap.arrays import short_repr
from tupli_mcap.errors import StorageError, did_you_mean, plural
from tupli_mcap.schema.success import success_of


def _fresh(data: Mapping[str, Any]) -> dict[str, Any]:
    """The default fields of a new item: id, time (UTC), and who may see it."""
    created_by = data.get("created_by")
    fields = {
        "id": uuid.uuid4().hex,
        "created_at": datetime.datetime.now(datetime.UTC).isoformat(),
        "published_in": [] if created_by is None else [created_by],
    }
    return {**fields, **data}


class DBItem(BaseModel):
    """The fields of every stored item. `created_at` is ISO 8601; `published_in` names groups."""

    id: str
    created_by: str
    published_in: list[str] = Field(default_factory=list)
    created_at: str

    @classmethod
    def create_new(cls, **data: Any) -> Self:
        """A new item with a random id, created now, visible to its creator; `data` are the other fields."""
        return cls(**_fresh(data))


class ArtifactMetadata(BaseModel):
    """The metadata that a user gives an artifact; `benchmark_id` is None if it belongs to no single benchmark."""

    name: str
    description: str = ""
    benchmark_id: str | None = None
    extra: dict[str, Any] = Field(default_factory=dict)


class ArtifactMetadataItem(DBItem, ArtifactMetadata):
    """A stored artifact; `hash` is the SHA-256 of its bytes in lower-case hexadecimal digits."""

    hash: str
    encoding: str = "utf-8"


class BenchmarkMetadata(BaseModel):
    """The metadata that a user gives a benchmark."""

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
        """The metadata at the time of storing, which its id depends on; `metadata` may have been edited afterwards."""
        return self._stored_metadata or self.metadata

    def edited(self, changes: Mapping[str, Any]) -> Self:
        """The same benchmark with some metadata fields changed."""
        made = self.model_copy(update={"metadata": self.metadata.model_copy(update=dict(changes))})
        made._stored_metadata = self.stored_metadata
        return made


class Benchmark(BenchmarkHeader):
    """A stored benchmark with its environment as text."""

    serialized: str


class StepNames:
    """Gymnasium's names for the parts of a step."""

    @property
    def observation(self: Any) -> Any:
        """`state`."""
        return self.state

    @property
    def terminated(self: Any) -> bool:
        """`terminal`."""
        return bool(self.terminal)

    @property
    def truncated(self: Any) -> bool:
        """`timeout`."""
        return bool(self.timeout)


class RLTuple(StepNames, BaseModel):
    """One step: `state` is the observation that `action` was chosen on.

    Values are kept as they are given: arrays stay arrays, of the same dtype. Two tuples are equal if their values are
    equal: arrays need equal shapes and elements, and a NaN equals a NaN.
    """

    state: Any
    action: Any
    reward: Any
    info: dict[Any, Any] = Field(default_factory=dict)
    terminal: bool = False
    timeout: bool = False

    if not TYPE_CHECKING:  # type checkers must still report unknown names

        def __getattr__(self, name: str) -> Any:
            try:
                return super().__getattr__(name)  # private attributes of subclasses are there
            except AttributeError as err:
                if name.startswith("_") or hasattr(type(self), name):  # a property that raised AttributeError
                    raise
                known = {*type(self).model_fields, *dir(type(self))} - {*dir(BaseModel)}
                hint = did_you_mean(name, sorted(word for word in known if word[0] != "_"))
                raise AttributeError(f"{err}{hint}", name=name) from None

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and _equal(self.__dict__, other.__dict__)

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={short_repr(value)}" for name, value in self.__dict__.items())
        return f"{type(self).__name__}({values})"

    __str__ = __repr__

    @classmethod
    def from_env_step(
        cls, obs: Any, action: Any, reward: Any, terminated: bool, truncated: bool, info: dict[Any, Any]
    ) -> Self:
        """A tuple made from the values of a step.

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
    """Whether two values are equal, in dicts and lists too; `==` of arrays would be an array."""
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
    """An episode made from values, to be stored."""

    benchmark_id: str
    metadata: dict[str, Any]
    tuples: list[RLTuple] = Field(fail_fast=True, repr=False)  # a defect in each would fill the memory


class EpisodeHeader(DBItem):
    """A stored episode without its tuples.

    `end` is `terminal`, `timeout` or `interrupted` ("" if unknown); `episode_return` is the sum of its rewards, NaN if
    one is, None if it is not known; `env` is the sub-environment, from 0, and `episode` the episode's number in its
    recording; `recording` is a path relative to the storage, with forward slashes. `run` has facts about the run: name,
    metadata, tags, split, environment, started and ended (ISO 8601 in UTC), and more.
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

    @property
    def steps(self) -> int:
        """`n_tuples`."""
        return self.n_tuples

    @property
    def return_(self) -> float | None:
        """`episode_return`."""
        return self.episode_return

    @property
    def success(self) -> bool | None:
        """Whether it succeeded: `success` or `is_success` of its metadata, if that is true, false, 0 or 1; else
        None."""
        return success_of(self.metadata)

    def __repr__(self) -> str:
        total = "" if self.episode_return is None else f", return {self.episode_return:g}"
        of = f" of {self.recording}" if self.recording else ""
        return (
            f"<{type(self).__name__} {self.episode}{of}: {plural(self.n_tuples, 'step')}{total}, {self.end}>"
        )

    __str__ = __repr__


DERIVED: Final[dict[str, Any]] = {"success": bool | None}
"""The properties of an episode that filters name like its fields, and their types."""

_HEADER_FIELDS = set(EpisodeHeader.model_fields)
_NEW, _SET = EpisodeHeader.__new__, object.__setattr__


def unchecked_header(values: dict[str, Any]) -> EpisodeHeader:
    """A header with `values`, one for each of its fields; the dict becomes the header's.

    Built without validation, and without `model_construct`: they would cost more than the rest of listing episodes.
    """
    made = _NEW(EpisodeHeader)
    _SET(made, "__pydantic_fields_set__", _HEADER_FIELDS)  # one set for all: nothing is ever added to it
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
        """Begin a new episode: forget the one that has ended."""

    @abstractmethod
    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        """The metadata of the episode up to and including this step."""
