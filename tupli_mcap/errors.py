"""The errors this package raises: one root, a few children, each for one kind of cause.

Every message is one sentence: what was expected, what was found, where, and what to do.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import functools
import itertools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

__all__ = [
    "FilterError",
    "FormatError",
    "MissingExtraError",
    "NotFoundError",
    "RecordingError",
    "SignatureError",
    "SpaceError",
    "StepError",
    "StorageError",
    "TupliError",
    "UntrustedError",
]

_SPACE = "free some space there, or choose another disk"
_FILES = "close some of them, or raise the limit (ulimit -n)"
_RIGHTS = "change its permissions, or choose another place"
_ADVICE: Final = {
    errno.ENOSPC: _SPACE,
    errno.EDQUOT: _SPACE,
    errno.EFBIG: "raise the limit (ulimit -f), or choose a disk that takes larger files",
    errno.EROFS: "choose a writable place",
    errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
    errno.EMFILE: _FILES,
    errno.ENFILE: _FILES,
    errno.ENOMEM: "free some memory",
    errno.EIO: "check the disk and its connection, or choose another disk",
    errno.ENOLCK: "the file system cannot lock files: choose another disk",
    errno.ENAMETOOLONG: "choose a shorter one",
    errno.ENOENT: "make its directory first",
    errno.ENOTDIR: "choose a path whose directories are directories",
}


_STATE = ("states", "observations", "state")
_NEXT_STATE = ("next_states", "next_observations", "next_state")
_ACTION, _REWARD = ("actions", "action"), ("rewards", "reward")
_LENGTH = ("n_steps", "steps")
_TERMINAL, _TIMEOUT = ("terminals", "terminal"), ("timeouts", "timeout")
_OTHERWISE: Final = {
    **dict.fromkeys(("obs", "observation", "observations", "states", "state"), _STATE),
    **dict.fromkeys(("next_obs", "next_observation", "next_observations", "next_states"), _NEXT_STATE),
    **dict.fromkeys(("act", "acts", "action", "actions"), _ACTION),
    **dict.fromkeys(("rew", "rews", "reward", "rewards"), _REWARD),
    **dict.fromkeys(("done", "dones", "terminated", "terminateds", "terminations", "terminals"), _TERMINAL),
    **dict.fromkeys(("len", "length", "num_steps", "total_steps", "n_tuples", "n_steps"), _LENGTH),
    **dict.fromkeys(("truncated", "truncateds", "truncations", "timeouts"), _TIMEOUT),
    **dict.fromkeys(("with_episode_filter", "with_benchmark_filter"), ("filter",)),
    "env_id": ("run.environment",),
}
"""Other names of columns, of keys of episodes and of `filter`, and ours: the error names the first that there is."""

_LOOKED_AT: Final = 1000  # entries of a directory, for names like one that is not there
_OURS: Final = (f"{Path(__file__).parent}{os.sep}", contextlib.__file__, functools.__file__)  # no caller's


class TupliError(Exception):
    """Root of every error this package raises on purpose."""


class SpaceError(TupliError):
    """A Gymnasium space cannot be recorded, or does not equal the recorded one."""


class StepError(TupliError):
    """A step cannot be stored exactly; everything recorded before it is safe."""


class FormatError(TupliError):
    """A defect in a file: what was expected, what was found, the path and the offset."""


class RecordingError(TupliError):
    """A recording cannot be opened, read or written: it exists, is in use, is closed, or the system refuses."""


class StorageError(TupliError):
    """A storage operation failed."""


class NotFoundError(StorageError, KeyError):
    """A storage has no benchmark, artifact or episode of that id."""

    def __str__(self) -> str:  # KeyError would show the repr
        return str(self.args[0]) if self.args else ""


class FilterError(TupliError, ValueError):
    """An invalid filter: an unknown key, a value that cannot be compared, bad syntax.

    Attributes:
        position: the character (from 0) of the filter's text where the mistake is; None for a filter without a text.
    """

    position: int | None = None

    def at(self, position: int) -> Self:
        """The same error with a position."""
        self.position = position
        return self


class UntrustedError(TupliError):
    """Code from a file would run, and nobody on this machine has trusted it."""


class SignatureError(TupliError):
    """A signature or a key is missing, is unknown, or does not fit what was signed."""


class MissingExtraError(TupliError, ImportError):
    """An optional dependency is not installed; the message names the extra to install."""


class Gathered:
    """Errors of several recordings, kept until all have been looked at, and then raised as one."""

    def __init__(self) -> None:
        self._errors: list[TupliError] = []

    @contextlib.contextmanager
    def keep(self) -> Iterator[None]:
        """Keeps the error of a recording that the block raises."""
        try:
            yield
        except (FormatError, RecordingError, StorageError) as err:
            self._errors.append(err)

    def raise_all(self) -> None:
        """Raises the error that was kept, and a RecordingError with the messages of all if several differ."""
        messages = dict.fromkeys(map(str, self._errors))
        if len(messages) == 1:
            raise self._errors[0]
        if messages:
            raise RecordingError(f"nothing was changed: {'; also, '.join(messages)}")


_in_command: Final = ContextVar("_in_command", default=False)


@contextlib.contextmanager
def in_command() -> Iterator[None]:
    """Within the block, messages name the options of a command instead of arguments in Python."""
    token = _in_command.set(True)
    try:
        yield
    finally:
        _in_command.reset(token)


def asking(argument: str, option: str) -> str:
    """How the one who reads a message asks for something: `overwrite=True`, or `--force` if a command was called."""
    return option if _in_command.get() else argument


def taken(path: object) -> str:
    """The message that a path which would be written is in use."""
    return f"{path} exists; choose another path, or pass {asking('overwrite=True', '--force')}"


def brief(err: BaseException | None) -> str:
    """An exception in one line: `ValueError: its message`."""
    text = " ".join(str(err).split())[:300]
    return f"{type(err).__name__}: {text}" if text else type(err).__name__


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns at the line of the caller outside of this package."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_OURS):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def plural(count: int, noun: str) -> str:
    """`1 episode`, `1,200 episodes`."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def bytes_of(size: int) -> str:
    """A size: `512 B`, `18.3 kB`, `2.0 GB`."""
    value, unit = float(size), "B"
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if value < 999.95 or unit == "TB":
            break
        value /= 1000
    return f"{size} B" if unit == "B" else f"{value:.1f} {unit}"


