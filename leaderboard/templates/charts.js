"use strict";
// Charts by Observable Plot (global Plot, on top of d3) from the page's data: lines with bands that answer to pointer and keys.
(() => {
  const data = JSON.parse(document.getElementById("chart-data").textContent);
  const charts = [];
  const hiddenEntries = new Map(); // table -> entries that the filters hide
  const hiddenLines = new Map(); // legend -> lines that are switched off

  const thousands = (value) => value.toLocaleString("en");
  const compact = (value) => (value >= 1e6 ? value / 1e6 + " M" : value >= 1e3 ? value / 1e3 + " k" : String(value));
  const figure = (value) => value.toFixed(3);
  const voxels = (value) => value.toFixed(1);

  // What a holder shows: its lines with the legend's numbers, its axes, and how values are written.
  function described(holder) {
    const kind = holder.dataset.chart;
    if (kind === "training") {
      const lines = data.training.map((line, index) => ({ ...line, index }));
      return {
        lines, legend: "training", height: 340, name: "step", show: voxels, at: thousands,
        x: { label: "training steps", ticks: 7, zero: true, tickFormat: compact },
        y: { label: "touched voxels per episode", nice: true, zero: true },
      };
    }
    const table = data.tables[Number(holder.dataset.table)];
    const legend = String(Number(holder.dataset.table) + 1);
    if (kind === "touch") {
      const lines = table.explorers.map((line, index) => ({ ...line, index })).filter((line) => line.points.length);
      const last = Math.max(data.horizon, ...lines.map((line) => line.points[line.points.length - 1][0]));
      const poses = [];
      for (let step = 0; step <= last; step += data.horizon) poses.push(step);
      return {
        lines, legend, height: 380, name: "step", show: figure, at: thousands,
        x: { label: "control steps; a new pose every " + data.horizon, domain: [0, last], ticks: poses, tickFormat: thousands },
        y: { label: "touched share of the surface", domain: [0, 1] },
      };
    }
    const top = Math.max(0.2, ...table.iou.flatMap((line) => line.points.map((point) => point[3])));
    const lines = table.iou
      .filter((line) => line.reconstructor === holder.dataset.reconstructorOf)
      .map((line) => ({ ...line, index: line.explorer }));
    return {
      lines, legend, height: 250, name: "poses", show: figure, at: String, dots: true,
      x: { label: "poses", type: "log", base: 2, ticks: [1, 2, 4, 8], tickFormat: String, domain: [0.93, 8.6] },
      y: { label: "IoU", domain: [0, Math.ceil(top * 5 - 1e-9) / 5], ticks: 5 },
    };
  }

  function visibleLines(chart) {
    const off = hiddenLines.get(chart.legend) || new Set();
    const gone = hiddenEntries.get(chart.table) || new Set();
    return chart.lines.filter((line) =>
      !off.has(line.index) && !(line.entries && line.entries.every((entry) => gone.has(entry))));
  }

  const said = (chart, row) =>
    row.line.label + "\n" + chart.name + " " + chart.at(row.x) + ": " + chart.show(row.y) +
    (chart.kind === "training" ? "\n10 to 90 %: " : "\n95 %: ") + chart.show(row.low) + " to " + chart.show(row.high);

  function draw(chart) {
    const lines = visibleLines(chart);
    chart.shown = lines;
    const rows = lines.flatMap((line) => line.points.map(([x, y, low, high]) => ({ line, x, y, low, high })));
    const colour = (row) => "var(--c" + row.line.colour + ")";
    const z = (row) => row.line;
    const width = Math.max(240, Math.round(chart.holder.clientWidth));
    const near = { maxRadius: Infinity };
    const line = (dashed) => Plot.lineY(rows.filter((row) => row.line.dashed === dashed), {
      x: "x", y: "y", z, stroke: colour, strokeWidth: 2, strokeDasharray: dashed ? "6 4" : undefined,
    });
    const svg = Plot.plot({
      width, height: chart.height, marginLeft: 46, marginBottom: 42, marginRight: 18, marginTop: 24,
      style: { fontSize: "12px", background: "transparent", overflow: "visible" },
      x: { labelAnchor: "center", labelArrow: "none", ...chart.x, ticks: ticks(chart, width) },
      y: { labelArrow: "none", grid: true, ...chart.y },
      color: { type: "identity" },
      marks: [
        Plot.ruleY([0], { strokeOpacity: 0.4 }),
        Plot.areaY(rows, { x: "x", y1: "low", y2: "high", z, fill: colour, fillOpacity: (row) => (row.line.dashed ? 0.06 : 0.14) }),
        line(false),
        line(true),
        chart.dots ? Plot.dot(rows, { x: "x", y: "y", r: 2.5, fill: colour }) : null,
        Plot.ruleX(rows, Plot.pointer({ x: "x", strokeOpacity: 0.35, py: "y", ...near })),
        Plot.dot(rows, Plot.pointer({ x: "x", y: "y", r: 4.5, fill: colour, stroke: "var(--page)", ...near })),
        Plot.tip(rows, Plot.pointer({
          x: "x", y: "y", title: (row) => said(chart, row), stroke: colour, fill: "var(--page)", lineHeight: 1.3, ...near,
        })),
      ],
    });
    const drawn = svg.tagName.toLowerCase() === "svg" ? svg : svg.querySelector("svg");
    drawn.setAttribute("role", "img");
    drawn.setAttribute("aria-label", chart.title + (lines.length ? ": " + lines.map((one) => one.label).join(", ") : ": nothing chosen"));
    chart.svg = drawn;
    chart.plot = svg;
    chart.place.replaceChildren(svg);
  }

  // On a narrow screen every second pose is labelled.
  function ticks(chart, width) {
    const wanted = chart.x.ticks;
    return Array.isArray(wanted) && wanted.length > 6 && width < 560 ? wanted.filter((_, index) => index % 2 === 0) : wanted;
  }

  // Arrow keys: left and right along a line, up and down between lines; what is reached is marked and said.
  function key(chart, event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step || !chart.shown.length) return;
    event.preventDefault();
    const lines = chart.shown.slice().sort((a, b) => b.points[b.points.length - 1][1] - a.points[a.points.length - 1][1]);
    if (chart.at_line === undefined) { chart.at_line = 0; chart.at_share = 1; }
    chart.at_line = Math.min(Math.max(chart.at_line + step[1], 0), lines.length - 1);
    const points = lines[chart.at_line].points;
    const before = Math.round(chart.at_share * (points.length - 1));
    const stride = Math.max(1, Math.round((points.length - 1) / 32));
    const index = Math.min(Math.max(before + stride * step[0], 0), points.length - 1);
    chart.at_share = points.length > 1 ? index / (points.length - 1) : 0;
    const [x, y, low, high] = points[index];
    const box = chart.svg.getBoundingClientRect();
    const scale = box.width / Number(chart.svg.getAttribute("width"));
    const at = (name, value) => chart.plot.scale(name).apply(value) * scale;
    chart.svg.dispatchEvent(new PointerEvent("pointermove", {
      clientX: box.left + at("x", x), clientY: box.top + at("y", y), pointerType: "mouse", bubbles: true,
    }));
    chart.voice.textContent = said(chart, { line: lines[chart.at_line], x, y, low, high }).replaceAll("\n", ", ");
  }

  for (const holder of document.querySelectorAll("[data-chart]")) {
    const chart = { ...described(holder), holder, kind: holder.dataset.chart, title: holder.dataset.title };
    chart.table = holder.dataset.table === undefined ? -1 : Number(holder.dataset.table);
    chart.place = document.createElement("div");
    chart.voice = document.createElement("p");
    chart.voice.className = "unseen";
    chart.voice.setAttribute("aria-live", "polite");
    holder.append(chart.place, chart.voice);
    holder.tabIndex = 0;
    holder.setAttribute("role", "group");
    holder.setAttribute("aria-label", chart.title + "; arrow keys read it");
    holder.addEventListener("keydown", (event) => key(chart, event));
    charts.push(chart);
    let width = -1;
    new ResizeObserver(() => {
      if (Math.abs(holder.clientWidth - width) < 1) return;
      width = holder.clientWidth;
      draw(chart);
    }).observe(holder);
  }

  for (const legend of document.querySelectorAll("[data-legend]")) {
    const off = new Set();
    hiddenLines.set(legend.dataset.legend, off);
    const buttons = Array.from(legend.querySelectorAll("button"));
    const every = document.createElement("button");
    every.type = "button";
    every.className = "every";
    const update = () => {
      for (const button of buttons) button.setAttribute("aria-pressed", String(!off.has(Number(button.dataset.line))));
      every.textContent = off.size ? "show all" : "hide all";
      for (const chart of charts) if (chart.legend === legend.dataset.legend && chart.shown) draw(chart);
    };
    for (const button of buttons) {
      button.addEventListener("click", () => {
        const line = Number(button.dataset.line);
        if (off.has(line)) off.delete(line); else off.add(line);
        update();
      });
    }
    every.addEventListener("click", () => {
      if (off.size) off.clear(); else for (const button of buttons) off.add(Number(button.dataset.line));
      update();
    });
    const item = document.createElement("li");
    item.append(every);
    legend.append(item);
    update();
  }

  document.addEventListener("entries", (event) => {
    hiddenEntries.set(event.detail.table, event.detail.hidden);
    for (const chart of charts) if (chart.table === event.detail.table && chart.shown) draw(chart);
  });

  for (const select of document.querySelectorAll("[data-heat]")) {
    const number = Number(select.dataset.heat);
    const rows = document.querySelectorAll("#heat-" + (number + 1) + " tbody tr");
    select.addEventListener("change", () => {
      const figures = data.tables[number].heat[Number(select.value)];
      for (const row of rows) {
        const values = figures[Number(row.dataset.entry)];
        row.querySelectorAll("td.cell").forEach((cell, column) => {
          const value = values[column];
          cell.dataset.value = value === null ? "" : String(value);
          cell.textContent = value === null ? "\u2013" : value.toFixed(2);
          cell.style.setProperty("--v", String(value === null ? 0 : value));
        });
      }
    });
    select.form.reset();
  }
})();
