"""Which infos of the steps are recorded, and their way into the journal."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tupli_mcap.errors import RecordingError, did_you_mean
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.recording.write.options import RecordInfo
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import shorten


def entries_of(given: Any, what: str) -> dict[str, Any]:
    """A copy of a dict of entries, empty for None; RecordingError if it is something else."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise RecordingError(f"{what}: expected a dict, found {shorten(given)}")
    return dict(given)


class InfoRecorder:
    """Chooses infos and puts them into the journal.

    Args:
        select: True for everything, the names of entries, or a function that returns what to record.

    Attributes:
        codec: encodes the entries of a step.
    """

    def __init__(self, select: RecordInfo) -> None:
        if isinstance(select, str):
            select = [select]
        if not isinstance(select, bool) and not callable(select) and isinstance(select, Iterable):
            select = list(select)
        named = isinstance(select, list) and all(isinstance(name, str) for name in select)
        if not (isinstance(select, bool) or callable(select) or named):
            raise RecordingError(
                f"record_info: expected True, False, a list of names or a function, found {select!r:.80}"
            )
        self._names = [] if isinstance(select, bool) or callable(select) else list(dict.fromkeys(select))
        self._unseen = set(self._names)
        self._last: tuple[Any, ...] | None = None  # keys of the last info, while a name is unseen
        self._select = select
        self.codec = InfoCodec(self._names)

    def chosen(self, info: Mapping[str, Any] | None) -> dict[str, Any]:
        """The entries of an environment's info that are to be recorded."""
        if self._select is False:
            return {}
        info = entries_of(info, "info")
        if callable(self._select):
            return entries_of(self._select(info), "record_info: what the function returns")
        if self._select is True:
            return info
        found = {name: info[name] for name in self._names if name in info}
        if self._unseen:
            self._unseen.difference_update(found)
            self._last = tuple(info)
        return found

    def warn_of_unseen(self, path: Path) -> None:
        """Warns once of names that no step's info had, if there were steps."""
        unseen, self._unseen = sorted(self._unseen), set()
        if unseen and self._last is not None:
            said = ", ".join(f"{name!r}{did_you_mean(name, map(str, self._last))}" for name in unseen)
            warnings.warn(f"{path}: record_info: no step's info had {said}", stacklevel=3)

    def put(self, writer: RecordingWriter, episode: int, step: int, info: Mapping[str, Any]) -> None:
        """Appends the entries of one step to the journal."""
        if writer.infos is None or writer.channels.info is None:
            return
        body = self.codec.encode(episode, step, info)
        writer.infos.append(time.time_ns(), (writer.channels.info, body))
