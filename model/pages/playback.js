"use strict";
/* The scene of a page of its own: a slider and a button for the time, the layers' boxes, the view's buttons. */
(async () => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const data = read("scene-data");
  const canvas = document.getElementById("scene-canvas");
  const slider = document.getElementById("scene-time");
  const play = document.getElementById("scene-play");
  const speed = document.getElementById("scene-speed");
  const readout = document.getElementById("scene-readout");
  const boxes = [...document.querySelectorAll("[data-layer]")];
  document.documentElement.classList.add("scripted");
  await unpack(read("three").gzip).catch(() => {}); // without it the viewer says what is missing
  const view = sceneViewer(canvas, data, (layer) => boxes.every((box) => box.dataset.layer !== layer || box.checked));
  let now = 0;
  let playing = false;
  let before = 0;
  let clock = 0;

  /** Runs a packed script, which sets `THREE`. */
  async function unpack(packed) {
    const bytes = new Blob([Uint8Array.from(atob(packed), (sign) => sign.charCodeAt(0))]);
    const script = document.createElement("script");
    script.textContent = await new Response(bytes.stream().pipeThrough(new DecompressionStream("gzip"))).text();
    document.head.append(script);
  }

  function show(index) {
    now = Math.min(Math.max(index, 0), data.moments.length - 1);
    const moment = data.moments[now];
    slider.value = String(now);
    slider.setAttribute("aria-valuetext", `${moment.t.toFixed(1)} seconds`);
    readout.textContent = `${moment.t.toFixed(1)} s · ${moment.p.map((v) => v.toFixed(0)).join(", ")} mm${moment.text ? " · " + moment.text : ""}`;
    view.show(moment);
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

  canvas.addEventListener("keydown", (event) => {
    if (event.key !== " ") return;
    event.preventDefault();
    setPlaying(!playing);
  });
  document.getElementById("scene-in").addEventListener("click", () => view.zoom(1.25));
  document.getElementById("scene-out").addEventListener("click", () => view.zoom(0.8));
  document.getElementById("scene-reset").addEventListener("click", view.reset);
  play.addEventListener("click", () => setPlaying(!playing));
  slider.addEventListener("input", () => {
    setPlaying(false);
    show(Number(slider.value));
  });
  for (const box of boxes) box.addEventListener("change", view.redraw);
  if (data.moments.length) show(now);
  else play.disabled = slider.disabled = true;
})();
