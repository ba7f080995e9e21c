"""Damaged and crafted recordings, a seeded sample of `tools/fuzz.py`: the right data, or a FormatError."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from fuzzing.model import Model, load_seeds
from fuzzing.oracle import judge, observe
from fuzzing.plain import Mutant
from fuzzing.run import MUTATORS, Case, Fuzzer, case_of

from tupli_mcap.dataset.items import steps_of
from tupli_mcap.errors import FormatError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.check.verify import verify_recording

SEEDS = {seed.name: seed for seed in load_seeds()}
SAMPLE = 400
PARTS = 2


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory: pytest.TempPathFactory) -> Fuzzer:
    return Fuzzer(list(SEEDS.values()), tmp_path_factory.mktemp("fuzz"))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("part", range(PARTS))
def test_the_right_data_or_one_error(fuzzer: Fuzzer, part: int) -> None:
    findings = []
    for number in range(part * SAMPLE // PARTS, (part + 1) * SAMPLE // PARTS):
        finding = fuzzer.run(case_of(2026, number, fuzzer.seeds))
        if finding is not None:
            findings.append(finding)
    hint = "read one again: tools/fuzz.py --seed 2026 --case <its number>"
    assert not findings, hint


def test_every_mutator_gets_through_to_the_reader(fuzzer: Fuzzer) -> None:
    for name in MUTATORS:
        for number in range(1, 30):
            fuzzer.run(case_of(1, number, fuzzer.seeds, only=[name]))
            if set(fuzzer.outcomes[name]) - {"refused"}:
                break
        else:
            pytest.fail(f"{name} makes files that are all refused at once")


@pytest.mark.parametrize("name", SEEDS)
def test_a_golden_file_is_put_together_again(name: str, tmp_path: Path) -> None:
    seed = SEEDS[name]
    again = Model.of(seed.data).encode()
    for data, file in ((seed.data, "a"), (again, "b")):
        (tmp_path / f"{file}.mcap").write_bytes(data)
        if seed.journal is not None:
            (tmp_path / f"{file}.mcap.journal").write_bytes(seed.journal)
    facts = [observe(tmp_path / f"{file}.mcap") for file in "ab"]
    assert facts[0][1] == facts[1][1] == []
    assert list(judge(facts[1][0], facts[0][0])) == []


def test_the_judge_sees_a_single_wrong_bit(fuzzer: Fuzzer) -> None:
    """One bit of an observation changed, all checksums made right: what a broken reader would let through."""
    seed = SEEDS["constant_zstd"]
    model = Model.of(seed.data)
    part = next(part for part in model.chunks() if len(part.inner) > 2)
    data = bytearray(part.inner[-1])
    data[35 + 8] ^= 1
    part.inner[-1] = bytes(data)
    finding = fuzzer.run(Case(0, "flip_bits", seed.name, Mutant(model.encode(), None, True, "a wrong bit")))
    assert finding is not None
    assert "are not" in finding.problem


def test_the_judge_sees_a_lost_episode(fuzzer: Fuzzer) -> None:
    """Reading refuses an index that leaves an episode out, so that the judge is asked without a file."""
    truth = fuzzer.truths["constant_zstd"]
    episodes = dict(list(truth["episodes"].items())[:-1])
    (problem,) = judge({**truth, "episodes": episodes}, truth)
    assert problem == "a complete recording of 2 episodes, not 3"


# What an index, or a message, may say wrongly while every checksum is right.
LIES = ("boundary", "row left out", "numbers swapped", "step", "episode", "flags", "rows swapped")


def lie(what: str, model: Model, random: np.random.Generator) -> bool:
    """Changes a model; False where it has no place for this lie."""
    index, rows = model.index, None if model.index is None else model.index.episodes
    if index is None or rows is None or len(rows) < 2:
        return False
    i = int(random.integers(len(rows) - 1))
    if what == "boundary":
        if rows["env"][i] != rows["env"][i + 1] or rows["length"][i] < 2:
            return False
        rows["length"][i] -= 1
        rows["first_row"][i + 1] -= 1
        rows["length"][i + 1] += 1
    elif what == "row left out":
        index.episodes = np.delete(rows, i)
        lengths = int(rows["metadata_length"][i])
        at = int(rows["metadata_offset"][i])
        index.texts = index.texts[:at] + index.texts[at + lengths :]
    elif what == "end":
        rows["end"][i] = (rows["end"][i] + 1) % 3
    elif what == "numbers swapped":
        for name in ("first_row", "length", "env"):
            rows[name][[i, i + 1]] = rows[name][[i + 1, i]]
    else:
        return lie_in_a_step(what, model, random)
    return True


def lie_in_a_step(what: str, model: Model, random: np.random.Generator, *, inside: bool = False) -> bool:
    """Changes a message: where reading holds it against the index, or `inside` of an episode and of a chunk."""
    assert model.index is not None
    rows = model.index.episodes
    ends = {(int(row["episode"]), int(row["length"]) - 1) for row in rows}
    topics = [body for opcode, body in model.summary if opcode == 4]
    steps = [int.from_bytes(body[:2], "little") for body in topics if b"/step" in body[:40]]
    places = [
        (part, k)
        for part in model.chunks()
        for k, piece in enumerate(part.inner)
        if piece[0] == 5 and int.from_bytes(piece[9:11], "little") in steps
        if (k + 1 < len(part.inner) and part.inner[k + 1][0] == 5) or not inside
        if (struct.unpack_from("<II", piece, 35) in ends) != inside
    ]
    if not places:
        return False
    part, k = places[int(random.integers(len(places)))]
    data = bytearray(part.inner[k])
    if what == "step":
        data[39] ^= 1
    elif what == "episode":
        data[35] ^= 1
    elif what == "flags":
        data[-2:] = b"\2\0"
    else:
        others = [j for j, piece in enumerate(part.inner) if piece[0] == 5 and j != k]
        if not others:
            return False
        j = others[0]
        part.inner[j], part.inner[k] = part.inner[k], part.inner[j]
        return True
    part.inner[k] = bytes(data)
    return True


@pytest.mark.parametrize("what", LIES)
def test_what_is_read_is_what_the_messages_say(what: str, tmp_path: Path) -> None:
    """Every checksum is right, and the index or a message lies: a FormatError, never other steps."""
    random, told = np.random.default_rng(LIES.index(what)), 0
    for name, seed in SEEDS.items():
        model = seed.model()
        if seed.journal is not None or not lie(what, model, random):
            continue
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(model.encode())
        with pytest.raises(FormatError, match="expected|gives|holds"), Recording(path) as recording:
            recording.read()
        with pytest.raises(FormatError, match="expected|gives|holds"), Recording(path) as recording:
            for episode in recording.episodes:
                episode[:]
        with pytest.raises(FormatError, match="expected|gives|holds"), Recording(path) as recording:
            steps = steps_of(recording, threads=1)
            steps.read(["states", "rewards", "terminals", "timeouts"], np.arange(len(steps)))
        told += 1
    assert told >= 3


@pytest.mark.parametrize("what", ["step", "episode", "end"])
def test_what_reading_does_not_compare_is_left_to_verify(what: str, tmp_path: Path) -> None:
    """Messages inside of an episode, and how the index says that an episode ends."""
    random, told = np.random.default_rng(7), 0
    for name, seed in SEEDS.items():
        model = seed.model()
        if seed.journal is not None or model.index is None:
            continue
        lied = lie(what, model, random) if what == "end" else lie_in_a_step(what, model, random, inside=True)
        if not lied:
            continue
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(model.encode())
        assert not verify_recording(path).ok
        told += 1
    assert told >= 3
