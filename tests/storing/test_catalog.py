"""The catalog: what goes in comes out, fast, whatever happens to its file."""

from __future__ import annotations

import itertools
import json
import math
import os
import random
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from postgres import Cluster, ServerCatalog
from sqlalchemy import event, true

from tupli_mcap.cache import cache_dir
from tupli_mcap.errors import FilterError, FormatError, NotFoundError, StorageError
from tupli_mcap.jsonvalue import dumps_plain
from tupli_mcap.schema import (
    EpisodeHeader,
    F,
    FilterAND,
    FilterEQ,
    FilterOR,
    bound,
    compile_predicate,
    parse_filter,
)
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.catalog import pages, place
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.database import CatalogDamagedError
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.order import After, Sort
from tupli_mcap.storage.catalog.place import catalog_path
from tupli_mcap.storage.catalog.queries import count_episodes, declared_keys, find_episodes
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.catalog.tables import FLAGGED_KEYS, LAST_EPISODE, RECORDING, TALLY
from tupli_mcap.storage.catalog.tallies import Tally, tallies
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.texts import escape_text, unescape_text

CREATED_NS = 1_795_251_600_000_001_999
STAMP = RecordingStamp(size=10, mtime_ns=20, mixed=30)
TEXTS = st.text() | st.sampled_from(["\x00", "\x01", "\ud7ff", "\ud800", "\udfff", "\ue000", "a\x00\x01"])


def row(episode: int = 0, metadata: Any = None, **changes: Any) -> EpisodeRow:
    base = EpisodeRow(
        episode=episode,
        env=0,
        n_tuples=22,
        end="terminal",
        episode_return=1.5,
        seed=7,
        created_at=CREATED_NS,
        created_by="me",
        published_in='["me"]',
        metadata=metadata if isinstance(metadata, str) else dumps_plain(metadata or {}),
    )
    return base._replace(**changes)


def put(
    catalog: Catalog | ServerCatalog,
    path: str = "a.mcap",
    rows: Any = (),
    uuid: str = "u",
    benchmark_id: str = "b",
    runs: str = "[{}]",
) -> None:
    catalog.put_recording(path, Entry(STAMP, uuid, benchmark_id, rows, runs))


@pytest.fixture
def catalog(tmp_path: Path) -> Iterator[Catalog]:
    with Catalog(tmp_path / "lab" / "catalog.sqlite") as catalog:
        yield catalog


@pytest.fixture(params=["sqlite", "postgresql"])
def any_catalog(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Catalog | ServerCatalog]:
    """A catalog in a file, and one in a server's database."""
    if request.param == "sqlite":
        with Catalog(tmp_path / "catalog.sqlite") as catalog:
            yield catalog
        return
    postgres: Cluster = request.getfixturevalue("postgres")
    with postgres.database() as url, ServerCatalog(url) as of_server:
        yield of_server


class TestRows:
    def test_a_row_comes_back_as_a_header(self, catalog: Catalog) -> None:
        metadata = {
            "score": 0.1,
            "nan": math.inf,
            "name": "größe\x00",
            "tags": ["a", {"$x": 1}],
            "none": None,
        }
        put(
            catalog,
            "runs/ä.mcap",
            [row(3, metadata, end="timeout", env=2)],
            uuid="f" * 32,
            benchmark_id="b",
        )
        (header,) = catalog.episodes()
        assert header == EpisodeHeader(
            id="f" * 32 + "-3",
            created_by="me",
            published_in=["me"],
            created_at="2026-11-21T09:00:00.000001+00:00",
            benchmark_id="b",
            metadata=metadata,
            n_tuples=22,
            terminated=False,
            timeout=True,
            end="timeout",
            episode_return=1.5,
            seed=7,
            env=2,
            episode=3,
            recording="runs/ä.mcap",
        )
        assert EpisodeHeader.model_validate(header.model_dump()) == header

    @pytest.mark.parametrize("seed", [None, 0, 2**63 - 1, 2**63, -(2**63) - 1, 2**128 + 1])
    def test_seeds_of_any_size(self, catalog: Catalog, seed: int | None) -> None:
        put(catalog, rows=[row(seed=seed)])
        assert catalog.episodes()[0].seed == seed
        assert catalog.count(F("seed") == seed) == 1

    @pytest.mark.parametrize("value", [None, 0.1, math.nan, math.inf, -math.inf, 1e308])
    def test_returns_of_any_kind(self, catalog: Catalog, value: float | None) -> None:
        put(catalog, rows=[row(episode_return=value)])
        assert repr(catalog.episodes()[0].episode_return) == repr(value)

    def test_headers_do_not_share_values(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0), row(1)])
        first, second = catalog.episodes()
        first.published_in.append("global")
        assert second.published_in == ["me"]

    @pytest.mark.parametrize(
        ("metadata", "message"),
        [
            ("[1]", "expected the metadata of an episode to be a JSON object, found '\\[1\\]'"),
            ("{", "expected JSON"),
            ('{"a": NaN}', "expected strict JSON, found NaN"),
            ('{"a": {"$b": 1}}', "expected one known tag"),
            ('{"a": ' + "[" * 64 + "]" * 64 + "}", "levels of nesting"),
            ('{"a": ' + "[" * 5000 + "]" * 5000 + "}", "levels of nesting"),
        ],
    )
    def test_bad_metadata_is_refused_and_changes_nothing(
        self, catalog: Catalog, metadata: str, message: str
    ) -> None:
        put(catalog, rows=[row(0)])
        with pytest.raises(FormatError, match=message):
            put(catalog, rows=[row(0), row(1, metadata)])
        assert catalog.count() == 1

    def test_a_key_twice_is_the_last_one_everywhere(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0, '{"a": 1, "a": 2}')])
        assert catalog.episodes(F("metadata.a") == 2)[0].metadata == {"a": 2}

    def test_an_episode_number_twice_or_too_large(self, catalog: Catalog) -> None:
        with pytest.raises(StorageError, match="UNIQUE constraint failed"):
            put(catalog, rows=[row(1), row(1)])
        with pytest.raises(FormatError, match=r"episode number below 2\*\*32, found 4294967296"):
            put(catalog, rows=[row(2**32)])
        assert catalog.recordings() == {}

    @given(TEXTS, TEXTS)
    def test_escaped_texts_sort_as_they_did(self, left: str, right: str) -> None:
        assert unescape_text(escape_text(left)) == left
        assert (escape_text(left).encode() < escape_text(right).encode()) == (left < right)
        assert "\x00" not in escape_text(left)


