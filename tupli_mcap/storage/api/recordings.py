"""Recordings on a server, read in place, fetched and sent: methods of `TupliAPIClient`."""

from __future__ import annotations

import contextlib
import os
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from tupli_mcap.errors import NotFoundError, RecordingError
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.source import TemporarySource
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.recording.opened import is_finished
from tupli_mcap.remote import is_cut_cheaper, is_url, shown_name
from tupli_mcap.storage.api.answers import Ticket, as_told
from tupli_mcap.storage.api.session import Session
from tupli_mcap.storage.api.upload import Sent, Tell, digest_of, send_file
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.downloads import fetched
from tupli_mcap.storage.sidecar import Notes


class Recordings:
    """Methods for the recordings of a server."""

    _session: Session

    def open_recording(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        """The recording that an `EpisodeHeader.recording` names, read from the server; the caller closes it.

        `episodes` are the numbers of those that will be read (None: all); the recording may lack the others.

        Raises:
            NotFoundError: there is no such recording.
            StorageError: the server cannot be reached.
        """
        if not isinstance(recording, str):
            raise NotFoundError(
                f"expected the recording of an episode header, such as 'recordings/…/….mcap', found {recording!r:.80}"
            )
        numbers = None if episodes is None else list(map(int, episodes))  # they may be NumPy's
        ticket = self._ticket(recording)
        if ticket.whole and not is_cut_cheaper(numbers, ticket.episodes, ticket.size):
            return Recording(self._session.url + ticket.path)
        return self._cut(recording, numbers)

    def _cut(self, recording: str, episodes: list[int] | None) -> Recording:
        """A recording of some episodes, made by the server; a temporary file holds it while it is open."""
        asked = {"recordings": [recording], "episodes": episodes}
        handle, name = tempfile.mkstemp(prefix="tupli-mcap-", suffix=".mcap")
        place = Path(name)
        try:
            with os_errors("cannot write", place), os.fdopen(handle, "wb") as file:
                self._session.fetch("/v1/query", asked, file)
            source = TemporarySource(place, recording)
        except BaseException:
            place.unlink()
            raise
        return Recording(source)

    @contextlib.contextmanager
    def downloaded(
        self, recording: str, episodes: int, tell: Callable[[float], None] = lambda _: None
    ) -> Iterator[Path | None]:
        """The downloaded file of a recording, valid in the block; None if it has another number of readable episodes.
        `tell` is called with the parts of the file that have come; all are 1.

        Raises:
            NotFoundError: there is no such recording, or another file has replaced it meanwhile.
            FormatError: its bytes do not have the SHA-256 that the server named.
        """
        ticket = self._ticket(recording)
        if not ticket.whole or ticket.episodes != episodes:
            yield None
            return

        def pieces(start: int) -> Iterator[bytes]:
            for piece in self._session.stream(ticket.path, start):
                yield piece
                start += len(piece)
                if start > ticket.size:  # then the SHA-256 is another one, and nothing is kept
                    return

        size = max(ticket.size, 1)  # a server may tell anything
        with fetched(ticket.digest, pieces, tell=lambda count: tell(count / size)) as path:
            yield path

    def _ticket(self, recording: str) -> Ticket:
        asked = {"recording": recording}
        return as_told(Ticket, self._session.ask("POST", "/v1/tickets", asked, repeat=True))

    def push(self, path: str | Path, tell: Tell = lambda _: None) -> str:
        """Store a local recording, without the episodes that were deleted here; returns its name for `open_recording`.
        `tell` is called with numbers of sent bytes.

        Storing it twice changes nothing; a recording that has grown replaces its earlier version.

        Raises:
            RecordingError: it is not finished; nothing was sent.
            StorageError: the server refuses it: it is empty, or its benchmark is not stored.
        """
        return self.send(path, tell, Path(path).name).name

    def send(self, path: str | Path, tell: Tell = lambda _: None, name: str = "") -> Sent:
        """As `push`; tells also whether the server had the recording already. `name`: of its file, for the server."""
        if is_url(str(path)):
            raise RecordingError(
                f"expected a local path, found {shown_name(str(path)):.200}; tupli-mcap push sends it"
            )
        with without_deleted(Path(path)) as kept:
            return send_file(self._session, kept, name=name, tell=tell)

    def is_stored(self, recording: str, path: Path) -> bool:
        """Whether a recording on the server has the bytes of a file. NotFoundError if there is no such recording."""
        return self._ticket(recording).digest == digest_of(path)[0]


@contextlib.contextmanager
def without_deleted(path: Path, name: str = "") -> Iterator[Path]:
    """A file with the episodes of a finished recording that were not deleted: its own file, if none was. `name`: its
    path or URL, where `path` is a copy. RecordingError if it is not finished."""
    _demand_finished(path, name or str(path))
    notes = Notes.read(path)
    if notes.deleted:
        with Recording(path) as recording:
            deleted = notes.about(recording.metadata).deleted
            numbers = [number for number in recording.index["episode"].tolist() if number not in deleted]
            if len(numbers) < len(recording):
                with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
                    kept = Path(folder) / path.name
                    rewrite_recording(recording, kept, episodes=numbers)
                    yield kept
                return
    yield path


def _demand_finished(path: Path, name: str) -> None:
    if is_finished(path):
        return
    if is_locked(path):
        raise RecordingError(f"{shown_name(name)} is being recorded; send it when its writer has closed it")
    fetch, file = ("download it, ", "FILE") if is_url(name) else ("", shlex.quote(str(path)))
    raise RecordingError(
        f"{shown_name(name)} is not finished: its writer was killed, or its end is missing; {fetch}write a finished "
        f"copy with tupli-mcap recover {file}, and send that"
    )
