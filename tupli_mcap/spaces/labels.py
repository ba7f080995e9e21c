"""Labels: names of dimensions and values for people, and the time that a step takes; kept as `labels.json`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.errors import FormatError, SpaceError, warn
from tupli_mcap.spaces.leaves import Leaf

LABELS_NAME = "labels.json"
LABELS_MEDIA_TYPE = "application/json"
MAX_LABELS = 1 << 20  # bytes of `labels.json`
_LONGEST = 200  # characters of one label
_OF_COLUMN = {
    "states": "state",
    "observation": "state",
    "observations": "state",
    "actions": "action",
    "rewards": "reward",
}


class Labels(NamedTuple):
    """Names of dimensions and values; leaves without names are left out.

    `dimensions`: leaf path (`state`, `state['arm']`, `action`) -> a name for each dimension of the flattened leaf.
    `values`: path of a Discrete leaf -> a name for each value, from the space's `start` on.
    `step_seconds`: time that passes in the environment during a step (s); None if unknown.
    """

    dimensions: dict[str, tuple[str, ...]]
    values: dict[str, tuple[str, ...]]
    step_seconds: float | None = None

    @classmethod
    def none(cls) -> Labels:
        """Labels without any name."""
        return cls({}, {})

    def __bool__(self) -> bool:
        return bool(self.dimensions or self.values or self.step_seconds)

    def to_json(self) -> bytes:
        return json.dumps(self._asdict(), ensure_ascii=False, sort_keys=True).encode()

    @classmethod
    def from_json(cls, data: bytes, leaves: Sequence[Leaf], where: str) -> Labels:
        """Parses `labels.json`; labels of other leaves than `leaves` are ignored. Raises FormatError if `data` is
        something else, or a leaf has another number of labels than dimensions or values."""
        expected = f"{where}: expected labels as schemas/labels.schema.json has them"
        if len(data) > MAX_LABELS:
            raise FormatError(f"{expected}, of at most {MAX_LABELS} bytes, found {len(data)}")
        try:
            document = json.loads(data)
        except (ValueError, RecursionError) as err:
            raise FormatError(f"{expected}, found no JSON: {err}") from err
        if not isinstance(document, dict):
            raise FormatError(f"{expected}, found {document!r:.80}")
        seconds = document.get("step_seconds")
        if seconds is not None and not _is_time(seconds):
            raise FormatError(f"{expected}, found {seconds!r:.80} as the seconds of a step")
        parts = []
        for key in ("dimensions", "values"):
            part = document.get(key, {})
            if not isinstance(part, dict) or not all(_are_texts(texts) for texts in part.values()):
                raise FormatError(f"{expected}, found {part!r:.80} as {key!r}")
            parts.append({path: tuple(texts) for path, texts in part.items()})
        by_path = {leaf.path: leaf for leaf in leaves}
        dimensions, values = ({p: t for p, t in part.items() if p in by_path} for part in parts)
        for part, count in ((dimensions, _dimensions), (values, _values)):
            for path, texts in part.items():
                if len(texts) != count(by_path[path]):
                    raise FormatError(f"{expected}, found {len(texts)} labels of {path}")
        return cls(dimensions, values, None if seconds is None else float(seconds))


def chosen_labels(given: Mapping[str, Sequence[str]], leaves: Sequence[Leaf], known: Labels) -> Labels:
    """`known`, replaced by `given` where it has names: leaf -> names of its dimensions, or of its values. Each name of
    `leaves_by_name` will do; it may begin with the name of a column: `states['pos']` is the leaf `state['pos']`.

    Raises:
        SpaceError: no leaf has the name, or the leaf has another number of dimensions or values.
    """
    by_name = leaves_by_name(leaves)
    dimensions, values, named = dict(known.dimensions), dict(known.values), set[str]()
    for key, names in given.items():
        root, *rest = re.split(r"(?=[\[.])", str(key), maxsplit=1)
        leaf = by_name.get(str(key)) or by_name.get("".join([_OF_COLUMN.get(root, root), *rest]))
        if leaf is None:
            raise SpaceError(
                f"labels: expected one of {sorted(leaf.path for leaf in leaves)}, found {key!r:.80}"
            )
        path = leaf.path
        if path in named:
            raise SpaceError(f"labels: expected names for {path} once, found them twice")
        named.add(path)
        texts = tuple(names) if not isinstance(names, str) else (names,)
        if not _are_texts(texts):
            raise SpaceError(
                f"labels: expected names of 1 to {_LONGEST} characters for {path}, found {names!r:.80}"
            )
        if len(texts) == _values(leaf):
            values[path] = texts
        elif len(texts) == _dimensions(leaf):
            dimensions[path] = texts
        else:
            counts = sorted({count for count in (_dimensions(leaf), _values(leaf)) if count is not None})
            raise SpaceError(
                f"labels: expected {' or '.join(map(str, counts)) or 'no'} names for {path} ({leaf.space}), "
                f"found {len(texts)}"
            )
    return Labels(dimensions, values, known.step_seconds)


def common_labels(of: Mapping[str, Labels]) -> Labels:
    """The labels of recordings, by their names; of a leaf on which two differ none, and a warning says so."""
    common, differing, where = Labels.none(), list[str](), ""
    for part in ("dimensions", "values"):
        parts = {name: getattr(labels, part) for name, labels in of.items()}
        for path in dict.fromkeys(path for texts in parts.values() for path in texts):
            said = {texts[path]: name for name, texts in parts.items() if path in texts}
            if len(said) == 1:
                getattr(common, part)[path] = next(iter(said))
            else:
                differing.append(path)
                where = where or " and ".join(list(said.values())[:2])
    if differing:
        warn(f"{where} have different labels of {', '.join(differing)}; indexes are used instead")
    seconds = {labels.step_seconds for labels in of.values()} - {None}
    return common._replace(step_seconds=seconds.pop() if len(seconds) == 1 else None)


def _dimensions(leaf: Leaf) -> int | None:
    return None if leaf.dtype is None else leaf.size


def _values(leaf: Leaf) -> int | None:
    return int(leaf.space.n) if isinstance(leaf.space, spaces.Discrete) else None


def _are_texts(texts: Any) -> bool:
    return isinstance(texts, list | tuple) and all(
        isinstance(text, str) and 0 < len(text) <= _LONGEST and text.isprintable() for text in texts
    )


def _is_time(seconds: Any) -> bool:
    return isinstance(seconds, int | float) and not isinstance(seconds, bool) and 0 < seconds < math.inf


def short_path(leaf: Leaf) -> str:
    """`arm.x[0]` for `state['arm']['x'][0]`; without keys, and before an index, the name of the root."""
    if not leaf.keys:
        return leaf.path
    text = "" if isinstance(leaf.keys[0], str) else re.split(r"\W", leaf.path, maxsplit=1)[0]
    for key in leaf.keys:
        text += f".{key}" if isinstance(key, str) else f"[{key}]"
    return text.removeprefix(".")


def leaves_by_name(leaves: Sequence[Leaf]) -> dict[str, Leaf]:
    """Leaves by each of their names: the path, `state['arm']['x']`; that of columns and filters, `state.arm.x`; and
    `arm.x`, as `short_path` has it, unless it could mean another leaf."""
    shorts = [short_path(leaf) for leaf in leaves]
    pairs = list(zip(shorts, leaves, strict=True))
    found = {short: leaf for short, leaf in pairs if shorts.count(short) == 1}
    found |= {f"{leaf.path.partition('[')[0]}.{short}": leaf for short, leaf in pairs}
    return found | {leaf.path: leaf for leaf in leaves}


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


def distinct(names: Sequence[str]) -> list[str]:
    """The names, where one that was there before gets its place: `x`, `x (1)`."""
    found: dict[str, None] = {}
    for i, name in enumerate(names):
        while name in found:
            name += f" ({i})"
        found[name] = None
    return list(found)
