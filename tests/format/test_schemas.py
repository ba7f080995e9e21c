"""The specification in `schemas/` says what the code does: tables, message texts and JSON Schemas."""

from __future__ import annotations

import json
import re
import struct
import tomllib
import zlib
from itertools import takewhile
from pathlib import Path
from typing import Any

import gymnasium as gym
import jsonschema
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from sample_spaces import SPACES, space_id
from schema_files import ROOT, SCHEMAS, validator

from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.journal.file import PAGE, Journal, LogArea, RowArea, journal_path
from tupli_mcap.mcap.container import CHUNK_ROWS, COMPRESSIONS
from tupli_mcap.mcap.records import BODY, CDR_HEADER, HEADER_FIELDS, PROFILE, RECORD_HEADER
from tupli_mcap.messages.episodes import END_NAMES, EpisodeEnd, EpisodeStart, record
from tupli_mcap.messages.frames import FRAME_LAYOUT, encode_pair
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topic, Topics, parse
from tupli_mcap.recording import Recording
from tupli_mcap.recording.contents import RECORDING_METADATA
from tupli_mcap.recording.index import EPISODE_ROWS, INDEX_MEDIA_TYPE, INDEX_NAME, EpisodeRow, IndexBuilder
from tupli_mcap.schema import ArtifactMetadata
from tupli_mcap.spaces.leaves import ROS_TYPES
from tupli_mcap.spaces.space_json import space_to_json
from tupli_mcap.storage import FileStorage
from tupli_mcap.wrappers import RecordEpisodes

SPEC = (SCHEMAS / "README.md").read_text(encoding="utf-8")
FORMATS = {"u8": "B", "bool": "?", "u16": "H", "u32": "I", "u64": "Q", "i64": "q", "f64": "d"}


def table(name: str) -> list[dict[str, str]]:
    """The rows of the specification's table `name`."""
    lines = SPEC.split(f"<!-- table: {name} -->\n", 1)[1].splitlines()
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in takewhile(lambda line: line.startswith("|"), lines)
    ]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[2:]]


def read_by_table(name: str, data: bytes) -> dict[str, Any]:
    """The fields with a constant place, taken from `data` as the table says."""
    found: dict[str, Any] = {}
    for row in table(name):
        if row["offset"] == "" or row["size"] == "":
            continue
        offset, size = int(row["offset"]), int(row["size"])
        field = row["field"].strip("`")
        code = FORMATS.get(row["type"])
        if code is None:
            found[field] = data[offset : offset + size]
        else:
            assert struct.calcsize(f"<{code}") == size, row
            (found[field],) = struct.unpack_from(f"<{code}", data, offset)
    return found


def place(name: str, field: str) -> int:
    """The offset of a field in a table."""
    return next(int(row["offset"]) for row in table(name) if row["field"].strip("`") == field)


def without_comments(path: Path) -> str:
    """A `.msg` file as schema text: no comments, one space between type and name."""
    lines = (" ".join(line.split("#", 1)[0].split()) for line in path.read_text().splitlines())
    return "".join(f"{line}\n" for line in lines if line)


class WithArtifact(TupliEnvWrapper):
    """A benchmark that needs one artifact."""

    def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
        return env, [self.storage.store_artifact(b"0.5", ArtifactMetadata(name="wind")).id]