class TestRecordings:
    def test_put_replace_remove(self, catalog: Catalog) -> None:
        put(catalog, "b.mcap", [row(0), row(1)], uuid="1")
        put(catalog, "a.mcap", [row(5)], uuid="2")
        put(catalog, "b.mcap", [row(1), row(0), row(2)], uuid="3")
        put(catalog, "odd\udcff\x01.mcap", [], uuid="4")
        assert catalog.recordings() == {"a.mcap": STAMP, "b.mcap": STAMP, "odd\udcff\x01.mcap": STAMP}
        assert [h.id for h in catalog.episodes()] == ["2-5", "3-0", "3-1", "3-2"]
        catalog.remove_recording("b.mcap")
        catalog.remove_recording("missing.mcap")
        assert [h.id for h in catalog.episodes()] == ["2-5"]
        assert sorted(catalog.recordings()) == ["a.mcap", "odd\udcff\x01.mcap"]

    def test_pages(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(n, {"n": n}) for n in range(10)])
        wanted = F("metadata.n") > 2
        pages = [catalog.episodes(wanted, limit=3, offset=offset) for offset in (0, 3, 6)]
        assert [[h.episode for h in page] for page in pages] == [[3, 4, 5], [6, 7, 8], [9]]
        assert len(catalog.episodes(wanted, offset=5)) == 2
        assert [h.episode for h in catalog.episodes(limit=2)] == [0, 1]

    def test_a_failing_source_changes_nothing(self, catalog: Catalog) -> None:
        def failing() -> Iterator[EpisodeRow]:
            yield from (row(n) for n in range(50_000))
            raise OSError("the disk is gone")

        put(catalog, rows=[row(0)])
        with pytest.raises(OSError, match="the disk is gone"):
            put(catalog, rows=failing())
        assert catalog.count() == 1

    def test_by_id(self, catalog: Catalog) -> None:
        put(catalog, "a.mcap", [row(n) for n in range(20)], uuid="a-b")
        put(catalog, "b.mcap", [row(n) for n in range(20)], uuid="c")
        assert [h.id for h in catalog.episodes(F("id") == "a-b-7")] == ["a-b-7"]
        assert [h.id for h in catalog.episodes(F("id").isin(["c-1", "a-b-2", "c-99", "x"]))] == [
            "a-b-2",
            "c-1",
        ]
        beyond = f"a-b-{2**32 + 7}"  # its row would be that of c-7
        for unknown in ("c-07", "c--7", "c-7 ", "c-", "-7", "", "c-" + "9" * 5000, "c-٧", beyond):
            assert catalog.count(F("id") == unknown) == 0
            assert catalog.count(F("id") != unknown) == 40
        assert "SEARCH episode USING INTEGER PRIMARY KEY" in catalog.explain(F("id") == "a-b-7")


def put_in_order(
    found: Iterable[EpisodeHeader], key: str, descending: bool, declared: bool
) -> list[EpisodeHeader]:
    """Numbers, then texts, each in order; then what has neither, or cannot be looked into without a declared key."""
    ordered = sorted(found, key=lambda header: (header.recording, header.episode))

    def value(header: EpisodeHeader) -> Any:
        names = {"return": "episode_return", "steps": "n_tuples", "ended": "created_at"}
        if key == "metadata.score":
            return header.metadata.get("score")
        return getattr(header, names.get(key, key)) if key else 0

    numbers = [h for h in ordered if isinstance(value(h), int | float) and not math.isnan(value(h))]
    texts = [h for h in ordered if isinstance(value(h), str) and (declared or "\x00" not in value(h))]
    rest = [h for h in ordered if h not in numbers and h not in texts]
    return [*(h for part in (numbers, texts) for h in sorted(part, key=value, reverse=descending)), *rest]


