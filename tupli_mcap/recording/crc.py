"""CRC-32: three times as fast with the extra `fast`, the same numbers without."""

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
