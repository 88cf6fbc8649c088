// Draws every figure of the page, in the colours of the page, and zooms those that share a time axis together.
"use strict";
(function () {
  const plots = [...document.querySelectorAll(".plot")];
  const specs = new Map(plots.map((node) => [node, JSON.parse(node.querySelector("script").textContent)]));
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const resolve = (value) => {
    if (typeof value === "string") return value.replace(/var\((--\w+)\)/g, (_, name) => colour(name));
    if (Array.isArray(value)) return value.map(resolve);
    if (value && typeof value === "object" && !ArrayBuffer.isView(value)) return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, k === "bdata" ? v : resolve(v)]));
    return value;
  };
  const themed = (spec) => {
    const axis = { gridcolor: colour("--line"), zerolinecolor: colour("--line"), linecolor: colour("--line") };
    const layout = resolve(spec.layout);
    layout.paper_bgcolor = "rgba(0,0,0,0)";
    layout.plot_bgcolor = colour("--plot");
    layout.font = { color: colour("--text"), family: "system-ui, sans-serif", size: 12 };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: colour("--c5"), activecolor: colour("--c0") };
    layout.colorway = [0, 1, 2, 3, 4, 5, 6].map((i) => colour("--c" + i));
    for (const key of Object.keys(layout)) if (/^[xy]axis/.test(key)) layout[key] = { ...axis, ...layout[key] };
    if (layout.scene) for (const key of ["xaxis", "yaxis", "zaxis"]) layout.scene[key] = { ...axis, backgroundcolor: colour("--plot"), ...layout.scene[key] };
    return [resolve(spec.data), layout];
  };
  const config = { responsive: true, displaylogo: false, showSendToCloud: false };
  let linking = false;
  function link(node) {
    node.on("plotly_relayout", (change) => {
      if (linking || !node.dataset.linked) return;
      const [from, to] = change["xaxis.range"] || [change["xaxis.range[0]"], change["xaxis.range[1]"]];
      const update = from !== undefined ? { "xaxis.range": [from, to] } : change["xaxis.autorange"] ? { "xaxis.autorange": true } : null;
      if (!update) return;
      linking = true;
      const others = plots.filter((other) => other !== node && other.dataset.linked === node.dataset.linked);
      Promise.all(others.map((other) => Plotly.relayout(other, update))).finally(() => { linking = false; });
    });
  }
  async function draw() {
    for (const node of plots) {
      node.textContent = "";
      await Plotly.newPlot(node, ...themed(specs.get(node)), config);
      link(node);
    }
    document.documentElement.dataset.drawn = String(plots.length);
  }
  const recolour = () => plots.forEach((node) => {
    const [data, layout] = themed(specs.get(node));
    for (const key of Object.keys(layout)) if (/^[xy]axis/.test(key) && node.layout && node.layout[key] && node.layout[key].range) layout[key].range = [...node.layout[key].range];
    Plotly.react(node, data, layout, config);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  addEventListener("beforeprint", () => { document.documentElement.classList.add("print"); recolour(); });
  addEventListener("afterprint", () => { document.documentElement.classList.remove("print"); recolour(); });
  draw();
})();
