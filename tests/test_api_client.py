"""A storage on a server keeps the contract of every storage."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import buckets
import gymnasium as gym
import pytest
from postgres import Cluster
from serving import PASSWORD, serving
from test_storage import StorageContract

from tupli_mcap import RecordEpisodes
from tupli_mcap.schema import Group
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.api import TupliAPIClient

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with buckets.bucket() as made:
        yield made.url


@pytest.fixture(params=["sqlite and a directory", "postgresql and s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    settings = Settings(tmp_path / "served")
    with contextlib.ExitStack() as stack:
        if "postgresql" in request.param:
            postgres: Cluster = request.getfixturevalue("postgres")
            database = stack.enter_context(postgres.database())
            place = f"{request.getfixturevalue('bucket')}/{tmp_path.name}"
            settings = replace(settings, database=database, blobs=place)
        yield stack.enter_context(serving(settings))


@pytest.fixture
def admin(url: str) -> Iterator[TupliAPIClient]:
    with TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        yield client


class TestContract(StorageContract):
    @pytest.fixture
    def storage(self, admin: TupliAPIClient) -> TupliAPIClient:
        admin.create_group(Group(name="lab"))
        return admin


def test_a_recording_that_has_grown_keeps_its_name(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    names = []
    for episodes in (1, 2):
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
            env.reset(seed=episodes)
            while not env.step(env.action_space.sample())[2]:
                pass
        names.append(admin.push(path))
        with admin.open_recording(names[-1]) as recording:
            assert len(recording) == episodes
    assert names[0] == names[1]
    assert [header.recording for header in admin.list_episodes()] == names
