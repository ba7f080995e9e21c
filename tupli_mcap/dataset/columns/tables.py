"""Datasets as tables of pandas or Arrow: one row per step, or one per episode."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array, are_floats
from tupli_mcap.dataset.columns.convert import import_pandas
from tupli_mcap.dataset.sources import DatasetError, Episodes
from tupli_mcap.errors import missing_extra
from tupli_mcap.messages.infos import columns_in
from tupli_mcap.recording.columns.fields import FIVE
from tupli_mcap.schema.keys import leaves_of, name_within
from tupli_mcap.schema.times import time_ns
from tupli_mcap.spaces.labels import common_labels, distinct, element_names

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

    from tupli_mcap.schema import EpisodeHeader
    from tupli_mcap.spaces.labels import Labels
    from tupli_mcap.spaces.leaves import Leaf

Level: TypeAlias = Literal["steps", "episodes"]
_MOST_COLUMNS = 500  # of one array: a depth image in a column for each pixel is of no use to anybody
_NAT = -(2**63)  # as datetime64 has it
_REAL = (int, float, np.integer, np.floating)


def dataframe(dataset: Episodes, level: Level, *, frames: bool) -> pd.DataFrame:
    """See `Dataset.to_pandas`."""
    return import_pandas().DataFrame(_columns(dataset, level, frames=frames))


def _columns(dataset: Episodes, level: Level, *, frames: bool) -> dict[str, Any]:
    """Columns that pandas takes; lists and masked arrays say what is missing, where a DataFrame has NaN."""
    if level == "episodes":
        if frames:
            raise DatasetError("expected the level 'steps' for frames, found 'episodes'")
        return _episode_columns(dataset.headers)
    if level != "steps":
        raise DatasetError(f"expected the level 'steps' or 'episodes', found {level!r:.80}")
    columns = _step_columns(dataset)
    return {**columns, "frames": list(dataset.read(("frames",)).frames)} if frames else columns


def arrow(dataset: Episodes, level: Level, *, frames: bool) -> pa.Table:
    """See `Dataset.to_arrow`."""
    try:
        import pandas
        import pyarrow
    except ImportError as err:
        raise missing_extra("an Arrow table needs pandas and pyarrow", "arrow") from err
    columns = _columns(dataset, level, frames=frames)
    frame = pandas.DataFrame(columns)
    typed = {}
    for name, column in columns.items():
        dtype = frame[name].dtype
        if dtype.kind in "Oc" or dtype.itemsize > 8:  # Arrow has no complex numbers, and no longer floats
            listed = column if isinstance(column, list) else frame[name]
            typed[name] = _arrow_column(list(listed), pyarrow, is_pandas=listed is not column)
            frame[name] = None
        elif dtype.kind == "f":
            typed[name] = pyarrow.array(column)
    table = pyarrow.Table.from_pandas(frame, preserve_index=False)
    for name, column in typed.items():
        table = table.set_column(table.schema.get_field_index(name), name, column)
    return table


def _arrow_column(values: Sequence[Any], pyarrow: Any, *, is_pandas: bool) -> Any:
    """Values as Arrow has them: arrays as lists of their dtype, and what has no common type as texts of JSON. NaN is
    what is missing if they are pandas'."""
    kind, arrays = None, [value for value in values if isinstance(value, np.ndarray)]
    kinds = {(value.dtype, value.ndim) for value in arrays}
    if len(arrays) == len(values) and len(kinds) == 1:
        ((dtype, ndim),) = kinds
        with contextlib.suppress(pyarrow.ArrowNotImplementedError):  # complex numbers
            kind = pyarrow.from_numpy_dtype(dtype)
            for _ in range(ndim):
                kind = pyarrow.list_(kind)
    listed = [value.tolist() if isinstance(value, np.ndarray) else value for value in values]
    try:
        return pyarrow.array(listed, kind, from_pandas=is_pandas)
    except (pyarrow.ArrowException, OverflowError, UnicodeEncodeError):  # numbers beside texts, say
        return pyarrow.array([None if value is None else jsonvalue.dumps_plain(value) for value in values])


def _episode_columns(headers: Sequence[EpisodeHeader]) -> dict[str, Any]:
    columns: dict[str, Any] = {
        "id": [header.id for header in headers],
        "episode": np.arange(len(headers)),  # as in the table of steps
        "run": _texts([header.run.get("name", "") for header in headers]),
        "run.split": _texts([header.run.get("split", "") for header in headers]),
        "run.environment": _texts([header.run.get("environment", "") for header in headers]),
        "recording": _texts([header.recording for header in headers]),
        "number": np.array([header.episode for header in headers], np.int64),
        "env": np.array([header.env for header in headers], np.int64),
        "steps": np.array([header.n_tuples for header in headers], np.int64),
        "return": np.array([header.episode_return for header in headers], np.float64),  # None becomes NaN
        "end": [header.end for header in headers],
        "seed": _whole_numbers([header.seed for header in headers]),
        "ended": _times([header.created_at for header in headers]),
        "benchmark_id": [header.benchmark_id for header in headers],
        "run.id": [header.run.get("id", "") for header in headers],
        "run.started": _times([header.run.get("started", "") for header in headers]),
        "run.tags": [list(header.run.get("tags", ())) for header in headers],
    }
    columns |= _columns_of("run.metadata", [header.run.get("metadata", {}) for header in headers])
    return columns | _columns_of("metadata", [header.metadata for header in headers])


