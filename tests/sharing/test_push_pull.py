"""Between a directory and a server: push, pull, publish; downloads that are kept; what may run of it."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import gymnasium as gym
import httpx
import numpy as np
import pytest
import web_server
from between import Between, Fault
from malicious import MODULE, _store as store, pickles, specs
from persons import Person
from serving import PASSWORD, serving
from typer.testing import CliRunner
from waiting import wait_for
from windy import WindyWrapper, windy

import tupli_mcap
from tupli_mcap import FileStorage, RecordEpisodes, Recording, TupliEnvWrapper, progress
from tupli_mcap.cli import app
from tupli_mcap.environment import EnvironmentRecord, capture
from tupli_mcap.errors import FormatError, RecordingError, StorageError, UntrustedError
from tupli_mcap.schema import (
    ArtifactMetadata,
    BenchmarkMetadata,
    BenchmarkQuery,
    F,
    Group,
    GroupMembership,
    GroupMembershipQuery,
)
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.base import TupliStorage
from tupli_mcap.storage.benchmark_json import BenchmarkContent, benchmark_hash, pack
from tupli_mcap.storage.downloads import fetched
from tupli_mcap.storage.exchange import copy_episodes
from tupli_mcap.wrappers.rollout import record_rollouts


def fill(lab: Path, episodes: int = 12, name: str = "cart") -> str:
    env = TupliEnvWrapper(gym.make("Pendulum-v1"), lab)
    uri = env.store(name=name)
    for seed in range(episodes):
        env.reset(seed=seed)
        while not env.step(env.action_space.sample())[3]:
            pass
    env.close()
    return uri


def pushed(admin: TupliAPIClient, lab: Path) -> str:
    uri = fill(lab)
    with FileStorage(lab) as storage:
        copy_episodes(storage, admin, benchmark_id=uri)
    return uri


def run(*words: object) -> str:
    done = CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def test_a_whole_recording_comes_and_goes_as_the_file_that_it_is(
    proxy: Between, admin: TupliAPIClient, tmp_path: Path
) -> None:
    uri = pushed(admin, tmp_path / "lab")
    with FileStorage(tmp_path / "lab") as lab, FileStorage(tmp_path / "pulled") as pulled:
        assert copy_episodes(admin, pulled, benchmark_id=uri)[uri].episodes == 12
        one, other = (storage.root / storage.list_episodes()[0].recording for storage in (lab, pulled))
        assert one.read_bytes() == other.read_bytes()
        before = proxy.up + proxy.down
        assert copy_episodes(admin, pulled, benchmark_id=uri)[uri].episodes == 0
        assert copy_episodes(lab, admin, benchmark_id=uri)[uri].episodes == 0
        assert proxy.up + proxy.down - before < one.stat().st_size  # nothing came again
    with FileStorage(tmp_path / "again") as again:  # what was fetched is kept
        before = proxy.down
        assert copy_episodes(admin, again, benchmark_id=uri)[uri].episodes == 12
        assert proxy.down - before < one.stat().st_size


def test_the_command_deletes_on_a_server(admin: TupliAPIClient, tmp_path: Path) -> None:
    pushed(admin, tmp_path / "lab")
    worst = admin.list_episodes(F("episode") < 2)
    told = json.loads(run("delete", admin.url, "--filter", "episode < 2", "--dry-run", "--json"))["result"]
    assert told == {"dry_run": True, "episodes": [header.id for header in worst]}
    assert admin.count_episodes() == 12
    assert run("delete", admin.url, "--filter", "episode < 2") == "deleted 2 episodes\n"
    assert min(header.episode for header in admin.list_episodes()) == 2
    for words in (["--episodes", "3"], [str(tmp_path / "lab"), "--filter", "episode < 4"], ["--filter", ""]):
        refused = CliRunner().invoke(app, ["delete", admin.url, *words])
        assert refused.exit_code == 2
    refused = CliRunner().invoke(app, ["delete", admin.url, "--filter", "episode < 2"])
    assert (refused.exit_code, refused.output.count("no episode that matches")) == (1, 1)
    assert admin.count_episodes() == 10


def test_episodes_of_a_server_cannot_be_annotated_there(admin: TupliAPIClient, tmp_path: Path) -> None:
    pushed(admin, tmp_path / "lab")
    dataset = tupli_mcap.open(admin)
    for annotate in (dataset[0].annotate, dataset.head(1).annotate):
        with pytest.raises(RecordingError, match="pull") as refused:
            annotate(success=True)
        assert str(refused.value).startswith(f"episode {dataset[0].id} cannot be changed here; download it")
        assert "recordings/" not in str(refused.value)
    tagged = CliRunner().invoke(app, ["tag", admin.url, "--episodes", "all", "good=true"])
    assert (tagged.exit_code, tagged.output.count("fetch episodes with tupli-mcap pull, or")) == (2, 1)


def test_the_picture_of_a_servers_episodes_is_not_named_after_its_address(
    admin: TupliAPIClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pushed(admin, tmp_path / "lab")
    monkeypatch.chdir(tmp_path)
    assert run("plot", admin.url).startswith("report.png: 12 episodes")


def test_what_has_grown_is_sent_and_fetched_as_what_is_new(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "lab" / "run.mcap"
    path.parent.mkdir()
    for seed, new in ((0, 1), (1, 1), (2, 1)):
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
            env.reset(seed=seed)
            while not env.step(env.action_space.sample())[2]:
                pass
        with FileStorage(path.parent) as lab, FileStorage(tmp_path / "pulled") as pulled:
            for source, target in ((lab, admin), (admin, pulled)):
                assert sum(each.episodes for each in copy_episodes(source, target).values()) == new
    assert [header.episode for header in admin.list_episodes()] == [0, 1, 2]
    assert sorted(header.episode for header in pulled.list_episodes()) == [0, 1, 2]


def test_of_a_directory_all_but_the_damaged_recordings_are_sent(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    uri = fill(lab := tmp_path / "lab", 2)
    bad = [lab / "bad.mcap", lab / "worse.mcap"]
    for seed, path in enumerate([*bad, lab / "good.mcap"]):
        record_rollouts("CartPole-v1", path, steps=500, seed=seed)
    for path in bad:
        with Recording(path) as recording:
            chunk = recording.file.store.table[0]
        content = bytearray(path.read_bytes())
        content[int(chunk["offset"] + chunk["length"]) - 9] ^= 255
        path.write_bytes(content)
    refused = CliRunner().invoke(app, ["push", str(lab)])
    assert refused.exit_code == 1
    sent, *_ = refused.stdout.splitlines()
    stored = admin.list_episodes()
    assert sent == (
        f"sent {len(stored)} episodes of 1 benchmark to {admin.url}, but not those of 2 recordings"
    )
    assert {each.benchmark_id for each in stored} == {uri, ""}
    assert len({each.recording for each in stored}) == 2
    for line, path in zip(refused.stderr.splitlines(), bad, strict=True):
        assert line.startswith(f"error: {path}: expected an undamaged recording, found damage: ")
    (lab / "none.mcap").write_bytes(b"no recording")
    shutil.copy(lab / "good.mcap", lab / "zcopy.mcap")
    refused = CliRunner().invoke(app, ["push", str(lab)])
    assert (refused.exit_code, len(refused.stderr.splitlines())) == (1, 4)
    assert f"error: {lab / 'none.mcap'}: expected an MCAP file" in refused.stderr
    assert refused.stderr.startswith(f"warning: skipped a copy: {lab / 'zcopy.mcap'} holds episodes of ")
    assert "skipped a recording" not in refused.stderr
    (lab / "none.mcap").unlink()
    (lab / "zcopy.mcap").unlink()
    refused = CliRunner().invoke(app, ["push", str(lab), "--json"])
    told = json.loads(refused.stdout)["result"]
    assert refused.exit_code == 1
    assert (told["episodes"], [each["path"] for each in told["errors"]]) == (0, list(map(str, bad)))


def test_of_a_directory_a_refused_benchmark_does_not_stop_the_others(tmp_path: Path) -> None:
    uri = fill(lab := tmp_path / "lab", 2)
    record_rollouts("CartPole-v1", lab / "plain.mcap", steps=50, seed=1)
    with serving(Settings(tmp_path / "served", max_body=500)) as url, TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        refused = CliRunner().invoke(app, ["push", str(lab), "--url", url])
        assert {each.benchmark_id for each in client.list_episodes()} == {""}
        shutil.rmtree(lab / "recordings")
        alone = CliRunner().invoke(app, ["push", str(lab), "--url", url])
    assert alone.stderr.startswith(
        f"error: {lab}/benchmarks/{uri}.json: expected a body of at most 500 bytes"
    )
    assert refused.exit_code == 1 and "but not those of 1 recording" in refused.stdout
    assert re.fullmatch(
        rf"error: {lab}/recordings/\S+: expected a body of at most 500 bytes.*\n", refused.stderr
    )


def test_warnings_count_over_all_benchmarks(admin: TupliAPIClient, tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    for name in ("cart", "pendulum"):
        fill(lab, 3, name)
    run("push", lab)
    admin.delete_episodes(F("episode") == 1)
    run("tag", lab, "--filter", "episode = 0", "good=true")
    warned = CliRunner().invoke(app, ["push", str(lab)])
    assert (warned.exit_code, warned.stderr) == (
        0,
        "warning: there already with other metadata, and left so: 2 episodes; `tupli-mcap push FILE` sends a recording "
        "anew\nwarning: not copied: 2 episodes that had been deleted there\n",
    )


def test_of_a_server_all_but_the_damaged_recordings_are_fetched(tmp_path: Path) -> None:
    for seed, name in enumerate(("bad", "good")):
        record_rollouts("CartPole-v1", tmp_path / f"{name}.mcap", steps=500, seed=seed, name=name)
    with serving(Settings(tmp_path / "served")) as url, TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        bad, good = (client.push(tmp_path / f"{name}.mcap") for name in ("bad", "good"))
        client.publish_episodes(F("run.name") == "bad")
        stored = tmp_path / "served" / bad
        content = bytearray(stored.read_bytes())
        content[len(content) // 2] ^= 255
        stored.write_bytes(content)
        words = ["pull", "--filter", "steps > 0", "--storage", str(tmp_path / "lab"), "--url", url]
        refused = CliRunner().invoke(app, words)
        assert (refused.exit_code, refused.stdout.count(", but not those of 1 recording\n")) == (1, 1)
        assert refused.stderr.startswith(f"error: {bad}: ")
        with FileStorage(tmp_path / "lab") as lab:
            ids = {each.id for each in lab.list_episodes()}
        assert ids == {each.id for each in client.list_episodes(F("recording") == good)}
        told = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)["result"]
        assert [each["path"] for each in told["errors"]] == [bad]
        stored.write_bytes(b"")
        with pytest.raises(FormatError, match=f"^{re.escape(bad)} is empty"):  # no path of the server
            client.open_recording(bad, [0])
        stored.unlink()
        gone = CliRunner().invoke(app, [*words[:-3], str(tmp_path / "other"), *words[-2:]])
        assert (gone.exit_code, gone.stdout.count(", but not those of 1 recording\n")) == (1, 1)
        lost = f"the server has lost {bad}; a backup may have it (says {url})"
        assert gone.stderr == f"error: {lost}\n"
        with pytest.raises(StorageError, match=re.escape(lost)):  # of which the server has to cut a part
            client.open_recording(bad, [0])


def test_annotations_of_what_is_there_are_sent_with_the_file(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "lab" / "run.mcap"
    path.parent.mkdir()
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=0)
        env.step(0)
    with FileStorage(path.parent) as lab:
        copy_episodes(lab, admin)
        tupli_mcap.open(path)[0].annotate(good=True)
        with pytest.warns(
            UserWarning,
            match="there already with other metadata, and left so: 1 episode; `tupli-mcap push FILE`",
        ):
            copy_episodes(lab, admin)
    assert admin.list_episodes()[0].metadata == {}
    result = CliRunner().invoke(app, ["push", str(path), "--url", admin.url])
    assert result.exit_code == 0, result.output
    assert admin.list_episodes()[0].metadata == {"good": True}


def test_pulling_a_filter_and_an_episode(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = pushed(admin, tmp_path / "lab")
    chosen = [header.id for header in admin.list_episodes(F("seed") >= 9)]
    target = tmp_path / "some"
    dry = run("pull", "--filter", "seed >= 9", "--storage", target, "--dry-run")
    assert dry == f"would fetch 3 episodes of 1 benchmark into {target}\n"
    assert not target.exists()
    run("pull", "--filter", "seed >= 9", "--storage", target)
    run("pull", admin.list_episodes(F("seed") == 0)[0].id, "--storage", target)
    with FileStorage(target) as storage:
        assert sorted(storage.list_episodes(), key=lambda h: h.episode)[0].seed == 0
        assert {header.id for header in storage.list_episodes(F("seed") > 0)} == set(chosen)
        assert storage.load_benchmark(uri).metadata.name == "cart"
    gone = CliRunner().invoke(app, ["pull", "0" * 32 + "-0", "--storage", str(target)])
    assert (gone.exit_code, "there is no episode with id" in gone.stderr) == (1, True)


def test_pulling_everything_that_one_may_read(admin: TupliAPIClient, tmp_path: Path) -> None:
    seen, unseen = fill(tmp_path / "lab", 2, "cart"), fill(tmp_path / "lab", 1, "pole")
    record_rollouts("CartPole-v1", tmp_path / "lab" / "teleop.mcap", steps=5, seed=1)
    run("push", tmp_path / "lab")
    signed_in(admin, "bob")
    target = tmp_path / "mine"
    assert run("pull", "--all", "--storage", target).endswith("; there is none that you may read\n")
    admin.login("admin", PASSWORD)
    run("publish", seen)
    admin.publish_episodes(F("benchmark_id") == "")
    admin.login("bob", "bob's password")
    assert run("pull", "--all", "--storage", target) == f"fetched 3 episodes of 1 benchmark into {target}\n"
    with FileStorage(target) as storage:
        assert [each.id for each in storage.list_benchmarks()] == [seen] != [unseen]
        names = {each.run["name"]: Path(each.recording).name for each in storage.list_episodes()}
    assert names.keys() == {"cart", "teleop"}  # of runs, and so are files
    assert all(f"-{name}-" in file for name, file in names.items())
    for words in ([], ["--all", seen], ["--all", "--filter", "steps > 0"]):
        refused = CliRunner().invoke(app, ["pull", *words])
        assert (refused.exit_code, refused.output.count("or --all alone")) == (2, 1)


def test_deleted_episodes_of_a_file_are_not_sent(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        for seed in range(4):
            env.reset(seed=seed)
            env.step(0)
    run("delete", path, "--episodes", "3")
    assert run("push", path, "--dry-run") == f"would send 3 episodes of {path} to {admin.url}\n"
    assert admin.count_episodes() == 0
    assert run("push", path).startswith(f"sent 3 episodes of {path} to {admin.url}\n")
    assert [header.episode for header in admin.list_episodes()] == [0, 1, 2]
    run("restore", path)
    run("delete", path, "--episodes", "0")
    with pytest.raises(StorageError, match="is stored with episode 0, which this file lacks"):
        admin.push(path)
    admin.delete_episodes(F("episode") >= 0)
    with admin.open_recording(admin.push(path)) as recording:
        assert recording.index["episode"].tolist() == [1, 2, 3]


def test_several_files_are_pushed_and_those_that_are_there_are_not_sent_again(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    one, two = paths = [tmp_path / "one.mcap", tmp_path / "two #1?.mcap"]
    for seed, path in enumerate(paths):
        record_rollouts("CartPole-v1", path, steps=5, seed=seed)
    uri = fill(tmp_path / "lab", 2)
    assert run("push", one).startswith(f"sent 1 episode of {one} to {admin.url}\n")
    assert run("push", one, two, tmp_path / "lab").startswith(
        f"already there: 1 episode of {one} at {admin.url}\n"
        f"sent 1 episode of {two} to {admin.url}\n"
        f"sent 2 episodes of 1 benchmark to {admin.url}\n"
    )
    assert run("push", one, "--dry-run") == f"already there: 1 episode of {one} at {admin.url}\n"
    told = json.loads(run("push", one, two, tmp_path / "lab", "--json"))["result"]
    names = [header.recording for header in admin.list_episodes(F("benchmark_id") == "")]
    assert sorted(told.pop("recordings")) == sorted(names)
    assert told == {"dry_run": False, "url": admin.url, "benchmarks": [uri], "episodes": 0, "errors": []}


def test_of_several_the_others_are_sent(admin: TupliAPIClient, tmp_path: Path) -> None:
    one, bad, two = paths = [tmp_path / f"{name}.mcap" for name in ("one", "bad", "two")]
    bad.write_bytes(b"nonsense")
    for seed in range(2):
        record_rollouts("CartPole-v1", paths[2 * seed], steps=5, seed=seed)
    refused = CliRunner().invoke(app, ["push", *map(str, paths)])
    assert refused.exit_code == 1
    assert refused.stdout.startswith(
        f"sent 1 episode of {one} to {admin.url}\nsent 1 episode of {two} to {admin.url}\nto let others see it: "
    )
    why = refused.stderr.removeprefix("error: ").strip()
    assert why.startswith(f"{bad}: expected an MCAP file")
    refused = CliRunner().invoke(app, ["push", *map(str, paths), "--json"])
    told = json.loads(refused.stdout)["result"]
    assert (refused.exit_code, len(told["recordings"]), told["episodes"]) == (1, 2, 0)
    assert told["errors"] == [{"path": str(bad), "message": why}]
    alone = CliRunner().invoke(app, ["push", str(bad), "--json"])
    assert (alone.exit_code, json.loads(alone.stdout)["error"]["message"]) == (1, why)


def test_what_is_not_finished_is_not_sent(proxy: Between, admin: TupliAPIClient, tmp_path: Path) -> None:
    (path := tmp_path / "lab" / "my run.mcap").parent.mkdir()
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=0)
        env.step(0)
        refused = CliRunner().invoke(app, ["push", str(path)])
        assert refused.exit_code == 1
        assert refused.stderr == f"error: {path} is being recorded; send it when its writer has closed it\n"
        shutil.copytree(path.parent, tmp_path / "killed")
    killed, cut = tmp_path / "killed" / path.name, tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-500])
    for each in (killed, cut):
        refused = CliRunner().invoke(app, ["push", str(each)])
        assert (refused.exit_code, refused.stderr.count("\n")) == (1, 1)
        assert refused.stderr.startswith(
            f"error: {each} is not finished: its writer was killed, or its end is"
        )
        before = proxy.up
        with pytest.raises(
            RecordingError, match=f"tupli-mcap recover {shlex.quote(str(each))}, and send that"
        ):
            admin.push(each)
        assert proxy.up == before
    with web_server.serving() as web:
        web.files["/r.mcap"] = cut.read_bytes()
        refused = CliRunner().invoke(app, ["push", web.url()])
        assert refused.stderr.startswith(f"error: {web.url()} is not finished: ")
        assert "; download it, write a finished copy with tupli-mcap recover FILE" in refused.stderr
    assert run("recover", killed).startswith(f"{killed}: ")
    assert run("push", f"{killed}".replace(".mcap", ".recovered.mcap")).startswith("sent 1 episode of ")


def test_a_damaged_recording_is_not_stored_and_replaces_nothing(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    record_rollouts("CartPole-v1", path, steps=500, seed=1)
    good = path.read_bytes()
    with Recording(path) as recording:
        chunk, attachment = recording.file.store.table[0], recording.file.contents.attachments
        places = [int(chunk["offset"] + chunk["length"]) - 9]
        places += [each.offset + each.length - 9 for each in attachment.values()]
    for there in (False, True):
        for place in places:
            path.write_bytes(good[:place] + bytes([good[place] ^ 255]) + good[place + 1 :])
            refused = CliRunner().invoke(app, ["push", str(path)])
            said = " ".join(refused.stderr.split())
            assert refused.exit_code == 1, place
            assert "expected an undamaged recording, found damage: " in said and "uploads" not in said
            assert "or what tupli-mcap recover FILE saves" in said
            assert bool(admin.list_episodes()) == there
        path.write_bytes(good)
        name = admin.push(path)
    assert {header.recording for header in admin.list_episodes()} == {name}
    with admin.open_recording(name) as stored:
        assert len(stored.read().rewards) == 500


def test_a_run_without_a_name_keeps_that_of_its_file(admin: TupliAPIClient, tmp_path: Path) -> None:
    files = [
        "lab/teleop.mcap",
        "my räw dáta #1.mcap",
        "20261126T150639-ppo-35c375effd9c.mcap",
        os.fsdecode(b"\xff.mcap"),
    ]
    (tmp_path / "lab").mkdir()
    for seed, name in enumerate(files):
        record_rollouts("CartPole-v1", tmp_path / name, steps=5, seed=seed)
        run("push", (tmp_path / name).parent if seed == 0 else tmp_path / name)
    fill(tmp_path / "more", 1)
    run("push", tmp_path / "more")
    names = sorted(each.run["name"] for each in admin.list_episodes())
    assert names == ["_", "cart", "my_r_w_d_ta_1", "ppo", "teleop"]
    for header in admin.list_episodes():
        with admin.open_recording(header.recording) as recording:
            assert recording.run.name == header.run["name"]


def test_pushing_a_recording_from_another_web_server(admin: TupliAPIClient, tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=30, seed=1)
    with web_server.serving() as web:
        web.files["/r.mcap"] = (tmp_path / "run.mcap").read_bytes()
        said = run("push", web.url() + "?sig=SECRET")
        assert said.startswith(f"sent 2 episodes of {web.url()} to {admin.url}\n") and "SECRET" not in said
    assert sum(header.n_tuples for header in admin.list_episodes()) == 30


def test_a_path_that_is_not_there_is_not_pushed(admin: TupliAPIClient, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["push", str(tmp_path / "nope"), "--url", admin.url])
    assert result.exit_code == 1 and "does not exist; give a recording" in result.output
    assert not (tmp_path / "nope").exists()


def test_dry_runs_change_nothing(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = fill(tmp_path / "lab")
    assert run("push", tmp_path / "lab", "--dry-run") == (
        f"would send 12 episodes of 1 benchmark to {admin.url}\n"
    )
    assert admin.list_benchmarks() == []
    run("push", tmp_path / "lab")
    assert "would publish" in run("publish", uri, "--dry-run")
    assert admin.list_benchmarks(F("published_in") == "global") == []
    run("publish", uri)
    assert "would hide" in run("unpublish", uri, "--dry-run")
    assert len(admin.list_episodes(F("published_in") == "global")) == 12


def test_push_says_how_to_publish(
    admin: TupliAPIClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = fill(tmp_path / "lab", 2)
    assert run("push", tmp_path / "lab").endswith(f"to let others see it: tupli-mcap publish {uri[:8]}\n")
    assert "to let others" not in run("push", tmp_path / "lab")
    for seed in range(3):
        record_rollouts("CartPole-v1", tmp_path / f"{seed}.mcap", steps=5, seed=seed)
    *_, way = shlex.split(run("push", tmp_path / "0.mcap").splitlines()[1])
    assert run("publish", "--filter", way) == "published 1 episode in global\n"
    said = run("push", tmp_path / "1.mcap", tmp_path / "2.mcap")
    ways = [shlex.split(line)[-1] for line in said.splitlines()[-2:]]
    for way in ways:
        assert run("publish", "--filter", way) == "published 1 episode in global\n"
    for seed in range(10, 14):
        record_rollouts("CartPole-v1", tmp_path / f"{seed}.mcap", steps=5, seed=seed)
    said = run("push", *(tmp_path / f"{seed}.mcap" for seed in range(10, 14)))
    to_let = "to let others see it: tupli-mcap publish"
    assert said.endswith(f"{to_let} --filter 'run.name = \"NAME\"'\n")
    ids = sorted(fill(tmp_path / "labs", 1, f"cart {number}")[:8] for number in range(4))
    record_rollouts("CartPole-v1", tmp_path / "labs" / "run.mcap", steps=5, seed=20)
    assert run("push", tmp_path / "labs").splitlines()[1:] == [
        f"{to_let} BENCHMARK_ID, for each of {' '.join(ids)}",
        f"{to_let} --filter 'run.name = \"NAME\"'",
    ]
    record_rollouts("CartPole-v1", tmp_path / "3.mcap", steps=5, seed=3)
    monkeypatch.setenv("TUPLI_MCAP_URL", "http://127.0.0.1:1")
    assert run("push", tmp_path / "3.mcap", "--url", admin.url).endswith(f" --url {admin.url}\n")


def test_publishing_nothing_is_an_error(admin: TupliAPIClient, tmp_path: Path) -> None:
    run("publish", pushed(admin, tmp_path / "lab"))
    bob = signed_in(admin, "bob")
    for filter_text in ("return > 5000", "episode >= 0"):  # Bob has none
        for dry in ([], ["--dry-run"]):
            refused = CliRunner().invoke(app, ["publish", "--filter", filter_text, *dry])
            assert (refused.exit_code, "no episode of yours matches" in refused.stderr) == (1, True)
    assert bob.count_episodes(F("created_by") == "bob") == 0


def test_publish_only_the_episodes_that_match(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = fill(tmp_path / "lab")
    run("push", tmp_path / "lab")
    seen = F("published_in") == "global"
    few = admin.count_episodes(F("episode") < 2)
    assert 0 < few < 12
    assert f" with {few} episodes in global" in run("publish", uri, "--filter", "episode < 2")
    assert admin.count_episodes(seen) == few and len(admin.list_benchmarks(seen)) == 1
    assert f"hid {few} episodes of {uri[:8]} from global" in run("unpublish", uri, "--filter", "episode < 5")
    assert admin.count_episodes(seen) == 0 and len(admin.list_benchmarks(seen)) == 1


def test_episodes_of_a_hidden_benchmark_cannot_be_pulled(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = fill(tmp_path / "lab")
    run("push", tmp_path / "lab")
    advice = f"the benchmark is not published in global: tupli-mcap publish {uri[:8]}\n"
    published = CliRunner().invoke(app, ["publish", "--filter", "episode < 2"])
    assert (published.exit_code, published.stderr.endswith(advice)) == (0, True)
    bob = signed_in(admin, "bob")
    with FileStorage(tmp_path / "bob") as mine, pytest.warns(UserWarning, match="ask admin to publish it$"):
        assert copy_episodes(bob, mine, F("episode") < 2) == {}
    admin.login("admin", PASSWORD)
    admin.publish_benchmark(uri)
    again = CliRunner().invoke(app, ["publish", "--filter", "episode < 2"])
    assert (again.exit_code, again.stderr) == (0, "")


def test_episodes_without_a_benchmark_are_published_by_a_filter(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=5, seed=1, name="teleop")
    run("push", tmp_path / "run.mcap")
    seen, chosen = F("published_in") == "global", ("--filter", 'run.name = "teleop"')
    assert run("publish", *chosen, "--dry-run") == "would publish 1 episode in global\n"
    assert admin.count_episodes(seen) == 0
    told = json.loads(run("publish", *chosen, "--json"))["result"]
    assert told == {"dry_run": False, "benchmark": None, "group": "global", "episodes": 1}
    assert admin.count_episodes(seen) == 1
    assert run("unpublish", *chosen, "--dry-run") == "would hide 1 episode from global\n"
    assert run("unpublish", *chosen) == "hid 1 episode from global\n"
    assert admin.count_episodes(seen) == 0
    for command in ("publish", "unpublish"):
        refused = CliRunner().invoke(app, [command])
        assert (refused.exit_code, "expected a BENCHMARK_ID or --filter" in refused.output) == (2, True)


@pytest.mark.sampled(0, keep=["3-pickle", "3-spec"])
@pytest.mark.parametrize("kind", ["pickle", "spec"])
@pytest.mark.parametrize("every", [1, 3])
def test_nothing_from_a_server_runs(admin: TupliAPIClient, tmp_path: Path, every: int, kind: str) -> None:
    """Listing, reading and fetching run nothing, and rebuilding is refused, from the server and from the directory."""
    marker = tmp_path / "marker"
    cases = pickles(marker) if kind == "pickle" else specs()
    with FileStorage(tmp_path / "evil") as evil, FileStorage(tmp_path / "pulled") as pulled:
        for name, value in itertools.islice(cases, None, None, every):
            record = EnvironmentRecord(f"{MODULE}:Env", **{kind: value})
            uri = store(evil, record, BenchmarkMetadata(name=name))
            copy_episodes(evil, admin, benchmark_id=uri)
            copy_episodes(admin, pulled, benchmark_id=uri)
            assert len(admin.list_episodes(F("benchmark_id") == uri, include_tuples=True)) == 2
            for storage in (admin, pulled):
                with pytest.raises(UntrustedError):
                    TupliEnvWrapper.load(storage, uri)
                (header, *_) = storage.list_episodes(F("benchmark_id") == uri)
                with storage.open_recording(header.recording) as recording, pytest.raises(UntrustedError):
                    recording.benchmark.make_env()
    assert not marker.exists()
    assert MODULE not in sys.modules


# --- downloads ---


def test_a_download_that_breaks_off_goes_on(
    proxy: Between, admin: TupliAPIClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = np.random.default_rng(0).bytes(3 << 20)
    uri = admin.store_artifact(data, ArtifactMetadata(name="noise")).id
    before = proxy.down
    admin._session._client.close()
    monkeypatch.setattr(admin._session, "_process", 0)  # connections anew
    proxy.faults += [Fault("reset", 1 << 20), Fault("5xx"), Fault("refuse"), Fault("reset", 1 << 20)]
    assert admin.load_artifact(uri) == data
    assert proxy.down - before < 1.5 * len(data)  # what was on its way when it broke off came twice
    before = proxy.down
    assert admin.load_artifact(uri) == data
    assert proxy.down - before < 10_000


def test_a_killed_download_goes_on_in_the_next_process(tmp_path: Path) -> None:
    data = bytes(range(256)) * 1000
    digest = hashlib.sha256(data).hexdigest()
    asked = []

    def pieces(start: int, stop: int = len(data)) -> Iterator[bytes]:
        asked.append(start)
        yield data[start:stop]

    def broken(start: int) -> Iterator[bytes]:
        yield from pieces(start, 1000)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), fetched(digest, broken):
        pass
    with fetched(digest, pieces) as path:
        assert path.read_bytes() == data
    with fetched(digest, pieces) as path:
        assert path.read_bytes() == data
    assert asked == [0, 1000]


def test_wrong_bytes_are_an_error_and_not_kept(proxy: Between, admin: TupliAPIClient) -> None:
    data = bytes(200_000)
    uri = admin.store_artifact(data, ArtifactMetadata(name="zeros")).id
    admin._session._process = 0
    proxy.faults += [Fault("flip", 100_000)]
    with pytest.raises(FormatError, match=f"expected bytes with the SHA-256 {uri}.*not kept"):
        admin.load_artifact(uri)
    assert admin.load_artifact(uri) == data


def test_what_is_kept_stays_within_a_budget_and_what_is_used_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CACHE_BYTES", "2500")
    kept = Path(os.environ["TUPLI_MCAP_CACHE_DIR"]) / "downloads"
    some = {hashlib.sha256(data).hexdigest(): data for data in (bytes([i]) * 1000 for i in range(6))}
    first, *others, last = some
    with fetched(first, lambda _: [some[first]]) as used:
        for digest in others:
            with fetched(digest, lambda _, data=some[digest]: [data]):
                pass
        assert used.exists()
        assert {path.name for path in kept.iterdir()} == {first, others[-1]}
    monkeypatch.setenv("TUPLI_MCAP_CACHE_BYTES", "0")
    with fetched(last, lambda _: [some[last]]):
        pass
    assert list(kept.iterdir()) == []
    monkeypatch.setenv("TUPLI_MCAP_CACHE_BYTES", "much")
    with (
        pytest.raises(StorageError, match="TUPLI_MCAP_CACHE_BYTES to be a number"),
        fetched(first, lambda _: []),
    ):
        pass


def test_a_bundle_at_a_url_is_fetched_once(tmp_path: Path) -> None:
    uri = fill(tmp_path / "lab", 2)
    with FileStorage(tmp_path / "lab") as lab, web_server.serving() as server:
        lab.bundle(uri, tmp_path / "b.mcap")
        server.files["/r.mcap"] = (tmp_path / "b.mcap").read_bytes()
        assert "imported 2 of 2 episodes" in run("import", server.url(), "--storage", tmp_path / "mine")
        assert server.sent < 1.1 * len(server.files["/r.mcap"])


def test_a_url_without_room_for_it_is_not_fetched(
    admin: TupliAPIClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=50, seed=1)
    with web_server.serving() as server:
        server.files["/r.mcap"] = data = (tmp_path / "run.mcap").read_bytes()
        admin.set_quota("admin", len(data) - 1)
        with monkeypatch.context() as patched:
            patched.setattr(
                tempfile, "tempdir", str(tmp_path / "nowhere")
            )  # for a copy there would be no place
            for dry in ([], ["--dry-run"]):
                refused = CliRunner().invoke(app, ["push", server.url(), *dry])
                assert (refused.exit_code, "0 B are used; delete artifacts" in refused.stderr) == (1, True)
        admin.set_quota("admin", len(data))
        assert run("push", server.url()).startswith("sent ")
        assert run("push", server.url()).startswith("already there: ")


def test_a_stopped_command_leaves_no_copy_of_a_url(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=50, seed=1)
    place = tmp_path / "temporary"
    place.mkdir()
    with web_server.serving() as server:
        server.files["/r.mcap"], server.delay = (tmp_path / "run.mcap").read_bytes(), 3.0
        command = [sys.executable, "-m", "tupli_mcap", "verify", server.url()]
        with subprocess.Popen(command, env=os.environ | {"TMPDIR": str(place)}) as process:
            wait_for(lambda: any(place.rglob("r.mcap")))
            process.terminate()
        assert list(place.iterdir()) == []


def test_threads_fetch_a_file_once() -> None:
    asked: list[int] = []
    gate = threading.Barrier(4)
    digest = hashlib.sha256(bytes(100_000)).hexdigest()

    def pieces(start: int) -> Iterator[bytes]:
        asked.append(start)
        yield bytes(100_000)

    def use() -> None:
        gate.wait()
        with fetched(digest, pieces) as path:
            assert path.stat().st_size == 100_000

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert asked == [0]


def test_what_two_users_have_published_is_fetched_once(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=60, seed=1)
    with serving(Settings(tmp_path / "served")) as url:
        for person in (admin := Person(url, "admin"), made_by(admin, "ann")):
            person.send((tmp_path / "run.mcap").read_bytes())
            person.ask("POST", "/v1/episodes/publish", {"filter": None, "group": "global"})
        made_by(admin, "bob")
        with TupliAPIClient(url) as bob, FileStorage(tmp_path / "mine") as mine:
            bob.login("bob", "bob's password")
            (copied,) = copy_episodes(bob, mine).values()
            assert copied.episodes == len(mine.list_episodes()) == len(bob.list_episodes())
    assert len(list((tmp_path / "mine").rglob("*.mcap"))) == 1


def made_by(admin: Person, name: str) -> Person:
    admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
    return Person(admin.url, name)


NAMES = (
    "line\nbreak.mcap", "tab\t.mcap", "back\\slash.mcap", "%2e%2e.mcap", "a%2Fb.mcap", "\U0001f916.mcap", "é/run.mcap",
    "e/run.mcap", "q?x=1#y&z.mcap", "\"'<b>.mcap", "\r\nX-Evil: 1.mcap", f"{'d' * 200}/{'e' * 200}.mcap", "\u202e.mcap",
)  # fmt: skip


@pytest.mark.filterwarnings("ignore:not served")
def test_a_served_directory_may_have_files_of_any_names(tmp_path: Path) -> None:
    """They are listed, sent with harmless headers, shown, and fetched; but for a name that is no text."""
    files = {}
    for seed, name in enumerate((*NAMES, os.fsdecode(b"\xff.mcap"))):
        path = tmp_path / "lab" / "recordings" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=20, seed=seed)
        files[f"recordings/{name}"] = (tmp_path / "run.mcap").rename(path).read_bytes()
    files.popitem()
    with serving(Settings(tmp_path / "lab")) as url, TupliAPIClient(url) as admin:
        admin.login("admin", PASSWORD)
        listed = {header.recording: header for header in admin.list_episodes()}
        assert listed.keys() == files.keys()
        person = Person(url, "admin")
        with httpx.Client(base_url=url, headers={"Accept": "text/html"}, timeout=60) as browser:
            browser.post("/sign-in", data={"username": "admin", "password": PASSWORD})
            for name, data in files.items():
                answer = httpx.get(url + person.ask("POST", "/v1/tickets", {"recording": name})["path"])
                assert (answer.status_code, answer.content) == (200, data), name
                told = f"attachment; filename*=utf-8''{quote(name.rpartition('/')[2])}"
                assert answer.headers["Content-Disposition"] == told
                assert "X-Evil" not in answer.headers
                assert browser.get(f"/episode/{listed[name].id}").status_code == 200
        with FileStorage(tmp_path / "mine") as mine:
            copy_episodes(admin, mine)
            assert {header.id for header in mine.list_episodes()} == {
                header.id for header in admin.list_episodes()
            }
    fetched = {path.read_bytes() for path in (tmp_path / "mine").rglob("*.mcap")}
    assert fetched == set(files.values())


# --- what is somebody else's ---


def signed_in(admin: TupliAPIClient, name: str) -> TupliAPIClient:
    """A new user, who is signed in on this machine from now on."""
    made_by(Person(admin.url, "admin"), name)
    admin.login(name, f"{name}'s password")
    return admin


def recorded_to(client: TupliAPIClient, uri: str) -> None:
    env = TupliEnvWrapper.load(client, uri)
    env.reset(seed=7)
    env.step(env.action_space.sample())
    env.close()
    client.flush()


def test_publishing_own_episodes_of_somebody_else_s_benchmark(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = pushed(admin, tmp_path / "lab")
    run("publish", uri)
    bob = signed_in(admin, "bob")
    for command in (["publish"], ["publish", "--dry-run"]):
        refused = CliRunner().invoke(app, [*command, uri])
        assert (refused.exit_code, "nothing of this is yours" in refused.stderr) == (1, True)
    recorded_to(bob, uri)
    own, seen = F("created_by") == "bob", F("published_in") == "global"
    of_it = f"1 episode of {uri[:8]}"
    assert run("publish", uri, "--dry-run") == f"would publish {of_it} in global\n"
    assert bob.count_episodes(own & seen) == 0
    assert run("publish", uri) == f"published {of_it} in global\n"
    assert bob.count_episodes(own & seen) == 1
    assert run("unpublish", uri, "--dry-run") == f"would hide {of_it} from global\n"
    assert run("unpublish", uri) == f"hid {of_it} from global\n"
    assert (bob.count_episodes(own & seen), bob.count_episodes(seen)) == (0, 12)
    assert len(bob.list_benchmarks(seen)) == 1


@pytest.mark.parametrize("full", ["benchmark", "episode"])
def test_publishing_a_benchmark_is_all_or_nothing(admin: TupliAPIClient, tmp_path: Path, full: str) -> None:
    uri = pushed(admin, tmp_path / "lab")
    publish, one = admin.publish_benchmark, uri
    if full == "episode":
        publish, one = admin.publish_episode, admin.list_episodes()[0].id
    groups = (f"{number:02}{'x' * 60}" for number in itertools.count())
    with pytest.raises(StorageError, match="expected groups of at most"):
        while group := next(groups):
            admin.create_group(group)
            publish(one, group)
    for dry in ([], ["--dry-run"]):
        refused = CliRunner().invoke(app, ["publish", uri, "--group", group, *dry])
        assert (refused.exit_code, "expected groups of at most" in refused.stderr) == (1, True)
    assert group not in admin.load_benchmark(uri).published_in
    assert admin.count_episodes(F("published_in") == group) == 0


def test_nothing_is_hidden_from_a_group_that_sees_nothing(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri = pushed(admin, tmp_path / "lab")
    assert admin.create_group("robots") == Group(name="robots")
    for words in ([uri], ["--filter", "episode >= 0"]):
        for group, why in (
            ("robots", "of this, nothing that is yours is published in robots"),
            ("robot", "or you are not in it (did you mean 'robots'?)"),
        ):
            for dry in ([], ["--dry-run"]):
                refused = CliRunner().invoke(app, ["unpublish", *words, "--group", group, *dry])
                assert (refused.exit_code, why in refused.stderr) == (1, True)
        refused = CliRunner().invoke(app, ["publish", *words, "--group", "robot", "--dry-run"])
        assert (refused.exit_code, "did you mean 'robots'?" in refused.stderr) == (1, True)


def cart_with(artifact: str, storage: TupliStorage) -> str:
    """The id of a new benchmark that needs an artifact."""
    record, metadata = capture(gym.make("CartPole-v1")), BenchmarkMetadata(name="cart")
    digest = benchmark_hash(BenchmarkContent(record, (artifact,)), metadata)
    query = BenchmarkQuery(hash=digest, serialized=pack(record, (artifact,)), metadata=metadata)
    return storage.store_benchmark(query).id


def test_a_copy_of_somebody_else_s_benchmark_comes_and_goes_with_its_artifacts(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    artifact = admin.store_artifact(b"wind", ArtifactMetadata(name="wind", description="of 2019")).id
    uri = cart_with(artifact, admin)
    run("publish", uri)
    bob = signed_in(admin, "bob")
    run("pull", uri, "--storage", tmp_path)
    with FileStorage(tmp_path) as lab:
        assert lab.load_artifact(artifact) == b"wind"
        assert copy_episodes(lab, bob, dry_run=True)[uri].artifacts == 1
        assert copy_episodes(lab, bob)[uri].artifacts == 1
        assert copy_episodes(lab, bob)[uri].artifacts == 0
    bob.login("admin", PASSWORD)
    bob.unpublish_artifact(artifact, "global")
    bob.login("bob", "bob's password")
    (item,) = bob.list_artifacts()
    assert (item.created_by, item.description) == ("bob", "of 2019")
    assert bob.load_artifact(artifact) == b"wind"


def test_a_pushed_bundle_of_somebody_else_s_benchmark_comes_with_it_and_its_artifacts(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    env = WindyWrapper(windy(), tmp_path / "lab")
    uri = env.store(name="windy")
    env.reset(seed=7)
    while not env.step(env.action_space.sample())[3]:
        pass
    env.close()
    with FileStorage(tmp_path / "lab") as lab:
        lab.bundle(uri, tmp_path / "bundle.mcap")
        plain = tmp_path / "lab" / lab.list_episodes()[0].recording
        copy_episodes(lab, admin)
    run("publish", uri)
    bob, of_bob = signed_in(admin, "bob"), F("created_by") == "bob"
    run("push", plain)  # it has no artifacts, and the server has its benchmark
    run("push", tmp_path / "bundle.mcap", "--dry-run")
    assert not bob.list_benchmarks(of_bob) and not bob.list_artifacts(of_bob)
    for _ in range(2):
        run("push", tmp_path / "bundle.mcap")
    assert len(bob.list_benchmarks(of_bob)) == len(bob.list_artifacts(of_bob)) == 1
    run("publish", uri)
    bob.login("admin", PASSWORD)
    assert bob.delete_benchmark(uri, episodes=True) == 1
    for artifact in bob.list_artifacts(F("created_by") == "admin"):
        bob.delete_artifact(artifact.id)
    cid = signed_in(bob, "cid")
    assert WindyWrapper.load(cid, uri, trust=True).get_wrapper_attr("data").shape == (50,)
    assert [header.created_by for header in cid.list_episodes()] == ["bob"]


def test_who_may_see_a_benchmark_can_load_it(admin: TupliAPIClient) -> None:
    env = WindyWrapper(windy(), admin)
    uri = env.store(name="windy")
    env.publish()
    bob = signed_in(admin, "bob")
    loaded = WindyWrapper.load(bob, uri, trust=True)
    assert np.array_equal(loaded.get_wrapper_attr("data"), env.get_wrapper_attr("data"))


def test_artifacts_that_are_somebody_else_s_stay_as_they_are(admin: TupliAPIClient) -> None:
    artifact = admin.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
    admin.create_group(Group(name="robots"))
    admin.publish_artifact(artifact, "robots")
    Person(admin.url, "admin").ask("POST", "/v1/users", {"username": "bob", "password": "bob's password"})
    member = GroupMembership(user="bob", roles=["contributor"])
    admin.add_group_members(GroupMembershipQuery(group_name="robots", members=[member]))
    admin.login("bob", "bob's password")
    uri = cart_with(artifact, admin)
    result = CliRunner().invoke(app, ["publish", uri, "--group", "robots"])
    assert (result.exit_code, result.stderr) == (0, "")
    dry = CliRunner().invoke(app, ["publish", uri, "--dry-run"])
    result = CliRunner().invoke(app, ["publish", uri])
    assert (result.exit_code, dry.stderr) == (0, result.stderr)
    assert "not published in global: 1 artifact of others that" in result.stderr
    admin.unpublish_benchmark(uri, "global")
    with httpx.Client(base_url=admin.url, headers={"Accept": "text/html"}, timeout=60) as browser:
        browser.post("/sign-in", data={"username": "bob", "password": "bob's password", "next": "/"})
        address = f"/share?dataset={uri}"
        (code,) = set(re.findall('name="code" value="([^"]+)"', browser.get(address).text))
        assert "1 artifact that it needs" not in browser.get(address).text
        answer = browser.post("/share", data={"code": code, "dataset": uri, "group": "global"})
        assert answer.status_code == 303, answer.text
        assert "1 artifact that it needs" in browser.get(address).text
    assert "global" in admin.load_benchmark(uri).published_in
    assert admin.load_benchmark(uri).published_in == ["bob", "robots", "global"]
    assert admin.list_artifacts()[0].published_in == ["admin", "robots"]


# --- what is not there, or no more ---


def test_a_filter_whose_key_no_episode_has_is_an_error(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "lab" / "run.mcap"
    path.parent.mkdir()
    record_rollouts("CartPole-v1", path, steps=5, seed=1)
    tupli_mcap.open(path)[0].annotate(score=1)
    uri = fill(tmp_path / "cart", 1)
    run("push", path.parent, tmp_path / "cart")
    one = admin.list_episodes()[0].id
    for words, where in (
        (["push", path.parent, tmp_path / "cart"], "metadata has score"),
        (["pull", "--storage", tmp_path / "new"], "metadata has score"),
        (["pull", one, "--storage", tmp_path / "new"], "metadata has "),
        (["pull", uri, "--storage", tmp_path / "new"], "metadata has no keys"),
        (["publish"], "metadata has score"),
        (["publish", uri], "metadata has no keys"),
        (["unpublish"], "metadata has score"),
    ):
        for test, dry in itertools.product(("metadata.scre > 0", "not metadata.scre"), ([], ["--dry-run"])):
            refused = CliRunner().invoke(app, [*map(str, words), "--filter", test, *dry])
            assert (refused.exit_code, "no episode has metadata.scre" in refused.stderr) == (2, True), words
            assert where in refused.stderr
    assert admin.list_benchmarks(F("published_in") == "global") == []
    assert not (tmp_path / "new").exists()
    run("push", tmp_path / "cart", path.parent, "--filter", "metadata.score > 0")  # one of them has it


@pytest.mark.parametrize(("deleted", "told"), [("episode = 3", "1 episode"), ("episode >= 0", "12 episodes")])
def test_what_was_deleted_here_is_not_fetched_again(
    admin: TupliAPIClient, tmp_path: Path, deleted: str, told: str
) -> None:
    uri, mine = pushed(admin, tmp_path / "lab"), tmp_path / "mine"
    run("pull", uri, "--storage", mine)
    run("delete", mine, "--filter", deleted)
    for dry in (["--dry-run"], []):
        result = CliRunner().invoke(app, ["pull", uri, "--storage", str(mine), *dry])
        assert "fetch" in result.stdout and " 0 episodes of 1 benchmark" in result.stdout
        assert f"not copied: {told} that had been deleted there; `tupli-mcap restore" in result.stderr
    assert run("restore", mine) == f"restored {told}\n"
    assert len(list(mine.rglob("*.mcap"))) == 1
    with FileStorage(mine) as storage:
        assert sorted(header.episode for header in storage.list_episodes()) == list(range(12))


@pytest.mark.filterwarnings("ignore:skipped a")
def test_a_damaged_file_with_deleted_episodes_does_not_keep_others_from_being_fetched(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    uri, mine = pushed(admin, tmp_path / "lab"), tmp_path / "mine"
    run("pull", uri, "--storage", mine)
    run("delete", mine, "--filter", "episode = 3")
    next(mine.rglob("*.mcap")).write_bytes(b"no recording")
    assert run("pull", uri, "--storage", mine) == f"fetched 12 episodes of 1 benchmark into {mine}\n"


def test_pull_says_why_it_fetched_nothing(admin: TupliAPIClient, tmp_path: Path) -> None:
    uri, mine = pushed(admin, tmp_path / "lab"), tmp_path / "mine"
    none = f"fetched 0 episodes into {mine}; no episode matches\n"
    assert run("pull", "--filter", "steps > 100000", "--storage", mine) == none
    assert run("pull", uri, "--storage", mine) == f"fetched 12 episodes of 1 benchmark into {mine}\n"
    again = run("pull", uri, "--filter", "episode < 3", "--storage", mine)
    why = "none of the 3 that match is new and can be copied"
    assert again == f"fetched 0 episodes of 1 benchmark into {mine}; {why}\n"
    said = run("push", tmp_path / "lab", "--filter", "episode < 0", "--benchmark", uri)
    assert said == f"sent 0 episodes of 1 benchmark to {admin.url}; no episode matches\n"


def test_one_bar_counts_all_recordings(
    admin: TupliAPIClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in range(6):
        record_rollouts("CartPole-v1", tmp_path / "lab" / f"{name}.mcap", steps=500, seed=name)
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_PAUSE", 0.0)
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich believe in a terminal
    with FileStorage(tmp_path / "lab") as lab, FileStorage(tmp_path / "mine") as mine:
        for source, target in ((lab, admin), (admin, mine)):
            capsys.readouterr()
            copy_episodes(source, target)
            bars = [line for line in capsys.readouterr().err.split("\r") if "copying 6 recordings" in line]
            percents = [int(re.findall(r"(\d+)%", bar)[0]) for bar in bars]
            assert percents == sorted(percents)
            assert percents[0] < 20 and 80 < percents[-1] <= 100


def test_push_of_a_directory_without_recordings_says_so(admin: TupliAPIClient, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    said = run("push", tmp_path / "empty")
    assert said.startswith(
        f"sent 0 episodes to {admin.url}; the directory has no episodes: give one with recordings"
    )


def test_a_recording_whose_episodes_are_all_deleted_is_not_sent(
    admin: TupliAPIClient, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    record_rollouts("CartPole-v1", path, steps=5, seed=1)
    run("delete", path, "--filter", "steps > 0")
    for dry in (["--dry-run"], []):
        result = CliRunner().invoke(app, ["push", str(path), *dry])
        assert (result.exit_code, result.stdout) == (1, "")
        assert f"found none in {path}; tupli-mcap restore {path} brings deleted ones back" in result.stderr


def test_push_counts_what_the_server_has_stored(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "lab" / "run.mcap"
    path.parent.mkdir()
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        for seed in range(3):
            env.reset(seed=seed)
            env.step(0)
    run("push", path.parent)
    run("delete", admin.url, "--filter", "episode = 1")
    told = "not copied: 1 episode that had been deleted there\n"
    for source, line in (
        (path.parent, f"sent 0 episodes to {admin.url}; none of the 3 that match is new and can be copied\n"),
        (path, f"already there: 2 episodes of {path} at {admin.url}\n"),
    ):
        for dry in ([], ["--dry-run"]):
            result = CliRunner().invoke(app, ["push", str(source), *dry])
            said = line.replace("sent", "would send") if dry else line
            assert (result.exit_code, result.stdout, told in result.stderr) == (0, said, True)
    tupli_mcap.open(path)[0].annotate(good=True)
    result = CliRunner().invoke(app, ["push", str(path), "--dry-run"])
    assert result.stdout == f"would send 2 episodes of {path} to {admin.url}\n" and told in result.stderr
    result = CliRunner().invoke(app, ["push", str(path)])
    assert result.stdout.startswith(f"sent 2 episodes of {path} to {admin.url}\n") and told in result.stderr
    assert [header.episode for header in admin.list_episodes()] == [0, 2]
