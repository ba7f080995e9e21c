"""Generates the functions that write steps of constant layout into rows.

Their source is generated from validated spaces: the live environment's, or those of a file whose steps are written
anew. It holds keys as `repr` of a `str` or `int`, or bound as objects; names and dtypes have fixed alphabets; there
is a limit of leaves. Readers generate no code. A value of the recorded type is stored directly; any other goes through
an exact cast, which refuses what it cannot store.

A row is a complete MCAP Message record. One `struct` call writes the end of row j (action, reward, flags) and the start
of row j+1 (record header and new observation); another writes sequence and log_time of row j, which commits it.
`put_whole` does not know the observation after a step: it writes zeros as the header of row j+1, and the header of row
j only after its state. Readers of the journal take no state from a row without a header.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from struct import Struct
from types import CodeType
from typing import Any, Protocol

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError, SpaceError, StepError
from tupli_mcap.mcap.records import BODY, HOLE
from tupli_mcap.messages.encode_values import (
    Packed,
    SourceCode,
    access_to,
    add_fields,
    add_structure_checks,
    flag_check,
)
from tupli_mcap.messages.layout import NUMBERS, PREFIX, SEQUENCE_OFFSET
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.exact import check_structure, exact_array, leaf_value, shorten
from tupli_mcap.spaces.leaves import Leaf

COMMIT = Struct("<IQ")
_TIME = Struct("<Q")
_MAX_LEAVES = 4096  # each takes time and memory to compile


class ImageSink(Protocol):
    """Stores images. `check` comes first, so that a refused step writes none of its images."""

    def check(self, value: Any) -> Array:
        """The image as it will be stored; raises StepError if it cannot be stored."""
        ...

    def put(self, image: Array) -> None:
        """Stores the image of the next state, before the step is committed."""
        ...

    def put_first(self, image: Array) -> None:
        """Stores the image of a reset, in place of the running row's."""
        ...

    def advance(self) -> None:
        """Goes on to the next row, whose image is not known yet, after the running row's step was committed."""
        ...


@dataclass
class RowEncoder:
    """Writes rows into a buffer.

    These raise StepError for a value that cannot be stored exactly, and change nothing then:
    `put(action, state, reward, terminal, timeout)` writes and commits a step; `state` is the state after it.
    `put_state(state)` starts a row.
    `put_whole(state, action, reward, terminal, timeout)` does both; the state after the step stays unknown.
    `put_next(episode, state)` turns the running row, which holds the final state, into a hole and starts the row after
    it as the first one of `episode`. The hole's time is the current one, but not before the last step's.

    `offset()` is the running row's offset in the buffer, `count()` the sequence of the next step, `total()` the return
    so far. `skip(rows, total)` goes on behind rows that other code committed, with `total` as the return so far.
    `move(start, last, end)` makes the row at `start` the running one, behind the row at `last`; `switch` is called when
    the row at `end` has been started. `begin(prefix)` begins another episode, whose rows start with `prefix`.
    """

    put: Callable[[Any, Any, Any, Any, Any], None]
    put_state: Callable[[Any], None]
    put_next: Callable[[int, Any], None]
    put_whole: Callable[[Any, Any, Any, Any, Any], None]
    offset: Callable[[], int]
    count: Callable[[], int]
    total: Callable[[], Any]
    skip: Callable[[int, Any], None]
    move: Callable[[int, int, int], None]
    begin: Callable[[bytes], None]
    state_end: int  # bytes of a row up to the end of its state


