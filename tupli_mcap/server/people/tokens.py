"""Tokens with which users, machines and addresses of recordings identify themselves.

access    signed (JWT), valid for a short time, void after a change of the password
refresh   stored as a digest; exchanged for a new pair, and within an hour again if that was lost, so that nobody has
          exchanged it. Any other second use ends the whole sign-in: two have the same token, so one has stolen it
API       stored as a digest; for machines, to read, or to read and write
ticket    signed; for one recording or query; void after a change of the password, and with the sign-in or the API token
          of the user who asked for it
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import jwt
from sqlalchemy import Connection, delete, func, insert, or_, select, update

from tupli_mcap import files
from tupli_mcap.errors import NotFoundError, StorageError, TupliError
from tupli_mcap.schema import ApiToken
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.server.database import audit
from tupli_mcap.server.people.access import GUEST, Caller
from tupli_mcap.server.people.accounts import caller_named, epoch_of, guest
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import API_TOKEN, REFRESH_TOKEN, USER

_API_PREFIX: Final = "tmcap_"
_ALGORITHM: Final = "HS256"
_MOST_DAYS: Final = 3650  # of a token for machines
_MOST_API_TOKENS: Final = 100  # of a user
_LOST_SECONDS: Final = 3600  # for which an answer may count as lost


class SignInError(TupliError):
    """A token or a password is not valid."""


class Tokens:
    """Makes and checks tokens. Methods that take a connection work in the transaction of their caller."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._secret = _secret(settings.secret)

    def pair(
        self, connection: Connection, user: str, family: str = "", *, epoch: int | None = None
    ) -> dict[str, Any]:
        """An access token and the refresh token for the next, as OAuth 2 names them.

        epoch: that of the password which was checked before; SignInError if the user has another one by now, or is
        deleted.
        """
        current = epoch_of(connection, user)
        if current is None or epoch not in (None, current):
            raise SignInError("Incorrect username or password")
        refresh = secrets.token_urlsafe(32)
        now = int(time.time())
        connection.execute(delete(REFRESH_TOKEN).where(REFRESH_TOKEN.c.expires < now))
        family = family or secrets.token_hex(16)
        row = {"digest": _digest(refresh), "user": user, "family": family}
        expires = now + self._settings.refresh_seconds
        connection.execute(insert(REFRESH_TOKEN).values(**row, used=False, expires=expires))
        return {
            "access_token": self._access(user, current, family),
            "refresh_token": refresh,
            "token_type": "bearer",
            "expires_in": self._settings.access_seconds,
        }

    def refreshed(self, connection: Connection, refresh: str) -> dict[str, Any] | None:
        """A new pair for a refresh token. If it was used within the last hour, and its successor was not used, the
        answer was lost: the successor counts as used from then on. None for any other used one, which ends the whole
        sign-in. SignInError if it is not valid, or has expired."""
        table = REFRESH_TOKEN
        found = connection.execute(select(table).where(table.c.digest == _digest(refresh))).first()
        if found is None or found.expires < time.time():
            raise SignInError("the refresh token is not valid; sign in again")
        latest = table.c.digest == (found.successor if found.used else found.digest)
        if found.used:
            latest &= table.c.expires > time.time() + self._settings.refresh_seconds - _LOST_SECONDS
        spent = update(table).where(latest, table.c.used.is_(False)).values(used=True)
        if not connection.execute(spent).rowcount:
            connection.execute(delete(table).where(table.c.family == found.family))
            return None
        pair = self.pair(connection, found.user, found.family)
        followed = update(table).where(table.c.digest == found.digest)
        connection.execute(followed.values(successor=_digest(pair["refresh_token"])))
        return pair

    def access_for(self, connection: Connection, refresh: str) -> str:
        """An access token for a refresh token that is not exchanged: PyTupli's client always keeps the same.
        SignInError if it is not valid, was used, or has expired."""
        found = _of_refresh_token(connection, refresh)
        if found is None:
            raise SignInError("Could not validate credentials")
        return self._access(found.user, found.epoch, found.family)

    def of_session(self, connection: Connection, refresh: str) -> Caller | None:
        """The caller of a browser, by the refresh token in its cookie, which stays valid; None if not signed in."""
        found = _of_refresh_token(connection, refresh)
        caller = None if found is None else caller_named(connection, found.user)
        return None if caller is None else caller._replace(sign_in=found.family)

    def form_code(self, refresh: str) -> str:
        """The code that a form of a signed-in browser has to send. Pages of other sites cannot know it."""
        return hmac.new(self._secret, f"form {_digest(refresh)}".encode(), hashlib.sha256).hexdigest()

    def is_form_code(self, refresh: str, code: str) -> bool:
        return hmac.compare_digest(self.form_code(refresh).encode(), code.encode())

    def _access(self, user: str, epoch: int, family: str) -> str:
        return self._signed("access", self._settings.access_seconds, sub=user, epoch=epoch, by=family)

    def end(self, connection: Connection, refresh: str) -> None:
        """Ends the sign-in of a refresh token; nothing happens if it is not valid."""
        table = REFRESH_TOKEN
        family = select(table.c.family).where(table.c.digest == _digest(refresh)).scalar_subquery()
        connection.execute(delete(table).where(table.c.family == family))

    def caller(self, connection: Connection, token: str) -> Caller:
        """The caller of an access token or an API token. SignInError if it is not valid, expired or revoked."""
        if token.startswith(_API_PREFIX):
            return _of_api_token(connection, token)
        told = self._told(token, "access")
        caller = caller_named(connection, told["sub"])
        if caller is None or caller.epoch != told.get("epoch"):
            raise SignInError("the access token is not valid any more")
        return caller._replace(sign_in=str(told.get("by", "")))

    # --- tokens of machines ---

    def create_api_token(
        self, connection: Connection, caller: Caller, name: str, scope: str, days: int | None
    ) -> ApiToken:
        """A new token for a machine, with the token itself, which is not stored. SignInError if the caller has a new
        password by now, or is deleted."""
        if not name.isprintable() or not 1 <= len(name) <= 100:
            raise StorageError(
                f"expected a token name of 1 to 100 printable characters, found {name[:100]!r}"
            )
        if scope not in ("read", "write"):
            raise StorageError(f"expected the scope 'read' or 'write', found {scope[:100]!r}")
        # a new password revokes a token that is just being made
        if epoch_of(connection, caller.name) != caller.epoch:
            raise SignInError("this sign-in has ended; sign in again")
        if days is not None and not 1 <= days <= _MOST_DAYS:
            raise StorageError(
                f"expected 1 to {_MOST_DAYS} days, found {days}; make another token after them"
            )
        own = select(func.count()).select_from(API_TOKEN).where(API_TOKEN.c.user == caller.name)
        if connection.execute(own).scalar_one() >= _MOST_API_TOKENS:
            raise StorageError(f"expected at most {_MOST_API_TOKENS} tokens of {caller.name}; revoke some")
        token, number = _API_PREFIX + secrets.token_urlsafe(32), secrets.token_hex(8)
        now = int(time.time())
        expires = None if days is None else now + days * 24 * 3600
        told = {"id": number, "name": name, "scope": scope, "created_at": now, "expires": expires}
        connection.execute(insert(API_TOKEN).values(**told, digest=_digest(token), user=caller.name))
        audit(connection, caller.name, "create_api_token", name)
        return _as_listed(told).model_copy(update={"token": token})

    def list_api_tokens(self, connection: Connection, caller: Caller) -> list[ApiToken]:
        """The caller's tokens for machines, without the tokens themselves."""
        table = API_TOKEN
        columns = (table.c.id, table.c.name, table.c.scope, table.c.created_at, table.c.expires)
        rows = connection.execute(select(*columns).where(table.c.user == caller.name))
        return [_as_listed(row._mapping) for row in rows]

    def delete_api_token(self, connection: Connection, caller: Caller, number: str) -> None:
        """Revokes one of the caller's tokens. NotFoundError if the caller has no such token."""
        own = (API_TOKEN.c.id == number, API_TOKEN.c.user == caller.name)
        if not connection.execute(delete(API_TOKEN).where(*own)).rowcount:
            raise NotFoundError("there is no such token")
        audit(connection, caller.name, "delete_api_token", number)

    # --- tickets ---

    def ticket(self, caller: Caller, *, of: Mapping[str, Any] | None = None, **what: Any) -> str:
        """A ticket for a `recording`, or for the episodes of a `query`, with this caller's rights. It is valid for a
        while, but no longer than what the caller has signed in with, nor than the ticket `of` which it is a part."""
        told: dict[str, Any] = {"sub": caller.name, "epoch": caller.epoch, "by": caller.sign_in}
        if of is not None:
            told["exp"] = of["exp"]
        return self._signed("ticket", self._settings.ticket_seconds, **told, **what)

    def of_ticket(self, connection: Connection, ticket: str) -> tuple[Caller, dict[str, Any]]:
        """The caller who was given a ticket, and what it opens. SignInError if it is not valid, has expired, or was
        revoked."""
        told = self._told(ticket, "ticket")
        if told["sub"] == GUEST:
            return guest(connection), told
        found = caller_named(connection, told["sub"])
        if found is not None:
            found = found._replace(sign_in=str(told.get("by", "")))
        if found is None or told.get("epoch") != found.epoch or not _lasts(connection, found):
            raise SignInError("the ticket is not valid any more")
        return found, told

    def _signed(self, kind: str, seconds: int, **told: Any) -> str:
        return jwt.encode(
            {"typ": kind, "exp": int(time.time()) + seconds, **told}, self._secret, algorithm=_ALGORITHM
        )

    def _told(self, token: str, kind: str) -> dict[str, Any]:
        try:
            told: dict[str, Any] = jwt.decode(
                token, self._secret, algorithms=[_ALGORITHM], options={"require": ["exp", "typ", "sub"]}
            )
        except jwt.PyJWTError:
            raise SignInError("the token is not valid, or has expired") from None
        if told["typ"] != kind:
            raise SignInError(f"expected a token of the kind {kind!r}, found another")
        return told