class TestOrder:
    @pytest.fixture
    def mixed(self, any_catalog: Catalog | ServerCatalog) -> Catalog | ServerCatalog:
        rng = random.Random(0)
        values = [3, 3.5, -1, True, None, "a", "b", [1], math.nan, 2**70, "a\x00", 0]
        flags = [True, False, 0, 1.0, 2, None, "yes"]
        for path in ("b.mcap", "a.mcap"):
            rows = [
                row(
                    i,
                    {"score": rng.choice(values), "success": rng.choice(flags)} if rng.random() < 0.8 else {},
                    episode_return=rng.choice([1.0, -2.0, math.inf, math.nan, None]),
                    n_tuples=rng.randrange(1, 4),
                    seed=rng.choice([None, 5, 2**127]),
                    created_at=CREATED_NS + rng.randrange(5) * 10**9,
                )
                for i in range(40)
            ]
            put(any_catalog, path, rows, uuid=path, runs=json.dumps([{"name": f"run 1% {path}"}]))
        return any_catalog

    @pytest.mark.sampled(2)
    @pytest.mark.parametrize("text", ["", "steps > 1", "metadata.score != 3"])
    def test_pages_forth_and_back_are_the_whole(self, mixed: Catalog | ServerCatalog, text: str) -> None:
        wanted = parse_filter(text) if text else None
        keys = ("return", "steps", "success", "ended", "seed", "end", "recording", "metadata.score", "")
        for key, descending in itertools.product(keys, (False, True)):
            self.check_pages(mixed, wanted, key, descending)

    def check_pages(
        self,
        mixed: Catalog | ServerCatalog,
        wanted: Any,
        key: str,
        descending: bool,
        limit: int = 15,
        declared: bool = False,
    ) -> None:
        sort = Sort(key, descending) if key else None
        with mixed._read() as connection:
            whole = [header.id for header in find_episodes(connection, wanted, sort=sort)]
            expected = put_in_order(find_episodes(connection, wanted), key, descending, declared)
            assert whole == [header.id for header in expected]
            for backwards in (False, True):
                after, paged = None, []
                while page := list(
                    find_episodes(
                        connection, wanted, limit=limit, sort=sort, after=after, backwards=backwards
                    )
                ):
                    paged += [header.id for header in page]
                    after = After(page[-1].recording, page[-1].episode)
                assert paged == (whole[::-1] if backwards else whole)

    @pytest.mark.sampled(
        0,
        keep=[
            "sqlite-0-1000-'return'-True",
            "postgresql-5-8-'metadata.score'-True",
            "sqlite-5-1000-'metadata.score'-True",
            "postgresql-1000-1000-''-False",
        ],
    )
    @pytest.mark.parametrize(
        ("key", "descending"), [("", False), ("return", True), ("metadata.score", True)], ids=repr
    )
    @pytest.mark.parametrize(("few", "scanned"), [(0, 1000), (5, 8), (5, 1000), (1000, 1000)])
    def test_each_way_to_a_page_leads_to_the_same_episodes(
        self,
        mixed: Catalog | ServerCatalog,
        monkeypatch: pytest.MonkeyPatch,
        few: int,
        scanned: int,
        key: str,
        descending: bool,
    ) -> None:
        """By an index that names few, or few in some recordings; through the next episodes; by several indexes; by
        nothing of the kind."""
        for name, value in {
            "_FEW": few,
            "_SCANNED": scanned,
            "_NEAR": 9,
            "_MOST": 50,
            "_RECORDINGS": 1,
        }.items():
            monkeypatch.setattr(pages, name, value)
        mixed.declare_key("metadata.score")
        score, time = F("metadata.score"), F("created_at")
        second = CREATED_NS // 1000 * 1000 + 10**9
        for wanted in (
            None,
            (score > 0) & (F("steps") > 1),
            (score >= 0) & (score < 3.2) & (F("return") == 1),
            (score == "a") | (score == 3),
            score.isin([3, "b", None, 2**70]) & (F("steps").isin([1, 3])),
            (score < "b") & ((F("steps") >= 2) & (F("steps") < 3)),
            ~(score == 3) & (F("return") < 0),
            score > 10**400,
            (time >= second) & (time < second + 2 * 10**9) & (F("recording") != "a.mcap"),
            (time == second) | (time > second + 3 * 10**9),
            (F("run.name") == "run 1% a.mcap") & (F("benchmark_id") == "b"),
            (F("recording") == "a.mcap") & (F("steps") > 0),
            F("run.name").isin(["run 1% b.mcap", "run"]) & (score == 3),
            F("run.name") == "run _% a.mcap",
        ):
            self.check_pages(mixed, wanted, key, descending, declared=True)

    @pytest.mark.parametrize(
        ("key", "index"),
        [
            ("return", "ix_episode_episode_return"),
            ("steps", "ix_episode_n_tuples"),
            ("metadata.score", "ix_value"),
        ],
    )
    def test_a_sorted_page_walks_an_index(
        self, catalog: Catalog, monkeypatch: pytest.MonkeyPatch, key: str, index: str
    ) -> None:
        monkeypatch.setattr(pages, "_FEW", 0)
        put(catalog, "a.mcap", [row(i, {"score": i}, episode_return=float(i)) for i in range(500)])
        catalog.declare_key("metadata.score")
        with catalog._read() as connection:
            asked: list[tuple[str, Any]] = []
            event.listen(connection, "before_cursor_execute", lambda *told: asked.append(told[2:4]))
            assert next(find_episodes(connection, None, sort=Sort(key, True), limit=1)).n_tuples > 0
            plans = [
                " ".join(step[-1] for step in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}", values))
                for sql, values in list(asked)
                if "ORDER BY" in sql
            ]
        assert any(index in plan and "FOR ORDER BY" not in plan for plan in plans), plans

    @pytest.mark.parametrize(
        ("after", "backwards", "seen"), [(None, False, range(10)), (20, True, range(10, 20))]
    )
    def test_only_the_next_episodes_are_looked_at(
        self,
        catalog: Catalog,
        monkeypatch: pytest.MonkeyPatch,
        after: int | None,
        backwards: bool,
        seen: range,
    ) -> None:
        monkeypatch.setattr(pages, "_NEAR", 10)
        put(catalog, "a.mcap", [row(i, {"n": i}) for i in range(40)])
        for first in (0, 5, 15, 30):
            wanted = bound(F("metadata.n") >= first, EpisodeHeader)
            reached = None if after is None else After("a.mcap", after)
            asked = pages.Asked(wanted, {}, true(), true(), after=reached, backwards=backwards)
            with catalog._read() as connection:
                ((ids, left),) = pages.candidates(connection, asked, 5)
                found = {row_id & LAST_EPISODE for row_id in ids}
            assert found == {i for i in seen if i >= first}
            assert left.most <= 0

    def test_recordings_of_few_episodes_are_asked_about_together(
        self, any_catalog: Catalog | ServerCatalog, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(pages, "_RECORDINGS", 20)
        paths = [f"{number:03}.mcap" for number in range(50)]
        for path in reversed(paths):
            put(any_catalog, path, [row(i, {"n": i}) for i in range(2)], uuid=path)
        put(any_catalog, "020a.mcap", [row(i, {"n": i}) for i in range(1200)], uuid="a")
        for wanted in (None, F("metadata.n") == 1, F("recording") >= "1"):
            self.check_pages(any_catalog, wanted, "", False, 90)

    def test_a_page_after_what_is_gone(self, mixed: Catalog | ServerCatalog) -> None:
        gone = After("a.mcap", 99)
        with mixed._read() as connection:
            assert next(find_episodes(connection, None, after=gone)).id == "b.mcap-0"
            assert next(find_episodes(connection, None, after=gone, backwards=True)).id == "a.mcap-39"
            with pytest.raises(NotFoundError, match="is gone; list from the beginning"):
                find_episodes(connection, None, after=gone, sort=Sort("return"))

    def test_a_text_that_looks_like_a_number_hides_nothing(
        self, any_catalog: Catalog | ServerCatalog
    ) -> None:
        """Only numbers that a database may not hold do: what is beside them comes last."""
        texts = ["3e1234", "ab3e123", "sha1:00e999", 'a "3e400', 1e-300, [1, -2.5e300], {"a\\": 1e301}]
        put(any_catalog, "a.mcap", [row(i, {"x": x, "score": i}) for i, x in enumerate(texts)])
        for descending, expected in ((False, [0, 1, 2, 3, 4, 5, 6]), (True, [3, 2, 1, 0, 4, 5, 6])):
            with any_catalog._read() as connection:
                found = list(find_episodes(connection, None, sort=Sort("metadata.score", descending)))
            assert [header.episode for header in found] == expected

    @pytest.mark.parametrize("key", ["run.name", "metadata", "published_in", 'metadata."a\\"b"', "nope"])
    def test_keys_that_have_no_order(self, mixed: Catalog | ServerCatalog, key: str) -> None:
        with (
            mixed._read() as connection,
            pytest.raises(FilterError, match="cannot sort by|unknown key"),
        ):
            find_episodes(connection, None, sort=Sort(key))

    def test_counting_stops(self, mixed: Catalog | ServerCatalog) -> None:
        with mixed._read() as connection:
            assert count_episodes(connection, None, most=7) == 7
            assert count_episodes(connection, parse_filter("metadata.score != 3"), most=7) == 7
            assert count_episodes(connection, None, most=1000) == 80


class TestTallies:
    def test_they_are_what_the_episodes_say(self, catalog: Catalog) -> None:
        rows = [
            row(0, {"success": True}, episode_return=1.0, n_tuples=2),
            row(1, {"is_success": False}, episode_return=-3.0, created_at=CREATED_NS + 10**9),
            row(2, {"success": "yes"}, episode_return=math.nan),
            row(3, published_in='["me", "all"]', episode_return=None),
        ]
        runs = '[{"name": "r", "environment": "Cart-v1"}]'
        catalog.put_recording("a.mcap", Entry(STAMP, "u", "", rows, runs))
        put(catalog, "empty.mcap")
        with catalog._read() as connection:
            (told,) = tallies(connection)
            (seen,) = tallies(connection, TALLY.c.published_in == '["me", "all"]')
            assert list(tallies(connection, of=RECORDING.c.environment == "Hopper-v5")) == []
        assert told == Tally(
            "a.mcap", "u", "", "Cart-v1", "me", 10, 30, [{"name": "r", "environment": "Cart-v1"}],
            4, 68, 2, -2.0, -3.0, 1.0, 2, 1, CREATED_NS // 1000 * 1000, (CREATED_NS + 10**9) // 1000 * 1000,
        )  # fmt: skip
        assert (seen.episodes, seen.returns, seen.return_sum, seen.size) == (1, 0, None, None)
        catalog.remove_recording("a.mcap")
        with catalog._read() as connection:
            assert list(tallies(connection)) == []


class TestDeclaredKeys:
    def test_an_index_is_used(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0, {"score": 1, "name": "x"})])
        wanted = [
            F("metadata.score") > 0.5,
            F("metadata.score") <= 1,
            F("metadata.score") == 1,
            F("metadata.score") == "text",
            F("metadata.score").isin([1, 2, "a"]),
            (F("metadata.score") > 0) & (F("metadata.name") == "x") & (F("benchmark_id") == "b"),
        ]
        index = "USING COVERING INDEX ix_value (key=?"
        for part in wanted:
            assert index not in catalog.explain(part)
        catalog.declare_key("metadata.score")
        for part in wanted:
            assert index in catalog.explain(part), part
        catalog.declare_key("metadata.name")
        either = (F("metadata.score") == 1) | (F("metadata.name") == "x")
        assert "MULTI-INDEX OR" in catalog.explain(either)
        for key in ("n_tuples", "episode_return", "seed", "created_by"):
            catalog.declare_key(key)
            plan = catalog.explain(F(key) > ("x" if key == "created_by" else 100))
            assert index in plan
            assert "compared exactly" not in plan
            if key != "created_by":
                assert ("compared exactly" in catalog.explain(F(key) > 2**60)) == (key != "n_tuples")

    def test_they_are_floats_and_texts(self, catalog: Catalog) -> None:
        values = [
            1,
            1.5,
            "1\x00",
            True,
            None,
            math.nan,
            -math.inf,
            [1],
            {"x": 1},
            2**63 + 1,
            10**300,
            -(2**1024 - 1),
        ]
        rows = [row(n, {"a b": {"ü": value}}) for n, value in enumerate(values)]
        put(catalog, "before.mcap", rows=[*rows, row(len(values), {})])
        catalog.declare_key('metadata."a b".ü')
        catalog.declare_key("episode_return")
        put(catalog, "after.mcap", rows=[*rows, row(len(values), {})])
        with sqlite3.connect(catalog.path) as connection:
            found = connection.execute(
                "SELECT number, text FROM value WHERE key = 0 ORDER BY 1, 2"
            ).fetchall()
            (returns,) = connection.execute("SELECT count(*) FROM value WHERE key = 1").fetchone()
        connection.close()
        numbers = [*[-math.inf] * 4, 1, 1, 1, 1, 1.5, 1.5, 2.0**63, 2.0**63, 1e300, 1e300]
        assert found == [
            *[(None, None)] * 8,
            *[(None, "1\x01\x01")] * 2,
            *((number, None) for number in numbers),
        ]
        assert returns == 2 * len(rows) + 2
        catalog.remove_recording("after.mcap")
        with sqlite3.connect(catalog.path) as connection:
            assert connection.execute("SELECT count(*) FROM value").fetchone() == (2 * len(rows) + 1,)
        connection.close()

    def test_flags_are_with_the_values_of_each_key(self, any_catalog: Catalog | ServerCatalog) -> None:
        """Also for keys that are declared later, and for those that have no place among the flags."""
        values: list[Any] = [True, False, 1, 0, None, "x", [True], [False], {"x": True}, math.nan]
        rows = [row(n, {"score": n, "good": value, "late": value}) for n, value in enumerate(values)]
        put(any_catalog, "before.mcap", [*rows, row(len(values), {"score": len(values)})])
        keys = ["score", "good", *(f"k{n}" for n in range(FLAGGED_KEYS)), "late"]
        for key in keys:
            any_catalog.declare_key(f"metadata.{key}")
        put(any_catalog, "after.mcap", rows)
        score = F("metadata.score")
        for name in ("good", "late"):
            key = F(f"metadata.{name}")
            true, false = FilterEQ(key=key.key, value=True), FilterEQ(key=key.key, value=False)
            for flag in (true, false, true & false, key == 1, key.isin([True, False]), key.isin([True, "x"])):
                for wanted in (flag, flag & (score < 9), flag & (score >= 1) & (score < 7), ~flag):
                    matches = compile_predicate(wanted, EpisodeHeader)
                    expected = [header.id for header in any_catalog.episodes() if matches(header)]
                    assert any_catalog.count(wanted) == len(expected), wanted
                    assert [h.id for h in any_catalog.episodes(wanted, limit=100)] == expected, wanted

    def test_an_index_rules_out_what_is_never_together(self, catalog: Catalog) -> None:
        catalog.declare_key("metadata.score")
        catalog.declare_key("metadata.good")
        put(catalog, rows=[row(n, {"score": n, "good": n >= 50}) for n in range(100)])
        wanted = FilterEQ(key="metadata.good", value=True) & (F("metadata.score") < 50)
        asked: list[str] = []
        with catalog._read() as connection:
            event.listen(connection, "before_cursor_execute", lambda *told: asked.append(told[2]))
            assert list(find_episodes(connection, wanted, limit=10)) == []
        assert [sql for sql in asked if "flags" in sql] == [sql for sql in asked if "count" in sql]
        assert len(asked) == 2, asked  # the declared keys, and how many the index finds

    def test_they_last(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0, {"score": 1})])
        for _ in range(2):
            catalog.declare_key("metadata.score")
            catalog.declare_key("metadata.x.y")
        with Catalog(catalog.path) as again:
            assert again.ask(declared_keys) == ["metadata.score", "metadata.x.y"]
            assert "ix_value" in again.explain(F("metadata.score") == 1)
            again.declare_key("benchmark_id")  # indexed as it is
            assert again.count(F("benchmark_id") == "b") == 1
        assert catalog.ask(declared_keys)[-1] == "benchmark_id"

    @pytest.mark.parametrize(
        ("key", "message"),
        [
            ("score", "unknown key 'score' .your own: metadata.score"),
            ("metadata", "cannot be declared: name one in it, such as metadata.score"),
            ("metadata..x", "needs a name at character 9"),
        ],
    )
    def test_keys_that_cannot_be_declared(self, catalog: Catalog, key: str, message: str) -> None:
        with pytest.raises(FilterError, match=message):
            catalog.declare_key(key)
        assert catalog.ask(declared_keys) == []

    @settings(max_examples=60, deadline=None)
    @given(st.text(max_size=6))
    def test_any_name_is_found(self, name: str) -> None:
        wanted = F("metadata", name) == 3
        with Catalog(None) as catalog:
            put(catalog, rows=[row(0, {name: 3}), row(1, {name + "x": 3})])
            assert catalog.count(wanted) == 1
            catalog.declare_key(F("metadata", name).key)
            assert catalog.ask(declared_keys) == [F("metadata", name).key]
            assert "ix_value" in catalog.explain(wanted)
            assert catalog.count(wanted) == 1

    def test_few_among_many_come_by_the_index(self, catalog: Catalog) -> None:
        chance = random.Random(1)
        rows = [row(n, {"score": chance.random(), "n": n, "name": f"run-{n % 7}"}) for n in range(20_000)]
        catalog.declare_key("metadata.score")
        put(catalog, rows=rows)
        wanted = (F("metadata.score") > 0.5) & (F("metadata.score") < 0.55)
        expected = sum(0.5 < json.loads(r.metadata)["score"] < 0.55 for r in rows)
        assert len(catalog.episodes(wanted)) == expected
        assert "ix_value (key=? AND number>? AND number<?)" in catalog.explain(wanted)


