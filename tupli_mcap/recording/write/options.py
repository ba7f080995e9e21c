"""The options of `RecordEpisodes`, and their checks."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

import numpy as np

from tupli_mcap.errors import RecordingError, by_words, did_you_mean, os_reason
from tupli_mcap.jsonvalue import is_unicode
from tupli_mcap.mcap.records import MAX_CHUNK
from tupli_mcap.messages.images.pictures import FrameFormat, ImageFormat, check_format, check_image_format
from tupli_mcap.remote import check_local, is_url, is_web, shown
from tupli_mcap.spaces.exact import shorten

if TYPE_CHECKING:
    import gymnasium as gym

    from tupli_mcap.recording.episode import Step
    from tupli_mcap.schema import RLTuple

Mode = Literal["x", "w", "a"]
Durability = Literal["os", "chunk", "step"]
CaptureEnv = Literal["spec", "pickle"] | None
Capture = Literal["all", "versions", "none"]
RecordInfo = bool | Sequence[str] | Callable[[dict[str, Any]], Mapping[str, Any]]
# Also an EpisodeMetadataCallback, which has reset().
MetadataCallback = Callable[["RLTuple"], Mapping[str, Any]]
StepCallback = Callable[["Step"], Mapping[str, Any] | None]

CAMERA: Final = "render"
"""The camera that `env.render()` is."""

RENDER_MODE: Final = "rgb_array"

_LONGEST = 255  # bytes of a name, in the usual file systems

_MOST = MAX_CHUNK // 2  # a chunk may come out larger; readers refuse those beyond


@dataclass(frozen=True)
class RecordOptions:
    """The arguments of `RecordEpisodes`, under the same names; its docstring says what each of them is.

    Raises:
        RecordingError: one of them has a value that it may not have.
        MissingExtraError: the extra that `image_format` needs is not installed.
    """

    metadata_callback: MetadataCallback | None = None
    record_info: RecordInfo = False
    step_callback: StepCallback | None = None
    compression: str = "zstd"
    mode: Mode = "x"
    reward_space: gym.Space[Any] | None = None
    benchmark_id: str = ""
    capture_env: CaptureEnv = "spec"
    attachments: Mapping[str, tuple[str, bytes]] | None = None
    labels: Mapping[str, Sequence[str]] | None = None
    flush_seconds: float | None = None
    journal_dir: str | os.PathLike[str] | None = None
    chunk_size: int = 256 * 1024
    durability: Durability = "os"
    frames: bool | int = False
    frame_format: FrameFormat = "png"
    image_format: ImageFormat = "raw"
    stack_size: int | None = None
    live: str | None = None
    max_bytes: int | None = None
    max_seconds: float | None = None
    name: str | None = None
    metadata: Mapping[str, Any] | None = None
    tags: Sequence[str] = ()
    split: str = ""
    capture: Capture = "all"
    autoreset_mode: str | None = None

    def __post_init__(self) -> None:
        size, seconds, frames = self.chunk_size, self.flush_seconds, self.frames
        if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 1 <= size <= _MOST:
            raise RecordingError(
                f"chunk_size: expected an integer from 1 to {_MOST} (bytes), found {size!r:.80}"
            )
        object.__setattr__(self, "chunk_size", int(size))  # the journal says it as JSON
        if seconds is not None and not (isinstance(seconds, int | float | np.number) and seconds >= 0):
            raise RecordingError(f"flush_seconds: expected seconds from 0 on, or None, found {seconds!r:.80}")
        for name, limit in (("max_bytes", self.max_bytes), ("max_seconds", self.max_seconds)):
            if limit is not None and not (isinstance(limit, int | float | np.number) and limit > 0):
                raise RecordingError(f"{name}: expected a positive number or None, found {limit!r:.40}")
        if not (isinstance(frames, bool) or (type(frames) is int and frames >= 0)):
            raise RecordingError(
                f"frames: expected True, False, or a number of steps from one frame to the next, found {frames!r:.60}"
            )
        if self.capture_env not in ("spec", "pickle", None):
            raise RecordingError(
                f"capture_env: expected 'spec', 'pickle' or None (nothing), found {self.capture_env!r:.80}"
            )
        if self.capture not in ("all", "versions", "none"):
            raise RecordingError(f"capture: expected 'all', 'versions' or 'none', found {self.capture!r:.80}")
        callback = self.metadata_callback
        if not (callback is None or callable(callback)):
            raise RecordingError(
                "metadata_callback: expected a function of a step, or an EpisodeMetadataCallback, "
                f"found {callback!r:.80}; what is the same for all episodes of a run is metadata="
            )
        if not (self.step_callback is None or callable(self.step_callback)):
            raise RecordingError(f"step_callback: expected a function, found {self.step_callback!r:.80}")
        if self.durability not in get_args(Durability):
            raise RecordingError(
                f"durability: expected one of {list(get_args(Durability))}, found {self.durability!r:.80}"
            )
        check_benchmark_id(self.benchmark_id)
        check_attachments(self.attachments)
        check_image_format(self.image_format)
        _check_directory(self.journal_dir)

    @property
    def every(self) -> int:
        """Every how many steps a frame is recorded, 0 for never."""
        return int(self.frames)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The camera that frames come from, if any."""
        return (CAMERA,) if self.every else ()

    @property
    def has_infos(self) -> bool:
        """True if something is recorded with each step's info."""
        return self.record_info is not False or self.step_callback is not None

    @property
    def has_callbacks(self) -> bool:
        """True if a callback needs the values of each step."""
        return self.has_infos or self.metadata_callback is not None

    @property
    def has_limits(self) -> bool:
        """True if the recording may go on in other files before a channel is full."""
        return self.max_bytes is not None or self.max_seconds is not None

    @property
    def is_plain(self) -> bool:
        """True if a step writes its row and nothing else."""
        needs = self.has_callbacks or self.every or self.has_limits
        return not needs and self.flush_seconds is None and self.durability != "step"

    def check_rendering(self, mode: Any) -> None:
        """Raises RecordingError where frames are wanted of an environment whose render mode gives none, and
        MissingExtraError where they cannot be encoded."""
        if not self.every:
            return
        if mode != RENDER_MODE:
            raise RecordingError(
                f"frames: expected an environment with render_mode={RENDER_MODE!r}, found {mode!r:.40}; "
                f"make it so: gymnasium.make(..., render_mode={RENDER_MODE!r})"
            )
        check_format(self.frame_format)


