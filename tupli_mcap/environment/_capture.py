"""Captures a live environment as an `EnvironmentRecord`. No environment is stepped, reset or closed, and only
`Snapshot.copy` makes another one."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import json
import platform
import random
import re
import sys
import warnings
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.environment._build import entry_point_name, foreign_code
from tupli_mcap.environment._changes import is_changed
from tupli_mcap.environment._local_code import is_local
from tupli_mcap.environment._pickling import InProcessCopy, dump
from tupli_mcap.environment._record import EnvironmentRecord, canonical_json
from tupli_mcap.errors import TupliError, brief

_ID_IN_TEXT = re.compile(r"<\w+<([^<>]+)>>+$")  # as Gymnasium writes an environment: <Wrapper<Class<id>>>
_OF_MAKE_VEC = ("num_envs", "vectorization_mode", "vector_kwargs", "wrappers")  # among a spec's arguments


def note(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> EnvironmentRecord:
    """Notes an environment's own EnvSpec, if JSON has a form for it, and the names of its classes.

    The spec may not rebuild the environment as it is. Of a vector environment, the first sub-environment is noted if it
    lives in this process; else the spec given to `gymnasium.make_vec`, if `gymnasium.make` takes it, or the id.
    """
    if not isinstance(env, gym.vector.VectorEnv):
        return _noted(env, *_told(env))
    inner = first_of(env)
    return _noted(env, *_told_of_many(env.unwrapped)) if inner is None else note(inner)


def first_of(envs: Any) -> gym.Env[Any, Any] | None:
    """The first sub-environment of a vector environment; None if it is not in this process."""
    inner = getattr(envs.unwrapped, "envs", None)
    return inner[0] if inner and isinstance(inner[0], gym.Env) else None


def name_of(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> str:
    """The Gymnasium id of an environment, or of the first sub-environment; the name of its class if it has no id."""
    base: Any = env.unwrapped
    name = getattr(getattr(base, "spec", None), "id", None)
    if isinstance(name, str):
        return name
    if (inner := first_of(env)) is not None:
        return name_of(inner)
    if type(base) is gym.vector.AsyncVectorEnv:
        # a text: a spec may not be picklable
        with contextlib.suppress(Exception):
            if found := _ID_IN_TEXT.search(base.call("__str__")[0]):
                return found[1]
    return type(base).__name__


def capture(
    env: gym.Env[Any, Any],
    *,
    by_reference: bool = False,
    pickled: bool = False,
    otherwise: str = "try by_reference=True, which stores the names of its classes only",
) -> EnvironmentRecord:
    """A record that rebuilds an environment as it is; `env` is not changed.

    It is the EnvSpec if the id is registered here, the arguments are plain data, the wrappers are Gymnasium's or
    of the environment's own package, it has not been reset, and `is_changed` finds no change. Else, or if `pickled`, it
    is the pickle. Classes from the user's own files (`__main__`, notebooks, tests, scripts) are pickled by value, so
    that the record works without those files; `by_reference=True` keeps that code out of it.

    Raises:
        TupliError: The environment cannot be pickled; it says what to do `otherwise`.
    """
    name, spec = _told(env)
    noted = _noted(env, name, spec)
    suits = spec is not None and not pickled and (by_reference or not _needs_local_code(spec))
    if spec is not None and suits and _is_as_made(env, spec):
        return noted
    try:
        data = dump(env, by_reference=by_reference)
    except Exception as err:
        hint = "" if by_reference else f", or {otherwise}"
        raise TupliError(
            f"the environment {noted.classes[-1]} cannot be pickled ({brief(err)}): wrap it before rendering or "
            f"opening files, give its class __getstate__ and __setstate__{hint}"
        ) from err
    return dataclasses.replace(noted, spec=None, pickle=data)


def fingerprint(env: gym.Env[Any, Any]) -> bytes | None:
    """Bytes that change when an environment changes; None if there are no such bytes."""
    try:
        return dump(env, by_reference=True)
    except Exception:  # noqa: BLE001 - any class may fail to pickle in its own way
        return None


def autoresets_of(env: gym.Env[Any, Any]) -> list[gym.wrappers.Autoreset]:
    """The `Autoreset` wrappers of an environment. The next step is a reset if `autoreset` of one is true, which is so
    after an end of what it wraps; an end that comes from a wrapper around it, such as a time limit, resets nothing."""
    return [layer for layer in _layers(env) if isinstance(layer, gym.wrappers.Autoreset)]


class Snapshot:
    """An environment at one moment, captured both by value and by reference.

    To take one is to pickle the environment, which changes nothing in it. If it cannot be pickled, using the snapshot
    raises the error. `copies` makes `copy` possible: objects that cannot be pickled (open files, windows) are then
    shared with the copies.
    """

    def __init__(self, env: gym.Env[Any, Any], *, copies: bool) -> None:
        self._name = type(env.unwrapped).__qualname__
        self._records = {flag: _attempt(env, by_reference=flag) for flag in (False, True)}
        self._copy: InProcessCopy | None = None
        self._failure: Exception | None = None
        if copies:
            try:
                self._copy = InProcessCopy(env)
            except Exception as err:  # noqa: BLE001 - any class may fail to pickle in its own way
                self._failure = err

    def record(self, *, by_reference: bool = False) -> EnvironmentRecord:
        """The environment as data, see `capture`. TupliError if it cannot be pickled."""
        found = self._records[bool(by_reference)]
        if isinstance(found, TupliError):
            raise found
        return found

    def copy(self) -> gym.Env[Any, Any]:
        """A new environment of the same classes in the captured state. Do not close it: this may close what the
        original uses. TupliError if the environment cannot be pickled."""
        if self._copy is None:
            raise TupliError(
                f"the environment {self._name} cannot be captured, since it cannot be pickled "
                f"({brief(self._failure)}): wrap it before rendering or opening files, or give its class "
                "__getstate__ and __setstate__"
            ) from self._failure
        try:
            with _quiet():
                return self._copy.restore()
        except Exception as err:
            raise TupliError(
                f"the environment {self._name} cannot be captured: its pickle does not load ({brief(err)})"
            ) from err


def _attempt(env: gym.Env[Any, Any], *, by_reference: bool) -> EnvironmentRecord | TupliError:
    try:
        return capture(env, by_reference=by_reference)
    except TupliError as err:
        return err.with_traceback(None)


def _noted(env: Any, name: str | None, spec: dict[str, Any] | None) -> EnvironmentRecord:
    classes = tuple(_class_name(layer) for layer in _layers(env))
    packages = {one.partition(":")[0].partition(".")[0] for one in classes} - sys.stdlib_module_names
    versions = dict(versions_of(frozenset({"gymnasium", "numpy", "cloudpickle", "tupli-mcap", *packages})))
    return EnvironmentRecord(name=name or classes[-1], spec=spec, classes=classes, versions=versions)


def _told(env: gym.Env[Any, Any]) -> tuple[str | None, dict[str, Any] | None]:
    """The id of an environment and its EnvSpec as JSON-able object, None where there is none."""
    base: Any = getattr(env.unwrapped, "spec", None)
    name = getattr(base, "id", None)
    if not isinstance(name, str):
        return None, None
    wrappers = [layer for layer in _layers(env) if isinstance(layer, gym.Wrapper)]
    before = [getattr(wrapper, "_cached_spec", None) for wrapper in wrappers]
    try:
        # First, since reading the spec of a wrapper copies the arguments of all wrappers below it.
        canonical_json([base.kwargs, [getattr(wrapper, "_saved_kwargs", None) for wrapper in wrappers]])
        with _quiet():
            return name, _plain_spec(env.spec)
    except Exception:  # noqa: BLE001 - an attribute or property of anybody's class; callables and arrays have no JSON
        return name, None
    finally:
        for wrapper, cached in zip(wrappers, before, strict=True):
            # a cached spec is no part of an environment's state
            wrapper._cached_spec = cached


def _told_of_many(envs: Any) -> tuple[str | None, dict[str, Any] | None]:
    """The same of a vector environment, for one of its sub-environments."""
    spec: Any = getattr(envs, "spec", None)
    name = getattr(spec, "id", None)
    if not isinstance(name, str):
        return None, None
    is_of_one = getattr(envs, "spec_is_of_one", False)
    if not is_of_one and (type(envs) is not gym.vector.AsyncVectorEnv or "wrappers" in spec.kwargs):
        return name, None
    kwargs = {key: value for key, value in spec.kwargs.items() if key not in _OF_MAKE_VEC}
    try:
        return name, _plain_spec(dataclasses.replace(spec, kwargs=kwargs))
    except Exception:  # noqa: BLE001 - callables and arrays have no JSON
        return name, None


def _plain_spec(spec: Any) -> dict[str, Any]:
    """Raises ValueError or TypeError where JSON has no form for it."""
    names = [field.name for field in dataclasses.fields(spec) if field.init]
    # is for vector environments, and differs between versions of gymnasium
    names.remove("vector_entry_point")
    fields = {name: getattr(spec, name) for name in names}
    fields["entry_point"] = entry_point_name(spec.entry_point)
    fields["additional_wrappers"] = [dataclasses.asdict(wrapper) for wrapper in spec.additional_wrappers]
    plain: dict[str, Any] = json.loads(canonical_json(fields))
    if not _has_text_keys(fields):
        raise ValueError("expected texts as keys: JSON would make texts of others")
    return plain


def _has_text_keys(value: Any) -> bool:
    """Whether all keys in dicts, lists and tuples are texts."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _has_text_keys(item) for key, item in value.items())
    return not isinstance(value, list | tuple) or all(map(_has_text_keys, value))


