"""One filter, one meaning: in memory, in SQLite and PostgreSQL, through JSON and as text."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import math
import operator
import re
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st
from postgres import Cluster, ServerCatalog
from pydantic import ValidationError
from sqlalchemy import Connection, false, not_, or_

from tupli_mcap.errors import FilterError
from tupli_mcap.jsonvalue import dumps_plain
from tupli_mcap.schema import (
    BaseFilter,
    EpisodeHeader,
    F,
    FilterAND,
    FilterCONTAINS,
    FilterEQ,
    FilterGEQ,
    FilterGT,
    FilterIN,
    FilterLEQ,
    FilterLT,
    FilterNE,
    FilterNOT,
    FilterOR,
    compile_predicate,
    evaluate_columns,
    format_filter,
    join_key,
    parse_filter,
    split_key,
)
from tupli_mcap.schema.times import local_text, span_of, time_ns
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.catalog.tables import EPISODE
from tupli_mcap.storage.listing import RecordingStamp

STAMP = RecordingStamp(1, 2, 3)
UUID = "0123456789abcdef0123456789abcdef"

# Few names and values, so that filters and items meet; each is there for a reason a database may err on.
NAMES = [
    "a",
    "b",
    "a.b",
    "0",
    "",
    '"',
    "'",
    "\\",
    "größe",
    "$float",
    "$x",
    "\x00",
    "\ud7ff",
    "x y",
    "\U0001f600",
]
NUMBERS = [
    *(
        0,
        1,
        -1,
        2**53,
        2**53 + 1,
        2**63 - 1,
        2**63,
        -(2**63),
        -(2**63) - 1,
        2**64,
        10**30,
        2**1024 - 1,
        -(2**1024 - 1),
    ),
    *(0.0, -0.0, 1.0, 0.1, 0.1 + 0.2, 0.3, 1.5, float(2**53), float(2**63), 1e300, 5e-324, 2.5e-310),
    *(
        math.nextafter(1.0, 2.0),
        math.nextafter(1.0, 0.0),
        1.7976931348623157e308,
        math.inf,
        -math.inf,
        math.nan,
    ),
]
# Metadata holds integers of 1024 bits at most; what they are compared with may be longer.
COMPARED = [*NUMBERS, 2**1024, -(2**1024), 10**400, -(10**400)]
TEXTS = [
    "",
    "a",
    "b",
    "ab",
    "A",
    "1",
    "true",
    "nan",
    "a\x00",
    "a\x00b",
    "a\x01",
    "\ud7ff",
    "\ue000",
    "é",
    "\U0001f600",
    "'\"\\",
    "100%_k/",
    "\u212a\u00df\u00c9s",
]
others = st.integers(-3, 3) | st.floats() | st.integers()
numbers = st.sampled_from(NUMBERS) | others
compared = st.sampled_from(COMPARED) | others
texts = st.sampled_from(TEXTS) | st.text(max_size=3)
scalars = st.none() | st.booleans() | numbers | texts
wanted = st.none() | st.booleans() | compared | texts
surrogates = st.sampled_from(["\ud800", "a\udfff", "\udfff\ud800"])
names = st.sampled_from(NAMES)
values = st.recursive(
    scalars | surrogates,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(names, inner, max_size=3),
    max_leaves=6,
)
items = st.dictionaries(names | surrogates, values, max_size=4)
metadata_keys = st.lists(names, min_size=1, max_size=3).map(lambda path: join_key(["metadata", *path]))
own_texts = st.sampled_from(
    [f"{UUID}-0", f"{UUID}-1", f"{UUID}-", "x-0", "terminal", "timeout", "me", "bench"]
)
MOMENTS = [
    "2026-03-29T00:30:00",
    "2026-03-29T01:59:59.5",
    "2026-10-25T01:30:00.000001",
    "2026-11-21",
    "2031-01-01",
]
times = st.sampled_from(
    [
        *(
            "2026-03-29",
            "2026-10-25",
            "2026-11-21",
            "2026-03-29 01:30",
            "2026-03-29T02:30+01:00",
            "2026-10-25 02:30",
        ),
        *("2026-03-29T01:59:59.5Z", "2026-03-29 01:59:59Z", "2026-10-25T01:30:00.000001999+00:00"),
        *(
            "today",
            "Yesterday",
            "7d ago",
            "3 h ago",
            "90min ago",
            "2w ago",
            "1 hour ago",
            "0001-01-02",
            "9998-12-31",
        ),
        *(1_795_219_200 * 10**9, 1_795_219_200 * 10**9 + 1, 2**63 - 1, 10**17),
        *(
            datetime.date(2026, 11, 21),
            datetime.datetime(2026, 11, 21),
            datetime.datetime(2026, 3, 29, 2, 30),
        ),
        datetime.datetime(2026, 3, 29, 0, 30, tzinfo=datetime.UTC),
    ]
)
real = compared.filter(lambda number: number == number)
whole = real.filter(lambda number: number % 1 == 0)
ends = st.sampled_from(["terminal", "timeout", "interrupted", ""])
FACTS: dict[str, st.SearchStrategy[Any]] = {
    **dict.fromkeys(("n_tuples", "env", "episode"), whole),
    "seed": whole | st.none(),
    "episode_return": real | st.none(),
    **dict.fromkeys(("terminated", "timeout"), st.booleans()),
    "success": st.booleans() | st.none(),
    **dict.fromkeys(("id", "created_by", "benchmark_id", "recording"), texts | own_texts),
    **dict.fromkeys(("created_at", "ended"), times),
    "end": ends,
    "published_in": texts | st.just("me"),
}
"""What each key that is no metadata may be compared with."""
fragments = texts | st.sampled_from(
    ["E", "B", "%", "_", "/", "0%", "k", "ss", "-0", "R.MCAP", "'\"", '"$', "a" * 2000]
)
"""What may occur in a text. Python's small letter of U+212A, the sign for kelvins, is k, and ß is ss to it."""
ORDERED = (FilterEQ, FilterNE, FilterGT, FilterGEQ, FilterLT, FilterLEQ)
operations = st.sampled_from(
    [FilterEQ, FilterNE, FilterIN, FilterGT, FilterGEQ, FilterLT, FilterLEQ, FilterCONTAINS]
)
TEXT_FACTS = ("id", "created_by", "benchmark_id", "recording", "published_in")


@st.composite
def leaves(draw: st.DrawFn) -> BaseFilter:
    kind = draw(operations)
    key = draw(metadata_keys | st.sampled_from(sorted(FACTS)))
    given = FACTS.get(key, wanted | own_texts)
    if kind is FilterCONTAINS and key in FACTS and key not in TEXT_FACTS:
        kind = FilterEQ
    if kind is FilterCONTAINS:
        return FilterCONTAINS(key=key, value=draw(fragments))
    if kind is FilterIN:
        return FilterIN(key=key, value=draw(st.lists(given, max_size=20)))
    if kind not in (FilterEQ, FilterNE):
        if key in ("terminated", "timeout", "success", "end"):
            kind = FilterNE
        elif key in ("n_tuples", "env", "episode", "seed"):
            given = real
        else:
            given = given.filter(lambda value: not (value is None or isinstance(value, bool)))
    return kind(key=key, value=draw(given))


