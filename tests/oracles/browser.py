"""A page in headless Chromium: whether it draws, zooms together, complains or asks for anything. Debian's package is enough."""

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
WATCH = """<script>window.seen = [];
addEventListener("error", (e) => seen.push("error: " + e.message));
addEventListener("unhandledrejection", (e) => seen.push("rejected: " + e.reason));
document.addEventListener("securitypolicyviolation", (e) => seen.push("asked for " + e.blockedURI));
const say = console.error; console.error = (...words) => { seen.push("console: " + words.join(" ")); say(...words); };
</script>"""
PROBE = """<script>(async () => {
  while (!document.documentElement.dataset.drawn) await new Promise((r) => setTimeout(r, 50));
  const plots = [...document.querySelectorAll(".plot")], linked = plots.filter((p) => p.dataset.linked === "time");
  if (linked.length) await Plotly.relayout(linked[0], {"xaxis.range": [9, 10]});
  await new Promise((r) => setTimeout(r, 1500));
  const space = plots.find((p) => p.layout.scene) || linked[0] || plots[0];
  const image = await Plotly.toImage(space, {format: "png", width: 500, height: 400});
  const out = document.createElement("pre"); out.id = "probe";
  out.textContent = JSON.stringify({seen, plots: plots.length, drawn: plots.filter((p) => p.querySelector(".main-svg")).length,
    ranges: linked.map((p) => p.layout.xaxis.range), image: image.length, canvas: !!space.querySelector("canvas")});
  document.body.append(out);
})();</script>"""


def probe(page: Path, folder: Path) -> dict[str, Any]:
    """What the browser found: complaints `seen`, how many `plots` and how many `drawn`, the `ranges` of those that share the time
    axis after one of them was zoomed to 9..10, the bytes of an `image` of the plot in space (else of the first), `canvas`."""
    text = page.read_text().replace("<title>", WATCH + "<title>", 1).replace("</body>", PROBE + "</body>")
    probed = folder / "probed.html"
    probed.write_text(text)
    options = "--headless --no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader --window-size=1200,900"
    command = [str(BROWSER), *options.split(), "--virtual-time-budget=60000", "--dump-dom", probed.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)
    found = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout)
    assert found is not None
    result: dict[str, Any] = json.loads(found[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    return result
