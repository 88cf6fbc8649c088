"""Scenarios: all resolve, --set goes where it means, mistakes name file and key, TOML written is TOML read."""

import math
import tomllib

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavquad import config, toml
from mavquad.errors import ConfigError
from mavquad.settings import Companion
from sitl.config import Sitl
from tools import scenarios


@pytest.mark.parametrize("name", scenarios.names())
def test_every_scenario_resolves_with_the_standard_conditions(name):
    _, sitl, companion = scenarios.resolve(scenarios.load(name), scenarios.Options(seed=7))
    assert (sitl.noise.position_m, sitl.noise.velocity_m_s, sitl.noise.attitude_deg) == (0.02, 0.03, 0.2)
    assert (sitl.noise.gyro_rad_s, sitl.noise.accel_m_s2, sitl.link.delay_ms) == (0.005, 0.05, 5.0)
    assert (sitl.seed, companion.seed, companion.takeoff_m) == (7, 7, 5.0)
    assert companion.path.name == {"gusty": "circle", "sweep": "hover"}.get(name, name)
    for resolved, kind in ((sitl, Sitl), (companion, Companion)):  # as written into the run folder
        again = config.convert(tomllib.loads(toml.dumps(msgspec.to_builtins(resolved))), kind, name)
        assert again == resolved


def test_the_standard_scenarios_are_those_of_the_architecture():
    assert scenarios.names() == ["circle", "ellipse", "gusty", "hover", "line", "rectangle", "spiral", "sweep"]
    sitl = scenarios.resolve(scenarios.load("gusty"), scenarios.Options()).sitl
    assert tuple(sitl.overrides) == ("body.mass_kg=+20%",)
    assert (sitl.wind.mean_m_s, sitl.wind.w20_m_s, sitl.wind.gusts[0].speed_m_s) == (5.0, 8.0, 6.0)
    line = scenarios.load("line").path
    assert (line.length_m, line.speed_m_s, line.accel_m_s2) == (200.0, 12.0, 2.5)


def test_with_mocap_the_observer_runs_on_it_with_torque_known_and_unknown():
    for attitude, expected in (
        ("ahrs", ["gsmo"]),
        ("mocap", [*scenarios.MOCAP_OBSERVERS]),
        ("both", [*scenarios.MOCAP_OBSERVERS]),
    ):
        resolved = scenarios.resolve(scenarios.load("circle"), scenarios.Options(attitude=attitude))
        assert list(resolved.companion.observers) == expected
    chosen = scenarios.resolve(scenarios.load("circle"), scenarios.Options(attitude="mocap", observers=["gsmo"]))
    assert list(chosen.companion.observers) == ["gsmo"]


def test_set_reaches_the_vehicle_the_simulator_and_the_companion():
    changes = [
        "vehicle.mass=+20%",
        "vehicle.body.inertia_kg_m2=+5%",
        "wind.mean_m_s=4",
        "noise.position_m=+50%",
        "path.radius_m=2.5",
        "limits.tilt_deg=+10%",
        "companion.control_hz=100",
        "flight.takeoff_m=8",
        "pid.x=0.25",
    ]
    options = scenarios.Options(controller="pd", observers=["gsmo"], attitude="mocap")
    _, sitl, companion = scenarios.resolve(scenarios.load("circle", changes), options)
    assert tuple(sitl.overrides) == ("body.mass_kg=+20%", "body.inertia_kg_m2=+5%")
    assert (sitl.wind.mean_m_s, sitl.attitude_source) == (4, "mocap")
    assert sitl.noise.position_m == pytest.approx(0.03)
    assert companion.path.radius_m == 2.5
    assert companion.limits.tilt_deg == pytest.approx(1.1 * Companion().limits.tilt_deg)
    assert (companion.control_hz, companion.takeoff_m, companion.tune) == (100, 8, {"pid": {"x": 0.25}})
    assert (companion.controller, tuple(companion.observers)) == ("pd", ("gsmo",))
    assert companion.estimator == "auto"


@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("circel", [], "known: circle"),
        ("circle", ["mass"], "TABLE.KEY=VALUE"),
        ("circle", ["windd.x.y"], "TABLE.KEY=VALUE"),
        ("circle", ["flight.takeof_m=3"], 'did you mean "takeoff_m"'),
        ("circle", ["noise.positon_m=+5%"], 'did you mean "position_m"'),
        ("circle", ["noise.positon_m=5"], 'unknown key "positon_m" in [noise]; did you mean "position_m"'),
        ("circle", ["wind.mean_m_s=-5"], "0 to 60 m/s"),
        ("circle", ["require.rmse_m=fast"], "require.rmse_m = 'fast'"),
        ("circle", ["companion.control_hz=0"], "1 to 1000"),
        ("circle", ["flight.takeoff_m=-3"], "takeoff_m = -3"),
    ],
)
def test_a_mistake_says_what_and_where(name, changes, says):
    with pytest.raises(ConfigError) as error:
        scenarios.resolve(scenarios.load(name, changes), scenarios.Options())
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_an_impossible_vehicle_and_a_missing_file_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="mass_kg = -2"):
        scenarios.resolve(scenarios.load("circle", ["vehicle.mass=-2"]), scenarios.Options())
    with pytest.raises(ConfigError, match="did you mean"):
        scenarios.resolve(scenarios.load("circle", ["vehicle.body.mas_kg=+20%"]), scenarios.Options())
    with pytest.raises(ConfigError, match=r"own\.toml: no such file"):
        scenarios.load(str(tmp_path / "own.toml"))
    own = tmp_path / "own.toml"
    own.write_text('about = "mine"\n[path]\nname = "hover"\n[wind]\nmean_m_s = 3.0\n[companion]\ncontroller = "pd"\n')
    mine = scenarios.resolve(scenarios.load(str(own)), scenarios.Options())
    assert (mine.sitl.wind.mean_m_s, mine.companion.controller) == (3.0, "pd")
    own.write_text('about = "mine"\npth = 1\n[path]\nname = "hover"\n')
    with pytest.raises(ConfigError, match=r'own\.toml: unknown key "pth"; did you mean "path"'):
        scenarios.load(str(own))


scalars = st.one_of(st.booleans(), st.integers(-(2**62), 2**62), st.floats(), st.text(max_size=20))
values = st.recursive(scalars, lambda v: st.lists(v, max_size=3), max_leaves=6)
tables = st.dictionaries(st.text(max_size=6), st.one_of(values, st.dictionaries(st.text(max_size=6), values, max_size=3)))


def _same(a, b):
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(_same, a, b))
    return (type(a) is type(b) and a == b) or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


@given(tables)
def test_toml_written_is_toml_read_to_the_last_bit(data):
    assert _same(data, tomllib.loads(toml.dumps(data)))


def test_toml_of_lists_of_tables_and_of_nothing():
    data = {"gusts": [{"t_s": 1.0, "about": 'a\n"b"'}], "empty": {}, "deep": {"er": {"x": [1, 2]}}}
    assert tomllib.loads(toml.dumps(data)) == data
    assert toml.dumps({"a": None}) == ""
    with pytest.raises(ConfigError, match="set"):
        toml.dumps({"a": {1, 2}})
