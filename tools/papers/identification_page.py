"""The page of `mavquad paper identification`: tables of errors beside their bounds, and figures 5-7 of the paper."""

from collections.abc import Sequence

import numpy as np

from mavquad.identify import fit, verify
from tools import bode, page
from tools.papers import hover_records, identification
from tools.papers.common import Row


def page_of(rows: Sequence[Row], seed: int) -> str:
    """The whole page: `rows` as the command found them, figures from one seed."""
    lead = page.text(
        "Hover models recovered from simulated sweeps. Errors are medians over the seeds; the Cramer-Rao bound beside each says"
        " what the record can tell at best, sd_pct also counts what neighbouring frequencies and outputs share. Table 1 is identified as printed: it is not a flyable plant."
    )
    return page.page("mavquad: identification (paper 004)", [*_tables(rows), *_figures(seed)], lead)


def _tables(rows: Sequence[Row]) -> list[tuple[str, list[str]]]:
    sections = []
    middle = [r for r in rows if r["seed"] is None]
    for scenario in dict.fromkeys(r["scenario"] for r in middle):
        pieces = []
        for config in dict.fromkeys(r["config"] for r in middle if r["scenario"] == scenario):
            own = {r["metric"]: r["value"] for r in middle if (r["scenario"], r["config"]) == (scenario, config)}
            pieces.append(page.text(config, "verdict"))
            kinds = ("err_pct", "cr_pct", "sd_pct", "rms_error_over_cr", "rms_error_over_sd")
            names = list(dict.fromkeys(m.partition(":")[2] for m in own if m.startswith("err_pct:")))
            if names:
                shown = [k for k in kinds if f"{k}:{names[0]}" in own]
                pieces.append(page.table(["parameter", *shown], [[n, *(own.get(f"{k}:{n}") for k in shown)] for n in names]))
            rest = [(m, v) for m, v in own.items() if m.partition(":")[0] not in kinds]
            pieces.append(page.table(["figure", "value"], rest))
        sections.append((scenario, pieces))
    return sections


def _figures(seed: int) -> list[tuple[str, list[str]]]:
    dt_s = hover_records.DT_S
    lat = hover_records.case("REF-lat")
    lon = hover_records.case("REF-lon")
    lateral = hover_records.sweeps(lat, seed)[2]  # the sweep on the lateral stick
    t = np.arange(len(lateral.r)) * dt_s
    response = identification.response_of(lon, seed)
    found = fit.fit(lon.structure, response)
    model = lon.structure.build(found.parameters)
    bodes = []
    modelled = fit.sampled_response(model, response.omega_rad_s, dt_s)
    exact = fit.sampled_response(lon.truth, response.omega_rad_s, dt_s)
    for i, output in enumerate(model.outputs):
        bodes += bode.bode(f"{output} from lon", response, (i, 0), [("fitted", modelled[:, i, 0]), ("truth", exact[:, i, 0])])
    record, _ = identification.doublets(lon, seed)
    checked = verify.check(model, record)
    span = np.arange(len(checked.measured)) * dt_s
    figure7 = [
        page.figure(
            f"{output}: fit {checked.fit_pct[i]:.1f} %, TIC {checked.tic[i]:.3f}",
            [page.line("measured", span, checked.measured[:, i]), page.line("predicted", span, checked.predicted[:, i], 1)],
            x="s",
            linked="check",
        )
        for i, output in enumerate(model.outputs)
    ]
    figure5 = page.figure("lateral stick", [page.line("percent of full stick", t, 100.0 * lateral.u[:, 1])], x="s", y="%")
    figure6 = page.figure("lon stick, applied", [page.line("lon", span, record.u[: span.size, 0])], x="s")
    return [
        ("Fig. 5: lateral sweep", [figure5]),
        ("Frequency response, longitudinal", bodes),
        ("Fig. 6: input of the check, not used to fit", [figure6]),
        ("Fig. 7: model over data, 3 s predictions", figure7),
    ]
