"""Step infos: entries that the user named have typed fields in `/info`, all others are JSON; infos as columns.

A typed field of an entry that is missing or no float64 is marked absent; the JSON then holds the entry.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import are_floats
from tupli_mcap.errors import FormatError
from tupli_mcap.messages import cdr
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.labels import indexed_names
from tupli_mcap.spaces.leaves import NameRegistry

_FIELD = struct.Struct("<d?7x")
_NUMBER = (int, float, np.integer, np.floating, np.bool_)
_FEW = 16  # numbers of one info that are drawn
_TOO_LARGE = 2**1000  # for a float


def with_text_keys(info: Mapping[Any, Any]) -> dict[str, Any]:
    """An info as people are shown it: an environment may have keys that are no text, such as the numbers of agents."""
    return {str(key): value for key, value in info.items()}


def paths_in(info: Mapping[Any, Any], before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The keys, as texts, that lead to each entry of an info, and to each of the dicts in it."""
    for key, value in info.items():
        yield (path := (*before, str(key)))
        if isinstance(value, dict):
            yield from paths_in(value, path)


# ---- as columns


def info_column(values: list[Any]) -> Any:
    """Values of infos, None where there is none, as one column. Numbers, and arrays of one shape, become an array of
    shape (steps, ...), float64 with NaN if some are missing. Other values stay a list, and so do numbers that would
    lose digits as floats."""
    if any(isinstance(value, list | tuple | dict) for value in values):
        return values
    there = [np.asarray(value) for value in values if value is not None]
    alike = len({value.shape for value in there}) == 1 and all(value.dtype.kind in "biuf" for value in there)
    if not alike:
        return values
    if len(there) == len(values):
        column = np.stack(there)
    else:
        column = np.full((len(values), *there[0].shape), np.nan)
        column[[value is not None for value in values]] = there
    return column if column.dtype.kind != "f" or are_floats(there) else values


def columns_in(infos: Sequence[Mapping[Any, Any]], most: int) -> Iterator[tuple[Any, str, Any]]:
    """The key, name and values of each column of infos: `("x", "info.x", [3, None])`, with None where there is none.

    An info that is always an array of one shape, or always a dict of numbers and of such arrays, has a column for each
    number, if it has about `most` at most: `info.contact.left[0]`. Columns of arrays have the arrays' dtype, and are
    masked where there is none.
    """
    for key in dict.fromkeys(key for info in infos for key in info):
        name, values = name_within("info", key), [info.get(key) for info in infos]
        found = _numbers_within(name, values, most) or {name: values}
        yield from ((key, own, column) for own, column in found.items())


def _numbers_within(name: str, values: list[Any], most: int) -> dict[str, Any] | None:
    """A column for each number in the values; None if one of them is no number, arrays differ in shape, or there are
    more than about `most`. Dicts may have different keys."""
    given = [value for value in values if value is not None]
    if given and all(isinstance(value, dict) for value in given):
        columns: dict[str, Any] = {}
        for key in dict.fromkeys(key for value in given for key in value):
            inside = [value if value is None else value.get(key) for value in values]
            parts = _numbers_within(name_within(name, key), inside, most)
            if parts is None or len(columns) > most:
                return None
            columns |= parts
        return columns
    if given and all(isinstance(value, np.ndarray) for value in given):
        column = info_column(given)
        if isinstance(column, list) or not 0 < column[0].size <= most:
            return None
        flat = column.reshape(len(column), column[0].size)
        if len(given) < len(values):
            there, flat = flat, np.ma.masked_array(np.zeros((len(values), flat.shape[1]), flat.dtype), True)
            flat[[value is not None for value in values]] = there
        names = indexed_names(name, column.shape[1:], np.arange(column[0].size))
        return {own: flat[:, i] for i, own in enumerate(names)}
    return {name: values} if given and all(map(is_number, given)) else None


def is_number(value: Any) -> bool:
    """Whether a value of an info is a real number, of any size. (NumPy has durations among its integers.)"""
    return isinstance(value, _NUMBER) and not isinstance(value, np.timedelta64)


class InfoNumbers(NamedTuple):
    """The numbers of a column of infos: float64 (infos,), masked where there is none."""

    key: Any
    name: str
    values: np.ma.MaskedArray[Any, np.dtype[np.float64]]


def numbers_in(infos: Sequence[Mapping[Any, Any]]) -> list[InfoNumbers]:
    """The columns of infos that have numbers: first the infos that are one, then dicts and arrays of few."""
    columns = _entries_first(columns_in(infos, _FEW))
    found = [InfoNumbers(key, name, _masked(values)) for key, name, values in columns]
    return [one for one in found if one.values.count()]


def _entries_first(columns: Iterable[tuple[Any, str, Any]]) -> list[tuple[Any, str, Any]]:
    return sorted(columns, key=lambda column: column[1] != name_within("info", column[0]))


def named_entries(info: Mapping[Any, Any]) -> dict[str, Any]:
    """One info as people are shown it: its entries by their names in it, with those in dicts and arrays of few numbers
    (`contact.left[0]`) last."""
    found = _entries_first(columns_in([with_text_keys(info)], _FEW))
    return {name.removeprefix("info."): values[0] for _, name, values in found}


def _masked(values: Any) -> np.ma.MaskedArray[Any, np.dtype[np.float64]]:
    if isinstance(values, np.ndarray):
        return np.ma.masked_array(values, dtype=np.float64)
    known = [is_number(value) and (not isinstance(value, int) or abs(value) < _TOO_LARGE) for value in values]
    numbers = [float(value) if fits else 0.0 for value, fits in zip(values, known, strict=True)]
    return np.ma.masked_array(numbers, np.logical_not(known), dtype=np.float64)


# ---- as messages


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

    @property
    def _fixed(self) -> int:
        return NUMBERS.size + _FIELD.size * len(self.names)

    def place(self, body: memoryview) -> tuple[int, int]:
        """(episode, step)."""
        if len(body) < self._fixed:
            raise FormatError(f"/info: expected at least {self._fixed} bytes, found {len(body)}")
        episode, step = NUMBERS.unpack_from(body)
        return episode, step

    def decode(self, body: memoryview) -> tuple[int, int, dict[str, Any]]:
        """(episode, step, info)."""
        episode, step = self.place(body)
        info: dict[str, Any] = {}
        for i, name in enumerate(self.names):
            value, present = _FIELD.unpack_from(body, NUMBERS.size + i * _FIELD.size)
            if present:
                info[name] = value
        text, _ = cdr.read_string(body, self._fixed, 0)
        rest = jsonvalue.loads(text)
        if not isinstance(rest, dict):
            raise FormatError(f"/info: expected a JSON object, found {text[:80]!r}")
        return episode, step, {**info, **rest}
