"""Signed bundles: whose key signed what, what a changed byte does, and what trusting a key allows."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from command_line import fails, ok, run
from cryptography.hazmat.primitives import serialization as ser
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa
from environments import Counter
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, ChunkIndex, DataEnd, McapRecord, Message, Metadata, Statistics, SummaryOffset
from serving import PASSWORD, serving
from signing_keys import write_key

import tupli_mcap
from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliEnvWrapper,
    rewrite_recording,
    signing,
    trust,
)
from tupli_mcap.environment import capture
from tupli_mcap.errors import (
    FormatError,
    MissingExtraError,
    NotFoundError,
    SignatureError,
    StorageError,
    TupliError,
    UntrustedError,
)
from tupli_mcap.mcap.container import Container, Prepared, Rows
from tupli_mcap.recording import annotate_episodes, edit_runs
from tupli_mcap.recording.check.signature import verify_signature
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.sign.sign import sign_recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, Signed
from tupli_mcap.schema import ArtifactMetadata, Episode, FilterEQ
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient
from tupli_mcap.storage.exchange import copy_episodes, push_recording


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's machine: what `as_author` does is not signed here."""
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def alices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Alice's machine: her key, and a bundle that she signed, of a pickled environment, an artifact, three episodes."""
    machine = tmp_path_factory.mktemp("alices")
    key = write_key(machine / "alice")
    with pytest.MonkeyPatch.context() as there:
        there.setenv("TUPLI_MCAP_CONFIG_DIR", str(machine / "config"))
        there.setenv("TUPLI_MCAP_DATA_DIR", str(machine / "data"))
        storage = FileStorage(machine / "storage")
        artifact = storage.store_artifact(b"wind\n1\n", ArtifactMetadata(name="wind.csv"))

        class WithArtifact(TupliEnvWrapper):
            def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
                return env, [artifact.id]

        env = WithArtifact(gym.wrappers.TimeLimit(Counter(2.0), 4), storage)
        env.store("counting")
        for seed in range(3):
            env.reset(seed=seed)
            while not any(env.step(0)[2:4]):
                pass
        env.close()
        assert env.id is not None
        storage.bundle(env.id, machine / "bundle.mcap", sign=key)
        storage.close()
    return machine


@pytest.fixture
def alice(alices: Path, tmp_path: Path) -> signing.SigningKey:
    for name in ("alice", "alice.pub"):
        shutil.copy(alices / name, tmp_path)
    return signing.SigningKey(tmp_path / "alice")


@pytest.fixture
def bundle(alices: Path, tmp_path: Path, alice: signing.SigningKey) -> Path:
    """A copy of Alice's bundle, beside her key."""
    return Path(shutil.copy(alices / "bundle.mcap", tmp_path))


def verified(path: Path) -> Any:
    with Recording(path) as recording:
        return verify_signature(recording)


# --- keys ---


@pytest.mark.parametrize("format", ["ssh", "pem"])
@pytest.mark.parametrize("passphrase", [None, "correct horse"])
def test_private_keys_of_both_formats(tmp_path: Path, format: str, passphrase: str | None) -> None:
    key = write_key(tmp_path / "bob", format=format, passphrase=passphrase)
    public = signing.read_public_key((tmp_path / "bob.pub").read_text())
    assert public == (key.public_key, "bob@lab")
    assert signing.is_signed(key.public_key, key.sign(b"text"), b"text")
    assert not signing.is_signed(key.public_key, key.sign(b"text"), b"texts")
    assert not signing.is_signed(key.public_key, b"short", b"text")
    assert repr(key) == f"<SigningKey {signing.fingerprint(key.public_key)}>"
    if passphrase is not None:
        for none in (None, ""):
            with pytest.raises(signing.PassphraseNeededError, match="encrypted, and needs a passphrase"):
                signing.SigningKey(tmp_path / "bob", none)
        with pytest.raises(signing.PassphraseNeededError, match="the passphrase does not open this key"):
            signing.SigningKey(tmp_path / "bob", "wrong")
    else:
        assert signing.SigningKey(tmp_path / "bob", "superfluous").public_key == key.public_key


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="needs ssh-keygen")
def test_keys_and_fingerprints_are_those_of_ssh_keygen(tmp_path: Path) -> None:
    subprocess.run(
        ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "carol", "-f", str(tmp_path / "id")], check=True
    )
    shown = subprocess.run(
        ["ssh-keygen", "-lf", str(tmp_path / "id.pub")], check=True, capture_output=True, text=True
    ).stdout
    key = signing.SigningKey(tmp_path / "id")
    assert signing.fingerprint(key.public_key) == shown.split()[1]
    assert signing.find_key(str(tmp_path / "id.pub")) == (key.public_key, "carol")


