#!/usr/bin/env python
"""Simulates power losses: makes the files that a disk may hold after one, reads them, and compares the steps.

For every kind of environment and each durability, at random moments: each sector of file and journal is as it was at
the last sync, or at any moment since; then file and journal are cut at every byte. Every synced step must be there, and
every step must be one that the environment returned. Exits with 1 if not.

    tools/power_loss.py [--crashes N] [--seed S]
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from power_loss import KINDS, Story, check, crash, record

from tupli_mcap.recording import journal_path


def crashes(story: Story, place: Path, count: int, rng: random.Random) -> tuple[int, list[str]]:
    """Simulates crashes; returns the number of checked steps, and what went wrong."""
    steps, wrong = 0, []
    for n in range(count):
        at = rng.randrange(len(story.moments))
        try:
            steps += check(story, place, crash(story, at, place, rng))
        except Exception as err:  # noqa: BLE001 - whatever happens is what is looked for
            wrong.append(f"crash {n} at moment {at}: {type(err).__name__}: {err}")
    return steps, wrong


def cuts(story: Story, place: Path, stride: int) -> tuple[int, list[str]]:
    """Cuts file and journal; returns the number of cuts, and what went wrong."""
    last, count, wrong = story.moments[-1], 0, []
    journal = last.journal or b""
    used = len(journal.rstrip(b"\0")) + 1
    for name, whole in (("file", last.file), ("journal", journal[:used])):
        for size in range(0, len(whole) + 1, stride):
            place.write_bytes(last.file[:size] if name == "file" else last.file)
            held = journal if name == "file" else journal[:size].ljust(len(journal), b"\0")
            journal_path(place).write_bytes(held if size % 2 or name == "file" else journal[:size])
            try:
                check(story, place, [0] * len(story.truth))
            except Exception as err:  # noqa: BLE001 - as above
                wrong.append(f"{name} cut at {size}: {type(err).__name__}: {err}")
            count += 1
    return count, wrong


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--crashes", type=int, default=300, help="for each kind and durability (default 300)")
    parser.add_argument("--steps", type=int, default=40, help="recorded before (default 40)")
    parser.add_argument("--stride", type=int, default=1, help="cut at every n-th byte (default 1)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), action="append", help="only these")
    asked = parser.parse_args()
    began, failures = time.monotonic(), 0
    print(f"{'kind':8} {'durability':10} {'crashes':>8} {'steps':>9} {'cuts':>8}  wrong")
    for kind in asked.kind or KINDS:
        large = kind == "frames"
        for durability in ("step", "chunk", "os"):
            with tempfile.TemporaryDirectory() as directory:
                place = Path(directory, "r.mcap")
                story = record(
                    Path(directory, "live.mcap"), kind, durability, asked.steps, 300_000 if large else 2000
                )
                rng = random.Random(f"{asked.seed} {kind} {durability}")
                count = asked.crashes // 10 if large else asked.crashes
                steps, wrong = crashes(story, place, count, rng)
                cut = 0
                if durability == "step":
                    cut, more = cuts(story, place, asked.stride * (997 if large else 1))
                    wrong += more
            failures += len(wrong)
            print(f"{kind:8} {durability:10} {count:8} {steps:9} {cut:8}  {len(wrong)}", flush=True)
            for line in wrong[:5]:
                print(f"    {line}")
    print(f"{failures} failures in {time.monotonic() - began:.0f} s")
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
