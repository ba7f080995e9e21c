"""What --json prints is what docs/reference/json.md says, of its type; each field on the page was printed."""

from __future__ import annotations

import datetime
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric import ed25519
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from damaged import chunks, hit, record
from gymnasium import spaces
from serving import PASSWORD, serving
from test_cli import COMMANDS, fill
from typer.testing import CliRunner

from tupli_mcap import EpisodeData, FileStorage, write_recording
from tupli_mcap.cli import app
from tupli_mcap.cli.output import JSON_VERSION
from tupli_mcap.server.settings import Settings
from tupli_mcap.wrappers.rollout import record_rollouts

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "json.md").read_text()
WITHOUT_JSON = {"browse", "serve", "help", "version"}


def tables(page: str) -> dict[str, tuple[bool, dict[str, str]]]:
    """By section whether it is about a list, and the type of each field."""
    found = {}
    for section in page.split("\n## ")[1:]:
        title, _, body = section.partition("\n")
        fields: dict[str, str] = {}
        for names, kinds in re.findall(r"^\| (`.*?) \| (.*?) \|", body, re.MULTILINE):
            keys, each = re.findall(r"`(.+?)`", names), kinds.split(", ")
            fields |= zip(keys, each if len(each) == len(keys) else each * len(keys), strict=True)
        for name in re.findall(r"`(.+?)`", title):
            found[name] = "\nA list of these" in body, fields
    return found


TABLES = tables(PAGE)
TYPES: dict[str, Any] = {
    "text": str, "integer": int, "number": (int, float), "boolean": bool, "list": list, "object": dict,
    "null": type(None),
}  # fmt: skip


