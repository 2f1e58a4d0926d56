"""What object code leaves to be found elsewhere: read from the symbol tables of ELF, COFF and Mach-O, of 64 bits."""

from __future__ import annotations

import struct


def undefined(code: bytes) -> set[str]:
    """Return the names that an object refers to and does not define."""
    readers = {b"\x7fELF": _elf, b"\xcf\xfa\xed\xfe": _mach}
    return readers.get(code[:4], _coff)(code)


def _name(code: bytes, at: int) -> str:
    return code[at : code.index(b"\0", at)].decode()


def _elf(code: bytes) -> set[str]:
    sections, size, count = struct.unpack_from("<40xQ10xHH", code)[:3]
    headers = [struct.unpack_from("<4xI16xQQI12xQ", code, sections + size * i) for i in range(count)]
    (table,) = (header for header in headers if header[0] == 2)
    _, begin, length, linked, each = table
    found: set[str] = set()
    for at in range(begin + each, begin + length, each):  # the first is none
        name, section = struct.unpack_from("<IxxH", code, at)
        if section == 0:
            found.add(_name(code, headers[linked][1] + name))
    return found


def _coff(code: bytes) -> set[str]:
    machine, _, _, begin, count = struct.unpack_from("<HHIII", code)
    assert machine in (0x8664, 0xAA64), f"no object of a known kind: it begins with {code[:4]!r}"
    found, skip = set[str](), 0
    for at in range(begin, begin + 18 * count, 18):
        if skip:
            skip -= 1
            continue
        zeros, place = struct.unpack_from("<II", code, at)
        value, section, _, kind, skip = struct.unpack_from("<IhHBB", code, at + 8)
        if kind == 2 and section == 0 and value == 0:  # external, in no section, not common
            name = code[at : at + 8].rstrip(b"\0").decode() if zeros else _name(code, begin + 18 * count + place)
            found.add(name)
    return found


def _mach(code: bytes) -> set[str]:
    commands, at, found = struct.unpack_from("<16xI", code)[0], 32, set[str]()
    for _ in range(commands):
        command, size = struct.unpack_from("<II", code, at)
        if command == 2:  # the table of symbols
            begin, count, names = struct.unpack_from("<8xIII", code, at)
            for place in range(begin, begin + 16 * count, 16):
                name, kind = struct.unpack_from("<IB", code, place)
                if kind & 0x0E == 0 and not kind & 0xE0:
                    found.add(_name(code, names + name))
        at += size
    return found
