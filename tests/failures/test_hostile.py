"""Files that lie about sizes, counts and places: refused by one error, in little memory and in linear time."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import lz4.frame
import numpy as np
import pytest
import zstandard
from counting import calls, grows
from fuzzing.crafted import checksum
from fuzzing.model import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    MESSAGE,
    SCHEMA,
    FileRecord,
    Model,
    load_seeds,
    record,
    strings,
)
from fuzzing.oracle import observe

import tupli_mcap
from tupli_mcap import EpisodeWriter, RecordEpisodes, TupliEnvWrapper
from tupli_mcap.arrays import Array
from tupli_mcap.cli.app import _report, app
from tupli_mcap.cli.output import begin_json
from tupli_mcap.dataset import TupliDataset
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.journal.file import RowArea, read_journal
from tupli_mcap.mcap.chunks import MAX_RATIO, ChunkClaim, decompress
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.records import MAGIC
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.mcap.walk import Walk
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.contents import Contents
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.schema import ArtifactMetadata
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.listing import list_recordings
from tupli_mcap.storage.verify import verify_paths

SEEDS = {seed.name: seed for seed in load_seeds()}
CAP, MULTIPLE = 64 << 20, 40  # bytes to open and list a file: as schemas/README.md has it
BIG = 2**64 - 1
REPEATED = b"tupli_mcap.recording.repeated"


def model(name: str = "constant_none") -> Model:
    return Model.of(SEEDS[name].data)


def with_episode(**fields: int) -> bytes:
    file = model()
    assert file.index is not None
    for name, value in fields.items():
        file.index.episodes[name][0] = value
    return file.encode()


def with_chunk(change: Callable[[Array], Any]) -> bytes:
    file = model()
    assert file.index is not None

    def changed(rows: Array) -> Array:
        found = change(rows)
        return rows if found is None else found

    file.index.change_chunks = changed
    return file.encode()


def setting(name: str, value: int) -> Callable[[Array], None]:
    def change(rows: Array) -> None:
        rows[name][0] = value

    return change


def on_the_first(name: str) -> Callable[[Array], None]:
    def change(rows: Array) -> None:
        rows[name][1] = rows[name][0]

    return change


def with_claim(place: int) -> bytes:
    file = model()
    assert file.index is not None
    file.index.claims[place] = 1 << 59
    return file.encode()


def with_space(space: Any, only: bytes = b"") -> bytes:
    """Whose step channel and final states (or `only` one of them) describe this space, with right checksums."""
    file = model()
    text = space if isinstance(space, bytes) else json.dumps(space).encode()
    for opcode, body in list(file.summary):
        if opcode != CHANNEL or b"observation_space" not in body or only not in body:
            continue
        at, texts = 4, []
        for _ in range(2):
            at += 4 + int.from_bytes(body[at : at + 4], "little")
        head, at = body[:at], at + 4
        while at < len(body):
            size = int.from_bytes(body[at : at + 4], "little")
            texts.append(body[at + 4 : at + 4 + size])
            at += 4 + size
        pairs = dict(zip(texts[::2], texts[1::2], strict=True)) | {b"observation_space": text}
        pairs[b"crc"] = b"%08x" % checksum(pairs)
        data = strings(*[one for pair in pairs.items() for one in pair])
        new = head + len(data).to_bytes(4, "little") + data
        file.summary = [(kind, new if old == body else old) for kind, old in file.summary]
    return file.encode()


def box(**fields: Any) -> dict[str, Any]:
    return {"type": "Box", "dtype": "float32", "shape": [4], "low": 0.0, "high": 1.0, **fields}


def nested(depth: int, stack: bool = False) -> dict[str, Any]:
    space = box(shape=[2**20] if stack else [1])
    for _ in range(depth):
        space = (
            {"type": "Sequence", "stack": True, "space": space}
            if stack
            else {"type": "Tuple", "spaces": [space]}
        )
    return space


def with_summary(opcode: int, times: int, change: Callable[[int, bytes], bytes]) -> bytes:
    """Records behind the first one of a kind in the summary."""
    file = model()
    at = next(i for i, (kind, _) in enumerate(file.summary) if kind == opcode)
    body = file.summary[at][1]
    file.summary[at + 1 : at + 1] = [(opcode, change(i, body)) for i in range(times)]
    return file.encode()


def attached(name: bytes, times: int = 1, claim: int = 1) -> bytes:
    file = model()
    body = bytes(16) + strings(name, b"text/plain") + struct.pack("<Q", claim) + b"x" + bytes(4)
    file.parts[2:2] = [FileRecord(ATTACHMENT, body)] * times
    return file.encode()


def with_texts(text: bytes) -> bytes:
    """The metadata of the first episode, and of no other."""
    file = model()
    assert file.index is not None
    file.index.texts = text
    file.index.episodes["metadata_offset"] = file.index.episodes["metadata_length"] = 0
    file.index.episodes["metadata_length"][0] = len(text)
    return file.encode()


def with_packed(name: str, value: int) -> bytes:
    """A claim of the first chunk of a file that is compressed."""
    file = model("constant_zstd")
    assert file.index is not None
    file.index.change_chunks = lambda rows: (setting(name, value)(rows), rows)[1]
    return file.encode()


def with_unused_texts() -> bytes:
    file = model()
    assert file.index is not None
    file.index.texts += b" " * 1000
    return file.encode()


def with_env(text: bytes) -> bytes:
    """The metadata of an image channel, with its checksum."""
    file = model("dict_with_images")
    for at, (opcode, body) in enumerate(file.summary):
        if opcode == CHANNEL and b"/image/" in body[:40]:
            leaf = body[4:].split(b"/image/")[1][: body[4] - len(b"/image/")]
            pairs = {b"env": text, b"leaf": leaf}
            pairs[b"crc"] = b"%08x" % checksum(pairs)
            data = strings(*[one for pair in pairs.items() for one in pair])
            topic = body[4 : 8 + body[4]]
            head = body[:4] + topic + strings(b"cdr")
            file.summary[at] = (opcode, head + len(data).to_bytes(4, "little") + data)
    return file.encode()


def footer(start: int) -> bytes:
    data = SEEDS["constant_none"].data
    return data[: -8 - 20] + struct.pack("<Q", start) + data[-8 - 12 :]


def channels(count: int) -> bytes:
    return with_summary(
        CHANNEL,
        count,
        lambda i, _: struct.pack("<HH", 100 + i, 0) + strings(b"/%d" % i, b"cdr") + bytes(4),
    )


def leaves(count: int) -> bytes:
    """Keys whose names all have to be told apart."""
    one = {"type": "Discrete", "dtype": "int64", "n": 2, "start": 0}
    return with_space(
        {"type": "Dict", "spaces": [["-" * (i % 50) + "a" + "." * (i // 50), one] for i in range(count)]}
    )


def chunks(count: int) -> bytes:
    def change(rows: Array) -> Array:
        return np.concatenate([rows, np.repeat(rows[:1], count)])

    return with_chunk(change)


REFUSED: dict[str, Callable[[], bytes]] = {
    "an episode that ends beyond 2**64": lambda: with_episode(first_row=BIG, length=2),
    "an episode of 2**63 steps": lambda: with_episode(length=1 << 63),
    "an episode without a step": lambda: with_episode(length=0),
    "an episode of another sub-environment": lambda: with_episode(env=7),
    "two episodes with the same steps": lambda: with_episode(length=4),
    "a final state that is not there": lambda: with_episode(final_row=1 << 40),
    "an episode count beyond the file": lambda: with_claim(1),
    "one text for all episodes": lambda: with_episode(metadata_offset=0, metadata_length=90),
    "a chunk count beyond the file": lambda: with_claim(2),
    "texts beyond the file": lambda: with_claim(3),
    "a chunk beyond the file": lambda: with_chunk(setting("offset", 1 << 40)),
    "a chunk in a journal's place": lambda: with_chunk(setting("offset", 1 << 63)),
    "a chunk of 2**63 bytes": lambda: with_chunk(setting("length", 1 << 63)),
    "a chunk of 2**40 bytes unpacked": lambda: with_chunk(setting("uncompressed", 1 << 40)),
    "more bytes than its compressed ones hold": lambda: with_packed("uncompressed", 1 << 27),
    "bytes that are not compressed, and others": lambda: with_chunk(setting("uncompressed", 100)),
    "more rows than its compressed bytes tell apart": lambda: with_packed("rows", 1 << 20),
    "rows of another size": lambda: with_packed("rows", 2),
    "metadata that no episode has": lambda: with_unused_texts(),
    "an image channel of no sub-environment": lambda: with_env(b"null"),
    "more rows than bytes": lambda: with_chunk(setting("rows", 1 << 31)),
    "a skip beyond the chunk": lambda: with_chunk(setting("skip", 1 << 31)),
    "a compression without a name": lambda: with_chunk(setting("compression", 9)),
    "chunks on one another": lambda: with_chunk(on_the_first("offset")),
    "a chunk in the index and not in the file": lambda: chunks(1),
    "a summary beyond the file": lambda: footer(1 << 50),
    "a summary in the data": lambda: footer(8),
    "a space that is no object": lambda: with_space(b"[]"),
    "final states of another space than the steps": lambda: with_space(box(high=2.0), b"/final_state"),
    "a space nested 65 times": lambda: with_space(nested(65)),
    "a space nested 100,000 times": lambda: with_space(b'{"type":"Tuple","spaces":[' * 100_000),
    "a space of 2**62 elements": lambda: with_space(box(shape=[2**31, 2**31])),
    "a space that Gymnasium copies again and again": lambda: with_space(nested(6, stack=True)),
    "a space of 2**26 numbers in a few bytes": lambda: with_space(box(shape=[2**26])),
    "a MultiDiscrete of 2**26 numbers": lambda: with_space(
        {"type": "MultiDiscrete", "dtype": "int64", "shape": [2**26], "nvec": 3, "start": 0}
    ),
    "a bound of 4,000 digits": lambda: with_space(
        b'{"type":"Discrete","dtype":"int64","start":0,"n":' + b"9" * 4000 + b"}"
    ),
    "a channel id twice": lambda: with_summary(
        CHANNEL, 1, lambda _, body: body[:2] + body[2:].replace(b"/step", b"/stop")
    ),
    "a topic twice": lambda: with_summary(CHANNEL, 1, lambda _, body: b"\x63\0" + body[2:]),
    "a schema id twice": lambda: with_summary(SCHEMA, 1, lambda _, body: body + b"bool more\n"),
    "schemas of many sizes": lambda: with_summary(SCHEMA, 1, lambda _, body: body[:2] + b"\xff" * 8 + body[10:]),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_claims_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(REFUSED[name]())
    with pytest.raises(
        FormatError,
        match="expected|claims|places|lists|names|gives|not that of its spaces|describes|without gaps|"
        "bytes, not|its CRC differs",
    ):
        Recording(path)


MEASURE = """
import sys, warnings
from pathlib import Path
from tupli_mcap.errors import FormatError
from tupli_mcap.recording import Recording
warnings.simplefilter("ignore")
def peak():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))
def read(path):
    try:
        with Recording(path) as recording:
            recording.all_metadata(), [e.number for e in recording.episodes], recording.attachments
    except FormatError:
        pass
