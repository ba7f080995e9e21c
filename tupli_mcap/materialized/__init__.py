"""Materialised columns: a directory of plain arrays, one a leaf, that are mapped into memory instead of read."""

from tupli_mcap.materialized.directory import Stage, exclusive, published
from tupli_mcap.materialized.files import BytesWriter, ColumnWriter
from tupli_mcap.materialized.manifest import MANIFEST, FileEntry, Manifest, SourceFile
from tupli_mcap.materialized.opened import OpenedColumns, open_columns
from tupli_mcap.materialized.plan import ColumnPlan

__all__ = [
    "MANIFEST",
    "BytesWriter",
    "ColumnPlan",
    "ColumnWriter",
    "FileEntry",
    "Manifest",
    "OpenedColumns",
    "SourceFile",
    "Stage",
    "exclusive",
    "open_columns",
    "published",
]
