"""Measures reading a file on a server: requests, bytes, and seconds over a link of 20 ms and 200 Mbit/s.

`python tools/bench_remote.py [FILE]`; without a file, it makes one of 380 episodes of 1,000 steps (46 MB). The link is
a server process that waits 20 ms before each connection and each answer, and limits its rate.
"""

from __future__ import annotations

import argparse
import http.server
import multiprocessing
import re
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

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
        self.send_response(206)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path, nargs="?")
    parser.add_argument("--draws", type=int, default=25, help="random choices of episodes")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = chosen.file or Path(folder) / "x.mcap"
        if chosen.file is None:
            make(path, 380, 1000)
        local = Recording(path)
        size, table = path.stat().st_size, local.file.store.table
        print(
            f"{path.name}: {size / 1e6:.1f} MB, {len(local)} episodes, "
            f"{len(table)} chunks of {table['length'].mean():,.0f} B"
        )
        with link(path) as (url, asked):
            ratios = list[float]()

            def cost(what: str, act: Callable[[], Any]) -> Any:
                before, began = tuple(asked), time.perf_counter()
                found = act()
                seconds = time.perf_counter() - began
                requests, sent = (now - then for now, then in zip(asked, before, strict=True))
                needed = sent / RATE + 2 * DELAY  # to connect, and to ask
                ratios.append(seconds / needed)
                print(
                    f"{what:28} {requests:5} requests {sent:12,} B  {sent / size:7.2%} of the file  {seconds:6.3f} s  "
                    f"{ratios[-1]:5.2f} of what the link needs"
                )
                return found

            def forget() -> None:
                source._blocks.__init__(source.BLOCK_BYTES)  # type: ignore[misc]

            recording = cost("open", lambda: Recording(url))
            cost("open a second time", lambda: Recording(url))
            actions = cost("one field, all steps", lambda: recording.read(fields=["actions"])).actions
            if not np.array_equal(actions, local.read(fields=["actions"]).actions):
                raise SystemExit("what came is not what is in the file")
            forget()
            episode = len(recording) // 2
            cost("one episode", lambda: recording.read(episodes=[episode]))
            row = local.index[episode]
            spans = local.file.store.spans(local.file.steps[0], int(row["first_row"]), int(row["length"]))
            print(f"{'':28} its chunks have {int(table['length'][[s.chunk for s in spans]].sum()):,} B")
            for seed in range(chosen.draws):
                forget()
                count = max(1, len(recording) // 100)
                some = np.sort(np.random.default_rng(seed).choice(len(recording), count, replace=False))
                cost(f"{count} random episodes", lambda some=some: recording.read(episodes=some))
            drawn = ratios[-chosen.draws :]
            print(f"{'':28} median {statistics.median(drawn):.2f}, worst {max(drawn):.2f}")
            forget()
            tupli_mcap.open(path)  # imports what datasets need, which is no cost of reading
            windows = cost("dataset of windows", lambda: tupli_mcap.open(url).windows(16))
            cost(
                "256 random windows of 16",
                lambda: windows[np.random.default_rng(0).integers(0, len(windows), 256)],
            )


if __name__ == "__main__":
    main()
