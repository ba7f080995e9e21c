"""Starts and stops the processes of a server."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import shutil
import socket
import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from uvicorn.supervisors import Multiprocess

from tupli_mcap.errors import StorageError
from tupli_mcap.server.app import create_app
from tupli_mcap.server.library import Library
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.traffic import logs
from tupli_mcap.server.traffic.patience import PatientProtocol

_KEEP_ALIVE_SECONDS = 30
_STOP_SECONDS = 600  # how long running requests may take once the server has to stop
_START_SECONDS = 60
_MOST_CONNECTIONS = 1000  # most connections of a process


@dataclass(frozen=True)
class Listening:
    """Where a server listens. workers: the number of processes. certificate, key: files for TLS. proxies: addresses of
    proxies whose X-Forwarded headers are believed."""

    host: str = "127.0.0.1"
    port: int = 8080
    workers: int = 1
    certificate: Path | None = None
    key: Path | None = None
    proxies: Sequence[str] = ()


def run(settings: Settings, listening: Listening, tell: Callable[[str, str | None], None]) -> None:
    """Serves until a signal stops the process; finishes running requests. StorageError if the directory, its database,
    the certificate or the address cannot be used.

    tell: called with the address, and the admin's password if it is new and random (else None).
    """
    _check_certificate(listening)
    with _bound(listening) as bound:
        library = Library(settings)
        try:
            password = library.first_password()
            library.adopt()
        finally:
            library.close()
        scheme = "http" if listening.certificate is None else "https"
        host = f"[{listening.host}]" if ":" in listening.host else listening.host
        tell(f"{scheme}://{host}:{bound.getsockname()[1]}", password)
        config = configured(functools.partial(_application, settings), settings, listening)
        if listening.workers == 1:
            with contextlib.suppress(KeyboardInterrupt):  # uvicorn raises it again after its shutdown
                uvicorn.Server(config).run([bound])
            return
        counts = settings.own / "metrics"
        shutil.rmtree(counts, ignore_errors=True)
        counts.mkdir()
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = str(counts)
        Multiprocess(config, [bound]).run()


def configured(
    application: Callable[[], FastAPI], settings: Settings, listening: Listening
) -> uvicorn.Config:
    """The configuration with which uvicorn serves the application that `application` makes."""
    patient = functools.partial(
        PatientProtocol, head_seconds=settings.head_seconds, stall_seconds=settings.stall_seconds
    )
    return uvicorn.Config(
        application,
        factory=True,
        workers=listening.workers,
        http=patient,  # type: ignore[arg-type]
        ws="none",
        lifespan="on",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(listening.proxies),
        forwarded_allow_ips=list(listening.proxies),
        limit_concurrency=_MOST_CONNECTIONS,
        timeout_keep_alive=_KEEP_ALIVE_SECONDS,
        timeout_graceful_shutdown=_STOP_SECONDS,
        timeout_worker_healthcheck=_START_SECONDS,
        ssl_certfile=listening.certificate,
        ssl_keyfile=listening.key,
    )


def _application(settings: Settings) -> FastAPI:
    logs.set_up()
    app = create_app(Library(settings))
    gc.freeze()  # modules and routes are no garbage: looking at them again and again takes long
    return app


def _check_certificate(listening: Listening) -> None:
    if listening.certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(listening.certificate, listening.key)
    except OSError as err:
        raise StorageError(
            f"expected a certificate in {listening.certificate} and its key in {listening.key}, both in PEM: "
            f"{err.strerror or err}"
        ) from err


def _bound(listening: Listening) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in listening.host else socket.AF_INET
        return socket.create_server((listening.host, listening.port), family=family, backlog=2048)
    except OSError as err:
        raise StorageError(
            f"cannot listen at {listening.host}, port {listening.port}: {err.strerror or err}; "
            "choose another address or port"
        ) from err
