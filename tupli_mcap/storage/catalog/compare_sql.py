"""Turns one comparison of a filter into SQL: of columns, of the values of declared keys, or of metadata.

A database may compare values differently from Python: numbers in metadata are compared as the nearest floats, texts
that SQL and Python may order differently are not compared. So each comparison becomes two conditions: one for all
rows that may match, and one for those of them that Python has to look at.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from sqlalchemy import Select, and_, case, exists, false, func, not_, or_, select, true, union_all
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.schema import BaseFilter, FilterEQ, FilterType
from tupli_mcap.schema.filters import ORDERING, path_of
from tupli_mcap.schema.predicate import scalar_test
from tupli_mcap.schema.values import OPERATORS, Scalar, classify, small_letters
from tupli_mcap.storage.catalog.metadata_sql import can_search, kind_at, text_at, value_at
from tupli_mcap.storage.catalog.rows import flag_bits, indexed_text, is_whole, nearest_float
from tupli_mcap.storage.catalog.tables import EPISODE, LAST_EPISODE, RECORDING, TALLY, VALUE, first_of
from tupli_mcap.storage.texts import escape_text

Condition = ColumnElement[bool]

_MOST_VALUES: Final = 250  # in a comparison: databases limit them

_PLAIN: Final = re.compile(r"[ !#-.0-\[\]-~]{0,1000}")  # printable ASCII without " \ and /
# SQLite reads a decimal number to within a few units in the last place.
_READ_WITHIN: Final = 1e-12
_SMALLEST: Final = 1e-300
_LARGEST: Final = sys.float_info.max
_LEAST_INTEGER, _MOST_INTEGER = -(2**63), 2**63 - 1

_FLAGS: Final = frozenset((0.0, 1.0))  # as which `VALUE` has flags, too
_LONGEST_PATTERN: Final = 1000  # databases have limits

_EPISODE_NUMBER: Final = re.compile("0|[1-9][0-9]{0,9}")
_TEXTS: Final = {
    "created_by": EPISODE.c.created_by,
    "benchmark_id": RECORDING.c.benchmark_id,
    "recording": RECORDING.c.path,
}
_INTEGERS: Final = {name: EPISODE.c[name] for name in ("created_at", "n_tuples", "env", "episode")}
_NUMBERS: Final = {name: EPISODE.c[name] for name in ("episode_return", "seed")}
_CHOICES: Final[Mapping[str, Mapping[Scalar, Condition]]] = {
    "end": {Scalar("text", end): EPISODE.c.end == end for end in END_NAMES},
    "terminated": {
        Scalar("bool", True): EPISODE.c.end == "terminal",
        Scalar("bool", False): EPISODE.c.end != "terminal",
    },
    "timeout": {
        Scalar("bool", True): EPISODE.c.end == "timeout",
        Scalar("bool", False): EPISODE.c.end != "timeout",
    },
    "success": {
        Scalar("bool", True): and_(EPISODE.c.success.is_not(None), EPISODE.c.success == 1),
        Scalar("bool", False): and_(EPISODE.c.success.is_not(None), EPISODE.c.success == 0),
        Scalar("null", None): EPISODE.c.success.is_(None),
    },
}


class Narrowed(NamedTuple):
    """What SQL can tell of a filter.

    Attributes:
        may: a condition that is true for all rows that match.
        unsure: conditions: where one is true, Python has to look at the row; elsewhere, `may` decides alone. Neither
            these nor `may` are ever NULL, unless one of these is simply true.
        ids: a query of ids of episodes, and of their recordings, that an index finds: all that match are among them.
    """

    may: Condition
    unsure: Sequence[Condition] = ()
    ids: Select[Any] | None = None

    def negated(self) -> Narrowed:
        """The same of the opposite filter."""
        return self._replace(may=or_(not_(self.may), *self.unsure))


ALL: Final = Narrowed(true(), unsure=[true()])


def compared(filter: BaseFilter) -> Narrowed:
    """A comparison by the columns of EPISODE and RECORDING; other values of metadata are looked for in the JSON."""
    name = path_of(filter)[0]
    if name in _CHOICES:
        test = scalar_test(filter)
        chosen = (condition for choice, condition in _CHOICES[name].items() if test(choice))
        return Narrowed(or_(false(), *chosen))
    if name in _TEXTS:
        return _of_texts(filter, _TEXTS[name])
    if name in _INTEGERS:
        return _of_integers(filter, _INTEGERS[name])
    if name == "id":
        return _of_ids(filter)
    if name == "published_in":
        return _of_groups(filter)
    if name in _NUMBERS:
        return _of_numbers(filter, _NUMBERS[name])
    if filter.type is FilterType.NE or name == "run":  # few runs have many episodes
        return ALL
    return ALL._replace(may=_in_metadata(filter))


def _of_texts(filter: BaseFilter, column: ColumnElement[str]) -> Narrowed:
    if filter.type is FilterType.IN:
        return _one_of(column, [escape_text(value) for value in filter.value])
    if filter.type is FilterType.CONTAINS:
        return ALL._replace(may=_occurs(filter.value, column))
    return Narrowed(OPERATORS[filter.type](column, escape_text(filter.value)))


def _occurs(wanted: str, column: ColumnElement[Any]) -> Condition:
    """The condition that a text occurs in a column, as far as SQL can tell; `lower` handles at least A to Z."""
    if not wanted.isprintable() or len(wanted) > _LONGEST_PATTERN:
        return column.is_not(None)
    return func.lower(column).contains(small_letters(wanted), autoescape=True)


def _of_integers(filter: BaseFilter, column: ColumnElement[int]) -> Narrowed:
    """A comparison of 64-bit integers with a number of any size; it may have a fraction only if it is an order."""
    if filter.type is FilterType.IN:
        return _one_of(column, [int(v) for v in filter.value if _LEAST_INTEGER <= v <= _MOST_INTEGER])
    kind, wanted = filter.type, filter.value
    if not _LEAST_INTEGER <= wanted <= _MOST_INTEGER:
        below = wanted < 0
        of_all = kind in ((FilterType.GT, FilterType.GEQ) if below else (FilterType.LT, FilterType.LEQ))
        return Narrowed(true() if of_all or kind is FilterType.NE else false())
    rounded = math.ceil if kind in (FilterType.GEQ, FilterType.LT) else math.floor
    return Narrowed(OPERATORS[kind](column, rounded(wanted)))


def _one_of(column: ColumnElement[Any], values: Sequence[Any]) -> Narrowed:
    return Narrowed(_any_of(column, values), [] if len(values) <= _MOST_VALUES else ALL.unsure)


def recorded(filter: BaseFilter) -> Condition:
    """Recordings of the time that a filter names."""
    parts = []
    if filter.type in (FilterType.GT, FilterType.GEQ, FilterType.EQ):
        parts.append(_of_integers(filter.model_copy(update={"type": FilterType.GEQ}), TALLY.c.last).may)
    if filter.type in (FilterType.LT, FilterType.LEQ, FilterType.EQ):
        parts.append(_of_integers(filter.model_copy(update={"type": FilterType.LEQ}), TALLY.c.first).may)
    return exists().where(TALLY.c.recording_id == RECORDING.c.id, *parts) if parts else true()


def of_runs(filter: BaseFilter) -> Condition:
    """Recordings whose runs, which are JSON, hold a text that is the same in all JSON."""
    texts = _values(filter)
    if len(texts) > _MOST_VALUES or not all(
        isinstance(text, str) and _PLAIN.fullmatch(text) for text in texts
    ):
        return true()
    return or_(false(), *(RECORDING.c.runs.contains(f'"{text}"', autoescape=True) for text in texts))


def _of_numbers(filter: BaseFilter, column: ColumnElement[Any]) -> Narrowed:
    """A comparison with a column that has the nearest floats, and NULL for NaN, too."""
    if filter.type is FilterType.NE:
        return _of_numbers(FilterEQ(key=filter.key, value=filter.value), column).negated()
    numbers, _ = _wanted(filter)
    known = column.is_not(None)
    if filter.type in ORDERING:
        found = _ordered(filter, column, numbers)
    else:
        found = _equal(column, numbers)
    null = [column.is_(None)] if None in _values(filter) else []
    unsure = [and_(known, condition) for condition in found.unsure]
    return Narrowed(or_(and_(known, found.may), *null), [*unsure, *null])


def near_value(filter: BaseFilter) -> list[Condition]:
    """A comparison, other than NE, with what `VALUE` holds, where one of several conditions has to be true: an index
    leads to each of them, but not to all in one OR."""
    number, text = VALUE.c.number, VALUE.c.text
    numbers, texts = _wanted(filter)
    if filter.type in ORDERING:
        return [(_ordered(filter, number, numbers) if numbers else _ordered(filter, text, texts)).may]
    conditions = [_neither()]
    conditions += [_equal(number, numbers).may] if numbers else []
    conditions += [and_(number.is_(None), _equal(text, texts).may)] if texts else []
    return conditions


def flagged(filter: BaseFilter, key: int) -> Condition | None:
    """A comparison with flags alone, by the flags that each row of `VALUE` has; None for any other, or for a key that
    has no place there. It is true of all episodes that match, and where the value is neither a number nor a text,
    maybe of others."""
    wanted = [classify(value) for value in _values(filter)]
    if filter.type in ORDERING or any(scalar.kind != "bool" for scalar in wanted):
        return None
    bits = flag_bits((scalar.value for scalar in wanted), key)
    return VALUE.c.flags.bitwise_and(bits) != 0 if bits else None


def unsure_value(filter: BaseFilter, key: int) -> Sequence[Condition]:
    """Where what `VALUE` holds at a key, and `flagged`, do not tell whether a comparison, other than NE, is true: see
    `Narrowed`."""
    number, text = VALUE.c.number, VALUE.c.text
    numbers, texts = _wanted(filter)
    if filter.type in ORDERING:
        unsure = [*_ordered(filter, number, numbers).unsure, *_ordered(filter, text, texts).unsure]
        unsure += [number.in_(_FLAGS)] if numbers else []
    elif flagged(filter, key) is not None:
        unsure = [_neither()]
    elif not _FLAGS.isdisjoint(numbers):
        return ALL.unsure
    else:
        unsure = [*_equal(number, numbers).unsure, *_equal(text, texts).unsure, _neither()]
    own = VALUE.c.episode_id == EPISODE.c.id, VALUE.c.key == key
    return [exists().where(*own, or_(*unsure)).correlate(EPISODE)] if unsure else []


def _neither() -> Condition:
    """Whether a value is no number, flag or text: null, a list, ..."""
    return and_(VALUE.c.number.is_(None), VALUE.c.text.is_(None))


def _values(filter: BaseFilter) -> Sequence[Any]:
    return filter.value if filter.type is FilterType.IN else [filter.value]


def _wanted(filter: BaseFilter) -> tuple[list[float], list[str]]:
    """The values that are compared, as they are stored: the nearest floats, and the beginnings of texts."""
    wanted = [classify(value) for value in _values(filter)]
    numbers = [nearest_float(scalar.value) for scalar in wanted if scalar.kind in ("number", "bool")]
    return numbers, [indexed_text(scalar.value) for scalar in wanted if scalar.kind == "text"]


def _ordered(filter: BaseFilter, column: ColumnElement[Any], wanted: Sequence[Any]) -> Narrowed:
    """A comparison of order with at most one stored value: of unequal ones, the order tells that of the values."""
    if not wanted:
        return Narrowed(false())
    if is_whole(wanted[0]):
        return Narrowed(OPERATORS[filter.type](column, wanted[0]))
    rising = filter.type in (FilterType.GT, FilterType.GEQ)
    return Narrowed(column >= wanted[0] if rising else column <= wanted[0], [column == wanted[0]])


def _equal(column: ColumnElement[Any], wanted: Sequence[Any]) -> Narrowed:
    """Whether a column has one of some stored values."""
    if len(wanted) > _MOST_VALUES:
        return ALL._replace(may=_any_of(column, wanted))
    parts = [value for value in wanted if not is_whole(value)]
    return Narrowed(_any_of(column, wanted), [column.in_(parts)] if parts else [])


def _in_metadata(filter: BaseFilter) -> Condition:
    """A comparison, other than NE, with a value that SQL finds in metadata."""
    path = path_of(filter)[1:]
    wanted = [classify(value) for value in _values(filter)]
    texts = [scalar.value for scalar in wanted if scalar.kind == "text"]
    ordered_texts = filter.type in ORDERING and texts
    unprintable = not all(map(str.isprintable, texts))
    if ordered_texts or unprintable or not can_search(path) or len(wanted) > _MOST_VALUES:
        return true()
    value = value_at(path)
    parts = [EPISODE.c.metadata.contains('"$', autoescape=True)]  # tags stand for other values
    for scalar in wanted:
        if filter.type is FilterType.CONTAINS:
            parts.append(_occurs(scalar.value, text_at(path)))
        elif scalar.kind in ("text", "bool"):
            parts.append(value == scalar.value)
        elif scalar.kind == "null":
            parts.append(kind_at(path) == "null")
        elif scalar.kind != "nan":
            parts.append(_number_in_metadata(filter.type, value, nearest_float(scalar.value)))
    if filter.type not in ORDERING:
        parts.append(kind_at(path) == "array")  # an element may be equal
    return case((EPISODE.c.readable, or_(*parts)), else_=true())


def _number_in_metadata(kind: FilterType, value: ColumnElement[Any], near: float) -> Condition:
    room = 0.0 if math.isinf(near) else abs(near) * _READ_WITHIN + _SMALLEST
    low, high = (min(max(bound, -_LARGEST), _LARGEST) for bound in (near - room, near + room))
    parts: list[Condition] = [value.is_not(None)]
    if kind not in (FilterType.LT, FilterType.LEQ) and near > -math.inf:
        parts.append(value >= low)
    if kind not in (FilterType.GT, FilterType.GEQ) and near < math.inf:
        parts.append(value <= high)
    return and_(*parts)


def _of_groups(filter: BaseFilter) -> Narrowed:
    """A comparison with groups; the column has a list of them in JSON."""
    groups = _values(filter)
    if filter.type not in (FilterType.EQ, FilterType.IN) or len(groups) > _MOST_VALUES:
        return ALL
    texts = [json.dumps(group) for group in groups]
    if any(len(text) > _LONGEST_PATTERN for text in texts):
        return ALL
    held = (EPISODE.c.published_in.contains(text, autoescape=True) for text in texts)
    return ALL._replace(may=or_(false(), *held))


def _of_ids(filter: BaseFilter) -> Narrowed:
    """A comparison with ids of episodes: their recording's uuid, a hyphen and their number."""
    if filter.type not in (FilterType.EQ, FilterType.NE, FilterType.IN):
        return ALL
    texts = _values(filter)
    parts = [text.rpartition("-") for text in texts]
    ids = [
        (escape_text(uuid), int(number))
        for uuid, _, number in parts
        if _EPISODE_NUMBER.fullmatch(number) and int(number) <= LAST_EPISODE  # beyond are others' rows
    ]
    if len(ids) > _MOST_VALUES:
        return ALL._replace(may=_any_of(RECORDING.c.uuid, [uuid for uuid, _ in ids]))
    if not ids:
        return Narrowed(false() if filter.type is not FilterType.NE else true())
    named = RECORDING.alias("named")
    first = first_of(named.c.id)
    rows = union_all(*(select(first + number).where(named.c.uuid == uuid) for uuid, number in ids))
    found = EPISODE.c.id.in_(rows)
    return Narrowed(not_(found) if filter.type is FilterType.NE else found)


def _any_of(column: ColumnElement[Any], values: Sequence[Any]) -> Condition:
    """The condition that a column holds one of the values; for many values, anything between them."""
    if len(values) <= _MOST_VALUES:
        return column.in_(values) if values else false()
    # PostgreSQL takes no `COLLATE`, which texts have, within a `BETWEEN`.
    return and_(column >= min(values), column <= max(values))
