"""A shuffle that stays sequential in the storage: blocks in random order, through a buffer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.arrays import Array

__all__ = ["through_buffer"]


def through_buffer(
    runs: tuple[Array, Array, Array], size: int, batch_size: int, random: np.random.Generator
) -> Iterator[Array]:
    """Batches of item numbers (int64) in which each item is once, the last one as long as is left.

    Each item waits a random time, but none longer than `span` blocks: so few blocks are in use at any time. (Drawing
    from a full buffer at random would leave stragglers of almost every block behind.)

    Args:
        runs: the first item, the length and the block of runs of items; blocks are put into the buffer in random
            order.
        size: how many items' worth of blocks are in use at a time, about twice as many as wait.
    """
    _, lengths, blocks = runs
    count = len(np.unique(blocks))
    span = size * count / int(lengths.sum())
    first = min(
        int(span), count - 1
    )  # before that block, nothing leaves: also the first items are of many blocks
    waiting, due, ready = np.empty(0, np.int64), np.empty(0), np.empty(0, np.int64)
    for now, block in enumerate(_blocks(*runs, random)):
        low, high = max(now, first), min(now + span, count)
        waiting = np.concatenate([waiting, block])
        due = np.concatenate([due, low + max(0.0, high - low) * random.random(len(block))])
        over = due < now + 1  # nothing that comes later can be due before
        ready = np.concatenate([ready, waiting[over][np.argsort(due[over])]])
        waiting, due = waiting[~over], due[~over]
        full = len(ready) - len(ready) % batch_size
        yield from ready[:full].reshape(-1, batch_size)
        ready = ready[full:]
    ready = np.concatenate([ready, waiting[np.argsort(due)]])
    for first in range(0, len(ready), batch_size):
        yield ready[first : first + batch_size]


def _blocks(firsts: Array, lengths: Array, blocks: Array, random: np.random.Generator) -> Iterator[Array]:
    """The items of one block after the other."""
    order = np.argsort(blocks, kind="stable")
    cuts = np.flatnonzero(np.diff(blocks[order], prepend=-1, append=-1))
    for block in random.permutation(len(cuts) - 1).tolist():
        chosen = order[cuts[block] : cuts[block + 1]]
        steps = lengths[chosen]
        within = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
        yield np.repeat(firsts[chosen], steps) + within
