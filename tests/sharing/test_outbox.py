"""Recording to a server: written here first and sent behind, whatever becomes of the network and of the process."""

from __future__ import annotations

import errno
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from between import Between
from faults import Faults
from served import COMMAND
from waiting import wait_for

from tupli_mcap import TupliEnvWrapper, files
from tupli_mcap.errors import RecordingError, StorageError
from tupli_mcap.schema import F
from tupli_mcap.server.library import Library
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.api.outbox import Outbox


@pytest.fixture
def env(admin: TupliAPIClient) -> Iterator[TupliEnvWrapper]:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), admin)
    env.store(name="cart")
    yield env
    env.close()


def roll(env: TupliEnvWrapper, episodes: int, first_seed: int = 0) -> None:
    for seed in range(first_seed, first_seed + episodes):
        env.reset(seed=seed)
        env.action_space.seed(seed)
        while not env.step(env.action_space.sample())[2]:
            pass


def waiting(client: TupliAPIClient) -> int:
    return len(client._outbox.waiting())


def test_a_full_disk_is_told_and_what_was_recorded_is_sent_later(
    admin: TupliAPIClient, env: TupliEnvWrapper
) -> None:
    roll(env, 4)
    told = []
    for at in range(100):
        with Faults(admin._outbox.directory, at, errno.ENOSPC, lasting=True)() as faults:
            try:
                admin.flush()
            except (StorageError, RecordingError) as err:
                told.append(str(err))
        if not faults.failed:
            break
    assert told
    assert all("No space left on device; free some space there" in each for each in told)
    assert admin.count_episodes() == 4


def test_episodes_are_sent_once_while_they_are_recorded_and_once_with_the_whole(
    proxy: Between, admin: TupliAPIClient, env: TupliEnvWrapper
) -> None:
    roll(env, 150)
    before = proxy.up
    assert admin.count_episodes() == 150
    first = proxy.up - before
    for i in range(10):
        roll(env, 1, 150 + i)
        assert admin.count_episodes() == 151 + i
    assert proxy.up - before < 3 * first  # and not 11 times as much
    listed = admin.list_episodes()
    assert [header.episode for header in listed] == list(range(160))
    assert len({header.recording for header in listed}) == 11
    env.close()
    whole = admin.list_episodes()
    assert [header.id for header in whole] == [header.id for header in listed]
    assert len({header.recording for header in whole}) == 1
    with admin.open_recording(listed[-1].recording) as recording:  # by the name of a part that is no more
        assert len(recording) == 160
    assert waiting(admin) == 0


def test_a_run_without_a_name_is_named_as_in_a_directory(admin: TupliAPIClient) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), admin, max_bytes=8000, chunk_size=1000)
    env.store(name="cart")
    roll(env, 20)
    assert {header.run["name"] for header in admin.list_episodes()} == {"cart"}  # of parts
    roll(env, 40, 20)
    env.close()
    listed = admin.list_episodes()
    assert len({header.recording for header in listed}) > 2
    assert {header.run["name"] for header in listed} == {"cart"}


def test_what_was_deleted_does_not_come_back_with_the_whole(
    admin: TupliAPIClient, env: TupliEnvWrapper
) -> None:
    roll(env, 3)
    assert admin.delete_episodes(F("episode") <= 2) == 3  # all that there are: nothing is left of them
    roll(env, 2)
    env.reset()
    env.step(0)
    admin.delete_episodes(F("episode") == 3)
    env.close()
    assert [header.episode for header in admin.list_episodes()] == [4, 5]


def test_recording_neither_waits_for_a_server_that_is_away_nor_fails(
    proxy: Between, admin: TupliAPIClient
) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), admin, max_bytes=1)  # each episode in a file of its own
    env.store(name="cart")
    proxy.go_away()
    roll(env, 3)
    with pytest.raises(StorageError, match="does not answer"):
        admin.flush()
    env.close()
    assert waiting(admin) == 3
    proxy.come_back()
    wait_for(lambda: not waiting(admin))  # nobody asks
    assert len(admin.list_episodes()) == 3


def test_another_url_loses_nothing_and_is_quiet(
    proxy: Between, admin: TupliAPIClient, env: TupliEnvWrapper
) -> None:
    url = admin.url
    proxy.go_away()
    roll(env, 2)
    env.close()
    admin.set_url("http://127.0.0.1:9")
    assert TupliAPIClient().url == "http://127.0.0.1:9"
    with pytest.raises(StorageError, match="http://127.0.0.1:9 does not answer"):
        admin.list_benchmarks()
    admin.set_url(url)
    proxy.come_back()
    assert admin.count_episodes() == 2


