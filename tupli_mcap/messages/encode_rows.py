"""Generated encoders: one Python function per recording that writes a step into a row of constant layout.

The source is generated from validated spaces: the live environment's, or those of a file whose episodes are written
anew. Keys come into it as `repr` of a `str` or `int` or are bound as objects, names and dtypes are of fixed alphabets,
and leaves are counted before anything is compiled. Readers generate nothing. The source takes the fast way when a value
has the recorded type, and otherwise calls an exact (slow) cast that refuses what it cannot store.

A row is a complete MCAP Message record. One `struct` call writes the end of row j (action, reward, flags) and the start
of row j+1 (record header and the new observation); one more writes sequence and log_time of row j, which commits it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from struct import Struct
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import DType
from tupli_mcap.errors import RecordingError, SpaceError, StepError
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.exact import check_structure, exact_array, exact_flag, leaf_value, shorten
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["COMMIT", "EPISODE_AND_STEP", "HOLE", "SEQUENCE_OFFSET", "RowEncoder", "make_row_encoder"]

SEQUENCE_OFFSET = 11  # of `sequence` in a Message record; log_time follows it
COMMIT = Struct("<IQ")
EPISODE_AND_STEP = Struct("<II")
_TIME = Struct("<Q")
HOLE = 0xFFFFFFFF  # the `sequence` of a row without a message
PREFIX = BODY + 8  # record header, CDR header, episode, step: the same for a whole episode
_MAX_LEAVES = 4096  # compiling takes time and memory for each
_BOOLS = b"\0\1"
_LARGE = 2048  # bytes from which a leaf is copied as an array instead of through `bytes`
_INT_FORMATS = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
}  # fmt: skip


class ImageSink(Protocol):
    """Takes images: `check` first, so that a refused step writes none of its images."""

    def check(self, value: Any) -> np.ndarray[Any, Any]:
        """The image as it will be stored; StepError if it cannot be."""
        ...

    def put(self, image: np.ndarray[Any, Any]) -> None:
        """The image of the next state; called before the step is committed."""
        ...

    def put_first(self, image: np.ndarray[Any, Any]) -> None:
        """The image of a reset: replaces the running row's."""
        ...


@dataclass
class RowEncoder:
    """Writes rows into a buffer, and knows where the next one goes.

    `put(action, state, reward, terminal, timeout)` writes and commits a step; `put_state(state)` starts a row.
    `put_plain` is `put` for episodes whose return nobody asks for while they run: `total` leaves it out.
    `put_next(episode, state)` leaves the running row, which holds the final state, as a hole, and starts the row after
    it, the first one of `episode`; the hole's time is now, but not before the last step's. All of them raise StepError
    for what cannot be stored exactly, and nothing has changed then.

    `offset()` is where the running row is in the buffer, `count()` the sequence of the next step, `total()` the return
    so far. `move(start, last, end)` makes the row at `start` the running one, behind the row at `last`; when the one at
    `end` has been started, `switch` is called. `begin(prefix, total)`: what the rows to come hold before their state,
    and the return before them.
    """

    put: Callable[[Any, Any, Any, Any, Any], None]
    put_plain: Callable[[Any, Any, Any, Any, Any], None]
    put_state: Callable[[Any], None]
    put_next: Callable[[int, Any], None]
    offset: Callable[[], int]
    count: Callable[[], int]
    total: Callable[[], Any]
    move: Callable[[int, int, int], None]
    begin: Callable[[bytes, Any], None]
    state_end: int  # bytes of a row up to the end of its state
    source: str


@dataclass
class _Source:
    """The generated body and the objects it names."""

    names: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)

    def bind(self, prefix: str, value: Any) -> str:
        name = f"{prefix}{len(self.names)}"
        self.names[name] = value
        return name


@dataclass
class _Packed:
    """Format pieces and argument expressions of one `struct` call, at growing offsets."""

    start: int
    offset: int
    format: str = "<"
    args: list[str] = field(default_factory=list)

    def add(self, offset: int, code: str, size: int, arg: str) -> None:
        if offset > self.offset:
            self.format += f"{offset - self.offset}x"
        self.format += code
        self.args.append(arg)
        self.offset = offset + size


