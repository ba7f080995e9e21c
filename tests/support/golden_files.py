"""The golden recordings, with their journals, and what their environments returned."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import zstandard

from tupli_mcap import jsonvalue
from tupli_mcap.recording import Recording
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.recording.write.writer import RecordingWriter

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
NAMES = sorted(path.stem for path in GOLDEN.glob("*.mcap"))
EARLIER = sorted(  # of earlier writers
    (folder, path.stem)
    for folder in ("before_crc", "before_size", "before_repeat")
    for path in (GOLDEN / folder).glob("*.mcap")
)
UNFINISHED = [name for name in NAMES if name.startswith("unfinished")]
COLUMNS = ("states", "actions", "rewards", "terminals", "timeouts")


def expected(name: str, directory: Path = GOLDEN) -> list[dict[str, Any]]:
    text = (directory / f"{name}.json").read_text(encoding="utf-8")
    found: list[dict[str, Any]] = jsonvalue.loads(text)
    return found


def place(name: str, directory: Path, golden: Path = GOLDEN) -> Path:
    """A copy of a golden recording, its journal beside it."""
    path = Path(shutil.copy(golden / f"{name}.mcap", directory))
    if name in UNFINISHED:
        (directory / f"{name}.mcap.journal").write_bytes(unpacked_journal(name, golden))
    return path


def unpacked_journal(name: str, directory: Path) -> bytes:
    packed = (directory / f"{name}.mcap.journal.zst").read_bytes()
    return zstandard.ZstdDecompressor().decompress(packed)


def finished(name: str, directory: Path) -> Path:
    """The same, with a summary: an unfinished one is recovered."""
    path = place(name, directory)
    if name in UNFINISHED:
        RecordingWriter(path, RecordOptions(mode="a", compression="none")).close()
    return path


def as_read(recording: Recording) -> Iterator[dict[str, Any]]:
    """What `expected` has, from a recording: by sub-environment, in the order of its rows."""
    for episode in sorted(recording.episodes, key=lambda e: (e.env, e.number)):
        steps = list(episode)
        columns = {name: [step[i] for step in steps] for i, name in enumerate(COLUMNS)}
        yield {
            **columns,
            "seed": episode.seed,
            "options": episode.options,
            "reset_info": episode.reset_info,
            "final_state": episode.final_state,
            "end": episode.end,
            "env": episode.env,
            "metadata": episode.metadata,
            "return": episode.return_,
            "infos": episode.infos,
        }


def assert_same(found: list[dict[str, Any]], wanted: list[dict[str, Any]]) -> None:
    """The same types, dtypes, shapes and bytes: compared as exact JSON, entry by entry."""
    assert len(found) == len(wanted)
    for number, (one, other) in enumerate(zip(found, wanted, strict=True)):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert jsonvalue.dumps(value) == jsonvalue.dumps(other[key]), (number, key)
