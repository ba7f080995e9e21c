"""Clients that are killed, and connections that break: three rounds of tools/client_faults.py, and that it can fail."""

from __future__ import annotations

import functools
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from tupli_mcap import FileStorage

TOOL = Path(__file__).parents[1] / "tools" / "client_faults.py"
SEED = 4  # of which the first three rounds push, record and pull


@functools.cache
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("client_faults", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["client_faults"] = module  # pickles look their module up
    spec.loader.exec_module(module)
    return module


def test_nothing_acknowledged_is_lost_and_retries_change_nothing(tmp_path: Path) -> None:
    rounds = dict(tool().campaign(3, SEED, tmp_path))
    assert rounds == {1: [], 2: [], 3: []}


def test_what_is_lost_or_twice_is_found(tmp_path: Path) -> None:
    ledger = tmp_path / "ledger"
    ledger.write_bytes(tool()._STEP.pack(0, 5, True) + tool()._STEP.pack(1, 42, False))
    with FileStorage(tmp_path / "lab") as lab:
        env = tool().TupliEnvWrapper(tool().Told(7), lab)
        env.store(name="token 7")
        for _ in range(2):
            env.reset(seed=0)
            while not env.step(0)[2]:
                pass
        env.close()
        assert list(tool().recorded_wrong(lab, 7, ledger)) == [
            "token 7: expected episode 0 once, found it 2 times",
            "token 7: expected episode 1 once, found it 0 times",
        ]
