"""What to call a leaf and its elements, where people look at them."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tupli_mcap.spaces.labels import Labels
from tupli_mcap.spaces.leaves import Leaf


def short_path(leaf: Leaf) -> str:
    """`arm.x[0]` for `state['arm']['x'][0]`; without keys, and before an index, the name of the root."""
    if not leaf.keys:
        return leaf.path
    text = "" if isinstance(leaf.keys[0], str) else re.split(r"\W", leaf.path, maxsplit=1)[0]
    for key in leaf.keys:
        text += f".{key}" if isinstance(key, str) else f"[{key}]"
    return text.removeprefix(".")


def element_names(leaf: Leaf, labels: Labels, elements: Sequence[int] | None = None) -> tuple[str, ...]:
    """Names of some elements (C order; all by default): their labels, else their indexes in the leaf."""
    chosen = np.arange(leaf.size) if elements is None else np.asarray(elements, np.int64)
    prefix = short_path(leaf)
    known = labels.dimensions.get(leaf.path)
    if known is not None and len(known) == leaf.size:
        own = f"{prefix}: " if leaf.keys else ""
        return tuple(own + known[i] for i in chosen)
    if leaf.shape == ():
        return (prefix,) * len(chosen)
    places = np.stack(np.unravel_index(chosen, leaf.shape), axis=1).tolist()
    return tuple(f"{prefix}[{','.join(map(str, place))}]" for place in places)
