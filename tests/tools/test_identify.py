"""`mavquad identify` on logs made here, on excerpts, and on the whole recording of a real autopilot."""

import json

import numpy as np
import pytest

from mavquad import airframe, wire
from mavquad.identify import attitude
from mavquad.identify.attitude import SecondOrder
from mavquad.identify.excitation import Sweep, value
from mavquad.identify.timebase import Held
from tools import __main__ as program
from tools import identify_log

TRUTH = SecondOrder(0.98, 11.0, 0.9, 0.03, (0.0,) * 4, 1.0, 40)
START_US = 1_700_000_000_000_000


def quaternion(roll, pitch):
    cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return (float(cr * cp), float(sr * cp), float(cr * sp), float(-sr * sp))


def write_log(path, *, attitude_hz=50.0, sent=True, amplitude=0.12, restart=False, gaps=(), jitter_s=0.0, turned=1.0, more=()):
    """Roll swept for 70 s, then both axes for 30 s; commands leave 2 ms before they arrive, telemetry jitters by 4 ms.

    `gaps` in the attitude (from, to), `jitter_s` of its stamps, its sign `turned`, `more` messages as (name, rate_hz, fields of t).
    """
    rng = np.random.default_rng(2)
    t_sent = np.cumsum(rng.uniform(0.015, 0.025, 5250))
    plan = Sweep(amplitude=amplitude, f_start_hz=0.1, f_end_hz=5.0, duration_s=65.0, quiet_s=2.0)
    later = (t_sent > 72.0) & (t_sent < 103.0)
    roll = np.array([value(plan, x) for x in t_sent]) + amplitude * later * np.sin(1.7 * t_sent)
    pitch = amplitude * later * np.sin(2.3 * t_sent + 1.0)
    t_even = np.arange(0.5, 104.0, 1.0 / attitude_hz)
    t_att = t_even + jitter_s * rng.uniform(-1.0, 1.0, t_even.size)
    answer = [turned * np.interp(t_att, t_even, attitude.predict(TRUTH, Held(t_sent, u), t_even)) for u in (roll, pitch)]
    speed = [np.gradient(a, t_att) for a in answer]
    entries = []
    for k, t in enumerate(t_att):
        if any(a < t < b for a, b in gaps):
            continue
        boot = int(1000 * t) + (60_000 if not restart or t < 90.0 else -85_000)
        fields = (boot, *(float(x[k]) for x in answer), 0.3, *(float(x[k]) for x in speed), 0.0)
        entries.append(
            (t + 0.002 + rng.exponential(0.004), wire.encode("ATTITUDE", fields, seq=k % 256, system=1, component=1))
        )
    if sent:
        for k, t in enumerate(t_sent):
            fields = (int(1000 * t), 1, 1, 7, quaternion(roll[k], pitch[k]), 0.0, 0.0, 0.0, 0.4)
            entries.append((t, wire.encode("SET_ATTITUDE_TARGET", fields, seq=k % 256, system=255, component=190)))
    for name, rate_hz, fields in more:
        for k, t in enumerate(np.arange(0.5, 104.0, 1.0 / rate_hz)):
            values = fields(
                t,
                {
                    "roll": np.interp(t, t_att, answer[0]),
                    "rollspeed": np.interp(t, t_att, speed[0]),
                    "sent": np.interp(t, t_sent, roll),
                },
            )
            entries.append((t + 0.003, wire.encode(name, values, seq=k % 256, system=1, component=1)))
    entries.sort(key=lambda entry: entry[0])
    path.write_bytes(b"".join((START_US + int(1e6 * t)).to_bytes(8, "big") + raw for t, raw in entries))
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_log(tmp_path_factory.mktemp("identify") / "made.tlog")


def test_a_log_with_a_sweep_gives_its_attitude_response_and_an_airframe_that_loads(log, tmp_path, capsys):
    out, report = tmp_path / "mine.toml", tmp_path / "mine.html"
    assert program.main(["identify", str(log), "--json", "--out", str(out), "--report", str(report)]) == 0
    (found,) = json.loads(capsys.readouterr().out)["logs"]
    roll = next(r for r in found["attitude"] if r["axis"] == "roll")
    assert roll["input"] == "SET_ATTITUDE_TARGET"
    assert roll["natural_frequency_rad_s"] == pytest.approx(11.0, rel=0.06)
    assert roll["damping"] == pytest.approx(0.9, rel=0.06)
    assert roll["delay_s"] == pytest.approx(0.03, abs=0.006)  # the way of the telemetry is known to some milliseconds
    assert roll["check"][0]["fit_pct"] > 90.0
    assert roll["coherence_min_0.2_4_hz"] > 0.95
    loaded = airframe.load(str(out))
    assert loaded.name == "mine"
    assert loaded.attitude.gain == pytest.approx(0.98, abs=0.02)
    assert "from x500" in out.read_text(encoding="utf-8")
    assert "coherence" in report.read_text(encoding="utf-8")
    assert any("mass_kg" in text for text in found["missing"])
    assert any("HIGHRES_IMU" in text for text in found["missing"])


