"""Turns failed requests of obstore into errors that say what to do, without secrets in their messages."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final, TypeVar

from tupli_mcap.errors import RecordingError
from tupli_mcap.remote.names import is_web, shown

SECONDS_VARIABLE: Final = "TUPLI_MCAP_REMOTE_SECONDS"
AUTHORITY: Final = "put the certificate of an authority of your own (PEM) into SSL_CERT_FILE"
_T = TypeVar("_T")
# Without credentials in the environment, obstore would ask the cloud's machine for them.
_WHERE_MACHINES_ASK: Final = ("//169.254.", "//metadata.google.internal")
_AGAIN: Final = "try again later"
# obstore says why a connection fails only in the debug text of its errors.
_CAUSES: Final = (
    ("dns error", "there is no server of the name {}", "check the address, and the network"),
    ("ConnectionRefused", "{} refuses connections", f"check the address, or {_AGAIN}"),
    ("NetworkUnreachable", "there is no way to {}", "check the network"),
    ("HostUnreachable", "there is no way to {}", "check the network"),
    (
        "CaUsedAsEndEntity",
        "the certificate of {} is that of an authority",
        "give the server one with basicConstraints=critical,CA:FALSE",
    ),
    ("InvalidCertificate", "the certificate of {} is not trusted here", f"check the address; {AUTHORITY}"),
    ("Content-Length", "{} does not tell how long it is", "download the file, and open that"),
    (
        "kind: Timeout",
        "{} does not answer in time",
        f"{_AGAIN}, or give it more time with {SECONDS_VARIABLE}",
    ),
)
_ASKED: Final = re.compile(r"https?://(?:[^/@\s]*@)?([^/@\s,]+)")
_STATUS: Final = re.compile(r"status code: (\d{3}(?: [A-Z][A-Za-z]*)*)")


class BrokenOffError(RecordingError):
    """The server does not answer, or stops in the middle of it."""


class FailedError(BrokenOffError):
    """The server answers that it fails."""


class RefusedError(Exception):
    """The server refuses the range, or has another version."""


def asked(url: str, ask: Callable[[], _T]) -> _T:
    """The answer to a request; RecordingError, without secrets in its message, if the request fails."""
    from obstore import exceptions as told

    try:
        return ask()
    except told.PreconditionError as err:
        raise RefusedError from err
    except (told.NotFoundError, FileNotFoundError):
        raise missing(url) from None
    except (told.PermissionDeniedError, told.UnauthenticatedError):
        raise RecordingError(
            f"{shown(url)} may not be read with the credentials found in the environment; check them, and your rights"
        ) from None
    except (told.NotSupportedError, told.NotModifiedError):
        raise
    except (told.BaseError, OSError, ValueError) as err:
        said = str(err).partition("\n")[0]
        if any(f"status code: {code}" in said for code in (416, 400, 405, 501)):
            raise RefusedError from None
        if any(where in said for where in _WHERE_MACHINES_ASK):
            raise RecordingError(
                f"{shown(url)} cannot be read: no credentials are in the environment; set those of its provider, such "
                "as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or for a public bucket AWS_SKIP_SIGNATURE=true"
            ) from None
        if said.startswith(("Generic Config error", "Generic URL error")):
            raise RecordingError(
                f"{shown(url)} cannot be read: {shown(said):.300}; check the address, and the environment"
            ) from None
        failed = FailedError if _STATUS.search(said) else BrokenOffError
        raise failed(f"{shown(url)} cannot be read: {why(str(err))}") from None


def missing(url: str) -> RecordingError:
    """The error for a URL of no file. In a bucket, it may be that of a folder."""
    advice = "check the address"
    if not is_web(url) and not url.endswith(".mcap"):
        advice += f"; for the recordings in a folder, give {shown(url).rstrip('/')}/*.mcap"
    return RecordingError(f"{shown(url)} does not exist; {advice}")


def why(told: str) -> str:
    """Why a request failed, and what to do, from the text of obstore's error."""
    said = told.partition("\n")[0]
    if status := _STATUS.search(said):
        denied = status[1][:3] in ("401", "403")
        advice = "check the credentials in the environment, and their rights" if denied else _AGAIN
        return f"its server answers {status[1]}; {advice}"
    for sign, cause, advice in _CAUSES:
        if sign in told:
            where = _ASKED.search(said)
            return f"{cause.format(where[1] if where else 'its server')}; {advice}"
    return f"{shown(said):.300}; {_AGAIN}"
