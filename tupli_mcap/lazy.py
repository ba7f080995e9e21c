"""The names of a door that are imported on first use."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def imported_on_use(door: dict[str, Any], homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package that imports a public name from its module when it is first used.

    Args:
        door: `globals()` of the package.
        homes: by module, relative to the package, its names as one text: `{"columns.saved": "SavedColumns open"}`.
    """
    package = door["__name__"]
    home_of = {name: home for home, names in homes.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        door[name] = getattr(importlib.import_module(f"{package}.{home_of[name]}"), name)
        return door[name]

    return find
