"""What the catalog holds of a recording: one row an episode, from its index and its sidecar."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from tupli_mcap.recording import Recording
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.common import LOCAL_USER
from tupli_mcap.storage.sidecar import Sidecar

__all__ = ["catalog_rows"]

_ENDS = ("terminal", "timeout", "interrupted")


def catalog_rows(recording: Recording, sidecar: Sidecar, *, live: bool) -> Iterator[EpisodeRow]:
    """The rows of a recording, without deleted episodes and those a live writer is in the middle of."""
    index = recording.index
    columns = [index[name].tolist() for name in ("episode", "env", "length", "end", "return", "end_time")]
    seeds = [
        seed if has else None
        for has, seed in zip(index["has_seed"].tolist(), index["seed"].tolist(), strict=True)
    ]
    running = _running(columns[1], columns[3]) if live else set()
    local = json.dumps([LOCAL_USER])
    for i, (number, env, length, end, total, created_at, seed, metadata) in enumerate(
        zip(*columns, seeds, recording.all_metadata(), strict=True)
    ):
        if number in sidecar.deleted or i in running:
            continue
        groups = sidecar.published_in.get(number)
        yield EpisodeRow(
            episode=number,
            env=env,
            n_tuples=length,
            end=_ENDS[end],
            episode_return=total,
            seed=seed,
            created_at=created_at,
            created_by=LOCAL_USER,
            published_in=local if groups is None else json.dumps(groups),
            metadata=metadata,
        )


def _running(envs: Sequence[int], ends: Sequence[int]) -> set[int]:
    """Positions of episodes that a live writer has not finished: each sub-environment's last, if it has no
    end."""
    last = {env: i for i, env in enumerate(envs)}
    return {i for i in last.values() if _ENDS[ends[i]] == "interrupted"}
