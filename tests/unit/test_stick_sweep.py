"""A helicopter's sticks: the program that is flown, what goes on the wire, and what a log with it gives or lacks."""

import math

import numpy as np
import pytest

from mavquad import airframe, sweep_flight, wire
from mavquad.errors import ConfigError, LogError
from mavquad.identify import fit, models, timebase
from mavquad.identify.structures import REF_LON
from mavquad.signals import NAN3, ZERO3, Demand, Estimate
from mavquad.sweep_flight import LEAD_S, Params
from tools import identify_hover, identify_log, identify_page

HELI = airframe.load("helicopter")
SHORT = Params(axes=("pitch", "roll"), stick_sweep_s=30.0, stick_records=1, stick_quiet_s=3.0, check_s=16.0)
GAINS = sweep_flight.gains(SHORT, HELI)


def flown(gains, until_s, dt_s=0.02, estimate=None):
    still = Estimate(0, (0.0, 0.0, -20.0), ZERO3, (1.0, 0.0, 0.0, 0.0), NAN3, NAN3, NAN3)
    wanted = Demand(0, (0.0, 0.0, -20.0), ZERO3, ZERO3, ZERO3, 0.0, 0.0)
    state = sweep_flight.init(gains)._replace(t_s=until_s)
    return sweep_flight.step(gains, state, estimate or still, wanted, None, dt_s)


def test_each_stick_is_swept_in_turn_with_a_little_noise_on_the_others():
    assert sweep_flight.duration_s(SHORT, "helicopter") == pytest.approx(LEAD_S + 2 * 36.0 + 16.0)
    t = np.arange(0.0, LEAD_S + 88.0, 0.02)
    sticks = np.array([sweep_flight.excitation_at(GAINS, x) for x in t])
    lon, lat = (sticks[(t > LEAD_S + a) & (t < LEAD_S + a + 28.0)].std(axis=0) for a in (4.0, 40.0))
    assert lon[1] > 2.5 * max(lon[[0, 2, 3]]) > 0.0
    assert lat[0] > 2.5 * max(lat[[1, 2, 3]]) > 0.0
    assert np.abs(sticks).max() <= 0.2 + 1e-12
    doublets = sticks[t > LEAD_S + 72.1]
    assert set(np.round(np.abs(doublets).ravel(), 9)) == {0.0, 0.09, 0.15}
    assert not np.any((doublets[:, 0] != 0.0) & (doublets[:, 1] != 0.0))
    np.testing.assert_array_equal(sticks, [sweep_flight.excitation_at(GAINS, x) for x in t])


def test_the_setpoint_is_the_holds_alone_and_the_sticks_go_beside_it_with_the_vehicles_stamp():
    state, command = flown(GAINS, 20.0)
    assert command.a_ned_m_s2[:2] == pytest.approx((0.0, 0.0))
    ((name, fields),) = sweep_flight.messages(GAINS, state, state, 123_456, (7, 1))
    message = wire.decode(wire.split(wire.encode(name, fields, seq=0, system=7, component=191))[0][0])
    assert (message.time_usec, message.group_mlx, message.target_system) == (123_456, 3, 7)
    assert message.controls[:4] == pytest.approx(state.excited, abs=1e-7)
    assert any(state.excited)


def test_an_abort_sends_sticks_of_zero_at_once():
    fast = Estimate(0, (0.0, 0.0, -20.0), (5.1, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), NAN3, NAN3, NAN3)
    state, _ = flown(GAINS, 20.0, estimate=fast)
    sends = dict(sweep_flight.messages(GAINS, sweep_flight.init(GAINS), state, 1, (1, 1)))
    assert sends["SET_ACTUATOR_CONTROL_TARGET"][-1] == (0.0,) * 8
    assert "speed" in sends["STATUSTEXT"][1]


@pytest.mark.parametrize("change", [{"stick_amplitude": (0.1, 0.6, 0.1, 0.1)}, {"stick_records": 0}, {"stick_f_end_hz": 20.0}])
def test_a_program_that_cannot_be_flown_is_refused(change):
    with pytest.raises(ConfigError, match="sweep"):
        Params(**change)


def log(*, applied_hz=50.0, attitude_hz=50.0, gap=False, without=()):
    """A flight as `identify_log` reads it: the short program, sticks applied as added, a first-order answer."""
    t = np.arange(0.0, 100.0, 0.02)
    added = np.array([sweep_flight.excitation_at(GAINS, x) for x in t])
    n = len(t)
    if gap:
        t, added = (np.delete(x, slice(1000, 1050), axis=0) for x in (t, added))
        n = len(t)
    every = round(50.0 / attitude_hz)
    answer = np.cumsum(added[:, [0, 1, 2]], axis=0) * 0.02
    turn = identify_log.Turn(t[::every], answer[::every], added[::every, :3], "ATTITUDE")
    position = identify_log.Vectors(t, np.zeros((n, 3)), answer, "LOCAL_POSITION_NED")
    step = round(50.0 / applied_hz)
    sticks = identify_log.Sticks(t, added, t[::step], added[::step])
    if "applied" in without:
        sticks = sticks._replace(applied_t_s=np.zeros(0), applied=np.zeros((0, 4)))
    return identify_log.Flight(
        None, n, 100.0, turn, None, None, None, None if "position" in without else position, None, ((0.0, 100.0),),
        timebase.SAME, np.zeros(0), (), None if "sticks" in without else sticks,
    )  # fmt: skip


