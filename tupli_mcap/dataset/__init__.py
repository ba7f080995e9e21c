"""Datasets: episodes of files, directories and servers, and the arrays of their steps.

opening            `open`: the dataset of a path, a URL, a storage, ...
dataset            `Dataset`: filters, sorts, reads and saves episodes
tupli, query       `TupliDataset`: PyTupli's interface; its three filters, and the columns read so far
sources            lists and opens episodes
which, chosen      finds those that a word, a number or a filter means: in one recording, in several
keys               the values of episodes at a key
columns/           whole columns: reads and saves them; as tables, and in the forms of other libraries
access, items/     `windows`, `transitions`, and samples of them; reads steps by number
curate, display    writes a recording of fewer episodes; shows datasets as text and HTML
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
    from tupli_mcap.dataset.curate import FilterReport, filter_recording, merge_recordings, split_recording
    from tupli_mcap.dataset.dataset import Dataset
    from tupli_mcap.dataset.opening import open
    from tupli_mcap.dataset.sources import DatasetError
    from tupli_mcap.dataset.tupli import TupliDataset

# Imported on first use: a process that only reads items, such as a worker of a DataLoader, needs no storage.
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
    "merge_recordings": "curate",
    "open": "opening",
    "open_columns": "columns.saved",
    "split_recording": "curate",
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
    "merge_recordings",
    "open",
    "open_columns",
    "split_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
