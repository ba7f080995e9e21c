"""Python and NumPy values as JSON text, exactly and both ways.

Values that JSON has are written plainly: strings, finite floats, integers, booleans, None, lists, dicts with string
keys. Any other value is an object with one key that starts with `$`:

`$float`: "nan", "inf" or "-inf"
`$int`: hexadecimal digits of an integer of more than 64 bits, and at most 1024
`$complex`: `[real, imaginary]`
`$str`: code points of a string with lone surrogates, which UTF-8 cannot carry
`$bytes`, `$bytearray`: base64
`$tuple`, `$set`, `$frozenset`: a list of values
`$dict`: `[key, value]` pairs, if a key is no string or starts with `$`
`$numpy`: `{"dtype", "shape", "data"}`, the bytes in C order as base64; a scalar has no shape
`$numpy_str`, `$numpy_bytes`: a scalar of these types, whose trailing NULs an array would drop

A dict of the user with such a key is written as `$dict`, so a `$` key is always a tag. The text is strict JSON.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import operator
import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array, is_masked
from tupli_mcap.errors import FormatError

MAX_DEPTH = 64
"""Deepest nesting of values: each container is a level, and each dimension of an array."""

Fallback = Callable[[Any], Any]

_SURROGATE = re.compile("[\ud800-\udfff]")
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*+"|[\[{]|[\]}]')
_DTYPE = re.compile(
    r"[<>|](?:b1|[iu][1248]|f(?:2|4|8|12|16)|c(?:8|16|24|32)|[SU][1-9]\d{0,8}|[Mm]8(?:\[\d*[A-Za-z]+\])?)"
)
_KINDS = "biufcSUMm"
_BRACKETS_A_LEVEL = 3  # {"$dict": [[key, ...
_MAX_CODE_POINT = 0x10FFFF
_SCALARS = {type(None), bool, float, int, str}
_PLAIN_OF: dict[type, Callable[[Any], Any]] = {str: str.__str__, int: int.__int__, float: float.__float__}
# Few other JSON readers take integers of more than 64 bits.
_EXACT_INT_BITS = 64
_PLAIN_INT_BITS = 1024  # no integer may have more: Python does not print those beyond 4300 digits
_LONG_NUMBER = re.compile(r"\d{309}")  # 1024 bits are 309 digits at most
_SAME_HASH = 64  # most keys with one hash: Python compares each of them with all others


def dumps(value: Any, *, fallback: Fallback | None = None) -> str:
    """Return JSON text from which `loads` rebuilds `value`: type, dtype, shape and bytes.

    Subclasses of the built-in types (a namedtuple, an `IntEnum`, an `OrderedDict`) come back as the built-in
    type. The payload of a NaN survives in NumPy values only. `fallback` is called for anything else (arrays of objects
    or with a mask too) and returns what to store in its place; for a key, or an entry of a set, it is its `repr`.

    Raises:
        TypeError: an object of another type, or an integer of more than 1024 bits, and no `fallback`; the message says
            where it is.
        ValueError: nesting beyond `MAX_DEPTH`, more than 64 keys or entries of a set with the same hash, or two that
            are alike as JSON, such as two NaN.
    """
    return _text(_Encoder(fallback, plain=False), value)


def dumps_any(value: Any) -> str:
    """Return `dumps` of any value: a tensor is stored as an array, any other object without an exact form as its
    `repr`.

    An object without a `repr` becomes the name of its type. What `dumps` refuses with a ValueError (a value nested too
    deep or in itself) becomes its `repr`: an entry of a dict alone, or all of its keys if one is refused.
    """
    try:
        return dumps(value, fallback=_nearest)
    except ValueError:
        if type(value) is not dict:
            return dumps(shown(value))
    items = {key: _shallow(item) for key, item in value.items()}
    try:
        return dumps(items, fallback=_nearest)
    except ValueError:  # of several keys with one `repr`, the last one stays
        return dumps(
            {key if type(key) is str else shown(key): item for key, item in items.items()}, fallback=_nearest
        )


def _shallow(value: Any) -> Any:
    try:
        dumps([value], fallback=_nearest)
    except ValueError:
        return shown(value)
    return value


def array_in(value: Any) -> Array | None:
    """Return the array in a tensor of PyTorch or JAX; None if there is none that NumPy has a dtype for."""
    try:
        if not hasattr(value, "detach"):
            return np.asarray(value.__array__())
        tensor = value.detach().cpu()
        # float32 holds each value of bfloat16, which NumPy does not have
        return np.asarray(tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor)
    except Exception:  # noqa: BLE001 (somebody else's code, and nothing depends on it)
        return None


def _nearest(value: Any) -> Any:
    """The array in a tensor, else the text of `shown`. A NumPy array that has no exact form (of objects, of records,
    with a mask) is no tensor: as an array it would come here again, or lose its mask."""
    found = None if isinstance(value, (np.ndarray, np.generic)) else array_in(value)
    return shown(value) if found is None else found


def shown(value: Any) -> str:
    """Return the `repr` of any value, or the name of its type if it has none (an integer of 5,000 digits)."""
    try:
        return repr(value)
    except Exception:  # noqa: BLE001 (somebody else's code, and nothing depends on it)
        return f"<{type(value).__module__}.{type(value).__qualname__}>"


def is_unicode(text: str) -> bool:
    """Whether UTF-8 has the text; it has no half of a surrogate pair."""
    return text.isascii() or _SURROGATE.search(text) is None


def spelled(value: Any) -> str:
    """Return a value for people, as filters write it: `true`, `null`, `0.5`; lists and dicts as JSON.

    A text has quotes only if it would read as another value: `good`, but `"true"` and `"3"`. Any value that JSON has no
    form for is its `repr`.
    """
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False) if _reads_otherwise(value) else value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    try:
        return json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError, RecursionError):
        return shown(value)


def _reads_otherwise(text: str) -> bool:
    try:
        float(text)  # also nan and inf
    except ValueError:
        return text.lower() in ("true", "false", "null", "none")
    return True


def dumps_plain(value: Any, *, max_depth: int = MAX_DEPTH, name: str = "value") -> str:
    """Return JSON text for filters: NumPy scalars are numbers, arrays and tuples are lists.

    Values that JSON has no form for (NaN, infinities, bytes, sets, complex numbers, dates) are tagged as by `dumps`.
    Keys that are numbers, booleans or None become strings as in the standard library's `json`, unless two keys become
    equal. `max_depth` is for text that is only printed: `loads` reads `MAX_DEPTH` levels. Raises as `dumps` does; its
    TypeError calls the value by its `name`.
    """
    return _text(_Encoder(None, plain=True, max_depth=max_depth), value, name)


def loads(text: str | bytes) -> Any:
    """Return the value of a text that `dumps` or `dumps_plain` wrote; nothing in the text is executed. Raises
    FormatError if the text is something else."""
    try:
        if isinstance(text, bytes):
            text = text.decode()
        brackets = _depth_of(text)
        number = (lambda digits: _bounded(int(digits))) if _LONG_NUMBER.search(text) else None
        value = json.loads(text, object_hook=_restore, parse_constant=_refuse_constant, parse_int=number)
        if brackets > MAX_DEPTH:  # each level takes at least one bracket
            _check_levels(value, 0)
        return value
    except UnicodeDecodeError as err:
        raise FormatError(f"expected JSON in UTF-8, found a bad byte at offset {err.start}") from err
    except json.JSONDecodeError as err:
        raise FormatError(f"expected JSON, found a defect at character {err.pos}: {err.msg}") from err
    except (ValueError, RecursionError, OverflowError) as err:
        raise FormatError(f"expected JSON of values: {err}") from err


def loads_at(place: str, text: str | bytes) -> Any:
    """As `loads`; an error begins with the place of the text."""
    try:
        return loads(text)
    except FormatError as err:
        raise FormatError(f"{place}: {err}") from err


class _UnstorableError(TypeError):
    """Collects the path on its way up, so that values that can be stored need no path."""

    def __init__(self, value: Any) -> None:
        super().__init__(value)
        self.found = type(value)
        self.path: list[str] = []


def _text(encoder: _Encoder, value: Any, name: str = "value") -> str:
    try:
        tree = encoder.encode(value, 0)
    except _UnstorableError as err:
        where = name + "".join(reversed(err.path))
        kind = f"{err.found.__module__}.{err.found.__qualname__}"
        raise TypeError(f"{where} is a {kind}, which has no exact JSON form; convert it") from None
    return json.dumps(tree, ensure_ascii=False, allow_nan=False, separators=(",", ":"))


class _Encoder:
    """Turns a value into one that `json.dumps` takes."""

    def __init__(self, fallback: Fallback | None, *, plain: bool, max_depth: int = MAX_DEPTH) -> None:
        self.fallback = fallback
        self.plain = plain
        self.max_depth = max_depth
        self.int_bits = _PLAIN_INT_BITS if plain else _EXACT_INT_BITS

    def encode(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if kind is bool or value is None:
            return value
        if kind is float:
            return value if math.isfinite(value) else {"$float": repr(value)}
        if kind is int:
            return self._integer(value, depth)
        if kind is str:
            return _string(value)
        if depth + _levels(value) > self.max_depth:
            raise ValueError(
                f"expected at most {self.max_depth} levels of nesting, found more (a value in itself?)"
            )
        if isinstance(value, (np.generic, np.ndarray)):
            return self._numpy(value, depth)
        if isinstance(value, dict):
            return self._mapping(value, depth)
        return self._other(value, depth)

    def _other(self, value: Any, depth: int) -> Any:
        if isinstance(value, list):
            return self._items(value, depth)
        if isinstance(value, tuple):
            return self._items(value, depth) if self.plain else {"$tuple": self._items(value, depth)}
        if isinstance(value, (set, frozenset)):
            tag = "$set" if isinstance(value, set) else "$frozenset"
            # Sorted by text: the order of a set differs between processes.
            return {tag: sorted(self._keys(list(value), depth), key=json.dumps)}
        if isinstance(value, (bytes, bytearray)):
            return {"$bytes" if isinstance(value, bytes) else "$bytearray": _base64(value)}
        if isinstance(value, complex):
            return {"$complex": [self.encode(value.real, depth + 1), self.encode(value.imag, depth + 1)]}
        for base, plain in _PLAIN_OF.items():  # subclasses, such as enumerations
            if isinstance(value, base):
                return self.encode(plain(value), depth + 1)
        return self._fall_back(value, depth)

    def _fall_back(self, value: Any, depth: int) -> Any:
        if self.fallback is None:
            raise _UnstorableError(value)
        return self.encode(self.fallback(value), depth + 1)

    def _integer(self, value: int, depth: int) -> Any:
        bits = value.bit_length()
        if bits > _PLAIN_INT_BITS:
            return self._fall_back(value, depth)
        return value if bits <= self.int_bits else {"$int": f"{value:x}"}

    def _items(self, values: Iterable[Any], depth: int) -> list[Any]:
        items: list[Any] = []
        try:
            for value in values:
                items.append(self.encode(value, depth + 1))  # noqa: PERF401 (the length says where it failed)
        except _UnstorableError as err:
            err.path.append(f"[{len(items)}]")
            raise
        return items

    def _mapping(self, value: dict[Any, Any], depth: int) -> Any:
        plain = True
        items: dict[Any, Any] = {}
        key: Any = None
        try:
            for key, item in value.items():
                plain = plain and type(key) is str and not key.startswith("$") and is_unicode(key)
                items[key] = self.encode(item, depth + 1)
        except _UnstorableError as err:
            err.path.append(f"[{shown(key)}]")
            raise
        if plain:
            return items
        if self.plain:
            named = {_json_key(key): item for key, item in items.items()}
            if len(named) == len(items) and all(type(name) is str for name in named):
                return named
        return {"$dict": list(map(list, zip(self._keys(list(items), depth), items.values(), strict=True)))}

    def _keys(self, keys: list[Any], depth: int) -> list[Any]:
        """Keys of a dict or entries of a set: exactly, or as texts, since neither a list nor an array can be one."""
        _check_hashes(keys)
        exact = _Encoder(self.fallback and shown, plain=False, max_depth=self.max_depth)
        encoded = [exact.encode(key, depth + 1) for key in keys]
        if len({key if type(key) is int else json.dumps(key) for key in encoded}) < len(keys):
            raise ValueError("expected keys that differ as JSON, found two that are alike")
        return encoded

    def _numpy(self, value: Any, depth: int) -> Any:
        if isinstance(value, np.str_):
            text = _string(str.__str__(value))  # str() would drop trailing NULs
            return text if self.plain else {"$numpy_str": text}
        if isinstance(value, np.bytes_):
            return {"$numpy_bytes": _base64(bytes(value))}
        dtype = value.dtype
        if dtype.kind not in _KINDS or dtype.itemsize == 0 or is_masked(value):
            return self._fall_back(value, depth)
        if self.plain and dtype.kind in "biufU":
            if dtype.char == "g":  # .item() of a long double is a long double again
                value = value.astype(np.float64)
            return self.encode(value.item() if value.ndim == 0 else value.tolist(), depth)
        data = np.asarray(value)
        if dtype.kind == "b":
            data = data.view(np.uint8) != 0  # a bool made by a view may hold any byte
        tagged = {"dtype": dtype.str, "data": _base64(data.tobytes())}
        if isinstance(value, np.ndarray):
            tagged["shape"] = list(value.shape)
        return {"$numpy": tagged}


def _json_key(key: Any) -> Any:
    """Return the string that `json` makes of a key, or the key itself if it makes none."""
    if isinstance(key, np.generic):
        key = key.item()
    if type(key) is str:
        return None if key.startswith("$") or not is_unicode(key) else key
    if key is None or type(key) is bool:
        return {None: "null", True: "true", False: "false"}[key]
    if type(key) is int and key.bit_length() <= _PLAIN_INT_BITS:
        return str(key)
    return repr(key) if type(key) is float and math.isfinite(key) else None


def _string(text: str) -> Any:
    return text if is_unicode(text) else {"$str": [ord(character) for character in text]}


def _base64(data: bytes | bytearray) -> str:
    return base64.b64encode(data).decode("ascii")


def _depth_of(text: str) -> int:
    """How deep brackets are nested, or their number if that is small."""
    most = text.count("[") + text.count("{")
    if most <= MAX_DEPTH:
        return most
    depth = deepest = 0
    for match in _TOKEN.finditer(text):
        token = match[0]
        if token in "[{":
            depth += 1
            deepest = max(deepest, depth)
            if depth > _BRACKETS_A_LEVEL * (MAX_DEPTH + 1):
                raise ValueError(f"expected at most {MAX_DEPTH} levels of nesting, found more")
        elif token in "]}":
            depth -= 1
    return deepest


def _levels(value: Any) -> int:
    """The number of levels that a value adds by itself, without its contents."""
    if type(value) in _SCALARS:
        return 0
    return max(1, value.ndim) if isinstance(value, np.ndarray) else 1


def _check_levels(value: Any, depth: int) -> None:
    """Raises ValueError if `dumps` would, because of the depth of a value."""
    if type(value) in _SCALARS:
        return
    if depth + _levels(value) > MAX_DEPTH:
        raise ValueError(f"expected at most {MAX_DEPTH} levels of nesting, found more")
    if isinstance(value, dict):
        for key, item in value.items():
            if type(key) is not str:
                _check_levels(key, depth + 1)
            _check_levels(item, depth + 1)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for item in value:
            _check_levels(item, depth + 1)


def _check_hashes(keys: list[Any]) -> None:
    """Raises ValueError if too many keys have the same hash: a dict or a set of n such keys takes n squared
    comparisons.

    Integers have the same hash if they differ by a multiple of 2**61 - 1.
    """
    if len(keys) > _SAME_HASH:
        hashes = sorted(map(hash, keys))
        if any(map(operator.eq, hashes, hashes[_SAME_HASH:])):
            raise ValueError(f"expected at most {_SAME_HASH} keys of the same hash, found more")


def _refuse_constant(name: str) -> Any:
    raise ValueError(f'expected strict JSON, found {name}, which is written {{"$float": "nan"}} or alike')


def _restore(tagged: dict[str, Any]) -> Any:
    """Called for every object of a text, innermost first."""
    for key in tagged:
        if key.startswith("$"):
            break
    else:
        return tagged
    restore = _RESTORE.get(key)
    if restore is None or len(tagged) != 1:
        raise ValueError(f"expected one known tag in an object, found {list(tagged)!r:.80}")
    try:
        return restore(tagged[key])
    except (TypeError, ValueError, OverflowError, binascii.Error, KeyError, AttributeError) as err:
        raise ValueError(f"expected a value of {key!r}, found {tagged[key]!r:.80} ({err})") from err


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise TypeError("not a list")
    return value


def _str(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("not a string")
    return value


def _from_int(value: Any) -> int:
    if not re.fullmatch(r"-?[0-9a-f]+", value):
        raise ValueError("not hexadecimal")
    return _bounded(int(value, 16))


def _bounded(value: int) -> int:
    if value.bit_length() > _PLAIN_INT_BITS:
        raise ValueError(f"an integer of more than {_PLAIN_INT_BITS} bits")
    return value


def _from_complex(value: Any) -> complex:
    real, imaginary = _list(value)
    if type(real) is not float or type(imaginary) is not float:
        raise TypeError("not two floats")
    return complex(real, imaginary)


def _from_base64(value: Any) -> bytes:
    return base64.b64decode(_str(value), validate=True)


def _from_items(value: Any) -> list[Any]:
    items = _list(value)
    _check_hashes(items)
    return items


def _from_pairs(value: Any) -> dict[Any, Any]:
    _check_hashes([key for key, _ in _list(value)])
    pairs = {key: item for key, item in _list(value)}  # noqa: C416 (two items each, or ValueError)
    if len(pairs) != len(value):
        raise ValueError("a key occurs twice")
    return pairs


def _from_numpy(value: Any) -> Any:
    name, data = _str(value["dtype"]), _from_base64(value["data"])
    if not _DTYPE.fullmatch(name) or value.keys() - {"dtype", "data", "shape"}:
        raise ValueError("not a dtype of numbers, strings, bytes or times")
    shape = _list(value.get("shape", []))
    if not all(type(length) is int and length >= 0 for length in shape):
        raise ValueError("not a shape")
    dtype = np.dtype(name)
    # The size is a claim: it must agree with the bytes before anything is allocated.
    if dtype.itemsize * math.prod(shape) != len(data):
        raise ValueError("bytes and shape do not agree")
    array = np.ndarray(tuple(shape), dtype, bytearray(data)).copy()
    if dtype.kind == "U" and array.reshape(-1).view(dtype.byteorder + "u4").max(initial=0) > _MAX_CODE_POINT:
        raise ValueError("a code point beyond Unicode")
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a boolean that is not 0 or 1")
    return array if "shape" in value else array[()]


_RESTORE: dict[str, Callable[[Any], Any]] = {
    "$float": {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}.__getitem__,
    "$int": _from_int,
    "$complex": _from_complex,
    "$str": lambda value: "".join([chr(code) for code in _list(value)]),
    "$bytes": _from_base64,
    "$bytearray": lambda value: bytearray(_from_base64(value)),
    "$tuple": lambda value: tuple(_list(value)),
    "$set": lambda value: set(_from_items(value)),
    "$frozenset": lambda value: frozenset(_from_items(value)),
    "$dict": _from_pairs,
    "$numpy": _from_numpy,
    "$numpy_str": lambda value: np.str_(_str(value)),
    "$numpy_bytes": lambda value: np.bytes_(_from_base64(value)),
}
