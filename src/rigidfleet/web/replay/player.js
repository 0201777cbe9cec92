// The page around the picture: timeline, speed, cameras, plots, keys.

import { Renderer } from "./gl.js";
import { CAMERAS, LEAST_EFFORT, Scene, offSlot, tensionColour } from "./scene.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8, 16];
const KEYS = [
  ["space", "play or pause"],
  ["← →", "back or forward by 1 s; with Shift by 0.1 s"],
  ["[ ]", "previous or next phase"],
  ["Home End", "go to the start or end"],
  ["− +", "slower or faster"],
  ["1 2 3", "camera: follow the formation, whole flight, from above (north up)"],
  ["p", "show or hide the panel"],
  ["?", "show this list"],
  ["drag", "rotate the view; with Shift or the right button, move it"],
  ["wheel", "zoom; on a touch screen, use two fingers"],
];
const SHOWN = { edges: "edges", trails: "trails", slots: "slots", axes: "body axes", names: "names", areas: "fences, falls" };
const ALERT = "#b00020";
const SLOW = 1 / 31; // seconds per picture above which the resolution is lowered

export const part = (id) => document.getElementById(id);

export function element(tag, parent, attributes = {}, text = "") {
  const made = parent.appendChild(document.createElement(tag));
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text) made.textContent = text;
  return made;
}

/** A number with three digits and no exponent. */
export function digits(x) {
  const size = Math.abs(x);
  return x.toFixed(size >= 99.95 ? 0 : size >= 9.995 ? 1 : 2).replace("-", "−");
}

function withUnit(x, unit) {
  if (!Number.isFinite(x)) return "–";
  if (x === 0) return `0 ${unit}`;
  const size = Math.abs(x);
  if (unit !== "m" || size >= 0.0995) return `${digits(x)} ${unit}`;
  if (size >= 0.000995) return `${digits(1000 * x)} mm`;
  return size > 1.5e-6 ? `${digits(1e6 * x)} µm` : "≤ 1 µm";
}

// -- time -----------------------------------------------------------------------------------------------

/** Round times between two times, at most a given number. */
function roundTimes(first, last, most) {
  const least = (last - first) / Math.max(most, 1), power = Math.pow(10, Math.floor(Math.log10(least)));
  if (!(least > 0)) return [first];
  const step = power * [1, 2, 5, 10].find((k) => k * power >= least * (1 - 1e-9)), found = [];
  for (let k = Math.ceil(first / step - 1e-6); k * step <= last + 1e-6 * step; k++) found.push(k * step);
  return found;
}

/** Time labels along a line. */
class TimeAxis {
  /** A label takes about `room` pixels. */
  constructor(box, room) {
    this.box = box;
    this.room = room;
  }

  /** Write round times from the first to the last; return them. */
  draw(first, last) {
    const { box } = this, wide = box.clientWidth, times = roundTimes(first, last, wide / this.room);
    const spans = times.map((time, k) => {
      const span = document.createElement("span"), share = last > first ? (time - first) / (last - first) : 0;
      span.textContent = `${Number(time.toFixed(3))}${k === times.length - 1 ? " s" : ""}`;
      span.style.left = `${100 * share}%`;
      // Labels at the ends stay inside.
      if (share * wide < 14) span.className = "first";
      else if ((1 - share) * wide < 14) span.className = "last";
      return span;
    });
    box.replaceChildren(...spans);
    return times;
  }
}

// -- plots ----------------------------------------------------------------------------------------------

/**
 * A plot of one quantity over time: `plot` {title, unit, column, colours, worst, limits, least, log, floor}. Each line has
 * a colour and a limit, which is null if there is none.
 */
class Plot {
  constructor(parent, plot, recording, seek) {
    this.plot = plot;
    this.recording = recording;
    const box = element("div", parent, { class: "plot" }), header = element("header", box);
    element("h2", header, {}, plot.title);
    this.value = element("output", header);
    const frame = element("div", box, { class: "frame" }), scale = element("div", frame, { class: "scale" });
    this.ends = [element("span", scale), element("span", scale)]; // beside the lines, never over them
    this.area = element("div", frame, { class: "area", title: "Click to go to this time" });
    this.canvas = element("canvas", this.area);
    this.cursor = element("div", this.area, { class: "cursor" });
    const go = (event) => seek(Math.max(0, Math.min(event.offsetX / this.area.clientWidth, 1)));
    this.area.addEventListener("pointerdown", (event) => {
      this.area.setPointerCapture(event.pointerId);
      go(event);
    });
    this.area.addEventListener("pointermove", (event) => event.buttons && go(event));
  }

