"""A Gymnasium space as a JSON object, and back: every bound, start, key and order is exact.

Dtypes have NumPy's names. An array is one number if all elements are equal, else the flat list of its elements in C
order; infinities are `"inf"` and `"-inf"`. A Dict is a list of pairs, as its keys have an order and need not be
strings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, SpaceError, brief
from tupli_mcap.spaces.exact import shorten
from tupli_mcap.spaces.leaves import MAX_DEPTH, ROS_TYPES

Json = dict[str, Any]

# of all leaves together: a space holds its bounds in memory, and a file only claims its size
_MAX_ELEMENTS = 2**26
_MAX_COPIED = 2**22  # of those below a stacked Sequence or a Graph, where Gymnasium makes its own arrays
_MAX_SPACES = 2**16
_DTYPES = {name: np.dtype(name) for name in ROS_TYPES}
_MAX_DIMENSIONS = 32  # of NumPy 1
_LARGE = 2**16  # elements
_FLAGS = ("bounded_below", "bounded_above")


class _Budget:
    """The memory that a space may still take.

    Gymnasium copies what is below a stacked Sequence or a Graph, so each level of these doubles the count.
    """

    def __init__(self) -> None:
        self._elements = _MAX_ELEMENTS
        self._copied = _MAX_COPIED
        self._spaces = _MAX_SPACES

    def take(self, shape: tuple[int, ...], copies: int) -> str | None:
        """Count a space of this shape; return what is wrong, if anything is."""
        size = math.prod(shape) * copies
        self._elements -= size
        self._copied -= size if copies > 1 else 0
        self._spaces -= copies
        if self._elements < 0:
            return f"at most {_MAX_ELEMENTS} elements in all, found a shape of {shape}"
        if self._copied < 0:
            return f"at most {_MAX_COPIED} elements below a stacked Sequence or a Graph, found a shape of {shape}"
        if self._spaces < 0:
            return f"at most {_MAX_SPACES} spaces, counting the copies Gymnasium makes, found more"
        return None


def space_to_json(space: gym.Space[Any]) -> Json:
    """Return an object of `str`, `int`, `float`, `bool`, `list` and `dict` only, which describes `space`.

    The state of the space's random generator is left out.

    Raises:
        SpaceError: a space is not Gymnasium's own (or is a subclass), no message can hold a dtype, a key has no JSON
            form, or the space is too large or too deep to be read again; the message starts with the path of the leaf:
            `space['a'][1]`.
    """
    return _write(space, "space", 0, 1, _Budget())


def space_from_json(obj: Any) -> gym.Space[Any]:
    """Return the space that an object of `space_to_json` describes; sizes are checked before anything is allocated.
    Raises FormatError, with the path, for a defect."""
    return _read(obj, "space", 0, 1, _Budget())


def _write(space: gym.Space[Any], path: str, depth: int, copies: int, budget: _Budget) -> Json:
    kind = type(space)
    if kind not in _CODECS:
        raise SpaceError(
            f"{path}: expected a space of Gymnasium itself, found {kind.__module__}.{kind.__qualname__}; "
            "wrap the environment so that it returns one"
        )
    if depth > MAX_DEPTH:
        raise SpaceError(f"{path}: expected at most {MAX_DEPTH} nested spaces, found more")
    shape = () if isinstance(space, (spaces.Dict, spaces.Tuple)) else space.shape or ()
    if (wrong := budget.take(shape, copies)) is not None:
        raise SpaceError(f"{path}: expected {wrong}")

    def write_sub(sub: gym.Space[Any], step: str, copied: bool = False) -> Json:
        return _write(sub, path + step, depth + 1, 2 * copies if copied else copies, budget)

    writer, _ = _CODECS[kind]
    return {"type": kind.__name__, **writer(space, path, write_sub)}


def _read(obj: Any, path: str, depth: int, copies: int, budget: _Budget) -> gym.Space[Any]:
    if not isinstance(obj, dict):
        raise FormatError(f"{path}: expected the object of a space, found {shorten(obj)}")
    reader = _READERS.get(obj["type"]) if isinstance(obj.get("type"), str) else None
    if reader is None:
        raise FormatError(f"{path}: expected the type of a space, found {shorten(obj.get('type'))}")
    if depth > MAX_DEPTH:
        raise FormatError(f"{path}: expected at most {MAX_DEPTH} nested spaces, found more")
    fields = _Fields(obj, path)
    if (wrong := budget.take(fields.shape("shape") if "shape" in obj else (), copies)) is not None:
        raise FormatError(f"{path}: expected {wrong}")

    def read_sub(sub: Any, step: str, copied: bool = False) -> gym.Space[Any]:
        return _read(sub, path + step, depth + 1, 2 * copies if copied else copies, budget)

    try:
        return reader(fields, read_sub)
    except (ValueError, TypeError, AssertionError, ArithmeticError, NotImplementedError) as err:
        raise FormatError(
            f"{path}: expected a space of Gymnasium, which refuses this one: {brief(err)}"
        ) from err


WriteSub = Callable[..., Json]
ReadSub = Callable[..., "gym.Space[Any]"]


# A writer and a reader for each space, side by side, with the same fields in the same order.


def _write_box(space: Any, path: str, _: WriteSub) -> Json:
    obj = {"dtype": _dtype_name(space.dtype, path), "shape": list(space.shape)}
    for name in ("low", "high"):
        bound = getattr(space, name)
        if bound.dtype != space.dtype or bound.shape != space.shape or np.isnan(bound).any():
            raise SpaceError(
                f"{path}: expected {name} of shape {space.shape} and {space.dtype}, found {shorten(bound)}"
            )
        obj[name] = _numbers(bound)
    if space.dtype.kind == "i":  # an infinite bound of a float says that there is none
        obj["bounded_below"] = _numbers(space.bounded_below)
        obj["bounded_above"] = _numbers(space.bounded_above)
    return obj


def _read_box(fields: _Fields, _: ReadSub) -> gym.Space[Any]:
    dtype, shape = fields.dtype(), fields.shape("shape")
    built = fields.built_shape(shape, "low", "high", *(_FLAGS if dtype.kind == "i" else ()))
    low, high = fields.array("low", dtype, built), fields.array("high", dtype, built)
    # The constructor takes no arrays of bools in some versions, and mistakes a lowest integer for a bound.
    as_given = np.uint8 if dtype.kind == "b" else dtype
    space = spaces.Box(low.astype(as_given), high.astype(as_given), built, dtype.type)
    space.low, space.high = low, high
    if dtype.kind == "i":
        flag = np.dtype(np.bool_)
        space.bounded_below = fields.array("bounded_below", flag, built)
        space.bounded_above = fields.array("bounded_above", flag, built)
    return space if built == shape else _spread(space, shape, "low", "high", *_FLAGS)


def _spread(space: Any, shape: tuple[int, ...], *names: str) -> gym.Space[Any]:
    """Turns a space of one element into one of `shape`: its arrays repeat the element without memory, read-only."""
    for name in names:
        setattr(space, name, np.broadcast_to(getattr(space, name), shape))
    space._shape = shape
    return cast("gym.Space[Any]", space)


def _write_discrete(space: Any, path: str, _: WriteSub) -> Json:
    return {"dtype": _dtype_name(space.dtype, path), "n": int(space.n), "start": int(space.start)}


def _read_discrete(fields: _Fields, _: ReadSub) -> gym.Space[Any]:
    dtype: Any = fields.dtype().type
    of_dtype = {} if dtype is np.int64 else {"dtype": dtype}  # Gymnasium 1.0 has int64 only
    return spaces.Discrete(fields.integer("n"), start=fields.integer("start"), **of_dtype)


def _write_multi_discrete(space: Any, path: str, _: WriteSub) -> Json:
    obj = {"dtype": _dtype_name(space.dtype, path), "shape": list(space.nvec.shape)}
    return {**obj, "nvec": _numbers(space.nvec), "start": _numbers(space.start)}


def _read_multi_discrete(fields: _Fields, _: ReadSub) -> gym.Space[Any]:
    dtype, shape = fields.dtype(), fields.shape("shape")
    built = fields.built_shape(shape, "nvec", "start")
    nvec, start = fields.array("nvec", dtype, built), fields.array("start", dtype, built)
    if dtype.kind not in "iu":
        raise fields.wrong("dtype", "an integer dtype")
    space = spaces.MultiDiscrete(nvec, dtype=dtype.type, start=start)
    return space if built == shape else _spread(space, shape, "nvec", "start")


def _write_multi_binary(space: Any, _path: str, _: WriteSub) -> Json:
    # n = 5 and n = (5,) are different spaces to Gymnasium
    return {"shape": list(space.shape), "flat": isinstance(space.n, int)}


def _read_multi_binary(fields: _Fields, _: ReadSub) -> gym.Space[Any]:
    shape, flat = fields.shape("shape"), fields.flag("flat")
    if flat and len(shape) != 1:
        raise fields.wrong("shape", "one length")
    return spaces.MultiBinary(shape[0] if flat else shape)


def _write_text(space: Any, _path: str, _: WriteSub) -> Json:
    # Code points if there are surrogates: JSON would join two of them into one character.
    text = "".join(_characters(space))
    characters = text if jsonvalue.is_unicode(text) else [ord(character) for character in text]
    return {"min_length": space.min_length, "max_length": space.max_length, "characters": characters}


def _characters(space: Any) -> list[str]:
    """The characters of a Text in their order. If the order is that of a set, as in Gymnasium 1.0, they are sorted: it
    differs between processes, and one space must have one description."""
    listed = list(dict.fromkeys(space.character_list))
    of_a_set = len(listed) > 8 and listed == list(space.character_set)  # too long for a coincidence
    return sorted(listed) if of_a_set else listed


def _read_text(fields: _Fields, _: ReadSub) -> gym.Space[Any]:
    lengths = {"min_length": fields.integer("min_length"), "max_length": fields.integer("max_length")}
    characters = fields.take("characters")
    if isinstance(characters, list):
        characters = "".join([chr(code) for code in characters])
    if not isinstance(characters, str) or len(set(characters)) != len(characters):
        raise fields.wrong("characters", "different characters")
    return spaces.Text(charset=characters, **lengths)


def _write_dict(space: Any, path: str, write_sub: WriteSub) -> Json:
    return {
        "spaces": [[_write_key(key, path), write_sub(sub, f"[{key!r}]")] for key, sub in space.spaces.items()]
    }


def _read_dict(fields: _Fields, read_sub: ReadSub) -> gym.Space[Any]:
    pairs = []
    for pair in fields.items("spaces"):
        if not isinstance(pair, list) or len(pair) != 2:
            raise fields.wrong("spaces", "pairs of a key and a space")
        key = _read_key(pair[0], fields)
        pairs.append((key, read_sub(pair[1], f"[{shorten(key)}]")))
    if len(dict(pairs)) != len(pairs):
        raise fields.wrong("spaces", "different keys")
    return spaces.Dict(pairs)


def _write_key(key: Any, path: str) -> Any:
    """A string as it is, another key as an object that holds its text."""
    try:
        text = jsonvalue.dumps(key)
    except (TypeError, ValueError) as err:
        raise SpaceError(f"{path}: expected keys with a JSON form, found {shorten(key)}: {err}") from err
    restored = jsonvalue.loads(text)
    # an enumeration, a named tuple, an object equal to nothing
    if type(restored) is not type(key) or restored != key:
        raise SpaceError(f"{path}: expected keys of built-in types or NumPy's, found {shorten(key)}")
    return key if text.startswith('"') else {"key": text}


def _read_key(obj: Any, fields: _Fields) -> Any:
    if isinstance(obj, dict) and obj.keys() == {"key"} and isinstance(obj["key"], str):
        return jsonvalue.loads_at(f"{fields.path}: a key", obj["key"])
    if not isinstance(obj, str):
        raise fields.wrong("spaces", "a key")
    return obj


def _write_tuple(space: Any, _path: str, write_sub: WriteSub) -> Json:
    return {"spaces": [write_sub(sub, f"[{i}]") for i, sub in enumerate(space.spaces)]}


def _read_tuple(fields: _Fields, read_sub: ReadSub) -> gym.Space[Any]:
    return spaces.Tuple([read_sub(sub, f"[{i}]") for i, sub in enumerate(fields.items("spaces"))])


def _read_one_of(fields: _Fields, read_sub: ReadSub) -> gym.Space[Any]:
    return spaces.OneOf([read_sub(sub, f"[{i}]") for i, sub in enumerate(fields.items("spaces"))])


def _write_sequence(space: Any, _path: str, write_sub: WriteSub) -> Json:
    return {"stack": bool(space.stack), "space": write_sub(space.feature_space, "[]", bool(space.stack))}


def _read_sequence(fields: _Fields, read_sub: ReadSub) -> gym.Space[Any]:
    stack = fields.flag("stack")
    return spaces.Sequence(read_sub(fields.take("space"), "[]", stack), stack=stack)


def _write_graph(space: Any, _path: str, write_sub: WriteSub) -> Json:
    edges = None if space.edge_space is None else write_sub(space.edge_space, ".edges", True)
    return {"node_space": write_sub(space.node_space, ".nodes", True), "edge_space": edges}


def _read_graph(fields: _Fields, read_sub: ReadSub) -> gym.Space[Any]:
    nodes: Any = read_sub(fields.take("node_space"), ".nodes", True)
    edges: Any = fields.take("edge_space")
    return spaces.Graph(nodes, None if edges is None else read_sub(edges, ".edges", True))


_Writer = Callable[[Any, str, WriteSub], Json]
_Reader = Callable[["_Fields", ReadSub], "gym.Space[Any]"]
_CODECS: dict[type, tuple[_Writer, _Reader]] = {
    spaces.Box: (_write_box, _read_box),
    spaces.Discrete: (_write_discrete, _read_discrete),
    spaces.MultiDiscrete: (_write_multi_discrete, _read_multi_discrete),
    spaces.MultiBinary: (_write_multi_binary, _read_multi_binary),
    spaces.Text: (_write_text, _read_text),
    spaces.Dict: (_write_dict, _read_dict),
    spaces.Tuple: (_write_tuple, _read_tuple),
    spaces.Sequence: (_write_sequence, _read_sequence),
    spaces.Graph: (_write_graph, _read_graph),
    spaces.OneOf: (_write_tuple, _read_one_of),
}
_READERS = {kind.__name__: reader for kind, (_, reader) in _CODECS.items()}


# ---- the fields of a space's object: bounds, dtypes and shapes


class _Fields:
    """Takes the fields of one object, and checks each of them."""

    def __init__(self, obj: Json, path: str) -> None:
        self._obj = obj
        self.path = path

    def take(self, name: str) -> Any:
        if name not in self._obj:
            raise FormatError(f"{self.path}: expected a field {name!r}, found none")
        return self._obj[name]

    def wrong(self, name: str, expected: str) -> FormatError:
        return FormatError(f"{self.path}: expected {expected} in {name!r}, found {shorten(self.take(name))}")

    def integer(self, name: str) -> int:
        value = self.take(name)
        if type(value) is not int:
            raise self.wrong(name, "an integer")
        return value

    def items(self, name: str) -> list[Any]:
        value = self.take(name)
        if not isinstance(value, list):
            raise self.wrong(name, "a list")
        return value

    def flag(self, name: str) -> bool:
        value = self.take(name)
        if type(value) is not bool:
            raise self.wrong(name, "true or false")
        return value

    def dtype(self) -> np.dtype[Any]:
        value = self.take("dtype")
        if not isinstance(value, str) or value not in _DTYPES:
            raise self.wrong("dtype", "the name of a dtype")
        return _DTYPES[value]

    def shape(self, name: str) -> tuple[int, ...]:
        value = self.items(name)
        if len(value) > _MAX_DIMENSIONS or not all(type(n) is int and 0 <= n < 2**63 for n in value):
            raise self.wrong(name, f"a list of at most {_MAX_DIMENSIONS} lengths")
        return tuple(value)

    def array(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Array:
        """An array of `shape`, from one number or from one for each element."""
        value = self.take(name)
        if not isinstance(value, list):
            return np.full(shape, self._number(name, value, dtype), dtype)
        if len(value) != math.prod(shape):
            raise FormatError(
                f"{self.path}: expected {math.prod(shape)} numbers in {name!r}, found {len(value)}"
            )
        array = np.array([self._number(name, item, dtype) for item in value], dtype)
        return array.reshape(shape)

    def built_shape(self, shape: tuple[int, ...], *names: str) -> tuple[int, ...]:
        """`shape`, or a shape of one element with as many dimensions if a large space has the same bounds everywhere.

        Such a space takes a few bytes in a file, and must take few in memory.
        """
        uniform = not any(isinstance(self._obj.get(name), list) for name in names)
        return (1,) * len(shape) if uniform and math.prod(shape) > _LARGE else shape

    def _number(self, name: str, value: Any, dtype: np.dtype[Any]) -> Any:
        if dtype.kind == "b":
            exact = type(value) is bool
        elif dtype.kind == "f":
            if isinstance(value, str) and value in ("inf", "-inf"):
                return float(value)
            with np.errstate(all="ignore"):
                exact = type(value) is float and value == float(dtype.type(value))
        else:
            exact = type(value) is int and np.iinfo(dtype).min <= value <= np.iinfo(dtype).max
        if not exact:
            raise FormatError(
                f"{self.path}: expected a number of {dtype} in {name!r}, found {shorten(value)}"
            )
        return value


def _dtype_name(dtype: np.dtype[Any], path: str) -> str:
    if _DTYPES.get(dtype.name) != dtype:  # big-endian ones have the same name
        raise SpaceError(
            f"{path}: expected a dtype of {', '.join(_DTYPES)}, found {dtype.str} ({dtype.name})"
        )
    return str(dtype.name)


def _numbers(array: Array) -> Any:
    """One number if all elements are the same bits, else the list of them; the opposite of `_Fields.array`."""
    if array.size and not any(array.strides):  # one element, spread
        array = array[(slice(1),) * array.ndim]
    flat = np.ascontiguousarray(array).reshape(-1)
    if flat.size == 0:
        return []
    items = flat.view(f"u{flat.itemsize}")
    values = flat[:1].tolist() if (items == items[0]).all() else flat.tolist()
    if flat.dtype.kind == "f":
        values = [value if math.isfinite(value) else str(value) for value in values]
    return values[0] if len(values) == 1 else values
