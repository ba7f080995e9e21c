"""The journal: a memory-mapped file beside the recording that holds every step not yet in a chunk.

Its pages belong to the file, so they outlive a killed process. The first page describes the areas as JSON; the areas
follow, page-aligned. Two kinds of area exist:

`RowArea`: two halves of constant-size rows, each with one spare row, for each of its channels.
`LogArea`: one or two halves of variable-size Message records behind a committed end offset.

Not thread-safe; one writer.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import mmap
import os
import re
import struct
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar
from uuid import uuid4

import numpy as np

from tupli_mcap import files
from tupli_mcap.errors import FormatError, RecordingError, os_reason, warn
from tupli_mcap.mcap.source import open_regular

MAGIC = b"TMCAPJ1\0"
EVENT_AREAS = "events", "info"
FRAMES_AREA = "frames/"  # followed by the sub-environment; no leaf has such a name
_HEAD = struct.Struct("<8sII")
PAGE = 4096
LOG_HEADER = 64  # bytes of a log's half before its records
_MAX_HEADER = 64 << 20
_PIECE = 1 << 20
# Bytes from which a new journal is written with zeros once, so that the system does not add its pages one by one. A
# short recording touches only a few pages of a smaller one.
_WORTH_ZEROS = 2 << 20
_UUID = re.compile("[0-9a-f]{32}")


def journal_path(path: str | os.PathLike[str]) -> Path:
    """The path of a recording's journal beside it, symbolic links followed. With `journal_dir`, it is in that
    directory instead."""
    path = Path(os.path.realpath(path))
    return path.parent / journal_name(path.name)


def journal_name(name: str) -> str:
    """The file name of the journal of the recording with the file name `name`."""
    return f"{name}.journal"


def journal_in(directory: str | os.PathLike[str], path: Path, uuid: str) -> Path:
    """The path of a recording's journal in a directory that recordings of the same name may share."""
    return Path(directory) / f"{path.name}.{uuid}.journal"


def recorded_journal(path: Path, metadata: Mapping[str, str]) -> Path:
    """The path of a recording's journal: beside it, or where its metadata say. FormatError if the metadata name a path
    that no writer chooses. A stranger's recording must not name any file."""
    if "journal" not in metadata:
        return journal_path(path)
    place, ending = Path(metadata["journal"]), f".{metadata.get('uuid')}.journal"
    if not place.is_absolute() or not place.name.endswith(ending) or "\0" in str(place):
        raise FormatError(
            f"{path}: expected its journal at an absolute path that ends in {ending}, found {str(place)!r:.200}; "
            "recover it into a new file"
        )
    return place


class RowArea(NamedTuple):
    """Two halves, each with `rows` rows of `row_size` bytes and a spare row for every one of `channels` channels."""

    name: str
    row_size: int
    rows: int
    channels: int = 1

    @property
    def block(self) -> int:
        """Bytes of one channel's rows in one half."""
        return (self.rows + 1) * self.row_size

    @property
    def half(self) -> int:
        return self.block * self.channels

    @property
    def size(self) -> int:
        return 2 * self.half


class LogArea(NamedTuple):
    """`halves` x `capacity` bytes of Message records; each half starts with its committed end (u64, 64 bytes)."""

    name: str
    capacity: int
    halves: int = 1

    @property
    def half(self) -> int:
        return LOG_HEADER + self.capacity

    @property
    def size(self) -> int:
        return self.halves * self.half


Area = RowArea | LogArea
A = TypeVar("A", RowArea, LogArea)


