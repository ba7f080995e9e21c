"""Recording vector environments: what an env-step costs beside one of a single environment of the same layout."""

from __future__ import annotations

import statistics
from collections.abc import Iterator

from tools.bench.contenders.ours import Ours
from tools.bench.measure import Run, alternate, ratio
from tools.bench.targets import Target, at_most
from tools.bench.vectors import record
from tools.bench.workloads import NUM_ENVS, WORKLOADS, Workload


def record_vector(run: Run) -> Iterator[Target]:
    """64 sub-environments, per env-step, over a single one, episodes of 1,000 and of 22 steps."""
    for name, limit in (("long", 0.3), ("growth", 0.5)):
        yield _compare(run, WORKLOADS[name], limit)


def _compare(run: Run, work: Workload, limit: float) -> Target:
    length = work.length
    steps = max(run.part(400_000) // NUM_ENVS, 2 * length)
    single_steps = run.part(100_000, 2000)
    episodes = -(-single_steps // length)

    def vector() -> float:
        path = run.fresh("vector.mcap")
        value, _ = record(Ours(), path, length, steps)
        path.unlink()
        return value

    def single() -> float:
        path = run.fresh("single.mcap")
        with work.beside() as bare:
            seconds, count = Ours().record(work, path, episodes)
        path.unlink()
        return (seconds - 2 * bare.seconds) / count * 1e6

    alternate({"vector": vector, "single": single}, 1)
    values = alternate({"vector": vector, "single": single}, max(run.rounds, 3))
    mine, other = statistics.median(values["vector"]), statistics.median(values["single"])
    note = f"{mine:.2f} µs of {other:.2f}; {NUM_ENVS} sub-environments"
    what = f"record a vector environment, episodes of {length:,} steps, per env-step over a single one"
    return at_most(what, limit, ratio(values["vector"], values["single"]), note, "x")
