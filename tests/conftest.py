"""Fixtures. Every test has its own directories for configuration, cache and data, so that none touches the user's, and
no width of a terminal, even if pytest runs in one."""

from __future__ import annotations

import contextlib
import functools
import gc
import itertools
import multiprocessing
import os
import random
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import certifi
import httpx
import pytest
import typer.testing
from hypothesis import settings

with contextlib.suppress(ImportError):  # `view` hides it from pyarrow, in processes that have not imported it
    import pandas  # noqa: F401

pytest.register_assert_rewrite("storage_contract")  # before it is imported

if TYPE_CHECKING:
    from between import Between
    from postgres import Cluster
    from viewing import HeadlessViewer

    from tupli_mcap.storage.api import TupliAPIClient


@pytest.fixture(scope="session", autouse=True)
def _shared_directories(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache for what is made once for several tests. One authority, instead of all that are known: they are loaded
    whenever a client of a server is made. A client of a bucket needs one at least."""
    authority, end, _ = Path(certifi.where()).read_text().partition("-----END CERTIFICATE-----\n")
    trusted = tmp_path_factory.mktemp("trusted")
    (trusted / "authority.pem").write_text(authority + end)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TUPLI_MCAP_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("SSL_CERT_FILE", str(trusted / "authority.pem"))
        patch.setenv("SSL_CERT_DIR", str(tmp_path_factory.mktemp("no more")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _patient_requests() -> Iterator[None]:
    """An answer may take longer than the five seconds that httpx waits, where the machine is busy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(httpx._config.DEFAULT_TIMEOUT_CONFIG, "read", 120.0)
        yield


@pytest.fixture(scope="session", autouse=True)
def _commands_made_once() -> Iterator[None]:
    """Typer would make all commands of the program anew whenever a test runs one of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.testing, "_get_command", functools.cache(typer.testing._get_command))
        yield


@pytest.fixture(scope="session")
def _directories(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """One directory after another. `mktemp` would look through those of all earlier tests for the next number."""
    parent = tmp_path_factory.mktemp("tests")
    return (parent / str(number) for number in itertools.count())


@pytest.fixture
def tmp_path(_directories: Iterator[Path]) -> Path:
    directory = next(_directories)
    directory.mkdir()
    return directory


@pytest.fixture(autouse=True)
def _private_config(_directories: Iterator[Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    private = next(_directories)
    for name in ["config", "cache", "data"]:
        (private / name).mkdir(parents=True)
        monkeypatch.setenv(f"TUPLI_MCAP_{name.upper()}_DIR", str(private / name))
    monkeypatch.delenv("COLUMNS", raising=False)  # what is printed is as wide as no terminal
    return private / "config"


@pytest.fixture(scope="session")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HeadlessViewer]:
    """One Rerun viewer for all tests; `show` closes open files. Skips if this machine cannot draw."""
    from viewing import HeadlessViewer, NoViewerError

    try:
        viewer = HeadlessViewer(tmp_path_factory.mktemp("viewer"))
    except NoViewerError as err:
        if os.environ.get("CI"):
            raise
        pytest.skip(f"{err}; `tools/setup-viewer` says what is missing")
    with viewer:
        yield viewer


@pytest.fixture(scope="session")
def postgres() -> Iterator[Cluster]:
    """One PostgreSQL for all tests, which make their own databases in it. Skips if it is not installed."""
    from postgres import NoPostgresError, cluster

    try:
        with cluster() as made:
            yield made
    except NoPostgresError as err:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(err))


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Between]:
    """A server behind a proxy that counts bytes and breaks connections."""
    from between import between
    from serving import serving

    from tupli_mcap.server.settings import Settings

    with serving(Settings(tmp_path / "served")) as url, between(url) as proxy:
        yield proxy


@pytest.fixture
def admin(proxy: Between) -> Iterator[TupliAPIClient]:
    """Its admin, signed in."""
    from serving import PASSWORD

    from tupli_mcap.storage.api import TupliAPIClient

    with TupliAPIClient(proxy.url) as client:
        client.login("admin", PASSWORD)
        yield client


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all-cases", action="store_true", help="run all cases of sampled tests, not a sample")


@pytest.hookimpl(tryfirst=True)  # before -k and -m choose
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of a test that is marked as sampled(n, keep=[…]), n of its cases run, and those whose ids are in `keep`.

    Which ones depends on nothing but the test's own name and the ids of its cases. A test that is named runs whole."""
    if config.getoption("all_cases"):
        return
    named = tuple(argument.partition("::")[2] for argument in config.args if "::" in argument)
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sampled") and not item.nodeid.partition("::")[2].startswith(named):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    left_out: set[pytest.Item] = set()
    for name, all_of_it in cases.items():
        mark = all_of_it[0].get_closest_marker("sampled")
        assert mark is not None
        kept = [item for item in all_of_it if item.name.partition("[")[2][:-1] in mark.kwargs.get("keep", ())]
        assert len(kept) == len(mark.kwargs.get("keep", ())), f"{name} has not all the cases to keep"
        others = sorted(set(all_of_it) - set(kept), key=lambda item: item.nodeid)
        chosen = random.Random(name).sample(others, min(mark.args[0], len(others)))
        left_out |= set(others) - set(chosen)
    items[:] = [item for item in items if item not in left_out]
    config.hook.pytest_deselected(items=list(left_out))


def pytest_collectstart() -> None:
    """What is imported while tests are collected is no garbage."""
    gc.disable()


def pytest_collection_finish() -> None:
    """What all tests have imported lasts: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)  # instead of 700: a test leaves little to collect
    gc.enable()


def pytest_configure() -> None:
    """Ctrl-C interrupts what tests start, too where this runs in the background of a shell, which ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    multiprocessing.get_start_method()  # settles it: TorchRL, once imported, would have every process spawned
    os.environ["OMP_NUM_THREADS"] = "1"  # tests run beside each other: PyTorch's threads would wait for cores
    os.environ["PYTHON_KEYRING_BACKEND"] = "keyring.backends.fail.Keyring"  # not the user's
    settings.register_profile("untimed", deadline=None)  # speed is measured in python -m tools.bench
    settings.load_profile("untimed")
