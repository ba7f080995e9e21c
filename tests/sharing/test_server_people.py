"""Users, groups, roles and tokens on the command line."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import pytest
from served import COMMAND
from serving import PASSWORD, serving
from typer.testing import CliRunner

from tupli_mcap import FileStorage, TupliEnvWrapper
from tupli_mcap.cli import app
from tupli_mcap.server.settings import Settings


@pytest.fixture(autouse=True)
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setenv("TUPLI_MCAP_PASSWORD", PASSWORD)
    with serving(Settings(tmp_path / "served")) as url:
        monkeypatch.setenv("TUPLI_MCAP_URL", url)
        yield url


def run(line: str, code: int = 0) -> str:
    done = CliRunner().invoke(app, line.split(), catch_exceptions=False)
    assert done.exit_code == code, done.output
    return done.stdout if code == 0 else done.stderr


def typed(line: str, *answers: tuple[str, str]) -> str:
    """What a command prints in a terminal, where each question is answered."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(
            COMMAND,
            ["tupli-mcap", *line.split()],
            {k: v for k, v in os.environ.items() if "PASSWORD" not in k},
        )
    shown = ""
    for question, answer in answers:
        before = len(shown)
        while not shown[before:].endswith(question):
            shown += os.read(terminal, 1).decode()
        os.write(terminal, f"{answer}\n".encode())
    try:
        while part := os.read(terminal, 4096):
            shown += part.decode()
    except OSError:  # the command has ended
        pass
    os.close(terminal)
    assert os.waitpid(pid, 0)[1] == 0, shown
    return shown.replace("\r", "")


def test_passwords_that_are_typed(url: str) -> None:
    assert typed("login admin", ("Password: ", PASSWORD)) == f"Password: \nsigned in to {url} as admin\n"
    new, again = "Password of the new user: ", "Repeat for confirmation: "
    shown = typed(
        "signup ann", (new, "one-word"), (again, "two-words"), (new, "one-word"), (again, "one-word")
    )
    assert shown == (
        f"{new}\n{again}\nError: The two entered values do not match.\n{new}\n{again}\n"
        f"created the user ann at {url}\n"
    )
    typed("login ann", ("Password: ", "one-word"))
    changed = (("Old password: ", "one-word"), ("New password: ", "another-word"), (again, "another-word"))
    assert typed("password", *changed).endswith(f"changed the password of ann at {url}\n")
    typed("login ann", ("Password: ", "another-word"))


def test_who_may_not_sign_up_is_told_who_creates_users(url: str) -> None:
    assert "an admin creates the users of this server (or --open-signup" in run("signup ann", code=1)


def test_a_group_of_two(url: str) -> None:
    run("login admin")
    for name in ("ann", "bob"):
        run(f"signup {name}")
    run("login ann")
    assert run("create-group robots --description arms") == f"created the group robots at {url}\n"
    assert run("add-members robots bob --role contributor --role member").splitlines() == [
        "group        robots",
        "description  arms",
        "ann          contributor, group_admin",
        "bob          contributor, member",
    ]
    refused = run("add-members robots bob --role admin", code=1)
    assert "Required: artifact_delete; ask an admin for a role that gives it" in refused
    assert re.search(r"^robots +arms$", run("list-groups"), re.MULTILINE)
    assert re.search(r"^bob +global, robots$", run("list-users"), re.MULTILINE)
    assert "bob" not in run("remove-members robots bob")
    assert run("delete-group robots") == f"deleted the group robots at {url}\n"
    assert "everybody is in the group global; it cannot be deleted" in run("delete-group global", 1)
    assert "Group not found" in run("read-group robots", code=1)
    assert "to delete without being asked, give --yes" in run("delete-user ann", code=1)
    assert "ann" in run("list-users")
    assert run("delete-user ann --yes") == f"deleted the user ann at {url}\n"
    assert run("whoami", code=1).endswith(f"sign in: tupli-mcap login USER --url {url}\n")


def test_the_database_makes_an_admin_where_the_password_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("login admin")
    run("signup ann")
    run("login ann")
    monkeypatch.setenv("TUPLI_MCAP_NEW_PASSWORD", "found again")
    assert "Insufficient permissions" in run("password admin", code=1)
    page = Path(__file__).parents[2] / "docs/howto/server.md"
    (told,) = re.findall(r"sqlite3 DIR/server/server.sqlite \"(INSERT .*)\"", page.read_text())
    with contextlib.closing(sqlite3.connect(tmp_path / "served/server/server.sqlite")) as database:
        database.execute(told)
        database.commit()
    assert run("password admin").startswith("changed the password of admin at ")