  /** Samples of all lines: the least and greatest of each interval that falls on one pixel. */
  stretch(first, last, pixels, visit) {
    const { plot, recording } = this, data = recording.columns[plot.column], width = recording.widths[plot.column];
    for (let line = 0; line < width; line++) {
      const points = [];
      for (let x = 0; x < pixels; x++) {
        const a = first + Math.floor((x / pixels) * (last - first + 1));
        const b = Math.max(a + 1, first + Math.floor(((x + 1) / pixels) * (last - first + 1)));
        let low = Infinity, high = -Infinity;
        for (let k = a; k < Math.min(b, last + 1); k++) {
          const y = data[k * width + line];
          if (y < low) low = y;
          if (y > high) high = y;
        }
        if (low <= high) points.push([x, low, high]);
      }
      visit(line, points);
    }
  }

  /** Limits drawn, {value, colour}: one for each line in its colour, or one for all. */
  get limits() {
    const { limits, colours } = this.plot, known = limits.filter((limit) => limit !== null);
    if (known.every((limit) => limit === known[0])) return known.slice(0, 1).map((value) => ({ value, colour: ALERT }));
    return limits.map((value, line) => ({ value, colour: colours[line % colours.length] })).filter(({ value }) => value !== null);
  }

  /** Draw the samples from the first to the last, over marks at shares of the width. */
  draw(first, last, marks = []) {
    const { plot, canvas, area } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = area.clientWidth, height = area.clientHeight;
    if (!width || last < first) return;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const lines = [], values = [];
    this.stretch(first, last, Math.floor(width), (line, points) => {
      lines.push([line, points]);
      for (const [, low, high] of points) values.push(low, high);
    });
    let low = Math.min(...values), high = Math.max(...values);
    if (!(low <= high)) return;
    const y = plot.log ? (v) => Math.log10(Math.max(v, plot.floor)) : (v) => v;
    if (plot.log) [low, high] = [y(low), Math.max(y(high), y(low) + 1)];
    else {
      // A limit is shown if the flight comes near it; with several limits, also one further away.
      const { limits } = this, near = Math.max(high + 1.5 * (high - low) + 1e-9, limits.length > 1 ? 3 * high : 0);
      for (const { value } of limits) if (value < near) high = Math.max(high, value);
      if (plot.least !== null && plot.least > low - 1.5 * (high - low) - 1e-9) low = Math.min(low, plot.least);
      if (low > 0 && low < 0.6 * high) low = 0;
      const least = 0.02 * Math.max(Math.abs(high), Math.abs(low), 1e-3);
      if (high - low < least) [low, high] = [low - least / 2, high + least / 2];
    }
    const place = (v) => 3 + (1 - (y(v) - low) / (high - low)) * (height - 6);
    pen.fillStyle = "rgb(255 255 255 / 70%)";
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = "#dde3e8";
    for (const share of marks) pen.fillRect(Math.round(share * (width - 1)), 0, 1, height);
    const bounds = plot.least === null ? this.limits : [...this.limits, { value: plot.least, colour: ALERT }];
    for (const { value, colour } of bounds) {
      if (place(value) < 0 || place(value) > height) continue;
      pen.strokeStyle = colour;
      pen.setLineDash([5, 3]);
      pen.beginPath();
      pen.moveTo(0, place(value));
      pen.lineTo(width, place(value));
      pen.stroke();
      pen.setLineDash([]);
    }
    if (plot.band) { // what the line may be, from the second to the third
      const [low, high] = lines.splice(1).map(([, points]) => points);
      pen.fillStyle = "rgb(11 98 168 / 28%)";
      pen.beginPath();
      low.forEach(([x, y]) => pen.lineTo(x, place(y)));
      high.reverse().forEach(([x, , y]) => pen.lineTo(x, place(y)));
      pen.fill();
    }
    for (const [line, points] of lines) {
      pen.strokeStyle = plot.colours[line % plot.colours.length];
      pen.lineWidth = 1.2;
      pen.beginPath();
      points.forEach(([x, a, b], k) => {
        const gap = k > 0 && x > points[k - 1][0] + 1;
        if (k === 0 || gap) pen.moveTo(x, place(a));
        else pen.lineTo(x, place(a));
        if (b > a) pen.lineTo(x, place(b));
      });
      pen.stroke();
    }
    [high, low].forEach((v, k) => (this.ends[k].textContent = withUnit(plot.log ? Math.pow(10, v) : v, plot.unit)));
  }

