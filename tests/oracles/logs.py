"""Logs of the other autopilots' formats, byte by byte from their specifications: small, and every value known.

ULog: https://docs.px4.io/main/en/dev_log/ulog_file_format.html. DataFlash: FMT records and data, as ArduPilot writes them.
"""

import struct

ULOG_TYPES = {"uint64_t": "Q", "float": "f", "uint8_t": "B", "int32_t": "i", "bool": "?"}


def ulog(topics: dict[str, tuple[str, list[tuple]]]) -> bytes:
    """A ULog. topics: name -> (format such as "uint64_t timestamp;float[4] q;", rows of plain numbers)."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    data += message(b"B", bytes(40))
    for name, (form, _) in topics.items():
        data += message(b"F", f"{name}:{form}".encode())
    for number, name in enumerate(topics):
        data += message(b"A", struct.pack("<BH", 0, number) + name.encode())
    rows = [(row[0], number, _packed(form, row)) for number, (form, rows) in enumerate(topics.values()) for row in rows]
    for _, number, body in sorted(rows):
        data += message(b"D", struct.pack("<H", number) + body)
    return data


def _packed(form: str, row: tuple) -> bytes:
    codes = "<"
    for item in form.strip(";").split(";"):
        kind, count = item.split()[0], 1
        if kind.endswith("]"):
            kind, _, size = kind[:-1].partition("[")
            count = int(size)
        codes += f"{count}{ULOG_TYPES[kind]}"
    return struct.pack(codes, *row)


FLASH_TYPES = {"Q": "Q", "B": "B", "H": "H", "c": "h", "C": "H", "f": "f", "I": "I", "N": "16s", "n": "4s", "Z": "64s"}


def dataflash(records: dict[str, tuple[str, str, list[tuple]]]) -> bytes:
    """A DataFlash log. records: name -> (format letters, column names, rows of raw numbers as they stand in the file)."""

    def form(kind: int, length: int, name: str, letters: str, columns: str) -> bytes:
        body = struct.pack("<BB4s16s64s", kind, length, name.encode(), letters.encode(), columns.encode())
        return b"\xa3\x95\x80" + body

    data = form(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    rows = []
    for kind, (name, (letters, columns, values)) in enumerate(records.items(), start=1):
        packing = "<" + "".join(FLASH_TYPES[letter] for letter in letters)
        data += form(kind, 3 + struct.calcsize(packing), name, letters, columns)
        rows += [(row[0], bytes([0xA3, 0x95, kind]) + struct.pack(packing, *row)) for row in values]
    return data + b"".join(raw for _, raw in sorted(rows, key=lambda item: item[0]))
