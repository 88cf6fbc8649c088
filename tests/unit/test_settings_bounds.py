"""What a companion file or a ground station may not set: no number, no fence, a clockwork without end."""

import math

import pytest

from mavquad import config, pipeline, tunables
from mavquad.errors import ConfigError
from mavquad.settings import Companion


def build(**data):
    return pipeline.build(config.convert({"observers": [], **data}, Companion, "test.toml"))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("key", "data"),
    [
        ("safety.fence_m", lambda x: {"safety": {"fence_m": x}}),  # a fence that nothing crosses
        ("safety.release_s", lambda x: {"safety": {"release_s": x}}),
        ("link.rates_hz.ATTITUDE", lambda x: {"link": {"rates_hz": {"ATTITUDE": x}}}),
        ("settle_s", lambda x: {"settle_s": x}),
        ("tune.pid.accel_max_m_s2", lambda x: {"tune": {"pid": {"accel_max_m_s2": x}}}),
    ],
)
def test_what_is_no_number_is_refused_by_its_key(key, data, number):
    with pytest.raises(ConfigError) as refused:
        build(**data(number))
    assert str(refused.value) == f"test.toml: {key} = {number}: expected a finite number"


def test_in_a_list_it_is_named_by_its_place():
    with pytest.raises(ConfigError, match=r"^x: wind\.gusts\[1\]\.speed_m_s = nan: "):
        config.convert({"wind": {"gusts": [{"speed_m_s": 1.0}, {"speed_m_s": math.nan}]}}, Companion, "x")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (
            {"link": {"publish_hz": 1e300}},
            "link.publish_hz = 1e+300: expected 0.01 to 100 Hz",
        ),  # its next time would be now, for ever
        ({"link": {"timesync_hz": 0.0}}, "link.timesync_hz = 0.0: expected 0.01 to 100 Hz"),
        ({"link": {"rates_hz": {"ATTITUDE": 1e-300}}}, "link.rates_hz.ATTITUDE = 1e-300: expected 0.01 to 1000 Hz"),
        ({"link": {"system": 300}}, "link.system = 300: expected 1 to 255"),
        ({"link": {"component": 0}}, "link.component = 0: expected 1 to 255"),
        ({"link": {"target_system": -1}}, "link.target_system = -1: expected 0 to 255"),
        ({"safety": {"hold_s": 0.0}}, "safety.hold_s = 0.0: expected more than 0, at most 1e6"),
        ({"safety": {"battery_percent": 101.0}}, "safety.battery_percent = 101.0: expected 0 to 100"),
        ({"settle_s": -0.1}, "settle_s = -0.1: expected 0 to 600"),
        (
            {"controller": "eskf-mpc", "tune": {"eskf-mpc": {"r_input": 1e300}}},
            "no gain belongs to state weights 4, 0.5, 0 and input weight 1e+300: ",
        ),
    ],
)
def test_what_nobody_can_fly_with_is_refused_in_words(data, said):
    with pytest.raises(ConfigError) as refused:
        build(**data)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("controller", ["pid", "eskf-mpc"])
def test_a_gain_set_in_flight_is_a_number_that_has_a_design(controller):
    plan = build(controller=controller)
    for tunable in tunables.tunables(plan):
        for bad in (math.nan, math.inf, -math.inf):
            with pytest.raises(ConfigError, match="expected a finite number"):
                tunables.change(plan, tunable.name, bad)
    if controller == "eskf-mpc":
        for bad in (1e38, 1e-38):
            with pytest.raises(ConfigError, match="no gain belongs"):
                tunables.change(plan, "ESKFMP_Q_POSITIO", bad)
