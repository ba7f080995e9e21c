"""Values as JSON text: exact, strict, and harmless to read."""

from __future__ import annotations

import enum
import json
import math
import subprocess
import sys
from collections import OrderedDict, namedtuple
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError
from tupli_mcap.jsonvalue import MAX_DEPTH, dumps, dumps_any, dumps_plain, loads, spelled
from tupli_mcap.schema import parse_filter


def same(one: Any, other: Any) -> bool:
    """Equal in type, dtype, shape and bytes, all the way down."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.longdouble):  # its bytes include padding
        return bool(one == other)
    if type(one) is complex:
        return same([one.real, one.imag], [other.real, other.imag])
    if isinstance(one, np.str_):
        return list(one) == list(other)
    if isinstance(one, np.ndarray | np.generic):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, dict):
        return len(one) == len(other) and all(
            same(a, b) and same(one[a], other[b]) for a, b in zip(one, other, strict=True)
        )
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float):
        if math.isnan(one):  # neither its sign nor its payload is kept
            return math.isnan(other)
        return math.copysign(1, one) == math.copysign(1, other) and one == other
    return bool(one == other)


def strict(text: str) -> Any:
    """Parse as other languages do: UTF-8, no NaN."""

    def refuse(name: str) -> Any:
        raise ValueError(name)

    return json.loads(text.encode(), parse_constant=refuse)


EXACT: list[Any] = [
    None, True, 0, -(2**63), 2**64 - 1, 2**64, -(2**1024 - 1), 0.1, -0.0, 5e-324, math.inf, -math.inf,
    math.nan, "", "é😀\n\x00", "\ud800", "\ud83d\ude00", b"\x00\xff", bytearray(b"ab"), 1 + 2j,
    complex(math.nan, -0.0), [], (), [1, (2, [3, ()])], {1, 2}, frozenset({"a", (1,)}), {},
    {"a": {"b": None}}, {"$float": "nan"}, {"$dict": []}, {"a": 1, "$b": 2},
    {1: "a", "1": "b", None: 0, (1, 2): []}, {"\ud800": 1}, np.float32(0.1), np.float64("nan"),
    np.bool_(True), np.int8(-3), np.uint64(2**64 - 1), np.float16(-0.0), np.longdouble("0.1"),
    np.complex64(1j), np.str_("a\x00"), np.str_("\ud800"), np.bytes_(b"a\x00"), np.str_(""),
    np.datetime64("2024-05-01T00:00:00.123456789"), np.datetime64("NaT"), np.timedelta64(5, "25s"),
    np.array(1.5), np.zeros((2, 0, 3), np.float16), np.arange(6).reshape(2, 3).T,
    np.array([1, 2], ">i4"), np.array(["ab", "é"]), np.array([b"a", b"bcd"]),
    np.array(["2024"], "M8[D]"), np.array([True, False]),
    np.array([0x7FF8DEADBEEF0001], np.uint64).view(np.float64),
    {"info": [np.arange(3), (np.float32(1),)]}, {np.int64(3): 1}, {b"k": 1, frozenset({1}): 2},
]  # fmt: skip


@pytest.mark.parametrize("value", EXACT, ids=lambda value: dumps(value)[:40])
def test_round_trip(value):
    text = dumps(value)
    strict(text)
    assert same(loads(text), value)
    assert same(loads(text.encode()), value)


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(st.characters(exclude_categories=[]))
    | st.binary(),
    lambda inner: (
        st.lists(inner)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text() | st.integers() | st.sampled_from(["$tuple", "$x"]), inner)
    ),
    max_leaves=20,
)
arrays = hnp.arrays(
    hnp.scalar_dtypes().filter(lambda dtype: dtype.itemsize), hnp.array_shapes(min_dims=0, min_side=0)
)


@given(json_values)
def test_any_value_round_trips(value):
    text = dumps(value)
    strict(text)
    assert same(loads(text), value)


@given(arrays)
def test_any_array_round_trips(array):
    assert same(loads(dumps(array)), array)


def test_arrays_read_are_ones_own():
    array = loads(dumps(np.zeros(3)))
    array[0] = 1
    assert array.flags.owndata


def test_subclasses_come_back_as_the_built_in_type():
    class Colour(enum.IntEnum):
        RED = 1

    class Name(str):
        __slots__ = ()

    point = namedtuple("point", "x y")
    value = {"colour": Colour.RED, "name": Name("n"), "point": point(1, 2), "map": OrderedDict(a=1)}
    assert same(loads(dumps(value)), {"colour": 1, "name": "n", "point": (1, 2), "map": {"a": 1}})


class Unknown:
    def __repr__(self) -> str:
        return "<unknown>"


@pytest.mark.parametrize(
    "value",
    [Unknown(), np.array([Unknown()], object), np.zeros(2, [("a", "i4")]), np.ma.masked_array([1], [True])],
)
def test_other_objects_are_named_or_fall_back(value):
    with pytest.raises(TypeError, match=r"value\['a'\]\[1\] is a .*; convert it"):
        dumps({"a": [0, value]})
    assert loads(dumps({"a": (0, value)}, fallback=repr)) == {"a": (0, repr(value))}


def test_nesting_is_bounded_both_ways():
    within: list[Any] = []
    within.append(within)
    with pytest.raises(ValueError, match="levels of nesting"):
        dumps(within)
    with pytest.raises(ValueError, match="levels of nesting"):
        dumps(Unknown(), fallback=lambda value: [value])
    for text in ("[" * 100_000, '{"a":' * 100_000, "[" * 500 + '"]"' + "]" * 500):
        with pytest.raises(FormatError, match="levels of nesting"):
            loads(text)
    assert loads("[" + ",".join(["[]"] * 1000) + "]") == [[]] * 1000
    assert loads(json.dumps(["[" * 1000, '\\"' + "{" * 1000])) == ["[" * 1000, '\\"' + "{" * 1000]


def test_deep_text_ends_no_process_whose_recursion_limit_is_raised():
    """Python's own parser then runs out of the C stack, before Python 3.12."""
    code = """
import sys
from tupli_mcap.errors import FormatError
from tupli_mcap.jsonvalue import loads
sys.setrecursionlimit(10**6)
for opening in ("[", '{"a":', '{"$tuple":['):
    try:
        loads(opening * 10**6)
    except FormatError as err:
        print(err)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.count("levels of nesting")) == (0, 3)


def test_deepest_values_round_trip():
    for wrap in (lambda v: [v], lambda v: (v,), lambda v: {1: v}, lambda v: {"a": v}):
        deep: Any = np.zeros(1)
        for _ in range(MAX_DEPTH - 1):
            deep = wrap(deep)
        assert loads(dumps(deep)) is not None


def test_a_dimension_is_a_level():
    deep: Any = np.zeros((1, 1))
    for _ in range(MAX_DEPTH - 1):
        deep = [deep]
    for write in (dumps, dumps_plain):
        with pytest.raises(ValueError, match="levels of nesting"):
            write(deep)
        assert loads(write(deep[0])) is not None


@pytest.mark.parametrize("text", ["[" * 65 + "]" * 65, '{"a":' * 65 + "1" + "}" * 65])
def test_levels_are_counted_alike_both_ways(text: str):
    """Deeper than `dumps` writes, though not deeper than tags nest brackets."""
    with pytest.raises(FormatError, match="levels of nesting"):
        loads(text)


def test_integers_are_bounded():
    most = 2**1024 - 1
    for write in (dumps, dumps_plain):
        assert loads(write([most, -most])) == [most, -most]
        with pytest.raises(TypeError, match="value is a builtins.int, which has no exact JSON form"):
            write(most + 1)
    for text in ('{"$int": "%x"}' % (most + 1), str(most + 1), f"[-{most + 1}]"):
        with pytest.raises(FormatError, match="more than 1024 bits"):
            loads(text)
    assert isinstance(loads(dumps_any(10**5000)), str)


def test_any_value_is_stored_in_the_nearest_form():
    key: Any = ()
    for _ in range(2 * MAX_DEPTH):
        key = (key,)
    for refused in ({(2**61 - 1) * i: 0 for i in range(100)}, {key: 1}):
        assert loads(dumps_any(refused)) == {repr(key): value for key, value in refused.items()}
    assert loads(dumps_any({math.nan: 1, float("nan"): 2, "x": [3]})) == {"nan": 2, "x": [3]}
    objects, records = np.array([None]), np.zeros(2, [("x", np.int64)])
    masked = np.ma.array([1, 2], mask=[False, True])
    for array in (objects, records, records[0], masked):
        assert loads(dumps_any({"a": [1, array], "b": 2})) == {"a": [1, repr(array)], "b": 2}


@pytest.mark.parametrize("tag", ["$set", "$frozenset", "$dict"])
def test_keys_of_one_hash_are_refused(tag: str):
    """Python's integers have the same hash if they differ by a multiple of 2**61 - 1."""
    numbers = [{"$int": f"{(2**61 - 1) * i:x}"} for i in range(1, 2000)]
    items: list[Any] = [[number, 0] for number in numbers] if tag == "$dict" else numbers
    with pytest.raises(FormatError, match="at most 64 keys of the same hash"):
        loads(json.dumps({tag: items}))
    assert len(loads(json.dumps({tag: items[:64]}))) == 64
    honest = set(range(100_000))
    assert loads(dumps(honest)) == honest