def _as_listed(row: Mapping[Any, Any]) -> ApiToken:
    times = {name: row[name] and iso_utc(row[name] * 10**9) for name in ("created_at", "expires")}
    return ApiToken.model_validate({**row, **times})


def _of_refresh_token(connection: Connection, refresh: str) -> Any:
    """The user and epoch of a refresh token; None if it is not valid."""
    table = REFRESH_TOKEN
    query = (
        select(table.c.user, table.c.family, USER.c.epoch)
        .join(USER, USER.c.name == table.c.user)
        .where(table.c.digest == _digest(refresh), table.c.used.is_(False))
        .where(table.c.expires > int(time.time()))
    )
    return connection.execute(query).first()


def _of_api_token(connection: Connection, token: str) -> Caller:
    table = API_TOKEN
    valid = or_(table.c.expires.is_(None), table.c.expires > int(time.time()))
    found = connection.execute(select(table).where(table.c.digest == _digest(token), valid)).first()
    caller = None if found is None else caller_named(connection, found.user, may_write=found.scope == "write")
    if found is None or caller is None:
        raise SignInError("the API token is not valid, or has expired; make another one")
    return caller._replace(sign_in=found.id, is_machine=True)


def _lasts(connection: Connection, caller: Caller) -> bool:
    """Whether the sign-in or the API token of a caller is still valid."""
    now = int(time.time())
    family, token = REFRESH_TOKEN.c, API_TOKEN.c
    ways = (
        select(family.user).where(family.family == caller.sign_in, family.expires > now),
        select(token.user).where(
            token.id == caller.sign_in, or_(token.expires.is_(None), token.expires > now)
        ),
    )
    return any(connection.execute(way.limit(1)).scalar() == caller.name for way in ways)


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()


def _secret(path: Path) -> bytes:
    """The key that signs tokens, made at the first start."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.suppress(FileExistsError):
        if not path.exists():  # on a full disk, a server with a key still starts
            files.write_bytes(path, secrets.token_bytes(32), overwrite=False, permissions=0o600)
    return path.read_bytes()
