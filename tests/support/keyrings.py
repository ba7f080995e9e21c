"""A keyring in memory, instead of the system's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import keyring
import keyring.backend
import keyring.errors

__all__ = ["Keyring", "keyring_in_memory"]


class Keyring(keyring.backend.KeyringBackend):
    """Keeps secrets in memory; while `locked`, returns and takes none."""

    priority = -1.0  # never the default one, for which each class that is defined comes into question

    def __init__(self) -> None:
        super().__init__()
        self.priority = 5.0
        self.kept: dict[tuple[str, str], str] = {}
        self.locked = False

    def _check(self) -> None:
        if self.locked:
            raise keyring.errors.KeyringLocked("secret words of the system")

    def get_password(self, service: str, username: str) -> str | None:
        self._check()
        return self.kept.get((service, username))

    def set_password(self, service: str, username: str, password: str) -> None:
        self._check()
        self.kept[service, username] = password

    def delete_password(self, service: str, username: str) -> None:
        self._check()
        del self.kept[service, username]


@contextlib.contextmanager
def keyring_in_memory() -> Iterator[Keyring]:
    """Replaces the keyring of this process within the block."""
    before, mine = keyring.get_keyring(), Keyring()
    keyring.set_keyring(mine)
    try:
        yield mine
    finally:
        keyring.set_keyring(before)
