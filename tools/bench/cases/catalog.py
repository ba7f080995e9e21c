"""Filtering a storage's catalog on a declared key."""

from __future__ import annotations

import statistics
import uuid
from collections.abc import Iterator

import numpy as np

from tools.bench.measure import Run, check, seconds_of
from tools.bench.targets import Target, at_most
from tools.bench.workloads import SEED

RECORDINGS = 100
MATCHES = 1000


def filter_catalog(run: Run) -> Iterator[Target]:
    """A range of a declared metadata key that matches 1,000 of all catalogued episodes."""
    from tupli_mcap.schema import FilterGEQ
    from tupli_mcap.storage.catalog.catalog import Catalog
    from tupli_mcap.storage.catalog.entries import Entry
    from tupli_mcap.storage.catalog.rows import EpisodeRow
    from tupli_mcap.storage.listing import RecordingStamp

    total = run.part(1_000_000)
    matches = min(MATCHES, total // 2)
    scores = np.random.default_rng(SEED).permutation(total)
    catalog = Catalog(run.fresh("catalog.sqlite"))
    catalog.declare_key("metadata.score")
    for number, part in enumerate(np.array_split(scores, RECORDINGS)):
        rows = [
            EpisodeRow(
                episode=episode,
                env=0,
                n_tuples=22,
                end="terminal",
                episode_return=22.0,
                seed=None,
                created_at=1_767_225_600 * 10**9,
                created_by="bench",
                published_in="[]",
                metadata=f'{{"score": {score}, "is_expert": false}}',
            )
            for episode, score in enumerate(part)
        ]
        name = uuid.UUID(int=number).hex
        stamp = RecordingStamp(size=1, mtime_ns=1, mixed=0)
        catalog.put_recording(f"{name}.mcap", Entry(stamp, name, "bench", rows))
    query = FilterGEQ(key="metadata.score", value=total - matches)
    found = catalog.episodes(query)
    check(
        sorted(header.metadata["score"] for header in found) == list(range(total - matches, total)),
        f"{len(found)} episodes of {matches}",
    )
    plan = catalog.explain(query)
    check("USING INDEX" in plan or "USING COVERING INDEX" in plan, f"no index in the plan: {plan}")
    values = [seconds_of(lambda: catalog.episodes(query)) * 1e3 for _ in range(max(run.rounds, 5))]
    counts = [seconds_of(lambda: catalog.count(query)) * 1e3 for _ in range(max(run.rounds, 5))]
    catalog.close()
    note = f"the plan uses an index; counting them takes {statistics.median(counts):.1f} ms"
    what = f"filter {total:,} catalogued episodes, {matches:,} matches"
    yield at_most(what, 50, statistics.median(values), note, "ms")
