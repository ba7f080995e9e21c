"""The names that a pickle gives for import, listed without loading it.

No decision depends on this list. The imports of a pickle say little about what it does: harmless functions may call
others that are named only in their arguments.
"""

from __future__ import annotations

import pickletools
from typing import Final, NamedTuple

WHAT_LOADING_DOES: Final = (
    "Loading this pickle can run any code; the names below are what it says it imports; they prove nothing."
)
_MAX_OPCODES = 500_000
_MAX_NAMES = 10_000
_SHOWN = 200  # characters of a name
_TEXTS = frozenset(
    {
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE"),
        *("SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
    }
)
_PUTS = frozenset({"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"})
_GETS = frozenset({"GET", "BINGET", "LONG_BINGET"})
_EXTENSIONS = frozenset({"EXT1", "EXT2", "EXT4"})
_LEAVES_THE_STACK = frozenset({"PROTO", "FRAME"})


class PickleImports(NamedTuple):
    """The imports that a pickle names.

    Attributes:
        names: `module:name`, each once, in the order of first use; at most 10,000, of at most 200 characters.
        gaps: known reasons why it may import more than these. Without any, it may still import more.
    """

    names: tuple[str, ...]
    gaps: tuple[str, ...]


def named_imports(data: bytes) -> PickleImports:
    """Lists the names in the import instructions of a pickle. Nothing is imported or run, and it never fails.

    It does not look into pickles within the pickle. Time and memory are linear in the size of the pickle, of which it
    reads the first 500,000 instructions.
    """
    listing = _Listing(data)
    position: int | None = 0
    try:
        for count, (opcode, arg, position) in enumerate(pickletools.genops(data)):
            if count == _MAX_OPCODES:
                listing.gaps[f"only its first {_MAX_OPCODES:,} instructions were read"] = None
                break
            listing.follow(opcode.name, arg, position or 0)
    except Exception as err:  # noqa: BLE001 - the reader of each opcode fails in its own way
        text = " ".join(str(err).split())[:_SHOWN]
        listing.gaps[f"after byte {position} it is no pickle ({type(err).__name__}: {text})"] = None
    return PickleImports(tuple(listing.names), tuple(listing.gaps))


class _Listing:
    """The names so far, and the state for finding the next one: the memo's texts, and the top two values of the stack
    if they are texts (else None). Dicts serve as ordered sets."""

    def __init__(self, data: bytes) -> None:
        self.names: dict[str, None] = {}
        self.gaps: dict[str, None] = {}
        self._data = data
        self._memo: dict[int, str | None] = {}
        self._top: tuple[str | None, str | None] = (None, None)

    def follow(self, kind: str, arg: object, position: int) -> None:
        if kind in _TEXTS:
            self._top = self._top[1], str(arg)
        elif kind in _GETS and isinstance(arg, int):
            self._top = self._top[1], self._memo.get(arg)
        elif kind in _PUTS:
            self._memo[arg if isinstance(arg, int) else len(self._memo)] = self._top[1]
        elif kind not in _LEAVES_THE_STACK:
            if kind in ("GLOBAL", "INST"):
                self._add(*self._lines_after(position))
            elif kind == "STACK_GLOBAL":
                self._add(*self._top)
            elif kind in _EXTENSIONS:
                self.gaps[f"whatever is registered as the extension {arg}"] = None
            self._top = (None, None)

    def _add(self, module: str | None, name: str | None) -> None:
        if module is None or name is None:
            self.gaps["a name made up at load time"] = None
        elif len(self.names) < _MAX_NAMES:
            self.names[f"{module[:_SHOWN]}:{name[:_SHOWN]}"[:_SHOWN]] = None
        else:
            self.gaps[f"more than {_MAX_NAMES:,} names"] = None

    def _lines_after(self, position: int) -> tuple[str, str]:
        """As the unpickler reads them; `genops` joins the two lines by a space, which either may hold."""
        first = self._data.index(b"\n", position + 1)
        second = self._data.index(b"\n", first + 1)
        module, name = self._data[position + 1 : first], self._data[first + 1 : second]
        return module.decode("utf-8", "replace"), name.decode("utf-8", "replace")
