"""Datasets: episodes, wherever they lie, and the arrays they are.

dataset            `open` and `Dataset`: narrowed, put in order, read, handed on
tupli, query       `TupliDataset`: PyTupli's, with three filters, and what has been read so far
sources, which     where episodes come from; which of them a word, a number or a filter means
load               from episodes to whole columns; tuple filters
statistics, tables what values are like; pandas and Arrow
tuples, convert    columns as steps and episodes; as what other libraries expect
access, items/     `windows`, `transitions`, and samples of them; how they read steps by number
saved              columns as a directory of `.npy` files
curate, display    a recording of fewer episodes; datasets as text and HTML
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tupli_mcap.dataset.convert import (
        BaseTupleParser,
        NumpyTupleParser,
        TensorflowTupleParser,
        TorchTupleParser,
    )
    from tupli_mcap.dataset.curate import FilterReport, filter_recording
    from tupli_mcap.dataset.dataset import Dataset, open
    from tupli_mcap.dataset.saved import SavedColumns, open_columns
    from tupli_mcap.dataset.sources import DatasetError
    from tupli_mcap.dataset.tupli import TupliDataset

# Imported on first use: who only reads items, as a worker of a DataLoader does, needs no storage.
_HOMES = {
    "BaseTupleParser": "convert",
    "Dataset": "dataset",
    "DatasetError": "sources",
    "FilterReport": "curate",
    "NumpyTupleParser": "convert",
    "SavedColumns": "saved",
    "TensorflowTupleParser": "convert",
    "TorchTupleParser": "convert",
    "TupliDataset": "tupli",
    "filter_recording": "curate",
    "open": "dataset",
    "open_columns": "saved",
}

__all__ = [
    "BaseTupleParser",
    "Dataset",
    "DatasetError",
    "FilterReport",
    "NumpyTupleParser",
    "SavedColumns",
    "TensorflowTupleParser",
    "TorchTupleParser",
    "TupliDataset",
    "filter_recording",
    "open",
    "open_columns",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
