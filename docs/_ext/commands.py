"""The reference of the command line, from the program itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import typer

from tupli_mcap.cli.app import _COMMANDS, _EXAMPLES, _plain, app


def documented() -> str:
    """A section for each group of commands, an entry for each command, as MyST."""
    return "\n".join(_lines())


def _lines() -> Iterator[str]:
    group: Any = typer.main.get_command(app)
    root = group.make_context("tupli-mcap", [], resilient_parsing=True)
    for title, names in _COMMANDS.items():
        yield f"## {title}\n"
        for name in names:
            command = group.get_command(root, name)
            with command.make_context(name, [], parent=root, resilient_parsing=True) as context:
                yield from _entry(name, command, context)


def _entry(name: str, command: Any, context: Any) -> Iterator[str]:
    yield f"(command-{name})=\n### {name}\n"
    yield f"```text\ntupli-mcap {name} {' '.join(command.collect_usage_pieces(context))}\n```\n"
    yield _prose(command.help or "") + "\n"
    rows = [record for param in command.get_params(context) if (record := _record(param, context))]
    if rows:
        yield "| | |\n|---|---|"
        yield from (f"| `{_cell(names)}` | {_cell(_prose(text))} |" for names, text in rows)
        yield ""
    if examples := _EXAMPLES.get(name):
        yield "```console\n" + "\n".join(f"$ tupli-mcap {example}" for example in examples) + "\n```\n"


def _record(param: Any, context: Any) -> tuple[str, str] | None:
    record = param.get_help_record(context)
    if record is None or "--help" in record[0]:
        return None
    return _plain(record[0], param.param_type_name), record[1]


def _prose(text: str) -> str:
    """Help as MyST: what would be markup in it is escaped, and options are code."""
    text = re.sub(r"\n(?!\n)(?<!\n\n)", " ", text)
    text = re.sub(r"([*_<>\[\]|#])", r"\\\1", text)
    return re.sub(r"`[^`]*`|(?<!\w)--[a-z][\w-]*", lambda found: f"`{found[0].strip('`')}`", text)


def _cell(text: str) -> str:
    return re.sub(r"(?<!\\)\|", r"\\|", text.replace("\n", " "))
