"""Nothing in a file is run, imported or obeyed by anything that reads it, shown with traps on all ways to do so."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from malicious import MODULE, build, module_source, pickles, specs

from tupli_mcap import FileStorage, TupliEnvWrapper

SUPPORT = Path(__file__).parents[1] / "support"


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("malicious")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TUPLI_MCAP_CONFIG_DIR", str(root / "their_config"))
        build(root / "corpus", root / "marker")
        with FileStorage(root / "harmless") as storage:
            env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, record_info=True)
            env.store("harmless")
            for seed in range(2):
                env.reset(seed=seed, options={"low": -0.01, "high": 0.01})
                while not any(env.step(seed)[2:4]):
                    pass
            env.close()
            storage.bundle(env.id or "", root / "corpus/harmless.mcap")
    whole = (root / "corpus/harmless.mcap").read_bytes()
    (root / "corpus/harmless_cut.mcap").write_bytes(whole[: len(whole) * 3 // 4])
    (root / f"{MODULE}.py").write_text(module_source(root / "marker"))
    return root


def run_child(corpus: Path, target: Path, code: list[str]) -> subprocess.CompletedProcess[str]:
    """Python in the corpus's directory, where `evil_module` can be imported from."""
    path = os.pathsep.join([str(corpus), str(SUPPORT.parents[1]), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path, "TUPLI_MCAP_CONFIG_DIR": str(target / "config")}
    return subprocess.run(
        [sys.executable, *code],
        cwd=corpus,
        env=environment,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )


def contents(directory: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(directory.rglob("*")) if path.is_file()}


@pytest.mark.sampled(0, keep=["5"])
@pytest.mark.parametrize("every", [1, 5])
def test_nothing_in_a_file_is_run(corpus: Path, tmp_path: Path, every: int) -> None:
    """Every operation on every file; or a fifth of them, each operation on a pickle, a space, a spec and a text."""
    shutil.copytree(corpus / "corpus/storage", tmp_path / "storage")
    before = contents(corpus)
    child = run_child(corpus, tmp_path, [str(SUPPORT / "trapped.py"), "corpus", str(tmp_path), str(every)])
    assert child.returncode == 0, child.stderr[-3000:]
    report = json.loads(child.stdout.splitlines()[-1])
    assert report["trapped"] == []
    assert report["wrong"] == []
    assert report["operations"] > 500 / every
    assert not (corpus / "marker").exists()
    assert {name: data for name, data in contents(corpus).items() if "__pycache__" not in name} == before


TRUSTING = """
import pathlib, sys
from tupli_mcap import Recording, TupliError
for name in sys.argv[1:]:
    with Recording(f"corpus/{name}.mcap") as recording:
        try:
            recording.benchmark.make_env(trust=True)
        except TupliError:
            pass
    if pathlib.Path("marker").exists():
        print(name)
        pathlib.Path("marker").unlink()
    sys.modules.pop("evil_module", None)
"""


def test_the_same_bundles_run_code_where_they_are_trusted(corpus: Path, tmp_path: Path) -> None:
    """The test above would show nothing if its bundles were harmless."""
    # The others are imported by other versions of gymnasium, or harm elsewhere.
    harmful = [
        f"spec_{name}" for name, _ in specs() if name in ("unregistered", "other_entry_point", "wrapper")
    ]
    harmful += [f"pickle_{name}" for name, _ in pickles(Path("/x"))]
    child = run_child(corpus, tmp_path, ["-c", TRUSTING, *harmful])
    assert child.stdout.splitlines() == harmful, child.stderr
    assert len(harmful) == 9


TRAPPED = """
import sys
from pathlib import Path
import trapped
from tupli_mcap import Recording
trap = trapped.Trap(Path(sys.argv[1]))
exec_, open_, run = exec, open, __import__("subprocess").run
for name, function in {
    "pickle": lambda: Recording("corpus/pickle_os_system.mcap").benchmark.make_env(trust=True),
    "spec": lambda: Recording("corpus/spec_other_entry_point.mcap").benchmark.make_env(trust=True),
    "import": lambda: __import__("evil_module"),
    "import_module": lambda: trapped.importlib.import_module("evil_module"),
    "loads": lambda: trapped.pickle.loads(b"N."),
    "find_class": lambda: trapped.pickle.Unpickler(trapped.io.BytesIO(b"cos\\nsystem\\n.")).load(),
    "subprocess": lambda: run(["true"]),
    "system": lambda: trapped.os.system("true"),
    "socket": lambda: __import__("socket").socket(),
    "write": lambda: open_("escaped", "w"),
    "create": lambda: trapped.os.open("escaped", trapped.os.O_CREAT | trapped.os.O_RDWR),
    "remove": lambda: trapped.os.remove("corpus/names.mcap"),
    "rename": lambda: trapped.os.rename("corpus/names.mcap", sys.argv[1] + "/x"),
    "mkdir": lambda: trapped.os.mkdir("escaped"),
    "compile": lambda: compile("1", "x", "eval"),
    "exec": lambda: exec_("1"),
    "fork": lambda: trapped.os.fork(),
}.items():
    trap.doing, trap.armed, before = name, True, len(trap.trapped)
    try:
        function()
    except Exception as err:
        pass
    trap.armed = False
    assert len(trap.trapped) > before, name
open_(sys.argv[1] + "/inside", "w").close()
print("all trapped")
"""


def test_the_traps_work(corpus: Path, tmp_path: Path) -> None:
    import socket  # noqa: F401 - imported in the child before the trap is armed, too

    child = run_child(
        corpus,
        tmp_path,
        ["-c", f"import sys, socket, subprocess; sys.path.append({str(SUPPORT)!r}){TRAPPED}", str(tmp_path)],
    )
    assert child.stdout == "all trapped\n", child.stderr[-2000:]
    assert not (corpus / "marker").exists()
