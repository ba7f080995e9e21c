"""The path of a storage's catalog: in a directory of this user, never in the storage.

Somebody else may have written the storage, and a database file and the files beside it can make SQLite run code. So a
catalog is opened only where nobody else can write: `<cache>/catalogs/<storage>/`, where `<storage>` is a
hash of the storage's real path, device and inode. All of it may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import shutil
import stat
import time
from pathlib import Path
from typing import Final

from tupli_mcap.cache import cache_dir, make_private

_MOUNTS: Final = Path("/proc/self/mounts")
# SQLite needs locks and memory maps that hold between machines.
_REMOTE: Final = re.compile(
    "9p|afs|beegfs|ceph|cifs|coda|davfs|glusterfs|gpfs|lustre|ncpfs|nfs4?|ocfs2|orangefs|pvfs2|smb3|smbfs"
    r"|fuse\.(?!fuse-overlayfs$).*"
)
_OCTAL: Final = re.compile(r"\\([0-7]{3})")
_FORGOTTEN: Final = 90 * 86_400  # seconds after which a catalog that nobody opened is deleted


def catalog_path(root: Path) -> Path | None:
    """The catalog of the storage in a directory; None if the cache directory is on a network file system.
    OSError if the directory cannot be made, or others may write there."""
    real = Path(os.path.realpath(root))
    status = real.stat()
    catalogs = cache_dir() / "catalogs"
    make_private(catalogs)
    for directory in (catalogs.parent, catalogs):
        if not is_private(directory):
            raise PermissionError(errno.EPERM, "others may write there", str(directory))
    if _is_remote(catalogs):
        return None
    name = hashlib.sha256(os.fsencode(real) + f"\0{status.st_dev}\0{status.st_ino}".encode()).hexdigest()
    directory = catalogs / name[:32]
    if not directory.exists():
        _forget_old(catalogs)
        make_private(directory)
    return directory / "catalog.sqlite"


def is_private(path: Path) -> bool:
    """Whether a file or directory (no link) belongs to this user, and nobody else may write to it."""
    status = path.lstat()
    kind = stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)
    return kind and status.st_uid == os.geteuid() and not stat.S_IMODE(status.st_mode) & 0o022


def _is_remote(directory: Path) -> bool:
    """Whether a directory is on a network file system; False if the system does not say."""
    here, found, longest = os.path.realpath(directory), "", -1
    with contextlib.suppress(OSError):
        for line in _MOUNTS.read_text("utf-8", "surrogateescape").splitlines():
            _, point, kind, *_ = line.split(" ")
            point = _OCTAL.sub(lambda match: chr(int(match[1], 8)), point)
            if len(point) >= longest and f"{here}/".startswith(f"{point.rstrip('/')}/"):
                found, longest = kind, len(point)  # the later one of two at one point counts
    return _REMOTE.fullmatch(found) is not None


def _forget_old(catalogs: Path) -> None:
    """Remove catalogs that have not been opened for long; opening one changes the directory it is in."""
    with contextlib.suppress(OSError):
        for directory in list(catalogs.iterdir()):
            if time.time() - directory.lstat().st_mtime > _FORGOTTEN:
                shutil.rmtree(directory, ignore_errors=True)
