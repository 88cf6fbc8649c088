"""The clock of the live companion, at the pace of a simulated vehicle."""

import pytest

from mavquad.link import clock


@pytest.mark.parametrize(("speed", "shown_us"), [(1.0, 40_000), (10.0, 400_000), (0.5, 20_000)])
def test_it_runs_at_its_speed_from_now_on(monkeypatch, speed, shown_us):
    now_ns = [1_800_000_000_000_000_000]
    monkeypatch.setattr(clock.time, "time_ns", lambda: now_ns[0])
    one = clock.Clock(speed)
    began_us = one.us()
    assert began_us == 1_800_000_000_000_000
    now_ns[0] += 40_000_000
    assert one.us() - began_us == shown_us


def test_at_real_time_it_is_the_wall_clock_whose_steps_it_follows(monkeypatch):
    one = clock.Clock()
    monkeypatch.setattr(clock.time, "time_ns", lambda: 5_000_000_000_000)
    assert one.us() == clock.wall_us() == 5_000_000_000
