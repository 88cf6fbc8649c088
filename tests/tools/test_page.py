"""Pages: self-contained, escaped, small; thinned lines keep their extremes."""

import base64
import json
import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tools import page as pages


def _specs(html: str) -> list[dict]:
    return [json.loads(s.replace("<\\/", "</")) for s in re.findall(r'<script type="application/json">(.*?)</script>', html)]


def test_a_page_is_one_file_that_may_ask_nothing_of_the_network_and_escapes_what_it_is_given():
    t = np.linspace(0.0, 60.0, 60_000)
    flat = pages.figure("rates", [pages.line("<b>x", t, np.sin(t)), *pages.band("b", t, t - 1, t + 1)], x="s", linked="time")
    space = pages.path3d("path", [("p", np.column_stack([t, t, t]), 0)], (np.zeros((2, 3)), np.ones((2, 3))))
    html = pages.page("a <title>", [("one & two", [flat, space, pages.table(["n", "v"], [["<i>", 1.0], ["b", float("nan")]])])])
    assert "a &lt;title&gt;" in html
    assert "one &amp; two" in html
    assert "&lt;i&gt;" in html
    assert "default-src 'none'" in html
    outside_library = html.replace(pages.get_plotlyjs(), "")
    assert not re.search(r"""(src|href)\s*=|url\(|@import|https?://""", outside_library)
    assert len(html) < 8e6
    assert [len(s["data"]) for s in _specs(outside_library)] == [3, 2]


def test_numbers_travel_as_float32_with_their_values():
    html = pages.figure("f", [pages.line("y", [0.0, 1.0, 2.0], [0.1, 0.2, 0.3])])
    y = _specs(html)[0]["data"][0]["y"]
    assert y["dtype"] == "f4"
    np.testing.assert_array_equal(np.frombuffer(base64.b64decode(y["bdata"]), "<f4"), np.float32([0.1, 0.2, 0.3]))


@given(hnp.arrays(float, st.integers(1, 500), elements=st.floats(-1e6, 1e6)), st.integers(10, 100))
def test_thinning_keeps_order_ends_and_extremes(y, points):
    x = np.arange(len(y), dtype=float)
    xs, ys = pages.thin(x, y, points)
    assert len(xs) <= points + 2
    assert np.all(np.diff(xs) > 0)
    assert (ys.min(), ys.max()) == (y.min(), y.max())
    np.testing.assert_array_equal(ys, y[xs.astype(int)])
    assert (xs[0], xs[-1]) == (0.0, len(y) - 1.0)


def test_a_histogram_carries_its_bins_and_counts_everything():
    values = np.random.default_rng(3).normal(size=1000)
    bar = pages.histogram("h", values)
    assert sum(bar.y) == 1000
    assert len(bar.x) == 60
