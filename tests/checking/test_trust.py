"""Signatures of environments: who may rebuild what, and what other users and files can do about it."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import stat
import subprocess
import sys
import time
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


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX's")
def test_a_directory_open_to_others_is_refused_or_closed(config: Path) -> None:
    config.mkdir(mode=0o777)
    config.chmod(0o777)
    with pytest.raises(
        TupliError, match=r"must be writable by you alone: found mode 0777 .* chmod it to 0700"
    ):
        trust.trust(DIGEST)
    config.chmod(0o755)  # others may look: what is in it is private
    (config / "trusted").mkdir()
    (config / "trusted").chmod(0o777)
    trust.trust(DIGEST)
    assert stat.S_IMODE((config / "trusted").stat().st_mode) == 0o700
    config.chmod(0o770)
    with pytest.raises(TupliError, match="must be writable by you alone"):
        trust.is_trusted(DIGEST)


def test_a_linked_key_is_refused(config: Path, tmp_path: Path) -> None:
    """It could lead to a file whose 32 bytes somebody else knows."""
    trust.trust(DIGEST)
    (config / "key").rename(tmp_path / "elsewhere")
    (config / "key").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(TupliError, match="the key .* cannot be read"):
        trust.is_trusted(DIGEST)


def test_a_copied_directory_trusts_the_same(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trust.trust(DIGEST)
    trust.trust_key(OTHER, "alice")
    shutil.copytree(config, tmp_path / "copy")
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "copy"))
    assert trust.trusted_digests() == [DIGEST]
    assert trust.trusted_keys() == [(OTHER, "alice")]
    (tmp_path / "copy/key").write_bytes(os.urandom(32))  # signatures without the key they were made with
    assert trust.trusted_digests() == [] == trust.trusted_keys()


def test_every_flipped_bit_of_a_signature_revokes_it(config: Path) -> None:
    trust.trust(DIGEST)
    trust.trust_key(OTHER, "alice")
    trust.vouch("1b" * 32, OTHER)
    for path in (
        config / "trusted" / DIGEST,
        config / "keys" / OTHER,
        config / "vouched" / f"{'1b' * 32}.{OTHER}",
    ):
        good = path.read_bytes()
        for i in range(0, 8 * len(good), 7):
            changed = bytearray(good)
            changed[i // 8] ^= 1 << i % 8
            path.write_bytes(changed)
            assert not (trust.is_trusted(DIGEST) and trust.trusted_keys() and trust.is_trusted("1b" * 32)), i
        path.write_bytes(good)
    assert trust.trusted_digests() == [DIGEST, "1b" * 32]


def test_signatures_of_one_kind_are_none_of_another(config: Path) -> None:
    """A file that is moved to another place says nothing there."""
    trust.trust(DIGEST)
    trust.trust_key(OTHER, "")
    trust.vouch(DIGEST, OTHER)
    texts = [
        path.read_bytes()
        for directory in ("trusted", "keys", "vouched")
        for path in (config / directory).iterdir()
    ]
    places = [f"trusted/{OTHER}", f"keys/{DIGEST}", f"vouched/{OTHER}.{DIGEST}", f"vouched/{OTHER}.{OTHER}"]
    for place in places:
        for text in texts:
            (config / place).write_bytes(text)
            assert not trust.is_trusted(OTHER)
            assert trust.trusted_keys() == [(OTHER, "")]


def test_keys_vouch_for_as_long_as_they_are_trusted(config: Path) -> None:
    trust.vouch(DIGEST, OTHER)
    assert not trust.is_trusted(DIGEST)
    trust.trust_key(OTHER, " Alice \n of the lab ")
    assert trust.trusted_keys() == [(OTHER, "Alice of the lab")]
    assert trust.is_trusted(DIGEST)
    trust.trust_key(OTHER, os.fsdecode(b"J\xf6rg"))
    assert trust.trusted_keys() == [(OTHER, "J?rg")]
    assert trust.untrust(DIGEST)
    assert not trust.is_trusted(DIGEST)
    trust.vouch(DIGEST, OTHER)
    assert trust.untrust_key(OTHER)
    assert not trust.untrust_key(OTHER)
    trust.trust_key(OTHER, "alice")
    assert not trust.is_trusted(DIGEST)


_CHURN = """
import sys
from tupli_mcap import trust
number = int(sys.argv[1])
mine, shared, key = f"{number:064x}", "5c" * 32, f"{1000 + number:064x}"
print("ready", flush=True)
while True:
    trust.trust(mine); trust.trust(shared); trust.trust_key(key, "k"); trust.vouch(mine, key)
    assert trust.is_trusted(mine)
    trust.untrust(shared); trust.untrust_key(key)
    assert trust.is_trusted(mine)
    trust.trusted_digests()
"""


def test_killed_and_crowding_processes_leave_a_sound_store(config: Path) -> None:
    """Eight processes make the key at once, sign and forget; they are killed one after another."""
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", _CHURN, str(i)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        for i in range(8)
    ]
    try:
        for process in processes:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
        time.sleep(0.3)
        for process in processes:
            time.sleep(0.05)
            assert process.poll() is None, process.stderr and process.stderr.read()
            process.kill()
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert trust.trusted_digests()
    assert set(trust.trusted_digests()) <= {*(f"{i:064x}" for i in range(8)), "5c" * 32}
    trust.trust(DIGEST)
    assert trust.is_trusted(DIGEST)
    assert len((config / "key").read_bytes()) == 32
