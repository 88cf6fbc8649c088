"""Recordings of three formats as one kind of signals."""

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from mavquad import wire
from mavquad.errors import LogError
from mavquad.link import recording, tlog
from mavquad.link.columns import Log
from mavquad.signals import Attitude, Imu, Mocap, Motors, Position, Target
from tests.oracles.logs import dataflash, ulog

DATA = Path(__file__).parent.parent / "data"
LEVEL = (1.0, 0.0, 0.0, 0.0)
TURNED = (math.cos(0.25), 0.0, 0.0, math.sin(0.25))  # 0.5 rad of yaw

PX4 = ulog(
    {
        "vehicle_attitude": (
            "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
            [(1000 * i + 90, 1000 * i, *(TURNED if i == 3 else LEVEL)) for i in range(5)] + [(5090, 5000, 0.5, 0, 0, 0)],
        ),
        "vehicle_angular_velocity": (
            "uint64_t timestamp;uint64_t timestamp_sample;float[3] xyz;",
            [(2000 * i + 50, 2000 * i, 0.5 * i, -1.0, 2.0) for i in range(3)],
        ),
        "sensor_combined": (
            "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2;",
            [(500 * i, 0.5, 0.25, 0.125, 1.0, 2.0, -9.5) for i in range(8)],
        ),
        "vehicle_local_position": (
            "uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;bool xy_valid;bool z_valid;",
            [(1000 * i, 1.0, 2.0, -3.0, 0.5, 0.25, 0.0, i != 1, True) for i in range(3)],
        ),
        "actuator_motors": (
            "uint64_t timestamp;float[6] control;",
            [(700 * i, 0.5, 0.25, -0.5, 1.0, math.nan, math.nan) for i in range(4)],
        ),
        "vehicle_attitude_setpoint": (
            "uint64_t timestamp;float[4] q_d;float[3] thrust_body;",
            [(900 * i, *TURNED, 0.0, 0.0, -0.625) for i in range(3)],
        ),
        "vehicle_mocap_odometry": (
            "uint64_t timestamp;float[3] position;float[4] q;",
            [(300, 1.0, 2.0, -3.0, *LEVEL)],
        ),
    }
)
ARDUPILOT = dataflash(
    {
        "ATT": (
            "QccccCC",
            "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw",
            [(1000 * i, 100, 200, 0, 0, 0, 9000) for i in range(4)],
        ),
        "XKQ": ("QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", []),
        "IMU": (
            "QBffffff",
            "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
            [(500 * i, i % 2, 0.5, 0.25, 0.125, 1.0, 2.0, -9.5) for i in range(8)],
        ),
        "RATE": ("Qfff", "TimeUS,R,P,Y", [(1000 * i, 90.0 * i, 0.0, -45.0) for i in range(4)]),
        "RCOU": ("QHHHH", "TimeUS,C1,C2,C3,C4", [(1000 * i, 1500, 1250, 900, 2000) for i in range(4)]),
        "NKF1": ("Qffffff", "TimeUS,VN,VE,VD,PN,PE,PD", [(1000 * i, 0.5, 0.25, 0.0, 1.0, 2.0, -3.0) for i in range(4)]),
        "CTUN": ("Qf", "TimeUS,ThO", [(0, 0.5), (3000, 0.5)]),
        "VISP": ("Qffffff", "TimeUS,PX,PY,PZ,Roll,Pitch,Yaw", [(100, 1.0, 2.0, -3.0, 0.0, 0.0, 90.0)]),
        "MSG": ("QZ", "TimeUS,Message", [(50, b"hello")]),
    }
)


def opened(data: bytes, path: Path) -> recording.Recording:
    path.write_bytes(data)
    return recording.open_recording(path)


def by_kind(log: recording.Recording) -> dict:
    """kind -> its samples."""
    return {
        kind: list(group)
        for kind, group in itertools.groupby(
            sorted((s for _, s in recording.samples(log)), key=lambda s: type(s).__name__), type
        )
    }


def test_a_ulog_gives_the_signals_that_px4_logged(tmp_path):
    log = opened(PX4, tmp_path / "flight.ulg")
    got = by_kind(log)
    assert (log.format, log.problem) == ("ULog", "")
    assert [s.t_us for s in got[Attitude]] == [0, 1000, 2000, 3000, 4000]  # the sixth quaternion is no unit
    assert got[Attitude][3].q_wxyz == pytest.approx(TURNED, abs=1e-7)
    assert got[Attitude][1].omega_rad_s == pytest.approx((0.25, -1.0, 2.0))  # between the samples of the rate
    assert got[Imu][0] == Imu(0, (1.0, 2.0, -9.5), (0.5, 0.25, 0.125))
    assert got[Position] == [Position(t, (1.0, 2.0, -3.0), (0.5, 0.25, 0.0)) for t in (0, 2000)]  # the second was not valid
    assert got[Motors][0] == Motors(0, (0.5, 0.25, 0.0, 1.0))  # two columns hold no motor
    assert got[Target][0].thrust == 0.625
    assert got[Target][0].type_mask == 7
    assert got[Mocap] == [Mocap(300, LEVEL, (1.0, 2.0, -3.0))]
    assert log.tables["vehicle_attitude/0"]["q"].shape == (6, 4)


