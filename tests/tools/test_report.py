"""The page of a flight: what it says, its size, and (with a browser) that it draws, zooms together and asks nothing of the network."""

import json
import re

import numpy as np
import pytest

from mavquad.errors import LogError
from tests.oracles import browser
from tools import __main__ as tools_main
from tools import page as pages
from tools import report

pytestmark = pytest.mark.xdist_group("flights")


@pytest.fixture(scope="session")
def page(flown, tmp_path_factory):
    """The page of a short flight."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    assert tools_main.main(["report", str(flown[0]), "--out", str(path)]) == 0
    return path


def test_the_first_screen_says_how_it_went_how_we_know_and_compared_with_what(flown, page):
    _, summary = flown
    text = page.read_text()
    lead = text[: text.index("<section>")]
    assert "The flight went well." in lead
    assert f"{summary['rmse_m']['position']:.3f} m" in lead
    assert "How we know:" in lead
    assert "compared with" in lead
    assert summary["command"] in text.replace("&#x27;", "'")
    assert "--verify" in text


def test_the_page_is_one_small_file_with_every_figure_filled(page):
    text = page.read_text()
    assert len(text.encode()) <= 8e6
    assert not re.search(r"""(src|href)\s*=\s*["']|@import""", text.replace(pages.get_plotlyjs(), ""))
    figures = [json.loads(s.replace("<\\/", "</")) for s in re.findall(r'<script type="application/json">(.*?)</script>', text)]
    titles = [f["layout"]["title"]["text"] for f in figures]
    for wanted in ("space", "True position less wanted", "Roll", "Body rate x", "Disturbance north", "States", "arrival"):
        assert any(wanted in title for title in titles)
    assert all(f["data"] for f in figures)


def test_a_failed_flight_says_what_failed(flown, tmp_path):
    run, summary = flown
    for path in run.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / "summary.json").unlink()
    (tmp_path / "summary.json").write_text(json.dumps({**summary, "ok": False, "failures": ["lost <its> way"]}))
    text = report.flight(tmp_path, tmp_path / "out.html").read_text()
    assert "did not go as it should: lost &lt;its&gt; way." in text


def test_a_folder_without_a_flight_is_refused(tmp_path):
    with pytest.raises(LogError, match="expected the run folder of a flight"):
        report.flight(tmp_path)


def test_spans_are_found_and_merged_until_they_can_be_drawn():
    t = 0.01 * np.arange(1000)
    on = np.zeros(1000, bool)
    on[100:200] = on[500:501] = True
    assert report._spans(t, on) == [(pytest.approx(1.0), pytest.approx(2.0)), (pytest.approx(5.0), pytest.approx(5.01))]
    on[::2] = True
    assert len(report._spans(t, on, most=10)) <= 10


@pytest.mark.skipif(browser.BROWSER is None, reason="no chromium on this machine; Debian's package is enough")
@pytest.mark.slow
def test_a_browser_draws_it_all_zooms_together_and_finds_no_error(page, tmp_path):
    result = browser.probe(page, tmp_path)
    assert result["seen"] == []
    assert result["drawn"] == result["plots"] > 10
    assert result["ranges"] == [[9, 10]] * len(result["ranges"])
    assert result["canvas"]
    assert result["image"] > 10_000  # a picture of the path in space, not a blank one