read(sys.argv[1])
for path in sys.argv[1:]:
    Path("/proc/self/clear_refs").write_text("5")
    before = peak()
    read(path)
    print(peak() - before)
"""


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="peak memory is measured as Linux tells it"
)
def test_memory_is_bounded_by_the_file(tmp_path: Path) -> None:
    made = {**REFUSED, "channels": lambda: channels(30_000), "leaves": lambda: leaves(2_000)}
    made |= {
        "attachments": lambda: attached(b"a", 5_000),
        "texts": lambda: with_texts(b'{"a":0}' + b" " * (1 << 22)),
    }
    paths = []
    for i, make in enumerate(made.values()):
        paths.append(tmp_path / f"{i}.mcap")
        paths[-1].write_bytes(make())
    command = [sys.executable, "-c", MEASURE, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    for name, path, taken in zip(made, paths, done.stdout.split(), strict=True):
        limit = CAP + MULTIPLE * path.stat().st_size
        assert int(taken) <= limit, f"{name}: {int(taken) >> 20} MiB for {path.stat().st_size} bytes"


@pytest.mark.parametrize("make", [channels, leaves, lambda n: attached(b"a", n), chunks])
def test_work_grows_as_the_file_does(make: Callable[[int], bytes], tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"

    def opened() -> None:
        with contextlib.suppress(FormatError):
            Recording(path).close()

    def done(count: int) -> int:
        path.write_bytes(make(count))
        return calls(opened)

    done(10)  # what is done once in a process
    assert grows(done, 500) < 1.3


@pytest.mark.parametrize("name", ["zstd", "lz4"])
@pytest.mark.parametrize("wrong", [-1, 1, 10**6, 2**31 - 1001])
def test_a_size_that_lies_either_way(name: str, wrong: int) -> None:
    data = bytes(range(250)) * 4
    plain: dict[str, bytes] = {
        "zstd": zstandard.ZstdCompressor().compress(data),
        "lz4": lz4.frame.compress(data, store_size=False),
    }
    assert bytes(decompress(name, memoryview(plain[name]), len(data), "here")) == data
    refusal = "here: (expected|the compressed data is damaged|[0-9]+ compressed bytes cannot hold)"
    with pytest.raises(FormatError, match=refusal):
        decompress(name, memoryview(plain[name]), len(data) + wrong, "here")
    if name == "zstd":  # the frame says what the file says, and holds something else
        unsized = zstandard.ZstdCompressor(write_content_size=False).compress(data)
        with pytest.raises(FormatError, match=refusal):
            decompress(name, memoryview(unsized), len(data) + wrong, "here")
        lying = bytearray(plain[name])
        lying[5:7] = struct.pack("<H", (len(data) - 256 + wrong) & 0xFFFF)
        claimed = zstandard.frame_content_size(bytes(lying))
        with pytest.raises(FormatError, match=refusal):
            decompress(name, memoryview(bytes(lying)), claimed, "here")


@pytest.mark.parametrize("name", ["zstd", "lz4"])
def test_nothing_follows_the_frame_of_a_chunk(name: str) -> None:
    """Readers that go on to the next frame would see other messages."""
    data = bytes(range(250)) * 4
    plain = zstandard.ZstdCompressor().compress(data) if name == "zstd" else lz4.frame.compress(data)
    assert bytes(decompress(name, memoryview(plain), len(data), "here")) == data
    for more in (plain, b"x"):
        with pytest.raises(FormatError, match="here: .*(unused data|bytes behind it)"):
            decompress(name, memoryview(plain + more), len(data), "here")


@pytest.mark.parametrize("damaged", [b"\0\x40\0\0", b"\0\0"])
def test_an_lz4_frame_has_its_end(damaged: bytes) -> None:
    """Other readers refuse a chunk without it, or read on in what follows."""
    data = bytes(range(250)) * 4
    plain = lz4.frame.compress(data)
    assert plain.endswith(bytes(4))
    with pytest.raises(FormatError, match="here: expected the end of the lz4 frame"):
        decompress("lz4", memoryview(plain[:-4] + damaged), len(data), "here")


@pytest.mark.parametrize(
    "name", [b"../../x", b"/etc/passwd", b"a\0b", b"CON", b"", b"\xff", b"x" * 70_000, b"artifacts/../../x"]
)
def test_attachment_names_are_no_paths(name: bytes, tmp_path: Path) -> None:
    directory = tmp_path / "a" / "b"
    directory.mkdir(parents=True)
    path = directory / "hostile.mcap"
    path.write_bytes(attached(name))
    before = sorted(tmp_path.rglob("*"))
    facts, refused = observe(path)
    assert facts["open"] or refused
    assert sorted(tmp_path.rglob("*")) == before


def test_to_replace_an_attachment_leaves_nothing_else_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A summary may say that an attachment ends behind other records."""
    path, summary = tmp_path / "a.mcap", Container.summary

    def lying(self: Container, start: int) -> bytes:
        (index,) = self.attachment_indexes[:1]
        index.length += 1000
        return summary(self, start)

    with EpisodeWriter(
        path, gym.spaces.Discrete(2), gym.spaces.Discrete(2), attachments={"a": ("", b"")}
    ) as writer:
        writer.begin()
        writer.step(0, 0, 1.0)
        monkeypatch.setattr(Container, "summary", lying)
    monkeypatch.undo()
    data = path.read_bytes()
    with pytest.raises(FormatError, match=r"a\.mcap: expected an attachment of \d+ bytes at offset \d+"):
        add_attachments(path, {"a": ("", b"b")})
    assert path.read_bytes() == data


