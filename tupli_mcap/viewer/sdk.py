"""Imports rerun-sdk where it is used, with one error if it is missing or too old."""

from __future__ import annotations

import contextlib
import gc
import importlib
import re
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from tupli_mcap.errors import TupliError, missing_extra

__all__ = ["OLDEST", "ViewerError", "import_quickly", "pa", "rerun_sdk", "rr", "rrb", "version_of"]

OLDEST = (0, 39)


class ViewerError(TupliError):
    """A viewer cannot be started or reached, or has nothing to show."""


def rerun_sdk() -> Any:
    """The module `rerun`. MissingExtraError if the extra `rerun` is not installed, or its rerun-sdk is too old."""
    try:
        import rerun
    except ImportError as err:
        raise missing_extra("looking at recordings needs rerun-sdk", "rerun") from err
    version = getattr(rerun, "__version__", None)
    if version is None or version_of(version) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise missing_extra(
            f"expected rerun-sdk {oldest} or later, found {version or 'another package'}", "rerun"
        )
    return rerun


class _Lazy:
    """A module that is imported when something of it is used: it is optional, and takes long to import."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        return getattr(importlib.import_module(self._name), attribute)


if TYPE_CHECKING:
    import pyarrow as pa
    import rerun as rr
    import rerun.blueprint as rrb
else:
    pa, rr, rrb = map(_Lazy, ("pyarrow", "rerun", "rerun.blueprint"))


class _NoPandas:
    """A finder that hides pandas."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: ModuleType | None = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(f"no module named {name!r} is needed here", name=name)


def import_quickly() -> None:
    """Imports rerun-sdk without pandas and without garbage collection, so that a small replay starts sooner.

    pyarrow looks for pandas at its first array; here it finds none. Only for a process that gives pyarrow no pandas
    objects, such as the command line. pandas can still be imported later, also by pyarrow. Does nothing if pandas is
    imported already.
    """
    if "pandas" in sys.modules:
        return
    finder: Any = _NoPandas
    sys.meta_path.insert(0, finder)
    collecting = gc.isenabled()
    gc.disable()  # modules are no garbage
    try:
        with contextlib.suppress(ImportError):  # `rerun_sdk` raises the error, if it is needed
            import pyarrow
            import rerun  # noqa: F401 - while nothing is collected

            pyarrow.array([])  # pyarrow looks for pandas only once
    finally:
        sys.meta_path.remove(finder)
        if collecting:
            gc.freeze()
            gc.enable()


def version_of(text: str) -> tuple[int, ...]:
    """Major and minor number in a version's text; empty if there is none."""
    found = re.search(r"(\d+)\.(\d+)", text)
    return tuple(map(int, found.groups())) if found else ()
