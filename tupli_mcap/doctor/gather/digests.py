"""A digest of every episode: equal content, equal digest, whatever its number, seed and times are."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.recording.blocks import Array, Block

__all__ = ["Digests", "feed"]

_SIZE = 16


class Digests:
    """BLAKE2b-128 over states, actions, rewards and flags of each episode."""

    def __init__(self, leaves: Sequence[Leaf]) -> None:
        self._packed = [leaf for leaf in leaves if leaf.kind not in ("image", "variable") and leaf.size]
        self._single = [leaf for leaf in leaves if leaf.kind in ("image", "variable")]
        # Content that differs in structure only must differ too.
        head = repr([(leaf.path, leaf.kind, leaf.shape) for leaf in leaves]).encode()
        self._empty = hashlib.blake2b(head, digest_size=_SIZE)
        self._running = self._empty.copy()
        self._done: list[bytes] = []

    def put(self, block: Block) -> None:
        packed = self._pack(block)
        width = packed.shape[1]
        data = memoryview(packed.reshape(-1).data)
        for i, (start, length) in enumerate(zip(block.starts.tolist(), block.lengths.tolist(), strict=True)):
            self._running.update(data[start * width : (start + length) * width])
            for leaf in self._single:
                feed(self._running, block.leaves[leaf.name][start : start + length])
            if block.whole or i + 1 < len(block.lengths):
                self._done.append(self._running.digest())
                self._running = self._empty.copy()

    def _pack(self, block: Block) -> Array:
        columns = [np.ascontiguousarray(block.leaves[leaf.name]) for leaf in self._packed]
        columns += [block.columns.terminals, block.columns.timeouts]
        return np.concatenate([c.reshape(len(c), -1).view(np.uint8) for c in columns], axis=1)

    @property
    def values(self) -> Array:
        """One 16-byte void an episode, in the order they were read."""
        return np.frombuffer(b"".join(self._done), np.dtype((np.void, _SIZE)))


def feed(digest: Any, value: Any) -> None:
    """Update a digest with a value of any space, so that different values make different digests."""
    if isinstance(value, dict):
        digest.update(b"d%d;" % len(value))
        for key, part in value.items():
            feed(digest, str(key))
            feed(digest, part)
    elif isinstance(value, tuple | list):
        digest.update(b"t%d;" % len(value))
        for part in value:
            feed(digest, part)
    elif isinstance(value, np.ndarray | np.generic):
        array = np.ascontiguousarray(value)
        digest.update(f"a{array.dtype.str}{np.shape(value)};".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    else:
        text = str(value).encode("utf-8", "surrogatepass")
        digest.update(b"%s%d;" % (type(value).__name__.encode(), len(text)) + text)
