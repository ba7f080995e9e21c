"""Bundles whose code would write the marker file if it ran."""

from __future__ import annotations

import base64
import json
import os
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from tupli_mcap import FileStorage, RecordEpisodes, Recording, rewrite_recording
from tupli_mcap.environment import EnvironmentRecord, capture
from tupli_mcap.recording.edit import copy_episodes
from tupli_mcap.schema import ArtifactMetadata, BenchmarkMetadata, BenchmarkQuery
from tupli_mcap.storage.benchmark_json import benchmark_hash, facts_about, pack, recording_attachments, unpack

MODULE = "evil_module"


def module_source(marker: Path) -> str:
    """A module that writes the marker when it is imported, and has an environment, a wrapper and a function."""
    return f"""
import pathlib, gymnasium
pathlib.Path({str(marker)!r}).write_text("imported")
Env = gymnasium.envs.classic_control.CartPoleEnv
Wrapper = gymnasium.wrappers.TimeLimit
def function(*args): pathlib.Path({str(marker)!r}).write_text("called")
"""


class _Reduced:
    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> Any:
        return self.call[0], self.call[1:]


def pickles(marker: Path) -> Iterator[tuple[str, bytes]]:
    """Pickles that write the marker when they are loaded."""
    write = f"__import__('pathlib').Path({str(marker)!r}).write_text('x')"
    inner = pickle.dumps(_Reduced(exec, write))
    text = str(marker).encode()
    yield "os_system", pickle.dumps(_Reduced(os.system, f"touch {marker}"))
    yield "eval", pickle.dumps(_Reduced(eval, write), 0)
    yield "nested", pickle.dumps(_Reduced(pickle.loads, inner))
    yield "inst", b"(S'touch " + text + b"'\nios\nsystem\n."
    yield "module", f"c{MODULE}\nEnv\n(tR.".encode()
    yield (
        "memo",
        b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94h\x00h\x01\x93\x8c"
        + bytes([len(text) + 6])
        + (b"touch " + text + b"\x85R."),
    )


def specs() -> Iterator[tuple[str, dict[str, Any]]]:
    """EnvSpecs that name the module in each way that makes gymnasium import it."""
    good = dict(capture(gym.make("CartPole-v1")).spec or {})
    evil = f"{MODULE}:Env"
    wrapper = {"name": "w", "entry_point": f"{MODULE}:Wrapper", "kwargs": {"max_episode_steps": 3}}
    yield "unregistered", {**good, "id": "Evil-v0", "entry_point": evil}
    yield "module_id", {**good, "id": f"{MODULE}:CartPole-v1"}
    yield "other_entry_point", {**good, "entry_point": evil}
    yield "wrapper", {**good, "additional_wrappers": [wrapper]}
    yield "vector", {**good, "id": "Evil-v1", "vector_entry_point": evil}
    yield "argument", {**good, "kwargs": {"env_id": f"{MODULE}:Env-v0", "render_mode": f"{MODULE}:x"}}
    yield "standard_library", {**good, "entry_point": "antigravity:fly", "id": "antigravity:Fly-v0"}


HOSTILE_TEXTS = [
    {"$numpy": {"dtype": "object", "shape": [1], "data": base64.b64encode(pickle.dumps(exec)).decode()}},
    {"$numpy": "object", "dtype": "O", "shape": [2], "data": "AAAA"},
    {"$ndarray": {"dtype": f"{MODULE}.Env"}},
    {"$type": f"{MODULE}:Env", "$float": f"{MODULE}", "$bytes": "!", "$tuple": [[]]},
    {"py/object": f"{MODULE}.Env", "py/reduce": [{"py/function": "os.system"}, ["true"]]},
    {"__reduce__": ["os.system", ["true"]], "__class__": f"{MODULE}.Env"},
    {"{0.__class__}": "{0.__init__.__globals__}", "%s%n": "${jndi:x}", "[link=file:///etc]": "\x1b]0;x\x07"},
]
SPACES = [
    {"type": f"{MODULE}:Env"},
    {"type": "Box", "low": 0, "high": 1, "shape": [4], "dtype": "object"},
    {"type": "Box", "low": 0, "high": 1, "shape": [4], "dtype": f"{MODULE}.Env"},
    {"type": "Dict", "spaces": {"__class__": {"type": "Discrete", "n": 2, "start": 0}}},
    {"type": "Tuple", "spaces": [{"type": "os.system"}]},
]
NAMES = [
    "../../escaped",
    "/tmp/escaped",
    "artifacts/../../escaped",
    "artifacts/" + "0" * 64,
    ".pth",
    "__init__.py",
    "a\0b",
]


