"""`recover_recording`: everything good is saved, nothing wrong gets in, and what was lost is said."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import zstandard
from counting import calls, grows, tallied
from damaged import BOX, chunks, flip, foreign, hit, places, record
from environments import Sampler, roll
from fuzzing.model import ATTACHMENT, METADATA, FileRecord, Model, strings
from golden_files import NAMES, UNFINISHED, as_read, assert_same, expected, place
from gymnasium import spaces
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from tool_modules import tool
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap import (
    FileStorage,
    FormatError,
    RecordEpisodes,
    Recording,
    RecordingError,
    journal_path,
    jsonvalue,
    recover_recording,
    verify_recording,
)
from tupli_mcap.cli.app import app
from tupli_mcap.mcap import chunks as chunks_of_files
from tupli_mcap.mcap.chunks import ChunkClaim, message_places
from tupli_mcap.mcap.records import MAGIC
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.mcap.walk import Damage, Found, Walk
from tupli_mcap.recording import RecoveryReport, finish_recording
from tupli_mcap.recording.check.signature import manifest, verify_signature
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME
from tupli_mcap.recording.recover.damaged import gather, read_file_end
from tupli_mcap.recording.recover.episodes import NewPlaces, make_plan
from tupli_mcap.recording.recover.evidence import FileEnd, PackedStore, RecordedChannels
from tupli_mcap.recording.sign.sign import sign_recording
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.vector import RecordEpisodes as RecordVector

Steps = dict[tuple[int, int], str]


def steps_of(recording: Recording, *, infos: bool = False) -> Steps:
    """Every step by the episode and step number it had before a repair, exact."""
    found: Steps = {}
    for episode in recording.episodes:
        origin = episode.metadata.get("recovered")
        number, first = (episode.number, 0) if origin is None else (origin["episode"], origin["first_step"])
        for i, step in enumerate(episode):
            values = [step.state, step.action, step.reward, step.terminal, step.timeout]
            found[number, first + i] = jsonvalue.dumps([*values, step.info] if infos else values)
    return found


def recovered(path: Path) -> tuple[RecoveryReport, Recording]:
    report = recover_recording(path, overwrite=True)
    assert report.target is not None
    return report, Recording(report.target)


def assert_true(found: Steps, wanted: Steps, report: RecoveryReport) -> None:
    """All steps are true ones, and those that are not here are named."""
    assert all(wanted[key] == value for key, value in found.items())
    missing = set(wanted) - set(found)
    named = {
        (lost.episode, step)
        for lost in report.lost
        for step in range(lost.first, 10_000 if lost.stop is None else lost.stop)
    }
    assert missing <= named
    assert named & set(found) == set()
    assert len(missing) == report.steps_lost


def written_by_another(source: Path, target: Path, *, in_order: bool, attachments: bool) -> None:
    """A copy as `mcap compress` and `mcap filter` write it: chunks of several channels, which are defined where their
    first message comes, and no checksums; without `attachments` also no metadata."""
    with source.open("rb") as file, target.open("wb") as out:
        reader = make_reader(file)
        writer = Writer(out, chunk_size=3000, enable_crcs=False)
        writer.start(reader.get_header().profile, "another program")
        known: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=in_order):
            if channel.id not in known:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                known[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            times = message.log_time, message.publish_time
            writer.add_message(known[channel.id], times[0], message.data, times[1], message.sequence)
        for each in reader.iter_attachments() if attachments else ():
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
        for one in reader.iter_metadata() if attachments else ():
            writer.add_metadata(one.name, one.metadata)
        writer.finish()


# ---- recordings of ours


STACKED = ["png_images", "png_stacks", "stacked", "stacked_last"]  # images that need those before them


@pytest.mark.parametrize(("in_order", "attachments"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("name", [name for name in NAMES if name not in (*UNFINISHED, *STACKED)])
def test_what_another_program_has_rewritten_is_whole(
    name: str, in_order: bool, attachments: bool, tmp_path: Path
) -> None:
    path = place(name, tmp_path)
    target = tmp_path / "by_another.mcap"
    written_by_another(path, target, in_order=in_order, attachments=attachments)
    with pytest.raises(FormatError, match="recover"):
        Recording(target)
    first = verify_recording(target).problems[0]
    assert (first.message, first.severity) == ("another program wrote it", "note")
    report, recording = recovered(target)
    with recording:
        assert report.steps_lost == 0
        assert report.damaged == []
        assert "another program wrote it" in " ".join(report.notes)
        wanted = expected(name)
        if not any(info for episode in wanted for info in episode["infos"] or ()):
            wanted = [{**episode, "infos": None} for episode in wanted]  # the channel has no messages
        if name == "described" and not attachments:  # they have its annotations
            wanted = [{**episode, "metadata": {}} for episode in wanted]
        assert_same(list(as_read(recording)), wanted)


@pytest.mark.parametrize("name", STACKED)
def test_stacks_that_another_program_has_rewritten_are_lost_but_for_the_first(
    name: str, tmp_path: Path
) -> None:
    path, target = place(name, tmp_path), tmp_path / "by_another.mcap"
    written_by_another(path, target, in_order=True, attachments=True)
    with Recording(path) as recording:
        wanted = steps_of(recording)
    report, recording = recovered(target)
    with recording:
        assert_true(steps_of(recording), wanted, report)
    assert report.damaged


@pytest.mark.parametrize(
    ("one", "why"),
    [
        (bytes(9), "messages, found more"),
        (struct.pack("<BQ", Opcode.CHANNEL, 0), "expected fields"),
        (struct.pack("<BQH", Opcode.SCHEMA, 14, 1) + bytes(12), "at most 1000 definitions in it"),
    ],
    ids=["no record", "no channel", "schemas"],
)
def test_many_small_records_in_a_chunk_of_another_program_take_little_memory(
    one: bytes, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks_of_files, "_MOST_DEFINITIONS", 1000)
    target = tmp_path / "by_another.mcap"
    written_by_another(record(tmp_path / "a.mcap"), target, in_order=True, attachments=True)
    data, raw = target.read_bytes(), one * ((16 << 20) // len(one))
    packed = zstandard.compress(raw)
    body = struct.pack("<QQQII4sQ", 0, 0, len(raw), 0, 4, b"zstd", len(packed)) + packed
    first = len(MAGIC) + 9 + struct.unpack_from("<Q", data, len(MAGIC) + 1)[0]
    target.write_bytes(data[:first] + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body + data[first:])
    tracemalloc.start()
    try:
        report, recording = recovered(target)
        assert tracemalloc.get_traced_memory()[1] < 10 * len(raw)
    finally:
        tracemalloc.stop()
    with recording:
        assert recording.n_steps == 300
    assert why in report.damaged[0].why


def test_a_file_that_was_cut_off_ahead_of_chunks_in_its_index(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    source = PathSource(path)
    beyond = {source.size + 100_000: ChunkClaim(100, 100, "", 0)}
    (*_, damage) = Walk(source, known=beyond, end=places(path)[-1].offset - 1)
    assert isinstance(damage, Damage)
    source.close()


def test_what_another_program_has_merged_is_refused(tmp_path: Path) -> None:
    """What is left of several recordings could mix their episodes."""
    target = tmp_path / "by_another.mcap"
    written_by_another(record(tmp_path / "a.mcap"), target, in_order=True, attachments=True)
    data = target.read_bytes()
    first = next(found for found in Walk(PathSource(target), need_crc=False) if found.opcode == Opcode.CHUNK)
    assert isinstance(first, Found)
    end = first.offset + first.length
    target.write_bytes(data[:end] + data[first.offset :])
    for dry_run in (True, False):
        with pytest.raises(FormatError, match="has merged several recordings into it; merge these with"):
            recover_recording(target, dry_run=dry_run)


@pytest.mark.parametrize("name", NAMES)
def test_a_good_recording_comes_back_whole(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    before = path.read_bytes()
    report, recording = recovered(path)
    with recording:
        assert_same(list(as_read(recording)), expected(name))
        assert recording.complete
    assert path.read_bytes() == before
    assert report.intact == (not name.startswith("unfinished"))
    assert (report.steps_lost, report.lost, report.damaged) == (0, [], [])
    assert Path(report.target or "").name == f"{name}.recovered.mcap"


def test_an_episode_with_a_hole_is_cut(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", length=200)
    with Recording(path) as recording:
        wanted, uuid = steps_of(recording), recording.uuid
        table = recording._contents.table
        seeds = {e.number: e.seed for e in recording.episodes}
    middle = chunks(path, "/step")[2]
    row = next(r for r in table if r["offset"] == middle.offset)
    first, stop = int(row["first"]), int(row["first"] + row["rows"])
    hit(path, middle)
    report, recording = recovered(path)
    with recording:
        found = steps_of(recording)
        assert_true(found, wanted, report)
        assert report.steps_lost == stop - first
        assert recording.uuid == uuid
        assert [lost.episode for lost in report.lost] == [0]
        head = next(e for e in recording.episodes if e.number == 0)
        assert (len(head), head.end, head.final_state) == (first, "interrupted", None)
        assert head.seed == seeds[head.number]
        assert head.metadata["recovered"] == {"episode": head.number, "first_step": 0, "length": 200}
        piece = recording.episodes[-1]
        assert piece.number == 2
        assert piece.metadata["recovered"] == {"episode": 0, "first_step": stop, "length": 200}
        assert piece.start.continued
        assert piece.seed is None
        assert piece.final_state is not None
        assert piece.return_ == sum(piece.rewards.tolist())
        assert [(c.episode, c.first_step, c.steps, c.becomes) for c in report.cut] == [
            (0, 0, first, 0),
            (0, stop, 200 - stop, 2),
        ]


@pytest.mark.parametrize("command", [False, True])
@pytest.mark.parametrize("lost", ["nothing", "steps", "metadata"])
def test_deleted_episodes_stay_deleted(lost: str, command: bool, tmp_path: Path) -> None:
    """All parts of one that is cut, too, and if the recording gets another UUID; and they can be restored."""
    path = record(tmp_path / "a.mcap", length=200)
    count = len(tupli_mcap.open(path))
    assert tupli_mcap.open(path)[:1].delete() == 1
    if lost == "steps":
        hit(path, chunks(path, "/step")[2])
    uuid = Recording(path).uuid
    if lost == "metadata":
        flip(path, *(m.start() for m in re.finditer(uuid.encode(), path.read_bytes())))
    target = tmp_path / "new" / "b.mcap"
    if command:
        assert CliRunner().invoke(app, ["recover", str(path), "-o", str(target)]).exit_code == 0
    else:
        recover_recording(path, target)
    with Recording(target) as recording:
        assert (recording.uuid == uuid) == (lost != "metadata")
        origins = [e.metadata.get("recovered", {}).get("episode", e.number) for e in recording.episodes]
    parts = 2 if lost == "steps" else 1
    assert (origins.count(0), len(origins)) == (parts, count + parts - 1)
    assert 0 not in [e.number for e in tupli_mcap.open(target)]
    assert len(tupli_mcap.open(target)) == count - 1
    assert len(tupli_mcap.restore_episodes(target)) == parts
    if lost == "nothing":
        tupli_mcap.restore_episodes(path)
    recover_recording(path, target, overwrite=True)
    assert len(tupli_mcap.open(target)) == count - (lost != "nothing")


def test_recovering_again_changes_nothing(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    hit(path, chunks(path, "/step")[1])
    first, recording = recovered(path)
    with recording:
        before = list(as_read(recording))
    again, recording = recovered(Path(first.target or ""))
    with recording:
        assert again.intact
        assert_same(list(as_read(recording)), before)


@pytest.mark.parametrize("topic", ["/episode_start", "/episode_end", "/final_state"])
@pytest.mark.parametrize("with_index", [True, False])
def test_lost_messages_of_episodes(topic: str, with_index: bool, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted = list(as_read(recording))
        index = recording._contents.data_end
    hit(path, chunks(path, topic)[0])
    if not with_index:
        flip(path, index + 100)
    report, recording = recovered(path)
    with recording:
        found = list(as_read(recording))
    for one, other in zip(found, wanted, strict=True):
        same = set(one) - {"reset_info", "options", "seed", "final_state"}
        assert jsonvalue.dumps({k: one[k] for k in same}) == jsonvalue.dumps({k: other[k] for k in same})
        assert (one["final_state"] is None) == (topic == "/final_state")
        if topic != "/episode_start" or with_index:
            assert one["seed"] == other["seed"]
    numbers = list(range(8))
    assert report.starts_lost == (numbers if topic == "/episode_start" else [])
    assert report.final_states_lost == (numbers if topic == "/final_state" else [])
    assert (
        report.ends_lost == (numbers[:-1] if topic == "/episode_end" and not with_index else [])
        or report.ends_lost == numbers
    )
    assert report.steps_lost == 0


def test_a_damaged_schema_of_infos_costs_at_most_the_infos(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", 11, record_info=True, compression="none")
    with Recording(path) as recording:
        wanted = [info for episode in recording.episodes for info in episode.infos]
    data = path.read_bytes()
    places = [match.start() for match in re.finditer(b"string json", data)]
    assert len(places) == 3  # in the data section, in the chunk and in the summary
    for damaged in (places[:1], places[1:2], places[2:], places):
        broken = bytearray(data)
        for at in damaged:
            broken[at] = 0xF4
        path.write_bytes(broken)
        report, recording = recovered(path)
        with recording:
            found = [info for episode in recording.episodes for info in episode.infos]
            assert recording.n_steps == 11
        is_lost = places[1] in damaged  # then the chunk has another CRC
        assert (found, report.infos_lost) == (([None] * 11, 11) if is_lost else (wanted, 0))


def test_a_damaged_header_of_a_chunk_loses_nothing_with_the_index(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted = steps_of(recording)
    for offset in range(50):  # opcode, length, times, sizes, CRC, name of the compression
        again = tmp_path / "b.mcap"
        again.write_bytes(path.read_bytes())
        flip(again, chunks(path, "/step")[1].offset + offset)
        report, recording = recovered(again)
        with recording:
            assert steps_of(recording) == wanted, offset
        assert report.steps_lost == 0


def truncate(path: Path, size: int) -> None:
    os.truncate(path, size)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 0.99])
def test_a_truncated_recording_keeps_its_whole_chunks(share: float, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted = steps_of(recording)
    size = int(path.stat().st_size * share)
    kept = sum(1 for item in chunks(path, "/step") if item.offset + item.length <= size)
    truncate(path, size)
    report, recording = recovered(path)
    with recording:
        found = steps_of(recording)
        assert all(wanted[key] == value for key, value in found.items())
        assert len(found) == min(300, kept * len(found) // max(kept, 1))
        assert kept
    assert not report.finished or share == 0.99


def test_a_hole_in_a_killed_recording_is_filled_from_its_journal(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    pid = os.fork()
    if pid == 0:
        try:
            env = RecordEpisodes(Sampler(BOX, spaces.Discrete(3), length=40), path, chunk_size=4096)
            roll(env, 300)
        finally:
            os._exit(0)
    os.waitpid(pid, 0)
    with Recording(path) as recording:
        wanted = steps_of(recording)
        final = recording.episodes[-1].final_state
    assert len(wanted) == 300
    bad = [item for item in places(path) if item.chunk is not None]
    hit(path, bad[2])
    report, recording = recovered(path)
    with recording:
        assert_true(steps_of(recording), wanted, report)
        assert 0 < report.steps_lost < 60
        assert recording.episodes[-1].end == "interrupted" or recording.episodes[-1].number == 8
        finals = [
            e.final_state
            for e in recording.episodes
            if e.metadata.get("recovered", {}).get("episode", e.number) == 7
        ]
        assert finals[-1].tobytes() == final.tobytes()
    assert report.journal == "used"
    hit(path, bad[-1])  # its rows are in the other half of the journal still
    again, recording = recovered(path)
    with recording:
        assert again.steps_lost == report.steps_lost
    journal_path(path).unlink()
    missing, recording = recovered(path)
    recording.close()
    assert missing.journal == "missing"


def test_damage_in_one_sub_environment_leaves_the_others_alone(tmp_path: Path) -> None:
    path = tmp_path / "v.mcap"
    fns = [lambda: Sampler(BOX, spaces.Discrete(3), length=30)] * 3
    with RecordVector(gym.vector.SyncVectorEnv(fns), path, chunk_size=4096) as env:
        env.reset(seed=3)
        for _ in range(1500):
            env.step(env.action_space.sample())
    with Recording(path) as recording:
        wanted = steps_of(recording)
        envs = {e.number: e.env for e in recording.episodes}
    hit(path, chunks(path, "/env_1/step")[0])
    report, recording = recovered(path)
    with recording:
        assert_true(steps_of(recording), wanted, report)
        assert report.steps_lost
        assert {envs[lost.episode] for lost in report.lost} == {1}
        assert recording.num_envs == 3


def test_a_step_without_its_image_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "i.mcap"
    space = spaces.Dict({"x": BOX, "camera": spaces.Box(0, 255, (8, 8, 3), np.uint8)})
    with RecordEpisodes(Sampler(space, spaces.Discrete(3), length=40), path, chunk_size=1024) as env:
        roll(env, 100)
    with Recording(path) as recording:
        wanted = steps_of(recording)
    found = chunks(path, "/image/state_camera")
    assert len(found) > 2
    hit(path, found[1])
    report, recording = recovered(path)
    with recording:
        assert_true(steps_of(recording), wanted, report)
    assert 0 < report.steps_lost <= 32  # images of a chunk


def test_what_else_is_damaged_is_said(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", attachments={"note": ("text/plain", b"x" * 5000)})
    with Recording(path) as recording:
        wanted = steps_of(recording)
    everything = places(path)
    attachment = next(i for i in everything if i.attachment is not None and i.attachment.name == "note")
    metadata = [item.offset + 1 for item in everything if item.opcode == 12]
    indexes = [item for item in everything if item.opcode == 7]
    hit(path, attachment)
    report = recover_recording(path, dry_run=True)
    assert [place.why for place in report.damaged] == ["the attachment 'note' is damaged (its CRC differs)"]
    hit(path, indexes[0])
    flip(path, *metadata, path.stat().st_size - 20)
    report, recording = recovered(path)
    with recording:
        assert steps_of(recording) == wanted
        assert recording.attachments == {} or "note" not in recording.attachments
    said = [place.why for place in report.damaged]
    assert report.attachments_lost == ["note"]
    assert any("message index" in why for why in said)
    assert any("new uuid" in note for note in report.notes)


def test_damaged_metadata_are_made_anew(tmp_path: Path) -> None:
    """One wrong character is enough: nothing is guessed, and nothing is tried out."""
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted, uuid = steps_of(recording), recording.uuid
    flip(path, path.read_bytes().index(uuid.encode()) + 5, path.read_bytes().rindex(uuid.encode()) + 5)
    with pytest.raises(FormatError, match="'tupli_mcap.recording' is damaged: expected crc"):
        Recording(path)
    with tallied(zlib, "crc32", lambda data, *_: len(data)) as sizes:
        report = recover_recording(path)
    assert sum(sizes) < 100 * path.stat().st_size
    with Recording(report.target or "") as recording:
        assert steps_of(recording) == wanted
        assert recording.uuid != uuid
    assert report.notes == ["the recording's metadata are lost: it has a new uuid and names no benchmark"]
    assert ["metadata" in place.why for place in report.damaged] == [True, True]
    assert verify_recording(report.target or "").problems == []


def test_metadata_are_at_both_ends_and_either_is_enough(tmp_path: Path) -> None:
    whole = record(tmp_path / "a.mcap").read_bytes()
    path = tmp_path / "b.mcap"
    path.write_bytes(whole)
    with Recording(path) as recording:
        wanted, uuid = steps_of(recording), recording.uuid
    for find in (bytes.index, bytes.rindex):
        path.write_bytes(whole)
        flip(path, find(whole, uuid.encode()) + 5)
        said = [(problem.kind, problem.message) for problem in verify_recording(path).errors]
        assert any(kind == "metadata" and "expected crc" in message for kind, message in said)
        report, recording = recovered(path)
        with recording:
            assert (steps_of(recording), recording.uuid) == (wanted, uuid)
        assert ["metadata" in place.why for place in report.damaged] == [True]


def test_metadata_at_the_ends_that_differ_are_found(tmp_path: Path) -> None:
    """Both are whole, and one of them is another recording's."""
    path, other = record(tmp_path / "a.mcap"), record(tmp_path / "b.mcap")
    last = [item for item in places(path) if item.opcode == 12][-1]
    data, (_, stranger) = path.read_bytes(), (item for item in places(other) if item.opcode == 12)
    end = other.read_bytes()[stranger.offset : stranger.offset + stranger.length]
    path.write_bytes(data[: last.offset] + end + data[last.offset + last.length :])
    assert [problem.message for problem in verify_recording(path).errors] == [
        "expected what 'tupli_mcap.recording' says"
    ]


