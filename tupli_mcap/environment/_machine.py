"""The unpickler's machine with symbols instead of objects: it finds what a pickle does, and does none of it."""

from __future__ import annotations

import _compat_pickle
import copyreg
import pickletools
from collections.abc import Callable
from typing import Any

from tupli_mcap.environment._symbols import (
    SHOWN_TEXT,
    SKELETONS,
    UNKNOWN,
    Call,
    Global,
    code_name,
    is_code,
    own_name,
    show,
)
from tupli_mcap.environment._verdicts import is_telling, verdict_of

__all__ = ["Found", "follow"]

_MAX_OPCODES = 500_000
_MAX_ENTRIES = 10_000  # of each list
_MAX_PROBLEMS = 20
_MAX_NESTING = 3  # pickles within bytes of pickles


def follow(data: bytes) -> Found:
    """What a pickle, and the pickles within it, would do; nothing is imported or run, and nothing raises."""
    found = Found()
    Machine(found, 0).follow(data)
    return found


class Found:
    """What was found so far, in this pickle and those within it. Dicts stand for ordered sets."""

    def __init__(self, opcodes: int = 0) -> None:
        self.imports: dict[tuple[str, str], None] = {}
        self.calls: dict[str, None] = {}
        self.functions: dict[str, None] = {}
        self.classes: dict[str, None] = {}
        self.uses: set[str] = set()
        self.problems: dict[str, None] = {}
        self.opcodes = opcodes

    def take_over(self, other: Found) -> None:
        """Adds what was found in a pickle within this one."""
        for entries, more in (
            (self.imports, other.imports),
            (self.calls, other.calls),
            (self.functions, other.functions),
            (self.classes, other.classes),
            (self.problems, other.problems),
        ):
            for entry in more:
                self.add(entries, entry)
        self.uses |= other.uses

    def add(self, entries: dict[Any, None], entry: Any) -> None:
        if len(entries) < _MAX_ENTRIES:
            entries[entry] = None
        elif entry not in entries:
            self.problems["it holds more than is listed here"] = None


