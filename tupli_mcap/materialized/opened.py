"""Columns as they are read: every file checked against the manifest's claims, and mapped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np

from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.materialized.files import map_array, map_bytes, sha256_of
from tupli_mcap.materialized.manifest import FileEntry, Manifest
from tupli_mcap.materialized.plan import Array, ColumnPlan, LeafFiles
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.variable import VariableField
from tupli_mcap.system import refused

__all__ = ["OpenedColumns", "VariableColumn", "open_columns"]

_ATTEMPTS = 5
_EPISODE_ID = "episode_id.npy"


class VariableColumn(Sequence[Any]):
    """Values of variable size, decoded when they are asked for. Safe from several threads."""

    def __init__(self, offsets: Array, values: memoryview, codec: VariableField, path: Path) -> None:
        self._offsets, self._values, self._codec, self._path = offsets, values, codec, path

    def __len__(self) -> int:
        return len(self._offsets) - 1

    @overload
    def __getitem__(self, i: int) -> Any: ...
    @overload
    def __getitem__(self, i: slice) -> list[Any]: ...
    def __getitem__(self, i: int | slice) -> Any:
        if isinstance(i, slice):
            return self.take(range(*i.indices(len(self))))
        if i < 0:
            i += len(self)
        begin, end = int(self._offsets[i]), int(self._offsets[i + 1])
        if not 0 <= begin <= end <= len(self._values):
            raise FormatError(
                f"{self._path}: expected ascending offsets up to {len(self._values)}, found {begin} and {end}; "
                "materialize the dataset again"
            )
        value, found = self._codec.decode(self._values[begin:end], 0, 0)
        if found != end - begin:
            raise FormatError(
                f"{self._path}: expected a value of {end - begin} bytes at {begin}, found {found}"
            )
        return value

    def take(self, rows: Iterable[int]) -> list[Any]:
        """The values of some rows (from 0), in their order."""
        return [self[i] for i in rows]


@dataclass(frozen=True)
class OpenedColumns:
    """The columns of a directory, mapped into memory and read-only.

    leaves: by leaf name, an array (steps, ...) or a VariableColumn. next_leaves: the same of the states that follow the
    breaks. terminal, timeout: bools. time: int64, ns. step: int64, counted from 0 in its episode. breaks: int64, the
    steps whose next state is not that of the step after them here, ascending; next_known: whether it was recorded, else
    it is the step's own state. episode_lengths: the steps here of each
    episode; recorded_lengths: before the tuple filter. episode_ids: bytes.
    """

    path: Path
    manifest: Manifest
    layout: StepLayout
    leaves: dict[str, Any]
    next_leaves: dict[str, Any]
    terminal: Array
    timeout: Array
    time: Array
    step: Array
    breaks: Array
    next_known: Array
    episode_lengths: Array
    recorded_lengths: Array
    episode_ids: Array


def open_columns(directory: Path, *, verify: bool = False) -> OpenedColumns | None:
    """The columns of a directory; None if there are none.

    Args:
        verify: also compare every file with its digest, which reads all of it.

    Raises:
        FormatError: they are damaged.
        StorageError: the system refuses.
    """
    for _ in range(_ATTEMPTS):
        try:
            manifest = Manifest.read(directory)
        except FileNotFoundError:
            return None
        except FormatError as err:
            raise FormatError(f"{err}; materialize the dataset again") from err
        try:
            opened = _open(directory, manifest)
            if verify:
                _verify(directory, manifest)
        except FormatError as err:
            if _current(directory, manifest):
                raise FormatError(f"{err}; materialize the dataset again") from err
            continue
        if _current(directory, manifest):  # else somebody has replaced some of the files in between
            return opened
    return None


def _current(directory: Path, manifest: Manifest) -> bool:
    try:
        return Manifest.read(directory).token == manifest.token
    except FileNotFoundError:
        return False


def _open(directory: Path, manifest: Manifest) -> OpenedColumns:
    layout = manifest.layout(directory)
    plan = ColumnPlan(layout, manifest.steps, manifest.episodes, manifest.breaks)
    plain = {
        name: map_array(directory / f"{name}.npy", _entry(directory, manifest, f"{name}.npy"), dtype, shape)
        for name, (dtype, shape) in plan.plain.items()
    }
    opened = OpenedColumns(
        directory,
        manifest,
        layout,
        leaves={name: _leaf(directory, manifest, layout, files) for name, files in plan.leaves.items()},
        next_leaves={
            name: _leaf(directory, manifest, layout, files) for name, files in plan.next_leaves.items()
        },
        terminal=plain["terminal"],
        timeout=plain["timeout"],
        time=plain["time"],
        step=plain["step"],
        breaks=plain["break"],
        next_known=plain["next_state_known"],
        episode_lengths=plain["episode_length"],
        recorded_lengths=plain["episode_recorded"],
        episode_ids=_episode_ids(directory, manifest),
    )
    _check_order(opened)
    return opened


def _leaf(directory: Path, manifest: Manifest, layout: StepLayout, files: LeafFiles) -> Any:
    path = directory / files.array
    array = map_array(path, _entry(directory, manifest, files.array), files.dtype, files.shape)
    if not files.variable:
        return array
    values = map_bytes(directory / files.values, _entry(directory, manifest, files.values))
    return VariableColumn(array, values, layout.variable[files.leaf.name], path)


def _episode_ids(directory: Path, manifest: Manifest) -> Array:
    entry = _entry(directory, manifest, _EPISODE_ID)
    if not (entry.dtype.startswith("|S") and entry.dtype[2:].isdecimal() and len(entry.dtype) < 8):
        raise FormatError(f"{directory / _EPISODE_ID}: expected texts, found {entry.dtype!r:.80}")
    return map_array(directory / _EPISODE_ID, entry, np.dtype(entry.dtype), (manifest.episodes,))


def _entry(directory: Path, manifest: Manifest, name: str) -> FileEntry:
    if name not in manifest.files:
        raise FormatError(f"{directory}: expected a file {name} in the manifest, found none")
    return manifest.files[name]


def _check_order(opened: OpenedColumns) -> None:
    """Whether lengths and breaks fit the steps; the columns themselves are not looked at."""
    lengths, breaks, steps = opened.episode_lengths, opened.breaks, opened.manifest.steps
    if len(lengths) and (lengths.min() < 0 or lengths.max() > steps):
        raise FormatError(f"{opened.path}: expected lengths of episodes from 0 to {steps}, found others")
    if int(lengths.sum()) != steps:
        raise FormatError(f"{opened.path}: expected {steps} steps of all episodes, found {lengths.sum()}")
    ends = np.cumsum(lengths[lengths > 0]) - 1
    if len(breaks) and (breaks[0] < 0 or breaks[-1] >= steps or (np.diff(breaks) <= 0).any()):
        raise FormatError(f"{opened.path}: expected breaks that ascend from 0 to {steps}, found others")
    places = np.searchsorted(breaks, ends)
    if len(ends) and (places[-1] == len(breaks) or (breaks[places] != ends).any()):
        raise FormatError(f"{opened.path}: expected a break at every end of an episode, found fewer")


def _verify(directory: Path, manifest: Manifest) -> None:
    for name, entry in manifest.files.items():
        try:
            found = sha256_of(directory / name)
        except FileNotFoundError as err:
            raise FormatError(f"{directory / name} is missing") from err
        except OSError as err:
            raise StorageError(f"{directory / name} cannot be read: {refused(err)}") from err
        if found != entry.sha256:
            raise FormatError(
                f"{directory / name}: expected the SHA-256 {entry.sha256:.16}…, found {found:.16}…"
            )
