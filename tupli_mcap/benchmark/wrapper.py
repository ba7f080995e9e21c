"""`TupliEnvWrapper` stores an environment as a benchmark, and records its episodes into the storage."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, Self, SupportsFloat

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec
from pydantic import ValidationError

from tupli_mcap import jsonvalue, trust as _trust
from tupli_mcap.benchmark._tap import PendingReset, Retyped, Tap
from tupli_mcap.environment import Snapshot, build, capture, fingerprint, name_of
from tupli_mcap.errors import NotFoundError, RecordingError, StorageError, TupliError, warn
from tupli_mcap.recording.write.options import MetadataCallback, RecordOptions, check_known
from tupli_mcap.schema import Benchmark, BenchmarkMetadata, BenchmarkQuery, FilterIN, RLTuple
from tupli_mcap.spaces.leaves import own_space
from tupli_mcap.storage import TupliStorage, storage_at
from tupli_mcap.storage.benchmark_json import (
    benchmark_hash,
    declared_spaces,
    facts_about,
    pack,
    recording_attachments,
    unpack,
)
from tupli_mcap.storage.texts import first_defect
from tupli_mcap.wrappers import RecordEpisodes
from tupli_mcap.wrappers.base import check_kind, drawn_seed

# Not `journal_dir`: a storage finds a recording that is being written by the journal beside it.
_RECORDING_OPTIONS = (
    "record_info", "step_callback", "reward_space", "compression", "chunk_size", "flush_seconds", "durability",
    "frames", "frame_format", "image_format", "max_bytes", "max_seconds", "name", "metadata", "tags", "split",
    "capture",
)  # fmt: skip


def _as_recorded(value: Any) -> Any:
    """A copy of options or an info as a recording gives them back."""
    return jsonvalue.loads(jsonvalue.dumps_any(value))


def _warn_of_another(env: gym.Env[Any, Any], benchmark: Benchmark) -> None:
    """Warns if an environment has another name than that of a benchmark, or other spaces."""
    here, there = name_of(env), benchmark.environment
    is_it = there in ("", here) or there.endswith((f":{here}", f".{here}"))  # of a class: module:Outer.Inner
    spaces = declared_spaces(benchmark.serialized)
    if not is_it or spaces not in (
        [],
        [own_space(env.observation_space), own_space(env.action_space)],
    ):
        warn(
            f"recording episodes of {here} for the benchmark {benchmark.id[:8]}, which is of {there or 'another'}"
            f"{' with other spaces' if is_it else ''}; store() makes this environment a benchmark of its own"
        )


class DeletedBenchmark(NamedTuple):
    """The result of `TupliEnvWrapper.delete`.

    `kept` maps each artifact that was not deleted to the benchmarks that need it.
    """

    id: str
    episodes: int
    artifacts: tuple[str, ...]
    kept: Mapping[str, tuple[str, ...]]


class TupliEnvWrapper(gym.Wrapper[Any, Any, Any, Any]):
    """Stores an environment as a benchmark and records what happens in it.

    The environment is captured as it is when it is wrapped: stepping it changes neither what is stored nor
    its id. No other environment is made for it. Once the benchmark has an id, every episode is recorded into one
    file of the storage, opened at the first reset or step; finished episodes are listed by the storage at once.
    Recording can be switched off and on.

    An environment is stored as its EnvSpec, which others build without trust, if its id is registered here, its
    arguments are plain data, its wrappers are Gymnasium's or of its own package, it has not been reset, and its
    attributes are those that its classes assign, with the constants and constructor arguments that they assign. Any
    other is stored as a pickle. A changed value that the constructor computes is not noticed; `verify --rerun`
    finds it. So change a registered environment by its arguments, a wrapper or a subclass.

    Args:
        env: the environment; the wrapper never changes it.
        storage: where the benchmark is kept: a storage, or the path of its directory; None is enough for
            `serialize_env`.
        benchmark_id: the id of the benchmark that `env` was loaded from.
        metadata_callback: called with every recorded step; its last result becomes the episode's metadata.
        rl_tuple_cls: the class of the tuples that the callback is given. Recorded are the values themselves.
        recording_options: for `RecordEpisodes`: record_info, step_callback, reward_space, compression,
            chunk_size, flush_seconds, durability, frames, frame_format, image_format, max_bytes, max_seconds, name,
            metadata, tags, split, capture.

    Subclasses that keep data outside of the environment override `_serialize` and `_deserialize`. `_serialize` is
    given a copy, made of the pickle when the environment is serialized; nobody closes it.
    Not thread-safe.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        storage: TupliStorage | str | os.PathLike[str] | None,
        benchmark_id: str | None = None,
        metadata_callback: MetadataCallback | None = None,
        rl_tuple_cls: type[RLTuple] = RLTuple,
        **recording_options: Any,
    ) -> None:
        check_kind(env, vector=False)
        super().__init__(env)
        check_known(type(self).__name__, recording_options, _RECORDING_OPTIONS)
        self._options = RecordOptions(**recording_options)
        self._storage = None if storage is None else storage_at(storage)
        self.id = benchmark_id
        self.metadata_callback = metadata_callback
        self.rl_tuple_cls = rl_tuple_cls
        self._snapshot = Snapshot(env, copies=self._changes_copies)
        self._tap = Tap(env)
        self._recording = True
        self._recorder: RecordEpisodes | None = None
        self._path: Path | None = None
        # as it is stored, so that recording need not ask the storage again
        self._benchmark: Benchmark | None = None
        # resets without a step, in order: a later one goes on with the random stream of the one before
        self._pending: list[PendingReset] = []

    @property
    def storage(self) -> TupliStorage:
        """The storage of the benchmark; raises StorageError if there is none. Another one finishes the recording in the
        storage before, and gets a new one."""
        if self._storage is None:
            raise StorageError("this environment has no storage; wrap it with TupliEnvWrapper(env, storage)")
        return self._storage

    @storage.setter
    def storage(self, storage: TupliStorage | str | os.PathLike[str] | None) -> None:
        self._finish()
        self._path = self._benchmark = None
        self._storage = None if storage is None else storage_at(storage)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The spec of the inner environment, without this wrapper."""
        return self.env.spec

    # --- stepping ---

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; while recording, a running episode ends as interrupted."""
        if self._recorder is None and self._recording and self.id is not None:
            recorder = self._open()
            if seed is None:
                self._hand_over(recorder)
            self._pending = []
            self._recorder = recorder
        if self._recorder is not None:
            return self._recorder.reset(seed=seed, options=options)
        unseeded = seed is None and getattr(self.env.unwrapped, "_np_random", 0) is None
        told = _as_recorded(options)  # before the environment takes any out
        result = self.env.reset(seed=seed, options=options)
        if unseeded:
            seed = drawn_seed(self.env)
        before = self._pending if seed is None else []
        # the caller may change them before a recorder sees them
        kept = deepcopy(result[0]), _as_recorded(result[1])
        self._pending = [*before, PendingReset(kept, seed, told)]
        return result

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take a step, and record it unless recording is off.

        Raises:
            StorageError: Recording is on, but the benchmark has not been stored.
            StepError: The step cannot be recorded exactly; what was recorded before is safe.
        """
        if self._recorder is not None:
            return self._recorder.step(action)
        if self._recording:
            return self._first_step(action)
        self._pending = []
        return self.env.step(action)

    def _first_step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        if self.id is None:
            raise StorageError(
                "this environment is not stored yet, so its steps cannot be recorded: call store(name=...) "
                "first, or deactivate_recording()"
            )
        if not self._pending:  # within an episode that began unrecorded: recording begins with the next one
            return self.env.step(action)
        recorder = self._open()
        self._hand_over(recorder)
        self._recorder = recorder
        return recorder.step(action)

    def _hand_over(self, recorder: RecordEpisodes) -> None:
        """Tells a recorder of the resets that have already happened."""
        pending, self._pending = self._pending, []
        for reset in pending:
            self._tap.pending = reset
            recorder.reset(seed=reset.seed, options=reset.options)

    def activate_recording(self) -> None:
        """Record from the next reset on (from the running episode on, if it has no step yet and is in no recording)."""
        self._recording = True

    def deactivate_recording(self) -> None:
        """Stop recording: the running episode ends as interrupted, and the file is finished."""
        self._recording = False
        self._finish()

    @property
    def recording_path(self) -> Path | None:
        """The file that is being recorded to, or was last; None before there is one."""
        return self._path if self._recorder is None else self._recorder.path

    def close(self) -> None:
        """Finish the recording, then close the environment. Calling it twice is fine."""
        try:
            self._finish()
        finally:
            super().close()

    def __getstate__(self) -> dict[str, Any]:
        """A copy, in this process or another one, records to another file."""
        if self._recorder is not None:
            raise RecordingError(
                f"a wrapper that records to {self._path} cannot be pickled or copied; close() it first, or call "
                "deactivate_recording()"
            )
        return {**self.__dict__, "_path": None}

    def _open(self) -> RecordEpisodes:
        with self.storage.beginning_recording():
            recorder = self._begin(self._stored_id())
        recorder.rotation.beginning = self.storage.beginning_recording
        recorder.rotation.finished = self._ingest
        return recorder

    def _ingest(self, path: Path) -> None:
        """Lists the episodes of a finished file; if this fails it warns, and the rollout goes on."""
        try:
            self.storage.ingest(path)
        except TupliError as err:
            warn(f"{path} will be listed by the next query: {err}", RuntimeWarning)

    def _begin(self, benchmark_id: str) -> RecordEpisodes:
        callback = self.metadata_callback
        if callback is not None and self.rl_tuple_cls is not RLTuple:
            callback = Retyped(callback, self.rl_tuple_cls)
        options = replace(self._options, metadata_callback=callback, benchmark_id=benchmark_id)
        if self._path is not None and self._path.exists():
            going_on = replace(options, mode="a", attachments={})
            # If the file cannot be appended to (somebody else writes to it), begin another one.
            with contextlib.suppress(RecordingError):
                return RecordEpisodes(self._tap, self._path, **vars(going_on))
        benchmark = self._benchmark
        if benchmark is None or benchmark.id != benchmark_id:
            benchmark = self._benchmark = self.storage.load_benchmark(benchmark_id)
            _warn_of_another(self.env, benchmark)
        self._path = self.storage.new_recording_path(benchmark_id, options.name or benchmark.metadata.name)
        options = replace(options, attachments=recording_attachments(benchmark.serialized))
        return RecordEpisodes(self._tap, self._path, **vars(options))

    def _finish(self) -> None:
        recorder, self._recorder = self._recorder, None
        if recorder is None or self._path is None:
            return
        recorder.close()
        self._path = recorder.path
        self.storage.ingest(self._path)

    # --- the benchmark ---

    def store(
        self,
        name: str,
        description: str = "",
        difficulty: str | None = None,
        version: str | None = None,
        metadata: dict[str, Any] | None = None,
        *,
        by_reference: bool = False,
    ) -> str:
        """Store the environment, as it was when it was wrapped, as a benchmark; returns its id.

        The id is a hash of the environment, its artifacts and the arguments: storing the same again changes
        nothing. The user's own classes are stored with their code, unless `by_reference` leaves it out: then
        those who load the benchmark need the same modules. The environment is signed as this user's own.

        Raises:
            TupliError: The environment cannot be pickled.
            StorageError: The storage refuses, or the metadata is no JSON.
        """
        try:
            told = BenchmarkMetadata(
                name=name,
                description=description,
                difficulty=difficulty,
                version=version,
                extra=metadata or {},
            )
        except ValidationError as err:
            raise StorageError(f"expected metadata with names as keys: {first_defect(err)}") from err
        serialized = self.serialize_env(self.env, by_reference=by_reference)
        content = unpack(serialized)
        query = BenchmarkQuery(hash=benchmark_hash(content, told), serialized=serialized, metadata=told)
        stored = self.storage.store_benchmark(query)
        try:
            _trust.trust(content.record.digest)
        except TupliError as err:
            warn(f"stored, but loading it will need trust=True: {err}")
        if self.id is not None and self.id != stored.id:
            self._finish()
            self._path = None
        self.id = stored.id
        # whose text names the id, as recordings carry it
        self._benchmark = self.storage.load_benchmark(stored.id)
        return stored.id

    @classmethod
    def load(
        cls,
        storage: TupliStorage | str | os.PathLike[str],
        benchmark_id: str | None = None,
        metadata_callback: MetadataCallback | None = None,
        rl_tuple_cls: type[RLTuple] = RLTuple,
        *,
        trust: bool = False,
        **recording_options: Any,
    ) -> Self:
        """Rebuild a benchmark's environment and wrap it.

        Raises:
            NotFoundError: There is no such benchmark.
            StorageError: There is no storage at the path.
            UntrustedError: It would run code that this user has not trusted, without `trust=True`.
        """
        if isinstance(benchmark_id, TupliStorage):
            raise StorageError("expected a storage and then a benchmark_id, found them the other way round")
        opened = storage_at(storage, existing=True)
        if benchmark_id is None:
            raise NotFoundError(
                "which benchmark? pass benchmark_id; list_benchmarks() (tupli-mcap list-benchmarks) names them all"
            )
        benchmark = opened.load_benchmark(benchmark_id)
        env = cls.deserialize_env(benchmark.serialized, opened, trust=trust)
        loaded = cls(env, opened, benchmark_id, metadata_callback, rl_tuple_cls, **recording_options)
        loaded._benchmark = benchmark
        return loaded

    def publish(self, publish_in: str = "global") -> None:
        """Make the benchmark visible to a group, and its artifacts, without which nobody can load it.

        Artifacts of others stay as they are: only they can publish them. Its episodes, too, stay as they are.
        """
        uri = self._stored_id()
        self.storage.publish_benchmark(uri, publish_in)
        benchmark = self.storage.load_benchmark(uri)
        needed = FilterIN(key="id", value=list(unpack(benchmark.serialized).artifacts))
        for item in self.storage.list_artifacts(needed):
            if item.created_by == benchmark.created_by:
                self.storage.publish_artifact(item.id, publish_in)

    def delete(self, delete_artifacts: bool = False, delete_episodes: bool = True) -> DeletedBenchmark:
        """Delete the benchmark from the storage, with its episodes, and with the artifacts that no other benchmark
        needs.

        The environment still works, and is not recorded until it is stored again.

        Raises:
            NotFoundError: The benchmark is not stored.
            StorageError: Its episodes shall be deleted while somebody else records more; nothing is deleted.
        """
        uri = self._stored_id()
        artifacts = unpack(self.storage.load_benchmark(uri).serialized).artifacts
        self._finish()
        self._path = None
        episodes = self.storage.delete_benchmark(uri, episodes=delete_episodes)
        self.id = None
        gone: list[str] = []
        kept: dict[str, tuple[str, ...]] = {}
        for artifact in artifacts if delete_artifacts else ():
            with contextlib.suppress(NotFoundError):  # gone already
                users = tuple(self.storage.artifact_users(artifact))
                if users:
                    kept[artifact] = users
                    continue
                self.storage.delete_artifact(artifact)
                gone.append(artifact)
        return DeletedBenchmark(uri, episodes, tuple(gone), MappingProxyType(kept))

    def _stored_id(self) -> str:
        if self.id is None:
            raise StorageError("this environment is not stored yet: call store(name=...) first")
        return self.id

    # --- environments as text ---

    def serialize_env(self, env: gym.Env[Any, Any], *, by_reference: bool = False) -> str:
        """An environment as text. `self.env` is serialized as it was when it was wrapped; no environment is changed."""
        snapshot = self._snapshot if env is self.env else Snapshot(env, copies=self._changes_copies)
        if not self._changes_copies:
            return pack(snapshot.record(by_reference=by_reference), [], facts_about(env))
        copy = snapshot.copy()
        before = fingerprint(copy)
        changed, artifacts = self._serialize(copy)
        if before is None or fingerprint(changed) != before:
            record = capture(changed, by_reference=by_reference, pickled=True)
        else:
            record = snapshot.record(by_reference=by_reference)
        return pack(record, artifacts, facts_about(env))

    @classmethod
    def deserialize_env(
        cls, serialized_env: str, storage: TupliStorage, *, trust: bool = False
    ) -> gym.Env[Any, Any]:
        """The environment in a text of `serialize_env`. Raises as `load` does."""
        return cls._deserialize(build(unpack(serialized_env).record, trust=trust), storage)

    @property
    def _changes_copies(self) -> bool:
        """Whether a subclass overrides `_serialize`, which then gets a copy."""
        return getattr(self._serialize, "__func__", None) is not TupliEnvWrapper._serialize

    def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
        """Override it to move data out of an environment before it is stored.

        Args:
            env: a copy of the environment, which may be changed (`env.unwrapped.data = artifact.id`).

        Returns:
            The environment to store, and the ids of the artifacts it needs.
        """
        return env, []

    @classmethod
    def _deserialize(cls, env: gym.Env[Any, Any], storage: TupliStorage) -> gym.Env[Any, Any]:
        """Override it to put the data back (`env.unwrapped.data = storage.load_artifact(env.unwrapped.data)`)."""
        return env
