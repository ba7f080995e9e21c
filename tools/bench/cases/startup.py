"""How long a process takes that imports, or that prints a help: beside one that imports Gymnasium.

Whole processes, in alternation; the smallest of the rounds counts, for whatever else a machine does only adds.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator

from tools.bench.contenders import OURS
from tools.bench.measure import Run, alternate, check, seconds_of
from tools.bench.targets import Target, at_most

_GYMNASIUM = "import gymnasium"
_IMPORTS = {
    OURS: "import tupli_mcap",
    f"{OURS}, reading": "from tupli_mcap import Recording",
    f"{OURS}, recording": "from tupli_mcap import RecordEpisodes",
    f"{OURS}, storage": "from tupli_mcap import FileStorage, TupliDataset",
}
_HELP = f"{OURS} --help"
_CLI = "import sys; from tupli_mcap.cli import main; sys.argv = ['tupli-mcap', '--help']; main()"


def startup(run: Run) -> Iterator[Target]:
    """`import tupli_mcap` against `import gymnasium`; the names of one's own work, and `tupli-mcap --help`."""
    codes = {"gymnasium": _GYMNASIUM, **_IMPORTS, _HELP: _CLI}
    sides = {name: _process(code) for name, code in codes.items()}
    alternate(sides, 1)  # compiles what is not compiled yet
    values = alternate(sides, max(run.rounds, 7))
    floor = min(values["gymnasium"])
    others = ", ".join(
        f"{name.partition(', ')[2]} {min(values[name]) / floor:.2f}" for name in list(_IMPORTS)[1:]
    )
    note = f"smallest of {len(values[OURS])} processes; with the names for {others}"
    yield at_most("import tupli_mcap, over import gymnasium", 1.3, min(values[OURS]) / floor, note, "x")
    yield at_most("tupli-mcap --help", 0.4, min(values[_HELP]), "smallest of the processes", "s")


def _process(code: str) -> Callable[[], float]:
    """Seconds of a process that runs `code`."""
    command = [sys.executable, "-c", code]

    def run() -> None:
        done = subprocess.run(command, capture_output=True, check=False)
        check(done.returncode == 0, f"{code!r} exits with {done.returncode}")

    return lambda: seconds_of(run)
