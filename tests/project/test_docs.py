"""What README, site and docstrings show is run, tested, or says why not; and the reference holds what there is."""

from __future__ import annotations

import builtins
import functools
import inspect
import json
import re
import shlex
import symtable
import sys
import tomllib
import types
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import typer

import tupli_mcap
from tupli_mcap.cli.app import _COMMANDS, _EXAMPLES, app

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "_ext"))
pytest.importorskip("sphinx", reason="the site's generator is in the extra `docs`")
import api  # noqa: E402
import built  # noqa: E402
import generated  # noqa: E402

CHANGES = ROOT / "docs" / "changes"
PAGES = [*ROOT.glob("*.md"), *(ROOT / "schemas").glob("*.md"), *(ROOT / "docs").rglob("*.md")]
PAGES = [path for path in PAGES if path.parent != CHANGES]  # whose code may be of an earlier version
RUN_BY_TESTS = {("README.md", "python"), ("README.md", "text")}  # test_readme
EARLIER = {("CHANGELOG.md", "python"), ("CHANGELOG.md", "console")}  # before a change, or after it
NO_CODE = {"", "text"}  # drawings, grammars, what a program prints
DIRECTIVE = re.compile(r"\{(code-cell|literalinclude|include|toctree|grid|grid-item-card|eval-rst|raw)\}")
_FENCE = re.compile(r"^ *```([^\n`]*)\n(.*?)^ *```$", re.MULTILINE | re.DOTALL)
_REASON = re.compile(r"<!-- not run: \S.{5,} -->\n$")


