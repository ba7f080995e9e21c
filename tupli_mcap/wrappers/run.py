"""The attachment `run.json` of a new recording: the user's words about the run, and facts about this process."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
import uuid
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns, Run
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.schema.times import iso_utc

_PACKAGES: Final = {  # distributions, by the module that says whether one is at work
    "tupli_mcap": "tupli-mcap", "gymnasium": "gymnasium", "numpy": "numpy", "torch": "torch", "jax": "jax",
    "tensorflow": "tensorflow", "stable_baselines3": "stable-baselines3", "d3rlpy": "d3rlpy", "torchrl": "torchrl",
    "ale_py": "ale-py", "mujoco": "mujoco",
}  # fmt: skip
_LONGEST: Final = 1000  # characters of an argument
_PATIENCE: Final = 2.0  # seconds for git


def with_run(
    attachments: Mapping[str, tuple[str, bytes]], options: RecordOptions, environment: str
) -> dict[str, tuple[str, bytes]]:
    """The attachments with `run.json`; without it if the user says nothing about the run and captures nothing.

    Raises:
        RecordingError: a part of the run is no text, or JSON cannot hold it.
    """
    run = Run.given(options.name, options.metadata, options.tags, options.split)
    if RUN_NAME in attachments or (run == Run() and options.capture == "none"):
        return dict(attachments)
    run = replace(run, id=uuid.uuid4().hex, environment=environment, started=iso_utc(time.time_ns()))
    if options.capture != "none":
        run = replace(run, versions=_versions())
    if options.capture == "all":
        command = tuple(argument[:_LONGEST] for argument in sys.orig_argv[:100])
        run = replace(run, command=command, git=_git(_program_folder()), host=os.uname().nodename)
    return {**attachments, RUN_NAME: (RUN_MEDIA_TYPE, RecordedRuns([run]).to_json())}


def _versions() -> dict[str, str]:
    loaded = tuple(name for name in _PACKAGES if name in sys.modules)
    return {"python": platform.python_version(), **_versions_of(loaded)}


@lru_cache(maxsize=8)
def _versions_of(modules: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for name in modules:
        try:
            found[_PACKAGES[name]] = metadata.version(_PACKAGES[name])
        except metadata.PackageNotFoundError:  # run from its sources
            continue
    return found


def _program_folder() -> str:
    """The directory of the program's file; without a file, as in a notebook, the working directory."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    return str(Path(file).absolute().parent) if file else os.getcwd()  # noqa: PTH109 - gone, perhaps


@lru_cache(maxsize=8)
def _git(folder: str) -> dict[str, Any]:
    """The commit of a folder, and whether files differ from it; empty if git does not know the folder."""
    # no program of the repository's configuration is run, and nothing in it is written
    ask = ["git", "-c", "core.fsmonitor=false", "-C", folder]
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}

    def answer(*arguments: str) -> str:
        done = subprocess.run(
            [*ask, *arguments], capture_output=True, check=True, timeout=_PATIENCE, env=environment, text=True
        )
        return done.stdout.strip()

    try:
        commit = answer("rev-parse", "HEAD")
        changed = answer("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return {"commit": commit, "dirty": bool(changed)}
