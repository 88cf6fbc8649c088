"""Observers over whole records: the compiled loops against the observers that fly, sample by sample on a recording."""

import heapq
import math
from pathlib import Path

import numpy as np
import pytest

from mavquad import active_flight, active_record, airframe, quat, wire
from mavquad.estimate import (
    extended_state_flight,
    extended_state_record,
    joint_flight,
    joint_record,
    joint_tick,
    leso_flight,
    record,
)
from mavquad.link import bulk, recording
from mavquad.link import signals as decode
from mavquad.link.columns import Log
from mavquad.signals import NAN3, Applied, Attitude, Command, Estimate, Imu, Position, Target

FLIGHT = Path(__file__).parent.parent / "data" / "sweep-roll-20s.tlog"
HOVER, G = 0.385, 9.80665
NOTHING = Command(NAN3, 0.0, 0.0, NAN3, NAN3)
UNKNOWN = Estimate(0, NAN3, NAN3, (1.0, 0.0, 0.0, 0.0), NAN3, NAN3, NAN3)
PERIOD_US = 20_000


@pytest.fixture(scope="module")
def flown():
    """The recording's samples in order of arrival, and the same as events."""
    found = recording.open_recording(FLIGHT, component=1).signals
    parts = {}
    for kind, name in ((record.ATTITUDE, Attitude), (record.POSITION, Position), (record.IMU, Imu)):
        s = found[name]
        parts[kind] = (s.arrival_us, s.columns[0], np.column_stack(s.columns[1:]))
    target = found[Target]
    angles = np.array([quat.to_euler(tuple(q)) for q in target.column("q_wxyz").tolist()])
    parts[record.COMMAND] = (
        target.arrival_us, target.columns[0], np.column_stack([angles[:, :2], G * target.column("thrust") / HOVER]),
    )  # fmt: skip
    ordered = heapq.merge(*(recording._samples(found[k]) for k in (Position, Imu, Target, Attitude)), key=lambda item: item[0])
    return [sample for _, sample in ordered], record.events(parts, PERIOD_US)


def _at_steps(samples, events):
    """Every sample, and whether it is one after which the observer is asked."""
    asked = set(events.t_us[events.step].tolist())
    for sample in samples:
        yield sample, isinstance(sample, Attitude) and sample.t_us in asked


def _flown(module, gains, samples, events):
    state, rows = module.init(gains), []
    for sample, asked in _at_steps(samples, events):
        if isinstance(sample, Target):  # what was sent, with no delay: the record's commands
            applied = Applied(sample.t_us, sample.q_wxyz, G * sample.thrust / HOVER, NAN3, 0.0)
            if module is extended_state_flight:
                state = state._replace(
                    sent=(*state.sent[-63:], extended_state_flight.Sent(sample.t_us, applied.thrust_m_s2, sample.thrust))
                )
            else:
                state = state.copy()
                joint_tick.applied_thrust.remember(
                    state.view(joint_tick.RECORD)[0], applied.t_us, applied.thrust_m_s2, applied.delay_s
                )
        else:
            state = module.observe(gains, state, sample)
        if asked:
            _, e = module.step(gains, state, Applied(sample.t_us, (1.0, 0.0, 0.0, 0.0), math.nan, NAN3, 0.0), sample.t_us)
            rows.append((*e.p_ned_m, *e.v_ned_m_s, *e.f_ned_m_s2))
    return np.array(rows)


@pytest.mark.parametrize(
    ("module", "bulk_module", "params"),
    [
        (joint_flight, joint_record, {"echo": False}),
        (joint_flight, joint_record, {"echo": False, "accel_tau_s": 0.3, "lead_s": 0.05}),
        (leso_flight, joint_record, {"echo": False}),
        (extended_state_flight, extended_state_record, {"echo": False}),
        (extended_state_flight, extended_state_record, {"echo": False, "adapt": 0.01, "anchor_s": 0.0}),
    ],
)
def test_a_record_in_bulk_gives_what_the_observer_gives_in_flight(flown, module, bulk_module, params):
    samples, events = flown
    gains = module.gains(module.Params(**params), airframe.load("x500"))
    again = bulk_module.run(gains, events)
    rows = _flown(module, gains, samples, events)
    got = np.column_stack([again.p_ned_m, again.v_ned_m_s, again.f_ned_m_s2])
    assert len(rows) == len(got) == events.step.sum() > 900
    assert np.nanmax(np.abs(rows[:, 6:])) > 0.1
    np.testing.assert_array_equal(np.isnan(rows), np.isnan(got))
    np.testing.assert_allclose(got, rows, rtol=0.0, atol=1e-9)  # the same kernels; the compiler may contract differently


