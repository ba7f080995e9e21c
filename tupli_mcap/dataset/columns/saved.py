"""Saved columns: the steps of a dataset as a directory of plain `.npy` files, which readers map into memory.

`docs/howto/columns.md` describes the directory. It is written atomically and never changes afterwards.
"""

from __future__ import annotations

import io
import math
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from tupli_mcap import files, jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.dataset.access import RandomAccess
from tupli_mcap.dataset.items import FIELDS, Steps
from tupli_mcap.dataset.items.steps import checked_fields, pick, pick_runs, rows_of_runs
from tupli_mcap.dataset.sources import DatasetError
from tupli_mcap.errors import FormatError, StorageError, plural
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.progress import progress
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.remote import check_local
from tupli_mcap.schema import BaseFilter, EpisodeHeader, F
from tupli_mcap.storage.atomic import os_errors, read_bytes
from tupli_mcap.storage.texts import first_defect

_MANIFEST = "manifest.json"
_BLOCK_BYTES = 16 << 20  # of steps that are written at once
_LONGEST_NAME = 200
_BLOCK = 4096  # steps in a block: cheap to read together
_INT64, _BOOL = np.dtype("<i8"), np.dtype(np.bool_)
_PLAIN = {"terminals": "terminal", "timeouts": "timeout", "times": "time"}
# Errors that NumPy raises for a file that is no `.npy` file, or is shorter than its header says.
_BROKEN = (ValueError, TypeError, SyntaxError, OverflowError, RecursionError, MemoryError, TokenError)


class _Manifest(BaseModel):
    """The content of `manifest.json`. `episodes` are headers as JSON texts, which are parsed only on access, since that
    takes longer than everything else; the run of each is an index in `runs`."""

    format: Literal["tupli_mcap columns"] = "tupli_mcap columns"
    version: Literal[1] = 1
    identity: str
    spaces: dict[str, str]
    step_seconds: float | None
    steps: int = Field(ge=1)
    breaks: int = Field(ge=1)
    episodes: list[str]
    runs: list[str] = Field(default_factory=list)


def _plan(layout: StepLayout, manifest: _Manifest) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
    """Dtype and shape of each array, by its name."""
    steps, breaks = manifest.steps, manifest.breaks
    dtypes = {name: dtype.newbyteorder("<") for name, dtype in layout.dtypes.items()}
    return {
        **{leaf.name: (dtypes[leaf.name], (steps, *leaf.shape)) for leaf in layout.leaves},
        **{f"next_{leaf.name}": (dtypes[leaf.name], (breaks, *leaf.shape)) for leaf in layout.state},
        "terminal": (_BOOL, (steps,)),
        "timeout": (_BOOL, (steps,)),
        "time": (_INT64, (steps,)),
        "break": (_INT64, (breaks,)),
        "next_known": (_BOOL, (breaks,)),
        "episode_length": (_INT64, (len(manifest.episodes),)),
    }


def _file_name(name: str) -> str:
    """The name of an array's file. Of a long one, the first characters and a checksum: file systems take 255 bytes."""
    if len(name) > _LONGEST_NAME:
        name = f"{name[:_LONGEST_NAME]}_{zlib.crc32(name.encode()):08x}"
    return f"{name}.npy"


# ---- writing


