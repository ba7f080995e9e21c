"""Which environments this user's machine may rebuild by running code from a file.

A digest (the SHA-256 of an environment, see `tupli_mcap.environment`) is trusted when the user's own
configuration directory holds a signature of it, made with a secret key that never leaves that directory. A
file cannot bring its own trust along: copying a recording copies no signature.

The directory is `$TUPLI_MCAP_CONFIG_DIR`, else the platform's user configuration directory. It holds `key`
(32 random bytes, mode 0600) and `trusted/<digest>` (one signature each). Every write is one atomic rename or
link, so any number of processes may sign at once.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import re
import secrets
import stat
import tempfile
from pathlib import Path

import platformdirs

from tupli_mcap.errors import TupliError

__all__ = ["config_dir", "is_trusted", "sign", "trust", "trusted_digests", "untrust"]

_KEY_BYTES = 32
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")
# Names what is signed, so that the key can never be made to sign something else that looks like a digest.
_PURPOSE = b"tupli_mcap environment v1\0"


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
    return _signature(_key(create=True), digest)


def trust(digest: str) -> None:
    """Let this user's processes rebuild the environment of that digest; doing it twice is fine.

    Raises:
        TupliError: As `sign`, or the signature cannot be written.
    """
    signature = sign(digest)
    path = config_dir() / "trusted" / digest
    try:
        _make_private_dir(path.parent)
        _write(path, signature.encode("ascii"), replace=True)
    except OSError as err:
        raise TupliError(f"the signature {str(path)!r} cannot be written: {err}") from err


def untrust(digest: str) -> bool:
    """Forget a digest; returns whether it was trusted until now.

    Raises:
        TupliError: The digest is not 64 hex digits, or the signature cannot be removed.
    """
    known = is_trusted(digest)
    path = config_dir() / "trusted" / digest
    try:
        path.unlink(missing_ok=True)
    except OSError as err:
        raise TupliError(f"the signature {str(path)!r} cannot be removed: {err}") from err
    return known


def is_trusted(digest: str) -> bool:
    """Whether this user signed that digest. A missing key or signature, or one that does not fit, means no.

    Raises:
        TupliError: The digest is not 64 hex digits, or the key is open to other users.
    """
    _check_digest(digest)
    try:
        found = (config_dir() / "trusted" / digest).read_bytes()
    except OSError:
        return False
    key = _key(create=False)
    return key is not None and hmac.compare_digest(found, _signature(key, digest).encode("ascii"))


def trusted_digests() -> list[str]:
    """Every digest this user trusts, sorted."""
    try:
        names = [path.name for path in (config_dir() / "trusted").iterdir()]
    except OSError:
        return []
    return sorted(name for name in names if _DIGEST.match(name) and is_trusted(name))


def _check_digest(digest: str) -> None:
    # The digest becomes a file name: nothing but hex digits may pass.
    if not isinstance(digest, str) or not _DIGEST.match(digest):
        raise TupliError(f"expected a digest of 64 hex digits, found {str(digest)[:80]!r}")


def _signature(key: bytes | None, digest: str) -> str:
    _check_digest(digest)
    if key is None:
        raise TupliError(f"there is no key in {str(config_dir())!r}")
    return hmac.new(key, _PURPOSE + digest.encode("ascii"), hashlib.sha256).hexdigest()


def _key(*, create: bool) -> bytes | None:
    path = config_dir() / "key"
    try:
        return _read_key(path)
    except FileNotFoundError:
        if not create:
            return None
    except OSError as err:
        raise TupliError(f"the key {str(path)!r} cannot be read: {err}") from err
    try:
        _make_private_dir(path.parent)
        # The first process to link wins; the others read its key.
        with contextlib.suppress(FileExistsError):
            _write(path, secrets.token_bytes(_KEY_BYTES), replace=False)
        return _read_key(path)
    except OSError as err:
        raise TupliError(f"the key {str(path)!r} cannot be made: {err}") from err


def _read_key(path: Path) -> bytes:
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if os.name == "posix" and (status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077):
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


def _make_private_dir(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(mode=0o700, exist_ok=True)


def _write(path: Path, data: bytes, *, replace: bool) -> None:
    """Write a private file as a whole or not at all; `replace=False` raises FileExistsError if it exists."""
    fd, name = tempfile.mkstemp(prefix=".", dir=path.parent)  # mode 0600
    temporary = Path(name)
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if replace:
            temporary.replace(path)
        else:
            os.link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
