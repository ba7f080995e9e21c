"""Datasets: episodes of files, directories and servers, and the arrays of their steps.

opening            `open`: the dataset of a path, a URL, a storage, ...
dataset            `Dataset`: filters, sorts, reads and saves episodes
tupli              `TupliDataset`: PyTupli's interface, which keeps the columns read so far
sources            lists and opens episodes
which, chosen      finds those that a word, a number or a filter means: in one recording, in several
keys               the values of episodes at a key
columns/           whole columns: reads and saves them; as tables, and in the forms of other libraries
access, items/     `windows`, `transitions`, and samples of them; reads steps by number
curate, display    writes a recording of fewer episodes, deletes episodes; shows datasets as text and HTML
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tupli_mcap.lazy import imported_on_use

if TYPE_CHECKING:
    from tupli_mcap.dataset.columns.convert import (
        BaseTupleParser,
        NumpyTupleParser,
        TensorflowTupleParser,
        TorchTupleParser,
    )
    from tupli_mcap.dataset.columns.saved import SavedColumns, open_columns
    from tupli_mcap.dataset.curate import (
        merge_recordings,
        recover_recording,
        restore_episodes,
        split_recording,
    )
    from tupli_mcap.dataset.dataset import Dataset
    from tupli_mcap.dataset.opening import open
    from tupli_mcap.dataset.sources import DatasetError
    from tupli_mcap.dataset.tupli import TupliDataset

# Imported on first use: a process that only reads items, such as a worker of a DataLoader, needs no storage.
__getattr__ = imported_on_use(
    globals(),
    {
        "columns.convert": "BaseTupleParser NumpyTupleParser TensorflowTupleParser TorchTupleParser",
        "columns.saved": "SavedColumns open_columns",
        "curate": "merge_recordings recover_recording restore_episodes split_recording",
        "dataset": "Dataset",
        "opening": "open",
        "sources": "DatasetError",
        "tupli": "TupliDataset",
    },
)

__all__ = [
    "BaseTupleParser",
    "Dataset",
    "DatasetError",
    "NumpyTupleParser",
    "SavedColumns",
    "TensorflowTupleParser",
    "TorchTupleParser",
    "TupliDataset",
    "merge_recordings",
    "open",
    "open_columns",
    "recover_recording",
    "restore_episodes",
    "split_recording",
]
