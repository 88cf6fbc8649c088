"""Flights in bulk: the compiled function against the simulated autopilot and the companion's pipeline step by step, bit for bit."""

import json
import sys

import numpy as np
import pytest

from mavquad.errors import ConfigError
from sitl import rotation, rotors
from sitl.sensors import COLUMNS, sense
from sitl.state import VEHICLE, Record
from tools import scenarios
from tools.__main__ import main
from tools.bulk import fleet, lean, normals, rates, setup, stepwise
from tools.bulk.state import FLYING, LOST, NOISE, TOUCHED, TRACE
from tools.campaigns import compiled, grid

SHORT = ("companion.settle_s=0.5", "path.turns=0.3", "flight.score_from_s=1")
# from 3.12 on sum() rounds once: the length of a quaternion that came over the wire may differ in its last bit
EXACT = sys.version_info < (3, 12)


def resolve(scenario="gusty", *changes, **options):
    return scenarios.resolve(scenarios.load(scenario, [*SHORT, *changes]), scenarios.Options(**{"seed": 3, **options}))


def both(resolved, periods):
    until_us = setup.START_US + periods * 1000 * resolved.sitl.period_ms
    prepared = setup.prepare(resolved)
    fused = np.zeros((periods, TRACE))
    assert setup.fly(prepared, until_us, fused) == periods
    return stepwise.Loop(resolved).noted(until_us), fused, prepared


@pytest.mark.parametrize(
    ("controller", "changes"),
    [
        ("pid", ()),
        ("pd", ("link.delay_ms=23.5", "wind.rotor_model=G", "vehicle.inertia=+10%", "noise.position_m=0.1")),
        ("autopilot", ("link.delay_ms=0",)),
    ],
)
def test_one_compiled_function_equals_autopilot_and_pipeline_step_by_step(controller, changes):
    slow, fast, prepared = both(resolve("gusty", *changes, controller=controller), 500)
    assert prepared.flight["engaged"]
    assert np.ptp(fast[300:, 1]) > 0.2  # it flies its path
    if EXACT:
        assert slow.tobytes() == fast.tobytes()
    else:
        np.testing.assert_allclose(fast, slow, atol=1e-6)


def test_what_the_lean_sensors_leave_is_what_the_autopilots_sensors_leave():
    vehicle = setup.prepare(resolve()).vehicle
    other = vehicle.state.array.copy()
    if type(vehicle.state.array) is np.recarray:
        other = other.view(np.recarray)
    rng = np.random.default_rng(5)
    for _ in range(30):
        normals = rng.standard_normal(COLUMNS)
        lean.sense(vehicle.state.array[0], vehicle.constants.array[0], normals)
        sense(other[0], vehicle.constants.array[0], normals)
        vehicle.state["step"] = vehicle.state["step"] + 1
        other["step"] += 1
    lean.quaternion(vehicle.state.array[0])
    made = ("ahrs_R", "ahrs_q_wxyz", "rates_rad_s", "rates_slope", "gyro_bias_rad_s", "nav_p_ned_m", "nav_v_ned_m_s", "past")
    assert set(made) < set(VEHICLE.names)
    for name in made:
        assert vehicle.state[name].tobytes() == np.ascontiguousarray(other[name][0]).tobytes(), name


def test_normals_in_a_record_are_those_of_numpys_generator():
    seeds = [[5, k] for k in range(4)]
    noise = Record(NOISE, generators=[normals.words(np.random.default_rng(seed)) for seed in seeds])
    found = np.empty((4, 4000, COLUMNS))
    for k, rows in enumerate(found):
        for row in rows:
            normals.draw(noise.array[0], k, 0, COLUMNS)
            row[:] = noise["normals"]
    assert np.abs(found).max() > 3.7  # beyond the tables' last layer too
    wanted = np.stack([np.random.default_rng(seed).standard_normal((4000, COLUMNS)) for seed in seeds])
    assert found.tobytes() == wanted.tobytes()


