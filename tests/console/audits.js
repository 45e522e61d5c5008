/* Checks of the whole page: an object of functions that return errors or findings as texts. */
({
  nameOf(e) {
    return e.id || e.getAttribute("aria-label") || e.textContent.trim();
  },

  shown(selector) {
    return [...document.querySelectorAll(selector)].filter((e) => e.checkVisibility());
  },

  /** Controls that can be used now, by mouse or keyboard. */
  usable() {
    return this.shown("button, input, select, a, canvas[tabindex], summary")
      .filter((e) => !e.disabled && !e.closest("[inert]") && !e.getAttribute("aria-disabled"))
      .map(this.nameOf);
  },

  /** Controls that Tab must reach: one of each group of tabs or radio buttons; arrow keys reach the others. */
  tabbable() {
    return this.shown("button, input, select, canvas[tabindex], summary, a")
      .filter((e) => !e.disabled && e.type !== "radio" && e.role !== "tab")
      .map(this.nameOf);
  },

  unnamed() {
    return this.shown("button, input, select, canvas[tabindex], [role=group], [role=tabpanel]")
      .filter((e) => !["aria-label", "aria-labelledby"].some((name) => e.getAttribute(name)))
      .filter((e) => !e.labels?.length && !e.textContent.trim())
      .map((e) => e.outerHTML);
  },

  /** Controls too small for a finger. */
  small() {
    return this.shown("button, input[type=text], .choices label")
      .filter((e) => e.getBoundingClientRect().height < 43.5 || e.getBoundingClientRect().width < 40)
      .map(this.nameOf);
  },

  /** Parts of the live view that reach into each other or beyond their own edge, and what the head hides. */
  overlapping() {
    const box = (e) => e.getBoundingClientRect();
    const meet = (a, b) => a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
    const found = [], parts = this.shown("#scene, #tension, #curves, #news, #simulated, .lamps, #rig");
    for (const [k, one] of parts.entries()) {
      for (const other of parts.slice(k + 1)) {
        const isLive = [one, other].every((e) => e.closest("#live")) || [one, other].every((e) => e.closest("#top"));
        if (isLive && meet(box(one), box(other))) found.push(`${this.nameOf(one)} and ${this.nameOf(other)}`);
      }
    }
    for (const row of this.shown("#tensions li")) {
      const [inner, outer] = [box(row), box(document.getElementById("tension"))];
      if (inner.right > outer.right || inner.bottom > outer.bottom) found.push(`row ${row.textContent}`);
    }
    const simulated = document.getElementById("simulated");
    if (simulated.scrollWidth > simulated.clientWidth + 1 || box(simulated).right > innerWidth || box(simulated).width < 50) found.push("simulated drives");
    return [...found, ...(document.documentElement.scrollWidth > innerWidth ? ["scrolls sideways"] : [])];
  },

  /** Texts that do not fit in their element. */
  cut() {
    return this.shown("button, .tiles dt, .tiles dd, .lamps span, #stop-words, #tensions .value, #jog-said, #cable-said")
      .filter((e) => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1)
      .map(this.nameOf);
  },

  /** Texts with less contrast than WCAG 2.2 asks for at level AA (1.4.3); disabled controls are exempt. */
  weak() {
    const parse = (colour) => colour.match(/[\d.]+/g).map(Number);
    const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    const luminance = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
    const behind = (e) => {
      for (; e; e = e.parentElement) {
        const colour = parse(getComputedStyle(e).backgroundColor);
        if ((colour[3] ?? 1) > 0.99) return colour;
      }
      return [255, 255, 255];
    };
    const exempt = "[aria-disabled=true], :disabled, label:has(:disabled), .unseen, canvas, option, .uplot";
    return this.shown("body *").flatMap((e) => {
      const text = [...e.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
      if (!text || e.closest(exempt)) return [];
      const style = getComputedStyle(e), size = parseFloat(style.fontSize);
      const needed = size >= 24 || (size >= 18.66 && style.fontWeight >= 700) ? 3 : 4.5;
      const [low, high] = [luminance(parse(e instanceof SVGElement ? style.fill : style.color)), luminance(behind(e))].sort((a, b) => a - b);
      const ratio = (high + 0.05) / (low + 0.05);
      return ratio < needed ? [`${this.nameOf(e)}: ${ratio.toFixed(2)}`] : [];
    });
  },
})