RECORDS = """
import os, sys
import gymnasium as gym
import tupli_mcap.recording.write.writer
from tupli_mcap import TupliEnvWrapper, files
from tupli_mcap.storage import TupliAPIClient

client = TupliAPIClient(sys.argv[1])
if "boot" in sys.argv:
    tupli_mcap.recording.write.writer.boot_id = lambda: "one boot"
chunk_size = 3000 if "chunks" in sys.argv else 1 << 18
durability = "step" if "sealed" in sys.argv else "os"
env = TupliEnvWrapper(gym.make("CartPole-v1"), client, chunk_size=chunk_size, durability=durability)
env.store(name="cart")
for seed in range(30 if "chunks" in sys.argv else 3):
    env.reset(seed=seed)
    while not env.step(env.action_space.sample())[2]:
        pass
    if seed % 10 == 1 and "asks" in sys.argv:
        print(client.count_episodes(), flush=True)
env.reset(seed=3)
env.step(0)
print("recorded", flush=True)
sys.stdin.readline()
"""


def records(url: str, *words: str) -> subprocess.Popen[str]:
    """A process that has recorded three episodes and a step, and waits for a line."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", RECORDS, url, *words], **pipes)
    for line in process.stdout or ():
        if line == "recorded\n":
            return process
    raise AssertionError(process.stderr and process.stderr.read())


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


@pytest.mark.parametrize("words", [(), ("asks",)], ids=str)
def test_what_a_killed_process_has_recorded_is_finished_and_sent_by_the_next(
    proxy: Between, admin: TupliAPIClient, words: tuple[str, ...]
) -> None:
    process = records(proxy.url, *words)
    kill(process)
    (left,) = admin._outbox.waiting()
    assert left.state == "unfinished"
    admin._outbox.send_left()  # as a client that is made next does
    wait_for(lambda: not waiting(admin))
    headers = admin.list_episodes()
    assert [header.end for header in headers] == ["terminal"] * 3 + ["interrupted"]  # type: ignore[union-attr]
    assert len({header.recording for header in headers}) == 1


LOOKS = """
import os, sys
from tupli_mcap.storage import TupliAPIClient

client = TupliAPIClient(sys.argv[1])
if "flush" in sys.argv:
    client.flush()
    os._exit(0)
if "logout" in sys.argv:
    client.logout()
