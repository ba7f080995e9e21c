"""Tells from the code of its classes whether an environment is still as its constructors left it.

No other environment is made for comparison. The code of a class shows which attributes it assigns, and which of these
get only constants or arguments of the constructor. An object is changed if it has another attribute, or another value
in one of those. Values that the constructor computes are not compared, nor are the contents of attributes.
"""

from __future__ import annotations

import dis
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import CodeType
from typing import Any, NamedTuple

_ATOMS = (type(None), bool, int, float, complex, str, bytes)
_SET_BY_MAKE = frozenset(("spec",))  # by gymnasium.make


class _Argument(NamedTuple):
    """An attribute is given the constructor's argument of this name."""

    name: str


_COMPUTED = object()  # in place of a value that the code does not show


def is_changed(obj: Any, arguments: Mapping[str, Any]) -> bool:
    """Whether an attribute of an object made with these arguments was set from outside of its classes."""
    cls: type = type(obj)
    assigned, given = _assigned(cls), _bound(cls, arguments)
    for name, value in vars(obj).items():
        if name in _SET_BY_MAKE:
            continue
        sources = assigned.get(name)
        if sources is None:
            return True
        expected = [given.get(s.name, _COMPUTED) if isinstance(s, _Argument) else s for s in sources]
        if all(type(one) in _ATOMS for one in expected) and not any(_same(value, one) for one in expected):
            return True
    return False


def _same(value: object, expected: object) -> bool:
    return type(value) is type(expected) and bool(value == expected)


def _bound(cls: type, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a constructor by name, defaults included; empty if they do not fit."""
    try:
        bound = inspect.signature(cls.__init__).bind_partial(None, **arguments)  # type: ignore[misc]
    except (TypeError, ValueError):
        return {}
    bound.apply_defaults()
    return dict(bound.arguments)


@functools.lru_cache(maxsize=256)
def _assigned(cls: type) -> Mapping[str, list[Any]]:
    """The values that the code of a class and its bases assigns to each attribute.

    A setter of a property counts only if that code assigns the property: others may be used from outside. What it
    stores as it is given is what the code assigns to the property.
    """
    sources: dict[str, list[Any]] = {}
    setters: list[tuple[str, Callable[..., Any]]] = []
    for base in cls.__mro__:
        for name, member in vars(base).items():
            if isinstance(member, functools.cached_property):
                sources.setdefault(name, []).append(_COMPUTED)
            if isinstance(member, property):
                setters += [(name, function) for function in _functions(member.fset)]
            for function in _functions(member):
                own = function is cls.__init__  # type: ignore[misc]
                for attribute, source in _stores(function.__code__):
                    usable = own or not isinstance(source, _Argument)
                    sources.setdefault(attribute, []).append(source if usable else _COMPUTED)
    for name, function in setters:
        for attribute, source in _stores(function.__code__) if name in sources else ():
            given = sources[name] if isinstance(source, _Argument) else [source]
            sources.setdefault(attribute, []).extend(given)
    return sources


def _functions(member: Any) -> Iterator[Callable[..., Any]]:
    """The functions written in Python behind a member of a class, without the setter of a property."""
    if isinstance(member, property):
        parts: tuple[Any, ...] = (member.fget, member.fdel)
    elif isinstance(member, functools.cached_property):
        parts = (member.func,)
    else:
        parts = (getattr(member, "__func__", member),)
    for part in parts:
        if inspect.isfunction(part):
            yield part
            if hasattr(part, "__wrapped__"):
                yield from _functions(inspect.unwrap(part))


def _stores(code: CodeType) -> Iterator[tuple[str, Any]]:
    """Each attribute that a function assigns, and the assigned value; those of functions in it, too."""
    instructions = [one for one in dis.get_instructions(code) if one.opname != "CACHE"]
    rebound = {one.argval for one in instructions if one.opname in ("STORE_FAST", "DELETE_FAST")}
    known = {*code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]} - rebound
    for i, one in enumerate(instructions):
        if one.opname == "STORE_ATTR":
            yield one.argval, _source(instructions[max(0, i - 2) : i + 1], known)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _stores(constant)


def _source(last: list[dis.Instruction], arguments: set[str]) -> Any:
    """The value that a STORE_ATTR stores, from the last instructions: load of the value, of the object, store."""
    target = last[-2] if len(last) > 1 else last[-1]
    if any(one.is_jump_target for one in last[-2:]) or not target.opname.startswith("LOAD_FAST"):
        return _COMPUTED  # one of several values, or of an object that is not a plain name
    if isinstance(target.argval, tuple):  # two loads in one instruction
        name: Any = target.argval[0]
        return _Argument(name) if name in arguments else _COMPUTED
    value = last[0]
    if len(last) == 3 and value.opname in ("LOAD_CONST", "LOAD_SMALL_INT"):
        return value.argval
    if len(last) == 3 and value.opname.startswith("LOAD_FAST") and value.argval in arguments:
        return _Argument(value.argval)
    return _COMPUTED
