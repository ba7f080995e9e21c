"""Decodes messages of variable layout: one, or many at once.

Of many messages, numbers are read by array operations, texts one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import headers_at
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages import cdr
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.variable.codec import VariableField
from tupli_mcap.spaces.leaves import Leaf


class MessageDecoder:
    """Decodes the CDR bodies of `/step` and `/final_state`. All methods raise FormatError for a defect."""

    def __init__(self, layout: StepLayout) -> None:
        self._step = [(leaf, layout.codec(leaf)) for leaf in layout.step_leaves if leaf.size]
        self._final = [(leaf, layout.codec(leaf)) for leaf in layout.final_leaves if leaf.size]

    def step(self, body: memoryview) -> dict[str, Any]:
        """Leaf values by name, `episode`, `step`, `terminal` and `timeout`."""
        values, position = self._leaves(body, self._step)
        if position + 2 != len(body):
            raise FormatError(f"expected a step message of {position + 2} bytes, found {len(body)}")
        if max(body[position], body[position + 1]) > 1:
            raise FormatError(f"expected flags of 0 or 1, found {bytes(body[position:])!r}")
        values["terminal"], values["timeout"] = bool(body[position]), bool(body[position + 1])
        values["episode"], values["step"] = NUMBERS.unpack_from(body)
        return values

    def state(self, body: memoryview) -> int:
        """The offset where the state ends in the body of an unfinished step."""
        return self._leaves(body, [pair for pair in self._step if pair[0].root == "state"])[1]

    def final(self, body: memoryview) -> tuple[int, dict[str, Any]]:
        """Episode number and leaf values of a final state."""
        values, position = self._leaves(body, self._final)
        if position != len(body):
            raise FormatError(f"expected a final state of {position} bytes, found {len(body)}")
        return NUMBERS.unpack_from(body)[0], values

    def _leaves(
        self, body: memoryview, leaves: list[tuple[Leaf, VariableField]]
    ) -> tuple[dict[str, Any], int]:
        values: dict[str, Any] = {}
        position = NUMBERS.size
        if len(body) < position:
            raise FormatError(f"expected a message of at least {position} bytes, found {len(body)}")
        for leaf, codec in leaves:
            values[leaf.name], position = codec.decode(body, position, 0)
        return values, position


Decode = Callable[[Any, Array, Collection[str]], dict[str, Any]]  # `steps` or `finals` of a `BatchDecoder`
LOG_TIME = "#log_time"  # the column of times (ns), named as in rows of constant size
_BOOL, _U4 = np.dtype(np.bool_), np.dtype("<u4")


class BatchDecoder:
    """Decodes Message records of `/step` and `/final_state` that lie in one buffer. Thread-safe.

    For a defect, all methods raise the FormatError that `MessageDecoder` raises for the first defective message. Texts
    that the caller does not ask for are skipped without a check.
    """

    def __init__(self, layout: StepLayout) -> None:
        self._layout = layout
        self._single = MessageDecoder(layout)

    def steps(self, data: Any, records: Array, names: Collection[str]) -> dict[str, Any]:
        """Columns of steps: an array for a leaf of constant size, a list for one of variable size.

        Each record begins and ends in `data` where `records` says, int64 (messages, 2). `names` are the columns to
        return: of leaves that have elements, `terminal`, `timeout` and `LOG_TIME`.
        """
        if set(names) == {LOG_TIME}:  # it is not in the message bodies
            return {LOG_TIME: _log_times(data, records)}
        try:
            fields = _Fields(data, records)
            columns = self._leaves(fields, self._layout.step_leaves, names)
            flags = {name: fields.take(_BOOL, 1) for name in ("terminal", "timeout")}
            fields.end()
        except FormatError:
            self._explain(data, records, self._single.step)
            raise
        columns |= {name: flag for name, flag in flags.items() if name in names}
        return columns | ({LOG_TIME: _log_times(data, records)} if LOG_TIME in names else {})

    def finals(self, data: Any, records: Array, names: Collection[str]) -> dict[str, Any]:
        """Columns of final states, like those of steps, and `episode` (uint32)."""
        try:
            fields = _Fields(data, records)
            columns = self._leaves(fields, self._layout.final_leaves, names)
            fields.end()
        except FormatError:
            self._explain(data, records, self._single.final)
            raise
        if "episode" in names:
            columns["episode"] = fields.episodes
        return columns

    def _leaves(self, fields: _Fields, leaves: Iterable[Leaf], names: Collection[str]) -> dict[str, Any]:
        columns: dict[str, Any] = {}
        for leaf in leaves:
            wanted = leaf.name in names
            values: Any
            if leaf.kind == "variable":
                field = self._layout.variable[leaf.name]
                values = fields.texts(wanted) if field.field_type == "string" else fields.each(field.decode)
            elif leaf.size:
                values = fields.take(self._layout.dtypes[leaf.name], leaf.size, wanted)
                values = values.reshape(-1, *leaf.shape)
            else:
                continue
            if wanted:
                columns[leaf.name] = values
        return columns

    def _explain(self, data: Any, records: Array, decode: Callable[[memoryview], object]) -> None:
        """Decodes one message after the other, to raise the error of the first defective one."""
        view = memoryview(data)
        for start, end in records.tolist():
            decode(view[start + BODY : end])


def _log_times(data: Any, records: Array) -> Array:
    """The `log_time` (uint64, ns) of each message record."""
    times: Array = headers_at(data)[LOG_TIME][records[:, 0]]
    return times


class _Fields:
    """Reads the fields of many messages, one field of all messages at a time.

    `end` checks the lengths of all messages at once. The texts of errors do not matter: `_explain` raises a better one.
    """

    def __init__(self, data: Any, records: Array) -> None:
        self._data = data
        self._bodies = records[:, 0] + BODY
        self._ends = records[:, 1]
        self._at = self._bodies.copy()
        self._aligned = 8  # all offsets from the bodies' starts are multiples of this
        self.episodes = self.take(_U4, 1)
        self.take(_U4, 1, wanted=False)

    def take(self, dtype: np.dtype[Any], count: int, wanted: bool = True) -> Array:
        """`count` elements of each message, flat, in the order of messages; empty unless `wanted`."""
        if dtype.itemsize > self._aligned:
            self._at += (self._bodies - self._at) & (dtype.itemsize - 1)
            self._aligned = dtype.itemsize
        size, found = count * dtype.itemsize, np.empty(0, dtype)
        if wanted and len(self._at):
            if size > len(self._data):
                raise FormatError("expected longer messages")
            rows = np.ndarray(len(self._data) - size + 1, f"V{size}", self._data, 0, (1,))
            try:
                found = rows[self._at].view(dtype)
            except IndexError as err:
                raise FormatError("expected longer messages") from err
            if dtype == np.bool_ and found.view(np.uint8).max(initial=0) > 1:
                raise FormatError("expected bools of 0 or 1")
        self._at += size
        self._aligned = math.gcd(self._aligned, size)
        return found

    def texts(self, wanted: bool) -> list[str]:
        """A string of each message."""
        sizes = self.take(_U4, 1)
        begin = self._at.tolist() if wanted else []
        self._at += sizes
        self._aligned = 1
        if not wanted:
            return []
        whole = bytes(self._data)
        stored = [whole[a:b] for a, b in zip(begin, self._at.tolist(), strict=True)]
        decoded = {text: cdr.decode_string(text, 0) for text in set(stored)}  # most occur often
        return [decoded[text] for text in stored]

    def each(self, decode: Callable[[memoryview, int, int], tuple[Any, int]]) -> list[Any]:
        """A value of each message; `decode` takes a body, an offset and 0, and returns the value and where it ends."""
        view, values, places = memoryview(self._data), [], []
        for body, at, end in zip(self._bodies.tolist(), self._at.tolist(), self._ends.tolist(), strict=True):
            value, offset = decode(view[body:end], at - body, 0)
            values.append(value)
            places.append(body + offset)
        self._at = np.array(places, np.int64)
        self._aligned = 1
        return values

    def end(self) -> None:
        """Raises FormatError if a message is shorter or longer than its fields."""
        if not np.array_equal(self._at, self._ends):
            raise FormatError("expected messages of another length")