@pytest.mark.parametrize(
    "text",
    [b"", b"null", b"[1]", b"\xff", b"NaN", b"[" * 100_000, b'{"a":' * 300 + b"1" + b"}" * 300, b"9" * 5_000],
)
def test_metadata_that_is_no_object(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(with_texts(text))
    with Recording(path) as recording:
        assert len(recording.read().rewards) == recording.n_steps
        if text:
            with pytest.raises(FormatError, match="hostile.mcap: metadata of episode 0: expected"):
                _ = recording.episodes[0].metadata


@pytest.mark.parametrize("text", [b"", b"{", b'{"$x":1}'])
def test_a_reset_info_that_is_no_json(text: bytes, tmp_path: Path) -> None:
    file, path = model(), tmp_path / "hostile.mcap"
    said = strings(b"{}\0")  # the last field of the start of episode 0
    for part in file.chunks():
        for k, piece in enumerate(part.inner):
            if piece.endswith(said):
                part.inner[k] = record(piece[0], piece[9 : -len(said)] + strings(text + b"\0"))
    path.write_bytes(file.encode())
    assert "expected JSON" in str(verify_recording(path).problems)
    with (
        Recording(path) as recording,
        pytest.raises(FormatError, match="hostile.mcap: reset_info of episode 0: "),
    ):
        _ = recording.episodes[0].reset_info


@pytest.mark.parametrize("time_ns", [0, 1, -(2**63), 2**63 - 1])
def test_times_at_the_limits(time_ns: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(with_episode(start_time=time_ns, end_time=time_ns))
    for words in (["info"], ["episodes"], ["ls", "--json"]):
        with pytest.raises(SystemExit) as stopped:
            app([*words, str(path)])
        assert not stopped.value.code, capsys.readouterr().err
    (tmp_path / "storage").mkdir()
    with FileStorage(tmp_path / "storage") as storage:
        path.rename(tmp_path / "storage" / "hostile.mcap")
        assert len(storage.list_episodes()) == 3


def test_pipes_devices_and_directories_are_no_recordings(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "directory.mcap").mkdir()
    (tmp_path / "nowhere.mcap").symlink_to(tmp_path / "missing")
    (tmp_path / "loop.mcap").symlink_to(tmp_path / "loop.mcap")
    for name in ("pipe.mcap", "directory.mcap", "nowhere.mcap", "loop.mcap", "a\0b"):
        with pytest.raises(RecordingError, match="cannot be opened|is a directory|does not exist"):
            Recording(tmp_path / name)
    with pytest.raises(OSError, match="no file"):  # where a recording may say that its journal is
        read_journal(Path("/dev/zero"))
    assert [item for item in list_recordings([tmp_path]) if item.error is None] == []
    with FileStorage(tmp_path) as storage:
        assert storage.list_episodes() == []


@pytest.mark.parametrize("make", ["pipe", "device", "directory", "holes"])
def test_what_lies_beside_recordings_may_be_anything(make: str, tmp_path: Path) -> None:
    """Nobody waits for the writer of a pipe, or reads without an end."""

    def put(path: Path) -> Path:
        path.unlink(missing_ok=True)
        if make == "pipe":
            os.mkfifo(path)
        elif make == "directory":
            path.mkdir()
        elif make == "device":
            path.symlink_to("/dev/zero")
        else:
            path.touch()
            os.truncate(path, 1 << 40)
        return path

    (tmp_path / "one.mcap").write_bytes(SEEDS["constant_zstd"].data)
    with FileStorage(tmp_path) as storage:
        artifact = storage.store_artifact(b"wind", ArtifactMetadata(name="wind"))
        TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage).store(name="cart")
    of_artifact, (benchmark,) = tmp_path / f"artifacts/{artifact.id}.json", tmp_path.glob("benchmarks/*")
    put(of_artifact)
    put(benchmark)
    with FileStorage(tmp_path) as storage, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert (storage.list_artifacts(), storage.list_benchmarks()) == ([], [])
        assert not all(report.ok for report, _ in verify_paths([tmp_path]))
    put(tmp_path / "one.mcap.json")
    with pytest.warns(UserWarning, match=r"skipped a recording: .*one\.mcap\.json: expected a file"):
        assert not tupli_mcap.open(tmp_path).headers
    put(tmp_path / "deleting.json")
    with pytest.raises(FormatError, match=r"deleting\.json: expected a file"):
        tupli_mcap.open(tmp_path)


def test_one_recording_twice_in_a_storage(tmp_path: Path) -> None:
    for name in ("one.mcap", "two.mcap"):
        (tmp_path / name).write_bytes(SEEDS["constant_zstd"].data)
    with FileStorage(tmp_path) as storage:
        with pytest.warns(UserWarning, match="skipped a copy: .* holds episodes of one.mcap again"):
            assert len(storage.list_episodes()) == 3


def test_zeros_do_not_switch_a_check_off(tmp_path: Path) -> None:
    """An attachment's data and its CRC after it, lost to a run of zeros."""
    data = bytearray(SEEDS["constant_none"].data)
    at = data.index(b"golden") + 5
    data[at : at + 5] = bytes(5)
    path = tmp_path / "hostile.mcap"
    path.write_bytes(data)
    with Recording(path) as recording, pytest.raises(FormatError, match="'note' .* is damaged"):
        recording.read_attachment("note")


def test_chunks_of_one_size_are_not_swapped(tmp_path: Path) -> None:
    data = SEEDS["dict_with_images"].data
    with Recording(Path(__file__).parents[1] / "golden" / "dict_with_images.mcap") as recording:
        table = recording._contents.table
        places = [(int(row["offset"]), int(row["length"])) for row in table]
        kinds = [
            (row["length"], row["uncompressed"], row["channel"], row["rows"], row["skip"]) for row in table
        ]
    i, j = next((i, j) for i in range(len(kinds)) for j in range(i) if kinds[i] == kinds[j])
    (a, size), (b, _) = places[j], places[i]
    swapped = data[:a] + data[b : b + size] + data[a + size : b] + data[a : a + size] + data[b + size :]
    path = tmp_path / "hostile.mcap"
    path.write_bytes(swapped)
    with (
        Recording(path) as recording,
        pytest.raises(FormatError, match="its CRC differs; the chunk is damaged"),
    ):
        recording.read()


@pytest.mark.parametrize("key", [b"created_ns", b"uuid", b"benchmark_id", b"crc"])
def test_damaged_metadata_is_seen(key: bytes, tmp_path: Path) -> None:
    """Of the record at the end, which readers go by, and of the first one, by verification."""
    data = bytearray(SEEDS["constant_zstd"].data)
    path = tmp_path / "hostile.mcap"
    for first in (True, False):
        at = data.index(key, 0 if first else data.index(REPEATED))
        for place in (at + len(key) + 4 + 3, at + 1):  # in the value, in the key
            damaged = data.copy()
            damaged[place] ^= 1
            path.write_bytes(damaged)
            assert any(problem.kind == "metadata" for problem in verify_recording(path).errors)
            if not first:
                with pytest.raises(FormatError, match="is damaged|expected a key 'crc'"):
                    Recording(path)


def test_a_missing_key_of_the_metadata_is_seen(tmp_path: Path) -> None:
    """Also where no checksum shows it: a known key is there instead."""
    data = (Path(__file__).parents[1] / "golden" / "before_crc" / "constant_zstd.mcap").read_bytes()
    path = tmp_path / "hostile.mcap"
    path.write_bytes(data.replace(b"benchmark_id", b"next_episode"))
    with pytest.raises(FormatError, match="expected 'benchmark_id' in the metadata record"):
        Recording(path)
    assert not verify_recording(path).ok


def test_a_length_that_swallows_the_checksum(tmp_path: Path) -> None:
    data = bytearray(SEEDS["vector_same_step"].data)
    at = data.index(b"benchmark_id", data.index(REPEATED)) + len(b"benchmark_id")
    assert data[at : at + 4] == bytes(4)
    data[at] = 4 + len("crc") + 4 + 8
    path = tmp_path / "hostile.mcap"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="expected a key 'crc'"):
        Recording(path)


