"""Run every stage of a plan once on made-up samples, so that its kernels are compiled or loaded before the link is opened. Pure."""

import math

from mavquad import control_step, lane, lifecycle, pipeline, wire
from mavquad import flight as flights
from mavquad.plan import Plan

_STEP_US = 20_000


def run(plan: Plan) -> int:
    """Feed a scratch flight a second of a hovering vehicle, engaged; nothing of it is kept. Returns the control steps taken."""
    f = flights.start(plan)
    steps = seq = 0
    for k in range(60):
        t_us = _STEP_US * (k + 1)
        for name, fields in _samples(t_us):
            raw = wire.encode(name, fields, seq=seq, system=1, component=1)
            seq = (seq + 1) & 0xFF
            f = pipeline.feed(plan, f, t_us, wire.split(raw)[0][0])
            steps += len(f.trace)
        if k == 10:  # straight to flying, without an autopilot to ask
            f = f.clone()
            f.life = f.life._replace(state=lifecycle.STREAMING, armed=True, mode=6 << 16, autopilot=lifecycle.PX4)
            control_step.anchor(plan, f)
    if lane.serves(plan):
        lane.Lane(plan, lockstep=False)
    return steps


def _samples(t_us: int) -> list[tuple[str, tuple[object, ...]]]:
    ms = t_us // 1000
    half = 0.005 * math.sin(1e-6 * t_us)
    q = (math.cos(half), math.sin(half), 0.0, 0.0)
    frames: list[tuple[str, tuple[object, ...]]] = [
        ("LOCAL_POSITION_NED", (ms, 0.0, 0.0, -5.0, 0.0, 0.0, 0.0)),
        ("HIGHRES_IMU", (t_us, 0.0, 0.0, -9.8, *(0.0,) * 10, 0, 0)),
        ("SERVO_OUTPUT_RAW", (t_us, 0, *(1570,) * 8, *(0,) * 8)),
        ("ATTITUDE_TARGET", (ms, 0, q, 0.0, 0.0, 0.0, 0.57)),
        ("ACTUATOR_CONTROL_TARGET", (t_us, 0, (0.01,) * 8)),
        ("ATT_POS_MOCAP", (t_us, q, 0.0, 0.0, -5.0, (0.0,) * 21)),
        ("ATTITUDE_QUATERNION", (ms, *q, 0.0, 0.0, 0.0, (0.0,) * 4)),
    ]
    if t_us == _STEP_US:
        frames.insert(0, ("HEARTBEAT", (2, 12, 0, 0, 4, 3)))
    return frames
