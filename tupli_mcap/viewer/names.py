"""What leaves, their dimensions and the entities they are sent to are called."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Sequence

import numpy as np

from tupli_mcap.spaces.leaves import Leaf

__all__ = ["dimension_names", "entity_of", "escaped", "title_of"]

_LONGEST = 80  # characters of a part of an entity path


def escaped(text: str) -> str:
    """Any text as one part of an entity path; texts that cannot be shown as they are get a number, to stay apart."""
    import rerun

    shown = "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text[:_LONGEST])
    if shown != text:
        shown += f"~{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"
    return str(rerun.escape_entity_path_part(shown or "_"))


def entity_of(leaf: Leaf) -> str:
    """The entity path of a leaf: `/state/arm/position`."""
    root = leaf.path.partition("[")[0]
    return "/".join(["", root, *(escaped(str(key)) for key in leaf.keys)])


def title_of(leaf: Leaf) -> str:
    """A leaf's name as people say it: `state · arm · position`."""
    root = leaf.path.partition("[")[0]
    return " · ".join([root, *(str(key)[:_LONGEST] for key in leaf.keys)])


def dimension_names(leaf: Leaf, known: Sequence[str] | None) -> list[str]:
    """A name for each dimension of the flattened leaf: the known ones, else its place such as `[0, 2]`."""
    if known is not None:
        return list(known)
    if leaf.shape == ():
        return [str(leaf.keys[-1]) if leaf.keys else leaf.path]
    return [f"[{', '.join(map(str, at))}]" for at in itertools.product(*map(range, leaf.shape))]


def magnitudes(values: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> list[float]:
    """How large each column of `values` typically gets: the 95th percentile of its finite absolute values."""
    found = []
    for column in values.T:
        finite = np.abs(column[np.isfinite(column)])
        found.append(float(np.percentile(finite, 95)) if len(finite) else 0.0)
    return found


def by_scale(sizes: Sequence[float], ratio: float, most: int) -> list[list[int]]:
    """Groups of dimensions that may share an axis: within `ratio` of the largest, at most `most` together.

    Dimensions that are always zero go with the smallest others. Groups and dimensions keep their order.
    """
    groups: list[list[int]] = []
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i]):
        largest = sizes[groups[-1][0]] if groups else 0.0
        if groups and len(groups[-1]) < most and (sizes[i] == 0 or sizes[i] * ratio >= largest):
            groups[-1].append(i)
        else:
            groups.append([i])
    return sorted(sorted(group) for group in groups)
