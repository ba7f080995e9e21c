"""PyTupli's client, as it is on PyPI, against our server."""

from __future__ import annotations

import importlib
import inspect
import itertools
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import httpx
import numpy as np
import pytest
from keyrings import Keyring, keyring_in_memory
from serving import PASSWORD, serving

from tupli_mcap.schema import (
    RIGHT,
    Group,
    GroupMembership,
    GroupMembershipQuery,
    Membership,
    UserOut,
    UserRole,
)
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient, TupliStorageError


@pytest.fixture(scope="module")
def pytupli() -> ModuleType:
    """PyTupli's modules, its names in one."""
    found = ModuleType("pytupli")
    for name in ("schema", "storage", "benchmark", "dataset"):
        vars(found).update(vars(importlib.import_module(f"pytupli.{name}")))
    return found


@pytest.fixture
def kept() -> Iterator[Keyring]:
    with keyring_in_memory() as kept:
        yield kept


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    with serving(Settings(tmp_path / "served", guests=True, min_password=3)) as url:
        yield url


@pytest.fixture
def admin(pytupli: ModuleType, kept: Keyring, url: str) -> Any:
    client = pytupli.TupliAPIClient()
    client.login("admin", PASSWORD, url)
    return client


METHODS = [
    name
    for name, member in vars(importlib.import_module("pytupli.storage").TupliAPIClient).items()
    if inspect.isfunction(member) and (not name.startswith("_") or name == "__init__")
]


@pytest.mark.parametrize("name", METHODS)
def test_our_client_has_the_method_with_the_same_parameters(pytupli: ModuleType, name: str) -> None:
    """What ours takes beyond them may be left out."""
    theirs = list(inspect.signature(getattr(pytupli.TupliAPIClient, name)).parameters.values())
    ours = list(inspect.signature(getattr(TupliAPIClient, name)).parameters.values())
    assert [(p.name, p.default, p.kind) for p in ours[: len(theirs)]] == [
        (p.name, p.default, p.kind) for p in theirs
    ]
    assert all(
        p.default is not p.empty or p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL) for p in ours[len(theirs) :]
    )
    assert name == "__init__" or inspect.getdoc(getattr(TupliAPIClient, name))


def test_our_client_takes_and_gives_what_pytupli_s_does(admin: Any, url: str) -> None:
    """The calls of `test_users_and_groups_and_publication`, with the models of `tupli_mcap.schema`."""
    with TupliAPIClient() as ours:
        ours.login("admin", PASSWORD, url)
        assert ours.signup("ann", "ann") == UserOut(
            username="ann",
            memberships=[
                Membership(group="global", roles=["global_member", "contributor"]),
                Membership(group="ann", roles=["user_admin", "contributor"]),
            ],
        )
        assert [user.username for user in ours.list_users()] == ["admin", "ann"]
        with pytest.raises(TupliStorageError, match="Signup failed"):
            ours.signup("ann", "ann")
        with pytest.raises(TupliStorageError, match="Login failed"):
            ours.login("ann", "wrong")
        lab = Group(name="lab", description="us")
        assert ours.create_group(lab) == lab
        query = GroupMembershipQuery(
            group_name="lab", members=[GroupMembership(user="ann", roles=["member"])]
        )
        assert ours.add_group_members(query).members == ["admin", "ann"]
        assert ours.read_group("lab").roles["ann"] == ["member"]
        assert ours.remove_group_members(query).members == ["admin"]
        assert ours.list_groups() == [lab]
        ours.delete_group("lab")
        role = UserRole(role="looker", rights=[RIGHT.EPISODE_READ], description=None)
        assert ours.create_role(role) == role
        assert role in ours.list_roles()
        ours.delete_role("looker")
        ours.change_password("ann", "new")
        ours.login("ann", "new")
        ours.change_password("ann", "newer", old="new")
        ours.login("admin", PASSWORD)
        ours.delete_user("ann")
        assert [user.username for user in ours.list_users()] == ["admin"]


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