def _is_as_made(env: gym.Env[Any, Any], spec: Mapping[str, Any]) -> bool:
    """Whether `gymnasium.make` of a spec returns such an environment, as far as can be told without making one."""
    *wrappers, base = _layers(env)
    if not isinstance(base.spec.entry_point, str):
        return False  # several functions may have the same name
    if foreign_code(spec) or any(wrapper["kwargs"] is None for wrapper in spec["additional_wrappers"]):
        return False
    if [_class_name(wrapper) for wrapper in reversed(wrappers)] != _wrappers_of(spec):
        return False
    has_reset = [
        wrapper._has_reset for wrapper in wrappers if isinstance(wrapper, gym.wrappers.OrderEnforcing)
    ]
    if any(has_reset) or (not has_reset and getattr(base, "_np_random", None) is not None):
        return False  # it has been reset
    if is_changed(base, base.spec.kwargs):
        return False
    return not any(is_changed(wrapper, getattr(wrapper, "_saved_kwargs", {})) for wrapper in wrappers)


def _wrappers_of(spec: Mapping[str, Any]) -> list[str]:
    """The wrappers that `gymnasium.make` puts around the environment of a spec, from the inside out."""
    made: list[Any] = [] if spec["disable_env_checker"] else [gym.wrappers.PassiveEnvChecker]
    made += [gym.wrappers.OrderEnforcing] if spec["order_enforce"] else []
    made += [] if spec["max_episode_steps"] is None else [gym.wrappers.TimeLimit]
    names = [f"{wrapper.__module__}:{wrapper.__qualname__}" for wrapper in made]
    return [*names, *(wrapper["entry_point"] for wrapper in spec["additional_wrappers"])]


def _needs_local_code(spec: Mapping[str, Any]) -> bool:
    entry_points = [spec["entry_point"], *(wrapper["entry_point"] for wrapper in spec["additional_wrappers"])]
    return any(is_local(str(entry_point).partition(":")[0]) for entry_point in entry_points)


def _layers(env: Any) -> Iterator[Any]:
    while True:
        yield env
        if not isinstance(env, gym.Wrapper | gym.vector.VectorWrapper):
            return
        env = env.env


def _class_name(env: Any) -> str:
    return f"{type(env).__module__}:{type(env).__qualname__}"


@functools.lru_cache(maxsize=64)
def versions_of(packages: frozenset[str]) -> Mapping[str, str]:
    """The versions of Python, and of those packages that are installed."""
    versions = {"python": platform.python_version()}
    for name in sorted(packages):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
            versions[name] = importlib.metadata.version(name)
    return MappingProxyType(versions)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hides warnings of constructors in the block, and restores the global random generators after it."""
    random_state, numpy_state = random.getstate(), np.random.get_state()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        random.setstate(random_state)
        np.random.set_state(numpy_state)
