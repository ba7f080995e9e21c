"""Messages of a layout without a constant size, back to values: one, or many at once.

Of many, numbers are taken by array operations, and texts one by one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages import cdr
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.leaves import Leaf


class MessageDecoder:
    """Decodes the CDR bodies of `/step` and `/final_state`. Every defect is a FormatError."""

    def __init__(self, layout: StepLayout) -> None:
        self._layout = layout
        self._step = [leaf for leaf in layout.step_leaves if leaf.kind == "variable" or leaf.size]
        self._final = [leaf for leaf in layout.final_leaves if leaf.kind == "variable" or leaf.size]

    def step(self, body: memoryview) -> dict[str, Any]:
        """Leaf values by name, `episode`, `step`, `terminal` and `timeout`."""
        values, position = self._leaves(body, self._step)
        if position + 2 != len(body):
            raise FormatError(f"expected a step message of {position + 2} bytes, found {len(body)}")
        if max(body[position], body[position + 1]) > 1:
            raise FormatError(f"expected flags of 0 or 1, found {bytes(body[position:])!r}")
        values["terminal"], values["timeout"] = bool(body[position]), bool(body[position + 1])
        values["episode"], values["step"] = _pair(body)
        return values

    def state(self, body: memoryview) -> int:
        """Where the state ends in the body of a step that is not complete."""
        leaves = [leaf for leaf in self._layout.state if not leaf.apart and leaf in self._step]
        return self._leaves(body, leaves)[1]

    def final(self, body: memoryview) -> tuple[int, dict[str, Any]]:
        """Episode number and leaf values of a final state."""
        values, position = self._leaves(body, self._final)
        if position != len(body):
            raise FormatError(f"expected a final state of {position} bytes, found {len(body)}")
        return _pair(body)[0], values

    def _leaves(self, body: memoryview, leaves: list[Leaf]) -> tuple[dict[str, Any], int]:
        values: dict[str, Any] = {}
        position = 8
        if len(body) < position:
            raise FormatError(f"expected a message of at least 8 bytes, found {len(body)}")
        for leaf in leaves:
            if leaf.kind == "variable":
                values[leaf.name], position = self._layout.variable[leaf.name].decode(body, position, 0)
                continue
            dtype = self._layout.dtypes[leaf.name]
            position += -position % dtype.itemsize
            size = leaf.size * dtype.itemsize
            if position + size > len(body):
                raise FormatError(f"{leaf.path}: expected {size} bytes at byte {position} of {len(body)}")
            value = np.frombuffer(body[position : position + size], dtype).reshape(leaf.shape).copy()
            if dtype == np.bool_ and value.view(np.uint8).max(initial=0) > 1:  # is no bool that NumPy knows
                raise FormatError(f"{leaf.path}: expected bools of 0 or 1, found another byte")
            values[leaf.name] = value[()] if leaf.is_scalar else value
            position += size
        return values, position


def _pair(body: memoryview) -> tuple[int, int]:
    return int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")


Decode = Callable[[Any, Array, Collection[str]], dict[str, Any]]  # `steps` or `finals` of a `BatchDecoder`
LOG_TIME = "#log_time"  # the name of the times (ns), as in the rows of constant size
_LOG_TIME_AT = 15  # in a record
_BOOL, _U4 = np.dtype(np.bool_), np.dtype("<u4")


class BatchDecoder:
    """Decodes Message records of `/step` and `/final_state` that lie in one buffer. Safe from several threads.

    Every defect is a FormatError, the one that `MessageDecoder` has for the first message that is defective. A text
    that nobody asks for is skipped, whatever it holds.
    """

    def __init__(self, layout: StepLayout) -> None:
        self._layout = layout
        self._single = MessageDecoder(layout)

    def steps(self, data: Any, records: Array, names: Collection[str]) -> dict[str, Any]:
        """Columns of steps: an array of a leaf of constant size, a list of one of variable size.

        Args:
            records: where each record begins and ends in `data`, int64 (messages, 2).
            names: of the leaves (those without elements are left out), `terminal`, `timeout` and `LOG_TIME`.
        """
        if set(names) == {LOG_TIME}:  # it is no part of the messages
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
        """Columns of final states, as those of steps, and `episode` (uint32)."""
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
        """Raises the error that decoding one message after the other has."""
        view = memoryview(data)
        for start, end in records.tolist():
            decode(view[start + BODY : end])


def _log_times(data: Any, records: Array) -> Array:
    """The `log_time` (uint64, ns) of each message record."""
    if not len(records):
        return np.empty(0, np.uint64)
    times: Array = np.ndarray(len(data) - 7, "<u8", data, 0, (1,))[records[:, 0] + _LOG_TIME_AT]
    return times


class _Fields:
    """The fields of messages, one after the other.

    Whether the messages are long enough is looked at in the end, of all fields together: an error before says no more
    than that something is wrong.
    """

    def __init__(self, data: Any, records: Array) -> None:
        self._data = data
        self._bodies = records[:, 0] + BODY
        self._ends = records[:, 1]
        self._at = self._bodies.copy()
        self._aligned = 8  # all the offsets from the bodies are multiples of it
        self.episodes = self.take(_U4, 1)
        self.take(_U4, 1, wanted=False)

    def take(self, dtype: np.dtype[Any], count: int, wanted: bool = True) -> Array:
        """`count` elements of each message, one after the other; none where they are not wanted."""
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
        decoded = {text: cdr.decode_string(text, 0) for text in set(stored)}  # many are alike
        return [decoded[text] for text in stored]

    def each(self, decode: Callable[[memoryview, int, int], tuple[Any, int]]) -> list[Any]:
        """A value of each message, and where it ends, by a function of a body and an offset in it."""
        view, values, places = memoryview(self._data), [], []
        for body, at, end in zip(self._bodies.tolist(), self._at.tolist(), self._ends.tolist(), strict=True):
            value, offset = decode(view[body:end], at - body, 0)
            values.append(value)
            places.append(body + offset)
        self._at = np.array(places, np.int64)
        self._aligned = 1
        return values

    def end(self) -> None:
        """FormatError if a message is shorter or longer than its fields."""
        if not np.array_equal(self._at, self._ends):
            raise FormatError("expected messages of another length")
