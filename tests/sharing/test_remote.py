"""Files on web servers and in buckets: what is asked for, what is read, and what happens when a server misbehaves."""

from __future__ import annotations

import base64
import contextlib
import fcntl
import gc
import gzip
import http.server
import itertools
import json
import multiprocessing
import os
import pickle
import pty
import re
import shutil
import ssl
import struct
import subprocess
import sys
import termios
import threading
import warnings
from collections.abc import Iterator
from concurrent.futures import wait
from pathlib import Path
from typing import Any
from urllib.parse import quote

import buckets
import numpy as np
import pytest
from between import Fault, between
from gymnasium import spaces
from hypothesis import given, strategies as st
from served import certificate
from typer.testing import CliRunner
from web_server import WebServer, serving

import tupli_mcap
from tupli_mcap import EpisodeData, EpisodeWriter, Recording, RecordingError, TupliDataset, write_recording
from tupli_mcap.cli import app
from tupli_mcap.dataset.items import Windows, steps_of
from tupli_mcap.remote import copied, matching, objects, plan, shown, source
from tupli_mcap.remote.objects import find
from tupli_mcap.remote.patterns import _is_match
from tupli_mcap.remote.plan import pieces_of

EPISODES, STEPS = 40, 500
TOOL = Path(sys.executable).with_name("tupli-mcap")


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of about 3 MB whose values cannot be compressed."""
    rng = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("large") / "r.mcap"
    write_recording(
        path,
        [
            EpisodeData(
                rng.normal(size=(STEPS, 17)).astype(np.float32), rng.normal(size=(STEPS, 6)).astype(np.float32),
                rng.normal(size=STEPS), np.zeros(STEPS, bool), np.arange(STEPS) == STEPS - 1,
                rng.normal(size=17).astype(np.float32), metadata={"number": i},
            )
            for i in range(EPISODES)
        ],
        observation_space=spaces.Box(-np.inf, np.inf, (17,)),
        action_space=spaces.Box(-np.inf, np.inf, (6,)),
    )  # fmt: skip
    return path


@pytest.fixture
def server(large: Path) -> Iterator[WebServer]:
    # an earlier server may have had the same port
    source._blocks = source._Blocks(source.BLOCK_BYTES)
    source._copies.clear()
    objects._no_suffixes.clear()
    with serving() as found:
        found.files["/r.mcap"] = large.read_bytes()
        yield found


def test_a_file_is_opened_by_its_tail(server: WebServer, large: Path) -> None:
    recording = Recording(server.url())
    assert [asked.range for asked in server.asked] == ["bytes=-131072"]
    assert len(recording) == EPISODES and recording.uuid == Recording(large).uuid


def test_a_whole_field_takes_few_requests(server: WebServer, large: Path) -> None:
    recording = Recording(server.url())
    server.asked.clear()
    found = recording.read(fields=["actions"])
    assert np.array_equal(found.actions, Recording(large).read().actions)
    assert len(server.asked) <= 8 and server.sent <= 1.05 * large.stat().st_size
    assert {asked.if_match for asked in server.asked} == {'"first"'}
    server.asked.clear()
    recording.read(fields=["states"])
    assert not server.asked  # the same chunks


def test_no_byte_is_fetched_twice(server: WebServer, large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan, "_LARGEST_PIECE", 1 << 20)
    expected = Recording(large)
    table, edge = expected.file.store.table, large.stat().st_size - (128 << 10)
    assert (
        (table["offset"] < edge) & (edge < table["offset"] + table["length"])
    ).any()  # a chunk straddles it
    assert np.array_equal(Recording(server.url()).read().states, expected.read().states)
    asked = [asked.range or "" for asked in server.asked]
    ranges = sorted(tuple(map(int, text[len("bytes=") :].split("-"))) for text in asked[1:])
    assert asked[0] == "bytes=-131072" and len(ranges) > 2
    assert all(before[1] < after[0] for before, after in itertools.pairwise([*ranges, (edge, edge)]))


def test_an_episode_takes_its_chunks_and_no_more(server: WebServer, large: Path) -> None:
    recording = Recording(server.url())
    server.asked.clear()
    expected = Recording(large)
    assert np.array_equal(recording.episodes[7].states, expected.episodes[7].states)
    store = expected.file.store
    row = expected.index[7]
    chunks = [span.chunk for span in store.spans(expected.file.steps[0], int(row["first_row"]), STEPS)]
    assert len(server.asked) <= 2
    assert server.sent <= 1.1 * int(store.table["length"][chunks].sum())


def _ranges(server: WebServer) -> list[tuple[str | None, bool]]:
    """The requests since the last call: the range of each, and whether bytes came."""
    found = [(asked.range, asked.sent > 0) for asked in server.asked]
    server.asked.clear()
    return found


@pytest.mark.parametrize("no_suffix", [0, 416], ids=["suffixes", "none"])
def test_what_opening_fetched_is_fetched_once_by_a_process(server: WebServer, no_suffix: int) -> None:
    server.no_suffix = no_suffix
    server.files["/other.mcap"] = server.files["/r.mcap"]
    Recording(server.url("/other.mcap"))  # learns whether the server knows suffixes
    _ranges(server)
    dataset = tupli_mcap.open(server.url())
    assert len(dataset) == EPISODES
    opened = _ranges(server)
    same = ("bytes=0-0", True) if no_suffix else ("bytes=-131072", False)
    assert len(opened) == (2 if no_suffix else 1)
    assert len(dataset[5].states) == STEPS
    asked = _ranges(server)
    assert len(asked) == 2 and asked[0] == same
    assert len(dataset.filter("metadata.number == 5").read().states) == STEPS
    assert _ranges(server) == [same]
    assert len(tupli_mcap.open(server.url())) == EPISODES
    assert _ranges(server) == [same]
    server.tags["/r.mcap"] = '"second"'
    assert len(tupli_mcap.open(server.url())) == EPISODES
    assert _ranges(server) == opened


def test_a_dataset_of_urls(server: WebServer, large: Path) -> None:
    local, remote = tupli_mcap.open(large), tupli_mcap.open(server.url())
    assert len(remote.filter("metadata.number < 3")) == 3
    for far, near in zip(
        remote.sort("return").head(5).read(fields=["states", "next_states"]).__dict__.values(),
        local.sort("return").head(5).read(fields=["states", "next_states"]).__dict__.values(),
        strict=True,
    ):
        assert np.array_equal(far, near)
    windows, expected = remote.windows(8), local.windows(8)
    for i in (0, 999, len(expected) - 1):
        assert np.array_equal(windows[i].states, expected[i].states)
    assert np.array_equal(pickle.loads(pickle.dumps(windows))[5].states, expected[5].states)
    dataset = TupliDataset.from_files(server.url())
    dataset.load()
    assert len(dataset.episodes) == EPISODES


def test_save_copies_from_a_server(server: WebServer, large: Path, tmp_path: Path) -> None:
    tupli_mcap.open(server.url()).head(3).save(tmp_path / "few.mcap")
    few = Recording(tmp_path / "few.mcap")
    assert np.array_equal(few.read().states, Recording(large).read(episodes=[0, 1, 2]).states)


def test_signatures_in_an_address_are_used_and_not_shown(server: WebServer) -> None:
    address = server.url("/r.mcap?X-Amz-Signature=SECRET")
    dataset = tupli_mcap.open(address)
    assert len(dataset.head(2).read(fields=["rewards"]).rewards) == 2 * STEPS
    told = [
        repr(dataset),
        repr(Recording(address)),
        repr(dataset[0]),
        *(h.recording for h in dataset.headers),
    ]
    server.files.clear()
    with pytest.raises(RecordingError) as caught:
        Recording(address)
    server.failures = [403, 403]
    with pytest.raises(RecordingError, match="credentials") as refused:
        Recording(address)
    server.failures = [500] * 50
    assert "SECRET" not in " ".join([*told, str(caught.value), str(refused.value)])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("GET https://me:pw@host/a?k=v (x)", "GET https://host/a (x)"),
        ("https://me:SEC@RE@T@host:80/x.mcap", "https://host:80/x.mcap"),
        ("https://me:SE/CR@host/a@b.mcap", "https://host/a@b.mcap"),
        ("https://me:SE?CR@host/x.mcap", "https://host/x.mcap"),
        ("https://me:SE#CR@host/x.mcap", "https://host/x.mcap"),
        ("https://me:SEC RE@T@host/x.mcap", "https://host/x.mcap"),
        ("http://lab:80 and http://lab: ask me@lab", "http://lab:80 and http://lab: ask me@lab"),
        ("https://me:SECRET@host?k=SEC@RET", "https://host"),
        ("https://host:80?k=SEC@RET", "https://host:80"),
        ("https://host?k=SEC@RET#SEC@RET", "https://host"),
        ("s3://lab/run@2.mcap", "s3://lab/run@2.mcap"),
        (
            "http://[::1]:80/a@b.mcap, http://127.0.0.1:80/c@d",
            "http://[::1]:80/a@b.mcap, http://127.0.0.1:80/c@d",
        ),
        ("https://a:SECRET@b/x,https://c:SECRET@d/y me@e", "https://b/x,https://d/y me@e"),
    ],
)
def test_secrets_in_addresses_are_not_shown(text: str, expected: str) -> None:
    assert shown(text) == expected


def test_an_error_does_not_show_a_password(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "2")
    with pytest.raises(RecordingError, match=r"^https://127\.0\.0\.1:1/x\.mcap cannot be read") as caught:
        Recording("https://bob:SECR@ET@127.0.0.1:1/x.mcap")
    assert "SECR" not in str(caught.value) and "ET@" not in str(caught.value)


@pytest.mark.parametrize("conditions", [True, False], ids=["If-Match", "ignored"])
def test_a_file_that_changes_is_an_error_and_never_a_mixture(server: WebServer, conditions: bool) -> None:
    recording = Recording(server.url())
    recording.episodes[0].states  # noqa: B018
    server.conditions = conditions
    server.tags["/r.mcap"] = '"second"'
    with pytest.raises(RecordingError, match="has been changed since it was opened"):
        recording.read()
    assert Recording(server.url()).n_steps == EPISODES * STEPS


def test_weak_tags_are_compared_and_not_sent(server: WebServer) -> None:
    server.tags["/r.mcap"] = 'W/"first"'
    recording = Recording(server.url())
    recording.read(fields=["rewards"])
    assert {asked.if_match for asked in server.asked} == {None}
    server.tags["/r.mcap"] = 'W/"second"'
    source._blocks = source._Blocks(source.BLOCK_BYTES)
    with pytest.raises(RecordingError, match="has been changed"):
        recording.read(episodes=[3])


@pytest.mark.parametrize("status", [400, 403, 404, 405, 416, 500, 501])
def test_a_server_that_knows_no_suffixes(server: WebServer, status: int) -> None:
    server.no_suffix, server.heads = status, False
    server.files["/again.mcap"] = server.files["/r.mcap"]
    size = len(server.files["/r.mcap"])
    by_size = ["bytes=0-0", f"bytes={size - 131072}-{size - 1}"]
    assert Recording(server.url()).n_steps == EPISODES * STEPS
    asked = [asked.range for asked in server.asked]
    assert asked[-2:] == by_size and set(asked[:-2]) == {"bytes=-131072"}
    assert len(asked) == 3 or status >= 500  # a server that fails is asked again
    server.asked.clear()
    assert Recording(server.url("/again.mcap")).n_steps == EPISODES * STEPS
    assert [asked.range for asked in server.asked] == by_size
    server.files["/files/"] = b"<!DOCTYPE HTML>\n<html><title>Directory listing"
    with pytest.raises(
        tupli_mcap.FormatError, match="found a web page; give the address of a recording itself"
    ):
        Recording(server.url("/files/"))
    with pytest.raises(RecordingError, match=r"nothing\.mcap does not exist"):
        Recording(server.url("/nothing.mcap"))
    server.files["/empty.mcap"] = b""
    with pytest.raises(tupli_mcap.FormatError, match="is empty"):
        Recording(server.url("/empty.mcap"))


def test_a_server_that_knows_no_ranges(server: WebServer, large: Path) -> None:
    server.ranges = server.heads = False
    with pytest.warns(UserWarning, match="sends whole files only"):
        recording = Recording(server.url())
    with recording:
        assert np.array_equal(recording.read().states, Recording(large).read().states)


@pytest.mark.filterwarnings("error::ResourceWarning", "error::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("tag", ['"first"', ""], ids=["ETag", "Last-Modified"])
def test_a_file_of_a_server_without_ranges_comes_once(server: WebServer, large: Path, tag: str) -> None:
    server.ranges = False
    server.files["/other.mcap"] = server.files["/r.mcap"]
    server.tags = {"/r.mcap": tag, "/other.mcap": tag}
    with pytest.warns(UserWarning, match="sends whole files only"):
        dataset = tupli_mcap.open(server.url()).filter("metadata.number < 9")
        assert len(dataset) == 9
    assert [asked for asked, _ in _ranges(server)] == ["bytes=-131072", "bytes=0-0", None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(dataset[3].states, Recording(large).episodes[3].states)
        assert len(dataset.read(["rewards"]).rewards) == 9 * STEPS
    del dataset
    gc.collect()
    assert set(_ranges(server)) == {(None, False)}
    with pytest.warns(UserWarning, match="other.mcap: the server sends whole files only"):
        Recording(server.url("/other.mcap")).close()
    assert [asked for asked, _ in _ranges(server)] == ["bytes=0-0", None]
    server.files["/r.mcap"], server.conditions = b"another", False
    server.tags["/r.mcap"] = '"second"'
    with pytest.warns(UserWarning, match="sends whole"), pytest.raises(tupli_mcap.FormatError):
        Recording(server.url())


def test_windows_of_a_server_without_ranges_go_into_other_processes(server: WebServer, large: Path) -> None:
    server.ranges = False
    with pytest.warns(UserWarning, match="sends whole files only"):
        windows = tupli_mcap.open(server.url()).windows(8)
    copied = pickle.dumps(windows)
    assert np.array_equal(pickle.loads(copied)[5].states, tupli_mcap.open(large).windows(8)[5].states)
    server.files["/r.mcap"], server.tags["/r.mcap"] = server.files["/r.mcap"][::-1], '"second"'
    with (
        pytest.warns(UserWarning, match="sends whole"),
        pytest.raises(RecordingError, match="has been changed since it was opened"),
    ):
        pickle.loads(copied)


def test_many_files_of_a_server_without_ranges(server: WebServer, tmp_path: Path) -> None:
    """Each of them is open; the limit that was set can be raised."""
    server.ranges = False
    for i in range(100):
        with EpisodeWriter(tmp_path / f"{i}.mcap", spaces.Discrete(2), spaces.Discrete(2)) as writer:
            writer.begin()
            writer.step(0, 1, 1.0)
        server.files[f"/{i}.mcap"] = (tmp_path / f"{i}.mcap").read_bytes()
    code = (
        "import resource, sys, tupli_mcap\n"
        "limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (80, limit))\n"
        "assert len(tupli_mcap.open(sys.argv[1:]).windows(1)) == 100\n"
    )
    urls = [server.url(f"/{i}.mcap") for i in range(100)]
    subprocess.run([sys.executable, "-W", "ignore", "-c", code, *urls], check=True, timeout=120)


def test_windows_of_a_file_object_cannot_be_pickled(large: Path) -> None:
    with large.open("rb") as file:
        windows = Windows(steps_of(Recording(file)), 8)
        with pytest.raises(RecordingError, match="was opened as a file object, which cannot be copied"):
            pickle.dumps(windows)


def test_a_folder_of_a_bucket(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "ENDPOINT": server.url("")}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    for folder in ("s3://lab/runs", "s3://lab/runs/"):
        with pytest.raises(RecordingError, match=rf"{folder} does not exist.*, give s3://lab/runs/\*\.mcap$"):
            Recording(folder)


def test_azure_which_has_no_suffixes(server: WebServer, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"ACCOUNT_NAME": "lab", "ACCOUNT_KEY": "c2VjcmV0", "ENDPOINT": server.url("")}.items():
        monkeypatch.setenv(f"AZURE_STORAGE_{name}", value)
    server.files["/lab/runs/r.mcap"] = server.files["/r.mcap"]
    assert Recording("az://lab/runs/r.mcap").n_steps == EPISODES * STEPS
    assert [asked.method for asked in server.asked] == ["GET", "GET"]
    with pytest.raises(RecordingError, match=r"az://lab/runs/nothing\.mcap does not exist"):
        Recording("az://lab/runs/nothing.mcap")
    server.failures = [403]
    with pytest.raises(RecordingError, match=r"az://lab/runs/r\.mcap may not be read with the credentials"):
        Recording("az://lab/runs/r.mcap")


def test_a_server_that_tells_no_length(server: WebServer) -> None:
    server.ranges = server.lengths = False
    with pytest.raises(
        RecordingError, match=r"r\.mcap cannot be read: .* does not tell how long it is; download"
    ):
        Recording(server.url())
    with pytest.raises(RecordingError, match="does not exist"):
        Recording(server.url("/nothing.mcap"))
    server.files["/runs/"] = b"<a href='r.mcap'>"
    with pytest.raises(
        RecordingError, match="a web server does not list its files; give the address of each"
    ):
        Recording(server.url("/runs/"))


@pytest.mark.parametrize("no_suffix", [0, 501])
def test_a_server_that_sends_more_than_it_says(server: WebServer, no_suffix: int) -> None:
    """Else it could fill the memory of who opens its file, or the disk of who downloads it."""
    server.beyond, server.no_suffix = 64 << 20, no_suffix
    with pytest.raises(RecordingError, match=r"r\.mcap: .* found more; "):
        Recording(server.url())
    with between(server.url("")) as proxy:
        proxy.faults.append(Fault("reset", 400_000))  # it is gone on with by a range
        with pytest.raises(RecordingError, match=r"r\.mcap: .* found more; "):
            list(find(f"{proxy.url}/r.mcap").whole().pieces)


def test_failures_that_pass_are_tried_again(server: WebServer) -> None:
    server.failures = [503, 500]
    recording = Recording(server.url())
    server.failures = [502]
    assert len(recording.read(fields=["rewards"]).rewards) == EPISODES * STEPS


def test_what_failed_is_asked_for_again(server: WebServer, large: Path) -> None:
    opened = source.open_url(server.url())
    assert isinstance(opened, source.RemoteSource)
    apart = [(start, start + 10_000) for start in range(0, 2_400_000, 300_000)]  # one request each
    server.failures = [404] * len(apart)
    opened.fetch(apart)
    coming = [block.coming for block in source._blocks._kept.values()]
    assert len(wait(coming).done) == len(apart)
    opened.fetch(apart)
    assert [opened.read(start, stop - start) for start, stop in apart] == [
        large.read_bytes()[start:stop] for start, stop in apart
    ]


@pytest.mark.parametrize(
    ("kind", "said"), [("stall", "TUPLI_MCAP_REMOTE_SECONDS"), ("reset", "try again later")]
)
def test_what_fails_for_ever_ends_with_one_error(
    server: WebServer, monkeypatch: pytest.MonkeyPatch, kind: str, said: str
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "2")
    with between(server.url("")) as proxy:
        recording = Recording(f"{proxy.url}/r.mcap")
        proxy.faults.extend([Fault(kind, 50_000)] * 1000)
        proxy.drop()
        with pytest.raises(RecordingError, match=f"r.mcap cannot be read: .*{said}"):
            recording.read(fields=["rewards"])
        assert len(proxy.faults) > 900
        proxy.faults.clear()
        assert len(recording.read(fields=["rewards"]).rewards) == EPISODES * STEPS
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "soon")
    with pytest.raises(RecordingError, match="expected TUPLI_MCAP_REMOTE_SECONDS to be a number of seconds"):
        Recording(server.url())


def test_a_server_that_cannot_be_reached_is_said_to_be_so(
    server: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "2")
    for name, value in {
        "ACCESS_KEY_ID": "me",
        "SECRET_ACCESS_KEY": "no",
        "ENDPOINT_URL": "http://127.0.0.1:1",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    server.failures = [503] * 20
    for url, said in {
        "http://127.0.0.1:1/x.mcap": "127.0.0.1:1 refuses connections; check the address, or try again later",
        "s3://lab/x.mcap": "127.0.0.1:1 refuses connections; check the address, or try again later",
        "https://me:x@lab.invalid/x.mcap": "there is no server of the name lab.invalid; check the address",
        server.url(): "its server answers 503 Service Unavailable; try again later",
    }.items():
        with pytest.raises(RecordingError, match=f"x?.mcap cannot be read: {said}"):
            Recording(url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url(""))
    server.failures = [403] * 20
    with pytest.raises(RecordingError, match="lab/ cannot be read: .* 403 Forbidden; check the credentials"):
        matching("s3://lab/*.mcap")


@pytest.mark.parametrize(
    ("status", "code", "said"),
    [
        (400, "ExpiredToken", "400 Bad Request (ExpiredToken: It is so.); check the credentials"),
        (
            400,
            "AuthorizationHeaderMalformed",
            "(AuthorizationHeaderMalformed: It is so.); check the credentials",
        ),
        (400, "InvalidRequest", "400 Bad Request (InvalidRequest: It is so.); check the address"),
        (403, "InvalidAccessKeyId", "(InvalidAccessKeyId: It is so.); check "),
        (429, "TooManyRequests", "429 Too Many Requests (TooManyRequests: It is so.); try again later"),
        (301, "PermanentRedirect", "the bucket is in another region; set AWS_REGION"),
    ],
)
def test_a_bucket_says_why_it_refuses(
    server: WebServer, monkeypatch: pytest.MonkeyPatch, status: int, code: str, said: str
) -> None:
    for name, value in {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "ENDPOINT": server.url("")}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    server.reason = f"<?xml?>\n<Error><Code>{code}</Code>\n<Message>It is so.</Message></Error>".encode()
    server.failures = [status] * 20
    for read in (Recording, matching):
        with pytest.raises(RecordingError, match=re.escape(said)):
            read("s3://lab/*.mcap" if read is matching else "s3://lab/x.mcap")


@pytest.mark.parametrize(
    ("url", "environment", "said"),
    [
        ("s3://lab/x.mcap", {"AWS_ENDPOINT_URL": "lab:9000"}, "such as http://lab:9000, found 'lab:9000'"),
        ("s3://lab/x.mcap", {"AWS_ENDPOINT_URL": "a:pw@lab"}, "such as http://lab, found 'lab'"),
        ("s3://lab/x.mcap", {"AWS_ACCESS_KEY_ID": "a"}, "Missing SecretAccessKey; check the address, and the"),
        ("az://lab/runs/x.mcap", {}, "Account must be specified; check the address, and the environment"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_the_environment_is_said(
    monkeypatch: pytest.MonkeyPatch, url: str, environment: dict[str, str], said: str
) -> None:
    for name in [name for name in os.environ if name.startswith(("AWS_", "AZURE_"))]:
        monkeypatch.delenv(name)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(RecordingError, match=re.escape(said)):
        Recording(url)


@pytest.mark.parametrize(
    ("days", "host", "trusted", "said"),
    [
        (1, "127.0.0.1", "certificate.pem", ""),
        (1, "localhost", "certificate.pem", r"of localhost:\d+ is that of another name; check the address"),
        (-1, "127.0.0.1", "certificate.pem", r"of 127\.0\.0\.1:\d+ has expired; renew it"),
        (
            1,
            "127.0.0.1",
            "nowhere.pem",
            r"no certificates of authorities .* SSL_CERT_FILE names no file: .*nowhere",
        ),
        (1, "127.0.0.1", "none.pem", r"is not trusted here; .* SSL_CERT_FILE names no file: .*none\.pem"),
        (
            1,
            "127.0.0.1",
            "key.pem",
            r"is not trusted here; .* not one of those \(PEM\) in SSL_CERT_FILE, .*key",
        ),
    ],
)
def test_why_a_certificate_is_refused_is_said(
    server: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    days: int, host: str, trusted: str, said: str,
) -> None:  # fmt: skip
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate(tmp_path, days=days))
    server.socket = context.wrap_socket(server.socket, server_side=True)
    (tmp_path / "others").mkdir()
    if trusted != "nowhere.pem":
        shutil.copy(os.environ["SSL_CERT_FILE"], tmp_path / "others/00000000.0")
    monkeypatch.setenv("SSL_CERT_DIR", str(tmp_path / "others"))
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / trusted))
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "2")
    address = server.url().replace("http://127.0.0.1", f"https://{host}")
    if not said:
        assert Recording(address).n_steps == EPISODES * STEPS
        return
    with pytest.raises(RecordingError, match=said):
        Recording(address)


def test_a_server_that_does_not_encrypt_is_said_to_be_so(
    server: WebServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_REMOTE_SECONDS", "2")
    with pytest.raises(RecordingError, match=r"\d does not encrypt; write http:// in the place of https://"):
        Recording(server.url().replace("http:", "https:"))


def test_a_user_and_a_password_in_an_address_are_sent(server: WebServer) -> None:
    passwords = {
        "p%40ss%2Fw%3Ard": b"p@ss/w:rd",
        "é €": "é €".encode(),
        "%E9%zz": b"\xe9%zz",
        "\udce9": b"\xe9",
    }
    for written, sent in passwords.items():
        server.sign_in = f"Basic {base64.b64encode(b'ann:' + sent).decode()}"
        assert Recording(server.url().replace("//", f"//ann:{written}@")).n_steps == EPISODES * STEPS
    for user in ("", "ann:wrong@"):
        with pytest.raises(RecordingError, match=r"r\.mcap may not be read .*give a user and a password"):
            Recording(server.url().replace("//", f"//{user}"))
    with pytest.raises(RecordingError, match=r"its port is no number; percent-encode a password \(%2F is /"):
        Recording(server.url().replace("//", "//ann:pass/word@"))


def test_a_redirect_to_another_server_has_no_password(server: WebServer) -> None:
    seen: list[str | None] = []

    class Other(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            seen.append(self.headers.get("Authorization"))
            self.send_response(307)
            self.send_header("Location", server.url())
            self.end_headers()

    server.sign_in = "Basic of the first server"
    with http.server.HTTPServer(("127.0.0.1", 0), Other) as first:
        threading.Thread(target=first.serve_forever, daemon=True).start()
        with pytest.raises(RecordingError, match="may not be read"):
            Recording(f"http://ann:secret@127.0.0.1:{first.server_port}/r.mcap")
        first.shutdown()
    assert set(seen) == {"Basic YW5uOnNlY3JldA=="}
    assert {asked.authorization for asked in server.asked} == {None}


def test_a_proxy_that_does_not_answer_is_named(server: WebServer) -> None:
    program = f"import tupli_mcap.recording as r; r.Recording({server.url()!r})"
    environment = os.environ | {"HTTP_PROXY": "http://127.0.0.1:1", "TUPLI_MCAP_REMOTE_SECONDS": "1"}
    environment.pop("NO_PROXY", None)
    environment.pop("no_proxy", None)
    ran = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert (
        "the proxy 127.0.0.1:1 (HTTP_PROXY or ALL_PROXY) refuses connections; check the address" in ran.stderr
    )


def test_a_whole_file_is_gone_on_with_while_something_comes(server: WebServer, large: Path) -> None:
    with between(server.url("")) as proxy:
        proxy.faults.extend([Fault("reset", 400_000)] * 7)  # more often than one request is tried again
        with copied(f"{proxy.url}/r.mcap") as path:
            assert path.read_bytes() == large.read_bytes()
        assert not proxy.faults


@pytest.mark.parametrize("name", [quote("走" * 90) + ".mcap", "..."])
def test_a_copy_whatever_its_name(server: WebServer, large: Path, name: str) -> None:
    server.files[f"/{name}"] = large.read_bytes()
    with copied(server.url(f"/{name}")) as path:
        assert path.read_bytes() == large.read_bytes()


def test_what_is_no_recording(server: WebServer) -> None:
    server.files |= {"/empty.mcap": b"", "/text.mcap": b"hello, I am a text and nothing else" * 9}
    with pytest.raises(tupli_mcap.FormatError, match="is empty"):
        Recording(server.url("/empty.mcap"))
    with pytest.raises(tupli_mcap.FormatError, match="expected an MCAP file"):
        Recording(server.url("/text.mcap"))
    with pytest.raises(RecordingError, match=r"nothing\.mcap does not exist"):
        Recording(server.url("/nothing.mcap"))
    server.files["/packed.mcap"] = gzip.compress(server.files["/r.mcap"][:9999])
    with pytest.raises(tupli_mcap.FormatError, match=r"compressed with gzip; unpack it; if a web server"):
        Recording(server.url("/packed.mcap"))
    with pytest.raises(RecordingError, match="a web server does not list its files"):
        tupli_mcap.open(server.url("/*.mcap"))


def test_a_recording_that_was_cut_short_is_recovered(server: WebServer, large: Path) -> None:
    server.files["/r.mcap"] = large.read_bytes()[: 2 << 20]
    with pytest.warns(UserWarning, match="steps not yet in a chunk cannot be recovered"):
        recording = Recording(server.url())
    assert not recording.complete
    states = recording.read().states
    assert np.array_equal(states, Recording(large).read().states[: len(states)]) and len(states) > 1000
    told = CliRunner().invoke(app, ["verify", server.url()]).output
    assert "→ download it, and save what is good with tupli-mcap recover FILE\n" in told


def _child(recording: Recording, answers: multiprocessing.Queue[str]) -> None:
    try:
        recording.read(episodes=[EPISODES // 2])
        answers.put("read")
    except RecordingError as err:
        answers.put(str(err))


def test_a_forked_process_says_what_to_do_and_does_not_hang(server: WebServer) -> None:
    recording = Recording(server.url())
    recording.read(episodes=[0])
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Python warns of forks with threads
        child = context.Process(target=_child, args=(recording, answers))
        child.start()
    assert '"spawn"' in answers.get(timeout=60)
    child.join()


def test_a_loader_with_workers_reads_from_a_server(server: WebServer, large: Path) -> None:
    pytest.importorskip("torch")
    loader = tupli_mcap.open(server.url()).loader(batch_size=64, num_workers=1, length=4, shuffle=False)
    first = next(iter(loader))
    expected = next(iter(tupli_mcap.open(large).loader(batch_size=64, length=4, shuffle=False)))
    assert bool((first["states"] == expected["states"]).all())


@pytest.mark.parametrize("command", ["info", "verify", "doctor", "episodes"])
def test_commands_take_addresses(server: WebServer, large: Path, command: str) -> None:
    far = CliRunner().invoke(app, [command, server.url(), "--json"])
    near = CliRunner().invoke(app, [command, str(large), "--json"])
    assert far.exit_code == near.exit_code == 0, far.output
    there = far.stdout.replace(server.url(), str(large))
    assert json.loads(there).keys() == json.loads(near.stdout).keys()


def test_episodes_are_run_again_from_the_copy_that_was_verified(server: WebServer, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    CliRunner().invoke(app, ["record", "CartPole-v1", "-o", str(path), "--steps", "50", "--seed", "1"])
    server.files["/run.mcap"] = path.read_bytes()
    told = CliRunner().invoke(app, ["verify", "--rerun", server.url("/run.mcap"), "--json"])
    assert told.exit_code == 0, told.output
    result = json.loads(told.stdout)["result"]
    assert result["reports"][0]["path"] == result["reruns"][0]["path"] == server.url("/run.mcap")
    assert result["reruns"][0]["agrees"] and server.sent < 2 * path.stat().st_size


@pytest.mark.sampled(0, keep=["fetching", "whole"])
@pytest.mark.parametrize(
    ("command", "what", "ranges"),
    [
        ("doctor", rb"fetching", True),
        ("verify", rb"downloading \xe2\x80\xa6\S*/campaign/r\.mcap", True),
        ("verify", rb"downloading \xe2\x80\xa6\S*/campaign/r\.mcap", False),
    ],
    ids=["fetching", "ranges", "whole"],
)
def test_a_terminal_shows_the_bytes_that_come(
    server: WebServer, command: str, what: bytes, ranges: bool
) -> None:
    server.delay, server.ranges = 1.1, ranges
    path = "/runs/of/a/long/campaign/r.mcap"
    server.files[path] = server.files["/r.mcap"]
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    asked = [str(TOOL), command, server.url(path), "--json"]
    with subprocess.Popen(asked, stdout=subprocess.PIPE, stderr=theirs) as process:
        os.close(theirs)
        said, _ = process.communicate(timeout=120)
    shown_there = b""
    with contextlib.suppress(OSError):  # the other end has closed
        while part := os.read(ours, 1 << 16):
            shown_there += part
    os.close(ours)
    assert f'"episodes": {EPISODES}' in said.decode()
    plain = re.sub(rb"\x1b\[[0-9;?]*[A-Za-z]", b"", shown_there)
    assert re.search(what + rb" .*[0-9.]+/[1-9][0-9.]* MB ([0-9.]+ .B/s|\?) +[0-9:-]+", plain)
    assert max(len(line.decode()) for line in re.split(rb"[\r\n]+", plain)) <= 80
    assert shown_there.rindex(b"\x1b[?25h") > shown_there.rindex(b" MB")  # it is gone, and the cursor is back


# ---- buckets


@pytest.fixture
def bucket(large: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    import obstore
    from obstore.store import S3Store

    with buckets.bucket() as made:
        store = S3Store(made.name)
        for name in ("runs/a.mcap", "runs/deep/b.mcap", "other.mcap", "runs/note.txt"):
            obstore.put(store, name, large.read_bytes())
        source._blocks = source._Blocks(source.BLOCK_BYTES)
        yield made.url


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_buckets_and_patterns(bucket: str, large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert np.array_equal(Recording(f"{bucket}/runs/a.mcap").read().states, Recording(large).read().states)
    assert matching(f"{bucket}/runs/*.mcap") == [f"{bucket}/runs/a.mcap"]
    assert matching(f"{bucket}/**/*.mcap") == [
        f"{bucket}/{name}" for name in ("other.mcap", "runs/a.mcap", "runs/deep/b.mcap")
    ]
    with pytest.raises(RecordingError, match="no file matches"):
        tupli_mcap.open(f"{bucket}/runs/*.bag")
    with pytest.raises(RecordingError, match=r"gone\.mcap does not exist"):
        Recording(f"{bucket}/gone.mcap")
    with pytest.raises(RecordingError, match=f"{bucket} is a bucket; give the URL of a recording"):
        Recording(bucket)
    with monkeypatch.context() as patch:
        patch.setenv("AWS_SKIP_SIGNATURE", "perhaps")
        with pytest.raises(RecordingError, match="boolean; check the address, and the environment"):
            Recording(f"{bucket}/runs/a.mcap")
    dataset = TupliDataset.from_files(f"{bucket}/runs/*.mcap")
    dataset.load()
    assert len(dataset.episodes) == EPISODES


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("name", ["run#1.mcap", "run?.mcap", "a b%20.mcap"])
def test_an_object_of_a_bucket_whatever_its_name(bucket: str, large: Path, name: str) -> None:
    import obstore
    from obstore.store import S3Store

    obstore.put(S3Store(bucket.removeprefix("s3://")), f"odd/{name}", large.read_bytes())
    (found,) = matching(f"{bucket}/odd/*.mcap")
    assert found == f"{bucket}/odd/{name}"
    assert Recording(found).n_steps == EPISODES * STEPS


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_commands_take_urls_and_patterns(bucket: str, tmp_path: Path) -> None:
    def told(*words: str) -> Any:
        done = CliRunner().invoke(app, [*words, "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.output)["result"]

    url, pattern = f"{bucket}/runs/a.mcap", f"{bucket}/**/*.mcap"
    listed = told("ls", pattern, "--filter", "metadata.number < 3")
    assert [(item["recording"], item["episodes"]) for item in listed] == [
        (f"{bucket}/{name}", 3) for name in ("other.mcap", "runs/a.mcap", "runs/deep/b.mcap")
    ]
    assert told("info", f"{bucket}/runs/*.mcap")["episodes"] == EPISODES
    assert [report["path"] for report in told("verify", pattern)["reports"]] == matching(pattern)
    assert told("merge", url, "-o", str(tmp_path / "merged.mcap"))["episodes"] == EPISODES
    assert len(told("split", url, "--episodes", "20", "-o", str(tmp_path / "part.mcap"))["recordings"]) == 2
    gone = CliRunner().invoke(app, ["ls", url, f"{bucket}/gone.mcap"])
    assert gone.exit_code == 1 and "gone.mcap does not exist" in gone.stderr
    assert "a.mcap" in gone.stdout


def test_other_addresses_go_through_fsspec(large: Path) -> None:
    import fsspec

    fsspec.filesystem("memory").pipe("/runs/x.mcap", large.read_bytes())
    assert np.array_equal(Recording("memory://runs/x.mcap").read().states, Recording(large).read().states)
    for folder in ("memory://runs", "memory:///runs"):
        assert matching(f"{folder}/*.mcap") == matching(f"{folder}/**") == [f"{folder}/x.mcap"]
    fsspec.filesystem("memory").pipe("/at-root.mcap", large.read_bytes())
    for root in ("memory://", "memory:///"):
        assert matching(f"{root}*.mcap") == [f"{root}at-root.mcap"]
    assert len(TupliDataset.from_files("memory://*.mcap").preview()) == EPISODES
    assert matching("memory://ru*/x.mcap") == ["memory://runs/x.mcap"]
    with pytest.raises(RecordingError, match="does not exist"):
        Recording("memory://runs/y.mcap")
    with pytest.raises(RecordingError, match="cannot be opened"):
        Recording("nosuch://runs/y.mcap")


def test_a_file_of_fsspec_that_was_replaced_is_read_anew() -> None:
    import fsspec

    system = fsspec.filesystem("memory")
    for content in (b"a", b"b"):
        system.pipe("/replaced.bin", content * 300_000)
        opened = source.open_url("memory://replaced.bin")
        assert isinstance(opened, source.RemoteSource)
        assert opened.read(0, 10) == content * 10
    system.rm("/replaced.bin")


def test_what_fsspec_cannot_list_is_one_error() -> None:
    import fsspec
    from fsspec.implementations.memory import MemoryFileSystem

    class Refusing(MemoryFileSystem):
        protocol = "refusing"

        def find(self, path: str, **_: Any) -> Any:
            raise Exception("550 no")  # as ftplib's errors, which are no OSError

    fsspec.register_implementation("refusing", Refusing, clobber=True)
    with pytest.raises(RecordingError, match=r"refusing://x/ cannot be read: 550 no"):
        matching("refusing://x/*.mcap")


def test_patterns_with_a_host(large: Path) -> None:
    import fsspec
    from fsspec.implementations.memory import MemoryFileSystem

    class Hosted(MemoryFileSystem):
        """As of SFTP: the host is an option of the file system, and no part of its paths."""

        protocol = "hosted"

        @classmethod
        def _strip_protocol(cls, path: str) -> str:
            return fsspec.utils.infer_storage_options(path)["path"].rstrip("/")

    fsspec.register_implementation("hosted", Hosted, clobber=True)
    fsspec.filesystem("hosted").pipe("/hosted/x.mcap", large.read_bytes())
    assert matching("hosted://me@lab/hosted/*.mcap") == ["hosted://me@lab/hosted/x.mcap"]
    assert "hosted://lab/hosted/x.mcap" in matching("hosted://lab/**/*.mcap")
    assert len(TupliDataset.from_files("hosted://lab/hosted/*.mcap").preview()) == EPISODES


def test_fsspec_gives_a_whole_file_in_pieces(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import fsspec

    monkeypatch.setattr(objects, "_RANGE", 1 << 20)
    data = large.read_bytes()
    system = fsspec.filesystem("memory")
    system.pipe("/runs/z.mcap", data)
    url = "memory://runs/z.mcap"
    whole = objects.find(url).whole()
    pieces = [bytes(piece) for piece in whole.pieces]
    assert b"".join(pieces) == data and whole.size == len(data)
    assert objects.find(url).newer(whole.version) is None
    assert max(map(len, pieces)) == 1 << 20
    coming = objects.find(url).whole().pieces
    next(coming)
    system.pipe("/runs/z.mcap", data + b"more")
    with pytest.raises(RecordingError, match="has been changed"):
        list(coming)
    system.rm("/runs/z.mcap")  # another test lists the folder


# ---- plans


@given(st.lists(st.tuples(st.integers(0, 1 << 26), st.integers(1, 1 << 20)), max_size=40))
def test_pieces_cover_what_is_wanted_and_little_more(starts: list[tuple[int, int]]) -> None:
    wanted = [(start, start + length) for start, length in starts]
    pieces = pieces_of(wanted)
    assert pieces == sorted(pieces)
    assert all(first[1] <= second[0] for first, second in itertools.pairwise(pieces))
    covered = sum(stop - start for start, stop in pieces)
    for start, stop in wanted:
        assert sum(a <= start and stop <= b for a, b in pieces) == 1
    for start, stop in pieces:  # only ranges that overlap make a larger one
        inside = sorted(each for each in wanted if start <= each[0] < stop)
        ends = itertools.accumulate((end for _, end in inside), max)
        assert stop - start <= 8 << 20 or all(a < end for (a, _), end in zip(inside[1:], ends, strict=False))
    union, end = 0, 0
    for start, stop in sorted(wanted):
        union += max(0, stop - max(start, end))
        end = max(end, stop)
    assert covered <= union * 1.2 + (16 << 10)


def test_patterns() -> None:
    def matches(pattern: str, text: str) -> bool:
        return _is_match(text.split("/"), pattern.split("/"))

    assert matches("s3://b/*.mcap", "s3://b/x.mcap") and not matches("s3://b/*.mcap", "s3://b/c/x.mcap")
    assert matches("s3://b/**/x?.mcap", "s3://b/x1.mcap") and matches(
        "s3://b/**/x?.mcap", "s3://b/c/d/x1.mcap"
    )
    assert matches("s3://b/**", "s3://b/c/d/x1.mcap") and not matches("s3://b/**/d", "s3://b/c/d/x1.mcap")
    assert matches("a[0-9].m", "a7.m") and not matches("a[!0-9].m", "a7.m") and not matches("a.m", "aXm")


def test_the_host_of_a_web_server_is_no_pattern(server: WebServer) -> None:
    """An address of IPv6 is in brackets, and a password may have a star."""
    for url in ("http://[::1]:8080/x.mcap", "https://me:a*b@lab/x.mcap?sign=*"):
        assert matching(url) == [url]
    with pytest.raises(RecordingError, match="a web server does not list its files"):
        matching("http://[::1]:8080/*.mcap")
    url = server.url().replace("://", "://me:a*b@")
    assert len(tupli_mcap.open(url)) == len(tupli_mcap.open(server.url()))


@pytest.mark.parametrize("command", [["recover"], ["tag", "a=1"], ["edit", "--name", "x"]])
def test_what_changes_files_takes_none_on_a_server(command: list[str]) -> None:
    told = CliRunner().invoke(app, [command[0], "https://me:SECRET@lab/x.mcap", *command[1:]])
    assert told.exit_code == 2 and "download" in told.stderr and "SECRET" not in told.output


# ---- blocks that outlive the process

_READS = """
import sys, tupli_mcap
with tupli_mcap.Recording(sys.argv[1]) as recording:
    for part in sys.argv[2:]:
        print(recording.read(["states"], episodes=None if part == "all" else [int(part)]).states.sum())