def make_row_encoder(
    layout: StepLayout,
    buffer: Any,
    channel: int,
    first: int,
    images: Sequence[ImageSink],
    switch: Callable[[], None],
    seal: Callable[..., None] | None,
) -> RowEncoder:
    """Generates the encoder that writes messages of `channel` into `buffer`, from sequence `first` on.

    The caller has to call `move` and `begin` before the first step. The layout is a constant one; there is a sink for
    each image leaf. `switch` is called when the row after the last one of a half has been started; `seal`, if given,
    with the offset of each committed row, and `alone=True` if no state follows it. Raises SpaceError if the layout has
    more than 4,096 leaves.
    """
    if len(layout.leaves) > _MAX_LEAVES:
        raise SpaceError(
            f"expected at most {_MAX_LEAVES:,} leaves in the spaces of a step, found {len(layout.leaves):,}; "
            "join some into arrays"
        )
    text, names = _code(layout, images, is_sealed=seal is not None)
    namespace = dict(
        names,
        buffer=buffer,
        first=first,
        header=layout.step_message.header(channel),
        numbers=NUMBERS.pack,
        unknown=bytes(PREFIX),
        time_at=_TIME.unpack_from,
        switch=switch,
        seal=seal,
        commit=COMMIT.pack_into,
        time_ns=time.time_ns,
        refusals=(RecordingError, MemoryError),  # raised by a flush of images, which is no fault of the step
        diagnose=lambda action, state, reward, err: _diagnose(layout, action, state, reward, err),
    )
    exec(_compiled(text), namespace)
    # a function in its own globals is a cycle, which would keep the buffer until the garbage collector runs
    encoder = namespace.pop("encoder")
    return RowEncoder(**encoder(), state_end=layout.state_end)


@functools.lru_cache(maxsize=8)
def _compiled(text: str) -> CodeType:
    """The compiled source, which all streams of a recording share."""
    return compile(text, "<tupli_mcap row encoder>", "exec")


def _code(layout: StepLayout, images: Sequence[ImageSink], *, is_sealed: bool) -> tuple[str, dict[str, Any]]:
    """The source of the encoder of a layout, and the objects that it names."""
    size, source = layout.step_message.record_size, SourceCode()
    tail = _tail(source, layout)
    state = SourceCode(source.names)
    head = _head(state, layout)
    puts, firsts, advance = [], [], []
    for i, leaf in enumerate(layout.images):
        check = source.bind("check", images[i].check)
        state.lines.append(f"image{i} = {check}({access_to(source, 'state', leaf.keys)})")
        puts.append(f"{source.bind('put_image', images[i].put)}(image{i})")
        firsts.append(f"{source.bind('put_first', images[i].put_first)}(image{i})")
        advance.append(f"{source.bind('advance', images[i].advance)}()")
    flags = [flag_check(source, "terminal"), flag_check(source, "timeout")]
    args = ", ".join([*tail.args, *head.args])
    put = [
        *flags, *source.lines, *state.lines, f"pack(buffer, offset + {tail.start}, {args})", *puts,
    ]  # fmt: skip
    ends = ", ".join([*tail.args[:-1], "unknown"])
    put_whole = [
        *flags, *source.lines, *state.lines, f"pack_end(buffer, offset + {tail.start}, {ends})",
        f"pack_values({', '.join(['buffer', f'offset + {PREFIX}', *head.args])})", *firsts,
        f"buffer[offset:offset + {PREFIX}] = prefix",
    ]  # fmt: skip
    amount = "reward"
    if layout.reward_space is not None:
        amount = "amount"
        line = f"amount = {source.bind('total', layout.reward_total)}(reward)"
        put.append(line)
        put_whole.append(line)
    first_row, next_row = ", ".join(["prefix", *head.args]), ", ".join(["started", *head.args])
    put_state = [*state.lines, f"pack_state(buffer, offset, {first_row})", *firsts]
    put_next = [*state.lines, f"pack_state(buffer, offset + {size}, {next_row})"]
    names = dict(
        source.names,
        pack=Struct(f"<{tail.format}{head.format}").pack_into,
        pack_state=Struct(f"<{PREFIX}s{head.format}").pack_into,
        pack_values=Struct(f"<{head.format}").pack_into,
        pack_end=Struct(f"<{tail.format}").pack_into,
    )
    blocks = {"lines": put, "first_lines": put_state, "next_lines": put_next, "whole_lines": put_whole}
    text = _ENCODER.format(
        **{name: _block(lines) for name, lines in blocks.items()},
        committed="        seal(offset)\n" if is_sealed else "",
        committed_alone="        seal(offset, alone=True)\n" if is_sealed else "",
        advance=_block(advance, 8),
        amount=amount,
        size=size,
        sequence=SEQUENCE_OFFSET,
        log_time=SEQUENCE_OFFSET + 4,
        hole=HOLE,
    )
    return text, names


