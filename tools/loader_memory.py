"""How much memory a worker of a DataLoader takes, beyond what importing takes, on a recording of many GiB.

Records compressible images (84 x 84 x 4, uint8), reads shuffled windows of them in a spawned worker, and prints the
most memory the worker ever had resident, less what one with nothing to read has. Exits with 1 above the limit.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch.utils.data import DataLoader, Dataset

from tupli_mcap import RecordEpisodes, TupliDataset
from tupli_mcap.torch import MapDataset, StreamDataset, collate

SHAPE = (84, 84, 4)


class Images(gym.Env[Any, Any]):
    """Each image has one bright column, which moves; episodes of 1000 steps."""

    observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
    action_space = spaces.Discrete(4)

    def __init__(self) -> None:
        self._images = np.zeros((84, *SHAPE), np.uint8)
        for i, image in enumerate(self._images):
            image[:, i] = 255
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._step = 0
        return self._images[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        return self._images[self._step % 84], 0.0, False, self._step % 1000 == 0, {}


class Nothing(Dataset[Any]):
    def __len__(self) -> int:
        return 64

    def __getitem__(self, index: int) -> Any:
        _ = TupliDataset, MapDataset  # the same imports
        return torch.zeros(1)


def record(path: Path, gib: float) -> None:
    """A recording of so many GiB of images."""
    start = time.perf_counter()
    steps = int(gib * 2**30) // int(np.prod(SHAPE))
    with RecordEpisodes(Images(), path) as env:
        over = True
        for _ in range(steps):
            if over:
                env.reset()
            over = any(env.step(0)[2:4])
    took = time.perf_counter() - start
    print(f"recorded {steps} steps, {gib:g} GiB, as {path.stat().st_size / 2**20:.0f} MiB in {took:.0f} s")


def peak(loader: DataLoader[Any], batches: int) -> float:
    """The most memory (MiB) that the loader's worker had resident while it made some batches."""
    iterator: Any = iter(loader)
    made = sum(1 for _ in itertools.islice(iterator, batches))
    if made < batches:
        sys.exit(
            f"expected {batches} batches, found {made}; record more with --gib, or ask for fewer with --batches"
        )
    status = Path(f"/proc/{iterator._workers[0].pid}/status").read_text()
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--gib", type=float, default=10.0, help="size of the images (default: 10)")
    parser.add_argument("--batches", type=int, default=200)
    parser.add_argument(
        "--batch-size", type=int, default=32, help="windows of 8 steps (default: 32, of 7 MiB)"
    )
    parser.add_argument("--limit", type=float, default=200.0, help="MiB (default: 200)")
    parser.add_argument("--file", type=Path, help="records to this file, or reads it if it is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        path = options.file or Path(directory) / "images.mcap"
        if not path.exists():
            record(path, options.gib)
        windows = TupliDataset.from_files(path).windows(8, fields=["states", "actions"])
        common: dict[str, Any] = {"num_workers": 1, "multiprocessing_context": "spawn"}
        imports = peak(DataLoader(Nothing(), **common), 32)
        print(f"a worker with nothing to read: {imports:.0f} MiB")
        stream = DataLoader(
            StreamDataset(windows, options.batch_size, seed=0), None, collate_fn=collate, **common
        )
        mapped = DataLoader(
            MapDataset(windows), options.batch_size, shuffle=True, collate_fn=collate, **common
        )
        worst = 0.0
        for name, loader, batches in (
            ("stream", stream, options.batches),
            ("map", mapped, options.batches // 10),
        ):
            above = peak(loader, batches) - imports
            worst = max(worst, above)
            print(f"{name}, after {batches} batches: {above:.0f} MiB above that")
    return int(worst > options.limit)


if __name__ == "__main__":
    sys.exit(main())
