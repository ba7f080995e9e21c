"""Column files: `.npy` arrays written row after row, and mapped into memory; each file has its SHA-256."""

from __future__ import annotations

import hashlib
import io
import mmap
import os
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.materialized.manifest import FileEntry
from tupli_mcap.materialized.plan import Array
from tupli_mcap.recording.source import open_regular
from tupli_mcap.system import refused

__all__ = ["BytesWriter", "ColumnWriter", "map_array", "map_bytes", "sha256_of"]

_MOST_HEADER = 4096
_BUFFER = 1 << 16  # of each of perhaps hundreds of files


class BytesWriter:
    """Writes one file; `finish` gives what the manifest says of it. OSError where the system refuses."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=_BUFFER)
        self._digest = hashlib.sha256()
        self._size = 0

    def write(self, data: Any) -> None:
        """Appends bytes, or what has them."""
        self._file.write(data)
        self._digest.update(data)
        self._size += memoryview(data).nbytes

    def finish(self) -> FileEntry:
        """Closes the file; it is whole, but not on the disk yet."""
        self._file.close()
        return self._entry("|u1", (self._size,))

    def _entry(self, dtype: str, shape: tuple[int, ...]) -> FileEntry:
        return FileEntry(dtype=dtype, shape=shape, size=self._size, sha256=self._digest.hexdigest())

    def close(self) -> None:
        """Gives the file up."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class ColumnWriter(BytesWriter):
    """Writes one `.npy` file (C order) of a dtype and shape that are known before its rows are."""

    def __init__(self, path: Path, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        super().__init__(path)
        self._dtype, self._shape, self._rows = dtype, shape, 0
        header = io.BytesIO()
        fields = {"descr": dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, fields)
        self.write(header.getvalue())

    def put(self, rows: Array) -> None:
        """Appends rows, cast to the column's dtype, which holds their values exactly."""
        if rows.size:
            array = np.ascontiguousarray(rows, self._dtype)
            self.write(array.reshape(-1).view(np.uint8))
        self._rows += len(rows)

    def finish(self) -> FileEntry:
        if self._rows != self._shape[0]:
            raise StorageError(f"expected {self._shape[0]} rows of a column, found {self._rows}")
        super().finish()
        return self._entry(self._dtype.str, self._shape)


def map_array(path: Path, entry: FileEntry, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
    """The array of a `.npy` file, mapped into memory: read-only, and no more than the file holds.

    Raises:
        FormatError: the manifest or the file says something else than `dtype` and `shape`.
        StorageError: the system refuses.
    """
    if entry.dtype != dtype.str or entry.shape != shape:
        raise _other(path, f"{dtype.str} of shape {shape}", f"{entry.dtype} of shape {entry.shape}")
    data = _mapped(path, entry)
    found = _header(data, path)
    header, content = found[0], int(np.prod(shape, dtype=object)) * dtype.itemsize
    if found[1:] != (dtype, shape) or header + content != len(data):
        raise _other(path, f"{dtype.str} of shape {shape} in {len(data)} bytes", f"{found[1]} of {found[2]}")
    return np.ndarray(shape, dtype, data, header)


def map_bytes(path: Path, entry: FileEntry) -> memoryview:
    """The bytes of a file, mapped into memory.

    Raises:
        FormatError: the file has another size.
        StorageError: the system refuses.
    """
    return memoryview(_mapped(path, entry))


def _mapped(path: Path, entry: FileEntry) -> Any:
    try:
        with os.fdopen(open_regular(path), "rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size != entry.size:
                raise _other(path, f"{entry.size} bytes", str(size))
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
    except FileNotFoundError as err:
        raise FormatError(f"{path} is missing") from err
    except OSError as err:
        raise StorageError(f"{path} cannot be read: {refused(err)}") from err


def _header(data: Any, path: Path) -> tuple[int, np.dtype[Any], tuple[int, ...]]:
    """Size of the header, dtype and shape of a `.npy` file; nothing in it is executed."""
    file = io.BytesIO(bytes(data[:_MOST_HEADER]))
    try:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError("another version of .npy")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as err:
        raise FormatError(f"{path}: expected a .npy file, found another ({err!s:.100})") from err
    if fortran or dtype.hasobject:
        raise _other(path, "an array of numbers in C order", f"{dtype} {'in Fortran order' * fortran}")
    return file.tell(), dtype, shape


def _other(path: Path, expected: str, found: str) -> FormatError:
    return FormatError(f"{path}: expected {expected}, found {found}")


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, as `sha256sum` prints it."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