def unexplained(page: str, text: str) -> list[str]:
    """The blocks of a page that nothing runs and that do not say why, as `line: language`."""
    found = []
    for block in _FENCE.finditer(text):
        language, body = block[1].strip(), block[2]
        where = f"{page}:{text.count(chr(10), 0, block.start()) + 1}: {language}"
        if DIRECTIVE.match(language) or language in NO_CODE or (page, language) in RUN_BY_TESTS | EARLIER:
            continue
        if language == "json":
            for line in body.splitlines():
                json.loads(line)
        elif not _REASON.search(text[: block.start()]):
            found.append(where)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_block_is_run_or_says_why_not(path: Path) -> None:
    assert unexplained(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")) == []


def test_pages_with_cells_are_run() -> None:
    cells = [path for path in PAGES if "```{code-cell}" in path.read_text(encoding="utf-8")]
    assert cells
    for path in cells:
        assert path.read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n"), path


def unknown_names(text: str) -> list[str]:
    """The names that the Python cells of a page use and none of those that a reader sees has made."""
    known, found = set(dir(builtins)), set[str]()
    for block in _FENCE.finditer(text):
        if block[1] != "{code-cell} python" or re.match(r":tags: \[remove-(cell|input)", block[2]):
            continue
        table = symtable.symtable(re.sub(r"(?m)^:.*", "", block[2]), "cell", "exec")
        symbols = [*table.get_symbols()]
        known |= {each.get_name() for each in symbols if each.is_assigned() or each.is_imported()}
        found |= {each.get_name() for each in symbols if each.is_referenced()} - known
    return sorted(found)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_readers_see_where_names_are_from(path: Path) -> None:
    assert unknown_names(path.read_text(encoding="utf-8")) == []


def test_names_of_hidden_cells_are_found() -> None:
    hidden = "```{code-cell} python\n:tags: [remove-cell]\nrobot = 1\n```\n"
    seen = "```{code-cell} python\nimport math\nmath.sin(robot)\n```\n"
    assert unknown_names(hidden + seen) == ["robot"]
    assert unknown_names(hidden.replace(":tags: [remove-cell]\n", "") + seen) == []


def docstring_blocks(module: str) -> Iterator[tuple[str, str]]:
    """The code in docstrings of a module's public names, by name."""
    for name, value in api.public_names(module):
        members = vars(value).items() if isinstance(value, type) else ()
        own = [(f"{name}.{key}", member) for key, member in members if not key.startswith("__")]
        for label, one in [(name, value), *own]:
            if code := api.code_in(getattr(one, "__doc__", None) or ""):
                yield label, code


def test_public_names_have_docstrings() -> None:
    """Methods and properties too, own or inherited; functions name all arguments that are given by keyword."""
    assert list(undocumented()) == []


def undocumented() -> Iterator[str]:
    for module in api.MODULES:
        for name, value in api.public_names(module):
            if not getattr(value, "__module__", "").startswith("tupli_mcap"):
                continue
            if isinstance(value, type):
                ours = [one for one in value.__mro__ if one.__module__.startswith("tupli_mcap")]
                members = {key: one for base in reversed(ours) for key, one in vars(base).items()}
                for key, member in members.items():
                    is_code = isinstance(member, property | classmethod | staticmethod | types.FunctionType)
                    if is_code and not key.startswith("_") and not inspect.getdoc(getattr(value, key)):
                        yield f"{name}.{key}"
            elif isinstance(value, types.FunctionType):
                for parameter in inspect.signature(value).parameters.values():
                    told = re.search(rf"\b{parameter.name}\b", value.__doc__ or "")
                    if parameter.kind is parameter.KEYWORD_ONLY and not told:
                        yield f"{name}: {parameter.name}"


@pytest.mark.parametrize("module", api.MODULES)  # which are imported by this test: that takes seconds
def test_code_in_docstrings_runs(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, code in docstring_blocks(module):
        directory = tmp_path / name
        directory.mkdir()
        monkeypatch.chdir(directory)
        exec(compile(code, f"<docstring of {name}>", "exec"), _names(directory))


def _names(directory: Path) -> dict[str, Any]:
    """What the code in docstrings takes for granted."""
    import gymnasium as gym
    import numpy as np
    from gymnasium import spaces
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from torch.utils.data import DataLoader

    from tupli_mcap.sb3 import VecRecordEpisodes
    from tupli_mcap.torch import MapDataset, StreamDataset, collate
    from tupli_mcap.torch.rl import RecordedStorage

    class ShortPPO(PPO):
        """As long as a test may take."""

        def learn(self, steps: int) -> Any:
            return super().learn(64)

    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), directory / "runs" / "first.mcap") as env:
        state, _ = env.reset(seed=0)
        for _ in range(100):
            state, *_ = env.step(int(state[2] + 0.5 * state[3] > 0))
    space = spaces.Box(-1, 1, (2,), np.float32)
    row = np.zeros(2, np.float32)
    names: dict[str, Any] = {
        **vars(tupli_mcap), **{name: getattr(tupli_mcap, name) for name in tupli_mcap.__all__},
        "tupli_mcap": tupli_mcap, "dataset": tupli_mcap.open(directory / "runs"),
        "observation_space": space, "action_space": space,
        "state": row, "action": row, "final_state": row, "reward": 0.0, "terminal": True, "timeout": False,
        "observations": np.zeros((5, 2)), "actions": np.zeros((5, 2)), "rewards": np.zeros(5),
        "terminations": np.zeros(5, bool), "truncations": np.zeros(5, bool),
        "s0": np.zeros((4, 2)), "s1": np.zeros((3, 2)), "a0": np.zeros((3, 1)), "a1": np.zeros((2, 1)),
        "r0": np.zeros(3), "r1": np.zeros(2),
        "DataLoader": DataLoader, "MapDataset": MapDataset, "StreamDataset": StreamDataset, "collate": collate,
        "PPO": functools.partial(ShortPPO, n_steps=16, batch_size=64, n_epochs=1, device="cpu"),
        "RecordedStorage": RecordedStorage, "VecRecordEpisodes": VecRecordEpisodes, "make_vec_env": make_vec_env,
    }  # fmt: skip
    return names


COMMANDS: Any = typer.main.get_command(app)


@pytest.mark.parametrize("example", [one for examples in _EXAMPLES.values() for one in examples])
def test_examples_of_commands_are_understood(example: str) -> None:
    name, *words = shlex.split(example)
    command = COMMANDS.get_command(None, name)
    options = {option for param in command.params for option in param.opts + param.secondary_opts}
    assert {word for word in words if re.match(r"--?[a-z]", word) and word != "-return"} <= options


def test_the_reference_of_commands_holds_all() -> None:
    page = generated.replaced((ROOT / "docs/reference/commands.md").read_text(encoding="utf-8"))
    for names in _COMMANDS.values():
        for name in names:
            section = page.partition(f"\n### {name}\n")[2].partition("\n### ")[0]
            options = [
                o
                for p in COMMANDS.commands[name].params
                if not p.hidden
                for o in p.opts
                if o.startswith("--")
            ]
            assert [option for option in options if option not in section] == [], name