def _tail(source: SourceCode, layout: StepLayout) -> Packed:
    """The end of a row, behind its state, and the start of the next one up to its state."""
    message = layout.step_message
    after_state = [leaf.name for leaf in (*layout.action, *layout.reward) if leaf.size] + ["terminal"]
    begin = BODY + message.offset(after_state[0])
    packed = Packed(begin, begin)
    add_structure_checks(source, layout.action_space, "action")
    add_fields(source, layout, layout.action, "action", packed)
    add_fields(source, layout, layout.reward, "reward", packed)
    packed.add(BODY + message.offset("terminal"), "?", 1, "terminal")
    packed.add(BODY + message.offset("timeout"), "?", 1, "timeout")
    packed.add(message.record_size, f"{PREFIX}s", PREFIX, "prefix")
    return packed


def _head(source: SourceCode, layout: StepLayout) -> Packed:
    """The state of a row."""
    packed = Packed(PREFIX, PREFIX)
    add_structure_checks(source, layout.observation_space, "state")
    add_fields(source, layout, layout.state, "state", packed)
    return packed


# The state of the encoder is in closure variables, which need no `self`.
_ENCODER = """\
def encoder():
    offset = start = last = end = 0
    sequence, prefix, total = first, b'', 0.0

    def put(action, state, reward, terminal, timeout):
        nonlocal offset, sequence, total
        try:
{lines}\
        except refusals:
            raise
        except Exception as err:
            raise diagnose(action, state, reward, err) from err
        commit(buffer, offset + {sequence}, sequence, time_ns())
{committed}\
        sequence += 1
        total += {amount}
        offset += {size}
        if offset == end:
            switch()

    def put_state(state):
        try:
{first_lines}\
        except Exception as err:
            raise diagnose(None, state, None, err) from err

    def put_next(episode, state):
        nonlocal offset, prefix, total
        started = header + numbers(episode, 0)
        try:
{next_lines}\
        except Exception as err:
            raise diagnose(None, state, None, err) from err
        before, = time_at(buffer, (last if offset == start else offset - {size}) + {log_time})
        now = time_ns()
        commit(buffer, offset + {sequence}, {hole}, now if now > before else before)
        prefix, total = started, 0.0
        offset += {size}
        if offset == end:
            switch()

    def put_whole(state, action, reward, terminal, timeout):
        nonlocal offset, sequence, total
        try:
{whole_lines}\
        except Exception as err:
            raise diagnose(action, state, reward, err) from err
        commit(buffer, offset + {sequence}, sequence, time_ns())
{committed_alone}\
        sequence += 1
        total += {amount}
        offset += {size}
{advance}\
        if offset == end:
            switch()

    def skip(rows, new_total):
        nonlocal offset, sequence, total
        sequence += rows
        total = new_total
        offset += rows * {size}
        if offset == end:
            switch()

    def move(new_start, new_last, new_end):
        nonlocal offset, start, last, end
        offset = start = new_start
        last, end = new_last, new_end

    def begin(new_prefix):
        nonlocal prefix, total
        prefix, total = new_prefix, 0.0

    return dict(
        put=put, put_state=put_state, put_next=put_next, put_whole=put_whole, skip=skip, move=move,
        begin=begin, offset=lambda: offset, count=lambda: sequence, total=lambda: total,
    )
"""


def _block(lines: Sequence[str], indent: int = 12) -> str:
    return "".join(f"{' ' * indent}{line}\n" for line in lines)


def _diagnose(layout: StepLayout, action: Any, state: Any, reward: Any, err: Exception) -> StepError:
    """The StepError that says which value the generated code could not store."""
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
