"""The certificate inside a recording: the attachment `replay-certificate.json`."""

from __future__ import annotations

import os
from pathlib import Path

from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.attach import add_attachments
from tupli_mcap.replay.certificate import Certificate
from tupli_mcap.replay.facts import content_digest

__all__ = ["CERTIFICATE_NAME", "covers", "read_certificate", "write_certificate"]

CERTIFICATE_NAME = "replay-certificate.json"
_MAX_BYTES = 16 << 20


def write_certificate(path: str | os.PathLike[str], certificate: Certificate) -> None:
    """Puts a certificate into the recording it is about, in place of an older one. Nothing else in the file changes.

    Raises:
        RecordingError: it is about another recording or an older state of this one, the recording is not finished or is
            being written, or it cannot be written.
    """
    path = Path(path)
    with Recording(path) as recording:
        if not covers(certificate, recording):
            raise RecordingError(
                f"{path}: expected a certificate of its {len(recording)} episodes, found one of recording "
                f"{certificate.recording} with {certificate.recorded.episodes}; replay it again"
            )
    add_attachments(path, {CERTIFICATE_NAME: ("application/json", certificate.to_json())})


def read_certificate(recording: Recording) -> Certificate | None:
    """The certificate a recording carries, None if there is none. It is what the file says, no proof of it:
    `certify` replays the recording again.

    Raises:
        FormatError: it is none, or damaged.
    """
    known = recording.attachments.get(CERTIFICATE_NAME)
    if known is None:
        return None
    where = f"{recording.name}: {CERTIFICATE_NAME}"
    if known.size > _MAX_BYTES:
        raise FormatError(f"{where}: expected at most {_MAX_BYTES} bytes, found {known.size}")
    return Certificate.from_json(recording.read_attachment(CERTIFICATE_NAME), where=where)


def covers(certificate: Certificate, recording: Recording) -> bool:
    """Whether a recording still holds the episodes that a certificate was made of, by their facts in the index."""
    return certificate.recording == recording.uuid and certificate.content_sha256 == content_digest(recording)
