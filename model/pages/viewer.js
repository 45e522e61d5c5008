"use strict";
/* A scene of scene.py by three.js (`THREE`): drag to turn, two fingers or Ctrl and wheel to zoom.

sceneViewer(canvas, data, shown) draws `data` (scene_data); `shown(layer)` says what is drawn. It returns
  show(moment)     the platform at a moment, or none (null); with `tensions` cables take their colours; `strokes`
                   and `labels` of its own are drawn in front of everything, and never change the view;
  update(parts)    other surfaces, strokes, labels or moments, kept in view;
  zoom(factor), reset(), redraw(), size() in mm;
  isSoftware       whether the processor draws, for want of a graphics card: a picture then takes some 50 ms of it;
  pick(x, y, height)  the point at that height [mm] that is drawn at a pixel of the canvas; null where none is.
The canvas is in a `.stage`, over which texts are laid. A picture is drawn when something changed, and only then.
tensionColour(share) is a cable's colour, from 0 at the lower limit of its tension to 1 at the upper. */

// Blue, grey and orange differ for every kind of colour vision; a cable beyond a limit is dashed as well.
function tensionMix(share) {
  if (share < 0 || share > 1) return ["limit", "limit", 0];
  return share < 0.5 ? ["encoder", "cable", 2 * share] : ["cable", "tag", 2 * share - 1];
}

function tensionColour(share) {
  const [from, to, at] = tensionMix(share);
  return `color-mix(in srgb, var(--${to}) ${(100 * at).toFixed(1)}%, var(--${from}))`;
}

// Lines as wide as on paper: a quad for each segment, whose corners are laid out in pixels.
const LINE_VERTEX = `
attribute vec2 corner;
attribute vec3 from, to;
uniform vec2 view;
uniform float width, nearer, cap;
varying vec2 at;
varying float far;
void main() {
  vec4 a = projectionMatrix * modelViewMatrix * vec4(from, 1.0), b = projectionMatrix * modelViewMatrix * vec4(to, 1.0);
  vec3 p = a.xyz / a.w, q = b.xyz / b.w;
  vec2 way = 0.5 * view * (q.xy - p.xy);
  far = length(way);
  vec2 ahead = far > 1e-6 ? way / far : vec2(1.0, 0.0);
  float reach = 0.5 * width + 1.0;
  at = vec2(mix(-cap * reach, far + cap * reach, corner.x), corner.y * reach);
  vec2 px = ahead * at.x + vec2(-ahead.y, ahead.x) * at.y;
  gl_Position = vec4(p.xy + 2.0 * px / view, mix(p.z, q.z, corner.x) - nearer, 1.0);
}`;
const LINE_FRAGMENT = `
uniform vec3 colour;
uniform vec2 dash;
uniform float width, opacity, ratio;
varying vec2 at;
varying float far;
void main() {
  if (dash.x > 0.0 && mod(at.x, dash.x + dash.y) > dash.x) discard;
  float off = length(vec2(max(max(-at.x, at.x - far), 0.0), at.y));
  float alpha = clamp((0.5 * width - off) * ratio + 0.5, 0.0, 1.0);
  if (alpha < 0.02) discard;
  gl_FragColor = vec4(colour, alpha * opacity);
}`;

/** The canvas's context; null without WebGL 2. */
const webglOf = (canvas) => canvas.getContext("webgl2", { alpha: false, antialias: true });

