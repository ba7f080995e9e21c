"""From a live environment to an `EnvironmentRecord`."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import json
import platform
import random
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.environment._attributes import HAS_LAZY_DICTS, attributes
from tupli_mcap.environment._build import foreign_code, make_from_spec
from tupli_mcap.environment._local_code import is_local
from tupli_mcap.environment._pickling import InProcessCopy, Names, attribute_names, dump, state
from tupli_mcap.environment._record import EnvironmentRecord, canonical_json
from tupli_mcap.errors import TupliError

__all__ = ["Snapshot", "capture"]


def capture(env: gym.Env[Any, Any], *, by_reference: bool = False) -> EnvironmentRecord:
    """What is needed to rebuild an environment as it is now, see `record_environment`; `env` is not changed.

    Raises:
        TupliError: The environment cannot be pickled.
    """
    return Snapshot(env, at_speed=True).record(by_reference=by_reference)


class Snapshot:
    """The state of an environment at one moment, kept in this process.

    Taking one costs about as much as pickling the environment, changes nothing in it and draws from no random
    generator. An environment that cannot be pickled is only complained about when the snapshot is used;
    objects in it that cannot be pickled (open files, windows) are shared with copies. `at_speed` leaves the original
    as quick as it is (Python 3.11 and 3.12), which takes another one, made from its spec.
    """

    def __init__(self, env: gym.Env[Any, Any], *, at_speed: bool = False) -> None:
        self._name = type(env.unwrapped).__qualname__
        self._copy: InProcessCopy | None = None
        self._failure: Exception | None = None
        names = _names_in(env) if at_speed else {}
        try:
            self._copy = InProcessCopy(env, names)
        except Exception as err:  # noqa: BLE001 - any class may fail to pickle in its own way
            self._failure = err
        _renew_attributes(env, names)

    def restore(self) -> gym.Env[Any, Any]:
        """A new environment of the same classes in the captured state.

        Raises:
            TupliError: The environment cannot be pickled.
        """
        if self._copy is None:
            raise TupliError(
                f"the environment {self._name} cannot be captured, since it cannot be pickled "
                f"({_brief(self._failure)}): wrap it before rendering or opening files, or give its class "
                "__getstate__ and __setstate__"
            ) from self._failure
        try:
            with _quiet():
                env = self._copy.restore()
        except Exception as err:
            raise TupliError(
                f"the environment {self._name} cannot be captured: its pickle does not load ({_brief(err)})"
            ) from err
        _forget_cached_specs(env)
        return env

    def record(self, *, by_reference: bool = False) -> EnvironmentRecord:
        """The captured environment as data, see `record_environment`.

        Raises:
            TupliError: The environment cannot be pickled.
        """
        env = self.restore()
        try:
            return record_environment(env, by_reference=by_reference)
        finally:
            self.discard(env)

    def discard(self, copy: gym.Env[Any, Any]) -> None:
        """Close a copy that `restore` made, unless that would close what the original still uses."""
        if self._copy is not None and not self._copy.shares:
            _close(copy)


def record_environment(env: gym.Env[Any, Any], *, by_reference: bool = False) -> EnvironmentRecord:
    """Describe an environment that is ours to use: the caller gives up `env`.

    Its EnvSpec is taken where `gymnasium.make` of it gives the same classes in the same state, the pickle
    otherwise. Classes from the user's own files (`__main__`, notebooks, tests, scripts) are pickled by value,
    so that the record works where those files are missing; `by_reference=True` keeps that code out of it.
    """
    layers = list(_layers(env))
    classes = tuple(_class_name(layer) for layer in layers)
    versions = dict(_versions(frozenset(name.partition(":")[0].partition(".")[0] for name in classes)))
    spec = _exact_spec(env, by_reference=by_reference)
    if spec is not None:
        return EnvironmentRecord(name=spec["id"], spec=spec, classes=classes, versions=versions)
    _forget_cached_specs(env)
    try:
        data = dump(env, by_reference=by_reference)
    except Exception as err:
        hint = (
            "" if by_reference else ", or try by_reference=True, which stores the names of its classes only"
        )
        raise TupliError(
            f"the environment {classes[-1]} cannot be pickled ({_brief(err)}): wrap it before rendering or "
            f"opening files, give its class __getstate__ and __setstate__{hint}"
        ) from err
    return EnvironmentRecord(name=classes[-1], pickle=data, classes=classes, versions=versions)


def _exact_spec(env: gym.Env[Any, Any], *, by_reference: bool) -> dict[str, Any] | None:
    """The EnvSpec as JSON-able object, or None where it would not rebuild this very environment."""
    try:
        with _quiet():
            spec = _spec_object(env)
            if spec is None or foreign_code(spec) or (not by_reference and _needs_local_code(spec)):
                return None
            fresh = make_from_spec(spec)
            try:
                same = _same(env, fresh)
            finally:
                _close(fresh)
    except Exception:  # noqa: BLE001 - whatever goes wrong here, the pickle is the answer
        return None
    return spec if same else None


def _spec_object(env: gym.Env[Any, Any]) -> dict[str, Any] | None:
    spec = env.spec
    if spec is None:
        return None
    names = [field.name for field in dataclasses.fields(spec) if field.init]
    names.remove("vector_entry_point")  # how others are made, and changing with gymnasium's versions
    told = {name: getattr(spec, name) for name in names}
    told["additional_wrappers"] = [dataclasses.asdict(wrapper) for wrapper in spec.additional_wrappers]
    # Callables, arrays and NaN have no JSON: raises, and the environment is pickled.
    plain: dict[str, Any] = json.loads(canonical_json(told))
    return plain


def _needs_local_code(spec: dict[str, Any]) -> bool:
    entry_points = [spec["entry_point"], *(wrapper["entry_point"] for wrapper in spec["additional_wrappers"])]
    return any(is_local(entry_point.partition(":")[0]) for entry_point in entry_points)


def _same(env: gym.Env[Any, Any], fresh: gym.Env[Any, Any]) -> bool:
    """Whether two environments have the same class chain and the same state, spec and spaces included."""
    if [type(layer) for layer in _layers(env)] != [type(layer) for layer in _layers(fresh)]:
        return False
    if _spec_object(env) != _spec_object(fresh):
        return False
    # Both went through a pickle, so that the one is no more "used" than the other.
    _forget_cached_specs(env)
    snapshot = Snapshot(fresh)
    fresh_copy = snapshot.restore()
    try:
        return state(env) == state(fresh_copy)
    finally:
        snapshot.discard(fresh_copy)


def _layers(env: gym.Env[Any, Any]) -> Iterator[gym.Env[Any, Any]]:
    while True:
        yield env
        if not isinstance(env, gym.Wrapper):
            return
        env = env.env


def _names_in(env: gym.Env[Any, Any]) -> Names:
    """The names of attributes in a new environment of the same spec; none where there is no such environment."""
    if not HAS_LAZY_DICTS:
        return {}
    try:
        with _quiet():
            spec = _spec_object(env)
            _forget_cached_specs(env)
            if spec is None or foreign_code(spec):
                return {}
            fresh = make_from_spec(spec)
            try:
                return attribute_names(fresh)
            finally:
                _close(fresh)
    except Exception:  # noqa: BLE001 - attributes are slower to reach then, no more
        return {}


def _renew_attributes(env: gym.Env[Any, Any], names: Names) -> None:
    """An equal new dict makes attributes quicker to reach, where the old one had to be asked for."""
    if not HAS_LAZY_DICTS:
        return
    for layer in _layers(env):
        if attributes(layer, names.get(type(layer), ())) is None:
            with contextlib.suppress(AttributeError, TypeError):
                layer.__dict__ = dict(layer.__dict__)


def _forget_cached_specs(env: gym.Env[Any, Any]) -> None:
    """Whether somebody has asked for `env.spec` is no part of an environment's state."""
    for layer in _layers(env):
        if isinstance(layer, gym.Wrapper):
            layer._cached_spec = None


def _close(env: gym.Env[Any, Any]) -> None:
    with contextlib.suppress(Exception):  # a copy nobody sees
        env.close()


def _class_name(env: gym.Env[Any, Any]) -> str:
    return f"{type(env).__module__}:{type(env).__qualname__}"


@functools.lru_cache(maxsize=64)
def _versions(modules: frozenset[str]) -> tuple[tuple[str, str], ...]:
    versions = {"python": platform.python_version()}
    for name in sorted({"gymnasium", "numpy", "cloudpickle", "tupli-mcap", *modules}):
        if name not in sys.stdlib_module_names:
            with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
                versions[name] = importlib.metadata.version(name)
    return tuple(versions.items())


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Constructors of environments may warn and draw from the global random generators: undo both."""
    random_state, numpy_state = random.getstate(), np.random.get_state()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        random.setstate(random_state)
        np.random.set_state(numpy_state)


def _brief(err: BaseException | None) -> str:
    text = " ".join(str(err).split())
    return f"{type(err).__name__}: {text[:200]}"
