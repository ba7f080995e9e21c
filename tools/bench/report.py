"""The results in words: tables of every workload, and what was promised."""

from __future__ import annotations

import re
import statistics
from typing import Any

from tools.bench.contenders import OURS
from tools.bench.matrix import OPERATIONS
from tools.bench.measure import ratio
from tools.bench.workloads import NUM_ENVS, WORKLOADS

MINE = (OURS, f"{OURS}, saved columns")


def figure(value: float) -> str:
    """Two or three digits that mean something."""
    if value < 0.005:
        return "<0.01" if value >= 0 else "~0"
    if value < 9.95:
        return f"{value:.2f}" if value < 1 else f"{value:.1f}"
    return f"{value:,.0f}" if value < 9.95e5 else f"{value / 1e6:.1f}M"


def table(found: dict[str, Any]) -> str:
    """One workload: a row a contender, a column an operation, footnotes below."""
    cells, notes = found["cells"], _Notes()
    names = list(next(iter(cells.values())))
    operations = [OPERATIONS[operation] for operation in cells]
    heads = " | ".join(f"{op.title}<br>{op.unit} {'▲' if op.higher else '▼'}" for op in operations)
    lines = [f"| | {heads} |", "|---|" + "---:|" * len(operations)]
    for name in names:
        if all(row.get(name, {}).get("cannot", "").startswith("not installed") for row in cells.values()):
            continue
        row = [_cell(operation, name, cells[operation], notes) for operation in cells]
        lines.append(
            f"| {'**' if name == OURS else ''}{name}{'**' if name == OURS else ''} | {' | '.join(row)} |"
        )
    return "\n".join([*lines, "", notes.text(_steps(found))])


def _steps(found: dict[str, Any]) -> str:
    """How much each contender has read, where it was less than the most."""
    steps = {name: facts["steps"] for name, facts in found["built"].items()}
    most = max(steps.values(), default=0)
    fewer = [f"{name} {count:,}" for name, count in steps.items() if count < most * 0.9]
    return f"{most:,} steps" + (
        f"; slower ones fewer, which favours them: {', '.join(fewer)}" if fewer else ""
    )


class _Notes:
    """Footnotes, each once."""

    def __init__(self) -> None:
        self._known: dict[str, int] = {}

    def mark(self, what: str) -> str:
        return f"<sup>{self._known.setdefault(what, len(self._known) + 1)}</sup>"

    def text(self, first: str) -> str:
        told = " ".join(f"<sup>{number}</sup> {what}." for what, number in self._known.items())
        return f"<sub>{first}. {told}</sub>"


def _cell(operation: str, name: str, row: dict[str, Any], notes: _Notes) -> str:
    """The median; bold for the best, with how much faster than us where somebody is."""
    cell = row.get(name)
    if cell is None:
        return ""
    if cell["failed"]:
        return "failed" + notes.mark(f"{name}: {_short(cell['failed'])}")
    if not cell["values"]:
        return "-" + notes.mark(
            f"{_short(cell['cannot'])}" if name in MINE else f"{name}: {_short(cell['cannot'])}"
        )
    middle = statistics.median(cell["values"])
    text = figure(middle)
    if len(cell["values"]) > 1 and middle > 0:
        spread = (max(cell["values"]) - min(cell["values"])) / 2 / middle
        text += f" <sub>±{spread:.0%}</sub>"
    ahead = lead(operation, name, row)
    if ahead is not None and ahead > 1.05:
        text += f" ⚡{figure(ahead)}x"
    return text


def lead(operation: str, name: str, row: dict[str, Any]) -> float | None:
    """How many times better than tupli-mcap somebody is; None for ourselves, or if it cannot be said."""
    mine, theirs = row.get(OURS, {}).get("values"), row.get(name, {}).get("values")
    if name in MINE or not mine or not theirs:
        return None
    if statistics.median(mine) <= 0 or statistics.median(theirs) <= 0:
        return None
    found = ratio(mine, theirs)
    return 1 / found if OPERATIONS[operation].higher else found


def _short(text: str) -> str:
    return text.replace("|", "/").rstrip(".")[:160]


def targets(found: list[dict[str, Any]]) -> str:
    """Promises as a table."""
    lines = ["| promised | limit | measured | |", "|---|---:|---:|---|"]
    for target in found:
        reached = {None: "not measured", True: "reached", False: "**not reached**"}[target["reached"]]
        lines.append(
            f"| {target['what']} | {target['words']} | {measured(target)} | {_noted(reached, target)} |"
        )
    return "\n".join(lines)


def measured(target: dict[str, Any]) -> str:
    """The figure, as the limit is written."""
    value = target["figure"]
    if value is None:
        return "-"
    if "1/" in target["words"] and 0 < value < 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:.3g} {target['unit']}".strip()