def test_records_beyond_the_file(tmp_path: Path) -> None:
    """In a file without an end, lengths are claims too."""
    file = model()
    file.parts, file.index = file.parts[:2], None
    for opcode in (3, 4, 5, 6, 9, 12, 0xFF):
        path = tmp_path / f"{opcode}.mcap"
        path.write_bytes(
            file.encode() + struct.pack("<BQ", opcode, BIG - 8) + bytes(100) + record(6, bytes(60))
        )
        with Recording(path) as recording:
            assert not recording.complete
            assert len(recording) == 0


def test_an_index_that_names_a_chunk_of_no_bytes_is_walked_past(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(model().encode())
    with contextlib.closing(PathSource(path)) as source:
        walk = Walk(source, known={len(MAGIC): ChunkClaim(0, 0, "", 0)})
        assert len(list(itertools.islice(walk, 1000))) < 1000


def test_a_chunk_of_a_channel_that_is_not_defined(tmp_path: Path) -> None:
    file = model()
    assert file.index is not None
    chunk = file.chunks()[0]
    rows = [piece[:9] + b"\x4d\0" + piece[11:] for piece in chunk.inner if piece[0] == MESSAGE]
    file.parts.append(FileRecord(CHUNK, b"", rows, chunk.compression, chunk.times))
    listed = file.index.chunks[:1].copy()
    listed["channel"] = 77
    file.index.chunks = np.concatenate([file.index.chunks, listed])
    path = tmp_path / "a.mcap"
    path.write_bytes(file.encode())
    with Recording(path) as recording:  # other channels are ignored
        assert recording.n_steps > 0
    with pytest.raises(FormatError, match="found one of channel 77"):
        add_attachments(path, {"a": ("text/plain", b"")})


def test_zeros_compress_as_far_as_they_do() -> None:
    """Honest extremes are within the bounds: a chunk of zeros by each compressor."""
    data = bytes(1 << 26)
    for name, packed in (
        ("zstd", zstandard.ZstdCompressor(level=-1).compress(data)),
        ("zstd", zstandard.ZstdCompressor(level=19).compress(data)),
        ("lz4", lz4.frame.compress(data, compression_level=12, block_size=lz4.frame.BLOCKSIZE_MAX4MB)),
    ):
        assert len(data) <= MAX_RATIO[name] * len(packed)
        assert len(data) > MAX_RATIO[name] // 2 * len(packed)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_recording_of_nothing_but_zeros(compression: str, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Zeros(), path, compression=compression, chunk_size=1 << 22) as env:
        for _ in range(3):
            env.reset()
            for _ in range(2000):
                env.step(0)
    with Recording(path) as recording:
        assert not recording.read().states.any()
    assert verify_recording(path).ok


class Zeros(gym.Env[Any, Any]):
    observation_space = gym.spaces.Box(0, 255, (16, 16, 3), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros((16, 16, 3), np.uint8), {}

    def step(self, action: Any) -> Any:
        return np.zeros((16, 16, 3), np.uint8), 0.0, False, False, {}


def test_lengths_of_maps_are_looked_at(tmp_path: Path) -> None:
    """Every bit of the length of the map in the last metadata record, and in a channel outside of chunks."""
    data = SEEDS["constant_zstd"].data
    for bit in range(8):
        damaged = bytearray(data)
        damaged[data.index(REPEATED) + len(REPEATED)] ^= 1 << bit
        path = tmp_path / "a.mcap"
        path.write_bytes(damaged)
        with pytest.raises(FormatError, match="damaged|expected|has \\d+ bytes"):
            Recording(path)
        assert not verify_recording(path).ok
    channel = data.index(b"/step")
    at = channel + len("/step") + 4 + len("cdr")
    assert data[channel + len("/step") : at] == b"\3\0\0\0cdr"
    for bit in range(8):
        damaged = bytearray(data)
        damaged[at] ^= 1 << bit
        path.write_bytes(damaged)
        assert not verify_recording(path).ok


@pytest.mark.parametrize("change", [('"halves": 1', '"halves": 0'), ('"channels": 1', '"channels": 0')])
def test_areas_of_nothing(change: tuple[str, str], tmp_path: Path) -> None:
    """An area of a journal has rows, or records, in some half."""
    seed = next(one for one in load_seeds() if one.name == "unfinished")
    assert seed.journal is not None
    head = struct.Struct("<8sII")
    magic, length, _ = head.unpack_from(seed.journal)
    before = seed.journal[head.size : head.size + length].decode()
    text = before.replace(*change).encode()
    assert before != text.decode()
    path = tmp_path / "a.mcap"
    path.write_bytes(seed.data)
    journal = head.pack(magic, length, zlib.crc32(text)) + text + seed.journal[head.size + length :]
    path.with_name("a.mcap.journal").write_bytes(journal)
    with pytest.raises(FormatError, match="expected areas"):
        read_journal(path.with_name("a.mcap.journal"))
    verify_recording(path)


def test_holes_of_a_journal_take_no_memory(tmp_path: Path) -> None:
    area = RowArea("steps", 64, 1 << 24)
    path = tmp_path / "a.journal"
    text = json.dumps({"info": {}, "areas": [{"kind": "rows", **area._asdict()}]}).encode()
    head = struct.pack("<8sII", b"TMCAPJ1\0", len(text), zlib.crc32(text)) + text
    with path.open("wb") as file:
        file.write(head)
        file.seek(4096 + 100)
        file.write(b"here")
        file.truncate(4096 + area.size)
    if path.stat().st_blocks * 512 > area.size:
        pytest.skip("this file system has no holes")
    script = MEASURE.split("def read")[0] + (
        "from tupli_mcap.journal.file import read_journal\n"
        "Path('/proc/self/clear_refs').write_text('5')\nbefore = peak()\n"
        "found = read_journal(Path(sys.argv[1])).data['steps']\n"
        "assert found[100:104].tobytes() == b'here' and not found[200:300].any()\nprint(peak() - before)\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    assert int(done.stdout) < 64 << 20


@pytest.mark.parametrize("place", ["open", "read", "window", "load"])
def test_memory_that_runs_out_is_told(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By one error of ours, which says what the memory was for."""
    path = tmp_path / "a.mcap"
    path.write_bytes(SEEDS["constant_zstd"].data)

    def refuse(*_: Any, **__: Any) -> Any:
        raise MemoryError("Unable to allocate 18.3 GiB")

    if place == "open":
        monkeypatch.setattr(ChunkStore, "__init__", refuse)
        with pytest.raises(
            RecordingError, match=r"opening a file of \d+ bytes needs more memory than there is"
        ):
            Recording(path)
        return
    dataset = TupliDataset.from_files(path)
    with Recording(path) as recording:
        monkeypatch.setattr(ChunkStore, "rows", refuse)
        with pytest.raises(RecordingError, match=r"of \d+ steps needs more memory than there is \(Unable"):
            if place == "read":
                recording.read()
            elif place == "window":
                recording.episodes[0][:1]
            else:
                dataset.convert_to_numpy()


def test_the_command_line_tells_that_memory_ran_out(
    capsys: pytest.CaptureFixture[str],
) -> None:
    begin_json("info")
    assert _report(MemoryError("Unable to allocate 18.3 GiB"), [], as_json=True) == 1
    out, err = capsys.readouterr()
    assert "error: not enough memory" in err
    assert json.loads(out)["error"]["type"] == "MemoryError"


def test_a_chunk_whose_rows_are_not_consecutive_ends_what_is_read(tmp_path: Path) -> None:
    """No writer makes it, its CRC is right, and nothing says that the recording was finished."""
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path, chunk_size=3000) as env:
        for seed in range(20):
            env.reset(seed=seed)
            while not any(env.step(env.action_space.sample())[2:4]):
                pass
    with Recording(path) as recording:
        whole, rows = recording.read().states, recording._contents.table
        first, second, *_ = np.flatnonzero(rows["channel"] == recording._topics["/step"])
    file = Model.of(path.read_bytes())
    file.index = None
    for expected in (len(whole), int(rows["rows"][first])):
        path.write_bytes(file.encode())
        with pytest.warns(UserWarning, match="has no journal"), Recording(path) as recording:
            assert np.array_equal(recording.read().states, whole[:expected])
        chunk = file.chunks()[second]
        row = bytearray(chunk.inner[1])
        row[11] ^= 128  # its sequence
        chunk.inner[1] = bytes(row)


def test_numbers_of_episodes_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def record_to(path: Path) -> None:
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
            env.reset(seed=1)
            env.step(0)

    paths = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path in paths:
        record_to(tmp_path / f"{path.stem}.first.mcap")
        with Recording(tmp_path / f"{path.stem}.first.mcap") as recording, monkeypatch.context() as patch:
            patch.setattr(Contents, "next_episode", 1 << 31)
            rewrite_recording(recording, path)
        record_to(path)
        with Recording(path) as recording:
            assert recording.index["episode"].tolist() == [0, 1 << 31]
        with pytest.raises(
            RecordingError, match="numbers of episodes up to 2147483648, .* record to another file"
        ):
            record_to(path)
    with pytest.raises(RecordingError, match="numbers of episodes below 4294967296, .* merge fewer"):
        tupli_mcap.open(paths).save(tmp_path / "both.mcap")
