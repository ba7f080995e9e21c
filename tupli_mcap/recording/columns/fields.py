"""The names of the columns of steps, Gymnasium's names for them, and columns that are found by name."""

from __future__ import annotations

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


def field_names(
    fields: str | Sequence[str], known: Sequence[str] = FIELDS, error: type[Exception] = RecordingError
) -> list[str]:
    """The fields under this package's names, each once; Gymnasium's names are understood. Raises `error` for an unknown
    name."""
    try:
        given = [fields] if isinstance(fields, str) else list(fields)
        names = [OTHER_NAMES.get(name, name) for name in given]
    except TypeError as err:
        raise error(f"expected fields from {', '.join(known)}, found {fields!r:.80}") from err
    for written, name in zip(given, names, strict=True):
        if name not in known:
            raise error(
                f"expected fields from {', '.join(known)}, found {written!r:.80}{did_you_mean(name, known)}"
            )
    return list(dict.fromkeys(names))


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
    """Columns by name. Gymnasium's names find ours: `batch["observations"]` is `batch["states"]`; the keys are ours.

    A name may go on with a leaf, as in `stats["observations['arm']"]`. A KeyError names the keys there are.
    """

    def __missing__(self, name: object) -> Any:
        known = _own_name(name)
        if known == name or not dict.__contains__(self, known):
            raise KeyError(
                f"expected one of {', '.join(self)}, found {name!r:.80}{did_you_mean(known, self)}"
            )
        return self[known]

    def __contains__(self, name: object) -> bool:
        return dict.__contains__(self, _own_name(name))

    def get(self, name: str, default: Any = None, /) -> Any:
        """The column, or the default if there is none."""
        return dict.get(self, _own_name(name), default)


def _own_name(name: Any) -> Any:
    """This package's name of a column, or of a leaf in it."""
    if not isinstance(name, str):
        return name
    column, bracket, leaf = name.partition("[")
    return OTHER_NAMES.get(column, column) + bracket + leaf


class Parts(SaysWhatIsMeant):
    """Columns and facts about them as attributes, None if not requested. `parts["states"]` is `parts.states`, as in a
    dict."""

    def __getitem__(self, name: str) -> Any:
        return self.asdict()[name]

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