def test_records_are_cut_where_the_sticks_rest_and_doublets_are_kept_for_the_check():
    swept = identify_hover.resampled(log())
    assert [stick for stick, _ in swept.sweeps] == [1, 0]
    for (_, span), start in zip(swept.sweeps, (LEAD_S, LEAD_S + 36.0), strict=True):
        assert span[0] == pytest.approx(start + 3.0 - identify_hover.EDGE_S, abs=0.3)
        assert span[1] == pytest.approx(start + 33.0 + identify_hover.EDGE_S, abs=0.3)
    assert len(swept.checks) == 1
    assert swept.checks[0][0] == pytest.approx(LEAD_S + 72.0 - identify_hover.EDGE_S, abs=0.1)


def test_a_gap_cuts_the_record_and_a_piece_below_20_s_is_dropped():
    swept = identify_hover.resampled(log(gap=True))  # 20 to 21 s, 12 s into the first sweep
    assert [stick for stick, _ in swept.sweeps] == [1, 0]
    assert swept.sweeps[0][1][0] == pytest.approx(21.0, abs=0.1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"without": ("sticks",)}, "SET_ACTUATOR_CONTROL_TARGET of group 3"),
        ({"without": ("applied",)}, "no ACTUATOR_CONTROL_TARGET: ask"),
        ({"without": ("position",)}, "no LOCAL_POSITION_NED"),
        ({"applied_hz": 10.0}, "ACTUATOR_CONTROL_TARGET comes at 10 Hz"),
        ({"attitude_hz": 25.0}, "ATTITUDE comes at 25 Hz"),
    ],
)
def test_what_is_missing_is_said_with_its_message_and_rate(changes, words):
    with pytest.raises(LogError, match=words):
        identify_hover.resampled(log(**changes))


def test_a_part_whose_stick_was_not_swept_says_which_axis_to_fly():
    swept = identify_hover.resampled(log())
    with pytest.raises(LogError, match="stick ped and col never swept; add --axis yaw --axis thrust"):
        identify_hover.part(swept, "yaw and heave", *identify_hover.PARTS["yaw and heave"])


def yaw_and_heave(late_s):
    """The exact answer of REF's yaw and heave at 500 Hz to sticks held for 20 ms, which are stamped `late_s` after they acted."""
    gains = sweep_flight.gains(
        Params(axes=("yaw", "thrust"), stick_sweep_s=40.0, stick_records=1, stick_quiet_s=3.0, check_s=0.0), HELI
    )
    plant, h = models.ref_yaw_heave(), 0.002
    ad, bd = fit.discretized(plant.a, plant.b, h)
    added = np.repeat([sweep_flight.excitation_at(gains, 0.02 * k) for k in range(5000)], 10, axis=0)
    x, answer = np.zeros(3), np.empty((len(added), 2))
    for k, u in enumerate(added[:, 2:]):
        answer[k] = x[:2]
        x = ad @ x + bd @ u
    t, zeros = h * np.arange(len(added)), np.zeros((len(added), 3))
    w, r = (np.column_stack([zeros[:, :2], column]) for column in answer.T)
    sticks = identify_log.Sticks(t + late_s, added, t + late_s, added)
    return identify_log.Flight(
        None, len(t), t[-1], identify_log.Turn(t, zeros, r, "ATTITUDE"), None, None, identify_log.Vectors(t, zeros, r, "HIGHRES_IMU"),
        identify_log.Vectors(t, zeros, w, "LOCAL_POSITION_NED"), None, ((0.0, t[-1]),), timebase.SAME, np.zeros(0), (), sticks,
    )  # fmt: skip


def test_the_answer_is_taken_where_the_sticks_change_although_they_are_stamped_late():
    flight = yaw_and_heave(late_s=0.0046)
    name, truth = "yaw and heave", models.REF_YAW_HEAVE
    early = identify_hover.part(identify_hover.resampled(flight), name, *identify_hover.PARTS[name])
    (found,), missing = identify_hover.identify(flight)
    assert [words.partition(":")[0] for words in missing] == ["longitudinal", "lateral"]
    assert found.late_s == pytest.approx(-0.0046, abs=5e-4)
    for parameter in ("Z_w", "N_r", "N_ped", "K_r", "K_rfb", "Z_col", "N_col"):
        assert found.found.parameters[parameter] == pytest.approx(truth[parameter], rel=0.02), parameter
    shown = "".join(identify_page._hover(found))
    assert "N_ped" in shown
    assert "r from ped" in shown  # its Bode plot
    assert abs(early.found.parameters["N_r"] / truth["N_r"] - 1.0) > 0.04  # a mere delay does not mend it


def test_parameters_that_move_together_are_named_in_one_line_a_group():
    alike = np.eye(10)
    for i, j in ((2, 3), (3, 9), (4, 5)):
        alike[i, j] = alike[j, i] = -0.99
    found = fit.Fit(REF_LON, np.ones(10), np.full(10, 0.01), np.full(10, 0.01), alike, 1.0, 5.0, 100.0, 7, 7, 90)
    assert identify_hover.doubts(found) == [
        "M_a, A_c, tau_s move together (correlations above 0.98)",
        "A_lon, A_lat move together (correlations above 0.98)",
    ]


def test_velocities_are_taken_along_the_body():
    euler = np.array([[0.0, 0.0, math.pi / 2], [0.0, 0.3, 0.0], [math.pi, 0.0, 0.0]])
    v = identify_hover.in_body(euler, np.tile([1.0, 0.0, 0.5], (3, 1)))
    c, s = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(v, [[0.0, -1.0, 0.5], [c - 0.5 * s, 0.0, s + 0.5 * c], [1.0, 0.0, -0.5]], atol=1e-12)