def is_of(value: object, kind: str) -> bool:
    if kind == "time":
        return isinstance(value, str) and datetime.datetime.fromisoformat(value).tzinfo is datetime.UTC
    return isinstance(value, TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def fields_in(value: Any, fields: dict[str, str], path: str = "") -> set[str]:
    """The fields of a value, each of which is of its type; those of an object are those that the page lists."""
    seen = {path} & fields.keys()
    if seen:
        assert any(is_of(value, kind) for kind in fields[path].split(" or ")), (path, fields[path], value)
    if isinstance(value, list) and any(name.startswith(f"{path}[]") for name in fields):
        seen.update(*(fields_in(item, fields, f"{path}[]") for item in value))
    prefix = f"{path}." if path else ""
    listed = {re.split(r"[.[]", name.removeprefix(prefix))[0] for name in fields if name.startswith(prefix)}
    if isinstance(value, dict) and listed:
        assert value.keys() == listed, path
        seen.update(*(fields_in(item, fields, prefix + key) for key, item in value.items()))
    return seen


def document(*words: object, code: int = 0) -> dict[str, Any]:
    done = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert done.exit_code == code, done.output
    found: dict[str, Any] = json.loads(done.stdout)
    assert found["version"] == JSON_VERSION
    return found


@pytest.fixture
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory with a storage, and recordings that are good, damaged, of no use for training, and none at all."""
    monkeypatch.chdir(tmp_path)
    fill(Path("lab"))
    with FileStorage("lab") as storage:
        storage.delete_episode(storage.list_episodes()[0].id)
    record_rollouts(
        "CartPole-v1", "runs/a.mcap", steps=200, seed=1, name="a", metadata={"lr": 0.1}, tags=["b"]
    )
    shutil.copy("runs/a.mcap", "a.mcap")
    damaged = record(Path("damaged.mcap"))
    hit(damaged, chunks(damaged, "/step")[2])
    Path("bad.mcap").write_bytes(b"nonsense")
    Path("blocked").mkdir()
    Path("blocked/recordings").write_bytes(b"no directory")
    states = np.array([[0, 0], [np.nan, 0], [0, 0]], np.float32)
    last = np.array([False, False, True])
    nan = EpisodeData(states, np.array([0, 1, 0]), np.ones(3), last, np.zeros(3, bool))
    box = spaces.Box(-1, 1, (2,), np.float32)
    write_recording("nan.mcap", [nan], observation_space=box, action_space=spaces.Discrete(2))
    Path("json_rewards.py").write_text("def halved(episode):\n    return episode.rewards / 2\n")
    key = ed25519.Ed25519PrivateKey.generate()
    Path("key").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, NoEncryption()))
    Path("key.pub").write_bytes(key.public_key().public_bytes(Encoding.OpenSSH, PublicFormat.OpenSSH))


CALLS = """
record: record CartPole-v1 -o new.mcap --steps 20
list-benchmarks: list-benchmarks --storage lab
list-artifacts: list-artifacts --storage lab
list-episodes: list-episodes --storage lab
rename: rename {pole} pole2 --description standing --storage lab --dry-run
compact: compact --storage lab --dry-run
reindex: reindex --storage lab
declare-key: declare-key metadata.score --storage lab
trust --key: trust --key key.pub --name me
bundle: bundle {pole} -o signed.mcap --storage lab --sign key
bundle: bundle {wind} -o wind.mcap --storage lab
export: export --storage lab --filter seed=2 -o exported.mcap
import: import signed.mcap --storage other --from key.pub
trust FILE: trust signed.mcap --show
trust FILE: trust wind.mcap
trust --list: trust --list
untrust: untrust wind.mcap
untrust: untrust --key key.pub
filter: filter runs/a.mcap --filter steps>15 -o some.mcap
trim: trim runs/a.mcap --steps :5 -o trimmed.mcap
relabel: relabel runs/a.mcap --function json_rewards:halved -o halved.mcap
delete: delete runs/a.mcap --episodes 0-1
delete: delete runs/a.mcap --episodes all --dry-run
restore: restore runs --dry-run --episodes 1
restore: restore runs
merge: merge runs/a.mcap -o merged.mcap --dry-run
split: split runs/a.mcap -o part.mcap --episodes 5 --dry-run
recover: recover damaged.mcap
tag: tag a.mcap success=true --episodes 0-2
edit: edit a.mcap --name b
ls: ls a.mcap bad.mcap lab | 1
info FILE: info a.mcap
info FILE: info some.mcap --filter steps>20
info FILE: info signed.mcap
info DIRECTORY: info lab
info DIRECTORY: info runs --episodes best
info DIRECTORY: info a.mcap lab
episodes: episodes lab
doctor: doctor nan.mcap bad.mcap a.mcap | 1
doctor --list: doctor --list
verify: verify lab runs damaged.mcap nan.mcap --rerun --episodes 0 | 1
view: view a.mcap --save a.rrd
view: view a.mcap --layout a.json
plot: plot a.mcap
render --rerun: render a.mcap -o film.mcap --episodes first --every 10
render: render film.mcap -o film.gif --episodes first
tag: tag a.mcap --undo
login: login admin --url {url}
whoami: whoami
signup: signup ann
push: push lab
push: push runs/a.mcap bad.mcap | 1
pull: pull {pole} --storage pulled
pull: pull {pole} --storage blocked | 1
publish: publish {pole}
unpublish: unpublish {pole}
password: password ann
ls: ls {url}
list-users: list-users
set-quota: set-quota ann 0.5
create-group: create-group lab --description us
list-groups: list-groups
add-members: add-members lab ann
read-group: read-group lab
remove-members: remove-members lab ann
delete-group: delete-group lab
create-role: create-role looker episode_read
list-roles: list-roles
delete-role: delete-role looker
create-token: create-token ci --forever
create-token: create-token robot --write
list-tokens: list-tokens
delete-token: delete-token {token}
delete-user: delete-user ann --yes
push: push --dry-run
backup-server: backup-server served -o backup
restore-server: restore-server backup again
logout: logout
"""
EMPTY = {
    "attachments_lost[]", "ends_lost[]", "final_states_lost[]", "foreign[]", "info_keys[]",
    "left_over[]", "notes[]", "options[]", "skipped[]", "starts_lost[]",
}  # fmt: skip
"""Lists in which nothing is here."""


@pytest.fixture
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A server."""
    monkeypatch.setenv("TUPLI_MCAP_PASSWORD", PASSWORD)
    monkeypatch.setenv("TUPLI_MCAP_NEW_PASSWORD", "another password")
    with serving(Settings(tmp_path / "served")) as url:
        yield url


@pytest.mark.usefixtures("room")
def test_every_command_prints_what_the_page_says(url: str) -> None:
    with FileStorage("lab") as storage:
        ids = {header.metadata.name: header.id for header in storage.list_benchmarks()} | {"url": url}
    seen: dict[str, set[str]] = {section: set() for section in TABLES}
    for section, line in (call.split(": ", 1) for call in CALLS.strip().split("\n")):
        call, _, code = line.partition(" | ")
        words = call.format(**ids).split()
        found = document(*words, code=int(code or 0))
        if section == "create-token":
            ids["token"] = found["result"]["id"]
        assert (list(found), found["command"]) == (["version", "command", "result"], words[0])
        are_several, fields = TABLES[section]
        assert isinstance(found["result"], list) == are_several
        for item in found["result"] if are_several else [found["result"]]:
            seen[section] |= fields_in(item, fields)
    for section, (_, fields) in TABLES.items():
        assert fields.keys() - seen[section] <= EMPTY, section
    told = {section.split()[0] for section in TABLES}
    assert told == set(COMMANDS) - WITHOUT_JSON


@pytest.mark.parametrize(
    ("words", "kind", "code"),
    [
        (["info", "gone.mcap"], "RecordingError", 1),
        (["list-episodes"], "StorageError", 1),
        (["ls", ".", "--filter", "return >"], "FilterError", 2),
        (["ls", "--sort", "colour"], "UsageError", 2),
        (["browse", "a.mcap"], "UsageError", 2),
        (["verify", "empty"], "RecordingError", 1),
        (["nothing"], "UsageError", 2),
        (["nothing", "ls"], "UsageError", 2),
        (["replay", "gone.mcap"], "RecordingError", 1),
    ],
)
def test_an_error_is_a_document_too(
    words: list[str], kind: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TUPLI_MCAP_STORAGE", raising=False)
    (tmp_path / "empty").mkdir()
    done = CliRunner().invoke(app, [*words, "--json"])
    message = done.stderr.removeprefix("error: ").rstrip("\n")
    assert (done.exit_code, bool(message)) == (code, True)
    assert json.loads(done.stdout) == {
        "version": JSON_VERSION,
        "command": {"nothing": None, "replay": "view"}.get(words[0], words[0]),
        "error": {"type": kind, "message": message, "exit_code": code},
    }


@pytest.mark.parametrize(
    ("error", "kind", "code"),
    [(KeyboardInterrupt(), "Interrupted", 130), (PermissionError(13, "no"), "OSError", 1)],
)
def test_what_ends_a_command_is_a_document_too(
    error: BaseException, kind: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any) -> None:
        raise error

    monkeypatch.setattr("tupli_mcap.storage.listing.list_recordings", fails)
    assert document("ls", code=code)["error"]["type"] == kind


def test_a_bug_is_a_document_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> None:
        raise RuntimeError("a bug")

    monkeypatch.setattr("tupli_mcap.storage.listing.list_recordings", fails)
    done = CliRunner().invoke(app, ["ls", "--json"])
    assert isinstance(done.exception, RuntimeError)
    assert json.loads(done.stdout)["error"] == {"type": "RuntimeError", "message": "a bug", "exit_code": 1}


def test_nothing_follows_a_document(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fails() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.modules["tupli_mcap.cli.app"], "flush", fails)
    assert "result" in document("ls", code=1)


def test_the_examples_of_the_page() -> None:
    result, error = (json.loads(line) for line in PAGE.split("```json\n")[1].split("```")[0].splitlines())
    assert (list(result), list(error)) == (["version", "command", "result"], ["version", "command", "error"])
    assert {result["version"], error["version"]} == {JSON_VERSION}