class Counted(int):
    """An integer that counts how often it is compared."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Counted.compared += 1
        return int(self) == other

    __hash__ = int.__hash__


def test_the_work_for_keys_grows_as_their_number(monkeypatch: pytest.MonkeyPatch):
    """Of those that are not refused."""

    def compared(count: int) -> int:
        Counted.compared = 0
        numbers = [(2**61 - 1) * (i % 64) + 1 + i // 64 for i in range(count)]
        loads(json.dumps({"$set": [{"$int": f"{number:x}"} for number in numbers]}))
        return Counted.compared

    monkeypatch.setitem(jsonvalue._RESTORE, "$int", lambda digits: Counted(int(digits, 16)))
    small, large = compared(2048), compared(4096)
    assert 0 < large <= 2.5 * small


# What `loads` accepts, whoever prints values can print.
tagged = st.recursive(
    st.none() | st.integers(-(2**1030), 2**1030) | st.floats(allow_nan=False, allow_infinity=False) | st.text()
    | st.builds(lambda n: {"$int": f"{n:x}"}, st.integers(2**64, 2**1030)),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)
    | st.builds(lambda items: {"$tuple": items}, st.lists(inner))
    | st.builds(lambda item, n: json.loads("[" * n + json.dumps(item) + "]" * n), inner, st.integers(1, 70)),
    max_leaves=8,
)  # fmt: skip


@given(tagged)
def test_what_is_read_can_be_printed(value):
    try:
        found = loads(json.dumps(value))
    except FormatError:
        return
    assert repr(found)
    assert same(loads(dumps(found)), found)
    assert dumps_plain(found)
    assert json.dumps(json.loads(dumps_plain([{"metadata": found}], max_depth=2 * MAX_DEPTH)))


def test_plain_text_can_be_filtered_on():
    value = {
        "score": np.float32(0.5), "done": np.bool_(True), "n": np.int64(3), "row": np.arange(2),
        "pair": (1, 2.5), "nan": np.float64("nan"), "grid": np.array([[1.0, np.inf]]), "name": np.str_("x"),
        7: "seven", "raw": b"\x00", "wide": np.longdouble(2), "when": np.datetime64("2024-01-01"),
    }  # fmt: skip
    parsed = strict(dumps_plain(value))
    assert same(
        {key: parsed[key] for key in parsed if key not in ("raw", "when")},
        {
            "score": 0.5, "done": True, "n": 3, "row": [0, 1], "pair": [1, 2.5], "nan": {"$float": "nan"},
            "grid": [[1.0, {"$float": "inf"}]], "name": "x", "7": "seven", "wide": 2.0,
        },
    )  # fmt: skip
    again = loads(dumps_plain(value))
    assert again["raw"] == b"\x00"
    assert again["when"] == np.datetime64("2024-01-01")
    assert math.isnan(again["nan"])


@pytest.mark.parametrize(
    "value",
    [
        {1: "a", "1": "b"},
        {"$float": 1},
        {(1, 2): 3},
        {math.nan: 1},
        {"cells": {(0, 1)}},
        frozenset({(1, (2,))}),
    ],
)
def test_plain_text_stays_reversible_where_names_would_meet(value):
    text = dumps_plain(value)
    strict(text)
    assert repr(loads(text)) == repr(value)


@given(json_values)
def test_plain_text_is_strict_and_stable(value):
    text = dumps_plain(value)
    strict(text)
    assert dumps_plain(loads(text)) == text


class Agent:
    def __repr__(self) -> str:
        return "Agent"

    def __array__(self) -> Any:
        return np.arange(2)


def test_keys_that_would_be_alike_are_refused() -> None:
    for alike in ({float("nan"): 1, float("nan"): 2}, {float("nan"), float("nan")}):
        for refusing in (dumps, dumps_plain, lambda value: dumps(value, fallback=repr)):
            with pytest.raises(ValueError, match="keys that differ as JSON, found two that are alike"):
                refusing(alike)
    pair = Agent(), Agent()
    info = {"of": dict.fromkeys(pair, 1), "who": set(pair), "one": {pair[0]: pair[1], (pair[0],): 2}}
    told = loads(dumps_any(info))
    assert (told["of"], told["who"]) == ("{Agent: 1, Agent: 1}", "{Agent, Agent}")
    assert told["one"].keys() == {"Agent", ("Agent",)}
    assert told["one"]["Agent"].tolist() == [0, 1]


def test_the_place_of_a_value_below_a_key_without_a_repr() -> None:
    class Nameless:
        def __repr__(self) -> str:
            raise RuntimeError

    with pytest.raises(TypeError, match=r"value\[<.*Nameless>\] is a builtins.object, which has no exact"):
        dumps({Nameless(): object()})


BAD = [
    "", "{", "[1,]", "nul", "NaN", "[Infinity]", '{"a":1}x', "1" * 5000, '{"$foo": 1}', '{"$float": 1}',
    '{"$float": "nan", "a": 1}', '{"$float": []}', '{"$int": "12_3"}', '{"$int": ""}', '{"$int": 3}',
    '{"$complex": [1.0]}', '{"$complex": "ab"}', '{"$str": [-1]}', '{"$str": ["a"]}',
    '{"$str": [1114112]}', '{"$bytes": "a"}', '{"$bytes": "é"}', '{"$bytes": 3}', '{"$tuple": "ab"}',
    '{"$tuple": {}}', '{"$set": [[]]}', '{"$dict": [[1]]}', '{"$dict": [[[], 1]]}',
    '{"$dict": [[1, 2], [1, 3]]}', '{"$dict": 3}', '{"$numpy": 3}', '{"$numpy": {}}',
    '{"$numpy_str": 3}', '{"$numpy_bytes": []}',
]  # fmt: skip


@pytest.mark.parametrize("text", BAD, ids=lambda text: text[:30])
def test_defects_are_format_errors(text):
    with pytest.raises(FormatError, match="expected"):
        loads(text)


@pytest.mark.parametrize(
    "fields",
    [
        {"dtype": "O"},
        {"dtype": "|O8"},
        {"dtype": "|V4"},
        {"dtype": "<f4,<i4"},
        {"dtype": "<f5"},
        {"dtype": "<i16"},
        {"dtype": "|S0"},
        {"dtype": "<U999999999999"},
        {"dtype": "<M8[parsec]"},
        {"dtype": ["<f4"]},
        {"dtype": [["a", "<f4"]]},
        {"shape": [2]},
        {"shape": [10**12]},
        {"shape": [-1, -1]},
        {"shape": [True]},
        {"shape": [1.0]},
        {"shape": "1"},
        {"shape": [1] * 100},
        {"shape": [0, 10**40], "data": ""},
        {"data": "AAAA"},
        {"data": 3},
        {"order": "F"},
        {"dtype": "|b1", "data": "Ag=="},
        {"dtype": "<U1", "data": "AAARAQ=="},
    ],
    ids=str,
)
def test_false_claims_of_arrays_are_format_errors(fields):
    good = {"dtype": "<f4", "shape": [1], "data": "AAAAAA=="}
    assert same(loads(json.dumps({"$numpy": good})), np.zeros(1, np.float32))
    with pytest.raises(FormatError, match=r"expected a value of '\$numpy'"):
        loads(json.dumps({"$numpy": good | fields}))


@pytest.mark.parametrize("data", [b"\xff\xfe", b'"\xed\xa0\x80"', b'"\x80"'])
def test_bad_utf8_is_a_format_error(data):
    with pytest.raises(FormatError, match="UTF-8"):
        loads(data)


@given(st.sampled_from([dumps(value) for value in EXACT]), st.data())
def test_a_damaged_text_is_a_value_or_a_format_error(text, data):
    at = data.draw(st.integers(0, len(text) - 1))
    damaged = text[:at] + data.draw(st.characters()) + text[at + data.draw(st.integers(0, 2)) :]
    try:
        value = loads(damaged)
    except FormatError:
        return
    assert same(loads(dumps(value)), value)


@pytest.mark.parametrize(
    "value",
    [True, False, None, 3, -0.5, 1e300, math.inf, "true", "None", "3", "1_0", "nan", "-inf", np.bool_(True)],
)
def test_what_is_spelled_is_what_a_filter_takes(value: Any) -> None:
    read = parse_filter(f"metadata.x == {spelled(value)}").value
    assert same(read, value.item() if isinstance(value, np.generic) else value)


def test_other_values_are_spelled_for_people() -> None:
    values = ["good", "", [1, True, "a"], {"a": None}, b"x", np.arange(2), [np.arange(2)]]
    assert [spelled(value) for value in values] == [
        "good", "", '[1, true, "a"]', '{"a": null}', "b'x'", "array([0, 1])", "[array([0, 1])]",
    ]  # fmt: skip
