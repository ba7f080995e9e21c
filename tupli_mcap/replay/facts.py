"""What a certificate says of this machine and of the recording it is about."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import platform
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.recording import Recording

__all__ = ["content_digest", "platform_facts", "versions_of"]

_ROW = np.dtype(
    [
        ("episode", "<u4"), ("env", "<u4"), ("length", "<u8"), ("return", "<f8"), ("start_time", "<i8"),
        ("end_time", "<i8"), ("seed", "<i8"), ("has_seed", "u1"), ("end", "u1"), ("final", "u1"),
    ]
)  # fmt: skip


def content_digest(recording: Recording) -> str:
    """SHA-256 (hex) over a recording's UUID and the facts of its episodes: number, sub-environment, length, return,
    times, seed, end. Appending and deleting change it, writing the file anew does not. No step is read."""
    index = recording.index
    rows = np.zeros(len(index), _ROW)
    for name in _ROW.names or ():
        rows[name] = index["final_row"] >= 0 if name == "final" else index[name]
    return hashlib.sha256(bytes.fromhex(recording.uuid) + rows.tobytes()).hexdigest()


def versions_of(env: gym.Env[Any, Any] | None) -> dict[str, str]:
    """Versions of Python, of what replaying rests on, and of the packages that an environment's classes come from."""
    names = {"gymnasium", "numpy", "tupli-mcap"}
    while env is not None:
        names |= _distributions(type(env).__module__.partition(".")[0])
        env = env.env if isinstance(env, gym.Wrapper) else None
    versions = {"python": platform.python_version()}
    for name in sorted(names):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def _distributions(module: str) -> set[str]:
    if module in sys.stdlib_module_names or module == "__main__":
        return set()
    return set(_packages().get(module, ()))


@functools.cache
def _packages() -> dict[str, list[str]]:
    return dict(importlib.metadata.packages_distributions())


def platform_facts() -> dict[str, str]:
    """System, machine, processor, C library and Python implementation: what floating-point results may depend on."""
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
