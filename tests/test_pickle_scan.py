"""What a pickle would do, told without loading it: nothing that the unpickler imports may be missing."""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import pickletools
import random
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import pytest
from test_environment import Counter, Engine

from tupli_mcap.environment import capture, scan_pickle


class Reduced:
    """Pickles as a call of `function`."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = function, args

    def __reduce__(self) -> Any:
        return self.call


def names(data: bytes) -> dict[str, str]:
    return {str(found): found.verdict for found in scan_pickle(data).imports}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_a_command_is_seen_in_every_protocol(protocol: int) -> None:
    scan = scan_pickle(pickle.dumps([1, Reduced(os.system, "echo hello")], protocol))
    system = f"{os.system.__module__}:system"
    assert [(str(found), found.verdict) for found in scan.imports] == [(system, "dangerous")]
    assert scan.calls == (f"{system.replace(':', '.')}('echo hello')",)
    assert scan.suspicious and not scan.problems


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
        (b"\x80\x04\x8c\x02os\x8c\x06system2\x8c\x03pop0\x930.", "system:system"),
        (b"c__builtin__\neval\n(S'1'\ntR.", "builtins:eval"),  # Python 2's names
        (b"ccommands\ngetoutput\n(S'x'\ntR.", "subprocess:getoutput"),
        (b"\x80\x04cgymnasium.envs.registration\nimportlib.import_module\n\x8c\x01m\x85R.", "m"),
        (b"c a b\nc d\n.", " a b:c d"),
        (pickle.dumps(Reduced(pickle.loads, pickle.dumps(Reduced(os.system, "x")))), "posix:system"),
        (pickle.dumps([pickle.dumps([pickle.dumps(Reduced(os.system, "x"))])]), "posix:system"),
        (pickle.dumps(Reduced(__import__, "evil")), "evil"),
        (cloudpickle.dumps(lambda: os), "os"),
    ],
)
def test_imports_are_found(data: bytes, found: str) -> None:
    assert found in names(data)


def test_what_is_reached_through_a_known_module_is_dangerous() -> None:
    reached = b"\x80\x04cgymnasium.envs.registration\nimportlib.import_module\n."
    assert names(reached) == {"gymnasium.envs.registration:importlib.import_module": "dangerous"}
    assert names(b"cgymnasium.wrappers.rendering\nRecordVideo\n.").popitem()[1] == "unknown"
    assert names(b"cnumpy\ndtype\n.").popitem()[1] == "known"
    assert names(b"cmypackage.envs\nMaze\n.").popitem()[1] == "unknown"


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "after byte 0 it is no pickle"),
        (b"nonsense", "after byte 0 it is no pickle"),
        (b"\x80\x04N", "after byte 2 it is no pickle"),
        (b"\x80\x04\x8c\x02osh\x05\x93.", "at byte 6 it recalls entry 5, which was never stored"),
        (b"\x80\x04K\x01\x8c\x01x\x93.", "imports something whose name it makes up while it is loaded"),
        (b"\x82\x07.", "imports whatever has extension code 7"),
        (b"R.", "takes a value from an empty stack"),
        (b"t.", "takes a mark that was never set"),
        (b"\x80\x04K\x01Q.", "asks for a persistent object"),
        (b"\x80\x05\x97.", "asks for a buffer"),
        (b"\x80\x04cnumpy\nprod\nN}\x86b.", "it changes numpy.prod"),
        (b"]" * 600_000 + b".", "only its first 500,000 instructions"),
        (b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7fx.", "after byte 0 it is no pickle"),
    ],
)
def test_what_cannot_be_followed_is_said(data: bytes, problem: str) -> None:
    scan = scan_pickle(data)
    assert any(problem in text for text in scan.problems), scan.problems
    assert scan.suspicious


def test_an_environment_by_value_shows_its_code() -> None:
    scan = scan_pickle(capture(Counter()).pickle or b"")
    assert scan.classes == ("Counter",)
    assert scan.functions == ("Counter.__init__", "Counter.reset", "Counter.step")
    assert {found.verdict for found in scan.imports} == {"known"}
    assert scan.calls == () == scan.problems
    engine = Engine()
    assert scan_pickle(capture(engine).pickle or b"").uses == ("open",)
    engine.close()


def test_an_environment_that_was_stepped_is_nothing_unusual() -> None:
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    scan = scan_pickle(capture(env).pickle or b"")
    assert not scan.suspicious
    assert "gymnasium.envs.classic_control.cartpole:CartPoleEnv" in names(capture(env).pickle or b"")


def test_helpers_that_call_what_they_are_given_are_shown() -> None:
    from tupli_mcap.environment import rebuild_ezpickled

    scan = scan_pickle(pickle.dumps(Reduced(rebuild_ezpickled, os.system, ("x",), {}, {})))
    assert scan.calls == ("tupli_mcap.environment.rebuild_ezpickled(posix.system, ('x'), {...}, {...})",)
    made = cloudpickle.dumps(Reduced(lambda text: text, "run"))
    assert (
        "test_helpers_that_call_what_they_are_given_are_shown.<locals>.<lambda>('run')"
        in scan_pickle(made).calls
    )


def test_scanning_neither_imports_nor_runs(tmp_path: Path) -> None:
    for data in (
        b"cno_such_module_at_all\nx\n.",
        pickle.dumps(Reduced(Path.touch, tmp_path / "marker")),
        pickle.dumps(Reduced(pickle.loads, pickle.dumps(Reduced(Path.touch, tmp_path / "marker")))),
    ):
        assert scan_pickle(data).imports
    assert not (tmp_path / "marker").exists()
    pickle.loads(data)
    assert (tmp_path / "marker").exists()


@pytest.mark.parametrize(
    "data",
    [
        b"]" * 16_000_000,
        b"(" * 4_000_000,
        b"N" + b"2\x86" * 1_000_000 + b".",  # nested tuples that share their halves
        b"\x80\x04N" + b"2\x93" * 1_000_000 + b".",
        b"\x80\x04" + b"C\xff" + b"\x80" * 254 + b"." + b"2" * 1_000_000 + b".",
        b"V" + b"9" * 8_000_000 + b"\n.",
        b"I" + b"9" * 8_000_000 + b"\n.",
    ],
    ids=range(7),
)
def test_time_is_bounded(data: bytes) -> None:
    start = time.process_time()
    scan = scan_pickle(data)
    assert time.process_time() - start < 8
    assert sum(len(text) for text in (*scan.calls, *scan.problems)) < 100_000


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
        self.imported: set[tuple[str, str]] = set()

    def find_class(self, module: str, name: str) -> Any:
        self.imported.add((module, name))
        return _Stub


def _really_imported(data: bytes) -> set[tuple[str, str]]:
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


def test_whatever_the_unpickler_imports_is_listed_or_a_problem_is_said() -> None:
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
        scan = scan_pickle(data_)
        found = {(one.module, one.name) for one in scan.imports}
        missing = _mapped(_really_imported(data_)) - found
        assert not missing or scan.problems, (data_, missing)
        imported += len(found)
    assert imported > 4000


def _mapped(imported: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """`find_class` of a subclass is given Python 2's names as they are; the scan maps them."""
    import _compat_pickle

    return {
        _compat_pickle.NAME_MAPPING.get(pair, (_compat_pickle.IMPORT_MAPPING.get(pair[0], pair[0]), pair[1]))
        for pair in imported
    }
