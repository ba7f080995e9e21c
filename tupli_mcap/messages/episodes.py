"""`/episode_start` and `/episode_end`: their schemas, encoders and decoders, adjacent and in field order."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.records import BODY, CDR_HEADER, RECORD_HEADER
from tupli_mcap.messages import cdr

END_NAMES = ("terminal", "timeout", "interrupted")
TERMINAL, TIMEOUT, INTERRUPTED = range(3)

START_NAME = "tupli_mcap/msg/EpisodeStart"
START_SCHEMA = (
    "uint32 episode\nuint32 env\nuint64 first_row\nbool seed_given\nbool continued\n"
    "string seed\nstring options\nstring reset_info\n"
)
END_NAME = "tupli_mcap/msg/EpisodeEnd"
END_SCHEMA = (
    "uint32 episode\nuint32 env\nuint64 first_row\nuint64 length\nfloat64 episode_return\nuint8 end\n"
    "bool has_final_state\nstring metadata\n"
)

_SEED = re.compile(r"-?[0-9]{1,80}", re.ASCII)
START_FIELDS = struct.Struct("<IIQ??2x")
END_FIELDS = struct.Struct("<IIQQdB?2x")


def record(channel: int, sequence: int, time_ns: int, body: bytes) -> bytes:
    """A whole Message record around a CDR body."""
    head = RECORD_HEADER.pack(5, BODY - 9 + len(body), channel, sequence, time_ns, time_ns)
    return head + CDR_HEADER + body


def _strings(*texts: str) -> bytes:
    """CDR strings, one after the other, from an offset on that is a multiple of 4."""
    out = bytearray()
    for text in texts:
        cdr.write_string(out, 0, text)
    return bytes(out)


class EpisodeStart(NamedTuple):
    """A message of `/episode_start`.

    Attributes:
        first_row: row of the first step in the step channel of `env`.
        seed_given: `seed` was passed to `reset`; else the environment drew it.
        continued: the environment was stepped on after an end, without a reset, or the episode goes on from another
            file.
        seed: decimal text, empty if there is none.
        options, reset_info: exact JSON; `options` is empty if none were passed.
    """

    episode: int
    env: int
    first_row: int
    seed_given: bool
    continued: bool
    seed: str
    options: str
    reset_info: str

    @property
    def seed_number(self) -> int | None:
        """The seed as a number; None if there is none."""
        return int(self.seed) if _SEED.fullmatch(self.seed) else None

    def encode(self) -> bytes:
        return START_FIELDS.pack(*self[:5]) + start_texts(*self[5:])

    @classmethod
    def decode(cls, body: memoryview) -> EpisodeStart:
        if len(body) < START_FIELDS.size:
            raise FormatError(
                f"/episode_start: expected at least {START_FIELDS.size} bytes, found {len(body)}"
            )
        seed, at = cdr.read_string(body, START_FIELDS.size, 0)
        options, at = cdr.read_string(body, at, 0)
        reset_info, _ = cdr.read_string(body, at, 0)
        return cls._make([*START_FIELDS.unpack_from(body, 0), seed, options, reset_info])


_PLAIN_START, _PLAIN_TEXTS = _strings("", "", "{}"), _strings("", "{}")


def start_texts(seed: str, options: str, reset_info: str) -> bytes:
    """The end of an `EpisodeStart`'s CDR body, which follows its `START_FIELDS`."""
    if options or reset_info != "{}":
        return _strings(seed, options, reset_info)
    if not seed:
        return _PLAIN_START
    own = _strings(seed)
    return own + bytes(-len(own) % 4) + _PLAIN_TEXTS


class EpisodeEnd(NamedTuple):
    """A message of `/episode_end`: `end` indexes END_NAMES, `metadata` is plain JSON."""

    episode: int
    env: int
    first_row: int
    length: int
    episode_return: float
    end: int
    has_final_state: bool
    metadata: str

    def encode(self) -> bytes:
        return END_FIELDS.pack(*self[:7]) + end_texts(self.metadata)

    @classmethod
    def decode(cls, body: memoryview) -> EpisodeEnd:
        if len(body) < END_FIELDS.size:
            raise FormatError(f"/episode_end: expected at least {END_FIELDS.size} bytes, found {len(body)}")
        metadata, _ = cdr.read_string(body, END_FIELDS.size, 0)
        message = cls._make([*END_FIELDS.unpack_from(body, 0), metadata])
        if message.end >= len(END_NAMES):
            raise FormatError(f"/episode_end: expected an end of 0, 1 or 2, found {message.end}")
        return message


_PLAIN_END = _strings("{}")


def end_texts(metadata: str) -> bytes:
    """The end of an `EpisodeEnd`'s CDR body, which follows its `END_FIELDS`."""
    return _PLAIN_END if metadata == "{}" else _strings(metadata)
