"""Signatures of environments: who may rebuild what, and what other users and files can do about it."""

from __future__ import annotations

import multiprocessing
import os
import stat
from pathlib import Path

import pytest

from tupli_mcap import trust
from tupli_mcap.errors import TupliError

DIGEST = "0f" * 32
OTHER = "a1" * 32


@pytest.fixture(autouse=True)
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))
    return tmp_path / "config"


def test_nothing_is_trusted_and_nothing_written_until_asked(config: Path) -> None:
    assert not trust.is_trusted(DIGEST)
    assert trust.trusted_digests() == []
    assert not config.exists()


def test_trust_and_untrust(config: Path) -> None:
    trust.trust(DIGEST)
    trust.trust(DIGEST)
    assert trust.is_trusted(DIGEST)
    assert not trust.is_trusted(OTHER)
    assert trust.trusted_digests() == [DIGEST]
    assert trust.untrust(DIGEST)
    assert not trust.untrust(DIGEST)
    assert not trust.is_trusted(DIGEST)


def test_key_and_directories_are_private(config: Path) -> None:
    trust.trust(DIGEST)
    assert stat.S_IMODE(config.stat().st_mode) == 0o700
    assert stat.S_IMODE((config / "trusted").stat().st_mode) == 0o700
    assert stat.S_IMODE((config / "key").stat().st_mode) == 0o600
    assert stat.S_IMODE((config / "trusted" / DIGEST).stat().st_mode) == 0o600
    assert sorted(path.name for path in config.iterdir()) == ["key", "trusted"]


def test_signature_of_another_key_or_digest_counts_for_nothing(config: Path) -> None:
    trust.trust(DIGEST)
    (config / "trusted" / OTHER).write_text(trust.sign(DIGEST))
    assert not trust.is_trusted(OTHER)
    (config / "key").write_bytes(bytes(32))
    assert not trust.is_trusted(DIGEST)


def test_signatures_without_a_key_count_for_nothing(config: Path) -> None:
    trust.trust(DIGEST)
    (config / "key").unlink()
    assert not trust.is_trusted(DIGEST)
    assert not (config / "key").exists()


@pytest.mark.parametrize(
    "digest", ["", "../key", "0f" * 31 + "0G", "0F" * 32, DIGEST + "\n", DIGEST + "0", None]
)
def test_a_digest_is_64_hex_digits(digest: str) -> None:
    for function in (trust.sign, trust.trust, trust.untrust, trust.is_trusted):
        with pytest.raises(TupliError, match="expected a digest of 64 hex digits"):
            function(digest)


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX's")
def test_a_key_open_to_others_is_refused(config: Path) -> None:
    trust.trust(DIGEST)
    (config / "key").chmod(0o644)
    with pytest.raises(TupliError, match="must belong to you alone: expected mode 0600, found 0644"):
        trust.is_trusted(DIGEST)


def test_a_damaged_key_is_said(config: Path) -> None:
    trust.trust(DIGEST)
    (config / "key").write_bytes(b"short")
    with pytest.raises(TupliError, match="must have 32 bytes, found 5"):
        trust.sign(DIGEST)


def test_an_unwritable_place_is_one_error(config: Path) -> None:
    config.write_text("a file where the directory should be")
    with pytest.raises(TupliError, match=r"the key .* cannot be"):
        trust.trust(DIGEST)


def _trust_many(numbers: range) -> None:
    for number in numbers:
        trust.trust(f"{number:064x}")


def test_many_processes_share_one_key() -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_trust_many, args=(range(i * 5, i * 5 + 5),)) for i in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert len(trust.trusted_digests()) == 20
