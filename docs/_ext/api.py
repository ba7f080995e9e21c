"""The reference of the Python API: which names it holds, where they are linked, and docstrings as reST."""

from __future__ import annotations

import functools
import importlib
import inspect
import re
import sys
from _collections import _tuplegetter  # type: ignore[attr-defined]
from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.autodoc.mock import mock

import tupli_mcap

MODULES = (
    *(f"tupli_mcap.{name}" for name in tupli_mcap._MODULES),
    "tupli_mcap.dataset.items",
    "tupli_mcap.torch.rl",
    "tupli_mcap.torch.d3rlpy",
)
"""The modules whose names are public."""

_SECTION = re.compile(r"(Args|Attributes|Raises|Returns|Yields):$")
_FIELDS = re.compile(r"[a-z]\w*(, [a-z]\w*)*: ")
_CODE = re.compile(r"(`+[^`]+`+)")
_MARKUP = re.compile(r"([*|])|_(?!\w)")


def public_names(module: str) -> Iterator[tuple[str, Any]]:
    """The names that a module documents, as users write them: those of the top level without their module."""
    with mock(["d3rlpy"]):  # which pins another Gymnasium
        door = importlib.import_module(module)
    own = [name for name, value in vars(door).items() if getattr(value, "__module__", "") == module]
    for name in getattr(door, "__all__", None) or [name for name in own if not name.startswith("_")]:
        value = getattr(door, name)
        short = getattr(tupli_mcap, name, None) is value if name in tupli_mcap.__all__ else False
        yield f"tupli_mcap.{name}" if short else f"{module}.{name}", value


def documented(module: str) -> str:
    """The page of a module: an entry for each of its names, those of the top level first, as MyST."""
    entries = []
    for name, value in sorted(public_names(module), key=lambda entry: entry[0].startswith(module)):
        kind = "class" if inspect.isclass(value) else "function" if callable(value) else "data"
        kind = "exception" if kind == "class" and issubclass(value, BaseException) else kind
        if module == "tupli_mcap.errors" and kind != "exception":
            continue
        options = "\n   :no-value:" if kind == "data" else ""
        entries.append(f".. auto{kind}:: {name}{options}\n")
    return "```{eval-rst}\n" + "\n".join(entries) + "```\n"


@functools.cache
def _homes() -> dict[str, str]:
    """Where each public object is really defined -> the name it is documented under."""
    found = {}
    for module in MODULES:
        for name, value in public_names(module):
            home = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
            if all(home):
                found[".".join(home)] = name
            found.setdefault(name.rpartition(".")[2], name)
    return found


def _resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> Any:
    """Links a name of an annotation or of a docstring's `Raises:` to the entry of the public name; what is ours and
    not public has none."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py":
        return None
    if name := _homes().get(target):
        return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, "obj", name, node, content)
    module, _, attribute = target.rpartition(".")
    return (
        content if module.startswith("tupli_mcap.") and hasattr(sys.modules.get(module), attribute) else None
    )


def _as_rest(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with code in backticks; this makes reST of them."""
    if what == "data" and value.__doc__ == type(value).__doc__:
        lines.clear()  # what its type is about
    lines[:] = _escaped("\n".join(_sections(lines))).split("\n")
    if what in ("attribute", "data", "property"):
        lines[:0] = ("..", "")  # else what stands before a colon in the first line is taken for a type


def _sections(lines: list[str]) -> Iterator[str]:
    """Lines of a docstring where fields that are explained are a section, and indented paragraphs are code."""
    section = fields = code = False
    for before, line in zip(["", *lines], lines, strict=False):
        starts = not before.strip()
        if line.strip():
            section = bool(_SECTION.match(line)) or (section and line.startswith("    "))
            if not section and starts and _FIELDS.match(line):
                fields = True
                yield "Fields:"
            elif not line.startswith("    ") and starts:
                fields = False
            if not (section or fields or code) and starts and line.startswith("    "):
                code = True
                yield from ("::", "")
            code = code and line.startswith("    ")
        line = "Fields:" if line == "Attributes:" else line
        yield f"    {line}" if fields and line.strip() else line


def code_in(docstring: str) -> str:
    """The indented paragraphs of a docstring that are code."""
    lines = list(_sections(inspect.cleandoc(docstring).split("\n")))
    code = False
    taken = []
    for line in lines:
        code = line == "::" or (code and (not line.strip() or line.startswith("    ")))
        if code and line != "::":
            taken.append(line)
    return inspect.cleandoc("\n" + "\n".join(taken)) if taken else ""


def _escaped(text: str) -> str:
    parts = _CODE.split(text)
    for i, part in enumerate(parts):
        if i % 2:
            after = parts[i + 1][:1]
            parts[i] = f"``{part.strip('`')}``" + ("\\ " if after.isalnum() else "")
        else:
            parts[i] = _MARKUP.sub(r"\\\g<0>", part)
    return "".join(parts)


def _name(app: Sphinx, tree: nodes.document) -> None:
    """A bare name, which annotations have that are imported for types only, is the public one."""
    for node in tree.findall(pending_xref):
        target = node.get("reftarget", "")
        if node.get("refdomain") == "py" and node.get("reftype") in ("class", "exc") and target in _homes():
            node["reftarget"] = _homes()[target]


def _skip(app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any) -> bool | None:
    """A field of a NamedTuple is in the docstring of its class, and an attribute has none of its own."""
    plain = isinstance(value, _tuplegetter) or (not callable(value) and value.__doc__ == type(value).__doc__)
    return True if plain and not isinstance(value, property) else None


def _signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, arguments: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """A default that a factory makes is `...`: Sphinx cannot parse `<factory>`."""
    return arguments and arguments.replace("<factory>", "..."), returned


def _import_modules(app: Sphinx) -> None:
    """Imports all modules before the build forks, or each of its processes would import them anew."""
    _homes()


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", _import_modules)
    app.connect("doctree-read", _name)
    app.connect("missing-reference", _resolve)
    app.connect("autodoc-skip-member", _skip)
    app.connect("autodoc-process-signature", _signature)
    app.connect("autodoc-process-docstring", _as_rest, priority=100)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}