class Machine:
    """The unpickler's stack and memo, with symbols instead of objects."""

    def __init__(self, found: Found, depth: int) -> None:
        self._found = found
        self._depth = depth
        self._stack: list[Any] = []
        self._marks: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._position = 0
        self._data = b""
        self.protocol = 0

    def follow(self, data: bytes) -> bool:
        """True if it reached the end of a pickle."""
        found, self._data = self._found, data
        try:
            for opcode, arg, position in pickletools.genops(data):
                found.opcodes += 1
                if found.opcodes > _MAX_OPCODES:
                    self._problem(f"only its first {_MAX_OPCODES:,} instructions were looked at")
                    return False
                self._position = position or 0
                handler = _HANDLERS.get(opcode.name)
                if handler is None:
                    self._problem(f"the instruction {opcode.name} is not known")
                else:
                    handler(self, arg)
        except Exception as err:  # noqa: BLE001 - the reader of each opcode fails in its own way
            text = " ".join(str(err).split())[:SHOWN_TEXT]
            self._problem(f"after byte {self._position} it is no pickle ({type(err).__name__}: {text})")
            return False
        return True

    def _problem(self, text: str) -> None:
        where = f" (in a pickle within it, at depth {self._depth})" if self._depth else ""
        if len(self._found.problems) < _MAX_PROBLEMS:
            self._found.problems[text + where] = None

    # ---- the stack

    def push(self, value: Any) -> None:
        self._stack.append(value)
        if isinstance(value, bytes) and value[:1] == b"\x80" and value[-1:] == b".":
            self._nested(value, loaded=False)

    def pop(self) -> Any:
        if self._stack:
            return self._stack.pop()
        self._problem(f"at byte {self._position} it takes a value from an empty stack")
        return UNKNOWN

    def mark(self) -> None:
        self._marks.append(self._stack)
        self._stack = []

    def pop_mark(self) -> list[Any]:
        if not self._marks:
            self._problem(f"at byte {self._position} it takes a mark that was never set")
            return []
        items, self._stack = self._stack, self._marks.pop()
        return items

    def pop_or_unmark(self) -> None:
        if self._stack or not self._marks:
            self.pop()
        else:
            self.pop_mark()

    def top(self) -> Any:
        if self._stack:
            return self._stack[-1]
        self._problem(f"at byte {self._position} it needs a value on an empty stack")
        return UNKNOWN

    def put(self, number: int) -> None:
        self._memo[number] = self.top()

    def memoize(self) -> None:
        self._memo[len(self._memo)] = self.top()

    def get(self, number: int) -> None:
        if number not in self._memo:
            self._problem(f"at byte {self._position} it recalls entry {number}, which was never stored")
        self._stack.append(self._memo.get(number, UNKNOWN))

    def unknown(self, why: str) -> None:
        self._problem(f"at byte {self._position} it {why}")
        self._stack.append(UNKNOWN)

    # ---- containers

    def take(self, count: int) -> None:
        items = [self.pop() for _ in range(count)]
        self.push(tuple(reversed(items)))

    def extend(self, items: list[Any], method: str) -> None:
        target = self.top()
        if isinstance(target, list):
            target.extend(items)
        elif not isinstance(target, dict | set):
            self._call_method(target, method)

    def _call_method(self, target: Any, method: str) -> None:
        while isinstance(target, Call):
            target = target.function
        if not self._is_known(target):
            self._found.add(self._found.calls, f"{show(target)}.{method}(...)")

    # ---- imports and calls

    def pair_at_position(self) -> tuple[str, str]:
        """The two lines after the opcode; a module's name may hold spaces."""
        first = self._data.index(b"\n", self._position + 1)
        second = self._data.index(b"\n", first + 1)
        module, name = self._data[self._position + 1 : first], self._data[first + 1 : second]
        return module.decode("utf-8", "replace"), name.decode("utf-8", "replace")

    def import_pair(self) -> Global:
        return self._import(*self.pair_at_position())

    def import_from_stack(self) -> None:
        name, module = self.pop(), self.pop()
        if isinstance(module, str) and isinstance(name, str):
            self._stack.append(self._import(module, name))
        else:
            self.unknown("imports something whose name it makes up while it is loaded")

    def import_extension(self, code: int) -> None:
        registered: dict[int, tuple[str, str]] = copyreg._inverted_registry  # type: ignore[attr-defined]
        if code in registered:
            self._stack.append(self._import(*registered[code]))
        else:
            self.unknown(f"imports whatever has extension code {code}")

    def _import(self, module: str, name: str) -> Global:
        if self.protocol < 3:  # the unpickler takes Python 2's names for Python 3's
            if (module, name) in _compat_pickle.NAME_MAPPING:
                module, name = _compat_pickle.NAME_MAPPING[module, name]
            else:
                module = _compat_pickle.IMPORT_MAPPING.get(module, module)
        self._found.add(self._found.imports, (module, name))
        return Global(module, name)

    def call(self, function: Any, args: Any, *, new: bool = False) -> None:
        """new: only `__new__` of a class is called, of which a class in the pickle has none of its own as a rule."""
        made = Call(function, args)
        self._stack.append(made)
        values = args if isinstance(args, tuple) else ()
        if is_code(function):
            self._code(values)
        elif isinstance(function, Global):
            self._call_global(function, values)
        if not (self._rebuilds(function, values) or (new and own_name(function))):
            self._found.add(self._found.calls, show(made))

    def _call_global(self, function: Global, values: tuple[Any, ...]) -> None:
        called = function.name.rpartition(".")[2]
        texts = [value for value in values if isinstance(value, str)]
        if called in ("subimport", "import_module", "__import__") and texts:
            self._import(texts[0], "")
        elif called in SKELETONS and texts:
            self._found.add(self._found.classes, texts[0])
        elif called == "loads":
            for value in values:
                if isinstance(value, bytes):
                    self._nested(value, loaded=True)

    def _rebuilds(self, function: Any, values: tuple[Any, ...]) -> bool:
        """Whether a call only rebuilds known objects. Some helpers call what they are given."""
        if is_code(function):
            return True
        return self._is_known(function) and all(
            self._is_known(value) for value in values if isinstance(value, Global)
        )

    def _is_known(self, value: Any) -> bool:
        return isinstance(value, Global) and verdict_of(value.module, value.name) == "known"

    def _code(self, values: tuple[Any, ...]) -> None:
        """A code object: cloudpickle gives `types.CodeType` its arguments, the names it mentions at 8."""
        self._found.add(self._found.functions, code_name(values))
        mentioned = values[8] if len(values) > 8 and isinstance(values[8], tuple) else ()
        for text in mentioned:
            if isinstance(text, str) and is_telling(text):
                self._found.uses.add(text)

    def build(self) -> None:
        """Sets attributes; on something imported, that changes it for the whole process."""
        self.pop()
        target = self.top()
        if isinstance(target, Global):
            self._found.add(self._found.calls, f"setattr({show(target)}, ...)")
            self._problem(f"it changes {show(target)}, which other names may then lead to")

    def _nested(self, data: bytes, *, loaded: bool) -> None:
        """A pickle within this one. Unless it is `loaded`, bytes (of an array, say) may look like one by chance."""
        if self._depth >= _MAX_NESTING:
            self._problem("it holds pickles within pickles, too deep to follow")
            return
        inner = Found(self._found.opcodes)
        if Machine(inner, self._depth + 1).follow(data) or loaded:
            self._found.take_over(inner)
        self._found.opcodes = inner.opcodes


