"""Checksums of movie files: USD has none, and plays other pictures from a file that a disk or a copy has damaged.

A crate file (.usdc) names the place of its contents at its begin, so USD passes over what follows them: there stand a
mark and the CRC-32 of all before. A file that another program has written anew has none, and is read as it is. A .usdz
file is a zip archive, which has a CRC-32 of each file in it.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path

from warpflag.base.output import OutputError

__all__ = ["add_checksum", "verify"]

_MARK = b"warpflag-crc32"
_BLOCK = 1 << 24  # bytes read at once


def add_checksum(path: Path) -> None:
    """Adds mark and CRC-32 to a crate file.

    Raises:
        OSError: it can't be written.
    """
    ending = _MARK + struct.pack("<I", _crc(path, path.stat().st_size))
    with path.open("ab") as file:
        file.write(ending)


def verify(path: Path) -> None:
    """Compares a movie file and its value clips with their checksums, where they have any.

    Raises:
        OutputError: one is damaged.
        OSError: one can't be read.
    """
    for file in [path, *sorted(path.with_name(f"{path.name}.clips").glob("*.usdc"))]:
        if file.suffix == ".usdz":
            try:
                with zipfile.ZipFile(file) as archive:
                    sound = archive.testzip() is None
            except (zipfile.BadZipFile, EOFError, NotImplementedError, ValueError, zlib.error):
                sound = False
        else:
            sound = _is_sound(file)
        if not sound:
            raise OutputError(f"{file}: is damaged: it does not agree with its checksum")


def _is_sound(path: Path) -> bool:
    """Whether a file agrees with the checksum at its end; true where it has none."""
    length = len(_MARK) + 4
    size = path.stat().st_size - length
    if size < 0:
        return True
    with path.open("rb") as file:
        file.seek(size)
        ending = file.read(length)
    return not ending.startswith(_MARK) or struct.unpack("<I", ending[-4:])[0] == _crc(path, size)


def _crc(path: Path, size: int) -> int:
    """CRC-32 of the first bytes of a file."""
    found = 0
    with path.open("rb") as file:
        while size > 0 and (block := file.read(min(size, _BLOCK))):
            found, size = zlib.crc32(block, found), size - len(block)
    return found
