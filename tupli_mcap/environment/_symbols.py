"""What stands for objects while a pickle is followed without being loaded, and how it is shown."""

from __future__ import annotations

from typing import Any

__all__ = [
    "SHOWN_TEXT",
    "SKELETONS",
    "UNKNOWN",
    "Call",
    "Global",
    "Unknown",
    "code_name",
    "is_code",
    "own_name",
    "show",
]

SHOWN_TEXT = 200
_SHOWN_DEPTH = 4
_SHOWN_ITEMS = 8
SKELETONS = ("_make_skeleton_class", "_make_skeleton_enum")  # cloudpickle's


class Global:
    __slots__ = ("module", "name")

    def __init__(self, module: str, name: str) -> None:
        self.module = module
        self.name = name


class Call:
    __slots__ = ("args", "function")

    def __init__(self, function: Any, args: Any) -> None:
        self.function = function
        self.args = args


class Unknown:
    """A value that the scan cannot know."""


UNKNOWN = Unknown()


def is_code(function: Any) -> bool:
    if isinstance(function, Call):  # cloudpickle's _builtin_type("CodeType")
        named = isinstance(function.args, tuple) and function.args == ("CodeType",)
        return named and isinstance(function.function, Global) and function.function.name == "_builtin_type"
    return isinstance(function, Global) and function.name.rpartition(".")[2] == "CodeType"


def code_name(values: tuple[Any, ...]) -> str:
    """The qualified name at 12 (from Python 3.11 on), else the name at 11."""
    return next((values[i] for i in (12, 11) if i < len(values) and isinstance(values[i], str)), "?")


def own_name(value: Any) -> str:
    """The name of a function or class whose code is in the pickle; empty for anything else."""
    if not (isinstance(value, Call) and isinstance(value.function, Global) and isinstance(value.args, tuple)):
        return ""
    maker, args = value.function.name, value.args
    if maker in SKELETONS:
        return next((arg for arg in args if isinstance(arg, str)), "?")
    is_function = (
        maker == "_make_function" and args and isinstance(args[0], Call) and is_code(args[0].function)
    )
    return code_name(args[0].args) if is_function else ""


def show(value: Any, depth: int = 0) -> str:
    """A value as text of bounded length."""
    if isinstance(value, Global):
        return f"{value.module}.{value.name}"[:SHOWN_TEXT]
    if depth >= _SHOWN_DEPTH or isinstance(value, Unknown):
        return "..."
    if isinstance(value, Call):
        args = _items(value.args, depth) if isinstance(value.args, tuple | list) else "..."
        if own_name(value):
            return own_name(value)[:SHOWN_TEXT]
        return f"{show(value.function, depth + 1)}({args})"[: 4 * SHOWN_TEXT]
    if isinstance(value, tuple):
        return f"({_items(value, depth)})"
    if isinstance(value, list):
        return f"[{_items(value, depth)}]"
    if isinstance(value, str | bytes):
        return repr(value[:SHOWN_TEXT]) + ("..." if len(value) > SHOWN_TEXT else "")
    if isinstance(value, int) and value.bit_length() > 128:
        return "..."
    return "{...}" if isinstance(value, dict | set) else repr(value)


def _items(values: Any, depth: int) -> str:
    shown = [show(item, depth + 1) for item in values[:_SHOWN_ITEMS]]
    return ", ".join(shown if len(values) <= _SHOWN_ITEMS else [*shown, "..."])
