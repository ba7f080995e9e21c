"""One object behind a URL: its size, its version, and ranges of its bytes.

Web servers, S3, Google Cloud Storage and Azure are read by obstore, which takes credentials from the environment as
their own tools do; all other kinds of URL by fsspec.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from typing import Any, NamedTuple, Protocol, TypeVar
from urllib.parse import urlsplit

from tupli_mcap.errors import RecordingError, missing_extra
from tupli_mcap.remote.failures import (
    SECONDS_VARIABLE,
    BrokenOffError,
    FailedError,
    RefusedError,
    asked,
    check_endpoints,
    missing,
)
from tupli_mcap.remote.names import is_web, parts_of, shown, signed_in

_T = TypeVar("_T")
Tell = Callable[[int], None]  # called with the number of bytes that have just arrived
_BUCKETS = frozenset({"s3", "s3a", "gs", "az", "azure", "abfs", "abfss", "adl"})
_PIECE = 256 << 10  # least bytes of a piece
_RANGE = 8 << 20  # bytes of each request of fsspec for a whole file
_TOLD = ("ETag", "mtime", "modify", "created")  # what file systems of fsspec say that changes with a file
_SECONDS = 120.0
_CLIENT = {"connect_timeout": "10s", "allow_http": True}
# A body may take any time while bytes arrive; a broken request is retried for a minute.
_UNLIMITED = {
    "client_options": {**_CLIENT, "read_timeout": "120s", "timeout": "365d"},
    "retry_config": {"max_retries": 5, "retry_timeout": timedelta(seconds=60)},
}


def _nobody(_: int) -> None:
    pass


class NoRangesError(Exception):
    """The server sends whole files only."""


class End(NamedTuple):
    """The last bytes of an object, its size, and its version: a text that changes with its content."""

    data: memoryview
    size: int
    version: str


class Whole(NamedTuple):
    """All bytes of an object, which come in pieces, its size, and its version."""

    pieces: Iterator[memoryview]
    size: int
    version: str


class RemoteObject(Protocol):
    """An object on a server. Thread-safe."""

    def tail(self, length: int, known: End | None = None) -> End:
        """The last `length` bytes, or all if there are fewer; `known` if that is still the version.
        NoRangesError if the server sends whole files only."""
        ...

    def get(self, start: int, stop: int, version: str, tell: Tell = ...) -> memoryview:
        """The bytes `start:stop`; `tell` is called as they arrive. RecordingError if the object has another version."""
        ...

    def whole(self) -> Whole:
        """All bytes, from one request."""
        ...

    def newer(self, known: str) -> Whole | None:
        """All bytes, from one request; None if the object still has the version `known`."""
        ...


_no_suffixes: set[str] = set()  # the servers that have refused a range of last bytes
_process: int | None = None  # the process that has read from servers


def find(url: str) -> RemoteObject:
    """The object behind a URL; sends no request yet.

    Raises:
        MissingExtraError: obstore or fsspec is not installed.
        RecordingError: the URL is not valid, or this process is a fork of one that has read from a server.
    """
    global _process
    _process = _process or os.getpid()
    check_process(url)
    return _StoredObject(url) if is_web(url) or _is_bucket(url) else _FsspecObject(url)


def listed(folder: str) -> Iterator[str]:
    """The URLs of all objects below a folder, at any depth. `folder` ends with a slash: `s3://bucket/`, `memory://`."""
    if not _is_bucket(folder):
        system, path = _fsspec(folder)
        for name in _by_fsspec(folder, lambda: system.find(path)):
            yield folder + name.removeprefix(path).lstrip("/")
        return
    store, path = open_store(folder)
    bucket = folder.removesuffix(path).rstrip("/")

    def names() -> list[str]:
        return [entry["path"] for page in store.list(path or None) for entry in page]

    for name in asked(folder, names):
        yield f"{bucket}/{name}"


def _is_bucket(url: str) -> bool:
    return parts_of(url).scheme.lower() in _BUCKETS


def changed(url: str) -> RecordingError:
    return RecordingError(f"{shown(url)} has been changed since it was opened; open it again")


# ---- obstore


def open_store(url: str, within: timedelta | None = None) -> tuple[Any, str]:
    """The obstore store of a URL, and the path in it.

    within: the time limit of a request with all its retries; without it, a request ends when no more bytes arrive.

    Raises:
        MissingExtraError: obstore is not installed.
        RecordingError: the URL is not valid.
    """
    try:
        from obstore.store import HTTPStore, from_url
    except ImportError as err:
        raise missing_extra(f"reading {shown(url)} needs obstore", "remote") from err
    options: Any = _UNLIMITED if within is None else _limited(within)
    parts = parts_of(url)
    if is_web(url):
        address, header = signed_in(url)
        if header:
            client = {**options["client_options"], "default_headers": {"Authorization": header}}
            options = {**options, "client_options": client}
        return asked(url, lambda: HTTPStore.from_url(address, **options)), ""
    check_endpoints()
    # The name of an object may have any letters: "?" and "#" do not end it.
    path = url.partition("://")[2].partition("/")[2].lstrip("/")
    if parts.scheme.lower() == "az":  # az://account/container/path
        container, _, path = path.partition("/")
        return asked(url, lambda: from_url(f"az://{parts.netloc}/{container}", **options)), path
    return asked(url, lambda: from_url(f"{parts.scheme}://{parts.netloc}", **options)), path


def _limited(within: timedelta) -> dict[str, Any]:
    """Options for a time limit: each attempt may take a quarter of it, and none begins in its last quarter."""
    attempt = within / 4
    return {
        "client_options": {**_CLIENT, "timeout": attempt},
        "retry_config": {"max_retries": 5, "retry_timeout": within - attempt},
    }


def _patience() -> timedelta:
    """The time limit of one range, with all retries."""
    text = os.environ.get(SECONDS_VARIABLE, str(_SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 1 <= seconds <= 1e6:
        raise RecordingError(
            f"expected {SECONDS_VARIABLE} to be a number of seconds from 1 on, found {text!r:.80}"
        )
    return timedelta(seconds=seconds)


def check_process(url: str) -> None:
    """Raises RecordingError in a fork of the process that read first: a fork lacks the threads that fetch."""
    if _process is not None and _process != os.getpid():
        raise RecordingError(
            f"{shown(url)} cannot be read in a forked process, as its parent has read from a server; start the process "
            'with "spawn" (DataLoader: multiprocessing_context="spawn")'
        )


class _StoredObject:
    """An object that obstore reads."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._sends_whole = False
        self._store, self._path = open_store(url, _patience())
        if not self._path and not is_web(url):
            folder = shown(url).rstrip("/")
            raise RecordingError(
                f"{folder} is a bucket; give the URL of a recording, such as {folder}/x.mcap, or of several, "
                f"such as {folder}/runs/*.mcap"
            )

    def tail(self, length: int, known: End | None = None) -> End:
        from obstore.exceptions import NotSupportedError

        server = urlsplit(self._url).netloc
        if server in _no_suffixes:
            return self._tail_by_size(length, known)
        options: dict[str, Any] = {"range": {"suffix": length}}
        if known is not None and _is_strong(known.version):
            options["if_none_match"] = known.version
        try:
            found = self._ask(options)
        except (NotSupportedError, RecordingError) as err:
            # Servers that know no suffixes fail, or say that there is no such file, or that it may not be read.
            if isinstance(err, BrokenOffError) and not isinstance(err, FailedError):
                raise
            end = self._tail_by_size(length, known)
            if end.size:  # of an empty object, every range is refused
                _no_suffixes.add(server)
            return end
        if found is None and known is not None:
            return known
        start, stop = found.range  # as the answer says, and as was asked for: obstore compares them
        return End(self._taken(found, stop - start), found.meta["size"], _version(found.meta))

    def _tail_by_size(self, length: int, known: End | None) -> End:
        """Its tail, from a server that knows no suffixes."""
        from obstore.exceptions import NotSupportedError

        try:
            meta = self._ask({"range": (0, 1)}).meta
        except (RefusedError, NotSupportedError) as err:
            if isinstance(err, RefusedError) and not self._ask({}).meta["size"]:
                return End(memoryview(b""), 0, "")
            self._sends_whole = True
            raise NoRangesError from err
        size, version = meta["size"], _version(meta)
        if known is not None and known.version == version:
            return known
        return End(self.get(max(0, size - length), size, version), size, version)

    def get(self, start: int, stop: int, version: str, tell: Tell = _nobody) -> memoryview:
        found = self._begun(self._store, {"range": (start, stop)}, version)
        return self._taken(found, stop - start, tell)

    def _taken(self, found: Any, length: int, tell: Tell = _nobody) -> memoryview:
        """The body of an answer. RecordingError if it has another length, before more of it is taken."""
        data, at = bytearray(length), 0
        for piece in self._streamed(found):
            if at + len(piece) > length:
                raise self._more_than(length)
            data[at : at + len(piece)] = piece
            at += len(piece)
            tell(len(piece))
        if at != length:
            raise changed(self._url)
        return memoryview(data).toreadonly()

    def _more_than(self, length: int) -> RecordingError:
        return RecordingError(
            f"{shown(self._url)}: expected {length} bytes from its server, found more; open it again"
        )

    def whole(self) -> Whole:
        store, _ = open_store(self._url)
        return self._whole(store, self._begun(store, {}, None))

    def newer(self, known: str) -> Whole | None:
        store, _ = open_store(self._url)
        found = self._begun(store, _unless(known), None)
        is_same = found is None or (_is_strong(known) and _version(found.meta) == known)
        return None if is_same else self._whole(store, found)

    def _whole(self, store: Any, found: Any) -> Whole:
        size = found.meta["size"]
        if self._sends_whole and size:  # an empty object may be sent whole by any server
            _no_suffixes.add(urlsplit(self._url).netloc)
        return Whole(self._pieces(store, found), size, _version(found.meta))

    def _pieces(self, store: Any, found: Any) -> Iterator[memoryview]:
        """The body of an answer. What breaks off is gone on with, as long as something comes."""
        start, version, size = 0, _version(found.meta), found.meta["size"]
        while True:
            before = start
            try:
                for piece in self._streamed(found):
                    start += len(piece)
                    if start > size:
                        raise self._more_than(size)
                    yield piece
                return
            except BrokenOffError:
                if start == before:
                    raise
            found = self._begun(store, {"range": {"offset": start}}, version)

    def _begun(self, store: Any, options: dict[str, Any], version: str | None) -> Any:
        """An answer whose body has not been read, None if the options ask for none; RecordingError if it is not of
        the version given."""
        from obstore.exceptions import NotSupportedError

        if _is_strong(version):
            options["if_match"] = version
        try:
            found = self._ask(options, store)
        except RefusedError as err:
            if version is None:
                raise
            raise changed(self._url) from err
        except NotSupportedError:
            raise BrokenOffError(
                f"{shown(self._url)}: the server sends whole files only; try again"
            ) from None
        if version is not None and _version(found.meta) != version:
            raise changed(self._url)
        return found

    def _streamed(self, found: Any) -> Iterator[memoryview]:
        stream = iter(found.stream(_PIECE))
        try:
            while (piece := asked(self._url, lambda: next(stream, None))) is not None:
                yield memoryview(piece)
        except RefusedError as err:
            raise changed(self._url) from err

    def _ask(self, options: Any, store: Any = None) -> Any:
        """An answer whose body has not been read; None if the options ask for none of this version."""
        from obstore.exceptions import NotModifiedError

        try:
            return asked(self._url, lambda: (store or self._store).get(self._path, options=options))
        except NotModifiedError:
            return None


