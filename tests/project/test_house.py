"""How the package is built: folders one can look over, and imports that can be seen."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

import tupli_mcap

PACKAGE = Path(tupli_mcap.__file__).parent
FOLDERS = sorted({path.parent for path in PACKAGE.rglob("*.py")})
LAZY_DOORS = [PACKAGE / folder / "__init__.py" for folder in ("", "recording", "dataset", "storage")]


def name_of(path: Path) -> str:
    return str(path.relative_to(PACKAGE.parent))


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=name_of)
def test_no_module_is_named_in_a_string(path: Path) -> None:
    if path in LAZY_DOORS:  # public names, imported on first use
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and "import_module" in ast.unparse(node.func):
            assert "tupli_mcap" not in ast.unparse(node), f"{path}:{node.lineno}"


@pytest.mark.parametrize("folder", FOLDERS, ids=name_of)
def test_each_folder_says_what_is_in_it(folder: Path) -> None:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    assert text
    assert len(text.splitlines()) <= LONGEST.get(folder.name, 15)


@pytest.mark.parametrize("folder", FOLDERS, ids=name_of)
def test_a_door_names_every_room_and_module(folder: Path) -> None:
    """Of one or two modules, the names say enough; revisions are found by their numbers."""
    names = {path.stem for path in folder.glob("*.py")} | {
        path.parent.name for path in folder.glob("*/__init__.py")
    }
    names -= {"__init__", "__main__"}
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    missing = sorted(name for name in names if not re.search(rf"\b{name}\b", text))
    assert len(names) <= 2 or folder.name == "versions" or not missing


@functools.cache
def imported_names(path: Path) -> list[tuple[str, str]]:
    """(module, name) of what a module imports from the package."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return [(node.module or "", alias.name) for node in nodes for alias in node.names]


@pytest.mark.parametrize("folder", FOLDERS[1:], ids=name_of)
def test_what_a_door_gives_is_imported_from_it(folder: Path) -> None:
    door = ast.parse((folder / "__init__.py").read_text())
    given = {
        name.value
        for node in door.body
        if isinstance(node, ast.Assign) and "__all__" in ast.unparse(node.targets[0])
        for name in ast.walk(node.value)
        if isinstance(name, ast.Constant)
    }
    room = ".".join(folder.relative_to(PACKAGE.parent).parts)
    behind = {(module, name) for module, name in imported_names(folder / "__init__.py") if name in given}
    around = [
        (name_of(path), module, name)
        for path in PACKAGE.rglob("*.py")
        if folder not in path.parents
        for module, name in imported_names(path)
        if (module, name) in behind and module.startswith(f"{room}.")
    ]
    assert not around


@pytest.mark.parametrize("folder", FOLDERS, ids=name_of)
def test_a_folder_can_be_looked_over(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= 14


def test_what_tests_share_is_in_support() -> None:
    """A test may import from others of its own room. Nothing else can: rooms are found by pytest alone."""
    tests = Path(__file__).parents[1]
    room_of = {path.stem: path.parent for path in tests.glob("*/test_*.py")}
    around = [
        (str(path.relative_to(tests.parent)), module)
        for folder in (tests, tests.parent / "tools")
        for path in folder.rglob("*.py")
        for module, _ in imported_names(path)
        if module in room_of and room_of[module] != path.parent
    ]
    assert around == []


LONGEST = {"journal": 35}
"""A protocol is explained where one enters."""