def _store(storage: FileStorage, record: EnvironmentRecord, metadata: BenchmarkMetadata, **more: Any) -> str:
    """Stores a benchmark with that environment, and two episodes of another one."""
    artifact = storage.store_artifact(
        pickle.dumps(_Reduced(os.system, "true")), ArtifactMetadata(name="../../x.pkl")
    )
    env = gym.make("CartPole-v1")
    serialized = pack(record, [artifact.id], facts_about(env))
    query = BenchmarkQuery(
        hash=benchmark_hash(unpack(serialized), metadata), serialized=serialized, metadata=metadata
    )
    benchmark = storage.store_benchmark(query).id
    path = storage.new_recording_path(benchmark)
    attachments = {**recording_attachments(serialized), **more.pop("attachments", {})}
    with RecordEpisodes(env, path, benchmark_id=benchmark, attachments=attachments, **more) as recorded:
        for seed in range(2):
            recorded.reset(seed=seed, options={"low": -0.01, "high": 0.01})
            while not any(recorded.step(seed)[2:4]):
                pass
    storage.ingest(path)
    return benchmark


def build(directory: Path, marker: Path) -> None:
    """Writes `<name>.mcap` for each case, and a storage `storage` that holds the benchmarks of all."""
    directory.mkdir()
    records = {
        f"pickle_{name}": EnvironmentRecord(f"{MODULE}:Env", pickle=data) for name, data in pickles(marker)
    }
    records |= {f"spec_{name}": EnvironmentRecord(f"{MODULE}:Env", spec=spec) for name, spec in specs()}
    with FileStorage(directory / "storage") as storage:
        for name, record in records.items():
            benchmark = _store(storage, record, BenchmarkMetadata(name=name, extra={"see": f"{MODULE}:Env"}))
            storage.bundle(benchmark, directory / f"{name}.mcap")
        record = EnvironmentRecord("x", spec=dict(specs())["wrapper"])
        named = {name: ("application/x-python", b"import " + MODULE.encode()) for name in NAMES}
        _store(storage, record, BenchmarkMetadata(name="names"), attachments=named, record_info=True)
        (path,) = (item for item in (directory / "storage/recordings").rglob("*.mcap") if _has(item, ".pth"))
        (directory / "names.mcap").write_bytes(path.read_bytes())
    _write_texts(directory)
    _write_spaces(directory)
    whole = (directory / "pickle_os_system.mcap").read_bytes()
    (directory / "cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    _write_journal_elsewhere(directory)


def _has(path: Path, attachment: str) -> bool:
    with Recording(path) as recording:
        return attachment in recording.attachments


def _write_texts(directory: Path) -> None:
    """Writes hostile JSON as metadata, options and reset info, unquoted, which our writer would not do."""
    for i, value in enumerate(HOSTILE_TEXTS):
        text = json.dumps({"value": value, **value})

        class Ends:
            @staticmethod
            def decode(body: memoryview, text: str = text) -> Any:
                return _END.decode(body)._replace(metadata=text)

        class Starts:
            @staticmethod
            def decode(body: memoryview, text: str = text) -> Any:
                return _START.decode(body)._replace(options=text, reset_info=text)

        with pytest.MonkeyPatch.context() as patch, Recording(directory / "spec_wrapper.mcap") as recording:
            patch.setattr(copy_episodes, "EpisodeEnd", Ends)
            patch.setattr(copy_episodes, "EpisodeStart", Starts)
            rewrite_recording(recording, directory / f"text_{i}.mcap")


_END, _START = copy_episodes.EpisodeEnd, copy_episodes.EpisodeStart


def _write_spaces(directory: Path) -> None:
    for i, space in enumerate(SPACES):
        with Recording(directory / "spec_wrapper.mcap") as recording:
            for channel in recording._contents.channels.values():
                for key in ("observation_space", "action_space"):
                    if key in channel.metadata:
                        channel.metadata[key] = json.dumps(space)
            rewrite_recording(recording, directory / f"space_{i}.mcap")


def _write_journal_elsewhere(directory: Path) -> None:
    """Writes an unfinished file that names another file of the user as its journal."""
    elsewhere = directory.parent / "elsewhere"
    elsewhere.mkdir()
    path = directory / "journal.mcap"
    record = EnvironmentRecord("x", spec=dict(specs())["wrapper"])
    carried = {"benchmark.json": ("application/json", record.to_json())}
    with RecordEpisodes(gym.make("CartPole-v1"), path, journal_dir=elsewhere, attachments=carried) as env:
        env.reset(seed=0)
        while not any(env.step(0)[2:4]):
            pass
    with Recording(path) as recording:
        named = Path(recording.metadata["journal"])
    named.write_text("precious")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
