"""The environments whose code from a file this user lets run, and the keys that the user trusts.

A digest (the SHA-256 of an environment, see `tupli_mcap.environment`) is trusted when the user's own
configuration directory holds a signature of it, made with a secret key that never leaves that directory. A
file cannot bring its own trust along: copying a recording copies no signature. The user may also trust other
people's public keys: what such a key has signed is trusted for as long as the key is.

The directory is `$TUPLI_MCAP_CONFIG_DIR`, else the platform's user configuration directory. It holds `key`
(32 random bytes, mode 0600), `trusted/<digest>` (one signature each), `keys/<public key>` (a signature and the
key's name) and `vouched/<digest>.<public key>`. Every write is one atomic rename or link, so any number of
processes may sign at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import re
import secrets
import stat
from pathlib import Path
from typing import NamedTuple

import platformdirs

from tupli_mcap import files
from tupli_mcap.errors import TupliError, os_reason

_KEY_BYTES = 32
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")
# Is signed with the digest, so that no signature made for another purpose passes for one of a digest.
_PURPOSE = b"tupli_mcap environment v1\0"
_PURPOSE_OF_KEYS = b"tupli_mcap public key v1\0"
_PURPOSE_OF_VOUCHERS = b"tupli_mcap voucher v1\0"
_MAX_FILE = 4096


class TrustedKey(NamedTuple):
    """Somebody's Ed25519 key: 64 hex digits, and the name this user gave it."""

    public_key: str
    name: str


def config_dir() -> Path:
    """The directory of this user's key and signatures; it need not exist yet."""
    override = os.environ.get("TUPLI_MCAP_CONFIG_DIR")
    return Path(override) if override else Path(platformdirs.user_config_path("tupli-mcap", appauthor=False))


def sign(digest: str) -> str:
    """The keyed signature (HMAC-SHA-256, 64 hex digits) of a digest; makes the key on first use.

    Raises:
        TupliError: The digest is not 64 hex digits, or the key cannot be made, read, or is open to other
        users.
    """
    _check_digest(digest)
    return _signed(_key(), _PURPOSE + digest.encode("ascii"))


def trust(digest: str) -> None:
    """Let this user's processes rebuild the environment of that digest; doing it twice is fine.

    Raises:
        TupliError: As `sign`, or the signature cannot be written.
    """
    _store(f"trusted/{digest}", sign(digest))


def untrust(digest: str) -> bool:
    """Forget a digest, and all keys' statements about it; returns whether it was trusted.

    Raises:
        TupliError: As `is_trusted`, or a signature cannot be removed.
    """
    known = is_trusted(digest)
    for path in (config_dir() / "trusted" / digest, *_vouchers(digest)):
        _remove(path)
    return known


def is_trusted(digest: str) -> bool:
    """Whether this user signed that digest, or a trusted key vouched for it. A missing key or signature, or one
    that does not fit, means no.

    Raises:
        TupliError: The digest is not 64 hex digits, or the user's key is damaged or open to other users.
    """
    _check_digest(digest)
    if _fits(config_dir() / "trusted" / digest, _PURPOSE + digest.encode("ascii")):
        return True
    believed = {key.public_key for key in trusted_keys()}
    return any(
        path.suffix[1:] in believed and _fits(path, _voucher(digest, path.suffix[1:]))
        for path in _vouchers(digest)
    )


def trusted_digests() -> list[str]:
    """Every digest this user trusts, sorted; those that keys vouched for when they were imported too. Raises as
    `is_trusted`."""
    names = {path.name for path in _listed("trusted")} | {path.stem for path in _listed("vouched")}
    return sorted(name for name in names if _DIGEST.match(name) and is_trusted(name))


# --- other people's keys ---


def trust_key(public_key: str, name: str) -> None:
    """Trust everything that this Ed25519 key (64 hex digits) signs; a second name replaces the first. Of the name, 200
    characters are kept, and blanks in a row are one.

    Raises:
        TupliError: It is no key, or cannot be noted.
    """
    _check_digest(public_key)
    # a surrogate stands for a byte of the command line that is no UTF-8
    text = " ".join(name.encode(errors="replace").decode().split())[:200]
    signature = _signed(_key(), _PURPOSE_OF_KEYS + public_key.encode("ascii") + text.encode())
    _store(f"keys/{public_key}", f"{signature} {text}")


def untrust_key(public_key: str) -> bool:
    """Trust a key no longer, and with it nothing that only the key vouched for; returns whether it was trusted.

    Raises:
        TupliError: It is no key or cannot be removed, or as `trusted_keys`.
    """
    _check_digest(public_key)
    known = any(key.public_key == public_key for key in trusted_keys())
    _remove(config_dir() / "keys" / public_key)
    for path in _listed("vouched"):
        if path.suffix[1:] == public_key:
            _remove(path)
    return known


