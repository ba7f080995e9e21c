"""The environments that killed processes record: of every layout, single and vector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FrameStackObservation

from tupli_mcap import FileStorage, RecordEpisodes, TupliEnvWrapper
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes as RecordVector

__all__ = ["KINDS", "Kind", "Tell", "open_recorder"]

Tell = Callable[[str, Any], None]


@dataclass(frozen=True)
class Kind:
    """A layout, an environment and the options it is recorded with."""

    space: gym.Space[Any]
    chunks: tuple[int, ...] = (700, 4000, 60_000)  # chunk_size, one of
    vector: AutoresetMode | None = None
    options: dict[str, Any] = field(default_factory=dict)
    elsewhere: bool = False  # the journal has a directory of its own
    storage: bool = False  # recorded by TupliEnvWrapper
    threaded: bool = False
    reuse: bool = False  # the environment returns the same array, with other values, again and again
    reward: gym.Space[Any] | None = None
    plain: bool = False  # states of one value each, for they are large
    rotates: bool = False  # goes on in other files
    silent: bool = False  # a reset gives no info, so that episodes are derived from rows
    window: int | None = None  # the axis of states that holds the newest frames, the oldest first
    large: int = 0  # every episode's texts are longer than the last one's, up to here


_BOX = spaces.Box(-1, 1, (4,), np.float32)
_WIDE = spaces.Box(-1, 1, (250,), np.float64)
_IMAGE = spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": spaces.Box(-1, 1, (1,))})
_TEXT = spaces.Dict({"note": spaces.Text(30), "x": spaces.Discrete(5)})
_LONG = spaces.Dict({"note": spaces.Text(1500), "x": spaces.Discrete(5)})
_SEEN = spaces.Dict({"note": spaces.Text(20), "camera": spaces.Box(0, 255, (6, 5, 1), np.uint8)})
_NESTED = spaces.Dict(
    {
        "zero": spaces.Box(-1, 1, (0,), np.float32),
        "arm": spaces.Tuple((spaces.Box(-1, 1, (2, 3), np.float16), spaces.MultiBinary(3))),
        "wide": spaces.Box(-1, 1, (60,), np.float64),
        "Scalar!": spaces.Box(-1, 1, (), np.float64),
        "deep": spaces.Dict({"n": spaces.Discrete(7, start=-3), "m": spaces.MultiDiscrete([3, 4])}),
    }
)
_NEXT, _SAME, _DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
_SMALL = (200, 700, 4000)

KINDS = {
    "box": Kind(_BOX, reuse=True),
    "discrete": Kind(spaces.Discrete(500), reward=spaces.Box(-9, 9, (2,), np.float32)),
    "nested": Kind(_NESTED),
    "silent": Kind(_BOX, reuse=True, silent=True),
    "silent nested": Kind(_NESTED, silent=True),
    "silent chunks": Kind(_WIDE, options={"durability": "chunk"}, silent=True),
    "silent vector": Kind(_WIDE, vector=_NEXT, silent=True),
    "large": Kind(spaces.Dict({"x": spaces.Discrete(5), "y": spaces.Box(-1, 1, (600,))}), reuse=True),
    "text": Kind(_TEXT, _SMALL),
    "sequence": Kind(
        spaces.Tuple((spaces.Sequence(_BOX), spaces.OneOf((spaces.Discrete(3), spaces.Text(9))))),
        _SMALL,
    ),
    "growing": Kind(spaces.Dict({"note": spaces.Text(50_000)}), _SMALL, large=50_000),
    "image": Kind(_IMAGE, (700, 2000, 20_000)),
    "image and text": Kind(_SEEN, (200, 2000)),
    "frames": Kind(spaces.Box(0, 255, (80, 80, 3), np.uint8), (20_000, 60_000), threaded=True),
    "frames and text": Kind(
        spaces.Dict({"see": spaces.Box(0, 255, (80, 80, 3), np.uint8), "note": spaces.Text(20)}),
        (300, 60_000),
        threaded=True,
    ),
    "stacked": Kind(spaces.Box(0, 255, (4, 90, 70), np.uint8), (20_000, 60_000), threaded=True, window=0),
    "stacked last": Kind(
        spaces.Box(0, 255, (90, 70, 3), np.uint8), (20_000, 60_000), threaded=True, window=-1
    ),
    "stacked png": Kind(
        spaces.Box(0, 255, (4, 90, 70), np.uint8),
        (20_000, 60_000),
        threaded=True,
        window=0,
        options={"image_format": "png"},
    ),
    "png": Kind(_IMAGE, (700, 2000, 20_000), options={"image_format": "png"}),
    "png frames": Kind(
        spaces.Box(0, 255, (80, 80, 3), np.uint8),
        (20_000, 60_000),
        threaded=True,
        options={"image_format": "png"},
    ),
    "info": Kind(_BOX, options={"record_info": True}),
    "info and text": Kind(_TEXT, _SMALL, options={"record_info": ["t"]}),
    "metadata": Kind(_BOX, options={"metadata_callback": True}),
    "huge": Kind(spaces.Box(0, 255, (420, 420, 3), np.uint8), threaded=True, plain=True),
    "lz4": Kind(_BOX, options={"compression": "lz4"}),
    "uncompressed": Kind(_IMAGE, (700, 2000), options={"compression": "none"}),
    "elsewhere": Kind(_BOX, elsewhere=True),
    "by time": Kind(_BOX, options={"flush_seconds": 0.002}),
    "synced steps": Kind(_BOX, options={"durability": "step"}),
    "synced images": Kind(_IMAGE, (700, 2000), options={"durability": "chunk", "record_info": True}),
    "synced texts": Kind(_TEXT, _SMALL, options={"durability": "step"}),
    "storage": Kind(_BOX, storage=True),
    "rotating": Kind(_BOX, (700,), options={"max_bytes": 8000}, reuse=True, rotates=True),
    "rotating vector": Kind(_WIDE, vector=_NEXT, options={"max_bytes": 300_000}, rotates=True),
    "rotating text": Kind(
        _LONG, vector=_SAME, options={"max_bytes": 250_000, "record_info": True}, rotates=True
    ),
    "vector": Kind(_WIDE, vector=_NEXT, reuse=True, threaded=True),
    "vector same": Kind(_WIDE, vector=_SAME, threaded=True),
    "vector disabled": Kind(_WIDE, vector=_DISABLED),
    "vector lz4": Kind(_WIDE, vector=_NEXT, options={"compression": "lz4"}),
    "vector nested": Kind(_NESTED, vector=_SAME, options={"record_info": True}),
    "vector synced": Kind(_WIDE, vector=_SAME, options={"durability": "step"}),
    "vector image": Kind(_IMAGE, (700, 2000), vector=_NEXT),
    "vector image same": Kind(_IMAGE, (700, 2000), vector=_SAME),
    "vector image disabled": Kind(_IMAGE, (700, 2000), vector=_DISABLED, options={"record_info": True}),
    "vector frames": Kind(spaces.Box(0, 255, (80, 80, 3), np.uint8), vector=_NEXT, threaded=True),
    "vector metadata": Kind(_WIDE, vector=_SAME, options={"metadata_callback": True, "record_info": True}),
    "vector huge": Kind(spaces.Box(0, 255, (420, 420, 3), np.uint8), vector=_SAME, threaded=True, plain=True),
    "vector text": Kind(_LONG, vector=_NEXT, options={"record_info": True}),
    "vector text same": Kind(_LONG, vector=_SAME),
    "vector text disabled": Kind(_SEEN, vector=_DISABLED),
    "vector growing": Kind(spaces.Dict({"note": spaces.Text(200_000)}), vector=_NEXT, large=200_000),
}
SUB_ENVIRONMENTS = 3


class Counter(EpisodeMetadataCallback):
    """Metadata of an episode: its steps, and their rewards."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._steps, self._total = 0, 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self._steps, self._total = self._steps + 1, self._total + float(tuple.reward)
        return {"steps": self._steps, "total": self._total}