def _reduce(machine: Machine, _: Any) -> None:
    args = machine.pop()
    machine.call(machine.pop(), args)


def _new(machine: Machine, _: Any) -> None:
    args = machine.pop()
    machine.call(machine.pop(), args, new=True)


def _new_with_keywords(machine: Machine, _: Any) -> None:
    machine.pop()
    _new(machine, None)


def _protocol(machine: Machine, version: int) -> None:
    machine.protocol = version


def _inst(machine: Machine, _: Any) -> None:
    args = machine.pop_mark()
    machine.call(machine.import_pair(), tuple(args))


def _obj(machine: Machine, _: Any) -> None:
    items = machine.pop_mark()
    machine.call(items[0] if items else UNKNOWN, tuple(items[1:]))


def _extend(method: str) -> Callable[[Machine, Any], None]:
    return lambda machine, _: machine.extend(machine.pop_mark(), method)


def _drop_marked(machine: Machine, _: Any) -> None:
    machine.pop_mark()


def _set_item(machine: Machine, _: Any) -> None:
    machine.pop()
    machine.pop()
    machine.extend([], "__setitem__")


def _from_mark(make: Callable[[list[Any]], Any]) -> Callable[[Machine, Any], None]:
    return lambda machine, _: machine.push(make(machine.pop_mark()))


def _constant(make: Callable[[], Any]) -> Callable[[Machine, Any], None]:
    return lambda machine, _: machine.push(make())


def _persistent(machine: Machine, arg: Any) -> None:
    if arg is None:
        machine.pop()
    machine.unknown("asks for a persistent object, which no environment has")


_LITERALS = (
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT", "STRING", "BINSTRING",
    "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES",
    "BINBYTES8",
)  # fmt: skip

_HANDLERS: dict[str, Callable[[Machine, Any], None]] = {
    **dict.fromkeys(_LITERALS, lambda machine, arg: machine.push(arg)),
    **dict.fromkeys(("FRAME", "STOP", "READONLY_BUFFER"), lambda machine, arg: None),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda machine, arg: machine.put(arg)),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda machine, arg: machine.get(arg)),
    **dict.fromkeys(("EXT1", "EXT2", "EXT4"), lambda machine, arg: machine.import_extension(arg)),
    **dict.fromkeys(("PERSID", "BINPERSID"), _persistent),
    "REDUCE": _reduce,
    "PROTO": _protocol,
    "NEWOBJ": _new,
    "NEWOBJ_EX": _new_with_keywords,
    "INST": _inst,
    "OBJ": _obj,
    "BUILD": lambda machine, _: machine.build(),
    "GLOBAL": lambda machine, _: machine.push(machine.import_pair()),
    "STACK_GLOBAL": lambda machine, _: machine.import_from_stack(),
    "NEXT_BUFFER": lambda machine, _: machine.unknown("asks for a buffer beside it"),
    "BYTEARRAY8": lambda machine, arg: machine.push(bytes(arg)),
    "NONE": _constant(lambda: None),
    "NEWTRUE": _constant(lambda: True),
    "NEWFALSE": _constant(lambda: False),
    "EMPTY_TUPLE": _constant(tuple),
    "EMPTY_LIST": _constant(list),
    "EMPTY_DICT": _constant(dict),
    "EMPTY_SET": _constant(set),
    "TUPLE": _from_mark(tuple),
    "LIST": _from_mark(list),
    "DICT": _from_mark(lambda _: {}),
    "FROZENSET": _from_mark(lambda _: set()),
    "TUPLE1": lambda machine, _: machine.take(1),
    "TUPLE2": lambda machine, _: machine.take(2),
    "TUPLE3": lambda machine, _: machine.take(3),
    "APPEND": lambda machine, _: machine.extend([machine.pop()], "append"),
    "APPENDS": _extend("extend"),
    "ADDITEMS": _extend("update"),
    "SETITEM": _set_item,
    "SETITEMS": _extend("update"),
    "MARK": lambda machine, _: machine.mark(),
    "POP": lambda machine, _: machine.pop_or_unmark(),
    "POP_MARK": _drop_marked,
    "DUP": lambda machine, _: machine.push(machine.top()),
    "MEMOIZE": lambda machine, _: machine.memoize(),
}
