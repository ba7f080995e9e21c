"""Step infos: entries that the user named have typed fields in `/info`, all others are JSON.

A typed field of an entry that is missing or no float64 is marked absent; the JSON then holds the entry.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError
from tupli_mcap.messages import cdr
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.spaces.leaves import NameRegistry

_FIELD = struct.Struct("<d?7x")


def with_text_keys(info: Mapping[Any, Any]) -> dict[str, Any]:
    """An info as people are shown it: an environment may have keys that are no text, such as the numbers of agents."""
    return {str(key): value for key, value in info.items()}


def paths_in(info: Mapping[Any, Any], before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys, as texts, that lead to each entry of an info, and to each of the dicts in it."""
    for key, value in info.items():
        yield (path := (*before, str(key)))
        if isinstance(value, dict):
            yield from paths_in(value, path)


class InfoCodec:
    """Encodes and decodes `/info` messages.

    Args:
        names: the entries that have typed fields.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        registry = NameRegistry(("episode", "step", "json"))
        self._fields = [registry.take(name, ("", "has_", "pad_")) for name in self.names]

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> InfoCodec:
        """The codec of a channel; raises FormatError if the channel's metadata are damaged."""
        names = jsonvalue.loads(metadata.get("fields", "[]"))
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FormatError(f"/info: expected a list of names in its metadata, found {names!r:.100}")
        return cls(names)

    def schema(self) -> tuple[str, dict[str, str]]:
        """The ros2msg text of `/info` and its channel's metadata."""
        lines = ["uint32 episode\nuint32 step\n"]
        lines += [f"float64 {field}\nbool has_{field}\nuint8[7] pad_{field}\n" for field in self._fields]
        return "".join([*lines, "string json\n"]), {"fields": jsonvalue.dumps(self.names)}

    def encode(
        self, episode: int, step: int, info: Mapping[str, Any], kinds: Sequence[type] = (float, np.float64)
    ) -> bytes:
        """The CDR body of a step's info. Values of `kinds` go into typed fields, which are read as `float`."""
        rest = dict(info)
        out = bytearray(NUMBERS.pack(episode, step))
        for name in self.names:
            value = rest.get(name)
            if type(value) in kinds:
                del rest[name]
                out += _FIELD.pack(value, True)
            else:
                out += _FIELD.pack(0.0, False)
        cdr.write_string(out, 0, jsonvalue.dumps_any(rest) if rest else "{}")
        return bytes(out)

    def decode(self, body: memoryview) -> tuple[int, int, dict[str, Any]]:
        """(episode, step, info)."""
        fixed = NUMBERS.size + _FIELD.size * len(self.names)
        if len(body) < fixed:
            raise FormatError(f"/info: expected at least {fixed} bytes, found {len(body)}")
        episode, step = NUMBERS.unpack_from(body)
        info: dict[str, Any] = {}
        for i, name in enumerate(self.names):
            value, present = _FIELD.unpack_from(body, NUMBERS.size + i * _FIELD.size)
            if present:
                info[name] = value
        text, _ = cdr.read_string(body, fixed, 0)
        rest = jsonvalue.loads(text)
        if not isinstance(rest, dict):
            raise FormatError(f"/info: expected a JSON object, found {text[:80]!r}")
        return episode, step, {**info, **rest}
