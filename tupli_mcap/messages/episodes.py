"""`/episode_start` and `/episode_end`: their schemas, encoders and decoders, adjacent and in field order."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.records import BODY, CDR_HEADER, RECORD_HEADER

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
_LENGTH = struct.Struct("<I")


def record(channel: int, sequence: int, time_ns: int, body: bytes) -> bytes:
    """A whole Message record around a CDR body."""
    head = RECORD_HEADER.pack(5, BODY - 9 + len(body), channel, sequence, time_ns, time_ns)
    return head + CDR_HEADER + body


def _strings(offset: int, *texts: bytes) -> bytes:
    out = bytearray()
    for text in texts:
        out += bytes(-(offset + len(out)) % 4)
        out += _LENGTH.pack(len(text) + 1) + text + b"\0"
    return bytes(out)


def read_strings(body: memoryview, offset: int, count: int) -> list[str]:
    """`count` CDR strings from `offset` on.

    Raises:
        FormatError: a length beyond the message, a missing NUL, or text that is not UTF-8.
    """
    texts = []
    for _ in range(count):
        offset += -offset % 4
        if offset + 4 > len(body):
            raise FormatError(f"expected a string at byte {offset} of a message of {len(body)} bytes")
        (length,) = _LENGTH.unpack_from(body, offset)
        offset += 4
        if length < 1 or offset + length > len(body) or body[offset + length - 1] != 0:
            raise FormatError(
                f"expected a string of {length} bytes with its NUL at byte {offset} of a message"
            )
        try:
            texts.append(str(body[offset : offset + length - 1], "utf-8"))
        except UnicodeDecodeError as err:
            raise FormatError(f"expected UTF-8 text at byte {offset} of a message: {err.reason}") from err
        offset += length
    return texts


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
        texts = read_strings(body, START_FIELDS.size, 3)
        return cls._make([*START_FIELDS.unpack_from(body, 0), *texts])


_PLAIN_START = _strings(START_FIELDS.size, b"", b"", b"{}")


def start_texts(seed: str, options: str, reset_info: str) -> bytes:
    """The end of an `EpisodeStart`'s CDR body, which follows its `START_FIELDS`."""
    if seed == "" and options == "" and reset_info == "{}":
        return _PLAIN_START
    return _strings(START_FIELDS.size, seed.encode(), options.encode(), reset_info.encode())


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
        message = cls._make([*END_FIELDS.unpack_from(body, 0), *read_strings(body, END_FIELDS.size, 1)])
        if message.end >= len(END_NAMES):
            raise FormatError(f"/episode_end: expected an end of 0, 1 or 2, found {message.end}")
        return message


_PLAIN_END = _strings(END_FIELDS.size, b"{}")


def end_texts(metadata: str) -> bytes:
    """The end of an `EpisodeEnd`'s CDR body, which follows its `END_FIELDS`."""
    return _PLAIN_END if metadata == "{}" else _strings(END_FIELDS.size, metadata.encode())
