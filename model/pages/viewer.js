"use strict";
/* A scene of scene.py by three.js (`THREE`): drag to turn, two fingers or Ctrl and wheel to zoom.

sceneViewer(canvas, data, shown) draws `data` (scene_data); `shown(layer)` says what is drawn. It returns
  show(moment)     the platform at a moment, or none (null); with `tensions` cables take their colours; `strokes`
                   and `labels` of its own are drawn in front of everything, and never change the view;
  update(parts)    other surfaces, strokes, labels or moments, kept in view;
  zoom(factor), reset(), redraw(), size() in mm;
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

function sceneViewer(canvas, data, shown = () => true) {
  const MARGIN = 24; // px, for texts beside points
  const LINE = 14; // height of a text, px
  const UNFITTED = ["tree", "trail", "pick"]; // layers that may lie outside the picture
  const context = globalThis.THREE && canvas.getContext("webgl2", { alpha: false, antialias: true });
  if (!context) return withoutWebGL(canvas);

  THREE.ColorManagement.enabled = false; // colours are those of the page
  const renderer = new THREE.WebGLRenderer({ canvas, context });
  renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
  renderer.shadowMap.enabled = true;
  const world = new THREE.Scene(), camera = new THREE.Camera();
  const lamp = new THREE.DirectionalLight("white", 0.3 * Math.PI), sky = new THREE.HemisphereLight("white", "#a8aeb8", 0.84 * Math.PI);
  const floor = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), new THREE.ShadowMaterial({ depthWrite: false }));
  const fixed = new THREE.Group(), robot = new THREE.Group();
  Object.assign(floor, { receiveShadow: true, renderOrder: -3 });
  lamp.castShadow = true;
  lamp.shadow.radius = 6;
  lamp.shadow.mapSize.set(1024, 1024);
  sky.position.set(0, 0, 1);
  camera.up.set(0, 0, 1);
  world.add(lamp, lamp.target, sky, floor, fixed, robot);

  const first = { azimuth: data.view.azimuth, elevation: data.view.elevation, zoom: 1 };
  const eye = { ...first };
  const pane = { width: 0, height: 0 }; // of the canvas, CSS px
  const uniforms = { view: { value: new THREE.Vector2() }, ratio: { value: 1 } }; // of all lines
  const point = new THREE.Vector3(), centre = new THREE.Vector3();
  const surfaces = new Map(), strokes = [], ownStrokes = []; // what was made of the data
  let seen = [], size = 1, distance = 1, perMm = 0; // of what is drawn; set by `update`
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

  // Lines.
  function makeLines(front = false) {
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setIndex([0, 2, 1, 1, 2, 3]);
    geometry.setAttribute("corner", new THREE.BufferAttribute(new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]), 2));
    const material = new THREE.ShaderMaterial({
      vertexShader: LINE_VERTEX, fragmentShader: LINE_FRAGMENT, side: THREE.DoubleSide, depthTest: !front, alphaToCoverage: true,
      uniforms: {
        ...uniforms, colour: { value: null }, dash: { value: new THREE.Vector2() },
        width: { value: 1 }, opacity: { value: 1 }, nearer: { value: 0 }, cap: { value: 1 },
      },
    });
    return Object.assign(new THREE.Mesh(geometry, material), { frustumCulled: false, renderOrder: front ? 9 : 0 });
  }

  function style(mesh, { role, width, opacity = 1, dash, ahead, layer }) {
    const { material } = mesh, { value: pattern } = material.uniforms.dash, solid = opacity >= 1;
    pattern.set(dash?.[0] ?? 0, dash?.[1] ?? dash?.[0] ?? 0);
    material.uniforms.colour.value = colourOf(role);
    material.uniforms.width.value = width;
    material.uniforms.opacity.value = opacity;
    material.uniforms.cap.value = solid && !pattern.x ? 1 : 0;
    // A little nearer than it is, thin lines most: on the same track they cover the wide ones.
    material.uniforms.nearer.value = perMm * size * (ahead ? 0.002 * (9 - width) : 0.0005);
    if (material.depthTest) {
      Object.assign(material, { transparent: !solid, depthWrite: solid, alphaToCoverage: solid });
      mesh.renderOrder = layer === "floor" ? -2 : solid ? 0 : -1;
    } else Object.assign(material, { transparent: true, alphaToCoverage: false });
    mesh.userData.layer = layer;
  }

  function place(mesh, segments) { // each of six coordinates
    const { geometry } = mesh;
    let buffer = geometry.getAttribute("from")?.data;
    if (!buffer || buffer.count < segments.length) {
      geometry.dispose();
      buffer = new THREE.InstancedInterleavedBuffer(new Float32Array(6 * Math.max(8, 1.5 * segments.length | 0)), 6);
      buffer.setUsage(THREE.DynamicDrawUsage);
      geometry.setAttribute("from", new THREE.InterleavedBufferAttribute(buffer, 3, 0));
      geometry.setAttribute("to", new THREE.InterleavedBufferAttribute(buffer, 3, 3));
    }
    for (let k = 0; k < segments.length; k++) buffer.array.set(segments[k], 6 * k);
    buffer.needsUpdate = true;
    geometry.instanceCount = segments.length;
  }

  /** As many meshes as strokes; those whose stroke is another one take it over, with their buffers. */
  function reconcile(meshes, wanted, front) {
    while (meshes.length > wanted.length && !front) dispose(meshes.pop());
    wanted.forEach((stroke, k) => {
      const mesh = (meshes[k] ??= makeLines(front));
      if (!mesh.parent) world.add(mesh);
      if (mesh.userData.stroke !== stroke) place(mesh, stroke.segments);
      mesh.userData.stroke = stroke;
      style(mesh, stroke);
    });
    for (const rest of meshes.slice(wanted.length)) rest.userData.stroke = rest.userData.layer = null;
  }

  // Surfaces: faces with light, and edges.
  function makeSurface({ vertices, faces, edges, role, opacity, layer }) {
    const group = new THREE.Group(), lines = makeLines();
    const middle = [0, 1, 2].map((k) => vertices.reduce((sum, v) => sum + v[k], 0) / vertices.length); // by which far ones come first
    const corners = faces.flatMap((face) => face.slice(2).flatMap((last, k) => [face[0], face[k + 1], last]));
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(vertices.flatMap((v) => v.map((c, k) => c - middle[k])), 3));
    geometry.setIndex(corners);
    const material = new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide, transparent: opacity < 1, depthWrite: opacity >= 1, opacity });
    material.color = colourOf(role);
    const mesh = new THREE.Mesh(geometry, material);
    mesh.position.fromArray(middle);
    mesh.castShadow = true;
    style(lines, { role, width: 1.2, layer });
    place(lines, edges.map(([a, b]) => [...vertices[a], ...vertices[b]]));
    group.userData.layer = layer;
    return group.add(mesh, lines);
  }

  function dispose(object) {
    object.removeFromParent();
    object.traverse(({ geometry, material }) => {
      geometry?.dispose();
      material?.dispose();
    });
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
    fixed.add(...surfaces.values());
    reconcile(strokes, data.strokes, false);
    redraw();
  }

  /** What must be in the picture; the camera, the light and the floor go by it. */
  function bound() {
    const reach = [0, 1, 2].map((k) => Math.max(...data.platform.vertices.map((v) => Math.abs(v[k]))));
    const every = Math.max(1, Math.floor(data.moments.length / 20));
    seen = [
      ...data.surfaces.flatMap((surface) => surface.vertices),
      ...data.strokes.filter((s) => !UNFITTED.includes(s.layer)).flatMap((s) => s.segments.flatMap((b) => [b.slice(0, 3), b.slice(3)])),
      ...data.labels.map((label) => label.at),
      ...data.moments.filter((_, k) => k % every === 0).flatMap(({ p }) => [-1, 1].map((sign) => p.map((v, k) => v + sign * reach[k]))),
    ];
    const box = new THREE.Box3().setFromArray(seen.flat());
    box.getCenter(centre);
    size = box.getSize(point).length();
    distance = 2.2 * size;
    perMm = (2 * 0.4 * 2) / (1.6 * distance); // of depth as the graphics card counts it, at the centre
    lamp.target.position.copy(centre);
    lamp.position.set(-0.25, -0.35, 1).multiplyScalar(size).add(centre);
    Object.assign(lamp.shadow.camera, { left: -size / 2, right: size / 2, top: size / 2, bottom: -size / 2, near: 0.1 * size, far: 2.5 * size });
    lamp.shadow.camera.updateProjectionMatrix();
    const ground = data.strokes.find((stroke) => stroke.layer === "floor" && stroke.segments.length);
    floor.userData.layer = ground ? "floor" : null;
    if (ground) {
      box.setFromArray(ground.segments.flat());
      box.getCenter(floor.position);
      floor.scale.set(...box.getSize(point).setZ(1).toArray());
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
  robot.add(platform, ...cables);
  robot.userData.layer = "robot";

  function placeRobot() {
    const { r, p, exits, tensions } = now, [low, high] = data.tension_limits || [0, 1];
    platform.matrix.set(r[0], r[1], r[2], p[0], r[3], r[4], r[5], p[1], r[6], r[7], r[8], p[2], 0, 0, 0, 1);
    cables.forEach((cable, i) => {
      const [segment] = cable.segment, { uniforms: its } = cable.material, tension = tensions?.[i] ?? null;
      for (let k = 0; k < 3; k++) segment[k] = exits[i][k];
      point.fromArray(data.anchors[i]).applyMatrix4(platform.matrix).toArray(segment, 3);
      place(cable, cable.segment);
      const [from, to, at] = tension === null ? ["cable", "cable", 0] : tensionMix((tension - low) / (high - low));
      const beyond = from === "limit";
      its.colour.value = cable.tint.lerpColors(colourOf(from), colourOf(to), at);
      its.width.value = tension === null ? 2 : beyond ? 3.4 : 2.4;
      its.dash.value.setScalar(beyond ? 5 : 0);
      its.cap.value = beyond ? 0 : 1;
    });
  }

  function draw() {
    waiting = false;
    if (!(pane.width > 0 && pane.height > 0)) return;
    if (turned) aim();
    if (now) placeRobot();
    reconcile(ownStrokes, now?.strokes ?? [], true);
    for (const { children } of [world, fixed])
      for (const object of children) if (object !== fixed && !object.isLight) object.visible = object.userData.layer !== null && shown(object.userData.layer);
    robot.visible &&= now !== null;
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
  const written = []; // where texts stand already: [left, right, base]

  function writeTexts() {
    written.length = 0;
    for (const { layer, text, at, mark } of data.labels) if (shown(layer)) write(text, point.fromArray(at), mark);
    for (const { layer, text, at, mark } of now?.labels ?? []) if (shown(layer)) write(text, point.fromArray(at), mark);
    for (const { name, layer, vertices } of data.surfaces)
      if (name && shown(layer)) write(name, above(vertices));
    if (shown("numbers") && robot.visible)
      cables.forEach(({ segment: [s] }, i) => write(String(i + 1), point.fromArray(s).lerp({ x: s[3], y: s[4], z: s[5] }, 0.25)));
    for (let k = written.length; k < texts.childElementCount; k++) texts.children[k].hidden = true;
  }

  function above(vertices) { // the middle of the uppermost vertices
    const top = Math.max(...vertices.map((v) => v[2])), upper = vertices.filter((v) => v[2] > top - 0.01);
    return point.set(...[0, 1, 2].map((k) => upper.reduce((sum, v) => sum + v[k], 0) / upper.length));
  }

  function write(text, at, mark = "") {
    at.project(camera);
    const x = ((1 + at.x) * pane.width) / 2, y = ((1 - at.y) * pane.height) / 2;
    const sign = texts.children[written.length] ?? texts.appendChild(document.createElement("span"));
    const word = sign.firstChild ?? sign.appendChild(document.createElement("b"));
    if (word.textContent !== text) {
      word.textContent = text;
      sign.wide = ruler.measureText(text).width;
    }
    const wide = sign.wide, [left, base] = free(mark ? x + 9 : x - wide / 2, mark ? y - 7 : y + 4, wide);
    sign.hidden = !(x > -LINE && x < pane.width + LINE && y > -LINE && y < pane.height + LINE);
    sign.className = mark;
    sign.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    word.style.transform = `translate(${(left - x).toFixed(1)}px, ${(base - 11 - y).toFixed(1)}px)`;
  }

  function free(left, base, wide) { // within the picture, and beside what is written there already: some lines up or down
    const start = Math.max(3, Math.min(left, pane.width - wide - 3));
    const isFree = (at) => at > LINE && at < pane.height - 3 && written.every(([l, r, b]) => start + wide < l || start > r || Math.abs(at - b) >= LINE);
    const at = [0, -LINE, LINE, -2 * LINE, 2 * LINE].map((off) => base + off).find(isFree) ?? base;
    written.push([start, start + wide, at]);
    return [start, at];
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
    uniforms.view.value.set(width, height);
    uniforms.ratio.value = w / width || 1;
    turned = true;
    draw(); // at once: the new size has cleared the canvas
  }).observe(canvas, exact ? { box: "device-pixel-content-box" } : {});
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
      turn(0, 0);
    },
  };
}

/** Says so in the scene's place; whatever else the page has goes on. */
function withoutWebGL(canvas) {
  const text = document.createElement("p");
  text.className = "without";
  text.textContent = "The 3-D scene needs WebGL 2, which this browser lacks or has switched off.";
  canvas.hidden = true;
  canvas.after(text);
  const nothing = () => {};
  return { update: nothing, zoom: nothing, redraw: nothing, show: nothing, reset: nothing, pick: () => null, size: () => 0 };
}
