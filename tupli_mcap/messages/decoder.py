"""Message-by-message decoding of layouts without a constant size."""

from __future__ import annotations

from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
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
