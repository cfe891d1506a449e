/* Draws the figures of a page with uPlot: one time axis and one cursor for all that are not alone, all edges aligned. */
(function () {
  "use strict";
  const content = JSON.parse(document.getElementById("figures").textContent);
  const SHADES = { held: "#8888882e", fault: "#d55e002e", failsafe: "#cc79a74d", limit: "#b8a900" };
  const MARKS = { operator: "#0072b2", lost: "#000000", paper: "#d04030" };
  const AXIS_PX = 84, INCH_PX = 88, TICKS_PX = 17, STRIP_PX = 4, RIGHT_PX = 10, TEXT = "11px system-ui, sans-serif";
  const PRINTED_PX = 690; // what fits beside the margins of a page of A4
  const charts = [];
  let moving = false;

  function numbers(text) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer), (value) => (Number.isFinite(value) ? value : null));
  }

  function dataOf(panel) {
    const tables = panel.tables.map((table) => table.map(numbers));
    if (!tables.length) return [[]];
    // 2: a gap of one line is a gap also where another line has instants of its own
    const gaps = tables.map((table) => table.map(() => 2));
    const data = tables.length === 1 ? tables[0] : uPlot.join(tables, gaps);
    if (!panel.stacked) return data;
    const sums = [data[0]];
    let sum = data[0].map(() => 0);
    for (const share of data.slice(1)) {
      sum = sum.map((so_far, row) => so_far + (share[row] ?? 0));
      sums.push(sum);
    }
    // the highest sum first: each lower one covers its part of it
    return [sums[0], ...sums.slice(1).reverse()];
  }

  function shade(u, marks) {
    const { ctx, bbox } = u;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (const interval of marks.intervals) {
      const begin = u.valToPos(interval.begin_s, "x", true), end = u.valToPos(interval.end_s, "x", true);
      const high = interval.kind === "limit" ? STRIP_PX * devicePixelRatio : bbox.height;
      ctx.fillStyle = SHADES[interval.kind];
      ctx.fillRect(begin, bbox.top + bbox.height - high, Math.max(end - begin, 1), high);
    }
    ctx.restore();
  }

  function mark(u, marks, panel, first) {
    const { ctx, bbox } = u, scale = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    const line = (x0, y0, x1, y1, colour, dash) => {
      ctx.strokeStyle = colour;
      ctx.lineWidth = scale;
      ctx.setLineDash(dash.map((length) => length * scale));
      ctx.beginPath();
      ctx.moveTo(x0, y0);
      ctx.lineTo(x1, y1);
      ctx.stroke();
    };
    for (const limit of panel.limits) {
      const y = u.valToPos(limit, "y", true);
      line(bbox.left, y, bbox.left + bbox.width, y, "#000000", [5, 4]);
    }
    for (const instant of marks.instants) {
      const x = u.valToPos(instant.t_s, "x", true);
      line(x, bbox.top, x, bbox.top + bbox.height, MARKS[instant.kind], instant.kind === "operator" ? [2, 3] : []);
    }
    const lanes = [...new Set(panel.bars.map((bar) => bar.lane))];
    for (const bar of panel.bars) {
      const begin = u.valToPos(bar.begin_s, "x", true), end = u.valToPos(bar.end_s, "x", true);
      const lane = lanes.indexOf(bar.lane), top = u.valToPos(lane + 0.9, "y", true);
      ctx.fillStyle = bar.colour;
      ctx.fillRect(begin, top, end - begin, u.valToPos(lane + 0.1, "y", true) - top);
      write(bar.name, Math.max(begin, bbox.left) + 4 * scale, top + 12 * scale, end - 4 * scale, "#000000");
    }
    if (first && panel.series.length) name(u);
    ctx.restore();

    function write(text, x, y, room_to, colour) {
      ctx.font = TEXT.replace(/^\d+/, (px) => px * scale);
      ctx.fillStyle = colour;
      if (x + ctx.measureText(text).width <= room_to) ctx.fillText(text, x, y);
    }

    function name(u) {
      const rows = []; // where the last text of each row ends
      const texts = marks.intervals.filter((interval) => interval.kind === "fault")
        .map((interval) => [interval.begin_s, interval.text, "#a04000"])
        .concat(marks.instants.map((instant) => [instant.t_s, instant.text, MARKS[instant.kind]]))
        .sort((a, b) => a[0] - b[0]);
      ctx.font = TEXT.replace(/^\d+/, (px) => px * scale);
      ctx.setLineDash([]);
      ctx.strokeStyle = "#ffffffc0"; // a rim, for what lies behind may have any colour
      ctx.lineWidth = 3 * scale;
      ctx.lineJoin = "round";
      for (const [t_s, text, colour] of texts) {
        const at = u.valToPos(t_s, "x", true), width = ctx.measureText(text).width;
        if (at < bbox.left - 1 || at > bbox.left + bbox.width) continue;
        const x = Math.max(bbox.left + 2 * scale, Math.min(at + 3 * scale, bbox.left + bbox.width - width - 2 * scale));
        let row = rows.findIndex((end) => end < x);
        if (row < 0) row = rows.length;
        rows[row] = x + width + 6 * scale;
        const y = bbox.top + (12 + 13 * row) * scale;
        ctx.strokeText(text, x, y);
        ctx.fillStyle = colour;
        ctx.fillText(text, x, y);
      }
    }
  }

  function readable(value) {
    return value == null ? "" : Math.abs(value) >= 1000 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
  }

  function optionsOf(figure, panel, data, first, last, key, whole) {
    const lines = panel.stacked ? [...panel.series].reverse() : panel.series;
    const lanes = [...new Set(panel.bars.map((bar) => bar.lane))];
    const marks = content.marks[figure.marks];
    return {
      width: 300,
      height: Math.round(panel.height * INCH_PX) + (last ? 52 : 0),
      padding: [8, RIGHT_PX, last ? 0 : 8, 0],
      cursor: {
        y: false,
        drag: { x: true, y: false },
        sync: { key, setSeries: false },
        bind: { dblclick: (u) => () => { move(u, ...whole); return null; } },
      },
      legend: {
        show: lines.length > 0, live: true,
        markers: { dash: (u, index) => (lines[index - 1]?.dashed ? "dashed" : "solid") },
      },
      scales: {
        x: { time: false, range: (u, low, high) => (low == null || low === high ? whole : [low, high]) },
        y: {
          range: (u, low, high) => {
            if (lanes.length) return [0, lanes.length];
            const [least, most] = uPlot.rangeNum(Math.min(low ?? -1, ...panel.limits), Math.max(high ?? 1, ...panel.limits), 0.08, true);
            return [panel.least ?? least, panel.most ?? most];
          },
        },
      },
      axes: [
        { show: true, size: last ? 32 : 0, values: last ? undefined : () => [], label: last ? "time from the release [s]" : undefined, labelSize: 20, labelFont: TEXT, font: TEXT,
          ticks: { show: last }, grid: { stroke: "#00000018" } },
        { size: AXIS_PX, space: TICKS_PX, font: TEXT, grid: { show: !lanes.length, stroke: "#00000018" },
          splits: lanes.length ? () => lanes.map((_, lane) => lane + 0.5) : undefined,
          values: lanes.length ? () => lanes : undefined },
      ],
      series: [
        { label: "s", class: "time", value: (u, value) => (value == null ? "" : value.toFixed(2)) },
        ...lines.map((line, index) => ({
          label: line.name || " ",
          class: line.name ? "named" : "unnamed",
          stroke: line.colour,
          fill: panel.stacked ? line.colour : undefined,
          width: line.width * 1.3,
          dash: line.dashed ? [6, 4] : undefined,
          points: { show: false },
          value: (u, value, _, row) =>
            readable(panel.stacked && value != null ? value - (u.data[index + 2]?.[row] ?? 0) : value),
        })),
      ],
      hooks: {
        drawAxes: [(u) => shade(u, marks)],
        draw: [(u) => mark(u, marks, panel, first)],
        setScale: [(u, scale) => { if (scale === "x") move(u, u.scales.x.min, u.scales.x.max); }],
      },
    };
  }

  function move(u, begin_s, end_s) {
    if (moving) return;
    moving = true;
    const me = charts.find((chart) => chart.u === u);
    for (const chart of charts) {
      const { min, max } = chart.u.scales.x;
      if (me && chart.key === me.key && (min !== begin_s || max !== end_s)) {
        chart.u.setScale("x", { min: begin_s, max: end_s });
      }
    }
    moving = false;
  }

  function build() {
    const prepared = content.figures.map((figure) => figure.panels.map((panel) => [panel, dataOf(panel)]));
    const ends = (panels) => panels.flatMap(([panel, data]) => [
      data[0][0], data[0][data[0].length - 1], ...panel.bars.flatMap((bar) => [bar.begin_s, bar.end_s]),
    ]).filter((time) => time != null);
    const spanOf = (times) => (times.length ? [Math.min(...times), Math.max(...times)] : [0, 1]);
    const shared = spanOf(prepared.filter((_, index) => !content.figures[index].alone).flatMap(ends));
    prepared.forEach((panels, index) => {
      const figure = content.figures[index], place = document.getElementById(figure.place);
      const whole = figure.window ?? (figure.alone ? spanOf(ends(panels)) : shared);
      const key = figure.alone ? figure.place : "flight";
      panels.forEach(([panel, data], at) => {
        const label = document.createElement(panel.series.length ? "tr" : "div");
        label.className = "axis";
        label.textContent = panel.label;
        const last = at === panels.length - 1;
        if (panel.bars.length && data[0].length === 0) data = [whole];
        moving = true; // until all are built, none moves another
        const u = new uPlot(optionsOf(figure, panel, data, at === 0, last, key, whole), data, place);
        if (panel.series.length) u.root.querySelector(".u-legend").prepend(label);
        else u.root.before(label);
        charts.push({ u, key, place });
        u.setScale("x", { min: whole[0], max: whole[1] });
        moving = false;
      });
    });
    const zoom = (event) => {
      const link = event.target.closest("a[data-begin]");
      const chart = charts.find((one) => one.key === "flight");
      if (link && chart) move(chart.u, Number(link.dataset.begin), Number(link.dataset.end));
    };
    document.addEventListener("click", zoom);
  }

  function fit(width) {
    for (const { u, place } of charts) {
      if (place.clientWidth) u.setSize({ width: width ?? place.clientWidth, height: u.height });
    }
  }

  build();
  fit();
  addEventListener("resize", () => fit());
  document.addEventListener("toggle", () => fit(), true);
  addEventListener("beforeprint", () => {
    document.querySelectorAll("figure details").forEach((part) => (part.open = true));
    fit(PRINTED_PX);
  });
  addEventListener("afterprint", () => fit());
})();
