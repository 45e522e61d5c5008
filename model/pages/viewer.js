"use strict";
/* A scene of scene.py on a canvas: drag to turn, two fingers or Ctrl and wheel to zoom.

sceneViewer(canvas, data, shown) draws `data` (scene_data); `shown(layer)` says what is drawn. It returns
  show(moment)     the platform at a moment, or none (null); with `tensions` cables take their colours; `strokes`
                   and `labels` of its own are drawn in front of everything, and never change the view;
  update(parts)    other surfaces, strokes, labels or moments, kept in view;
  zoom(factor), reset(), redraw(), size() in mm;
  pick(x, y, height)  the point at that height [mm] that is drawn at a pixel of the canvas; null where none is.
tensionColour(share) is a cable's colour, from 0 at the lower limit of its tension to 1 at the upper. */

// Blue, grey and orange differ for every kind of colour vision; a cable beyond a limit is dashed as well.
function tensionColour(share) {
  const style = getComputedStyle(document.documentElement);
  const hex = (role) => parseInt(style.getPropertyValue(`--${role}`).trim().slice(1), 16);
  if (share < 0 || share > 1) return style.getPropertyValue("--limit").trim();
  const [from, to] = share < 0.5 ? ["encoder", "cable"] : ["cable", "tag"], at = share < 0.5 ? 2 * share : 2 * share - 1;
  const mix = (bits) => Math.round(((hex(from) >> bits) & 255) * (1 - at) + ((hex(to) >> bits) & 255) * at);
  return `rgb(${mix(16)},${mix(8)},${mix(0)})`;
}

