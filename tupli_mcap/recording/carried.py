"""The code that a recording carries: what rebuilding its environment would run, and trusting it."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium as gym

from tupli_mcap import trust
from tupli_mcap.environment import PickleImports, named_imports, reasons_for_distrust
from tupli_mcap.errors import NotFoundError
from tupli_mcap.recording.reader import Recording
from tupli_mcap.recording.signed import claimed_signer

__all__ = ["CarriedCode", "EntryPoint", "carried_code", "set_trust", "untrust"]

_DIGEST = re.compile(r"[0-9a-f]{64}\Z")


class EntryPoint(NamedTuple):
    """Code that a spec names: `name` is `module:attribute`. here: what this machine has registered under the
    environment's id (None: nothing, or a wrapper, which is not registered)."""

    of: Literal["environment", "wrapper"]
    name: str
    here: str | None


class CarriedCode(NamedTuple):
    """An environment in a recording, as the file tells of it (`name`, `classes` and `versions` are claims).

    kind: "spec" (its JSON text is `spec`, the code it names `entry_points`) or "pickle" (of `size` bytes, whose
        instructions name `imports`; it may import and run anything).
    foreign: what would run that this machine does not know; empty if it needs no trust.
    needs_trust: whether it is built only where somebody trusts it. trusted: whether this user trusts the digest,
        or the key that signed it.
    signed_by: the fingerprint of the key that the file says has signed it; None if it is not signed.
    signer: what this user calls that key, if it is trusted here and has signed this very environment.
    """

    name: str
    kind: Literal["spec", "pickle"]
    spec: str
    entry_points: list[EntryPoint]
    size: int
    imports: PickleImports | None
    classes: tuple[str, ...]
    versions: dict[str, str]
    digest: str
    foreign: list[str]
    needs_trust: bool
    trusted: bool
    signed_by: str | None
    signer: str | None


def carried_code(path: str | os.PathLike[str]) -> CarriedCode:
    """What rebuilding a recording's environment would run; nothing is run.

    Raises:
        RecordingError: the recording carries no environment.
        FormatError: it is damaged.
    """
    with Recording(path) as recording:
        benchmark = recording.benchmark
        signed_by = claimed_signer(recording)
    record = benchmark.record
    voucher = benchmark.voucher if signed_by is not None else None
    spec: dict[str, Any] | None = None if record.spec is None else dict(record.spec)
    foreign = reasons_for_distrust(record)
    return CarriedCode(
        name=record.name,
        kind="pickle" if spec is None else "spec",
        spec="" if spec is None else json.dumps(spec),
        entry_points=[] if spec is None else _entry_points(spec),
        size=len(record.pickle or b""),
        imports=None if record.pickle is None else named_imports(record.pickle),
        classes=record.classes,
        versions=dict(record.versions),
        digest=record.digest,
        foreign=foreign,
        needs_trust=bool(foreign),
        trusted=trust.is_trusted(record.digest) or voucher is not None,
        signed_by=signed_by,
        signer=None if voucher is None else voucher.name or "no name",
    )


def _entry_points(spec: dict[str, Any]) -> list[EntryPoint]:
    known = gym.registry.get(str(spec.get("id")))
    here = None if known is None else str(known.entry_point)
    found = [EntryPoint("environment", str(spec.get("entry_point")), here)]
    wrappers = spec.get("additional_wrappers")
    for wrapper in wrappers if isinstance(wrappers, list) else ():
        name = wrapper.get("entry_point") if isinstance(wrapper, dict) else wrapper
        found.append(EntryPoint("wrapper", str(name), None))
    return found


def set_trust(path: str | os.PathLike[str], *, trusted: bool) -> CarriedCode:
    """Trusts the environment of a recording on this machine, or no longer; returns what it is about.

    Raises:
        RecordingError: the recording carries no environment.
        TupliError: the signature cannot be written.
    """
    code = carried_code(path)
    if trusted:
        trust.trust(code.digest)
    else:
        trust.untrust(code.digest)
    return code._replace(trusted=trusted or code.signer is not None)


def untrust(what: str) -> tuple[str, bool]:
    """Trusts an environment no longer, given as a recording or as a digest (its first 8 digits or more will do).

    Returns:
        The digest, and whether it was trusted.

    Raises:
        NotFoundError: no trusted environment, or several, have a digest that starts so.
        RecordingError, FormatError: as `carried_code`.
    """
    if Path(what).exists() or not re.fullmatch(r"[0-9a-f]{8,64}", what):
        digest = carried_code(what).digest
    elif _DIGEST.match(what):
        digest = what
    else:
        found = [digest for digest in trust.trusted_digests() if digest.startswith(what)]
        if len(found) != 1:
            raise NotFoundError(
                f"{len(found) or 'no'} trusted environments have a digest that starts with {what!r}; "
                "`tupli-mcap trust --list` shows them"
            )
        (digest,) = found
    return digest, trust.untrust(digest)
