"""Runs everything that reads a file on malicious bundles, in a process that traps the execution of code.

`python trapped.py CORPUS TARGET N` does every Nth operation on each file, another one first on the next file, so that
N files in a row get every operation. It prints a JSON object: `trapped` (everything that would have run, imported,
connected or written, with the operation that did it), `wrong` (errors that are not ours), and the number of operations.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import json
import os
import pickle
import sys
import tempfile
import traceback
import urllib.parse
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import rich.cells
import typer.main

import tupli_mcap
from tupli_mcap import (
    FileStorage,
    FilterEQ,
    RecordEpisodes,
    Recording,
    TupliDataset,
    TupliEnvWrapper,
    TupliError,
    plots,
    viewer,
)
from tupli_mcap.cli import app
from tupli_mcap.doctor import examine
from tupli_mcap.messages import encode_rows as encoder
from tupli_mcap.recording.check.signature import verify_signature
from tupli_mcap.recording.check.verify import verify_recording
from tupli_mcap.recording.describe.description import describe
from tupli_mcap.recording.edit.repair.recover import recover_recording
from tupli_mcap.recording.sign.carried_code import carried_code
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.reexecute import certify, render
from tupli_mcap.viewer.foxglove_layout import write_layout

# Starting programs, networks, native code, other processes: never, whatever the arguments are.
FORBIDDEN = (
    *(
        "subprocess.",
        "os.system",
        "os.exec",
        "os.posix_spawn",
        "os.spawn",
        "os.startfile",
        "os.fork",
        "pty.spawn",
    ),
    *("socket.", "ctypes.", "urllib.", "http.", "ftplib.", "smtplib.", "webbrowser.", "os.kill", "os.putenv"),
    *("pickle.find_class", "marshal.", "compile", "exec", "import", "code.__new__", "builtins.input"),
    *("sqlite3.enable_load_extension", "sqlite3.load_extension", "syslog.", "winreg.", "cpython."),
)
# Changing files: within the target only. The arguments at these positions are paths.
CHANGING = {
    **dict.fromkeys(
        ("os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.chmod", "os.chown", "os.utime"), (0,)
    ),
    **dict.fromkeys(("os.rename", "os.link", "os.symlink"), (0, 1)),
    **dict.fromkeys(
        ("os.setxattr", "os.removexattr", "shutil.rmtree", "sqlite3.connect", "os.chflags"), (0,)
    ),
    **dict.fromkeys(("shutil.copyfile", "shutil.copytree", "shutil.move"), (1,)),
    **dict.fromkeys(("tempfile.mkstemp", "tempfile.mkdtemp"), (0,)),
}
_RELATIVE = {
    "os.remove": 1,
    "os.rmdir": 1,
}  # where the descriptor is of the directory that the path is in, or -1
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Trap:
    """Notes and prevents forbidden events while it is armed."""

    def __init__(self, target: Path) -> None:
        self.target = os.path.realpath(target)
        self.armed = False
        self.doing = ""
        self.trapped: list[str] = []
        self._busy = False
        sys.addaudithook(self._audit)
        for module, name in (
            (pickle, "loads"),
            (pickle, "load"),
            (cloudpickle, "loads"),
            (cloudpickle, "load"),
        ):
            setattr(module, name, self._wrapped(f"{module.__name__}.{name}", getattr(module, name)))
        importlib.import_module = self._wrapped("importlib.import_module", importlib.import_module)

    def _wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            if self.armed and not (name == "importlib.import_module" and args[0] in sys.modules):
                self.spring(f"{name}({args[0]!r:.80})")
            return function(*args, **kwargs)

        return call

    def _audit(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.armed or self._busy:
            return
        self._busy = True
        try:
            if event.startswith(FORBIDDEN):
                if not self._is_harmless(event, args):
                    self.spring(f"{event}{args!r:.200}")
            elif event == "open":
                path, mode, flags = args
                if (
                    flags & _WRITING or (isinstance(mode, str) and set(mode) & set("wax+"))
                ) and self._outside(path):
                    self.spring(f"open({path!r}, {mode!r}, {flags:o})")
            elif event in CHANGING and any(map(self._outside, _changed(event, args))):
                self.spring(f"{event}{args!r:.200}")
        finally:
            self._busy = False

    def _is_harmless(self, event: str, args: tuple[Any, ...]) -> bool:
        if event == "import":
            return args[0] in sys.modules
        if event == "os.putenv":  # the commands spare themselves pydantic's plugins
            return args[0] == b"PYDANTIC_DISABLE_PLUGINS"
        if (
            event == "compile" and args[1] == "<filter>"
        ):  # what a user filters by is parsed, and not run: see "exec"
            return True
        # A writer generates its encoder from the environment at hand, as `append` does; readers generate nothing.
        return (
            event in ("compile", "exec", "code.__new__") and self.doing.endswith(": append") and _encoding()
        )

    def _outside(self, path: Any) -> bool:
        if isinstance(path, int) or path is None:
            return False
        text = os.fsdecode(path)
        if text == ":memory:":  # sqlite3: no file
            return False
        if text.startswith("file:"):  # sqlite3
            text = urllib.parse.unquote(text.removeprefix("file:").partition("?")[0])
        real = os.path.realpath(text)
        return real != self.target and not real.startswith(self.target + os.sep) and real != os.devnull

    def spring(self, what: str) -> None:
        self.trapped.append(f"{self.doing}: {what}")
        raise RuntimeError(f"trapped: {what}")


def _changed(event: str, args: tuple[Any, ...]) -> list[Any]:
    """The paths that an event changes."""
    at = args[_RELATIVE[event]] if event in _RELATIVE else -1
    if at != -1:  # how `shutil.rmtree` goes down into a directory
        return [Path(f"/proc/self/fd/{at}").readlink() / os.fsdecode(args[0])]
    return [args[i] for i in CHANGING[event] if i < len(args)]


def _encoding() -> bool:
    """Whether the call comes from the module that generates encoders."""
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename != encoder.__file__:
        frame = frame.f_back
    return frame.f_code.co_filename == encoder.__file__


def operations(path: Path, work: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """All operations on a file, by name. Those that write get a copy in `work`."""
    name = path.name

    yield "open", lambda: Recording(path).close()
    for what in (_facts, _episodes, _columns, _attachments, _benchmark):
        yield what.__name__.strip("_"), lambda what=what: _with(path, what)
    yield "dataset", lambda: _dataset(TupliDataset.from_files(path))
    yield "certify", lambda: certify(path)
    yield "verify", lambda: verify_recording(path)
    yield "examine", lambda: examine(path)
    yield "recover", lambda: recover_recording(path, work / f"recovered_{name}", overwrite=True)
    yield "carried code", lambda: carried_code(path)
    yield (
        "rewrite",
        lambda: _with(path, lambda r: tupli_mcap.rewrite_recording(r, work / f"rewritten_{name}")),
    )
    yield "merge", lambda: tupli_mcap.merge_recordings([path], work / f"merged_{name}", overwrite=True)
    yield "split", lambda: tupli_mcap.split_recording(path, work / f"{name}_parts" / "a.mcap", episodes=1)
    yield (
        "filter",
        lambda: tupli_mcap.open(path).filter("n_tuples > 0").save(work / f"some_{name}", overwrite=True),
    )
    yield "import", lambda: _import(path, work / "lab")
    yield "view", lambda: viewer.save(path, work / f"{name}.rrd", overwrite=True)
    yield "plot", lambda: plots.report(path).figure
    yield "render", lambda: render(path, work / f"rendered_{name}", overwrite=True)
    yield "layout", lambda: write_layout(path, work / f"{name}.json", overwrite=True)
    for command in ("info", "ls", "episodes", "verify", "doctor"):
        yield f"tupli-mcap {command}", _cli(command, str(path))
    yield "tupli-mcap info --json", _cli("info", str(path), "--json")
    yield "tupli-mcap trust --show", _cli("trust", str(path), "--show")
    yield "tupli-mcap trust --show --json", _cli("trust", str(path), "--show", "--json")
    yield "tupli-mcap verify --rerun", _cli("verify", "--rerun", str(path))
    yield "tupli-mcap recover", _cli("recover", str(path), "-o", str(work / f"again_{name}"), "--force")
    yield (
        "tupli-mcap bundle",
        _cli("bundle", str(path), "-o", str(work / f"bundle_{name}"), "--storage", str(work / "lab")),
    )
    yield (
        "tupli-mcap import --dry-run",
        _cli("import", str(path), "--storage", str(work / "lab"), "--dry-run"),
    )
    if name != "journal.mcap":  # whose journal lies where it says, also for those who append to it
        yield "append", lambda: _append(path, work)


def _with(path: Path, function: Callable[[Recording], Any]) -> Any:
    with Recording(path) as recording:
        return function(recording)


def _facts(recording: Recording) -> None:
    describe(recording)
    repr((recording, recording.metadata, recording.all_metadata(), recording.observation_space))
    if SIGNATURE_NAME in recording.attachments:
        verify_signature(recording)
    _tolerant(lambda: recording.labels)


def _episodes(recording: Recording) -> None:
    for i, episode in enumerate(recording.episodes):
        _tolerant(
            lambda e=episode: (e.seed, e.metadata, e.end, e.final_state, e.infos),
            lambda e=episode: (e.options, e.reset_info),
            lambda i=i: recording.infos(i),
            lambda e=episode: [step.state for step in e],
        )


def _tolerant(*functions: Callable[[], Any]) -> None:
    for function in functions:
        with contextlib.suppress(TupliError):
            function()


def _columns(recording: Recording) -> None:
    recording.read()
    recording.read(fields=["next_states", "rewards"], threads=2)
    recording.read_steps(0, 0, 3)


def _attachments(recording: Recording) -> None:
    for name in recording.attachments:
        recording.read_attachment(name)


def _benchmark(recording: Recording) -> None:
    benchmark = recording.benchmark
    repr((benchmark, benchmark.needs_trust, benchmark.voucher))
    benchmark.make_env()
    raise AssertionError("the environment was built")


def _dataset(dataset: TupliDataset) -> None:
    dataset = dataset.with_episode_filter(
        FilterEQ(key="metadata.value", value=1) | FilterEQ(key="env", value=0)
    )
    repr(dataset.preview())
    dataset.load()
    dataset.convert_to_numpy()
    dataset.convert_to_d4rl_format()
    dataset.convert_to_dataframe()
    with contextlib.suppress(ImportError):
        dataset.convert_to_tensors()
    repr((dataset.episodes[:1], dataset.tuples[:2], dataset.infos[:1]))


def _import(path: Path, root: Path) -> None:
    with FileStorage(root) as storage:
        benchmark = storage.import_bundle(path)
        storage.list_episodes(include_tuples=True)
        TupliEnvWrapper.load(storage, benchmark)
    raise AssertionError("the environment was built")


_MADE = gym.make("CartPole-v1")


def _append(path: Path, work: Path) -> None:
    copy = work / f"appended_{path.name}"
    copy.write_bytes(path.read_bytes())
    with RecordEpisodes(_MADE, copy, mode="a", attachments={}) as env:
        env.reset(seed=1)
        env.step(0)


def storage_operations(root: Path, work: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """All operations on a storage that somebody else filled (a copy, whose catalog is rebuilt)."""

    here = str(root)
    yield "reindex", _cli("reindex", "--storage", here)
    for command in ("list-benchmarks", "list-artifacts", "list-episodes", "compact"):
        yield command, _cli(command, "--storage", here)
    yield "verify", _cli("verify", here)
    yield "ls", _cli("ls", here)
    yield "doctor", _cli("doctor", here)
    yield "dataset of a storage", lambda: _dataset(TupliDataset(FileStorage(root)))

    def load_all() -> None:
        with FileStorage(root) as storage:
            for header in storage.list_benchmarks():
                storage.load_benchmark(header.id)
                try:
                    TupliEnvWrapper.load(storage, header.id)
                except TupliError:
                    continue
                raise AssertionError(f"the environment {header.metadata.name} was built")

    yield "load all", load_all


_COMMAND = typer.main.get_command(app)  # typer evaluates the annotations of our own functions here


def _cli(*words: str) -> Callable[[], Any]:
    """A command in this process, its output thrown away."""

    def run() -> None:
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            code = _COMMAND.main(list(words), standalone_mode=False)
        if code not in (None, 0, 1):
            raise AssertionError(f"{words} is no command: {out.getvalue()[-300:]}")

    return run


def main(corpus: Path, target: Path, every: int) -> None:
    os.environ["TUPLI_MCAP_CONFIG_DIR"] = str(target / "config")
    os.environ["TUPLI_MCAP_CACHE_DIR"] = str(target / "cache")
    os.environ.pop("TUPLI_MCAP_STORAGE", None)
    tempfile.tempdir = str(target)
    warnings.simplefilter("ignore")
    trap = Trap(target)
    wrong: list[str] = []
    count = 0

    def run(subject: str, given: Iterator[tuple[str, Callable[[], Any]]], *, armed: bool) -> None:
        nonlocal count
        for name, operation in given:
            trap.doing, trap.armed = f"{subject}: {name}", armed
            count += armed
            try:
                operation()
            except (TupliError, SystemExit):
                pass
            except Exception:  # noqa: BLE001 - reported
                trap.armed = False
                if armed:
                    wrong.append(f"{trap.doing}: {traceback.format_exc(limit=-6)}")
            finally:
                trap.armed = False

    # Lazy imports of our own first, on a harmless file: what is imported after that was named by a file.
    "\x1b".encode("unicode_escape")  # how the terminal shows such characters
    rich.cells.get_character_cell_size("\N{HORIZONTAL ELLIPSIS}")  # tables of characters' widths
    warm = target / "warm"
    warm.mkdir()
    run("warm", operations(corpus / "harmless.mcap", warm), armed=False)
    run("warm", operations(corpus / "harmless_cut.mcap", warm), armed=False)
    run("warm", storage_operations(target / "storage", warm), armed=False)
    paths = sorted(path for path in corpus.glob("*.mcap") if not path.name.startswith("harmless"))
    for number, path in enumerate(paths):
        run(path.name, itertools.islice(operations(path, target), number % every, None, every), armed=True)
    run("storage", storage_operations(target / "storage", target), armed=True)
    print(json.dumps({"trapped": trap.trapped, "wrong": wrong, "operations": count}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
