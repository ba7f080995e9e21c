"""Copies for stock viewers: what Rerun plots and what Foxglove's layout names, from a recording that stays one."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll
from gymnasium import spaces
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from test_golden import NAMES, as_read, assert_same, expected, place
from typer.testing import CliRunner

from tupli_mcap import RecordEpisodes, Recording, RecordingError
from tupli_mcap.cli.app import app
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.edit.repair import recover_recording
from tupli_mcap.recording.edit.rewrite import rewrite_recording
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes
from tupli_mcap.viewer.companion_channels import companion_topics, write_companions
from tupli_mcap.viewer.to_mcap import foxglove_layout

SPACE = spaces.Dict(
    {
        "half": spaces.Box(-1, 1, (2,), np.float16),
        "cam": spaces.Box(0, 255, (6, 5, 3), np.uint8),
        "on": spaces.MultiBinary(2),
        "mode": spaces.Discrete(3),
    }
)
TEXT = spaces.Dict({"say": spaces.Text(5), "x": spaces.Box(-1, 1, (2,))})


def record(path: Path, space: gym.Space[Any], *, vector: bool = False) -> Path:
    if vector:
        inner = gym.vector.SyncVectorEnv([lambda: Sampler(space, space)] * 2)
        with RecordVectorEpisodes(inner, path, chunk_size=3000) as env:
            env.reset(seed=1)
            for _ in range(40):
                env.step(env.action_space.sample())
    else:
        with RecordEpisodes(Sampler(space, space), path, chunk_size=3000) as single:
            roll(single, 40)
    return path


def decoded(path: Path, topic: str) -> list[tuple[int, int, Any]]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(m.sequence, m.log_time, d) for _, _, m, d in reader.iter_decoded_messages(topics=[topic])]


def clean(path: Path) -> bool:
    report = verify_recording(path)
    assert (report.kind, report.problems) == ("recording", [])
    return True


@pytest.mark.parametrize("vector", [False, True], ids=["single", "vector"])
@pytest.mark.parametrize("space", [SPACE, TEXT], ids=["constant", "variable"])
def test_companions_hold_what_the_steps_hold(space: gym.Space[Any], vector: bool, tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", space, vector=vector)
    top = "/env_1" if vector else ""
    with Recording(source) as recording:
        target = write_companions(recording, tmp_path / "out.mcap")
        layout = recording.layout
        episodes = [e for e in recording.episodes if e.env == int(vector)]
        topics = companion_topics(layout, top)
        for leaf in layout.step_leaves:
            if leaf.name == "action_cam":  # wider than a plot
                assert leaf.name not in topics
                continue
            found = decoded(target, topics[leaf.name])
            column = {"s": "states", "a": "actions", "r": "rewards"}[leaf.name[0]]
            wanted = [v for e in episodes for v in leaf.get(getattr(e, column))]
            assert [sequence for sequence, _, _ in found] == list(range(len(wanted)))
            assert [t for _, t, _ in found] == [t for _, t, _ in decoded(source, f"{top}/step")]
            if leaf.kind == "variable":
                assert [message.data for _, _, message in found] == wanted
                continue
            assert np.array_equal(
                [m.data for _, _, m in found], np.reshape(wanted, (-1, leaf.size)).astype(np.float64)
            )
            assert found[0][2].layout.dim[0].size == leaf.size
        returns = [m.data[0] for _, _, m in decoded(target, f"{top}/plot/return")]
        assert returns == pytest.approx(np.concatenate([np.cumsum(e.rewards) for e in episodes]))


@pytest.mark.parametrize("name", NAMES)
def test_the_copy_is_the_same_recording(name: str, tmp_path: Path) -> None:
    with Recording(place(name, tmp_path)) as recording:
        target = write_companions(recording, tmp_path / "out.mcap")
        uuid = recording.uuid
    assert clean(target)
    with Recording(target) as copy:
        assert_same(list(as_read(copy)), expected(name))
        assert (copy.uuid, copy.complete) == (uuid, True)


def test_rewriting_leaves_companions_out_and_recovering_keeps_the_steps(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", SPACE)
    with Recording(source) as recording:
        target = write_companions(recording, tmp_path / "out.mcap", episodes=[1, 3])
        wanted = [e.actions["mode"].tolist() for e in recording.episodes if e.number in (1, 3)]
    with Recording(target) as copy:
        assert [e.actions["mode"].tolist() for e in copy.episodes] == wanted
        rewrite_recording(copy, tmp_path / "again.mcap")
        again = write_companions(copy, tmp_path / "twice.mcap")
    returns = [[m.data for _, _, m in decoded(path, "/plot/return")] for path in (target, again)]
    assert returns[0] == returns[1]
    with Recording(tmp_path / "again.mcap") as plain, Recording(source) as first:
        topics = [c.topic for c in plain._contents.channels.values()]
        assert topics == [c.topic for c in first._contents.channels.values()]
    assert clean(tmp_path / "again.mcap")
    data = target.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 9 // 10])
    recover_recording(tmp_path / "cut.mcap", tmp_path / "saved.mcap")
    assert clean(tmp_path / "saved.mcap")
    with Recording(tmp_path / "saved.mcap") as saved:
        assert saved.num_steps > 0


def test_recording_goes_on_in_a_copy(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", SPACE)
    with Recording(source) as recording:
        target = write_companions(recording, tmp_path / "out.mcap")
    with RecordEpisodes(Sampler(SPACE, SPACE), target, mode="a") as env:
        roll(env, 10)
    with Recording(target) as recording:
        assert recording.num_steps == 50
    assert clean(target)


def test_rerun_plots_the_companions(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    with Recording(record(tmp_path / "r.mcap", TEXT)) as recording:
        target = write_companions(recording, tmp_path / "out.mcap")
        states = np.concatenate([e.states["x"] for e in recording.episodes]).astype(np.float64)
        texts = [text for e in recording.episodes for text in e.states["say"]]
    rrd = tmp_path / "out.rrd"
    command = [
        Path(sys.executable).with_name("rerun"),
        "mcap",
        "convert",
        "--application-id",
        "t",
        target,
        "-o",
        rrd,
    ]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=120, check=True)
    assert "WARN" not in done.stderr and "ERROR" not in done.stderr
    found: dict[str, list[Any]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(rrd).stream():
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name in ("Scalars:scalars", "TextDocument:text", "TextLog:text") and not chunk.is_static:
                    found.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    assert np.array_equal(found["/plot/state_x Scalars:scalars"], states)
    assert len(found["/plot/return Scalars:scalars"]) == 40
    (said,) = [values for key, values in found.items() if key.startswith("/text/state_say")]
    assert [text for (text,) in said] == texts


# ---- Foxglove's layout


def panels_in(tree: Any) -> list[str]:
    return [tree] if isinstance(tree, str) else [*panels_in(tree["first"]), *panels_in(tree["second"])]


def look_up(path: str, file: Path) -> Any:
    """What a message path names in the first message of its topic."""
    match = re.fullmatch(r"(?P<topic>(/[a-z0-9_]+)+?)(?P<fields>(\.[a-z0-9_]+(\[\d+\])?)*)", path)
    assert match is not None, path
    value = decoded(file, match["topic"])[0][2]
    for name, _, index in re.findall(r"\.([a-z0-9_]+)(\[(\d+)\])?", match["fields"]):
        value = getattr(value, name)
        value = value[int(index)] if index else value
    return value


@pytest.mark.parametrize("vector", [False, True], ids=["single", "vector"])
@pytest.mark.parametrize("space", [SPACE, TEXT], ids=["constant", "variable"])
def test_the_layout_names_what_is_there(space: gym.Space[Any], vector: bool, tmp_path: Path) -> None:
    with Recording(record(tmp_path / "r.mcap", space, vector=vector)) as recording:
        target = write_companions(recording, tmp_path / "out.mcap")
        layout = json.loads(json.dumps(foxglove_layout(recording)))
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert sorted(panels_in(layout["layout"])) == sorted(layout["configById"])
    kinds = {name.partition("!")[0] for name in layout["configById"]}
    assert kinds >= {"Plot", "RawMessages"}
    assert space is TEXT or kinds >= {"Image", "StateTransitions"}
    for name, config in layout["configById"].items():
        for path in config.get("paths", []):
            assert path["label"]
            assert isinstance(look_up(path["value"], target), int | float), path
        if name.startswith("Image"):
            assert look_up(config["imageMode"]["imageTopic"], target).encoding == "rgb8"
        elif name.startswith("RawMessages"):
            assert look_up(config["topicPath"], target) is not None


def test_the_layout_of_cartpole_is_labelled(tmp_path: Path) -> None:
    with RecordEpisodes(
        gym.make("CartPole-v1"), tmp_path / "r.mcap", labels={"action": ["left", "right"]}
    ) as env:
        roll(env, 10)
    with Recording(tmp_path / "r.mcap") as recording:
        layout = foxglove_layout(recording)
        names = recording.labels.dimensions["state"]
    paths = layout["configById"]["Plot!state"]["paths"]
    assert [path["value"] for path in paths] == [f"/step.state[{i}]" for i in range(4)]
    assert tuple(path["label"] for path in paths) == names
    assert layout["configById"]["StateTransitions!action"]["paths"][0]["value"] == "/step.action"


# ---- refusals


def test_what_cannot_be_written(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", SPACE)
    with Recording(source) as recording:
        (tmp_path / "out.mcap").write_bytes(b"here")
        with pytest.raises(
            RecordingError, match="exists already; choose another name, or replace it with --force"
        ):
            write_companions(recording, tmp_path / "out.mcap")
        write_companions(recording, tmp_path / "out.mcap", force=True)
    assert clean(tmp_path / "out.mcap")


def test_the_command_writes_a_copy_and_a_layout(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", SPACE)
    runner = CliRunner()
    done = runner.invoke(app, ["replay", str(source), "-e", "best", "--to-mcap", str(tmp_path / "out.mcap")])
    assert done.exit_code == 0, done.output
    assert "open it with: rerun" in done.output
    with Recording(tmp_path / "out.mcap") as copy, Recording(source) as recording:
        best = max(recording.episodes, key=lambda e: e.return_)
        assert [e.number for e in copy.episodes] == [best.number]
    layout = json.loads((tmp_path / "out.foxglove-layout.json").read_text(encoding="utf-8"))
    assert layout["layout"]["direction"] == "row"
    again = ["replay", str(source), "--to-mcap", str(tmp_path / "new.mcap"), "--layout"]
    done = runner.invoke(app, [*again, str(tmp_path / "out.foxglove-layout.json")])
    assert done.exit_code == 1 and not (tmp_path / "new.mcap").exists()
    done = runner.invoke(app, [*again, str(tmp_path / "other.json")])
    assert done.exit_code == 0 and (tmp_path / "other.json").exists()
    done = runner.invoke(app, ["replay", str(source), "--layout", "x.json"])
    assert done.exit_code == 2
    both = [str(source), str(tmp_path / "new.mcap")]
    done = runner.invoke(app, ["replay", *both, "--to-mcap", str(tmp_path / "no.mcap")])
    assert done.exit_code == 1 and not (tmp_path / "no.mcap").exists()


@pytest.mark.parametrize(
    ("target", "layout", "told"),
    [
        ("r.mcap", None, "is the recording, which is never written over"),
        ("new.mcap", "r.mcap", "is the recording, which is never written over"),
        ("new.txt", None, "expected a name that ends in .mcap"),
        ("no/new.mcap", None, "there is no directory"),
        ("new.mcap", "no/layout.json", "there is no directory"),
    ],
)
def test_a_copy_that_cannot_be_leaves_everything(
    tmp_path: Path, target: str, layout: str | None, told: str
) -> None:
    source = record(tmp_path / "r.mcap", spaces.Box(-1, 1, (2,)))
    before = source.read_bytes()
    words = ["--to-mcap", str(tmp_path / target), "--force", "--episode", "first"]
    words += [] if layout is None else ["--layout", str(tmp_path / layout)]
    done = CliRunner().invoke(app, ["replay", str(source), *words])
    assert done.exit_code == 1 and told in done.output
    assert source.read_bytes() == before and list(tmp_path.iterdir()) == [source]


@pytest.mark.filterwarnings("ignore:.*is declared float32:UserWarning")
def test_rewriting_a_vector_recording_keeps_the_order_of_ends(tmp_path: Path) -> None:
    """Episodes of sub-environments end in another order than they begin in."""
    for name in NAMES:
        if name.startswith("vector"):
            with Recording(place(name, tmp_path)) as recording:
                rewrite_recording(recording, tmp_path / f"{name}-new.mcap")
            assert clean(tmp_path / f"{name}-new.mcap")
