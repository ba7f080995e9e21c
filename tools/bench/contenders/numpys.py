"""NumPy's own files: compressed .npz, and .npy that is mapped into memory, which is the floor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import LOADED, ByHand, Session
from tools.bench.data import Array, Data

FACTS = ("lengths", "returns")


class _Kept:
    """Keeps blocks until the end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.blocks: list[dict[str, Array]] = []

    def write(self, leaves: dict[str, Array]) -> None:
        self.blocks.append(leaves)

    def all(self, lengths: Array, returns: Array, finals: dict[str, Array]) -> dict[str, Array]:
        made = {name: np.concatenate([block[name] for block in self.blocks]) for name in self.blocks[0]}
        return made | {"lengths": lengths, "returns": returns} | {f"final.{k}": v for k, v in finals.items()}


class _ToNpz(_Kept):
    def finish(self, lengths: Array, returns: Array, finals: dict[str, Array]) -> None:
        with self.path.open("wb") as file:
            np.savez_compressed(file, **self.all(lengths, returns, finals))


class _ToNpy(_Kept):
    def finish(self, lengths: Array, returns: Array, finals: dict[str, Array]) -> None:
        self.path.mkdir()
        for name, leaf in self.all(lengths, returns, finals).items():
            np.save(self.path / f"{name}.npy", leaf)


class Columns(Session):
    """Episodes and windows of whole columns, in memory or mapped into it."""

    def __init__(self, leaves: dict[str, Array], lengths: Array) -> None:
        super().__init__(lengths)
        self._leaves = leaves
        self._starts = np.cumsum(lengths) - lengths

    def episode(self, number: int) -> dict[str, Any]:
        first = self._starts[number]
        last = first + self.lengths[number]  # type: ignore[index]
        return {name: np.array(leaf[first:last]) for name, leaf in self._leaves.items()}

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        first = self._starts[number] + start
        return {name: np.array(leaf[first : first + length]) for name, leaf in self._leaves.items()}

    def windows(self, places: Sequence[tuple[int, int]], length: int) -> dict[str, Any]:
        at = np.asarray(places)
        rows = (self._starts[at[:, 0]] + at[:, 1])[:, None] + np.arange(length)
        return {name: leaf[rows] for name, leaf in self._leaves.items() if name.startswith(LOADED)}


def chosen(leaves: dict[str, Array], lengths: Array, returns: Array, least: float) -> dict[str, Any]:
    """The rows of the episodes that reach a return."""
    return Data(leaves, lengths).take(np.flatnonzero(returns >= least)).leaves


class Npz(ByHand):
    """One compressed file."""

    sink = _ToNpz
    batches = True
    note = "everything is in memory until it is written, and again before a window or an episode is read"

    def listing(self, path: Path) -> Array:
        with np.load(path) as file:
            lengths: Array = file["lengths"]
            return lengths

    def _leaves(self, path: Path) -> tuple[dict[str, Array], Array, Array]:
        with np.load(path) as file:
            names = [name for name in file.files if name not in FACTS and not name.startswith("final.")]
            return {name: file[name] for name in names}, file["lengths"], file["returns"]

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        leaves, lengths, _ = self._leaves(path)
        return leaves, lengths

    def field(self, path: Path) -> Array:
        with np.load(path) as file:
            actions: Array = file["actions"]
            return actions

    def open(self, path: Path) -> Session:
        leaves, lengths, _ = self._leaves(path)
        return Columns(leaves, lengths)

    def select(self, path: Path, least: float) -> dict[str, Any]:
        return chosen(*self._leaves(path), least)


class Npy(ByHand):
    """One file a column, uncompressed, mapped into memory."""

    sink = _ToNpy
    batches = True
    note = "the floor: nothing is compressed or checked; everything is in memory until it is written"

    def _leaves(self, path: Path) -> tuple[dict[str, Array], Array, Array]:
        names = [file.stem for file in path.glob("*.npy") if not file.name.startswith("final.")]
        mapped = {name: np.load(path / f"{name}.npy", mmap_mode="r") for name in names}
        return mapped, np.array(mapped.pop("lengths")), np.array(mapped.pop("returns"))

    def listing(self, path: Path) -> Array:
        lengths: Array = np.load(path / "lengths.npy")
        return lengths

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        leaves, lengths, _ = self._leaves(path)
        return {name: np.array(leaf) for name, leaf in leaves.items()}, lengths

    def field(self, path: Path) -> Array:
        actions: Array = np.load(path / "actions.npy")
        return actions

    def open(self, path: Path) -> Session:
        leaves, lengths, _ = self._leaves(path)
        return Columns(leaves, lengths)

    def select(self, path: Path, least: float) -> dict[str, Any]:
        return chosen(*self._leaves(path), least)
