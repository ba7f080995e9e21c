"""The parts of a recording that need trust: its environment's code, and options of resets that are more than data."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple

import gymnasium as gym

from tupli_mcap import jsonvalue, trust
from tupli_mcap.environment import (
    DOCUMENT_NAME,
    canonical_json,
    entry_point_name,
    more_than_data,
    reasons_for_distrust,
    sha256,
)
from tupli_mcap.errors import MissingExtraError, NotFoundError, SignatureError
from tupli_mcap.files import is_there
from tupli_mcap.recording.check.signature import verify_signature
from tupli_mcap.recording.describe.description import claimed_signer
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME

_DIGEST = re.compile(r"[0-9a-f]{64}\Z")
_MAX_OPTIONS = 20  # that are shown


class EntryPoint(NamedTuple):
    """Code that a spec names as `module:attribute`.

    `here` is the entry point that this machine has registered under the environment's id; None if there is none, or for
    a wrapper, which is not registered.
    """

    of: Literal["environment", "wrapper"]
    name: str
    here: str | None


class CarriedCode(NamedTuple):
    """The environment in a recording, as the file describes it; `name`, `classes` and `versions` are claims.

    Attributes:
        kind: "spec" (its JSON text is `spec`, the code it names `entry_points`), "pickle" (of `size` bytes, which may
            import and run anything) or "names" (nothing can rebuild it).
        foreign: the code that would run and that this machine does not know; empty if building it needs no trust.
        options: the parts of its resets' options that are more than data; replaying would pass them to the environment.
        needs_trust: it is built, or given all options, only if the user trusts it.
        trusted: this user trusts the digests, or the key that signed it.
        options_digest: of the environment and those options; None if there are none.
        signed_by: the fingerprint of the key that the signature names, unchecked; None if it is not signed.
        signer: the name this user gave that key, if it is trusted here and signed this very environment.
    """

    name: str
    kind: Literal["spec", "pickle", "names"]
    spec: str
    entry_points: list[EntryPoint]
    size: int
    classes: tuple[str, ...]
    versions: dict[str, str]
    digest: str
    foreign: list[str]
    options: list[str]
    options_digest: str | None
    needs_trust: bool
    trusted: bool
    signed_by: str | None
    signer: str | None


def carried_code(path: str | os.PathLike[str]) -> CarriedCode:
    """Describes what rebuilding a recording's environment would run, and the options it would get; runs nothing.

    Raises:
        RecordingError: the recording carries no environment.
        FormatError: it is damaged.
    """
    with Recording(path) as recording:
        benchmark = recording.benchmark
        signed_by = claimed_signer(recording)
        options = _foreign_options(recording)
        given = options_are_trusted(recording) if options else True
    record = benchmark.record
    voucher = benchmark.voucher if signed_by is not None else None
    spec: dict[str, Any] | None = None if record.spec is None else dict(record.spec)
    foreign = reasons_for_distrust(record)
    return CarriedCode(
        name=record.name,
        kind="spec" if spec is not None else "pickle" if record.pickle is not None else "names",
        spec="" if spec is None else json.dumps(spec),
        entry_points=[] if spec is None else _entry_points(spec),
        size=len(record.pickle or b""),
        classes=record.classes,
        versions=dict(record.versions),
        digest=record.digest,
        foreign=foreign,
        options=list(dict.fromkeys(options.values()))[:_MAX_OPTIONS],
        options_digest=_options_digest(record.digest, options) if options else None,
        needs_trust=bool(foreign or options),
        trusted=(trust.is_trusted(record.digest) or voucher is not None) and given,
        signed_by=signed_by,
        signer=None if voucher is None else voucher.name or "no name",
    )


def _entry_points(spec: dict[str, Any]) -> list[EntryPoint]:
    registered = gym.registry.get(str(spec.get("id")))
    here = None if registered is None else str(entry_point_name(registered.entry_point))
    points = [EntryPoint("environment", str(spec.get("entry_point")), here)]
    wrappers = spec.get("additional_wrappers")
    for wrapper in wrappers if isinstance(wrappers, list) else ():
        name = wrapper.get("entry_point") if isinstance(wrapper, dict) else wrapper
        points.append(EntryPoint("wrapper", str(name), None))
    return points


def set_trust(path: str | os.PathLike[str], *, trusted: bool) -> CarriedCode:
    """Trusts the environment of a recording, and the options of its resets, on this machine, or withdraws that trust;
    returns their description.

    Raises:
        RecordingError: the recording carries no environment.
        TupliError: the signature cannot be written.
    """
    code = carried_code(path)
    for digest in (code.digest, code.options_digest):
        if digest is not None:
            (trust.trust if trusted else trust.untrust)(digest)
    return code._replace(trusted=trusted or carried_code(path).trusted)


def untrust(what: str) -> tuple[str, bool]:
    """Withdraws the trust in an environment, given as a recording or as a digest (its first 8 digits or more).

    Returns:
        The digest, and whether it was trusted.

    Raises:
        NotFoundError: no trusted environment, or several, have a digest that starts like this.
        RecordingError, FormatError: as `carried_code`.
    """
    if is_there(what) or not re.fullmatch(r"[0-9a-f]{8,64}", what):
        code = carried_code(what)
        digest = code.digest
        if code.options_digest is not None:
            trust.untrust(code.options_digest)
    elif _DIGEST.match(what):
        digest = what
    else:
        digests = [digest for digest in trust.trusted_digests() if digest.startswith(what)]
        if len(digests) != 1:
            raise NotFoundError(
                f"{len(digests) or 'no'} trusted environments have a digest that starts with {what!r}; "
                "`tupli-mcap trust --list` shows them"
            )
        (digest,) = digests
    return digest, trust.untrust(digest)


def foreign_options(text: str) -> str:
    """The part of a reset's options (exact JSON, empty for none) that is more than data, as for arguments of a spec."""
    return more_than_data(jsonvalue.loads(text)) if text else ""


def options_are_trusted(recording: Recording) -> bool:
    """Whether this user trusts the options of a recording's resets: exactly these with this environment, or the key
    that signed the whole recording.

    Trust in the environment alone is not enough: a stranger may record the same environment with other options.
    """
    carried = DOCUMENT_NAME in recording.attachments
    digest = recording.benchmark.record.digest if carried else ""
    if trust.is_trusted(_options_digest(digest, _foreign_options(recording))):
        return True
    if SIGNATURE_NAME not in recording.attachments or not trust.trusted_keys():
        return False
    try:
        return verify_signature(recording).trusted
    except (SignatureError, MissingExtraError):
        return False


def _foreign_options(recording: Recording) -> dict[str, str]:
    """The options (texts) that hold more than data, each with that part."""
    foreign: dict[str, str] = {}
    seen = {""}
    for position in range(len(recording)):
        for reset in (*recording.resets_before(position), recording.episode_start(position)):
            if reset.options not in seen:
                seen.add(reset.options)
                why = foreign_options(reset.options)
                if why:
                    foreign[reset.options] = why
    return foreign


def _options_digest(environment: str, options: Iterable[str]) -> str:
    return sha256(canonical_json({"environment": environment, "options": sorted(options)}))
