"""Signing a recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from tupli_mcap import files, signing
from tupli_mcap.errors import SignatureError
from tupli_mcap.recording.check.signature import (
    Signature,
    check_readers,
    manifest,
    manifest_of_episodes,
    verify_signature,
)
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.edit.rewrite import rewrite_recording
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import SIGNATURE_MEDIA_TYPE, SIGNATURE_NAME, Signed


def sign_recording(path: str | os.PathLike[str], key: signing.SigningKey) -> Signature:
    """Adds the signature of a key to a finished recording, or replaces its signature; the file changes in one rename.

    Raises:
        SignatureError: the recording is not finished, or readers may see different contents in it.
        RecordingError, FormatError: it cannot be read or written.
    """
    with Recording(path) as recording:
        if not recording.complete:
            raise SignatureError(
                f"{recording.name}: only a finished recording can be signed; recover it first"
            )
        covered = manifest(recording)
        check_readers(recording, covered["attachments"], None)
        signed = Signed.make(covered, key)
    add_attachments(path, {SIGNATURE_NAME: (SIGNATURE_MEDIA_TYPE, signed.encode())})
    with Recording(path) as written:  # a signature that does not fit is worse than none
        return verify_signature(written)


def episodes_alike(first: Recording, second: Recording, numbers: Sequence[int], directory: Path) -> bool:
    """Whether the episodes with these numbers are equal in two recordings: steps, records, images, frames, times.

    `directory` is for temporary files: the episodes are written anew, since other episodes may lie between them. Raises
    FormatError for a damaged recording, RecordingError if the directory cannot be written to.
    """
    manifests = []
    for recording in (first, second):
        with files.private_directory(directory, shown=directory) as private:
            rewrite_recording(recording, private / "episodes", episodes=numbers)
            with Recording(private / "episodes") as written:
                manifests.append(manifest_of_episodes(written))
    return manifests[0] == manifests[1]