  point(share, state) {
    const { plot } = this, all = Array.from(state[plot.column]).slice(0, plot.band ? 1 : undefined), values = all.filter(Number.isFinite);
    this.cursor.style.transform = `translateX(${(share * this.area.clientWidth).toFixed(1)}px)`;
    const worst = values.length ? (plot.worst === "least" ? Math.min(...values) : Math.max(...values)) : NaN;
    const text = withUnit(plot.log ? Math.max(worst, plot.floor) : worst, plot.unit);
    if (this.value.textContent !== text) this.value.textContent = text;
    const limit = all.some((value, line) => plot.limits[line] !== null && value > plot.limits[line]), least = plot.least !== null && worst < plot.least;
    this.value.style.color = limit || least ? "var(--alert)" : "";
  }
}

// -- the player -----------------------------------------------------------------------------------------

export class Player {
  constructor(recording, renderer = new Renderer(part("view"))) {
    const { info } = recording;
    this.recording = recording;
    this.time = recording.start;
    this.playing = false;
    this.speed = 1;
    this.pictures = 0;
    this.stale = true;
    this.slow = 0;
    this.told = 0;
    this.scene = new Scene(renderer, part("labels"), recording);
    document.documentElement.classList.toggle("software", renderer.software);
    this.write(info);
    const go = (share) => this.seek(this.span()[0] + share * (this.span()[1] - this.span()[0]));
    this.plots = info.plots.map((plot) => new Plot(part("plots"), plot, recording, go));
    this.axes = { plots: new TimeAxis(part("moments"), 36), slider: new TimeAxis(part("times"), 55) };
    this.listen();
    this.resize();
    const changes = new ResizeObserver(() => this.resize());
    for (const box of [document.documentElement, part("bar")]) changes.observe(box);
    this.follow();
    requestAnimationFrame((now) => {
      this.last = now;
      this.frame(now);
    });
  }

  /** Text that does not change. */
  write(info) {
    part("name").textContent = info.name;
    part("title").textContent = info.title;
    this.writeStory(info);
    for (const speed of this.speeds()) element("option", part("speed"), { value: String(speed) }, `${speed}×`);
    part("speed").value = "1";
    for (const mode of CAMERAS) {
      const title = { follow: "Follow the formation (1)", overview: "Show the whole flight (2)", top: "View from above, north up (3)" }[mode];
      element("button", part("cameras"), { type: "button", title, "data-mode": mode }, mode[0].toUpperCase() + mode.slice(1))
        .addEventListener("click", () => this.look(mode));
    }
    for (const [name, text] of Object.entries(SHOWN)) {
      if (name === "areas" && !info.areas.length) continue;
      const label = element("label", part("show")), box = element("input", label, { type: "checkbox", "data-show": name });
      box.checked = this.scene.show[name];
      label.append(text);
      box.addEventListener("change", () => {
        this.scene.show[name] = box.checked;
        this.stale = true;
      });
    }
    if (info.edges.length && info.forces) this.writeScale(info);
    for (const [keys, deed] of this.keys()) {
      element("dt", part("help-list"), {}, keys);
      element("dd", part("help-list"), {}, deed);
    }
    this.look(info.camera);
  }

  speeds() {
    return SPEEDS;
  }

  /** Keys and their functions. */
  keys() {
    return KEYS;
  }

  /** Information about the whole flight. */
  writeStory(info) {
    part("whole").textContent = `of ${Number(this.recording.end.toFixed(2))} s`;
    part("ending").hidden = !info.ending;
    part("ending").textContent = `Incomplete: ${info.ending.split(": ")[0]}`;
    part("ending").title = info.ending;
    part("phases").replaceChildren();
    info.phases.forEach((phase, k) => {
      const title = `${k + 1}. ${phase.name} (${digits(phase.start)} to ${digits(phase.end)} s)`;
      const button = element("button", part("phases"), { type: "button", title }, phase.name);
      button.style.flexGrow = String(Math.max(phase.end - phase.start, 1e-3));
      button.addEventListener("click", () => this.seek(phase.start));
    });
    this.writeDrifts(info);
  }