def _aligned(n: int) -> int:
    return -(-n // PAGE) * PAGE


class Journal:
    """A journal being written. It replaces an earlier one with `publish`, once it holds all that one held."""

    def __init__(self, path: Path, areas: list[Area], info: Mapping[str, Any]) -> None:
        self.path = path
        self.areas = {area.name: area for area in areas}
        self.info = dict(info)
        kinds = {RowArea: "rows", LogArea: "log"}
        described = [{"kind": kinds[type(area)], **area._asdict()} for area in areas]
        text = json.dumps({"info": self.info, "areas": described}).encode()
        header = _HEAD.pack(MAGIC, len(text), zlib.crc32(text)) + text
        self.offsets, size = _place(areas, len(header))
        self._temporary = temporary = path.with_name(path.name + ".tmp")
        try:
            self._map, self._status = _create(temporary, size)
            self._map[: len(header)] = header
        except OSError as err:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise RecordingError(
                f"{path}: could not make the journal of {size} bytes: {os_reason(err)} (journal_dir=)"
            ) from err

    def publish(self, *, durable: bool = False, replaced: str = "") -> None:
        """Renames the journal to its path, in place of this recording's earlier journal. Readers find it from then on.

        With `durable` it is on the disk before its name is. The journal of another recording is renamed, since that
        recording may have been renamed without it, and a warning says to what. `replaced` is the uuid of a recording
        that this one replaces; its journal needs no warning.

        RecordingError if the system refused.
        """
        if durable:
            self.sync()
        try:
            _set_aside(self.path, self.info.get("uuid"), replaced)
            self._temporary.replace(self.path)
        except OSError as err:
            with contextlib.suppress(OSError):
                self._temporary.unlink()
            raise RecordingError(
                f"{self.path}: could not put the journal in place: {os_reason(err)}"
            ) from err
        if durable:
            sync_directory(self.path.parent)

    def buffer(self, name: str) -> memoryview:
        """The bytes of an area."""
        start = self.offsets[name]
        return memoryview(self._map)[start : start + self.areas[name].size]

    def area(self, name: str, kind: type[A]) -> A:
        """The area `name`, of the kind that the caller has planned."""
        area = self.areas[name]
        if not isinstance(area, kind):
            raise TypeError(f"expected the area {name!r} to be a {kind.__name__}, found {area!r}")
        return area

    def sync(self) -> None:
        """Waits until every mapped page that changed is on the disk; RecordingError if the disk refused."""
        try:
            self._map.flush()
        except OSError as err:
            raise RecordingError(
                f"{self.path}: the journal could not be synced to the disk: {os_reason(err)}"
            ) from err

    def close(self) -> None:
        """Unmaps the file, which frees its descriptor, and its space if it was removed.

        If views of it exist, the last one unmaps it.
        """
        with contextlib.suppress(BufferError):
            self._map.close()

    def remove(self) -> None:
        """Removes the file, if its path still names it. Warns if the system refuses: the file is useless by then."""
        for place in (self.path, journal_aside(self.path, str(self.info.get("uuid")))):
            try:
                if os.path.samestat(place.stat(), self._status):
                    place.unlink()
            except OSError as err:
                if err.errno not in (errno.ENOENT, errno.ENAMETOOLONG):  # else it is not there
                    warn(
                        f"{place}: the recording is finished, but its journal cannot be removed "
                        f"({err.strerror}); delete it"
                    )


def journal_aside(path: Path, uuid: str) -> Path:
    """The path to which a recording's journal is renamed if another recording needs its name."""
    return journal_in(path.parent, path.with_name(path.name.removesuffix(".journal")), uuid)


def _set_aside(path: Path, uuid: Any, replaced: str) -> None:
    """Renames a journal that is not that of the recording `uuid`, or that cannot be read. Warns, unless it is that of
    `replaced`."""
    try:
        found, whose = str(journal_info(path).get("uuid")), "was the journal of another recording"
    except OSError:  # there is none
        return
    except FormatError:
        found, whose = uuid4().hex, "could not be read: it may be the journal of another recording,"
    if found == uuid or not _UUID.fullmatch(found):
        return
    kept = journal_aside(path, found)
    path.rename(kept)
    if found == replaced:
        return
    warn(
        f"{path} {whose} and is kept as {kept.name}: if that recording was renamed, "
        "rename its journal accordingly; if it was deleted, delete this too"
    )


def _place(areas: list[Area], header: int) -> tuple[dict[str, int], int]:
    """The offset of each area after a header of `header` bytes, and the offset where the last one ends."""
    offset, offsets = _aligned(header), {}
    for area in areas:
        offsets[area.name] = offset
        offset = _aligned(offset + area.size)
    return offsets, offset


def _create(path: Path, size: int) -> tuple[mmap.mmap, os.stat_result]:
    fd = files.create(path, 0o644)
    try:
        files.hold(fd)  # the map keeps it
        _reserve(fd, size)
        return mmap.mmap(fd, size), os.fstat(fd)
    finally:
        os.close(fd)


def _reserve(fd: int, size: int) -> None:
    """Reserves the space: a write into a hole of a file on a full disk would be a SIGBUS instead of an error."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(fd, 0, size)
        if size < _WORTH_ZEROS:
            return
    block = bytes(1 << 20)  # macOS has no such call; zeros take the space as well
    for start in range(0, size, len(block)):
        os.pwrite(fd, block[: size - start], start)


class JournalContents(NamedTuple):
    """A journal as it is on the disk: its description, and copies of its areas' bytes (uint8)."""

    info: dict[str, Any]
    areas: dict[str, Area]
    data: dict[str, np.ndarray[Any, np.dtype[np.uint8]]]

    def area(self, name: str, kind: type[A]) -> A:
        """The area `name`; raises FormatError if there is none of this kind."""
        area = self.areas.get(name)
        if not isinstance(area, kind):
            what = "rows" if kind is RowArea else "records"
            raise FormatError(f"expected an area of {what} {name!r} in the journal, found none")
        return area

    @property
    def torn(self) -> bool:
        """True if rows in it may be torn: it was made in another boot of this machine, or on another machine."""
        boot, now = self.info.get("boot"), boot_id()
        return bool(boot and now and boot != now)

    @property
    def sealed_records(self) -> bool:
        """True if the records of its logs carry checksums."""
        return self.info.get("seals") in ("records", "rows")

    @property
    def sealed_rows(self) -> bool:
        """True if its rows carry checksums too."""
        return self.info.get("seals") == "rows"


def read_journal(path: Path, only: Collection[str] | None = None) -> JournalContents:
    """Reads a journal and changes nothing. If `only` is given, it reads the areas of these names alone.

    Raises:
        FormatError: the file is no journal, or describes areas it does not have.
        OSError: the file cannot be read.
    """
    with _open(path) as file:
        info, areas, offsets = _read_header(path, file)
        areas = [area for area in areas if only is None or area.name in only]
        data = {area.name: _read_area(file.fileno(), offsets[area.name], area.size) for area in areas}
    return JournalContents(info, {area.name: area for area in areas}, data)


def _read_area(fd: int, start: int, size: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """The bytes of an area. Its size is a claim, and a file may have holes, so zeros must take no memory."""
    area = np.zeros(size, np.uint8)
    for at in range(0, size, _PIECE):
        length = min(_PIECE, size - at)
        piece = np.frombuffer(os.pread(fd, length, start + at), np.uint8)
        if len(piece) != length:
            raise FormatError(f"expected {size} bytes of an area at offset {start}, found {at + len(piece)}")
        if piece.any():
            area[at : at + length] = piece
    return area


def journal_info(path: Path) -> dict[str, Any]:
    """The description in a journal's header; nothing else is read. Raises as `read_journal` does."""
    with _open(path) as file:
        return _read_header(path, file)[0]


def is_journal_of(path: Path, uuid: str) -> bool:
    """Whether there is a journal at a path that can be read, and belongs to the recording `uuid`."""
    with contextlib.suppress(OSError, FormatError):
        return journal_info(path).get("uuid") == uuid and bool(_UUID.fullmatch(uuid))
    return False


def _open(path: Path) -> BinaryIO:
    """Opens a journal for reading. Its path may come from a recording that somebody else made."""
    try:
        return os.fdopen(open_regular(path), "rb")
    except ValueError as err:  # a NUL in the path
        raise OSError(errno.EINVAL, str(err), str(path)) from err


def _read_header(path: Path, file: BinaryIO) -> tuple[dict[str, Any], list[Area], dict[str, int]]:
    """What a journal says of itself, its areas, and their offsets."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise FormatError(f"{path}: expected a journal header of {_HEAD.size} bytes, found {len(head)} bytes")
    magic, length, crc = _HEAD.unpack(head)
    text = file.read(length) if magic == MAGIC and length <= _MAX_HEADER else b""
    if magic != MAGIC or len(text) != length or zlib.crc32(text) != crc:
        raise FormatError(f"{path}: expected a journal of this version, found {magic!r} or a damaged header")
    try:
        body = json.loads(text)
        areas, info = [_area(entry) for entry in body["areas"]], dict(body["info"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as err:
        raise FormatError(f"{path}: expected areas in the journal's header, found {text[:80]!r}") from err
    offsets, _ = _place(areas, _HEAD.size + length)
    size = os.fstat(file.fileno()).st_size
    for area in areas:
        if offsets[area.name] + area.size > size:
            left = max(0, size - offsets[area.name])
            raise FormatError(f"{path}: area {area.name!r} expected {area.size} bytes, found {left}")
    return info, areas, offsets


def _area(entry: Mapping[str, Any]) -> Area:
    values = {key: value for key, value in entry.items() if key != "kind"}
    sizes = [value for key, value in values.items() if key != "name"]
    if type(entry["name"]) is not str or any(type(n) is not int or not 0 < n < 1 << 48 for n in sizes):
        raise ValueError(entry)
    return RowArea(**values) if entry["kind"] == "rows" else LogArea(**values)


# ---- power losses


def boot_id() -> str:
    """A text that differs for each boot of each machine; empty if the system has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def sync_file(fd: int, name: str) -> None:
    """Waits until the file's data and size are on the disk; RecordingError if the disk refused, and how much it has
    is unknown."""
    try:
        if hasattr(fcntl, "F_FULLFSYNC"):  # macOS: its fsync stops at the drive's cache
            fcntl.fcntl(fd, fcntl.F_FULLFSYNC)
        else:
            os.fdatasync(fd)
    except OSError as err:
        raise RecordingError(f"{name}: could not be synced to the disk: {os_reason(err)}") from err


def sync_directory(path: Path) -> None:
    """Waits until the names in a directory are on the disk; RecordingError if the disk refused."""
    try:
        files.sync(path)
    except OSError as err:
        raise RecordingError(f"{path}: could not be synced to the disk: {os_reason(err)}") from err