def test_normals_passed_over_are_passed_over():
    noise = Record(NOISE, generators=[normals.words(np.random.default_rng(k)) for k in range(4)])
    generator = np.random.default_rng(2)
    for count in (1, 4000, 7):
        normals.skip(noise.array[0], 2, count)
        generator.standard_normal(count)
        normals.draw(noise.array[0], 2, 3, 4)
        assert noise["normals"][3:7].tobytes() == generator.standard_normal(4).tobytes()
    assert noise["generators"][1].tolist() == list(normals.words(np.random.default_rng(1)))


def test_a_generators_step_is_the_same_without_the_compiler():
    generator = np.random.default_rng(8)
    for _ in range(20):
        before = [np.uint64(word) for word in normals.words(generator)]
        generator.bit_generator.random_raw()
        assert normals._step_uncompiled(*before) == tuple(normals.words(generator)[:2])


def test_the_same_seed_is_the_same_flight_in_one_call_or_in_many():
    ends = []
    for seed, cuts in ((3, []), (3, [1.0, 2.6]), (4, [])):
        p = setup.prepare(resolve(seed=seed))
        for cut in cuts:
            setup.fly(p, setup.START_US + round(1e6 * cut))
        setup.fly(p)
        assert p.flight["ended"] == FLYING
        assert p.flight["t_us"] >= p.end_us
        ends.append(p.flight.array.tobytes())
    assert ends[0] == ends[1] != ends[2]


def test_each_vehicle_of_a_fleet_moves_as_it_would_alone():
    flights = [
        setup.prepare(resolve("gusty", f"wind.mean_m_s={0.2 * seed}", seed=seed, controller="pid")) for seed in range(1, 36)
    ]
    for p in flights:
        setup.fly(p, setup.START_US + 2_500_000)  # setpoints flow
    together = fleet.gather(flights)  # a part and three vehicles more
    for steps in (1, 400):
        fleet.advance(together, steps, threads=2)
        for p in flights:
            v = p.vehicle
            rates.with_loops(v.state.array, v.setpoint.array, v.constants.array, v._gusts, p.noise.array, steps)
    alone = [p.vehicle.state.array.tobytes() for p in flights]
    assert [together.vehicles[k : k + 1].tobytes() for k in range(35)] == alone
    assert len(set(alone)) == 35
    assert np.ptp(together.vehicles["p_ned_m"][:, 0]) > 0.01


def test_vehicles_side_by_side_keep_their_bits_whatever_one_of_them_meets():
    flights = [setup.prepare(resolve(seed=seed, controller="pid")) for seed in range(1, 25)]
    for p in flights:
        setup.fly(p, setup.START_US + 2_500_000)
    v = [p.vehicle for p in flights]
    v[2].constants["ground_d_m"] = v[2].state["p_ned_m"][2] + 0.03  # sinks to the ground on the way
    v[2].setpoint["thrust"] = 0.3
    v[3].constants["lag_s"] = 0.0
    v[4].setpoint["R"] = rotation.from_euler(3.14, 0.3, 1.0)  # turns over, at rates beyond the sine's series
    v[5].constants["effectiveness"], v[5].constants["push_nm"] = (0.8, 1.0, 1.1, 0.9), (0.05, -0.1, 0.02)
    v[6].setpoint["rates_rad_s"] = (0.0, 0.0, 0.9)
    v[7].constants["drag_quadratic"], v[7].constants["push_n"] = (0.1, 0.2, 0.3), (1.0, -2.0, 0.5)
    v[8].constants["rotor_model"] = rotors.MODEL_G  # its eight go alone
    together = fleet.gather(flights)
    fleet.advance(together, 150, threads=1)
    fleet.advance(together, 0, threads=1)
    for p in flights:
        rates.with_loops(
            p.vehicle.state.array, p.vehicle.setpoint.array, p.vehicle.constants.array, p.vehicle._gusts, p.noise.array, 150
        )
    for k in range(24):
        for name in VEHICLE.names:
            assert together.vehicles[k : k + 1][name].tobytes() == v[k].state.array[name].tobytes(), (k, name)
    assert [bool(grounded) for grounded in together.vehicles["grounded"]] == [k == 2 for k in range(24)]
    assert together.vehicles["impact_m_s"][2] > 0.1
    assert np.abs(together.vehicles["omega_rad_s"][4]).max() > 0.5
    assert np.linalg.norm(together.vehicles["omega_rad_s"][6]) > 0.5