function sceneViewer(canvas, data, shown = () => true) {
  const context = canvas.getContext("2d");
  const CABLE_PIECES = 10; // so that a cable can pass behind one obstacle and in front of another
  const MARGIN = 24; // px, for texts beside points
  const UNFITTED = ["tree", "trail", "pick"]; // layers that may lie outside the picture
  const first = { azimuth: data.view.azimuth, elevation: data.view.elevation, zoom: 1 };
  const eye = { ...first };
  const reach = [0, 1, 2].map((k) => Math.max(...data.platform.vertices.map((v) => Math.abs(v[k]))));
  let strokes, seenPoints, centre, size, distance; // of what is drawn; set by `update`
  let now = null;
  let waiting = false;
  let colours = {};

  function update(parts) {
    data = { ...data, ...parts };
    const placed = data.moments.filter((_, k) => k % Math.max(1, Math.floor(data.moments.length / 20)) === 0);
    seenPoints = [ // all that must be in the picture
      ...data.surfaces.flatMap((surface) => surface.vertices),
      ...data.strokes.filter((s) => !UNFITTED.includes(s.layer)).flatMap((s) => s.segments.flatMap((b) => [b.slice(0, 3), b.slice(3)])),
      ...data.labels.map((label) => label.at),
      ...placed.flatMap(({ p }) => [-1, 1].map((sign) => p.map((v, k) => v + sign * reach[k]))),
    ];
    const bounds = [0, 1, 2].map((k) => [Math.min(...seenPoints.map((v) => v[k])), Math.max(...seenPoints.map((v) => v[k]))]);
    centre = bounds.map(([low, high]) => (low + high) / 2);
    size = Math.hypot(...bounds.map(([low, high]) => high - low));
    distance = 2.2 * size;
    strokes = data.strokes.map((stroke) =>
      stroke.dash.length ? stroke : { ...stroke, segments: stroke.segments.flatMap((b) => pieces(b, size / 30)) });
    redraw();
  }

  function pieces(segment, longest) {
    const start = segment.slice(0, 3), end = segment.slice(3);
    const count = Math.max(1, Math.ceil(Math.hypot(...end.map((v, c) => v - start[c])) / longest));
    const at = (i) => end.map((v, c) => start[c] + ((v - start[c]) * i) / count);
    return Array.from({ length: count }, (_, i) => [...at(i), ...at(i + 1)]);
  }

  function readColours() {
    const style = getComputedStyle(document.documentElement);
    for (const role of ["ink", "muted", "surface", "limit", "obstacle", "platform", "cable", "tree", "raw", "frame", "encoder", "tag"])
      colours[role] = style.getPropertyValue("--" + role).trim();
  }

  function shade(hex, light) {
    const value = parseInt(hex.slice(1), 16);
    const mix = (channel) => Math.round(light < 1 ? channel * light : 255 - (255 - channel) * (2 - light));
    return `rgb(${mix(value >> 16)},${mix((value >> 8) & 255)},${mix(value & 255)})`;
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

  // Everything fits at every angle and size of the window; zooming in goes beyond that.
  function fitted() {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    const see = seer(eye), seen = seenPoints.map(see);
    const [[left, right], [low, high]] = [0, 1].map((k) => [Math.min(...seen.map((p) => p[k])), Math.max(...seen.map((p) => p[k]))]);
    const scale = eye.zoom * Math.min((width - 2 * MARGIN) / (right - left), (height - 2 * MARGIN) / (high - low));
    return { see, scale, middle: [(left + right) / 2, (low + high) / 2], width, height };
  }

  function projector() {
    const { see, scale, middle, width, height } = fitted();
    return (p) => {
      const [x, y, depth] = see(p);
      return [width / 2 + scale * (x - middle[0]), height / 2 - scale * (y - middle[1]), depth];
    };
  }

  // Along the ray from the eye through a pixel, to a horizontal plane before it.
  function pick(x, y, level) {
    const { scale, middle, width, height } = fitted();
    const a = (eye.azimuth * Math.PI) / 180, e = (eye.elevation * Math.PI) / 180;
    const ca = Math.cos(a), sa = Math.sin(a), ce = Math.cos(e), se = Math.sin(e);
    const right = (x - width / 2) / scale + middle[0], up = (height / 2 - y) / scale + middle[1];
    const share = (level - centre[2] - se * distance) / (ce * up - se * distance); // of the depth of the centre
    if (!(share > 0.05 && share < 20)) return null;
    const toward = distance * (1 - share);
    return [
      centre[0] + share * (-sa * right - se * ca * up) + ce * ca * toward,
      centre[1] + share * (ca * right - se * sa * up) + ce * sa * toward,
      level,
    ];
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
    const project = projector(), items = collect(project);
    items.sort((one, other) => other.depth - one.depth);
    for (const item of items) paint(item);
    texts(project);
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
    const surface = (solid) => {
      const seen = solid.vertices.map(project), colour = colours[solid.role];
      for (const face of solid.faces) {
        const points = face.map((k) => seen[k]);
        const depth = points.reduce((sum, p) => sum + p[2], 0) / points.length;
        items.push({ points, depth, alpha: solid.opacity, fill: shade(colour, light(face.map((k) => solid.vertices[k]))) });
      }
      for (const [a, b] of solid.edges) segment(seen[a], seen[b], colour, 1.2);
    };
    for (const solid of data.surfaces) if (shown(solid.layer)) surface(solid);
    for (const stroke of strokes.filter((one) => shown(one.layer)))
      for (const b of stroke.segments) {
        segment(project(b.slice(0, 3)), project(b.slice(3)), colours[stroke.role], stroke.width, stroke.opacity, stroke.dash);
        // A little nearer than it is, thin lines most: on the same track they cover the wide ones.
        if (stroke.ahead) items[items.length - 1].depth -= 0.002 * size * (9 - stroke.width);
        if (stroke.layer === "floor") items[items.length - 1].depth += size;
      }
    if (shown("robot") && now) robot(project, segment, surface);
    for (const stroke of (now?.strokes ?? []).filter((one) => shown(one.layer)))
      for (const b of stroke.segments) {
        segment(project(b.slice(0, 3)), project(b.slice(3)), colours[stroke.role], stroke.width, 1, stroke.dash);
        items[items.length - 1].depth = -1e9; // in front of everything
      }
    return items;
  }

  function light(corners) {
    const [a, b, c] = corners;
    const u = b.map((v, k) => v - a[k]), w = c.map((v, k) => v - a[k]);
    const n = [u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]];
    const length = Math.hypot(...n) || 1;
    return 0.82 + 0.34 * Math.abs(n[2] / length) + 0.12 * Math.abs(n[0] / length);
  }

  function cables() { // from outlet or pulley to anchor
    const { r, p, exits } = now;
    const place = (v) => [0, 1, 2].map((k) => p[k] + r[3 * k] * v[0] + r[3 * k + 1] * v[1] + r[3 * k + 2] * v[2]);
    return { place, ends: data.anchors.map((anchor, i) => [exits[i], place(anchor)]) };
  }

  function robot(project, segment, surface) {
    const { place, ends } = cables();
    const [low, high] = data.tension_limits || [0, 1];
    ends.forEach(([start, end], i) => {
      const tension = now.tensions?.[i] ?? null, share = tension === null ? null : (tension - low) / (high - low);
      const beyond = share < 0 || share > 1;
      const [colour, width] = share === null ? [colours.cable, 1.4] : [tensionColour(share), beyond ? 3.4 : 2.2];
      let last = project(start);
      for (let k = 1; k <= CABLE_PIECES; k++) {
        const next = project(start.map((v, c) => v + ((end[c] - v) * k) / CABLE_PIECES));
        segment(last, next, colour, width, 1, beyond ? [5, 5] : null);
        last = next;
      }
    });
    surface({ ...data.platform, vertices: data.platform.vertices.map(place) });
  }

  const LINE = 14; // height of a text, px
  let written = []; // where texts stand already: [left, right, base]

  function texts(project) {
    written = [];
    for (const { layer, text, at, mark } of [...data.labels, ...(now?.labels ?? [])]) if (shown(layer)) write(text, project(at), mark);
    for (const solid of data.surfaces.filter((one) => one.name && shown(one.layer))) {
      const top = Math.max(...solid.vertices.map((v) => v[2]));
      const upper = solid.vertices.filter((v) => v[2] > top - 0.01);
      write(solid.name, project([0, 1, 2].map((k) => upper.reduce((sum, v) => sum + v[k], 0) / upper.length)));
    }
    if (shown("numbers") && shown("robot") && now)
      cables().ends.forEach(([start, end], i) => write(String(i + 1), project(start.map((v, c) => v + 0.25 * (end[c] - v)))));
  }

  function placed(left, base, wide) { // beside what is written there already, one or two lines up or down
    const free = (at) => written.every(([l, r, b]) => left + wide < l || left > r || Math.abs(at - b) >= LINE);
    const at = [0, -LINE, LINE, -2 * LINE, 2 * LINE].map((off) => base + off).find(free) ?? base;
    written.push([left, left + wide, at]);
    return [left, at];
  }

  function write(text, [x, y], mark = "") {
    context.font = "600 12px system-ui, sans-serif";
    if (mark) {
      context.beginPath();
      context.arc(x, y, 5, 0, 2 * Math.PI);
      Object.assign(context, { fillStyle: mark === "ring" ? colours.surface : colours.ink, strokeStyle: colours.ink, lineWidth: 2 });
      context.fill();
      context.stroke();
    }
    const wide = context.measureText(text).width, [left, base] = placed(mark ? x + 9 : x - wide / 2, mark ? y - 7 : y + 4, wide);
    context.textAlign = "left";
    Object.assign(context, { strokeStyle: colours.surface, fillStyle: colours.ink, lineWidth: 3 });
    context.strokeText(text, left, base); // readable on lines and faces
    context.fillText(text, left, base);
  }

  function redraw() {
    if (!waiting) {
      waiting = true;
      requestAnimationFrame(draw);
    }
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

  const down = new Map(); // pointer → where it is
  canvas.addEventListener("pointerdown", (event) => {
    down.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = down.get(event.pointerId), next = [event.clientX, event.clientY];
    if (!last) return;
    const other = [...down].filter(([id]) => id !== event.pointerId).map(([, at]) => at)[0];
    const apart = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]) || 1;
    if (other) zoom(apart(next) / apart(last));
    else turn((last[0] - next[0]) * 0.4, (next[1] - last[1]) * 0.4);
    down.set(event.pointerId, next);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => down.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return; // the page scrolls
    event.preventDefault();
    zoom(Math.exp(-event.deltaY * 0.002));
  }, { passive: false });
  const keys = {
    ArrowLeft: () => turn(-5, 0), ArrowRight: () => turn(5, 0), ArrowUp: () => turn(0, 5), ArrowDown: () => turn(0, -5),
    "+": () => zoom(1.15), "-": () => zoom(1 / 1.15),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    readColours();
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  readColours();
  update({});
  return {
    update, zoom, redraw, pick,
    size: () => size, // diagonal of all that is fitted into the picture, [mm]
    show: (moment) => {
      now = moment;
      redraw();
    },
    reset: () => {
      Object.assign(eye, first);
      redraw();
    },
  };
}
