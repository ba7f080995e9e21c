"""Datasets: a lazy query over recorded episodes, and the arrays it yields."""

from tupli_mcap.dataset.curate import FilterReport, filter_recording
from tupli_mcap.dataset.dataset import TupliDataset
from tupli_mcap.dataset.parsers import (
    BaseTupleParser,
    NumpyTupleParser,
    TensorflowTupleParser,
    TorchTupleParser,
)
from tupli_mcap.dataset.sources import DatasetError

__all__ = [
    "BaseTupleParser",
    "DatasetError",
    "FilterReport",
    "NumpyTupleParser",
    "TensorflowTupleParser",
    "TorchTupleParser",
    "TupliDataset",
    "filter_recording",
]
