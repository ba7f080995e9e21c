"""Names of leaves, dimensions and entities, and texts from files made safe for entity paths and Markdown."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Sequence

from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.sdk import rr

_LONGEST = 80  # characters of a part of an entity path


def escaped(text: str) -> str:
    """Any text as one part of an entity path. A text that must be cut or changed gets a checksum, to stay unique."""
    shown = "".join(char if char.isprintable() else "\N{REPLACEMENT CHARACTER}" for char in text[:_LONGEST])
    if shown != text:
        shown += f"~{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"
    return str(rr.escape_entity_path_part(shown or "_"))


def entity_of(leaf: Leaf) -> str:
    """The entity path of a leaf: `/state/arm/position`."""
    return "/".join(["", leaf.root, *(escaped(str(key)) for key in leaf.keys)])


def title_of(leaf: Leaf) -> str:
    """A leaf's name for people: `state · arm · position`."""
    return " · ".join([leaf.root, *(_text(key)[:_LONGEST] for key in leaf.keys)])


def dimension_names(leaf: Leaf, known: Sequence[str] | None) -> list[str]:
    """A name for each dimension of the flattened leaf: the known names, else indexes such as `[0, 2]`."""
    if known is not None:
        return list(known)
    if leaf.shape == ():
        return [_text(leaf.keys[-1]) if leaf.keys else leaf.path]
    return [f"[{', '.join(map(str, at))}]" for at in itertools.product(*map(range, leaf.shape))]


def _text(key: object) -> str:
    """A key of a space as valid UTF-8, which the viewer needs: without lone surrogates."""
    return str(key).encode("utf-8", "replace").decode()


def plain(text: str) -> str:
    """Text from a file, escaped so that Markdown shows it as it is."""
    kept = "".join(c if c.isprintable() else " " for c in text[:400])
    return "".join(f"\\{c}" if c in r"\`*_{}[]<>()#+!|~" else c for c in kept)
