"""CRC-32 by ISA-L where there is a build of it, else by zlib.

End every use of ISA-L with a loop of NumPy. ISA-L leaves the upper halves of the vector registers dirty, which slows
down everything that follows in the thread on Intel processors, the environment included; NumPy's loops clear them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

try:
    from isal.isal_zlib import crc32 as _crc32
except ImportError:
    from zlib import crc32 as _crc32

_ZEROS = np.zeros(256)


def crc32(data: Any, value: int = 0, /) -> int:
    """The checksum of `data`, behind bytes whose checksum is `value`."""
    found: int = _crc32(data, value)
    np.add(_ZEROS, _ZEROS, out=_ZEROS)  # long enough for a loop of vectors
    return found


def crc32_each(parts: Iterable[bytes]) -> list[int]:
    """The checksum of each part."""
    found = list(map(_crc32, parts))
    np.add(_ZEROS, _ZEROS, out=_ZEROS)
    return found
