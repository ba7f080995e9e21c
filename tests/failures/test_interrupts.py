"""Ctrl-C at any line of any command: one line on stderr, exit code 130, and the old state or the new one."""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from faulty_storages import Lab, clone, state_of, strays, template
from test_broken_off import BreakAt
from typer.testing import CliRunner

from tupli_mcap import Recording, trust
from tupli_mcap.cli import app

Command = Callable[[Lab], list[object]]

COMMANDS: dict[str, Command] = {
    "ls": lambda lab: ["ls", lab.root],
    "info": lambda lab: ["info", lab.bundle],
    "episodes": lambda lab: ["episodes", lab.bundle, "--filter", "n_tuples > 1"],
    "list-benchmarks": lambda lab: ["list-benchmarks", "--storage", lab.root],
    "list-artifacts": lambda lab: ["list-artifacts", "--storage", lab.root, "--json"],
    "list-episodes": lambda lab: ["list-episodes", "--storage", lab.root],
    "compact": lambda lab: ["compact", "--storage", lab.root],
    "reindex": lambda lab: ["reindex", "--storage", lab.root],
    "bundle": lambda lab: ["bundle", lab.benchmark, "-o", lab.root.parent / "b.mcap", "--storage", lab.root],
    "export": lambda lab: [
        "export", "-o", lab.root.parent / "e.mcap", "--storage", lab.root, "--filter", f'benchmark_id = "{lab.other}"'
    ],
    "import": lambda lab: ["import", lab.bundle, "--storage", lab.root],
    "trust": lambda lab: ["trust", lab.bundle],
    "untrust": lambda lab: ["untrust", lab.bundle],
    "verify": lambda lab: ["verify", lab.root],
    "doctor": lambda lab: ["doctor", lab.bundle],
    "recover": lambda lab: ["recover", lab.bundle, "-o", lab.root.parent / "r.mcap"],
}  # fmt: skip

UNCHANGED, WHOLE = "nothing was changed", "every file is as it was, or finished"

_labs: list[Lab] = []


@pytest.fixture
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    if not _labs:
        _labs.append(template(tmp_path_factory.mktemp("made")))
    return _labs[0]


class Traced(BreakAt):
    """Counts lines up to the one that is interrupted; what reports the interruption is not interrupted again."""

    def local(self, frame: Any, event: str, arg: Any) -> Any:
        if any(name == "_report" for name in _callers(frame)):
            return None
        return super().local(frame, event, arg)


def _callers(frame: Any) -> Iterator[str]:
    """The names of a function and of those that called it."""
    while frame is not None:
        yield frame.f_code.co_name
        frame = frame.f_back


def run(words: list[object], line: int) -> tuple[bool, int, str]:
    """Runs a command; whether it was interrupted, its exit code, and what it said on stderr."""
    trace = Traced(line)
    sys.settrace(trace)
    try:
        result = CliRunner().invoke(app, [str(word) for word in words])
    finally:
        sys.settrace(None)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return trace.left <= 0, result.exit_code, result.stderr


def check_interrupted(name: str, made: Lab, directory: Path, line: int) -> bool:
    lab = clone(made, directory)
    before, trusted = state_of(lab), trust.trusted_digests()
    words = COMMANDS[name](lab)
    hit, code, said = run(words, line)
    if not hit:
        assert code == 0, said
        return False
    after = state_of(lab)
    # an interruption that comes after everything was done may go unnoticed, in a finalizer say
    if code != 0 or said:
        assert (code, said) in {(130, f"interrupted; {told}\n") for told in (UNCHANGED, WHOLE)}, said
        assert after == before or UNCHANGED not in said
    assert len(strays(lab)) <= 1  # interrupted while it was being removed
    assert len({*trust.trusted_digests()} ^ {*trusted}) <= 1
    again = run(words, 1 << 60)
    assert again[1] == 0 or " exists" in again[2], again
    new = state_of(lab)
    if name == "import":
        assert before.items() <= after.items() <= new.items()
    else:
        assert after in (before, new)
    return True


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", COMMANDS)
def test_any_command_at_any_line(tmp_path: Path, lab: Lab, name: str) -> None:
    lines = lines_of(name, lab, tmp_path / "whole")
    hits = 0
    for i, line in enumerate(random.Random(name).choices(range(1, lines), k=2)):
        hits += check_interrupted(name, lab, tmp_path / str(i), line)
        shutil.rmtree(tmp_path / str(i))
    assert hits  # the second run of a command has fewer lines than the first


def lines_of(name: str, made: Lab, directory: Path) -> int:
    """How many lines of the package a command runs."""
    lab = clone(made, directory)
    state_of(lab)  # as before each interruption: there is a catalog
    far = 1 << 40
    trace = Traced(far)
    sys.settrace(trace)
    try:
        CliRunner().invoke(app, [str(word) for word in COMMANDS[name](lab)])
    finally:
        sys.settrace(None)
    return far - trace.left


# A file that an interrupt keeps from its owner is closed by its last reference.
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
@pytest.mark.parametrize("mode", ["x", "w", "a"])
def test_recording_at_any_line(tmp_path: Path, mode: str) -> None:
    first = tmp_path / "first.mcap"
    words = ["record", "CartPole-v1", "--steps", "40", "--seed", "1"]
    assert run([*words, "-o", first], 1 << 60)[1] == 0
    assert len(Recording(first)) >= 1
    steps = Recording(first).n_steps
    for line in random.Random(mode).choices(range(1, 12_000), k=3):
        path = tmp_path / f"{mode}{line}.mcap"
        if mode != "x":
            shutil.copyfile(first, path)
        hit, code, said = run([*words, "-o", path, "--mode", mode], line)
        if hit and (code or said):
            assert (code, said.partition(";")[0].rstrip(), said.count("\n")) == (130, "interrupted", 1)
        if mode == "x" and not path.exists():
            continue
        with Recording(path) as recording:
            assert recording.complete
            assert recording.n_steps >= (steps if mode == "a" else 1)
            assert len(recording.read().states) == recording.n_steps
        assert [p.name for p in tmp_path.iterdir() if p.suffix != ".mcap"] == []
