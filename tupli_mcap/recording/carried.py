"""The code that a recording carries: what rebuilding its environment would run, and trusting it."""

from __future__ import annotations

import json
import os
from typing import Any, Literal, NamedTuple

from tupli_mcap import trust
from tupli_mcap.environment._build import foreign_code
from tupli_mcap.recording.reader import Recording

__all__ = ["CarriedCode", "carried_code", "set_trust"]


class CarriedCode(NamedTuple):
    """An environment in a recording, as the file tells of it (`name`, `classes` and `versions` are claims).

    kind: "spec" (its JSON text is `spec`) or "pickle" (of `size` bytes).
    foreign: what of a spec this machine does not know; empty for a pickle, all of which is foreign.
    needs_trust: False for a spec without anything foreign. trusted: whether this user trusts the digest.
    """

    name: str
    kind: Literal["spec", "pickle"]
    spec: str
    size: int
    classes: tuple[str, ...]
    versions: dict[str, str]
    digest: str
    foreign: list[str]
    needs_trust: bool
    trusted: bool


def carried_code(path: str | os.PathLike[str]) -> CarriedCode:
    """What rebuilding a recording's environment would run; nothing is run.

    Raises:
        RecordingError: the recording carries no environment.
        FormatError: it is damaged.
    """
    with Recording(path) as recording:
        record = recording.benchmark.record
    spec: dict[str, Any] | None = None if record.spec is None else dict(record.spec)
    foreign = [] if spec is None else foreign_code(spec)
    return CarriedCode(
        record.name,
        "pickle" if spec is None else "spec",
        "" if spec is None else json.dumps(spec),
        len(record.pickle or b""),
        record.classes,
        dict(record.versions),
        record.digest,
        foreign,
        spec is None or bool(foreign),
        trust.is_trusted(record.digest),
    )


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
    return code._replace(trusted=trusted)
