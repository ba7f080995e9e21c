"""Values of variable size as CDR: every space, exactly, for this reader and for others."""

from __future__ import annotations

import re
import struct
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.spaces import GraphInstance
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from mcap_ros2._dynamic import generate_dynamic
from sample_spaces import NESTED_GRAPHS, SPACES, space_id

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, SpaceError, StepError
from tupli_mcap.messages.variable.codec import VariableField, variable_dtypes

Box, Dict, Discrete, Graph = spaces.Box, spaces.Dict, spaces.Discrete, spaces.Graph
OneOf, Sequence, Text, Tuple = spaces.OneOf, spaces.Sequence, spaces.Text, spaces.Tuple

VARIABLE = (Text, Sequence, Graph, OneOf)
HEADER = b"\x00\x01\x00\x00"

needs_nested_graphs = pytest.mark.skipif(
    not NESTED_GRAPHS, reason="the Graphs of Gymnasium 1.0 are of Box and Discrete only"
)


def is_variable(space: gym.Space[Any]) -> bool:
    if isinstance(space, Dict | Tuple):
        return True
    return isinstance(space, VARIABLE)


# Leaves of constant size are put into a Sequence, as a field of their own is not this module's.
FIELDS = [space if is_variable(space) else Sequence(space) for space in SPACES]