def test_the_text_names_the_input_the_spread_and_what_is_missing(log, capsys):
    assert program.main(["identify", str(log), "--fit", "3-60", "--check", "75-100"]) == 0
    shown = capsys.readouterr().out
    assert "SET_ATTITUDE_TARGET" in shown
    assert "75-100 s" in shown
    assert "no ATTITUDE_TARGET in this log" in shown


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sent": False}, "no SET_ATTITUDE_TARGET in this log; record"),
        ({"attitude_hz": 4.0}, "4.0 Hz; needs 17 Hz"),
        ({"amplitude": 0.002}, "record a sweep"),
    ],
)
def test_what_a_log_lacks_is_said_with_what_to_record(change, message, tmp_path, capsys):
    path = write_log(tmp_path / "poor.tlog", **change)
    assert program.main(["identify", str(path)]) == 1
    assert message in capsys.readouterr().err


def imu(x_sign=1.0, z_m_s2=-9.81):
    """HIGHRES_IMU: a hover that rolls."""
    return (
        "HIGHRES_IMU",
        50.0,
        lambda t, now: (int(1e6 * t) + 60_000_000, 0.0, 0.0, z_m_s2, x_sign * float(now["rollspeed"]), *(0.0,) * 9, 63, 0),
    )


def target(limit_rad=9.9):
    """ATTITUDE_TARGET: the command as far as the autopilot goes, at 0.4 of full thrust."""
    return (
        "ATTITUDE_TARGET",
        50.0,
        lambda t, now: (
            int(1000 * t) + 60_000,
            0,
            quaternion(float(np.clip(now["sent"], -limit_rad, limit_rad)), 0.0),
            0.0,
            0.0,
            0.0,
            0.4,
        ),
    )


def position(v_sign=1.0):
    """LOCAL_POSITION_NED: 3 m/s there and back."""
    return (
        "LOCAL_POSITION_NED",
        50.0,
        lambda t, now: (int(1000 * t) + 60_000, 6.0 * np.sin(0.5 * t), 0.0, -5.0, v_sign * 3.0 * np.cos(0.5 * t), 0.0, 0.0),
    )


def servos(top_us=2000):
    """SERVO_OUTPUT_RAW: four motors that turn the roll, two each way, cut at `top_us`."""

    def fields(t, now):
        left, right = (int(np.clip(1600 + sign * 4000 * now["sent"], 1150, top_us)) for sign in (-1, 1))
        return (int(1e6 * t) % 2**32 + 60_000_000, 0, right, left, left, right, *(0,) * 12)

    return "SERVO_OUTPUT_RAW", 50.0, fields


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"gaps": [(30.0, 33.0), (80.0, 80.5)]}, "ATTITUDE: 1 gaps, the longest 3.0"),
        (
            {"gaps": [(x, x + 1.0) for x in range(5, 100, 15)]},
            "roll from SET_ATTITUDE_TARGET: no stretch of 20 s without a gap",
        ),
        ({"jitter_s": 0.006}, "ATTITUDE: stamps spread by"),
        (
            {"turned": -1.0},
            "roll from SET_ATTITUDE_TARGET: the attitude moves against the command: the two have different sign",
        ),
        (
            {"more": [imu(x_sign=-1.0), servos()]},
            "torque per command, roll: HIGHRES_IMU.xgyro runs against the change of ATTITUDE.roll",
        ),
        ({"more": [imu(z_m_s2=9.81), target()]}, "hover thrust: HIGHRES_IMU.zacc shows +9.8 m/s^2 in flight, FRD shows -9.8"),
        ({"more": [imu(), position(v_sign=-1.0)]}, "drag: LOCAL_POSITION_NED.vx runs against the change of x"),
        ({"more": [servos(top_us=1900)]}, "SERVO_OUTPUT_RAW: a motor stands at its limit (1900 us) for"),
        ({"more": [target(limit_rad=0.06)]}, "roll: the autopilot stops at 3 deg (ATTITUDE_TARGET) where 7 deg were asked"),
        ({}, "hover thrust: no thrust (ATTITUDE_TARGET) beside an accelerometer (HIGHRES_IMU) in flight; record both"),
        ({}, "drag: no velocity (LOCAL_POSITION_NED) beside an accelerometer (HIGHRES_IMU) in flight; record both"),
        ({}, "torque per command, roll: no SERVO_OUTPUT_RAW with moving motors in this log; ask for it at 50 Hz"),
        ({}, "yaw from SET_ATTITUDE_TARGET: its command moves for 0 s only (needs 20); record a sweep on it"),
    ],
)
def test_what_is_wrong_with_a_log_is_said_in_one_line(change, line, tmp_path, capsys):
    assert program.main(["identify", str(write_log(tmp_path / "poor.tlog", **change))]) in (0, 1)
    shown = capsys.readouterr().out.splitlines()
    assert [text for text in shown if line in text], "\n".join(shown)


