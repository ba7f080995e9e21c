"""PyTupli's client, as it is on PyPI, against our server."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import httpx
import keyring
import keyring.backend
import numpy as np
import pytest
from serving import PASSWORD, serving

from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient


class Keyring(keyring.backend.KeyringBackend):
    """A keyring in memory: where PyTupli keeps address and tokens."""

    priority = 1  # type: ignore[assignment]

    def __init__(self) -> None:
        super().__init__()
        self.kept: dict[tuple[str, str], str] = {}

    def get_password(self, service: str, username: str) -> str | None:
        return self.kept.get((service, username))

    def set_password(self, service: str, username: str, password: str) -> None:
        self.kept[service, username] = password

    def delete_password(self, service: str, username: str) -> None:
        del self.kept[service, username]


@pytest.fixture(scope="module")
def pytupli() -> ModuleType:
    """PyTupli's modules, its names in one."""
    found = ModuleType("pytupli")
    for name in ("schema", "storage", "benchmark", "dataset"):
        vars(found).update(vars(importlib.import_module(f"pytupli.{name}")))
    return found


@pytest.fixture
def kept() -> Iterator[Keyring]:
    before, mine = keyring.get_keyring(), Keyring()
    keyring.set_keyring(mine)
    yield mine
    keyring.set_keyring(before)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    with serving(Settings(tmp_path / "served", guests=True)) as url:
        yield url


@pytest.fixture
def admin(pytupli: ModuleType, kept: Keyring, url: str) -> Any:
    client = pytupli.TupliAPIClient()
    client.login("admin", PASSWORD, url)
    return client


def test_it_stores_records_filters_trains_and_deletes(pytupli: ModuleType, admin: Any, url: str) -> None:
    env = pytupli.TupliEnvWrapper(gym.make("CartPole-v1"), storage=admin)
    env.store(name="cart", description="a pole")
    for seed in range(3):
        env.reset(seed=seed)
        done = False
        while not done:
            action = env.action_space.sample()
            *_, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
    (header,) = admin.list_benchmarks()
    assert (header.id, header.metadata.name, header.created_by) == (env.id, "cart", "admin")
    assert admin.list_benchmarks(pytupli.FilterEQ(key="metadata.name", value="another")) == []

    episodes = admin.list_episodes(pytupli.FilterEQ(key="benchmark_id", value=env.id))
    assert len(episodes) == 3
    assert all(episode.terminated and episode.n_tuples > 5 for episode in episodes)
    dataset = pytupli.TupliDataset(storage=admin).with_benchmark_filter(
        pytupli.FilterEQ(key="id", value=env.id)
    )
    dataset.load()
    observations, actions, rewards, terminals, timeouts = dataset.convert_to_tensors()
    assert len(observations) == len(actions) == len(rewards) == sum(e.n_tuples for e in episodes)
    assert int(terminals.sum()) == 3
    assert not timeouts.any()

    ours = TupliAPIClient(url)  # the same episodes, as a recording
    ours.login("admin", PASSWORD)
    items = ours.list_episodes(include_tuples=True)
    np.testing.assert_allclose([t.state for item in items for t in item.tuples], observations)  # type: ignore[union-attr]

    loaded = pytupli.TupliEnvWrapper.load(storage=admin, benchmark_id=env.id)
    assert loaded.unwrapped.spec.id == "CartPole-v1"
    loaded.delete(delete_episodes=True)
    assert admin.list_benchmarks() == admin.list_episodes() == ours.list_episodes() == []
    ours.close()


def test_artifacts(pytupli: ModuleType, admin: Any) -> None:
    item = admin.store_artifact(b"wind\0", pytupli.ArtifactMetadata(name="Böe", extra={"rows": 3}))
    assert (item.name, item.extra) == ("Böe", {"rows": 3})
    assert admin.load_artifact(item.id) == b"wind\0"
    assert [found.id for found in admin.list_artifacts()] == [item.id]
    admin.publish_artifact(item.id)
    assert admin.list_artifacts(pytupli.FilterEQ(key="published_in", value="global"))[0].id == item.id
    admin.unpublish_artifact(item.id, "global")
    assert admin.list_artifacts(pytupli.FilterEQ(key="published_in", value="global")) == []
    admin.delete_artifact(item.id)
    admin.delete_artifact(item.id)
    with pytest.raises(pytupli.TupliStorageError, match="API request failed: 404"):
        admin.load_artifact(item.id)


