"""The public models: fields, defaults, and values kept as they are."""

from __future__ import annotations

import datetime
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

import tupli_mcap.schema as schema
from tupli_mcap.errors import StorageError
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    Benchmark,
    BenchmarkHeader,
    BenchmarkMetadata,
    BenchmarkQuery,
    DBItem,
    Episode,
    EpisodeHeader,
    EpisodeItem,
    EpisodeMetadataCallback,
    EpisodesListRequest,
    FilterAND,
    RLTuple,
    compile_predicate,
)


def test_everything_exported_is_there() -> None:
    assert all(hasattr(schema, name) for name in schema.__all__)


class TestItems:
    def test_create_new(self) -> None:
        first, second = (DBItem.create_new(created_by="me") for _ in range(2))
        assert first.id != second.id
        assert len(first.id) == 32
        assert first.published_in == ["me"]
        created = datetime.datetime.fromisoformat(first.created_at)
        assert abs(created - datetime.datetime.now(datetime.UTC)) < datetime.timedelta(minutes=1)

    def test_create_new_takes_given_fields(self) -> None:
        item = DBItem.create_new(created_by="me", id="x", published_in=["global"], created_at="2026")
        assert item == DBItem(id="x", created_by="me", published_in=["global"], created_at="2026")

    def test_artifacts(self) -> None:
        metadata = ArtifactMetadata(name="wind.csv", extra={"rows": 1000})
        assert (metadata.description, metadata.benchmark_id) == ("", None)
        item = ArtifactMetadataItem.create_new(created_by="me", hash="ab", **metadata.model_dump())
        assert (item.name, item.encoding, item.extra) == ("wind.csv", "utf-8", {"rows": 1000})
        assert ArtifactMetadataItem.model_validate_json(item.model_dump_json()) == item

    def test_benchmarks(self) -> None:
        metadata = BenchmarkMetadata(name="car", difficulty="hard", version="1")
        query = BenchmarkQuery(hash="ab", serialized="{}", metadata=metadata)
        benchmark = Benchmark.create_new(created_by="me", **query.model_dump())
        assert benchmark.metadata == metadata
        header = BenchmarkHeader.model_validate(benchmark.model_dump())
        assert compile_predicate(schema.F("metadata.name") == "car", BenchmarkHeader)(header)

    def test_defaults_are_not_shared(self) -> None:
        ArtifactMetadata(name="a").extra["x"] = 1
        RLTuple(state=0, action=0, reward=0).info["x"] = 1
        assert ArtifactMetadata(name="a").extra == {}
        assert RLTuple(state=0, action=0, reward=0).info == {}

    def test_missing_fields(self) -> None:
        with pytest.raises(ValidationError, match="name"):
            BenchmarkMetadata()  # type: ignore[call-arg]


