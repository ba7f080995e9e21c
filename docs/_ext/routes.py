"""The reference of the server's HTTP interface, from its OpenAPI document."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PYTUPLI = ("/access", "/artifacts", "/benchmarks", "/episodes")


def document() -> dict[str, Any]:
    """What `GET /openapi.json` of a new server answers."""
    from tupli_mcap.server.app import create_app
    from tupli_mcap.server.library import Library
    from tupli_mcap.server.settings import Settings

    with tempfile.TemporaryDirectory() as name:
        library = Library(Settings(Path(name)))
        try:
            return create_app(library).openapi()
        finally:
            library.close()


def documented() -> str:
    """The routes as tables, ours and PyTupli's, and the schemas they name, as MyST."""
    return "\n".join(_lines(document()))


def _lines(api: dict[str, Any]) -> Iterator[str]:
    routes = [
        (path, method, route) for path, methods in api["paths"].items() for method, route in methods.items()
    ]
    for title, chosen in (
        ("Routes", [one for one in routes if not one[0].startswith(_PYTUPLI)]),
        ("PyTupli's routes", [one for one in routes if one[0].startswith(_PYTUPLI)]),
    ):
        yield f"## {title}\n"
        for path, method, route in chosen:
            yield from _route(path, method, route)
    yield "## Schemas\n"
    for name, schema in sorted(api.get("components", {}).get("schemas", {}).items()):
        yield from _schema(name, schema)


def _route(path: str, method: str, route: dict[str, Any]) -> Iterator[str]:
    yield f"**`{method.upper()} {path}`**\n"
    yield (route.get("description") or route.get("summary", "")).strip() + "\n"
    rows = [
        (f"{one['name']}", one["in"], _type(one.get("schema", {})), one.get("required", False))
        for one in route.get("parameters", [])
    ]
    for kind, content in route.get("requestBody", {}).get("content", {}).items():
        rows.append(
            ("body", kind, _type(content.get("schema", {})), route["requestBody"].get("required", False))
        )
    for status, answer in route.get("responses", {}).items():
        if status.startswith("2"):
            kinds = answer.get("content", {})
            shown = ", ".join(
                f"{_type(content.get('schema', {}))} ({kind})" for kind, content in kinds.items()
            )
            rows.append(
                (f"answer {status}", "", shown.replace("any (application/json)", "null") or "no body", True)
            )
    yield "| | | |\n|---|---|---|"
    for name, where, kind, required in rows:
        yield f"| `{name}` | {where}{'' if required else ', optional'} | {kind} |"
    yield ""


def _short(name: str) -> str:
    return name.rpartition("__")[2]  # FastAPI puts the module before a name that two have


def _type(schema: dict[str, Any]) -> str:
    """A schema in a few words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{_short(name)}](#schema-{name.lower()})"
    for word in ("anyOf", "oneOf", "allOf"):
        if word in schema:
            return " or ".join(_type(one) for one in schema[word])
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    return schema.get("format") or schema.get("type") or "any"


def _schema(name: str, schema: dict[str, Any]) -> Iterator[str]:
    yield f"(schema-{name.lower()})=\n**{_short(name)}**\n"
    if about := schema.get("description"):
        yield about.split("\n\n")[0].replace("\n", " ") + "\n"
    required = schema.get("required", [])
    if properties := schema.get("properties"):
        yield "| field | |\n|---|---|"
        for field, of in properties.items():
            yield f"| `{field}` | {_type(of)}{'' if field in required else ', optional'} |"
        yield ""
