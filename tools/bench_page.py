"""Measures the pages of `tupli-mcap browse` on a directory of a million episodes.

    python tools/bench_page.py [--episodes 1000000] [--directory DIR] [--repeats 5]

Makes recordings of 10,000 short episodes each (DIR keeps them), catalogues them, gets each page in turn over HTTP, and
prints the median and the slowest time. Exits with 1 if the first page takes more than 300 ms.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
from gymnasium import spaces

import tupli_mcap

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from pages import browsing

EACH, STEPS, MOST_MS = 10_000, 2, 300.0


def make(root: Path, episodes: int) -> None:
    """Makes recordings of random episodes, with returns and metadata, unless they exist."""
    box = spaces.Box(-1, 1, (3,), np.float32)
    rng = np.random.default_rng(0)
    for number in range(-(-episodes // EACH)):
        path = root / f"run{number:03}.mcap"
        if path.exists():
            continue
        with tupli_mcap.EpisodeWriter(
            path, box, box, name=f"run{number}", metadata={"lr": 10.0**-number}
        ) as writer:
            values = rng.uniform(-1, 1, (EACH, STEPS + 1, 3)).astype(np.float32)
            for i in range(EACH):
                writer.begin(metadata={"score": float(rng.random()), "success": bool(i % 2)})
                for step in range(STEPS):
                    writer.step(
                        values[i, step],
                        values[i, step],
                        reward=float(values[i, step, 0]),
                        terminal=step == STEPS - 1,
                    )
                writer.end(values[i, STEPS])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=1_000_000)
    parser.add_argument(
        "--directory", type=Path, help="where recordings are kept; by default a temporary directory"
    )
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        root = options.directory or Path(folder)
        root.mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        make(root, options.episodes)
        print(f"{options.episodes:,} episodes are there after {time.perf_counter() - began:.0f} s")
        with browsing(root) as address, httpx.Client(base_url=address, timeout=3600) as client:
            began = time.perf_counter()
            client.get("/")
            print(f"the first question, which catalogues what is new: {time.perf_counter() - began:.1f} s")
            first = measured(client, options.repeats)
    sys.exit(first > MOST_MS)


def measured(client: httpx.Client, repeats: int) -> float:
    """Prints how long each page takes (ms); returns the median of the first one."""
    listed = client.get("/episodes?sort=-return&format=json").json()
    uri, after = listed["episodes"][0]["id"], listed["after"]
    pages = {
        "datasets": "/",
        "a dataset": "/dataset/-",
        "its cover": "/cover/-",
        "episodes": "/episodes",
        "by return": "/episodes?sort=-return",
        "the next page of these": f"/episodes?sort=-return&after={after}",
        "the newest": "/episodes?sort=-ended",
        "by a key of the metadata": "/episodes?sort=metadata.score",
        "those that a filter is true of": "/episodes?filter=metadata.score+%3E+0.999",
        "an episode": f"/episode/{uri}",
        "its values at a step": f"/episode/{uri}/step/1",
    }
    medians = []
    for name, page in pages.items():
        taken = []
        for _ in range(repeats):
            began = time.perf_counter()
            client.get(page).raise_for_status()
            taken.append((time.perf_counter() - began) * 1e3)
        medians.append(statistics.median(taken))
        print(f"{name:32} {medians[-1]:8.0f} ms, at most {max(taken):.0f}")
    return medians[0]


if __name__ == "__main__":
    main()
