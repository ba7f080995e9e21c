"""Datasets: a lazy query over recorded episodes, and the arrays it yields."""

from tupli_mcap.dataset.curate import FilterReport, filter_recording
from tupli_mcap.dataset.dataset import TupliDataset
from tupli_mcap.dataset.parsers import (
    BaseTupleParser,
    NumpyTupleParser,
    TensorflowTupleParser,
    TorchTupleParser,
)
from tupli_mcap.dataset.saved import SavedColumns, open_columns
from tupli_mcap.dataset.sources import DatasetError

__all__ = [
    "BaseTupleParser",
    "DatasetError",
    "FilterReport",
    "NumpyTupleParser",
    "SavedColumns",
    "TensorflowTupleParser",
    "TorchTupleParser",
    "TupliDataset",
    "filter_recording",
    "open_columns",
]
