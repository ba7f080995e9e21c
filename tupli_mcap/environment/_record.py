"""`EnvironmentRecord`: an environment as data, and its form in `benchmark.json`."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from tupli_mcap.errors import FormatError, TupliError

DOCUMENT_NAME = "benchmark.json"
PICKLE_NAME = "env.cloudpickle"
MAX_PICKLE = 16 << 20  # bytes of a pickle that a recording carries
_MAX_JSON_BYTES = 64 << 20
_HEX_DIGEST = r"^[0-9a-f]{64}$"
# Fields of an EnvSpec with these values are left out, so that a field which a later gymnasium adds changes no
# digest.
_SPEC_DEFAULTS: dict[str, Any] = {
    "entry_point": None,
    "reward_threshold": None,
    "nondeterministic": False,
    "max_episode_steps": None,
    "order_enforce": True,
    "disable_env_checker": False,
    "kwargs": {},
    "additional_wrappers": [],
}


def canonical_json(value: object) -> bytes:
    """The one UTF-8 JSON text of a value: sorted keys, no spaces, no NaN.

    Raises:
        ValueError: The value holds NaN, an infinity, or something JSON has no form for (TypeError).
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.encode("ascii")


def sha256(data: bytes) -> str:
    """SHA-256 as 64 hex digits."""
    return hashlib.sha256(data).hexdigest()


class _Pickle(BaseModel):
    sha256: str = Field(pattern=_HEX_DIGEST)
    size: int = Field(ge=0)


class _Environment(BaseModel):
    name: str = Field(max_length=1000)
    spec: dict[str, JsonValue] | None = None
    pickle: _Pickle | None = None
    classes: list[str] = []
    versions: dict[str, str] = {}
    digest: str = Field(pattern=_HEX_DIGEST)


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore")

    format: Literal["tupli_mcap.benchmark"]
    version: Literal[1]
    environment: _Environment
    benchmark: dict[str, JsonValue] | None = None


@dataclass(frozen=True)
class EnvironmentRecord:
    """An environment as data. At most one of `spec` and `pickle` is set; without either it cannot be rebuilt.

    Attributes:
        name: the registered id, or the class as `module:Class` if there is none; for people.
        spec: the gymnasium EnvSpec as JSON-able object. In a recording it is the environment's own; in a benchmark it
            is the one that rebuilds the environment.
        pickle: the environment as cloudpickle bytes, which run code when loaded.
        classes: the environment's classes as `module:Class`, outermost wrapper first; a claim, for messages only.
        versions: of Python and of the packages in use; for messages only.
        benchmark: the benchmark's own entry in `benchmark.json` (id, metadata, artifacts); None without a benchmark.
    """

    name: str
    spec: Mapping[str, Any] | None = None
    pickle: bytes | None = field(default=None, repr=False)
    classes: tuple[str, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    benchmark: Mapping[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.spec is not None and self.pickle is not None:
            raise ValueError("an environment record has either a spec or a pickle")

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 (64 hex digits) of what rebuilding executes: the spec, or the pickle; of the names if there is
        neither. It is always computed, never taken from a file."""
        if self.spec is not None:
            told = {k: v for k, v in self.spec.items() if k not in _SPEC_DEFAULTS or v != _SPEC_DEFAULTS[k]}
            return sha256(canonical_json({"spec": told}))
        if self.pickle is not None:
            return sha256(canonical_json({"pickle": sha256(self.pickle)}))
        return sha256(canonical_json({"classes": list(self.classes), "name": self.name}))

    def to_json(self, benchmark: Mapping[str, Any] | None = None) -> bytes:
        """The content of `benchmark.json`; the pickle is kept beside it, as `env.cloudpickle`.

        benchmark: replaces the record's own `benchmark` entry.

        Raises:
            TupliError: The entry cannot be written as JSON.
        """
        pickle = None if self.pickle is None else {"sha256": sha256(self.pickle), "size": len(self.pickle)}
        document = {
            "format": "tupli_mcap.benchmark",
            "version": 1,
            "environment": {
                "name": self.name,
                "spec": self.spec,
                "pickle": pickle,
                "classes": list(self.classes),
                "versions": dict(self.versions),
                "digest": self.digest,
            },
            "benchmark": self.benchmark if benchmark is None else benchmark,
        }
        try:
            return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False).encode("utf-8")
        except (TypeError, ValueError) as err:
            raise TupliError(f"the metadata of a benchmark must be JSON without NaN: {err}") from err

    @classmethod
    def from_json(
        cls, data: bytes, pickle: bytes | None = None, *, where: str = "benchmark.json"
    ) -> EnvironmentRecord:
        """Read `benchmark.json` and the pickle beside it, executing nothing.
        FormatError if the JSON is no such document, or names another digest than that of its contents."""
        if len(data) > _MAX_JSON_BYTES:
            raise FormatError(f"{where}: expected at most {_MAX_JSON_BYTES} bytes, found {len(data)}")
        try:
            document = _Document.model_validate_json(data)
        except ValidationError as err:
            first = err.errors(include_url=False, include_input=False)[0]
            place = ".".join(str(part) for part in first["loc"]) or "the document"
            raise FormatError(f"{where}: not a benchmark document: {place}: {first['msg']}") from err
        environment = document.environment
        if environment.pickle is not None:
            _check_pickle(environment.pickle, pickle, environment.spec is not None, where)
        record = cls(
            name=environment.name,
            spec=environment.spec,
            pickle=None if environment.pickle is None else pickle,
            classes=tuple(environment.classes),
            versions=environment.versions,
            benchmark=document.benchmark,
        )
        try:
            digest = record.digest
        except (ValueError, RecursionError) as err:
            raise FormatError(f"{where}: the environment's spec is not strict JSON: {err}") from err
        if digest != environment.digest:
            raise FormatError(
                f"{where}: expected an environment with digest {environment.digest}, found {digest}"
            )
        return record


def _check_pickle(said: _Pickle, data: bytes | None, has_spec: bool, where: str) -> None:
    if has_spec:
        raise FormatError(f"{where}: an environment has either a spec or a pickle, found both")
    if data is None:
        raise FormatError(f"{where}: the pickled environment (SHA-256 {said.sha256}) is missing beside it")
    if len(data) != said.size or sha256(data) != said.sha256:
        raise FormatError(
            f"{where}: expected a pickled environment of {said.size} bytes, SHA-256 {said.sha256}, "
            f"found {len(data)} bytes, SHA-256 {sha256(data)}"
        )
