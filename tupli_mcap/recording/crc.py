"""CRC-32 by ISA-L, which takes a third of zlib's time; by zlib on the machines that it is not made for."""

try:
    from isal.isal_zlib import crc32
except ImportError:
    from zlib import crc32

__all__ = ["crc32"]
