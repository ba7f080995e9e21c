"""A storage on a server keeps the contract of every storage."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from serving import PASSWORD, serving
from test_storage import StorageContract

from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.api import TupliAPIClient


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    with serving(Settings(tmp_path / "served")) as url:
        yield url


@pytest.fixture
def admin(url: str) -> Iterator[TupliAPIClient]:
    with TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        yield client


class TestContract(StorageContract):
    @pytest.fixture
    def storage(self, admin: TupliAPIClient) -> TupliAPIClient:
        admin.create_group("lab")
        return admin
