"""Pickling environments: copies within this process, and bytes for another process."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from types import FunctionType
from typing import Any, cast

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from tupli_mcap.environment._local_code import by_value

_PROTOCOL = 5
_PLAIN_ATOMS = (type(None), bool, int, float, complex, str, bytes)
# what a pickler writes by itself; a PickleBuffer is what an array reduces to
_WRITTEN = (*_PLAIN_ATOMS, list, tuple, dict, set, frozenset, FunctionType, pickle.PickleBuffer)
_MAX_PLAIN_DEPTH = 20


class InProcessCopy:
    """An environment pickled for this process only.

    Classes are pickled by reference, so that any class can be copied (locally defined ones too) and copies are
    instances of the very same classes. So are objects that cannot be pickled (open files): copies share them with the
    original.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        buffer = io.BytesIO()
        pickler = _InProcessPickler(buffer)
        pickler.dump(env)
        self._data, self._kept = buffer.getvalue(), pickler.kept

    def restore(self) -> gym.Env[Any, Any]:
        """A new environment in the state that was captured."""
        return cast("gym.Env[Any, Any]", _InProcessUnpickler(io.BytesIO(self._data), self._kept).load())


def dump(env: gym.Env[Any, Any], *, by_reference: bool) -> bytes:
    """Pickle an environment for other processes; local classes by value unless `by_reference`."""
    buffer = io.BytesIO()
    if by_reference:
        _ByReferencePickler(buffer, _PROTOCOL).dump(env)
    else:
        with by_value():
            _EnvPickler(buffer, _PROTOCOL).dump(env)
    return buffer.getvalue()


def load(data: bytes) -> Any:
    """Unpickle what `dump` made. This runs code from the bytes: call it on trusted ones only."""
    return _Unpickler(io.BytesIO(data)).load()


def rebuild_ezpickled(
    cls: type, args: tuple[Any, ...], kwargs: dict[str, Any], attributes: dict[str, Any]
) -> Any:
    """Construct an object from its constructor's arguments, then set the attributes that were changed.

    Pickles name it as `tupli_mcap.environment.rebuild_ezpickled`, which must not be renamed.
    """
    made = cls(*args, **kwargs)
    made.__dict__.update(attributes)
    return made


rebuild_ezpickled.__module__ = "tupli_mcap.environment"


class _EnvPickler(cloudpickle.Pickler):  # type: ignore[misc]
    """cloudpickle, but objects that pickle as their constructor's arguments keep their plain attributes as
    well: `env.unwrapped.gravity = 5` is part of the environment. A wrapper's cached spec is not."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, EzPickle) and type(obj).__getstate__ is EzPickle.__getstate__:
            own = {name: value for name, value in vars(obj).items() if name != "_cached_spec"}
            if "_ezpickle_args" in own:
                args, kwargs = own.pop("_ezpickle_args"), own.pop("_ezpickle_kwargs")
                plain = {name: value for name, value in own.items() if _is_plain(value)}
                return rebuild_ezpickled, (type(obj), args, kwargs, plain)
        if isinstance(obj, gym.Wrapper):
            reduced = obj.__reduce_ex__(_PROTOCOL)
            if isinstance(reduced, tuple) and isinstance(state := (*reduced, None, None)[2], dict):
                return *reduced[:2], {**state, "_cached_spec": None}, *reduced[3:]
            return reduced
        return super().reducer_override(obj)


class _ByReferencePickler(_EnvPickler):
    """Classes and functions as `module` and `name` only, even those of `__main__`."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, type) or (callable(obj) and hasattr(obj, "__code__")):
            return NotImplemented
        return super().reducer_override(obj)


class _InProcessPickler(_EnvPickler):
    def __init__(self, buffer: io.BytesIO) -> None:
        super().__init__(buffer, _PROTOCOL)
        self.kept: list[Any] = []
        self._numbers: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> Any:
        if not isinstance(obj, type) and self._can_pickle(obj):
            return None
        if id(obj) not in self._numbers:
            self._numbers[id(obj)] = len(self.kept)
            self.kept.append(obj)  # which also keeps its id from being used again
        return self._numbers[id(obj)]

    def _can_pickle(self, obj: Any) -> bool:
        if type(obj) in _WRITTEN:
            return True
        try:
            reduce = self.dispatch_table.get(type(obj))
            _ = obj.__reduce_ex__(_PROTOCOL) if reduce is None else reduce(obj)
        except Exception:  # noqa: BLE001 - any class may fail to pickle in its own way
            return False
        return True


class _InProcessUnpickler(pickle.Unpickler):
    def __init__(self, buffer: io.BytesIO, kept: list[Any]) -> None:
        super().__init__(buffer)
        self._kept = kept

    def persistent_load(self, pid: Any) -> Any:
        return self._kept[pid]


class _Unpickler(pickle.Unpickler):
    """Makes new classes at each load, as in another process; cloudpickle would redefine a live class of this process
    when it loads a pickled version of it."""

    def find_class(self, module: str, name: str) -> Any:
        found = super().find_class(module, name)
        if module == "cloudpickle.cloudpickle" and name in ("_make_skeleton_class", "_make_skeleton_enum"):
            return _untracked(found)
        return found


def _untracked(make: Callable[..., Any]) -> Callable[..., Any]:
    # The last two arguments of both functions are the class's tracker id and `extra`.
    return lambda *args: make(*args[:-2], None, args[-1])


def _is_plain(value: Any, depth: int = 0) -> bool:
    if type(value) in _PLAIN_ATOMS or isinstance(value, np.generic):
        return True
    if type(value) is np.ndarray:
        return not value.dtype.hasobject
    if depth >= _MAX_PLAIN_DEPTH:
        return False
    if type(value) in (list, tuple, set, frozenset):
        return all(_is_plain(item, depth + 1) for item in value)
    if type(value) is dict:
        return all(_is_plain(key, depth + 1) and _is_plain(item, depth + 1) for key, item in value.items())
    return False
