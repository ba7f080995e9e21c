"""Readers that know nothing of us: the mcap package, mcap-ros2-support, Rerun."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll
from gymnasium import spaces
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel
from mcap_ros2.decoder import DecoderFactory
from sample_spaces import SPACES, space_id

from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.messages.step import StepLayout


def record(path: Path, space: gym.Space[Any]) -> list[tuple[Any, ...]]:
    with RecordEpisodes(Sampler(space, space), path, chunk_size=2000, record_info=True) as env:
        return roll(env, 20)


def rerun_says(path: Path, out: Path) -> str:
    done = subprocess.run(
        [
            str(Path(sys.executable).with_name("rerun")),
            "mcap",
            "convert",
            "--application-id",
            "test",
            str(path),
            "-o",
            str(out),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.sampled(12)
@pytest.mark.parametrize("space", SPACES, ids=space_id)
def test_every_space_decodes_field_by_field(tmp_path: Path, space: gym.Space[Any]) -> None:
    path = tmp_path / "r.mcap"
    taken = record(path, space)
    layout = Recording(path).layout
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/step"])]
    assert len(found) == len(taken)
    for message, (state, action, reward, terminal, timeout, _) in zip(found, taken, strict=True):
        assert (message.reward, message.terminal, message.timeout) == (reward, terminal, timeout)
        for leaves, value in ((layout.state, state), (layout.action, action)):
            for leaf in leaves:
                if leaf.kind in ("array", "scalar") and leaf.size:
                    expected = np.asarray(leaf.get(value))
                    if expected.dtype == np.float16:
                        expected = expected.view(np.uint16)
                    decoded = getattr(message, leaf.name)
                    decoded = list(decoded) if isinstance(decoded, bytes) else decoded  # uint8 arrays
                    decoded = np.asarray(decoded, dtype=expected.dtype).reshape(expected.shape)
                    assert decoded.tobytes() == expected.tobytes()
                elif type(leaf.space) is spaces.Text:
                    assert isinstance(getattr(message, leaf.name), str)
    assert "WARN" not in rerun_says(path, tmp_path / "r.rrd")


def test_images_are_ros_images(tmp_path: Path) -> None:
    space = spaces.Dict(
        {"front": spaces.Box(0, 255, (6, 5, 3), np.uint8), "depth": spaces.Box(0, 255, (4, 3, 1), np.uint8)}
    )
    path = tmp_path / "r.mcap"
    taken = record(path, space)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for name, key, encoding in (("state_front", "front", "rgb8"), ("state_depth", "depth", "mono8")):
            images = [m for _, _, _, m in reader.iter_decoded_messages(topics=[f"/image/{name}"])]
            assert len(images) == len(taken)
            for image, step in zip(images, taken, strict=True):
                assert (image.height, image.width, image.encoding) == (*step[0][key].shape[:2], encoding)
                assert image.header.frame_id == name
                assert bytes(image.data) == step[0][key].tobytes()


def test_the_data_section_alone_tells_everything(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    record(path, spaces.Box(-1, 1, (2,)))
    with path.open("rb") as file:
        messages = list(NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False))
    assert sum(channel.topic == "/step" for _, channel, _ in messages) == 20


def test_summary_statistics_and_indexes(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    record(path, spaces.Box(-1, 1, (2,)))
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert reader.get_header().profile == "tupli_mcap"
        assert summary is not None and summary.statistics is not None
        counts = {summary.channels[c].topic: n for c, n in summary.statistics.channel_message_counts.items()}
        assert counts == {"/step": 20, "/episode_start": 3, "/episode_end": 3, "/final_state": 3, "/info": 20}
        assert summary.statistics.message_count == 49
        times = [m.log_time for _, _, m in reader.iter_messages(topics=["/step"])]
        assert times == sorted(times)
        assert (summary.statistics.message_start_time, summary.statistics.message_end_time)[0] <= times[0]
        part = [
            m.log_time
            for _, _, m in reader.iter_messages(topics=["/step"], start_time=times[5], end_time=times[9])
        ]
        assert part == [t for t in times if times[5] <= t < times[9]]


def test_metadata_rebuilds_the_spaces(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    space = spaces.Dict({"Weird Key!": spaces.Box(-1, 1, (2,)), "weird_key": spaces.Discrete(3)})
    record(path, space)
    with path.open("rb") as file:
        channels: dict[str, Channel] = {c.topic: c for c in make_reader(file).get_summary().channels.values()}  # type: ignore[union-attr]
    layout = StepLayout.from_metadata(channels["/step"].metadata)
    assert layout.observation_space == space
    assert [leaf.name for leaf in layout.state] == ["state_weird_key", "state_weird_key_2"]
