"""How long a process takes that imports, or that prints a help: beside one that imports Gymnasium.

Whole processes, in alternation; the smallest of the rounds counts, for whatever else a machine does only adds.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator

from benchmarks.measure import OURS, Line, Run, alternate, at_most, check, seconds_of

_GYMNASIUM = "import gymnasium"
_IMPORTS = {
    OURS: "import tupli_mcap",
    f"{OURS}, reading": "from tupli_mcap import Recording",
    f"{OURS}, recording": "from tupli_mcap import RecordEpisodes",
    f"{OURS}, storage": "from tupli_mcap import FileStorage, TupliDataset",
}
_HELP = f"{OURS} --help"
_CLI = "import sys; from tupli_mcap.cli import main; sys.argv = ['tupli-mcap', '--help']; main()"


def startup(run: Run) -> Iterator[Line]:
    """`import tupli_mcap` against `import gymnasium`; the names of one's own work, and `tupli-mcap --help`."""
    codes = {"gymnasium": _GYMNASIUM, **_IMPORTS, _HELP: _CLI}
    sides = {name: _process(code) for name, code in codes.items()}
    alternate(sides, 1)  # compiles what is not compiled yet
    values = alternate(sides, max(run.rounds, 7))
    floor = min(values["gymnasium"])
    yield Line("start-up", "gymnasium", _GYMNASIUM, "s", values["gymnasium"])
    for name, code in _IMPORTS.items():
        found = min(values[name]) / floor
        words, met = at_most(1.3, "min/min") if name == OURS else ("", lambda _: None)
        yield Line("start-up", name, code, "s", values[name], found, words, met(found))
    least = min(values[_HELP])
    yield Line("start-up", _HELP, "a process", "s", values[_HELP], None, "min <= 0.4 s", least <= 0.4)


def _process(code: str) -> Callable[[], float]:
    """Seconds of a process that runs `code`."""
    command = [sys.executable, "-c", code]

    def run() -> None:
        done = subprocess.run(command, capture_output=True, check=False)
        check(done.returncode == 0, f"{code!r} exits with {done.returncode}")

    return lambda: seconds_of(run)
