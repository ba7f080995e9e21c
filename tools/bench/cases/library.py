"""Large storages: what adding a recording, a filter and a new catalog cost; and chunks that are copied."""

from __future__ import annotations

import statistics
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from tools.bench.library import add, fill, template
from tools.bench.measure import Run, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_most

EPISODES = 1000  # of each recording
FEW = 10


def library(run: Run) -> Iterator[Target]:
    """Adding a recording to a small and to a large storage, and a filter among all that is in the large one."""
    from tupli_mcap import F, FileStorage

    many = max(run.part(1_000_000) // EPISODES, 2 * FEW)
    data = template(run.fresh("template.mcap"), EPISODES)
    storages = {}
    for recordings in (FEW, many):
        root = run.fresh("storage")
        fill(root, data, recordings)
        storages[recordings] = FileStorage(root)
        storages[recordings].declare_key("metadata.score")
    rebuilt = seconds_of(storages[many].reindex)
    storages[FEW].reindex()

    def ingest(recordings: int) -> float:
        path = storages[recordings].root / "recordings" / f"{uuid.uuid4().hex}.mcap"
        add(path, data)
        begin = time.process_time()  # the disk waits for whom it likes
        storages[recordings].ingest(path)
        return (time.process_time() - begin) * 1e3

    values = alternate({str(n): lambda n=n: ingest(n) for n in storages}, max(run.rounds, 9))
    medians = {n: statistics.median(values[str(n)]) for n in storages}
    note = f"{EPISODES:,} episodes each; {medians[FEW]:.0f} and {medians[many]:.0f} ms of processor time"
    found = ratio(values[str(many)], values[str(FEW)])
    yield at_most(f"add a recording to {many:,}, over adding one to {FEW}", 2.0, found, note, "x")
    large, query = storages[many], F("metadata.score") == 7
    check(len(large.list_episodes(query)) >= many, "episodes are missing")
    times = [seconds_of(lambda: large.list_episodes(query)) * 1e3 for _ in range(max(run.rounds, 9))]
    what = f"FileStorage.list_episodes of {many:,} among {many * EPISODES:,}"
    note = f"all files looked at; making the catalog anew takes {rebuilt:.1f} s"
    yield at_most(what, 50, min(times), note, "ms")
    for storage in storages.values():
        storage.close()


def copying(run: Run) -> Iterator[Target]:
    """Leaving the last episode out: with chunks copied, and with all compressed anew."""
    from tupli_mcap import Recording, rewrite_recording
    from tupli_mcap.wrappers.rollout import record_rollouts

    path, anew = run.fresh("run.mcap"), run.fresh("anew.mcap")
    steps = run.part(1_000_000)
    record_rollouts("MountainCar-v0", path, steps=steps, seed=1)
    with Recording(path) as recording:
        rewrite_recording(recording, anew, compression="lz4")  # nothing of it can be copied as zstd

    def side(source: Path) -> float:
        with Recording(source) as recording:
            numbers = recording.index["episode"][:-1].tolist()
            return seconds_of(lambda: rewrite_recording(recording, run.fresh("out.mcap"), episodes=numbers))

    values = alternate({"copied": lambda: side(path), "anew": lambda: side(anew)}, max(run.rounds, 5))
    note = f"{steps:,} steps; {min(values['copied']):.2f} and {min(values['anew']):.2f} s"
    yield at_most(
        "copy chunks, over compressing anew", 1.0, ratio(values["copied"], values["anew"]), note, "x"
    )
