"""The names of a door that are imported on first use."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def imported_on_use(door: dict[str, Any], homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package (`door`: its `globals()`) that imports a public name from its module on first use.

    `homes` has the names of each module, relative to the package: `{"columns.saved": "SavedColumns open"}`.
    """
    package = door["__name__"]
    home_of = {name: home for home, names in homes.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        door[name] = getattr(importlib.import_module(f"{package}.{home_of[name]}"), name)
        return door[name]

    return find