class Teller(gym.Env[Any, Any]):
    """Reports each result before returning it: ("reset", …) and ("step", …), with its number."""

    def __init__(self, kind: Kind, number: int, seed: int, tell: Tell) -> None:
        self.observation_space = kind.space
        self.action_space = spaces.Discrete(9)
        self._kind, self._number, self._tell = kind, number, tell
        self._random = np.random.default_rng([seed, number])
        kind.space.seed(seed)
        self._kept: Any = None
        self._episodes = self._steps = self._length = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._episodes += 1
        self._steps, self._length = 0, int(self._random.integers(1, 12))
        state, info = self._state(), {} if self._kind.silent else {"r": self._episodes}
        self._tell("reset", (self._number, state, seed, options, info))
        return state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._steps += 1
        state, done = self._state(), self._steps >= self._length
        how = int(self._random.integers(3)) if done else -1
        reward: Any = float(self._random.normal())
        if self._kind.reward is not None:
            reward = self._random.normal(size=2).astype(np.float32)
        note = "y" * int(
            self._random.choice([0, 9, 900])
        )  # some do not fit into what the journal has for them
        info = {"t": self._steps * 0.1, "note": f"step {self._steps}{note}"}
        result = (state, reward, how in (0, 2), how in (1, 2), info)
        self._tell("step", (self._number, action, *result))
        return result

    def _state(self) -> Any:
        if self._kind.large:
            n = int(self._random.integers(1, min(self._kind.large, 20 * 2**self._episodes)))
            return {"note": "".join(chr(97 + (i * 7 + self._steps) % 26) for i in range(n % 26)) + "x" * n}
        if self._kind.plain:
            space = self.observation_space
            return np.full(space.shape, self._random.integers(256), space.dtype)
        state = self.observation_space.sample()
        if self._kind.window is not None:
            frames = np.moveaxis(state, self._kind.window, 0)
            if self._steps and self._random.integers(9):  # now and then it breaks off
                frames[:-1] = self._kept[1:]
            self._kept = frames
        if not self._kind.reuse:
            return state
        if self._kept is None:
            self._kept = state
        elif isinstance(state, np.ndarray):
            self._kept[...] = state
        else:
            self._kept["x"] = state["x"]
            self._kept["y"][...] = state["y"]
        return self._kept


