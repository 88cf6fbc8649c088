"""tools/fused_tick.py: the same bits as the pipeline, stage by stage."""

import math
import random

import pytest

from mavquad import control_step, pipeline, quat, wire
from mavquad.errors import ConfigError
from tools import fused_tick
from tools.benches import live

CHOSEN = {"controller": "eskf-mpc", "estimator": "joint", "compensator": "asmf", "tune": {"eskf-mpc": {"constrained": "off"}}}
_SETPOINT = wire.ID["SET_ATTITUDE_TARGET"]


def _telemetry(ms, draw):
    """Noisy telemetry of one moment: attitudes at 250 Hz, accelerometers at 125, positions at 50, echoes at 10; some of it twice."""
    t_s, said = 1e-3 * ms, []
    if ms % 8 == 0:
        accel = (draw(0.0, 0.2), draw(0.0, 0.2), draw(-9.8, 0.2))
        said.append(("HIGHRES_IMU", (1000 * ms, *accel, draw(0, 0.01), draw(0, 0.01), draw(0, 0.01), *(0.0,) * 7, 0, 0)))
    if ms % 20 == 0:
        v = (0.8 * math.cos(t_s), 0.4 * math.sin(t_s), draw(0.0, 0.03))
        said.append(("LOCAL_POSITION_NED", (ms, 0.8 * math.sin(t_s) + draw(0, 0.02), draw(0, 0.02), draw(-5.0, 0.02), *v)))
    if ms % 100 == 0:
        q = quat.from_euler(draw(0.0, 0.05), draw(0.0, 0.05), 0.0)
        said.append(("ATTITUDE_TARGET", (ms, 7, q, 0.0, 0.0, 0.0, draw(0.5, 0.01))))
    q = quat.from_euler(0.1 * math.sin(2.0 * t_s) + draw(0, 0.003), draw(0.0, 0.003), draw(0.2, 0.003))
    said.append(("ATTITUDE_QUATERNION", (ms, *q, draw(0, 0.05), draw(0, 0.05), draw(0, 0.05), (0.0,) * 4)))
    frames = [wire.split(wire.encode(name, fields, seq=0, system=1, component=1))[0][0] for name, fields in said]
    return frames + frames[-1:] * (ms % 28 == 0)


@pytest.mark.parametrize("path", [{"name": "circle", "speed_m_s": 3.0}, {"name": "hover"}])
def test_one_compiled_tick_is_the_pipelines_bit_for_bit(path):
    plan, flight = live.hovering(path=path, **CHOSEN)
    fused = fused_tick.Tick(plan, flight)
    random_ = random.Random(7)
    draw = lambda mean, sigma: mean + sigma * random_.gauss(0.0, 1.0)  # noqa: E731
    start_ms, setpoints = flight.now_us // 1000 + 4, 0
    for ms in range(start_ms - start_ms % 4, start_ms + 2800, 4):
        frames = _telemetry(ms, draw)
        flight = pipeline.feed_all(plan, flight, 1000 * ms + 5000, frames)
        wanted = [raw[10:-2] for _, raw in flight.outbox if wire.split(raw)[0][0].msgid == _SETPOINT]
        assert [raw[10:-2] for raw in fused.feed(frames)] == wanted
        setpoints += len(wanted)
    assert setpoints > 330
    assert flight.compensator.record.tobytes() == fused.state["active"].tobytes()
    assert flight.estimator.tobytes() == fused.state["joint"].tobytes()
    assert abs(flight.sent.q_wxyz[1]) > 1e-3


def test_what_is_no_plain_tick_is_refused():
    plan, flight = live.hovering(**CHOSEN)
    fused = fused_tick.Tick(plan, flight)
    ms = flight.now_us // 1000 + 8
    jump = ("LOCAL_POSITION_NED", (ms, 30.0, 0.0, -5.0, 0.0, 0.0, 0.0))
    level = ("ATTITUDE_QUATERNION", (ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 4))
    frames = [wire.split(wire.encode(*said, seq=0, system=1, component=1))[0][0] for said in (jump, level)]
    with pytest.raises(ConfigError, match="feed the pipeline"):
        fused.feed(frames)
    with pytest.raises(ConfigError, match="got direct, pid, none"):
        fused_tick.fixed(live.hovering(controller="pid")[0])
    assert control_step.G_M_S2 == fused_tick.G_M_S2
