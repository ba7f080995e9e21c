"""Frozen recordings, one a feature: today's code reads them, writes them, and other readers agree.

`tools/make_golden.py` wrote them; the values beside them are from the environments, not from the files.
"""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from golden_files import (
    EARLIER,
    GOLDEN,
    NAMES,
    UNFINISHED,
    as_read,
    assert_same,
    expected,
    finished,
    place,
    unpacked_journal,
)
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tool_modules import tool

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.mcap.records import PROFILE
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.recording import Recording, finish_recording
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.edit.merge import Excerpt
from tupli_mcap.recording.edit.rewrite import rewrite_recording
from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.recording.opened import read_contents
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.recording.write.writer import RecordingWriter

UNCOMPRESSED = [name for name in NAMES if name not in ("constant_zstd", "constant_lz4")]


def test_there_is_one_for_each_feature_and_all_are_small() -> None:
    assert set(NAMES) == set(tool("make_golden").FEATURES)
    assert sum(path.stat().st_size for path in GOLDEN.iterdir() if path.is_file()) < 512 * 1024


@pytest.mark.parametrize("name", NAMES)
def test_reads_what_the_environment_returned(name: str, tmp_path: Path) -> None:
    with Recording(place(name, tmp_path)) as recording:
        assert recording.complete == (name not in UNFINISHED)
        assert_same(list(as_read(recording)), expected(name))
        number = list(tool("make_golden").FEATURES).index(name)
        assert int(recording.uuid, 16) == 1 + number or name == "rewritten"
        assert recording.n_steps == sum(len(episode["rewards"]) for episode in expected(name))


