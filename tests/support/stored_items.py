"""A benchmark and an episode to store."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.environment import capture
from tupli_mcap.schema import (
    BenchmarkMetadata,
    BenchmarkQuery,
    Episode,
    RLTuple,
)
from tupli_mcap.storage.benchmark_json import BenchmarkContent, benchmark_hash, pack


def query(
    name: str = "cart", env: gym.Env[Any, Any] | None = None, artifacts: tuple[str, ...] = ()
) -> BenchmarkQuery:
    record = capture(env or gym.make("CartPole-v1"))
    metadata = BenchmarkMetadata(
        name=name, description="a pole", extra={"level": np.int64(3), "limits": (1, 2)}
    )
    content = BenchmarkContent(record, artifacts)
    return BenchmarkQuery(
        hash=benchmark_hash(content, metadata), serialized=pack(record, artifacts), metadata=metadata
    )


def episode(benchmark_id: str, length: int = 3, score: float = 1.0) -> Episode:
    tuples = [
        RLTuple(
            state=[0.5 * i, -1.0],
            action=i % 2,
            reward=score,
            info={"step": i},
            terminal=i == length - 1,
        )
        for i in range(length)
    ]
    return Episode(benchmark_id=benchmark_id, metadata={"score": score}, tuples=tuples)