def _noted(reached: str, target: dict[str, Any]) -> str:
    return f"{reached}: {_short(target['note'])}" if target["note"] else reached


def machine(results: dict[str, Any]) -> str:
    """On what, and which versions."""
    about = results["machine"]
    packages = dict(about["packages"])
    for entry in results["contenders"].values():
        packages |= entry["versions"]
    packages.pop("python", None)
    versions = ", ".join(f"{name} {version}" for name, version in sorted(packages.items()))
    quick = " **A quick run: a look, not a result.**" if results["quick"] else ""
    return (
        f"{about['cpu']}, {about['cores']} cores, {about['memory']}, {about['system']}, Python {about['python']}; "
        f"{about['date']}, commit {about['commit']}, load {about['load']} at the start.{quick}\n\n{versions}"
    )


LEGEND = """▼ less is better, ▲ more is better; ⚡2x is twice as good as tupli-mcap. Figures are medians over rounds \
in which the contenders take turns, ± half the range. The time of a contender counts only if it recorded or read \
exactly the steps of the rollout.

| | |
|---|---|
| record | time of a step, without that of the rollout itself; closing included |
| open, list | opening, and reading the length of each episode |
| read all, one field | opening, and reading all columns, or only the actions |
| episode, window | reading one at a random place of an open dataset that was read before |
| epoch | a shuffled epoch of windows in PyTorch's `DataLoader`, its start included: 20,000 windows, fewer for \
slow contenders that read them one by one |
| filter | opening, and reading the best 1 % of episodes |
| append | adding about 1,000 steps (200 images) to a dataset |"""


VECTORS = (
    "A vector environment (next-step autoreset) of four random floats and two actions, with episodes of 1,000 steps: "
    "the time of recording an env-step, its bytes, and opening and reading all of them. By hand, in `.npz` and in "
    "`.npy`, a row is a vector step with a mask of the sub-environments that took it; nothing else separates "
    "episodes. `mcap` and foxglove-sdk write a message per env-step. Minari's and PyTupli's recorders refuse a vector "
    "environment; LeRobot and d3rlpy take the steps of one episode at a time."
)


def vectors(found: dict[str, Any]) -> list[str]:
    """A line a contender of what recording a vector environment costs."""
    cells, lines = found["cells"], []
    for name in cells["record"]:
        row = {operation: _cell(operation, name, cells[operation], _Notes()) for operation in cells}
        told = ", ".join(f"{cell} {OPERATIONS[operation].unit}" for operation, cell in row.items())
        lines.append(
            f"record {NUM_ENVS} sub-environments, {name}: {re.sub('<sup>.*?</sup>|<.*?>', '', told)}"
        )
    return lines


PICTURES = (
    "Images and stacks of frames (`FrameStackObservation`), which are stored once each, in both formats of "
    "`image_format`, both exact: pixels in compressed chunks (the default), and PNG. *record* is what a step costs "
    "over the same rollout without a recorder; *read* opens and gives all states, with one thread and with two."
)


def pictures(found: list[dict[str, Any]]) -> str:
    """A row a kind of pictures and a format."""
    lines = [
        "| | format | record<br>µs/step ▼ | size<br>bytes/step ▼ | read<br>steps/s ▲ | read, 2 threads<br>steps/s ▲ |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for row in found:
        form = {"raw": "pixels", "png": "PNG"}[row["form"]]
        values = (figure(row[key]) for key in ("record", "bytes", "read1", "read2"))
        lines.append(f"| {row['what']} | {form} | {' | '.join(values)} |")
    return "\n".join(lines)


def page(results: dict[str, Any]) -> str:
    """Everything."""
    parts = ["# Benchmark", f"`python -m tools.bench` writes this page. {LEGEND}"]
    parts += ["![By number of steps](growth.svg)", f"## Machine\n\n{machine(results)}"]
    for work, found in results["matrix"].items():
        parts.append(f"## {WORKLOADS[work].title}\n\n![{work}]({work}.svg)\n\n{table(found)}")
    if "vectors" in results:
        parts.append(f"## Recording {NUM_ENVS} sub-environments\n\n{VECTORS}\n\n{table(results['vectors'])}")
    if "pictures" in results:
        parts.append(f"## Pixels and PNG\n\n{PICTURES}\n\n{pictures(results['pictures'])}")
    notes = [f"- {name}: {e['note']}" for name, e in results["contenders"].items() if e["note"]]
    parts.append("## Contenders\n\n" + "\n".join(notes))
    parts.append("## Promises\n\n" + targets(results["targets"]))
    if results["failures"]:
        parts.append("## What failed\n\n" + "\n".join(f"- {_short(line)}" for line in results["failures"]))
    return "\n\n".join(parts) + "\n"
