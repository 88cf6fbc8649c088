"""`mavquad replay` on logs that autopilots keep aboard: PX4 ULog and ArduPilot DataFlash."""

import json
import math

import pytest

from tests.oracles.logs import dataflash, ulog
from tools.__main__ import main

ROLL_RAD, TURN_RAD_S = 0.3, 4.0  # the vehicle rolls by 0.3 sin(4 t)


def roll(t: float) -> tuple[float, float]:
    """Angle and rate."""
    return ROLL_RAD * math.sin(TURN_RAD_S * t), ROLL_RAD * TURN_RAD_S * math.cos(TURN_RAD_S * t)


def attitude(k: int, hz: float) -> tuple[int, float, float, float, float]:
    half = 0.5 * roll(k / hz)[0]
    return (round(1e6 * k / hz), math.cos(half), math.sin(half), 0.0, 0.0)


@pytest.fixture
def px4(tmp_path):
    rates = [(round(1e6 * k / 250), roll(k / 250)[1], 0.0, 0.0) for k in range(1000)]
    data = ulog(
        {
            "vehicle_attitude": ("uint64_t timestamp;float[4] q;", [attitude(k, 200.0) for k in range(800)]),
            "vehicle_angular_velocity": ("uint64_t timestamp;float[3] xyz;", rates),
        }
    )
    (tmp_path / "flight.ulg").write_bytes(data)
    return tmp_path / "flight.ulg"


def ways(result: dict) -> dict[str, float]:
    """rms error of the roll rate by method."""
    return {way["method"]: way["rms_rad_s"][0] for way in result["rates"]["ways"]}


def test_the_rates_of_a_ulog_are_those_that_were_flown(px4, capsys):
    assert main(["replay", str(px4), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["rates"]["source"] == "ULog vehicle_attitude"
    assert result["rates"]["sample_hz"] == pytest.approx(200.0)
    assert result["rates"]["signal_rms_rad_s"][0] == pytest.approx(ROLL_RAD * TURN_RAD_S / math.sqrt(2), rel=0.02)
    found = ways(result)
    half_a_sample = ROLL_RAD * TURN_RAD_S**2 / math.sqrt(2) * 0.0025  # what a plain difference is late by
    assert found["difference"] == pytest.approx(half_a_sample, rel=0.05)
    assert found["rates the autopilot reports"] < 0.002  # the truth, against a central difference
    assert found["gsmo"] < 0.05
    assert any(note.startswith("not enough for disturbance and wind") for note in result["notes"])
    assert {row["name"]: row["count"] for row in result["streams"]} == {
        "vehicle_angular_velocity/0": 1000,
        "vehicle_attitude/0": 800,
    }


def test_a_slow_dataflash_log_is_read_and_called_slow(tmp_path, capsys):
    rows = [(round(1e6 * k / 10), 0, round(100 * math.degrees(roll(k / 10)[0])), 0, 0) for k in range(300)]
    path = tmp_path / "flight.bin"
    path.write_bytes(dataflash({"ATT": ("Qcccc", "TimeUS,DesRoll,Roll,Pitch,Yaw", rows)}))
    assert main(["replay", str(path)]) == 0
    said = capsys.readouterr().out
    assert "not enough for body rates (gsmo): attitude at 10.0 Hz is too slow, needs 50 Hz" in said
    assert "note: 10 Hz is too slow for the rates of a multirotor" in said
    assert "rates the autopilot reports" not in said  # the log holds none


def test_the_pipeline_does_not_run_over_a_log_without_frames(px4, tmp_path, capsys):
    assert main(["replay", str(px4), "--csv", str(tmp_path / "trace.csv")]) == 1
    assert "a log kept aboard holds none" in capsys.readouterr().err