def test_the_rotors_of_the_file_lift_the_weight_at_the_hover_thrust_that_was_found(tmp_path):
    """Else a simulator of this very file would hover at another thrust than its companion sends."""
    out = tmp_path / "own.toml"
    made = write_log(tmp_path / "hover.tlog", more=[imu(), target()])
    assert program.main(["identify", str(made), "--out", str(out)]) == 0
    loaded = airframe.load(str(out))
    assert loaded.hover_thrust == pytest.approx(0.4, abs=0.001)
    assert 4.0 * loaded.rotors.thrust_max_n * loaded.hover_thrust == pytest.approx(loaded.body.mass_kg * 9.80665, rel=1e-3)


def test_a_log_without_attitude_and_a_missing_file_are_refused(tmp_path, capsys):
    path = tmp_path / "empty.tlog"
    raw = wire.encode("SYSTEM_TIME", (1, 2), seq=0, system=1, component=1)
    path.write_bytes(START_US.to_bytes(8, "big") + raw)
    assert program.main(["identify", str(path)]) == 1
    assert "no ATTITUDE in it (it holds SYSTEM_TIME)" in capsys.readouterr().err
    assert program.main(["identify", str(tmp_path / "none.tlog")]) == 1
    assert "no such file" in capsys.readouterr().err


def test_a_restart_of_the_vehicle_leaves_its_longest_run(tmp_path):
    flight = identify_log.read(write_log(tmp_path / "restart.tlog", restart=True))
    assert flight.attitude.t_s[-1] < 92.0
    assert "restarted" in flight.notes[0]


def test_spans_are_read_or_refused(log, capsys):
    for wrong in ("200", "9-3", "a-b"):
        assert program.main(["identify", str(log), "--fit", wrong]) == 1
        assert "--fit" in capsys.readouterr().err


def test_the_real_sweep_meets_its_acceptance(recordings, capsys, tmp_path):
    """Coherence above 0.95 from 0.2 to 4 Hz, 200-230 s predicted to 90 %, 63 % of a step in 150 to 210 ms."""
    path = recordings / "arducopter-sitl-sweep-calm.tlog"
    out = tmp_path / "arducopter.toml"
    assert program.main(["identify", str(path), "--check", "200-230", "--json", "--out", str(out)]) == 0
    (found,) = json.loads(capsys.readouterr().out)["logs"]
    sent = {r["axis"]: r for r in found["attitude"] if r["input"] == "SET_ATTITUDE_TARGET"}
    for axis in ("roll", "pitch"):
        assert sent[axis]["coherence_min_0.2_4_hz"] > 0.95
        assert sent[axis]["check"][0]["fit_pct"] >= 90.0
        assert 0.150 <= sent[axis]["t63_s"] <= 0.210
        assert found["gyro_filter"][axis]["cutoff_hz"] == pytest.approx(20.0, abs=1.0)
    assert found["hover_thrust"]["value"] == pytest.approx(0.3635, abs=0.003)
    assert airframe.load(str(out)).hover_thrust == pytest.approx(0.3635, abs=0.003)


def test_a_real_log_without_commands_says_what_to_record(recordings, capsys):
    assert program.main(["identify", str(recordings / "arducopter-sitl-flight1.tlog")]) == 1
    assert "no SET_ATTITUDE_TARGET in this log; record" in capsys.readouterr().err


def test_bounds_of_the_real_vehicle_are_not_contradicted_by_its_own_flight(recordings, capsys, tmp_path):
    path, out = recordings / "arducopter-sitl-flight1.tlog", tmp_path / "never.toml"
    assert program.main(["identify", str(path), "--bounds", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["logs"]
    assert found["bounds"]["default"]["contradictions"] > 50  # the design note's numbers do not fit this flight
    assert found["bounds"]["own"]["contradictions"] == 0
    assert program.main(["identify", str(path), "--bounds", "--out", str(out)]) == 1
    assert not out.exists()


def test_bounds_go_into_the_airframe_file(recordings, tmp_path):
    path, out = recordings / "arducopter-sitl-sweep-calm.tlog", tmp_path / "own.toml"
    assert program.main(["identify", str(path), "--bounds", "--out", str(out), "--report", str(tmp_path / "page.html")]) == 0
    loaded = airframe.load(str(out))
    assert loaded.bounds != airframe.load("x500").bounds
    assert loaded.bounds.e_velocity_m_s < 0.06


def test_bounds_need_an_accelerometer(log, capsys):
    assert program.main(["identify", str(log), "--bounds"]) == 1
    assert "bounds need HIGHRES_IMU" in capsys.readouterr().err
