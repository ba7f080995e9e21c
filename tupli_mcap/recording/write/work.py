"""The mark of unfinished work, which keeps steps safe if something interrupts the recorder.

A signal handler, or another thread, may raise at any instruction, and once more while that is handled. So nothing that
keeps steps safe waits for an exception handler:

1. `Work.state` is set before work that must be whole, and goes back to DONE when it is.
2. Whoever finds it set does not trust what is in memory. The file and its journal are whole at every moment: the
   recording is finished from them, as after a killed process.
3. Handlers make it DONE again where they know that nothing was left half done. They need not be reached.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal, NoReturn, Protocol, TypeVar

from tupli_mcap.errors import RecordingError, StepError

if TYPE_CHECKING:
    from collections.abc import Callable

    from tupli_mcap.recording.write.writer import RecordingWriter

T = TypeVar("T")

DONE: Final = 0
"""Nothing is half done."""
BEGUN: Final = 1
"""The recorder works."""
ASKING: Final = 2
"""Within a step or a reset, the environment or a callback works: what the recorder has in memory is whole."""
CLOSED: Final = 3
"""The files are finished."""


class FileRecorder(Protocol):
    """Records the episodes that go to one file, which `writer` writes."""

    writer: RecordingWriter

    def close(self) -> None:
        """Ends what runs as interrupted and finishes the file."""
        ...


class Work:
    """What one wrapper records: the recorders whose files are not finished, and the mark. Not thread-safe.

    As a context manager it marks a block, which stays marked if anything but a refused step breaks it off.

    Attributes:
        state: DONE, BEGUN, ASKING or CLOSED.
        recorders: the last one takes the steps; those before it were left by a rotation that was interrupted.
    """

    __slots__ = ("recorders", "state")

    def __init__(self) -> None:
        self.state = DONE
        self.recorders: list[FileRecorder] = []

    def __enter__(self) -> None:
        self.state = BEGUN

    def __exit__(self, _: object, err: BaseException | None, __: object) -> Literal[False]:
        if err is None:
            self.finish()
        elif self.is_whole_after(err):
            self.state = DONE
        else:
            self.recorders[-1].writer.stop(err)
        return False

    def ask(self, function: Callable[..., T], *args: Any) -> T:
        """Calls what is not the recorder's within a step: a callback, or what renders."""
        self.state = ASKING
        result = function(*args)
        self.go_on()
        return result

    def go_on(self) -> None:
        """Goes on after what was asked, which may have closed the recording, or flushed it in vain; RecordingError if
        it has."""
        if self.state != ASKING:
            self.refuse()
        self.state = BEGUN

    def finish(self) -> None:
        """The work is done; nothing is half done any more. RecordingError if a signal handler has closed the recording
        within it."""
        if self.state != BEGUN:
            self.refuse()
        self.state = DONE

    def is_whole_after(self, err: BaseException) -> bool:
        """Whether nothing was left half done: what was asked raised, or a step was refused before anything changed."""
        return self.state == ASKING or isinstance(err, StepError)

    def refuse(self) -> NoReturn:
        """Raises the RecordingError that says why no more can be recorded: earlier work was not finished."""
        raise self.recorders[-1].writer.why_stopped()

    def flush(self) -> None:
        """Writes everything recorded so far into chunks; callbacks may ask for it, too."""
        before, writer = self.state, self.recorders[-1].writer
        if before == BEGUN or writer.closed:
            self.refuse()
        self.state = BEGUN
        try:
            writer.flush()
        except BaseException as err:
            writer.stop(err)
            raise
        self.state = before

    def close(self) -> None:
        """Finishes all files; from their journals, where the mark is set. Calling it again goes on with what is left.
        RecordingError if the disk refuses. The file and its journal hold everything that was recorded."""
        for recorder in self.recorders:
            writer = recorder.writer
            if self.state != DONE:
                self.state = BEGUN  # also for what is asked just now
                writer.break_off()
                continue
            self.state = BEGUN
            try:
                recorder.close()
            except RecordingError as err:
                writer.stop(err)
                writer.leave_unfinished()
                raise
            except BaseException:
                writer.break_off()
                raise
            self.state = DONE
        self.state = CLOSED