def by_words(meant: Mapping[str, str]) -> dict[str, str]:
    """What several words mean, by each of them: `{"rm remove": "delete"}` is `{"rm": "delete", "remove": "delete"}`."""
    return {word: what for words, what in meant.items() for word in words.split()}


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """` (did you mean 'return'?)` where one of the known names is like this one, or has it as a word, else nothing."""
    text, names = str(name), list(known)
    close = [meant for meant in _OTHERWISE.get(text, ()) if meant in names]
    close = close or difflib.get_close_matches(text, names, n=1, cutoff=0.6)
    close = close or sorted((each for each in names if text in re.split("[-_]", each)), key=len)
    return f" (did you mean {close[0]!r}?)" if close else ""


def no_file(path: Path, give: str = "give a recording (.mcap) or a directory of them") -> RecordingError:
    """The error for a path that does not exist: what to give, and what is there instead."""
    return RecordingError(f"{path} does not exist; {give}{_there_instead(path)}")


def _there_instead(path: Path) -> str:
    """` (did you mean 'runs/ppo.mcap'?)`, or else ` (in runs: a.mcap, b.mcap, c.mcap and 3 more)`; or nothing."""
    try:
        folder = next(each for each in path.parents if each.is_dir())
        missing, *rest = path.relative_to(folder).parts
        with os.scandir(folder) as entries:
            names = sorted(
                each.name for each in itertools.islice(entries, _LOOKED_AT) if each.name[:1] != "."
            )
    except (OSError, ValueError, StopIteration):  # a NUL in the path, for example
        return ""
    by_stem = {name.removesuffix(".mcap"): name for name in names}
    for stem in difflib.get_close_matches(missing.removesuffix(".mcap"), by_stem, n=3):
        meant = folder.joinpath(by_stem[stem], *rest)
        if meant.exists():
            return f" (did you mean {str(meant)!r}?)"
    files = [name for name in names if name.endswith(".mcap")]
    if not files or rest:
        return ""
    more = f" and {len(files) - 3:,} more" if len(files) > 3 else ""
    where = "here" if folder == Path() else f"in {folder}"
    return f" ({where}: {', '.join(files[:3])}{more})"


class SaysWhatIsMeant:
    """Suggests the name that may be meant when an attribute does not exist, in notebooks too."""

    _elsewhere: ClassVar[Mapping[str, str]] = {}
    """By names that may be expected here, where their values are."""

    if not TYPE_CHECKING:  # type checkers must still report unknown names

        def __getattr__(self, name: str) -> Any:
            known = dir(type(self))
            if name in known:  # a property that raised AttributeError
                return object.__getattribute__(self, name)
            meant = "" if name.startswith("_") else did_you_mean(name, [n for n in known if n[0] != "_"])
            ours = _OTHERWISE.get(name, ())
            if ours and "read" in known and not set(ours) & {*known}:
                # columns exist only in the result of `read`
                meant = f" (read() gives its columns: read().{ours[0]})"
            if name in type(self)._elsewhere:
                meant = f" ({type(self)._elsewhere[name]})"
            # without `obj=`: with it, Python would add a hint of its own
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}{meant}", name=name
            )


def missing_extra(what: str, extra: str) -> MissingExtraError:
    """The error for an extra that is not installed; `what` says what needs which package."""
    return MissingExtraError(f"{what}: {install_line(extra)}")


def install_line(extra: str) -> str:
    """The command that installs an extra from the source of this package: an index, a checkout, a directory, a file."""
    import shlex

    checkout = Path(__file__).absolute().parents[1]
    try:
        own = 'name = "tupli-mcap"\n' in (checkout / "pyproject.toml").read_text()
    except (OSError, UnicodeDecodeError):
        own = False
    if own:
        return f"pip install -e {shlex.quote(f'{checkout}[{extra}]')}"
    origin = _origin() or "tupli-mcap"
    return f"pip install {shlex.quote(f'{origin}[{extra}]')}"


def _origin() -> str | None:
    """The directory or file that pip installed this package from; None if it was an index."""
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import unquote, urlsplit

    try:
        url = urlsplit(json.loads(distribution("tupli-mcap").read_text("direct_url.json") or "{}")["url"])
    except (PackageNotFoundError, ValueError, KeyError):
        return None
    path = unquote(url.path)
    return path if url.scheme == "file" and Path(path).exists() else None


@contextlib.contextmanager
def memory_for(what: Callable[[], str]) -> Iterator[None]:
    """Turns a MemoryError into a RecordingError that says what the memory was for."""
    try:
        yield
    except MemoryError as err:
        raise RecordingError(
            f"{what()} needs more memory than there is ({err or 'out of memory'}); read fewer episodes at a time"
        ) from err


def os_reason(err: OSError) -> str:
    """Why the system refused, and what to do: `No space left on device; free some space there, ...`."""
    reason = err.strerror or str(err) or type(err).__name__
    return f"{reason}; {_ADVICE.get(err.errno or 0, 'choose another place')}"
