"""The wire in vehicle time: delay, jitter, loss, duplication, reordering, corruption, silence; datagrams; parameters."""

import struct

import numpy as np
import pytest

from mavquad.errors import ConfigError
from sitl import config, links
from sitl.params import INT32, REAL32, Table


def passed(count=4000, period_us=1000, **faults):
    """(arrival us, number) of `count` numbered frames sent each period."""
    queue = links.Queue(config.Link(**faults), np.random.default_rng(3))
    out = []
    for k in range(count + 100):
        t_us = k * period_us
        if k < count:
            queue.put(t_us, k)
        out += [(t_us, raw) for raw in queue.take(t_us, lambda k: k.to_bytes(4, "big"))]
    return [(t_us, int.from_bytes(raw, "big")) for t_us, raw in out], queue


def test_delay_alone_keeps_order_and_time():
    out, queue = passed(delay_ms=5.0)
    assert out == [(1000 * (k + 5), k) for k in range(4000)]
    assert queue.due_us == links.NEVER


def test_jitter_never_overtakes():
    out, _ = passed(delay_ms=5.0, jitter_ms=10.0)
    late = np.array([t - 1000 * k for t, k in out]) / 1000.0
    assert [k for _, k in out] == list(range(4000))
    assert late.min() >= 5.0
    assert late.max() <= 16.0  # arrivals are looked for each millisecond
    assert late.std() > 0.5


@pytest.mark.parametrize("share", [0.01, 0.2])
def test_loss_and_duplication_have_their_shares(share):
    out, queue = passed(loss=share)
    assert len(out) == 4000 - queue.counts["lost"]
    assert queue.counts["lost"] == pytest.approx(4000 * share, abs=4.0 * np.sqrt(4000 * share))
    out, queue = passed(duplicate=share)
    assert len(out) == 4000 + queue.counts["duplicated"]
    assert queue.counts["duplicated"] == pytest.approx(4000 * share, abs=4.0 * np.sqrt(4000 * share))


def test_a_reordered_frame_is_overtaken_and_still_arrives():
    out, queue = passed(reorder=0.05, reorder_ms=20.0)
    numbers = [k for _, k in out]
    assert sorted(numbers) == list(range(4000))
    held = [k for t, k in out if t - 1000 * k >= 25_000]
    assert len(held) == queue.counts["reordered"] > 100
    assert numbers != sorted(numbers)


def test_corruption_changes_one_byte():
    queue = links.Queue(config.Link(corrupt=0.5, delay_ms=0.0), np.random.default_rng(1))
    raw = bytes(range(40))
    changed = 0
    for k in range(400):
        queue.put(k, raw)
        (got,) = queue.take(k, lambda item: item)
        difference = sum(a != b for a, b in zip(got, raw, strict=True))
        assert difference in (0, 1)
        changed += difference
    assert changed == queue.counts["corrupted"]
    assert 150 < changed < 250


def test_silence_lets_nothing_pass():
    out, queue = passed(delay_ms=0.0, silences=[(1.0, 2.0)])
    assert [k for _, k in out] == [*range(1000), *range(2000, 4000)]
    assert queue.counts["lost"] == 1000


def test_the_same_seed_spoils_the_same_frames():
    assert passed(loss=0.1, jitter_ms=3.0)[0] == passed(loss=0.1, jitter_ms=3.0)[0]


def test_datagrams_are_full_but_never_above_1400_bytes():
    frames = [bytes([k]) * 100 for k in range(30)]
    packed = links.datagrams(frames)
    assert b"".join(packed) == b"".join(frames)
    assert [len(data) for data in packed] == [1400, 1400, 200]
    assert links.datagrams([]) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("link.loss=1.5", r"link.loss = 1.5: expected 0 to 1"),
        ("link.losses=0.5", r'unknown key "losses" in \[link\]; did you mean "loss"\?'),
        ("wind.rotor_model=X", r"wind.rotor_model = 'X'; known: G, P, none"),
        ('faults=[{kind="moto", t_s=1.0}]', r"faults\[0\].kind = 'moto'; did you mean \"motor\"\?"),
        ("noise.mocap_rate_hz=333", r"noise.mocap_rate_hz = 333: expected 1, 2, 5"),
        ("control_period_ms=7", r"control_period_ms = 7: expected 1 to 100 ms, a multiple of the loop's 2 ms"),
        ("start.p_ned_m=[0, 0, 1]", r"not below the ground"),
        ("seed=-1", r"seed = -1: expected 0 to 4294967295"),
        ("loop_hz=400", r"loop_hz = 400"),
        ('faults=[{kind="nan", t_s=1.0}]', r'kind = "nan" needs sensor'),
        ("link.silences=[[3.0, 1.0]]", r"expected 0 <= from < to"),
    ],
)
def test_a_bad_value_is_named_with_what_is_allowed(change, said):
    with pytest.raises(ConfigError, match=said):
        config.load(None, [change])


def test_a_bad_file_is_named(tmp_path):
    path = tmp_path / "sitl.toml"
    path.write_text("[wind]\nmean = 5.0\n")
    with pytest.raises(ConfigError, match=r'sitl.toml: unknown key "mean" in \[wind\]; did you mean "mean_m_s"'):
        config.load(path, [])


def test_a_file_changes_only_what_it_names(tmp_path):
    path = tmp_path / "sitl.toml"
    path.write_text("seed = 5\n[wind]\nmean_m_s = 5.0\n[link]\nloss = 0.1\n[params]\nMPC_XY_P = 1.5\n")
    got = config.load(path, ["wind.from_deg=90", "seed=6"])
    assert (got.seed, got.wind.mean_m_s, got.wind.from_deg, got.link.loss, got.link.delay_ms) == (6, 5.0, 90.0, 0.1, 5.0)
    assert got.params == {"MPC_XY_P": 1.5}


def table(bytewise):
    return Table({"GAIN": 0.5, "COUNT": 7}, {}, bytewise)


def test_px4_puts_the_bytes_of_an_integer_into_the_float():
    t = table(bytewise=True)
    name, value, kind, count, index = t.fields("COUNT")
    assert (name, kind, count, index) == ("COUNT", INT32, 2, 1)
    assert struct.unpack("<i", struct.pack("<f", value))[0] == 7
    assert t.put_wire("COUNT", struct.unpack("<f", struct.pack("<i", -12))[0], INT32)
    assert t["COUNT"] == -12


def test_ardupilot_sends_the_number_itself():
    t = table(bytewise=False)
    assert t.fields("COUNT")[1:3] == (7.0, INT32)
    assert t.put_wire("COUNT", 9.0, REAL32)
    assert t["COUNT"] == 9
    assert not t.put_wire("GAIN", float("nan"), REAL32)
    assert t["GAIN"] == 0.5


def test_a_parameter_that_is_not_there_is_a_mistake_in_the_file():
    with pytest.raises(ConfigError, match='this autopilot has no "GAIM"; did you mean "GAIN"?'):
        Table({"GAIN": 0.5}, {"GAIM": 1.0}, True)