class TestTuples:
    @pytest.mark.parametrize(
        "value", [np.float32([1, 2]), {"a": np.zeros(2)}, (1, [2]), 3, np.int64(3), "text", None], ids=repr
    )
    def test_a_step_keeps_the_objects_it_is_made_of(self, value: Any) -> None:
        info = {"x": value, 1: object()}
        step = RLTuple.from_env_step(value, value, value, np.True_, np.bool_(False), info)
        assert step.state is value
        assert step.action is value
        assert step.reward is value
        assert step.info is info
        assert (step.terminal, step.timeout) == (True, False)
        assert type(step.terminal) is bool

    def test_construction_keeps_values_too(self) -> None:
        state = np.arange(3, dtype=np.uint8)
        step = RLTuple(state=state, action=1, reward=0.5)
        assert step.state is state
        assert (step.info, step.terminal, step.timeout) == ({}, False, False)

    def test_gymnasiums_names_are_other_names_of_the_same_values(self) -> None:
        step = RLTuple(state=7, action=1, reward=0.5, terminal=True)
        assert (step.observation, step.terminated, step.truncated) == (7, True, False)
        assert list(step.model_dump()) == ["state", "action", "reward", "info", "terminal", "timeout"]
        assert pickle.loads(pickle.dumps(step)) == RLTuple.model_validate_json(step.model_dump_json()) == step

    @pytest.mark.parametrize(
        "make",
        [
            lambda n: np.float32([n, 2]),
            lambda n: {"a": np.full((2, 2), n), "b": [np.zeros(n), "x"]},
            lambda n: ([np.array([n])], 1.0),
            lambda n: np.array([np.zeros(n), "x"], object),
            lambda n: np.array(["a" * n]),
            lambda n: np.float64(n),
            lambda n: (None, "text" * n),
            lambda n: np.array([np.nan, n]),
            lambda n: {"a": float("nan"), "b": n},
        ],
    )
    def test_tuples_are_equal_where_their_values_are(self, make: Callable[[int], Any]) -> None:
        step, same, other = (
            RLTuple(state=make(n), action=make(n), reward=1.0, info={"x": make(n)}) for n in (3, 3, 4)
        )
        assert (step == same) is True
        assert (step == other) is False
        assert (step != other) is True
        assert [step] == [same] != [other]
        for name in ("state", "action", "info"):
            assert step != step.model_copy(update={name: getattr(other, name)})

    @pytest.mark.parametrize(
        ("one", "other"),
        [
            (np.zeros(2), np.zeros(3)),
            (np.zeros(2), np.zeros((2, 1))),
            (np.zeros(2), [0.0, 0.0]),
            (np.zeros(2), None),
            ([0], (0,)),
            ([0], [0, 0]),
            ({"a": 0}, {"b": 0}),
            ({"a": np.zeros(1)}, [np.zeros(1)]),
            (np.nan, 0.0),
        ],
        ids=repr,
    )
    def test_tuples_differ_where_their_values_do(self, one: Any, other: Any) -> None:
        steps = [RLTuple(state=value, action=0, reward=0.0) for value in (one, other)]
        assert (steps[0] == steps[1]) is False
        assert (steps[1] == steps[0]) is False

    def test_a_tuple_equals_none_of_another_type(self) -> None:
        class Own(RLTuple):
            pass

        assert RLTuple(state=0, action=0, reward=0) != Own(state=0, action=0, reward=0)
        assert RLTuple(state=0, action=0, reward=0) != 3

    def test_tuples_of_tensors(self) -> None:
        torch = pytest.importorskip("torch")
        step, same, other = (RLTuple(state=torch.full((2,), n), action=0, reward=0) for n in (1.0, 1.0, 2.0))
        assert (step == same) is True
        assert (step == other) is False

    def test_subclasses_may_convert(self) -> None:
        class Listed(RLTuple):
            @classmethod
            def from_env_step(cls, obs: Any, *rest: Any) -> Listed:
                return super().from_env_step(obs.tolist(), *rest)

        step = Listed.from_env_step(np.zeros(2), 1, 0.0, False, False, {})
        assert type(step) is Listed
        assert step.state == [0.0, 0.0]


def steps(**last: Any) -> list[RLTuple]:
    return [RLTuple(state=0, action=0, reward=1), RLTuple(state=1, action=0, reward=2, **last)]


class TestEpisodes:
    @pytest.mark.parametrize(
        ("last", "end"),
        [({"terminal": True}, "terminal"), ({"timeout": True}, "timeout"), ({}, "interrupted")],
    )
    def test_create_new(self, last: dict[str, Any], end: str) -> None:
        episode = Episode(benchmark_id="b", metadata={"x": 1}, tuples=steps(**last))
        item = EpisodeItem.create_new(created_by="me", **episode.model_dump())
        assert (item.n_tuples, item.end) == (2, end)
        assert (item.terminated, item.timeout) == (end == "terminal", end == "timeout")
        assert item.tuples == episode.tuples
        assert (
            EpisodeItem.create_new(created_by="me", benchmark_id="b", metadata={}, tuples=steps()).n_tuples
            == 2
        )

    def test_an_episode_needs_a_tuple(self) -> None:
        with pytest.raises(StorageError, match="needs at least one tuple"):
            EpisodeItem.create_new(created_by="me", benchmark_id="b", metadata={}, tuples=[])

    def test_headers_need_only_the_common_fields(self) -> None:
        header = EpisodeHeader(
            id="x",
            created_by="me",
            created_at="2026",
            benchmark_id="b",
            metadata={},
            n_tuples=1,
            terminated=True,
            timeout=False,
        )
        assert (header.end, header.episode_return, header.seed, header.recording) == ("", None, None, "")
        assert (header.env, header.episode, header.published_in) == (0, 0, [])

    def test_a_request_without_arguments_is_for_every_episode(self) -> None:
        request = EpisodesListRequest()
        assert not request.include_tuples
        assert compile_predicate(request)({})
        assert EpisodesListRequest.model_validate_json(request.model_dump_json()) == FilterAND(filters=[])

    def test_metadata_callbacks(self) -> None:
        class Return(EpisodeMetadataCallback):
            total = 0.0

            def reset(self) -> None:
                self.total = 0.0

            def __call__(self, tuple: RLTuple) -> dict[str, Any]:
                self.total += tuple.reward
                return {"cum_eps_reward": self.total}

        callback = Return()
        assert [callback(step) for step in steps()][-1] == {"cum_eps_reward": 3.0}
        with pytest.raises(TypeError, match="abstract"):
            EpisodeMetadataCallback()  # type: ignore[abstract]
