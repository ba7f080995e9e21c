"""Tells which imported modules are the user's own files, which another machine cannot install.

Classes of such modules (a script, a notebook, a test, a helper beside them) are pickled by value: otherwise nobody else
could load the environment.
"""

from __future__ import annotations

import contextlib
import functools
import site
import sys
import sysconfig
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import cloudpickle

# cloudpickle has one registry of modules for the whole process.
_LOCK = threading.RLock()


def is_local(module_name: str) -> bool:
    """Whether a module exists only in the user's own files.

    True for `__main__`, for test modules, and for modules that are not in the standard library, in a directory that pip
    installs to, or in an editable install. False for modules that are not imported, and for compiled ones.
    """
    top = module_name.partition(".")[0]
    if top in ("__main__", "__mp_main__"):
        return True
    if top in ("tupli_mcap", "gymnasium") or top in sys.stdlib_module_names:
        return False
    module = sys.modules.get(top)
    return module is not None and _is_local_module(top, module)


@contextlib.contextmanager
def by_value() -> Iterator[None]:
    """Within the block, cloudpickle pickles the classes and functions of all local modules by value."""
    with _LOCK:
        registered = []
        already = cloudpickle.list_registry_pickle_by_value()
        for name, module in list(sys.modules.items()):
            if "." not in name and name not in already and name != "__main__" and is_local(name):
                cloudpickle.register_pickle_by_value(module)
                registered.append(module)
        try:
            yield
        finally:
            for module in registered:
                cloudpickle.unregister_pickle_by_value(module)


def _is_local_module(name: str, module: ModuleType) -> bool:
    file = getattr(module, "__file__", None)
    if file is None:
        locations = list(getattr(module, "__path__", ()))  # a namespace package
        if not locations:
            return False  # built in, or made at run time
        file = str(Path(locations[0]) / "__init__.py")
    if not file.endswith(".py"):
        return False
    if name == "conftest" or name.startswith("test_") or name.endswith("_test"):
        return True
    path = Path(file)
    import_root = path.parent.parent if path.name == "__init__.py" else path.parent
    installed, editable = _installed_roots()
    return (
        not any(root in path.parents for root in installed)
        and import_root not in editable
        and name not in _editable_names()
    )


@functools.cache
def _installed_roots() -> tuple[frozenset[Path], frozenset[Path]]:
    """Directories below which everything is installed, and source directories of editable installs."""
    paths = sysconfig.get_paths()
    site_dirs = {paths["purelib"], paths["platlib"], *site.getsitepackages(), site.getusersitepackages()}
    installed = {Path(directory) for directory in (*site_dirs, paths["stdlib"], paths["platstdlib"])}
    editable: set[Path] = set()
    for directory in site_dirs:
        for pth in Path(directory).glob("*.pth"):
            with contextlib.suppress(OSError, UnicodeDecodeError):
                lines = pth.read_text(encoding="utf-8").splitlines()
                editable.update(Path(line) for line in lines if Path(line).is_absolute())
    return frozenset(installed), frozenset(editable)


def _editable_names() -> set[str]:
    """Packages that setuptools' editable installs map to a directory."""
    names: set[str] = set()
    for name, module in list(sys.modules.items()):
        if name.startswith("__editable__"):
            names.update(getattr(module, "MAPPING", ()))
    return names
