"""Clients that are killed, and connections that break: three rounds of tools/client_faults.py, and that it can fail."""

from __future__ import annotations

from pathlib import Path

from tool_modules import tool

from tupli_mcap import FileStorage

TOOL = tool("client_faults")
SEED = 2910  # of which the first three rounds push and are killed, pull, record with two processes and are killed


def test_nothing_acknowledged_is_lost_and_retries_change_nothing(tmp_path: Path) -> None:
    rounds = dict(TOOL.campaign(3, SEED, tmp_path))
    assert rounds == {1: [], 2: [], 3: []}


def test_what_is_lost_or_twice_is_found(tmp_path: Path) -> None:
    ledger = tmp_path / "ledger"
    ledger.write_bytes(TOOL._STEP.pack(0, 5, True) + TOOL._STEP.pack(1, 42, False))
    with FileStorage(tmp_path / "lab") as lab:
        env = TOOL.TupliEnvWrapper(TOOL.Told(7), lab)
        env.store(name="token 7")
        for _ in range(2):
            env.reset(seed=0)
            while not env.step(0)[2]:
                pass
        env.close()
        assert list(TOOL.recorded_wrong(lab, 7, ledger)) == [
            "token 7: expected episode 0 once, found it 2 times",
            "token 7: expected episode 1 once, found it 0 times",
        ]