function sceneViewer(canvas, data, shown = () => true) {
  const MARGIN = 24, LINE = 14; // px: around all, for texts beside points; the height of a text
  const UNFITTED = ["tree", "trail", "pick"]; // layers that may lie outside the picture
  const context = globalThis.THREE && webglOf(canvas);
  if (!context) return withoutWebGL(canvas);

  THREE.ColorManagement.enabled = false; // colours are those of the page
  const renderer = new THREE.WebGLRenderer({ canvas, context });
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.shadowMap.enabled = true;
  renderer.debug.checkShaderErrors = false; // which would wait for the compiler
  const lamp = new THREE.DirectionalLight("white", 0.3 * Math.PI), sky = new THREE.HemisphereLight("white", "#a8aeb8", 0.84 * Math.PI);
  lamp.castShadow = true;
  lamp.shadow.radius = 5;
  lamp.shadow.mapSize.set(1024, 1024);
  sky.position.set(0, 0, 1);
  const floor = new THREE.Mesh(new THREE.PlaneGeometry(), new THREE.ShadowMaterial({ depthWrite: false }));
  Object.assign(floor, { receiveShadow: true, renderOrder: -3 }).userData.layer = "floor";
  const robot = new THREE.Group(), world = new THREE.Scene().add(lamp, lamp.target, sky, floor, robot);
  const camera = new THREE.Camera();
  camera.up.set(0, 0, 1);

  const first = { azimuth: data.view.azimuth, elevation: data.view.elevation, zoom: 1 };
  const eye = { ...first }, pane = { width: 0, height: 0 }; // of the canvas, CSS px
  const view = { value: new THREE.Vector2() }, ratio = { value: 1 }; // for the lines
  const point = new THREE.Vector3(), centre = new THREE.Vector3(), box = new THREE.Box3();
  const surfaces = new Map(), strokes = [], ownStrokes = []; // what was made of the data
  let seen = [], names = [], size = 1, distance = 1, perMm = 0; // of what is drawn; set by `update`
  let now = null, waiting = false, turned = true;

  // Colours: one object a role, which materials share.
  const colours = {};
  const read = (role) => getComputedStyle(canvas).getPropertyValue(`--${role}`).trim() || "gray";
  const colourOf = (role) => (colours[role] ??= new THREE.Color(read(role)));
  function readColours() {
    for (const role in colours) colours[role].set(read(role));
    renderer.setClearColor(colourOf("surface"));
    floor.material.opacity = matchMedia("(prefers-color-scheme: dark)").matches ? 0.4 : 0.13;
    redraw();
  }

  // Lines, and surfaces: faces with light, and edges.
  function makeLines(front = false) {
    const geometry = new THREE.InstancedBufferGeometry(), corners = new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]);
    geometry.setIndex([0, 2, 1, 1, 2, 3]).setAttribute("corner", new THREE.BufferAttribute(corners, 2));
    const own = { colour: null, dash: new THREE.Vector2(), width: 1, opacity: 1, nearer: 0, cap: 1 };
    const uniforms = { view, ratio, ...Object.fromEntries(Object.entries(own).map(([name, value]) => [name, { value }])) };
    const material = new THREE.ShaderMaterial({ uniforms, vertexShader: LINE_VERTEX, fragmentShader: LINE_FRAGMENT, side: THREE.DoubleSide, depthTest: !front });
    return Object.assign(new THREE.Mesh(geometry, material), { frustumCulled: false });
  }

  function style(mesh, { role, width, opacity = 1, dash = null, ahead = false, layer }) {
    const { material, material: { uniforms: its, depthTest } } = mesh, isFull = opacity >= 1;
    its.colour.value = colourOf(role);
    its.dash.value.set(dash?.[0] ?? 0, dash?.[1] ?? dash?.[0] ?? 0);
    its.width.value = width;
    its.opacity.value = opacity;
    its.cap.value = isFull && !dash?.length ? 1 : 0;
    // A little nearer than it is, thin lines most: on the same track they cover the wide ones.
    its.nearer.value = perMm * size * (ahead ? 0.002 * (9 - width) : 0.0005);
    Object.assign(material, { transparent: !isFull || !depthTest, depthWrite: isFull, alphaToCoverage: isFull && depthTest });
    mesh.renderOrder = !depthTest ? 9 : layer === "floor" ? -2 : isFull ? 0 : -1;
    mesh.userData.layer = layer;
  }

  function place(mesh, segments) { // each of six coordinates
    const { geometry } = mesh;
    let buffer = geometry.getAttribute("from")?.data;
    if (!buffer || buffer.count < segments.length) {
      geometry.dispose();
      buffer = new THREE.InstancedInterleavedBuffer(new Float32Array(6 * Math.ceil(1 + 1.5 * segments.length)), 6).setUsage(THREE.DynamicDrawUsage);
      ["from", "to"].forEach((name, k) => geometry.setAttribute(name, new THREE.InterleavedBufferAttribute(buffer, 3, 3 * k)));
    }
    for (let k = 0; k < segments.length; k++) buffer.array.set(segments[k], 6 * k);
    buffer.needsUpdate = true;
    geometry.instanceCount = segments.length;
  }

  /** A mesh a stroke: one that had another stroke takes this over into its buffers. */
  function reconcile(meshes, wanted, front) {
    while (meshes.length > wanted.length) dispose(meshes.pop());
    wanted.forEach((stroke, k) => {
      if (k === meshes.length) world.add((meshes[k] = makeLines(front)));
      if (meshes[k].userData.stroke !== stroke) place(meshes[k], stroke.segments);
      meshes[k].userData.stroke = stroke;
      style(meshes[k], stroke);
    });
  }

  function makeSurface({ vertices, faces, edges, role, opacity, layer }) {
    const geometry = new THREE.BufferGeometry(), lines = makeLines(), isFull = opacity >= 1, isSolid = faces.length < 1000;
    const material = new THREE.MeshLambertMaterial({ flatShading: isSolid, side: THREE.DoubleSide, transparent: !isFull, depthWrite: isFull, opacity });
    const mesh = new THREE.Mesh(geometry, Object.assign(material, { color: colourOf(role) }));
    box.setFromArray(vertices.flat()).getCenter(mesh.position); // far ones are drawn first
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(vertices.flat(), 3));
    geometry.translate(-mesh.position.x, -mesh.position.y, -mesh.position.z);
    geometry.setIndex(faces.flatMap((face) => face.slice(2).flatMap((last, k) => [face[0], face[k + 1], last])));
    if (!isSolid) geometry.computeVertexNormals(); // it is smooth, such as the boundary of a region
    mesh.castShadow = isSolid;
    style(lines, { role, width: 1.2, layer });
    place(lines, edges.map(([a, b]) => [...vertices[a], ...vertices[b]]));
    return Object.assign(new THREE.Group().add(mesh, lines), { userData: { layer } });
  }

  function dispose(object) {
    object.removeFromParent();
    object.traverse(({ geometry, material }) => [geometry, material].forEach((part) => part?.dispose()));
  }

  // What is drawn.
  function update(parts) {
    data = { ...data, ...parts };
    bound();
    for (const [surface, group] of surfaces)
      if (!data.surfaces.includes(surface)) {
        dispose(group);
        surfaces.delete(surface);
      }
    for (const surface of data.surfaces) if (!surfaces.has(surface)) surfaces.set(surface, makeSurface(surface));
    world.add(...surfaces.values());
    reconcile(strokes, data.strokes, false);
    redraw();
  }

  /** What must be in the picture; the camera, the light and the floor go by it. */
  function bound() {
    const reach = box.setFromArray(data.platform.vertices.flat()).getSize(point).toArray().map((v) => v / 2);
    const every = Math.max(1, Math.floor(data.moments.length / 20));
    seen = [
      ...data.surfaces.flatMap((surface) => surface.vertices),
      ...data.strokes.filter((s) => !UNFITTED.includes(s.layer)).flatMap((s) => s.segments.flatMap((b) => [b.slice(0, 3), b.slice(3)])),
      ...data.labels.map((label) => label.at),
      ...data.moments.filter((_, k) => k % every === 0).flatMap(({ p }) => [-1, 1].map((sign) => p.map((v, k) => v + sign * reach[k]))),
    ];
    names = data.surfaces.filter((surface) => surface.name).map(({ name, layer, vertices }) => {
      const top = Math.max(...vertices.map((v) => v[2])), upper = vertices.filter((v) => v[2] > top - 0.01);
      return { layer, text: name, at: box.setFromArray(upper.flat()).getCenter(point).toArray() };
    });
    size = box.setFromArray(seen.flat()).getSize(point).length();
    box.getCenter(centre);
    distance = 2.2 * size;
    perMm = 1 / distance; // of depth as the graphics card counts it, at the centre
    lamp.target.position.copy(centre);
    lamp.position.set(-0.25, -0.35, 1).multiplyScalar(size).add(centre);
    Object.assign(lamp.shadow.camera, { left: -size / 2, right: size / 2, top: size / 2, bottom: -size / 2, near: 0.1 * size, far: 2.5 * size }).updateProjectionMatrix();
    const ground = data.strokes.find((stroke) => stroke.layer === "floor")?.segments.flat() ?? [];
    floor.material.visible = ground.length > 0;
    if (ground.length) {
      box.setFromArray(ground).getCenter(floor.position);
      box.getSize(floor.scale).setZ(1);
    }
    turned = true;
  }

  /** Everything fits at every angle and size of the window; zooming in goes beyond that. */
  function aim() {
    turned = false;
    const a = (eye.azimuth * Math.PI) / 180, e = (eye.elevation * Math.PI) / 180;
    camera.position.set(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)).multiplyScalar(distance).add(centre);
    camera.lookAt(centre);
    camera.updateMatrixWorld();
    let left = Infinity, right = -Infinity, low = Infinity, high = -Infinity;
    for (const v of seen) {
      point.fromArray(v).applyMatrix4(camera.matrixWorldInverse).multiplyScalar(distance / Math.max(-point.z, 0.05 * distance));
      left = Math.min(left, point.x);
      right = Math.max(right, point.x);
      low = Math.min(low, point.y);
      high = Math.max(high, point.y);
    }
    const scale = eye.zoom * Math.min((pane.width - 2 * MARGIN) / (right - left), (pane.height - 2 * MARGIN) / (high - low));
    const x = (left + right) / 2, y = (low + high) / 2, wide = pane.width / 2 / scale, tall = pane.height / 2 / scale, near = 0.4;
    camera.projectionMatrix.makePerspective(...[x - wide, x + wide, y + tall, y - tall].map((v) => near * v), near * distance, 2 * distance);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  // The platform and its cables.
  const cables = data.anchors.map(() => Object.assign(makeLines(), { segment: [[0, 0, 0, 0, 0, 0]], tint: new THREE.Color() }));
  const platform = makeSurface(data.platform);
  platform.matrixAutoUpdate = false;
  robot.add(platform, ...cables).userData.layer = "robot";

  function placeRobot() {
    const { r, p, exits, tensions } = now, [low, high] = data.tension_limits || [0, 1];
    platform.matrix.set(r[0], r[1], r[2], p[0], r[3], r[4], r[5], p[1], r[6], r[7], r[8], p[2], 0, 0, 0, 1);
    cables.forEach((cable, i) => {
      const [segment] = cable.segment, tension = tensions?.[i] ?? null;
      const [from, to, at] = tension === null ? ["cable", "cable", 0] : tensionMix((tension - low) / (high - low));
      const beyond = from === "limit";
      exits[i].forEach((v, k) => (segment[k] = v));
      point.fromArray(data.anchors[i]).applyMatrix4(platform.matrix).toArray(segment, 3);
      place(cable, cable.segment);
      style(cable, { role: from, width: tension === null ? 2 : beyond ? 3.4 : 2.4, dash: beyond ? [5] : null, layer: "robot" });
      cable.material.uniforms.colour.value = cable.tint.lerpColors(colourOf(from), colourOf(to), at);
    });
  }

  function draw() {
    waiting = false;
    if (!(pane.width > 0 && pane.height > 0)) return;
    if (turned) aim();
    if (now) placeRobot();
    reconcile(ownStrokes, now?.strokes ?? [], true);
    for (const object of world.children) if (object.userData.layer) object.visible = shown(object.userData.layer) && (object !== robot || now !== null);
    renderer.render(world, camera);
    writeTexts();
  }

  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(draw);
  }

  // Texts keep their size: elements over the canvas.
  const texts = document.createElement("div");
  Object.assign(texts, { className: "texts", ariaHidden: "true" });
  canvas.after(texts);
  const ruler = document.createElement("canvas").getContext("2d");
  ruler.font = "600 12px system-ui, sans-serif";
  const taken = []; // where marks and texts are already: [left, right, base]

  /** All texts, the most important first: of two that overlap, the later one moves by some lines or is left out. */
  function writeTexts() {
    const words = [];
    const add = (layer, text, at, mark = "") => shown(layer) && words.push({ text, mark, ...pixelOf(at) });
    for (const list of [data.labels, now?.labels ?? []]) for (const { layer, text, at, mark } of list) add(layer, text, point.fromArray(at), mark);
    if (robot.visible) cables.forEach(({ segment: [s] }, i) => add("numbers", String(i + 1), point.fromArray(s).lerp({ x: s[3], y: s[4], z: s[5] }, 0.25)));
    for (const { layer, text, at } of names) add(layer, text, point.fromArray(at));
    taken.length = 0;
    for (const { mark, x, y } of words) if (mark) taken.push([x - 4, x + 4, y + 5]);
    words.forEach(write);
    for (let k = words.length; k < texts.childElementCount; k++) texts.children[k].hidden = true;
  }

  function pixelOf(at) {
    at.project(camera);
    return { x: ((1 + at.x) * pane.width) / 2, y: ((1 - at.y) * pane.height) / 2, isIn: Math.abs(at.x) <= 1 && Math.abs(at.y) <= 1 };
  }

  function write({ text, mark, x, y, isIn }, k) {
    const sign = texts.children[k] ?? texts.appendChild(document.createElement("span"));
    const word = sign.firstChild ?? sign.appendChild(document.createElement("b"));
    sign.hidden = !isIn;
    if (!isIn) return;
    if (word.textContent !== text) {
      word.textContent = text;
      sign.wide = ruler.measureText(text).width;
    }
    const { wide } = sign;
    const found = mark ? free(x + 9, y - 7, wide) ?? free(x - 9 - wide, y - 7, wide) : free(x - wide / 2, y + 4, wide);
    sign.className = mark;
    sign.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    word.hidden = !found; // its mark stays
    if (!found) return;
    const [left, base] = found;
    word.style.transform = `translate(${(left - x).toFixed(1)}px, ${(base - 11 - y).toFixed(1)}px)`;
  }

  /** A free position in the picture, up to some lines higher or lower; null without one. */
  function free(wanted, base, wide) {
    const left = Math.max(3, Math.min(wanted, pane.width - wide - 3));
    const isFree = (at) => at > LINE && at < pane.height - 3 && taken.every(([l, r, b]) => left + wide + 4 < l || left > r + 4 || Math.abs(at - b) >= LINE);
    const at = [0, -1, 1, -2, 2, -3, 3].map((lines) => base + lines * LINE).find(isFree);
    if (at === undefined) return null;
    taken.push([left, left + wide, at]);
    return [left, at];
  }

  // What a pointer and keys do.
  function zoom(factor) {
    eye.zoom = Math.min(Math.max(eye.zoom * factor, 0.4), 8);
    turned = true;
    redraw();
  }

  function turn(azimuth, elevation) {
    eye.azimuth += azimuth;
    eye.elevation = Math.min(Math.max(eye.elevation + elevation, -89), 89);
    turned = true;
    redraw();
  }

  function pick(x, y, level) { // along the ray from the eye through a pixel
    if (turned) aim();
    point.set((2 * x) / pane.width - 1, 1 - (2 * y) / pane.height, 0).unproject(camera).sub(camera.position);
    const share = (level - camera.position.z) / point.z;
    return share > 0 && share < 20 * distance ? point.multiplyScalar(share).add(camera.position).setZ(level).toArray() : null;
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

  canvas.addEventListener("webglcontextrestored", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", readColours);
  addEventListener("beforeprint", draw);
  const exact = "devicePixelContentBoxSize" in ResizeObserverEntry.prototype;
  new ResizeObserver(([{ contentRect, devicePixelContentBoxSize: exactly }]) => {
    const { width, height } = contentRect;
    const [w, h] = exactly ? [exactly[0].inlineSize, exactly[0].blockSize] : [width, height].map((v) => Math.round(v * devicePixelRatio));
    Object.assign(pane, { width, height });
    renderer.setSize(w, h, false);
    view.value.set(width, height);
    ratio.value = w / width || 1;
    turned = true;
    draw(); // at once: the new size has cleared the canvas
  }).observe(canvas, exact ? { box: "device-pixel-content-box" } : {});
  readColours();
  update({});
  const info = context.getExtension("WEBGL_debug_renderer_info");
  const drawnBy = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return {
    isSoftware: /swiftshader|llvmpipe|softpipe|software|basic render/i.test(drawnBy),
    update, zoom, redraw, pick,
    size: () => size, // diagonal of all that is fitted into the picture, [mm]
    show: (moment) => {
      now = moment;
      redraw();
    },
    reset: () => {
      Object.assign(eye, first);
      turn(0, 0);
    },
  };
}

/** Says so in the scene's place; everything else on the page continues. */
function withoutWebGL(canvas) {
  const text = document.createElement("p");
  text.className = "without";
  text.textContent = "The 3-D scene needs WebGL 2, which this browser lacks or has switched off.";
  canvas.hidden = true;
  canvas.after(text);
  const nothing = () => {};
  return { isSoftware: false, update: nothing, zoom: nothing, redraw: nothing, show: nothing, reset: nothing, pick: () => null, size: () => 0 };
}