@pytest.mark.parametrize("name", UNFINISHED)
def test_what_was_killed_while_it_was_finished_can_be_finished(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    journal = tmp_path / f"{name}.mcap.journal"
    kept = journal.read_bytes()
    finish_recording(path)
    whole = path.read_bytes()
    summary = int.from_bytes(whole[-28:-20], "little")
    for end in (summary, len(whole) - 37):  # nothing of the summary, and all but the footer
        path.write_bytes(whole[:end])
        journal.write_bytes(kept)
        report = finish_recording(path)
        assert (report.target, report.damaged, report.finished) == (str(path), [], False)
        assert not journal.exists()
        with Recording(path) as recording:
            assert recording.complete
            assert_same(list(as_read(recording)), expected(name))
        assert verify_recording(path).ok


@pytest.mark.parametrize("name", UNFINISHED)
def test_what_was_not_finished_can_be_in_its_place(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    before = path.read_bytes()
    finish_recording(path, dry_run=True)
    assert path.read_bytes() == before
    report = finish_recording(path)
    assert report.target == str(path)
    assert [left.name for left in tmp_path.iterdir()] == [path.name]
    with Recording(path) as recording:
        assert recording.complete
        assert_same(list(as_read(recording)), expected(name))
    assert verify_recording(path).ok
    finished = path.read_bytes()
    assert finish_recording(path).intact
    assert path.read_bytes() == finished
    path.write_bytes(finished[: len(finished) // 2])
    with pytest.raises((RecordingError, FormatError)):
        finish_recording(path)
    assert path.read_bytes() == finished[: len(finished) // 2]


@pytest.mark.parametrize(("folder", "name"), EARLIER)
def test_reads_those_of_earlier_writers(folder: str, name: str, tmp_path: Path) -> None:
    """Those of the first one have no checksum in their metadata; then journals did not say how long the file was; then
    the metadata were at the beginning only."""
    directory = GOLDEN / folder
    with Recording(place(name, tmp_path, directory)) as recording:
        assert ("crc" in recording._contents.channels[1].metadata) == (folder != "before_crc")
        assert_same(list(as_read(recording)), expected(name, directory))
    RecordingWriter(tmp_path / f"{name}.mcap", RecordOptions(mode="a")).close()
    with Recording(tmp_path / f"{name}.mcap") as recording:
        assert recording.complete
        assert_same(list(as_read(recording)), expected(name, directory))


@pytest.mark.parametrize("name", NAMES)
def test_columns_are_the_steps(name: str, tmp_path: Path) -> None:
    with Recording(place(name, tmp_path)) as recording:
        columns = recording.read()
        wanted = [step for episode in recording.episodes for step in episode]
        layout = recording.layout
        for leaf in layout.state:
            column = leaf.get(columns.states)
            assert len(column) == len(wanted)
            for value, step in zip(column, wanted, strict=True):
                assert jsonvalue.dumps(
                    np.asarray(value) if leaf.kind != "variable" else value
                ) == jsonvalue.dumps(
                    np.asarray(leaf.get(step.state)) if leaf.kind != "variable" else leaf.get(step.state)
                )
        assert columns.terminals.tolist() == [step.terminal for step in wanted]
        assert columns.timeouts.tolist() == [step.timeout for step in wanted]


@pytest.mark.parametrize("name", UNFINISHED)
def test_finishing_an_unfinished_one_loses_nothing(name: str, tmp_path: Path) -> None:
    with Recording(finished(name, tmp_path)) as recording:
        assert recording.complete
        assert_same(list(as_read(recording)), expected(name))


@pytest.mark.parametrize("name", NAMES)
def test_rewriting_one_keeps_everything(name: str, tmp_path: Path) -> None:
    """Of a vector recording too, whose episodes end in another order than they begin in."""
    with Recording(place(name, tmp_path)) as recording:
        rewrite_recording(recording, tmp_path / "new.mcap")
        uuid = recording.uuid
    report = verify_recording(tmp_path / "new.mcap")
    assert (report.kind, report.problems) == ("recording", [])
    with Recording(tmp_path / "new.mcap") as rewritten:
        assert_same(list(as_read(rewritten)), expected(name))
        assert (rewritten.uuid, rewritten.complete) == (uuid, True)


@pytest.mark.parametrize("without", [("states", "infos"), ("actions", "frames"), ("states", "actions")])
@pytest.mark.parametrize("name", NAMES)
def test_fields_can_be_left_out(name: str, without: tuple[str, str], tmp_path: Path) -> None:
    with Recording(finished(name, tmp_path)) as recording:
        whole = list(as_read(recording))
        opened = contextlib.nullcontext([Excerpt(recording, recording.index)])
        (tmp_path / "few.mcap").write_bytes(b"".join(stream_excerpts(opened, without)))
        cameras = recording.cameras
    assert verify_recording(tmp_path / "few.mcap").problems == []
    with Recording(tmp_path / "few.mcap") as few:
        assert few.cameras == (() if "frames" in without else cameras)
        for episode in whole:
            nothing = [{}] * len(episode["rewards"])
            episode |= {field: nothing for field in ("states", "actions") if field in without}
            if "states" in without and episode["final_state"] is not None:
                episode["final_state"] = {}
            if "infos" in without:
                episode["infos"] = None
        assert_same(list(as_read(few)), whole)


@pytest.mark.parametrize("name", NAMES)
def test_other_readers_decode_every_message(name: str, tmp_path: Path) -> None:
    path = finished(name, tmp_path)
    with Recording(path) as recording:
        layout, steps, episodes = recording.layout, recording.n_steps, len(recording)
        lengths = {episode.number: len(episode) for episode in recording.episodes}
        states = {e.number: [step.state for step in e] for e in recording.episodes}
    seen: dict[str, int] = {}
    places = set()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == PROFILE
        for _, channel, message, decoded in reader.iter_decoded_messages():
            topic = channel.topic.rpartition("/")[2] if channel.topic.endswith("/step") else channel.topic
            seen[topic] = seen.get(topic, 0) + 1
            assert message.log_time == message.publish_time
            if topic != "step":
                continue
            places.add((decoded.episode, decoded.step))
            for leaf in layout.state:
                if leaf.kind != "variable" and not leaf.apart and leaf.size:
                    value = np.asarray(leaf.get(states[decoded.episode][decoded.step]))
                    raw = value.view(np.uint16) if value.dtype == np.float16 else value
                    stored = getattr(decoded, leaf.name)
                    stored = np.asarray(list(stored) if isinstance(stored, bytes) else stored)
                    stored = stored.reshape(value.shape)
                    np.testing.assert_array_equal(stored, raw, err_msg=leaf.path)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(seen.values())
        assert {a.name for a in summary.attachment_indexes} >= {"episodes.index"}
        assert sum(1 for _ in reader.iter_attachments()) == len(summary.attachment_indexes)
        first, last = reader.iter_metadata()
        assert (first.name, last.name) == ("tupli_mcap.recording", "tupli_mcap.recording.repeated")
        assert first.metadata == last.metadata
    assert seen["step"] == steps
    assert seen["/episode_start"] == seen["/episode_end"] == episodes
    assert places == {(number, step) for number, length in lengths.items() for step in range(length)}


def parts(path: Path) -> list[bytes]:
    """The bytes of a recording, its index uncompressed: versions of zstd may write other bytes."""
    with contextlib.closing(PathSource(path)) as source:
        contents = read_contents(source)
        before = source.read(0, contents.data_end)
    index = contents.index
    return [before, index.episodes.tobytes(), index.chunks.tobytes(), bytes(index.metadata)]


@pytest.mark.parametrize("name", UNCOMPRESSED)
@pytest.mark.filterwarnings("ignore:.*is declared float32:UserWarning")
def test_the_writer_writes_the_same_bytes(name: str, tmp_path: Path) -> None:
    tool("make_golden").make(name, tmp_path)
    hint = "the format changed: say so in schemas/README.md and run tools/make_golden.py"
    assert (tmp_path / f"{name}.json").read_text() == (GOLDEN / f"{name}.json").read_text()
    if name in UNFINISHED:
        assert (tmp_path / f"{name}.mcap").read_bytes() == (GOLDEN / f"{name}.mcap").read_bytes(), hint
        journals = [unpacked_journal(name, directory) for directory in (tmp_path, GOLDEN)]
        assert journals[0] == journals[1], hint
    else:
        assert parts(tmp_path / f"{name}.mcap") == parts(GOLDEN / f"{name}.mcap"), hint


@pytest.mark.parametrize(("name", "every"), [("frames", 2), ("unfinished_frames", 1)])
def test_frames_show_what_was_drawn(name: str, every: int, tmp_path: Path) -> None:
    painting = tool("make_golden").painting
    with Recording(place(name, tmp_path)) as recording:
        assert recording.cameras == ("render",)
        for number, episode in enumerate(recording.episodes):
            steps = [s for s in range(len(episode) + 1) if s % every == 0 or s == len(episode)]
            if episode.end == "interrupted":
                steps = [s for s in steps if s % every == 0]
            assert episode.frames.steps.tolist() == steps
            for step, frame in zip(steps, episode.frames, strict=True):
                np.testing.assert_array_equal(frame, painting(number, step))


def test_attachments_and_benchmark() -> None:
    with Recording(GOLDEN / "constant_zstd.mcap") as recording:
        assert recording.benchmark_id == "b" * 64
        assert recording.created_ns == tool("make_golden").START_NS
        assert list(recording.attachments) == ["benchmark.json", "note"]
        assert recording.read_attachment("note") == b"golden"
        assert recording.benchmark.record.name == "Pole-v0"
    with Recording(GOLDEN / "rewritten.mcap") as recording:
        assert [episode.number for episode in recording.episodes] == [0, 2]
        assert recording.read_attachment("note") == b"rewritten"


def test_the_three_compressions_hold_the_same() -> None:
    for name in ("constant_lz4", "constant_none"):
        assert (GOLDEN / f"{name}.json").read_text() == (GOLDEN / "constant_zstd.json").read_text()


@pytest.mark.parametrize("version", [b"0", b"3", b"9"])
def test_another_version_is_refused(version: bytes, tmp_path: Path) -> None:
    data = (GOLDEN / "unfinished.mcap").read_bytes()
    key = b"format_version" + (1).to_bytes(4, "little")
    assert data.count(key + b"1") == 1
    path = tmp_path / "other.mcap"
    path.write_bytes(data.replace(key + b"1", key + version))
    with pytest.raises(FormatError, match="is damaged: expected crc") as damaged:
        Recording(path)
    crc, found = re.findall("crc ([0-9a-f]{8}), found '([0-9a-f]{8})'", str(damaged.value))[0]
    path.write_bytes(path.read_bytes().replace(found.encode(), crc.encode()))
    with pytest.raises(FormatError, match=f"expected format version '1' or '2', found '{version.decode()}'"):
        Recording(path)


def test_expected_values_are_strict_json() -> None:
    for name in NAMES:
        json.loads((GOLDEN / f"{name}.json").read_text(), parse_constant=pytest.fail)
