"""The rows of recordings by kind: steps, images of a leaf, final states; for recordings of one or several layouts."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from tupli_mcap.dataset.items.gather import TIME, Column, ConstantRows, DecodedRows, RowFormat, Rows
from tupli_mcap.dataset.items.index import StepIndex
from tupli_mcap.dataset.items.segments import Segments
from tupli_mcap.messages.batches import BatchDecoder, Decode
from tupli_mcap.messages.shared_dtypes import common_dtype
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["EPISODE", "final_rows", "image_rows", "step_rows"]

EPISODE = "episode"  # the column of the number that a final state says its episode has
_BOOL, _U32, _U64 = np.dtype(np.bool_), np.dtype(np.uint32), np.dtype(np.uint64)
_Format = tuple[Any, dict[str, str], Leaf | None]


def step_rows(index: StepIndex) -> Rows:
    """The leaves of steps that are no images, "terminal", "timeout" and `TIME`."""
    columns = {leaf.name: _column(index, leaf) for leaf in index.layouts[0].leaves}
    columns = {name: column for name, column in columns.items() if name not in index.images}
    columns |= {"terminal": Column((), _BOOL), "timeout": Column((), _BOOL), TIME: Column((), _U64)}
    if not index.layouts[0].constant:
        return _decoded(index, lambda layout: BatchDecoder(layout).steps, columns, index.steps)
    return _constant(
        index, lambda layout: (layout.step_message.dtype, _fields(index, layout), None), columns, index.steps
    )


def image_rows(index: StepIndex, name: str) -> Rows:
    """A leaf of the state (ROS name in the first layout) that is an image in one of the layouts."""
    (leaf,) = (leaf for leaf in index.layouts[0].state if leaf.name == name)

    def of_layout(layout: StepLayout) -> _Format:
        own = _fields(index, layout)[name]
        if own in layout.image_messages:
            turned = next((one for one in layout.images if one.name == own and one.frames_last), None)
            return layout.image_messages[own].dtype, {name: "data"}, turned
        return layout.step_message.dtype, {name: own}, None

    return _constant(index, of_layout, {name: _column(index, leaf)}, index.images[name])


def final_rows(index: StepIndex) -> Rows:
    """The leaves of final states, and `EPISODE`."""

    columns = {leaf.name: _column(index, leaf) for leaf in index.layouts[0].state} | {
        EPISODE: Column((), _U32)
    }
    if not index.layouts[0].constant:
        return _decoded(index, lambda layout: BatchDecoder(layout).finals, columns, index.finals)
    return _constant(
        index,
        lambda layout: (layout.final_message.dtype, _fields(index, layout), None),
        columns,
        index.finals,
    )


def _column(index: StepIndex, leaf: Leaf) -> Column:
    """A leaf of the first layout, in a dtype that holds the values of all layouts."""
    if leaf.kind == "variable":
        return Column((), None)
    dtype = index.layouts[0].dtypes[leaf.name]
    for layout in index.layouts[1:]:
        (other,) = (other for other in layout.leaves if other.path == leaf.path)
        dtype = common_dtype(dtype, layout.dtypes[other.name]) or dtype
    return Column(leaf.shape, dtype)


def _fields(index: StepIndex, layout: StepLayout) -> dict[str, str]:
    """ROS names in the first layout, and in another."""
    names = {leaf.path: leaf.name for leaf in layout.leaves}
    return {leaf.name: names[leaf.path] for leaf in index.layouts[0].leaves}


def _constant(
    index: StepIndex,
    of_layout: Callable[[StepLayout], _Format],
    columns: dict[str, Column],
    segments: Segments,
) -> Rows:
    """Rows of constant size; `of_layout` gives what a `RowFormat` has beside the store."""
    found = [of_layout(layout) for layout in index.layouts]
    files = zip(index.stores, index.layout_of, strict=True)
    return ConstantRows(segments, [RowFormat(store, *found[i]) for store, i in files], columns)


def _decoded(
    index: StepIndex,
    of_layout: Callable[[StepLayout], Decode],
    columns: dict[str, Column],
    segments: Segments,
) -> Rows:
    """Rows of variable size; `of_layout` gives what decodes messages."""

    def renamed(layout: StepLayout) -> Decode:
        decode, fields = of_layout(layout), _fields(index, layout)
        if all(mine == own for mine, own in fields.items()):
            return decode
        mine_of = {own: mine for mine, own in fields.items()}

        def decode_renamed(data: Any, records: Any, names: Collection[str]) -> dict[str, Any]:
            found = decode(data, records, [fields.get(name, name) for name in names])
            return {mine_of.get(name, name): values for name, values in found.items()}

        return decode_renamed

    found = [renamed(layout) for layout in index.layouts]
    return DecodedRows(segments, index.stores, [found[i] for i in index.layout_of], columns)