  /** When vehicles of a log are off their slots: a mark over the slider for each, short ones before long ones. */
  writeDrifts({ drifts = [], colours }) {
    const { start, end } = this.recording, share = (time) => `${(100 * (time - start)) / (end - start)}%`;
    for (const drift of drifts.sort((a, b) => b.end - b.start - (a.end - a.start))) {
      const worst = `at most ${withUnit(drift.worst, "m")}, at ${digits(drift.at)} s`;
      const title = `Agent ${drift.who + 1} is off its slot (${digits(drift.start)} to ${digits(drift.end)} s): ${worst}`;
      const mark = element("button", part("drifts"), { type: "button", title, "aria-label": title });
      Object.assign(mark.style, { left: share(drift.start), width: share(start + drift.end - drift.start), background: colours[drift.who] });
      mark.addEventListener("click", () => this.seek(drift.at));
    }
    part("drifts").hidden = !drifts.length;
  }

  writeScale(info) {
    part("tension").hidden = false;
    const most = `${info.beyond ? "≥ " : ""}${digits(info.tension)} N`;
    part("push").textContent = `pushes ${most}`;
    part("pull").textContent = `pulls ${most}`;
    const canvas = part("scale"), pen = canvas.getContext("2d");
    for (let x = 0; x < canvas.width; x++) {
      const place = (2 * (x + 0.5)) / canvas.width - 1;
      pen.fillStyle = `rgb(${tensionColour(Math.sign(place) * place * place).map((c) => 255 * c)})`;
      pen.fillRect(x, 0, 1, canvas.height);
    }
  }

  listen() {
    part("play").addEventListener("click", () => this.toggle());
    part("scrub").addEventListener("input", (event) => this.seek(Number(event.target.value)));
    part("speed").addEventListener("change", (event) => this.hasten(Number(event.target.value)));
    part("more").addEventListener("click", () => this.panel());
    part("keys").addEventListener("click", () => this.help());
    part("help-close").addEventListener("click", () => this.help());
    // A control clicked with mouse or finger loses the focus, or the space bar would press it again;
    // a control reached by keyboard keeps it.
    for (const name of ["click", "change"]) {
      document.addEventListener(name, () => {
        const at = document.activeElement, opening = name === "click" && at.tagName === "SELECT";
        if (!opening && at.id !== "view" && !at.matches(":focus-visible")) at.blur();
      });
    }
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("hashchange", () => this.follow());
    this.steer(part("view"));
    this.scene.renderer.canvas.addEventListener("webglcontextlost", () => say("The graphics driver of this machine failed. Reload the page."));
  }

