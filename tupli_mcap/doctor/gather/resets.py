"""What happens between episodes: whether there was a reset, and whose observation the final state is."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.doctor.findings import MAX_PLACES
from tupli_mcap.doctor.gather.digests import feed
from tupli_mcap.errors import FormatError
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import Array, Block

__all__ = ["Seams", "continued"]

_CONTINUED = 17  # byte of an EpisodeStart


_Seen = tuple[tuple[int, int], bytes, bytes | None]  # place of the final state, first state, final state


class Seams:
    """Final states that equal the first state of the next episode of the same sub-environment.

    compared: episodes whose final state and next first state are known, and whose own first state is another one (where
    every episode starts alike, an equal final state may be chance). equal: how many of them are equal, and the first.
    """

    def __init__(self, leaves: Sequence[Leaf]) -> None:
        self._leaves = [leaf for leaf in leaves if leaf.size or leaf.kind == "variable"]
        self._before: dict[int, _Seen] = {}  # by sub-environment
        self.compared = 0
        self.equal = 0
        self.places: list[tuple[int, int]] = []
        self._first = b""

    def put(self, block: Block) -> None:
        finals = {int(at): i for i, at in enumerate(block.finals_of)}
        numbers, envs = block.rows["episode"].tolist(), block.rows["env"].tolist()
        lengths = block.rows["length"].tolist()
        for i, start in enumerate(block.starts.tolist()):
            if block.first_step == 0:
                self._first = self._key(block.leaves, start)
                self._compare(envs[i], self._first)
            if block.whole:
                final = self._key(block.finals, finals[i]) if i in finals else None
                self._before[envs[i]] = ((numbers[i], lengths[i]), self._first, final)

    def _compare(self, env: int, first: bytes) -> None:
        before = self._before.get(env)
        if before is None or before[2] is None or before[1] == first:
            return
        self.compared += 1
        if before[2] == first:
            self.equal += 1
            if len(self.places) < MAX_PLACES:
                self.places.append(before[0])

    def _key(self, columns: dict[str, Any], i: int) -> bytes:
        parts = []
        for leaf in self._leaves:
            value = columns[leaf.name][i]
            if leaf.kind == "variable":
                digest = hashlib.blake2b(digest_size=16)
                feed(digest, value)
                parts.append(digest.digest())
            else:
                parts.append(value.tobytes())
        return b"".join(parts)


def continued(recording: Recording, rows: Array) -> Array:
    """Which episodes began with a step after an end, without a reset (bool, one for each index row).

    Raises:
        FormatError: a start is damaged.
    """
    if not len(rows):
        return np.zeros(0, np.bool_)
    starts = rows["start_row"].astype(np.int64)
    first = int(starts.min())
    found = bytearray()
    for body in recording._store.bodies(
        recording._channel("/episode_start"), first, int(starts.max()) + 1 - first
    ):
        if len(body) <= _CONTINUED:
            raise FormatError(f"{recording.name}: expected an episode start, found {len(body)} bytes")
        found.append(body[_CONTINUED])
    flags: Array = np.frombuffer(bytes(found), np.uint8)[starts - first] != 0
    return flags
