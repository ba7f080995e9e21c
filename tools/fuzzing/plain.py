"""Accidents: flipped bits, lost and doubled bytes, cut files. What is read afterwards must be the right data."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Sequence
from typing import NamedTuple

from fuzzing.model import Seed, split

__all__ = ["PLAIN", "Mutant"]


class Mutant(NamedTuple):
    """A file to read, and its journal. `accident`: what is read of it must be true; `note` tells what was done."""

    data: bytes
    journal: bytes | None
    accident: bool
    note: str


Mutator = Callable[[random.Random, Seed, Sequence[Seed]], Mutant]


def _place(rng: random.Random, data: bytes) -> int:
    """Anywhere, or near the start or the end of a record."""
    if rng.random() < 0.6 or len(data) < 64:
        return rng.randrange(len(data))
    starts = [8 + at for _, at, _ in split(data[8:])]
    return min(len(data) - 1, max(0, rng.choice(starts) + rng.randrange(-12, 48)))


def flip_bits(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    data = bytearray(seed.data)
    count = rng.choice([1, 1, 1, 2, 4, 16])
    for _ in range(count):
        data[_place(rng, seed.data)] ^= 1 << rng.randrange(8)
    return Mutant(bytes(data), seed.journal, True, f"{count} bits flipped")


def set_bytes(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    data = bytearray(seed.data)
    at, count = _place(rng, seed.data), rng.choice([1, 1, 2, 4, 8])
    value = rng.choice([0, 0xFF, 0x7F, 0x80, rng.randrange(256)])
    data[at : at + count] = bytes([value]) * len(data[at : at + count])
    return Mutant(bytes(data), seed.journal, True, f"{count} bytes at {at} set to {value}")


def zero_run(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    data = bytearray(seed.data)
    at, count = _place(rng, seed.data), rng.choice([8, 16, 64, 512, 4096])
    data[at : at + count] = bytes(len(data[at : at + count]))
    return Mutant(bytes(data), seed.journal, True, f"{count} zeros at {at}")


def garbage_run(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    data = bytearray(seed.data)
    at, count = _place(rng, seed.data), rng.choice([8, 16, 64, 512, 4096])
    data[at : at + count] = rng.randbytes(len(data[at : at + count]))
    return Mutant(bytes(data), seed.journal, True, f"{count} random bytes at {at}")


def truncate(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    at = _place(rng, seed.data)
    return Mutant(seed.data[:at], seed.journal, True, f"cut at {at}")


def append_junk(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    junk = rng.choice([bytes, rng.randbytes])(rng.choice([1, 8, 100, 4096]))
    return Mutant(seed.data + junk, seed.journal, True, f"{len(junk)} bytes appended")


def cut_bytes(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    at, count = _place(rng, seed.data), rng.choice([1, 2, 8, 9, 100, 1000])
    return Mutant(seed.data[:at] + seed.data[at + count :], seed.journal, True, f"{count} bytes lost at {at}")


def insert_bytes(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    at, count = _place(rng, seed.data), rng.choice([1, 2, 8, 9, 100])
    data = seed.data[:at] + rng.choice([bytes, rng.randbytes])(count) + seed.data[at:]
    return Mutant(data, seed.journal, True, f"{count} bytes inserted at {at}")


def _records(seed: Seed) -> list[bytes]:
    """The bytes of each record; joined after the magic they are the file."""
    data = seed.data[8:]
    starts = [at for _, at, _ in split(data)] + [len(data)]
    return [data[a:b] for a, b in itertools.pairwise(starts)]


def move_records(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """Records doubled, lost or swapped, as a file system with stale blocks might."""
    records = _records(seed)
    i, j = rng.randrange(len(records)), rng.randrange(len(records))
    how = rng.choice(["double", "drop", "swap", "copy over", "reverse", "cut twice"])
    if how == "double":
        records.insert(j, records[i])
    elif how == "drop":
        del records[i]
    elif how == "swap":
        records[i], records[j] = records[j], records[i]
    elif how == "copy over":
        records[j] = records[i]
    elif how == "reverse":
        i, j = min(i, j), max(i, j)
        records[i:j] = records[i:j][::-1]
    else:
        records = records[:i] + records[j:]
    return Mutant(seed.data[:8] + b"".join(records), seed.journal, True, f"{how} records {i} and {j}")


def swap_alike(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """Two records of the same kind and size change places: nothing else in the file moves."""
    records = _records(seed)
    groups: dict[tuple[int, int], list[int]] = {}
    for i, data in enumerate(records):
        groups.setdefault((data[0], len(data)), []).append(i)
    alike = [group for group in groups.values() if len(group) > 1]
    if not alike:
        return move_records(rng, seed, seeds)
    i, j = rng.sample(rng.choice(alike), 2)
    if rng.random() < 0.5:
        records[i], records[j] = records[j], records[i]
    else:
        records[i] = records[j]
    return Mutant(seed.data[:8] + b"".join(records), seed.journal, True, f"records {i} and {j} of one size")


def splice(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """The start of one file and the end of another; the other's data may be what is read."""
    other = rng.choice(seeds)
    if rng.random() < 0.5:
        mine, theirs = _records(seed), _records(other)
        i, j = rng.randrange(len(mine)), rng.randrange(len(theirs))
        data = seed.data[:8] + b"".join(mine[:i] + theirs[j:])
        return Mutant(data, seed.journal, False, f"records before {i}, then those of {other.name} from {j}")
    i = _place(rng, seed.data)
    j = i if rng.random() < 0.5 else _place(rng, other.data)
    return Mutant(
        seed.data[:i] + other.data[j:], seed.journal, False, f"{i} bytes, then {other.name} from {j}"
    )


def journal_bytes(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """Damage to the journal. Its rows carry no checksum, so what is read may be what the damage says."""
    journal = bytearray(
        seed.journal or rng.choice([other.journal for other in seeds if other.journal]) or b""
    )
    how = rng.choice(["bits", "zeros", "cut", "foreign", "garbage", "none"])
    used = len(bytes(journal).rstrip(b"\0"))
    at = rng.randrange(used)
    if how == "bits":
        for _ in range(rng.choice([1, 2, 8])):
            journal[rng.randrange(used)] ^= 1 << rng.randrange(8)
    elif how == "zeros":
        journal[at : at + 64] = bytes(len(journal[at : at + 64]))
    elif how == "garbage":
        journal[at : at + 64] = rng.randbytes(len(journal[at : at + 64]))
    elif how == "cut":
        del journal[at:]
    elif how == "foreign":
        journal = bytearray(rng.choice([other.journal for other in seeds if other.journal]) or b"")
    data = seed.data if rng.random() < 0.7 else seed.data[: _place(rng, seed.data)]
    found = None if how == "none" else bytes(journal)
    return Mutant(
        data, found, how in ("none", "foreign"), f"journal: {how} at {at}; {len(data)} bytes of file"
    )


PLAIN: dict[str, Mutator] = {
    function.__name__: function
    for function in (
        flip_bits, set_bytes, zero_run, garbage_run, truncate, append_junk, cut_bytes, insert_bytes, move_records,
        swap_alike, splice, journal_bytes,
    )
}  # fmt: skip
