"""A file on a server, as a reader sees it: ranges are planned ahead, fetched at the same time, and cached."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO, Final, NamedTuple
from urllib.parse import urlsplit

from tupli_mcap.errors import FormatError, RecordingError, warn
from tupli_mcap.files import as_file_name, stopped_by_signals
from tupli_mcap.progress import progress
from tupli_mcap.remote.kept import kept_blocks
from tupli_mcap.remote.names import shown
from tupli_mcap.remote.objects import End, NoRangesError, RemoteObject, Whole, check_process, find
from tupli_mcap.remote.plan import Range, pieces_of

BLOCK_BYTES: Final = 256 << 20  # of all files of this process
# Fetched when a file is opened: holds the summary and the index, unless the file is huge.
_TAIL = 128 << 10
# Fetched together when any byte of it is read: holds what a recording says about its run and its environment.
_HEAD = 16 << 10
_AT_ONCE = 8
_MOST_ENDS = 512
_MOST_COPIES = 16


class _Block(NamedTuple):
    """Bytes of a file that have arrived, or are being fetched."""

    start: int
    stop: int
    coming: Future[memoryview]

    @property
    def has_failed(self) -> bool:
        return self.coming.done() and self.coming.exception() is not None


class _Blocks:
    """The cache of this process: the blocks of remote files used last, by file and version, and by file what opening
    it last has fetched."""

    def __init__(self, budget: int) -> None:
        self._budget = budget
        self._kept: OrderedDict[tuple[str, int, int], _Block] = OrderedDict()
        self._of: dict[str, dict[tuple[int, int], _Block]] = {}
        self._ends: OrderedDict[str, End] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def end_of(self, url: str) -> End | None:
        """The end of a file when it was opened last. It may have another version by now."""
        with self._lock:
            return self._ends.get(url)

    def keep_end(self, url: str, end: End) -> None:
        with self._lock:
            self._ends[url] = end
            self._ends.move_to_end(url)
            if len(self._ends) > _MOST_ENDS:
                self._ends.popitem(last=False)

    def find(self, file: str, start: int, stop: int) -> _Block | None:
        """The block that holds a range. One that could not be fetched does not count: the server may answer by now."""
        with self._lock:
            for (first, last), block in self._of.get(file, {}).items():
                if first <= start and stop <= last and not block.has_failed:
                    self._kept.move_to_end((file, first, last))
                    return block
        return None

    def put(self, file: str, block: _Block) -> None:
        with self._lock:
            key = (file, block.start, block.stop)
            if key in self._kept:
                self._drop(key)
            self._kept[key] = block
            self._of.setdefault(file, {})[key[1:]] = block
            self._bytes += block.stop - block.start
            while self._bytes > self._budget and len(self._kept) > 1:
                self._drop(next(iter(self._kept)))

    def forget(self, file: str, block: _Block) -> None:
        with self._lock:
            key = (file, block.start, block.stop)
            if self._kept.get(key) is block:
                self._drop(key)

    def _drop(self, key: tuple[str, int, int]) -> None:
        del self._kept[key]
        blocks = self._of[key[0]]
        del blocks[key[1:]]
        if not blocks:
            del self._of[key[0]]
        self._bytes -= key[2] - key[1]


_watch: Callable[[int, int], None] | None = None


@contextmanager
def watching(watch: Callable[[int, int], None]) -> Iterator[None]:
    """Within the block, calls `watch(planned, arrived)` with numbers of new bytes, from any thread."""
    global _watch
    _watch = watch
    try:
        yield
    finally:
        _watch = None


def _tell(planned: int, came: int) -> None:
    watch = _watch
    if watch is not None:
        watch(planned, came)


_blocks = _Blocks(BLOCK_BYTES)
_fetchers = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="tupli-remote")


class RemoteSource:
    """One version of a file on a server. Thread-safe; a copy in another process fetches for itself.

    Opening it has fetched the tail of the file, which stays in memory. If the file on the server changes, reading
    raises RecordingError: bytes of two versions are never mixed.
    """

    def __init__(self, url: str, remote: RemoteObject, tail: End) -> None:
        self.path: Path | None = None
        self.name = shown(url)
        self.size = tail.size
        self._url, self._remote, self._tail = url, remote, tail
        self._file = f"{tail.version} {url}"
        self._kept = kept_blocks(url, tail.version)
        self._lock = threading.Lock()
        self._planned: list[Range] = []  # not requested yet; the next one is the last
        self._unread: set[tuple[int, int]] = set()  # of the plan: requested, and not read yet

    def read(self, offset: int, length: int) -> bytes:
        return bytes(self.view(offset, length))

    def view(self, offset: int, length: int) -> memoryview:
        stop = offset + length
        if stop > self.size:
            raise FormatError(
                f"{self.name}: expected {length} bytes at offset {offset}, found the end of the file at {self.size}"
            )
        first = self.size - len(self._tail.data)
        if offset >= first:
            return self._tail.data[offset - first : stop - first]
        if stop > first:  # the tail has the rest
            return memoryview(self.read(offset, first - offset) + self._tail.data[: stop - first])
        check_process(self._url)
        block = _blocks.find(self._file, offset, stop) or self._kept_block(offset, stop)
        block = block or self._ask_for(offset, stop)
        try:
            data = block.coming.result()
        except BaseException:
            _blocks.forget(self._file, block)
            raise
        with self._lock:
            self._unread.discard((block.start, block.stop))
            self._fill()
        return data[offset - block.start : stop - block.start]

    def fetch(self, ranges: Sequence[Range]) -> None:
        """Starts to fetch ranges that will be read next; fetching continues while they are read."""
        first = self.size - len(self._tail.data)
        kept = self._kept.ranges() if self._kept else []
        wanted = [(start, min(stop, first)) for start, stop in ranges if start < first]
        missing = [
            (start, stop)
            for start, stop in wanted
            if not _blocks.find(self._file, start, stop)
            and not any(begin <= start and stop <= end for begin, end in kept)
        ]
        with self._lock:
            given_up = sum(stop - start for start, stop in self._planned)
            self._planned = pieces_of(missing)[::-1]
            self._unread = set()
            _tell(sum(stop - start for start, stop in self._planned) - given_up, 0)
            self._fill()

    def _kept_block(self, start: int, stop: int) -> _Block | None:
        """The block with a range, from the disk."""
        kept = self._kept
        if kept is None:
            return None
        for begin, end in kept.ranges():
            if begin <= start and stop <= end and (data := kept.read((begin, end))) is not None:
                coming: Future[memoryview] = Future()
                coming.set_result(data)
                block = _Block(begin, end, coming)
                _blocks.put(self._file, block)
                return block
        return None

    def _ask_for(self, start: int, stop: int) -> _Block:
        """Requests the planned range that holds this range, or else the range alone."""
        with self._lock:
            for i, (first, last) in enumerate(self._planned):
                if first <= start and stop <= last:
                    del self._planned[i]
                    return self._begin(first, last)
            if stop <= _HEAD:
                start, stop = 0, min(_HEAD, self.size - len(self._tail.data))
            _tell(stop - start, 0)
            return self._begin(start, stop)

    def _fill(self) -> None:
        """Requests more of the plan."""
        while self._planned and len(self._unread) < _AT_ONCE:
            piece = self._planned.pop()
            self._begin(*piece)
            self._unread.add(piece)

    def _begin(self, start: int, stop: int) -> _Block:
        block = _Block(start, stop, _fetchers.submit(self._get, start, stop))
        _blocks.put(self._file, block)
        return block

    def _get(self, start: int, stop: int) -> memoryview:
        left = stop - start

        def tell(came: int) -> None:
            nonlocal left
            left -= came
            _tell(0, came)

        try:
            data = self._remote.get(start, stop, self._tail.version, tell)
        except BaseException:
            _tell(-left, 0)
            raise
        if self._kept:
            self._kept.write((start, stop), data)
        return data

    def refresh(self) -> None:
        """Does nothing, since this source is one version of the file."""

    def close(self) -> None:
        """Does nothing, since no connection is held open."""

    def __reduce__(self) -> tuple[Callable[..., RemoteSource], tuple[str, bytes, int, str]]:
        tail = self._tail
        return _again, (self._url, bytes(tail.data), tail.size, tail.version)


def _again(url: str, tail: bytes, size: int, version: str) -> RemoteSource:
    return RemoteSource(url, find(url), End(memoryview(tail), size, version))


def open_url(url: str) -> RemoteSource | BinaryIO:
    """Opens a file on a server. What this process fetched before is used again if the server says that the file is the
    same. If the server sends whole files only, warns, and returns a temporary copy.

    Raises:
        RecordingError: the file does not exist, may not be read, or the server does not answer.
        MissingExtraError: the package that reads such URLs is not installed.
    """
    remote, copy = find(url), _copies.get(url)
    if copy is None:
        with contextlib.suppress(NoRangesError):
            end = remote.tail(_TAIL, _blocks.end_of(url))
            _blocks.keep_end(url, end)
            return RemoteSource(url, remote, end)
        copy = _downloaded(url, remote.whole())
    elif newer := remote.newer(copy.version):
        copy = _downloaded(url, newer)
    with _lock:
        _copies[url] = copy
        _copies.move_to_end(url)
        if len(_copies) > _MOST_COPIES:
            _copies.popitem(last=False)
    return copy.opened()


class _Copy:
    """A copy of one version of a file: a file without a name, which is gone when nobody holds it any more."""

    def __init__(self, file: IO[bytes], version: str) -> None:
        self.version = version
        self._fd = os.dup(file.fileno())

    def opened(self) -> BinaryIO:
        return os.fdopen(os.dup(self._fd), "rb")

    def __del__(self) -> None:
        os.close(self._fd)


_copies: OrderedDict[str, _Copy] = OrderedDict()  # those used last, by URL
_lock = threading.Lock()


def _downloaded(url: str, whole: Whole) -> _Copy:
    """A copy of a file that the server sends as a whole; warns of that, unless the file is empty: it has no ranges."""
    if whole.size:
        warn(
            f"{shown(url)}: the server sends whole files only, so all of it is downloaded into a temporary file; "
            "a server that supports range requests avoids this"
        )
    with tempfile.TemporaryFile() as file:
        _save(url, whole, file)
        return _Copy(file, whole.version)


@contextmanager
def copied(url: str, demand: Callable[[int], None] = lambda _: None) -> Iterator[Path]:
    """A temporary copy of a whole file, for callers that read all of it. `demand` is called with its size before it is
    fetched, and may raise.

    Raises:
        RecordingError: the file cannot be read, or the disk is full.
        MissingExtraError: the package that reads such URLs is not installed.
    """
    whole = find(url).whole()
    demand(whole.size)
    with stopped_by_signals(), tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
        path = Path(folder) / (as_file_name(Path(urlsplit(url).path).name) or "recording.mcap")
        with path.open("xb") as file:
            _save(url, whole, file)
        yield path


def _save(url: str, whole: Whole, file: IO[bytes]) -> None:
    """Writes a file that comes from a server, with a progress bar; RecordingError if the connection breaks."""
    done = 0
    try:
        with progress(whole.size, f"downloading {shown(url)}", in_bytes=True) as bar:
            for piece in whole.pieces:
                file.write(piece)
                done += len(piece)
                bar.advance(len(piece))
        file.flush()
    except OSError as err:
        raise RecordingError(f"{shown(url)} cannot be copied to {tempfile.gettempdir()}: {err}") from err
    if done != whole.size:
        raise RecordingError(f"{shown(url)}: expected {whole.size} bytes, found {done}; try again")