def test_the_reference_of_python_holds_all() -> None:
    pages = (ROOT / "docs" / "reference" / "api").glob("*.md")
    text = "\n".join(generated.replaced(page.read_text(encoding="utf-8")) for page in pages)
    entries = set(re.findall(r"^\.\. auto\w+:: (\S+)$", text, re.MULTILINE))
    names = {name for module in api.MODULES for name, _ in api.public_names(module)}
    helpers = {name for name in names if name.startswith("tupli_mcap.errors.")}
    assert names - helpers - entries == set()
    assert {f"tupli_mcap.{name}" for name in tupli_mcap.__all__} <= entries


def test_the_reference_of_http_holds_every_route() -> None:
    page = generated.replaced((ROOT / "docs/reference/http.md").read_text(encoding="utf-8"))
    import routes

    for path, methods in routes.document()["paths"].items():
        for method in methods:
            assert f"**`{method.upper()} {path}`**" in page


def test_every_environment_variable_is_listed() -> None:
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tupli_mcap").rglob("*.py"))
    page = (ROOT / "docs/reference/variables.md").read_text(encoding="utf-8")
    variables = re.compile(r"TUPLI_MCAP_[A-Z_]+")
    assert set(variables.findall(code)) == set(variables.findall(page))


def test_the_citation_is_of_this_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"\nversion: {project['version']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


# --- that these tests can fail ---


def test_blocks_without_a_reason_are_found() -> None:
    block = "```python\nx\n```\n\n"
    text = (
        f"{block}<!-- not run: needs a robot -->\n{block}<!-- not run: -->\n{block.replace('python', 'sh')}"
    )
    assert unexplained("page.md", text) == ["page.md:1: python", "page.md:11: sh"]
    with pytest.raises(json.JSONDecodeError, match="Expecting value"):
        unexplained("page.md", "```json\n{a}\n```\n".replace("{a}", "[1, }]"))


def test_foreign_hosts_and_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<script src="https://cdn.example/x.js"></script><a href="b.html#no">b</a>'
    )
    (tmp_path / "b.html").write_text(
        '<a id="yes" href="gone.html">x</a><style>@import "//fonts.example/f"</style>'
    )
    assert built.problems(tmp_path) == [
        "a.html: loads https://cdn.example/x.js",
        "a.html: links to b.html#no, which has no such place",
        "b.html: loads //fonts.example/f",
        "b.html: links to gone.html, which is not there",
    ]


def wrong_change(path: Path) -> str:
    """What is wrong with a fragment of the changelog; empty if nothing is."""
    name = re.fullmatch(r"\+[a-z0-9-]+\.(breaking|added|changed|fixed)\.md", path.name)
    if name is None:
        return f"{path.name}: expected a name such as +short-words.added.md"
    blocks = _FENCE.findall(path.read_text(encoding="utf-8"))
    if name[1] == "breaking" and len(blocks) != 2:
        return f"{path.name}: expected two blocks, code before and after, found {len(blocks)}"
    return ""


def test_changes_are_named_and_what_breaks_shows_how() -> None:
    assert [problem for path in sorted(CHANGES.glob("[!R]*")) if (problem := wrong_change(path))] == []


def test_only_the_version_of_the_package_is_unreleased() -> None:
    heading = f"## {version('tupli-mcap')} (unreleased)"
    shown = generated.replaced("<!-- generated: changes -->")
    assert shown.splitlines()[0] == heading if any(CHANGES.glob("+*.md")) else not shown
    assert "unreleased" not in (ROOT / "CHANGELOG.md").read_text()


def test_wrong_changes_are_found(tmp_path: Path) -> None:
    for name, text, problem in [
        ("12.added.md", "A thing.", "expected a name"),
        ("+a-thing.bugfix.md", "A thing.", "expected a name"),
        ("+a-thing.breaking.md", "A thing.", "expected two blocks, code before and after, found 0"),
        ("+a-thing.breaking.md", "A.\n\n```python\na\n```\n\nis now\n\n```python\nb\n```\n", ""),
    ]:
        (tmp_path / name).write_text(text)
        assert problem in wrong_change(tmp_path / name)
        assert bool(problem) == bool(wrong_change(tmp_path / name))