def _times(texts: Sequence[str]) -> Any:
    """Times (ISO 8601) for pandas, NaT for a text that is no time, or one before 1678 or after 2261: 64 bits of
    nanoseconds hold no others."""
    found = [time_ns(text) for text in texts]
    known = [ns if ns is not None and abs(ns) < 2**63 else _NAT for ns in found]
    return _in_utc(np.array(known, np.int64).view("datetime64[ns]"))


def _in_utc(times: Any) -> Any:
    return import_pandas().DatetimeIndex(times).tz_localize("UTC")


def _whole_numbers(values: Sequence[int | None]) -> Any:
    """Integers, some of which are None; floats would lose digits."""
    fits = all(value is None or -(2**63) <= value < 2**63 for value in values)
    return (
        import_pandas().array(values, dtype="Int64") if fits else import_pandas().Series(values, dtype=object)
    )


def _columns_of(root: str, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A column for each leaf of any item, named as in filters (`metadata.opt.lr`), with None for items without it."""
    once = {id(item): item for item in items}  # the episodes of a run share its metadata
    leaves = {key: dict(leaves_of(item)) for key, item in once.items()}
    paths = dict.fromkeys(path for own in leaves.values() for path in own)
    return {
        name_within(root, *path): _column([leaves[id(item)].get(path) for item in items]) for path in paths
    }


def _column(values: list[Any]) -> Any:
    """Values, None where there is none, as a column that tells what is missing from NaN."""
    given = [value for value in values if value is not None]
    numbers = all(isinstance(value, _REAL) and not isinstance(value, bool) for value in given)
    if numbers and any(isinstance(value, float | np.floating) for value in given):
        return _floats(values)
    if numbers and len(given) < len(values):
        return _whole_numbers(values)
    if len(given) < len(values) and all(isinstance(value, bool | np.bool_) for value in given):
        return import_pandas().array(values, dtype="boolean")
    # pandas would make a complex number of None
    if len(given) < len(values) and any(isinstance(value, complex | np.complexfloating) for value in given):
        return import_pandas().Series(values, dtype=object)
    return _texts(values)


def _with_gaps(values: Array) -> Any:
    """An array; with pandas' nullable dtype if it is one of integers or flags that some steps lack."""
    if not isinstance(values, np.ma.MaskedArray) or values.dtype.kind == "f":
        return values
    column = import_pandas().array(values.filled(0))
    column[np.ma.getmaskarray(values)] = import_pandas().NA
    return column


def _floats(values: Sequence[Any]) -> Any:
    """Numbers, some of which may be None: as a masked array, which tells them from NaN, if floats hold them exactly."""
    numbers = np.array([np.nan if value is None else value for value in values])
    given = [np.asarray(value) for value in values if value is not None]
    if numbers.dtype.kind != "f" or not are_floats(given):
        return import_pandas().Series(values, dtype=object)
    return np.ma.masked_array(numbers, [value is None for value in values])


def _texts(values: Sequence[Any]) -> Any:
    """Values, some of which may be texts: as objects if one has a lone surrogate, since pandas keeps texts as UTF-8. A
    file's name has one for each byte that is no UTF-8."""
    try:
        "".join(value for value in values if isinstance(value, str)).encode()
    except UnicodeEncodeError:
        return import_pandas().Series(values, dtype=object)
    return values


def _step_columns(dataset: Episodes) -> dict[str, Any]:
    found = dataset.read((*FIVE, "times", "infos"))
    lengths = found.episode_lengths
    columns: dict[str, Any] = {
        "episode": np.repeat(np.arange(len(lengths)), lengths),
        "step": dataset.step_numbers,
        "time": _in_utc(found.times.astype("datetime64[ns]")),
    }
    recording = dataset.example
    if recording is not None:
        own = {name: opened.labels for name, opened in dataset.opened()}
        labels = common_labels(own or {recording.name: recording.labels})
        columns |= _named(found.states, recording.layout.state, labels)
        columns |= _named(found.actions, recording.layout.action, labels)
        columns |= _named(found.rewards, recording.layout.reward, labels)
    columns |= {"terminal": found.terminals, "timeout": found.timeouts}
    for _, name, values in columns_in(found.infos, _MOST_COLUMNS):
        columns[name] = _with_gaps(values) if isinstance(values, np.ndarray) else _column(values)
    there = np.flatnonzero(lengths)  # `filter_steps` may leave none of an episode
    of_there = np.repeat(np.arange(len(there)), lengths[there])
    episodes = _episode_columns([dataset.headers[i] for i in there.tolist()])
    repeated = {"id", "run", "env", "seed", *(key for key in episodes if key.startswith("metadata."))}
    for key in episodes:
        if key in repeated:
            values = episodes[key]
            if isinstance(values, np.ndarray):
                columns[key] = values[of_there]
            else:
                columns[key] = import_pandas().Series(values).iloc[of_there].reset_index(drop=True)
    return columns


def _named(column: Any, leaves: Sequence[Leaf], labels: Labels) -> Mapping[str, Any]:
    """A column for each element of each leaf; one of objects for images, large arrays, and values of variable size."""
    columns: list[tuple[str, Any]] = []
    for leaf in leaves:
        values = leaf.get(column)
        if isinstance(values, list) or leaf.apart or leaf.size > _MOST_COLUMNS:
            columns.append((leaf.path, _texts(list(values))))
            continue
        flat = values.reshape(len(values), leaf.size)
        own = f"{leaf.root}." if not leaf.keys and leaf.path in labels.dimensions else ""
        columns += [(own + name, flat[:, i]) for i, name in enumerate(element_names(leaf, labels))]
    names = distinct([name for name, _ in columns])
    return {name: values for name, (_, values) in zip(names, columns, strict=True)}
