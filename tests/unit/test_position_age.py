"""The age of positions against a vehicle that swings about, whose accelerometer is noisy, biased and tilted."""

import math

import numpy as np
import pytest

from mavquad import position_age, quat

G_M_S2 = 9.80665


def motion(t, size):
    """(p, v, a) north of a swing of two tones."""
    p = v = a = 0.0
    for amplitude, w in ((1.5 * size, 0.9), (0.6 * size, 2.3)):
        p += amplitude * math.sin(w * t)
        v += amplitude * w * math.cos(w * t)
        a -= amplitude * w * w * math.sin(w * t)
    return p, v, a


def heard(age_s, seconds=40.0, size=1.0, every_imu=4, seed=1, bias=(0.1, -0.1, 0.2), tilt_rad=0.004):
    """The state after hearing IMU samples every `every_imu` ms and a velocity each 20 ms that is age_s old."""
    rng = np.random.default_rng(seed)
    state, q = position_age.START, quat.from_euler(tilt_rad, -tilt_rad, 0.3)
    for ms in range(1, round(1000 * seconds)):
        t = 1e-3 * ms
        if ms % every_imu == 0:
            world = (motion(t, size)[2], 0.0, -G_M_S2)
            body = quat.rotate_back(quat.from_euler(0.0, 0.0, 0.3), world)
            accel = tuple(float(x) for x in np.array(body) + bias + 0.05 * rng.standard_normal(3))
            state = position_age.feel(state, 1000 * ms, accel, q)
        if ms % 20 == 0:
            v = np.array([motion(t - age_s, size)[1], 0.0, 0.0]) + 0.03 * rng.standard_normal(3)
            state = position_age.hear(state, 1000 * ms, tuple(float(x) for x in v))
    return state, motion(t, size)


@pytest.mark.parametrize("every_imu", [4, 16])
@pytest.mark.parametrize("age_s", [0.02, 0.05])
def test_the_age_is_found_by_a_vehicle_that_moves(age_s, every_imu):
    state, (p, v, _) = heard(age_s, every_imu=every_imu)
    assert abs(position_age.age_s(state) - age_s) < 0.004
    late, late_v, _ = motion(39.999 - age_s, 1.0)
    carried_p, carried_v = position_age.carried(state, (late, 0.0, 0.0), (late_v, 0.0, 0.0))
    assert abs(carried_p[0] - p) < 0.25 * abs(late - p)
    assert abs(carried_v[0] - v) < 0.1


def test_what_is_stamped_in_time_is_left_alone():
    state, _ = heard(0.0)
    assert position_age.age_s(state) == 0.0
    assert position_age.carried(state, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))


def test_a_vehicle_at_rest_tells_nothing_and_nothing_is_changed():
    state, _ = heard(0.05, size=0.0)
    assert position_age.age_s(state) == 0.0


def test_gaps_and_nonsense_begin_again_or_are_dropped():
    state, _ = heard(0.05, seconds=20.0)
    imu_us, position_us = (int(state.view(position_age.RECORD)[name][0]) for name in ("imu_us", "position_us"))
    lost = (math.nan, 0.0, 0.0)
    assert position_age.feel(state, imu_us + 4000, lost, quat.IDENTITY).tobytes() == state.tobytes()
    assert position_age.hear(state, position_us + 20_000, lost).tobytes() == state.tobytes()
    after = position_age.feel(state, imu_us + 2_000_000, (0.0, 0.0, -G_M_S2), quat.IDENTITY)
    assert after.view(position_age.RECORD)["position_us"][0] == 0
    assert position_age.age_s(after) == position_age.age_s(state)  # constant within a boot
