"""Rebuilds a live environment from an `EnvironmentRecord`; what may run code from a file needs the user's trust."""

from __future__ import annotations

import contextlib
import copy
import platform
import re
import sys
from collections.abc import Iterator, Mapping
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from tupli_mcap import trust as _trust
from tupli_mcap.environment._pickling import load
from tupli_mcap.environment._record import EnvironmentRecord, sha256
from tupli_mcap.errors import TupliError, UntrustedError, asking

# These render modes open no window.
_PICTURES = frozenset(
    {"rgb_array", "rgb_array_list", "depth_array", "depth_array_list", "rgbd_tuple", "ansi", "ansi_list"}
)

# A text like this cannot name a file, URL, module or attribute.
_PLAIN_WORD = re.compile(r"[A-Za-z0-9_ +=,;()\[\]<>#-]{0,256}\Z")
_LARGEST: Final = 1 << 20

_INSTEAD: Final = (
    "record with capture_env='pickle', or make the environment yourself and pass it on: "
    "tupli_mcap.reexecute.certify(path, env=...), tupli_mcap.reexecute.render(path, env=...)"
)


def build(
    record: EnvironmentRecord, *, trust: bool = False, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Rebuild an environment.

    A spec is built when its id is registered on this machine (with the entry points the file names) and its
    wrappers are gymnasium's own or come from the environment's own package, already imported. Everything
    else, the pickled environment above all, is code from a file: it runs only if this user made or trusted
    it (`tupli_mcap.trust`) or `trust=True` is given. Arguments in a spec are data for code installed here, unless
    one of them may name a file or more code, or be a size that fills the memory (`foreign_arguments`). `render_mode`
    replaces the record's, which is left out without trust if it may open a window; a pickled environment that has no
    such mode keeps its own.

    Raises:
        UntrustedError: Code would run that nobody here has trusted; nothing has been executed.
        TupliError: The environment does not build: the record only names it, a package is missing, another Python
            version made it.
    """
    if record.spec is None and record.pickle is None:
        raise TupliError(
            f"the environment {record.name[:200]!r} cannot be rebuilt: expected a spec or a pickle, found only the "
            f"names of its classes ({', '.join(record.classes)[:300]}); {_INSTEAD} (of vector environments, those of "
            "gymnasium.make_vec with vectorization_mode='sync' or 'async' tell how to make a single one)"
        )
    # those that do not say how they were made
    silent = [str(one.get("entry_point")) for one in _wrappers(record.spec) if one.get("kwargs") is None]
    if silent:
        raise TupliError(
            f"the environment {record.name[:200]!r} cannot be rebuilt from its spec, which lacks the arguments of "
            f"{', '.join(silent)[:300]} (no gymnasium.utils.RecordConstructorArgs); {_INSTEAD}"
        )
    reasons = reasons_for_distrust(record)
    window = record.spec is not None and _may_open_a_window(record.spec)
    trusted = trust or (bool(reasons or window) and _trust.is_trusted(record.digest))
    if reasons and not trusted:
        raise UntrustedError(
            f"rebuilding the environment {record.name[:200]!r} would run {'; '.join(reasons)}. If you trust "
            f"where it comes from, pass {asking('trust=True', '--trust')} or run `tupli-mcap trust FILE` (digest "
            f"{record.digest}); reading its episodes needs no trust"
        )
    spec = record.spec
    if spec is not None and window and not trusted:
        spec = {**spec, "kwargs": {k: v for k, v in spec["kwargs"].items() if k != "render_mode"}}
    try:
        env = load(record.pickle or b"") if spec is None else make_from_spec(spec, render_mode)
    except (Exception, SystemExit) as err:
        made_with = ", ".join(f"{name} {version}" for name, version in list(record.versions.items())[:20])
        missing = isinstance(err, ModuleNotFoundError)
        raise TupliError(
            f"the environment {record.name[:200]!r} cannot be rebuilt here with Python "
            f"{platform.python_version()} ({type(err).__name__}: {' '.join(str(err).split())[:300]}); "
            f"it was stored with {made_with or 'unknown versions'}"
            f"{'. Install that module, or name its directory in PYTHONPATH' if missing else ''}"
        ) from err
    if not isinstance(env, gym.Env):
        raise TupliError(
            f"expected a gymnasium.Env in the record {record.name[:200]!r}, found {type(env).__name__}"
        )
    if render_mode is not None and record.spec is None and render_mode in _render_modes(env):
        with contextlib.suppress(AttributeError):  # where it cannot be set
            env.unwrapped.render_mode = render_mode
    return env


def _wrappers(spec: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """The wrappers that a spec in a file describes."""
    wrappers = (spec or {}).get("additional_wrappers")
    return (
        [wrapper for wrapper in wrappers if isinstance(wrapper, dict)] if isinstance(wrappers, list) else []
    )


def _may_open_a_window(spec: Mapping[str, Any]) -> bool:
    arguments = spec.get("kwargs")
    mode = arguments.get("render_mode") if isinstance(arguments, dict) else None
    return mode is not None and not (isinstance(mode, str) and mode in _PICTURES)


def _render_modes(env: gym.Env[Any, Any]) -> list[Any]:
    told = (env.metadata or {}).get("render_modes")
    return list(told) if isinstance(told, list | tuple | set) else []


def make_from_spec(spec: Mapping[str, Any], render_mode: str | None) -> gym.Env[Any, Any]:
    """`gymnasium.make` of a spec given as JSON-able object; runs its entry points."""
    fields = copy.deepcopy(dict(spec))
    known = gym.registry.get(fields["id"])
    # It does not matter for a single environment; take this machine's own.
    fields["vector_entry_point"] = None if known is None else known.vector_entry_point
    if known is not None and fields.get("entry_point") == entry_point_name(known.entry_point):
        fields["entry_point"] = known.entry_point
    wrappers = tuple(WrapperSpec(**wrapper) for wrapper in fields.pop("additional_wrappers", ()))
    made = EnvSpec(**fields, additional_wrappers=wrappers)
    return gym.make(made) if render_mode is None else gym.make(made, render_mode=render_mode)


def entry_point_name(entry_point: Any) -> Any:
    """An entry point as a spec in a file names it: `module:name`, also of a class or function."""
    if not callable(entry_point):
        return entry_point
    named = entry_point if hasattr(entry_point, "__qualname__") else type(entry_point)
    return f"{named.__module__}:{named.__qualname__}"


def foreign_code(spec: Mapping[str, Any]) -> list[str]:
    """The code that building a spec would run and that this machine does not know; empty if it needs no trust.

    Wrappers are resolved without an import: a file must not choose what is imported.
    """
    name = spec.get("id")
    known = gym.registry.get(name) if isinstance(name, str) else None
    if known is None:
        named = str(spec.get("entry_point"))[:200]
        return [
            f"the entry point {named!r} of {str(name)[:100]!r}, an id that is not registered here (in Python, import "
            "its package first)"
        ]
    reasons = []
    registered = entry_point_name(known.entry_point)
    if spec.get("entry_point") != registered:
        named = str(spec.get("entry_point"))[:200]
        reasons.append(f"the entry point {named!r} of {name!r}, registered here as {str(registered)[:200]!r}")
    wrappers = spec.get("additional_wrappers", [])
    if not isinstance(wrappers, list):
        return [*reasons, f"additional wrappers of type {type(wrappers).__name__}"]
    package = _top_level(registered)
    for wrapper in wrappers:
        entry_point = wrapper.get("entry_point") if isinstance(wrapper, dict) else None
        if not _is_known_wrapper(entry_point, package):
            reasons.append(f"the wrapper {str(entry_point)[:200]!r}, none of those that need no trust")
    return reasons


def _is_known_wrapper(entry_point: object, package: str) -> bool:
    """Not every imported wrapper will do: some write to files that their arguments name."""
    if not isinstance(entry_point, str):
        return False
    module_name, _, class_name = entry_point.partition(":")
    if not module_name.startswith("gymnasium.wrappers.") and (
        not package or _top_level(entry_point) != package
    ):
        return False
    # Not `getattr`: modules with a `__getattr__` import what they are asked for.
    wrapper = vars(sys.modules.get(module_name, object)).get(class_name)
    return (
        isinstance(wrapper, type)
        and issubclass(wrapper, gym.Wrapper)
        # These write to the folder that an argument names, or open a window.
        and not issubclass(wrapper, gym.wrappers.RecordVideo | gym.wrappers.HumanRendering)
    )


def packages_named_by(record: EnvironmentRecord) -> list[str]:
    """The packages and modules, apart from Gymnasium, whose code a spec names, and the record does not hold."""
    spec = record.spec or {}
    named = [spec.get("entry_point"), *(wrapper.get("entry_point") for wrapper in _wrappers(spec))]
    return sorted({_top_level(entry_point) for entry_point in named} - {"", "gymnasium"})


def _top_level(entry_point: object) -> str:
    return entry_point.partition(":")[0].partition(".")[0] if isinstance(entry_point, str) else ""


def reasons_for_distrust(record: EnvironmentRecord) -> list[str]:
    """The code that rebuilding would run and that this machine does not know; empty if it needs no trust."""
    if record.spec is not None:
        return [*foreign_code(record.spec), *foreign_arguments(record.spec)]
    if record.pickle is None:
        return []
    size = len(record.pickle)
    said = f" (it says: {', '.join(record.classes)[:300]})" if record.classes else ""
    return [f"{size} bytes of pickled Python code with SHA-256 {sha256(record.pickle)}{said}"]


# ---- arguments of specs, and options of resets


def more_than_data(value: object) -> str:
    """Why a value from a file needs trust: its first part that may be code, and what it may be; empty for plain data.

    Some environments pass texts to `open` or `gymnasium.make`, and allocate as many things as a number says. Flags,
    plain words, fractions and whole numbers up to 2^20 are data; several such numbers may still cost much memory.
    """
    for item in _atoms(value):
        if isinstance(item, int):
            if abs(item) > _LARGEST:
                shown = str(item) if item.bit_length() <= 64 else f"a number of {item.bit_length()} bits"
                return f"{shown} and may be a size that fills the memory"
        elif not _PLAIN_WORD.match(item):
            return f"{item[:100]!r} and may name a file or code"
    return ""


def foreign_arguments(spec: Mapping[str, Any]) -> list[str]:
    """Arguments in a spec that are `more_than_data`, such as `xml_file="../x.xml"`, and that are not registered."""
    kwargs = spec.get("kwargs", {})
    registered = gym.registry.get(str(spec.get("id")))
    usual = {} if registered is None else registered.kwargs
    given = [("", kwargs)]
    given += [
        (f" of the wrapper {str(one.get('name'))[:60]!r}", one.get("kwargs")) for one in _wrappers(spec)
    ]
    reasons = []
    for where, arguments in given:
        items = arguments.items() if isinstance(arguments, dict) else [("kwargs", arguments)]
        for name, value in items:
            if not where and isinstance(usual.get(name), str | int) and usual[name] == value:
                continue
            why = more_than_data(value)
            if why:
                reasons.append(f"the argument {name[:60]!r}{where}, which holds {why}")
    return reasons


def _atoms(value: object) -> Iterator[str | int]:
    """All texts and whole numbers in a value from a file, keys included; of an array, the smallest and the largest."""
    rest = [value]
    while rest:
        item = rest.pop()
        if isinstance(item, np.ndarray | np.generic):
            if item.dtype.kind in "iu" and item.size:
                yield from (int(item.min()), int(item.max()))
            elif item.dtype.kind in "SU":
                rest.append(item.tolist())
        elif isinstance(item, str | int):
            yield item
        elif isinstance(item, bytes | bytearray):
            yield item.decode("latin-1")
        elif isinstance(item, dict):
            rest += [*item, *item.values()]
        elif isinstance(item, list | tuple | set | frozenset):
            rest += item
