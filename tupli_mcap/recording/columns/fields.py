"""The names of the columns of steps, Gymnasium's names for them, and columns that are found by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from tupli_mcap.errors import RecordingError, SaysWhatIsMeant, did_you_mean

FIVE = ("states", "actions", "rewards", "terminals", "timeouts")
FIELDS = (*FIVE, "next_states", "times", "infos", "frames")
_MOST_KEYS = 20  # keys of infos that are shown
OTHER_NAMES = MappingProxyType(
    {
        "observations": "states",
        "next_observations": "next_states",
        "terminations": "terminals",
        "truncations": "timeouts",
    }
)
OTHER_STEP_NAMES = MappingProxyType(
    {
        "observation": "states",
        "next_observation": "next_states",
        "terminated": "terminals",
        "truncated": "timeouts",
    }
)
"""Gymnasium's names for the values of one step -> column."""


def step_name(field: str) -> str:
    """What the value of a field in one step is called: `state` for `states`."""
    return field.removesuffix("s")


FIELD_OF = MappingProxyType(
    {
        **{step_name(field): field for field in FIELDS},
        **{field: field for field in FIELDS},
        **OTHER_NAMES,
        **OTHER_STEP_NAMES,
    }
)
"""Every name of a column, or of its value in one step -> column."""
_VALUE_OF = MappingProxyType({"states": "state", "next_states": "state", "actions": "action"})
"""Column -> the value, of which a part may be wanted. States and next states are of one space, and have the same parts.
"""


def split_name(name: str) -> tuple[str, str]:
    """The field of a name, and the part of it that the name goes on with: `state.arm[0]` as `state` and `.arm[0]`."""
    word, *part = re.split(r"(?=[.\[])", name, maxsplit=1)
    return word, "".join(part)


def field_names(
    fields: str | Sequence[str], known: Sequence[str] = FIELDS, error: type[Exception] = RecordingError
) -> list[str]:
    """The columns of fields, each once; a field may have any name in `FIELD_OF`. Raises `error` for an unknown name; of
    a part of a field (`state.arm`), the message says how to get it."""
    try:
        given = [fields] if isinstance(fields, str) else list(fields)
        names = [FIELD_OF.get(name, name) for name in given]
    except TypeError as err:
        raise error(f"expected fields from {', '.join(known)}, found {fields!r:.80}") from err
    for written, name in zip(given, names, strict=True):
        if name not in known:
            word, part = split_name(str(name))
            whole = FIELD_OF.get(word)
            hint = _how_to_get(part, whole) if part and whole in known else did_you_mean(word, known)
            raise error(f"expected fields from {', '.join(known)}, found {written!r:.80}{hint}")
    return list(dict.fromkeys(names))


def fields_and_parts(
    fields: str | Sequence[str], known: Sequence[str] = FIELDS, error: type[Exception] = RecordingError
) -> tuple[list[str], list[str]]:
    """The columns of fields, as `field_names`, and the parts that are wanted of the state and of the action, such as
    "state.arm" for the field "observations.arm". All is wanted of that of which no part is named. Raises `error` for
    other parts of the next state than of the state."""
    given = [fields] if isinstance(fields, str) or not isinstance(fields, Sequence) else list(fields)
    names: list[Any] = []
    parts: dict[str, list[str]] = {}  # of each column; none for all of it
    for name in given:
        word, part = split_name(name) if isinstance(name, str) else (name, "")
        field = FIELD_OF.get(word, "") if isinstance(word, str) else ""
        if field in _VALUE_OF and field in known:
            own = parts.setdefault(field, [])
            own.append(f"{_VALUE_OF[field]}{part}")
            name = field
        names.append(name)
    wanted = {
        field: [] if _VALUE_OF[field] in own else list(dict.fromkeys(own)) for field, own in parts.items()
    }
    state, after = wanted.get("states", []), wanted.get("next_states", [])
    if len({"states", "next_states"} & wanted.keys()) == 2 and sorted(state) != sorted(after):
        raise error(
            f"expected the same parts of states and of next_states, found {', '.join(state) or 'all'} "
            f"and {', '.join(after) or 'all'}; name the same ones"
        )
    return field_names(names, known, error), list(dict.fromkeys([*state, *after, *wanted.get("actions", [])]))


