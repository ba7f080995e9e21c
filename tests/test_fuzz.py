"""Damaged and crafted recordings, a seeded sample of `tools/fuzz.py`: the right data, or a FormatError."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

from fuzzing.model import Model, load_seeds
from fuzzing.oracle import judge, observe
from fuzzing.plain import Mutant
from fuzzing.run import MUTATORS, Case, Fuzzer, case_of

SEEDS = {seed.name: seed for seed in load_seeds()}
SAMPLE = 2_500
PARTS = 5


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory: pytest.TempPathFactory) -> Fuzzer:
    return Fuzzer(list(SEEDS.values()), tmp_path_factory.mktemp("fuzz"))


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
        for number in range(8):
            fuzzer.run(case_of(1, number, fuzzer.seeds, only=[name]))
    for name, outcomes in fuzzer.outcomes.items():
        assert set(outcomes) - {"refused"}, f"{name} makes files that are all refused at once"


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
    seed = SEEDS["constant_zstd"]
    model = Model.of(seed.data)
    assert model.index is not None
    model.index.episodes = model.index.episodes[:-1]
    finding = fuzzer.run(Case(0, "flip_bits", seed.name, Mutant(model.encode(), None, True, "one less")))
    assert finding is not None
    assert "a complete recording of 2 episodes, not 3" in finding.problem
