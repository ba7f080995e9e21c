"""Tuple filters: which steps of some columns are wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tupli_mcap.dataset.tuples import Tuples
from tupli_mcap.errors import FilterError
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.schema import BaseFilter, RLTuple, check_keys, evaluate_columns

__all__ = ["STEP_KEYS", "TupleFilter", "TupleSelector", "selector_of"]

STEP_KEYS: Mapping[str, str] = {
    "state": "states",
    "action": "actions",
    "reward": "rewards",
    "terminal": "terminals",
    "timeout": "timeouts",
    "next_state": "next_states",
    "info": "infos",
    "step": "steps",
}
"""What an expression may name, and the column it is in; `step` counts from 0 within its episode."""

TupleFilter = BaseFilter | Callable[[RLTuple], bool]
Mask = np.ndarray[Any, np.dtype[np.bool_]]


class TupleSelector:
    """A tuple filter and the columns it needs to see."""

    def __init__(self, fields: tuple[str, ...], filter: TupleFilter) -> None:
        self.fields = fields
        self.filter = filter

    def mask(self, columns: Mapping[str, Any], layout: StepLayout) -> Mask:
        """Which steps of `columns` (by field, at least `self.fields`) are wanted.

        Raises:
            FilterError: the expression does not fit the columns, or the function returned no flag.
        """
        if isinstance(self.filter, BaseFilter):
            steps = {key: columns[field] for key, field in STEP_KEYS.items() if field in self.fields}
            return evaluate_columns(self.filter, steps)
        tuples = Tuples(columns, layout)
        return np.fromiter((_flag(self.filter(item)) for item in tuples), np.bool_, len(tuples))


def selector_of(filter: TupleFilter) -> TupleSelector:
    """What to read for a filter.

    Raises:
        FilterError: it is neither an expression nor a function, or it names an unknown field of a step.
    """
    if isinstance(filter, BaseFilter):
        check_keys(filter, STEP_KEYS)
        needed = {field for key, field in STEP_KEYS.items() if _names(filter, key)}
        return TupleSelector(("terminals", *sorted(needed - {"terminals"})), filter)
    if not callable(filter):
        raise FilterError(
            f"expected a function of one tuple or an expression like F('reward') > 0, found {filter!r:.80}"
        )
    return TupleSelector(("states", "actions", "rewards", "terminals", "timeouts", "infos"), filter)


def _names(filter: BaseFilter, key: str) -> bool:
    try:
        check_keys(filter, [name for name in STEP_KEYS if name != key])
    except FilterError:
        return True
    return False


def _flag(value: object) -> bool:
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, np.ndarray) and value.shape == () and value.dtype == np.bool_:
        return bool(value)
    raise FilterError(
        f"expected True or False from a tuple filter, found {value!r:.80}; compare one number of a step"
    )
