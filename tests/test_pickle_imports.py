"""The names that a pickle gives for import, listed without loading it: none that the unpickler asks for is missing."""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import pickletools
import random
import resource
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import pytest
from test_environment import Counter

from tupli_mcap.environment import PickleImports, capture, named_imports


class Reduced:
    """Pickles as a call of `function`."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


SYSTEM = f"{os.system.__module__}:system"


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_names_are_listed_in_every_protocol(protocol: int) -> None:
    found = named_imports(pickle.dumps([1, Reduced(os.system, "echo hello")], protocol))
    assert found == PickleImports((SYSTEM,), ())


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"cos\nsystem\n(S'x'\ntR.", "os:system"),
        (b"(S'x'\nios\nsystem\n.", "os:system"),
        (b"(cos\nsystem\nS'x'\no.", "os:system"),
        (b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x01x\x85R.", "os:system"),
        # From the memo, through entries that PUT and MEMOIZE number differently.
        (
            b"\x80\x04\x8c\x02os\x94\x8c\x06systemq\x07\x8c\x04math\x940h\x00h\x07\x93\x8c\x01x\x85R.",
            "os:system",
        ),
        (b"c__builtin__\neval\n(S'1'\ntR.", "__builtin__:eval"),  # as the pickle has it, not as Python 3 does
        (b"cmodule\na.b.c\n.", "module:a.b.c"),
        (b"c a b\nc d\n.", " a b:c d"),
        (b"c" + b"m" * 1000 + b"\nname\n.", "m" * 200),
        (cloudpickle.dumps(lambda: os), "cloudpickle.cloudpickle:subimport"),
    ],
)
def test_a_name_is_listed(data: bytes, found: str) -> None:
    assert found in named_imports(data).names


@pytest.mark.parametrize(
    ("data", "gap"),
    [
        (b"", "after byte 0 it is no pickle"),
        (b"nonsense", "after byte 0 it is no pickle"),
        (b"\x80\x04N", "after byte 2 it is no pickle"),
        (b"\x80\x04\x8c\x02osh\x05\x93.", "a name made up at load time"),
        (b"\x80\x04K\x01\x8c\x01x\x93.", "a name made up at load time"),
        (b"\x80\x04\x8c\x02os\x8c\x06system2\x8c\x03pop0\x930.", "a name made up at load time"),
        (b"\x82\x07.", "whatever is registered as the extension 7"),
        (b"]" * 600_000 + b".", "only its first 500,000 instructions were read"),
        (b"".join(b"cm\nf%d\n" % i for i in range(10_001)) + b".", "more than 10,000 names"),
        (b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7fx.", "after byte 0 it is no pickle"),
        (b"V" + b"9" * 8_000_000, "after byte 0 it is no pickle"),
    ],
)
def test_what_is_not_listed_is_said(data: bytes, gap: str) -> None:
    found = named_imports(data)
    assert any(gap in text for text in found.gaps), found.gaps
    assert sum(map(len, found.gaps)) < 1000
    assert len(found.names) <= 10_000


def test_an_honest_environment_has_no_gaps() -> None:
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    found = named_imports(capture(env).pickle or b"")
    assert "gymnasium.envs.classic_control.cartpole:CartPoleEnv" in found.names
    assert found.gaps == ()
    assert named_imports(capture(Counter()).pickle or b"").gaps == ()


def test_listing_neither_imports_nor_runs(tmp_path: Path) -> None:
    data = pickle.dumps(Reduced(Path.touch, tmp_path / "marker"))
    assert named_imports(b"cno_such_module_at_all\nx\n.").names == ("no_such_module_at_all:x",)
    assert named_imports(data).names
    assert not (tmp_path / "marker").exists()
    pickle.loads(data)
    assert (tmp_path / "marker").exists()


def test_pickles_within_it_are_not_read() -> None:
    """Each copy of one would have to be read again."""
    inner = pickle.dumps(Reduced(os.system, "x"))
    data = pickle.dumps(Reduced(pickle.loads, inner))
    assert named_imports(data).names == ("_pickle:loads",)
    blob = b"\x80" + bytes(1 << 20) + b"."
    once = b"\x80\x04B" + len(blob).to_bytes(4, "little") + blob
    one, two, four = (_work(once + b"2" * 1000 * n + b".") for n in (1, 2, 4))
    assert four - two == pytest.approx(2 * (two - one), rel=0.05)


def _work(data: bytes) -> int:
    """Calls that listing makes."""
    calls = 0

    def count(frame: object, event: str, arg: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        named_imports(data)
    finally:
        sys.setprofile(None)
    return calls


@pytest.mark.parametrize(
    "data",
    [
        b"]" * 16_000_000,
        b"N" + b"2\x86" * 1_000_000 + b".",  # nested tuples that share their halves
        b"\x80\x04\x8c\x01x" + b"\x94" * 1_000_000 + b".",
    ],
    ids=range(3),
)
def test_the_work_is_bounded(data: bytes) -> None:
    assert _work(data) < 20 * 500_000


class _Stub:
    """Stands for whatever a pickle imports: anything can be done with it."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __call__(self, *args: Any, **kwargs: Any) -> _Stub:
        return _Stub()

    def __setstate__(self, state: Any) -> None:
        pass

    def append(self, item: Any) -> None:
        pass

    extend = __setitem__ = add = lambda self, *items: None


class _Watched(pickle.Unpickler):
    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data))
        self.imported: set[str] = set()

    def find_class(self, module: str, name: str) -> Any:
        self.imported.add(f"{module}:{name}"[:200])
        return _Stub


def _really_imported(data: bytes) -> set[str]:
    watched = _Watched(data)
    with contextlib.suppress(Exception), little_memory():  # a damaged pickle fails in any way
        watched.load()
    return watched.imported


@contextlib.contextmanager
def little_memory() -> Iterator[None]:
    """64 MiB more than there is: a damaged number would make the unpickler clear a list of gigabytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (64 << 20), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_whatever_the_unpickler_asks_for_is_listed_or_a_gap_is_said() -> None:
    """The unpickler itself is the oracle, on damaged, shuffled and spliced pickles."""
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    seeds = [capture(Counter()).pickle or b"", capture(env).pickle or b""]
    seeds += [pickle.dumps([Reduced(os.system, "x"), "os", "system", {1: Counter}], p) for p in range(6)]
    parts = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes if opcode.arg is None]
    parts += [
        b"h\x00",
        b"h\x01",
        b"q\x00",
        b"\x8c\x02os",
        b"\x8c\x06system",
        b"cos\nsystem\n",
        b"ios\nsystem\n",
    ]
    rng, imported = random.Random(5), 0
    for _ in range(4000):
        data = bytearray(rng.choice(seeds))
        if rng.random() < 0.5:
            for _ in range(rng.randint(1, 4)):
                data[rng.randrange(len(data))] = rng.randrange(256)
        else:
            data = bytearray(b"\x80\x04" + b"".join(rng.choices(parts, k=rng.randint(3, 20))) + b".")
        data_ = bytes(data).replace(b"X", b"\x8c") if rng.random() < 0.05 else bytes(data)
        found = named_imports(data_)
        missing = _really_imported(data_) - set(found.names)
        assert not missing or found.gaps, (data_, missing)
        imported += len(found.names)
    assert imported > 4000