def save_columns(
    directory: str | os.PathLike[str],
    steps: Steps,
    headers: Sequence[EpisodeHeader],
    step_seconds: float | None,
) -> None:
    """Writes the columns of steps; see `Dataset.save_columns`."""
    place = _path_of(directory)
    check_local(directory)
    if os.path.lexists(place):
        raise StorageError(
            f"expected an unused path for columns, but {place} exists; choose another one, or remove it"
        )
    layout = _layout_of(steps)
    runs = {id(header.run): header.run for header in headers}
    places = {run: i for i, run in enumerate(runs)}
    manifest = _Manifest(
        identity=steps.identity,
        spaces=layout.to_metadata(),
        step_seconds=step_seconds,
        steps=len(steps),
        breaks=len(steps.breaks),
        episodes=[_text_of(header, places[id(header.run)]) for header in headers],
        runs=[jsonvalue.dumps(run) for run in runs.values()],
    )
    with os_errors("columns cannot be saved to", place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with files.replacing(place, overwrite=False) as new:
            new.mkdir()
            _write(new, steps, layout, manifest)
            for path in new.iterdir():
                files.sync(path)


def _layout_of(steps: Steps) -> StepLayout:
    """The layout of the columns: the spaces of the steps, with dtypes that hold the values of all their recordings.
    DatasetError if there is no step, or values are of variable size."""
    layout = steps.layout
    if layout is None or not len(steps):
        raise DatasetError("expected steps to save, found none; choose episodes and steps by other filters")
    varying = [f"{leaf.path} of {leaf.space!r:.80}" for leaf in layout.leaves if leaf.kind == "variable"]
    if varying:
        raise DatasetError(
            f"expected values of a fixed size, found {varying[0]}, which no array holds; read such steps from their "
            "recordings"
        )
    dtype_of = {name: array.dtype for name, array in _arrays(steps, layout, np.empty(0, np.int64))}
    dtypes = {name: dtype_of[name] for name in layout.dtypes}
    return StepLayout(layout.observation_space, layout.action_space, layout.reward_space, dtypes)


def _text_of(header: EpisodeHeader, run: int) -> str:
    """A header as JSON; its run is an index in the manifest's `runs`, since many episodes share one."""
    try:
        return jsonvalue.dumps({**dict(header), "run": run})
    except ValueError as err:  # it is one level deeper here
        raise DatasetError(f"episode {header.id}: its metadata cannot be saved: {err}") from err


def _write(directory: Path, steps: Steps, layout: StepLayout, manifest: _Manifest) -> None:
    """Fills the directory, one block of steps after the other; not through maps: a full disk would kill the process."""
    plan = _plan(layout, manifest)
    for name, (dtype, shape) in plan.items():
        header = io.BytesIO()
        fields = {"descr": dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, fields)
        (directory / _file_name(name)).write_bytes(header.getvalue())

    def append(name: str, array: Array) -> None:
        with (directory / _file_name(name)).open("ab") as file:
            file.write(np.ascontiguousarray(array, plan[name][0]).data)

    append("break", steps.breaks)
    append("next_known", ~np.isin(steps.breaks, steps.open_ends))
    append("episode_length", steps.episode_lengths)
    many = max(1, _BLOCK_BYTES // step_bytes(layout))
    with progress(len(steps), "Saving") as bar:
        for first in range(0, len(steps), many):
            rows = np.arange(first, min(first + many, len(steps)))
            for name, array in _arrays(steps, layout, rows):
                append(name, array)
            bar.advance(len(rows))
    (directory / _MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")


def _arrays(steps: Steps, layout: StepLayout, rows: Array) -> Iterator[tuple[str, Array]]:
    """The arrays of some consecutive steps, by the names of their files."""
    columns = steps.read([field for field in FIELDS if field != "next_states"], rows)
    ends = steps.breaks[slice(*steps.breaks.searchsorted([rows[0], rows[-1] + 1]))] if len(rows) else rows
    columns |= steps.read(["next_states"], ends)
    for field, column in columns.items():
        leaves = field_leaves(field, layout)
        prefix = "next_" if field == "next_states" else ""
        if leaves is None:
            yield _PLAIN[field], column
        else:
            yield from ((f"{prefix}{leaf.name}", leaf.get(column)) for leaf in leaves)


# ---- reading


class SavedColumns(RandomAccess):
    """The columns in a directory; they have windows, transitions and delta windows like the saved dataset.

    The steps are those at the time of saving; the recordings are not read. Thread-safe. Windows of them can be pickled:
    a copy in another process maps the same files.
    """

    def __init__(self, directory: Path, manifest: _Manifest, steps: SavedSteps) -> None:
        self._directory, self._manifest, self._steps = directory, manifest, steps

    @property
    def steps(self) -> Steps:
        return self._steps

    def preview(self) -> list[EpisodeHeader]:
        """The episodes as they were listed at the time of saving.

        Raises:
            FormatError: an entry of the manifest is no header of an episode.
        """
        return list(self._headers)

    @cached_property
    def _headers(self) -> Sequence[EpisodeHeader]:
        try:
            runs = [jsonvalue.loads(text) for text in self._manifest.runs]
            found = [jsonvalue.loads(text) for text in self._manifest.episodes]
            for header in found:
                if isinstance(header.get("run"), int):
                    header["run"] = runs[header["run"]]
            return [EpisodeHeader.model_validate(header) for header in found]
        except (ValidationError, FormatError, IndexError, AttributeError) as err:
            raise _defect(self._directory / _MANIFEST, "headers of episodes", first_defect(err)) from err

    def _values_now(self) -> Callable[[F | BaseFilter], Array]:
        return self.episode_values  # the headers are read only when values are needed

    def _step_seconds(self) -> float | None:
        return self._manifest.step_seconds

    def __len__(self) -> int:
        """The number of steps."""
        return len(self._steps)

    def __repr__(self) -> str:
        episodes = len(self._manifest.episodes)
        return f"<SavedColumns of {str(self._directory)!r}: {plural(episodes, 'episode')}, {plural(len(self), 'step')}>"


class SavedSteps:
    """The steps of saved columns by number (see `Steps`): rows of arrays that are mapped into memory."""

    fields: tuple[str, ...] = FIELDS

    def __init__(
        self,
        directory: Path,
        whole: StepLayout,
        identity: str,
        arrays: Mapping[str, Array],
        parts: Sequence[str] = (),
    ) -> None:
        self._directory = directory.absolute()  # absolute, since copies in other processes open it again
        self._whole, self._arrays, self._parts = whole, arrays, parts
        self.layout: StepLayout | None = (layout := whole.only(parts))
        self.identity = identity
        self.episode_lengths, self.breaks = arrays["episode_length"], arrays["break"]
        self.open_ends = self.breaks[~arrays["next_known"]]
        self._nest_state = layout.nest_state
        self._state = [(arrays[leaf.name], arrays[f"next_{leaf.name}"]) for leaf in layout.state]
        self._columns: dict[str, Any] = {field: arrays[name] for field, name in _PLAIN.items()}
        self._columns["states"] = layout.nest_state([array for array, _ in self._state])
        self._columns["actions"] = layout.nest_action([arrays[leaf.name] for leaf in layout.action])
        self._columns["rewards"] = layout.nest_reward([arrays[leaf.name] for leaf in layout.reward])

    def __len__(self) -> int:
        return len(self._columns["terminals"])

    def __repr__(self) -> str:
        return f"<{plural(len(self), 'step')} of {plural(len(self.episode_lengths), 'episode')}>"

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        return {
            field: self._next_states(rows) if field == "next_states" else pick(self._columns[field], rows)
            for field in checked_fields(fields)
        }

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        return {
            field: self._next_states(rows_of_runs(starts, length))
            if field == "next_states"
            else pick_runs(self._columns[field], starts, length)
            for field in checked_fields(fields)
        }

    def _next_states(self, rows: Array) -> Any:
        """The state of the step after each; after a break, the next state that was saved for it."""
        places = np.minimum(self.breaks.searchsorted(rows), len(self.breaks) - 1)
        broken = self.breaks[places] == rows
        after, places = np.where(broken, rows, rows + 1), places[broken]
        leaves = []
        for states, next_states in self._state:
            leaf = states.take(after, axis=0)
            leaf[broken] = next_states.take(places, axis=0)
            leaves.append(leaf)
        return self._nest_state(leaves)

    def only(self, parts: Sequence[str]) -> SavedSteps:
        return SavedSteps(self._directory, self._whole, self.identity, self._arrays, parts)

    def blocks(self, rows: Array) -> Array:
        return rows // _BLOCK

    def limit(self, cache_bytes: int, threads: int) -> None:
        """Does nothing: the system keeps mapped files as it has room."""

    def __reduce__(self) -> tuple[Callable[..., Steps], tuple[Path, str, Sequence[str]]]:
        return _opened_again, (self._directory, self.identity, self._parts)


def open_columns(directory: str | os.PathLike[str]) -> SavedColumns:
    """The columns that `save_columns` of a dataset wrote to a directory, mapped into memory and read-only.

    Nothing in the files is executed, and all sizes are checked.

    Raises:
        DatasetError: the directory is no path.
        StorageError: there are no columns, or the system refuses.
        FormatError: a file is missing, or is no file of saved columns.
    """
    place = _path_of(directory)
    with os_errors("columns cannot be read from", place):
        manifest = _read_manifest(place / _MANIFEST)
        try:
            layout = StepLayout.from_metadata(manifest.spaces)
        except FormatError as err:
            raise _defect(place / _MANIFEST, "spaces", str(err)) from err
        if not layout.constant:
            raise _defect(place / _MANIFEST, "spaces of values of a fixed size", "others")
        arrays = {
            name: _mapped(place / _file_name(name), *known) for name, known in _plan(layout, manifest).items()
        }
    _check_episodes(place, arrays, manifest.steps)
    return SavedColumns(place, manifest, SavedSteps(place, layout, manifest.identity, arrays))


def _path_of(directory: object) -> Path:
    if not isinstance(directory, str | os.PathLike):
        raise DatasetError(f"expected the path of a directory of columns, found {directory!r:.80}")
    return Path(directory)


def _read_manifest(path: Path) -> _Manifest:
    if not path.is_file():
        raise StorageError(f"{path.parent} holds no columns; write them with dataset.save_columns(...)")
    try:
        return _Manifest.model_validate_json(read_bytes(path))
    except ValidationError as err:
        raise _defect(path, "a manifest of columns, version 1", first_defect(err)) from err


def _mapped(path: Path, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """The array of a `.npy` file, which must fill the file exactly."""
    if not path.is_file():
        raise _defect(path, "a file", "none")
    try:
        array = np.lib.format.open_memmap(path, mode="r")  # never unpickles, unlike np.load
    except _BROKEN as err:
        raise _defect(path, f"a .npy file of {dtype.name} of shape {shape}", str(err)) from err
    size = path.stat().st_size
    expected = (dtype, shape, True, math.prod(shape) * dtype.itemsize)
    if (array.dtype, array.shape, array.flags.c_contiguous, size - array.offset) != expected:
        raise _defect(
            path,
            f"{dtype.name} of shape {shape} in C order, and nothing after it",
            f"{array.dtype} of shape {array.shape} in a file of {size} bytes",
        )
    return np.asarray(array)


def _check_episodes(directory: Path, arrays: Mapping[str, Array], steps: int) -> None:
    """Raises FormatError unless lengths and breaks fit the steps; the columns themselves are not read."""
    lengths, breaks = arrays["episode_length"], arrays["break"]
    if lengths.sum() != steps:
        raise _defect(directory / "episode_length.npy", f"{steps} steps of all episodes", "others")
    ends = np.cumsum(lengths[lengths > 0]) - 1
    if breaks[0] < 0 or (breaks[1:] <= breaks[:-1]).any() or breaks[-1] >= steps:
        raise _defect(directory / "break.npy", f"numbers of steps that ascend to {steps - 1}", "others")
    if not np.isin(ends, breaks).all():
        raise _defect(directory / "episode_length.npy", "episodes that end at a break", "others")


def _opened_again(directory: Path, identity: str, parts: Sequence[str]) -> Steps:
    steps = open_columns(directory).steps
    if steps.identity != identity:
        raise StorageError(f"expected the columns that {directory} held before, found others; open them anew")
    return steps.only(parts)


def _defect(path: Path, expected: str, found: str) -> FormatError:
    return FormatError(f"{path}: expected {expected}, found {found:.200}; save the columns anew")