def _version(meta: Any) -> str:
    return meta["e_tag"] or f"{meta['last_modified']} {meta['size']}"


def _is_strong(version: str | None) -> bool:
    """Whether servers match a version: a tag that is not weak (W/"…")."""
    return version is not None and version.startswith('"')


def _unless(version: str) -> dict[str, Any]:
    """The options that ask for an object unless it still has a version. A time tells that to the second."""
    if _is_strong(version):
        return {"if_none_match": version}
    with contextlib.suppress(ValueError):  # a weak tag
        return {"if_modified_since": datetime.fromisoformat(version.rpartition(" ")[0])}
    return {}


# ---- fsspec


def _fsspec(url: str) -> tuple[Any, str]:
    try:
        import fsspec
    except ImportError as err:
        raise missing_extra(f"reading {shown(url)} needs fsspec", "remote") from err
    try:
        system, path = fsspec.core.url_to_fs(url)
    except Exception as err:  # noqa: BLE001 - each of its file systems raises errors of its own
        raise RecordingError(f"{shown(url)} cannot be opened: {shown(str(err)):.300}") from None
    return system, path


def _by_fsspec(url: str, ask: Callable[[], _T]) -> _T:
    """The answer to a request; RecordingError, without secrets in its message, if the request fails."""
    try:
        return ask()
    except FileNotFoundError:
        raise missing(url) from None
    except Exception as err:  # noqa: BLE001 - each of its file systems raises errors of its own
        raise RecordingError(f"{shown(url)} cannot be read: {shown(str(err)):.300}") from None


