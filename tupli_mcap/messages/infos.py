"""Step infos: numeric entries asked for by name are typed fields of `/info`, everything else is JSON.

An entry that is missing, or that its typed field cannot hold exactly, is marked absent there and kept in the JSON.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.messages.episodes import read_strings
from tupli_mcap.spaces.exact import shorten
from tupli_mcap.spaces.leaves import NameRegistry

if TYPE_CHECKING:
    from tupli_mcap.recording.write.writer import RecordingWriter

__all__ = ["InfoDecoder", "InfoRecorder", "RecordInfo", "entries_of", "info_schema"]

RecordInfo = bool | Sequence[str] | Callable[[dict[str, Any]], Mapping[str, Any]]
_HEAD = struct.Struct("<II")
_FIELD = struct.Struct("<d?7x")


def entries_of(given: Any, what: str) -> dict[str, Any]:
    """A copy of a dict of entries, empty for None; RecordingError if it is something else."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise RecordingError(f"{what}: expected a dict, found {shorten(given)}")
    return dict(given)


class InfoRecorder:
    """Chooses and encodes infos. `select` True: everything; names: those; a callable: what it returns."""

    def __init__(self, select: RecordInfo) -> None:
        if isinstance(select, str):
            select = [select]
        if not isinstance(select, bool) and not callable(select) and isinstance(select, Iterable):
            select = list(select)
        named = isinstance(select, list) and all(isinstance(name, str) for name in select)
        if not (isinstance(select, bool) or callable(select) or named):
            raise RecordingError(
                f"record_info: expected True, False, a list of names or a function, found {select!r:.80}"
            )
        self._names = [] if isinstance(select, bool) or callable(select) else list(dict.fromkeys(select))
        self._select = select
        registry = NameRegistry(("episode", "step", "json"))
        self._fields = [registry.take(name, ("", "has_", "pad_")) for name in self._names]

    def schema(self) -> tuple[str, dict[str, str]]:
        """The ros2msg text of `/info` and its channel's metadata."""
        lines = ["uint32 episode\nuint32 step\n"]
        lines += [f"float64 {field}\nbool has_{field}\nuint8[7] pad_{field}\n" for field in self._fields]
        return "".join([*lines, "string json\n"]), {"fields": jsonvalue.dumps(self._names)}

    def chosen(self, info: Mapping[str, Any] | None) -> dict[str, Any]:
        """The entries of an environment's info that are to be recorded."""
        if self._select is False:
            return {}
        info = entries_of(info, "info")
        if callable(self._select):
            return entries_of(self._select(info), "record_info: what the function returns")
        if self._select is True:
            return info
        return {name: info[name] for name in self._names if name in info}

    def put(self, writer: RecordingWriter, episode: int, step: int, info: Mapping[str, Any]) -> None:
        """Appends the entries of one step to the journal."""
        if writer.infos is None or writer.channels.info is None:
            return
        body = self.encode(episode, step, info)
        writer.infos.append(time.time_ns(), (writer.channels.info, body))

    def encode(self, episode: int, step: int, info: Mapping[str, Any]) -> bytes:
        """The CDR body of a step's entries."""
        rest = dict(info)
        parts = [_HEAD.pack(episode, step)]
        for name in self._names:
            value = rest.get(name)
            if type(value) in (float, np.float64):
                del rest[name]
                parts.append(_FIELD.pack(value, True))
            else:
                parts.append(_FIELD.pack(0.0, False))
        text = jsonvalue.dumps_any(rest).encode() if rest else b"{}"
        return b"".join([*parts, struct.pack("<I", len(text) + 1), text, b"\0"])


def info_schema(metadata: Mapping[str, str]) -> str:
    """The ros2msg text of `/info` that its channel's metadata ask for; FormatError if they are damaged."""
    return InfoRecorder(InfoDecoder(metadata).names).schema()[0]


class InfoDecoder:
    """Decodes `/info` messages by their channel's metadata."""

    def __init__(self, metadata: Mapping[str, str]) -> None:
        names = jsonvalue.loads(metadata.get("fields", "[]"))
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FormatError(f"/info: expected a list of names in its metadata, found {names!r:.100}")
        self._names: list[str] = names

    @property
    def names(self) -> list[str]:
        """The entries that have typed fields."""
        return self._names

    def decode(self, body: memoryview) -> tuple[int, int, dict[str, Any]]:
        """(episode, step, info)."""
        fixed = _HEAD.size + _FIELD.size * len(self._names)
        if len(body) < fixed:
            raise FormatError(f"/info: expected at least {fixed} bytes, found {len(body)}")
        episode, step = _HEAD.unpack_from(body)
        info: dict[str, Any] = {}
        for i, name in enumerate(self._names):
            value, present = _FIELD.unpack_from(body, _HEAD.size + i * _FIELD.size)
            if present:
                info[name] = value
        (text,) = read_strings(body, fixed, 1)
        rest = jsonvalue.loads(text)
        if not isinstance(rest, dict):
            raise FormatError(f"/info: expected a JSON object, found {text[:80]!r}")
        return episode, step, {**info, **rest}