def test_other_keys_are_refused(tmp_path: Path, alice: signing.SigningKey) -> None:
    other = rsa.generate_private_key(65537, 2048)
    (tmp_path / "rsa").write_bytes(
        other.private_bytes(ser.Encoding.PEM, ser.PrivateFormat.PKCS8, ser.NoEncryption())
    )
    with pytest.raises(SignatureError, match="expected an Ed25519 key, found RSAPrivateKey"):
        signing.SigningKey(tmp_path / "rsa")
    for passphrase in (None, "of another key"):
        with pytest.raises(SignatureError, match=r"alice\.pub: expected a private Ed25519 key"):
            signing.SigningKey(tmp_path / "alice.pub", passphrase)
    with pytest.raises(SignatureError, match="'none' cannot be read: No such file .*; give the path"):
        signing.SigningKey("none")
    with pytest.raises(SignatureError, match="found a private one; give its .pub file"):
        signing.find_key(str(tmp_path / "alice"))
    for text in ("ssh-rsa AAAA", "ssh-ed25519 AAAA", "ssh-ed25519 !", "ssh-ed25519 " + "A" * 70):
        with pytest.raises(SignatureError, match="expected a public Ed25519 key"):
            signing.find_key(text)
    with pytest.raises(NotFoundError, match="no trusted key 'bob' and no file of that name"):
        signing.find_key("bob")
    with pytest.raises(NotFoundError, match="no trusted key './a"):
        signing.find_key(f"./{'a' * 300}")
    pem = ed25519.Ed25519PrivateKey.generate().public_key()
    text = pem.public_bytes(ser.Encoding.PEM, ser.PublicFormat.SubjectPublicKeyInfo).decode()
    assert signing.read_public_key(text).public_key == pem.public_bytes_raw().hex()


def test_keys_are_found_by_name_and_fingerprint(tmp_path: Path, alice: signing.SigningKey) -> None:
    key = signing.find_key("alice.pub")
    trust.trust_key(key.public_key, "alice")
    for text in ("alice", signing.fingerprint(key.public_key), key.public_key):
        assert signing.find_key(text) == (key.public_key, "alice")
    trust.trust_key("00" * 32, "alice")
    with pytest.raises(NotFoundError, match="2 trusted keys are named 'alice'"):
        signing.find_key("alice")


def test_a_bare_word_is_no_file(bundle: Path, tmp_path: Path, alice: signing.SigningKey) -> None:
    """An unpacked folder may hold a file of the name of somebody the user knows."""
    (tmp_path / "bob").write_text((tmp_path / "alice.pub").read_text())
    with pytest.raises(NotFoundError, match=r"no trusted key 'bob' .* as FILE\.pub or \./FILE"):
        signing.find_key("bob")
    assert fails("import", bundle, "--require-signature", "--from", "bob").startswith(
        "there is no trusted key"
    )
    assert not Path("_local_storage").exists()
    for text in ("./bob", str(tmp_path / "bob"), "alice.pub"):
        assert signing.find_key(text).public_key == alice.public_key


def test_the_comment_of_a_key_moves_no_cursor(tmp_path: Path, alice: signing.SigningKey) -> None:
    text = (tmp_path / "alice.pub").read_text().split()
    comment = "alice\x1b[2K\r what SHA256:HARMLESS alice\x9b2J\u202e"
    (tmp_path / "evil.pub").write_text(f"{text[0]} {text[1]} {comment}\n")
    shown = ok("trust", "--key", "evil.pub") + ok("trust", "--list")
    assert shown.count(signing.fingerprint(alice.public_key)) == 2
    assert all(line.isprintable() for line in shown.split("\n"))


# --- signatures ---


def test_a_signed_bundle(bundle: Path, alice: signing.SigningKey) -> None:
    signature = verified(bundle)
    assert signature.public_key == alice.public_key
    assert (signature.name, signature.trusted, signature.not_covered) == (None, False, ())
    trust.trust_key(alice.public_key, "Alice")
    assert verified(bundle).name == "Alice"
    with Recording(bundle) as recording:
        assert recording.benchmark.record.digest == signature.environment
        assert len(recording) == 3


def test_an_unsigned_recording(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=0)
        env.step(0)
    with Recording(tmp_path / "a.mcap") as recording:
        with pytest.raises(SignatureError, match=r"a\.mcap is not signed; ask for a bundle"):
            verify_signature(recording)


def test_compression_and_later_attachments_do_not_matter(bundle: Path, tmp_path: Path) -> None:
    added = {"replay-certificate.json": ("application/json", b"{}")}
    for compression in ("none", "lz4", "zstd"):
        target = tmp_path / f"{compression}.mcap"
        with Recording(bundle) as recording:
            rewrite_recording(recording, target, attachments=added, compression=compression)
        assert verified(target).not_covered == ("replay-certificate.json",)


