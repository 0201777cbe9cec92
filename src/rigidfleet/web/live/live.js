// A flight under way, flown from this page.

import { Player, digits, element, part, say } from "../replay/player.js";
import { Recording } from "../replay/recording.js";

const KEPT = 12000; // samples at most
const SPAN = 30; // of the plots [s]
const HANDS = { // keys and the lever that each pushes: forward, left, up; roll, pitch, yaw
  w: ["move", 0, 1], s: ["move", 0, -1], a: ["move", 1, 1], d: ["move", 1, -1], r: ["move", 2, 1], f: ["move", 2, -1],
  q: ["turn", 2, 1], e: ["turn", 2, -1],
};

/** Ask the flight for something; say why it is not done. */
async function order(command) {
  const answer = await fetch("command", { method: "POST", body: JSON.stringify(command) }).catch(() => null);
  if (!answer || answer.ok) return;
  part("ending").textContent = await answer.text();
  part("ending").hidden = false;
}

const FAREWELL = "The flight has ended. This page can be closed.";

class LivePlayer extends Player {
  constructor(recording) {
    super(recording);
    this.hand = { move: [0, 0, 0], turn: [0, 0, 0] };
    this.keys = new Set();
    this.idle = true; // nothing to tell the flight
    this.build(recording.info);
    this.hear(recording.info);
    this.resize();
    setInterval(() => this.push(), 100);
    setInterval(() => {
      this.redraw();
      this.tell();
    }, 250);
  }

  // -- the page --

  build(info) {
    const card = element("section", document.body, { id: "fly", "aria-label": "Fly" });
    element("h2", card, {}, "Target");
    const sticks = element("div", card, { id: "sticks" }), levers = element("div", sticks);
    sticks.prepend(this.pad());
    for (const [name, group, k] of [["up", "move", 2], ["yaw", "turn", 2], ["pitch", "turn", 1], ["roll", "turn", 0]]) {
      this.lever(levers, name, group, k);
    }
    element("h2", card, {}, "Formation");
    this.choices = element("div", card, { class: "row" });
    for (const name of info.formations) {
      element("button", this.choices, { type: "button", "data-formation": name }, name).addEventListener("click", () => order({ formation: name }));
    }
    element("h2", card, {}, "Gust from");
    const gusts = element("div", card, { class: "row" });
    for (const [name, forward, left] of [["the left", 0, -1], ["the right", 0, 1], ["the front", -1, 0], ["behind", 1, 0]]) {
      element("button", gusts, { type: "button" }, name).addEventListener("click", () => this.gust(forward, left));
    }
    const label = element("label", card, { class: "lever" }, "force");
    this.strength = element("input", label, { type: "range", min: "0.5", max: "8", step: "0.5", value: "3", id: "strength" });
    element("p", card, {}, "Keys: W A S D move, R F up and down, Q E turn; space pauses");
    const controls = part("controls"), before = part("cameras");
    const add = (id, text, title, deed) => {
      const button = element("button", controls, { type: "button", id, title }, text);
      button.addEventListener("click", deed);
      controls.insertBefore(button, before);
    };
    add("now", "Live", "Back to the present", () => this.present());
    add("again", "Again", "Begin anew", () => order({ again: true }));
    add("end", "End", "End the flight", () => order({ stop: true }));
    document.addEventListener("keydown", (event) => this.press(event, true));
    document.addEventListener("keyup", (event) => this.press(event, false));
    window.addEventListener("blur", () => this.keys.clear());
  }

  /** A round pad that moves the target as seen: up is away from the eye. */
  pad() {
    const pad = document.createElement("div"), knob = element("i", pad);
    pad.id = "pad";
    pad.title = "Drag to move the target";
    const put = (x, y) => {
      const size = Math.max(1, Math.hypot(x, y));
      [this.hand.move[0], this.hand.move[1]] = [-y / size, -x / size];
      knob.style.transform = `translate(${(36 * x) / size}px, ${(36 * y) / size}px)`;
    };
    const drag = (event) => {
      const box = pad.getBoundingClientRect();
      put((event.clientX - box.left - box.width / 2) / 40, (event.clientY - box.top - box.height / 2) / 40);
    };
    pad.addEventListener("pointerdown", (event) => {
      pad.setPointerCapture(event.pointerId);
      drag(event);
    });
    pad.addEventListener("pointermove", (event) => event.buttons && drag(event));
    for (const end of ["pointerup", "pointercancel"]) pad.addEventListener(end, () => put(0, 0));
    return pad;
  }

  /** A lever that springs back when it is let go. */
  lever(parent, name, group, k) {
    const label = element("label", parent, { class: "lever" }, name);
    const input = element("input", label, { type: "range", min: "-1", max: "1", step: "0.02", value: "0", "data-lever": name });
    input.addEventListener("input", () => (this.hand[group][k] = Number(input.value)));
    const back = () => {
      input.value = "0";
      this.hand[group][k] = 0;
    };
    for (const end of ["pointerup", "pointercancel", "blur", "keyup"]) input.addEventListener(end, back);
  }

  // -- the hand --

