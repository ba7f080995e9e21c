"""The lines of a generated encoder (`encode_rows`) that check one value, and what packs it into a row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import DType
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.exact import exact_array, exact_flag
from tupli_mcap.spaces.leaves import Leaf, subspaces

_BOOLS = b"\0\1"
_INT_FORMATS = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
}  # fmt: skip


@dataclass
class SourceCode:
    """Lines of a generated function, and the objects that they name."""

    names: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)

    def bind(self, prefix: str, value: Any) -> str:
        """A name for an object."""
        name = f"{prefix}{len(self.names)}"
        self.names[name] = value
        return name


@dataclass
class Packed:
    """The format and the argument expressions of one `struct` call, at growing offsets."""

    start: int
    offset: int
    format: str = ""
    args: list[str] = field(default_factory=list)

    def add(self, offset: int, code: str, size: int, arg: str) -> None:
        """One more argument, of `size` bytes at `offset`."""
        if offset > self.offset:
            self.format += f"{offset - self.offset}x"
        self.format += code
        self.args.append(arg)
        self.offset = offset + size


def add_structure_checks(source: SourceCode, space: Any, expression: str) -> None:
    """Lines that raise TypeError unless tuples and dicts are those of the space."""
    if type(space) not in (spaces.Dict, spaces.Tuple):
        return
    of_tuple = f"not isinstance({expression}, tuple) or " if type(space) is spaces.Tuple else ""
    source.lines.append(f"if {of_tuple}len({expression}) != {len(space.spaces)}: raise TypeError")
    for key, sub in subspaces(space):
        if type(sub) in (spaces.Dict, spaces.Tuple):
            add_structure_checks(source, sub, access_to(source, expression, (key,)))


def access_to(source: SourceCode, root: str, keys: Sequence[Any]) -> str:
    """The expression of a leaf: `state['arm'][0]`."""
    parts = [repr(key) if type(key) in (str, int) else source.bind("key", key) for key in keys]
    return root + "".join(f"[{part}]" for part in parts)


def add_fields(
    source: SourceCode, layout: StepLayout, leaves: Sequence[Leaf], root: str, packed: Packed
) -> None:
    """Lines that check the leaves of an action, a state or a reward, and what packs them."""
    for i, leaf in enumerate(leaves):
        if leaf.apart:
            continue
        dtype = layout.dtypes[leaf.name]
        access = access_to(source, root, leaf.keys)
        if leaf.size == 0:
            check = source.bind("check", _exact_bytes(leaf, dtype))
            source.lines.append(f"{check}({access})")
            continue
        offset = BODY + layout.step_message.offset(leaf.name)
        value = f"{root[0]}{i}" if leaf.keys else root
        if leaf.keys:
            source.lines.append(f"{value} = {access}")
        _leaf(source, leaf, dtype, value, offset, packed)


def _leaf(source: SourceCode, leaf: Leaf, dtype: DType, value: str, offset: int, packed: Packed) -> None:
    nbytes = leaf.size * dtype.itemsize
    if leaf.kind == "scalar" and dtype.kind in "iu":
        exact = source.bind("exact", lambda value: int(exact_array(value, dtype, leaf.shape, leaf.path)))
        kind = source.bind("kind", dtype.type)
        source.lines.append(
            f"if {value}.__class__ is not {kind} and {value}.__class__ is not int: {value} = {exact}({value})"
        )
        packed.add(offset, _INT_FORMATS[dtype.name], nbytes, value)
    elif value == "reward" and leaf.shape == () and dtype == np.float64:
        exact = source.bind("exact", _exact_float(leaf))
        double = source.bind("double", np.float64)
        source.lines.append(
            f"if reward.__class__ is not float and reward.__class__ is not {double}: reward = {exact}(reward)"
        )
        packed.add(offset, "d", nbytes, value)
    else:
        kind, shape = source.bind("dtype", dtype), source.bind("shape", leaf.shape)
        raw, exact = f"{value}b", source.bind("exact", _exact_bytes(leaf, dtype))
        # exactly this class: the bytes of a subclass may mean something else, as those of a masked array do
        plain = f"{value}.__class__ is {source.bind('array', np.ndarray)}"
        if leaf.shape == ():
            plain = f"({plain} or {value}.__class__ is {source.bind('scalar', dtype.type)})"
        # a vector's length follows from the number of its bytes; `shape` would make a tuple for each value
        vector = len(leaf.shape) == 1
        shaped = f"{value}.ndim == 1" if vector else f"{value}.shape == {shape}"
        source.lines.append(
            f"{raw} = {value}.tobytes() if {plain} and {value}.dtype is {kind} and {shaped} else {exact}({value})"
        )
        if vector:
            source.lines.append(f"if len({raw}) != {nbytes}: {raw} = {exact}({value})")
        if dtype.kind == "b":  # a view may have made bools of other bytes
            source.lines.append(f"if {raw}.translate(None, {_BOOLS!r}): {raw} = {exact}({value})")
        packed.add(offset, f"{nbytes}s", nbytes, raw)


def flag_check(source: SourceCode, name: str) -> str:
    """The line that makes a bool of a flag."""
    exact, kind = source.bind("exact", exact_flag), source.bind("kind", np.bool_)
    return (
        f"if {name} is not False and {name} is not True and {name}.__class__ is not {kind}: "
        f"{name} = {exact}({name}, {name!r})"
    )


def _exact_float(leaf: Leaf) -> Callable[[Any], float]:
    dtype = np.dtype(np.float64)

    def exact(value: Any) -> float:
        if value.__class__ is int and -(2**53) <= value <= 2**53:
            return float(value)
        if value.__class__ is np.float32 and value == value:  # widening may quiet a NaN
            return float(value)
        return float(exact_array(value, dtype, (), leaf.path))

    return exact


def _exact_bytes(leaf: Leaf, dtype: DType) -> Callable[[Any], bytes]:
    return lambda value: exact_array(value, dtype, leaf.shape, leaf.path).tobytes()
