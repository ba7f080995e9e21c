"""Commands on trust: which environments in files may be rebuilt on this machine, and what that would run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import Json
from tupli_mcap.cli.output import bytes_of, print_facts, print_json

if TYPE_CHECKING:
    from tupli_mcap.environment import PickleScan
    from tupli_mcap.recording.carried import CarriedCode

__all__ = ["register"]

_SHOWN = 40  # entries of a list on the terminal; --json has them all


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command("trust")(_trust)
    app.command("untrust")(_untrust)


def _trust(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="A recording.")] = None,
    show: Annotated[bool, typer.Option("--show", help="Only show what would run.")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Trust it no longer.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="Only list what is trusted.")] = False,
    as_json: Json = False,
) -> None:
    """Let the environment in a file be rebuilt.

    Rebuilding it may run code that came with the file, as this user, on this machine. --show tells what,
    without running it: a pickle is followed instruction by instruction. It cannot tell that code is harmless.
    Reading the episodes of a file needs no trust. Only this user's processes trust it from then on; one
    changed byte of the environment ends that.
    """
    from tupli_mcap.recording.carried import carried_code, set_trust

    if sum((show, remove, listed)) > 1:
        raise typer.BadParameter("--show, --remove and --list exclude each other")
    if listed != (file is None):
        raise typer.BadParameter("--list takes no FILE" if listed else "expected a FILE, or --list")
    if file is None:
        _list(as_json=as_json)
        return
    code = carried_code(file) if show else set_trust(file, trusted=not remove)
    if as_json:
        print_json(_json_of(code))
    else:
        print_facts(_facts_of_code(code))


def _untrust(
    what: Annotated[
        str, typer.Argument(metavar="FILE|DIGEST", help="A recording, or a digest (8 digits may do).")
    ],
    as_json: Json = False,
) -> None:
    """Trust an environment no longer.

    FILE takes the environment in a recording, DIGEST one that `trust --list` shows.
    """
    from tupli_mcap.recording.carried import untrust

    digest, was_trusted = untrust(what)
    if as_json:
        print_json({"digest": digest, "was_trusted": was_trusted})
    else:
        print(f"{digest} {'is trusted no longer' if was_trusted else 'was not trusted'}")


def _list(*, as_json: bool) -> None:
    from tupli_mcap import trust

    digests = trust.trusted_digests()
    if as_json:
        print_json({"config_dir": str(trust.config_dir()), "digests": digests})
    else:
        print("\n".join(digests) or "nothing is trusted")


def _json_of(code: CarriedCode) -> dict[str, Any]:
    scan = None
    if code.scan is not None:
        scan = {**code.scan._asdict(), "imports": [one._asdict() for one in code.scan.imports]}
        scan["suspicious"] = code.scan.suspicious
    entry_points = [one._asdict() for one in code.entry_points]
    return {**code._asdict(), "entry_points": entry_points, "scan": scan}


def _facts_of_code(code: CarriedCode) -> list[tuple[str, str]]:
    runs = {
        "spec": "the registered environment, by its spec",
        "pickle": f"{bytes_of(code.size)} of pickled Python code",
    }
    if code.kind == "spec" and code.needs_trust:
        runs["spec"] = "code that its spec names"
    return [
        ("environment", code.name),
        ("runs", runs[code.kind]),
        *([("spec", code.spec)] if code.spec else []),
        *((one.of, f"{one.name}{_registered(one.name, one.here)}") for one in code.entry_points),
        *([("classes", ", ".join(code.classes))] if code.classes else []),
        *(_facts_of_scan(code.scan) if code.scan is not None else []),
        ("made with", ", ".join(f"{name} {version}" for name, version in code.versions.items())),
        ("digest", code.digest),
        *([("foreign", "; ".join(code.foreign))] if code.foreign and code.kind == "spec" else []),
        ("trusted", "yes" if code.trusted else "no" if code.needs_trust else "not needed"),
    ]


def _registered(name: str, here: str | None) -> str:
    if here is None:
        return ""
    return " (as registered here)" if here == name else f" (registered here: {here})"


def _facts_of_scan(scan: PickleScan) -> list[tuple[str, str]]:
    facts = []
    for verdict in ("dangerous", "unknown", "known"):
        names = [str(found) for found in scan.imports if found.verdict == verdict]
        facts.append((f"imports, {verdict}", _several(names)))
    facts += [
        ("calls", _several(scan.calls)),
        ("own code", _several([*(f"class {name}" for name in scan.classes), *scan.functions])),
        ("it mentions", _several(scan.uses)),
        ("not followed", _several(scan.problems)),
    ]
    return [(label, text) for label, text in facts if text]


def _several(texts: Any) -> str:
    shown = ", ".join(texts[:_SHOWN])
    return shown if len(texts) <= _SHOWN else f"{shown} and {len(texts) - _SHOWN} more (--json lists them)"
