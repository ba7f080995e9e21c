"""`verify_recording` and `verify_paths`: good files are good, and every damage is found, named and placed."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import unprivileged
from crafted import find_step
from damaged import BOX, chunks, flip, foreign, hit, places, record
from environments import Sampler, roll
from fuzzing.model import Model, footer
from golden_files import GOLDEN, NAMES, UNFINISHED, place
from gymnasium import spaces
from mcap.opcode import Opcode
from typer.testing import CliRunner

from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    files,
    journal_path,
    progress,
    recover_recording,
    verify_recording,
)
from tupli_mcap.cli.app import app
from tupli_mcap.doctor import examine
from tupli_mcap.errors import FormatError, NotFoundError
from tupli_mcap.mcap.chunks import chunk_records, message_headers
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.episodes import EpisodeEnd, EpisodeStart
from tupli_mcap.recording import VerifyReport, annotate_episodes, finish_recording
from tupli_mcap.recording.check.report import RECOVER
from tupli_mcap.recording.edit import assemble, rewrite
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.recording.index import INDEX_NAME, EpisodeRow, IndexBuilder
from tupli_mcap.schema import ArtifactMetadata
from tupli_mcap.storage.verify import verify_paths

_IN_JOURNAL = "steps that are still in its journal are not verified"
DO_NOT_CARE = (Opcode.HEADER,)  # the text that says which library wrote it


def kinds(report: VerifyReport) -> set[str]:
    return {problem.kind for problem in report.errors}


def said(report: VerifyReport) -> str:
    return "\n".join(f"{problem.place}: {problem.message}" for problem in report.problems)


# ---- good files


@pytest.mark.parametrize("name", NAMES)
def test_golden_recordings_are_good(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    before = path.read_bytes()
    report = verify_recording(path)
    assert report.errors == []
    assert report.ok
    assert report.state == ("unfinished" if name in UNFINISHED else "complete")
    with Recording(path) as recording:
        assert (report.episodes, report.steps) == (len(recording), recording.n_steps)
    assert path.read_bytes() == before
    assert [problem.severity for problem in report.problems] == ["note"] * (name in UNFINISHED)


@pytest.mark.parametrize("name", sorted(path.stem for path in (GOLDEN / "before_crc").glob("*.mcap")))
def test_recordings_of_earlier_writers_are_good(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path, GOLDEN / "before_crc")
    assert verify_recording(path).errors == []
    finish_recording(path)
    annotate_episodes(path, {"good": True})
    assert verify_recording(path).errors == []


@pytest.mark.parametrize("position", range(6))
def test_a_recovered_recording_is_good(position: int, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", length=200)
    everything = [item for item in places(path) if item.chunk is not None]
    hit(path, everything[position % len(everything)])
    assert not verify_recording(path).ok
    target = recover_recording(path).target
    assert verify_recording(target or "").problems == []


def test_a_live_recording_is_said_to_be_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path) as env:
        roll(env, 20)
        report = verify_recording(path)
        assert (report.state, report.ok) == ("recording", True)
        assert "a writer is at work" in said(report)
    assert verify_recording(path).problems == []


def test_an_unfinished_recording_is_no_damage(tmp_path: Path) -> None:
    path = place("unfinished", tmp_path)
    journal_path(path).unlink()
    report = verify_recording(path)
    assert report.ok
    assert "there is no journal beside it" in said(report)
    assert RECOVER in [problem.advice for problem in report.problems]
    assert not any("--in-place" in problem.advice for problem in report.problems)  # it would refuse


def kill_while_recording(path: Path, steps: int, **options: Any) -> None:
    """A recording whose process was killed after some steps."""
    pid = os.fork()
    if pid == 0:
        try:
            env = RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path, **options)
            env.reset(seed=1)
            for _ in range(steps):
                env.step(0)
        finally:
            os._exit(0)
    os.waitpid(pid, 0)


def test_the_journal_of_another_recording_is_told(tmp_path: Path) -> None:
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    kill_while_recording(path, 5)
    kill_while_recording(other, 5)
    journal_path(path).write_bytes(journal_path(other).read_bytes())
    code, out, _ = tell("verify", path)
    out = " ".join(out.split())  # lines are broken where paths are long
    assert code == 0
    assert _IN_JOURNAL not in out
    assert "steps that were not yet in a chunk are missing" in out
    assert "lost: steps not yet in a chunk" in " ".join(tell("recover", path)[1].split())


def test_a_journal_elsewhere_is_found(tmp_path: Path) -> None:
    path, directory = tmp_path / "a.mcap", tmp_path / "journals"
    directory.mkdir()
    kill_while_recording(path, 5, journal_dir=directory)
    assert _IN_JOURNAL in " ".join(tell("verify", path)[1].split())
    (journal,) = directory.iterdir()
    journal.unlink()
    assert f"there is no journal at {journal}" in " ".join(tell("verify", path)[1].split())


def test_killed_before_the_file_defines_its_channels_is_no_damage(tmp_path: Path) -> None:
    """Its journal defines them; also those that an append adds."""
    path = tmp_path / "a.mcap"
    given: list[dict[str, Any]] = [{}, {"record_info": True}]
    for options in given:
        if (pid := os.fork()) == 0:
            with RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path, mode="a", **options) as env:
                container: Any = env._writer.container
                container.define_channels = lambda: os.kill(os.getpid(), signal.SIGKILL)
                env.reset()
                env.step(0)
        os.waitpid(pid, 0)
        assert journal_path(path).exists()
        assert verify_recording(path).errors == []
        with RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path, mode="a") as env:
            roll(env, 3)
        assert verify_recording(path).problems == []


def test_killed_before_the_first_step_nothing_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    kill_while_recording(path, 0)
    assert "journal" not in tell("verify", path)[1]
    assert "lost:" not in tell("recover", path)[1]


def test_a_file_that_is_cut_off_is_damaged_unless_a_journal_goes_on(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    last = next(item for item in places(path) if item.chunk is not None)
    os.truncate(path, last.offset + last.length - 10)
    code, out, _ = tell("verify", path)
    assert code == 1
    assert "the last record is cut off" in out
    assert "if the file was cut off" in " ".join(tell("recover", path)[1].split())


# ---- damage


@pytest.mark.sampled(0, keep=["variable", "dict_with_images"])
@pytest.mark.parametrize(
    "name",
    ["constant_none", "constant_zstd", "dict_with_images", "infos", "variable", "vector_same_step", "bundle"],
)
def test_every_flipped_byte_is_found(name: str, tmp_path: Path) -> None:
    path = place(name, tmp_path)
    data = path.read_bytes()
    ignored = [item for item in places(path) if item.opcode in DO_NOT_CARE]
    assert [item.length for item in ignored] == [39]
    rng = random.Random(name)
    for _ in range(60):
        position = rng.randrange(len(data))
        bad = bytearray(data)
        bad[position] ^= 1 << rng.randrange(8)
        path.write_bytes(bad)
        report = verify_recording(path)
        library = any(item.offset + 27 <= position < item.offset + item.length for item in ignored)
        assert not report.ok or library or _same_records(path, data, tmp_path), position


def _same_records(path: Path, data: bytes, directory: Path) -> bool:
    """Whether a flip changed nothing: bits in a zstd frame that decoders ignore."""
    original = directory / "original.mcap"
    original.write_bytes(data)
    ours = [(item.opcode, bytes(item.body), item.chunk and bytes(item.chunk.data)) for item in places(path)]
    theirs = [
        (item.opcode, bytes(item.body), item.chunk and bytes(item.chunk.data)) for item in places(original)
    ]
    return ours == theirs


@pytest.mark.parametrize("topic", ["/step", "/episode_start", "/episode_end", "/final_state"])
def test_a_damaged_chunk_is_placed(topic: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    chunk = chunks(path, topic)[0]
    hit(path, chunk)
    report = verify_recording(path)
    assert [(p.kind, p.offset) for p in report.errors if p.kind == "chunk"] == [("chunk", chunk.offset)]
    assert all("recover" in problem.advice for problem in report.errors)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_recording(share: float, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    os.truncate(path, int(path.stat().st_size * share))
    report = verify_recording(path)
    assert report.state == "unfinished" or not report.ok
    assert report.problems


@pytest.mark.parametrize("content", [b"", b"nonsense" * 100, b"\x89MCAP0\r\n", bytes(5000)])
def test_what_is_no_recording(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    report = verify_recording(path)
    assert not report.ok
    assert not any("append to it" in problem.advice for problem in report.problems)
    with pytest.raises(RecordingError, match="does not exist"):
        verify_recording(tmp_path / "none.mcap")


def test_other_files_are_not_verified(tmp_path: Path) -> None:
    path = foreign(tmp_path / "f.mcap")
    code, out, _ = tell("verify", path)
    assert code == 1
    assert "it is an MCAP file, but no recording of tupli-mcap" in out
    assert '→ "mcap doctor" checks other MCAP files' in out and "EpisodeWriter makes episodes of a" in out


# ---- contents that are consistent, but wrong


class Forger(assemble.Assembler):
    """What a recording is rewritten to with a mistake, as a faulty writer would: CRCs and summary are right."""

    mistake = ""

    def __init__(self, container: Container) -> None:
        super().__init__(container)
        add = self.index.add

        def row(found: EpisodeRow, metadata: str) -> None:
            add(self.changed_row(found), metadata)

        self.index.add = row  # type: ignore[method-assign]

    def copy_first(self, *_: Any) -> int:
        return 0

    def add_chunk(self, rows: Any) -> None:
        super().add_chunk(self.changed(self.container.channels[rows.channel].topic, rows))

    def changed(self, topic: str, rows: Any) -> Any:
        data = bytearray(rows.data)
        size = int(rows.offsets[1]) if len(rows.offsets) > 1 else len(data)
        if topic == "/step" and rows.first == 0:
            if self.mistake == "step":
                data[size * 3 + BODY + 4] += 1
            elif self.mistake == "episode":
                data[size * 3 + BODY] += 1
            elif self.mistake == "flag":
                data[size * 3 - 1] = 1
            elif self.mistake == "bool":
                data[size * 3 - 1] = 2
            elif self.mistake == "publish_time":
                data[size * 3 + 23] ^= 1
            elif self.mistake == "cdr":
                data[size * 3 + 31] ^= 1
            elif self.mistake == "reward":
                data[size * 4 - 4] ^= 0x30
            elif self.mistake == "sequence":
                data[size * 3 + 11] ^= 1
        if topic == "/episode_end" and self.mistake == "end":
            body = memoryview(data)[BODY:size]
            told = EpisodeEnd.decode(body)
            data[BODY:size] = told._replace(length=told.length + 1).encode()
        if topic == "/episode_start" and self.mistake == "start":
            start = EpisodeStart.decode(memoryview(data)[BODY:size])
            data[BODY:size] = start._replace(first_row=start.first_row + 1).encode()
        if topic == "/final_state" and self.mistake == "final":
            data[BODY] ^= 1
        return rows._replace(data=bytes(data))

    def changed_row(self, row: EpisodeRow) -> EpisodeRow:
        if row.episode == 1:
            return {
                "length": row._replace(length=row.length - 1),
                "index_return": row._replace(episode_return=row.episode_return + 1),
                "index_seed": row._replace(seed=99),
                "index_end": row._replace(end=2 if row.end != 2 else 0),
                "index_final": row._replace(final_row=-1),
                "index_time": row._replace(end_time=row.end_time + 1),
            }.get(self.mistake, row)
        return row


def forge(recording: Recording, container: Container, mistake: str) -> None:
    """Rewrites a recording with a mistake."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rewrite, "Assembler", Forger)
        patch.setattr(Forger, "mistake", mistake)
        rewrite.write(recording, container, dict(recording.metadata), None, {}, signed=False)