filters = st.recursive(
    leaves(),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3).map(lambda parts: FilterAND(filters=parts)),
        st.lists(inner, max_size=3).map(lambda parts: FilterOR(filters=parts)),
        inner.map(lambda part: FilterNOT(filters=[part])),
    ),
    max_leaves=6,
)
flags = st.dictionaries(
    st.sampled_from(["success", "is_success"]),
    st.sampled_from([True, False, 0, 1, 1.0, 2, "1", None, [True], math.nan]),
)
rows = st.fixed_dictionaries(
    {
        "metadata": items | st.builds(operator.or_, items, flags),
        "n_tuples": st.integers(0, 3) | st.just(2**62),
        "env": st.integers(0, 2),
        "end": st.sampled_from(["terminal", "timeout", "interrupted"]),
        "episode_return": st.none() | st.floats() | st.sampled_from([0.0, 1.0, 2.0**63]),
        "seed": st.none() | st.integers(0, 3) | st.integers(-(2**130), 2**130),
        "created_by": st.sampled_from(["me", "you", "Mo\u212a%", "a\x00", "\ud800"]),
        "created_at": st.sampled_from(MOMENTS),
    }
)


def header_of(number: int, row: dict[str, Any]) -> EpisodeHeader:
    return EpisodeHeader(
        id=f"{UUID}-{number}",
        published_in=["me"],
        benchmark_id="bench",
        terminated=row["end"] == "terminal",
        timeout=row["end"] == "timeout",
        episode=number,
        recording="r.mcap",
        **{"created_at": "2026-01-01", **row},
    )


def fill(catalog: Catalog | ServerCatalog, headers: list[EpisodeHeader]) -> None:
    rows = [
        EpisodeRow(
            episode=h.episode,
            env=h.env,
            n_tuples=h.n_tuples,
            end=h.end,
            episode_return=h.episode_return,
            seed=h.seed,
            created_at=time_ns(h.created_at) or 0,
            created_by=h.created_by,
            published_in=json.dumps(h.published_in),
            metadata=dumps_plain(h.metadata),
        )
        for h in headers
    ]
    catalog.put_recording("r.mcap", Entry(STAMP, UUID, "bench", rows))


KEYS = ("metadata.a", "metadata.a.b", 'metadata."a.b"', "metadata.0", "n_tuples", "episode_return", "end")


@pytest.fixture(scope="module")
def catalogs(postgres: Cluster) -> Iterator[list[Catalog | ServerCatalog]]:
    """Of SQLite and PostgreSQL, one catalog without declared keys and one with."""
    with contextlib.ExitStack() as stack:
        made = [stack.enter_context(Catalog(None)) for _ in range(2)]
        urls = [stack.enter_context(postgres.database()) for _ in range(2)]
        of_server = [stack.enter_context(ServerCatalog(url)) for url in urls]
        for key in KEYS:
            made[1].declare_key(key)
            of_server[1].declare_key(key)
        yield [*made, *of_server]


@contextlib.contextmanager
def local_zone(name: str) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TZ", name)
        time.tzset()
        yield
    time.tzset()


@pytest.fixture(scope="module", autouse=True)
def _zone() -> Iterator[None]:
    """A zone of two offsets."""
    with local_zone("CET-1CEST,M3.5.0,M10.5.0/3"):
        yield


