"""Files that lie with right checksums: every claim of a recording set to a value that hurts."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import lz4.frame
import numpy as np
import zstandard

from fuzzing.model import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    METADATA,
    SCHEMA,
    FileRecord,
    Model,
    Seed,
    footer,
    pack,
    record,
    split,
    strings,
)
from fuzzing.plain import Mutant
from tupli_mcap.arrays import Array

__all__ = ["CRAFTED"]

_BITS = (7, 8, 15, 16, 24, 31, 32, 33, 47, 48, 62, 63, 64)
_TAGS = (
    "$float", "$int", "$complex", "$str", "$bytes", "$bytearray", "$tuple", "$set", "$frozenset", "$dict", "$numpy",
    "$numpy_str", "$numpy_bytes", "$else",
)  # fmt: skip
_TYPES = (
    "Box",
    "Discrete",
    "MultiDiscrete",
    "MultiBinary",
    "Text",
    "Dict",
    "Tuple",
    "OneOf",
    "Sequence",
    "Graph",
)


def number(rng: random.Random, near: int = 0) -> int:
    """An integer that code tends to get wrong."""
    kind = rng.random()
    if kind < 0.25:
        return near + rng.choice([-8, -1, 1, 2, 8, 9])
    if kind < 0.35:
        return near * rng.choice([2, 16, 256, -1])
    if kind < 0.85:
        return max(0, (1 << rng.choice(_BITS)) + rng.choice([-2, -1, 0, 1]))
    return rng.choice([0, 1, 2, 3, 10, 100, 1000, 10**6, rng.getrandbits(64)])


def _mutant(model: Model, seed: Seed, note: str) -> Mutant:
    return Mutant(model.encode(), seed.journal, False, note)


def index_row(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """A field of an episode's row."""
    model = seed.model()
    if model.index is None or not len(model.index.episodes):
        return chunk_head(rng, seed, _)
    rows, notes = model.index.episodes, []
    for _ in range(rng.choice([1, 1, 2, 4])):
        i, name = rng.randrange(len(rows)), rng.choice(rows.dtype.names[:-1])
        _set(rows, i, name, rng)
        notes.append(f"{name}[{i}]={rows[name][i]}")
    return _mutant(model, seed, "index: " + ", ".join(notes))


def _set(rows: Array, i: int, name: str, rng: random.Random) -> None:
    if rows.dtype[name].kind == "f":
        rows[name][i] = rng.choice([float("nan"), float("inf"), -0.0, 1e308, 5e-324])
        return
    size = rows.dtype[name].itemsize * 8
    value = number(rng, int(rows[name][i])) & ((1 << size) - 1)
    if rows.dtype[name].kind == "i" and value >> (size - 1):
        value -= 1 << size
    rows[name][i] = value


