"""What reaches the terminal: no text of a file as it is, whatever the file carries and whichever command meets it."""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler
from gymnasium import spaces
from typer.main import get_command

from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    TupliEnvWrapper,
    rewrite_recording,
    trust,
)
from tupli_mcap.cli import app, terminal as terminal_module
from tupli_mcap.cli.episodes import print_episodes
from tupli_mcap.cli.output import print_json
from tupli_mcap.cli.terminal import one_line, say_json, visible
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.schema import ArtifactMetadata, EpisodeHeader, EpisodeMetadataCallback, RLTuple

# A title, a bell, a line erased, a colour of one character (CSI), text that runs backwards, another line, markup, DEL.
HOSTILE = "x\x1b]0;pwned\x07\x1b[2K\r\x9b31my\u202eevil\u2066\nnext\u2028[red]r[/red]\x7f\U000e0041z"
FILE_NAME = HOSTILE.replace("/", "|")
OWN_STYLES = re.compile(r"\x1b\[[0-9;]*m")
COMMAND = get_command(app)
TOOL = Path(sys.executable).with_name("tupli-mcap")


def hidden(text: str) -> set[str]:
    """The characters of a text that are none to look at."""
    return {c for c in text if c != "\n" and unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}


def run(*args: object) -> str:
    """Everything that a command prints, however it ends; nothing in it does anything to a terminal."""
    data = io.BytesIO()
    with io.TextIOWrapper(data, "utf-8", write_through=True) as out:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            code = COMMAND.main([str(arg) for arg in args], standalone_mode=False)
        printed = data.getvalue().decode()
    assert hidden(OWN_STYLES.sub("", printed)) == set(), (args, printed)
    assert "\nnext" not in printed or "--debug" in args, args  # a traceback keeps its line breaks
    assert code in (None, 0, 1, 2), args
    return printed


@pytest.fixture(autouse=True)
def _coloured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)


class Odd(Sampler):
    """An environment of short episodes, every name and text in which is hostile."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"

    def __init__(self) -> None:
        observations = spaces.Dict({HOSTILE: spaces.Text(100, charset=set(HOSTILE)), "x": spaces.Box(-1, 1)})
        super().__init__(observations, spaces.Discrete(2), length=3)

    def reset(self, **options: Any) -> Any:
        state, _ = super().reset(**options)
        return state, {HOSTILE: HOSTILE}

    def render(self) -> Any:
        return np.zeros((8, 8, 3), np.uint8)


class Texts(EpisodeMetadataCallback):
    def reset(self) -> None:
        pass

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        return {HOSTILE: HOSTILE, "list": [HOSTILE]}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "odd.mcap"
    carried = {HOSTILE: (HOSTILE, b"bytes"), "labels.json": ("application/json", _labels())}
    with RecordEpisodes(
        Odd(), path, attachments=carried, frames=True, record_info=True, metadata_callback=Texts()
    ) as env:
        for seed in range(3):
            env.reset(seed=seed, options={HOSTILE: HOSTILE})
            while not any(env.step(0)[2:4]):
                pass
    return path


def _labels() -> bytes:
    return json.dumps({"values": {"action": ["[red]up[/red]", "[/]"]}, "dimensions": {}}).encode()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark and two episodes, whose own texts are harmless."""
    directory = tmp_path_factory.mktemp("bundle")
    with FileStorage(directory / "lab") as storage:
        with TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage) as env:
            benchmark = env.store(name="pole", description="about", difficulty="easy", version="1")
            for seed in range(2):
                env.reset(seed=seed)
                while not any(env.step(seed)[2:4]):
                    pass
        storage.bundle(benchmark, directory / "b.mcap")
    return directory / "b.mcap"


def spoilt(value: Any) -> Iterator[Any]:
    """A JSON value with one text replaced, or one key of an object and what is below it: each text and key once."""
    if isinstance(value, str) or value is None:
        yield HOSTILE
    elif isinstance(value, dict):
        for key in value:
            yield {**{k: item for k, item in value.items() if k != key}, HOSTILE: 1}
            yield from ({**value, key: item} for item in spoilt(value[key]))
    elif isinstance(value, list):
        yield 1
        yield from ([item, *value[1:]] for first in value[:1] for item in spoilt(first))


# --- what a file carries ---


