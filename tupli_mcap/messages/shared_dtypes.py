"""Checks whether one array can hold the steps of several recordings, and which dtype it needs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import SpaceError
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.leaves import Leaf


def field_leaves(field: str, layout: StepLayout) -> Sequence[Leaf] | None:
    """The leaves of a field; None if it is a plain column (flags, infos)."""
    groups = {
        "states": layout.state,
        "next_states": layout.state,
        "actions": layout.action,
        "rewards": layout.reward,
    }
    return groups.get(field)


def check_layouts(
    first: StepLayout, first_name: str, other: StepLayout, other_name: str, fields: Iterable[str]
) -> None:
    """Raises SpaceError unless one array can hold each of these fields of two recordings; it names the first leaf that
    differs, and both recordings."""
    for field in fields:
        ours, theirs = field_leaves(field, first), field_leaves(field, other)
        if ours is None or theirs is None:
            continue
        root = field.removeprefix("next_").removesuffix("s")
        found = {leaf.keys: leaf for leaf in theirs}
        if {leaf.keys for leaf in ours} != found.keys():
            a, b = (", ".join(leaf.path for leaf in leaves) or "nothing" for leaves in (ours, theirs))
            raise _differ(root, a, first_name, b, other_name)
        for leaf in ours:
            a, b = _describe(leaf, first), _describe(found[leaf.keys], other)
            if a != b and not _compatible(leaf, first, found[leaf.keys], other):
                raise _differ(leaf.path, a, first_name, b, other_name)


def _compatible(a: Leaf, first: StepLayout, b: Leaf, other: StepLayout) -> bool:
    if "variable" in (a.kind, b.kind):
        return a.kind == b.kind and type(a.space) is type(b.space)
    return a.shape == b.shape and common_dtype(first.dtypes[a.name], other.dtypes[b.name]) is not None


def _describe(leaf: Leaf, layout: StepLayout) -> str:
    if leaf.kind == "variable":
        return type(leaf.space).__name__
    return f"{layout.dtypes[leaf.name].name} of shape {leaf.shape}"


def _differ(path: str, a: str, first: str, b: str, other: str) -> SpaceError:
    return SpaceError(
        f"{path}: expected {a} as in {first}, found {b} in {other}, which cannot be put into one array; "
        "choose recordings of one kind by a filter of run.environment or benchmark_id, for example"
    )


def common_dtype(a: np.dtype[Any], b: np.dtype[Any]) -> np.dtype[Any] | None:
    """A dtype that holds all values of both exactly; None if there is none of the same kind of numbers."""
    if a == b:
        return a
    if "b" in a.kind + b.kind or (a.kind == "f") != (b.kind == "f"):
        return None
    common = np.result_type(a, b)
    return None if common.kind == "f" and a.kind != "f" else common
