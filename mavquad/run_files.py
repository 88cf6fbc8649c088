"""What a companion leaves in its run folder beside the plan: names of logs, and the trace."""

import json
import struct
from pathlib import Path


def next_log(run: Path, stem: str) -> Path:
    """flight.tlog, or flight-2.tlog for a companion that was started again in the same folder."""
    path, n = run / f"{stem}.tlog", 1
    while path.exists():
        n += 1
        path = run / f"{stem}-{n}.tlog"
    return path


class TraceWriter:
    """`flight.trace`: a line of JSON with the column names, then rows of little-endian float64."""

    def __init__(self, path: Path, names: tuple[str, ...]) -> None:
        self._file = path.open("xb")
        self._file.write(json.dumps(names).encode() + b"\n")
        self._row = struct.Struct(f"<{len(names)}d")

    def write(self, row: tuple[float, ...]) -> None:
        self._file.write(self._row.pack(*row))

    def write_bytes(self, rows: bytes) -> None:
        """Rows as they are to lie in the file."""
        self._file.write(rows)

    def close(self) -> None:
        self._file.close()