  press(event, down) {
    const key = event.key.toLowerCase();
    if (!(key in HANDS) || event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    if (down) this.keys.add(key);
    else this.keys.delete(key);
  }

  /** Axes of the view on the ground: forward and left. */
  view() {
    const a = this.scene.camera.azimuth;
    return [[-Math.cos(a), -Math.sin(a)], [Math.sin(a), -Math.cos(a)]];
  }

  /** Tell the flight what the hand does. */
  push() {
    const move = [...this.hand.move], turn = [...this.hand.turn], all = { move, turn };
    for (const key of this.keys) {
      const [group, k, sign] = HANDS[key];
      all[group][k] += sign;
    }
    const still = [...move, ...turn].every((x) => x === 0);
    if (still && this.idle) return;
    this.idle = still;
    const [f, l] = this.view(), reach = this.recording.reachAt(this.recording.count - 1), speed = Math.max(0.5, Math.min(0.7 * reach, 6));
    const world = [0, 1].map((s) => speed * (move[0] * f[s] + move[1] * l[s]));
    order({ move: [...world, speed * move[2]], turn: turn.map((x) => 0.6 * x) });
  }

  gust(forward, left) {
    const [f, l] = this.view();
    order({ gust: [0, 1].map((s) => forward * f[s] + left * l[s]).concat(0), strength: Number(this.strength.value) });
  }

  resize() {
    super.resize();
    if (!part("fly")) return; // not built yet
    part("fly").style.bottom = `${part("bar").offsetHeight + 28}px`;
    part("fly").style.maxHeight = `calc(100vh - ${part("bar").offsetHeight + part("head").offsetHeight + 56}px)`;
  }

  // -- what the flight says --

  hear(story) {
    const { info } = this.recording;
    Object.assign(info, story);
    this.speed = story.speed;
    part("speed").value = String(story.speed);
    this.writeStory(info);
    this.mark(!story.paused);
    for (const button of this.choices.children) {
      const mine = button.dataset.formation;
      button.setAttribute("aria-pressed", String(mine === story.formation));
      button.classList.toggle("waiting", mine === story.waiting);
    }
  }

  /** What was flown can still be looked at. */
  end(words) {
    this.over = true;
    part("ending").textContent = [FAREWELL, words].filter(Boolean).join(" ");
    part("ending").hidden = false;
    for (const id of ["fly", "play", "speed", "now", "again", "end"]) part(id).hidden = true;
    this.resize();
    this.tell();
  }

  // -- instead of what a flight that is over does --

  speeds() {
    return this.recording.info.speeds;
  }

  keys() {
    const own = [["W A S D", "move the target: away, left, back, right"], ["R F", "raise, lower it"], ["Q E", "turn it left, right"]];
    return [...own, ...super.keys().map(([keys, deed]) => [keys, keys === "space" ? "pause, go on" : deed])];
  }

  toggle() {
    order({ pause: !this.recording.info.paused });
  }

  hasten(speed) {
    order({ speed });
  }

  follow() {
    this.scene.camera.shown = null;
    this.present();
  }

  present() {
    this.back = false;
    this.playing = true;
    this.stale = true;
  }

  /** Look back; the flight goes on. */
  seek(time) {
    this.back = true;
    super.seek(time);
  }

  advance(wait) {
    const { recording } = this, { info } = recording;
    // A step behind the newest sample, so that there is always one to go to.
    const goal = recording.end - info.step;
    if (this.back || Math.abs(goal - this.time) < 1e-3) return;
    this.stale = true;
    if (!info.paused && !info.ending) this.time += wait * info.speed;
    this.time += (goal - this.time) * (Math.abs(goal - this.time) > 1 ? 1 : Math.min(1, 4 * wait));
    this.time = Math.max(recording.start, Math.min(this.time, recording.end));
  }

  span() {
    const { start, end } = this.recording;
    const last = this.back ? Math.min(end, Math.max(this.time, start + SPAN)) : end;
    return [Math.max(start, last - SPAN), last];
  }

  tell() {
    if (!this.scene.state) return;
    super.tell();
    const { recording } = this, { info } = recording, last = part("phases").lastElementChild, phase = info.phases.at(-1);
    if (last) last.style.flexGrow = String(Math.max(recording.end - phase.start, 1e-3));
    const ago = `${digits(recording.end - this.time)} s ago`, slow = info.pace < 0.9 ? `live, at ${info.pace} of its speed` : "live";
    const now = this.over ? "" : info.paused ? "paused" : slow;
    part("whole").textContent = this.back ? ago : now;
    if (!this.back && !info.busy && !info.ending) part("phase-name").textContent = `holding ${info.formation}`;
    part("now").setAttribute("aria-pressed", String(!this.back));
  }
}

/** Numbers of a sample: time, then the columns one after the other. */
function sample(text, info) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0)), numbers = new Float32Array(bytes.buffer);
  const values = {};
  let at = 1;
  for (const { name, width } of info.columns) {
    values[name] = numbers.subarray(at, at + width);
    at += width;
  }
  return [numbers[0], values];
}

function main() {
  const info = JSON.parse(part("info").textContent), recording = new Recording(info, {}, 0), source = new EventSource("stream");
  let player = null, lost = 0;
  source.addEventListener("story", (event) => {
    const story = JSON.parse(event.data);
    if (story.flight !== info.flight) location.reload();
    else if (player) player.hear(story);
    else Object.assign(info, story);
  });
  source.addEventListener("sample", (event) => {
    const [time, values] = sample(event.data, info);
    if (!recording.count) info.start = time;
    // A sample that got lost is made up for, so that times stay even.
    while (recording.count && recording.end + 1.5 * info.step < time) recording.append(values);
    recording.append(values);
    if (recording.count > KEPT) recording.forget(KEPT / 2);
    if (player || recording.count < 2) return;
    try {
      player = window.replay = new LivePlayer(recording);
    } catch (error) {
      say(`This flight cannot be shown: ${error.message}. It needs a browser of 2023 or later with WebGL 2 (hardware acceleration) switched on.`);
      throw error;
    }
  });
  const over = (words) => {
    source.close();
    if (player) player.end(words);
    else say(FAREWELL);
  };
  source.addEventListener("end", (event) => over(JSON.parse(event.data)));
  source.addEventListener("open", () => clearTimeout(lost));
  source.addEventListener("error", () => {
    clearTimeout(lost);
    lost = setTimeout(() => over(""), 3000);
  });
}

main();
