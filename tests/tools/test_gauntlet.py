"""The table of faults: what is judged on the wire, what a row must come to, and two rows as a person flies them."""

import json
import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavquad import wire
from mavquad.setpoint.limits import Limits
from tools import __main__ as tools_main
from tools import gauntlet, listener, scenarios

LIMITS = Limits()


def setpoint(q=(1.0, 0.0, 0.0, 0.0), rates=(0.0, 0.0, 0.0), thrust=0.5, component=191):
    fields = (1000, 1, 1, 7, q, *rates, thrust)
    return wire.encode("SET_ATTITUDE_TARGET", fields, seq=0, system=1, component=component)


def lean(deg):
    half = math.radians(0.5 * deg)
    return (math.cos(half), math.sin(half), 0.0, 0.0)


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (setpoint(), ""),
        (setpoint(lean(39.9), thrust=0.95), ""),
        (setpoint(lean(-41.0)), "tilt of more than 40 deg"),
        (setpoint((0.0, 1.0, 0.0, 0.0)), "tilt of more than 40 deg"),
        (setpoint((1.01, 0.0, 0.0, 0.0)), "no unit quaternion"),
        (setpoint((math.nan, 0.0, 0.0, 0.0)), "not finite"),
        (setpoint(thrust=math.inf), "not finite"),
        (setpoint(thrust=0.96), "thrust outside 0.08 to 0.95"),
        (setpoint(thrust=0.0), "thrust outside 0.08 to 0.95"),
        (setpoint(rates=(0.0, 2.6, 2.6)), "rates of more than 200 deg/s"),
        (setpoint(rates=(math.nan, 0.0, 0.0)), "not finite"),
    ],
)
def test_the_listener_judges_each_setpoint_in_a_datagram(raw, why):
    with listener.Listener(LIMITS, 191) as ear:
        beat = wire.encode("HEARTBEAT", (18, 8, 0, 0, 4, 3), seq=0, system=1, component=191)
        ear.judge(beat + raw + setpoint(thrust=7.0, component=190) + beat)
    assert ear.heard == 1
    assert ear.bad == ({why: 1} if why else {})


def test_a_signed_setpoint_is_judged_too():
    raw = wire.sign(setpoint(thrust=0.99), bytes(32), 0, 1)
    with listener.Listener(LIMITS, 191) as ear:
        ear.judge(raw + raw)
    assert (ear.heard, list(ear.bad.values())) == (2, [2])


def test_a_frame_that_cannot_be_decoded_is_bad():
    raw = bytearray(setpoint())
    raw[-1] ^= 1
    with listener.Listener(LIMITS, 191) as ear:
        ear.judge(bytes(raw))
    assert sum(ear.bad.values()) == 1
    assert wire.ID["SET_ATTITUDE_TARGET"] == dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET


def row(name="x", must=gauntlet.FINISHES, **more):
    flown = {
        "row": name,
        "must": must,
        "held": False,
        "rmse_m": 0.03,
        "state": "released",
        "reason": "landing by the autopilot",
    }
    flown |= {"landed": True, "crashed": False, "setpoints": 9, "judged": 9, "bad": {}, "announced": [], "problems": []}
    return flown | {"command": "mavquad fly circle --controller eskf-mpc"} | more


@pytest.mark.parametrize(
    ("flown", "wrong"),
    [
        (row(), ""),
        (row(landed=False), "did not finish"),
        (row(crashed=True), "did not finish"),
        (row(reason="no telemetry for 1.5 s"), "did not finish"),
        (row(bad={"not finite": 1}), "setpoints on the wire"),
        (row(judged=8), "8 of 9 setpoints judged"),
        (row(held=True, rmse_m=0.061), "2.03 times the clean one"),
        (row(held=True, rmse_m=0.059), ""),
        (row(held=True, rmse_m=0.2, command="mavquad fly circle --controller pid"), ""),
        (row(must=gauntlet.LETS_GO, reason="no telemetry for 1.5 s"), ""),
        (row(must=gauntlet.LETS_GO, reason="no telemetry for 1.5 s", landed=False), "not given back"),
        (row(must=gauntlet.LETS_GO, state="engaged"), "not given back"),
        (row(must=gauntlet.FALLS, announced=["autopilot restarted, beginning again"]), ""),
        (row(must=gauntlet.FALLS), "not announced"),
    ],
)
def test_what_a_row_must_come_to(flown, wrong):
    rows = [row("clean"), flown]
    gauntlet.judge(rows)
    assert rows[0]["wrong"] == []
    assert wrong in " ".join(flown["wrong"])
    assert bool(flown["wrong"]) is bool(wrong)


def test_every_row_is_a_flight_that_can_be_resolved():
    for entry in gauntlet.ROWS:
        scenario = scenarios.load("circle", [*gauntlet.BASE, *entry.sets])
        scenarios.resolve(scenario, scenarios.Options())
    assert len({entry.name for entry in gauntlet.ROWS}) == len(gauntlet.ROWS)


def test_time_degraded_is_what_was_held_slowed_and_not_followed():
    texts = [(10.0, "120 ms late, flying slower"), (11.0, "250 ms late, flying slower"), (13.0, "in time again")]
    texts += [(14.0, "setpoints are not followed"), (15.5, "released: no telemetry for 1.5 s")]
    assert gauntlet.degraded_s(texts, {"held": 3, "held level": 2, "late": 9}) == pytest.approx(0.5 + 3.0 + 1.5)


@pytest.mark.xdist_group("flights")
def test_a_row_of_the_gauntlet_is_flown_and_listened_to(tmp_path, capsys):
    words = ["fly", "gauntlet", "--rows", "silence 2", "--set", "flight.takeoff_m=1", "--run", str(tmp_path / "run"), "--json"]
    assert tools_main.main(words) == 0
    (flown,) = json.loads(capsys.readouterr().out)
    assert flown["wrong"] == []
    assert flown["state"] == "released"
    assert flown["judged"] == flown["setpoints"] > 300
    assert flown["bad"] == {}
    assert any("no telemetry" in text for text in flown["announced"])
