"""Recordings with a changed step and correct checksums, which no writer makes."""

from __future__ import annotations

import struct
from pathlib import Path

from fuzzing.model import FileRecord, Model

__all__ = ["Model", "find_step", "set_flags"]

_MESSAGE = 5
_EPISODE = 35  # the offset of the episode and the step in the record of a message


def find_step(model: Model, episode: int, step: int) -> tuple[FileRecord, int]:
    """The chunk of a step, and the step's place in it."""
    assert model.index is not None
    topics = {int.from_bytes(body[:2], "little"): body for opcode, body in model.summary if opcode == 4}
    for part in model.chunks():
        for k, piece in enumerate(part.inner):
            is_step = piece[0] == _MESSAGE and b"/step" in topics[int.from_bytes(piece[9:11], "little")][:40]
            if is_step and struct.unpack_from("<II", piece, _EPISODE) == (episode, step):
                return part, k
    raise LookupError(f"no step {step} of episode {episode}")


def set_flags(path: Path, episode: int, step: int, *, terminal: bool = False, timeout: bool = False) -> Path:
    """Changes the flags of a step."""
    model = Model.of(path.read_bytes())
    part, k = find_step(model, episode, step)
    part.inner[k] = part.inner[k][:-2] + bytes([terminal, timeout])
    path.write_bytes(model.encode())
    return path
