"""rerun-sdk, imported where it is used, with one error where it is missing or too old."""

from __future__ import annotations

import re
from typing import Any

from tupli_mcap.errors import MissingExtraError, TupliError

__all__ = ["OLDEST", "ViewerError", "rerun_sdk"]

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
        raise MissingExtraError(
            "looking at recordings needs rerun-sdk: pip install 'tupli-mcap[rerun]'"
        ) from err
    found = getattr(rerun, "__version__", None)
    if found is None or version_of(found) < OLDEST:
        raise MissingExtraError(
            f"expected rerun-sdk {'.'.join(map(str, OLDEST))} or later, found {found or 'another package'}: "
            "pip install -U 'tupli-mcap[rerun]'"
        )
    return rerun


def version_of(text: str) -> tuple[int, ...]:
    """Major and minor number in a version's text; empty if there is none."""
    found = re.search(r"(\d+)\.(\d+)", text)
    return tuple(map(int, found.groups())) if found else ()
