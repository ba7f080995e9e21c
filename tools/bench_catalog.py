"""Measures the catalog: ingesting episodes, and finding few among many. Run it, or call `measure`."""

from __future__ import annotations

import json
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tupli_mcap.schema import BaseFilter, F
from tupli_mcap.storage.catalog import Catalog, EpisodeRow, RecordingStamp

PER_RECORDING = 100_000


def rows(count: int, seed: int) -> Iterator[EpisodeRow]:
    """Episodes with five metadata entries each, `score` uniform in [0, 1)."""
    chance = random.Random(seed)
    for number in range(count):
        score = chance.random()
        metadata = {"score": score, "is_expert": score > 0.5, "cum_eps_reward": -200 * score, "n": number}
        metadata["name"] = f"run-{number % 7}"
        yield EpisodeRow(
            episode=number,
            env=0,
            n_tuples=22,
            end="terminal",
            episode_return=22.0,
            seed=number,
            created_at="2026-01-01T00:00:00+00:00",
            created_by="bench",
            published_in="[]",
            metadata=json.dumps(metadata),
        )


def measure(episodes: int = 1_000_000, matches: int = 1_000) -> dict[str, float]:
    """Seconds for ingesting (per 100,000 episodes) and for listing about `matches` of `episodes`.

    Listing includes the headers with their parsed metadata; each number is a median.
    """
    with tempfile.TemporaryDirectory() as folder, Catalog(Path(folder) / "catalog.sqlite") as catalog:
        catalog.declare_key("metadata.score")
        ingest: list[float] = []
        for number in range(-(-episodes // PER_RECORDING)):
            batch = list(rows(min(PER_RECORDING, episodes - number * PER_RECORDING), number))
            ingest.append(_timed(partial(_put, catalog, f"{number}.mcap", batch)))
        width = matches / episodes
        declared = (F("metadata.score") >= 0.5) & (F("metadata.score") < 0.5 + width)
        undeclared = F("metadata.cum_eps_reward") > -200 * width
        return {
            "ingest of 100,000": statistics.median(ingest) * PER_RECORDING / min(PER_RECORDING, episodes),
            "listing, declared key": _median(catalog, declared),
            "listing, any key": _median(catalog, undeclared),
        }


def _put(catalog: Catalog, name: str, batch: list[EpisodeRow]) -> None:
    catalog.put_recording(name, RecordingStamp(1, 2, 3), uuid=name, benchmark_id="b", rows=batch)


def _median(catalog: Catalog, wanted: BaseFilter) -> float:
    return statistics.median(_timed(lambda: catalog.episodes(wanted)) for _ in range(7))


def _timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    for name, seconds in measure(*map(int, sys.argv[1:])).items():
        print(f"{name:24} {seconds * 1e3:10.1f} ms")