class TestOneMeaning:
    @settings(max_examples=60, deadline=None)
    @given(data=st.lists(rows, min_size=1, max_size=4), filter=filters)
    def test_memory_and_databases_agree(
        self, catalogs: list[Catalog | ServerCatalog], data: list[dict[str, Any]], filter: BaseFilter
    ) -> None:
        headers = [header_of(number, row) for number, row in enumerate(data)]
        predicate = compile_predicate(filter, EpisodeHeader)
        expected = [header.episode for header in headers if predicate(header)]
        again = BaseFilter.model_validate_json(filter.model_dump_json())
        for catalog in catalogs:
            fill(catalog, headers)
            assert [header.episode for header in catalog.episodes(filter)] == expected
            assert [header.episode for header in catalog.episodes(filter, limit=2)] == expected[:2]
            assert [header.episode for header in catalog.episodes(~again)] == [
                header.episode for header in headers if not predicate(header)
            ]
            assert catalog.count(again) == len(expected)

    @pytest.mark.parametrize("key", ["created_by", "recording", "benchmark_id", "metadata.a"])
    def test_sql_looks_for_a_part_of_a_text(self, catalogs: list[Catalog | ServerCatalog], key: str) -> None:
        headers = [header_of(0, base_row({"a": "Bx%"}, 0))]
        for catalog in catalogs[::2]:
            fill(catalog, headers)
            plan = catalog.explain(F(key).contains("%'; --"))
            assert "lower(" in plan and "LIKE" in plan and "/%'; --" in plan

    @settings(max_examples=300, deadline=None)
    @given(
        key=st.sampled_from([*FACTS, "metadata", "end.x", "n_tuples.x"]),
        kind=operations,
        value=wanted | own_texts | times,
    )
    def test_what_is_refused_in_memory_is_refused_in_databases(
        self, catalogs: list[Catalog | ServerCatalog], key: str, kind: Any, value: Any
    ) -> None:
        def refusal(ask: Any) -> str | None:
            try:
                ask()
            except FilterError as err:
                return str(err)
            return None

        try:
            asked = kind(key=key, value=[value] if kind is FilterIN else value)
        except FilterError:
            return
        said = refusal(lambda: compile_predicate(asked, EpisodeHeader))
        assert {said} == {refusal(lambda of=catalog: of.count(asked)) for catalog in catalogs}
        if key not in FACTS:
            assert said is not None

    @settings(max_examples=300, deadline=None)
    @given(filter=filters)
    def test_json_restores_a_filter(self, filter: BaseFilter) -> None:
        again = BaseFilter.model_validate_json(filter.model_dump_json())
        assert again == filter
        assert hash(again) == hash(filter)
        assert BaseFilter.model_validate(filter.to_params_dict()) == filter
        assert json.loads(json.dumps(filter.to_params_dict(), allow_nan=False)) == filter.to_params_dict()

    @settings(max_examples=300, deadline=None)
    @given(filter=filters)
    def test_repr_is_the_expression(self, filter: BaseFilter) -> None:
        again = eval(repr(filter), {"F": F, "FilterAND": FilterAND, "FilterOR": FilterOR, "float": float})
        row = header_of(
            0, {"metadata": {"a": 1, "b": "a"}, "n_tuples": 1, "end": "timeout", "created_by": "me"}
        )
        assert compile_predicate(again)(row) == compile_predicate(filter)(row)

    @settings(max_examples=400, deadline=None)
    @given(filter=filters)
    def test_text_restores_a_filter(self, filter: BaseFilter) -> None:
        if has_empty(filter):
            with pytest.raises(FilterError, match=r"an empty (AND|OR) has no text"):
                format_filter(filter)
        else:
            assert flat(parse_filter(format_filter(filter))) == flat(filter)

    @pytest.mark.sampled(0, keep=["5-sqlite", "5-postgresql"])
    @pytest.mark.parametrize("of", ["sqlite", "postgresql"])
    @pytest.mark.parametrize("every", [1, 5])
    def test_numbers_compare_exactly_in_databases(self, every: int, of: str, postgres: Cluster) -> None:
        with postgres.database() as url, Catalog(None) if of == "sqlite" else ServerCatalog(url) as catalog:
            fill(catalog, [header_of(i, base_row({"x": number}, number)) for i, number in enumerate(NUMBERS)])
            headers = catalog.episodes()
            pairs = itertools.product(COMPARED, ORDERED)
            for value, operation in itertools.islice(pairs, None, None, every):
                real = ("metadata.x", "episode_return") if value == value else ("metadata.x",)
                may_be_seed = value % 1 == 0 or (value == value and operation not in (FilterEQ, FilterNE))
                for key in (*real, *(("seed",) if may_be_seed else ())):
                    asked = operation(key=key, value=value)
                    expected = [h.episode for h in headers if compile_predicate(asked)(h)]
                    assert [h.episode for h in catalog.episodes(asked)] == expected, asked
                    assert catalog.count(asked) == len(expected), asked

    def test_texts_longer_than_a_pattern_of_a_database(self) -> None:
        with Catalog(None) as catalog:
            fill(catalog, [header_of(0, base_row({"x": "a"}, 0.5))])
            for key in (*TEXT_FACTS, "metadata.x", "run.name", "run.tags"):
                for asked in (
                    FilterEQ(key=key, value="x" * 100_000),
                    FilterIN(key=key, value=["x" * 100_000]),
                ):
                    assert catalog.count(asked) == 0, key

    @pytest.mark.sampled(0, keep=["3-sqlite", "3-postgresql"])
    @pytest.mark.parametrize("of", ["sqlite", "postgresql"])
    @pytest.mark.parametrize("every", [1, 3])
    def test_sql_is_sure_of_no_episode_that_does_not_match(
        self, every: int, of: str, postgres: Cluster
    ) -> None:
        long = "x" * 499
        held = [
            *NUMBERS,
            True,
            False,
            None,
            [1],
            {"y": 1},
            "",
            "1",
            long,
            long + "x",
            long + "xy",
            long + "xz",
        ]
        compared = [
            0,
            1,
            True,
            None,
            0.1,
            2**53,
            2**53 + 1,
            2**63 - 1,
            math.inf,
            math.nan,
            10**400,
            *held[-6:],
        ]
        with postgres.database() as url, Catalog(None) if of == "sqlite" else ServerCatalog(url) as catalog:
            rows = [base_row({"x": value}, 0.5) for value in held]
            fill(catalog, [header_of(i, row) for i, row in enumerate([*rows, base_row({}, 0)])])
            catalog.declare_key("metadata.x")
            headers = catalog.episodes()
            pairs = itertools.product(compared, (*ORDERED, FilterIN))
            for value, operation in itertools.islice(pairs, None, None, every):
                if operation in ORDERED[2:] and not isinstance(value, int | float | str):
                    continue
                if operation in ORDERED[2:] and isinstance(value, bool):
                    continue
                asked = operation(key="metadata.x", value=[value, 7] if operation is FilterIN else value)
                for each in (asked, ~asked, ~asked | (F("episode") < 5)):
                    matches = compile_predicate(each, EpisodeHeader)
                    expected = {h.episode for h in headers if matches(h)}
                    assert catalog.count(each) == len(expected), each
                    with catalog._read() as connection:
                        assert surely(connection, each) <= expected, each


def surely(connection: Connection, filter: BaseFilter) -> set[int]:
    """The episodes that match according to SQL alone."""
    asked = queries._asked(connection, filter, None, None)
    found = queries._narrowed(asked)
    sure = queries._query(asked, found, EPISODE.c.episode).where(not_(or_(false(), *found.unsure)))
    return set(connection.execute(sure).scalars())