def _check_leaves(layout: StepLayout) -> None:
    if len(layout.leaves) > _MAX_LEAVES:
        raise SpaceError(
            f"expected at most {_MAX_LEAVES:,} leaves in the spaces of a step, found {len(layout.leaves):,}; "
            "join some into arrays"
        )


def make_row_encoder(
    layout: StepLayout,
    buffer: Any,
    channel: int,
    first: int,
    images: Sequence[ImageSink],
    switch: Callable[[], None],
    seal: Callable[[int], None] | None = None,
) -> RowEncoder:
    """Generates the encoder of a constant layout for the messages of `channel`, from sequence `first`, into `buffer`.

    `images` has a sink for each image leaf; `switch` is called when the row after the last one has been started;
    `seal`, if given, with the offset of each committed row. `move` and `begin` come before the first step.

    Raises:
        SpaceError: the layout has more than 4,096 leaves.
    """
    _check_leaves(layout)
    message = layout.step_message
    size = message.record_size
    source = _Source()
    after_state = [leaf.name for leaf in (*layout.action, *layout.reward) if leaf.size] + ["terminal"]
    begin = BODY + message.offset(after_state[0])
    tail = _Packed(begin, begin)
    stores: list[str] = []
    _structure_checks(source, layout.action_space, "action")
    _fields(source, layout, layout.action, "action", tail, stores)
    _fields(source, layout, layout.reward, "reward", tail, stores)
    tail.add(BODY + message.offset("terminal"), "?", 1, "terminal")
    tail.add(BODY + message.offset("timeout"), "?", 1, "timeout")
    tail.add(size, f"{PREFIX}s", PREFIX, "prefix")
    state = _Source(source.names)
    head = _Packed(0, 0)
    head.add(0, f"{PREFIX}s", PREFIX, "prefix")
    _structure_checks(state, layout.observation_space, "state")
    state_stores: list[str] = []
    _fields(state, layout, layout.state, "state", head, state_stores)
    next_state = [line.replace("offset +", f"offset + {size} +") for line in state_stores]
    shifted = _shift(head, size, tail)
    puts, firsts = [], []
    for i, leaf in enumerate(layout.images):
        check = source.bind("check", images[i].check)
        state.lines.append(f"image{i} = {check}({_access(source, 'state', leaf.keys)})")
        puts.append(f"{source.bind('put_image', images[i].put)}(image{i})")
        firsts.append(f"{source.bind('put_first', images[i].put_first)}(image{i})")
    flags = [_flag(source, "terminal"), _flag(source, "timeout")]
    put_lines = [
        *flags,
        *source.lines,
        *state.lines,
        f"pack(buffer, offset + {shifted.start}, {', '.join(shifted.args)})",
        *stores,
        *next_state,
        *puts,
    ]
    first_lines = [
        *state.lines,
        f"pack_state(buffer, offset, {', '.join(head.args)})",
        *state_stores,
        *firsts,
    ]
    next_lines = [
        *state.lines,
        f"pack_state(buffer, offset + {size}, {', '.join(['started', *head.args[1:]])})",
        *next_state,
    ]
    amount = "reward"
    if layout.reward_space is not None:
        put_lines.append(f"amount = {source.bind('total', layout.reward_total)}(reward)")
        amount = "amount"
    text = _render(
        put_lines, first_lines, next_lines, size, amount, "" if seal is None else "        seal(offset)\n"
    )
    namespace = dict(
        source.names,
        buffer=buffer,
        first=first,
        header=message.header(channel),
        numbers=EPISODE_AND_STEP.pack,
        time_at=_TIME.unpack_from,
        switch=switch,
        seal=seal,
        pack=Struct(shifted.format).pack_into,
        pack_state=Struct(head.format).pack_into,
        commit=COMMIT.pack_into,
        time_ns=time.time_ns,
        refusals=(RecordingError, MemoryError),  # of the chunk of images that the step has filled
        diagnose=lambda action, state, reward, err: _diagnose(layout, action, state, reward, err),
        view=np.frombuffer(buffer, np.uint8),
    )
    exec(compile(text, "<tupli_mcap row encoder>", "exec"), namespace)
    encoder = namespace.pop(
        "encoder"
    )  # a name in its own globals would keep the buffer until garbage is collected
    return RowEncoder(**encoder(), state_end=layout.state_end, source=text)