def test_users_groups_and_publication(pytupli: ModuleType, admin: Any, kept: Keyring) -> None:
    episode = pytupli.Episode(
        benchmark_id="",
        metadata={"score": 1.5},
        tuples=[
            pytupli.RLTuple(state=[0.0, 1.0], action=1, reward=1.0, info={}, terminal=True, timeout=False)
        ],
    )
    assert admin.signup("ann", "ann").username == "ann"
    assert [user.username for user in admin.list_users()] == ["admin", "ann"]
    with pytest.raises(pytupli.TupliStorageError, match="Signup failed"):
        admin.signup("ann", "ann")
    admin.create_group(pytupli.Group(name="lab", description="us"))
    members = [pytupli.GroupMembership(user="ann", roles=["member"])]
    query = pytupli.GroupMembershipQuery(group_name="lab", members=members)
    assert set(admin.add_group_members(query).members) == {"admin", "ann"}
    told = {"hash": "h", "serialized": '{"py/object": "x"}', "metadata": {"name": "cart"}}
    benchmark = admin.store_benchmark(pytupli.BenchmarkQuery(**told))
    with pytest.raises(pytupli.TupliStorageError, match="API request failed: 409"):
        admin.store_benchmark(pytupli.BenchmarkQuery(**told))
    episode.benchmark_id = benchmark.id
    made = admin.record_episode(episode)
    assert (made.n_tuples, made.metadata) == (1, {"score": 1.5})

    tokens = dict(kept.kept)
    admin.login("ann", "ann")
    assert admin.list_benchmarks() == admin.list_episodes() == []
    for ask in (
        lambda: admin.load_benchmark(benchmark.id),
        lambda: admin.load_benchmark("0" * 64),
        lambda: admin.publish_episode(made.id),
        lambda: admin.delete_episode(made.id),
        lambda: admin.record_episode(episode),
        lambda: admin.delete_user("admin"),
        lambda: admin.list_roles(),
    ):
        with pytest.raises(pytupli.TupliStorageError, match="API request failed: 403"):
            ask()
    kept.kept = dict(tokens)
    admin.publish_benchmark(benchmark.id, "lab")
    admin.publish_episode(made.id, "lab")
    admin.login("ann", "ann")
    assert admin.load_benchmark(benchmark.id).serialized == told["serialized"]
    (item,) = admin.list_episodes(include_tuples=True)
    assert (item.tuples[0].state, item.tuples[0].reward) == ([0.0, 1.0], 1.0)
    assert admin.list_episodes(pytupli.FilterGT(key="metadata.score", value=2)) == []
    admin.change_password("ann", "another")
    with pytest.raises(pytupli.TupliStorageError, match="Login failed"):
        admin.login("ann", "ann")
    admin.login("ann", "another")
    kept.kept = dict(tokens)
    admin.remove_group_members(query)
    admin.delete_group("lab")
    admin.create_role(pytupli.UserRole(role="looker", rights=["benchmark_read"], description=""))
    assert "looker" in {role.role for role in admin.list_roles()}
    admin.delete_role("looker")
    admin.delete_user("ann")
    admin.delete_user("ann")


def test_an_expired_access_token_is_renewed(admin: Any, kept: Keyring) -> None:
    kept.kept["pytupli", "access_token"] = "expired"
    assert [user.username for user in admin.list_users()] == ["admin"]
    assert kept.kept["pytupli", "access_token"] != "expired"
    assert admin.list_groups() == []


def test_guests_are_told_403(url: str) -> None:
    for method, path in (
        ("GET", "users/list"),
        ("POST", "users/refresh-token"),
        ("DELETE", "users/delete?username=x"),
    ):
        assert httpx.request(method, f"{url}/access/{path}").status_code == 403
    assert httpx.get(f"{url}/access/groups/list").json() == []
    assert httpx.post(f"{url}/episodes/list", json={"include_tuples": True}).json() == []
