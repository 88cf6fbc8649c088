"""The parameter protocol: a table of names and values as the personality has it, and its integers on the wire.

PX4 puts the bytes of an int32 into the float (capability bit PARAM_ENCODE_BYTEWISE), ArduPilot the number itself.
"""

import difflib
import math
import struct
from collections.abc import Iterator, Mapping

from mavquad.errors import ConfigError

INT32, REAL32 = 6, 9  # MAV_PARAM_TYPE


class Table:
    """Parameters in their order: a name whose default is an int stays an integer."""

    def __init__(self, defaults: Mapping[str, int | float], changes: Mapping[str, float], bytewise: bool) -> None:
        self._values = dict(defaults)
        self._names = list(defaults)
        self._bytewise = bytewise
        for name, value in changes.items():
            if name not in self._values:
                near = difflib.get_close_matches(name.upper(), self._names, n=1, cutoff=0.5)
                hint = f'did you mean "{near[0]}"?' if near else f"known: {', '.join(self._names)}"
                raise ConfigError(f'params: this autopilot has no "{name}"; {hint}')
            self.put(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __len__(self) -> int:
        return len(self._names)

    def names(self) -> Iterator[str]:
        """Every name in its order."""
        return iter(self._names)

    def put(self, name: str, value: float) -> None:
        """Change one; an integer parameter takes the nearest integer."""
        self._values[name] = round(value) if isinstance(self._values[name], int) else float(value)

    def put_wire(self, name: str, value: float, kind: int) -> bool:
        """Change one to what came in a PARAM_SET; False for what is no number."""
        if self._bytewise and isinstance(self._values[name], int) and kind != REAL32:
            value = struct.unpack("<i", struct.pack("<f", value))[0]
        if not math.isfinite(value):
            return False
        self.put(name, value)
        return True

    def fields(self, name: str) -> tuple[str, float, int, int, int]:
        """PARAM_VALUE of one."""
        value, kind = self._values[name], REAL32
        if isinstance(value, int):
            kind = INT32
            if self._bytewise:
                value = struct.unpack("<f", struct.pack("<i", value))[0]
        return name, float(value), kind, len(self._names), self._names.index(name)

    def find(self, name: str, index: int) -> str | None:
        """The name that a PARAM_REQUEST_READ means, or None."""
        if index >= 0:
            return self._names[index] if index < len(self._names) else None
        return name if name in self._values else None
