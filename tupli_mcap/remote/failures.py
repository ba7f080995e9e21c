"""Turns failed requests of obstore into errors that say what to do, without secrets in their messages."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar
from urllib.parse import urlsplit

from tupli_mcap.errors import RecordingError
from tupli_mcap.remote.names import is_web, parts_of, shown

SECONDS_VARIABLE: Final = "TUPLI_MCAP_REMOTE_SECONDS"
AUTHORITY: Final = "put the certificate of an authority of your own (PEM) into SSL_CERT_FILE"
_T = TypeVar("_T")
# Without credentials in the environment, obstore would ask the cloud's machine for them.
_WHERE_MACHINES_ASK: Final = ("//169.254.", "//metadata.google.internal")
_AGAIN: Final = "try again later"
_LATER: Final = ("408", "429")  # what a server answers that has too much to do
_ADDRESS: Final = "check the address, and the environment"
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
    ("No CA certificates", "no certificates of authorities are found here", "install ca-certificates; {}"),
    ("NotValidForName", "the certificate of {} is that of another name", "check the address"),
    ("ExpiredContext", "the certificate of {} has expired", "renew it on the server"),
    ("InvalidCertificate", "the certificate of {} is not trusted here", "check the address; {}"),
    ("InvalidContentType", "{} does not encrypt", "write http:// in the place of https://"),
    ("invalid port number", "its port is no number", "percent-encode a password (%2F is /, %23 #, %3F ?)"),
    ("Content-Length", "{} does not tell how long it is", "download the file, and open that"),
    (
        "kind: Timeout",
        "{} does not answer in time",
        f"{_AGAIN}, or give it more time with {SECONDS_VARIABLE}",
    ),
)
_ASKED: Final = re.compile(r"https?://(?:[^/@\s]*@)?([^/@\s,]+)")
_CONNECTED: Final = re.compile(r'"tcp connect error",\s*([^\s,]+:(\d+)),')
_ENDPOINT: Final = re.compile(r"(AWS|AZURE)_\w*ENDPOINT(_URL)?(_S3)?")
_STATUS: Final = re.compile(r"status code: (\d{3}(?: [A-Z][A-Za-z]*)*)")
# Buckets say in XML why they refuse.
_REASON: Final = re.compile(r"<Code>([^<]+)</Code>(?:\s*<Message>([^<]*)</Message>)?")


class BrokenOffError(RecordingError):
    """The server does not answer, or stops in the middle of it."""


class FailedError(BrokenOffError):
    """The server answers that it fails."""


class RefusedError(RecordingError):
    """The server refuses the request, such as its range, or has another version."""


def check_endpoints() -> None:
    """Raises RecordingError for an endpoint in the environment that is no web address: obstore would panic."""
    for name, value in os.environ.items():
        if _ENDPOINT.fullmatch(name) and value and not is_web(value):
            address = shown(f"http://{value}")
            raise RecordingError(
                f"expected {name} to be an address such as {address:.80}, found {address[7:]!r:.80}"
            )


def asked(url: str, ask: Callable[[], _T]) -> _T:
    """The answer to a request; RecordingError, without secrets in its message, if the request fails. The caller handles
    obstore's NotModifiedError and NotSupportedError, which say what a server does not send."""
    from obstore import exceptions as told

    try:
        return ask()
    except told.PreconditionError as err:
        raise RefusedError(f"{shown(url)} has another version on its server; open it again") from err
    except (told.NotFoundError, FileNotFoundError):
        raise missing(url) from None
    except (told.PermissionDeniedError, told.UnauthenticatedError) as err:
        raise RecordingError(_forbidden(url, str(err))) from None
    except (told.NotSupportedError, told.NotModifiedError):
        raise
    except (told.BaseError, OSError, ValueError) as err:
        said = str(err).partition("\n")[0]
        if any(f"status code: {code}" in said for code in (416, 400, 405, 501)):
            raise RefusedError(f"{shown(url)} cannot be read: {why(str(err))}") from None
        if any(where in said for where in _WHERE_MACHINES_ASK):
            raise RecordingError(
                f"{shown(url)} cannot be read: no credentials are in the environment; set those of its provider, such "
                "as AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or for a public bucket AWS_SKIP_SIGNATURE=true"
            ) from None
        if said.startswith(("Generic Config error", "Generic URL error")):
            raise RecordingError(f"{shown(url)} cannot be read: {shown(said):.300}; {_ADDRESS}") from None
        if "Content-Length" in str(err) and is_web(url) and parts_of(url).path.endswith("/"):
            raise unlisted(url) from None
        failed = FailedError if _STATUS.search(said) else BrokenOffError
        raise failed(f"{shown(url)} cannot be read: {why(str(err))}") from None


