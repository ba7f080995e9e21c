"""A checksum for the pairs of metadata records and channels, which MCAP gives none."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping

from tupli_mcap.errors import FormatError

__all__ = ["check_crc", "with_crc"]

_KEY = "crc"


def with_crc(values: Mapping[str, str]) -> dict[str, str]:
    """The pairs and, as the last one, `crc`: the CRC-32 of the others in 8 hexadecimal digits."""
    pairs = {key: value for key, value in values.items() if key != _KEY}
    return {**pairs, _KEY: _crc(pairs)}


def check_crc(values: Mapping[str, str], known: Collection[str], where: str) -> dict[str, str]:
    """The pairs without `crc`.

    Raises:
        FormatError: `crc` differs, or is missing where there are others than the `known` keys: the first recordings
            had none, but a damaged key must not pass for a missing one.
    """
    pairs = {key: value for key, value in values.items() if key != _KEY}
    if _KEY not in values:
        # A damaged length may have made the key part of a value: the bytes of a length in it are seen by their zeros.
        other = sorted(pairs.keys() - set(known)) or [key for key, value in pairs.items() if "\0" in value]
        if other:
            raise FormatError(
                f"{where}: expected a key 'crc' beside {other!r:.80}, found none; the file is damaged"
            )
    elif values[_KEY] != _crc(pairs):
        raise FormatError(f"{where} is damaged: expected crc {_crc(pairs)}, found {values[_KEY]!r:.20}")
    return pairs


def _crc(pairs: Mapping[str, str]) -> str:
    """In the order of the keys, each text as MCAP stores it: its length (u32) and its bytes."""
    texts = [text.encode() for pair in sorted(pairs.items()) for text in pair]
    return f"{zlib.crc32(b''.join(len(text).to_bytes(4, 'little') + text for text in texts)):08x}"
