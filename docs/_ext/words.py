"""Tables of the keys of filters, checks and extras, made from the program itself."""

from __future__ import annotations

import dataclasses
import inspect
import re
import tomllib
import typing
from pathlib import Path
from typing import Any

from tupli_mcap.doctor import CHECKS
from tupli_mcap.recording import Run
from tupli_mcap.schema import BenchmarkHeader, EpisodeHeader, facts
from tupli_mcap.schema.models import DERIVED

ROOT = Path(__file__).parents[2]

_ABOUT = {  # the meaning of each key
    "benchmark_id": "the benchmark it belongs to",
    "created_by": "the user who stored it, on a server",
    "end": "`terminal`, `timeout`, `interrupted`, or empty if not known",
    "ended": "when its last step returned; also `created_at`",
    "env": "number of the sub-environment, from 0",
    "episode": "its number in the recording, from 0",
    "id": "unique",
    "metadata": "its metadata, with annotations applied: `metadata.score`",
    "published_in": "groups that may see it",
    "recording": "path of its file; in a storage, below the storage",
    "return": "sum of its rewards; also `episode_return`",
    "run": "see below",
    "seed": "seed of its reset",
    "steps": "number of its steps; also `n_tuples`",
    "success": "`success` or `is_success` of its metadata, if that is true, false, 0 or 1; else null",
    "terminated": "its last step was terminal",
    "timeout": "its last step was a timeout, and not terminal",
    "environment": "Gymnasium id, or the class",
    "hash": "the same as `id`",
    "created_at": "when it was stored",
}
_RUN = {
    "id": "the same in all files of a run",
    "name": "the name given to the recorder, else the file's",
    "metadata": "settings: `run.metadata.lr`",
    "tags": 'a list: `"baseline" in run.tags`',
    "split": "`train`, `eval` or another word",
    "environment": "Gymnasium id, or the class",
    "started": "a time",
    "ended": "a time",
    "command": "a list: the program's arguments",
    "git": "`run.git.commit`, `run.git.dirty`",
    "versions": "`run.versions.numpy`",
    "host": "name of the machine",
}


def filter_keys_of(model: Any) -> dict[str, tuple[str, str]]:
    """Key -> its type, and its meaning."""
    kinds = DERIVED | {name: field.annotation for name, field in model.model_fields.items()}
    return {
        key: (_kind(kinds[facts.path_in(key, model)[0]]), _ABOUT[key]) for key in facts.filter_keys(model)
    }


def filter_keys(of: str) -> str:
    """The keys that filters over episodes, runs or benchmarks may name, as a table."""
    if of == "run":
        hints = typing.get_type_hints(Run)
        found = {f"run.{f.name}": (_kind(hints[f.name]), _RUN[f.name]) for f in dataclasses.fields(Run)}
    else:
        found = filter_keys_of({"episode": EpisodeHeader, "benchmark": BenchmarkHeader}[of])
    rows = [f"| `{key}` | {kind} | {about} |" for key, (kind, about) in found.items()]
    return "| key | | |\n|---|---|---|\n" + "\n".join(rows)


def _kind(hint: Any) -> str:
    names = {str: "text", int: "whole number", float: "number", bool: "true or false", type(None): "null"}
    if hint in names:
        return names[hint]
    origin, inside = typing.get_origin(hint), typing.get_args(hint)
    if origin in (list, tuple):
        return "list of texts"
    if origin is dict or hint is Any or inspect.isclass(hint):
        return "object"
    return " or ".join(_kind(one) for one in inside)


def checks() -> str:
    """The doctor's checks."""
    return "| check | finds |\n|---|---|\n" + "\n".join(
        f"| `{check.id}` | {check.summary} |" for check in CHECKS.values()
    )


def extras() -> str:
    """The extras, and what each of them installs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = [
        f"| `{name}` | {', '.join(re.split(r'[<>=!~; ]', item)[0] for item in items)} |"
        for name, items in project["optional-dependencies"].items()
        if name not in ("dev", "docs", "bench")
    ]
    return "| extra | installs |\n|---|---|\n" + "\n".join(rows)
