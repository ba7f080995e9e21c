"""Which ranges of a remote file are asked for together."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

__all__ = ["is_cut_cheaper", "pieces_of"]

Range = tuple[int, int]  # first byte, and the one behind the last

_LARGEST_GAP = 1 << 20
_LARGEST_PIECE = 8 << 20
# Fewer requests may cost a fifth of what is wanted, or so many bytes. Between two chunks lie the message indexes of the
# first one, which are a seventh of a file of small steps: a whole field must not become a request for each chunk.
_WASTE = 5
_LITTLE = 16 << 10
_CHUNK = 128 << 10  # about what a chunk takes
_TAIL = 128 << 10  # what opening takes
_CUT = 4


def pieces_of(wanted: Iterable[Range]) -> list[Range]:
    """Ranges that cover all the wanted ones, in ascending order, each a request.

    Neighbours become one piece, and so do those with small gaps between them: the smallest gaps first, as long as all
    of them together stay a small part of what is wanted. A piece ends at 8 MiB, so that several travel side by side.
    """
    merged = _touching(wanted)
    gaps = sorted((after[0] - before[1], i) for i, (before, after) in enumerate(itertools.pairwise(merged)))
    left = _LITTLE + sum(stop - start for start, stop in merged) // _WASTE
    bridged = set()
    for gap, i in gaps:
        left -= gap
        if left < 0 or gap > _LARGEST_GAP:
            break
        bridged.add(i)
    pieces: list[list[int]] = []
    for i, (start, stop) in enumerate(merged):
        if pieces and i - 1 in bridged:
            pieces[-1][1] = stop
        else:
            pieces.append([start, stop])
    return [piece for start, stop in pieces for piece in _cut(start, stop)]


def _touching(wanted: Iterable[Range]) -> list[Range]:
    found: list[Range] = []
    for start, stop in sorted(wanted):
        if found and start <= found[-1][1]:
            found[-1] = (found[-1][0], max(stop, found[-1][1]))
        elif start < stop:
            found.append((start, stop))
    return found


def _cut(start: int, stop: int) -> list[Range]:
    """A range in pieces of about the same size."""
    count = -(-(stop - start) // _LARGEST_PIECE)
    size = -(-(stop - start) // count)
    return [(at, min(stop, at + size)) for at in range(start, stop, size)]


def is_cut_cheaper(wanted: Sequence[int] | None, episodes: int, size: int) -> bool:
    """Whether a server should make a recording of the wanted ones (None: all) of a file's episodes, rather than be
    asked for ranges of the file.

    Ranges bring the index, and whole chunks: of each wanted episode its own, and one for what lies beside it. What is
    cut brings its rows only, but the server has to unpack and pack them, which takes as long as to send some times as
    many bytes. The index would tell the bytes exactly; it can have more of them than the wanted episodes.
    """
    if wanted is None or not episodes:
        return False
    rows = size / episodes
    ranges = _TAIL + min(size, len(wanted) * (rows + _CHUNK))
    return _CUT * len(wanted) * rows < ranges