def look_at(path: object, out: Path) -> None:
    """Every command that looks at one recording, or makes another one of it."""
    for args in (
        ("info", path),
        ("ls", path),
        ("episodes", path),
        ("doctor", path),
        ("verify", path),
        ("recover", path, "--dry-run"),
        ("merge", path, "-o", out / "m.mcap", "--dry-run"),
        ("split", path, "-o", out / "s.mcap", "--episodes", 1, "--dry-run"),
        ("filter", path, "--filter", "env = 0", "-o", out / "f.mcap", "--dry-run"),
        ("trust", path, "--show"),
        ("bundle", path, "-o", out / "b.mcap"),
        ("import", path, "--storage", out / "lab", "--dry-run"),
        ("render", path, "-o", out / "r.mcap"),
    ):
        run(*args)
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        run(*args, "--json")
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()


def test_names_and_texts_of_a_recording(recording: Path, tmp_path: Path) -> None:
    look_at(recording, tmp_path / "out")
    for args in (
        ("doctor", recording, "--level", "info"),
        ("episodes", recording, "--filter", f"metadata.{HOSTILE} = 1"),
        ("plot", recording, "-o", tmp_path / "p.png"),
        ("replay", recording, "--save", tmp_path / "r.rrd"),
        ("replay", recording, "--layout", tmp_path / "l.json"),
        ("verify", recording, "--rerun"),
        ("recover", recording, "-o", tmp_path / "new.mcap"),
    ):
        run(*args)
    assert "[red]r[/red]" in run("episodes", recording)  # no markup: it is shown as it is
    (told, *_) = json.loads(run("episodes", recording, "--json"))["result"]
    assert told["metadata"] == {HOSTILE: HOSTILE, "list": [HOSTILE]}


def test_a_file_of_a_hostile_name(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / FILE_NAME
    path.mkdir()
    path = path / f"{FILE_NAME}.mcap"
    shutil.copy(recording, path)
    look_at(path, tmp_path / "out")
    look_at(f"{FILE_NAME}/none.mcap", tmp_path / "out")
    cut = path.with_name(f"cut{FILE_NAME}.mcap")
    cut.write_bytes(path.read_bytes()[:-500])
    look_at(cut, tmp_path / "out")
    garbage = path.with_name(f"garbage{FILE_NAME}.mcap")
    garbage.write_bytes(HOSTILE.encode())
    look_at(garbage, tmp_path / "out")
    for args in (
        ("ls", tmp_path),
        ("doctor", tmp_path),
        ("verify", tmp_path),
        ("recover", path, "-o", path.with_name(f"r{FILE_NAME}")),
        ("merge", path, "-o", path.with_name(f"m{FILE_NAME}")),
        ("plot", path, "-o", path.with_name(f"p{FILE_NAME}.png")),
        ("replay", path, "--save", path.with_name(f"s{FILE_NAME}.rrd")),
        ("record", "CartPole-v1", "-o", path.with_name(f"o{FILE_NAME}.mcap"), "--steps", 9),
        ("record", "CartPole-v1", "-o", path.with_name(f"o{FILE_NAME}.mcap"), "--steps", 9),
        ("record", "CartPole-v1", "-o", tmp_path / HOSTILE / "none" / "a.mcap"),
        ("record", HOSTILE, "-o", tmp_path / "a.mcap"),
        ("reindex", "--storage", path.parent),
        ("list-episodes", "--storage", path.parent),
        ("list-benchmarks", "--storage", tmp_path / f"none{HOSTILE}"),
        ("trust", "--key", HOSTILE),
        (HOSTILE,),
        ("ls", f"--{HOSTILE}"),
    ):
        run(*args)
        run(*args, *([] if args[0] in ("replay", HOSTILE) else ["--json"]))
    assert "Traceback" in run("--debug", "info", garbage)


@pytest.mark.parametrize("attachment", ["benchmark.json", "labels.json"])
def test_documents_in_a_file(bundle: Path, tmp_path: Path, attachment: str) -> None:
    with Recording(bundle) as found:
        document = json.loads(found.read_attachment(attachment))
    path = tmp_path / "b.mcap"
    count = 0
    for other in spoilt(document):
        shutil.copy(bundle, path)
        add_attachments(path, {attachment: ("application/json", json.dumps(other).encode())})
        for args in (("info", path), ("trust", path, "--show"), ("verify", path)):
            run(*args)
        count += 1
        if HOSTILE in other.get("environment", {}).get("versions", {}):
            look_at(path, tmp_path / "out")
    assert count > 5


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "key", ["library", "uuid", "benchmark_id", "created_ns", "rewritten", HOSTILE], ids=repr
)
def test_metadata_records(bundle: Path, tmp_path: Path, key: str) -> None:
    path = tmp_path / "m.mcap"
    with Recording(bundle) as found:
        found._contents.metadata[key] = HOSTILE
        rewrite_recording(found, path)
    look_at(path, tmp_path / "out")


