"""The application: its commands, and the one place that turns an error into a line and an exit code.

Exit codes: 0 (success), 1 (the command failed, or found a problem), 2 (wrong usage), 130 (Ctrl-C). Only light modules
are imported here; each command imports what it calls, so that help and completion are quick.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from tupli_mcap import errors
from tupli_mcap.cli import doctor, episodes, info, ls, record, render, storage, verify, view
from tupli_mcap.cli.edit import about, copy, recover
from tupli_mcap.cli.output import begin_json, print_json_error
from tupli_mcap.cli.share import bundle, exchange, people, serve, trust
from tupli_mcap.cli.terminal import (
    fail,
    fetch_progress,
    flush,
    print_traceback,
    say,
    say_interrupted,
    stop_writing,
    warnings_in_one_line,
)
from tupli_mcap.errors import FilterError, TupliError, by_words, did_you_mean, in_command

FAILED, USAGE, INTERRUPTED = 1, 2, 130  # 128 + SIGINT, as shells have it
_VALUES = {"int": "N", "float": "N", "str": "TEXT", "path": "PATH", "file": "FILE"}  # in helps


class _Group(TyperGroup):
    """Errors are one line on stderr; `--debug`, anywhere before `--`, adds the traceback."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        words = list(sys.argv[1:] if args is None else args)
        given = words[: words.index("--")] if "--" in words else words
        debug, as_json = "--debug" in given, "--json" in given
        words = [word for word in given if word != "--debug"] + words[len(given) :]
        begin_json(_command_in(given))
        try:
            from_servers = any("://" in word for word in given)
            with (
                in_command(),
                warnings_in_one_line(),
                fetch_progress() if from_servers else contextlib.nullcontext(),
            ):
                code = super().main(words, prog_name, complete_var, False, windows_expand_args, **extra)
            flush()
        except BaseException as err:  # noqa: BLE001 - _report raises again what is not for the user
            if debug and not isinstance(err, SystemExit):
                print_traceback(err)
            code = _report(err, given, as_json=as_json)
            with _to_nowhere_if_full():
                flush()
        if not standalone_mode:
            return code
        sys.exit(code if isinstance(code, int) else 0)

    def make_context(self, *args: Any, **extra: Any) -> Any:
        with _before_typer():
            return super().make_context(*args, **extra)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        # Typer would suggest hidden ones, too.
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            ctx.fail(f"No such command {args[0]!r}{_similar(args[0])}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        with _before_typer():
            return super().invoke(ctx)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Writes the commands in groups."""
        width = max(map(len, _NAMES))
        limit = formatter.width - 6 - width
        for title, commands in _COMMANDS.items():
            found = {name: self.get_command(ctx, name) for name in commands}
            lines = [
                (name.ljust(width), command.get_short_help_str(limit))
                for name, command in found.items()
                if command is not None
            ]
            with formatter.section(title):
                formatter.write_dl(lines)


class _Command(TyperCommand):
    """A command whose help names values in plain words, and ends with examples."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        for title, kind in (("Arguments", "argument"), ("Options", "option")):
            records = [
                param.get_help_record(ctx) for param in self.get_params(ctx) if param.param_type_name == kind
            ]
            lines = [(_plain(record[0], kind), record[1]) for record in records if record is not None]
            if lines:
                with formatter.section(title):
                    formatter.write_dl(lines)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        name = self.name or ""
        lines = _EXAMPLES.get(_OTHER_NAMES.get(name, name), ())
        if lines:
            with formatter.section("Examples"):
                for line in lines:
                    formatter.write(f"  tupli-mcap {line}\n")


def _plain(name: str, kind: str) -> str:
    """The name of a parameter in a help, with `N` or `TEXT` in place of Python's types, which typer adds."""
    given, _, told = name.partition(" <")
    if not told or kind == "argument":
        return given
    python_type = told.removesuffix(">")
    return f"{given} {_VALUES.get(python_type.removesuffix(' range'), python_type)}"


class _InterruptedError(TupliError):
    """The user pressed Ctrl-C. The message is the command's note on it, and may be empty."""


@contextlib.contextmanager
def _before_typer() -> Iterator[None]:
    """Turns Ctrl-C into our own error, because typer would turn it into an Abort without the message."""
    try:
        yield
    except KeyboardInterrupt as err:
        raise _InterruptedError(*err.args) from err


def _command_in(words: Sequence[str]) -> str | None:
    """The name of the command in the words of a call, of a hidden one its other name; None if there is no such command.
    It is the first word that is no option: those before it have no values."""
    first = next((word for word in words if not word.startswith("-")), "")
    name = _OTHER_NAMES.get(first, first)
    return name if name in _NAMES else None


def _what_is_safe(words: Sequence[str]) -> str:
    """What Ctrl-C leaves of a command. A file is replaced as a whole or not at all, so this holds at any time."""
    command = _command_in(words)
    if command is None or command in _READING:
        return "nothing was changed"
    if command in ("push", "pull"):
        return "what has arrived is kept; run it again to go on"
    if command in _ASKING:
        return "the server may have done it all the same"
    return "every file is as it was, or finished"


def _report(err: BaseException, words: Sequence[str], *, as_json: bool) -> int:
    """Prints an error as a line, and as JSON if asked; returns the exit code. Raises a bug of ours again."""
    message = str(err)
    code, kind = FAILED, _kind_of(err)
    if isinstance(err, OSError) and err.errno == errno.EPIPE:
        # The reader of our output is gone (`| head`). Python must not write to it at exit either.
        stop_writing()
        return FAILED
    if isinstance(err, _InterruptedError | KeyboardInterrupt):
        message = f"interrupted; {message or _what_is_safe(words)}"
        say_interrupted(message)
        if as_json:
            _print_json_error("Interrupted", message, INTERRUPTED)
        return INTERRUPTED
    if isinstance(err, TupliError):
        code = USAGE if isinstance(err, FilterError) else FAILED  # filters come from the command line only
    elif isinstance(err, MemoryError):
        message = f"not enough memory ({message or 'out of memory'}); --debug shows where"
    elif isinstance(err, OSError):
        name = "" if err.filename is None else f"{os.fsdecode(err.filename)}: "
        message = f"{name}{err.strerror or err}"
    elif hasattr(err, "format_message"):  # an error of typer, whose classes differ between its versions
        from tupli_mcap.remote import shown_argument

        message = shown_argument(err.format_message().replace(": Value error, ", ": "))  # from pydantic
        code, kind = getattr(err, "exit_code", USAGE), "UsageError"
        context = getattr(err, "ctx", None)
        if context is not None:
            message = f"{message.rstrip('.')}; see {context.command_path} --help"
    else:
        if as_json and isinstance(err, Exception):
            _print_json_error(kind, message, FAILED)
        raise err
    fail(message)
    if as_json:
        _print_json_error(kind, message, code)
    return code


def _print_json_error(kind: str, message: str, exit_code: int) -> None:
    """Prints an error as JSON, if stdout takes it; the line on stderr says it, too."""
    with _to_nowhere_if_full():
        print_json_error(kind, message, exit_code)


@contextlib.contextmanager
def _to_nowhere_if_full() -> Iterator[None]:
    """If stdout takes no more of what the block writes, drops it: Python would fail on it once more at exit."""
    try:
        yield
    except OSError:
        stop_writing()


def _kind_of(err: BaseException) -> str:
    """The public name of an error: a class of `tupli_mcap.errors`, else OSError, else the name of its own class."""
    known = [kind.__name__ for kind in type(err).__mro__ if kind.__name__ in (*errors.__all__, "OSError")]
    return known[0] if known else type(err).__name__


app = typer.Typer(
    name="tupli-mcap",
    cls=_Group,
    invoke_without_command=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        say(f"tupli-mcap {version('tupli-mcap')}")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Record reinforcement-learning episodes as MCAP files, look at them, share them.

    With --json, commands print results and errors as JSON. Exit codes: 0 (success), 1 (the
    command failed, or found a problem), 2 (wrong usage), 130 (interrupted by Ctrl-C; it is how
    browse, serve and view --web end, with 0).
    """
    if context.invoked_subcommand is None:
        say(*context.get_help().split("\n"))


def _version() -> None:
    """Print the version."""
    _print_version(True)


def _help(
    context: typer.Context,
    command: Annotated[
        str | None, typer.Argument(metavar="[COMMAND]", help="The command to explain.")
    ] = None,
) -> None:
    """Explain a command, or list all commands."""
    root = context.find_root()
    group: Any = root.command
    if command is None:
        say(*root.get_help().split("\n"))
        return
    found = group.get_command(root, command)
    if found is None:
        raise typer.BadParameter(f"there is no command {command!r}{_similar(command)}", context)
    with found.make_context(command, [], parent=root, resilient_parsing=True) as its:
        say(*found.get_help(its).split("\n"))


_FUNCTIONS: dict[str, list[Callable[..., None]]] = {
    "Record": [record.record],
    "Look": [ls.ls, info.info, episodes.episodes, view.view, serve.browse, render.plot, render.render],
    "Check": [doctor.doctor, verify.verify],
    "Edit": [about.tag, about.edit, copy.filter_, storage.delete, storage.restore, copy.trim,
        copy.relabel, copy.merge, copy.split, recover.recover],
    "Share": [bundle.bundle, bundle.import_, bundle.export, trust.trust, trust.untrust],
    "Server": [serve.serve, people.login, people.logout, people.whoami, people.signup, people.password,
        exchange.push, exchange.pull, exchange.publish, exchange.unpublish, serve.backup_server,
        serve.restore_server],
    "People": [people.list_users, people.set_quota, people.delete_user, people.list_groups, people.read_group,
        people.create_group, people.delete_group, people.add_members, people.remove_members,
        people.list_roles, people.create_role, people.delete_role, people.list_tokens,
        people.create_token, people.delete_token],
    "Storage": [storage.list_benchmarks, storage.list_artifacts, storage.list_episodes, storage.rename,
        storage.compact, storage.reindex, storage.declare_key],
    "Help": [_help, _version],
}  # fmt: skip
_COMMANDS = {
    title: {each.__name__.strip("_").replace("_", "-"): each for each in functions}
    for title, functions in _FUNCTIONS.items()
}
"""By their titles in `--help`, the commands by name, which is that of their function."""
_EXAMPLES: dict[str, Sequence[str]] = {
    "record": (
        "record CartPole-v1 -o run.mcap --steps 10000 --seed 1",
        "record CartPole-v1 -o run.mcap --num-envs 8 --policy my_agent:act",
        "record CartPole-v1 -o runs/ --name random --set policy=random",
    ),
    "ls": (
        "ls",
        "ls runs/ --filter 'run.metadata.lr < 1e-3' --sort -return --limit 5",
        "ls lab/ --columns run,return,started",
    ),
    "tag": (
        "tag run.mcap --episodes 3,7 success=true note='gripper slipped'",
        "tag runs/ --filter 'return > 100' quality=good",
        "tag run.mcap --undo",
    ),
    "edit": (
        "edit run.mcap --name ppo-seed3 --set lr=0.0003 --tag baseline",
        "edit runs/ --filter 'run.name ~ \"ppo\"' --tag baseline",
        "edit run.mcap --undo",
    ),
    "info": ("info run.mcap", "info runs/", "info run.mcap --filter 'return > 100'"),
    "episodes": (
        "episodes run.mcap --filter 'return > 100'",
        "episodes a.mcap b.mcap --sort -return --limit 10",
        "episodes lab/ --limit 20 --json",
    ),
    "view": ("view run.mcap", "view run.mcap --episodes best,worst --compare", "view lab/ --web"),
    "browse": ("browse runs/", "browse run.mcap", "browse lab/ --port 8000 --no-open"),
    "plot": ("plot run.mcap -o report.html", "plot runs/ --x steps -o compared.pdf"),
    "render": ("render run.mcap -o best.mp4", "render run.mcap -o first.gif --episodes first --rerun"),
    "doctor": ("doctor run.mcap", "doctor runs/ --fail-on warning", "doctor run.mcap --episodes best,worst"),
    "verify": ("verify run.mcap", "verify run.mcap --rerun --episodes 0,4,10-19"),
    "filter": (
        "filter a.mcap --filter 'return > 9 and success' -o b.mcap",
        "filter a.mcap --episodes 3,7-9 -o b.mcap",
        "filter a/ --filter 'steps > 9' --sort -return --limit 5 -o c.mcap",
        "filter https://example.org/a.mcap --filter 'return > 100' -o b.mcap",
    ),
    "delete": (
        "delete run.mcap --episodes 3,7",
        "delete lab/ --filter 'return < 10' --dry-run",
        "delete http://127.0.0.1:8080 --filter 'run.name = \"ppo-3\"'",
    ),
    "restore": ("restore run.mcap", "restore run.mcap --episodes 3"),
    "trim": (
        "trim run.mcap --steps 10:-5 -o trimmed.mcap",
        "trim run.mcap --episodes 3 --steps :200 -o trimmed.mcap",
    ),
    "relabel": (
        "relabel run.mcap --function my_rewards:shaped -o shaped.mcap",
        "relabel runs/ --function my_robot:clip --field actions -o b.mcap",
    ),
    "merge": ("merge a.mcap b.mcap -o all.mcap",),
    "split": ("split all.mcap -o part.mcap --episodes 1000",),
    "recover": ("recover run.mcap", "recover runs/ --in-place", "recover a.mcap b.mcap --dry-run"),
    "bundle": (
        "bundle run.mcap -o bundle.mcap",
        "bundle 3f2a --storage lab -o bundle.mcap --sign ~/.ssh/id_ed25519",
    ),
    "import": ("import bundle.mcap --storage lab --dry-run", "import bundle.mcap --storage lab"),
    "export": ("export --storage lab --filter 'return > 100' -o good.mcap",),
    "trust": ("trust run.mcap --show", "trust --key colleague.pub --name colleague"),
    "untrust": ("untrust run.mcap",),
    "backup-server": ("backup-server shared/ -o backup/",),
    "restore-server": ("restore-server backup/ shared/",),
    "serve": ("serve shared/", "serve shared/ --host 0.0.0.0 --port 80 --guests"),
    "login": ("login ann --url http://192.0.2.7:8080",),
    "signup": ("signup ann",),
    "logout": ("logout",),
    "whoami": ("whoami", "whoami --url http://192.0.2.7:8080"),
    "password": ("password", "password ann"),
    "push": ("push lab/", "push runs/*.mcap", "push lab/ --benchmark 3f2a --filter 'return > 100'", "push"),
    "pull": ("pull 3f2a --storage lab", "pull --filter 'return > 100' --storage lab --dry-run"),
    "publish": (
        "publish 3f2a",
        "publish 3f2a --group robots --filter 'return > 100'",
        "publish --filter 'run.name = \"teleop\"'",
    ),
    "unpublish": ("unpublish 3f2a --group robots", "unpublish --filter 'run.name = \"teleop\"'"),
    "list-users": ("list-users",),
    "set-quota": ("set-quota ann 50", "set-quota ann"),
    "delete-user": ("delete-user ann",),
    "list-groups": ("list-groups",),
    "read-group": ("read-group robots",),
    "create-group": ("create-group robots --description 'those with arms'",),
    "delete-group": ("delete-group robots",),
    "add-members": ("add-members robots ann bob", "add-members robots ann --role contributor"),
    "remove-members": ("remove-members robots bob",),
    "list-roles": ("list-roles",),
    "create-role": ("create-role looker episode_read benchmark_read",),
    "delete-role": ("delete-role looker",),
    "list-tokens": ("list-tokens",),
    "create-token": ("create-token robot --write --days 30", "create-token ci --forever"),
    "delete-token": ("delete-token 0f3c9a1b2d4e5f60",),
    "list-benchmarks": ("list-benchmarks --storage lab", "list-benchmarks --storage http://127.0.0.1:8080"),
    "list-artifacts": ("list-artifacts --storage lab",),
    "list-episodes": ("list-episodes --storage lab --filter 'metadata.score > 30'",),
    "rename": ("rename 3f2a 'cart pole, windy' --storage lab", "rename 3f2a --undo --storage lab"),
    "compact": ("compact run.mcap", "compact lab/ --dry-run"),
    "reindex": ("reindex --storage lab",),
    "declare-key": (
        "declare-key metadata.score --storage lab",
        "declare-key metadata.score --storage http://127.0.0.1:8080",
    ),
    "help": ("help view",),
}
_NAMES = [name for commands in _COMMANDS.values() for name in commands]
_MEANT = by_words(
    {
        "rollout run": "record",
        "list list-runs list-recordings runs": "ls",
        "describe stats summary": "info",
        "cat dump print read": "episodes",
        "play rerun show visualize": "view",
        "gui ui web": "browse",
        "film video": "render",
        "compare report": "plot",
        "check lint validate": "verify",
        "annotate label metadata note": "tag",
        "mv set": "edit",
        "find grep head query sample search select": "filter",
        "remove rm": "delete",
        "undelete undo": "restore",
        "cut slice": "trim",
        "concat join": "merge",
        "fix repair": "recover",
        "sign": "bundle",
        "convert": "export",
        "server start": "serve",
        "share upload": "push",
        "clone download sync": "pull",
        "clean gc prune": "compact",
    }
)
"""Names that other programs have for a command."""


def _similar(name: str) -> str:
    """As `did_you_mean`, of commands."""
    return did_you_mean(_MEANT.get(name, name), _NAMES)


_READING = {name for name in _NAMES if name.startswith("list-")}.union(
    ("ls", "info", "episodes", "browse", "whoami", "read-group"), _COMMANDS["Check"], _COMMANDS["Help"]
)
_ASKING = {*_COMMANDS["Server"], *_COMMANDS["People"]} - {"serve", "backup-server", "restore-server"}
for _commands in _COMMANDS.values():
    for _name, _command in _commands.items():
        app.command(_name, cls=_Command)(_command)
_OTHER_NAMES = {"replay": "view", "map": "relabel"}
"""Hidden names of commands: an earlier one, and the one in Python."""
app.command("replay", cls=_Command, hidden=True)(view.view)
app.command("map", cls=_Command, hidden=True)(copy.relabel)


def main() -> None:
    """The console entry point."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell (`>&-`)
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115, PTH123 - open until the end
    shown = contextlib.ExitStack()
    shown.enter_context(warnings_in_one_line())
    atexit.register(shown.close)  # after what is sent at exit, which may warn
    try:
        app()
    except KeyboardInterrupt:  # before a command began
        fail("interrupted")
        sys.exit(INTERRUPTED)
    except Exception as err:  # noqa: BLE001 - a bug of ours; its message may hold text of a file, which must be escaped
        print_traceback(err)
        sys.exit(FAILED)
