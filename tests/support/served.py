"""Real processes of `tupli-mcap serve`."""

from __future__ import annotations

import base64
import contextlib
import datetime
import hashlib
import ipaddress
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from serving import PASSWORD

COMMAND = str(Path(sys.executable).with_name("tupli-mcap"))


class Process:
    """A server in processes of its own."""

    def __init__(self, directory: Path, log: Path, *options: str, port: int = 0) -> None:
        self._command = [COMMAND, "serve", str(directory), *options]
        self.log_file = log
        self.port = port
        self.start()

    def start(self) -> None:
        """Starts it, on the same port as before, and waits until it is ready."""
        out = self.log_file.with_suffix(".out")
        with out.open("wb") as stdout, self.log_file.open("ab") as stderr:
            self._process = subprocess.Popen(
                [*self._command, "--port", str(self.port)],
                stdout=stdout,
                stderr=stderr,
                env={**os.environ, "TUPLI_MCAP_ADMIN_PASSWORD": PASSWORD},
                start_new_session=True,
            )
        while not (found := re.search(r"at (https?://\S+)", out.read_text())):
            assert self._process.poll() is None, self.log_file.read_text()
            time.sleep(0.02)
        self.url = found[1]
        self.port = int(self.url.rpartition(":")[2])
        while not self._is_ready():
            assert self._process.poll() is None, self.log_file.read_text()
            time.sleep(0.02)

    @property
    def pid(self) -> int:
        return self._process.pid

    def _is_ready(self) -> bool:
        with contextlib.suppress(httpx.TransportError):
            return httpx.get(f"{self.url}/ready", verify=False, timeout=60).status_code in (200, 503)
        return False

    def kill(self) -> None:
        """Kills all of its processes at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(60)

    def stop(self) -> None:
        """Tells it to stop."""
        self._process.terminate()

    def wait(self) -> int:
        return self._process.wait(120)

    def log(self) -> list[dict[str, Any]]:
        """The lines of its log; one that is being written is left out."""
        whole = self.log_file.read_text().rpartition("\n")[0]
        return [json.loads(line) for line in whole.splitlines()]


@contextlib.contextmanager
def served(directory: Path, *options: str, port: int = 0) -> Iterator[Process]:
    """A server within the block."""
    process = Process(directory, directory.with_name(f"{directory.name}.log"), *options, port=port)
    try:
        yield process
    finally:
        process.kill()


def certificate(folder: Path, *, of_authority: bool = False, days: int = 1) -> tuple[Path, Path]:
    """A certificate of 127.0.0.1, valid for some days, which may also sign others, as `openssl req -x509` makes it,
    and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=9))
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]), False
        )
        .add_extension(x509.BasicConstraints(ca=of_authority, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / "certificate.pem", folder / "key.pem"
    paths[0].write_bytes(made.public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return paths


def sign_in(client: httpx.Client) -> dict[str, str]:
    """The header with which the admin is signed in."""
    answer = client.post("/v1/tokens", json={"username": "admin", "password": PASSWORD})
    return {"Authorization": f"Bearer {answer.json()['access_token']}"}


def begin(client: httpx.Client, token: dict[str, str], data: bytes) -> str:
    """Begins an upload; returns its address."""
    digest = base64.b64encode(hashlib.sha256(data).hexdigest().encode()).decode()
    headers = {"Upload-Length": str(len(data)), "Upload-Metadata": f"sha256 {digest}", **token}
    return client.post("/v1/uploads", headers=headers).headers["Location"]
