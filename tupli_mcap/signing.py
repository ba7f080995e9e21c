"""Ed25519 keys: people sign bundles with their SSH keys, and trust those of others.

Public keys are 64 hex digits inside this package, and shown as `ssh-keygen -l` shows them. Reading OpenSSH's public
keys needs no other package; signing and checking need the extra `sign`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from tupli_mcap import trust
from tupli_mcap.errors import NotFoundError, SignatureError, missing_extra, os_reason

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

_MAX_KEY_FILE = 1 << 16
_SSH_HEAD = b"\0\0\0\x0bssh-ed25519\0\0\0\x20"  # the name of the algorithm and the length of a key
_SSH_LINE = re.compile(r"ssh-ed25519\s+([A-Za-z0-9+/]+=*)(?:\s+(.*))?\s*\Z")
_FINGERPRINT = re.compile(r"SHA256:[A-Za-z0-9+/]{43}\Z")


class PassphraseNeededError(SignatureError):
    """A private key is encrypted, and no passphrase or another one was given."""


class SigningKey:
    """A private Ed25519 key, of OpenSSH (`ssh-keygen -t ed25519`) or in PEM (PKCS #8).

    Args:
        path: the file.
        passphrase: of an encrypted key.

    Raises:
        SignatureError: there is no such file, or it holds another kind of key.
        PassphraseNeededError: the key is encrypted and the passphrase missing or wrong.
        MissingExtraError: the extra `sign` is not installed.
    """

    def __init__(self, path: str | os.PathLike[str], passphrase: str | None = None) -> None:
        self._key: Ed25519PrivateKey = _load_private(Path(path), passphrase)
        self.public_key = self._key.public_key().public_bytes_raw().hex()

    def sign(self, message: bytes) -> bytes:
        """The 64 bytes of a signature."""
        return self._key.sign(message)

    def __repr__(self) -> str:
        return f"<SigningKey {fingerprint(self.public_key)}>"


def is_signed(public_key: str, signature: bytes, message: bytes) -> bool:
    """Whether a signature of a message was made with the private half of a key; raises MissingExtraError if the extra
    `sign` is not installed."""
    exceptions, _, ed25519 = _cryptography()
    try:
        ed25519.Ed25519PublicKey.from_public_bytes(bytes.fromhex(public_key)).verify(signature, message)
    except (ValueError, exceptions.InvalidSignature):
        return False
    return True


def fingerprint(public_key: str) -> str:
    """`SHA256:...`, as `ssh-keygen -l` prints it."""
    digest = hashlib.sha256(_SSH_HEAD + bytes.fromhex(public_key)).digest()
    return f"SHA256:{base64.b64encode(digest).decode('ascii').rstrip('=')}"


def read_public_key(text: str, where: str = "the key") -> trust.TrustedKey:
    """A public key, as OpenSSH (`ssh-ed25519 AAAA... alice@host`, whose comment is its name) or PEM writes it. Raises
    SignatureError if it is something else."""
    line = _SSH_LINE.match(text.strip())
    if line is not None:
        try:
            blob = base64.b64decode(line[1], validate=True)
        except binascii.Error:
            blob = b""
        if blob.startswith(_SSH_HEAD) and len(blob) == len(_SSH_HEAD) + 32:
            return trust.TrustedKey(blob[len(_SSH_HEAD) :].hex(), (line[2] or "").strip())
    elif "-----BEGIN PUBLIC KEY-----" in text:
        exceptions, serialization, ed25519 = _cryptography()
        try:
            key = serialization.load_pem_public_key(text.encode())
        except (ValueError, exceptions.UnsupportedAlgorithm):
            key = None
        if isinstance(key, ed25519.Ed25519PublicKey):
            return trust.TrustedKey(key.public_bytes_raw().hex(), "")
    if "PRIVATE KEY" in text:
        raise SignatureError(f"{where}: expected a public key, found a private one; give its .pub file")
    raise SignatureError(
        f"{where}: expected a public Ed25519 key (`ssh-ed25519 AAAA...` or PEM), found {text.strip()[:40]!r}"
    )


def find_key(text: str) -> trust.TrustedKey:
    """A public key, given as the name or fingerprint of a trusted one, as the path of its file, or as its own text.

    A bare word is a name and never a file, unless it ends in `.pub`: somebody else may have put a file with that name
    into the working directory.

    Raises:
        NotFoundError: it is none of these, or several trusted keys have the name.
        SignatureError: the file holds something else.
    """
    known = [
        key for key in trust.trusted_keys() if text in (key.name, key.public_key, fingerprint(key.public_key))
    ]
    if len(known) == 1:
        return known[0]
    if len(known) > 1:
        raise NotFoundError(f"{len(known)} trusted keys are named {text!r}; give a fingerprint")
    if text.startswith("ssh-") or "-----BEGIN" in text:
        return read_public_key(text)
    path = Path(text)
    is_path = not _FINGERPRINT.match(text) and (text.endswith(".pub") or os.sep in text)
    if not is_path or not os.path.isfile(path):  # noqa: PTH113 - `Path.is_file` raises OSError for a long name
        raise NotFoundError(
            f"there is no trusted key {text!r} and no file of that name; `tupli-mcap trust --key FILE.pub --name NAME` "
            "adds one (a file is given as FILE.pub or ./FILE)"
        )
    return read_public_key(_read(path).decode("utf-8", "replace"), str(path))


def _load_private(path: Path, passphrase: str | None) -> Ed25519PrivateKey:
    exceptions, serialization, ed25519 = _cryptography()
    data = _read(path)
    load: Callable[..., Any] = serialization.load_pem_private_key
    if b"BEGIN OPENSSH PRIVATE KEY" in data:
        load = serialization.load_ssh_private_key
    try:
        key = load(data, password=None)
    except TypeError as err:  # it is encrypted
        if not passphrase:
            raise PassphraseNeededError(
                f"{path}: the key is encrypted, and needs a passphrase; pass passphrase= (TUPLI_MCAP_KEY_PASSPHRASE)"
            ) from err
        try:
            key = load(data, password=passphrase.encode())
        except (ValueError, exceptions.UnsupportedAlgorithm) as wrong:
            raise PassphraseNeededError(f"{path}: the passphrase does not open this key") from wrong
    except (ValueError, exceptions.UnsupportedAlgorithm) as err:
        raise SignatureError(
            f"{path}: expected a private Ed25519 key of OpenSSH or in PEM, found something else ({err}); "
            "`ssh-keygen -t ed25519` makes one"
        ) from err
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise SignatureError(
            f"{path}: expected an Ed25519 key, found {type(key).__name__}; `ssh-keygen -t ed25519` makes one"
        )
    return cast("Ed25519PrivateKey", key)


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_MAX_KEY_FILE)
    except FileNotFoundError as err:
        raise SignatureError(
            f"the key {str(path)!r} cannot be read: {err.strerror}; give the path of a key"
        ) from err
    except OSError as err:
        raise SignatureError(f"the key {str(path)!r} cannot be read: {os_reason(err)}") from err


def _cryptography() -> tuple[Any, Any, Any]:
    """The modules of `cryptography` that are used."""
    try:
        from cryptography import exceptions
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as err:
        raise missing_extra("signatures of bundles need the package cryptography", "sign") from err
    return exceptions, serialization, ed25519