def test_a_ulog_of_an_older_px4_gives_the_same_signals(tmp_path):
    old = ulog(
        {
            "vehicle_attitude": (
                "uint64_t timestamp;float rollspeed;float pitchspeed;float yawspeed;float[4] q;",
                [(1000 * i, 0.5, -1.0, 2.0, *LEVEL) for i in range(3)],
            ),
            "actuator_outputs": ("uint64_t timestamp;float[16] output;", [(0, 1500.0, 1250.0, 900.0, 2000.0, *[0.0] * 12)]),
            "vehicle_attitude_setpoint": ("uint64_t timestamp;float[4] q_d;float thrust;", [(0, *LEVEL, 0.625)]),
            "vehicle_visual_odometry": (
                "uint64_t timestamp;float x;float y;float z;float[4] q;",
                [(0, 1.0, 2.0, -3.0, *LEVEL)],
            ),
        }
    )
    got = by_kind(opened(old, tmp_path / "old.ulg"))
    assert got[Attitude][2] == Attitude(2000, LEVEL, (0.5, -1.0, 2.0))
    assert got[Motors] == [Motors(0, (0.5, 0.25, 0.0, 1.0))]
    assert got[Target][0].thrust == 0.625
    assert got[Mocap] == [Mocap(0, LEVEL, (1.0, 2.0, -3.0))]


def test_a_dataflash_log_gives_the_signals_that_ardupilot_logged(tmp_path):
    log = opened(ARDUPILOT, tmp_path / "flight.bin")
    got = by_kind(log)
    assert (log.format, log.problem) == ("DataFlash", "")
    roll, yaw = math.radians(2.0) / 2, math.pi / 4
    expected = (
        math.cos(roll) * math.cos(yaw),
        math.sin(roll) * math.cos(yaw),
        math.sin(roll) * math.sin(yaw),
        math.cos(roll) * math.sin(yaw),
    )
    assert got[Attitude][2].q_wxyz == pytest.approx(expected)
    assert got[Attitude][2].omega_rad_s == pytest.approx((math.pi, 0.0, -math.pi / 4))
    assert [s.t_us for s in got[Imu]] == [500 * i for i in range(8)]  # no FMTU: nobody says that I is an instance
    assert got[Imu][0] == Imu(0, (1.0, 2.0, -9.5), (0.5, 0.25, 0.125))
    assert got[Motors][0] == Motors(0, (0.5, 0.25, 0.0, 1.0))
    assert got[Position][3] == Position(3000, (1.0, 2.0, -3.0), (0.5, 0.25, 0.0))
    assert got[Target][0].q_wxyz == pytest.approx((math.cos(math.radians(0.5)), math.sin(math.radians(0.5)), 0.0, 0.0))
    assert got[Target][0].thrust == 0.5
    assert got[Mocap][0].q_wxyz == pytest.approx((math.cos(yaw), 0.0, 0.0, math.sin(yaw)))
    assert log.tables["ATT"]["Yaw"].tolist() == [90.0] * 4


def test_the_quaternion_of_the_filter_is_preferred_to_euler_angles(tmp_path):
    log = dataflash(
        {
            "ATT": ("Qccc", "TimeUS,Roll,Pitch,Yaw", [(1000 * i, 100, 200, 0) for i in range(4)]),
            "NKQ1": ("Qffff", "TimeUS,Q1,Q2,Q3,Q4", [(1000 * i, *TURNED) for i in range(4)]),
        }
    )
    attitude = opened(log, tmp_path / "flight.bin").signals[Attitude]
    assert attitude.source == "NKQ1"
    assert np.allclose(attitude.column("q_wxyz"), TURNED)
    assert np.isnan(attitude.column("omega_rad_s")).all()


def test_a_tlog_gives_what_the_live_link_would_have_decoded():
    log = recording.open_recording(DATA / "sweep-roll-20s.tlog")
    assert {kind.__name__: signal.source for kind, signal in log.signals.items()} == {
        "Attitude": "ATTITUDE_QUATERNION",
        "Imu": "HIGHRES_IMU",
        "Position": "LOCAL_POSITION_NED",
        "Motors": "SERVO_OUTPUT_RAW",
        "Target": "ATTITUDE_TARGET",
    }
    rows = Log(DATA / "sweep-roll-20s.tlog").columns("ATTITUDE_QUATERNION")
    attitude = log.signals[Attitude]
    assert np.array_equal(attitude.arrival_us, rows["t_us"])
    assert np.array_equal(attitude.column("t_us"), 1000 * rows["time_boot_ms"].astype(np.int64))
    assert np.array_equal(attitude.column("omega_rad_s")[:, 0], rows["rollspeed"].astype(float))
    assert attitude.rate_hz() == pytest.approx(100.0)
    assert recording.not_enough_for(log) == []


