#!/usr/bin/env python
"""Damages golden recordings in many simple ways, then verifies and recovers each.

`python tools/damage.py [--every N] [--name NAME ...] [--kind flip|cut|zero|swap]`: at every N-th byte of each
recording, flips a bit, cuts the file, zeroes 64 bytes, or copies bytes from elsewhere in the file. Then `verify` must
find the damage, unless all records are as they were; `recover` must return only recorded steps, and name the missing
ones; and `verify` must find nothing in the recovered file. Prints a line per recording; exits with 1 if something is
wrong.
"""

from __future__ import annotations

import argparse
import io
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zstandard
from mcap.records import Chunk, Header
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from tupli_mcap import Recording, TupliError, jsonvalue, recover_recording, verify_recording

GOLDEN = Path(__file__).parents[1] / "tests" / "golden"
Steps = dict[tuple[int, int], str]


def flip(data: bytes, at: int, rng: random.Random) -> bytes:
    """Flips one bit."""
    bad = bytearray(data)
    bad[at] ^= 1 << rng.randrange(8)
    return bytes(bad)


def cut(data: bytes, at: int, rng: random.Random) -> bytes:
    """Cuts the file."""
    return data[:at]


def zero(data: bytes, at: int, rng: random.Random) -> bytes:
    """Writes zeros, as a lost page leaves them."""
    return data[:at] + bytes(len(data[at : at + 64])) + data[at + 64 :]


def swap(data: bytes, at: int, rng: random.Random) -> bytes:
    """Copies bytes from elsewhere in the file."""
    other, size = rng.randrange(len(data)), rng.randrange(1, 200)
    part = data[other : other + size]
    return data[:at] + part + data[at + len(part) :]


DAMAGES: dict[str, Callable[[bytes, int, random.Random], bytes]] = {
    "flip": flip,
    "cut": cut,
    "zero": zero,
    "swap": swap,
}


def place(name: str, directory: Path) -> Path:
    """A copy of a golden recording, its journal beside it."""
    path = directory / f"{name}.mcap"
    path.write_bytes((GOLDEN / f"{name}.mcap").read_bytes())
    packed = GOLDEN / f"{name}.mcap.journal.zst"
    if packed.exists():
        journal = zstandard.ZstdDecompressor().decompress(packed.read_bytes())
        (directory / f"{name}.mcap.journal").write_bytes(journal)
    return path


def steps_of(path: Path) -> Steps:
    """Every step by the episode and step number it had before a repair, exact."""
    found: Steps = {}
    with Recording(path) as recording:
        for episode in recording.episodes:
            origin = episode.metadata.get("recovered")
            number, first = (
                (episode.number, 0) if origin is None else (origin["episode"], origin["first_step"])
            )
            for i, step in enumerate(episode):
                values = [step.state, step.action, step.reward, step.terminal, step.timeout]
                found[number, first + i] = jsonvalue.dumps(values)
    return found


def records(data: bytes) -> list[Any]:
    """All records, without what no rule is about: the library in the header, and how chunks are compressed (LZ4 has
    many ways to repeat what is constant)."""
    found: list[Any] = []
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if isinstance(record, Header):
            record.library = ""
        elif isinstance(record, Chunk):
            record.data = get_chunk_data_stream(record)[0].read(record.uncompressed_size)
        found.append(record)
    return found


def wrong(path: Path, wanted: Steps, original: bytes) -> str | None:
    """What is wrong after verifying and recovering a damaged file; None if nothing is."""
    damaged, verified = path.read_bytes(), verify_recording(path)
    said = verified.problems or verified.state != "complete"
    if damaged != original and not said and records(damaged) != records(original):
        return "damage not found"
    try:
        report = recover_recording(path, overwrite=True)
    except TupliError:
        return None
    if report.target is None:
        return None
    verified = verify_recording(report.target)
    if verified.errors:
        return f"recovered, and damaged: {verified.errors[0].message}"
    found = steps_of(Path(report.target))
    if any(wanted.get(key) != value for key, value in found.items()):
        return "steps that never were"
    missing = set(wanted) - set(found)
    named = {
        (lost.episode, step)
        for lost in report.lost
        for step in range(lost.first, 1000 if lost.stop is None else lost.stop)
    }
    tail_is_gone = not report.finished or report.journal in ("stale", "damaged", "missing")
    if not missing <= named and not tail_is_gone:
        return f"missing without a word: {sorted(missing - named)[:3]}"
    return None


def main() -> int:
    """Runs it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--every", type=int, default=7, help="bytes from one damage to the next")
    parser.add_argument("--name", action="append", help="of a golden recording; all by default")
    parser.add_argument("--kind", action="append", choices=list(DAMAGES), help="all by default")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    bad = total = 0
    for name in asked.name or sorted(path.stem for path in GOLDEN.glob("*.mcap")):
        for kind in asked.kind or DAMAGES:
            began = time.perf_counter()
            with tempfile.TemporaryDirectory() as directory:
                found, tried = sweep(name, kind, asked.every, Path(directory))
            total, bad = total + tried, bad + sum(found.values())
            said = "; ".join(f"{count} x {what}" for what, count in found.most_common(5)) or "all well"
            print(f"{name} {kind}: {tried} in {time.perf_counter() - began:.0f} s, {said}", flush=True)
    print(f"{total} damaged files, {bad} wrong")
    return 1 if bad else 0


def sweep(name: str, kind: str, every: int, directory: Path) -> tuple[Counter[str], int]:
    """Everything that went wrong, by sentence (with the first place of each), and the number of files tried."""
    path = place(name, directory)
    wanted, data = steps_of(path), path.read_bytes()
    found: Counter[str] = Counter()
    first: dict[str, int] = {}
    for at in range(0, len(data), every):
        path.write_bytes(DAMAGES[kind](data, at, random.Random(at)))
        try:
            what = wrong(path, wanted, data)
        except Exception as err:  # noqa: BLE001 - reported
            what = f"{type(err).__name__}: {err} ({traceback.extract_tb(err.__traceback__)[-1].name})"
        if what is not None:
            sentence = f"{what} (first at {first.setdefault(what[:40], at)})"
            found[sentence] += 1
    return found, len(range(0, len(data), every))


if __name__ == "__main__":
    sys.exit(main())