def same(one: Any, other: Any) -> bool:
    """Equal in type, dtype, shape and bytes, all the way down."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray | np.generic):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def encode(field: VariableField, value: Any, before: int = 0) -> bytes:
    out = bytearray(b"\xee" * 4 + bytes(before))
    field.encode(value, out, 4)
    return bytes(out)


def decode(field: VariableField, data: bytes, before: int = 0) -> Any:
    value, end = field.decode(memoryview(data), 4 + before, 4)
    assert end == len(data)
    return value


def schema_of(field: VariableField, head: str = "", tail: str = "") -> str:
    parts = [f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in field.definitions]
    return f"{head}{field.field_type} {field.name}\n{tail}" + "".join(parts)


def ros_decode(field: VariableField, value: Any, before: int) -> Any:
    """What mcap-ros2-support reads, with other fields before and after."""
    schema = schema_of(field, f"uint8[{before}] head\n" if before else "", "uint8 tail\n")
    decoder = generate_dynamic("tupli_mcap/msg/Step", schema)["tupli_mcap/msg/Step"]
    message = decoder(HEADER + encode(field, value, before)[4:] + b"\x77")
    assert message.tail == 0x77
    return getattr(message, field.name)


def flat(value: Any) -> list[Any]:
    """All numbers and texts of a value or of a decoded ROS message, in order; a text not chosen is empty."""
    if isinstance(value, np.ndarray | np.generic):
        bits = np.asarray(value)
        bits = bits.view(np.uint16) if bits.dtype == np.float16 else bits
        return [repr(x) for x in bits.reshape(-1).tolist()]
    if isinstance(value, bytes):
        return [repr(x) for x in value]
    if isinstance(value, dict):
        return [x for item in value.values() for x in flat(item)]
    if isinstance(value, list | tuple):
        return [x for item in value for x in flat(item)]
    if hasattr(value, "__slots__") and not isinstance(value, str | int | float):
        skipped = ("has_edges", "has_edge_links", "structure_needs_at_least_one_member")
        return [x for name in value.__slots__ if name not in skipped for x in flat(getattr(value, name))]
    return [] if value is None or value == "" else [repr(value)]


@pytest.mark.parametrize("space", FIELDS, ids=space_id)
@pytest.mark.parametrize("before", [0, 1, 6])
def test_samples_round_trip(space, before):
    field = VariableField(space, "note")
    space.seed(3)
    for _ in range(5):
        value = space.sample()
        data = encode(field, value, before)
        assert same(decode(field, data, before), value)


@pytest.mark.parametrize("space", FIELDS, ids=space_id)
@pytest.mark.parametrize("before", [0, 3])
def test_another_reader_sees_the_same_fields(space, before):
    field = VariableField(space, "note", type_prefix="StateNote")
    space.seed(5)
    for _ in range(3):
        value = space.sample()
        seen = ros_decode(field, value, before)
        if field.field_type == "uint32":  # a number of arrays without elements
            assert seen == len(value)
        else:
            assert flat(seen) == flat(value)


@pytest.mark.parametrize("space", FIELDS, ids=space_id)
def test_names_suit_every_reader(space):
    taken = {"NoteItem"}
    field = VariableField(space, "note", type_prefix="Note", taken=taken)
    names = [name for name, _ in field.definitions]
    assert len(set(names)) == len(names)
    assert "tupli_mcap/NoteItem" not in names
    assert {name.removeprefix("tupli_mcap/") for name in names} <= taken
    for name, text in field.definitions:
        assert re.fullmatch(r"tupli_mcap/[A-Z][A-Za-z0-9]*", name)
        lines = [line.split(" ") for line in text.splitlines()]
        fields = [line[1] for line in lines]
        assert fields
        assert len(set(fields)) == len(fields)
        for ros, line_name in lines:
            assert re.fullmatch(r"(tupli_mcap/[A-Z][A-Za-z0-9]*|[a-z]+\d*)(\[\d*\])?", ros)
            assert re.fullmatch(r"[a-z](_?[a-z0-9]+)*", line_name) or line_name.startswith("structure_needs")


@pytest.mark.parametrize(
    ("space", "field_type"),
    [
        (Text(3), "string"),
        (Sequence(Text(3)), "string[]"),
        (Sequence(Discrete(3)), "int64[]"),
        (Sequence(Box(0, 1, (2, 3))), "float32[]"),
        (Sequence(Box(0, 1, (), np.float16), stack=True), "uint16[]"),
        (Sequence(Box(0, 1, (2, 0)), stack=True), "uint32"),
        (Sequence(Box(0, 1, (2, 0))), "tupli_mcap/NoteItem[]"),
        (Sequence(Dict(a=Discrete(2))), "tupli_mcap/NoteItem[]"),
        (Sequence(Dict(a=Discrete(2)), stack=True), "tupli_mcap/Note"),
        (Graph(Discrete(2), None), "tupli_mcap/Note"),
    ],
    ids=str,
)
def test_field_types(space, field_type):
    assert VariableField(space, "note", type_prefix="Note").field_type == field_type


@needs_nested_graphs
def test_definitions_read_well():
    edges = Dict([("Weight", Box(0, 1, ())), ("label?", Text(3)), ("bool", Discrete(2))])
    field = VariableField(Graph(Box(0, 1, (2,)), edges), "g", type_prefix="StateG")
    assert field.definitions == [
        ("tupli_mcap/StateGEdges", "float32[] weight\nstring[] label\nint64[] bool_2\n"),
        (
            "tupli_mcap/StateG",
            "float32[] nodes\nbool has_edges\ntupli_mcap/StateGEdges[] edges\n"
            "bool has_edge_links\nint32[] edge_links\n",
        ),
    ]


@given(st.text(st.characters(exclude_categories=[])))
def test_any_text(text):
    field = VariableField(Text(5), "note")
    assert decode(field, encode(field, text)) == text
    seen = ros_decode(field, text, 0)
    if not re.search("[\x00\x1a\ud800-\udfff]", text):
        assert seen == text
    seen.encode()
    assert "\0" not in seen


@given(
    st.lists(hnp.arrays(np.float64, (2,), elements=st.floats(width=64)), max_size=4).map(tuple),
    st.integers(0, 9),
)
def test_any_floats_to_the_bit(value, before):
    field = VariableField(Sequence(Box(-np.inf, np.inf, (2,), np.float64)), "note")
    assert same(decode(field, encode(field, value, before), before), value)


def test_nan_payloads_survive():
    payload = np.array([0x7FF8DEADBEEF0001, 0xFFF0000000000001], np.uint64).view(np.float64)
    half = np.array([0x7E01, 0xFC01, 0x8000], np.uint16).view(np.float16)
    for value in ((payload,), (half,)):
        field = VariableField(Sequence(Box(-np.inf, np.inf, value[0].shape, value[0].dtype.type)), "note")
        assert same(decode(field, encode(field, value)), value)


def test_none_and_empty_edges_differ():
    field = VariableField(Graph(Box(-1, 1, (2,)), Discrete(3)), "note")
    nodes, links = np.zeros((3, 2), np.float32), np.zeros((0, 2), np.int32)
    none = GraphInstance(nodes, None, None)
    empty = GraphInstance(nodes, np.zeros(0, np.int64), links)
    half = GraphInstance(nodes, None, links)
    no_nodes = GraphInstance(nodes[:0], np.zeros(0, np.int64), None)
    for value in (none, empty, half, no_nodes):
        assert same(decode(field, encode(field, value)), value)


@needs_nested_graphs
@pytest.mark.parametrize(
    "edge_space", [Text(2), Dict(a=Discrete(2)), Box(0, 1, (2, 0)), Tuple(()), Sequence(Discrete(2))]
)
def test_none_edges_of_every_kind(edge_space):
    field = VariableField(Graph(Discrete(2), edge_space), "note")
    value = GraphInstance(np.zeros(1, np.int64), None, None)
    assert same(decode(field, encode(field, value)), value)
    ros_decode(field, value, 1)


@pytest.mark.parametrize(
    ("space", "value", "again"),
    [
        (
            Sequence(Discrete(3)),
            (1, np.int8(2), True, np.array(0)),
            (np.int64(1), np.int64(2), np.int64(1), np.int64(0)),
        ),
        (Sequence(Box(0, 9, (), np.float32)), (1, 0.5), (np.array(1, np.float32), np.array(0.5, np.float32))),
        (Sequence(Box(0, 9, (2,), np.float32)), (np.array([1, 2]),), (np.array([1, 2], np.float32),)),
        (Sequence(Box(0, 1, (1,), np.bool_)), (np.array([2], np.uint8).view(np.bool_),), (np.array([True]),)),
        (Sequence(Box(0, 9, (2,), np.float64)), (np.array([1, 2], ">f4"),), (np.array([1.0, 2.0]),)),
        (Sequence(Box(0, 9, (2, 2), np.int8)), (np.arange(4, dtype=np.int8).reshape(2, 2).T,), None),
        (OneOf([Discrete(2), Text(3)]), (np.uint8(1), "abc"), (np.int64(1), "abc")),
        (Dict({"b": Text(2), "a": Text(2)}), {"b": "x", "a": "y"}, {"a": "y", "b": "x"}),
        (Sequence(Box(0, 1, (2,)), stack=True), np.zeros((0, 2), np.float32), None),
    ],
    ids=str,
)
def test_values_that_lose_nothing_are_stored(space, value, again):
    field = VariableField(space, "note")
    found = decode(field, encode(field, value))
    if again is None:
        again = tuple(np.ascontiguousarray(x) for x in value) if isinstance(value, tuple) else value
    assert same(found, again)


def test_more_arrays_without_elements_than_numpy_makes() -> None:
    field = VariableField(Sequence(Box(0, 1, (0, 2**31)), stack=True), "note")
    assert field.decode(memoryview(struct.pack("<I", 3)), 0, 0)[0].shape == (3, 0, 2**31)
    with pytest.raises(FormatError, match=r"^note: expected arrays of shape .* found 4294967295"):
        field.decode(memoryview(struct.pack("<I", 2**32 - 1)), 0, 0)


class Custom(gym.Space[Any]):
    def __repr__(self) -> str:  # without an address: the processes that share the tests name them alike
        return "Custom()"


@pytest.mark.parametrize(
    ("space", "value", "match"),
    [
        (Text(3), 5, r"^note: expected a string, found 5"),
        (Sequence(Text(3)), ("a", b"b"), r"^note\[1\]: expected a string, found b'b'"),
        (Sequence(Text(3)), ["a"], r"^note: expected a tuple, found \['a'\]"),
        (Sequence(Text(3)), None, r"^note: expected a tuple, found None"),
        (Sequence(Discrete(3)), [1], r"^note: expected a tuple, found \[1\]"),
        (Sequence(Discrete(3)), (1, 1.7), r"^note\[1\]: expected .*int64.*1\.7"),
        (Sequence(Discrete(3)), (2**70,), r"^note\[0\]: expected int64"),
        (Sequence(Box(0, 2, (), np.int8)), (300,), r"^note\[0\]: expected .*int8"),
        (Sequence(Discrete(3)), (np.array([1]),), r"^note\[0\]: expected shape \(\), found shape \(1,\)"),
        (Sequence(Discrete(3)), (None,), r"^note\[0\]: expected int64"),
        (Sequence(Discrete(3)), ("1",), r"^note\[0\]: expected int64"),
        (Sequence(Box(0, 1, (2,))), (np.array([0.1, 1.0]),), r"^note\[0\]: expected .*float32.*float64"),
        (Sequence(Box(0, 1, (2,))), (np.zeros(3),), r"^note\[0\]: expected shape \(2,\), found shape \(3,\)"),
        (Sequence(Box(0, 1, (2, 0))), (np.zeros((2, 1)),), r"^note\[0\]: expected shape"),
        (Sequence(Box(0, 1, (2,), np.bool_)), (np.array([0, 2]),), r"^note\[0\]: expected .*bool"),
        (
            Sequence(Box(0, 1, (2,)), stack=True),
            (np.zeros(2),),
            r"^note: expected an array of float32 and shape \(n, 2\)",
        ),
        (Sequence(Box(0, 1, (2,)), stack=True), np.zeros((3, 3)), r"^note: expected shape \(3, 2\)"),
        (Sequence(Box(0, 1, (0,)), stack=True), np.zeros((3, 3)), r"^note: expected shape \(3, 0\)"),
        (
            Dict(a=Text(3)),
            {"a": "x", "b": "y"},
            r"^note: expected a dict with the keys \['a'\], found \['a', 'b'\]",
        ),
        (Dict(a=Text(3)), {}, r"^note: expected a dict with the keys \['a'\], found \[\]"),
        (Dict(a=Text(3)), ["x"], r"^note: expected a dict"),
        (Dict(a=Tuple((Text(3),))), {"a": (3,)}, r"^note\.a\[0\]: expected a string, found 3"),
        (Tuple((Text(3),)), ["x"], r"^note: expected a tuple of 1, found \['x'\]"),
        (Tuple((Text(3),)), ("x", "y"), r"^note: expected a tuple of 1"),
        (OneOf([Text(3), Discrete(2)]), (1, "x"), r"^note\[1\]: expected int64"),
        (OneOf([Text(3), Discrete(2)]), (2, "x"), r"^note\[0\]: expected an index below 2, found 2"),
        (OneOf([Text(3), Discrete(2)]), (-1, "x"), r"^note\[0\]: expected an index"),
        (OneOf([Text(3), Discrete(2)]), (0.0, "x"), r"^note\[0\]: expected an index"),
        (OneOf([Text(3), Discrete(2)]), "x", r"^note: expected a pair"),
        (Graph(Discrete(3), None), (np.zeros(1), None, None), r"^note: expected a GraphInstance"),
        (
            Graph(Discrete(3), None),
            GraphInstance(None, None, None),
            r"^note\.nodes: expected an array of int64",
        ),
        (
            Graph(Discrete(3), None),
            GraphInstance(np.zeros(1, int), np.zeros(1), None),
            r"^note\.edges: expected None",
        ),
        (
            Graph(Discrete(3), Discrete(2)),
            GraphInstance(np.zeros(1, int), np.zeros(1, int), np.zeros((1, 3), int)),
            r"^note\.edge_links: expected shape \(1, 2\)",
        ),
    ],
    ids=str,
)
def test_what_is_not_stored_exactly_is_refused(space, value, match):
    field = VariableField(space, "note")
    out = bytearray(b"before")
    with pytest.raises(StepError, match=match):
        field.encode(value, out, 0)
    assert out == b"before"


@pytest.mark.parametrize(
    ("space", "match"),
    [
        (
            Sequence(Custom((2,), np.float32)),
            r"^state\[\]: expected a space of Gymnasium itself, found Custom",
        ),
        (
            Dict({"a": Tuple((Text(2), Sequence(Box(0, 1, (2,), np.longdouble))))}),
            r"^state\['a'\]\[1\]\[\]: expected a dtype",
        ),
        (OneOf([Text(2), Custom()]), r"^state\[1\]: expected a space"),
        (Graph(Box(0, 1, (2,), np.dtype(">f4")), None), r"^state\.nodes: expected a dtype"),
    ],
    ids=str,
)
def test_refused_spaces_name_the_leaf(space, match):
    with pytest.raises(SpaceError, match=match):
        VariableField(space, "s", path="state")


@pytest.mark.parametrize("stack", [False, True])
def test_too_deep_spaces_are_refused(stack):
    space: gym.Space[Any] = Text(2)
    for _ in range(70):
        space = Tuple((space,))
    if stack:
        space = Sequence(space, stack=True)
    with pytest.raises(SpaceError, match="nested more than 64 deep"):
        VariableField(space, "note")


@pytest.mark.parametrize("space", FIELDS[::2], ids=space_id)
def test_truncation_anywhere_is_a_format_error(space):
    field = VariableField(space, "note")
    space.seed(1)
    data = encode(field, space.sample())
    for end in range(4, len(data)):
        with pytest.raises(FormatError, match=r"^note: expected"):
            field.decode(memoryview(data)[:end], 4, 4)


@pytest.mark.sampled(10)
@pytest.mark.parametrize("space", FIELDS, ids=space_id)
@settings(max_examples=25)
@given(data=st.data())
def test_flipped_bytes_are_a_value_or_a_format_error(space, data):
    field = VariableField(space, "note")
    space.seed(2)
    good = bytearray(encode(field, space.sample()))
    if len(good) == 4:
        return
    at = data.draw(st.integers(4, len(good) - 1))
    good[at] = data.draw(st.integers(0, 255))
    try:
        value, end = field.decode(memoryview(bytes(good)), 4, 4)
    except FormatError:
        return
    assert end <= len(good)
    out = bytearray(b"\xee" * 4)
    field.encode(value, out, 4)


LENGTH = struct.Struct("<I")


@pytest.mark.parametrize(
    ("space", "data", "match"),
    [
        (Text(3), LENGTH.pack(2**32 - 1), "a string of 4294967295 bytes"),
        (Text(3), LENGTH.pack(2) + b"ab", "a string with one NUL, at its end"),
        (Text(3), LENGTH.pack(3) + b"\0a\0", "a string with one NUL, at its end"),
        (Text(3), LENGTH.pack(2) + b"\xff\0", "UTF-8 at offset 4"),
        (Text(3), LENGTH.pack(4) + b"\x1a00\0", "an escaped character after U\\+001A, found '00'"),
        (Text(3), LENGTH.pack(6) + b"\x1a0041\0", "an escaped character"),
        (Text(3), LENGTH.pack(6) + b"\x1aD800\0", "an escaped character"),
        (Sequence(Discrete(2)), LENGTH.pack(2**32 - 1) + bytes(12), "4294967295 of int64"),
        (Sequence(Box(0, 1, (2,))), LENGTH.pack(3) + bytes(12), "a multiple of 2 elements"),
        (Sequence(Dict({})), LENGTH.pack(2**32 - 1), "4294967295 items"),
        (Sequence(Text(2)), LENGTH.pack(2**31), "2147483648 items"),
        (Sequence(Box(0, 1, (), np.bool_)), LENGTH.pack(1) + b"\2", "booleans of 0 or 1"),
        (OneOf([Text(2)]), LENGTH.pack(1), "an index below 1"),
        (OneOf([Discrete(2), Text(2)]), LENGTH.pack(1) + LENGTH.pack(1), "no elements"),
        (OneOf([Text(2), Discrete(2)]), LENGTH.pack(1) + LENGTH.pack(2) + b"a\0", "no text"),
        (OneOf([Box(0, 1, (2,))]), LENGTH.pack(0) + LENGTH.pack(1), "2 elements before"),
        (Graph(Discrete(2), None), LENGTH.pack(0) + b"\2", "a boolean at offset 4"),
    ],
    ids=str,
)
def test_false_claims_are_format_errors(space, data, match):
    with pytest.raises(FormatError, match=f"^note: expected {match}"):
        VariableField(space, "note").decode(memoryview(data), 0, 0)


def test_an_empty_string_without_nul_is_read():
    assert VariableField(Text(3), "note").decode(memoryview(LENGTH.pack(0)), 0, 0) == ("", 4)


def test_decoded_arrays_are_ones_own():
    field = VariableField(Sequence(Box(0, 1, (2,)), stack=True), "note")
    data = encode(field, np.ones((2, 2), np.float32))
    value = decode(field, data)
    value[0] = 5
    assert same(decode(field, data), np.ones((2, 2), np.float32))


def f8(*shape: int) -> Array:
    return np.full(shape, 0.1)


WIDER = [
    (Sequence(Box(0, 1, (2,))), (f8(2), np.ones(2, np.float32)), {"[]": "float64"}),
    (Sequence(Box(0, 1, (2,)), stack=True), f8(3, 2), {"[]": "float64"}),
    (Sequence(Box(0, 1, (), np.float16)), (0.1, np.float32(0.5)), {"[]": "float64"}),
    (Sequence(Discrete(3, start=1)), (1.0, np.float64(1.5)), {"[]": "float64"}),
    (Sequence(Discrete(3)), (1, True, np.int8(2)), {}),
    (OneOf([Text(2), Box(0, 1, (2,))]), (1, f8(2)), {"[1]": "float64"}),
    (OneOf([Text(2), Box(0, 1, (2,))]), (np.int64(0), "x"), {}),
    (Sequence(Dict(a=Tuple((Box(0, 1, (1,)), Text(2))))), ({"a": (f8(1), "x")},), {"[]['a'][0]": "float64"}),
    (Sequence(Dict(a=Box(0, 1, (1,))), stack=True), {"a": f8(2, 1)}, {"[]['a']": "float64"}),
    (
        Graph(Box(0, 1, (2,)), Box(0, 1, ())),
        GraphInstance(f8(3, 2), f8(1), np.zeros((1, 2), np.int64)),
        {".nodes": "float64", ".edges": "float64", ".edge_links": "int64"},
    ),
]


@pytest.mark.parametrize(("space", "value", "dtypes"), WIDER, ids=str)
@pytest.mark.filterwarnings("ignore:note:UserWarning")
def test_wider_values_than_declared_are_stored_as_they_are(space, value, dtypes):
    assert variable_dtypes(space, [value], "note") == dtypes
    field = VariableField(space, "note", dtypes=dtypes)
    again = decode(field, encode(field, value))
    assert repr(flat(again)) == repr(flat(value)) or not dtypes
    ros_decode(field, value, 1)
    if dtypes:
        with pytest.raises(StepError, match=r"^note.*: expected"):
            encode(VariableField(space, "note"), value)


def test_wider_values_warn_once_a_leaf():
    space = Sequence(Box(0, 1, (2,)))
    with pytest.warns(UserWarning, match=r"^state\['a'\]\[\] is declared float32, but .* float64") as caught:
        variable_dtypes(space, [(f8(2), f8(2)), (f8(2),)], "state['a']")
    assert len(caught) == 1


@pytest.mark.parametrize(
    "value", [None, 3, (3, 4), {"a": 1}, GraphInstance(None, 1, 2), ("x", 1), (5, 1)], ids=str
)
@pytest.mark.parametrize("space", FIELDS[-20:], ids=space_id)
def test_values_of_another_structure_widen_nothing_or_are_refused(space, value):
    try:
        dtypes = variable_dtypes(space, [value], "note")
        field = VariableField(space, "note", dtypes=dtypes)
        data = encode(field, value)
    except StepError:
        return
    assert same(decode(field, data), value) or value == (3, 4)  # as NumPy scalars


@pytest.mark.parametrize("dtypes", [{"[0]": "float64"}, {"[]": "complex64"}, {"": "float64"}], ids=str)
def test_dtypes_of_other_leaves_are_refused(dtypes):
    with pytest.raises(SpaceError, match=r"^note(\[\])?: expected (dtypes of leaves|a dtype)"):
        VariableField(Sequence(Box(0, 1, (2,))), "note", dtypes=dtypes)
