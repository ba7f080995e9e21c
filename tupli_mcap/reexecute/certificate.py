"""The certificate: which episodes were run again and with which software, what agreed, and what did not."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import platform
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tupli_mcap.environment import versions_of
from tupli_mcap.recording import Recording

_HEX_DIGEST = r"^[0-9a-f]{64}$"
SkipKind = Literal["unseeded", "after_divergence", "no_predecessor", "untrusted"]
REASONS: dict[SkipKind, str] = {
    "unseeded": "reset without a seed, from a random state that is not recorded",
    "after_divergence": "reset without a seed, after an episode that diverged",
    "no_predecessor": "reset without a seed, after steps or episodes that are missing in the recording",
    "untrusted": "reset with options that need trust, such as names of files, or after such a reset; "
    "allow them with `tupli-mcap trust FILE`, or with --trust (trust=True)",
}
"""Why episodes could not be checked."""
_ROW = np.dtype(
    [
        ("episode", "<u4"), ("env", "<u4"), ("length", "<u8"), ("return", "<f8"), ("start_time", "<i8"),
        ("end_time", "<i8"), ("seed", "<i8"), ("has_seed", "u1"), ("end", "u1"), ("final", "u1"),
    ]
)  # fmt: skip


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Divergence(_Model):
    """The first difference of an episode.

    kind: "value", "end" (a flag: the episode ended earlier or later), or "error" (the environment raised).
    episode, env: its number and its sub-environment. step: counts from 0; the episode's length for the final state, -1
        for an error in reset.
    leaf, path: the field's name in the file, and the name of the value (`state.pos[1]`).
    expected, found: the recorded value and the one of the new run, as text.
    largest_difference, largest_step: the largest difference of this leaf in the episode, and its step; None if it is no
        number.
    differing_steps, length: how many steps of the episode differ, the final state counted with the last one, and how
        many it has. hint: a likely cause, or empty.
    """

    kind: Literal["value", "end", "error"]
    episode: int = Field(ge=0)
    env: int = Field(ge=0)
    step: int = Field(ge=-1)
    leaf: str
    path: str
    expected: str
    found: str
    largest_difference: float | None
    largest_step: int | None
    differing_steps: int = Field(ge=0)
    length: int = Field(ge=1)
    hint: str = ""

    def __str__(self) -> str:
        """The divergence in one line."""
        of = f" of sub-environment {self.env}" if self.env else ""
        where = f"episode {self.episode}{of}"
        if self.kind == "error":
            return f"{where}: the environment fails at {_place(self.step, self.length)} with {self.found}"
        place = _place(self.step, self.length)
        return (
            f"{where} diverges at {place}: {self.path} is {self.expected} recorded, {self.found} in the rerun"
        )


def _place(step: int, length: int) -> str:
    return "its reset" if step < 0 else "its final state" if step == length else f"step {step}"


class Skipped(_Model):
    """Episodes that could not be checked, for one reason."""

    kind: SkipKind
    reason: str
    episodes: int = Field(ge=1)
    steps: int = Field(ge=1)
    first: int = Field(ge=0)


class Counts(_Model):
    """Episodes and their steps."""

    episodes: int = Field(ge=0)
    steps: int = Field(ge=0)


class Certificate(_Model):
    """The result of running the episodes of a recording again.

    recorded: all episodes of the recording. chosen: the chosen ones; each is agreed, diverged or skipped.
    divergences: the first one of each diverged episode, at most 100, in the order of the recording.
    versions, platform: the software and the machine of this run. recorded_versions: those of the recording.
    environment, environment_digest: its name, and the digest of what was rebuilt; "" for one that was passed in.
    content_sha256: over the facts of the episodes; it changes if episodes are added or deleted.
    created_ns: wall clock (ns).
    """

    format: Literal["tupli_mcap.replay_certificate"] = "tupli_mcap.replay_certificate"
    version: Literal[1] = 1
    recording: str = Field(pattern=r"^[0-9a-f]{32}$")
    benchmark_id: str
    environment: str
    environment_digest: str
    content_sha256: str = Field(pattern=_HEX_DIGEST)
    created_ns: int = Field(ge=0, lt=1 << 63)
    recorded: Counts
    chosen: Counts
    agreed: Counts
    diverged: Counts
    skipped: list[Skipped]
    divergences: list[Divergence] = Field(max_length=100)
    versions: dict[str, str]
    recorded_versions: dict[str, str]
    platform: dict[str, str]

    @property
    def agrees(self) -> bool:
        """Whether at least one episode was compared, and none differs; see `complete`."""
        return self.agreed.episodes > 0 and self.diverged.episodes == 0

    @property
    def complete(self) -> bool:
        """Whether every episode of the recording was compared and agrees."""
        return self.agreed == self.recorded and self.recorded.episodes > 0

    @property
    def first(self) -> Divergence | None:
        """The first divergence; None if there is none."""
        return self.divergences[0] if self.divergences else None

    @property
    def version_differences(self) -> dict[str, tuple[str, str]]:
        """Package -> (version when recorded, version now), where they differ."""
        here = self.versions
        return {
            name: (then, here[name])
            for name, then in self.recorded_versions.items()
            if here.get(name, then) != then
        }

    def to_json(self) -> bytes:
        """The certificate as UTF-8 JSON."""
        return self.model_dump_json(indent=2).encode()


def content_digest(recording: Recording) -> str:
    """SHA-256 (hex) over a recording's UUID and the facts of its episodes: number, sub-environment, length, return,
    times, seed, end. Appending and deleting change it, rewriting the file does not. Reads no steps."""
    index = recording.index
    rows = np.zeros(len(index), _ROW)
    for name in _ROW.names or ():
        rows[name] = index["final_row"] >= 0 if name == "final" else index[name]
    return hashlib.sha256(bytes.fromhex(recording.uuid) + rows.tobytes()).hexdigest()


def versions_under(env: gym.Env[Any, Any] | None) -> dict[str, str]:
    """Versions of Python, Gymnasium, NumPy and tupli-mcap, and of the packages of an environment's classes."""
    names = {"gymnasium", "numpy", "tupli-mcap"}
    while env is not None:
        names.update(_packages().get(type(env).__module__.partition(".")[0], ()))
        env = env.env if isinstance(env, gym.Wrapper) else None
    return dict(versions_of(frozenset(names)))


@functools.cache
def _packages() -> dict[str, list[str]]:
    return dict(importlib.metadata.packages_distributions())


def platform_facts() -> dict[str, str]:
    """System, machine, processor, C library and Python implementation, on which floating-point results may depend."""
    facts = {
        "system": platform.system(),
        "machine": platform.machine(),
        "cpu": _cpu(),
        "libc": " ".join(platform.libc_ver()).strip(),
        "implementation": platform.python_implementation(),
    }
    return {name: text for name, text in facts.items() if text}


def _cpu() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
