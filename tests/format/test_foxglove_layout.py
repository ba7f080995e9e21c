"""The layout that makes Foxglove plot a recording: its message paths name what is in the file."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll
from golden_files import NAMES, place
from gymnasium import spaces
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from typer.testing import CliRunner

from tupli_mcap import RecordEpisodes, Recording, RecordingError
from tupli_mcap.cli.app import app
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes
from tupli_mcap.viewer.foxglove_layout import foxglove_layout, write_layout

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
    source = record(tmp_path / "r.mcap", space, vector=vector)
    layout = json.loads(write_layout(source, tmp_path / "layout.json").read_text(encoding="utf-8"))
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    assert sorted(panels_in(layout["layout"])) == sorted(layout["configById"])
    kinds = {name.partition("!")[0] for name in layout["configById"]}
    assert kinds >= {"Plot", "RawMessages"}
    assert space is TEXT or kinds >= {"Image", "StateTransitions"}
    for name, config in layout["configById"].items():
        for path in config.get("paths", []):
            assert path["label"]
            assert isinstance(look_up(path["value"], source), int | float), path
        if name.startswith("Image"):
            assert look_up(config["imageMode"]["imageTopic"], source).encoding == "rgb8"
        elif name.startswith("RawMessages"):
            assert look_up(config["topicPath"], source) is not None


def test_what_has_no_number_in_a_message_is_not_plotted(tmp_path: Path) -> None:
    with Recording(record(tmp_path / "r.mcap", SPACE)) as recording:
        panels = foxglove_layout(recording)["configById"]
    assert "Plot!state.half" not in panels  # stored as bits
    assert "Plot!action.cam" not in panels  # too wide
    assert "Plot!state.on" in panels


def test_keys_that_utf_8_lacks(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", spaces.Dict({"\ud800": spaces.Box(-1, 1, ())}))
    layout = json.loads(write_layout(source, tmp_path / "layout.json").read_text(encoding="utf-8"))
    (path,) = layout["configById"]['Plot!state."\\ud800"']["paths"]
    assert (path["value"], path["label"]) == ("/step.state", "?")


@pytest.mark.parametrize("name", NAMES)
def test_every_golden_recording_has_a_layout(name: str, tmp_path: Path) -> None:
    with Recording(place(name, tmp_path)) as recording:
        assert json.dumps(foxglove_layout(recording), allow_nan=False)


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
    source = record(tmp_path / "r.mcap", spaces.Box(-1, 1, (2,)))
    before = source.read_bytes()
    target = tmp_path / "layout.json"
    target.write_bytes(b"here")
    with pytest.raises(RecordingError, match=r"exists; choose another path, or pass overwrite=True$"):
        write_layout(source, target)
    write_layout(source, target, overwrite=True)
    assert json.loads(target.read_text(encoding="utf-8"))["layout"]["direction"] == "row"
    with pytest.raises(RecordingError, match="is the recording itself, which is never overwritten"):
        write_layout(source, source, overwrite=True)
    with pytest.raises(RecordingError, match="there is no directory"):
        write_layout(source, tmp_path / "no" / "layout.json")
    with pytest.raises(RecordingError, match="expected one recording to make a layout for, found 2"):
        write_layout([source, source], tmp_path / "two.json")
    assert source.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == [target, source]


def test_the_command_writes_a_layout(tmp_path: Path) -> None:
    source = record(tmp_path / "r.mcap", SPACE)
    target = tmp_path / "layout.json"
    runner = CliRunner()
    done = runner.invoke(app, ["replay", str(source), "--layout", str(target)])
    assert done.exit_code == 0, done.output
    assert "import this file as a layout" in done.output
    with Recording(source) as recording:
        assert json.loads(target.read_text(encoding="utf-8")) == foxglove_layout(recording)
    assert runner.invoke(app, ["replay", str(source), "--layout", str(target)]).exit_code == 1
    assert runner.invoke(app, ["replay", str(source), "--layout", str(target), "--force"]).exit_code == 0
    assert runner.invoke(app, ["replay", str(source), "--layout", "x.json", "-e", "best"]).exit_code == 2