class TestLargeFilters:
    def test_many_values(self, any_catalog: Catalog | ServerCatalog) -> None:
        put(any_catalog, rows=[row(n, {"name": f"{n}", "n": n, "f": n + 0.5}) for n in range(50)])
        for count in (60, 600, 40_000):
            assert any_catalog.count(F("metadata.name").isin([f"{n}" for n in range(count)])) == 50
            assert any_catalog.count(F("metadata.n").isin(range(10, count))) == 40
            assert any_catalog.count(F("metadata.f").isin([n + 0.5 for n in range(10, count)])) == 40
            assert any_catalog.count(F("benchmark_id").isin([f"{n}" for n in range(count)] + ["b"])) == 50
            assert any_catalog.count(F("episode").isin(range(10, count))) == 40
            assert any_catalog.count(F("episode_return").isin([n + 0.5 for n in range(count)])) == 50
            assert any_catalog.count(F("seed").isin([None, 2**70, *range(count)])) == 50
            assert any_catalog.count(F("id").isin([f"u-{n}" for n in range(10, count)])) == 40

    def test_many_parts(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(n, {"n": n}) for n in range(50)])
        parts = [F(f"metadata.n{i}") == i for i in range(1500)]
        assert catalog.count(FilterOR(filters=[*parts, F("metadata.n") > 39])) == 10
        assert catalog.count(FilterOR(filters=[F("benchmark_id") == f"{i}" for i in range(3000)])) == 0
        assert catalog.count(~FilterOR(filters=parts)) == 50
        assert catalog.count(FilterOR(filters=[*parts, F("episode") < 3, F("benchmark_id") == "x"])) == 3
        assert catalog.count(FilterAND(filters=[F("metadata.n") > i for i in range(-1500, 40)])) == 10

    def test_what_is_left_to_python(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(n, {"n": n}, created_by=f"{n}") for n in range(50)])
        others = FilterAND(filters=[F("created_by") != f"{n}" for n in range(40)])
        assert "compared exactly" not in catalog.explain(others)
        many = FilterAND(filters=[F("created_by") != f"{n}" for n in range(1000)])
        assert "compared exactly" in catalog.explain(many)
        assert [catalog.count(others), catalog.count(many), catalog.count(~many)] == [10, 0, 50]
        page = catalog.episodes(F("metadata.n") >= 20, limit=5, offset=3)
        assert [header.episode for header in page] == [23, 24, 25, 26, 27]
        assert catalog.episodes(F("metadata.n") >= 20, offset=2**63 - 1, limit=2**63 - 1) == []


