"""A shuffled order of an epoch in which items that are near each other on the disk stay near each other.

The blocks (chunks) of the items are shuffled and laid out as one sequence. Each rank has a part of it, and each
stream of a rank a part of that. Within a stream, the items of `mix` blocks at a time are shuffled. Batch b of a rank
is number b // streams of stream b % streams, as a DataLoader takes batches from its workers in turn: so each of
`streams` workers reads different blocks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.steps import Numbered

_CHUNK_BYTES = 256 << 10  # assumed if the size of chunks is not known


@dataclass(frozen=True)
class Blocks:
    """Items by the block of their first step; all arrays are int64.

    Run i holds the items from `starts[i]` to `stops[i] - 1`; those of block k are runs `firsts[k]` to
    `firsts[k + 1] - 1`.
    """

    starts: Array
    stops: Array
    firsts: Array

    def __len__(self) -> int:
        return len(self.firsts) - 1

    @property
    def sizes(self) -> Array:
        """Items of each block."""
        return np.add.reduceat(self.stops - self.starts, self.firsts[:-1])

    @cached_property
    def digest(self) -> str:
        """A digest (SHA-256, hex) of the items in each block."""
        return hashlib.sha256(
            b"".join(part.tobytes() for part in (self.starts, self.stops, self.firsts))
        ).hexdigest()

    def items(self, block: int) -> Array:
        """The items of a block."""
        runs = slice(int(self.firsts[block]), int(self.firsts[block + 1]))
        sizes = self.stops[runs] - self.starts[runs]
        found: Array = np.arange(sizes.sum()) + np.repeat(self.starts[runs] - np.cumsum(sizes) + sizes, sizes)
        return found


def _blocks_of(items: Numbered, least: int) -> Blocks:
    """The blocks of items, and neighbours joined as long as there are fewer than `least` items in them together."""
    begins, lengths, kind = items.block_runs()
    stops = begins + lengths
    order = np.argsort(kind, kind="stable")
    begins, stops, kind = begins[order], stops[order], kind[order]
    firsts = np.concatenate([[0], np.flatnonzero(kind[1:] != kind[:-1]) + 1])
    sizes = np.add.reduceat(stops - begins, firsts)
    joined = (np.cumsum(sizes) - sizes) // max(1, least)  # blocks that begin in the same `least` items
    kept = np.concatenate([[True], joined[1:] != joined[:-1]])
    return Blocks(begins, stops, np.append(firsts[kept], len(begins)))


def mixing(items: Numbered, cache_bytes: int) -> tuple[int, Blocks]:
    """The number of blocks that are mixed at a time, and the blocks, each of one or several chunks. Mixed blocks fit
    into half of the cache, and are large enough that few items extend into the next block, which would be read
    twice."""
    chunk_bytes = getattr(items.source, "block_bytes", 0) or _CHUNK_BYTES
    chunks = max(2, cache_bytes // 2 // chunk_bytes)
    single = _blocks_of(items, 1)
    items_of_chunk = len(items) / len(single)
    steps = getattr(items, "length", 1) + getattr(items, "history", 0)  # of an item, where it has many
    least = int(min(2 * steps, chunks * items_of_chunk / 4))
    blocks = _blocks_of(items, least) if least > items_of_chunk else single
    return max(2, chunks * len(blocks) // len(single)), blocks


class ShuffledBatches:
    """The batches of one rank in one epoch: batch b is an array of numbers of items (int64).

    Args:
        key: seed of the order (non-negative integers); None for the order of the items.
        mix: number of blocks whose items are mixed.
        drop_last: only full batches, the same number in every rank.
        rank, ranks: which of how many parts of the items.
        streams: number of parts of the order.
    """

    def __init__(
        self,
        blocks: Blocks | None,
        total: int,
        size: int,
        key: Sequence[int] | None,
        mix: int,
        *,
        drop_last: bool = False,
        rank: int = 0,
        ranks: int = 1,
        streams: int = 1,
    ) -> None:
        self._blocks, self._key, self._mix = blocks, key, mix
        self._size = size
        first = total * rank // ranks
        count = total * (rank + 1) // ranks - first
        if drop_last:
            count = total // ranks // size * size
        self._count = -(-count // size)
        self._streams = streams if key is not None else 1
        self._bounds = first + _stream_bounds(count, size, self._streams)
        self._group: tuple[int, int, Array] = (0, 0, np.empty(0, np.int64))
        if blocks is not None and key is not None:
            self._order = np.random.default_rng(key).permutation(len(blocks))
            self._ends = np.cumsum(blocks.sizes[self._order])

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, batch: int) -> Array:
        stream, place = batch % self._streams, batch // self._streams
        start = int(self._bounds[stream]) + place * self._size
        stop = min(start + self._size, int(self._bounds[stream + 1]))
        if self._key is None:
            return np.arange(start, stop)
        parts = []
        while start < stop:
            low, high, items = self._mixed(start, stream)
            end = min(stop, high)
            parts.append(items[start - low : end - low])
            start = end
        return np.concatenate(parts)

    def _mixed(self, place: int, stream: int) -> tuple[int, int, Array]:
        """The range of places of the mixed blocks around a place of the stream, and their items in the drawn order."""
        low, high, items = self._group
        if not low <= place < high:
            begin, end = int(self._bounds[stream]), int(self._bounds[stream + 1])
            first = int(np.searchsorted(self._ends, begin, side="right"))
            at = int(np.searchsorted(self._ends, place, side="right"))
            group = first + (at - first) // self._mix * self._mix
            low = max(begin, int(self._ends[group - 1]) if group else 0)
            high = min(end, int(self._ends[min(group + self._mix, len(self._ends)) - 1]))
            items = np.random.default_rng([*(self._key or ()), low]).permutation(self._laid_out(low, high))
            self._group = low, high, items
        return low, high, items

    def _laid_out(self, low: int, high: int) -> Array:
        """The items at places `low` to `high - 1` of the shuffled blocks."""
        assert self._blocks is not None  # only known blocks are shuffled
        first = int(np.searchsorted(self._ends, low, side="right"))
        last = int(np.searchsorted(self._ends, high, side="left"))
        found = np.concatenate([self._blocks.items(int(k)) for k in self._order[first : last + 1]])
        before = int(self._ends[first - 1]) if first else 0
        return found[low - before : high - before]


def _stream_bounds(count: int, size: int, streams: int) -> Array:
    """The bounds of the streams such that batch b is in stream b % streams and only the last one is not full."""
    batches = -(-count // size)
    full = np.array([len(range(stream, batches, streams)) for stream in range(streams)], np.int64) * size
    if batches:
        full[(batches - 1) % streams] -= batches * size - count
    return np.concatenate([[0], np.cumsum(full)])