class TestTimes:
    """In CET: the clocks of 2026 are changed on 29 March and 25 October."""

    @pytest.mark.parametrize(
        ("value", "first", "length"),
        [
            ("2026-11-21", "2026-11-20T23:00:00", 86_400),
            ("2026-03-29", "2026-03-28T23:00:00", 23 * 3600),
            ("2026-10-25", "2026-10-24T22:00:00", 25 * 3600),
            ("2026-11-21 09:30", "2026-11-21T08:30:00", 60),
            ("2026-11-21T09:30", "2026-11-21T08:30:00", 60),
            ("2026-07-01 09:30:05", "2026-07-01T07:30:05", 1),
            ("2026-07-01 09:30:05Z", "2026-07-01T09:30:05", 1),
            ("2026-07-01 09:30:05+0530", "2026-07-01T04:00:05", 1),
            (" 2026-07-01T09:30:05,25 -01:00", "2026-07-01T10:30:05.25", 0.01),
            ("2026-07-01T09:30:05.123456789+00:00", "2026-07-01T09:30:05.123456", 1e-6),
            ("today", "2026-11-20T23:00:00", 86_400),
            ("YESTERDAY", "2026-11-19T23:00:00", 86_400),
            ("last tuesday", "2026-11-16T23:00:00", 86_400),
            ("Saturday", "2026-11-13T23:00:00", 86_400),
            ("this week", "2026-11-15T23:00:00", 7 * 86_400),
            ("Last  week", "2026-11-08T23:00:00", 7 * 86_400),
            ("this month", "2026-10-31T23:00:00", 30 * 86_400),
            ("last month", "2026-09-30T22:00:00", 31 * 86_400 + 3600),
            ("this year", "2025-12-31T23:00:00", 365 * 86_400),
            ("last year", "2024-12-31T23:00:00", 365 * 86_400),
            ("7d ago", "2026-11-14T08:00:00", 1e-6),
            ("1 week ago", "2026-11-14T08:00:00", 1e-6),
            ("2 W ago", "2026-11-07T08:00:00", 1e-6),
            ("3h ago", "2026-11-21T05:00:00", 1e-6),
            ("90 min ago", "2026-11-21T06:30:00", 1e-6),
            (1_795_248_000_123_456_789, "2026-11-21T08:00:00.123456", 1e-6),
        ],
    )
    def test_what_a_value_names(self, value: Any, first: str, length: float) -> None:
        found = span_of(value, datetime.datetime.fromisoformat("2026-11-21T09:00:00+01:00"))
        assert found.start == time_ns(first)
        assert found.stop - found.start == round(length * 10**9)

    @pytest.mark.parametrize(
        "day", [datetime.date(2024, 1, 1), datetime.date(2024, 2, 29), datetime.date(2026, 12, 31)]
    )
    @pytest.mark.parametrize("unit", ["week", "month", "year"])
    def test_this_one_follows_the_last_and_holds_today(self, unit: str, day: datetime.date) -> None:
        now = datetime.datetime.combine(day, datetime.time(23, 59)).astimezone()
        last, this = span_of(f"last {unit}", now), span_of(f"this {unit}", now)
        assert last.stop == this.start <= now.timestamp() * 10**9 < this.stop
        begin, end = (datetime.datetime.fromtimestamp(ns / 10**9) for ns in this)
        assert (begin.time(), end.time()) == (datetime.time(), datetime.time())
        place = {"week": (begin.weekday(), end.weekday()), "month": (begin.day, end.day)}
        assert place.get(unit, (begin.timetuple().tm_yday, end.timetuple().tm_yday)) in ((0, 0), (1, 1))

    @pytest.mark.parametrize(
        ("zone", "day", "begin", "end"),
        [
            ("America/Santiago", "2023-09-03", "2023-09-03T04:00+00:00", "2023-09-04T03:00+00:00"),
            ("Africa/Cairo", "2024-04-26", "2024-04-25T22:00+00:00", "2024-04-26T21:00+00:00"),
            ("America/Havana", "2023-11-05", "2023-11-05T04:00+00:00", "2023-11-06T05:00+00:00"),
            ("America/Santiago", "2024-04-06", "2024-04-06T03:00+00:00", "2024-04-07T04:00+00:00"),
            ("America/Nuuk", "2024-03-30", "2024-03-30T02:00+00:00", "2024-03-31T01:00+00:00"),
        ],
        ids=[
            "no midnight",
            "no midnight",
            "two midnights",
            "the hour before midnight twice",
            "no hour before midnight",
        ],
    )
    def test_days_where_clocks_are_changed_at_midnight(
        self, zone: str, day: str, begin: str, end: str
    ) -> None:
        with local_zone(zone):
            assert span_of(day) == (time_ns(begin), time_ns(end))
            before = datetime.datetime.fromisoformat(day) - datetime.timedelta(days=1)
            assert span_of(before.date().isoformat()).stop == time_ns(begin)

    def test_what_a_table_shows_is_what_is_found(self) -> None:
        created_at = "2026-11-21T08:30:05.999999+00:00"
        shown = local_text(time_ns(created_at) or 0)
        assert shown == "2026-11-21 09:30:05+01:00"
        header = header_of(0, {**base_row({}, 0), "created_at": created_at})
        local = shown.removesuffix("+01:00")
        moment = datetime.datetime.fromisoformat(created_at)
        with Catalog(None) as catalog:
            fill(catalog, [header])
            assert catalog.episodes()[0].created_at == created_at
            for key in (F("created_at"), F("ended")):
                for value in (shown, local, local.replace(" ", "T"), created_at, moment, moment.date()):
                    true = [key == value, key >= value, key <= value, key.isin(["2001-01-01", value])]
                    for asked in (*true, key > "2026-11-20", key < "2026-11-22"):
                        assert compile_predicate(asked, EpisodeHeader)(header), asked
                        assert catalog.count(asked) == 1, asked
                        assert parse_filter(format_filter(asked)) == asked
                    for asked in (key != value, key > value, key < value, ~(key == value)):
                        assert not compile_predicate(asked, EpisodeHeader)(header), asked
                        assert catalog.count(asked) == 0, asked

    @pytest.mark.parametrize("zone", ["UTC", "CET-1", "EST5", "LMT4:56:02"])
    @pytest.mark.parametrize(
        ("early", "late"),
        [
            ("0001-01-01", "9999-12-31"),
            ("0001-01-01T00:00:00+14:00", "9999-12-31 23:59:59-12:00"),
            (datetime.date.min, datetime.date.max),
            (datetime.datetime.min, datetime.datetime.max),
            (
                datetime.datetime.min.replace(tzinfo=datetime.UTC),
                datetime.datetime.max.replace(tzinfo=datetime.UTC),
            ),
        ],
    )
    def test_the_ends_of_the_calendar_are_open_ends(self, zone: str, early: Any, late: Any) -> None:
        key = F("ended")
        header = header_of(0, {**base_row({}, 0), "created_at": "2026-11-21T08:30:05+00:00"})
        with local_zone(zone), Catalog(None) as catalog:
            fill(catalog, [header])
            for asked in (key > early, key >= early, key != early, key < late, key <= late, key != late):
                assert compile_predicate(asked, EpisodeHeader)(header), asked
                assert catalog.count(asked) == 1, asked
                assert catalog.count(~asked) == 0, asked

    def test_an_index_leads_to_times(self) -> None:
        with Catalog(None) as catalog:
            catalog.declare_key("ended")
            assert "USING COVERING INDEX ix_value (key=? AND number>? AND number<?)" in catalog.explain(
                F("created_at") == "2026-11-21"
            )

    def test_facts_that_say_no_time(self) -> None:
        """No comparison is true of a missing time, nor of a text that says none; `not` turns the answer round."""
        headers = [header_of(0, {**base_row({}, 0), "created_at": day}) for day in ("2026-11-21", "some day")]
        with Catalog(None) as catalog:
            fill(catalog, headers[:1])
            for header, key in zip(headers, (F("run.started"), F("created_at")), strict=True):
                for asked in (key > "2001-01-01", key == "today", key != "today", key.isin(["today"])):
                    assert not compile_predicate(asked, EpisodeHeader)(header), asked
                    assert compile_predicate(~asked, EpisodeHeader)(header), asked
                    if header is headers[0]:
                        assert (catalog.count(asked), catalog.count(~asked)) == (0, 1), asked

    @pytest.mark.parametrize(
        ("filter", "message"),
        [
            *(
                (
                    F(key) > value,
                    f"'{key}' is a time: expected a time, such as .*; found {re.escape(repr(value))}",
                )
                for key in ("created_at", "ended")
                for value in (
                    5,
                    1_795_248_000,
                    2**63,
                    1.8e18,
                    "soon",
                    "2026-13-01",
                    "2026-11-21 25:00",
                    "1d",
                    "",
                )
            ),
            *(
                (
                    F("created_at") == value,
                    f"'created_at' is a time: expected .*; found {re.escape(repr(value))}",
                )
                for value in (None, True, math.nan, "999999999w ago")
            ),
            (F("n_tuples") < "20", "'n_tuples' is a whole number: expected such a value, found '20'"),
            (
                F("n_tuples").isin([1, None]),
                "'n_tuples' is a whole number: expected such a value, found None",
            ),
            (F("n_tuples") == 1.5, "'n_tuples' is a whole number: expected such a value, found 1.5"),
            (F("env") == "CartPole-v1", "found 'CartPole-v1' \\(did you mean 'run.environment'\\?\\)$"),
            (F("env") != math.inf, "'env' is a whole number: expected such a value, found inf"),
            (F("seed").isin([1.0, 0.1]), "'seed' is a whole number or null: .*, found 0.1"),
            (F("seed") == True, "'seed' is a whole number or null: expected such a value, found True"),  # noqa: E712
            (
                F("episode_return") != math.nan,
                "nan is equal to nothing; 'episode_return' <= inf is true of all",
            ),
            (F("terminated") == 1, "'terminated' is true or false: expected such a value, found 1"),
            (F("end") > 1, "'end' is a text: expected such a value, found 1"),
            (F("end") == "terminated", "'end' is terminal, timeout or interrupted, found 'terminated'"),
            (F("end").contains("lost"), "'end' is terminal, timeout or interrupted, found 'lost'"),
            (
                F("end") > "terminal",
                r"'end' has no order: expected ==, != or in, found F\(.end.\) > 'terminal'",
            ),
            (F("n_tuples").contains("1"), "'n_tuples' is a whole number: expected such a value, found '1'"),
            (F("ended").contains("2026"), "'ended' is a time, which contains no text: expected one of = !="),
            (F("end.x") == 1, "filter key 'end.x': end is a text and has no parts"),
            (F("published_in") == 3, "'published_in' is a text: expected such a value, found 3"),
            (F("steps.x") > 1, "filter key 'steps.x': steps is a whole number and has no parts"),
            (F("metadata") != 1, "'metadata' holds several values .* name one, such as metadata.score"),
            (F("run") == "ppo", "'run' holds several values .* name one, such as run.name"),
            (F("lr") > 1, r"unknown key 'lr' \(your own: metadata.lr, run.metadata.lr\); the keys are"),
            (F("name") == "ppo", r"unknown key 'name' \(did you mean 'run.name'\?\); the keys are"),
            (
                F("info.force") > 1,
                r"unknown key 'info.force': it is of steps, which filter_steps\(...\) of a dataset chooses",
            ),
            (F("observations[0]") > 1, "unknown key .*: it is of steps, which filter_steps"),
            (F("frame") > 1, "unknown key 'frame'.*: it is of steps, which filter_steps"),
            (
                F("reward") > 1,
                r"unknown key 'reward' \(did you mean 'return'\?\): it is of steps, which filter_steps",
            ),
            (
                F("episode_length") > 3,
                r"unknown key 'episode_length' \(did you mean 'steps'\?\); the keys are",
            ),
            (F("tag") == "ppo", r"unknown key 'tag' \(did you mean 'run.tags'\?\); the keys are"),
        ],
        ids=repr,
    )
    def test_what_can_never_be_true_is_refused(self, filter: BaseFilter, message: str) -> None:
        with pytest.raises(FilterError, match=message):
            compile_predicate(filter, EpisodeHeader)
        with pytest.raises(FilterError, match=message), Catalog(None) as catalog:
            catalog.count((F("n_tuples") > 0) & ~filter)

    def test_a_part_of_an_end(self) -> None:
        rows = [
            base_row({}, i) | {"end": end} for i, end in enumerate(("terminal", "timeout", "interrupted"))
        ]
        headers = [header_of(i, row) for i, row in enumerate(rows)]
        found = [compile_predicate('end ~ "TERM"', EpisodeHeader)(header) for header in headers]
        assert found == [True, False, False]

    def test_dates_are_about_times(self) -> None:
        for value in (datetime.date(2026, 11, 21), datetime.datetime(2026, 11, 21)):
            with pytest.raises(FilterError, match=r"'metadata.day' holds no times: expected a text"):
                F("metadata.day").isin([value])

    def test_times_of_numpy(self) -> None:
        key, moment = F("ended"), datetime.datetime(2026, 11, 21, 9, 30, 7, 5)
        for unit in ("us", "ns"):
            assert (key > np.datetime64(moment, unit)) == (key > moment)
        day = datetime.date(2026, 11, 21)
        assert (key == np.datetime64(day)) == (key == day)
        assert key.isin(np.array([day, day], "M8")) == key.isin([day, day])
        assert (key > np.datetime64("2026-11-21T09")) == (key > datetime.datetime(2026, 11, 21, 9))