def test_an_unfinished_file_that_names_its_journal(tmp_path: Path) -> None:
    elsewhere = tmp_path / FILE_NAME
    elsewhere.mkdir()
    path = tmp_path / "live.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path, journal_dir=elsewhere) as env:
        env.reset(seed=1)
        env.step(0)
        shutil.copy(path, tmp_path / "copy.mcap")
    copy = tmp_path / "copy.mcap"
    with pytest.warns(UserWarning, match="pwned"):
        Recording(copy).close()
    look_at(copy, tmp_path / "out")
    run("plot", copy, "-o", tmp_path / "p.png")
    assert "pwned" in run("episodes", copy)


def test_sidecars_of_a_storage(bundle: Path, tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    run("import", bundle, "--storage", lab)
    (path,) = lab.rglob("*.mcap")
    for text in (
        json.dumps({HOSTILE: 1, "deleted": [HOSTILE]}),
        json.dumps({"published_in": {HOSTILE: [HOSTILE]}}),
        json.dumps({"version": HOSTILE}),
        HOSTILE,
    ):
        path.with_name(f"{path.name}.json").write_text(text)
        for command in ("ls", "doctor", "verify"):
            run(command, lab)
        for command in ("compact", "reindex", "list-episodes", "list-benchmarks", "list-artifacts"):
            run(command, "--storage", lab)
            run(command, "--storage", lab, "--json")


def test_texts_of_a_storage(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    with FileStorage(lab) as storage:
        storage.store_artifact(
            b"1", ArtifactMetadata(name=HOSTILE, description=HOSTILE, extra={HOSTILE: HOSTILE})
        )
        with TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage) as env:
            benchmark = env.store(name=HOSTILE, description=HOSTILE, difficulty=HOSTILE, version=HOSTILE)
            env.reset(seed=1)
            env.step(0)
    for command in ("list-benchmarks", "list-artifacts", "list-episodes"):
        assert "pwned" in run(command, "--storage", lab) or command == "list-episodes"
        run(command, "--storage", lab, "--json")
        run(command, "--storage", lab, "--filter", f"metadata.{HOSTILE} = '{HOSTILE}'")
    run("bundle", benchmark, "-o", tmp_path / "b.mcap", "--storage", lab)
    look_at(tmp_path / "b.mcap", tmp_path / "out")
    run("export", "-o", tmp_path / "e.mcap", "--storage", lab)
    for path in lab.rglob("*.json"):
        path.write_text(json.dumps({HOSTILE: HOSTILE, "version": HOSTILE}))
        run("list-benchmarks", "--storage", lab)
        run("list-artifacts", "--storage", lab)
        run("verify", lab)


def test_comments_of_keys(tmp_path: Path) -> None:
    blob = b"\0\0\0\x0bssh-ed25519\0\0\0 " + bytes(range(32))
    comment = HOSTILE.replace("\n", " ")
    Path("evil.pub").write_text(f"ssh-ed25519 {base64.b64encode(blob).decode()} {comment}\n")
    for args in (("trust", "--key", "evil.pub"), ("trust", "--list"), ("untrust", "--key", "evil.pub")):
        run(*args)
        run("trust", "--key", "evil.pub")
        run(*args, "--json")
    trust.trust_key(bytes(range(32)).hex(), HOSTILE)
    assert "pwned" in run("trust", "--list")
    assert json.loads(run("trust", "--list", "--json"))["result"]["keys"][0]["name"].startswith(
        "x\x1b]0;pwned\x07"
    )


def test_errors_of_other_peoples_code(tmp_path: Path) -> None:
    Path("shouting.py").write_text(f"def act(state):\n    raise RuntimeError({HOSTILE!r})\n")
    assert "pwned" in run("record", "CartPole-v1", "-o", "a.mcap", "--policy", "shouting:act")
    Path("warning.py").write_text(
        f"import warnings\ndef act(state):\n    warnings.warn({HOSTILE!r})\n    return 0\n"
    )
    assert "warning: x" in run(
        "record", "CartPole-v1", "-o", "a.mcap", "--policy", "warning:act", "--steps", 3
    )
    script = (
        "import sys, tupli_mcap.cli.info as commands\n"
        f"def broken(facts): raise ZeroDivisionError({HOSTILE!r})\n"
        "commands.print_facts = broken\n"
        "sys.argv[1:] = ['info', 'a.mcap']\n"
        "from tupli_mcap.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, hidden(done.stderr)) == (1, set())
    assert "ZeroDivisionError: x" in done.stderr


def test_a_stdout_of_another_encoding(recording: Path) -> None:
    for args in (("episodes", recording), ("episodes", recording, "--json"), ("info", recording)):
        environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
        done = subprocess.run([TOOL, *args], capture_output=True, env=environment, check=False)
        assert (done.returncode, done.stderr) == (0, b"")
        assert hidden(OWN_STYLES.sub("", done.stdout.decode("ascii"))) == set()


# --- one odd episode among others ---


def header(metadata: dict[str, Any], number: int) -> EpisodeHeader:
    return EpisodeHeader(
        id=f"{number}", created_by="", created_at="0001-01-01T00:00:00+00:00", benchmark_id="", metadata=metadata,
        n_tuples=1, terminated=True, timeout=False, episode=number,
    )  # fmt: skip


def nested(levels: int) -> Any:
    value: Any = 1
    for i in range(levels):
        value = [value] if i % 2 else {"a": value}
    return value


UNPRINTABLE = {
    "long": 1 << 20_000,
    "inside": [[1 << 20_000]],
    "deep": nested(100),
    "deeper": nested(190),
    "key": {(1,): nested(70)},
}


@pytest.mark.parametrize("value", UNPRINTABLE.values(), ids=UNPRINTABLE)
def test_an_episode_that_cannot_be_printed_is_no_end_of_a_listing(
    value: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    headers = [header({"a": value}, 0), header({"a": 7}, 1)]
    print_episodes(headers, several=True, as_json=False)
    assert "a=7" in capsys.readouterr().out
    print_episodes(headers, several=True, as_json=True)
    first, second = json.loads(capsys.readouterr().out)["result"]
    assert (first["episode"], second["metadata"]) == (0, {"a": 7})


# --- the one place ---


def test_visible() -> None:
    assert visible("a\tb\x1b\x9b\u202e\udc80\U000e0041") == r"a\tb\x1b\x9b\u202e\udc80\U000e0041"
    assert visible("é 日\u3000本\xa0 🙂 [red]\\x1b") == "é 日\u3000本\xa0 🙂 [red]\\x1b"
    assert one_line("a\n  b\x0b\x1bc") == r"a b \x1bc"


def test_json_stays_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    value = {HOSTILE: [HOSTILE, "é日🙂", "\x7f\x80\u2029"]}
    print_json(value)
    printed = capsys.readouterr().out
    assert json.loads(printed)["result"] == value
    assert hidden(printed) == set()
    assert "é日🙂" in printed
    say_json('"\\ud800"')
    assert json.loads(capsys.readouterr().out) == "\ud800"


WRITERS = {
    "print",
    "input",
    "stdout",
    "stderr",
    "stdin",
    "__stdout__",
    "__stderr__",
    "echo",
    "secho",
    "prompt",
}
WRITERS |= {"confirm", "print_exc", "print_exception", "showwarning", "Console", "Progress", "dup2"}


def writers(source: str) -> list[tuple[int, str]]:
    """Where a module names something that writes to the terminal."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Name):
            names = [node.id]
        elif isinstance(node, ast.Attribute):
            names = [node.attr]
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [alias.name for alias in node.names]
        found += [(node.lineno, name) for name in names if name in WRITERS]
    return found


def test_one_module_prints() -> None:
    package = Path(terminal_module.__file__).parent
    found = {
        path.name: writers(path.read_text()) for path in package.rglob("*.py") if path.name != "terminal.py"
    }
    assert {name: places for name, places in found.items() if places} == {}
    assert len(found) > 10
    assert writers(Path(terminal_module.__file__).read_text())
    assert writers("import sys; sys.stderr.write('x')") == [(1, "stderr")]
    assert writers("from typer import echo as e") == [(1, "echo")]


def test_a_closed_output_is_no_crash() -> None:
    script = "from tupli_mcap.cli import main; main()"
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -c '{script}' version >&-"], stderr=subprocess.PIPE, check=True
    )
    assert done.stderr == b""