def test_the_set_membership_bounds_of_a_record_are_those_in_flight(flown):
    samples, events = flown
    gains = active_flight.gains(active_flight.Params(), airframe.load("x500"))._replace(hover_thrust=HOVER)
    state, rows = active_flight.init(gains), []
    for sample, asked in _at_steps(samples, events):
        state = active_flight.observe(gains, state, sample)
        if asked:
            silent = Applied(sample.t_us, (math.nan,) * 4, math.nan, NAN3, 0.0)
            state, _ = active_flight.step(gains, state, UNKNOWN, NOTHING, silent, sample.t_us)
            rows.append(active_flight.published(state))
    shown = dict(zip(active_flight.PUBLISHED, np.array(rows).T, strict=True))
    again = active_record.run(gains, events)
    for i, axis in enumerate("ned"):
        np.testing.assert_allclose(again.f_ned_m_s2[:, i], shown[f"f_{axis}"], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(again.low_m_s2[:, i], shown[f"f_{axis}_low"], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(again.high_m_s2[:, i], shown[f"f_{axis}_high"], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(again.guaranteed, shown["guarantee"])


def test_steps_are_a_period_apart_and_never_go_back():
    t = np.array([0, 10, 20, 30, 30, 25, 40, 55, 60, 70, 80]) * 1000
    parts = {record.ATTITUDE: (np.arange(11), t, np.tile([1.0, 0, 0, 0, 0, 0, 0], (11, 1)))}
    events = record.events(parts, 20_000)
    assert events.t_us[events.step].tolist() == [0, 20_000, 40_000, 55_000, 80_000]


def test_samples_that_are_not_finite_are_no_events():
    values = np.tile([1.0, 2.0, 3.0, 0.0, 0.0, 0.0], (4, 1))
    values[2, 4] = np.nan
    events = record.events({record.POSITION: (np.arange(4), np.arange(4), values)}, 20_000)
    assert events.t_us.tolist() == [0, 1, 3]
    assert not events.step.any()


@pytest.mark.parametrize("name", sorted(bulk.DECODERS))
def test_columns_are_decoded_and_refused_as_the_live_link_does(name):
    rng = np.random.default_rng(5)
    log = Log(FLIGHT)
    kind = log.dialect.layout(log.dialect.ids[name]).dtype
    streams = log.find(name)
    rows = log.rows(streams[0]).copy() if streams else np.zeros(200, kind)
    if not streams:
        rows["q"] = (1.0, 0.0, 0.0, 0.0)
    floats = [f for f in kind.names or () if kind[f].base.kind == "f"]
    for i, field in zip(rng.choice(len(rows), 20), np.resize(floats, 20) if floats else (), strict=False):
        rows[field][i] = rng.choice([np.nan, np.inf, 3.0])
    taken = {}
    for i, row in enumerate(rows):
        fields = {f: tuple(row[f].tolist()) if kind[f].shape else row[f].item() for f in kind.names[1:-1]}
        try:
            taken[i] = decode.DECODERS[name](wire.spec(name).make(**fields))
        except decode.LinkError:
            continue
    found, good, columns = bulk.DECODERS[name](rows)
    assert np.flatnonzero(good).tolist() == list(taken)
    for i, sample in taken.items():
        assert type(sample) is found
        for mine, theirs in zip(columns, sample, strict=True):
            np.testing.assert_allclose(mine[i], theirs, rtol=0.0, atol=1e-15)
