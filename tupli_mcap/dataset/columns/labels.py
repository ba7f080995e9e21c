"""Labels in filters of steps: names of elements and of values, as what they stand for in a recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.fields import FIELD_OF, step_name
from tupli_mcap.schema import BaseFilter, FilterIN, FilterType, format_key, join_key
from tupli_mcap.schema.filters import COMBINING, path_of
from tupli_mcap.spaces.labels import Labels

_NAMED = 8  # most elements that an error names
_EQUAL = (FilterType.EQ, FilterType.NE, FilterType.IN)


class StepLabels:
    """The labels of a recording, by the paths that filters name: `state.Pole Angle` is `state[2]`, and the value "left"
    of `action` is 0. A label of several values means any of them; one of several elements means none."""

    def __init__(self, layout: StepLayout, labels: Labels) -> None:
        self._elements: dict[tuple[str, ...], list[tuple[int, ...]]] = {}
        self._values: dict[tuple[str, ...], dict[str, list[int]]] = {}
        for leaf in (*layout.state, *layout.action, *layout.reward):
            path = (leaf.root, *map(str, leaf.keys))
            for i, name in enumerate(labels.dimensions.get(leaf.path, ())):
                if not name.isdigit():  # it would be an index
                    index = tuple(map(int, np.unravel_index(i, leaf.shape)))  # empty for a single number
                    self._elements.setdefault((*path, name), []).append(index)
            for i, name in enumerate(labels.values.get(leaf.path, ())):
                space: Any = leaf.space
                self._values.setdefault(path, {}).setdefault(name, []).append(int(space.start) + i)

    def applied(self, filter: BaseFilter) -> BaseFilter:
        """The filter without labels. FilterError if it compares a value that has labels with another text, or several
        elements have the label that it names."""
        if filter.type in COMBINING:
            return filter.model_copy(update={"filters": tuple(map(self.applied, filter.filters))})
        first, *inside = path_of(filter)
        path = (step_name(FIELD_OF.get(first, first)).removeprefix("next_"), *inside)
        if path in self._elements:
            outer = (first, *inside[:-1])
            keys = [join_key((*outer, index) if index else outer) for index in self._elements[path]]
            if len(keys) > 1:
                raise FilterError(
                    f"expected the label of one element, found {filter.key!r}, which is that of {len(keys)}; "
                    f"name one by its index: {', '.join(keys[:8])}"
                )
            return self.applied(filter.model_copy(update={"key": keys[0]}))
        self._check_named(filter, first, path)
        values = filter.value if filter.type is FilterType.IN else [filter.value]
        if path not in self._values or not any(isinstance(value, str) for value in values):
            return filter
        numbers = [one for value in values for one in self._numbers(filter, value, self._values[path])]
        found = FilterIN(key=filter.key, value=numbers)
        return ~found if filter.type is FilterType.NE else found

    def _check_named(self, filter: BaseFilter, first: str, path: tuple[str, ...]) -> None:
        """FilterError if a key names all elements of an array that has labels, or none of them."""
        for leaf in (path, path[:-1]):
            names = [
                inside[-1]
                for inside in self._elements
                if inside[:-1] == leaf and self._elements[inside] != [()]
            ]
            if names and not (path != leaf and path[-1].isdigit()):
                keys = [format_key((first, *leaf[1:], name)) for name in names]
                raise FilterError(
                    f"filter key {filter.key!r} names no element{did_you_mean(format_key((first, *path[1:])), keys)}: "
                    f"name one of them: {', '.join(keys[:_NAMED])}, or by its index"
                )

    @staticmethod
    def _numbers(filter: BaseFilter, value: Any, names: dict[str, list[int]]) -> list[Any]:
        if filter.type in _EQUAL and (not isinstance(value, str) or value in names):
            return names[value] if isinstance(value, str) else [value]
        raise FilterError(
            f"{filter.key!r} is one of {', '.join(names)}: expected a comparison with =, != or in, and one of them, "
            f"found {filter!s:.80}{did_you_mean(value, names)}"
        )