def named_parts(field: str, parts: Sequence[str]) -> list[str]:
    """The names of a field that has only some parts, as from `fields_and_parts`: its own, if it has all."""
    value = _VALUE_OF.get(field, field)
    own = [part for part in parts if split_name(part)[0] == value]
    return [f"{step_name(field)}{part.removeprefix(value)}" for part in own] or [field]


def _how_to_get(part: str, field: str | None) -> str:
    if field == "infos":
        return "; read 'infos', which has a dict for each step"
    keys = "" if {"[", '"'} & set(part) else "".join(f"[{key!r}]" for key in part[1:].split("."))
    return f"; read {field!r}, and take {keys or 'that part'} of it"


def described(column: Any) -> str:
    """A column in short: dtype and shape, or the number of values; for dicts, their keys; a single value itself."""
    if isinstance(column, np.generic | str) or not hasattr(column, "__len__"):
        return f"{column!s:.40}"
    if isinstance(column, np.ndarray):
        return f"{column.dtype} {column.shape}"
    if isinstance(column, dict):
        return "{" + ", ".join(f"{key!r}: {described(value)}" for key, value in column.items()) + "}"
    if isinstance(column, tuple):
        return f"({', '.join(map(described, column))})"
    if all(isinstance(value, dict) for value in column):
        keys = list(dict.fromkeys(key for value in column for key in value))
        more = f" and {len(keys) - _MOST_KEYS} more" if len(keys) > _MOST_KEYS else ""
        return f"{len(column)} dicts of {', '.join(map(str, keys[:_MOST_KEYS])) or 'nothing'}{more}"
    return f"{len(column)} values"


class ColumnDict(dict[str, Any]):
    """Columns by name. A column and its value in a step find each other, also by Gymnasium's names: `states`, `state`,
    `observations` and `observation` are one; the keys are ours.

    A name may go on with a leaf, as in `stats["observations.arm"]`. A KeyError names the keys there are.
    """

    def __missing__(self, name: object) -> Any:
        known = self._own_name(name)
        if known == name:
            raise KeyError(f"expected one of {', '.join(self)}, found {name!r:.80}{did_you_mean(name, self)}")
        return self[known]

    def __contains__(self, name: object) -> bool:
        return dict.__contains__(self, self._own_name(name))

    def get(self, name: str, default: Any = None, /) -> Any:
        """The column, or the default if there is none."""
        return dict.get(self, self._own_name(name), default)

    def _own_name(self, name: Any) -> Any:
        """The key that a name means; the name itself if there is none."""
        if dict.__contains__(self, name) or not isinstance(name, str):
            return name
        word, part = split_name(name)
        field = FIELD_OF.get(word, word)
        meant = (own + part for own in (field, step_name(field)))
        return next((key for key in meant if dict.__contains__(self, key)), name)


class Parts(SaysWhatIsMeant):
    """Columns and facts about them as attributes, None if not requested. `parts["states"]` is `parts.states`, as in a
    dict."""

    def __getitem__(self, name: str) -> Any:
        return self.asdict()[name]

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.asdict())

    def __repr__(self) -> str:
        told = "; ".join(f"{name}: {described(value)}" for name, value in self.asdict().items())
        return f"<{type(self).__name__} of {told}>"

    __iter__ = None  # it has no order

    def __contains__(self, name: object) -> bool:
        return name in self.asdict()

    def asdict(self) -> ColumnDict:
        """The requested columns and facts, by name."""
        return ColumnDict({name: value for name, value in vars(self).items() if value is not None})


class GymnasiumNames(SaysWhatIsMeant):
    """Columns of steps under Gymnasium's names."""

    states: Any
    next_states: Any
    terminals: Any
    timeouts: Any

    @property
    def observations(self) -> Any:
        """`states`."""
        return self.states

    @property
    def next_observations(self) -> Any:
        """`next_states`."""
        return self.next_states

    @property
    def terminations(self) -> Any:
        """`terminals`."""
        return self.terminals

    @property
    def truncations(self) -> Any:
        """`timeouts`."""
        return self.timeouts
