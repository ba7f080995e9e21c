"""Measures reading a file on a server: requests, bytes, and seconds over a link of 20 ms and 200 Mbit/s.

`python tools/bench_remote.py [FILE]`; without a file, it makes one of 380 episodes of 1,000 steps (46 MB). The link is
a server process that waits 20 ms before each connection and each answer, and limits its rate. Exits with 1 if a figure
misses its limit.
"""

from __future__ import annotations

import argparse
import http.server
import multiprocessing
import re
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

import tupli_mcap
from tupli_mcap import EpisodeData, Recording, write_recording
from tupli_mcap.remote import source

DELAY, RATE, PIECE = 0.020, 200e6 / 8, 64 << 10


class Link(http.server.BaseHTTPRequestHandler):
    """Serves ranges of one file, all connections together no faster than the link."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # as web servers do: else the end of an answer waits for the client
    data = b""
    free_at = 0.0
    lock = threading.Lock()
    asked: Any = None  # shared with the reader: requests, bytes

    def setup(self) -> None:
        super().setup()
        time.sleep(DELAY)

    def log_message(self, *_: Any) -> None:
        pass

    def do_GET(self) -> None:
        size = len(self.data)
        first, last = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers["Range"]).groups()  # type: ignore[union-attr]
        start = int(first) if first else max(0, size - int(last))
        stop = min(size, int(last) + 1) if first else size
        time.sleep(DELAY)
        if self.headers["If-None-Match"] == '"one"':
            start = stop = 0
        self.send_response(206 if stop else 304)
        self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.send_header("Content-Length", str(stop - start))
        self.send_header("ETag", '"one"')
        self.end_headers()
        with self.asked.get_lock():
            self.asked[0] += 1
            self.asked[1] += stop - start
        for at in range(start, stop, PIECE):
            piece = self.data[at : min(stop, at + PIECE)]
            with Link.lock:
                Link.free_at = max(Link.free_at, time.monotonic()) + len(piece) / RATE
                wait = Link.free_at - time.monotonic()
            if wait > 0.001:
                time.sleep(wait)
            self.wfile.write(piece)


def _serve(path: Path, asked: Any, port: Any) -> None:
    Link.data, Link.asked = path.read_bytes(), asked
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Link)
    port.put(server.server_port)
    server.serve_forever()


@contextmanager
def link(path: Path) -> Iterator[tuple[str, Any]]:
    """The URL of a file behind the link, and the counters of requests and bytes."""
    context = multiprocessing.get_context("spawn")
    asked, port = context.Array("q", 2), context.Queue()
    process = context.Process(target=_serve, args=(path, asked, port), daemon=True)
    process.start()
    try:
        yield f"http://127.0.0.1:{port.get(timeout=60)}/x.mcap", asked
    finally:
        process.kill()
        process.join()


def make(path: Path, episodes: int, steps: int) -> None:
    """A recording of steps of 17 + 6 floats, at their length or close to it."""
    rng = np.random.default_rng(0)

    def each() -> Iterator[EpisodeData]:
        for _ in range(episodes):
            n = steps if steps > 100 else int(rng.integers(10, 2 * steps - 10))
            yield EpisodeData(
                rng.normal(size=(n, 17)).astype("f4"), rng.normal(size=(n, 6)).astype("f4"), rng.normal(size=n),
                np.zeros(n, bool), np.arange(n) == n - 1, rng.normal(size=17).astype("f4"),
            )  # fmt: skip

    box = spaces.Box(-np.inf, np.inf, (17,)), spaces.Box(-np.inf, np.inf, (6,))
    write_recording(path, each(), observation_space=box[0], action_space=box[1])


class Cost(NamedTuple):
    """What a read took: `slowness` is its time, of what the link needs for as many bytes."""

    requests: int
    sent: int
    slowness: float


class Reader:
    """Reads behind a link, prints what that costs, and says whether it is within limits."""

    def __init__(self, asked: Any, size: int) -> None:
        self.good = True
        self._asked, self._size = asked, size

    def cost(self, what: str, act: Callable[[], Any]) -> tuple[Any, Cost]:
        """What an act returns, and its cost."""
        before, began = tuple(self._asked), time.perf_counter()
        found = act()
        seconds = time.perf_counter() - began
        requests, sent = (now - then for now, then in zip(self._asked, before, strict=True))
        slowness = seconds / (sent / RATE + 2 * DELAY)  # to connect, and to ask
        print(
            f"{what:28} {requests:5} requests {sent:12,} B  {sent / self._size:7.2%} of the file  {seconds:6.3f} s  "
            f"{slowness:5.2f} of what the link needs"
        )
        return found, Cost(requests, sent, slowness)

    def limit(self, what: str, found: float, most: float) -> None:
        """Notes whether a figure is within its limit; prints it if it is not."""
        if found > most:
            self.good = False
            print(f"MISSED: {what}: {found:,.2f} (must reach: at most {most:,.2f})")


def forget() -> None:
    """Empties the cache of this process."""
    source._blocks = source._Blocks(source.BLOCK_BYTES)


def read_each(reader: Reader, url: str, local: Recording, draws: int) -> None:
    """Reads a field, an episode, and random ones of the file `local` from a server."""
    size, table = local.size, local.file.store.table
    recording, opened = reader.cost("open", lambda: Recording(url))
    reader.limit("requests to open", opened.requests, 1)
    _, again = reader.cost("open a second time", lambda: Recording(url))
    reader.limit("requests to open again", again.requests, 1)
    reader.limit("bytes to open again", again.sent, 0)
    found, field = reader.cost("one field, all steps", lambda: recording.read(fields=["actions"]))
    if not np.array_equal(found.actions, local.read(fields=["actions"]).actions):
        raise SystemExit("what came is not what is in the file")
    reader.limit("requests for a field", field.requests, 8)
    reader.limit("part of the file for a field", field.sent / size, 1.05)
    reader.limit("slowness of a field", field.slowness, 1.3)
    forget()
    episode = len(recording) // 2
    _, one = reader.cost("one episode", lambda: recording.read(episodes=[episode]))
    row = local.index[episode]
    spans = local.file.store.spans(local.file.steps[0], int(row["first_row"]), int(row["length"]))
    chunks = int(table["length"][[s.chunk for s in spans]].sum())
    print(f"{'':28} its chunks have {chunks:,} B")
    reader.limit("requests for an episode", one.requests, 2)
    reader.limit("bytes for an episode, of its chunks", one.sent / chunks, 1.1)
    drawn = []
    for seed in range(draws):
        forget()
        count = max(1, len(recording) // 100)
        some = np.sort(np.random.default_rng(seed).choice(len(recording), count, replace=False))
        drawn.append(
            reader.cost(f"{count} random episodes", lambda some=some: recording.read(episodes=some))[1]
        )
    median, worst = statistics.median(each.slowness for each in drawn), max(each.slowness for each in drawn)
    print(f"{'':28} median {median:.2f}, worst {worst:.2f}")
    reader.limit("part of the file for 1% of the episodes", max(each.sent for each in drawn) / size, 0.03)
    reader.limit("slowness of random episodes", median, 1.3)


def read_windows(reader: Reader, url: str, path: Path) -> None:
    """Reads random windows from a server."""
    forget()
    tupli_mcap.open(path)  # imports what datasets need, which is no cost of reading
    windows, _ = reader.cost("dataset of windows", lambda: tupli_mcap.open(url).windows(16))
    numbers = np.random.default_rng(0).integers(0, len(windows), 256)
    _, many = reader.cost("256 random windows of 16", lambda: windows[numbers])
    reader.limit("slowness of random windows", many.slowness, 1.3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, nargs="?", help="with episodes of about 1,000 steps")
    parser.add_argument("--draws", type=int, default=25, help="random choices of episodes")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = chosen.file or Path(folder) / "x.mcap"
        if chosen.file is None:
            make(path, 380, 1000)
        local = Recording(path)
        table = local.file.store.table
        print(
            f"{path.name}: {local.size / 1e6:.1f} MB, {len(local)} episodes, "
            f"{len(table)} chunks of {table['length'].mean():,.0f} B"
        )
        with link(path) as (url, asked):
            reader = Reader(asked, local.size)
            read_each(reader, url, local, chosen.draws)
            read_windows(reader, url, path)
    sys.exit(not reader.good)


if __name__ == "__main__":
    main()
