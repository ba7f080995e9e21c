"""rerun-sdk, imported where it is used, with one error where it is missing or too old."""

from __future__ import annotations

import contextlib
import gc
import re
import sys
from types import ModuleType
from typing import Any

from tupli_mcap.errors import TupliError, missing_extra

__all__ = ["OLDEST", "ViewerError", "import_quickly", "rerun_sdk"]

OLDEST = (0, 39)


class ViewerError(TupliError):
    """A viewer cannot be started or reached, or there is nothing it could show."""


def rerun_sdk() -> Any:
    """The module `rerun`.

    Raises:
        MissingExtraError: the extra `rerun` is not installed, or its rerun-sdk is too old.
    """
    try:
        import rerun
    except ImportError as err:
        raise missing_extra("looking at recordings needs rerun-sdk", "rerun") from err
    found = getattr(rerun, "__version__", None)
    if found is None or version_of(found) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise missing_extra(
            f"expected rerun-sdk {oldest} or later, found {found or 'another package'}", "rerun"
        )
    return rerun


class _NoPandas:
    """Finds no pandas, for whoever imports it first."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: ModuleType | None = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(f"no module named {name!r} is needed here", name=name)


def import_quickly() -> None:
    """Imports rerun-sdk without pandas, which pyarrow imports with its first array where it is installed.

    That, and looking for garbage meanwhile, is a third of the time that a small recording takes to be shown. Only for
    a process that gives pyarrow nothing of pandas, as the command line is one. Whoever imports pandas later gets it,
    and so does pyarrow where it is asked to make something for pandas. Nothing happens if it is there already.
    """
    if "pandas" in sys.modules:
        return
    finder: Any = _NoPandas
    sys.meta_path.insert(0, finder)
    collecting = gc.isenabled()
    gc.disable()  # what is imported is no garbage
    try:
        with contextlib.suppress(ImportError):  # there is an error for it, if it is needed
            import pyarrow
            import rerun  # noqa: F401 - here, where nothing is collected

            pyarrow.array([])  # it looks once
    finally:
        sys.meta_path.remove(finder)
        if collecting:
            gc.freeze()
            gc.enable()


def version_of(text: str) -> tuple[int, ...]:
    """Major and minor number in a version's text; empty if there is none."""
    found = re.search(r"(\d+)\.(\d+)", text)
    return tuple(map(int, found.groups())) if found else ()