def trusted_keys() -> list[TrustedKey]:
    """The keys this user trusts, by name. TupliError if the user's own key is damaged or open to other users."""
    found = []
    for path in _listed("keys"):
        if not _DIGEST.match(path.name):
            continue
        signature, _, name = _content(path).decode("utf-8", "replace").partition(" ")
        if _is_signature(signature, _PURPOSE_OF_KEYS + path.name.encode("ascii") + name.encode()):
            found.append(TrustedKey(path.name, name))
    return sorted(found, key=lambda key: (key.name, key.public_key))


def vouch(digest: str, public_key: str) -> None:
    """Trust a digest for as long as that key is trusted: the caller has checked the key's signature of it.

    Raises:
        TupliError: As `trust`.
    """
    _check_digest(digest)
    _check_digest(public_key)
    _store(f"vouched/{digest}.{public_key}", _signed(_key(), _voucher(digest, public_key)))


def _voucher(digest: str, public_key: str) -> bytes:
    return _PURPOSE_OF_VOUCHERS + digest.encode("ascii") + public_key.encode("ascii")


def _vouchers(digest: str) -> list[Path]:
    return [path for path in _listed("vouched") if path.stem == digest and _DIGEST.match(path.suffix[1:])]


# --- files ---


def _listed(directory: str) -> list[Path]:
    try:
        return list((config_dir() / directory).iterdir())
    except OSError:
        return []


def _content(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_MAX_FILE)
    except OSError:
        return b""


def _fits(path: Path, message: bytes) -> bool:
    return _is_signature(_content(path).decode("ascii", "replace"), message)


def _is_signature(text: str, message: bytes) -> bool:
    if not text:
        return False
    key = _known_key()
    return key is not None and hmac.compare_digest(text.encode(), _signed(key, message).encode("ascii"))


def _store(name: str, text: str) -> None:
    path = config_dir() / name
    try:
        _make_private_dir(path.parent)
        files.write_bytes(path, text.encode(), permissions=0o600)
    except OSError as err:
        raise TupliError(f"the signature {str(path)!r} cannot be written: {os_reason(err)}") from err


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as err:
        raise TupliError(f"the signature {str(path)!r} cannot be removed: {os_reason(err)}") from err


def _check_digest(digest: str) -> None:
    # The digest becomes a file name: nothing but hex digits may pass.
    if not isinstance(digest, str) or not _DIGEST.match(digest):
        raise TupliError(f"expected a digest of 64 hex digits, found {str(digest)[:80]!r}")


def _signed(key: bytes, message: bytes) -> str:
    return hmac.new(key, message, hashlib.sha256).hexdigest()


def _known_key() -> bytes | None:
    path = config_dir() / "key"
    try:
        return _read_key(path)
    except FileNotFoundError:
        return None
    except OSError as err:
        raise TupliError(f"the key {str(path)!r} cannot be read: {os_reason(err)}") from err


def _key() -> bytes:
    """This user's key, which is made on first use."""
    key, path = _known_key(), config_dir() / "key"
    if key is not None:
        return key
    try:
        _make_private_dir(path.parent)
        # The first process to link wins; the others read its key.
        with contextlib.suppress(FileExistsError):
            files.write_bytes(path, secrets.token_bytes(_KEY_BYTES), overwrite=False, permissions=0o600)
        return _read_key(path)
    except OSError as err:
        raise TupliError(f"the key {str(path)!r} cannot be made: {os_reason(err)}") from err


def _read_key(path: Path) -> bytes:
    _check_private(path.parent)
    # A link could lead to a file whose content somebody else knows.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW), "rb") as file:
        status = os.fstat(file.fileno())
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise TupliError(
                f"the key {str(path)!r} must belong to you alone: expected mode 0600, found "
                f"{stat.S_IMODE(status.st_mode):04o} of user {status.st_uid}; chmod it, or delete it"
            )
        key = file.read(_KEY_BYTES + 1)
    if len(key) != _KEY_BYTES:
        raise TupliError(
            f"the key {str(path)!r} must have {_KEY_BYTES} bytes, found {len(key)}: delete it and sign anew"
        )
    return key


def _check_private(directory: Path) -> None:
    """Who may write into the directory could put a key of their own there."""
    status = directory.stat()
    if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o022:
        raise TupliError(
            f"the directory {str(directory)!r} must be writable by you alone: found mode "
            f"{stat.S_IMODE(status.st_mode):04o} of user {status.st_uid}; chmod it to 0700, or set "
            "TUPLI_MCAP_CONFIG_DIR"
        )


def _make_private_dir(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700, exist_ok=True)
    if path != config_dir() and stat.S_IMODE(path.stat().st_mode) & 0o077:
        path.chmod(0o700)
