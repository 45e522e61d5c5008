"use strict";
/* Charts: values under the pointer; a drag, two fingers or Ctrl and wheel zoom every chart of a group. */
(() => {
  const plots = [...document.querySelectorAll(".plot")].map(setUp);
  document.documentElement.classList.add("charted");

  function setUp(figure) {
    const data = JSON.parse(figure.querySelector("script").textContent);
    const area = figure.querySelector(".area"), svg = area.querySelector("svg");
    const make = (parent, name, tag = "div") =>
      parent.appendChild(Object.assign(document.createElement(tag), { className: name, hidden: true }));
    const plot = { data, svg, figure, lines: svg.querySelector(".lines"), ticks: svg.querySelector(".ticks"), x: data.x, y: data.y };
    for (const name of ["chosen", "cursor", "readout"]) plot[name] = make(area, name);
    plot.reset = Object.assign(make(area, "reset", "button"), { type: "button", textContent: "Reset zoom" });
    plot.reset.addEventListener("click", () => zoom(plot, ...data.x));
    listen(plot, svg);
    return plot;
  }

  function listen(plot, svg) {
    let down = new Map(), from = null, pinch = null; // down: pointer → x in px
    const px = (event) => event.clientX - svg.getBoundingClientRect().left;
    const at = (x) => plot.x[0] + (x / svg.clientWidth) * (plot.x[1] - plot.x[0]);
    const dragged = (event) => [from, px(event)].sort((a, b) => a - b);
    const end = () => { down = new Map(); from = pinch = null; plot.chosen.hidden = true; };
    const on = (name, act) => svg.addEventListener(name, act, { passive: false });
    on("pointerdown", (event) => {
      if (event.button) return;
      down.set(event.pointerId, px(event));
      if (event.pointerType === "mouse") { from = px(event); svg.setPointerCapture(event.pointerId); }
      if (down.size === 2) pinch = [...down].map(([id, x]) => [id, at(x)]);
      read(plot, at(px(event)));
    });
    on("pointermove", (event) => {
      if (down.has(event.pointerId)) down.set(event.pointerId, px(event));
      if (pinch) {
        const [[a, u], [b, v]] = pinch, p = down.get(a), q = down.get(b), slope = (v - u) / (q - p), left = u - p * slope;
        if (Math.abs(q - p) > 8) zoom(plot, left, left + svg.clientWidth * slope);
        return;
      }
      if (from !== null) {
        const [left, right] = dragged(event);
        plot.chosen.hidden = right - left < 5;
        plot.chosen.style.cssText = `left: ${left}px; width: ${right - left}px`;
      }
      read(plot, at(px(event)));
    });
    on("pointerup", (event) => {
      const ends = from === null ? [0, 0] : dragged(event);
      end();
      if (ends[1] - ends[0] >= 5) zoom(plot, ...ends.map(at));
    });
    on("pointercancel", end);
    on("mousedown", (event) => event.preventDefault()); // neither focus nor selected text
    for (const gone of ["pointerleave", "blur"]) on(gone, (event) => { if (!down.size && event.pointerType !== "touch") hide(plot); });
    on("dblclick", () => zoom(plot, ...plot.data.x));
    on("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return; // the page scrolls
      event.preventDefault();
      scale(plot, Math.exp(event.deltaY * 0.004), at(px(event)));
    });
    on("keydown", (event) => {
      const [a, b] = plot.x, now = plot.at ?? (a + b) / 2, step = (b - a) / 50;
      const keys = { "+": () => scale(plot, 0.7, now), "-": () => scale(plot, 1.4, now), Escape: () => zoom(plot, ...plot.data.x) };
      Object.assign(keys, { ArrowLeft: () => read(plot, Math.max(a, now - step)), ArrowRight: () => read(plot, Math.min(b, now + step)) });
      if (keys[event.key]) { event.preventDefault(); keys[event.key](); }
    });
  }

  const scale = (plot, factor, about) => zoom(plot, ...plot.x.map((v) => about + (v - about) * factor));
  const shown = (n) => String(Number(n.toPrecision(8)));
  const hide = (plot) => { plot.cursor.hidden = plot.readout.hidden = true; };

  function zoom(plot, from, to) {
    const [low, high] = plot.data.x, a = Math.max(from, low), b = Math.min(to, high), whole = a === low && b === high;
    if (!(b - a >= (high - low) / 2000)) return;
    for (const other of plots.filter((p) => p.data.group === plot.data.group)) {
      other.x = [a, b];
      other.y = whole ? other.data.y : fitted(other);
      other.reset.hidden = whole;
      other.figure.classList.toggle("zoomed", !whole);
      hide(other);
      draw(other);
    }
  }
  function fitted({ data, x: [a, b] }) { // the range of y of what is seen between a and b
    const seen = data.lines.filter((line) => line.fits).flatMap((line) =>
      [line.y, line.low, line.high].filter(Boolean).flatMap((column) =>
        [...column.filter((_, k) => line.x[k] >= a && line.x[k] <= b), value(line.x, column, a), value(line.x, column, b)]));
    const known = seen.filter((v) => v !== null), [low, high] = [Math.min, Math.max].map((of) => known.reduce((a, b) => of(a, b), known[0]));
    const room = 0.06 * (high - low) || 0.05 * Math.abs(high) || 1;
    return known.length ? [data.zero && low >= 0 ? 0 : low - room, high + room] : data.y;
  }
  function value(xs, ys, x) { // between points; null in a gap and beyond the ends
    let low = 0, high = xs.length - 1;
    if (high < 0 || x < xs[0] || x > xs[high]) return null;
    while (high - low > 1) { const k = (low + high) >> 1; if (xs[k] <= x) low = k; else high = k; }
    if (ys[low] === null || ys[high] === null) return null;
    return ys[low] + (xs[high] > xs[low] ? ((x - xs[low]) / (xs[high] - xs[low])) * (ys[high] - ys[low]) : 0);
  }
  function round(low, high, most) { // as `ticks` of charts.py
    const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= rough * (1 - 1e-9)), first = Math.ceil(low / step - 1e-9);
    return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => (first + k) * step);
  }

  function add(parent, tag, attributes, text = "") {
    const element = parent.appendChild(document.createElementNS("http://www.w3.org/2000/svg", tag));
    for (const [name, to] of Object.entries(attributes)) element.setAttribute(name, to);
    return Object.assign(element, { textContent: text });
  }
  function draw({ data, ticks, lines, x: [a, b], y: [low, high] }) {
    const [x0, x1] = data.x, [y0, y1] = data.y;
    const box = [(a - x0) / (x1 - x0), (y1 - high) / (y1 - y0), (b - a) / (x1 - x0), (high - low) / (y1 - y0)];
    lines.setAttribute("viewBox", box.map((part) => 1000 * part).join(" "));
    ticks.replaceChildren();
    const across = (x) => `${((100 * (x - a)) / (b - a)).toFixed(3)}%`, up = (y) => `${((100 * (high - y)) / (high - low)).toFixed(3)}%`;
    for (const x of round(a, b, 6)) {
      add(ticks, "line", { x1: across(x), x2: across(x), y1: 0, y2: "100%" });
      add(ticks, "text", { class: "x", x: across(x), y: "100%", dy: 16 }, shown(x));
    }
    for (const y of round(low, high, 5).filter((y) => !data.log || Math.abs(y - Math.round(y)) < 1e-9)) {
      add(ticks, "line", { x1: 0, x2: "100%", y1: up(y), y2: up(y) });
      add(ticks, "text", { class: "y", x: 0, dx: -6, y: up(y), dy: 4 }, shown(data.log ? 10 ** y : y));
    }
    add(ticks, "text", { class: "unit", x: 0, dx: -44, y: -7 }, data.quantity);
    add(ticks, "text", { class: "unit end", x: "100%", y: "100%", dy: 31 }, data.xQuantity);
    for (const [middle, name] of data.spans.map(([from, to, name]) => [(from + to) / 2, name]))
      if (middle > a && middle < b) add(ticks, "text", { class: "span", x: across(middle), y: 4 }, name);
  }

  function read(plot, x) {
    const { data, cursor, readout, svg, x: [a, b], y: [low, high] } = plot;
    if (x < a || x > b) return hide(plot);
    plot.at = x;
    const digits = (span) => Math.min(Math.max(2 - Math.floor(Math.log10(span)), 0), 6);
    const text = (y) => (y === null ? "–" : data.log ? String(Math.round(10 ** y)) : y.toFixed(digits(high - low)));
    readout.replaceChildren(`${x.toFixed(digits(b - a))} ${data.xUnit}`);
    for (const line of data.lines.filter((one) => one.name)) {
      const row = readout.appendChild(document.createElement("div")), y = value(line.x, line.y, x);
      const ends = line.low && !data.log ? ` (${text(value(line.x, line.low, x))} to ${text(value(line.x, line.high, x))})` : "";
      add(add(row, "svg", { width: 16, height: 10, "aria-hidden": true }), "path", { d: "M0 5H16", fill: "none", style: line.stroke });
      row.append(`${line.name} ${text(y)} ${data.unit}${y === null ? "" : ends}`);
    }
    const left = ((x - a) / (b - a)) * svg.clientWidth, beyond = left > svg.clientWidth / 2;
    cursor.hidden = readout.hidden = false;
    cursor.style.left = `${left}px`;
    readout.style.cssText = beyond ? `right: ${svg.clientWidth - left + 10}px` : `left: ${left + 10}px`;
  }
})();
