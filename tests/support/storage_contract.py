"""What every storage promises."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stored_items import episode, query

import tupli_mcap
from tupli_mcap.errors import (
    FilterError,
    NotFoundError,
    SpaceError,
    StorageError,
)
from tupli_mcap.schema import (
    ArtifactMetadata,
    BenchmarkMetadata,
    BenchmarkQuery,
    Episode,
    F,
    FilterEQ,
    FilterIN,
    RLTuple,
)
from tupli_mcap.storage import FileStorage, TupliAPIClient, TupliStorage
from tupli_mcap.storage.benchmark_json import benchmark_hash, unpack

BAD_IDS = [
    "",
    "no-such-thing",
    "../../etc/passwd",
    "/etc/passwd",
    "a/b",
    "..",
    ".",
    "\0",
    "x" * 5000,
    "0" * 64,
    "A" * 64,
]


class StorageContract:
    """Subclasses have a fixture `storage` that gives an empty TupliStorage."""

    # --- benchmarks ---

    def test_benchmark_round_trip(self, storage: TupliStorage) -> None:
        told = query()
        header = storage.store_benchmark(told)
        assert header.id == header.hash == told.hash
        assert header.metadata.extra == {"level": 3, "limits": [1, 2]}
        loaded = storage.load_benchmark(header.id)
        assert loaded.metadata == header.metadata
        assert unpack(loaded.serialized).record.digest == unpack(told.serialized).record.digest
        assert storage.list_benchmarks() == [header]

    def test_same_content_has_one_id(self, storage: TupliStorage) -> None:
        first = storage.store_benchmark(query())
        assert storage.store_benchmark(query()) == first
        other = storage.store_benchmark(query("another name"))
        assert other.id != first.id
        changed = gym.make("CartPole-v1")
        changed.unwrapped.gravity = 1.0  # type: ignore[attr-defined]
        assert storage.store_benchmark(query(env=changed)).id not in (first.id, other.id)
        assert len(storage.list_benchmarks()) == 3

    def test_a_wrong_hash_is_refused(self, storage: TupliStorage) -> None:
        told = query()
        with pytest.raises(StorageError, match=f"expected the hash {told.hash} of the benchmark's content"):
            storage.store_benchmark(told.model_copy(update={"hash": "0" * 64}))

    def test_text_of_somebody_else_is_kept_as_it_is(self, storage: TupliStorage) -> None:
        told = BenchmarkQuery(
            hash="anything", serialized='{"py/object": "evil"}', metadata=BenchmarkMetadata(name="x")
        )
        header = storage.store_benchmark(told)
        assert storage.load_benchmark(header.id).serialized == told.serialized
        assert header.hash == "anything"

    def test_list_benchmarks_filters(self, storage: TupliStorage) -> None:
        first, second = storage.store_benchmark(query("one")), storage.store_benchmark(query("two"))
        assert storage.list_benchmarks(FilterEQ(key="id", value=first.id)) == [first]
        assert storage.list_benchmarks(FilterEQ(key="metadata.name", value="two")) == [second]
        assert storage.list_benchmarks(F("metadata.extra.level") > 3) == []
        with pytest.raises(FilterError, match="unknown key 'nonsense'"):
            storage.list_benchmarks(FilterEQ(key="nonsense", value=1))
        with pytest.raises(
            FilterError, match=r"unknown key 'name' \(did you mean 'metadata.name'\?\); the keys"
        ):
            storage.list_benchmarks("name = 'two'")

    def test_delete_and_publish_benchmark(self, storage: TupliStorage) -> None:
        header = storage.store_benchmark(query())
        storage.publish_benchmark(header.id)
        storage.publish_benchmark(header.id, "lab")
        storage.publish_benchmark(header.id, "lab")
        assert storage.list_benchmarks()[0].published_in == [*header.published_in, "global", "lab"]
        assert storage.load_benchmark(header.id).published_in[-1] == "lab"
        storage.delete_benchmark(header.id)
        assert storage.list_benchmarks() == []
        with pytest.raises(NotFoundError, match=header.id):
            storage.delete_benchmark(header.id)

    def test_metadata_that_is_no_json_is_refused(self, storage: TupliStorage) -> None:
        told = query()
        told.metadata.extra["what"] = object()
        with pytest.raises(
            StorageError, match=r"BenchmarkMetadata: expected values that JSON can hold: .*what"
        ):
            storage.store_benchmark(told)

    def test_metadata_json_has_no_form_for_comes_back(self, storage: TupliStorage) -> None:
        odd = {"inf": np.inf, "set": {1, 2}, "bytes": b"x", "text": "\udc80", "tag": {"$float": "nan"}}
        told = query()
        told.metadata.extra.update(odd, nan=np.nan)
        found_hash = benchmark_hash(unpack(told.serialized), told.metadata)
        header = storage.store_benchmark(told.model_copy(update={"hash": found_hash}))
        storage.publish_benchmark(header.id, "lab")
        found = storage.load_benchmark(header.id).metadata.extra
        assert {name: found[name] for name in odd} == odd
        assert np.isnan(found["nan"])
        assert len(storage.list_benchmarks(F("metadata.extra.inf") > 0)) == 1
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="x", extra=dict(odd)))
        assert item.extra == odd
        storage.publish_artifact(item.id, "lab")
        assert storage.list_artifacts()[0].extra == odd

    def test_a_group_has_a_name(self, storage: TupliStorage) -> None:
        header = storage.store_benchmark(query())
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="x"))
        made = storage.record_episode(episode(header.id))
        no_names: tuple[Any, ...] = (None, 3, "", "a\0b")
        for publish, uri in (
            (storage.publish_benchmark, header.id),
            (storage.publish_artifact, item.id),
            (storage.publish_episode, made.id),
        ):
            for group in no_names:
                with pytest.raises(StorageError, match="expected the name of a group to publish in, found"):
                    publish(uri, group)
        assert storage.list_episodes() == [made]
        assert storage.list_benchmarks() == [header]

    def test_deleting_an_unknown_benchmark_deletes_no_episodes(self, storage: TupliStorage) -> None:
        header = storage.store_benchmark(query())
        storage.record_episode(episode(header.id))
        storage.delete_benchmark(header.id)
        for uri in (header.id, *BAD_IDS):
            with pytest.raises(NotFoundError, match="there is no benchmark"):
                storage.delete_benchmark(uri, episodes=True)
        assert storage.count_episodes() == 1

    # --- artifacts ---

    def test_artifact_round_trip(self, storage: TupliStorage) -> None:
        data = bytes(range(256)) * 10
        item = storage.store_artifact(data, ArtifactMetadata(name="wind", extra={"rows": np.int32(5)}))
        assert storage.load_artifact(item.id) == data
        assert item.hash == item.id
        assert item.extra == {"rows": 5}
        assert storage.list_artifacts() == [item]
        assert storage.list_artifacts(FilterEQ(key="name", value="sun")) == []

    def test_artifacts_are_deduplicated(self, storage: TupliStorage) -> None:
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="first"))
        assert storage.store_artifact(b"abc", ArtifactMetadata(name="second")) == item
        assert storage.store_artifact(b"", ArtifactMetadata(name="empty")).id != item.id
        assert len(storage.list_artifacts()) == 2

    def test_delete_and_publish_artifact(self, storage: TupliStorage) -> None:
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="first"))
        storage.publish_artifact(item.id, "lab")
        assert storage.list_artifacts()[0].published_in[-1] == "lab"
        storage.delete_artifact(item.id)
        assert storage.list_artifacts() == []
        with pytest.raises(NotFoundError, match="there is no artifact"):
            storage.load_artifact(item.id)

    def test_an_artifact_in_use_is_not_deleted(self, storage: TupliStorage) -> None:
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="wind"))
        header = storage.store_benchmark(query(artifacts=(item.id,)))
        assert storage.artifact_users(item.id) == [header.id]
        with pytest.raises(StorageError, match=f"artifact {item.id} is needed by benchmark {header.id}"):
            storage.delete_artifact(item.id)
        storage.delete_artifact(item.id, force=True)
        assert storage.list_artifacts() == []
        with pytest.raises(NotFoundError, match="there is no artifact"):
            storage.artifact_users(item.id)

    def test_an_artifact_is_bytes(self, storage: TupliStorage) -> None:
        with pytest.raises(StorageError, match="expected the bytes of an artifact, found str"):
            storage.store_artifact("text", ArtifactMetadata(name="x"))  # type: ignore[arg-type]

    # --- episodes ---

    def test_episode_round_trip(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        header = storage.record_episode(episode(benchmark, 4, score=2.5))
        assert header.benchmark_id == benchmark
        assert header.metadata == {"score": 2.5}
        assert (header.n_tuples, header.terminated, header.timeout) == (4, True, False)
        assert header.episode_return == 10.0
        assert storage.list_episodes(FilterIN(key="seed", value=[10**40])) == []
        assert storage.count_episodes(F("metadata.score") < 10**40) == 1
        (item,) = storage.list_episodes(include_tuples=True)
        assert item.id == header.id
        assert [t.action for t in item.tuples] == [0, 1, 0, 1]  # type: ignore[union-attr]
        np.testing.assert_array_equal([t.state for t in item.tuples], [[0.5 * i, -1.0] for i in range(4)])  # type: ignore[union-attr]
        assert [t.info for t in item.tuples] == [{"step": i} for i in range(4)]  # type: ignore[union-attr]
        assert item.tuples[-1].terminal  # type: ignore[union-attr]

    def test_many_episodes_keep_their_order(self, storage: TupliStorage) -> None:
        first, second = (storage.store_benchmark(query(name)).id for name in ("one", "two"))
        given = [episode([first, second][i % 2], 2 + i, score=float(i)) for i in range(6)]
        headers = storage.record_episodes(given)
        assert [h.metadata["score"] for h in headers] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
        assert [h.n_tuples for h in headers] == [2, 3, 4, 5, 6, 7]
        assert {h.benchmark_id for h in headers[::2]} == {first}
        assert storage.count_episodes() == 6

    def test_episodes_filter_and_page(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        storage.declare_key("metadata.score")
        storage.record_episodes([episode(benchmark, score=float(i)) for i in range(5)])
        everything = storage.list_episodes()
        assert [h.metadata["score"] for h in storage.list_episodes(F("metadata.score") >= 3)] == [3.0, 4.0]
        assert storage.count_episodes(F("metadata.score") < 1) == 1
        assert storage.list_episodes(limit=2, offset=1) == everything[1:3]
        ids = [h.id for h in everything[:2]]
        assert storage.list_episodes(FilterIN(key="id", value=ids)) == everything[:2]
        with pytest.raises(FilterError, match="unknown key 'score'"):
            storage.list_episodes(FilterEQ(key="score", value=1))

    def test_episodes_in_an_order(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        for scores in ((2.0, 0.0), (1.0, 2.0)):  # two recordings
            storage.record_episodes([episode(benchmark, score=score) for score in scores])
        everything = storage.list_episodes()
        rising = sorted(everything, key=lambda h: h.metadata["score"])
        falling = sorted(
            everything, key=lambda h: h.metadata["score"], reverse=True
        )  # equal ones stay in order
        for key in ("return", "metadata.score"):
            assert storage.list_episodes(sort=key) == rising
            assert storage.list_episodes(sort=f"-{key}") == falling
            assert storage.list_episodes(F("return") > 0, sort=f"-{key}", limit=2, offset=1) == falling[1:3]
        assert storage.list_episodes(sort="metadata.none") == everything
        read = storage.list_episodes(F("return") > 0, include_tuples=True, sort="-return")
        assert [(item.id, item.tuples[0].reward) for item in read] == [
            (header.id, header.metadata["score"]) for header in falling[:3]
        ]
        for key in ("score", "", "-", "--return"):
            with pytest.raises(FilterError, match="unknown key|needs a name"):
                storage.list_episodes(sort=key)
        with pytest.raises(FilterError, match="cannot sort by 'run.name'; sort by return, steps"):
            storage.list_episodes(sort="run.name")
        no_key: Any = 3
        with pytest.raises(
            FilterError, match="expected a key to sort by, such as 'return' or '-return', found 3"
        ):
            storage.list_episodes(sort=no_key)

    def test_pages_are_counted_from_zero(self, storage: TupliStorage) -> None:
        no_counts: tuple[Any, ...] = (-1, 2.0, True, "2", 1 << 63)
        for number in no_counts:
            with pytest.raises(StorageError, match="expected limit to be an integer from 0, found"):
                storage.list_episodes(limit=number)
            with pytest.raises(StorageError, match="expected offset to be an integer from 0, found"):
                storage.list_episodes(offset=number)

    def test_what_is_no_filter(self, storage: TupliStorage) -> None:
        no_filters: tuple[Any, ...] = (b"metadata.score > 3", {"key": "id"}, True, F("id"), lambda h: True)
        for ask in (storage.list_episodes, storage.list_benchmarks, storage.delete_episodes):
            for no_filter in no_filters:
                with pytest.raises(FilterError, match="expected a filter, such as FilterEQ"):
                    ask(no_filter)
        nothing: Any = None
        with pytest.raises(FilterError, match="expected a filter of the episodes to delete, found None"):
            storage.delete_episodes(nothing)

    def test_a_text_is_a_filter(self, storage: TupliStorage, tmp_path: Path) -> None:
        benchmark = storage.store_benchmark(query()).id
        storage.record_episodes([episode(benchmark, score=float(i)) for i in range(5)])
        assert [h.metadata["score"] for h in storage.list_episodes("metadata.score >= 3")] == [3.0, 4.0]
        assert len(storage.list_episodes("metadata.score >= 3", include_tuples=True)) == 2
        assert storage.count_episodes("metadata.score < 3") == 3
        assert len(storage.list_benchmarks(f'id = "{benchmark}"')) == 1
        assert storage.list_artifacts('name = "none"') == []
        if isinstance(storage, TupliAPIClient):
            assert storage.publish_episodes("metadata.score < 3") == 3
            assert storage.unpublish_episodes('published_in = "global" and metadata.score < 2', "global") == 2
        if isinstance(storage, FileStorage):
            storage.bundle(benchmark, tmp_path / "some.mcap", "metadata.score < 2")
            assert len(tupli_mcap.open(tmp_path / "some.mcap")) == 2
            assert len(tupli_mcap.open(storage.export(tmp_path / "one.mcap", "metadata.score < 1"))) == 1
        with pytest.raises(FilterError, match=r"unknown key 'score'.*metadata\.score"):
            storage.delete_episodes("score > 3")
        assert storage.delete_episodes("metadata.score > 2") == 2
        assert storage.count_episodes() == 3

    def test_delete_episodes(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        headers = storage.record_episodes([episode(benchmark, score=float(i)) for i in range(5)])
        storage.delete_episode(headers[1].id)
        assert [h.metadata["score"] for h in storage.list_episodes()] == [0.0, 2.0, 3.0, 4.0]
        assert storage.delete_episodes(F("metadata.score") >= 3) == 2
        assert [h.id for h in storage.list_episodes()] == [headers[0].id, headers[2].id]
        with pytest.raises(NotFoundError, match="there is no episode with id"):
            storage.delete_episode(headers[1].id)
        assert storage.delete_episodes(FilterEQ(key="benchmark_id", value=benchmark)) == 2
        assert storage.list_episodes() == []

    def test_delete_what_a_dataset_has(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        headers = storage.record_episodes([episode(benchmark, score=float(i)) for i in range(5)])
        dataset = tupli_mcap.open(storage)
        assert (dataset.delete(dry_run=True), storage.count_episodes()) == (5, 5)
        assert dataset.filter("metadata.score >= 3").delete() == 2
        assert dataset[0].delete() == 1
        assert [h.id for h in storage.list_episodes()] == [h.id for h in headers[1:3]]
        assert dataset.delete() == 2

    @pytest.mark.parametrize("made", [copy.deepcopy, lambda it: pickle.loads(pickle.dumps(it))])
    def test_copies_of_episodes(self, storage: TupliStorage, made: Any) -> None:
        benchmark = storage.store_benchmark(query()).id
        storage.record_episodes([episode(benchmark, score=float(i)) for i in range(2)])
        one = tupli_mcap.open(storage)[1]
        copied = made(one)
        assert (copied.id, copied.metadata) == (one.id, one.metadata)
        assert np.array_equal(copied.rewards, one.rewards)
        del copied
        assert len(one.recording.read().rewards) == one.recording.n_steps

    def test_publish_episode(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        headers = storage.record_episodes([episode(benchmark), episode(benchmark)])
        storage.publish_episode(headers[1].id, "lab")
        assert [h.published_in[-1] == "lab" for h in storage.list_episodes()] == [False, True]
        assert storage.list_episodes(FilterEQ(key="published_in", value="lab"))[0].id == headers[1].id
        assert storage.count_episodes(FilterIN(key="published_in", value=["lab", "another"])) == 1
        assert storage.count_episodes(F("published_in") != "lab") == 1

    def test_an_episode_needs_a_benchmark_and_tuples(self, storage: TupliStorage) -> None:
        with pytest.raises(NotFoundError, match="there is no benchmark"):
            storage.record_episode(episode("0" * 64))
        benchmark = storage.store_benchmark(query()).id
        with pytest.raises(StorageError, match="at least one tuple"):
            storage.record_episode(Episode(benchmark_id=benchmark, metadata={}, tuples=[]))

    def test_what_cannot_be_recorded_leaves_nothing(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        for reward in (None, "much"):
            made = Episode(
                benchmark_id=benchmark, metadata={}, tuples=[RLTuple(state=1, action=1, reward=reward)]
            )
            with pytest.raises(SpaceError, match="reward: expected a number, or an array of them, found"):
                storage.record_episode(made)
        made = episode(benchmark)
        made.metadata["what"] = object()
        with pytest.raises(StorageError, match=r"metadata of an episode that JSON can hold: .*what"):
            storage.record_episode(made)
        assert storage.list_episodes() == []

    def test_structured_values(self, storage: TupliStorage) -> None:
        benchmark = storage.store_benchmark(query()).id
        tuples = [
            RLTuple(
                state={
                    "pos": np.array([i, 2.5], np.float32),
                    "mode": "left" if i else "right",
                    "on": bool(i),
                },
                action=(np.int16(i), [1, 2, 3]),
                reward=np.float32(0.5),
                timeout=i == 1,
            )
            for i in range(2)
        ]
        storage.record_episode(Episode(benchmark_id=benchmark, metadata={}, tuples=tuples))
        (item,) = storage.list_episodes(include_tuples=True)
        state = item.tuples[1].state  # type: ignore[union-attr]
        assert state["mode"] == "left"
        assert state["pos"].dtype == np.float32
        assert state["pos"].tolist() == [1.0, 2.5]
        assert bool(state["on"]) is True
        assert item.tuples[1].action[0] == 1  # type: ignore[union-attr]
        assert item.end == "timeout"

    # --- ids ---

    def test_ids_are_no_paths(self, storage: TupliStorage) -> None:
        calls: list[Callable[[str], Any]] = [
            storage.load_benchmark,
            storage.delete_benchmark,
            storage.publish_benchmark,
            storage.new_recording_path,
            storage.load_artifact,
            storage.delete_artifact,
            storage.publish_artifact,
            storage.delete_episode,
            storage.publish_episode,
            storage.open_recording,
        ]
        for call, uri in itertools.product(calls, BAD_IDS):
            with pytest.raises(NotFoundError, match="there is no"):
                call(uri)
        with pytest.raises(NotFoundError, match="there is no recording"):
            storage.open_recording("recordings/\0.mcap")
