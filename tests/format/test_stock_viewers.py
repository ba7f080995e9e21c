"""What stock viewers make of every golden recording: Rerun's importer, Foxglove's own decoders, the ROS 2 decoder.

Foxglove's packages come from npm (`tools/setup-foxglove`).
"""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from golden_files import NAMES, finished
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from PIL import Image

from tupli_mcap.recording import Recording
from tupli_mcap.spaces.leaves import Leaf

DECODERS = Path(__file__).parents[1] / "foxglove"


class Message(NamedTuple):
    """A decoded message as plain values: fields by name, arrays as arrays, lists or bytes."""

    topic: str
    sequence: int
    time: int
    fields: dict[str, Any]


# ---- decoders


def by_ros2(path: Path) -> Iterator[Message]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield Message(channel.topic, message.sequence, message.log_time, _fields(decoded))


def _fields(decoded: Any) -> dict[str, Any]:
    return {
        name: _fields(getattr(decoded, name))
        if hasattr(getattr(decoded, name), "__slots__")
        else getattr(decoded, name)
        for name in decoded.__slots__
    }


def from_json(value: Any) -> Any:
    """A value as tests/foxglove/decode.mjs writes it."""
    if isinstance(value, list):
        return [from_json(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "integer" in value:
        return int(value["integer"])
    if "float" in value:
        return float(value["float"])
    if "bytes" in value:
        dtype = value["array"].removesuffix("Array").lower().removeprefix("big").replace("clamped", "")
        return np.frombuffer(base64.b64decode(value["bytes"]), dtype)
    return {name: from_json(item) for name, item in value["fields"].items()}


@pytest.fixture(scope="module")
def by_foxglove(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Message]]:
    """Every message of every golden recording, decoded by Foxglove's packages in one run of node."""
    node = shutil.which("node")
    if node is None or not (DECODERS / "node_modules").is_dir():
        pytest.skip("Foxglove's decoders are not installed: node or tests/foxglove/node_modules is missing")
    directory = tmp_path_factory.mktemp("foxglove")
    paths = {str(finished(name, directory)): name for name in NAMES}
    done = subprocess.run(
        [node, str(DECODERS / "decode.mjs"), *paths], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, list[Message]] = {name: [] for name in paths.values()}
    for line in done.stdout.splitlines():
        told = json.loads(line)
        message = Message(told["topic"], told["sequence"], int(told["time"]), from_json(told["message"]))
        found[paths[told["path"]]].append(message)
    return found


# ---- against our reader


class Told:
    """What our reader says of a recording, by the places that messages name."""

    def __init__(self, recording: Recording) -> None:
        self.layout = recording.layout
        self.episodes = {episode.number: episode for episode in recording.episodes}
        self.states = {n: [step.state for step in episode] for n, episode in self.episodes.items()}
        firsts = recording.index["first_row"].tolist()
        self.rows = {
            (episode.env, first + i): (episode.number, i)
            for episode, first in zip(recording.episodes, firsts, strict=True)
            for i in range(len(episode))
        }

    def check(self, message: Message) -> None:
        """Raises AssertionError unless the message says what our reader does."""
        topic, fields = message.topic, message.fields
        env, name = 0, topic
        if topic.startswith("/env_"):
            number, _, rest = topic.removeprefix("/env_").partition("/")
            env, name = int(number), f"/{rest}"
        if name == "/step":
            self._step(env, message)
        elif name.startswith("/image/"):
            self._image(env, name.removeprefix("/image/"), message)
        elif name.startswith("/camera/"):
            assert fields["format"] == "png"
            assert bytes(fields["data"]).startswith(b"\x89PNG")
        elif name.startswith("/frame/"):
            assert fields["episode"] in self.episodes
        else:
            episode = self.episodes[fields["episode"]]
            if name == "/final_state":
                for leaf in self.layout.final_leaves:
                    self._leaf(leaf, leaf.get(episode.final_state), fields)
            elif name == "/episode_end":
                assert (fields["length"], fields["env"]) == (len(episode), episode.env)
                np.testing.assert_array_equal(fields["episode_return"], episode.return_)
                assert ("terminal", "timeout", "interrupted")[fields["end"]] == episode.end
            elif name == "/episode_start":
                assert fields["seed"] == ("" if episode.seed is None else str(episode.seed))
            else:
                assert name == "/info", name
                assert episode.infos is not None
                assert 0 <= fields["step"] < len(episode)

    def _step(self, env: int, message: Message) -> None:
        fields = message.fields
        number, i = self.rows[env, message.sequence]
        assert (fields["episode"], fields["step"]) == (number, i)
        step = list(self.episodes[number])[i]
        assert (fields["terminal"], fields["timeout"]) == (step.terminal, step.timeout)
        for leaves, value in (
            (self.layout.state, step.state),
            (self.layout.action, step.action),
            (self.layout.reward, step.reward),
        ):
            for leaf in leaves:
                if not leaf.apart:
                    self._leaf(leaf, leaf.get(value), fields)

    def _leaf(self, leaf: Leaf, value: Any, fields: dict[str, Any]) -> None:
        if leaf.kind == "variable":
            assert isinstance(value, str) == isinstance(fields[leaf.name], str)
            if (
                isinstance(value, str) and "\x1a" not in fields[leaf.name]
            ):  # which escapes what CDR cannot hold
                assert fields[leaf.name] == value
            return
        if not leaf.size:
            assert leaf.name not in fields
            return
        wanted = np.asarray(value, self.layout.dtypes[leaf.name])
        wanted = wanted.view(np.uint16) if wanted.dtype == np.float16 else wanted
        found = fields[leaf.name]
        found = np.asarray(list(found) if isinstance(found, bytes) else found, wanted.dtype)
        np.testing.assert_array_equal(found.reshape(wanted.shape), wanted, err_msg=leaf.path)

    def _image(self, env: int, name: str, message: Message) -> None:
        (leaf,) = (leaf for leaf in self.layout.images if leaf.name == name)
        number, i = self.rows[env, message.sequence]
        image, fields = leaf.get(self.states[number][i]), message.fields
        assert fields["header"]["frame_id"] == name
        if fields.get("format") == "png":
            with Image.open(io.BytesIO(bytes(fields["data"]))) as picture:
                shown = np.asarray(picture).reshape(picture.height, picture.width, -1)
        else:
            depth = {"mono8": 1, "rgb8": 3, "rgba8": 4}[fields["encoding"]]
            shown = np.frombuffer(bytes(fields["data"]), np.uint8)
            shown = shown.reshape(fields["height"], fields["width"], depth)
        if leaf.kind == "stack":  # the newest frames, one below the other
            image = np.moveaxis(image, -1 if leaf.frames_last else 0, 0)
            frames = len(shown) // image.shape[1]
            image = image[-frames:].reshape(len(shown), image.shape[2], -1)
        np.testing.assert_array_equal(shown, image)


def assert_told(path: Path, messages: Sequence[Message]) -> None:
    with Recording(path) as recording, path.open("rb") as file:
        told = Told(recording)
        for message in messages:
            told.check(message)
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    wanted = {summary.channels[number].topic: count for number, count in counts.items()}
    assert Counter(message.topic for message in messages) == wanted


@pytest.mark.parametrize("name", NAMES)
def test_the_ros2_decoder_says_what_our_reader_says(name: str, tmp_path: Path) -> None:
    path = finished(name, tmp_path)
    assert_told(path, list(by_ros2(path)))


@pytest.mark.parametrize("name", NAMES)
def test_foxgloves_decoders_say_what_our_reader_says(
    name: str, by_foxglove: dict[str, list[Message]], tmp_path: Path
) -> None:
    assert_told(finished(name, tmp_path), by_foxglove[name])


def test_the_comparison_can_fail(tmp_path: Path) -> None:
    path = finished("dict_with_images", tmp_path)
    messages = list(by_ros2(path))
    for topic in ("/step", "/final_state", "/episode_end", "/episode_start", "/image/state_camera"):
        at = next(i for i, message in enumerate(messages) if message.topic == topic)
        fields = dict(messages[at].fields)
        for field in set(fields) & {"terminal", "length", "seed", "data", "state_camera"}:
            fields[field] = b"" if isinstance(fields[field], bytes) else 99
        with pytest.raises((AssertionError, ValueError)):
            assert_told(path, [*messages[:at], messages[at]._replace(fields=fields), *messages[at + 1 :]])
    with pytest.raises(AssertionError):
        assert_told(path, messages[1:])


# ---- Rerun


@pytest.mark.parametrize("name", NAMES)
def test_rerun_imports_every_entity_and_row(name: str, tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    path, target = finished(name, tmp_path), tmp_path / "golden.rrd"
    rerun = Path(sys.executable).with_name("rerun")
    command = [rerun, "mcap", "convert", path, "-o", target, "--application-id", "golden"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=120, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "WARN" not in said and "ERROR" not in said, said
    rows: Counter[str] = Counter()
    components: dict[str, set[str]] = {}
    timelines: dict[str, set[str]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for chunk in RrdReader(target).stream():
            if not chunk.is_static:
                rows[chunk.entity_path] += chunk.num_rows
                names = set(chunk.to_record_batch().schema.names)
                components.setdefault(chunk.entity_path, set()).update(names)
                timelines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topics = {summary.channels[number].topic: count for number, count in counts.items()}
    assert {entity: n for entity, n in rows.items() if not entity.startswith("/__")} == topics
    with Recording(path) as recording:
        assert sum(n for topic, n in topics.items() if topic.endswith("/step")) == recording.n_steps
        images = {leaf.name: 1 if leaf.kind == "stack" else leaf.shape[2] for leaf in recording.layout.images}
        as_png = "png" in path.stem
    for topic in topics:
        assert {"message_log_time", "message_publish_time"} <= timelines[topic]
        head, _, leaf_name = topic.rpartition("/")
        if head.endswith("/image"):
            kind = "DepthImage" if images[leaf_name] == 1 else "Image"
            shown = {"EncodedImage:blob"} if as_png else {f"{kind}:buffer", f"{kind}:format"}
            assert shown <= components[topic]
        elif "/camera/" in topic:
            assert "EncodedImage:blob" in components[topic]
        else:
            assert any(component.endswith(":message") for component in components[topic])
