"""Values of variable size (Text, Sequence, Graph, OneOf, and values inside them) as fields of a message.

`VariableField` turns a space into a tree of small functions. The space alone decides the structure:

| space | one value | items of a Sequence | stacked, or the nodes and edges of a Graph |
|---|---|---|---|
| Box, Discrete, MultiDiscrete, MultiBinary | `T` or `T[n]` | `T[]`, all elements in a row | the same |
| the same without elements | no field | a message of one dummy byte each | `uint32`, their number |
| Text | `string` | `string[]` | the same |
| Dict, Tuple | a message with a field for each entry | `Message[]` | a message of stacked fields |
| Sequence | its items, or its stack | a message with a field `value` each | the same |
| Graph | message: `nodes`, `has_edges`, `edges`, `has_edge_links`, `edge_links` | `Message[]` | the same |
| OneOf | message: `index`, and a field for each option, empty unless chosen | `Message[]` | the same |
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import DType
from tupli_mcap.errors import FormatError, SpaceError, StepError
from tupli_mcap.messages.variable.leaf_codecs import (
    Codec,
    Decode,
    Encode,
    Leaf,
    empty_batch,
    numeric,
    numeric_batch,
    numeric_items,
    text,
)
from tupli_mcap.messages.variable.nested_codecs import (
    Entry,
    Maybe,
    decode_dict,
    decode_graph,
    decode_one_of,
    decode_tuple,
    encode_dict,
    encode_graph,
    encode_one_of,
    encode_tuple,
    items_of,
    with_dummy,
)
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.exact import decide_dtype
from tupli_mcap.spaces.leaves import (
    CONSTANT,
    MAX_DEPTH,
    ROS_TYPES,
    Leaf as SpaceLeaf,
    NameRegistry,
    camel,
    subspaces,
)

_Seen = dict[str, tuple[DType, list[Any]]]  # declared dtype and values of the numbers at a path
_DUMMY = "structure_needs_at_least_one_member"  # ROS 2's own name for this field


class VariableField:
    """A field of a message that holds values of `space`. Thread-safe.

    Args:
        space: of the values.
        name: of the field.
        type_prefix: of the names of nested messages.
        path: names the field in errors; `name` by default.
        taken: type names (without package) that are in use; this field adds its own.
        dtypes: dtypes of leaves that are stored wider than the space declares, by path, as
            `variable_dtypes` returns them.
        seen: collects the numbers of encoded values; nothing of use is written then.

    Attributes:
        field_type: ROS type of the field.
        definitions: names and texts of the messages nested in it.

    Raises:
        SpaceError: a space that is not Gymnasium's own, a dtype that no message can hold, or a path in `dtypes` that
            is not in the space.
    """

    def __init__(
        self,
        space: gym.Space[Any],
        name: str,
        type_prefix: str = "Value",
        *,
        path: str | None = None,
        taken: set[str] | None = None,
        dtypes: Mapping[str, str] | None = None,
        seen: _Seen | None = None,
    ) -> None:
        self.name = name
        self.path = name if path is None else path
        wide = {self.path + where: dtype for where, dtype in (dtypes or {}).items()}
        builder = _Builder(set() if taken is None else taken, wide, seen)
        codec = builder.single(space, type_prefix, self.path, 0)
        if wide:
            raise SpaceError(
                f"{self.path}: expected dtypes of leaves in {space}, found some of {sorted(wide)}"
            )
        self.field_type: str = codec.ros
        self.definitions: list[tuple[str, str]] = builder.definitions
        self._encode = codec.encode
        self._decode = codec.decode

    def encode(self, value: Any, out: bytearray, origin: int) -> None:
        """Append `value` to `out`, aligned from `origin`; raises StepError, and leaves `out` as it is, for another
        structure or a leaf that cannot be stored exactly."""
        start = len(out)
        try:
            self._encode(value, out, origin)
        except StepError as err:
            del out[start:]
            raise StepError(f"{self.path}{err}") from err.__cause__

    def encoded(self, value: Any) -> bytes:
        """The bytes of a value by itself; StepError as `encode`."""
        out = bytearray()
        self.encode(value, out, 0)
        return bytes(out)

    def decode(self, data: memoryview, offset: int, origin: int) -> tuple[Any, int]:
        """Return the value at `offset`, with the types of the space's samples, and the offset after it; raises
        FormatError if the bytes are no value of the space."""
        try:
            return self._decode(data, offset, origin)
        except FormatError as err:
            raise FormatError(f"{self.path}: {err}") from err


@dataclass
class _Builder:
    """Makes codecs and collects the message definitions they need."""

    taken: set[str]
    wide: dict[str, str]  # path to dtype; a used one is removed
    seen: _Seen | None
    definitions: list[tuple[str, str]] = field(default_factory=list)

    def single(self, space: gym.Space[Any], type_name: str, path: str, depth: int) -> Codec:
        """One value of a space."""
        _check_depth(path, depth)
        if type(space) in CONSTANT:
            return numeric(self._leaf(space, path))
        if type(space) is spaces.Text:
            return text()
        if type(space) is spaces.Dict or type(space) is spaces.Tuple:
            return self._composite(space, type_name, path, depth, self.single)
        if type(space) is spaces.Sequence:
            make = self._stacked if space.stack else self._items
            return make(space.feature_space, type_name, f"{path}[]", depth + 1)
        if type(space) is spaces.Graph:
            return self._graph(space, type_name, path, depth)
        if type(space) is spaces.OneOf:
            return self._one_of(space, type_name, path, depth)
        raise SpaceError(
            f"{path}: expected a space of Gymnasium itself, found {type(space).__qualname__}; "
            "wrap the environment so that it returns one"
        )

    def _leaf(self, space: gym.Space[Any], path: str) -> Leaf:
        leaf = Leaf.of(space, path, self.wide.pop(path, None))
        return (
            leaf if self.seen is None else replace(leaf, seen=self.seen.setdefault(path, (leaf.dtype, []))[1])
        )

    def _items(self, space: gym.Space[Any], type_name: str, path: str, depth: int) -> Codec:
        """A tuple of values: a Sequence without `stack`."""
        if type(space) in CONSTANT and 0 not in (space.shape or ()):
            return numeric_items(self._leaf(space, path))
        codec = self.single(space, f"{type_name}Item", path, depth)
        if codec.kind not in ("message", "string"):
            codec = self._message(f"{type_name}Item", [(codec.ros, "value")], codec.encode, codec.decode)
        return items_of(codec)

    def _stacked(self, space: gym.Space[Any], type_name: str, path: str, depth: int) -> Codec:
        """A batch of values, as `gymnasium.vector.utils.concatenate` makes it."""
        if type(space) in CONSTANT:
            leaf = self._leaf(space, path)
            return numeric_batch(leaf) if leaf.count else empty_batch(leaf)
        if type(space) is spaces.Dict or type(space) is spaces.Tuple:
            return self._composite(space, type_name, path, depth, self._stacked)
        return self._items(space, type_name, path, depth)

    def _composite(
        self, space: Any, type_name: str, path: str, depth: int, make: Callable[..., Codec]
    ) -> Codec:
        """A Dict or Tuple, its entries made by `make`."""
        _check_depth(path, depth)
        is_dict = type(space) is spaces.Dict
        entries = subspaces(space)
        names = NameRegistry(tuple(ROS_TYPES))
        fields: list[tuple[str, str]] = []
        encoders: list[Entry] = []
        decoders: list[Decode] = []
        for key, sub in entries:
            name = names.take(str(key) if is_dict else f"item_{key}")
            codec = make(sub, type_name + camel(name), f"{path}[{key!r}]", depth + 1)
            fields.append((codec.ros, name))
            encoders.append((key, name_within("", key), codec.encode))
            decoders.append(codec.decode)
        if not is_dict:
            return self._message(type_name, fields, encode_tuple(encoders), decode_tuple(decoders))
        decode = decode_dict([key for key, _ in entries], decoders)
        return self._message(type_name, fields, encode_dict(encoders), decode)

    def _graph(self, space: Any, type_name: str, path: str, depth: int) -> Codec:
        nodes = self._stacked(space.node_space, f"{type_name}Nodes", f"{path}.nodes", depth + 1)
        fields = [(nodes.ros, "nodes")]
        edges = None
        if space.edge_space is not None:
            edges = Maybe.of(self._stacked(space.edge_space, f"{type_name}Edges", f"{path}.edges", depth + 1))
            fields += [("bool", "has_edges"), (edges.codec.ros, "edges")]
        links_space = spaces.Box(0, 1, (2,), np.int32)  # as Gymnasium's samples; a Graph declares none
        links = Maybe.of(numeric_batch(self._leaf(links_space, f"{path}.edge_links")))
        fields += [("bool", "has_edge_links"), (links.codec.ros, "edge_links")]
        encode, decode = encode_graph(nodes, edges, links), decode_graph(nodes, edges, links)
        return self._message(type_name, fields, encode, decode)

    def _one_of(self, space: Any, type_name: str, path: str, depth: int) -> Codec:
        options = [
            Maybe.of(self.single(sub, f"{type_name}Option{i}", f"{path}[{i}]", depth + 1))
            for i, sub in enumerate(space.spaces)
        ]
        fields = [("uint32", "index")]
        fields += [(option.codec.ros, f"option_{i}") for i, option in enumerate(options)]
        return self._message(type_name, fields, encode_one_of(options), decode_one_of(options))

    def _message(
        self, type_name: str, fields: list[tuple[str, str]], encode: Encode, decode: Decode
    ) -> Codec:
        """A nested message; `fields` are ROS type and name of each field, with no type if it takes no bytes."""
        lines = [f"{ros} {name}\n" for ros, name in fields if ros]
        unique, n = type_name, 2
        while unique in self.taken:
            unique, n = f"{type_name}N{n}", n + 1
        self.taken.add(unique)
        full = f"tupli_mcap/{unique}"
        self.definitions.append((full, "".join(lines) or f"uint8 {_DUMMY}\n"))
        if not lines:
            encode, decode = with_dummy(encode, decode)
        return Codec(full, "message", encode, decode)


def _check_depth(path: str, depth: int) -> None:
    if depth > MAX_DEPTH:
        raise SpaceError(f"{path}: a space nested more than {MAX_DEPTH} deep cannot be recorded")


def variable_dtypes(space: gym.Space[Any], values: Sequence[Any], path: str) -> dict[str, str]:
    """Return path and dtype name of the leaves that `values` (a recording's first) need wider than declared.

    A path starts after the value itself: `[]` is an item of a Sequence, `['a']` an entry of a Dict, `[1]` one of
    a Tuple or an option of a OneOf; `.nodes`, `.edges` and `.edge_links` are parts of a Graph.

    Each such leaf gets a warning, in which `path` names the value. Values of another structure are ignored here and
    refused when they are stored. Raises StepError if a leaf has values of a dtype no message can hold.
    """
    seen: _Seen = {}
    numbers = VariableField(space, path, seen=seen)
    for value in values:
        with contextlib.suppress(StepError):
            numbers.encode(value, bytearray(), 0)
    dtypes = {}
    for where, (dtype, found) in seen.items():
        wide = decide_dtype(SpaceLeaf((), where, "", space, "array", dtype, ()), found)
        if wide != dtype:
            dtypes[where.removeprefix(path)] = wide.name
    return dtypes
