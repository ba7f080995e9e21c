"""The commands trust and untrust: which environments in files may be rebuilt, and what that would run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.options import Json, local_path
from tupli_mcap.cli.output import print_facts, print_json, print_result
from tupli_mcap.errors import bytes_of

if TYPE_CHECKING:
    from tupli_mcap.recording.sign.carried_code import CarriedCode


def trust(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="A recording.", parser=local_path)
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Only show what rebuilding would run.")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Stop trusting it.")] = False,
    key: Annotated[
        str | None,
        typer.Option("--key", metavar="KEY", help="Trust what this public key signs (a .pub file)."),
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="A name for the key.")] = None,
    listed: Annotated[bool, typer.Option("--list", help="Only list what is trusted.")] = False,
    as_json: Json = False,
) -> None:
    """Allow the environment in a file to be rebuilt.

    Rebuilding may run code from the file with your rights on this machine; so may reset
    options that name files or code. --show prints what the file says about that code, and
    runs nothing. Trust is yours only, and ends when a byte of the environment changes.
    Reading episodes needs no trust. --key trusts every environment that this key signs (see
    bundle --sign).
    """
    from tupli_mcap.recording.sign.carried_code import carried_code, set_trust

    if sum((show, remove, listed, key is not None)) > 1:
        raise typer.BadParameter("--show, --remove, --list and --key exclude each other")
    if (listed or key is not None) != (file is None):
        raise typer.BadParameter(
            "expected a FILE, --list or --key" if file is None else "--list and --key take no FILE"
        )
    if name is not None and key is None:
        raise typer.BadParameter("--name goes with --key")
    if file is None:
        _list(as_json=as_json) if key is None else _trust_key(key, name, as_json=as_json)
        return
    code = carried_code(file) if show else set_trust(file, trusted=not remove)
    if as_json:
        print_json(code)
    else:
        print_facts(_facts_of_code(code))


def _trust_key(text: str, name: str | None, *, as_json: bool) -> None:
    from tupli_mcap import trust
    from tupli_mcap.signing import find_key, fingerprint

    key = find_key(text)
    trust.trust_key(key.public_key, name or key.name)
    told = {"fingerprint": fingerprint(key.public_key), "name": name or key.name}
    print_result(told, f"what {told['fingerprint']} {told['name']} signs is trusted", as_json=as_json)


def untrust(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[FILE|DIGEST]", help="A recording, or a digest; its first 8 digits are enough."
        ),
    ] = None,
    key: Annotated[
        str | None, typer.Option("--key", metavar="KEY", help="A key: its name, fingerprint or .pub file.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Stop trusting an environment or a key.

    FILE is a recording with the environment; `trust --list` shows each DIGEST. With a key,
    every environment that only this key signed is not trusted any more either.
    """
    from tupli_mcap import trust
    from tupli_mcap.recording.sign.carried_code import untrust
    from tupli_mcap.signing import find_key, fingerprint

    if (what is None) == (key is None):
        raise typer.BadParameter("expected either a FILE or DIGEST, or --key")
    digest = signer = None
    if key is not None:
        trusted_key = find_key(key)
        signer = fingerprint(trusted_key.public_key)
        was_trusted = trust.untrust_key(trusted_key.public_key)
    else:
        digest, was_trusted = untrust(what or "")
    print_result(
        {"digest": digest, "fingerprint": signer, "was_trusted": was_trusted},
        f"{digest or signer} {'is not trusted any more' if was_trusted else 'was not trusted'}",
        as_json=as_json,
    )


def _list(*, as_json: bool) -> None:
    from tupli_mcap import trust
    from tupli_mcap.signing import fingerprint

    digests = trust.trusted_digests()
    keys = [{"fingerprint": fingerprint(key.public_key), "name": key.name} for key in trust.trusted_keys()]
    lines = [f"environment  {digest}" for digest in digests]
    lines += [f"key          {key['fingerprint']} {key['name']}" for key in keys]
    told = {"config_dir": trust.config_dir(), "digests": digests, "keys": keys}
    print_result(told, *(lines or ["nothing is trusted"]), as_json=as_json)


def _facts_of_code(code: CarriedCode) -> list[tuple[str, str]]:
    runs = {
        "spec": "the registered environment, by its spec",
        "pickle": f"{bytes_of(code.size)} of pickled Python code",
        "names": "nothing: the file only names it",
    }
    if code.kind == "spec" and code.foreign:
        runs["spec"] = "code that its spec names"
    return [
        ("environment", code.name),
        ("runs", runs[code.kind]),
        ("spec", code.spec),
        *((one.of, f"{one.name}{_registered(one.name, one.here)}") for one in code.entry_points),
        ("classes", ", ".join(code.classes)),
        ("warning", "loading this pickle can run any code" if code.kind == "pickle" else ""),
        ("made with", ", ".join(f"{name} {version}" for name, version in code.versions.items())),
        ("digest", code.digest),
        ("foreign", "; ".join(code.foreign) if code.kind == "spec" else ""),
        *(("options", f"of a reset hold {why}") for why in code.options),
        ("signed by", " ".join(filter(None, (code.signed_by, code.signer and f"({code.signer})")))),
        ("trusted", _trusted(code)),
    ]


def _trusted(code: CarriedCode) -> str:
    if not code.needs_trust:
        return "not needed"
    if code.trusted and code.signer:
        return f"yes, while the key of {code.signer} is trusted"
    return "yes" if code.trusted else "no"


def _registered(name: str, here: str | None) -> str:
    if here is None:
        return ""
    return " (as registered here)" if here == name else f" (registered here: {here})"
