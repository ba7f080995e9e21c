"""The names that a pickle gives for import, listed without loading it.

Nothing is decided by this list. What a pickle imports says little of what it does: functions that everybody imports
call others that are named only in their arguments.
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
    """What a pickle says it imports.

    names: `module:name`, each once, in the order of their first use; at most 10,000, of at most 200 characters.
    gaps: why it may import more than these, as far as its instructions tell. Without any, it may still.
    """

    names: tuple[str, ...]
    gaps: tuple[str, ...]


def named_imports(data: bytes) -> PickleImports:
    """Lists what the import instructions of a pickle name. Nothing is imported or run, and no pickle makes it fail.

    Pickles within it are not looked at. Time and memory are linear in the size of the pickle, of which the first
    500,000 instructions are read.
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
    """The names so far, and what is needed to tell the next one: the memo's texts, and the two values on top of the
    stack where the last instructions put texts there (None: anything else). Dicts stand for ordered sets."""

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