def base_row(metadata: dict[str, Any], number: float) -> dict[str, Any]:
    ret, seed = (number, None) if isinstance(number, float) else (None, number)
    return {
        "metadata": metadata,
        "n_tuples": 1,
        "end": "timeout",
        "created_by": "me",
        "episode_return": ret,
        "seed": seed,
    }


def has_empty(filter: BaseFilter) -> bool:
    return filter.key is None and (not filter.filters or any(map(has_empty, filter.filters)))


def flat(filter: BaseFilter) -> BaseFilter:
    """Without ANDs and ORs of one, which text does not show."""
    if filter.key is not None:
        return filter
    parts = [flat(part) for part in filter.filters]
    if len(parts) == 1 and filter.type != "NOT":
        return parts[0]
    return BaseFilter(type=filter.type, filters=parts)


ITEM = {
    "metadata": {
        "n": 1,
        "f": 1.0,
        "big": 2**53 + 1,
        "nan": math.nan,
        "t": "b",
        "name": "100%_PPO_Ü",
        "yes": True,
        "no": None,
        "untagged": {"$float": "inf", "x": 1},
        "huge": 2**1024 - 1,
        "l": [1],
        "tags": ["a", "b", ["c"]],
        "empty": [],
        "d": {"x": 1},
    }
}


