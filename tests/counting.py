"""Counts what a piece of work does: on a file four times as large it may do four times as much, on any machine."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

__all__ = ["calls", "grows", "tallied"]


def calls(work: Callable[[], Any]) -> int:
    """How many functions `work` calls, of Python and of C."""
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
    """Collects what `size` says of the arguments of each call of a function that `place` holds as `name`."""
    sizes: list[int] = []
    real = getattr(place, name)

    def counted(*args: Any, **options: Any) -> Any:
        sizes.append(size(*args, **options))
        return real(*args, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(place, name, counted)
        yield sizes


def grows(work: Callable[[int], int], start: int) -> float:
    """How much more `work` counts for four times `start`, over four: about 1 if it is linear, 4 if it is quadratic."""
    return work(4 * start) / work(start) / 4
