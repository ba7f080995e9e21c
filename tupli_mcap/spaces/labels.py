"""Labels: names of dimensions and values for people, and the time that a step takes; kept as `labels.json`."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, SpaceError, did_you_mean, warn
from tupli_mcap.schema.keys import name_within
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

    `dimensions`: leaf path (`state`, `state.arm`, `action`) -> a name for each dimension of the flattened leaf.
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

    def to_json(self, leaves: Sequence[Leaf]) -> bytes:
        """`labels.json` of a recording with these leaves, which has labels of no others."""
        stored = {leaf.path: _stored_path(leaf) for leaf in leaves}
        parts = {
            "dimensions": {stored[path]: texts for path, texts in self.dimensions.items()},
            "values": {stored[path]: texts for path, texts in self.values.items()},
        }
        document = {**parts, "step_seconds": self.step_seconds}
        return json.dumps(document, ensure_ascii=False, sort_keys=True).encode()

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
        if seconds is not None and not is_time(seconds):
            raise FormatError(f"{expected}, found {seconds!r:.80} as the seconds of a step")
        found = cls({}, {}, None if seconds is None else float(seconds))
        by_path = {_stored_path(leaf): leaf for leaf in leaves}
        for key, count in (("dimensions", _dimensions), ("values", _values)):
            part = document.get(key, {})
            if not isinstance(part, dict) or not all(_are_texts(texts) for texts in part.values()):
                raise FormatError(f"{expected}, found {part!r:.80} as {key!r}")
            for leaf, texts in ((by_path[path], texts) for path, texts in part.items() if path in by_path):
                if len(texts) != count(leaf):
                    raise FormatError(f"{expected}, found {len(texts)} labels of {leaf.path}")
                getattr(found, key)[leaf.path] = tuple(texts)
        return found


def chosen_labels(given: Mapping[str, Sequence[str]], leaves: Sequence[Leaf], known: Labels) -> Labels:
    """`known`, replaced by `given` where it has names: leaf -> names of its dimensions, or of its values. Each name of
    `leaves_by_name` will do; it may begin with the name of a column: `states.pos` is the leaf `state.pos`.

    Raises:
        SpaceError: no leaf has the name, the leaf has another number of dimensions or values, or a name is no text that
            can be printed.
    """
    if not isinstance(given, Mapping):
        raise SpaceError(f"labels: expected a dict, such as {{'state': ['x', 'angle']}}, found {given!r:.80}")
    by_name = leaves_by_name(leaves)
    dimensions, values, named = dict(known.dimensions), dict(known.values), set[str]()
    for key, names in given.items():
        root, *rest = re.split(r"(?=[\[.])", str(key), maxsplit=1)
        leaf = by_name.get(str(key)) or by_name.get("".join([_OF_COLUMN.get(root, root), *rest]))
        if leaf is None:
            known_paths = sorted(leaf.path for leaf in leaves)
            raise SpaceError(
                f"labels: expected one of {known_paths}, found {key!r:.80}{did_you_mean(key, known_paths)}"
            )
        path = leaf.path
        if path in named:
            raise SpaceError(f"labels: expected names for {path} once, found them twice")
        named.add(path)
        texts = (names,) if isinstance(names, str) or not isinstance(names, Iterable) else tuple(names)
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


def is_time(seconds: Any) -> bool:
    """Whether this can be the time of a step (s): a number above 0 that a float can hold."""
    is_number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    return is_number and 0 < seconds <= sys.float_info.max


def _stored_path(leaf: Leaf) -> str:
    """What `labels.json` calls a leaf: `state['arm'][0]`."""
    return leaf.root + "".join(f"[{key!r}]" for key in leaf.keys)


def leaves_by_name(leaves: Sequence[Leaf]) -> dict[str, Leaf]:
    """Leaves by each of their names: the path, `state.arm.x`; `state['arm']['x']`; and `arm.x`, unless it could mean
    another leaf."""
    shorts = [leaf.path.removeprefix(f"{leaf.root}.") for leaf in leaves]
    found = {short: leaf for short, leaf in zip(shorts, leaves, strict=True) if shorts.count(short) == 1}
    return found | {_stored_path(leaf): leaf for leaf in leaves} | {leaf.path: leaf for leaf in leaves}


def element_names(leaf: Leaf, labels: Labels, elements: Sequence[int] | None = None) -> tuple[str, ...]:
    """Names of some elements (C order; all by default): `state.q[0]`, with its label, if there is one, in place of the
    index: `state.q: elbow`, or `Pole Angle` if the state is this leaf alone."""
    chosen = np.arange(leaf.size) if elements is None else np.asarray(elements, np.int64)
    known = labels.dimensions.get(leaf.path)
    if known is not None:
        own = f"{leaf.path}: " if leaf.keys else ""
        return tuple(own + known[i] for i in chosen)
    return indexed_names(leaf.path, leaf.shape, chosen)


def indexed_names(name: str, shape: tuple[int, ...], elements: Array) -> tuple[str, ...]:
    """Names of some elements (C order) of an array of this name and shape; a scalar has the name itself."""
    if shape == ():
        return (name,) * len(elements)
    places = np.stack(np.unravel_index(elements, shape), axis=1).tolist()
    return tuple(name_within(name, tuple(place)) for place in places)


def distinct(names: Sequence[str]) -> list[str]:
    """The names, where one that was there before gets its place: `x`, `x (1)`."""
    found: dict[str, None] = {}
    for i, name in enumerate(names):
        while name in found:
            name += f" ({i})"
        found[name] = None
    return list(found)