@pytest.mark.parametrize("name", ["unfinished", "unfinished_frames"])
def test_a_journal_is_found_by_the_uuid_in_damaged_metadata(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    with Recording(path) as recording:
        wanted, uuid = steps_of(recording), recording.uuid
    flip(path, path.read_bytes().index(b"created_ns") + 20)
    report, recording = recovered(path)
    with recording:
        assert (steps_of(recording), recording.uuid) == (wanted, uuid)
    assert report.journal == "used"
    assert report.notes == [
        "of the recording's metadata, format_version, library, created_ns, benchmark_id are lost"
    ]
    assert verify_recording(report.target or "").problems == []


@pytest.mark.sampled(8)
@pytest.mark.parametrize("kind", ["flip", "cut", "zero", "swap"])
@pytest.mark.parametrize("name", ["bundle", "dict_with_images", "unfinished", "variable", "vector_same_step"])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_damage_anywhere(name: str, kind: str, tmp_path: Path) -> None:
    """A sample of `tools/damage.py`: what is saved is true, what is missing is said, what is written is good."""
    found, tried = tool("damage").sweep(name, kind, place(name, tmp_path).stat().st_size // 7, tmp_path)
    assert tried >= 7
    assert not found


# ---- other MCAP files


@pytest.mark.parametrize("cut", [0, 500])
def test_other_files_are_refused(cut: int, tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.mcap")
    truncate(path, path.stat().st_size - cut)
    with pytest.raises(FormatError, match='nothing of a tupli_mcap recording .*"mcap recover"'):
        recover_recording(path)
    assert [p.name for p in tmp_path.iterdir()] == ["f.mcap"]


def test_a_recording_that_lost_its_spaces_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    flip(path, *(m.start() for m in re.finditer(b"observation_space", path.read_bytes())))
    with pytest.raises(FormatError, match='the spaces of the recording are .*"mcap recover" copies'):
        recover_recording(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


# ---- work grows as the file does


def index_heads(count: int) -> bytes:
    """The headers of as many episode indexes, each of which claims all that follows."""
    name, kind = INDEX_NAME.encode(), INDEX_MEDIA_TYPE.encode()
    head = 9 + 20 + len(name) + 4 + len(kind) + 8
    made = bytearray(MAGIC)
    for left in range(count * head + 4, 4, -head):
        made += struct.pack("<BQQQI", 9, left - 9, 1, 1, len(name)) + name
        made += struct.pack("<I", len(kind)) + kind + struct.pack("<Q", left - head - 4)
    return bytes(made) + b"crc?"


def record_heads(count: int) -> bytes:
    """The headers of as many Metadata records, each of which claims all that follows."""
    return MAGIC + b"".join(
        struct.pack("<BQI", 12, 30 * left - 9, 0xFFFF) + bytes(17) for left in range(count, 0, -1)
    )


def records_between_damage(count: int) -> bytes:
    """Pairs of empty Metadata records, and bytes that are no record before each."""
    return MAGIC + (b"\xee" * 9 + 2 * (struct.pack("<BQ", 12, 8) + bytes(8))) * count


@pytest.mark.parametrize(
    ("make", "work"),
    [
        (index_heads, lambda path: read_file_end(PathSource(path))),
        (record_heads, verify_recording),
        (record_heads, lambda path: gather(PathSource(path), FileEnd())),
        (records_between_damage, verify_recording),
    ],
)
def test_a_file_is_not_read_again_for_each_claim_in_it(
    make: Callable[[int], bytes], work: Callable[[Path], Any], tmp_path: Path
) -> None:
    def bytes_read(count: int) -> int:
        path = tmp_path / "a.mcap"
        path.write_bytes(make(count))
        with tallied(PathSource, "read", lambda _, __, length: length) as sizes:
            work(path)
        return sum(sizes)

    assert grows(bytes_read, 1500) < 1.3


def turn_round(path: Path) -> None:
    """Lets the chunks of a recording, with their indexes, lie in the file the other way round; its end is lost."""
    data = path.read_bytes()
    found = [item for item in places(path) if item.opcode in (Opcode.CHUNK, Opcode.MESSAGE_INDEX)]
    pairs = [(a.offset, b.offset + b.length) for a, b in zip(found[::2], found[1::2], strict=True)]
    path.write_bytes(data[: pairs[0][0]] + b"".join(data[first:stop] for first, stop in reversed(pairs)))


def test_chunks_may_come_in_any_order(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted = list(as_read(recording))
    turn_round(path)
    report, recording = recovered(path)
    with recording:
        assert_same(list(as_read(recording)), wanted)
    assert report.damaged == []


def test_a_chunk_that_comes_late_is_not_held_against_all_others(tmp_path: Path) -> None:
    def done(count: int) -> int:
        path = tmp_path / f"{count}.mcap"
        env = Sampler(BOX, spaces.Discrete(3), length=40)
        with RecordEpisodes(env, path, chunk_size=200, attachments={}) as recorder:  # a row each
            roll(recorder, count)
        turn_round(path)
        return calls(lambda: recover_recording(path, dry_run=True))

    assert grows(done, 150) < 1.3


class Looked(int):
    """A number that counts how often it is held against another one."""

    times = 0

    def __gt__(self, other: int) -> bool:
        Looked.times += 1
        return int(self) > other

    def __rsub__(self, other: int) -> int:
        Looked.times += 1
        return other - int(self)


def test_a_step_is_not_held_against_each_piece_of_its_episode(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=20, length=20)
    source = PathSource(path)
    gathered = gather(source, read_file_end(source))
    layout = Recording(path).layout
    (whole,) = make_plan(
        gathered, PackedStore(gathered), layout, RecordedChannels.of(gathered, layout)
    ).episodes
    source.close()

    def looked(count: int) -> int:
        places = NewPlaces(
            whole._replace(number=i, run=whole.run._replace(step=Looked(10 * i), steps=6))
            for i in range(count)
        )
        Looked.times = 0
        for step in range(10 * count):
            piece, at = divmod(step, 10)
            assert places.find(0, step) == (None if at >= 6 else (piece, at))
            assert places.find(0, step, state=True) == (None if at > 6 else (piece, at))
        return Looked.times

    assert grows(looked, 50) < 1.5


def test_rows_are_taken_once(tmp_path: Path) -> None:
    """Of two chunks with the same rows the first one in the file counts, and the other one is named."""
    path = record(tmp_path / "a.mcap")
    with Recording(path) as recording:
        wanted = steps_of(recording)
    data = path.read_bytes()
    twice = chunks(path, "/step")[1]
    stop = next(item for item in places(path) if item.offset > twice.offset + twice.length).offset
    path.write_bytes(data[:stop] + data[twice.offset : stop] + data[stop:])
    report, recording = recovered(path)
    with recording:
        assert steps_of(recording) == wanted
    (place,) = (place for place in report.damaged if "rows that another one holds" in place.why)
    assert place.offset == stop


# ---- targets, errors, the command


def test_targets(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    other = tmp_path / "other.mcap"
    assert recover_recording(path, dry_run=True).target is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap"]
    recover_recording(path, other)
    for dry_run in (True, False):
        with pytest.raises(RecordingError, match=r"other\.mcap exists; choose another path"):
            recover_recording(path, other, dry_run=dry_run)
        with pytest.raises(RecordingError, match=r"a\.mcap is never overwritten"):
            recover_recording(path, path, overwrite=True, dry_run=dry_run)
    recover_recording(path, other, overwrite=True)
    with pytest.raises(RecordingError, match="cannot be written"):
        recover_recording(path, other / "x.mcap")
    with pytest.raises(RecordingError, match="does not exist"):
        recover_recording(tmp_path / "none.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "other.mcap"]


def test_a_live_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path) as env:
        roll(env, 5)
        with pytest.raises(RecordingError, match=r"is being recorded; close its writer first"):
            recover_recording(path)


def test_a_directory_is_not_recovered(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is a directory; give one file"):
        recover_recording(tmp_path)
    result = CliRunner().invoke(app, ["recover", str(tmp_path)])
    each = f"tupli-mcap recover --in-place {tmp_path}"
    found = f"{tmp_path} is a directory; give recordings (.mcap), or finish all in it with: {each}"
    assert (result.exit_code, " ".join(result.stderr.split())) == (1, f"error: {found}")


def test_what_is_finished_in_a_directory(tmp_path: Path) -> None:
    record(tmp_path / "good.mcap")
    killed = place("unfinished", tmp_path)
    lost = tmp_path / "lost.mcap"
    shutil.copy(killed, lost)
    for option, told in (
        ("--dry-run", "can be finished (nothing was written)"),
        ("--in-place", "now finished"),
    ):
        done = CliRunner().invoke(app, ["recover", str(tmp_path), "--in-place", option])
        assert done.exit_code == 1
        assert f"save what is good in a new file: tupli-mcap recover {lost}" in done.stderr
        said = " ".join(done.stdout.split())
        assert said.startswith(f"{killed}: ") and told in said
        assert said.endswith("nothing was wrong with 1 of 3 recordings")


@pytest.mark.parametrize("content", [b"", b"nonsense" * 100, b"\x89MCAP0\r\n", bytes(5000)])
def test_nothing_to_save(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert result.exit_code == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    if not content:
        with pytest.raises(FormatError, match="is empty"):
            recover_recording(path)


def test_the_command(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    hit(path, chunks(path, "/step")[2])
    dry = CliRunner().invoke(app, ["recover", str(path), "--dry-run"])
    assert dry.exit_code == 0
    assert "nothing was written" in dry.output
    result = CliRunner().invoke(app, ["recover", str(path), "--json"])
    assert result.exit_code == 0
    report = json.loads(result.output)["result"]
    assert report["target"] == str(tmp_path / "a.recovered.mcap")
    assert report["steps"] + report["steps_lost"] == 300
    shown = CliRunner().invoke(app, ["recover", str(path), "--force"])
    assert "STEPS LOST" in shown.output
    assert "the chunk" in shown.output
    assert f"Delete {path}, or move it away" in " ".join(shown.output.split())


def test_several_files_are_recovered_one_after_the_other(tmp_path: Path) -> None:
    good, torn, none = (tmp_path / f"{name}.mcap" for name in ("good", "torn", "none"))
    record(good)
    hit(record(torn), chunks(torn, "/step")[2])
    none.write_bytes(b"nonsense" * 100)
    refused = CliRunner().invoke(app, ["recover", str(good), str(torn), "-o", str(tmp_path / "new.mcap")])
    assert refused.exit_code == 2
    assert "--output names one new recording; leave it out for 2 files" in refused.stderr

    done = CliRunner().invoke(app, ["recover", str(none), str(good), str(torn)])
    assert done.exit_code == 1
    assert done.stderr.startswith(f"error: {none}") and done.stderr.count("\n") == 1
    said = [line for line in done.stdout.splitlines() if line.startswith(str(tmp_path))]
    assert [line.partition(":")[0] for line in said] == [str(good), str(torn)]
    for file in (good, torn):
        assert file.with_suffix(".recovered.mcap").exists()
        file.with_suffix(".recovered.mcap").unlink()
    both = CliRunner().invoke(app, ["recover", str(good), str(torn)])
    assert both.exit_code == 0

    told = CliRunner().invoke(app, ["recover", str(none), str(torn), "--force", "--json"])
    bad, saved = json.loads(told.stdout)["result"]
    assert (told.exit_code, bad.keys()) == (1, saved.keys())
    assert bad["error"] in told.stderr and {value for key, value in bad.items() if value} == {
        bad["source"],
        bad["error"],
    }
    assert (saved["source"], saved["error"], saved["saved"]) == (str(torn), None, True)


def test_all_recordings_of_a_directory_are_finished(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    record(tmp_path / "live" / "finished.mcap")
    with RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), tmp_path / "live" / "killed.mcap") as env:
        roll(env, 5)
        shutil.copytree(tmp_path / "live", runs)
    done = CliRunner().invoke(app, ["recover", str(runs), "--in-place", "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["result"]
    assert [(one["target"], one["finished"]) for one in told] == [
        (str(runs / "finished.mcap"), True),
        (str(runs / "killed.mcap"), False),
    ]
    with Recording(runs / "killed.mcap") as recording:
        assert recording.complete and recording.n_steps == 5


def test_interrupted_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = record(tmp_path / "a.mcap")
    steps: list[Callable[..., Any]] = [os.fsync]

    def stop(fd: int) -> None:
        steps[0](fd)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", stop)
    with pytest.raises(KeyboardInterrupt):
        recover_recording(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_headers_of_a_chunk_are_read_once_not_for_each_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record(tmp_path / "a.mcap", steps=1200, length=2)
    hit(path, chunks(path, "/step")[3])
    calls = []

    def counted(data: Any, most: int) -> Any:
        calls.append(len(data))
        return message_places(data, most)

    monkeypatch.setattr("tupli_mcap.recording.columns.chunk_store.message_places", counted)
    report, recording = recovered(path)
    with recording:
        assert len(recording.episodes) > 500
        assert report.final_states_lost == []
    with Recording(path) as damaged:
        table = damaged._contents.table
    assert 0 < len(calls) <= len(table)


def test_no_step_saved_is_a_failure(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60, capture_env="pickle")
    for found in chunks(path, "/step"):
        hit(path, found)
    result = CliRunner().invoke(app, ["recover", str(path)])
    assert result.exit_code == 1
    said = " ".join(result.output.split())  # lines are broken where paths are long
    assert f"{path}: none of its 60 steps could be saved; 3 attachments saved to" in said
    with Recording(tmp_path / "a.recovered.mcap") as recording:
        assert (recording.n_steps, list(recording.attachments)) == (
            0,
            ["benchmark.json", "env.cloudpickle", "run.json"],
        )


def test_a_signature_stays_only_where_it_still_fits(tmp_path: Path) -> None:
    pytest.importorskip("cryptography")
    from signing_keys import write_key

    path = record(tmp_path / "a.mcap", steps=60)
    sign_recording(path, write_key(tmp_path / "key"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-3])
    report, recording = recovered(cut)
    with recording:
        verify_signature(recording)
        assert recording.n_steps == 60
    assert report.notes == []
    with Recording(path) as recording:
        run = recording.file.contents.attachments["run.json"]
    of_run = tmp_path / "run.mcap"
    of_run.write_bytes(path.read_bytes())
    flip(of_run, run.offset + run.length - 10)
    hit(path, chunks(path, "/step")[1])
    for file, lost in ((path, []), (of_run, ["run.json"])):
        told = recover_recording(file, dry_run=True)
        report, recording = recovered(file)
        assert (told.notes, told.attachments) == (report.notes, report.attachments)
        with recording:
            assert SIGNATURE_NAME not in recording.attachments
            assert 0 < recording.n_steps < 60 + bool(lost)
        assert report.notes == ["its signature is left out: it does not fit what could be saved"]
        assert report.attachments_lost == lost
        assert verify_recording(str(report.target)).problems == []


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_a_signature_of_sub_environments_stays_where_nothing_is_damaged(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "a.mcap"
    how = {"autoreset_mode": gym.vector.AutoresetMode[mode]}
    envs = gym.make_vec("CartPole-v1", 3, "sync", vector_kwargs=how)
    with RecordVector(envs, path) as env:
        env.action_space.seed(1)
        env.reset(seed=1)
        for _ in range(400):
            env.step(env.action_space.sample())
    with Recording(path) as recording:
        signed = manifest(recording)
    with recovered(path)[1] as recording:
        assert manifest(recording) == signed


def test_a_file_is_finished_in_place_whatever_lies_beside_it(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60)
    (tmp_path / "a.recovered.mcap").write_bytes(path.read_bytes())
    assert finish_recording(path).intact


@pytest.mark.parametrize("lost", ["benchmark.json", "env.cloudpickle"])
def test_appending_makes_no_environment_of_two_halves(lost: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60, capture_env="pickle")
    hit(path, next(item for item in places(path) if item.attachment and item.attachment.name == lost))
    report, recording = recovered(path)
    recording.close()
    assert report.attachments_lost == [lost]
    target = Path(str(report.target))
    other = Sampler(BOX, spaces.Discrete(3), length=40)
    other.steps = 1234567  # its pickle differs
    with RecordEpisodes(other, target, mode="a", capture_env="pickle") as env:
        roll(env, 20)
    found = verify_recording(target)
    assert (found.errors, found.steps) == ([], 80)
    with Recording(target) as appended:
        assert {"benchmark.json", "env.cloudpickle"} - set(appended.attachments) == {lost}


def test_episodes_lost_at_the_end_are_named_by_their_starts(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=300)
    with Recording(path) as recording:
        wanted = steps_of(recording)
    last = chunks(path, "/step")[-3:]
    ends = chunks(path, "/episode_end")
    index = next(item for item in places(path) if item.attachment and item.attachment.name == INDEX_NAME)
    for found in [*last, *ends, index]:
        hit(path, found)
    report, recording = recovered(path)
    with recording:
        assert_true(steps_of(recording), wanted, report)
    assert report.episodes_lost >= 1


def test_an_attachment_replaced_before_another_is_no_damage(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60)
    for content in (b"{}", b'{"a": 1}'):
        add_attachments(path, {"replay-certificate.json": ("application/json", content)})
        add_attachments(path, {f"card-{len(content)}.txt": ("text/plain", b"x")})
    assert verify_recording(path).problems == []
    report, recording = recovered(path)
    with recording:
        assert recording.read_attachment("replay-certificate.json") == b'{"a": 1}'
    assert report.intact


@pytest.mark.parametrize("kind", ["attachment", "metadata"])
def test_what_another_program_has_added_behind_the_index_is_not_cut_off(kind: str, tmp_path: Path) -> None:
    """As `mcap add attachment` and `mcap add metadata` do."""
    path = record(tmp_path / "a.mcap", steps=60)
    file = Model.of(path.read_bytes())
    if kind == "attachment":
        body = bytes(16) + strings(b"notes", b"text/plain") + (2).to_bytes(8, "little") + b"hi" + bytes(4)
        file.behind.append(FileRecord(ATTACHMENT, body))
    else:
        file.behind.append(FileRecord(METADATA, strings(b"notes", b"")))
    data = file.encode()
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="has added 'notes' behind the episode index.*recover"):
        add_attachments(path, {"more": ("text/plain", b"x")})
    with pytest.raises(RecordingError, match="has added 'notes' behind the episode index.*recover"):
        record(path, steps=60, mode="a")
    assert path.read_bytes() == data
    report, recording = recovered(path)
    with recording:
        assert recording.n_steps == 60
        assert ("notes" in recording.attachments) == (kind == "attachment")
    assert report.target is not None
    record(Path(report.target), steps=60, mode="a")
    with Recording(report.target) as recording:
        assert recording.n_steps == 120
    # what is made of it has it, too
    other = record(tmp_path / "b.mcap", steps=60)
    tupli_mcap.open(report.target).filter("episode > 0").save(tmp_path / "filtered.mcap")
    tupli_mcap.open([report.target, other]).save(tmp_path / "merged.mcap")
    tupli_mcap.open(report.target).filter("episode = 0").delete()
    FileStorage(tmp_path).compact({Path(report.target).name})
    for made in (report.target, tmp_path / "filtered.mcap", tmp_path / "merged.mcap"):
        with Path(made).open("rb") as stream:
            names = [one.name for one in make_reader(stream).iter_metadata()]
        assert names.count("notes") == (kind == "metadata")
        assert verify_recording(made).problems == []


def test_damage_before_the_metadata_of_another_program_does_not_get_into_copies(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60)
    file, notes = Model.of(path.read_bytes()), strings(b"notes", b"")
    file.behind.append(FileRecord(METADATA, notes))
    data = file.encode()
    length = len(notes).to_bytes(8, "little")
    assert data.count(length + notes) == 1
    path.write_bytes(data.replace(length + notes, b"\xff" + length[1:] + notes))
    copy = tupli_mcap.open(path).save(tmp_path / "copy.mcap")
    assert verify_recording(copy).problems == []
