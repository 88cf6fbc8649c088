"""Texts that must come again as they are committed. MAVQUAD_REGEN=1 writes them anew, in a commit that says why they changed."""

import html
import os
import re
from pathlib import Path

_TEXT = re.compile(r'<text class="[^"]*" x="([\d.]+)" y="([\d.]+)"[^>]*>([^<]*)</text>')
_CELL = 12.2  # width of a character in a picture that Rich draws


def check(path: Path, text: str) -> None:
    """Compare with the committed text."""
    if os.environ.get("MAVQUAD_REGEN") == "1":
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


def screen(svg: str) -> str:
    """The characters of a terminal's picture, line by line."""
    rows: dict[float, list[tuple[float, str]]] = {}
    for x, y, words in _TEXT.findall(svg):
        rows.setdefault(float(y), []).append((float(x), html.unescape(words).replace("\xa0", " ")))
    lines = []
    for y in sorted(rows):
        line = ""
        for x, words in sorted(rows[y]):
            line = line.ljust(round(x / _CELL)) + words
        lines.append(line.rstrip())
    return "\n".join(lines).strip("\n") + "\n"
