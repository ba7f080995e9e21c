"""Many messages of variable size at once: the values and the errors of one after the other."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import Sampler, Scripted
from gymnasium import spaces
from sample_spaces import BOXES, SPACES
from test_variable import same

from tupli_mcap import FormatError, RecordEpisodes, Recording, StepError
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.decoder import LOG_TIME, BatchDecoder, MessageDecoder
from tupli_mcap.messages.step import StepLayout

SEEN = spaces.Dict(
    {
        "note": spaces.Text(12, min_length=0, charset="abä\x1a€"),
        "x": spaces.Box(-1, 1, (3,), np.float64),
        "flag": spaces.Box(0, 1, (), np.bool_),
        "seen": spaces.Box(0, 255, (2, 2, 3), np.uint8),
        "none": spaces.Box(0, 1, (2, 0)),
        "goal": spaces.Text(3),
        "half": spaces.Box(-1, 1, (5,), np.float16),
    }
)
FEW = [
    SEEN,
    spaces.Text(5, min_length=0),
    spaces.Tuple((spaces.Sequence(spaces.Box(-1, 1, (2,))), spaces.Text(4), spaces.Discrete(3))),
    spaces.Tuple((spaces.Text(4), *BOXES)),
]


class Messages:
    """The steps and the final states of a recording, as they lie in one chunk each."""

    def __init__(self, recording: Recording) -> None:
        layout = recording.layout
        assert layout is not None and not layout.constant
        self.layout: StepLayout = layout
        store = recording._store
        found = {
            name: store.records(store.chunks(recording._topics[topic])[0])
            for name, topic in (("step", "/step"), ("final", "/final_state"))
        }
        self.data = {name: bytes(data) for name, (data, _) in found.items()}
        self.records = {name: records for name, (_, records) in found.items()}
        leaves = [leaf.name for leaf in layout.step_leaves if leaf.kind == "variable" or leaf.size]
        finals = [leaf.name for leaf in layout.final_leaves if leaf.kind == "variable" or leaf.size]
        self.names = {"step": [*leaves, "terminal", "timeout"], "final": [*finals, "episode"]}

    def at_once(self, kind: str, data: bytes, records: Any, names: list[str]) -> dict[str, Any]:
        decoder = BatchDecoder(self.layout)
        return (decoder.steps if kind == "step" else decoder.finals)(data, records, names)

    def one_by_one(self, kind: str, data: bytes, records: Any, names: list[str]) -> dict[str, list[Any]]:
        decoder, view = MessageDecoder(self.layout), memoryview(data)
        found: list[dict[str, Any]] = []
        for start, end in records.tolist():
            if kind == "step":
                found.append(decoder.step(view[start + BODY : end]))
            else:
                episode, values = decoder.final(view[start + BODY : end])
                found.append(values | {"episode": episode})
        return {name: [values[name] for values in found] for name in names}

    def check(self, kind: str, data: bytes, records: Any, names: list[str]) -> None:
        """Asserts that both give the same."""
        try:
            wanted = self.one_by_one(kind, data, records, self.names[kind])
        except FormatError as err:
            told = str(err)
        else:
            told = ""
        if told:
            with pytest.raises(FormatError, match=f"^{re.escape(told)}$"):
                self.at_once(kind, data, records, names)
            return
        found = self.at_once(kind, data, records, names)
        assert set(found) == set(names)
        for name, column in found.items():
            assert len(column) == len(records)
            if isinstance(column, list):
                assert all(map(same, column, wanted[name]))
            else:
                assert np.array(wanted[name], column.dtype).tobytes() == column.tobytes()


def recorded(path: Path, space: Any) -> Messages:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with RecordEpisodes(Sampler(space, spaces.Discrete(3), length=4), path, attachments={}) as env:
            env.action_space.seed(0)
            for episode in range(4):
                env.reset(seed=episode)
                for _ in range(4):
                    env.step(env.action_space.sample())
    with Recording(path) as recording:
        return Messages(recording)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_of_every_space(tmp_path: Path, space: Any) -> None:
    messages = recorded(
        tmp_path / "r.mcap", spaces.Dict({"it": space, "note": spaces.Text(3), "x": SEEN["x"]})
    )
    for kind, names in messages.names.items():
        messages.check(kind, messages.data[kind], messages.records[kind], names)


@pytest.mark.parametrize("space", FEW, ids=["dict", "text", "tuple", "boxes"])
class TestSome:
    def test_fields_and_rows(self, tmp_path: Path, space: Any) -> None:
        messages = recorded(tmp_path / "r.mcap", space)
        for kind, names in messages.names.items():
            data, records = messages.data[kind], messages.records[kind]
            for name in names:
                messages.check(kind, data, records, [name])
            for rows in ([3, 0, 3], [2], [], slice(1, None, 2)):
                messages.check(kind, data, records[rows], names)

    def test_any_byte_that_differs(self, tmp_path: Path, space: Any) -> None:
        """An error where there is one message by message, and else the same values."""
        messages = recorded(tmp_path / "r.mcap", space)
        for kind, names in messages.names.items():
            records = messages.records[kind][:3]
            begin, end = int(records[1, 0]) + BODY, int(records[1, 1])
            for at in range(begin, end):
                for bits in (0x01, 0x80, 0xFF):
                    broken = bytearray(messages.data[kind])
                    broken[at] ^= bits
                    messages.check(kind, bytes(broken), records, names)

    def test_any_cut(self, tmp_path: Path, space: Any) -> None:
        messages = recorded(tmp_path / "r.mcap", space)
        for kind, names in messages.names.items():
            records = messages.records[kind][:2]
            begin, end = records[1].tolist()
            for stop in range(begin + BODY, end):
                cut = np.array([records[0], [begin, stop]])
                with pytest.raises(FormatError):
                    messages.at_once(kind, messages.data[kind], cut, names[-1:])
                messages.check(kind, messages.data[kind], cut, names)


def test_times_and_episodes(tmp_path: Path) -> None:
    messages = recorded(tmp_path / "r.mcap", SEEN)
    data, records = messages.data["step"], messages.records["step"]
    decoder = BatchDecoder(messages.layout)
    with Recording(tmp_path / "r.mcap") as recording:
        times = recording.read(fields=["times"]).times
    for names in ([LOG_TIME], [LOG_TIME, "timeout"]):
        assert np.array_equal(decoder.steps(data, records, names)[LOG_TIME], times)
    finals = decoder.finals(messages.data["final"], messages.records["final"], ["episode"])
    assert finals["episode"].tolist() == [0, 1, 2, 3]
    # to know the times alone, nothing of the messages is looked at
    assert len(decoder.steps(bytes(len(data)), records, [LOG_TIME])[LOG_TIME]) == len(records)


def test_records_that_do_not_fill_their_chunk(tmp_path: Path) -> None:
    recorded(tmp_path / "r.mcap", SEEN)
    with Recording(tmp_path / "r.mcap") as recording:
        store, chunk = recording._store, recording._store.chunks(recording._topics["/step"])[0]
        data, records = store.records(chunk)
        second = int(records[1, 0])
        changes = {
            "expected a message record at byte": [
                (second, b"\x04"),
                (second + 1, b"\xff"),
                (second + 8, b"\x7f"),
            ],
            "holds a message of channel": [(second + 9, b"\x63")],
        }
        for match, places in changes.items():
            for at, byte in places:
                broken = bytes(data[:at]) + byte + bytes(data[at + 1 :])
                with pytest.raises(FormatError, match=match):
                    store._find_records(chunk, broken)
        with pytest.raises(FormatError, match=f"expected {len(records)} messages, found {len(records) - 1}"):
            store._find_records(chunk, bytes(data[: int(records[-1, 0])]))
        with pytest.raises(FormatError, match="expected a message record at byte"):
            store._find_records(chunk, bytes(data[:-1]))


def test_numbers_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    space = spaces.Dict({"note": spaces.Text(3), "n": spaces.Box(-100, 100, (), np.int8)})
    values: list[Any] = [0, -128, 127, np.int8(5), np.int64(-7), True, 3]
    env = Scripted(lambda step: {"note": "a", "n": [*values, 128][step]}, space, length=99)
    with RecordEpisodes(env, tmp_path / "r.mcap", attachments={}) as recorder:
        recorder.reset(seed=1)
        for _ in values[1:]:
            recorder.step(1)
        with pytest.raises(StepError, match="expected values that int8 holds exactly"):
            recorder.step(1)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.read().states["n"].tolist() == values[:-1]