class TestMeaning:
    @pytest.mark.parametrize(
        ("filter", "expected"),
        [
            (F("metadata.n") == 1, True),
            (F("metadata.n") == 1.0, True),
            (F("metadata.f") == 1, True),
            (F("metadata.n") == True, False),  # noqa: E712
            (F("metadata.yes") == 1, False),
            (F("metadata.yes") != 1, True),
            (F("metadata.yes") == True, True),  # noqa: E712
            (F("metadata.big") == float(2**53), False),
            (F("metadata.big") > float(2**53), True),
            (F("metadata.missing") == 1, False),
            (F("metadata.missing") != 1, False),
            (F("metadata.missing") < 1, False),
            (~(F("metadata.missing") < 1), True),
            (~(F("metadata.missing") != 1), True),
            (F("metadata.no") == None, True),  # noqa: E711
            (F("metadata.no") != None, False),  # noqa: E711
            (F("metadata.n") != None, True),  # noqa: E711
            (F("metadata.missing") == None, False),  # noqa: E711
            (F("metadata.no") < 1, False),
            (F("metadata.nan") == math.nan, False),
            (F("metadata.nan") != math.nan, True),
            (F("metadata.nan") >= math.nan, False),
            (F("metadata.nan") < 1, False),
            (F("metadata.n") != math.nan, True),
            (F("metadata.t") > "a", True),
            (F("metadata.t") > "B", True),
            (F("metadata.t") > 1, False),
            (F("metadata.t") < 1, False),
            (F("metadata.n") != "1", True),
            (F("metadata.l") == 1, True),
            (F("metadata.l") != 1, False),
            (F("metadata.l") == True, False),  # noqa: E712
            (F("metadata.l") != 2, True),
            (F("metadata.l").isin([2, 1]), True),
            (F("metadata.l").isin([2, None]), False),
            (F("metadata.l") >= 1, False),
            (F("metadata.tags") == "b", True),
            (F("metadata.tags") == "c", False),
            (F("metadata.empty") == None, False),  # noqa: E711
            (F("metadata.empty") != None, True),  # noqa: E711
            (F("metadata.l.0") == 1, False),
            (F("metadata.d") != 1, True),
            (F("metadata.d.x") == 1, True),
            (F("metadata.n.x") != 1, False),
            (F("metadata.nan.$float") == "nan", False),
            (F("metadata.untagged") > 1, False),
            (F("metadata.untagged.$float") == "inf", True),
            (F("metadata.huge") > 1e308, True),
            (F("metadata.huge") == 2**1024 - 1, True),
            (F("metadata.huge") > 2**1024 - 2, True),
            (F("metadata.huge") < 2**1024, True),
            (F("metadata.huge") > 10**3000, False),
            (F("metadata.huge") < math.inf, True),
            (F("metadata.huge") == 10**3000, False),
            (F("metadata.huge") != 10**3000, True),
            (F("metadata.t").contains("B"), True),
            (F("metadata.t").contains(""), True),
            (F("metadata.t").contains("bb"), False),
            (F("metadata.n").contains("1"), False),
            (F("metadata.no").contains(""), False),
            (F("metadata.missing").contains(""), False),
            (F("metadata.tags").contains("B"), True),
            (F("metadata.tags").contains("c"), False),
            (F("metadata.empty").contains(""), False),
            (F("metadata.name").contains("%"), True),
            (F("metadata.name").contains("0%_"), True),
            (F("metadata.name").contains("0_p"), False),
            (F("metadata.name").contains("100%o"), False),
            (F("metadata.name").contains("Ü"), True),
            (F("metadata.name").contains("ü"), False),
            (F("metadata.name").contains("PpO"), True),
            (F("metadata.n").isin([]), False),
            (F("metadata.n").isin(["1", 2, 1]), True),
            (F("metadata.nan").isin([math.nan]), False),
            (F("metadata.no").isin([None]), True),
            (FilterAND(filters=[]), True),
            (FilterOR(filters=[]), False),
            (~FilterOR(filters=[]), True),
        ],
        ids=repr,
    )
    def test_each_rule(self, filter: BaseFilter, expected: bool) -> None:
        assert compile_predicate(filter)(ITEM) is expected
        row = header_of(0, base_row(ITEM["metadata"], 0))
        with Catalog(None) as plain, Catalog(None) as declared:
            for key in ("metadata.l", "metadata.tags", "metadata.empty", "metadata.name"):
                declared.declare_key(key)
            for catalog in (plain, declared):
                fill(catalog, [row])
                assert catalog.count(filter) == expected

    def test_no_filter_is_true_of_everything(self) -> None:
        assert compile_predicate(None)({})

    def test_numpy_values_are_what_they_hold(self) -> None:
        item = {"a": np.float32(0.5), "b": np.bool_(True), "c": np.array(3), "d": np.array([3])}
        assert compile_predicate((F("a") == 0.5) & (F("b") == True) & (F("c") == 3) & (F("d") != 3))(item)  # noqa: E712
        assert compile_predicate(F("a") == np.float64(0.5))(item)

    def test_tagged_floats_are_floats(self) -> None:
        predicate = compile_predicate(F("x") > 3)
        assert predicate({"x": {"$float": "inf"}})
        assert not predicate({"x": {"$float": "nan"}})
        assert not compile_predicate(F("x.$float") == "nan")({"x": {"$float": "nan"}})


class TestConstruction:
    def test_combining_never_mutates(self) -> None:
        a, b, c = F("a") == 1, F("b") == 2, F("c") == 3
        both = a & b
        before = both.model_dump_json()
        assert (both & c) == FilterAND(filters=[a, b, c])
        assert (c & both) == FilterAND(filters=[c, a, b])
        assert (a | b | c) == FilterOR(filters=[a, b, c])
        assert both.apply_prefix("metadata") == (F("metadata.a") == 1) & (F("metadata.b") == 2)
        assert both.model_dump_json() == before
        assert ~~a == a
        with pytest.raises(ValueError, match="frozen"):
            a.value = 3  # type: ignore[misc]

    def test_lists_of_the_caller_are_copied(self) -> None:
        values, parts = [1, 2], [F("a") == 1]
        chosen, either = F("x").isin(values), FilterOR(filters=parts)
        values.append(3)
        parts.clear()
        assert chosen.value == (1, 2)
        assert len(either.filters) == 1

    def test_from_list(self) -> None:
        headers = [header_of(n, base_row({}, 0)) for n in range(2)]
        built = FilterOR.from_list(headers, on_key="benchmark_id", from_key="id")
        assert built == (F("benchmark_id") == f"{UUID}-0") | (F("benchmark_id") == f"{UUID}-1")
        assert FilterOR.from_list([], on_key="a", from_key="b") == FilterOR(filters=[])

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: FilterEQ(key="a"), "EQ needs a key and a value"),
            (lambda: FilterEQ(value=1), "EQ needs a key and a value"),
            (lambda: FilterEQ(key="a", value={}), "'a' can be compared with null, bool, numbers and text"),
            (lambda: FilterEQ(key="a", value=[1]), "can be compared with"),
            (lambda: F("a") == object(), "can be compared with"),
            (lambda: F("a") == 1j, "can be compared with"),
            (lambda: F("a") == np.datetime64("2020-01-01"), "'a' holds no times"),
            (lambda: F("ended") > np.datetime64("NaT"), "can be compared with"),
            (lambda: F("a") > True, "GT on 'a' orders numbers or text, found True"),
            (lambda: F("a") <= None, "LEQ on 'a' orders numbers or text, found None"),
            (lambda: F("a") < [1], "can be compared with"),
            (lambda: FilterIN(key="a", value=3), "IN on 'a' takes a list of values, found 3"),
            (lambda: FilterIN(key="a", value=[[3]]), r"found \(3,\)|found \[3\]"),
            (lambda: FilterEQ(type="GT", key="a", value=1), "Input should be"),
            (lambda: FilterAND(filters=[], key="a"), "takes no key or value"),
            (lambda: FilterNOT(filters=[]), "NOT takes exactly one filter, found 0"),
            (lambda: FilterEQ(key="a", value=1, filters=[F("b") == 1]), "takes no filters"),
            (lambda: FilterEQ(key="a", value="\ud800"), "lone surrogate"),
            (lambda: FilterEQ(key="a", value=1 << 20_000), "too large an integer"),
            (lambda: F("a..b") == 1, r"'a..b' needs a name at character 2"),
            (lambda: F("") == 1, "needs a name at character 0"),
            (lambda: F('a."x') == 1, "needs a name at character 2"),
            (lambda: F('a."x"y') == 1, "needs a dot or its end at character 5"),
            (lambda: F(r'a."\x"') == 1, "not a JSON string"),
            (lambda: nested(33), "nest at most 32 deep"),
            (lambda: bool(F("a") == 1), "no truth value"),
            (lambda: 1 < F("a") < 3, "no truth value"),
            (lambda: F("a") and F("b") > 1, 'F\\("a"\\) has no truth value: compare it'),
            (lambda: F("a") > 1 & F("b") < 3, r"needs parentheses: \(F\('a'\) > 1\) & \(F\('b'\) < 3\)"),
            (
                lambda: F("a") | (F("b") > 1),
                r'is not compared, F\("a"\) == True, or its comparison needs parentheses',
            ),
            (lambda: ~F("a"), r'F\("a"\) is not compared, ~\(F\("a"\) == True\), or its comparison needs'),
            (lambda: ~F("a") == 1, "needs parentheses"),
            (lambda: F(3), "expected the name of a key, such as 'metadata.score', found 3"),  # type: ignore[arg-type]
            (lambda: F("a").isin("abc"), "isin on 'a' takes a list of values, found 'abc'"),
            (lambda: F("a").isin(3), "isin on 'a' takes a list of values, found 3"),  # type: ignore[arg-type]
            (lambda: compile_predicate(F("id"), EpisodeHeader), r'expected a filter, .*, found F\("id"\)'),  # type: ignore[arg-type]
        ],
    )
    def test_what_has_no_meaning_is_refused(self, make: Any, message: str) -> None:
        with pytest.raises(FilterError, match=message):
            make()

    @pytest.mark.parametrize("type", ["AND", "OR", "NOT"])
    @pytest.mark.parametrize("depth", [33, 500, 5000])
    def test_data_that_nests_too_deep_is_refused(self, type: str, depth: int) -> None:
        data: dict[str, Any] = {"type": "EQ", "key": "a", "value": 1}
        for _ in range(depth):
            data = {"type": type, "filters": [data]}
        with pytest.raises(FilterError, match="^BaseFilter: filters nest at most 32 deep$"):
            BaseFilter(**data)
        with pytest.raises(ValidationError, match="filters nest at most 32 deep"):
            BaseFilter.model_validate(data)

    def test_unknown_keys_are_refused_with_the_known_ones(self) -> None:
        misspelt = (F("metadata.x") == 1) & ~(F("n_tuple") == 1)
        with pytest.raises(
            FilterError, match=r"'n_tuple' \(did you mean 'n_tuples'\?\); the keys are .*, steps,"
        ):
            compile_predicate(misspelt, EpisodeHeader)
        with pytest.raises(FilterError, match=r"'length' \(did you mean 'steps'\?\)"):
            compile_predicate(F("length") > 1, EpisodeHeader)
        with (
            Catalog(None) as catalog,
            pytest.raises(FilterError, match=r"'n_tuple' \(did you mean 'n_tuples'\?\)"),
        ):
            catalog.episodes(misspelt)

    @given(st.lists(st.text(max_size=4).filter(lambda text: text.isprintable()), min_size=1, max_size=3))
    @example(["", ".", '"', "a.b", '"a"', "a[0]", "a[0,1]", "[0]", "a[b]", "\ud800", "a\x1b[2J"])
    def test_keys_round_trip(self, segments: list[str]) -> None:
        assert split_key(join_key(segments)) == tuple(segments)
        assert join_key(segments).isprintable()

    def test_indexes_are_in_brackets(self) -> None:
        name = 'state.arm."a.b"[3][1,2]'
        assert join_key(["state", "arm", "a.b", 3, (1, 2)]) == name
        assert split_key(name) == ("state", "arm", "a.b", "3", "1", "2")
        parsed = parse_filter("state.arm[0].q[1, 2] > 1 and x in[1] and not action[0]")
        assert parsed == parse_filter("state.arm.0.q.1.2 > 1 and x in [1] and not action.0")
        assert format_filter(parsed) == "state.arm[0].q[1, 2] > 1 and x in [1] and not action[0] == true"
        assert split_key("metadata.loss[a].w[0]x") == ("metadata", "loss[a]", "w[0]x")
        with pytest.raises(FilterError, match="needs a name at character 6"):
            split_key("state.[0]")