def test_a_password_must_be_long_enough(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run("login admin")
    monkeypatch.setenv("TUPLI_MCAP_NEW_PASSWORD", "seven77")
    monkeypatch.setenv("TUPLI_MCAP_PASSWORD", "seven77")
    for line in ("signup ann", "password admin"):
        monkeypatch.setenv("TUPLI_MCAP_PASSWORD", PASSWORD if line == "password admin" else "seven77")
        assert "expected a password of 8 to 1024 characters, found 7 characters" in run(line, code=1)
    monkeypatch.setenv("TUPLI_MCAP_PASSWORD", "eight888")
    assert run("signup ann") == f"created the user ann at {url}\n"


def test_a_quota_of_a_user(url: str) -> None:
    run("login admin")
    run("signup ann")
    assert json.loads(run("set-quota ann 4.1 --json"))["result"]["quota"] == 4_100_000_000
    assert run("set-quota ann 1.5") == f"ann may store 1.5 GB at {url}\n"
    assert "User does not exist" in run("set-quota bob 1", code=1)
    assert re.search(r"^ann +0 B +1\.5 GB +global$", run("list-users"), re.MULTILINE)
    assert re.search(r"^admin +0 B +global$", run("list-users"), re.MULTILINE)
    listed = json.loads(run("list-users --json"))["result"]
    assert [(user["used"], user["quota"]) for user in listed] == [(0, None), (0, 1_500_000_000)]
    run("login ann")
    listed = json.loads(run("list-users --json"))["result"]
    assert {(user["used"], user["quota"]) for user in listed} == {(None, None)}
    assert run("list-users").split()[:2] == ["USER", "GROUPS"]
    assert re.search(r"^stored +0 B of 1\.5 GB$", run("whoami"), re.MULTILINE)
    assert "Insufficient permissions" in run("set-quota ann 2", code=1)
    run("login admin")
    assert "as much as the server lets everybody" in run("set-quota ann")
    run("login ann")
    assert re.search(r"^stored +0 B$", run("whoami"), re.MULTILINE)


def test_lists_are_of_the_server_of_the_last_login(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert f"sign in: tupli-mcap login USER --url {url}" in run(
        "list-benchmarks", code=1
    )  # of TUPLI_MCAP_URL
    run("login admin")
    monkeypatch.delenv("TUPLI_MCAP_URL")
    assert run("list-benchmarks") == "no benchmarks\n"
    Path("_local_storage").mkdir()
    with FileStorage("_local_storage") as storage:
        TupliEnvWrapper(gym.make("CartPole-v1"), storage).store("cart")
    assert "cart" in run("list-benchmarks")
    Path("_local_storage").rename("lab")
    assert "no storage" in run("list-artifacts --storage nowhere", code=1)
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "stranger"))
    assert "there is no storage at '_local_storage'" in run("list-episodes", code=1)


def test_a_role_and_what_it_cannot_be(url: str) -> None:
    run("login admin")
    assert run("create-role looker episode_read benchmark_read") == f"created the role looker at {url}\n"
    assert re.search(r"^looker +episode_read, benchmark_read", run("list-roles"), re.MULTILINE)
    run("delete-role looker")
    assert "looker" not in run("list-roles")
    assert "expected rights among benchmark_create" in run("create-role x flying", code=2)


def test_a_token_for_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    run("login admin")
    token = run("create-token ci --days 3").strip()
    (_, listed) = run("list-tokens").splitlines()
    assert re.fullmatch(r"[0-9a-f]{16}  ci +read .*", listed)
    assert token not in listed
    assert "expected a token name of 1 to 100 printable characters" in run(
        f"create-token {'x' * 101}", code=1
    )
    run("logout")
    monkeypatch.setenv("TUPLI_MCAP_TOKEN", token)
    assert "admin" in run("whoami")
    assert "may only read" in run("create-group lab", code=1)
    monkeypatch.delenv("TUPLI_MCAP_TOKEN")
    run("login admin")
    run(f"delete-token {listed.split()[0]}")
    monkeypatch.setenv("TUPLI_MCAP_TOKEN", token)
    assert "not valid" in run("whoami", code=1)
