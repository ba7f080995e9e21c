"""Checks a signature against everything that it covers.

The manifest covers the contents a reader sees, not the bytes of the file: others may compress chunks anew. Attachments
that were added after signing (a replay certificate, a quality card) are listed as not covered.
"""

from __future__ import annotations

import hashlib
from collections.abc import Container, Mapping
from typing import Any, NamedTuple

from tupli_mcap import signing, trust
from tupli_mcap.environment import DOCUMENT_NAME, canonical_json, sha256
from tupli_mcap.errors import FormatError, SignatureError
from tupli_mcap.recording.check.report import Findings, VerifyReport
from tupli_mcap.recording.check.structure import Structure
from tupli_mcap.recording.contents import RECORDING_METADATA
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.opened import OpenFile
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.recover.damaged import read_file_end
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, STATEMENTS, Signed, is_covered_kind

# Keys of the metadata that are signed; the others depend on how the file was written.
_IDENTITY = ("uuid", "format_version", "library", "created_ns", "benchmark_id")


class Signature(NamedTuple):
    """A signature that fits its recording.

    Attributes:
        public_key: of the signer, 64 hex digits.
        fingerprint: of the key, as `ssh-keygen -l` shows it.
        name: the name this user gave the key; None if the key is not trusted here.
        environment: the digest of the signed environment; None if the recording carries none.
        not_covered: attachments that were added after signing, or that others may replace (a replay certificate).
    """

    public_key: str
    fingerprint: str
    name: str | None
    environment: str | None
    not_covered: tuple[str, ...]

    @property
    def trusted(self) -> bool:
        """Whether this user trusts the key."""
        return self.name is not None


def verify_signature(recording: Recording, walk: Structure | None = None) -> Signature:
    """Checks the signature of a finished recording against everything it covers; reads all chunks.

    `walk` is a `Structure` of the file that has run, if there is one.

    Raises:
        SignatureError: there is none, or it does not fit; the message says what was changed.
        FormatError: the file is damaged.
        MissingExtraError: the extra `sign` is not installed.
    """
    name = recording.name
    if SIGNATURE_NAME not in recording.attachments:
        raise SignatureError(f"{name} is not signed; ask for a bundle made with `tupli-mcap bundle --sign`")
    signed = Signed.decode(recording.read_attachment(SIGNATURE_NAME), name)
    fingerprint = signing.fingerprint(signed.public_key)
    if not signed.fits():
        raise SignatureError(f"{name}: its signature was not made by the key {fingerprint} that it names")
    if not recording.complete:
        raise SignatureError(
            f"{name}: expected a finished recording, as all signed ones are, found an unfinished one"
        )
    current = manifest(recording)
    _compare(signed.manifest, current, f"{name}, signed by {fingerprint}")
    check_readers(recording, current["attachments"], walk)
    names = {key.public_key: key.name for key in trust.trusted_keys()}
    not_covered = tuple(
        sorted(recording.attachments.keys() - {*signed.manifest["attachments"], SIGNATURE_NAME})
    )
    return Signature(
        signed.public_key, fingerprint, names.get(signed.public_key), current["environment"], not_covered
    )


def manifest(recording: Recording) -> dict[str, Any]:
    """The manifest of the file as it is."""
    carried = DOCUMENT_NAME in recording.attachments
    return {
        "format": "tupli_mcap.manifest",
        "version": 1,
        **manifest_of_episodes(recording),
        "environment": recording.benchmark.record.digest if carried else None,
        "attachments": {
            name: sha256(recording.read_attachment(name))
            for name in sorted(recording.attachments)
            if name not in STATEMENTS
        },
    }


def manifest_of_episodes(recording: Recording) -> dict[str, Any]:
    """The part of the manifest about episodes."""
    contents = recording.file.contents
    index = contents.index
    return {
        "recording": {key: recording.metadata[key] for key in _IDENTITY if key in recording.metadata},
        "channels": {str(number): _channel(recording.file, number) for number in sorted(contents.channels)},
        "episodes": {
            "count": len(index.episodes),
            "sha256": sha256(index.episodes.tobytes() + index.metadata),
        },
    }


def _channel(file: OpenFile, number: int) -> dict[str, Any]:
    """A channel's topic, number of messages, and digest of its definition and all its message records in order."""
    channel = file.contents.channels[number]
    schema = file.contents.schemas.get(channel.schema_id)
    definition = {
        "topic": channel.topic,
        "encoding": channel.message_encoding,
        "metadata": {key: value for key, value in channel.metadata.items() if key != "crc"},
        "schema": None if schema is None else [schema.name, schema.encoding, sha256(schema.data)],
    }
    digest = hashlib.sha256(canonical_json(definition))
    for chunk in file.store.chunks(number):
        digest.update(file.store.load(chunk, keep=False))
    return {"topic": channel.topic, "messages": file.store.count(number), "sha256": digest.hexdigest()}


def check_readers(recording: Recording, covered: Container[str], walk: Structure | None) -> None:
    """Raises SignatureError unless other readers see what was hashed.

    They use the definitions in the chunks, the summary's indexes, or the order of the file. So all of these must agree,
    and nothing `covered` may be there twice.
    """
    if walk is None:
        source = recording.file.source
        walk = Structure(source, read_file_end(source), Findings(VerifyReport(recording.name)))
        walk.run()
    wrong = [problem.message + f" ({problem.place})" * bool(problem.place) for problem in walk.report.errors]
    wrong += [
        f"{name!r:.100} is in it twice"
        for name in sorted(walk.repeated)
        if name in covered or is_covered_kind(name) or name in (INDEX_NAME, RECORDING_METADATA)
    ]
    if wrong:
        raise SignatureError(
            f"{recording.name}: other readers may see other data than what was signed: {wrong[0]}; "
            "ask its signer for another copy, or write it again with tupli-mcap bundle"
        )


def _compare(signed: Mapping[str, Any], current: Mapping[str, Any], where: str) -> None:
    """Raises SignatureError at the first difference; new attachments are allowed if no environment is rebuilt from
    them."""
    for part in ("format", "version", "recording", "environment"):
        if signed.get(part) != current[part]:
            raise SignatureError(
                f"{where}: its {part} was changed: expected {signed.get(part)!r:.100}, found {current[part]!r:.100}"
            )
    for part, noun in (("attachments", "attachment"), ("channels", "channel")):
        expected = signed.get(part)
        if not isinstance(expected, dict):
            raise FormatError(f"{where}: the manifest lists no {part}")
        for name, value in expected.items():
            if name not in current[part]:
                raise SignatureError(f"{where}: the {noun} {name!r:.100} that was signed is missing")
            if current[part][name] != value:
                raise SignatureError(
                    f"{where}: the {noun} {_named(current[part][name], name)} was changed after signing"
                )
        for name in current[part].keys() - expected.keys():
            if part == "channels" or is_covered_kind(name):
                raise SignatureError(
                    f"{where}: the {noun} {_named(current[part][name], name)} was added after signing"
                )
    if signed.get("episodes") != current["episodes"]:
        raise SignatureError(f"{where}: the episode index was changed after signing")


def _named(value: Any, name: str) -> str:
    return repr(value["topic"] if isinstance(value, dict) else name)[:100]