def write_tlog(path: Path, rows: list[tuple[int, str, tuple, int]]) -> Path:
    with tlog.Writer(path) as log:
        for i, (t_us, name, fields, system) in enumerate(rows):
            log.write(t_us, wire.encode(name, fields, seq=i, system=system, component=1))
    return path


def test_samples_come_in_the_order_of_arrival_and_broken_ones_are_counted(tmp_path):
    quaternion = ("ATTITUDE_QUATERNION", (5, *LEVEL, 0.0, 0.0, 0.0, (0.0,) * 4))
    path = write_tlog(
        tmp_path / "flight.tlog",
        [
            (10, *quaternion, 1),
            (11, "LOCAL_POSITION_NED", (6, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0), 1),
            (12, "ATTITUDE_QUATERNION", (7, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4), 1),
            (13, "LOCAL_POSITION_NED", (8, math.nan, 2.0, 3.0, 0.0, 0.0, 0.0), 1),
            (14, *quaternion, 1),
        ],
    )
    log = recording.open_recording(path)
    assert [(t, type(s).__name__) for t, s in recording.samples(log)] == [(10, "Attitude"), (11, "Position"), (14, "Attitude")]
    assert log.refused == 2


def test_stamps_of_the_outputs_are_unwrapped_by_the_attitude_beside_them(tmp_path):
    servo = (0xFFFFFFFF - 1000, 0, *[1500] * 8, *[0] * 8)
    after = (4000, 0, *[1500] * 8, *[0] * 8)
    rows = []
    for t_us, ms in ((10, 4294966), (30, 4294972)):
        rows.append((t_us, "ATTITUDE_QUATERNION", (ms, *LEVEL, 0.0, 0.0, 0.0, (0.0,) * 4), 1))
        rows.append((t_us + 1, "SERVO_OUTPUT_RAW", servo if t_us == 10 else after, 1))
    motors = recording.open_recording(write_tlog(tmp_path / "long.tlog", rows)).signals[Motors]
    assert motors.column("t_us").tolist() == [0xFFFFFFFF - 1000, (1 << 32) + 4000]


def test_two_vehicles_in_one_tlog_must_be_told_apart(tmp_path):
    attitude = (5, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0)
    path = write_tlog(tmp_path / "two.tlog", [(i, "ATTITUDE", attitude, 1 + i % 2) for i in range(6)])
    with pytest.raises(LogError, match=r"attitude comes from 1/1, 2/1; expected one vehicle"):
        recording.open_recording(path)
    assert recording.open_recording(path, system=2).signals[Attitude].arrival_us.tolist() == [1, 3, 5]


def test_a_slow_log_says_what_it_is_too_slow_for(tmp_path):
    rows = [(250_000 * i, "ATTITUDE", (250 * i, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0), 1) for i in range(20)]
    lines = recording.not_enough_for(recording.open_recording(write_tlog(tmp_path / "slow.tlog", rows)))
    assert "not enough for body rates (gsmo): attitude at 4.0 Hz is too slow, needs 50 Hz" in lines[0]
    assert any("position is missing" in line for line in lines)


@pytest.mark.parametrize(("name", "data"), [("cut.ulg", PX4), ("cut.bin", ARDUPILOT)])
def test_a_log_cut_anywhere_is_read_as_far_as_it_goes_or_refused_in_one_line(name, data, tmp_path):
    read = 0
    for cut in range(4, len(data), 7):
        said = ""
        try:
            assert opened(data[:cut], tmp_path / name).tables
            read += 1
        except LogError as error:
            said = str(error)
        assert said == "" or (said.startswith(str(tmp_path / name)) and "\n" not in said)
    assert read > 20


def test_a_ulog_and_a_dataflash_log_cut_inside_a_record_say_so(tmp_path):
    assert "truncated at byte" in opened(PX4[:-3], tmp_path / "cut.ulg").problem
    assert "truncated at byte" in opened(ARDUPILOT[:-3], tmp_path / "cut.bin").problem


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "empty: 0 bytes"),
        (b"ULog", "not a readable ULog"),
        (b"ULog\x01\x12\x35\x01" + bytes(8), "without any logged data"),
        (b"\xa3\x95\x80" + bytes(300), "DataFlash log"),
        (b"some,text\n" * 100, "not a tlog"),
    ],
)
def test_what_is_no_log_is_refused(data, text, tmp_path):
    with pytest.raises(LogError, match=text):
        opened(data, tmp_path / "log")
    with pytest.raises(LogError, match="no such file"):
        recording.open_recording(tmp_path / "nothing")
