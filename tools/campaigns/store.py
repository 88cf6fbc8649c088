"""The rows of a campaign: one SQLite file, a row a flight, written in one transaction when the flight has ended, never before."""

import json
import sqlite3
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from mavquad import __version__
from mavquad.errors import LogError
from tools.campaigns.grid import Flight

Summary = dict[str, Any]


class Result(NamedTuple):
    """What came of a flight: its summary, or (where it could not be flown) why."""

    id: str
    summary: Summary
    problem: str = ""


def _at(*keys: str | int) -> Callable[[Summary], Any]:
    def find(summary: Summary) -> Any:
        found: Any = summary
        for key in keys:
            try:
                found = found[key]
            except (KeyError, IndexError, TypeError):
                return None
        return found

    return find


def _us(find: Callable[[Summary], Any]) -> Callable[[Summary], Any]:
    return lambda summary: None if find(summary) is None else 1e6 * find(summary)


SCORES: dict[str, Callable[[Summary], Any]] = {  # columns, each from summary.json
    "rmse_m": _at("rmse_m", "position"),
    "rmse_n_m": _at("rmse_m", "n"),
    "rmse_e_m": _at("rmse_m", "e"),
    "rmse_d_m": _at("rmse_m", "d"),
    "max_error_m": _at("max_error_m"),
    "misses": _at("setpoint_misses"),
    "messages_lost": _at("messages_lost"),
    "delay_s": _at("delay_s"),
    "disturbance_correlation": _at("disturbance", "correlation"),
    "disturbance_lag_s": _at("disturbance", "lag_s"),
    "disturbance_rms_m_s2": _at("disturbance", "error_m_s2"),
    "inside_pct": _at("bounds", "inside_pct"),
    "half_width_m_s2": _at("bounds", "half_width_m_s2"),
    "empty_sets": _at("bounds", "empty"),
    "qp_p99_us": _us(_at("solver", "qp_p99_s")),
    "qp_fallbacks": _at("solver", "qp_fallbacks"),
    "duration_s": _at("duration_s"),
    "wall_s": _at("wall_s"),
}
_KEYS = ("id", "engine", "scenario", "personality", "variant", "seed", "command", "drawn", "version", "finished_utc")
COLUMNS = (*_KEYS, "ok", "problem", *SCORES, "summary")


class Store:
    """An open file of results; `with` closes it. Raises LogError where it is none or cannot be written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, timeout=30.0, isolation_level=None)
            self._db.execute("PRAGMA journal_mode = WAL")
            kinds = {"seed": "INTEGER", "ok": "INTEGER", **dict.fromkeys(SCORES, "REAL")}
            body = ", ".join(f"{name} {kinds.get(name, 'TEXT')}" for name in COLUMNS)
            self._db.execute(f"CREATE TABLE IF NOT EXISTS flights ({body}, PRIMARY KEY (id, engine))")
            have = {row[1] for row in self._db.execute("PRAGMA table_info(flights)")}
        except (sqlite3.Error, OSError) as error:
            raise LogError(f"{path}: cannot be used for a campaign's results: {error}; choose another --out") from None
        if not set(COLUMNS) <= have:
            missing = ", ".join(sorted(set(COLUMNS) - have))
            raise LogError(f"{path}: a table of another version, without {missing}; choose another --out")

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: Any) -> None:
        self._db.close()

    def finished(self, engine: str) -> set[str]:
        """The ids of the flights that are here."""
        return {row[0] for row in self._db.execute("SELECT id FROM flights WHERE engine = ?", (engine,))}

    def add(self, engine: str, results: Iterable[tuple[Flight, Result]]) -> None:
        """All of these rows or, when killed, none. A flight that is here already stays as it is."""
        rows = [self._row(engine, flight, result) for flight, result in results]
        columns = ", ".join(COLUMNS)
        now = "strftime('%Y-%m-%dT%H:%M:%SZ', 'now')"
        values = ", ".join(now if name == "finished_utc" else "?" for name in COLUMNS)
        try:
            self._db.execute("BEGIN IMMEDIATE")
            self._db.executemany(f"INSERT OR IGNORE INTO flights ({columns}) VALUES ({values})", rows)
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            raise LogError(f"{self.path}: cannot be written: {error}; what is in it stays") from None

    def rows(self, engine: str, flights: Iterable[Flight]) -> list[dict[str, Any]]:
        """The rows of these flights, in their order, without the summaries."""
        columns = [name for name in COLUMNS if name != "summary"]
        query = f"SELECT {', '.join(columns)} FROM flights WHERE engine = ?"
        found = {row[0]: dict(zip(columns, row, strict=True)) for row in self._db.execute(query, (engine,))}
        return [found[flight.id] for flight in flights if flight.id in found]

    def _row(self, engine: str, flight: Flight, result: Result) -> list[Any]:
        s = result.summary
        problem = result.problem or "; ".join(s.get("failures", []))
        keys = [flight.id, engine, flight.scenario, flight.personality, flight.variant, flight.seed, flight.command]
        scores = [find(s) for find in SCORES.values()]
        return [*keys, json.dumps(flight.drawn), __version__, int(bool(s.get("ok"))), problem, *scores, json.dumps(s)]