def index_shape(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """Counts, sizes, and the order and number of rows."""
    model = seed.model()
    if model.index is None:
        return chunk_head(rng, seed, seeds)
    index, how = (
        model.index,
        rng.choice(["claim", "drop", "double", "swap", "texts", "tail", "empty", "other"]),
    )
    if how == "claim":
        place = rng.choice([1, 2, 3])
        index.claims[place] = number(
            rng, (0, len(index.episodes), len(index.chunks), len(index.texts))[place]
        )
        how += f" {place}: {index.claims[place]}"
    elif how == "texts":
        index.texts = b"".join([json_text(rng, index.texts[:200]) for _ in range(3)])
        index.episodes["metadata_offset"], index.episodes["metadata_length"] = 0, len(index.texts)
    elif how == "tail":
        index.compress = lambda part: zstandard.ZstdCompressor().compress(part) + b"tail"
    elif how == "empty":
        index.episodes, index.texts = index.episodes[:0], b""
    elif how == "other":
        others = [other for other in seeds if other.journal is None]
        model.index = rng.choice(others).model().index
    else:
        _reorder(rng, index, how)
    return _mutant(model, seed, f"index: {how}")


def _reorder(rng: random.Random, index: Any, how: str) -> None:
    name = rng.choice(["episodes", "chunks"])
    rows = getattr(index, name)
    order = list(range(len(rows))) or [0]
    i, j = rng.randrange(len(order)), rng.randrange(len(order))
    if how == "drop":
        del order[i]
    elif how == "double":
        order.insert(j, i)
    else:
        order[i], order[j] = order[j], order[i]
    if name == "episodes":
        index.episodes = rows[order] if len(rows) else rows
    else:
        index.change_chunks = lambda table: table[order] if len(table) else table


def chunk_row(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """A field of the chunk table."""
    model = seed.model()
    if model.index is None or not len(model.index.chunks):
        return chunk_head(rng, seed, _)
    names = model.index.chunks.dtype.names[:-1]
    i, name, salt = rng.randrange(len(model.index.chunks)), rng.choice(names), rng.random()

    def change(rows: Array) -> Array:
        _set(rows, i, name, random.Random(salt))
        return rows

    model.index.change_chunks = change
    return _mutant(model, seed, f"chunk table: {name}[{i}]")


def chunk_head(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """What a chunk says of itself: size, compression, times."""
    model = seed.model()
    if not model.chunks():
        return definitions(rng, seed, _)
    part = rng.choice(model.chunks())
    how = rng.choice(["size", "compression", "times", "relabel"])
    size = sum(map(len, part.inner))
    if how == "size":
        part.size = number(rng, size)
    elif how == "compression":
        part.compression = rng.choice([b"zstd", b"lz4", b"", b"ZSTD", b"x" * 70_000, b"\xff\xfe", b"snappy"])
        part.packed = lambda data: pack(rng.choice([b"zstd", b"lz4", b""]), data)
    elif how == "relabel":
        part.compression, part.packed = b"", lambda data: pack(b"zstd", data)
    else:
        part.times = (number(rng) & (2**64 - 1), number(rng) & (2**64 - 1))
    return _mutant(model, seed, f"chunk: {how} {part.size} {part.compression[:8]!r}")


def frames(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """Compressed data that is no single honest frame."""
    model = seed.model()
    if not model.chunks():
        return definitions(rng, seed, _)
    part = rng.choice(model.chunks())
    part.compression = rng.choice([b"zstd", b"lz4"])
    how = rng.choice(
        ["unsized", "two frames", "cut", "junk after", "longer", "shorter", "bomb", "skippable", "lie"]
    )
    part.packed = lambda data: _frames(rng, how, part.compression, data)
    if how in ("bomb", "lie"):
        part.size = rng.choice([None, 1 << 20, 1 << 28, (1 << 31) - 1, 1 << 31])
    return _mutant(model, seed, f"{part.compression.decode()} {how}, size {part.size}")


def _frames(rng: random.Random, how: str, name: bytes, data: bytes) -> bytes:
    packed = pack(name, data)
    if how == "unsized":
        plain = {b"zstd": zstandard.ZstdCompressor(write_content_size=False).compress}
        return plain.get(name, lambda data: lz4.frame.compress(data, store_size=False))(data)
    if how == "two frames":
        return pack(name, data[: len(data) // 2]) + pack(name, data[len(data) // 2 :])
    if how == "cut":
        return packed[: rng.randrange(len(packed) + 1)]
    if how == "junk after":
        return packed + rng.randbytes(rng.choice([1, 7, 100]))
    if how == "skippable":
        return struct.pack("<II", 0x184D2A50, 4) + b"skip" + packed
    if how == "bomb":
        return pack(name, bytes(1 << rng.choice([16, 20, 22])))
    if how == "lie" and name == b"zstd":  # the frame header's content size, in each of its widths
        return packed[:4] + bytes([0xE0]) + (number(rng) & (2**64 - 1)).to_bytes(8, "little") + packed[6:]
    return pack(name, data + b"\0" if how == "longer" else data[:-1])


def message(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """A message: a number somewhere in its body, its length, its header."""
    model = seed.model()
    if not model.chunks():
        return definitions(rng, seed, _)
    part = rng.choice(model.chunks())
    at = rng.randrange(len(part.inner))
    data = bytearray(part.inner[at])
    how = rng.choice(
        ["u32", "u32", "u64", "f64", "byte", "longer", "shorter", "length", "head", "drop", "double"]
    )
    place = rng.randrange(9, len(data))
    if how == "u32":
        _store(data, 35 + (place - 35) // 4 * 4 if place > 38 else place, number(rng, 4), 4)
    elif how == "u64":
        _store(data, 35 + (place - 35) // 8 * 8 if place > 42 else place, number(rng), 8)
    elif how == "f64":
        value = rng.choice([float("nan"), float("inf"), float("-inf"), 1e308])
        data[place : place + 8] = struct.pack("<d", value)[: len(data[place : place + 8])]
    elif how == "byte":
        data[place] = rng.choice([0, 1, 2, 0x1A, 0x7F, 0x80, 0xFF])
    elif how == "head":
        place, size = rng.choice([(0, 1), (9, 2), (11, 4), (15, 8), (23, 8), (31, 4)])
        _store(data, place, number(rng, data[place]), size)
    elif how in ("longer", "shorter", "length"):
        data = data[:place] if how == "shorter" else data + rng.randbytes(rng.choice([1, 4, 60]))
        _store(data, 1, len(data) - 9 if how != "length" else number(rng, len(data)), 8)
    changed = [] if how == "drop" else [bytes(data)] * (2 if how == "double" else 1)
    part.inner[at : at + 1] = changed
    return _mutant(model, seed, f"message {at}: {how} at {place}")


def _store(data: bytearray, at: int, value: int, size: int) -> None:
    at = max(0, min(at, len(data) - size))
    data[at : at + size] = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little")


def text_in_message(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """The JSON texts of starts, ends and infos; lengths follow."""
    model = seed.model()
    spots = [(part, i) for part in model.chunks() for i, data in enumerate(part.inner) if b"{" in data[35:]]
    spots = [(part, i) for part, i in spots if part.inner[i][0] == 5]
    if not spots:
        return message(rng, seed, _)
    part, i = rng.choice(spots)
    data = part.inner[i]
    start = data.index(b"{", 35)
    length = int.from_bytes(data[start - 4 : start], "little")
    text = json_text(rng, data[start : start + length - 1]) + b"\0"
    tail = data[start + length :] if rng.random() < 0.5 else b""
    body = data[9 : start - 4] + len(text).to_bytes(4, "little") + text + tail
    part.inner[i] = record(5, body)
    return _mutant(model, seed, f"text of message {i}: {text[:80]!r}")


def json_text(rng: random.Random, text: bytes) -> bytes:
    """A JSON text changed in one place, or something that is none."""
    how = rng.random()
    if how < 0.25:
        data = bytearray(text or b"{}")
        data[rng.randrange(len(data))] = rng.choice(b'{}[]",:\\0-9eE.$\0\xff')
        return bytes(data)
    if how < 0.35:
        deep = rng.choice([10, 63, 64, 65, 200, 1000, 100_000])
        return rng.choice([b"[" * deep + b"]" * deep, b'{"a":' * deep + b"1" + b"}" * deep])
    if how < 0.45:
        return rng.choice([
            b"", b"NaN", b"1e999", b"-" + b"9" * 5000, b'"\\ud800"', b"\xff\xfe{}", b"null", b"[]", b'{"a":1,"a":2}',
            b'{"":0}', b"1" * 400, b'{"a":' + b"9" * 4000 + b"}", b"true", b'{"$int":"' + b"f" * 9000 + b'"}',
        ])  # fmt: skip
    try:
        tree = json.loads(text)
    except ValueError:
        return rng.choice([b"{", b"[1", b"{}{}"])
    places: list[tuple[Any, Any]] = []
    _walk(tree, places)
    if not places:
        tree = _value(rng)
    for _ in range(rng.choice([1, 1, 2])):
        if places:
            holder, key = rng.choice(places)
            if rng.random() < 0.15:
                del holder[key]
                break
            holder[key] = _value(rng, holder[key])
    return json.dumps(tree).encode()


def _walk(value: Any, places: list[tuple[Any, Any]]) -> None:
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in pairs:
        places.append((value, key))
        _walk(item, places)


def _value(rng: random.Random, old: Any = 0) -> Any:
    simple: list[Any] = [
        None, True, False, -1, 1.5, "", "x" * 300, "inf", "-inf", "nan", [], {}, [[]], [old], [old, old], {"a": old},
        1e308, -0.0, "\ud800", "\0", "€" * 20, number(rng), -number(rng), 2**70, [number(rng)], "float128",
        rng.choice(_TYPES), "float16", "int64", [number(rng), number(rng)], [1] * 40, [0], [3, 0], list(range(50)),
    ]  # fmt: skip
    if isinstance(old, int) and rng.random() < 0.5:
        return number(rng, old)
    if rng.random() < 0.25:
        return {rng.choice(_TAGS): _tagged(rng, rng.choice(simple))}
    if rng.random() < 0.1:
        return {
            "type": rng.choice(_TYPES),
            "dtype": "float32",
            "shape": [number(rng)],
            "low": 0,
            "high": 1,
            "n": 3,
        }
    return rng.choice(simple)


def _tagged(rng: random.Random, value: Any) -> Any:
    numpy = {
        "dtype": rng.choice(
            ["<f8", "|b1", "<U3", "|S1", "<M8[ns]", "<m8[25s]", "|O", "<f16", ">i2", "<U99999999"]
        ),
        "shape": rng.choice([[], [1], [2], [0], [2**62, 4], [-1], [0, 2**62], [2**70, 0], None]),
        "data": rng.choice(["AAAAAAAAAAA=", "", "//////////8=", "!!", 3]),
    }
    choices = [
        value,
        [value],
        [[value, value]],
        [[[], 1]],
        numpy,
        "abc",
        "f" * 5000,
        [1.0, 2.0],
        [value, value],
    ]
    return rng.choice(choices)


def definitions(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """Schemas and channels, in the summary, outside of chunks and in them alike."""
    model = seed.model()
    bodies = [(opcode, body) for opcode, body in model.summary if opcode in (SCHEMA, CHANNEL)]
    bodies += [(part.opcode, part.body) for part in model.parts if part.opcode in (SCHEMA, CHANNEL)]
    if not bodies:
        return metadata(rng, seed, _)
    opcode, old = rng.choice(bodies)
    new, note = (_schema if opcode == SCHEMA else _channel)(rng, old)
    everywhere = rng.random() < 0.7
    model.summary = [(kind, new if body == old else body) for kind, body in model.summary]
    for part in model.parts if everywhere else ():
        if part.opcode == opcode and part.body == old:
            part.body = new
        part.inner = [record(opcode, new) if piece[9:] == old else piece for piece in part.inner]
    return _mutant(model, seed, f"{note}{'' if everywhere else ' (summary only)'}")


def _schema(rng: random.Random, body: bytes) -> tuple[bytes, str]:
    at, fields = 2, []
    for _ in range(2):
        size = int.from_bytes(body[at : at + 4], "little")
        fields.append(body[at + 4 : at + 4 + size])
        at += 4 + size
    text, how = body[at + 4 :], rng.choice(["id", "name", "text", "length"])
    schema_id = int.from_bytes(body[:2], "little")
    if how == "id":
        schema_id = number(rng, schema_id) & 0xFFFF
    elif how == "name":
        fields[rng.randrange(2)] = rng.choice([b"", b"\xff", b"x" * 70_000, b"a/b/C"])
    elif how == "text":
        text = rng.choice(
            [b"", text * 50, text[:-1], b"uint8[4294967295] a\n", b"\xff" + text, b"A a\n" * 1000]
        )
    size = len(text) if how != "length" else number(rng, len(text)) & 0xFFFFFFFF
    return schema_id.to_bytes(2, "little") + strings(*fields) + size.to_bytes(
        4, "little"
    ) + text, f"schema {how}"


def _channel(rng: random.Random, body: bytes) -> tuple[bytes, str]:
    ids, at, head = [body[:2], body[2:4]], 4, []
    for _ in range(2):
        size = int.from_bytes(body[at : at + 4], "little")
        head.append(body[at + 4 : at + 4 + size])
        at += 4 + size
    entries = _strings_of(body[at + 4 :])
    how = rng.choice(["id", "topic", "entry", "entry", "entry", "entry", "drop", "size"])
    if how == "id":
        ids[rng.randrange(2)] = (number(rng, ids[0][0]) & 0xFFFF).to_bytes(2, "little")
    elif how == "topic":
        topics = [
            b"/step",
            b"/env_0/step",
            b"/env_1/step",
            b"/final_state",
            b"/episode_start",
            b"",
            b"\xff",
            b"/info",
        ]
        head[0] = rng.choice([*topics, b"/x/step", b"/image/state", b"x" * 70_000])
    elif how == "entry" and entries:
        at = rng.randrange(len(entries) // 2) * 2 + 1
        entries[at] = json_text(rng, entries[at])
        how += f" {entries[at - 1]!r}: {entries[at][:120]!r}"
    elif how == "drop" and entries:
        at = rng.randrange(len(entries) // 2) * 2
        del entries[at : at + 2]
    data = strings(*entries)
    size = len(data) if how != "size" else number(rng, len(data)) & 0xFFFFFFFF
    return b"".join(ids) + strings(*head) + size.to_bytes(4, "little") + data, f"channel {how}"


def _strings_of(data: bytes) -> list[bytes]:
    found, at = [], 0
    while at + 4 <= len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        found.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return found


def metadata(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """The metadata record: versions, ids, places of journals. Its own checksum, where it has one, follows."""
    model = seed.model()
    parts = [part for part in model.parts if part.opcode == METADATA]
    if not parts:
        return chunk_head(rng, seed, _)
    part = rng.choice(parts)
    size = int.from_bytes(part.body[:4], "little")
    entries = _strings_of(part.body[8 + size :])
    values = [
        b"", b"0", b"2", b"1" * 5000, b"\xff", b"/dev/zero", b"/dev/stdin", b"../../x", b"/etc/passwd", b"x\0y",
        b"-1", b"\xd9\xa1", b"9" * 30, b"F" * 32, b"g" * 32, "é".encode() * 16, b"/" + b"a" * 5000,
    ]  # fmt: skip
    if rng.random() < 0.7 and entries:
        at = rng.randrange(len(entries) // 2) * 2 + 1
        entries[at] = rng.choice(values)
    elif rng.random() < 0.5:
        entries += [rng.choice([b"journal", b"uuid", b"format_version", b"x"]), rng.choice(values)]
    else:
        del entries[:2]
    pairs = dict(zip(entries[::2], entries[1::2], strict=False))
    if b"crc" in pairs and rng.random() < 0.8:
        pairs[b"crc"] = b"%08x" % checksum(pairs)
    data = strings(*[text for pair in pairs.items() for text in pair])
    length = len(data) if rng.random() < 0.9 else number(rng, len(data)) & 0xFFFFFFFF
    part.body = part.body[: 4 + size] + length.to_bytes(4, "little") + data
    return _mutant(model, seed, f"metadata: {data[-120:]!r}")


def checksum(pairs: dict[bytes, bytes]) -> int:
    """CRC-32 of the other pairs as they are stored, in the order of their keys."""
    rest = sorted((key, value) for key, value in pairs.items() if key != b"crc")
    return zlib.crc32(strings(*[text for pair in rest for text in pair]))


def attachment(rng: random.Random, seed: Seed, _: Sequence[Seed]) -> Mutant:
    """An attachment of a bad name or a bad `benchmark.json`."""
    model = seed.model()
    names = [
        b"../../x", b"/etc/passwd", b"a\0b", b"CON", b"", b"\xff", b"x" * 70_000, b"episodes.index", b"benchmark.json",
        b"artifacts/../../x", b"artifacts/" + b"0" * 64, b"env.cloudpickle",
    ]  # fmt: skip
    name = rng.choice(names)
    found = [part for part in model.parts if part.opcode == ATTACHMENT]
    old = b'{"name":"Pole-v0","spec":{"id":"Pole-v0"},"versions":{}}'
    for part in found:
        if b"benchmark.json" in part.body[:64]:
            old = part.body[part.body.index(b"{") : -4]
    data = json_text(rng, old) if name == b"benchmark.json" or rng.random() < 0.3 else rng.randbytes(20)
    size = len(data) if rng.random() < 0.8 else number(rng, len(data))
    times = struct.pack("<QQ", number(rng) & (2**64 - 1), 0)
    body = times + strings(name, b"text/plain") + struct.pack("<Q", size & (2**64 - 1)) + data + bytes(4)
    if found and rng.random() < 0.5:
        rng.choice(found).body = body
    else:
        at = next(i for i, part in enumerate(model.parts) if part.opcode == METADATA) + 1
        model.parts[at:at] = [FileRecord(ATTACHMENT, body)] * rng.choice([1, 1, 2])
    return _mutant(model, seed, f"attachment {name[:20]!r}: {data[:80]!r}")


def summary_field(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """A number in a record of the summary or in the footer, its CRC made right."""
    if seed.journal is not None:
        return journal_field(rng, seed, seeds)
    data = seed.data
    end = len(data) - 8 - 29
    start, offsets = struct.unpack_from("<QQ", data, end + 9)
    summary = bytearray(data[start:end])
    how = rng.choice(
        ["field", "field", "field", "length", "opcode", "double", "drop", "footer", "times a thousand"]
    )
    records = split(bytes(summary))
    opcode, at, body = rng.choice(records)
    if how == "field" and body:
        size = rng.choice([2, 4, 8, 8])
        _store(summary, at + 9 + rng.randrange(max(1, len(body) - size + 1)), number(rng, at), size)
    elif how == "length":
        _store(summary, at + 1, number(rng, len(body)), 8)
    elif how == "opcode":
        summary[at] = rng.choice([0, 1, 2, 3, 4, 5, 6, 8, 10, 11, 13, 14, 0x80, 0xFF])
    elif how in ("double", "times a thousand"):
        summary += record(opcode, body) * (1 if how == "double" else 1000)
    elif how == "drop":
        del summary[at : at + 9 + len(body)]
    else:
        start, offsets = rng.choice([(number(rng, start), offsets), (start, number(rng, offsets))])
    tail = footer(start & (2**64 - 1), offsets & (2**64 - 1), bytes(summary))
    real = struct.unpack_from("<Q", data, end + 9)[0]
    return Mutant(data[:real] + bytes(summary) + tail, None, False, f"summary: {how} of {opcode} at {at}")


def journal_field(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """The journal's description, its rows and the ends of its logs; the header's CRC follows."""
    if seed.journal is None:
        seed = rng.choice([other for other in seeds if other.journal is not None])
    journal = bytearray(seed.journal or b"")
    size = int.from_bytes(journal[8:12], "little")
    how = rng.choice(["json", "json", "json", "rows", "length"])
    if how == "json":
        text = json_text(rng, bytes(journal[16 : 16 + size]))
        journal[16 : 16 + len(text)] = text
        journal[8:16] = struct.pack("<II", len(text), zlib.crc32(text))
        how += f": {text[-200:]!r}"
    elif how == "length":
        _store(journal, 8, number(rng, size), 4)
    else:
        words = np.frombuffer(journal[4096 : len(journal) // 4 * 4], "<u4")
        used = (4096 + 4 * np.flatnonzero(words)).tolist()
        for _ in range(rng.choice([1, 1, 4])):
            _store(journal, rng.choice(used), number(rng, 4), rng.choice([4, 8]))
    return Mutant(seed.data, bytes(journal), False, f"journal of {seed.name}: {how}")


def chunks_moved(rng: random.Random, seed: Seed, seeds: Sequence[Seed]) -> Mutant:
    """Chunks lost, doubled, swapped or taken from another file, the index as it was or following."""
    model = seed.model()
    places = [i for i, part in enumerate(model.parts) if part.opcode == CHUNK]
    if not places:
        return definitions(rng, seed, seeds)
    i, j = rng.choice(places), rng.choice(places)
    how = rng.choice(["drop", "double", "swap", "foreign", "empty", "merge"])
    if how == "drop":
        del model.parts[i]
    elif how == "double":
        model.parts.insert(j, model.parts[i])
    elif how == "swap":
        model.parts[i], model.parts[j] = model.parts[j], model.parts[i]
    elif how == "foreign":
        chunks = rng.choice(seeds).model().chunks()
        model.parts[i] = rng.choice(chunks) if chunks else model.parts[i]
    elif how == "empty":
        model.parts[i].inner = []
    else:
        model.parts[i].inner = model.parts[i].inner + model.parts[j].inner
    return _mutant(model, seed, f"chunks {i} and {j}: {how}")


CRAFTED = {
    function.__name__: function
    for function in (
        index_row, index_shape, chunk_row, chunk_head, frames, message, text_in_message, definitions, metadata,
        attachment, summary_field, journal_field, chunks_moved,
    )
}  # fmt: skip