_MEANT = by_words(
    {
        "record_video render video": "frames",
        "config hparams hyperparameters params": "metadata",
        "is_success success": "metadata_callback",
        "append overwrite": "mode",
        "experiment run_name": "name",
        "directory file filename": "path",
        "info infos": "record_info",
    }
)
"""Names that options have elsewhere."""


def check_known(called: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raises TypeError, which names the class or function that was called, if it has no such option."""
    for name in given:
        if name not in known:
            meant = _MEANT.get(name, name)
            hint = did_you_mean(meant if meant in known else name, known) or f"; it has {', '.join(known)}"
            raise TypeError(f"{called}() has no option {name!r}{hint}")


def check_benchmark_id(benchmark_id: object) -> None:
    """Raises RecordingError unless it is a text that a file can hold."""
    if not isinstance(benchmark_id, str) or not is_unicode(benchmark_id):
        raise RecordingError(f"benchmark_id: expected a text, empty for none, found {shorten(benchmark_id)}")


def check_attachments(attachments: object) -> None:
    """Raises RecordingError unless it is None, or a dict as `RecordEpisodes` takes it."""
    if attachments is None:
        return
    expected = "attachments: expected a dict of names and pairs of a media type and bytes"
    if not isinstance(attachments, Mapping):
        raise RecordingError(f"{expected}, found {shorten(attachments)}")
    for name, pair in attachments.items():
        is_pair = isinstance(pair, tuple | list) and len(pair) == 2
        texts = (name, pair[0]) if is_pair else ()
        good = all(isinstance(text, str) and is_unicode(text) for text in texts)
        if not (is_pair and good and isinstance(pair[1], bytes | bytearray | memoryview)):
            raise RecordingError(f"{expected}, found {shorten(pair)} at {shorten(name)}")


def _check_directory(place: str | os.PathLike[str] | None) -> None:
    if place is None:
        return
    expected = f"journal_dir: expected a directory, found {str(place)!r}"
    if not isinstance(place, str | os.PathLike):
        raise RecordingError(expected)
    try:
        if not Path(place).is_dir():
            raise RecordingError(f"{expected}; make it")
    except OSError as err:
        raise RecordingError(f"{expected}: {os_reason(err)}") from err


def check_name(path: str | os.PathLike[str], *, or_directory: bool = False) -> None:
    """Raises RecordingError unless a new recording may have this name: with another one, no directory would show it,
    and a URL is no place of this machine."""
    check_local(path)
    if "\0" in os.fspath(path) or len(os.fsencode(Path(path).name)) > _LONGEST:
        raise RecordingError(
            f"expected a name of at most {_LONGEST} bytes without a NUL, found {os.fspath(path)!r:.80}"
        )
    if Path(path).suffix != ".mcap":
        also, then = (", or a directory", f", or {os.sep} for a directory") if or_directory else ("", "")
        raise RecordingError(
            f"expected a name that ends in .mcap{also}, found {os.fspath(path)}; add .mcap{then}"
        )


def check_place(path: str | os.PathLike[str]) -> None:
    """Raises RecordingError unless a recording can be written at `path`, as it was given, and now: as a `Path` a URL no
    longer looks like one."""
    if not isinstance(path, str | os.PathLike) or not isinstance(os.fspath(path), str):
        raise RecordingError(f"expected a path to record to, such as 'run.mcap', found {shorten(path)}")
    if not os.fspath(path):
        raise RecordingError("expected a path to record to, found an empty text; name a directory as '.'")
    if "\0" in os.fspath(path):
        raise RecordingError(f"expected a path to record to, found {os.fspath(path)!r}, which holds a NUL")
    if is_url(os.fspath(path)):
        then = "copy the file"
        if is_web(os.fspath(path)):
            then = "tupli-mcap push FILE sends it; or TupliEnvWrapper(env, storage=TupliAPIClient(URL)) does so itself"
        raise RecordingError(
            f"{shown(str(path))}: expected a local path to record to, found a URL; record to a path, and {then}"
        )
    now = time.time()
    if not 0 < now < (1 << 63) / 1e9:  # a `log_time` of 0 says that there is no row
        raise RecordingError(
            f"{path}: expected a clock between 1970 and 2262, found {now:.0f} s since 1970; set the system's clock"
        )