def _shift(head: _Packed, size: int, tail: _Packed) -> _Packed:
    """`tail`, followed by the state of the next row (the prefix itself is already in `tail`)."""
    joined = _Packed(tail.start, tail.offset, tail.format, list(tail.args))
    joined.format += head.format[1:].removeprefix(f"{PREFIX}s")
    joined.args += head.args[1:]
    joined.offset = size + head.offset
    return joined


def _render(
    put_lines: Sequence[str],
    first_lines: Sequence[str],
    next_lines: Sequence[str],
    size: int,
    amount: str,
    committed: str,
) -> str:
    """The source. What changes from row to row is in cells of a closure: attributes take twice the bytecode."""

    def block(lines: Sequence[str]) -> str:
        return "".join(f"            {line}\n" for line in lines)

    def put(name: str, counted: str) -> str:
        return (
            f"    def {name}(action, state, reward, terminal, timeout):\n"
            f"        nonlocal offset, sequence{', total' if counted else ''}\n"
            "        try:\n" + block(put_lines) + "        except refusals:\n"
            "            raise\n"
            "        except Exception as err:\n"
            "            raise diagnose(action, state, reward, err) from err\n"
            f"        commit(buffer, offset + {SEQUENCE_OFFSET}, sequence, time_ns())\n"
            f"{committed}"
            "        sequence += 1\n"
            f"{counted}"
            f"        offset += {size}\n"
            "        if offset == end:\n"
            "            switch()\n\n"
        )

    return (
        "def encoder():\n"
        "    offset = start = last = end = 0\n"
        "    sequence, prefix, total = first, b'', 0.0\n\n"
        + put("put", f"        total += {amount}\n")
        + put("put_plain", "")
        + "    def put_state(state):\n"
        "        try:\n" + block(first_lines) + "        except Exception as err:\n"
        "            raise diagnose(None, state, None, err) from err\n\n"
        "    def put_next(episode, state):\n"
        "        nonlocal offset, prefix, total\n"
        "        started = header + numbers(episode, 0)\n"
        "        try:\n" + block(next_lines) + "        except Exception as err:\n"
        "            raise diagnose(None, state, None, err) from err\n"
        f"        before, = time_at(buffer, (last if offset == start else offset - {size}) + {SEQUENCE_OFFSET + 4})\n"
        "        now = time_ns()\n"
        f"        commit(buffer, offset + {SEQUENCE_OFFSET}, {HOLE}, now if now > before else before)\n"
        "        prefix, total = started, 0.0\n"
        f"        offset += {size}\n"
        "        if offset == end:\n"
        "            switch()\n\n"
        "    def move(new_start, new_last, new_end):\n"
        "        nonlocal offset, start, last, end\n"
        "        offset = start = new_start\n"
        "        last, end = new_last, new_end\n\n"
        "    def begin(new_prefix, new_total):\n"
        "        nonlocal prefix, total\n"
        "        prefix, total = new_prefix, new_total\n\n"
        "    return dict(\n"
        "        put=put, put_plain=put_plain, put_state=put_state, put_next=put_next, move=move, begin=begin,\n"
        "        offset=lambda: offset, count=lambda: sequence, total=lambda: total,\n"
        "    )\n"
    )


def _structure_checks(source: _Source, space: Any, expression: str) -> None:
    if type(space) not in (spaces.Dict, spaces.Tuple):
        return
    n = len(space.spaces)
    if type(space) is spaces.Tuple:
        source.lines.append(
            f"if not isinstance({expression}, tuple) or len({expression}) != {n}: raise TypeError"
        )
        children = list(enumerate(space.spaces))
    else:
        source.lines.append(f"if len({expression}) != {n}: raise TypeError")
        children = list(space.spaces.items())
    for key, sub in children:
        if type(sub) in (spaces.Dict, spaces.Tuple):
            _structure_checks(source, sub, _access(source, expression, (key,)))


def _access(source: _Source, root: str, keys: Sequence[Any]) -> str:
    parts = [repr(key) if type(key) in (str, int) else source.bind("key", key) for key in keys]
    return root + "".join(f"[{part}]" for part in parts)