class Stacked(FrameStackObservation):
    """Declares that the environment stacks frames, as it does itself."""

    def __init__(self, env: gym.Env[Any, Any], axis: int) -> None:
        gym.Wrapper.__init__(self, env)
        self.stack_size = env.observation_space.shape[axis]  # type: ignore[index, misc]

    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)

    def step(self, action: Any) -> Any:
        return self.env.step(action)


def open_recorder(
    kind: Kind, path: Path, mode: Any, chunk: int, seed: int, tell: Tell, benchmark_id: str = ""
) -> Any:
    """The environment of a kind, wrapped so that it is recorded; of a storage, `path` is its directory."""
    if kind.storage:
        storage = FileStorage(path)
        return TupliEnvWrapper(Teller(kind, 0, seed, tell), storage, benchmark_id, chunk_size=chunk)
    options: dict[str, Any] = {"mode": mode, "chunk_size": chunk, "attachments": {}, **kind.options}
    if "metadata_callback" in options:
        options["metadata_callback"] = Counter()
    if kind.elsewhere:
        options["journal_dir"] = path.parent / "journals"
    if kind.reward is not None:
        options["reward_space"] = kind.reward
    if kind.window is not None:
        return RecordEpisodes(Stacked(Teller(kind, 0, seed, tell), kind.window), path, **options)
    if kind.vector is None:
        return RecordEpisodes(Teller(kind, 0, seed, tell), path, **options)
    makers = [lambda i=i: Teller(kind, i, seed, tell) for i in range(SUB_ENVIRONMENTS)]
    return RecordVector(SyncVectorEnv(makers, autoreset_mode=kind.vector), path, **options)
