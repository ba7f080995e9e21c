"""Counts operations instead of seconds: on a file four times as large, there may be four times as many."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

__all__ = ["calls", "grows", "tallied"]


def calls(work: Callable[[], Any]) -> int:
    """The number of calls that `work` makes of functions in Python and C."""
    count = 0

    def note(_: Any, event: str, __: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(before)
    return count


@contextmanager
def tallied(place: Any, name: str, size: Callable[..., int]) -> Iterator[list[int]]:
    """Collects `size` of the arguments of each call of the function `name` of `place`."""
    sizes: list[int] = []
    real = getattr(place, name)

    def counted(*args: Any, **options: Any) -> Any:
        sizes.append(size(*args, **options))
        return real(*args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(place, name, counted)
        yield sizes


def grows(work: Callable[[int], int], start: int) -> float:
    """The count for four times `start`, divided by four times the count for `start`: about 1 if linear, 4 if
    quadratic."""
    return work(4 * start) / work(start) / 4