class _FsspecObject:
    """An object that fsspec reads. A change that leaves its size, tag and time the same is not noticed."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._system, self._path = _fsspec(url)

    def tail(self, length: int, known: End | None = None) -> End:
        size, version = self._now()
        if known is not None and known.version == version and not version.startswith(" "):
            return known
        if not size:
            return End(memoryview(b""), 0, "")
        data = self._asked(lambda: self._system.cat_file(self._path, start=max(0, size - length), end=size))
        return End(memoryview(data), size, version)

    def _now(self) -> tuple[int, str]:
        """Its size and version at this moment."""
        info = self._asked(lambda: self._system.info(self._path))
        size, told = int(info["size"]), next(filter(None, map(info.get, _TOLD)), "")
        return size, f"{told} {size}"

    def get(self, start: int, stop: int, version: str, tell: Tell = _nobody) -> memoryview:
        data = memoryview(self._asked(lambda: self._system.cat_file(self._path, start=start, end=stop)))
        if len(data) != stop - start:
            raise changed(self._url)
        tell(len(data))
        return data

    def whole(self) -> Whole:
        size, version = self._now()
        return Whole(self._pieces(size, version), size, version)

    def newer(self, known: str) -> Whole | None:
        whole = self.whole()
        return None if whole.version == known else whole

    def _pieces(self, size: int, version: str) -> Iterator[memoryview]:
        for at in range(0, size, _RANGE):
            yield self.get(at, min(at + _RANGE, size), version)
        if self._now()[1] != version:
            raise changed(self._url)

    def _asked(self, ask: Callable[[], _T]) -> _T:
        return _by_fsspec(self._url, ask)
