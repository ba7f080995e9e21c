"""Keys for signatures, as `ssh-keygen` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization as ser
from cryptography.hazmat.primitives.asymmetric import ed25519

from tupli_mcap import signing


def write_key(path: Path, *, format: str = "ssh", passphrase: str | None = None) -> signing.SigningKey:
    """A new private key, and beside it `<name>.pub` as `ssh-keygen` writes it."""
    key = ed25519.Ed25519PrivateKey.generate()
    encryption: Any = ser.NoEncryption()
    if passphrase is not None:
        encryption = ser.BestAvailableEncryption(passphrase.encode())
    kind = ser.PrivateFormat.OpenSSH if format == "ssh" else ser.PrivateFormat.PKCS8
    path.write_bytes(key.private_bytes(ser.Encoding.PEM, kind, encryption))
    line = key.public_key().public_bytes(ser.Encoding.OpenSSH, ser.PublicFormat.OpenSSH)
    path.with_name(f"{path.name}.pub").write_bytes(line + b" " + path.stem.encode() + b"@lab\n")
    return signing.SigningKey(path, passphrase)
