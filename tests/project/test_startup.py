"""What importing must not import: what is not needed yet, looked at in new processes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

from tupli_mcap import RecordEpisodes

# Extras, and what of the standard library or of the dependencies takes long.
EXTRAS = (
    "pandas", "pyarrow", "rerun", "foxglove", "torch", "torchrl", "tensordict", "torchdata", "tensorflow",
    "matplotlib", "d3rlpy", "fsspec", "requests", "aiohttp", "cryptography", "PIL", "ale_py", "h5py", "IPython",
    "stable_baselines3",
)  # fmt: skip
HEAVY = (*EXTRAS, "gymnasium", "numpy", "pydantic", "sqlalchemy", "sqlite3", "mcap", "zstandard", "rich")
DATABASE = ("sqlalchemy", "sqlite3", "asyncio", "ssl")


def looks(*codes: str) -> list[set[str]]:
    """The modules that are there after each of `codes`, which run one after another in a new process."""
    script = "import sys\n" + "".join(f"{code}\nprint('\\nlook', *sys.modules)\n" for code in codes)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    found = [set(line.split()[1:]) for line in done.stdout.splitlines() if line.startswith("look ")]
    assert len(found) == len(codes)
    return found


def imported(code: str) -> set[str]:
    """The modules that are there after `code` has run in a new process."""
    return looks(code)[0]


def run(*arguments: str) -> str:
    """Code that runs the command line."""
    return f"from tupli_mcap.cli import app\ntry: app({list(arguments)!r})\nexcept SystemExit: pass"


# Each list is of codes that may import more and more: what an earlier one has imported, the later ones may, too.
LEFT_OUT = {
    "reading": [
        ("import tupli_mcap", (*HEAVY, "typer", "dataclasses")),
        ("import tupli_mcap; dir(tupli_mcap); tupli_mcap.__all__", HEAVY),
        ("from tupli_mcap import TupliError", HEAVY),
        ("import tupli_mcap.cli", HEAVY),
        ("from tupli_mcap import F, FilterEQ", (*EXTRAS, *DATABASE, "gymnasium", "mcap")),
        ("from tupli_mcap import Recording", (*EXTRAS, *DATABASE, "tupli_mcap.recording.write.writer")),
        ("from tupli_mcap import Recording, verify_recording", (*EXTRAS, *DATABASE)),
        ("from tupli_mcap import open, merge_recordings", (*EXTRAS, *DATABASE)),
        ("from tupli_mcap import TupliAPIClient", (*EXTRAS, *DATABASE)),
        ("from tupli_mcap import FileStorage, TupliDataset, TupliEnvWrapper", EXTRAS),
    ],
    "recording": [
        (
            "from tupli_mcap import RecordEpisodes; from tupli_mcap.vector import RecordEpisodes",
            (*EXTRAS, *DATABASE, "tupli_mcap.viewer", "tupli_mcap.recording.edit.repair"),
        ),
    ],
    "commands": [
        (run("--help"), [name for name in HEAVY if name != "rich"]),  # draws the help
        (run("record", "--help"), [name for name in HEAVY if name not in ("rich", "pydantic")]),  # typer's
        (run("ls", "none.mcap"), (*EXTRAS, *DATABASE)),
    ],
}


@pytest.mark.parametrize("what", LEFT_OUT)
def test_left_out(what: str) -> None:
    codes, left_out = zip(*LEFT_OUT[what], strict=True)
    for code, found, names in zip(codes, looks(*codes), left_out, strict=True):
        assert found & set(names) == set(), code


def test_a_replay_is_saved_without_what_pyarrow_would_import(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=1)
        env.step(0)
    found = imported(run("replay", str(path), "--save", str(tmp_path / "r.rrd")))
    assert (tmp_path / "r.rrd").stat().st_size > 10_000
    assert "rerun" in found
    assert found & {"pandas", "pyarrow.compute", "pydoc", "matplotlib", "sqlalchemy"} == set()


@pytest.mark.parametrize("earlier", ["", "import pandas; "])
def test_pandas_is_there_for_those_who_use_it(earlier: str) -> None:
    code = (
        f"{earlier}from tupli_mcap.viewer.sdk import import_quickly; import_quickly(); import pyarrow\n"
        "assert pyarrow.table({'a': [1, 2]}).to_pandas().a.tolist() == [1, 2]\n"
        "import pandas; assert pandas.Series([1]).sum() == 1"
    )
    assert "pandas" in imported(code)


def test_the_look_sees_what_is_imported() -> None:
    assert {"sqlite3", "numpy"} <= imported("import sqlite3, numpy")
