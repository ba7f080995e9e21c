"""The command `view`: its options, what it opens, what it leaves behind, and what it says of bad input."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import gymnasium as gym
import numpy as np
import pytest

from tupli_mcap import FileStorage, MissingExtraError, RecordEpisodes, Recording, TupliEnvWrapper, viewer
from tupli_mcap.cli import app
from tupli_mcap.errors import install_line
from tupli_mcap.viewer import targets
from tupli_mcap.viewer.sdk import ViewerError

pytest.importorskip("rerun")
from rrd import Rrd


def record(path: Path, env: str, steps: int, seed: int) -> Path:
    with RecordEpisodes(gym.make(env), path) as recorder:
        recorder.action_space.seed(seed)
        recorder.reset(seed=seed)
        for _ in range(steps):
            *_, terminated, truncated, _ = recorder.step(recorder.action_space.sample())
            if terminated or truncated:
                recorder.reset()
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of CartPole, one of Pendulum beside them."""
    folder = tmp_path_factory.mktemp("replayed")
    (folder / "runs").mkdir()
    record(folder / "runs" / "one.mcap", "CartPole-v1", 200, 1)
    record(folder / "runs" / "two.mcap", "CartPole-v1", 200, 2)
    record(folder / "pendulum.mcap", "Pendulum-v1", 30, 3)
    return folder


def replay(*words: object) -> int:
    return app(["replay", *map(str, words)], standalone_mode=False) or 0


def returns_of(path: Path) -> np.ndarray:
    with Recording(path) as recording:
        return recording.index["return"].copy()


@pytest.mark.parametrize(
    ("which", "chosen"),
    [("first", [0]), ("last", [-1]), ("2,0", [2, 0]), ("best", None), ("all", slice(None))],
)
def test_episodes_are_chosen(folder: Path, tmp_path: Path, which: str, chosen: object) -> None:
    goal = tmp_path / "out.rrd"
    assert replay(folder / "runs" / "one.mcap", "--episode", which, "--save", goal) == 0
    returns = returns_of(folder / "runs" / "one.mcap")
    expected = [returns.max()] if chosen is None else returns[chosen]
    found = Rrd(goal)
    # an episode that was broken off has a marker too
    sent = [value for end in found.entities() if end.startswith("/end/") for (value,) in found.scalars(end)]
    assert sorted(sent) == sorted(expected)


def test_a_directory_is_one_collection(folder: Path, tmp_path: Path) -> None:
    best = max(returns_of(path).max() for path in (folder / "runs").glob("*.mcap"))
    assert replay(folder / "runs", "--episode", "best", "--save", tmp_path / "best.rrd") == 0
    assert Rrd(tmp_path / "best.rrd").scalars("/return")[-1, 0] == best
    assert replay(folder / "runs", "--episode", "1", "--save", tmp_path / "both.rrd") == 0
    ends = [returns_of(folder / "runs" / name)[1] for name in ("one.mcap", "two.mcap")]
    assert Rrd(tmp_path / "both.rrd").scalars("/end/terminal")[:, 0].tolist() == ends


def test_a_storage_with_a_filter(tmp_path: Path) -> None:
    storage = FileStorage(tmp_path / "lab")
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage)
    env.store(name="cartpole")
    env.action_space.seed(1)
    env.reset(seed=1)
    for _ in range(150):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    env.close()
    long = [header for header in storage.list_episodes() if header.n_tuples > 20]
    assert len(long) > 1
    storage.delete_episode(long[0].id)
    words = ["--filter", "n_tuples > 20", "--save", tmp_path / "out.rrd"]
    assert replay(tmp_path / "lab", *words) == 0
    assert len(Rrd(tmp_path / "out.rrd").scalars("/state")) == sum(h.n_tuples + 1 for h in long[1:])


def test_recordings_are_compared(folder: Path, tmp_path: Path) -> None:
    runs = [folder / "runs" / "one.mcap", folder / "runs" / "two.mcap"]
    assert replay(*runs, "--compare", "--episode", "best", "--save", tmp_path / "out.rrd") == 0
    found = Rrd(tmp_path / "out.rrd")
    numbers = [int(returns_of(path).argmax()) for path in runs]
    roots = [f"/{path.stem}_{number}" for path, number in zip(runs, numbers, strict=True)]
    last = [found.scalars(f"{root}/return")[-1, 0] for root in roots]
    assert last == [returns_of(path).max() for path in runs]
    named = [found.rows(f"{root}/return", "SeriesLines:names")[0][0] for root in roots]
    assert named == [f"one {numbers[0]}", f"two {numbers[1]}"]