class TestFile:
    def test_it_is_a_wal_database(self, catalog: Catalog) -> None:
        with sqlite3.connect(catalog.path) as connection:
            assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        connection.close()

    @pytest.mark.parametrize("content", [b"", b"no database", b"SQLite format 3\x00" + b"\xff" * 5000])
    def test_what_is_no_catalog_is_replaced(self, tmp_path: Path, content: bytes) -> None:
        path = tmp_path / "catalog.sqlite"
        path.write_bytes(content)
        with Catalog(path) as catalog:
            put(catalog, rows=[row(0)])
            assert catalog.count() == 1

    @pytest.mark.parametrize(
        "change", ["PRAGMA user_version = 99", "PRAGMA application_id = 1", "DROP TABLE declared"]
    )
    def test_another_version_is_replaced(self, tmp_path: Path, change: str) -> None:
        path = tmp_path / "catalog.sqlite"
        with Catalog(path) as catalog:
            put(catalog, rows=[row(0)])
        with sqlite3.connect(path) as connection:
            connection.execute(change)
        connection.close()
        with Catalog(path) as catalog:
            assert catalog.recordings() == {}
            put(catalog, rows=[row(0)])
        with Catalog(path) as catalog:
            assert catalog.count() == 1

    def test_a_new_file_is_told_from_the_old_one(self, catalog: Catalog) -> None:
        found = set()
        for _ in range(20):  # a file system may give a new file the number of one that nobody has open
            assert catalog.recordings() == {}
            found.add(catalog.identity)
            catalog.path.unlink()
            assert not catalog.is_current()
        assert len(found) == 20

    def test_damage_inside_is_said_and_reset_repairs(self, tmp_path: Path) -> None:
        path = tmp_path / "catalog.sqlite"
        with Catalog(path) as catalog:
            put(catalog, rows=[row(n) for n in range(1000)])
        content = bytearray(path.read_bytes())
        content[4096 * 8 :] = b"\xa5" * (len(content) - 4096 * 8)
        path.write_bytes(content)
        with Catalog(path) as catalog:
            with pytest.raises(CatalogDamagedError, match=r"is damaged .* delete it"):
                catalog.episodes()
            catalog.reset()
            assert catalog.recordings() == {}
            put(catalog, rows=[row(0)])
            assert catalog.count() == 1

    def test_deleted_while_open(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0)])
        for path in list(catalog.path.parent.iterdir()):
            path.unlink()
        assert catalog.recordings() == {}
        put(catalog, rows=[row(0)])
        with Catalog(catalog.path) as again:
            assert again.count() == 1

    def test_an_impossible_place(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(StorageError, match="cannot be used"):
            Catalog(tmp_path / "file" / "catalog.sqlite")

    def test_closed(self, catalog: Catalog) -> None:
        catalog.close()
        catalog.close()
        with pytest.raises(StorageError, match="is closed"):
            catalog.episodes()

    @pytest.mark.parametrize(
        "change",
        [
            "CREATE TRIGGER t AFTER INSERT ON episode BEGIN UPDATE episode SET n_tuples = 7; END",
            "CREATE VIEW v AS SELECT 1",
            "CREATE TABLE more (x)",
            "CREATE INDEX ix_more ON episode (end)",
            "ALTER TABLE episode ADD COLUMN more",
            "DROP INDEX ix_recording_uuid",
            "DROP INDEX ix_value",
        ],
    )
    def test_a_schema_that_is_not_exactly_ours_is_thrown_away(self, tmp_path: Path, change: str) -> None:
        path = tmp_path / "catalog.sqlite"
        for expected in (0, 1):  # once more without the change: declared keys are part of the schema
            with Catalog(path) as catalog:
                assert len(catalog.recordings()) == expected
                put(catalog, rows=[row(0)])
                for key in ("metadata.score", "end", "benchmark_id", "created_at"):
                    catalog.declare_key(key)
        with sqlite3.connect(path) as connection:
            connection.execute(change)
        connection.close()
        with Catalog(path) as catalog:
            assert catalog.recordings() == {}
            put(catalog, rows=[row(0)])
            assert [header.n_tuples for header in catalog.episodes()] == [22]

    @pytest.mark.parametrize("kind", ["a link", "a journal beside it", "open to others", "a linked log"])
    def test_a_file_that_may_be_somebody_elses_is_not_opened(self, tmp_path: Path, kind: str) -> None:
        directory = tmp_path / "mine"
        path, elsewhere = directory / "catalog.sqlite", tmp_path / "elsewhere"
        with Catalog(path) as catalog:
            put(catalog, rows=[row(0)])
        elsewhere.write_bytes(path.read_bytes())
        if kind == "a link":
            path.unlink()
            path.symlink_to(elsewhere)
        elif kind == "a journal beside it":
            path.with_name("catalog.sqlite-journal").write_bytes(b"")
        elif kind == "open to others":
            path.chmod(0o666)
        else:
            path.with_name("catalog.sqlite-wal").symlink_to(elsewhere)
        content = elsewhere.read_bytes()
        with Catalog(path) as catalog:
            assert catalog.recordings() == {}
        assert elsewhere.read_bytes() == content
        assert {file.name for file in directory.iterdir() if file.suffix != ".lock"} == {"catalog.sqlite"}

    def test_a_catalog_is_private(self, tmp_path: Path) -> None:
        mask = os.umask(0)
        try:
            with Catalog(tmp_path / "a" / "b" / "catalog.sqlite") as catalog:
                put(catalog, rows=[row(0)])
                found = [(tmp_path / "a"), *(tmp_path / "a").rglob("*")]
                modes = {path.name: path.stat().st_mode & 0o777 for path in found if path.suffix != ".lock"}
        finally:
            os.umask(mask)
        assert modes == {"a": 0o700, "b": 0o700} | {
            f"catalog.sqlite{end}": 0o600 for end in ("", "-wal", "-shm")
        }


class TestInMemory:
    def test_it_has_no_file(self) -> None:
        with Catalog(None) as catalog:
            put(catalog, rows=[row(0)])
            assert catalog.path is None
            first = catalog.identity
            assert catalog.is_current()
            catalog.reset()
            assert not catalog.is_current()
            assert catalog.recordings() == {}
            assert catalog.identity != first
        with pytest.raises(StorageError, match="is closed"):
            catalog.episodes()

    def test_what_fails_at_first_leaves_it_usable(self) -> None:
        with Catalog(None) as catalog:
            with pytest.raises(StorageError, match="UNIQUE constraint failed"):
                put(catalog, rows=[row(1), row(1)])
            assert catalog.recordings() == {}


class TestPlace:
    def test_each_storage_has_its_own(self, tmp_path: Path) -> None:
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
        (tmp_path / "link").symlink_to(tmp_path / "one")
        one, two, link = (catalog_path(tmp_path / name) for name in ("one", "two", "link"))
        assert one is not None
        assert one == link != two
        assert one.is_relative_to(cache_dir() / "catalogs")
        (tmp_path / "two").rename(tmp_path / "one" / "moved")
        assert catalog_path(tmp_path / "one" / "moved") not in (one, two)

    def test_it_is_private_or_none(self, tmp_path: Path) -> None:
        catalog_path(tmp_path)
        assert (cache_dir() / "catalogs").stat().st_mode & 0o777 == 0o700
        cache_dir().chmod(0o777)
        with pytest.raises(PermissionError, match="others may write there"):
            catalog_path(tmp_path)

    @pytest.mark.parametrize(
        ("kind", "is_local"),
        [
            ("ext4", True),
            ("nfs4", False),
            ("cifs", False),
            ("fuse.sshfs", False),
            ("fuse.fuse-overlayfs", True),
        ],
    )
    def test_not_on_a_network(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, is_local: bool
    ) -> None:
        cache = tmp_path / "my home" / "cache"
        monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", str(cache))
        mounts = tmp_path / "mounts"
        other = "nfs4" if is_local else "ext4"
        point = str(cache.parent).replace(" ", "\\040")
        mounts.write_text(f"x / {other} rw 0 0\ny {point} {kind} rw 0 0\nz {point}x {other} rw 0 0\n")
        monkeypatch.setattr(place, "_MOUNTS", mounts)
        assert (catalog_path(tmp_path) is not None) == is_local
        (tmp_path / "lab").mkdir()
        with FileStorage(tmp_path / "lab") as storage:
            assert storage.count_episodes() == 0
        assert (list(cache.rglob("*.sqlite")) != []) == is_local

    def test_what_nobody_opens_is_forgotten(self, tmp_path: Path) -> None:
        old, used, new = tmp_path / "old", tmp_path / "used", tmp_path / "new"
        for root in (old, used, new):
            root.mkdir()
        for root in (old, used):
            FileStorage(root).count_episodes()
            path = catalog_path(root)
            assert path is not None
            os.utime(path.parent, ns=(0, 0))
        with FileStorage(used) as storage:
            storage.count_episodes()
        FileStorage(new).count_episodes()
        assert len(list((cache_dir() / "catalogs").iterdir())) == 2


WORKER = """
import sys
from pathlib import Path
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import RecordingStamp

path, name = Path(sys.argv[1]), sys.argv[2]
sys.stdin.readline()
with Catalog(path) as catalog:
    for n in range(10):
        rows = [EpisodeRow(i, 0, 1, "terminal", 1.0, None, 0, "", "[]", '{"a": %d}' % i) for i in range(20)]
        catalog.put_recording(f"{name}-{n}", Entry(RecordingStamp(1, 2, 3), name, "b", rows))
        catalog.declare_key(f"metadata.score{n % 3}")
        assert len(catalog.episodes()) >= 20
"""


class TestSharing:
    @pytest.mark.sampled(0)
    def test_several_processes(self, tmp_path: Path) -> None:
        path = tmp_path / "catalog.sqlite"
        path.write_bytes(b"garbage, which all of them find")
        command = [sys.executable, "-c", WORKER, str(path)]
        workers = [subprocess.Popen([*command, str(n)], stdin=subprocess.PIPE, text=True) for n in range(4)]
        for worker in workers:
            assert worker.stdin is not None
            worker.stdin.write("go\n")
            worker.stdin.close()
        assert [worker.wait(60) for worker in workers] == [0] * 4
        with Catalog(path) as catalog:
            assert len(catalog.recordings()) == 40
            assert catalog.count() == 800
            assert sorted(catalog.ask(declared_keys)) == [f"metadata.score{n}" for n in range(3)]

    @pytest.mark.parametrize("in_memory", [False, True])
    def test_several_threads(self, tmp_path: Path, in_memory: bool) -> None:
        catalog = Catalog(None if in_memory else tmp_path / "catalog.sqlite")
        errors: list[StorageError] = []

        def work(name: int) -> None:
            try:
                for n in range(5):
                    put(catalog, f"{name}-{n}", [row(i, {"n": i}) for i in range(20)])
                    assert catalog.count(F("metadata.n") == 3) >= 1
            except StorageError as err:
                errors.append(err)

        threads = [threading.Thread(target=work, args=(n,)) for n in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert not errors
        assert catalog.count() == 400
        catalog.close()

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
    def test_a_forked_child(self, catalog: Catalog) -> None:
        put(catalog, rows=[row(0)])
        child = os.fork()
        if child == 0:  # nothing of pytest may run here
            status = 1
            try:
                put(catalog, "child.mcap", [row(0)])
                status = 0 if catalog.count() == 2 else 2
            finally:
                os._exit(status)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert sorted(catalog.recordings()) == ["a.mcap", "child.mcap"]

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
    def test_a_forked_child_has_a_memory_of_its_own(self) -> None:
        with Catalog(None) as catalog:
            put(catalog, rows=[row(0)])
            child = os.fork()
            if child == 0:  # nothing of pytest may run here
                status = 1
                try:
                    fresh = not catalog.is_current() and catalog.count() == 0
                    put(catalog, "child.mcap", [row(0), row(1)])
                    status = 0 if fresh and catalog.count() == 2 else 2
                finally:
                    os._exit(status)
            assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
            assert catalog.count() == 1
