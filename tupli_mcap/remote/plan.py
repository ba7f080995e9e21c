"""Plans which ranges of a remote file are fetched in one request."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

Range = tuple[int, int]  # half-open: first byte, and the one after the last

_LARGEST_GAP = 1 << 20
_LARGEST_PIECE = 8 << 20
# To save requests, gaps are fetched too, up to a fifth of the wanted bytes, or so many bytes. Between two chunks are
# the message indexes of the first, a seventh of a file of small steps: without this rule, reading a whole field would
# take a request for each chunk.
_WASTE = 5
_LITTLE = 16 << 10
_CHUNK = 128 << 10  # about the compressed size of a chunk
_TAIL = 128 << 10  # about the bytes that opening a file takes
_CUT = 4


def pieces_of(wanted: Iterable[Range]) -> list[Range]:
    """Ranges that cover all the wanted ones, in ascending order; each is one request.

    Adjacent ranges become one, and so do ranges with small gaps: the smallest gaps first, as long as all gaps together
    are a small part of the wanted bytes. A range holds each wanted one whole or not at all, so that nothing is fetched
    twice. It has at most 8 MiB, unless a wanted one is larger, so that several are fetched at the same time.
    """
    merged = _apart(wanted)
    gaps = sorted((after[0] - before[1], i) for i, (before, after) in enumerate(itertools.pairwise(merged)))
    left = _LITTLE + sum(stop - start for start, stop in merged) // _WASTE
    bridged = set()
    for gap, i in gaps:
        left -= gap
        if left < 0 or gap > _LARGEST_GAP:
            break
        bridged.add(i)
    pieces: list[Range] = []
    for i, (start, stop) in enumerate(merged):
        if i - 1 in bridged and stop - pieces[-1][0] <= _LARGEST_PIECE:
            pieces[-1] = (pieces[-1][0], stop)
        else:
            pieces.append((start, stop))
    return pieces


def _apart(wanted: Iterable[Range]) -> list[Range]:
    """The wanted ranges in ascending order; those that overlap become one."""
    found: list[Range] = []
    for start, stop in sorted(wanted):
        if found and start < found[-1][1]:
            found[-1] = (found[-1][0], max(stop, found[-1][1]))
        elif start < stop:
            found.append((start, stop))
    return found


def is_cut_cheaper(wanted: Sequence[int] | None, episodes: int, size: int) -> bool:
    """Whether a server should cut out the wanted episodes (None: all) as a recording, instead of sending ranges.

    Ranges bring the index and whole chunks: those of each episode, and about one more for rows beside it. A cut brings
    only the wanted rows, but the server has to decompress and compress them, which takes as long as sending several
    times as many bytes. This is an estimate: fetching the index to compute it could cost more than the episodes.
    """
    if wanted is None or not episodes:
        return False
    rows = size / episodes
    ranges = _TAIL + min(size, len(wanted) * (rows + _CHUNK))
    return _CUT * len(wanted) * rows < ranges