def test_an_artifact_with_long_metadata_is_downloaded(pytupli: ModuleType, admin: Any) -> None:
    told = pytupli.ArtifactMetadata(name="wind", description="ö" * 11_000)
    item = admin.store_artifact(b"wind", told)  # as JSON in ASCII, more than a header may have
    assert admin.load_artifact(item.id) == b"wind"
    assert admin.list_artifacts()[0].description == told.description


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


def test_who_deletes_again_what_they_have_deleted(pytupli: ModuleType, admin: Any, kept: Keyring) -> None:
    """It is gone, for its owner; others are not told whether it was ever there."""
    tokens = dict(kept.kept)
    for name in ("ann", "bob"):
        kept.kept = dict(tokens)
        admin.signup(name, name)
    admin.login("ann", "ann")
    told = {"hash": "h", "serialized": '{"py/object": "x"}', "metadata": {"name": "cart"}}
    benchmark = admin.store_benchmark(pytupli.BenchmarkQuery(**told))
    artifact = admin.store_artifact(b"wind", pytupli.ArtifactMetadata(name="wind"))
    row = pytupli.RLTuple(state=[0.0], action=1, reward=1.0, info={}, terminal=True, timeout=False)
    episode = admin.record_episode(pytupli.Episode(benchmark_id=benchmark.id, metadata={}, tuples=[row]))
    deleting = (
        (admin.delete_episode, episode.id),
        (admin.delete_artifact, artifact.id),
        (admin.delete_benchmark, benchmark.id),
    )
    for delete, uri in deleting:
        delete(uri)
        delete(uri)
        for unknown in ("%", "", uri[:5]):
            with pytest.raises(pytupli.TupliStorageError, match="API request failed: 403"):
                delete(unknown)
    assert admin.list_episodes() == []
    admin.login("bob", "bob")
    for delete, uri in deleting:
        with pytest.raises(pytupli.TupliStorageError, match="API request failed: 403"):
            delete(uri)


NO_FILTERS = ({"type": "EQ"}, {"type": "EQ", "value": 3}, {"type": "XX"}, {"type": "EQ", "key": None, "value": None},
    {"type": "EQ", "key": "id"}, {"type": "GT", "key": "n_tuples", "value": None}, {"type": "NOT"}, {"filters": 3},
    {"type": "OR", "filters": [{"type": "EQ"}]}, {"filters": [3]}, {"key": "id", "value": "x"})  # fmt: skip


def test_a_filter_that_is_none_selects_nothing(pytupli: ModuleType, admin: Any, url: str) -> None:
    told = {"hash": "h", "serialized": '{"py/object": "x"}', "metadata": {"name": "cart"}}
    kept = admin.store_benchmark(pytupli.BenchmarkQuery(**told))
    for everything in (None, pytupli.FilterAND(filters=[]), pytupli.FilterOR(filters=[])):
        assert [item.id for item in admin.list_benchmarks(everything)] == [kept.id]
        assert admin.list_episodes(everything) == admin.list_artifacts(everything) == []
    for kind, no_filter in itertools.product(("benchmarks", "artifacts", "episodes"), NO_FILTERS):
        answer = httpx.post(f"{url}/{kind}/list", json=no_filter)
        assert (answer.status_code, answer.json()["error"]) == (400, "FilterError"), (no_filter, answer.text)
    for kind in ("benchmarks", "artifacts", "episodes"):
        assert httpx.post(f"{url}/{kind}/list").json() == []  # of a guest, and without a body


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


def test_what_docs_say_of_times_and_errors(url: str, admin: Any, pytupli: ModuleType) -> None:
    admin.store_artifact(b"wind", pytupli.ArtifactMetadata(name="wind"))
    (listed,) = admin.list_artifacts()
    assert datetime.fromisoformat(listed.created_at).utcoffset() == timedelta(0)
    assert set(httpx.get(url).json()) == {"name", "version"}
    denied = httpx.get(f"{url}/benchmarks/load", params={"benchmark_id": "x"})
    assert set(denied.json()) == {"detail", "error"}
    (invalid,) = httpx.post(f"{url}/access/groups/create", json={}).json()["detail"]
    assert set(invalid) == {"type", "loc", "msg"}
