"""What a kernel takes on a GPU, read from a compiled cubin: an ELF file, so plain struct parsing does.

NVIDIA does not document the `.nv.info` sections; the codes here are those that every reader of them found. The numbers
equal those of `cuobjdump -res-usage`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_REGISTERS, _FRAME_SIZE = 0x2F, 0x11  # attributes of .nv.info: symbol index and value
_WITH_PAYLOAD = 4  # format of an attribute that is followed by as many bytes as it says
_RESERVED = 1024  # bytes of shared memory that the system takes of every block; from sm_90 on part of the section
_SYMBOL = 24  # bytes


@dataclass(frozen=True)
class Usage:
    """Of one kernel: registers per thread, bytes of stack per thread (spilled registers and local arrays), and static
    bytes of shared memory per block, without those that the system takes."""

    registers: int
    stack: int
    shared: int

    def occupancy(self, architecture: int, block: int = 256) -> float:
        """Largest share of an SM's threads that blocks of this size can keep, by registers and shared memory."""
        threads, memory = 2048, {80: 164, 90: 228}.get(architecture, 100) * 1024
        warps = -(-block // 32)
        # Registers are handed out by 256 to a warp, warps by four, one to each quarter of an SM.
        per_warp = -(-self.registers * 32 // 256) * 256
        by_registers = 65536 // per_warp // 4 * 4 // warps
        by_memory = memory // (-(-(self.shared + _RESERVED) // 128) * 128)
        return min(threads // (32 * warps), by_registers, by_memory, 32) * 32 * warps / threads


@dataclass(frozen=True)
class _Section:
    name: str
    size: int
    data: bytes  # empty where the file holds none


def usage(cubin: Path) -> dict[str, Usage]:
    """Usage by the name of the kernel's function."""
    sections = {section.name: section for section in _sections(cubin.read_bytes())}
    symbols, names = sections[".symtab"].data, sections[".strtab"].data
    found: dict[str, dict[int, int]] = {}
    for attribute, payload in _attributes(sections[".nv.info"].data):
        if attribute in (_REGISTERS, _FRAME_SIZE):
            symbol, value = struct.unpack_from("<II", payload)
            (start,) = struct.unpack_from("<I", symbols, symbol * _SYMBOL)
            found.setdefault(_text(names, start), {})[attribute] = value
    taken = _RESERVED if ".nv.shared.reserved.0" in sections else 0
    result = {}
    for name, values in found.items():
        if _REGISTERS not in values or f".nv.info.{name}" not in sections:
            continue  # a function that kernels call
        memory = sections.get(f".nv.shared.{name}")
        shared = max(0, memory.size - taken) if memory else 0
        result[name] = Usage(values[_REGISTERS], values.get(_FRAME_SIZE, 0), shared)
    return result


def _sections(elf: bytes) -> Iterator[_Section]:
    if elf[:5] != b"\x7fELF\x02":
        raise ValueError("not a 64-bit ELF file")
    (table,) = struct.unpack_from("<Q", elf, 0x28)
    stride, count, names = struct.unpack_from("<HHH", elf, 0x3A)
    heads = [struct.unpack_from("<IIQQQQ", elf, table + k * stride) for k in range(count)]
    begin, length = heads[names][4:6]
    texts = elf[begin : begin + length]
    for name, kind, _flags, _address, offset, size in heads:
        data = b"" if kind == 8 else elf[offset : offset + size]  # 8: takes no room in the file
        yield _Section(_text(texts, name), size, data)


def _attributes(info: bytes) -> Iterator[tuple[int, bytes]]:
    """Code and payload of each attribute; empty where the value is in the head itself."""
    at = 0
    while at < len(info):
        form, code, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form == _WITH_PAYLOAD:
            yield code, info[at : at + size]
            at += size


def _text(table: bytes, start: int) -> str:
    return table[start : table.index(b"\0", start)].decode()