def test_recordings_of_other_spaces_are_other_rerun_recordings(folder: Path, tmp_path: Path) -> None:
    goal = tmp_path / "out.rrd"
    assert replay(folder / "runs" / "one.mcap", folder / "pendulum.mcap", "--save", goal) == 0
    found = Rrd(goal)
    assert len(found.recordings) == 2 and len(found.blueprints) == 2


@pytest.mark.parametrize(("words", "opens"), [(["--apart"], "rerun - < "), ([], "rerun ")])
def test_what_opens_the_file_opens_all_that_is_in_it(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], words: list[str], opens: str
) -> None:
    goal = tmp_path / "out of it.rrd"
    assert replay(folder / "runs" / "one.mcap", "-e", "0,1,2", "--save", goal, *words) == 0
    command = capfd.readouterr().out.partition("open it with: ")[2].strip()
    assert command == f"{opens}'{goal}'"


BAD = [
    (["{one}", "-e", "99"], r"one\.mcap has no episode 99; choose from 0 to \d+", 1),
    (["{one}", "-e", "beste"], r"expected numbers of episodes such as '3,7-9', or best, .* found 'beste'", 2),
    (["{one}", "--filter", "n_tuples > 9999"], r"one\.mcap has no episode that matches n_tuples > 9999$", 1),
    (["{runs}", "--filter", "steps > 9999"], r"runs has no episode that matches steps > 9999$", 1),
    (["{one}", "--filter", "bogus > 1"], r"bogus", 2),
    (["{runs}", "-e", "99"], r"runs has no episode 99; choose from 0 to \d+", 1),
    (["{folder}/none.mcap"], r"none\.mcap does not exist; give the path of a recording", 1),
    (["{folder}/damaged.mcap"], r"damaged\.mcap", 1),
    (["{one}", "{pendulum}", "--compare"], r"expected recordings of the same spaces to compare", 1),
    (["{one}", "--compare", "--apart"], r"give one of them", 2),
    (["{one}", "--web"], r"give one of them", 2),
    (
        ["{one}", "--compare", "-e", "all", "{runs}"],
        r"at most 16 episodes to compare, found \d+",
        1,
    ),
]