def _fields(
    source: _Source, layout: StepLayout, leaves: Sequence[Leaf], root: str, packed: _Packed, stores: list[str]
) -> None:
    for i, leaf in enumerate(leaves):
        if leaf.apart:
            continue
        dtype = layout.dtypes[leaf.name]
        access = _access(source, root, leaf.keys)
        if leaf.size == 0:
            check = source.bind("check", _exact_bytes(leaf, dtype))
            source.lines.append(f"{check}({access})")
            continue
        offset = BODY + layout.step_message.offset(leaf.name)
        value = f"{root[0]}{i}" if leaf.keys else root
        if leaf.keys:
            source.lines.append(f"{value} = {access}")
        _leaf(source, leaf, dtype, value, offset, packed, stores)


def _leaf(
    source: _Source, leaf: Leaf, dtype: DType, value: str, offset: int, packed: _Packed, stores: list[str]
) -> None:
    nbytes = leaf.size * dtype.itemsize
    if leaf.kind == "scalar" and dtype.kind in "iu":
        exact = source.bind("exact", _exact_int(leaf, dtype))
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
        raw = f"{value}b"
        large, is_bool = nbytes >= _LARGE, dtype.kind == "b"
        exact = source.bind("exact", _exact_plain(leaf, dtype) if large else _exact_bytes(leaf, dtype))
        fast = value if large else f"{value}.tobytes()"
        # of exactly this class: a subclass may mean something else by its bytes, as a masked array does
        plain = f"{value}.__class__ is {source.bind('array', np.ndarray)}"
        if leaf.shape == ():
            plain = f"({plain} or {value}.__class__ is {source.bind('scalar', dtype.type)})"
        # a vector's length is told by its bytes, which spares it making a tuple
        vector = len(leaf.shape) == 1 and not large
        shaped = f"{value}.ndim == 1" if vector else f"{value}.shape == {shape}"
        source.lines.append(
            f"{raw} = {fast} if {plain} and {value}.dtype is {kind} and {shaped} else {exact}({value})"
            if not (large and is_bool)
            else f"{raw} = {exact}({value})"
        )
        if vector:
            source.lines.append(f"if len({raw}) != {nbytes}: {raw} = {exact}({value})")
        if is_bool and not large:  # made by a view, perhaps
            source.lines.append(f"if {raw}.translate(None, {_BOOLS!r}): {raw} = {exact}({value})")
        if large:
            stores.append(
                f"view[offset + {offset}:offset + {offset + nbytes}].view({kind}).reshape({shape})[...] = {raw}"
            )
        else:
            packed.add(offset, f"{nbytes}s", nbytes, raw)


def _flag(source: _Source, name: str) -> str:
    exact, kind = source.bind("exact", exact_flag), source.bind("kind", np.bool_)
    return (
        f"if {name} is not False and {name} is not True and {name}.__class__ is not {kind}: "
        f"{name} = {exact}({name}, {name!r})"
    )


def _exact_int(leaf: Leaf, dtype: DType) -> Callable[[Any], int]:
    return lambda value: int(exact_array(value, dtype, leaf.shape, leaf.path))


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


def _exact_plain(leaf: Leaf, dtype: DType) -> Callable[[Any], np.ndarray[Any, Any]]:
    return lambda value: exact_array(value, dtype, leaf.shape, leaf.path)


def _diagnose(layout: StepLayout, action: Any, state: Any, reward: Any, err: Exception) -> StepError:
    """The StepError that names what the fast path stumbled over."""
    if isinstance(err, StepError):
        return err
    groups: list[tuple[str, Any, Any, Sequence[Leaf]]] = [
        ("state", layout.observation_space, state, layout.state)
    ]
    if reward is not None:
        groups.insert(0, ("action", layout.action_space, action, layout.action))
        groups.append(("reward", None, reward, layout.reward))
    try:
        for name, space, root, leaves in groups:
            if space is not None:
                check_structure(space, root, name)
            for leaf in leaves:
                exact_array(leaf_value(root, leaf), layout.dtypes[leaf.name], leaf.shape, leaf.path)
    except StepError as found:
        return found
    if reward is None:
        return StepError(
            f"state: expected a value structured as {layout.observation_space}, found {shorten(state)}"
        )
    return StepError(
        f"expected a step structured as state {layout.observation_space} and action {layout.action_space}, "
        f"found state {shorten(state)} and action {shorten(action)}"
    )
