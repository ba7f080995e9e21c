"""The attachment `signature.ed25519`, and the checks of a signature that need no step."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, Field, JsonValue, ValidationError

from tupli_mcap import signing, trust
from tupli_mcap.environment import DOCUMENT_NAME, PICKLE_NAME, canonical_json
from tupli_mcap.errors import FormatError

SIGNATURE_NAME = "signature.ed25519"
SIGNATURE_MEDIA_TYPE = "application/json"
# Attachments that anybody may add at any time, so no signature covers them.
STATEMENTS = (SIGNATURE_NAME, "replay-certificate.json")
_MAX_BYTES = 16 << 20
# Is signed with the manifest, so that no signature made for another purpose passes for one of a manifest.
_PURPOSE = b"tupli_mcap signature v1\0"
_HEX_KEY = r"^[0-9a-f]{64}$"
# An environment is rebuilt from these, or they say something about runs and episodes: they must be signed. Other
# attachments may be added later.
_COVERED_KINDS = (DOCUMENT_NAME, PICKLE_NAME, "artifacts/", "run.json", "annotations.json", "made_of.json")


class _Document(BaseModel):
    format: Literal["tupli_mcap.signature"]
    version: Literal[1]
    algorithm: Literal["ed25519"]
    public_key: str = Field(pattern=_HEX_KEY)
    signature: str = Field(pattern=r"^[0-9a-f]{128}$")
    manifest: dict[str, JsonValue]


class Signed(NamedTuple):
    """A manifest (JSON values, see `schemas/signature.schema.json`) and a signature of it (64 bytes)."""

    public_key: str
    signature: bytes
    manifest: Mapping[str, Any]

    @classmethod
    def make(cls, manifest: Mapping[str, Any], key: signing.SigningKey) -> Signed:
        """Signs a manifest."""
        return cls(key.public_key, key.sign(_PURPOSE + canonical_json(manifest)), manifest)

    def fits(self) -> bool:
        """Whether the key made this signature of this manifest."""
        return signing.is_signed(self.public_key, self.signature, _PURPOSE + canonical_json(self.manifest))

    def encode(self) -> bytes:
        """The attachment's bytes."""
        document = {
            "format": "tupli_mcap.signature",
            "version": 1,
            "algorithm": "ed25519",
            "public_key": self.public_key,
            "signature": self.signature.hex(),
            "manifest": self.manifest,
        }
        return json.dumps(document, indent=2).encode("ascii")

    @classmethod
    def decode(cls, data: bytes, where: str) -> Signed:
        """Parses the attachment; raises FormatError if the bytes are no signature."""
        if len(data) > _MAX_BYTES:
            raise FormatError(
                f"{where}: expected a signature of at most {_MAX_BYTES} bytes, found {len(data)}"
            )
        try:
            document = _Document.model_validate_json(data)
            canonical_json(document.manifest)
        except ValidationError as err:
            first = err.errors(include_url=False, include_input=False)[0]
            place = ".".join(str(part) for part in first["loc"]) or "the document"
            raise FormatError(
                f"{where}: {SIGNATURE_NAME} is not a signature: {place}: {first['msg']}"
            ) from err
        except (ValueError, RecursionError) as err:
            raise FormatError(f"{where}: {SIGNATURE_NAME}: its manifest is not strict JSON: {err}") from err
        return cls(document.public_key, bytes.fromhex(document.signature), document.manifest)


def voucher(signature: bytes, digest: str, where: str) -> trust.TrustedKey | None:
    """The trusted key that signed an environment; None if there is none. Only the manifest is checked.

    `signature` is the attachment, `digest` computed from the environment that would be rebuilt. Raises
    MissingExtraError if a trusted key would have to be checked, and the extra `sign` is not installed.
    """
    try:
        signed = Signed.decode(signature, where)
    except FormatError:
        return None
    known = {key.public_key: key for key in trust.trusted_keys()}
    if signed.public_key not in known or signed.manifest.get("environment") != digest:
        return None
    return known[signed.public_key] if signed.fits() else None


def is_covered_kind(name: str) -> bool:
    """Whether a signature must cover an attachment of that name."""
    return name.startswith(_COVERED_KINDS)


def stays_signed(present: Iterable[str], added: Iterable[str]) -> bool:
    """Whether a signature still fits after attachments are added: they replace none, and need not be signed."""
    before = set(present).difference(STATEMENTS)
    return not any(name in before or is_covered_kind(name) for name in added)
