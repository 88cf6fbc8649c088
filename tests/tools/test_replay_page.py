"""`mavquad replay LOG` without options: one page of anyone's flight; observers compared, truth or a smoother as reference, what-ifs."""

import json
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from mavquad.errors import ConfigError
from mavquad.link import recording, tlog
from mavquad.settings import Companion
from tests.oracles import browser
from tests.oracles.logs import dataflash
from tools import __main__ as tools_main
from tools import page as pages
from tools import recorded, smooth, what_if

pytestmark = pytest.mark.xdist_group("flights")
DATA = Path(__file__).resolve().parents[1] / "data"
SWEEP, FLIGHT = DATA / "sweep-roll-20s.tlog", DATA / "flight1-20s.tlog"


def _replay(capsys, *words):
    assert tools_main.main(["replay", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["replay"]


@pytest.fixture(scope="session")
def page(tmp_path_factory):
    """The page of a real autopilot's sweep, made as anybody would: no options."""
    log = tmp_path_factory.mktemp("log") / "your.tlog"
    shutil.copy(SWEEP, log)
    assert tools_main.main(["replay", str(log)]) == 0
    return log.with_name("your.tlog.replay.html")


def test_no_option_makes_one_page_that_asks_for_nothing(page):
    text = page.read_text()
    assert len(text.encode()) <= 8e6
    assert not re.search(r"""(src|href)\s*=\s*["']|@import""", text.replace(pages.get_plotlyjs(), ""))
    figures = [json.loads(s.replace("<\\/", "</")) for s in re.findall(r'<script type="application/json">(.*?)</script>', text)]
    titles = [f["layout"]["title"]["text"] for f in figures]
    for wanted in (
        "Roll",
        "Specific thrust",
        "Disturbance north",
        "Wind towards east",
        "Body rate z",
        "Messages a second",
        "Armed",
    ):
        assert wanted in " ".join(titles)
    names = {t["name"] for f in figures for t in f["data"]}
    assert {"gsmo", "joint", "leso", "eskf", "asmf", "bounds, asmf", "3 sigma, eskf", "controller=iadrc"} <= names
    assert "was commanded (ATTITUDE_TARGET)" in names
    assert all(f["data"] for f in figures)
    assert "Nobody said which vehicle this is" in text
    assert "mavquad replay " in text


@pytest.mark.skipif(browser.BROWSER is None, reason="no chromium on this machine; Debian's package is enough")
@pytest.mark.slow
def test_a_browser_draws_the_replay_zooms_it_together_and_finds_no_error(page, tmp_path):
    result = browser.probe(page, tmp_path)
    assert result["seen"] == []
    assert result["drawn"] == result["plots"] > 10
    assert result["ranges"] == [[9, 10]] * len(result["ranges"])
    assert result["image"] > 10_000


def test_parameter_sets_are_compared_against_a_smoother_that_is_named_as_one(capsys):
    words = ("--observer", "joint", "--observer", "joint:lead_s=0.3", "--observer", "eskf", "--compare")
    r = _replay(capsys, SWEEP, *words)
    assert "Rauch-Tung-Striebel" in r["reference"]
    assert "not truth" in r["reference"]
    off = {c["observer"]: c["disturbance_rms_m_s2"] for c in r["compared"]}
    assert list(off) == ["joint", "joint:lead_s=0.3", "eskf"]
    assert (
        0.0 < 1.2 * np.linalg.norm(off["joint"]) < np.linalg.norm(off["joint:lead_s=0.3"])
    )  # leading by 0.3 s amplifies noise
    assert all(c["steps"] > 900 for c in r["compared"])


def test_a_flight_of_ours_is_compared_with_the_truth_and_its_own_commands_are_shown(flown, capsys, tmp_path):
    run, _ = flown
    r = _replay(capsys, run / "flight.tlog", "--compare", "--out", tmp_path / "page.html")
    assert "truth" in r["reference"]
    assert r["vehicle_source"] == "plan.toml"
    for c in r["compared"]:
        assert max(c["velocity_rms_m_s"]) < 0.2
    assert r["compared"][-1]["observer"] == "asmf"
    assert r["compared"][-1]["inside_bounds_pct"] > 99.0
    assert [d["what_if"] for d in r["what_if"]] == ["sent by this companion (flight.trace)"]
    flight = recorded.flown(recording.open_recording(run / "flight.tlog"), None, None)
    own = what_if.sent(flight, run / "flight.trace")
    before_landing = own.t_us[int(0.75 * own.t_us.size)]
    acted = flight.command.attitude_rad[(flight.command.t_us > own.t_us[50]) & (flight.command.t_us < before_landing)]
    nearest = np.abs(acted[:, None, 0] - own.attitude_rad[None, :, 0]).min(axis=1)
    assert len(acted) > 100
    assert np.mean(np.degrees(nearest) < 1e-5) > 0.95  # a roll the autopilot acted on is one that was sent


def test_another_controller_would_have_commanded_much_the_same_path(capsys):
    r = _replay(capsys, SWEEP, "--what-if", "controller=iadrc", "--what-if", "controller=pid,compensator=asmf,pid.integral=0")
    assert [d["what_if"] for d in r["what_if"]] == ["controller=iadrc", "controller=pid,compensator=asmf,pid.integral=0"]
    for d in r["what_if"]:
        assert "as it was flown" in d["wanted"]
        assert d["steps"] > 900
        assert 0.0 < d["thrust_rms_m_s2"] < 0.5
        assert 0.1 < d["roll_rms_deg"] < 5.0  # the sweep itself is faster than the smoothed path


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--observer", "gsmoo"], "no observer is called 'gsmoo'; known: gsmo, joint"),
        (["--observer", "joint:leed_s=1"], 'did you mean "lead_s"'),
        (["--what-if", "controller=sweep"], "expected one of pd, pid"),
        (["--what-if", "control=pid"], "expected one of controller, compensator, estimator"),
        (["--airframe", "no-such"], "no-such"),
        (["--system", "7"], "attitude comes from 1/1"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words, says, capsys):
    assert tools_main.main(["replay", str(SWEEP), "--json", *words]) == 1
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


def test_what_if_changes_only_what_it_names():
    base = Companion(controller="eskf-mpc", estimator="eskf", tune={"pid": {"damping": 1.2}})
    changed = what_if.settings("controller=pid,pid.integral=0.2", base)
    assert (changed.controller, changed.estimator) == ("pid", "auto")
    assert changed.tune["pid"] == {"damping": 1.2, "integral": 0.2}
    assert changed.safety == base.safety
    with pytest.raises(ConfigError, match="expected one of"):
        what_if.settings("compensator", base)


# ---- logs that are not as they should be -----------------------------------------------------------------------------------
def _records(path):
    with path.open("rb") as stream:
        return [(t_us, frame.raw) for t_us, frame in tlog.read(stream)]


def _write(path, records):
    path.write_bytes(b"".join(struct.pack(">Q", t_us) + raw for t_us, raw in records))
    return path


def test_a_boot_clock_that_restarts_leaves_the_longest_run(tmp_path, capsys):
    records = _records(SWEEP)
    span_us = records[-1][0] - records[0][0] + 1000
    start = records[0][0]
    again = [(t_us + span_us, raw) for t_us, raw in records if t_us < start + 8_000_000]  # the same boot stamps once more
    r = _replay(capsys, _write(tmp_path / "twice.tlog", [*records, *again]))
    assert any("restarts 1 times: its longest run, 20" in note for note in r["notes"])
    whole = _replay(capsys, SWEEP)
    assert [o["steps"] for o in r["observers"]] == pytest.approx([o["steps"] for o in whole["observers"]], abs=5)


def test_stamps_that_go_back_within_a_log_change_little(tmp_path, capsys):
    records, rng = _records(SWEEP), np.random.default_rng(3)
    mixed = [records[i] for i in np.argsort(np.arange(len(records)) + rng.uniform(0.0, 6.0, len(records)))]
    r, whole = _replay(capsys, _write(tmp_path / "mixed.tlog", mixed)), _replay(capsys, SWEEP)
    for a, b in zip(r["observers"], whole["observers"], strict=True):
        np.testing.assert_allclose(a["disturbance_mean_m_s2"], b["disturbance_mean_m_s2"], atol=0.05)


def test_of_two_vehicles_one_has_to_be_chosen(tmp_path, capsys):
    from mavquad import wire

    other = []
    for t_us, raw in _records(SWEEP):
        frame = wire.split(raw)[0][0]
        if frame.msgid in wire.ID_SET and frame.component == 1:
            m = wire.decode(frame)
            other.append((t_us + 500, wire.encode(type(m).__name__, tuple(m), seq=frame.seq, system=2, component=1)))
    both = sorted([*_records(SWEEP), *other], key=lambda record: record[0])
    path = _write(tmp_path / "both.tlog", both)
    assert tools_main.main(["replay", str(path), "--json"]) == 1
    said = capsys.readouterr().err
    assert "attitude comes from 1/1, 2/1; expected one vehicle: choose it with --system" in said
    one, two = _replay(capsys, path, "--system", "1"), _replay(capsys, path, "--system", "2")
    assert one["observers"][0]["disturbance_mean_m_s2"] == pytest.approx(two["observers"][0]["disturbance_mean_m_s2"])


def test_a_log_without_position_still_gives_its_rates(tmp_path, capsys):
    bare = tmp_path / "bare.bin"
    rows = [(10_000 * i, 0, 100 * (i % 7), 0, 0, 0, 9000) for i in range(400)]
    bare.write_bytes(dataflash({"ATT": ("QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw", rows)}))
    page = tmp_path / "bare.html"
    r = _replay(capsys, bare, "--out", page)
    assert r["observers"] == []
    assert "No position in this log" in page.read_text()
    assert tools_main.main(["replay", str(bare), "--json", "--compare"]) == 1
    assert "no position in it" in capsys.readouterr().err


@pytest.mark.parametrize("size", [0, 7, 20, 55, 400, 1500, 2999, 8000, 30_000])
def test_a_log_cut_anywhere_is_replayed_or_refused_in_one_line(size, tmp_path, capsys):
    path = tmp_path / "cut.tlog"
    path.write_bytes(SWEEP.read_bytes()[:size])
    done = tools_main.main(["replay", str(path), "--json"])
    out, said = capsys.readouterr()
    assert said.count("\n") <= 1
    if done == 0:
        assert json.loads(out)["replay"]
    else:
        assert "cut.tlog" in said


# ---- the smoother -------------------------------------------------------------------------------------------------------------
def test_the_smoother_finds_a_disturbance_through_noise_without_lag():
    rng, dt_s = np.random.default_rng(11), np.full(1499, 0.02)
    t = 0.02 * np.arange(1500)
    f = np.column_stack([np.sin(t), 0.5 * np.cos(0.7 * t), 0.0 * t])
    v = np.cumsum(f * 0.02, axis=0)
    p = np.cumsum(v * 0.02, axis=0)
    found = smooth._smoothed(dt_s, p + rng.normal(0.0, smooth.SIGMA_M, p.shape), v + rng.normal(0.0, smooth.SIGMA_M_S, v.shape))
    inner = slice(100, -100)
    lag = np.sum((found[2, inner, 0] - f[inner, 0]) * np.cos(t[inner])) / np.sum(np.cos(t[inner]) ** 2)
    assert abs(lag) < 0.02  # s: a filter of this bandwidth would lag by 0.2 s
    assert np.sqrt(np.mean((found[2] - f)[inner] ** 2)) < 0.2
    assert np.sqrt(np.mean((found[1] - v)[inner] ** 2)) < 0.5 * smooth.SIGMA_M_S


def test_wind_is_what_the_drag_says():
    from mavquad import airframe

    x500 = airframe.load("x500")
    v, wind = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[5.0, -3.0], [0.0, 4.0]])
    through = v[:, :2] - wind
    speed = np.linalg.norm(through, axis=1)[:, None]
    drag = x500.drag.linear_n_s_m[0] + x500.drag.quadratic_n_s2_m2[0] * speed
    f = np.column_stack([-drag * through / x500.body.mass_kg, np.zeros(2)])
    np.testing.assert_allclose(recorded.wind(x500, v, f), wind, atol=1e-12)
