"""Keeps a user's tokens, by server: in the system's keyring if there is one, else in a file that only this user can
read.

`servers.json` in the user's configuration directory lists the servers and the signed-in users, the server used last at
the end. It is written again whenever tokens change, in the keyring too, so what was read is valid as long as the file
is the same.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from tupli_mcap import files, trust
from tupli_mcap.errors import StorageError
from tupli_mcap.storage.atomic import Lock, os_errors

if TYPE_CHECKING:
    from keyring.backend import KeyringBackend

_SERVICE: Final = "tupli-mcap"
_TOKENS: Final = ("access_token", "refresh_token")
_Servers = dict[str, dict[str, Any]]


class TokenStore:
    """Tokens by server. Safe for threads and processes.
    StorageError if the file cannot be written, or the keyring does not give what it keeps."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lock = Lock(path.with_name(f"{path.name}.lock"))
        """Keeps other processes and threads out; reentrant in a thread."""
        self._seen: tuple[int, int] | None = None
        self._known: _Servers = {}

    def last(self) -> str:
        """The server that was used last; empty if there is none."""
        return next(reversed(self._servers()), "")

    def username(self, url: str) -> str:
        """Who is signed in, or was until the sign-in ended; empty if nobody is."""
        return str(self._servers().get(url, {}).get("username", ""))

    def tokens(self, url: str) -> dict[str, str]:
        """`access_token` and `refresh_token`; empty if nobody is signed in any more."""
        found = self._servers().get(url, {})
        if "keyring" in found and "access_token" not in found:
            found |= _from_keyring(found["keyring"])
        return {name: str(found[name]) for name in _TOKENS if name in found}

    def put(self, url: str, username: str, tokens: dict[str, Any]) -> None:
        """Keeps the tokens of a user, and makes the server the last used one."""
        told, account = {name: str(tokens[name]) for name in _TOKENS}, f"{username} at {url}"
        if _into_keyring(account, told):
            told = {"keyring": account}
        with self.lock:
            earlier = self._stored().get(url, {}).get("keyring")
            self._write({**self._others(url), url: {"username": username, **told}})
        if earlier is not None and told != {"keyring": earlier}:  # of who was signed in before
            _out_of_keyring(earlier)

    def forget(self, url: str) -> None:
        """Deletes the user and the tokens for a server."""
        self._keep_only(url, {})

    def end(self, url: str) -> None:
        """Deletes the tokens for a server, but not the user: their sign-in has ended."""
        self._keep_only(url, {"username": self.username(url)})

    def _keep_only(self, url: str, kept: dict[str, Any]) -> None:
        """Leaves the server in its place: it was not used by this."""
        with self.lock:
            servers = self._stored()
            if url in servers:
                if (account := servers[url].get("keyring")) is not None:
                    _out_of_keyring(account)
                self._write({**servers, url: kept})

    def use(self, url: str) -> None:
        """Makes a server the last used one."""
        with self.lock:
            if self.last() != url:
                self._write({**self._others(url), url: self._stored().get(url, {})})

    def _others(self, url: str) -> _Servers:
        return {name: kept for name, kept in self._stored().items() if name != url}

    def _write(self, servers: _Servers) -> None:
        with os_errors("cannot write", self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            files.write_bytes(self.path, json.dumps(servers, indent=2).encode(), permissions=0o600)

    def _servers(self) -> _Servers:
        """The entries of the file, with tokens read from the keyring since it was written."""
        try:
            status = self.path.stat()
        except OSError:
            return {}
        seen = (status.st_ino, status.st_mtime_ns)
        if seen != self._seen:
            self._known, self._seen = self._stored(), seen
        return self._known

    def _stored(self) -> _Servers:
        try:
            found = json.loads(self.path.read_bytes())
        except (OSError, ValueError):
            return {}
        known = found.items() if isinstance(found, dict) else ()
        return {url: kept for url, kept in known if isinstance(kept, dict)}


def user_tokens() -> TokenStore:
    """The tokens of this user."""
    return TokenStore(trust.config_dir() / "servers.json")


def last_server() -> str:
    """The server that this user signed in to last, or chose since; empty if there is none."""
    return user_tokens().last()


def _keyring() -> KeyringBackend | None:
    """The system's keyring; None if there is none, or the package `keyring` is not installed."""
    try:
        import keyring
    except ImportError:
        return None
    backend = keyring.get_keyring()
    # a backend with a lower priority keeps nothing, or keeps it unprotected
    return backend if backend.priority >= 1 else None


def _into_keyring(account: str, tokens: dict[str, str]) -> bool:
    """Whether the keyring has taken them."""
    backend = _keyring()
    if backend is None:
        return False
    try:
        backend.set_password(_SERVICE, account, json.dumps(tokens))
    except Exception:  # noqa: BLE001 - each keyring raises errors of its own
        return False
    return True


def _from_keyring(account: str) -> dict[str, str]:
    backend = _keyring()
    try:
        found = None if backend is None else backend.get_password(_SERVICE, account)
        return {} if found is None else dict(json.loads(found))
    except Exception as err:  # noqa: BLE001 - each keyring raises errors of its own
        raise StorageError(
            f"the keyring does not give the tokens of {account} ({type(err).__name__}); unlock it, or sign in again"
        ) from None


def _out_of_keyring(account: str) -> None:
    backend = _keyring()
    if backend is not None:
        with contextlib.suppress(Exception):  # it is gone already, or the keyring is locked
            backend.delete_password(_SERVICE, account)
