"""Power losses: syncs file and journal, and tells torn rows of a journal from whole ones.

If a process is killed, the kernel still has all pages of its journal. If the kernel goes down, pages it has not written
are lost, in any order and in parts. The journal names the boot it was made in: after another boot, only rows count that
are known to be whole.
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from pathlib import Path
from typing import Any, Literal, get_args

from tupli_mcap import files
from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.mcap.records import BODY

Durability = Literal["os", "chunk", "step"]
SECTOR = 512  # bytes a disk writes as one
_SEAL = struct.Struct("<II")
_SEAL_START, _SEAL_END = 23, 31  # the place of `publish_time`, which is derived when a row goes to a chunk
STATE = BODY + 8  # offset of the state in a step's record


def check_durability(value: Any) -> None:
    """Raises RecordingError unless it is one of the settings."""
    if value not in get_args(Durability):
        raise RecordingError(f"durability: expected one of {list(get_args(Durability))}, found {value!r:.80}")


def boot_id() -> str:
    """A text that differs for each boot of each machine; empty if the system has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def checksum(record: bytes | bytearray | memoryview) -> int:
    """CRC-32 of a Message record without its `publish_time`."""
    view = memoryview(record)
    return zlib.crc32(view[_SEAL_END:], zlib.crc32(view[:_SEAL_START]))


def seal(view: bytearray | memoryview, start: int, end: int, running: bytes | bytearray | memoryview) -> None:
    """Writes the checksums of a record, and of the state that follows its step, in place of `publish_time`."""
    whole = checksum(memoryview(view)[start:end])
    _SEAL.pack_into(view, start + _SEAL_START, whole, zlib.crc32(running))


def seal_of(view: bytes | memoryview, start: int) -> tuple[int, int]:
    """The two checksums of the record at `start`."""
    whole, running = _SEAL.unpack_from(view, start + _SEAL_START)
    return whole, running


def sync_file(fd: int, name: str) -> None:
    """Waits until the file's data and size are on the disk.

    Raises:
        RecordingError: the disk refused; how much it has is unknown.
    """
    try:
        if hasattr(fcntl, "F_FULLFSYNC"):  # macOS: its fsync stops at the drive's cache
            fcntl.fcntl(fd, fcntl.F_FULLFSYNC)
        elif hasattr(os, "fdatasync"):
            os.fdatasync(fd)
        else:
            os.fsync(fd)
    except OSError as err:
        raise RecordingError(f"{name}: could not be synced to the disk: {os_reason(err)}") from err


def sync_directory(path: Path) -> None:
    """Waits until the names in a directory are on the disk.

    Raises:
        RecordingError: the disk refused.
    """
    try:
        files.sync(path)
    except OSError as err:
        raise RecordingError(f"{path}: could not be synced to the disk: {os_reason(err)}") from err