def missing(url: str) -> RecordingError:
    """The error for a URL of no file. In a bucket, it may be that of a folder."""
    advice = "check the address"
    if not is_web(url) and not url.endswith(".mcap"):
        advice += f"; for the recordings in a folder, give {shown(url).rstrip('/')}/*.mcap"
    return RecordingError(f"{shown(url)} does not exist; {advice}")


def unlisted(url: str) -> RecordingError:
    """The error for a pattern or a folder on a web server."""
    return RecordingError(f"{shown(url)}: a web server does not list its files; give the address of each")


def _forbidden(url: str, told: str) -> str:
    """What to say of a file that its server does not let one read."""
    if is_web(url):
        return (
            f"{shown(url)} may not be read with the credentials in its address; give a user and a password, "
            "https://USER:PASSWORD@HOST/…, or a new signature"
        )
    return (
        f"{shown(url)} may not be read with the credentials found in the environment{_reason(told)}; check them, and "
        "your rights"
    )


def _reason(told: str) -> str:
    """Why a bucket refuses, in brackets, if it says so."""
    if (found := _REASON.search(told)) is None:
        return ""
    code, message = found[1], found[2]
    return shown(f" ({code}: {message.strip():.200})" if message else f" ({code:.80})")


def why(told: str) -> str:
    """Why a request failed, and what to do, from the text of obstore's error."""
    said = told.partition("\n")[0]
    if "incorrectly configured region" in said:
        return "the bucket is in another region; set AWS_REGION to that of the bucket"
    if status := _STATUS.search(said):
        reason, code = _reason(told), status[1][:3]
        advice = _ADDRESS if code < "500" and code not in _LATER else _AGAIN
        if code in ("401", "403") or "Token" in reason or "Authorization" in reason:
            advice = "check the credentials in the environment, and their rights"
        return f"its server answers {status[1]}{reason}; {advice}"
    for sign, cause, advice in _CAUSES:
        if sign in told:
            return f"{cause.format(_where(told))}; {advice.format(_authority())}"
    if not any(sign in said for sign in ("Error performing", "HTTP error")):  # nothing was sent
        return f"{shown(said.partition(': ')[2] or said):.300}; {_ADDRESS}"
    return f"{shown(said):.300}; {_AGAIN}"


def _where(told: str) -> str:
    """The server that a request could not reach, or the proxy on the way to it: that has another port."""
    named = _ASKED.search(told.partition("\n")[0])
    if named is None:
        return "its server"
    url = urlsplit(named[0])
    connected = _CONNECTED.search(told)
    if connected and int(connected[2]) != (url.port or (443 if url.scheme == "https" else 80)):
        return f"the proxy {connected[1]} ({url.scheme.upper()}_PROXY or ALL_PROXY)"
    return named[1]


def _authority() -> str:
    """What to do about a certificate that is not trusted."""
    if not (given := os.environ.get("SSL_CERT_FILE")):
        return AUTHORITY
    if not Path(given).is_file():
        return f"SSL_CERT_FILE names no file: {given}"
    return f"its authority is not one of those (PEM) in SSL_CERT_FILE, {given}"
