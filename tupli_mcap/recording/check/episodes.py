"""Checks the episodes of a recording: every row belongs to one, and each has a start, consecutive steps and an end."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from mcap.records import Channel

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT, EpisodeEnd, EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.check.report import Findings
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.index import LARGE_SEED, NO_SEED, EpisodeIndex, indexed_seed
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.recover.step_runs import StepFacts, step_facts
from tupli_mcap.spaces.leaves import Leaf


def verify_episodes(recording: Recording, findings: Findings) -> None:
    """Compares the rows of all channels, the records of the episodes and the index with each other."""
    findings.report.episodes = len(recording.index)
    findings.report.steps = recording.n_steps
    if not recording.num_envs:
        return
    checker = _Checker(recording, findings)
    for env, channel in enumerate(recording.file.steps):
        checker.steps(env, channel)
        checker.images(channel)
        checker.bools(channel, recording.layout.step_leaves)
    checker.bools(recording.file.topics.get(FINAL_STATE, 0), recording.layout.final_leaves)
    checker.starts()
    checker.ends()
    checker.finals()
    checker.infos()


class _Checker:
    def __init__(self, recording: Recording, findings: Findings) -> None:
        self._recording = recording
        self._layout: StepLayout = recording.layout
        file = recording.file
        self._store: ChunkStore = file.store
        self._topics: Mapping[str, int] = file.topics
        self._channels: Mapping[int, Channel] = file.contents.channels
        self._index: EpisodeIndex = file.contents.index
        self._findings, self._error = findings, findings.error
        self._rows: Array = recording.index
        self._at = {int(number): i for i, number in enumerate(self._rows["episode"])}

    # ---- steps

    def steps(self, env: int, channel: int) -> None:
        """Checks every row of a step channel against its episode."""
        topic = self._channels[channel].topic
        episodes = self._rows[self._rows["env"] == env]
        episodes = episodes[np.argsort(episodes["first_row"], kind="stable")]
        firsts, lengths = episodes["first_row"].astype(np.int64), episodes["length"].astype(np.int64)
        total = self._store.count(channel)
        expected = np.append(0, (firsts + lengths))
        begins = np.append(firsts, total)
        for i in np.flatnonzero(begins != expected).tolist():
            where, until = int(expected[i]), int(begins[i])
            self._error("rows", f"rows {where} to {until} belong to no episode", channel=topic)
        if (firsts != expected[:-1]).any() or not len(episodes):
            return  # otherwise every later episode would be reported
        sums = np.zeros(len(episodes))
        row = 0
        try:
            for facts in step_facts(self._store, self._layout, channel, 0, total):
                self._batch(facts, row, episodes, firsts, lengths, sums, topic)
                row += len(facts.episode)
        except FormatError as err:
            self._error("rows", str(err), channel=topic)
            return
        self._returns(episodes, sums)

    def _batch(
        self,
        facts: StepFacts,
        row: int,
        episodes: Array,
        firsts: Array,
        lengths: Array,
        sums: Array,
        topic: str,
    ) -> None:
        rows = row + np.arange(len(facts.episode))
        at = np.searchsorted(firsts, rows, side="right") - 1
        known = (at >= 0) & (rows < firsts[at] + lengths[at])
        for i, why in facts.bad.items():
            self._error("rows", f"row {row + i} cannot be decoded: {why}", channel=topic)
            known[i] = False
        steps = rows - np.where(known, firsts[at], 0)
        last = known & (steps == lengths[at] - 1)
        ends = np.where(facts.terminal != 0, TERMINAL, np.where(facts.timeout != 0, TIMEOUT, INTERRUPTED))
        checks = {
            "has the number of another episode": known & (facts.episode != episodes["episode"][at]),
            "has a step that does not follow the one before": known & (facts.step != steps),
            "has a flag that is neither 0 nor 1": (facts.terminal > 1) | (facts.timeout > 1),
            "ends its episode before its last step": known & ~last & ((facts.terminal | facts.timeout) != 0),
            "has flags that differ from the end of its episode": last & (ends != episodes["end"][at]),
        }
        for what, wrong in checks.items():
            for i in np.flatnonzero(wrong)[:3].tolist():
                place: dict[str, Any] = {"channel": topic}
                if known[i]:
                    place.update(episode=int(episodes["episode"][at[i]]), step=int(steps[i]))
                self._error("episode", f"row {row + i} {what}", **place)
        if known.any():
            with np.errstate(invalid="ignore", over="ignore"):
                np.add.at(sums, at[known], facts.reward[known])

    def _returns(self, episodes: Array, sums: Array) -> None:
        with np.errstate(invalid="ignore"):
            close = np.isclose(sums, episodes["return"], rtol=1e-6, atol=1e-6, equal_nan=True)
        for i in np.flatnonzero(~close).tolist():
            listed, total = float(episodes["return"][i]), float(sums[i])
            if not (math.isfinite(listed) and math.isfinite(total)):
                continue  # depends on the order of summation
            why = f"its return is {listed!r}, its rewards sum up to {total!r}"
            self._error("episode", why, episode=int(episodes["episode"][i]))

    def images(self, channel: int) -> None:
        """Checks that image channels have a row for each step, with the right constant bytes and stamp."""
        topics = Topics.of_step(self._channels[channel].topic)
        for leaf in self._layout.images:
            topic = topics.image(leaf.name)
            number = self._topics.get(topic, 0)
            steps, images = self._store.count(channel), self._store.count(number)
            if steps != images:
                self._error("image", f"expected {steps} images, found {images}", channel=topic)
            layout = self._layout.image_messages[leaf.name]
            fixed = np.frombuffer(layout.body[8:], np.uint8)
            try:
                for chunk in self._store.chunks(number):
                    rows = self._store.rows(chunk, layout.dtype, keep=False)
                    time = rows["sec"].astype(np.int64) * 10**9 + rows["nanosec"]
                    if (rows["fixed"] != fixed).any() or (time != rows["#log_time"].astype(np.int64)).any():
                        first = int(self._store.table["first"][chunk])
                        self._error("image", f"a header in rows from {first} on is damaged", channel=topic)
            except FormatError as err:
                self._error("image", str(err), channel=topic)

    def bools(self, channel: int, leaves: Sequence[Leaf]) -> None:
        """Checks the bools in rows of constant size; decoding checks those of other rows."""
        names = [leaf.name for leaf in leaves if leaf.size and self._layout.dtypes.get(leaf.name) == np.bool_]
        if not names or not self._layout.constant:
            return
        step = channel in self._recording.file.steps
        dtype = (self._layout.step_message if step else self._layout.final_message).dtype
        try:
            for chunk in self._store.chunks(channel):
                rows = self._store.rows(chunk, dtype, keep=False)
                first = int(self._store.table["first"][chunk])
                for name in names:
                    wrong = (rows[name].view(np.uint8) > 1).reshape(len(rows), -1).any(axis=1)
                    for i in np.flatnonzero(wrong)[:3].tolist():
                        place = self._channels[channel].topic
                        self._error(
                            "rows",
                            f"row {first + i} has a bool in {name!r} other than 0 and 1",
                            channel=place,
                        )
        except FormatError:
            return  # `steps` has reported it

    # ---- messages of episodes

    def _messages(self, topic: str) -> Iterator[tuple[int, int, memoryview]]:
        """(row, log_time, body) of a channel's messages."""
        try:
            yield from self._store.all_messages(self._topics.get(topic))
        except FormatError as err:
            self._error("rows", str(err), channel=topic)

    def starts(self) -> None:
        """Checks that every episode has one start, in the row that the index names, with the facts in the index."""
        seen: set[int] = set()
        for row, time, body in self._messages(EPISODE_START):
            place: dict[str, Any] = {"channel": EPISODE_START}
            try:
                start = EpisodeStart.decode(body)
                place["episode"] = start.episode
                for text in (start.options or "{}", start.reset_info):
                    jsonvalue.loads(text)
            except FormatError as err:
                self._error("episode", f"row {row} cannot be decoded: {err}", **place)
                continue
            i = self._at.get(start.episode)
            if i is None or int(self._rows["start_row"][i]) != row:
                continue  # a reset without a step
            seen.add(start.episode)
            entry = self._rows[i]
            seed, has_seed = indexed_seed(start.seed_number)
            if not entry["has_seed"] and has_seed == LARGE_SEED:  # earlier writers did not mark such seeds
                has_seed = NO_SEED
            facts = (start.env, start.first_row, time, seed, has_seed)
            index = tuple(int(entry[name]) for name in ("env", "first_row", "start_time", "seed", "has_seed"))
            if facts != index or bytes(body[16:18]) not in (b"\0\0", b"\1\0", b"\0\1", b"\1\1"):
                self._error("episode", f"its start and the index differ: {facts} and {index}", **place)
        for number in sorted(self._at.keys() - seen):
            self._error("episode", "it has no start", episode=number, channel=EPISODE_START)

    def ends(self) -> None:
        """Checks that every episode has one end, with the facts in the index; notes ends whose steps are not there."""
        seen: set[int] = set()
        lost = 0
        for row, time, body in self._messages(EPISODE_END):
            place: dict[str, Any] = {"channel": EPISODE_END}
            try:
                end = EpisodeEnd.decode(body)
                place["episode"] = end.episode
                if not isinstance(jsonvalue.loads(end.metadata), dict):
                    raise FormatError("expected metadata as a JSON object")
            except FormatError as err:
                self._error("episode", f"row {row} cannot be decoded: {err}", **place)
                continue
            i = self._at.get(end.episode)
            if i is None or self._is_ignored(i, end, row):
                lost += 1
                continue
            if end.episode in seen:
                self._error("episode", "it ends twice", **place)
            seen.add(end.episode)
            entry = self._rows[i]
            facts = (end.env, end.first_row, end.length, end.end, end.has_final_state, time, row)
            index = (
                int(entry["env"]), int(entry["first_row"]), int(entry["length"]), int(entry["end"]),
                int(entry["final_row"]) >= 0, int(entry["end_time"]), int(entry["end_row"]),
            )  # fmt: skip
            same = np.float64(end.episode_return).tobytes() == entry["return"].tobytes()
            if facts != index or not same or body[33] > 1:
                self._error("episode", f"its end and the index differ: {facts} and {index}", **place)
            if end.metadata != self._index.metadata_text(i):
                self._error("episode", "its metadata differ between its end and the index", **place)
        for number in sorted(self._at.keys() - seen):
            self._error("episode", "it has no end", episode=number, channel=EPISODE_END)
        self._note_lost("episode", lost, "ends")

    def _is_ignored(self, i: int, end: EpisodeEnd, row: int) -> bool:
        """Whether an end is of more steps than are left of its episode, so that recovery made another one."""
        entry = self._rows[i]
        earlier = row < entry["end_row"] and end.length > entry["length"]
        return bool(earlier and entry["end"] == INTERRUPTED)

    def _note_lost(self, kind: str, lost: int, what: str) -> None:
        """Notes messages that readers ignore, since their steps are not there."""
        if lost and self._recording.complete:
            self._findings.note(
                kind,
                f"{lost} {what} are of steps that are not in the recording",
                f"nothing to be done: a power loss or a lost journal leaves such {what}, and they are never shown",
            )

    def finals(self) -> None:
        """Checks that the final states are those that the index names, and notes those of no episode in it."""
        layout, topic = self._layout, FINAL_STATE
        rows = {int(row["final_row"]): row for row in self._rows if row["final_row"] >= 0}
        constant = all(leaf.kind != "variable" for leaf in layout.final_leaves)
        size = layout.final_message.body_size if constant else 0
        decoder = MessageDecoder(layout)
        lost = 0
        for row, _, body in self._messages(topic):
            number = int.from_bytes(body[:4], "little")
            place = {"channel": topic, "episode": number}
            entry = rows.pop(row, None)
            if entry is None and self._is_of_an_unfinished_step(row, number):
                continue
            if entry is None and number not in self._at:
                lost += 1
                continue
            if (
                entry is None
                or int(entry["episode"]) != number
                or int(entry["env"]) != int.from_bytes(body[4:8], "little")
            ):
                self._error("final_state", f"row {row} is the final state of no episode", **place)
                continue
            if constant and len(body) != size:
                self._error("final_state", f"expected {size} bytes, found {len(body)}", **place)
            elif not constant:
                try:
                    decoder.final(body)
                except FormatError as err:
                    self._error("final_state", f"it cannot be decoded: {err}", **place)
        for entry in rows.values():
            self._error("final_state", "it is missing", episode=int(entry["episode"]), channel=topic)
        self._note_lost("final_state", lost, "final states")

    def _is_of_an_unfinished_step(self, row: int, number: int) -> bool:
        """Whether a final state is of a step that its recorder did not finish, so that it does not count."""
        i = self._at.get(number)
        if i is None:
            return False
        end, final_row = int(self._rows["end"][i]), int(self._rows["final_row"][i])
        return end == INTERRUPTED and not 0 <= final_row <= row

    def infos(self) -> None:
        """Checks that each step has at most one info, and notes infos of steps that are not in the recording."""
        codec = self._recording.file.info_codec
        if codec is None:
            return
        last: dict[int, int] = {}
        lost = 0
        for row, _, body in self._messages(INFO):
            place: dict[str, Any] = {"channel": INFO}
            try:
                number, step, _ = codec.decode(body)
            except FormatError as err:
                self._error("info", f"row {row} cannot be decoded: {err}", **place)
                continue
            place.update(episode=number, step=step)
            i = self._at.get(number)
            if i is None or step >= int(self._rows["length"][i]):
                lost += 1
            elif step <= last.get(number, -1):
                self._error("info", f"row {row} is the second info of its step, or out of order", **place)
            last[number] = step
        self._note_lost("info", lost, "infos")
