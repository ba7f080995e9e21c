"""Every Gymnasium space as JSON and back, to the bit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, strategies as st
from sample_spaces import COMPOSITE_SPACES, FUNDAMENTAL_SPACES, SPACES, space_id

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, SpaceError
from tupli_mcap.spaces.leaves import MAX_DEPTH
from tupli_mcap.spaces.space_json import space_from_json, space_to_json

# Those of Gymnasium 1.0 sample in the order in which a set happens to be.
TEXTS_ARE_ORDERED = list(spaces.Text(1).character_list) == sorted(spaces.Text(1).character_set)
DTYPES = ["float16", "float32", "float64"] + [f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)]


def through_text(space: gym.Space[Any]) -> gym.Space[Any]:
    return space_from_json(json.loads(json.dumps(space_to_json(space), allow_nan=False)))


def assert_same_box(one: spaces.Box, other: spaces.Box) -> None:
    for name in ("low", "high", "bounded_below", "bounded_above"):
        left, right = getattr(one, name), getattr(other, name)
        assert (left.dtype, left.shape, left.tobytes()) == (right.dtype, right.shape, right.tobytes()), name


@pytest.mark.parametrize("space", SPACES, ids=space_id)
def test_round_trip(space):
    again = through_text(space)
    assert again == space
    assert type(again) is type(space)
    assert repr(again) == repr(space)
    if "Text" in repr(space) and not TEXTS_ARE_ORDERED:
        return
    space.seed(7)
    again.seed(7)
    assert repr(again.sample()) == repr(space.sample())


@pytest.mark.parametrize("text", ["Text(3)", "Text(3, charset=set('abcdefghij'))"])
def test_a_space_is_described_alike_in_every_process(text):
    code = f"""if True:
        from gymnasium.spaces import Text
        from tupli_mcap.spaces.space_json import space_to_json
        print(space_to_json({text}))"""
    command = [sys.executable, "-c", code]
    seen = [
        subprocess.run(command, env=os.environ | {"PYTHONHASHSEED": seed}, stdout=subprocess.PIPE, check=True)
        for seed in ("1", "2")
    ]
    assert seen[0].stdout == seen[1].stdout
    assert b"characters" in seen[0].stdout


@pytest.mark.parametrize("space", SPACES, ids=space_id)
def test_round_trip_through_tagged_json(space):
    assert space_from_json(jsonvalue.loads(jsonvalue.dumps(space_to_json(space)))) == space


@pytest.mark.parametrize("name", DTYPES)
def test_extreme_bounds_survive_to_the_bit(name):
    dtype = np.dtype(name)
    info = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
    low = np.array([[info.min, 0], [info.min, 1]], dtype)
    high = np.array([[info.max, 0], [info.max, info.max]], dtype)
    space = spaces.Box(low, high, dtype=dtype.type)
    assert_same_box(through_text(space), space)


@pytest.mark.parametrize(("low", "high"), [(-np.inf, np.inf), (-np.inf, 3), (0, np.inf)])
@pytest.mark.parametrize("name", ["float16", "float64", "int8", "int64"])
def test_unbounded_integers_stay_unbounded(name, low, high):
    space = spaces.Box(low, high, (2, 3), np.dtype(name).type)
    again = through_text(space)
    assert_same_box(again, space)
    assert not np.all(again.bounded_below & again.bounded_above)


def test_negative_zero_and_subnormals_survive():
    low = np.array([-0.0, 0.0, -5e-324])
    space = spaces.Box(low, np.array([0.0, -0.0, 5e-324]), dtype=np.float64)
    assert_same_box(through_text(space), space)


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=6))
def test_any_float_bounds(values):
    high = np.array(values, np.float32)
    space = spaces.Box(np.full(high.shape, -np.inf, np.float32), high, dtype=np.float32)
    assert_same_box(through_text(space), space)


def test_uniform_bounds_are_stored_once():
    space = spaces.Box(0, 255, (480, 640, 3), np.uint8)
    assert len(json.dumps(space_to_json(space))) < 200


def test_dict_keeps_order_and_keys_of_any_type():
    keys: list[Any] = [
        "b",
        "a",
        3,
        (1, "x"),
        None,
        b"\x00",
        2.5,
        frozenset({1}),
        np.int64(9),
        "$float",
        "\ud800",
    ]
    space = spaces.Dict([(key, spaces.Discrete(2 + i)) for i, key in enumerate(keys)])
    again = through_text(space)
    assert list(again.spaces) == keys
    assert [type(key) for key in again.spaces] == [type(key) for key in keys]


def test_text_characters_keep_their_order_and_surrogates():
    space = spaces.Text(3, charset="ba\ud83d\ude00\x00é")
    assert through_text(space).character_list == space.character_list


class Custom(gym.Space[Any]):
    pass


class MyBox(spaces.Box):
    pass


@pytest.mark.parametrize(
    "leaf",
    [
        Custom((2,), np.float32),
        MyBox(0, 1, (2,)),
        spaces.Box(0, 1, (2,), np.longdouble),
        spaces.Box(0, 1, (2,), np.dtype(">f4")),
    ],
    ids=lambda leaf: type(leaf).__name__ + str(leaf.dtype),
)
def test_refused_leaves_are_named(leaf):
    space = spaces.Dict({"a": spaces.Tuple([spaces.Discrete(2), spaces.Sequence(leaf)])})
    with pytest.raises(SpaceError, match=r"^space\['a'\]\[1\]\[\]: expected a (space|dtype) of"):
        space_to_json(space)


def test_refused_keys_and_depth_are_named():
    with pytest.raises(SpaceError, match=r"^space: expected keys with a JSON form"):
        space_to_json(spaces.Dict([(object(), spaces.Discrete(2))]))
    space: gym.Space[Any] = spaces.Discrete(2)
    for _ in range(MAX_DEPTH + 1):
        space = spaces.Tuple([space])
    with pytest.raises(SpaceError, match=f"expected at most {MAX_DEPTH} nested spaces"):
        space_to_json(space)


BAD: list[tuple[str, Any, str]] = [
    ("no object", [], "expected the object of a space"),
    ("unknown type", {"type": "Bax"}, "expected the type of a space, found 'Bax'"),
    ("type of a type", {"type": ["Box"]}, "expected the type of a space"),
    ("no fields", {"type": "Box"}, "expected a field 'dtype'"),
    ("foreign dtype", {"type": "Discrete", "dtype": "object", "n": 2, "start": 0}, "the name of a dtype"),
    (
        "float of integers",
        {"type": "Discrete", "dtype": "int8", "n": 2.0, "start": 0},
        "expected an integer in 'n'",
    ),
    (
        "n of a small dtype",
        {"type": "Discrete", "dtype": "int8", "n": 300, "start": 0},
        "Gymnasium, which refuses",
    ),
    ("nothing to choose", {"type": "OneOf", "spaces": []}, "Gymnasium, which refuses"),
    (
        "same key",
        {"type": "Dict", "spaces": [["a", {"type": "MultiBinary", "shape": [2], "flat": True}]] * 2},
        "keys",
    ),
    ("no pair", {"type": "Dict", "spaces": [["a"]]}, "pairs of a key and a space"),
    ("no key", {"type": "Dict", "spaces": [[1, {}]]}, "expected a key"),
    (
        "key that runs",
        {"type": "Dict", "spaces": [[{"key": '{"$list": []}'}, {}]]},
        "^space: a key: .*one known tag",
    ),
    ("negative length", {"type": "MultiBinary", "shape": [-1], "flat": False}, "lengths"),
    (
        "text of numbers",
        {"type": "Text", "min_length": 1, "max_length": 2, "characters": 3},
        "different characters",
    ),
    (
        "bad code point",
        {"type": "Text", "min_length": 1, "max_length": 2, "characters": [-1]},
        "which refuses",
    ),
]


@pytest.mark.parametrize(
    ("obj", "match"), [(obj, match) for _, obj, match in BAD], ids=[name for name, _, _ in BAD]
)
def test_defects_are_format_errors(obj, match):
    with pytest.raises(FormatError, match=match):
        space_from_json(obj)


def box(**fields: Any) -> dict[str, Any]:
    return {"type": "Box", "dtype": "float32", "shape": [2], "low": 0.0, "high": 1.0} | fields


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"shape": [10**6, 10**6]}, "at most .* elements in all"),
        ({"shape": [0, 10**30]}, "lengths"),
        ({"low": [0.0]}, "expected 2 numbers in 'low', found 1"),
        ({"low": "nan"}, "expected a number of float32 in 'low'"),
        ({"low": 0.1}, "expected a number of float32"),
        ({"low": 2.0}, "which refuses this one"),
        ({"dtype": "int8", "low": 0, "high": 128}, "expected a number of int8"),
        ({"dtype": "bool", "low": 0, "high": 1}, "expected a number of bool"),
        ({"dtype": "float16", "high": 1e30}, "expected a number of float16"),
    ],
)
def test_boxes_with_false_claims(fields, match):
    with pytest.raises(FormatError, match=match):
        space_from_json(box(**fields))


def test_copies_gymnasium_would_make_are_counted():
    obj: dict[str, Any] = {"type": "Discrete", "dtype": "int64", "n": 2, "start": 0}
    for _ in range(40):
        obj = {"type": "Sequence", "stack": True, "space": obj}
    with pytest.raises(FormatError, match="counting the copies Gymnasium makes"):
        space_from_json(obj)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("space", [*FUNDAMENTAL_SPACES[::3], *COMPOSITE_SPACES], ids=space_id)
@given(data=st.data())
def test_a_damaged_object_is_a_space_or_a_format_error(space, data):
    text = json.dumps(space_to_json(space))
    at = data.draw(st.integers(0, len(text) - 1))
    damaged = text[:at] + data.draw(st.sampled_from('0123456789-"[]{},:.eanullI')) + text[at + 1 :]
    try:
        obj = jsonvalue.loads(damaged)
        again = space_from_json(obj)
    except FormatError:
        return
    assert isinstance(again, gym.Space)