  /** Dragging rotates, with the right button or Shift it moves; the wheel or two fingers zoom. */
  steer(view) {
    const { camera } = this.scene, fingers = new Map();
    view.addEventListener("contextmenu", (event) => event.preventDefault());
    view.addEventListener("pointerdown", (event) => {
      view.setPointerCapture(event.pointerId);
      if (this.grab(event)) return;
      fingers.set(event.pointerId, event);
    });
    const away = (event) => {
      fingers.delete(event.pointerId);
      this.release(event);
    };
    view.addEventListener("pointerup", away);
    view.addEventListener("pointercancel", away);
    view.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return this.drag(event);
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
      const other = [...fingers.values()].find((finger) => finger.pointerId !== event.pointerId);
      if (other) {
        const apart = (finger) => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        camera.zoom *= apart(before) / Math.max(apart(event), 1);
        camera.shift((0.5 * dx) / view.clientHeight, (0.5 * dy) / view.clientHeight);
      } else if (event.buttons === 2 || event.shiftKey) camera.shift(dx / view.clientHeight, dy / view.clientHeight);
      else camera.turn(dx * 0.006, dy * 0.006);
      fingers.set(event.pointerId, event);
      this.stale = true;
    });
    view.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      camera.zoom = Math.max(0.03, Math.min(camera.zoom * Math.exp(event.deltaY * lines * 0.0012), 60));
      this.stale = true;
    }, { passive: false });
  }

  // What a press, a movement and a release in the picture do, other than to turn it.
  grab() {
    return false;
  }

  drag() {}

  release() {}

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    if (part("help").open && event.key !== "?") return;
    const step = event.shiftKey ? 0.1 : 1, { phases } = this.recording.info, now = this.recording.phaseAt(this.time);
    const speeds = this.speeds();
    const speed = (by) => this.hasten(speeds[Math.max(0, Math.min(speeds.indexOf(this.speed) + by, speeds.length - 1))]);
    const deeds = {
      " ": () => !event.target.matches("button, [type=checkbox]") && this.toggle(),
      k: () => this.toggle(),
      ArrowLeft: () => this.seek(this.time - step),
      ArrowRight: () => this.seek(this.time + step),
      Home: () => this.seek(this.recording.start),
      End: () => this.seek(this.recording.end),
      "[": () => this.seek(phases[Math.max(now - (this.time - phases[now].start < 0.5 ? 1 : 0), 0)].start),
      "]": () => this.seek(phases[now + 1]?.start ?? this.recording.end),
      "+": () => speed(1), "=": () => speed(1), "-": () => speed(-1),
      1: () => this.look("follow"), 2: () => this.look("overview"), 3: () => this.look("top"),
      p: () => this.panel(),
      "?": () => this.help(),
    };
    const deed = deeds[event.key];
    if (!deed || deed() === false) return;
    event.preventDefault();
  }

  // -- commands --

  toggle() {
    if (!this.playing && this.time >= this.recording.end) this.seek(this.recording.start);
    this.play(!this.playing);
  }

  play(on) {
    this.playing = on && this.recording.end > this.recording.start;
    this.mark(this.playing);
    this.slow = 0;
    this.stale = true;
  }

  /** Label the button with its next action. */
  mark(playing) {
    part("play").setAttribute("aria-label", playing ? "Pause" : "Play");
    part("play").classList.toggle("playing", playing);
  }

  seek(time) {
    this.time = Math.max(this.recording.start, Math.min(time, this.recording.end));
    this.stale = true;
  }

  hasten(speed) {
    this.speed = speed;
    part("speed").value = String(speed);
  }

  look(mode) {
    this.scene.camera.use(mode);
    for (const button of part("cameras").children) button.setAttribute("aria-pressed", String(button.dataset.mode === mode));
    this.stale = true;
  }

  panel() {
    const panel = part("panel"), hidden = getComputedStyle(panel).display === "none";
    panel.classList.toggle("asked", hidden);
    panel.classList.toggle("dismissed", !hidden);
    this.resize();
  }

  /** Show or hide the list of keys. */
  help() {
    const help = part("help");
    if (help.open) help.close();
    else help.showModal();
  }

  /** Apply the address: `#t=52` shows that time, paused; also `&camera=top` and `&speed=2`. */
  follow() {
    const asked = new URLSearchParams(location.hash.slice(1)), t = parseFloat(asked.get("t"));
    if (CAMERAS.includes(asked.get("camera"))) this.look(asked.get("camera"));
    if (SPEEDS.includes(Number(asked.get("speed")))) this.hasten(Number(asked.get("speed")));
    if (Number.isFinite(t)) this.seek(t);
    this.scene.camera.shown = null;
    this.play(!Number.isFinite(t) && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  resize() {
    // The centre of the picture lies in the middle of the free area.
    const { clientWidth: width, clientHeight: height } = document.documentElement, { camera } = this.scene;
    if (!width || !height) return; // in a frame that is not shown yet
    const beside = (id) => (part(id)?.offsetWidth && width > 760 ? part(id).offsetWidth + 14 : 0);
    document.documentElement.style.setProperty("--bar", `${part("bar").offsetHeight}px`);
    const below = part("fly")?.offsetHeight && width <= 760 ? part("fly").offsetHeight + 14 : 0;
    const left = beside("fly"), right = beside("panel"), bottom = part("bar").offsetHeight + 14 + below;
    const top = width <= 760 ? part("head").offsetHeight + 14 : 0; // which takes half of a narrow page
    camera.centre = [(left - right) / width, (bottom - top) / height];
    camera.free = [1 - (left + right) / width, Math.max(1 - (bottom + top) / height, 0.2)];
    part("more").setAttribute("aria-pressed", String(part("panel").offsetWidth > 0));
    this.redraw();
    this.stale = true;
  }

  /** The time range of the plots. */
  span() {
    return [this.recording.start, this.recording.end];
  }

  redraw() {
    const { recording, axes } = this, [start, end] = this.span(), shares = [];
    for (const time of axes.plots.draw(start, end)) shares.push(end > start ? (time - start) / (end - start) : 0);
    axes.slider.draw(recording.start, recording.end);
    for (const plot of this.plots) plot.draw(recording.nearest(start), recording.nearest(end), shares);
  }

  // -- from picture to picture --

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    const wait = Math.min((now - this.last) / 1000, 0.25);
    this.last = now;
    if (this.playing) {
      this.advance(wait);
      this.spare(wait);
    }
    // A still picture is drawn once more at full resolution.
    const { renderer } = this.scene, sharpen = !this.stale && renderer.scale < 1;
    if (!this.stale && !sharpen) return;
    renderer.scale = sharpen ? 1 : renderer.effort;
    this.stale = this.scene.draw(this.time, wait);
    // Text and sliders need not change with every picture.
    if (!this.playing || now - this.told > 80) {
      this.told = now;
      this.tell();
    }
    this.pictures++;
  }

  advance(wait) {
    this.seek(this.time + wait * this.speed);
    if (this.time >= this.recording.end) this.play(false);
  }

  /** If drawing is slow, draw fewer pixels. */
  spare(wait) {
    const { renderer } = this.scene;
    this.slow = wait > SLOW ? this.slow + 1 : Math.max(0, this.slow - 1);
    if (this.slow < 8) return;
    renderer.effort = Math.max(LEAST_EFFORT, 0.8 * renderer.effort);
    this.slow = 0;
  }

  tell() {
    const { recording, scene, time } = this, { info } = recording, { state } = scene, phase = info.phases[state.phase];
    const write = (id, text) => part(id).textContent !== text && (part(id).textContent = text);
    const { azimuth } = scene.camera;
    part("compass").style.transform = `rotate(${Math.atan2(Math.cos(azimuth), -Math.sin(azimuth))}rad)`;
    write("time", `${time.toFixed(1)} s`);
    write("number", `${state.phase + 1}/${info.phases.length}`);
    const rate = state.clock?.[0] ?? 1;
    write("phase-name", `${phase?.name ?? ""}${rate < 0.995 ? ` (waits: clock at ${Math.round(100 * rate)} %)` : ""}`);
    part("scrub").min = String(recording.start);
    part("scrub").max = String(recording.end);
    part("scrub").value = String(time);
    part("scrub").setAttribute("aria-valuetext", `${time.toFixed(1)} s, ${phase?.name ?? ""}`);
    [...part("phases").children].forEach((button, k) => button.toggleAttribute("aria-current", k === state.phase));
    const [first, last] = this.span(), share = last > first ? (time - first) / (last - first) : 0;
    for (const plot of this.plots) plot.point(share, state);
    const much = scene.enlarged > 1e6 ? "Vehicles have no size; they are drawn as if." : `Vehicles are drawn ${digits(scene.enlarged)} times their size.`;
    const larger = scene.enlarged > 1.15 && !scene.night ? much : "";
    write("notes", [info.note, larger, overworked(state), adrift(state, info), avoiding(state), unheard(state)].filter(Boolean).join("\n"));
  }
}

