"""What the operating system refuses, in words: the reason, and what to do about it."""

from __future__ import annotations

import errno
from typing import Final

__all__ = ["refused"]

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


def refused(err: OSError) -> str:
    """Why the system refused, and what to do: `No space left on device; free some space there, ...`."""
    reason = err.strerror or str(err) or type(err).__name__
    return f"{reason}; {_ADVICE.get(err.errno or 0, 'choose another place')}"
