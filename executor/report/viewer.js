"use strict";
/* The interactive scene: drag to turn, buttons or ctrl + wheel to zoom, a slider for the time. */
(() => {
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const canvas = document.getElementById("scene-canvas");
  const context = canvas.getContext("2d");
  const slider = document.getElementById("scene-time");
  const play = document.getElementById("scene-play");
  const speed = document.getElementById("scene-speed");
  const readout = document.getElementById("scene-readout");
  const boxes = [...document.querySelectorAll("[data-layer]")];
  document.documentElement.classList.add("scripted");

  const first = { azimuth: data.view.azimuth, elevation: data.view.elevation, zoom: 1 };
  const eye = { ...first };
  const bounds = [0, 1, 2].map((k) => {
    const values = [data.frame, ...data.obstacles].flatMap((solid) => solid.vertices.map((v) => v[k]));
    return [Math.min(...values), Math.max(...values)];
  });
  const centre = bounds.map(([low, high]) => (low + high) / 2);
  const size = Math.hypot(...bounds.map(([low, high]) => high - low));
  const distance = 2.2 * size;
  data.path = pieces(data.path, size / 100);
  data.raw = pieces(data.raw, size / 100);
  const CABLE_PIECES = 10; // so that a cable can pass behind one obstacle and in front of another
  let now = data.moments.length - 1;
  let playing = false;
  let before = 0;
  let clock = 0;
  let waiting = false;
  let colours = {};

  function pieces(points, longest) {
    return points.flatMap((end, k) => {
      if (k === 0) return [end];
      const start = points[k - 1];
      const count = Math.max(1, Math.ceil(Math.hypot(...end.map((v, c) => v - start[c])) / longest));
      return Array.from({ length: count }, (_, i) => end.map((v, c) => start[c] + ((v - start[c]) * (i + 1)) / count));
    });
  }

  function readColours() {
    const style = getComputedStyle(document.documentElement);
    for (const role of ["ink", "muted", "obstacle", "platform", "cable", "tree", "raw", "frame", "encoder", "tag"])
      colours[role] = style.getPropertyValue("--" + role).trim();
  }

  function shade(hex, light) {
    const value = parseInt(hex.slice(1), 16);
    const mix = (channel) => Math.round(light < 1 ? channel * light : 255 - (255 - channel) * (2 - light));
    return `rgb(${mix(value >> 16)},${mix((value >> 8) & 255)},${mix(value & 255)})`;
  }

  function shown(layer) {
    return boxes.some((box) => box.dataset.layer === layer && box.checked);
  }

  // Turned, and as seen from the eye, in mm on the plane through the centre; y is up.
  function seer(eye) {
    const a = (eye.azimuth * Math.PI) / 180, e = (eye.elevation * Math.PI) / 180;
    const ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
    return (p) => {
      const x = p[0] - centre[0], y = p[1] - centre[1], z = p[2] - centre[2];
      const depth = distance - (ce * ca * x + ce * sa * y + se * z);
      const k = distance / Math.max(depth, 0.05 * distance);
      return [k * (-sa * x + ca * y), k * (-se * ca * x - se * sa * y + ce * z), depth];
    };
  }

  // Where the first view has everything in the middle of the picture.
  const window0 = [0, 1].map((k) => {
    const values = [data.frame, ...data.obstacles].flatMap((solid) => solid.vertices.map(seer(first))).map((p) => p[k]);
    return [Math.min(...values), Math.max(...values)];
  });

  function projector() {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const [across, up] = window0.map(([low, high]) => high - low);
    const scale = eye.zoom * 0.94 * Math.min(width / across, height / up);
    const [x0, y0] = window0.map(([low, high]) => (low + high) / 2);
    const see = seer(eye);
    return (p) => {
      const [x, y, depth] = see(p);
      return [width / 2 + scale * (x - x0), height / 2 - scale * (y - y0), depth];
    };
  }

  function draw() {
    waiting = false;
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.lineCap = context.lineJoin = "round";
    const items = collect(projector());
    items.sort((one, other) => other.depth - one.depth);
    for (const item of items) paint(item);
    if (shown("obstacles")) names(projector());
  }

  function paint(item) {
    context.globalAlpha = item.alpha;
    context.setLineDash(item.dash || []);
    context.beginPath();
    context.moveTo(item.points[0][0], item.points[0][1]);
    for (const p of item.points.slice(1)) context.lineTo(p[0], p[1]);
    if (item.fill) {
      context.closePath();
      context.fillStyle = item.fill;
      context.fill();
    } else {
      context.strokeStyle = item.stroke;
      context.lineWidth = item.width;
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  function collect(project) {
    const items = [];
    const segment = (a, b, stroke, width, alpha = 1, dash = null) =>
      items.push({ points: [a, b], depth: (a[2] + b[2]) / 2, stroke, width, alpha, dash });
    const edges = (solid, stroke, width, alpha, dash) => {
      const seen = solid.vertices.map(project);
      for (const [a, b] of solid.edges) segment(seen[a], seen[b], stroke, width, alpha, dash);
    };
    const surface = (solid, colour, alpha) => {
      const seen = solid.vertices.map(project);
      for (const face of solid.faces) {
        const points = face.map((k) => seen[k]);
        const depth = points.reduce((sum, p) => sum + p[2], 0) / points.length;
        items.push({ points, depth, alpha, fill: shade(colour, light(face.map((k) => solid.vertices[k]))) });
      }
      edges(solid, colour, 1.2, 1);
    };
    const track = (points, stroke, width, alpha = 1, dash = null) => {
      const seen = points.map(project);
      // A little nearer than they are, thin lines most: on the same track they cover the wide ones.
      for (let k = 1; k < seen.length; k++) {
        segment(seen[k - 1], seen[k], stroke, width, alpha, dash);
        items[items.length - 1].depth -= 0.002 * size * (9 - width);
      }
    };
    if (shown("frame")) edges(data.frame, colours.frame, 2.5, 1);
    if (shown("workspace")) edges(data.workspace, colours.muted, 1, 0.8, [4, 4]);
    if (shown("obstacles")) for (const solid of data.obstacles) surface(solid, colours.obstacle, 0.62);
    if (shown("tree"))
      for (const b of data.tree) segment(project(b.slice(0, 3)), project(b.slice(3)), colours.tree, 1, 0.75);
    if (shown("raw")) track(data.raw, colours.raw, 1.8);
    if (shown("path")) track(data.path, colours.ink, 4.5);
    if (shown("seen")) track(data.seen, colours.tag, 7, 0.35);
    if (shown("driven")) track(data.driven, colours.encoder, 2);
    if (shown("robot") && data.moments.length) robot(project, segment, surface);
    return items;
  }

  function light(corners) {
    const [a, b, c] = corners;
    const u = b.map((v, k) => v - a[k]), w = c.map((v, k) => v - a[k]);
    const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]];
    const length = Math.hypot(...n) || 1;
    return 0.82 + 0.34 * Math.abs(n[2] / length) + 0.12 * Math.abs(n[0] / length);
  }

  function robot(project, segment, surface) {
    const moment = data.moments[now];
    const r = moment.r, p = moment.p;
    const place = (v) => [0, 1, 2].map((k) => p[k] + r[3 * k] * v[0] + r[3 * k + 1] * v[1] + r[3 * k + 2] * v[2]);
    const exits = moment.exits || data.outlets;
    data.anchors.forEach((anchor, i) => {
      const end = place(anchor), start = exits[i];
      let last = project(start);
      for (let k = 1; k <= CABLE_PIECES; k++) {
        const next = project(start.map((v, c) => v + ((end[c] - v) * k) / CABLE_PIECES));
        segment(last, next, colours.cable, 1.4);
        last = next;
      }
    });
    surface({ ...data.platform, vertices: data.platform.vertices.map(place) }, colours.platform, 0.85);
  }

  function names(project) {
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "center";
    context.fillStyle = colours.ink;
    for (const solid of data.obstacles) {
      const top = Math.max(...solid.vertices.map((v) => v[2]));
      const upper = solid.vertices.filter((v) => v[2] > top - 0.01);
      const middle = [0, 1, 2].map((k) => upper.reduce((sum, v) => sum + v[k], 0) / upper.length);
      const [x, y] = project(middle);
      context.fillText(solid.name, x, y + 4);
    }
  }

  function redraw() {
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(draw);
    }
  }

  function show(index) {
    now = Math.min(Math.max(index, 0), data.moments.length - 1);
    const moment = data.moments[now];
    slider.value = String(now);
    slider.setAttribute("aria-valuetext", `${moment.t.toFixed(1)} seconds`);
    const near = moment.clearance === undefined ? "" : ` · clearance ${moment.clearance.toFixed(1)} mm (${moment.to})`;
    readout.textContent = `${moment.t.toFixed(1)} s · ${moment.p.map((v) => v.toFixed(0)).join(", ")} mm${near}`;
    redraw();
  }

  function tick(time) {
    if (!playing) return;
    clock += ((time - before) / 1000) * Number(speed.value);
    before = time;
    const last = data.moments.length - 1;
    let index = now;
    while (index < last && data.moments[index + 1].t <= clock) index++;
    show(index);
    if (index >= last) return setPlaying(false);
    requestAnimationFrame(tick);
  }

  function setPlaying(on) {
    playing = on;
    play.textContent = on ? "Pause" : "Play";
    if (!on) return;
    if (now >= data.moments.length - 1) show(0);
    clock = data.moments[now].t;
    before = performance.now();
    requestAnimationFrame(tick);
  }

  function zoom(factor) {
    eye.zoom = Math.min(Math.max(eye.zoom * factor, 0.4), 8);
    redraw();
  }

  function turn(azimuth, elevation) {
    eye.azimuth += azimuth;
    eye.elevation = Math.min(Math.max(eye.elevation + elevation, -89), 89);
    redraw();
  }

  let drag = null;
  canvas.addEventListener("pointerdown", (event) => {
    drag = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!drag) return;
    turn((drag[0] - event.clientX) * 0.4, (event.clientY - drag[1]) * 0.4);
    drag = [event.clientX, event.clientY];
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => (drag = null));
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // the page scrolls
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.002));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-5, 0), ArrowRight: () => turn(5, 0), ArrowUp: () => turn(0, 5), ArrowDown: () => turn(0, -5),
    "+": () => zoom(1.15), "-": () => zoom(1 / 1.15), " ": () => setPlaying(!playing),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  document.getElementById("scene-in").addEventListener("click", () => zoom(1.25));
  document.getElementById("scene-out").addEventListener("click", () => zoom(0.8));
  document.getElementById("scene-reset").addEventListener("click", () => {
    Object.assign(eye, first);
    redraw();
  });
  play.addEventListener("click", () => setPlaying(!playing));
  slider.addEventListener("input", () => {
    setPlaying(false);
    show(Number(slider.value));
  });
  for (const box of boxes) box.addEventListener("change", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readColours();
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  readColours();
  if (data.moments.length) show(now);
  else play.disabled = slider.disabled = true;
  redraw();
})();