def test_a_certificate_is_nobody_s_secret(bundle: Path, alice: signing.SigningKey) -> None:
    """It may be added and replaced after signing, and is not what was signed."""
    for text in (b"{}", b'{"a": 1}'):
        add_attachments(bundle, {"replay-certificate.json": ("application/json", text)})
        assert verified(bundle).not_covered == ("replay-certificate.json",)
    sign_recording(bundle, alice)
    with Recording(bundle) as recording:
        assert recording.read_attachment("replay-certificate.json") == b'{"a": 1}'
    add_attachments(bundle, {"env.cloudpickle": ("application/octet-stream", b"")})
    with pytest.raises(FormatError, match="expected a pickled environment of"):
        verified(bundle)


def _with_a_certificate(bundle: Path) -> None:
    add_attachments(bundle, {"replay-certificate.json": ("application/json", b"{}")})


def _written_again(bundle: Path) -> None:
    """The signature is in front of the steps then."""
    with Recording(bundle) as recording:
        rewrite_recording(recording, bundle, compression="none")


@pytest.mark.parametrize("ahead", [None, _with_a_certificate, _written_again])
@pytest.mark.filterwarnings("ignore:.*its signature covers", "ignore:.*was not finished and has no journal")
def test_a_signature_that_was_left_out_is_in_no_place_of_the_file(
    bundle: Path, alice: signing.SigningKey, ahead: Callable[[Path], None] | None
) -> None:
    """Whoever has lost the end of the file, or was killed while it went on, goes through its records."""
    if ahead is not None:
        ahead(bundle)
    before = Recording(bundle).read()
    annotate_episodes(bundle, {"good": True})
    edit_runs(bundle, tags=["seen"])
    assert verify_recording(bundle).problems == []
    with Recording(bundle) as recording:
        assert str(recording.read()) == str(before)
    cut = bundle.with_name("cut.mcap")
    cut.write_bytes(bundle.read_bytes()[:-8])
    assert SIGNATURE_NAME not in Recording(cut).attachments
    sign_recording(bundle, alice)
    verified(bundle)


def test_verify_checks_signatures(bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert verify_recording(bundle).ok
    assert "(a key that is not trusted here)" in verify_recording(bundle).signed_by
    report = verify_recording(tampered(bundle, tmp_path / "cut.mcap", episodes=[0]))
    (problem,) = report.errors
    assert problem.kind == "signature"
    assert "was changed after signing" in problem.message
    for name in [name for name in sys.modules if name.partition(".")[0] == "cryptography"]:
        monkeypatch.setitem(sys.modules, name, None)
    report = verify_recording(bundle)
    assert report.ok
    assert [problem.message for problem in report.problems] == ["it is signed, which was not checked"]


def test_signing_again_replaces_the_signature(bundle: Path, tmp_path: Path) -> None:
    bob = write_key(tmp_path / "bob")
    assert sign_recording(bundle, bob).public_key == bob.public_key == verified(bundle).public_key


def test_rewriting_drops_a_signature_that_would_not_fit(bundle: Path, tmp_path: Path) -> None:
    changes: list[dict[str, Any]] = [
        {"episodes": [0, 2]},
        {"benchmark_id": "0" * 64},
        {"attachments": {"benchmark.json": ("application/json", b"{}")}},
        {"attachments": {"artifacts/" + "0" * 64: ("application/octet-stream", b"")}},
    ]
    for change in changes:
        with Recording(bundle) as recording:
            rewrite_recording(recording, tmp_path / "other.mcap", **change)
        with pytest.raises(SignatureError, match="is not signed"):
            verified(tmp_path / "other.mcap")


def test_what_is_made_of_a_signed_recording_says_that_it_is_not(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey
) -> None:
    (tmp_path / "shaped.py").write_text("def reward(episode):\n    return episode.rewards\n")
    for i, command in enumerate(
        (
            "merge bundle.mcap",
            "split bundle.mcap --episodes 1",
            "filter bundle.mcap --episodes 1",
            "trim bundle.mcap --steps 1:",
            "relabel bundle.mcap --function shaped:reward",
        )
    ):
        for arguments in ((f"{i}.mcap", "--dry-run"), (f"{i}.mcap",)):
            done = run(*command.split(), "-o", *arguments)
            expected = (0, "warning: bundle.mcap is signed; what is made of it is not\n")
            assert (done.code, done.err) == expected, command
        with Recording(tmp_path / f"{i}.mcap") as made:
            assert SIGNATURE_NAME not in made.attachments
    for part in (parts := sorted(tmp_path.glob("1*.mcap"))):
        sign_recording(part, alice)
    with pytest.warns(UserWarning, match=r"1.mcap and 2 other recordings are signed; what is made of them"):
        tupli_mcap.open(parts).save("all.mcap")


def test_exporting_several_recordings_drops_the_signature_of_the_first(bundle: Path, tmp_path: Path) -> None:
    with FileStorage(tmp_path / "lab") as lab:
        benchmark = lab.import_bundle(bundle)
        (item, *_) = lab.list_episodes(include_tuples=True)
        lab.record_episode(Episode(benchmark_id=benchmark, metadata={}, tuples=item.tuples))
        lab.export(tmp_path / "all.mcap")
    assert verify_recording(tmp_path / "all.mcap").problems == []
    with Recording(tmp_path / "all.mcap") as recording:
        assert len(recording) == 4
        assert SIGNATURE_NAME not in recording.attachments


def tampered(bundle: Path, target: Path, **changes: Any) -> Path:
    """A rewritten bundle with the signature of the original, all CRCs right."""
    with Recording(bundle) as recording:
        signature = recording.read_attachment(SIGNATURE_NAME)
        attachments = {**changes.pop("attachments", {}), SIGNATURE_NAME: ("application/json", signature)}
        rewrite_recording(recording, target, attachments=attachments, **changes)
    return target


def _other_document(bundle: Path) -> bytes:
    with Recording(bundle) as recording:
        return recording.read_attachment("benchmark.json").replace(b'"counting"', b'"Counting"')


def _other_environment(bundle: Path) -> dict[str, tuple[str, bytes]]:
    record = capture(Counter(666.0))
    return {
        "benchmark.json": ("application/json", record.to_json()),
        "env.cloudpickle": ("application/octet-stream", record.pickle or b""),
    }


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: {"episodes": [0, 2]}, "was changed after signing"),
        (lambda b: {"episodes": []}, "'run.json' that was signed is missing"),
        (lambda b: {"benchmark_id": "0" * 64}, "its recording was changed: expected .* found"),
        (lambda b: {"attachments": _other_environment(b)}, "its environment was changed"),
        (
            lambda b: {"attachments": {"benchmark.json": ("application/json", _other_document(b))}},
            "the attachment 'benchmark.json' was changed after signing",
        ),
        (
            lambda b: {"attachments": {"artifacts/" + "0" * 64: ("application/octet-stream", b"")}},
            "the attachment 'artifacts/0000.*' was added after signing",
        ),
    ],
)
def test_a_change_is_found_and_named(
    bundle: Path, tmp_path: Path, change: Callable[[Path], dict[str, Any]], message: str
) -> None:
    with pytest.raises(SignatureError, match=message):
        verified(tampered(bundle, tmp_path / "other.mcap", **change(bundle)))