class TestTables:
    def test_message_record(self) -> None:
        data = record(7, 8, 9, b"body")
        assert read_by_table("message-record", data) == {
            "opcode": 5,
            "length": len(data) - 9,
            "channel": 7,
            "sequence": 8,
            "log_time": 9,
            "publish_time": 9,
            "cdr": CDR_HEADER,
        }
        assert place("message-record", "body") == BODY == RECORD_HEADER.size + len(CDR_HEADER)
        assert [(f"#{row['field']}", int(row["offset"])) for row in table("message-record")[:-1]] == [
            (name, offset) for name, _, offset in HEADER_FIELDS
        ]

    def test_frame(self) -> None:
        assert read_by_table("frame", encode_pair(3, 9)) == {"episode": 3, "step": 9}
        assert [(row["field"], int(row["offset"])) for row in table("frame")] == [
            (field.name, field.offset) for field in FRAME_LAYOUT.fields
        ]

    def test_episode_start(self) -> None:
        message = EpisodeStart(1, 2, 3, True, False, "77", "[1]", "{}")
        body = message.encode()
        assert read_by_table("episode-start", body) == {
            "episode": 1,
            "env": 2,
            "first_row": 3,
            "seed_given": True,
            "continued": False,
        }
        at = place("episode-start", "seed")
        assert body[at : at + 7] == struct.pack("<I", 3) + b"77\0"
        assert [row["field"] for row in table("episode-start")] == list(message._fields)

    def test_episode_end(self) -> None:
        message = EpisodeEnd(1, 2, 3, 4, 0.5, 2, True, "{}")
        body = message.encode()
        assert read_by_table("episode-end", body) == dict(zip(message._fields[:7], message[:7], strict=True))
        at = place("episode-end", "metadata")
        assert body[at:] == struct.pack("<I", 3) + b"{}\0"
        assert [row["field"] for row in table("episode-end")] == list(message._fields)
        values = next(row["value"] for row in table("episode-end") if row["field"] == "end")
        assert values == ", ".join(f"{i} {name}" for i, name in enumerate(END_NAMES))

    def test_info(self) -> None:
        codec = InfoCodec(["score", "other"])
        body = codec.encode(1, 2, {"score": 0.25})
        for k, (value, here) in enumerate([(0.25, True), (0.0, False)]):
            found = read_by_table("info-field", body[8 + 16 * k :])
            assert found == {"<name>": value, "has_<name>": here, "pad_<name>": bytes(7)}
        text, metadata = codec.schema()
        assert text.splitlines()[2:5] == ["float64 score", "bool has_score", "uint8[7] pad_score"]
        assert json.loads(metadata["fields"]) == ["score", "other"]

    def test_index(self) -> None:
        builder = IndexBuilder()
        builder.add(EpisodeRow(1, 2, 0.5, 3, 4, 5, 6, 7, -1, 8, 9, 2), '{"a":1}')
        chunk = np.array((1, 2, 3, 4, 5, 6, 7, 8, COMPRESSIONS.index("lz4"), 0), CHUNK_ROWS).tobytes()
        data = builder.encode(chunk)
        assert read_by_table("index-header", data) == {
            "magic": b"TMIDX\0\0\1",
            "episodes": 1,
            "chunks": 1,
            "metadata": 7,
        }
        parts, at = [], 32
        for _ in range(3):
            (size,) = struct.unpack_from("<Q", data, at)
            parts.append(zstandard.ZstdDecompressor().decompress(data[at + 8 : at + 8 + size]))
            at += 8 + size
        assert at == len(data)
        assert read_by_table("episode-row", parts[0]) == {
            "first_row": 1,
            "length": 2,
            "return": 0.5,
            "start_time": 3,
            "end_time": 4,
            "seed": 5,
            "start_row": 6,
            "end_row": 7,
            "final_row": -1,
            "metadata_offset": 0,
            "metadata_length": 7,
            "episode": 8,
            "env": 9,
            "end": 2,
            "has_seed": 1,
            "pad": b"\0\0",
        }
        assert read_by_table("chunk-row", parts[1]) == {
            "offset": 1,
            "length": 2,
            "uncompressed": 3,
            "first": 4,
            "rows": 5,
            "skip": 6,
            "crc": 7,
            "channel": 8,
            "compression": 2,
            "pad": 0,
        }
        assert parts[2] == b'{"a":1}'
        values = next(row["value"] for row in table("chunk-row") if row["field"] == "compression")
        assert values == ", ".join(f"{i} {name}" for i, name in enumerate(COMPRESSIONS))
        assert f"name `{INDEX_NAME}`" in SPEC
        assert f"`{INDEX_MEDIA_TYPE}`" in SPEC

    @pytest.mark.parametrize(("name", "dtype"), [("episode-row", EPISODE_ROWS), ("chunk-row", CHUNK_ROWS)])
    def test_rows_are_these_dtypes(self, name: str, dtype: np.dtype[Any]) -> None:
        fields: Any = dtype.fields
        expected = {key: (fields[key][1], fields[key][0].itemsize) for key in fields}
        found = {row["field"]: (int(row["offset"]), int(row["size"])) for row in table(name)}
        assert found == expected
        size = sum(int(row["size"]) for row in table(name))
        assert size == dtype.itemsize
        assert f"| {size} each |" in SPEC

    def test_journal(self, tmp_path: Path) -> None:
        path = journal_path(tmp_path / "a.mcap")
        areas = [RowArea("steps", 100, 10, 3), LogArea("events", 1000, 1)]
        journal = Journal(path, areas, {"uuid": "0" * 32})
        journal.publish()
        data = path.read_bytes()
        journal.remove()
        head = read_by_table("journal-header", data)
        text = data[place("journal-header", "description") :][: head["length"]]
        assert head["magic"] == b"TMCAPJ1\0"
        assert head["crc"] == zlib.crc32(text)
        description = json.loads(text)
        assert description["info"] == {"uuid": "0" * 32}
        assert [entry["kind"] for entry in description["areas"]] == ["rows", "log"]
        for entry in description["areas"]:
            listed = ", ".join(f'"{key}"' for key in list(entry)[1:])
            assert f'`{{"kind": "{entry["kind"]}", {listed}}}`' in SPEC
        first = -(-(16 + len(text)) // PAGE) * PAGE
        assert journal.offsets == {"steps": first, "events": first + -(-2 * 3 * 11 * 100 // PAGE) * PAGE}
        assert areas[1].size == 64 + 1000


class TestMessages:
    def test_files_are_the_schemas_of_a_recording(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
            env.reset(seed=0)
            env.step(0)
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        written = {schema.name: schema.data.decode() for schema in summary.schemas.values()}
        example = SCHEMAS / "examples" / "CartPole"
        files = [SCHEMAS / "EpisodeStart.msg", SCHEMAS / "EpisodeEnd.msg", example / "Step.msg"]
        files.append(example / "FinalState.msg")
        assert written == {f"tupli_mcap/msg/{file.stem}": without_comments(file) for file in files}
        assert all(file.read_text().startswith("# EXAMPLE") for file in files[2:])

    def test_every_dtype_is_in_the_specification(self) -> None:
        section = SPEC.split("## 5 Dtypes", 2)[1].split("## 6", 1)[0]
        for name, ros in ROS_TYPES.items():
            row = next(line for line in section.splitlines() if re.match(rf"\|.*\b{name}\b.*\|.*\|", line))
            assert "the same" in row or f"`{ros}`" in row

    def test_every_channel_metadata_key_is_in_the_specification(self) -> None:
        section = SPEC.split("## 7 Channel metadata", 2)[1].split("## 8", 1)[0]
        for key in StepLayout(gym.spaces.Discrete(2), gym.spaces.Discrete(2)).to_metadata():
            assert f"`{key}`" in section


class TestJsonSchemas:
    @pytest.mark.sampled(24)
    @pytest.mark.parametrize("space", SPACES, ids=space_id)
    def test_every_space(self, space: gym.Space[Any]) -> None:
        validator("space.schema.json").validate(json.loads(json.dumps(space_to_json(space))))

    @pytest.mark.parametrize(
        "defect",
        [
            {"type": "Ball"},
            {"type": "Discrete", "dtype": "float32", "n": 2, "start": 0},
            {"type": "Discrete", "dtype": "int64", "n": 2},
            {"type": "Box", "dtype": "float32", "shape": [2], "low": 0.0, "high": True},
            {"type": "Box", "dtype": "int8", "shape": [2], "low": 0, "high": 1},
            {"type": "Dict", "spaces": {"a": {"type": "Discrete", "dtype": "int64", "n": 2, "start": 0}}},
            {"type": "Tuple", "spaces": [{"type": "Tuple"}]},
            [],
        ],
    )
    def test_a_defective_space_is_refused(self, defect: object) -> None:
        with pytest.raises(jsonschema.ValidationError, match=r"."):
            validator("space.schema.json").validate(defect)

    @pytest.mark.parametrize("journal_dir", [False, True])
    def test_recording_metadata(self, tmp_path: Path, journal_dir: bool) -> None:
        path = tmp_path / "a.mcap"
        where = tmp_path if journal_dir else None
        with RecordEpisodes(gym.make("CartPole-v1"), path, journal_dir=where) as env:
            env.reset(seed=0)
            env.step(0)
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            assert reader.get_header().profile == PROFILE
            (found,) = [m.metadata for m in reader.iter_metadata() if m.name == RECORDING_METADATA]
        schema = validator("recording-metadata.schema.json")
        schema.validate(found)
        assert set(found) - {"journal"} == {*schema.schema["required"], "crc"}
        for key in found:
            with pytest.raises(jsonschema.ValidationError, match=r"."):
                schema.validate({**found, key: 1})

    def test_benchmark_of_a_spec_and_of_a_pickle(self, tmp_path: Path) -> None:
        schema = validator("benchmark.schema.json")
        env = gym.make("CartPole-v1")
        changed = gym.make("CartPole-v1")
        changed.unwrapped.gravity = 1.0  # type: ignore[attr-defined]
        for name, inner in (("spec", env), ("pickle", changed)):
            with RecordEpisodes(inner, tmp_path / f"{name}.mcap", capture_env=name) as recorder:  # type: ignore[arg-type]
                recorder.reset(seed=0)
                recorder.step(0)
            with Recording(tmp_path / f"{name}.mcap") as recording:
                document = json.loads(recording.read_attachment("benchmark.json"))
            schema.validate(document)
            assert document["environment"][name] is not None
            other = {"spec": "pickle", "pickle": "spec"}[name]
            document["environment"][other] = document["environment"][name]
            with pytest.raises(jsonschema.ValidationError, match=r"."):
                schema.validate(document)

    def test_benchmark_of_a_bundle(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path / "lab")
        env = WithArtifact(gym.make("CartPole-v1"), storage=storage)
        env.store(name="cartpole", description="a pole")
        with Recording(storage.bundle(env.id, tmp_path / "bundle.mcap")) as recording:
            document = json.loads(recording.read_attachment("benchmark.json"))
            names = set(recording.attachments)
        env.close()
        (artifact,) = document["benchmark"]["artifacts"]
        assert names == {"benchmark.json", f"artifacts/{artifact}"}
        assert document["benchmark"]["artifact_metadata"][artifact]["name"] == "wind"
        assert document["benchmark"]["observation_space"]["type"] == "Box"
        validator("benchmark.schema.json").validate(document)


def test_the_wheel_ships_the_schemas() -> None:
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = config["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["force-include"] == {"schemas": "tupli_mcap/schemas"}


def test_links_in_the_specification_lead_somewhere() -> None:
    anchors = {
        re.sub(r"[^a-z0-9 -]", "", line.lstrip("# ").lower()).replace(" ", "-")
        for line in SPEC.splitlines()
        if line.startswith("#")
    }
    assert set(re.findall(r"\]\(#([^)]+)\)", SPEC)) <= anchors
    for name in re.findall(r"`([\w./]+\.(?:msg|json))`", SPEC):
        if name not in (
            "benchmark.json",
            "labels.json",
            "run.json",
            "annotations.json",
            "made_of.json",
            "deleting.json",
        ):  # attachments, and a file beside recordings
            assert list(SCHEMAS.rglob(Path(name).name)), name


@pytest.mark.parametrize("env", [None, 0, 12])
def test_topics_say_what_they_are_made_of(env: int | None) -> None:
    topics = Topics.of(env)
    made = [topics.step, topics.image("state_a"), topics.camera("render"), topics.frame("render")]
    top = "" if env is None else f"/env_{env}"
    assert made == [f"{top}/step", f"{top}/image/state_a", f"{top}/camera/render", f"{top}/frame/render"]
    kinds = [("step", ""), ("image", "state_a"), ("camera", "render"), ("frame", "render")]
    assert [parse(topic) for topic in made] == [Topic(topics, env or 0, *kind) for kind in kinds]
    assert Topics.of_step(topics.step) == topics


@pytest.mark.parametrize(
    "topic", ["/info", "/plot/step", "/env_01/step", "/env_/step", "/step/", "/image/", "step"]
)
def test_other_topics_are_none_of_an_environment(topic: str) -> None:
    assert parse(topic) is None