"""


def _read_elsewhere(url: str, *parts: str) -> str:
    """What another process reads: single episodes by number, or all of them."""
    done = subprocess.run([sys.executable, "-c", _READS, url, *parts], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_another_process_reads_kept_blocks(
    server: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", str(tmp_path))
    assert (
        _read_elsewhere(server.url(), "3", "7") and not (tmp_path / "blocks").exists()
    )  # only if it is wanted
    monkeypatch.setenv("TUPLI_MCAP_BLOCK_BYTES", str(64 << 20))
    first = _read_elsewhere(server.url(), "all", "7")
    (folder,) = (tmp_path / "blocks").iterdir()
    assert (folder.stat().st_mode & 0o777, folder.parent.stat().st_mode & 0o777) == (0o700, 0o700)
    server.asked.clear()
    assert _read_elsewhere(server.url(), "all", "7") == first
    assert len(server.asked) == 1  # of the tail, which tells that the file is the same

    blocks = sorted(folder.iterdir())
    damaged = bytearray(blocks[0].read_bytes())
    damaged[-1] ^= 1
    blocks[0].write_bytes(damaged)
    blocks[-1].write_bytes(blocks[-1].read_bytes()[:-1])
    server.asked.clear()
    assert _read_elsewhere(server.url(), "all", "7") == first
    assert len(server.asked) > 1

    server.tags["/r.mcap"] = '"second"'
    server.files["/r.mcap"] = bytes(server.files["/r.mcap"])
    server.asked.clear()
    assert _read_elsewhere(server.url(), "all", "7") == first
    assert len(server.asked) > 1 and len(list((tmp_path / "blocks").iterdir())) == 2
    server.tags["/r.mcap"] = 'W/"weak"'
    assert _read_elsewhere(server.url(), "all", "7") == first
    assert len(list((tmp_path / "blocks").iterdir())) == 2


def test_kept_blocks_stay_within_their_budget(
    server: WebServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    budget = 1 << 20
    monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("TUPLI_MCAP_BLOCK_BYTES", str(budget))
    together = [
        subprocess.Popen(
            [sys.executable, "-c", _READS, server.url(), *map(str, range(first, EPISODES, 2))],
            stdout=subprocess.PIPE,
        )
        for first in (0, 1)
    ]
    told = "".join(each.communicate()[0].decode() for each in together)
    assert [each.returncode for each in together] == [0, 0] and len(told.split()) == EPISODES
    kept = [path.stat().st_size for path in (tmp_path / "blocks").rglob("*") if path.is_file()]
    assert budget // 2 < sum(kept) <= budget * 17 // 16
    monkeypatch.setenv("TUPLI_MCAP_BLOCK_BYTES", "much")
    with pytest.raises(
        RecordingError, match="expected TUPLI_MCAP_BLOCK_BYTES to be a number of bytes, found 'much'"
    ):
        Recording(server.url())
