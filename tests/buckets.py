"""A bucket of moto's S3 server, with its credentials in the environment."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator

import boto3
import pytest
from moto.server import ThreadedMotoServer

_NUMBERS = itertools.count()


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
        with contextlib.closing(boto3.client("s3")) as client:
            pages = client.get_paginator("list_objects_v2").paginate(Bucket=self.name)
            return [each["Key"] for page in pages for each in page.get("Contents", [])]


@contextlib.contextmanager
def bucket() -> Iterator[Bucket]:
    """An empty bucket within the block."""
    made = Bucket(f"lab-{next(_NUMBERS)}")
    with pytest.MonkeyPatch.context() as patch:
        for key, value in {
            "AWS_ACCESS_KEY_ID": "me", "AWS_SECRET_ACCESS_KEY": "SECRET", "AWS_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": made.address, "AWS_ALLOW_HTTP": "true",
        }.items():  # fmt: skip
            patch.setenv(key, value)
        with contextlib.closing(boto3.client("s3")) as client:
            client.create_bucket(Bucket=made.name)
        try:
            yield made
        finally:
            made.stop()