def nested(depth: int) -> BaseFilter:
    inner: BaseFilter = F("a") == 1
    for _ in range(depth):
        inner = FilterAND(filters=[inner])
    return inner


class TestParser:
    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("metadata.cum_eps_reward > -200", F("metadata.cum_eps_reward") > -200),
            ("a = 1 and b == 'x' or not c != 2.5", ((F("a") == 1) & (F("b") == "x")) | ~(F("c") != 2.5)),
            ("a=1 AND (b=2 Or c=TRUE)", (F("a") == 1) & ((F("b") == 2) | (F("c") == True))),  # noqa: E712
            ("n_tuples in [1, 2.0, 'x', null,]", F("n_tuples").isin([1, 2.0, "x", None])),
            ("a not in []", ~F("a").isin([])),
            ("'x' in run.tags and 3 not in b", (F("run.tags") == "x") & ~(F("b") == 3)),
            ('metadata."a.b".c >= 1e-3', F("metadata", "a.b", "c") >= 1e-3),
            ("metadata.größe.run-1.0 < inf", F("metadata.größe.run-1.0") < math.inf),
            (r"""a = 'it\'s' and b = "\u00e9" """, (F("a") == "it's") & (F("b") == "é")),
            ("nanor = 1 and metadata.class = 2", (F("nanor") == 1) & (F("metadata.class") == 2)),
            ("(" * 64 + "a = 1" + ")" * 64, F("a") == 1),
            ("a ~ \"x\" and not b~'y'", F("a").contains("x") & ~F("b").contains("y")),
            ("a = none and android = -inf", (F("a") == None) & (F("android") == -math.inf)),  # noqa: E711
        ],
    )
    def test_texts(self, text: str, expected: BaseFilter) -> None:
        assert parse_filter(text) == expected

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", "needs a key such as metadata.score at character 0, found the end"),
            ("a 3", "needs one of = == != > >= < <= ~ in, and, or, or the end at character 2, found '3'"),
            ("a > ", "needs a value .* at character 4, found the end"),
            ("a > b", "needs a value .* at character 4, found 'b'"),
            ("a > 3 b", "needs and, or, or the end at character 6, found 'b'"),
            ("(a > 3", r"needs and, or, or '\)' at character 6, found the end"),
            ("(a > 3 b", r"needs and, or, or '\)' at character 7, found 'b'"),
            ("a > 3)", r"needs and, or, or the end at character 5, found '\)'"),
            ("a in (1)", r"needs '\[' at character 5"),
            ("'x' = run.tags", "needs in and a key, .* at character 4, found '='"),
            ("'x' not run.tags", "needs 'in' at character 8, found 'run.tags'"),
            ("'x' in ['x']", r"needs a key such as run.tags at character 7, found '\['"),
            ("a in [1 2]", "needs ',' at character 8"),
            ("a ; drop", "at character 2, found ';'"),
            ("a ~ 3", r"CONTAINS \(~\) on 'a' takes a text, found 3 \(at character 0"),
            ("a ~ ['x']", r"needs a value .* at character 4, found '\['"),
            ("a > true", r"orders numbers or text, found True \(at character 0"),
            ("a..b = 1", "at character 1"),
            ("and = 1", "needs a key .* at character 0, found 'and'"),
            ("a = 'x", "at character 4"),
            ("a = " + "9" * 5000, "a shorter number at character 4"),
            ("(" * 10_000 + "a = 1" + ")" * 10_000, "nests deeper than 64 at character 65"),
            ("not " * 10_000 + "a = 1", "nests deeper than 64"),
        ],
    )
    def test_errors_say_where(self, text: str, message: str) -> None:
        with pytest.raises(FilterError, match=message):
            parse_filter(text)

    @pytest.mark.parametrize(
        ("text", "found", "right"),
        [
            ("end == terminal", "terminal", 'end == "terminal"'),
            ("ended > 2024-05-01", "2024-05-01", 'ended > "2024-05-01"'),
            ("(ended <= 2024-05-01 12:30 )", "2024-05-01 12:30", '(ended <= "2024-05-01 12:30" )'),
            ("not ended > 7d ago AND env=1", "7d ago", 'not ended > "7d ago" AND env=1'),
            ("id = x@y.z or env = 1", "x@y.z", 'id = "x@y.z" or env = 1'),
            ("recording != /lab/a.mcap", "/lab/a.mcap", 'recording != "/lab/a.mcap"'),
            ("metadata.v in [1, 1.2.3]", "1.2.3", 'metadata.v in [1, "1.2.3"]'),
            ("run.name ~ ppo-seed", "ppo-seed", 'run.name ~ "ppo-seed"'),
            ("metadata.s = truely", "truely", 'metadata.s = "truely"'),
        ],
    )
    def test_a_text_without_quotes_is_shown_with_them(self, text: str, found: str, right: str) -> None:
        said = re.escape(f"found {found!r}; put a text or a time in quotes, as in {right}")
        with pytest.raises(FilterError, match=f"needs a value .*, {said}$"):
            parse_filter(text)
        parse_filter(right)

    def test_words_may_follow_numbers_at_once(self) -> None:
        assert parse_filter("a = 1and b = 2or c = 3") == (F("a") == 1) & (F("b") == 2) | (F("c") == 3)

    @settings(max_examples=500, deadline=None)
    @given(st.text(alphabet="ab.\"'()[]<>=!~,12e-+ nortu\\", max_size=25))
    def test_any_text_is_a_filter_or_an_error(self, text: str) -> None:
        try:
            parsed = parse_filter(text)
        except FilterError:
            return
        assert flat(parse_filter(format_filter(parsed))) == flat(parsed)