@pytest.mark.parametrize(("words", "said", "code"), BAD, ids=[" ".join(words) for words, *_ in BAD])
def test_bad_input_is_one_line_and_no_file(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], words: list[str], said: str, code: int
) -> None:
    data = bytearray((folder / "runs" / "one.mcap").read_bytes())
    data[len(data) // 3] ^= 0xFF
    (folder / "damaged.mcap").write_bytes(data)
    paths = {"one": folder / "runs" / "one.mcap", "runs": folder / "runs", "folder": folder}
    paths["pendulum"] = folder / "pendulum.mcap"
    assert replay(*(word.format(**paths) for word in words), "--save", tmp_path / "out.rrd") == code
    told = capfd.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1
    assert re.search(said, told)
    assert list(tmp_path.iterdir()) == []


def test_a_file_has_the_name_the_viewer_wants(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert replay(folder / "runs" / "one.mcap", "--save", folder / "out.mcap") == 1
    assert "expected a name that ends in .rrd" in capfd.readouterr().err
    assert replay(folder / "runs" / "one.mcap", "--save", folder / "none" / "out.rrd") == 1
    assert "there is no directory" in capfd.readouterr().err


def test_without_a_display_it_names_the_other_ways(
    folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert replay(folder / "runs" / "one.mcap") == 1
    told = capfd.readouterr().err
    assert "there is no display here; look in a browser with --web" in told and "--save FILE.rrd" in told


@pytest.mark.parametrize("url", ["viewer.example", "http://["])
def test_a_url_that_is_none_is_told(folder: Path, capfd: pytest.CaptureFixture[str], url: str) -> None:
    assert replay(folder / "runs" / "one.mcap", "--connect", url) == 1
    assert f"error: the viewer at {url} did not take the data" in capfd.readouterr().err


def test_where_no_viewer_answers_it_ends_soon(
    folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(targets, "_ANSWER_SECONDS", 0.3)
    port = targets.free_port()
    assert replay(folder / "runs" / "one.mcap", "--connect", f"rerun+http://127.0.0.1:{port}/proxy") == 1
    (told,) = [line for line in capfd.readouterr().err.splitlines() if "re_sdk" not in line]
    assert re.search(rf"error: no viewer answers at .*; start one there \(rerun --port {port}\)", told)


def test_without_a_viewer_it_says_how_to_get_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        ViewerError, match=r"there is no viewer: .* pip install --force-reinstall rerun-sdk=="
    ):
        viewer.show(folder / "runs" / "one.mcap")
    old = tmp_path / "rerun"
    old.write_text("#!/bin/sh\necho rerun-cli 0.22.1\n")
    old.chmod(0o755)
    with pytest.raises(ViewerError, match=r"to be of version .* found 'rerun-cli 0\.22\.1'; install"):
        viewer.show(folder / "runs" / "one.mcap")


def test_a_viewer_that_does_not_start_is_told_with_its_last_words(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "rerun"
    broken.write_text("#!/bin/sh\necho Error: no graphics here\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setattr(targets, "viewer_program", lambda: broken)
    monkeypatch.setenv("DISPLAY", ":9")
    with pytest.raises(ViewerError, match="did not start; its last output is 'Error: no graphics here'"):
        viewer.show(folder / "runs" / "one.mcap")


def test_without_rerun_the_error_names_the_extra(folder: Path, tmp_path: Path) -> None:
    script = (
        "import sys; sys.modules['rerun'] = None\n"
        "from tupli_mcap import Recording\nfrom tupli_mcap.cli import app\n"
        f"assert len(Recording({str(folder / 'runs' / 'one.mcap')!r}).episodes)\n"
        f"app(['replay', {str(folder / 'runs' / 'one.mcap')!r}, '--save', {str(tmp_path / 'out.rrd')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == f"error: looking at recordings needs rerun-sdk: {install_line('rerun')}\n"
    assert issubclass(MissingExtraError, ImportError)


def test_the_web_viewer_ends_with_the_command(folder: Path) -> None:
    words = ["replay", str(folder / "runs" / "one.mcap"), "--web", "-e", "best"]
    command = [sys.executable, "-c", f"from tupli_mcap.cli import app; app({words!r})"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = urlsplit(process.stdout.readline().strip())
        data = urlsplit(parse_qs(url.query)["url"][0].removeprefix("rerun+"))
        assert url.hostname == data.hostname == "127.0.0.1"
        with urllib.request.urlopen(f"http://{url.netloc}/", timeout=120) as page:
            assert b"Rerun" in page.read()
        assert {address for port in (url.port, data.port) for address in listening(port)} == {"0100007F"}
        process.send_signal(signal.SIGINT)
        assert process.wait(120) == 0
        assert process.stderr is not None and process.stderr.read() == ""
    finally:
        process.kill()
        process.communicate()
    assert not [address for port in (url.port, data.port) for address in listening(port)]


def listening(port: int | None) -> list[str]:
    """The addresses (hexadecimal, as the kernel has them) at which somebody listens on a port."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()
    ]
    local = [fields[1].split(":") for fields in lines if fields[3] == "0A"]
    return [address for address, found in local if int(found, 16) == port]


@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb")
def test_the_native_viewer_stays_open(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from rerun.experimental import ViewerClient

    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1000x700x24", "-nolisten", "tcp"]
    screen = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as told:
        monkeypatch.setenv("DISPLAY", f":{told.readline().strip()}")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    ports: list[int] = []
    free_port = targets.free_port
    monkeypatch.setattr(targets, "free_port", lambda: ports.append(free_port()) or ports[-1])
    pid = 0
    try:
        with Recording(folder / "runs" / "one.mcap") as recording:
            pid = recording.replay(episodes="best")
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{ports[0]}/proxy")
        until = time.monotonic() + 120
        timelines: list[str | None] = []
        while timelines != ["step"] and time.monotonic() < until:
            timelines = [found.current_timeline for found in client.get_state().recordings]
            time.sleep(0.1)
        assert timelines == ["step"]
        assert listening(ports[0]) == ["0100007F"]
    finally:
        if pid:
            os.kill(pid, signal.SIGKILL)
        screen.terminate()
        screen.wait(120)


def test_in_a_notebook_it_is_the_result_of_a_cell(folder: Path) -> None:
    shown = viewer.display(folder / "runs" / "one.mcap", "first")
    assert repr(shown).startswith("one: Episode 0: ")
    assert "<b>one</b>" in shown._repr_html_() and "pip install rerun-notebook" in shown._repr_html_()
