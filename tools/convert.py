"""mavquad convert: a log as Parquet, CSV or MCAP, for other tools.

LOG is a MAVLink tlog, a PX4 ULog (.ulg) or an ArduPilot DataFlash log (.bin). Every kind of message becomes a table: a file of its own
in a folder (parquet, csv), or a topic of one file (mcap). With --signals, what mavquad's estimators take of it instead: attitude,
imu, position, ... in SI units, NED and FRD. Example:

  mavquad convert flight.tlog --to parquet --only ATTITUDE_QUATERNION --only HIGHRES_IMU
"""

import argparse
import csv
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mavquad.errors import LogError
from mavquad.link.columns import Log
from mavquad.link.recording import Recording, Signal, from_tlog, kept_aboard, not_enough_for, open_recording

Array = NDArray[Any]
Tables = dict[str, Array]
# letters of a signal's columns
AXES = {"q_wxyz": "wxyz", "omega_rad_s": "xyz", "accel_m_s2": "xyz", "gyro_rad_s": "xyz", "p_ned_m": "ned", "v_ned_m_s": "ned"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, help="a tlog, .ulg or .bin file")
    parser.add_argument("--to", choices=WRITERS, required=True, help="the format to write")
    parser.add_argument(
        "--out", type=Path, help="folder (parquet, csv) or file (mcap) to make; default: beside the working folder"
    )
    parser.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="only this message or topic; may be repeated"
    )
    parser.add_argument("--signals", action="store_true", help="the signals that estimators take, instead of every message")
    parser.add_argument(
        "--from", dest="start_s", type=float, metavar="S", help="leave out what is earlier, seconds from the start"
    )
    parser.add_argument("--until", dest="end_s", type=float, metavar="S", help="leave out what is later")
    parser.add_argument("--system", type=int, help="only this vehicle of a tlog")
    parser.add_argument("--component", type=int, help="only this component of a tlog")
    parser.add_argument("--dialect", default="ardupilotmega", help="pymavlink's dialect for a tlog (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="say what was written as JSON")


def run(args: argparse.Namespace) -> int:
    tables, notes = load(args)
    if args.only:
        tables = {name: table for name, table in tables.items() if set(name.split("/")) & set(args.only) or name in args.only}
    tables = sliced(tables, args.start_s, args.end_s)
    if not tables:
        raise LogError(f"{args.log}: nothing to convert is left; --only, --from, --until or --system exclude every message")
    out = args.out or Path(f"{args.log.stem}{'-signals' if args.signals else ''}.{args.to}")
    if out.exists():
        raise LogError(f"{out}: exists already and is not overwritten; choose another with --out")
    for note in notes:
        print(note, file=sys.stderr)
    WRITERS[args.to](out, tables)
    if args.json:
        print(json.dumps({"out": str(out), "tables": {name: len(table) for name, table in tables.items()}, "notes": notes}))
    else:
        width = max(map(len, tables))
        for name, table in tables.items():
            print(f"{name:{width}} {len(table):9d}")
        print(f"{sum(map(len, tables.values()))} rows of {len(tables)} tables in {out}")
    return 0


def load(args: argparse.Namespace) -> tuple[Tables, list[str]]:
    """The tables asked for, and what is to be said of the log."""
    if not kept_aboard(args.log):
        log = Log(args.log, args.dialect)
        if not args.signals:
            return messages(log, args.system, args.component), [log.problem] if log.problem else []
        recording = from_tlog(log, system=args.system, component=args.component)
    else:
        recording = open_recording(args.log)
    notes = ([recording.problem] if recording.problem else []) + (not_enough_for(recording) if args.signals else [])
    return (signal_tables(recording) if args.signals else recording.tables), notes


def messages(log: Log, system: int | None, component: int | None) -> Tables:
    """Every known message of a tlog by `system/component/NAME`."""
    return {
        f"{s.system}/{s.component}/{s.name}": rows
        for s, rows in log.everything().items()
        if system in (None, s.system) and component in (None, s.component)
    }


def signal_tables(recording: Recording) -> Tables:
    """Each signal as one table of scalar columns: `q_w`, `omega_x_rad_s`, ..."""
    return {kind.__name__.lower(): _scalars(signal) for kind, signal in recording.signals.items()}


def _scalars(signal: Signal) -> Array:
    columns: dict[str, Array] = {}
    for name, values in zip(signal.kind._fields, signal.columns, strict=True):
        if values.ndim == 1:
            columns[name] = values
            continue
        stem, _, unit = name.partition("_")
        for k, column in enumerate(values.T):
            letter = AXES[name][k] if name in AXES else str(k + 1)
            columns[
                f"q_{letter}" if name == "q_wxyz" else "_".join(filter(None, (stem, letter, unit.removeprefix("ned_"))))
            ] = column
    columns["arrival_us"] = signal.arrival_us
    table = np.empty(signal.arrival_us.size, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table


def sliced(tables: Tables, start_s: float | None, end_s: float | None) -> Tables:
    """What lies in a time span counted from the earliest stamp; empty tables are left out."""
    origin = min((int(table["t_us"].min()) for table in tables.values() if len(table)), default=0)
    kept = {}
    for name, table in tables.items():
        t_s = 1e-6 * (table["t_us"] - origin)
        inside = (t_s >= (start_s or 0.0)) & (t_s < (np.inf if end_s is None else end_s))
        if inside.any():
            kept[name] = table if inside.all() else table[inside]
    return kept


def write_parquet(out: Path, tables: Tables) -> None:
    """One file a table; arrays as lists of fixed size."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise LogError("writing Parquet needs pyarrow: pip install 'mavquad[export]'") from None
    out.mkdir(parents=True)
    for name, table in tables.items():
        columns = {}
        for key in table.dtype.names or ():
            values = table[key]
            if values.dtype.kind == "S":
                columns[key] = pa.array(_texts(values))
            elif values.ndim == 2:
                flat = pa.array(np.ascontiguousarray(values).reshape(-1))
                columns[key] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            else:
                columns[key] = pa.array(np.ascontiguousarray(values))
        pq.write_table(pa.table(columns), out / f"{name.replace('/', '-')}.parquet", compression="zstd")


def write_csv(out: Path, tables: Tables) -> None:
    """One file a table; arrays as columns `name[0]`, ...; each number with the digits that give it back exactly."""
    out.mkdir(parents=True)
    for name, table in tables.items():
        columns: dict[str, list[Any]] = {}
        for key in table.dtype.names or ():
            values = table[key]
            if values.ndim == 2:
                columns |= {f"{key}[{k}]": _plain(column) for k, column in enumerate(values.T)}
            else:
                columns[key] = _plain(values)
        with (out / f"{name.replace('/', '-')}.csv").open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))


def write_mcap(out: Path, tables: Tables) -> None:
    """One file, a topic a table, JSON messages with a schema, in the order of time."""
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError:
        raise LogError("writing MCAP needs mcap: pip install 'mavquad[export]'") from None
    encode = msgspec.json.Encoder().encode  # NaN becomes null, as JSON has none
    rows: dict[int, Iterator[dict[str, Any]]] = {}
    stamps, owners = [], []
    with out.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="mavquad")
        for name, table in tables.items():
            schema = json.dumps({"type": "object", "properties": {key: _schema(table[key]) for key in table.dtype.names or ()}})
            schema_id = writer.register_schema(name.split("/")[-1], "jsonschema", schema.encode())
            channel = writer.register_channel(f"/{name}", "json", schema_id)
            rows[channel] = _rows(table)
            stamps.append(table["t_us"])
            owners.append(np.full(len(table), channel))
        t_us, owner = np.concatenate(stamps), np.concatenate(owners)
        for i in np.argsort(t_us, kind="stable"):  # within a table the rows come in their own order
            t_ns = max(0, 1000 * int(t_us[i]))
            writer.add_message(int(owner[i]), log_time=t_ns, publish_time=t_ns, data=encode(next(rows[int(owner[i])])))
        writer.finish()


def _rows(table: Array) -> Iterator[dict[str, Any]]:
    """The rows of a table as dictionaries, in the order of their stamps."""
    table = table[np.argsort(table["t_us"], kind="stable")]
    names = table.dtype.names or ()
    columns = [_texts(table[key]) if table[key].dtype.kind == "S" else table[key].tolist() for key in names]
    return (dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True))


def _schema(values: Array) -> dict[str, Any]:
    kind = {"f": "number", "S": "string", "b": "boolean"}.get(values.dtype.kind, "integer")
    return {"type": "array", "items": {"type": kind}} if values.ndim == 2 else {"type": kind}


def _plain(values: Array) -> list[Any]:
    if values.dtype.kind == "S":
        return _texts(values)
    return list(map(str, values)) if values.dtype.kind == "f" else values.tolist()  # str: shortest digits of a float32


def _texts(values: Array) -> list[str]:
    return [value.split(b"\0", 1)[0].decode("utf-8", "replace") for value in values.tolist()]


WRITERS: dict[str, Callable[[Path, Tables], None]] = {"parquet": write_parquet, "csv": write_csv, "mcap": write_mcap}