COLUMNS = {
    "reward": np.array([0.1, 1.0, math.nan, -1.0], np.float32),
    "terminal": np.array([False, False, False, True]),
    "state": {"pos": np.arange(8, dtype=np.int64).reshape(4, 2), "tag": ["x", "y", None, "x"]},
    "action": (np.array([0, 1, 2, 3], np.uint8), [{"k": 1}, {}, {"k": [5, 6]}, {"k": True}]),
}


class TestColumns:
    @pytest.mark.parametrize(
        ("filter", "expected"),
        [
            (F("reward") > 0, [1, 1, 0, 0]),
            (F("reward") > 0.1, [1, 1, 0, 0]),  # float32(0.1) is greater than 0.1
            (F("reward") != 1, [1, 0, 1, 1]),
            (~(F("reward") > 0), [0, 0, 1, 1]),
            (F("terminal") == True, [0, 0, 0, 1]),  # noqa: E712
            (F("terminal") == 1, [0, 0, 0, 0]),
            (F("state.pos[0]") < 2.5, [1, 1, 0, 0]),
            (F("state.pos.0") < 2.5, [1, 1, 0, 0]),
            (F("state.pos.1") >= 3, [0, 1, 1, 1]),
            (F("state.tag") == "x", [1, 0, 0, 1]),
            (F("state.tag").isin([None, "y"]), [0, 1, 1, 0]),
            (F("action.0") > 300, [0, 0, 0, 0]),
            (F("action.0") >= -1, [1, 1, 1, 1]),
            (F("action.1.k") != 2, [1, 0, 1, 1]),
            (F("action[1].k[1]") == 6, [0, 0, 1, 0]),
            ((F("reward") > 0) & (F("action.0") > 0), [0, 1, 0, 0]),
            ((F("reward") < 0) | (F("action.0") == 0), [1, 0, 0, 1]),
            (FilterAND(filters=[]), [1, 1, 1, 1]),
            (FilterOR(filters=[]), [0, 0, 0, 0]),
            (F("reward").isin([]), [0, 0, 0, 0]),
        ],
        ids=repr,
    )
    def test_masks(self, filter: BaseFilter, expected: list[int]) -> None:
        mask = evaluate_columns(filter, COLUMNS)
        assert mask.dtype == np.bool_
        assert mask.astype(int).tolist() == expected

    @pytest.mark.parametrize(
        ("filter", "message"),
        [
            (
                F("rewards") > 0,
                r"'rewards' \(did you mean 'reward'\?\): a step has reward, terminal, state, action",
            ),
            (
                F("state.vel") > 0,
                r"unknown key 'state.vel' \(did you mean 'state.tag'\?\): state has pos, tag",
            ),
            (F("state.poss.1") > 0, r"unknown key 'state.poss.1' \(did you mean 'state.pos\[0\]'\?\)"),
            (
                F("state") > 0,
                r"'state' names several values of a step; name one of them: state.pos\[0\], state.tag",
            ),
            (F("state.pos") > 0, r"values of shape \(2,\) have state.pos\[0\] to state.pos\[1\]"),
            (F("state.pos[2]") > 0, r"'state.pos\[2\]' names no number: .* state.pos\[0\] to state.pos\[1\]"),
            (F("action.2") > 0, "action has 0, 1"),
            (F("reward.0") > 0, r"'reward.0' names no number: values of shape \(\) have reward$"),
        ],
    )
    def test_errors_say_what_there_is(self, filter: BaseFilter, message: str) -> None:
        with pytest.raises(FilterError, match=message):
            evaluate_columns(filter, COLUMNS)

    @settings(max_examples=300, deadline=None)
    @given(
        data=st.lists(numbers, min_size=1, max_size=5),
        dtype=st.sampled_from(["f8", "f4", "f2", "i8", "i1", "u8", "u1", "?"]),
        operation=st.sampled_from([FilterEQ, FilterNE, FilterGT, FilterGEQ, FilterLT, FilterLEQ]),
        value=compared,
    )
    def test_arrays_and_scalars_agree(
        self, data: list[float], dtype: str, operation: Any, value: float
    ) -> None:
        array = np.array([fit(number, np.dtype(dtype)) for number in data], dtype)
        asked = operation(key="x", value=value)
        predicate = compile_predicate(asked)
        assert evaluate_columns(asked, {"x": array}).tolist() == [predicate({"x": item}) for item in array]


def fit(number: float, dtype: np.dtype[Any]) -> Any:
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        whole = 0 if isinstance(number, float) and not math.isfinite(number) else int(number)
        return min(max(whole, limits.min), limits.max)
    if dtype.kind == "b":
        return number == 1
    with np.errstate(over="ignore"):
        try:
            return dtype.type(float(number))
        except OverflowError:
            return dtype.type(math.inf)