def test_scores_are_those_of_a_flight_step_by_step():
    words = ("gusty", "--seed", "5", "--controller", "pid", *(w for change in SHORT for w in ("--set", change)))
    fast = compiled._fused(compiled._resolve(words))
    slow = compiled._stepwise(compiled._resolve(words))
    assert fast[0]["rmse_m"]["position"] == pytest.approx(slow[0]["rmse_m"]["position"], rel=2e-3)
    assert fast[0]["max_error_m"] == pytest.approx(slow[0]["max_error_m"], rel=2e-3)
    assert fast[1:] == slow[1:]
    assert slow[0]["setpoint_misses"] == 0


@pytest.mark.parametrize(("constant", "value", "ended"), [("thrust_max_n", 1.0, TOUCHED), ("mass_kg", np.nan, LOST)])
def test_a_flight_that_does_not_go_well_says_how(constant, value, ended):
    p = setup.prepare(resolve(controller="pid"))
    p.vehicle.constants[constant] = value
    setup.fly(p)
    assert p.flight["ended"] == ended


def test_what_is_not_one_compiled_function_flies_stage_by_stage():
    for options, changes, reason in (
        ({"controller": "adrc"}, (), "controller adrc"),
        ({"controller": "pid", "compensator": "asmf"}, (), "compensator asmf"),
        ({"controller": "pid", "personality": "ardupilot"}, (), "personality ardupilot"),
        ({"controller": "pid"}, ("link.jitter_ms=5", "link.loss=0.01"), "link.jitter_ms, link.loss"),
        ({"controller": "pid"}, ('faults=[{kind = "motor", motor = 1, effectiveness = 0.9, t_s = 11}]',), "faults"),
    ):
        resolved = resolve("gusty", *changes, **options)
        assert setup.why_not_fused(resolved) == reason
        loop = stepwise.Loop(resolved)
        flown = loop.fly(loop.engage_us + 1_200_000)
        assert not flown.grounded
        assert len(flown.truth.t_us) > 300
        error = flown.trace.vector("ref_p")[-50:] - flown.truth.p_ned_m[-50:]
        assert np.abs(error).max() < 1.0, options
    with pytest.raises(ConfigError, match="helicopter is no quadrotor"):
        stepwise.Loop(scenarios.resolve(scenarios.load("hover"), scenarios.Options(airframe="helicopter")))


def test_a_campaign_without_sockets(tmp_path, capsys):
    file = tmp_path / "both.toml"
    file.write_text(
        'about = "x"\nseeds = "1-2"\nbaseline = "pid"\nmetrics = ["rmse_m", "disturbance_correlation"]\n'
        f"set = {json.dumps(SHORT)}\n"
        '[[scenario]]\nname = "gusty"\n[[variant]]\nname = "pid"\ncontroller = "pid"\n[[variant]]\nname = "adrc"\ncontroller = "adrc"\n'
        '[draw]\n"wind.mean_m_s" = { uniform = [2.0, 5.0] }\n'
    )
    words = ["campaign", str(file), "--out", str(tmp_path / "x.sqlite"), "--json"]
    assert main([*words, "--jobs", "1"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["problem"] for row in told["rows"]] == [""] * 4
    pid, adrc = told["cells"][:2]
    assert (pid["flown"], adrc["flown"], adrc["pairs"]) == (2, 2, 2)
    assert 0.0 < pid["median"] < 0.5
    assert told["cells"][2]["median"] is None  # pid estimates no disturbance
    assert told["cells"][3]["median"] > 0.2
    flights = list(grid.flights(grid.load(str(file))))
    assert [len(chunk) for chunk in compiled.chunks(flights)] == [3, 1]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["speed"]["flights"] == 0
