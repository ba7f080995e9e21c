"""What every test gets: a configuration directory of its own, so that no test trusts anything for the user."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def _private_config(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path_factory.mktemp("config")
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(directory))
    return directory


def pytest_configure() -> None:
    """Ctrl-C interrupts what tests start, too where this runs in the background of a shell, which ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