/** Names of the vehicles for which a test of their value holds; "" for none. */
function named(values, test) {
  const who = Array.from(values ?? []).flatMap((value, i) => (test(value) ? [i + 1] : []));
  if (!who.length) return "";
  return who.length > 8 ? `${who.length} agents` : `Agent${who.length > 1 ? "s" : ""} ${who.join(", ")}`;
}

/** Which vehicles cannot give what is asked of them, in words. */
function overworked({ saturated }) {
  const who = named(saturated, (share) => share > 0.5);
  return who && `${who} cannot give all that is asked.`;
}

/** Which vehicles of a log are surely off their slots, in words. */
function adrift(state, { off }) {
  const who = named(Array.from(state.doubt ?? [], (_, i) => offSlot(state, i)), (by) => by > off);
  return who && `${who} off the plan by more than ${withUnit(off, "m")} (red).`;
}

/** What the layers of avoidance do, in words. */
function avoiding({ aside, acts }) {
  const yields = named(acts, (x) => x > 0.5 && x <= 1.5), held = named(acts, (x) => x > 1.5);
  const way = aside?.[0] ?? 0;
  return [
    way > 0.02 && `The formation flies ${way.toFixed(1)} m beside its path.`,
    yields && `${yields} led by barriers (amber).`, held && `${held} held by the guard (red).`,
  ].filter(Boolean).join("\n");
}

/** How many edges are let go for want of messages, in words. */
function unheard({ silent }) {
  const count = Array.from(silent ?? []).filter((share) => share > 0.99).length;
  return count ? `${count} edge${count > 1 ? "s" : ""} let go: no messages (broken lines).` : "";
}

export function say(words) {
  part("notice").textContent = words;
  part("notice").hidden = false;
}