def with_another_step(bundle: Path, target: Path) -> Path:
    """A copy of a bundle with its signature in which one step is another, all CRCs right."""
    with Recording(bundle) as recording:
        signature = recording.read_attachment(SIGNATURE_NAME)
        store = recording._store
        (chunk,) = store.chunks(recording._step_channels[0])
        body = bytearray(store.load(chunk))
        body[60] ^= 1
        # what a forger would write, with all CRCs and indexes right
        store._chunk(chunk, None, keep=True).data = bytes(body)
        forged = {SIGNATURE_NAME: ("application/json", signature)}
        # compressed anew, so that no chunk is copied as it is in the file
        rewrite_recording(recording, target, attachments=forged, compression="lz4")
    return target


def test_a_changed_step_is_found(bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(SignatureError, match="the channel '/step' was changed after signing"):
        verified(with_another_step(bundle, tmp_path / "forged.mcap"))


# --- what other readers see ---


def seen(path: Path) -> list[Any]:
    """What the readers of the `mcap` package see, by the order of the file and by its indexes, in every order."""
    found = []
    for reader, order in itertools.product((SeekingReader, NonSeekingReader), (False, True)):
        with path.open("rb") as file:
            messages = reader(file).iter_messages(log_time_order=order)
            found.append(sorted((c.topic, s.data, m.sequence, m.data) for s, c, m in messages))
    return found


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def _forged_chunk() -> bytes:
    message = _record(Message(channel_id=1, log_time=5, data=b"forged", publish_time=5, sequence=0))
    return _record(Chunk("", message, 5, 5, zlib.crc32(message), len(message)))


def _other_definitions(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    real = Container.definitions
    monkeypatch.setattr(
        Container, "definitions", lambda self, channel: real(self, channel).replace(b" reward", b" regret")
    )
    return {}


def _messages_among_the_definitions(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    real = Container.prepare

    def prepare(self: Container, rows: Rows) -> Prepared:
        chunk = real(self, rows)
        first = bytes(rows.data[: int((*rows.offsets, len(rows.data))[1])])
        data = bytes(chunk.data[: chunk.skip]) + first + bytes(chunk.data[chunk.skip :])
        return Prepared(rows, chunk.skip + len(first), data, zlib.crc32(data))

    monkeypatch.setattr(Container, "prepare", prepare)
    return {}


def _an_index_into_an_attachment(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The summary names a chunk in an attachment, where anybody may add one, instead of those that were signed."""
    chunk = _forged_chunk()
    real = Container.finish

    def finish(self: Container) -> None:
        (note,) = (index for index in self.attachment_indexes if index.name == "note")
        at = note.offset + note.length - 4 - len(chunk)
        size = len(chunk) - 49
        index = _record(ChunkIndex(len(chunk), at, "", size, 5, 0, {}, 5, size))
        self.chunk_indexes = [index] * len(self.chunk_indexes)
        real(self)

    monkeypatch.setattr(Container, "finish", finish)
    return {"note": ("text/plain", chunk)}


def _a_chunk_behind_the_data(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Who reads the file in its order goes on behind the end of the data, up to the footer."""
    real = Container.finish

    def finish(self: Container) -> None:
        self.write(_record(DataEnd(0)), _forged_chunk())
        real(self)

    monkeypatch.setattr(Container, "finish", finish)
    return {}


def _metadata_in_the_summary(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Behind the last group of records that the summary lists, counted nowhere."""
    extra = Metadata("tupli_mcap.recording", {"benchmark_id": "forged"})
    statistics = Container._statistics

    def offset(opcode: int, start: int, length: int) -> SummaryOffset:
        return SummaryOffset(opcode, start, length - len(_record(extra)) * (opcode == Opcode.METADATA_INDEX))

    def counted(self: Container) -> Statistics:
        found = statistics(self)
        self.metadata_indexes.append(extra)  # type: ignore[arg-type]
        return found

    monkeypatch.setattr(Container, "_statistics", counted)
    monkeypatch.setattr("tupli_mcap.mcap.container.SummaryOffset", offset)
    return {}


def _an_older_attachment(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The environment is in the file twice: the summary lists the signed one only."""
    real = Container.start

    def start(self: Container) -> None:
        real(self)
        self.add_attachment("benchmark.json", "application/json", b"{}", 0)
        self.attachment_indexes.clear()

    monkeypatch.setattr(Container, "start", start)
    return {}


FORGERIES: dict[str, tuple[Callable[[pytest.MonkeyPatch], dict[str, Any]], str]] = {
    "definitions": (_other_definitions, "schema records differ from those of the data"),
    "skipped": (_messages_among_the_definitions, "expected consecutive rows in it"),
    "index": (_an_index_into_an_attachment, "chunk index records differ from those of the data"),
    "behind the data": (_a_chunk_behind_the_data, "the end of the data"),
    "summary": (_metadata_in_the_summary, "expected no record with opcode 12 in the summary"),
    "twice": (_an_older_attachment, "'benchmark.json' is in it twice"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_file_that_others_read_otherwise_does_not_fit(
    bundle: Path, tmp_path: Path, name: str, alice: signing.SigningKey
) -> None:
    """Every reader sees what was signed; where one sees something else, the signature is refused."""
    honest = seen(tampered(bundle, tmp_path / "honest.mcap", compression="lz4"))
    assert all(messages == honest[0] for messages in honest)
    verified(tmp_path / "honest.mcap")
    forge, message = FORGERIES[name]
    with pytest.MonkeyPatch.context() as mallory:
        attachments = forge(mallory)
        tampered(bundle, tmp_path / "forged.mcap", compression="lz4", attachments=attachments)
    assert name in ("summary", "twice") or seen(tmp_path / "forged.mcap") != honest
    with Recording(bundle) as original, Recording(tmp_path / "forged.mcap") as forged:
        assert str(forged.read().rewards) == str(original.read().rewards)
    expected = f"other readers may see other data than what was signed: .*{message}"
    with pytest.raises(SignatureError, match=expected):
        verified(tmp_path / "forged.mcap")
    with pytest.raises(SignatureError, match=expected):
        sign_recording(tmp_path / "forged.mcap", alice)
    with FileStorage(tmp_path / "lab") as storage, pytest.raises(SignatureError, match=expected):
        storage.import_bundle(tmp_path / "forged.mcap", require_signature=True, signers=[alice.public_key])


def test_a_signed_recording_is_not_appended_to(bundle: Path) -> None:
    before = bundle.read_bytes()
    with pytest.raises(RecordingError, match="is signed, and appending would make"):
        RecordEpisodes(gym.wrappers.TimeLimit(Counter(2.0), 4), bundle, mode="a")
    assert bundle.read_bytes() == before


@pytest.mark.filterwarnings("ignore:.*was not finished and has no journal")
def test_every_flipped_byte_is_found_or_changes_nothing(bundle: Path) -> None:
    """What still verifies gives the same episodes, the same environment, the same artifacts."""
    data = bundle.read_bytes()
    with Recording(bundle) as recording:
        expected = _all_of(recording)
    found = 0
    for position in range(3, len(data), 37):
        changed = bytearray(data)
        changed[position] ^= 0x20
        bundle.write_bytes(changed)
        try:
            with Recording(bundle) as recording:
                signature = verify_signature(recording)
                assert _all_of(recording) == expected, position
                assert signature.not_covered == ()
        except (SignatureError, FormatError):
            found += 1
    assert found > 0.8 * len(data) / 37


def _all_of(recording: Recording) -> Any:
    attachments = {name: recording.read_attachment(name) for name in recording.attachments}
    columns = recording.read()
    facts = [recording.episode_metadata(i) for i in range(len(recording))]
    return attachments, str(columns.states), str(columns.rewards), facts, dict(recording.metadata)


def test_a_signature_of_another_key_or_text_does_not_fit(bundle: Path, tmp_path: Path) -> None:
    with Recording(bundle) as recording:
        good = Signed.decode(recording.read_attachment(SIGNATURE_NAME), "x")
        bob = write_key(tmp_path / "bob")
        forged = [
            good._replace(public_key=bob.public_key),
            good._replace(signature=bob.sign(b"something")),
            good._replace(manifest={**good.manifest, "environment": "0" * 64}),
        ]
        for signed in forged:
            attachment = {SIGNATURE_NAME: ("application/json", signed.encode())}
            rewrite_recording(recording, tmp_path / "forged.mcap", attachments=attachment)
            with pytest.raises(SignatureError, match="its signature was not made by the key SHA256:"):
                verified(tmp_path / "forged.mcap")


def test_a_signature_that_is_none_is_a_format_error(bundle: Path, tmp_path: Path) -> None:
    with Recording(bundle) as recording:
        good = json.loads(recording.read_attachment(SIGNATURE_NAME))
        for bad in (b"", b"[", b"{}", b"[" * 100_000, *(json.dumps({**good, k: 3}).encode() for k in good)):
            attachment = {SIGNATURE_NAME: ("application/json", bad)}
            rewrite_recording(recording, tmp_path / "bad.mcap", attachments=attachment)
            with pytest.raises(FormatError, match=r"bad\.mcap: signature\.ed25519 is not a signature"):
                verified(tmp_path / "bad.mcap")
            with Recording(tmp_path / "bad.mcap") as damaged, pytest.raises(UntrustedError):
                damaged.benchmark.make_env()


def test_an_unfinished_recording_is_not_signed(tmp_path: Path, alice: signing.SigningKey) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "a.mcap") as env:
        env.reset(seed=0)
        env.step(0)
        shutil.copy(tmp_path / "a.mcap", tmp_path / "b.mcap")
    with (
        pytest.warns(UserWarning, match="journal"),
        pytest.raises(SignatureError, match="only a finished recording can be signed"),
    ):
        sign_recording(tmp_path / "b.mcap", alice)


def test_the_manifest_is_as_specified(bundle: Path) -> None:
    import jsonschema

    schema = json.loads((Path(__file__).parents[2] / "schemas/signature.schema.json").read_text())
    with Recording(bundle) as recording:
        document = json.loads(recording.read_attachment(SIGNATURE_NAME))
    jsonschema.validate(document, schema)
    document["manifest"]["channels"]["1"].pop("sha256")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


# --- trusting keys ---


def test_on_the_command_line(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = signing.fingerprint(alice.public_key)
    line = fails("import", bundle, "--storage", "lab", "--require-signature")
    assert line.endswith(
        f"expected a signature of a key that you trust (tupli-mcap trust --key), found {mark}"
    )
    assert not Path("lab").exists()
    assert f"\nsigned by    {mark} (not checked)\n" in ok("info", bundle)
    assert re.search(rf"signed by +{re.escape(mark)}\ntrusted +no\n$", ok("trust", bundle, "--show"))
    out = ok("import", bundle, "--storage", "other", "--from", "alice.pub")
    assert out.startswith("imported 3 of 3 episodes")
    assert re.search(rf"^signed by +{re.escape(mark)}$", out, re.MULTILINE)
    told = run("import", bundle, "--storage", "other", "--from", "alice.pub", "--json").json
    assert told["signed_by"] == mark
    assert run("trust", "--key", "alice.pub", "--name", "Alice", "--json").json == {
        "fingerprint": mark,
        "name": "Alice",
    }
    assert ok("trust", "--list") == f"key          {mark} Alice\n"
    assert re.search(
        rf"signed by +{re.escape(mark)} \(Alice\)\ntrusted +yes, while the key of Alice is trusted\n$",
        ok("trust", bundle, "--show"),
    )
    told = run("trust", bundle, "--show", "--json").json
    assert (told["trusted"], told["signed_by"], told["signer"]) == (True, mark, "Alice")
    ok("import", bundle, "--storage", "lab", "--require-signature")
    digest = told["digest"]
    assert ok("trust", "--list") == f"environment  {digest}\nkey          {mark} Alice\n"
    assert ok("untrust", "--key", "Alice") == f"{mark} is not trusted any more\n"
    assert ok("trust", "--list") == "nothing is trusted\n"
    assert fails("untrust", "--key", "Alice").startswith("there is no trusted key 'Alice'")
    assert fails("untrust", code=2).startswith("Invalid value: expected either a FILE or DIGEST, or --key")
    assert fails("trust", bundle, "--name", "x", code=2).startswith("Invalid value: --name goes with --key")

    locked = write_key(tmp_path / "bob", passphrase="secret")
    assert fails("bundle", bundle, "-o", "b.mcap", "--sign", "bob").endswith(
        "encrypted, and needs a passphrase; pass passphrase= (TUPLI_MCAP_KEY_PASSPHRASE)"
    )
    assert not Path("b.mcap").exists()
    monkeypatch.setenv("TUPLI_MCAP_KEY_PASSPHRASE", "secret")
    ok("bundle", bundle, "-o", "b.mcap", "--sign", "bob")
    assert verified(Path("b.mcap")).public_key == locked.public_key
    benchmark = run("info", bundle, "--json").json["benchmark_id"]
    ok("bundle", benchmark, "-o", "c.mcap", "--sign", "bob", "--storage", "lab")
    assert verified(Path("c.mcap")).public_key == locked.public_key


def test_what_a_trusted_key_signed_may_be_built(bundle: Path, alice: signing.SigningKey) -> None:
    with Recording(bundle) as recording:
        with pytest.raises(UntrustedError, match="pickled Python code"):
            recording.benchmark.make_env()
        trust.trust_key(alice.public_key, "alice")
        assert recording.benchmark.make_env().unwrapped.start == 2.0  # type: ignore[attr-defined]
        assert trust.trusted_digests() == []  # bound to the key, nothing else
        trust.untrust_key(alice.public_key)
        with pytest.raises(UntrustedError, match="pickled Python code"):
            recording.benchmark.make_env()


def test_a_signature_vouches_for_no_other_environment(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey
) -> None:
    trust.trust_key(alice.public_key, "alice")
    other = tampered(bundle, tmp_path / "other.mcap", attachments=_other_environment(bundle))
    with Recording(other) as recording, pytest.raises(UntrustedError):
        recording.benchmark.make_env()


def test_importing_takes_the_key_s_word(bundle: Path, tmp_path: Path, alice: signing.SigningKey) -> None:
    trust.trust_key(alice.public_key, "alice")
    with FileStorage(tmp_path / "lab") as storage:
        benchmark = storage.import_bundle(bundle, require_signature=True)
        TupliEnvWrapper.load(storage, benchmark).close()
        trust.untrust_key(alice.public_key)
        with pytest.raises(UntrustedError):
            TupliEnvWrapper.load(storage, benchmark)
        trust.trust_key(alice.public_key, "alice")  # what was vouched for before is forgotten
        with pytest.raises(UntrustedError):
            TupliEnvWrapper.load(storage, benchmark)


def test_fetching_from_a_server_takes_the_key_s_word(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey
) -> None:
    with serving(Settings(tmp_path / "served")) as url, TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        push_recording(client, bundle)
        (benchmark,) = client.list_benchmarks()
        with FileStorage(tmp_path / "lab") as lab:

            def refused() -> None:
                for storage in (client, lab):
                    with pytest.raises(UntrustedError, match="pickled Python code"):
                        TupliEnvWrapper.load(storage, benchmark.id)

            copy_episodes(client, lab, benchmark_id=benchmark.id)
            refused()
            trust.trust_key(write_key(tmp_path / "bob").public_key, "bob")
            copy_episodes(client, lab, benchmark_id=benchmark.id)
            refused()
            trust.trust_key(alice.public_key, "alice")
            copy_episodes(client, lab, benchmark_id=benchmark.id)
            for storage in (client, lab):
                TupliEnvWrapper.load(storage, benchmark.id).close()
            trust.untrust_key(alice.public_key)
            refused()


def test_importing_without_asking_works_as_before(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey
) -> None:
    with FileStorage(tmp_path / "lab") as storage:
        benchmark = storage.import_bundle(bundle)
        with pytest.raises(UntrustedError):
            TupliEnvWrapper.load(storage, benchmark)
        trust.trust_key(alice.public_key, "alice")
        cut = tampered(bundle, tmp_path / "cut.mcap", episodes=[0])
        with pytest.warns(
            UserWarning, match="imported as if it were not signed: .* was changed after signing"
        ):
            storage.import_bundle(cut)
        with pytest.raises(UntrustedError):
            TupliEnvWrapper.load(storage, benchmark)


def test_a_required_signature(bundle: Path, tmp_path: Path, alice: signing.SigningKey) -> None:
    bob = write_key(tmp_path / "bob")
    with FileStorage(tmp_path / "lab") as storage:

        def refused(path: Path, message: str, *signers: str) -> None:
            with pytest.raises(SignatureError, match=message):
                storage.import_bundle(path, require_signature=True, signers=signers)
            assert storage.list_benchmarks() == [] == storage.list_artifacts()

        refused(bundle, "expected a signature of a key that you trust")
        trust.trust_key(bob.public_key, "bob")
        refused(bundle, "expected a signature of a key that you trust")
        refused(bundle, "expected a signature of one of the keys given", bob.public_key)
        trust.trust_key(alice.public_key, "alice")
        refused(tampered(bundle, tmp_path / "cut.mcap", episodes=[0]), "was changed after signing")
        with Recording(bundle) as recording:
            rewrite_recording(recording, tmp_path / "unsigned.mcap", episodes=[0])
        refused(tmp_path / "unsigned.mcap", "is not signed")
        trust.untrust_key(alice.public_key)
        storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
        assert storage.count_episodes() == 3
        assert trust.trusted_digests() == []  # a key that is only named for this import


def steps_in(storage: FileStorage) -> str:
    found = []
    for header in storage.list_episodes():
        with storage.open_recording(header.recording) as recording:
            columns = recording.read()
            found.append(
                (header.id, columns.states.tolist(), columns.actions.tolist(), columns.rewards.tolist())
            )
    return str(found)


@pytest.mark.parametrize("by_hand", [False, True])
@pytest.mark.filterwarnings("ignore:skipped a")
def test_who_was_there_first_under_its_name_does_not_count(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey, by_hand: bool
) -> None:
    """The same UUID and the same episodes, with other contents: that is no copy of what was signed."""
    forged = with_another_step(bundle, tmp_path / "forged.mcap")
    with FileStorage(tmp_path / "lab") as storage:
        if by_hand:
            (tmp_path / "lab").mkdir()
            shutil.copy(forged, tmp_path / "lab" / "a.mcap")
        else:
            storage.import_bundle(forged)
        before = steps_in(storage)
        (name,) = {header.recording for header in storage.list_episodes()}
        expected = f"with other contents: '{name}' differs from '{bundle}'; delete the one that is wrong"
        for signers in ([alice.public_key], []):
            with pytest.raises(StorageError, match=re.escape(expected)):
                storage.import_bundle(bundle, require_signature=bool(signers), signers=signers)
        assert steps_in(storage) == before
        assert storage.count_episodes() == 3
        assert len(list((tmp_path / "lab").rglob("*.mcap"))) == 1
        storage.delete_episodes(FilterEQ(key="recording", value=name))
        storage.compact()  # until then, the deleted ones can be restored, and would be there twice
        storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
        assert storage.count_episodes() == 3
        assert steps_in(storage) != before


def test_a_part_that_is_there_with_the_same_contents(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey
) -> None:
    """Compressed otherwise, without a signature, some of the episodes only: still the same episodes."""
    part = tmp_path / "part.mcap"
    with Recording(bundle) as recording:
        rewrite_recording(recording, part, episodes=[1], compression="lz4")
    with FileStorage(tmp_path / "lab") as storage:
        storage.import_bundle(part)
        for _ in range(2):
            storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
            assert storage.count_episodes() == 3
            assert len({header.id for header in storage.list_episodes()}) == 3
        storage.import_bundle(part)
        assert len(list((tmp_path / "lab").rglob("*.mcap"))) == 2


@pytest.mark.parametrize("in_place", [False, True])
def test_what_was_checked_is_what_is_taken(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey, monkeypatch: pytest.MonkeyPatch, in_place: bool
) -> None:
    """The file is another one, or other bytes, as soon as it has been checked."""
    honest = bundle.read_bytes()
    forged = with_another_step(bundle, tmp_path / "forged.mcap").read_bytes()
    with FileStorage(tmp_path / "other") as other:
        other.import_bundle(bundle)
        expected = steps_in(other)
    store_benchmark = FileStorage.store_benchmark

    def swap(self: FileStorage, query: Any) -> Any:
        if in_place:
            with bundle.open("r+b") as file:
                file.write(forged)
                file.truncate()
        else:
            (tmp_path / "new").write_bytes(forged)
            (tmp_path / "new").replace(bundle)
        return store_benchmark(self, query)

    with FileStorage(tmp_path / "lab") as storage:
        with monkeypatch.context() as swapping:
            swapping.setattr(FileStorage, "store_benchmark", swap)
            if in_place:
                with pytest.raises((SignatureError, FormatError), match="bundle|recordings"):
                    storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
                assert storage.count_episodes() == 0
            else:
                storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
                assert steps_in(storage) == expected
        bundle.write_bytes(honest)
        storage.import_bundle(bundle, require_signature=True, signers=[alice.public_key])
        assert steps_in(storage) == expected


def test_without_the_extra(
    bundle: Path, tmp_path: Path, alice: signing.SigningKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "cryptography"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[sign\]"):
        signing.SigningKey(tmp_path / "alice")
    with Recording(bundle) as recording:
        assert len(recording.read().rewards) == 12
        with pytest.raises(UntrustedError):
            recording.benchmark.make_env()
        with pytest.raises(MissingExtraError, match=r"pip install .*\[sign\]"):
            verify_signature(recording)
    with FileStorage(tmp_path / "lab") as storage:
        storage.import_bundle(bundle)
        with pytest.raises(MissingExtraError):
            storage.import_bundle(bundle, require_signature=True)


def test_every_refusal_is_a_tupli_error() -> None:
    assert issubclass(SignatureError, TupliError)
