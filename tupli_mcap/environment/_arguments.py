"""Finds the parts of a spec's arguments, and of a reset's options, that are more than data and so need trust."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

import gymnasium as gym
import numpy as np

# A text like this cannot name a file, URL, module or attribute.
_PLAIN_WORD = re.compile(r"[A-Za-z0-9_ +=,;()\[\]<>#-]{0,256}\Z")
_LARGEST: Final = 1 << 20


def more_than_data(value: object) -> str:
    """Why a value from a file needs trust: its first part that may be code, and what it may be; empty for plain data.

    Some environments pass texts to `open` or `gymnasium.make`, and allocate as many things as a number says. Flags,
    plain words, fractions and whole numbers up to 2^20 are data; several such numbers may still cost much memory.
    """
    for item in _atoms(value):
        if isinstance(item, int):
            if abs(item) > _LARGEST:
                shown = str(item) if item.bit_length() <= 64 else f"a number of {item.bit_length()} bits"
                return f"{shown} and may be a size that fills the memory"
        elif not _PLAIN_WORD.match(item):
            return f"{item[:100]!r} and may name a file or code"
    return ""


def foreign_arguments(spec: Mapping[str, Any]) -> list[str]:
    """Arguments in a spec that are `more_than_data`, such as `xml_file="../x.xml"`, and that are not registered."""
    kwargs = spec.get("kwargs", {})
    registered = gym.registry.get(str(spec.get("id")))
    usual = {} if registered is None else registered.kwargs
    wrappers = spec.get("additional_wrappers")
    given = [("", kwargs)]
    given += [
        (f" of the wrapper {str(wrapper.get('name'))[:60]!r}", wrapper.get("kwargs"))
        for wrapper in (wrappers if isinstance(wrappers, list) else ())
        if isinstance(wrapper, dict)
    ]
    reasons = []
    for where, arguments in given:
        items = arguments.items() if isinstance(arguments, dict) else [("kwargs", arguments)]
        for name, value in items:
            if not where and name in usual and _same(usual[name], value):
                continue
            why = more_than_data(value)
            if why:
                reasons.append(f"the argument {name[:60]!r}{where}, which holds {why}")
    return reasons


def _same(usual: object, value: object) -> bool:
    return isinstance(usual, str | int) and usual == value


def _atoms(value: object) -> Iterator[str | int]:
    """All texts and whole numbers in a value from a file, keys included; of an array, the smallest and the largest."""
    rest = [value]
    while rest:
        item = rest.pop()
        if isinstance(item, np.ndarray | np.generic):
            if item.dtype.kind in "iu" and item.size:
                yield from (int(item.min()), int(item.max()))
            elif item.dtype.kind in "SU":
                rest.append(item.tolist())
        elif isinstance(item, str | int):
            yield item
        elif isinstance(item, bytes | bytearray):
            yield item.decode("latin-1")
        elif isinstance(item, dict):
            rest += [*item, *item.values()]
        elif isinstance(item, list | tuple | set | frozenset):
            rest += item