MISTAKES = {
    "step": "has a step that does not follow the one before",
    "episode": "has the number of another episode",
    "flag": "ends its episode before its last step",
    "bool": "neither 0 nor 1",
    "publish_time": "publish times equal to log times",
    "cdr": "plain little-endian CDR",
    "reward": "its rewards sum up to",
    "sequence": "expected consecutive rows",
    "end": "its end and the index differ",
    "start": "its start and the index differ",
    "final": "is the final state of no episode",
    "length": "gives 59 of the 60 steps to episodes",
    "index_return": "its end and the index differ",
    "index_seed": "its start and the index differ",
    "index_end": "flags that differ from the end",
    "index_final": "its end and the index differ",
    "index_time": "its end and the index differ",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_faulty_writer_is_found_out(mistake: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60, length=20)
    target = tmp_path / "b.mcap"
    fd = os.open(target, os.O_RDWR | os.O_CREAT)
    with Recording(path) as recording:
        forge(recording, Container(fd, str(target), "zstd"), mistake)
    os.close(fd)
    report = verify_recording(target)
    assert not report.ok
    assert MISTAKES[mistake] in said(report)


@pytest.mark.parametrize("mistake", ["none"])
def test_a_rewriter_without_a_mistake_is_not(mistake: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", steps=60, length=20)
    fd = os.open(tmp_path / "b.mcap", os.O_RDWR | os.O_CREAT)
    with Recording(path) as recording:
        forge(recording, Container(fd, "b.mcap", "zstd"), mistake)
    os.close(fd)
    assert verify_recording(tmp_path / "b.mcap").problems == []
    assert IndexBuilder().count == 0


def test_a_wrong_artifact_is_found(tmp_path: Path) -> None:
    name = "artifacts/" + "0" * 64
    path = record(tmp_path / "a.mcap", attachments={name: ("application/octet-stream", b"x")})
    report = verify_recording(path)
    assert kinds(report) == {"attachment"}
    assert "has the SHA-256 2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881" in said(report)


# ---- directories and storages


def storage_at(root: Path) -> FileStorage:
    storage = FileStorage(root)
    for name in ("one", "two"):
        target = root / "recordings" / f"{name}.mcap"
        target.parent.mkdir(exist_ok=True, parents=True)
        record(target, steps=50)
    storage.store_artifact(b"data", ArtifactMetadata(name="n", description="d"))
    assert len(storage.list_episodes()) == 4
    return storage


def test_a_storage(tmp_path: Path) -> None:
    with storage_at(tmp_path / "lab") as storage:
        reports = [report for report, _ in verify_paths([storage.root])]
    assert [report.problems for report in reports] == [[], [], []]
    assert [report.kind for report in reports] == ["recording", "recording", "storage"]


def test_a_storage_with_damage_goes_on_and_sums_up(tmp_path: Path) -> None:
    root = tmp_path / "lab"
    with storage_at(root):
        artifact = next(path for path in (root / "artifacts").iterdir() if len(path.name) == 64)
        artifact.write_bytes(b"other")
        flip(root / "recordings" / "one.mcap", 2000)
        (root / "recordings" / "gone.mcap.journal").write_bytes(b"x")
        (root / "recordings" / f".tupli-mcap-{32 * '0'}.tmp").write_bytes(b"x")
        notes = {"version": 1, "uuid": Recording(root / "recordings" / "two.mcap").uuid, "deleted": [77]}
        (root / "recordings" / "two.mcap.json").write_text(json.dumps(notes))
        reports = [report for report, _ in verify_paths([root])]
        (root / "recordings" / "two.mcap.json").write_text("nonsense")
        again = [report for report, _ in verify_paths([root])]
    one, two, other = reports
    assert [report.ok for report in reports] == [False, True, False]
    assert one.path.endswith("one.mcap")
    assert "notes episodes that are not in the recording: [77]" in said(two)
    assert {problem.kind for problem in other.problems} == {"artifact", "leftover"}
    assert "has bytes with SHA-256" in said(other)
    assert "gone.mcap.journal is the journal of a recording that is not here" in said(other)
    assert "was left by a process that was killed" in said(other)
    assert kinds(again[1]) == {"sidecar"}


def test_an_artifact_whose_storing_was_killed_is_no_damage(tmp_path: Path) -> None:
    said_of = ArtifactMetadata(name="n", description="d")
    with FileStorage(tmp_path) as storage:
        item = storage.store_artifact(b"data", said_of)
        (tmp_path / "artifacts" / f"{item.id}.json").unlink()
        ((report, _),) = verify_paths([tmp_path])
        assert report.ok and "has no metadata, so it is not listed" in said(report)
        with pytest.raises(NotFoundError, match="there is no artifact"):
            storage.publish_artifact(item.id, "lab")
        storage.store_artifact(b"data", said_of)
        ((report, _),) = verify_paths([tmp_path])
        assert report.problems == []


def test_damage_is_not_hidden_by_a_thousand_notes(tmp_path: Path) -> None:
    root = tmp_path / "lab"
    with FileStorage(root) as storage:
        storage.store_artifact(b"data", ArtifactMetadata(name="n", description="d"))
    for i in range(1005):
        (root / f"gone_{i:04}.mcap.json").write_text("{}")
    (good,) = verify_paths([root])
    assert (good[0].ok, len(good[0].problems), good[0].more) == (True, 1000, 5)
    artifact = next(path for path in (root / "artifacts").iterdir() if len(path.name) == 64)
    artifact.write_bytes(b"other")
    (damaged,) = verify_paths([root])
    assert kinds(damaged[0]) == {"artifact"}
    assert (damaged[0].ok, len(damaged[0].problems), damaged[0].more) == (False, 1000, 6)


def test_a_storage_in_which_a_program_writes_meanwhile(tmp_path: Path) -> None:
    with storage_at(tmp_path / "lab") as storage, ThreadPoolExecutor(1) as pool:
        note = storage.root / "artifacts" / "note"
        writing = pool.submit(lambda: [files.write_bytes(note, b"") for _ in range(400)])
        while not writing.done():
            assert not [report.problems for report, _ in verify_paths([storage.root]) if report.problems]
        writing.result()


def test_a_plain_directory_and_several_paths(tmp_path: Path) -> None:
    record(tmp_path / "x" / "a.mcap") if (tmp_path / "x").mkdir() is None else None
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no")
    found = [report for report, _ in verify_paths([bad, tmp_path / "x", tmp_path / "none.mcap"])]
    assert [report.ok for report in found] == [False, True, False]
    assert "does not exist" in said(found[2])


def test_a_pattern(tmp_path: Path) -> None:
    for name in ("a1.mcap", "a2.mcap", "b.mcap"):
        record(tmp_path / name)
    found = [report for report, _ in verify_paths([tmp_path / "a*.mcap", str(tmp_path / "c*.mcap")])]
    assert [(Path(report.path).name, report.ok) for report in found] == [
        ("a1.mcap", True),
        ("a2.mcap", True),
        ("c*.mcap", False),
    ]


def test_the_command(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    good = CliRunner().invoke(app, ["verify", str(path)])
    assert (good.exit_code, good.output.strip()) == (0, f"{path}: ok (8 episodes, 300 steps)")
    hit(path, chunks(path, "/step")[1])
    other = record(tmp_path / "b.mcap", steps=20)
    both = CliRunner().invoke(app, ["verify", str(path), str(other)])
    assert both.exit_code == 1
    assert f"{other}: ok" in both.output
    assert "1 of 2 undamaged" in both.output
    assert "save what is good with tupli-mcap recover" in both.output
    report = json.loads(CliRunner().invoke(app, ["verify", str(path), "--json"]).output)["result"]
    assert (report["ok"], report["damaged"]) == (False, 1)
    assert report["reports"][0]["problems"][0]["kind"] == "chunk"
    assert CliRunner().invoke(app, ["verify"]).exit_code == 2


def test_memory_is_that_of_a_few_chunks(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "a.mcap"
    wide = spaces.Box(-1.0, 1.0, (512,), np.float64)
    with RecordEpisodes(Sampler(wide, spaces.Discrete(3), length=50), path) as env:
        roll(env, 4000)
    assert path.stat().st_size > 12_000_000
    tracemalloc.start()
    assert verify_recording(path).ok
    recover_recording(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8_000_000 + (64 << 20) * 0.2


@pytest.mark.parametrize("topic", ["/step", "/episode_start", "/episode_end", "/final_state"])
def test_one_bad_chunk_is_one_problem_in_the_text(topic: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    hit(path, chunks(path, topic)[0])
    shown = CliRunner().invoke(app, ["verify", str(path)], env={"COLUMNS": "80"})
    assert shown.exit_code == 1
    lines = shown.output.splitlines()
    assert lines[0].startswith(f"{path}: 1 problem (")
    assert "error" in lines[1]
    assert (
        sum(line.startswith("  error: ") for line in lines) == 1
    )  # its CRC differs, or it cannot be decompressed
    assert shown.output.count("tupli-mcap recover") == 1
    assert "follow from that; see --json" in shown.output
    problems = json.loads(CliRunner().invoke(app, ["verify", str(path), "--json"]).output)["result"][
        "reports"
    ][0]
    assert [problem["follows"] for problem in problems["problems"]].count(False) == 1
    assert len(problems["problems"]) > 3


@pytest.mark.parametrize("name", ["benchmark.json", "run.json"])
def test_a_bad_attachment_is_one_problem_in_the_text(name: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", name="ppo")
    flip(path, path.read_bytes().index(name.encode()) + 60)
    shown = CliRunner().invoke(app, ["verify", str(path)], env={"COLUMNS": "80"})
    assert shown.exit_code == 1
    assert shown.output.startswith(f"{path}: 1 problem (")
    assert shown.output.count("  error: ") == 1 and f"{name!r} is damaged" in shown.output


@pytest.mark.parametrize("name", ["run.json", "annotations.json", "made_of.json", "labels.json"])
def test_an_attachment_that_says_something_else_is_found(name: str, tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    add_attachments(path, {name: ("application/json", b"nonsense")})
    (problem,) = verify_recording(path).problems
    assert (problem.kind, problem.severity) == ("attachment", "error")
    assert problem.message.startswith(f"{name}: expected ")


@pytest.mark.sampled(0, keep=["205"])
@pytest.mark.parametrize("stride", [41, 205])
def test_killed_while_the_end_is_written_is_no_damage(tmp_path: Path, stride: int) -> None:
    path = tmp_path / "a.mcap"
    env = RecordEpisodes(Sampler(BOX, spaces.Discrete(3)), path)
    roll(env, 60)
    journal = journal_path(path).read_bytes()
    env.close()
    whole = path.read_bytes()
    index = next(item for item in places(path) if item.attachment and item.attachment.name == INDEX_NAME)
    for size in range(index.offset, len(whole), stride):
        path.write_bytes(whole[:size])
        journal_path(path).write_bytes(journal)
        report = verify_recording(path)
        assert (report.ok, report.state) == (True, "unfinished"), (size, said(report))
        assert recover_recording(path, overwrite=True).steps == 60


def test_a_cut_footer_is_not_said_to_be_nothing(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:-3])
    assert not verify_recording(path).ok
    report = recover_recording(path)
    assert not report.intact
    assert (report.steps, report.damaged[-1].why) == (300, "the footer is damaged or cut off")
    shown = CliRunner().invoke(app, ["recover", str(path), "--force"])
    assert "nothing was lost" in shown.output


# --- what there is to say of what cannot be verified ---


def tell(*args: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    return result.exit_code, result.stdout, result.stderr


def test_a_missing_file_is_told_with_one_advice(tmp_path: Path) -> None:
    path = tmp_path / "none.mcap"
    code, out, _ = tell("verify", path)
    assert code == 1
    assert out.splitlines() == [
        f"{path}: 1 problem (its episodes cannot be read)",
        "  error: does not exist",
        "  → give the path of a recording (.mcap)",
    ]


def test_nothing_to_verify_or_to_replay_is_said(tmp_path: Path) -> None:
    assert tell("verify", tmp_path) == (
        1, "", "error: there is nothing to verify; give recordings (.mcap) or directories of them\n"
    )  # fmt: skip
    (tmp_path / "empty.mcap").touch()
    code, _, err = tell("verify", "--rerun", tmp_path)
    assert (code, err.count("\n")) == (1, 1)
    assert err.startswith("error: no episode was run again")


def test_a_lost_journal_is_not_called_all_there(tmp_path: Path) -> None:
    path = place(next(iter(UNFINISHED)), tmp_path)
    assert _IN_JOURNAL in " ".join(tell("verify", path)[1].split())
    journal_path(path).unlink()
    _, out, _ = tell("verify", path)
    assert "no journal beside it" in out
    with pytest.warns(UserWarning, match="no journal"):
        found = examine(path)
    for text in (out, *(finding.message for finding in found.findings)):
        assert _IN_JOURNAL not in " ".join(text.split())


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "command", ["verify", "recover", "ls", "info", "episodes", "doctor", "trust", "import"]
)
def test_what_may_not_be_read_fails_and_is_no_usage_error(command: str, tmp_path: Path) -> None:
    path = place(NAMES[0], tmp_path)
    path.chmod(0)
    done = unprivileged(command, path, *(["--storage", tmp_path / "lab"] if command == "import" else []))
    assert done.returncode == 1
    assert "permissions" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.sampled(1)
@pytest.mark.parametrize("command", ["verify", "ls"])
def test_a_closed_directory_stops_nothing(command: str, tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0)
    shutil.copy(place(NAMES[0], tmp_path), tmp_path / "open.mcap")
    done = unprivileged(command, tmp_path / "closed", tmp_path / "open.mcap")
    assert done.returncode == 1
    assert "cannot be read" in done.stdout + done.stderr
    assert "open.mcap" in done.stdout


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(RecordingError, match="a device, a pipe or a socket"):
        recover_recording(tmp_path / "pipe.mcap")


@pytest.mark.parametrize("kept", [0, 31], ids=["messages", "bodies"])
def test_rows_that_change_places_inside_an_episode_are_found(kept: int, tmp_path: Path) -> None:
    """Whole messages, or what they say: then sequence numbers and times are right, too."""
    path = record(tmp_path / "a.mcap", steps=60, length=20)
    model = Model.of(path.read_bytes())
    (part, i), (other, j) = find_step(model, 1, 5), find_step(model, 1, 12)
    one, two = part.inner[i], other.inner[j]
    part.inner[i], other.inner[j] = one[:kept] + two[kept:], two[:kept] + one[kept:]
    path.write_bytes(model.encode())
    wrong = [item for item in verify_recording(path).problems if "does not follow the one" in item.message]
    assert [(item.channel, item.episode, item.step) for item in wrong] == [("/step", 1, 5), ("/step", 1, 12)]


def test_bools_other_than_0_and_1_are_found(tmp_path: Path) -> None:
    space = spaces.Box(0, 1, (3,), np.bool_)
    path = tmp_path / "a.mcap"
    with RecordEpisodes(Sampler(space, spaces.Discrete(2)), path, compression="none") as env:
        roll(env, 30)
    model = Model.of(path.read_bytes())
    (part,) = (part for part in model.chunks() if b"/step" in part.inner[1][:60])
    row = bytearray(part.inner[-1])
    row[35 + 8] = 7
    part.inner[-1] = bytes(row)
    path.write_bytes(model.encode())
    assert "has a bool in 'state' other than 0 and 1" in said(verify_recording(path))
    with (
        pytest.raises(FormatError, match="expected bools of 0 or 1 in 'state'"),
        Recording(path) as recording,
    ):
        recording.read()


def test_a_chunk_of_too_many_messages_is_left_early() -> None:
    """No more of them are looked at than its compressed bytes can stand for: not the bytes behind them, either."""
    sizes = [35, 36] * 5000
    data = b"".join(struct.pack("<BQ", 5, size - 9) + bytes(size - 9) for size in sizes)
    with pytest.raises(FormatError, match="expected at most 1600 messages"):
        chunk_records(memoryview(data + b"no message"), "the chunk", packed=100)
    assert len(message_headers(memoryview(data))) == 10_000


@pytest.mark.parametrize("claimed", [9, 27, 1 << 31, 1 << 63, (1 << 64) - 1])
def test_a_message_of_another_size_than_it_claims_is_found(claimed: int) -> None:
    data = struct.pack("<BQ", 5, 26) + bytes(26) + struct.pack("<BQ", 5, claimed) + bytes(26)
    with pytest.raises(FormatError, match=f"expected a message record at byte .* of {claimed} bytes"):
        message_headers(memoryview(data))


@pytest.mark.parametrize("size", [0, 9, 18])
def test_a_summary_offset_of_another_size_is_found(size: int, tmp_path: Path) -> None:
    path = place("constant_zstd", tmp_path)
    data = path.read_bytes()
    start, offsets = struct.unpack_from("<QQ", data, len(data) - 28)
    summary = data[start : len(data) - 37] + struct.pack("<BQ", Opcode.SUMMARY_OFFSET, size) + bytes(size)
    path.write_bytes(data[:start] + summary + footer(start, offsets, summary))
    assert f"a summary offset has {size} bytes, not 17" in said(verify_recording(path))


def test_a_summary_offset_that_is_not_there_is_found(tmp_path: Path) -> None:
    path = place("constant_zstd", tmp_path)
    data = path.read_bytes()
    start, offsets = struct.unpack_from("<QQ", data, len(data) - 28)
    summary = data[start : len(data) - 37 - 26]  # without the last offset
    path.write_bytes(data[:start] + summary + footer(start, offsets, summary))
    assert "no summary offset points to the records with opcode" in said(verify_recording(path))


def test_a_bar_shows_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "seeds["
    place.mkdir()
    path = record(place / "seed]a.mcap", steps=4000, length=20)  # no markup of rich
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    monkeypatch.setattr(progress, "_PAUSE", 0.0)
    monkeypatch.setattr(progress, "_visible", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich believe in a terminal
    assert verify_recording(path).ok
    percents = [int(found) for found in re.findall(r"(\d+)%", capsys.readouterr().err)]
    assert percents == sorted(percents)
    assert percents[0] < 20 and 50 < percents[-1] <= 100