"""


def looks(url: str, *words: str) -> str:
    """Runs a process that records nothing; returns what it writes to stderr."""
    command = [sys.executable, "-c", LOOKS, url, *words]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=240, check=True)
    return done.stderr


def test_a_dry_run_sends_nothing_that_was_left(proxy: Between, admin: TupliAPIClient) -> None:
    kill(records(proxy.url))
    command = [sys.executable, "-m", "tupli_mcap", "push", "--dry-run", "--url", proxy.url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)
    assert done.stdout.startswith("would send 1 recording, ")
    assert (waiting(admin), admin.count_episodes()) == (1, 0)


def test_the_command_that_sends_what_was_left_counts_it(proxy: Between, admin: TupliAPIClient) -> None:
    kill(records(proxy.url))
    command = [sys.executable, "-m", "tupli_mcap", "push", "--url", proxy.url]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)
    assert done.stdout.startswith("sent 1 recording, ")
    assert (waiting(admin), admin.count_episodes()) == (0, 4)


@pytest.mark.sampled(0, keep=["()"])
@pytest.mark.parametrize("words", [(), ("flush",)], ids=str)
def test_a_short_program_that_records_nothing_sends_what_was_left(
    proxy: Between, admin: TupliAPIClient, words: tuple[str, ...]
) -> None:
    kill(records(proxy.url))
    assert waiting(admin) == 1
    assert looks(proxy.url, *words) == ""
    assert waiting(admin) == 0
    assert admin.count_episodes() == 4


def test_what_the_server_refuses_of_another_program_is_no_error(
    proxy: Between, admin: TupliAPIClient
) -> None:
    kill(records(proxy.url))
    admin._session.ask("PUT", "/v1/users/admin/quota", {"bytes": 1})
    looks(proxy.url, "flush")
    assert waiting(admin) == 1


def test_signing_out_keeps_what_cannot_be_sent(proxy: Between, admin: TupliAPIClient) -> None:
    kill(records(proxy.url))
    admin._session.tokens.end(admin.url)
    assert "who is not signed in any more" in looks(proxy.url, "logout")
    assert admin.username == ""


def test_a_program_that_ends_has_sent_what_it_recorded(proxy: Between, admin: TupliAPIClient) -> None:
    process = records(proxy.url)
    _, errors = process.communicate("\n", timeout=120)
    assert (process.returncode, errors) == (0, "")
    assert admin.count_episodes() >= 3


def test_a_program_that_ends_while_the_server_is_away_says_what_waits(
    proxy: Between, admin: TupliAPIClient
) -> None:
    process = records(proxy.url)
    proxy.go_away()
    _, errors = process.communicate("\n", timeout=120)
    assert process.returncode == 0
    assert "tupli-mcap push sends it" in errors
    assert "Traceback" not in errors
    proxy.come_back()
    assert waiting(admin) == 1


def test_a_command_that_ends_while_the_server_is_away_says_what_waits_in_one_line(
    proxy: Between, admin: TupliAPIClient
) -> None:
    kill(records(proxy.url))
    proxy.go_away()
    done = subprocess.run(
        [COMMAND, "list-tokens", "--url", proxy.url], stderr=subprocess.PIPE, text=True, check=False
    )
    assert done.stderr.count("\n") == 2, done.stderr
    error, warning = done.stderr.splitlines()
    assert done.returncode == 1 and error.startswith("error: ") and "does not answer" in error
    assert warning.startswith("warning: what was recorded waits in ")


def test_damaged_recordings_are_saved_as_far_as_they_can_be(proxy: Between, admin: TupliAPIClient) -> None:
    kill(records(proxy.url, "chunks", "asks"))
    (left,) = admin._outbox.waiting()
    Path(f"{left.path}.journal").unlink(missing_ok=True)
    with pytest.warns(RuntimeWarning, match="was damaged: what could be saved"):
        admin._outbox.flush(everything=True)
    assert admin.count_episodes() >= 22  # which had been sent
    assert waiting(admin) == 0
    assert [path.name for path in (admin._outbox.directory / "damaged").rglob("*.mcap")] == [left.path.name]


def test_what_was_recorded_before_the_machine_was_started_anew_is_sent(
    admin: TupliAPIClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill(records(admin.url, "chunks", "boot", "sealed"))
    monkeypatch.setattr("tupli_mcap.journal.file.boot_id", lambda: "another boot")
    admin._outbox.flush(everything=True)
    assert waiting(admin) == 0
    assert [header.end for header in admin.list_episodes()] == ["terminal"] * 30 + ["interrupted"]


def test_a_recording_at_which_the_server_fails_holds_up_no_other(
    admin: TupliAPIClient, env: TupliEnvWrapper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take_in = Library.take_in

    def failing(self: Library, caller: Any, incoming: Any, name: str) -> str:
        if "-bad-" in name:
            raise RuntimeError("a mistake of the server")
        return take_in(self, caller, incoming, name)

    served = tmp_path / "served" / "recordings" / str(env.id)
    with monkeypatch.context() as patch:
        patch.setattr(Library, "take_in", failing)
        for name in ["bad", "good"]:
            env = TupliEnvWrapper(env.env, admin, env.id, name=name)
            roll(env, 2)
            env._finish()
        wait_for(lambda: len(list(served.glob("*-good-*"))) == 1)
        env = TupliEnvWrapper(env.env, admin, env.id, name="better")
        roll(env, 1)
        env._finish()
        with pytest.raises(StorageError, match="-bad-.* was not sent, and is kept: the server has failed"):
            admin.flush()
        assert len(list(served.glob("*-better-*"))) == 1
    admin.flush()
    assert (admin.count_episodes(), waiting(admin)) == (5, 0)


def test_of_two_processes_one_sends_and_the_other_waits_for_that(
    proxy: Between, admin: TupliAPIClient
) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), admin, max_bytes=1)
    env.store(name="cart")
    proxy.go_away()
    roll(env, 6)
    env.close()
    proxy.come_back()
    senders = [admin._outbox, *(Outbox(admin._session.another()) for _ in range(2))]
    before = proxy.up
    with ThreadPoolExecutor(3) as pool:
        for done in [pool.submit(sender.flush, everything=True) for sender in senders]:
            done.result()
    assert waiting(admin) == 0
    assert sorted(header.seed or 0 for header in admin.list_episodes()) == list(range(6))
    assert proxy.up - before < 6 * 15_000  # each was sent once


def test_a_directory_that_another_program_removes_meanwhile_is_passed_over(admin: TupliAPIClient) -> None:
    directory = admin._outbox.directory
    directory.mkdir(parents=True)
    with ThreadPoolExecutor(1) as pool:
        writing = pool.submit(lambda: [files.write_bytes(directory / "note", b"") for _ in range(400)])
        while not writing.done():
            assert not admin._outbox.waiting()
        writing.result()
