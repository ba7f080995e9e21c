"""Datasets: episodes, wherever they lie, and the arrays they are.

opening            `open`: the dataset of a path, a URL, a storage, ...
dataset            `Dataset`: episodes narrowed, put in order, read, handed on
tupli, query       `TupliDataset`: PyTupli's, with three filters, and what has been read so far
sources, which     where episodes come from; which of them a word, a number or a filter means
keys               the values that episodes have at a key
columns/           whole columns: read, saved, as tables and as what other libraries expect
access, items/     `windows`, `transitions`, and samples of them; how they read steps by number
curate, display    a recording of fewer episodes; datasets as text and HTML
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tupli_mcap.dataset.columns.convert import (
        BaseTupleParser,
        NumpyTupleParser,
        TensorflowTupleParser,
        TorchTupleParser,
    )
    from tupli_mcap.dataset.columns.saved import SavedColumns, open_columns
    from tupli_mcap.dataset.curate import FilterReport, filter_recording
    from tupli_mcap.dataset.dataset import Dataset
    from tupli_mcap.dataset.opening import open
    from tupli_mcap.dataset.sources import DatasetError
    from tupli_mcap.dataset.tupli import TupliDataset

# Imported on first use: who only reads items, as a worker of a DataLoader does, needs no storage.
_HOMES = {
    "BaseTupleParser": "columns.convert",
    "Dataset": "dataset",
    "DatasetError": "sources",
    "FilterReport": "curate",
    "NumpyTupleParser": "columns.convert",
    "SavedColumns": "columns.saved",
    "TensorflowTupleParser": "columns.convert",
    "TorchTupleParser": "columns.convert",
    "TupliDataset": "tupli",
    "filter_recording": "curate",
    "open": "opening",
    "open_columns": "columns.saved",
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
