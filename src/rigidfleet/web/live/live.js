// A live flight, controlled from this page.

import { Player, digits, element, part, say } from "../replay/player.js";
import { Recording } from "../replay/recording.js";
import { add, dot, length, scaled, sub, unit } from "../replay/gl.js";

const KEPT = 12000; // greatest number of samples
const SPAN = 30; // time range of the plots [s]
const HANDS = { // each key with the control that it moves: forward, left, up; roll, pitch, yaw
  w: ["move", 0, 1], s: ["move", 0, -1], a: ["move", 1, 1], d: ["move", 1, -1], r: ["move", 2, 1], f: ["move", 2, -1],
  q: ["turn", 2, 1], e: ["turn", 2, -1],
};

const CLEAR = 14; // least size of a ball to a pointer [px]

let refusal = ""; // why the last command was refused, until another is taken

/** Send a command to the flight; the page says why it is refused. */
async function order(command) {
  const answer = await fetch("command", { method: "POST", body: JSON.stringify(command) }).catch(() => null);
  if (answer && !(answer.ok && ("move" in command || "pull" in command))) refusal = answer.ok ? "" : await answer.text();
  window.replay?.speak();
}

/** A slider with its value in a unit beside it. */
function setting(parent, text, name, range) {
  const lever = element("label", parent, { class: "lever value" }, text);
  const input = element("input", lever, { type: "range", ...range });
  const value = element("output", lever), write = () => (value.textContent = `${input.value} ${name}`);
  input.addEventListener("input", write);
  write();
  return input;
}

const FAREWELL = "The flight has ended. This page can be closed.";

class LivePlayer extends Player {
  constructor(recording) {
    super(recording);
    this.hand = { move: [0, 0, 0], turn: [0, 0, 0] };
    this.keys = new Set();
    this.idle = true; // no command to send
    this.arming = false; // whether the next click puts a ball
    this.held = null; // the ball that is drawn: its slot, the pointer and the place it is drawn to
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
    this.strength = setting(card, "force", "N/kg", { min: "0.5", max: "8", step: "0.5", value: "3", id: "strength" });
    if (info.loss !== null) this.network(card, info.loss);
    const ball = element("section", card, { id: "ball" });
    element("h2", ball, {}, "Ball");
    const row = element("div", ball, { class: "row" });
    const add_ = element("button", row, { type: "button", id: "add-ball", title: "Click in the picture where it shall be (b)" }, "Add ball");
    add_.addEventListener("click", () => this.arm(!this.arming));
    const remove = element("button", row, { type: "button", id: "remove-ball", title: "Remove the ball with the ring (x)" }, "Remove");
    remove.addEventListener("click", () => this.removeBall());
    const [least, most] = info.ball.radius.map(String);
    setting(ball, "radius", "m", { min: least, max: most, step: "0.1", value: "1", id: "radius" });
    setting(ball, "speed", "m/s", { min: "0", max: String(info.ball.speed), step: "0.1", value: "0", id: "fling" });
    const guard = info.unguarded ? `Contact ends the flight: there is no guard (${info.unguarded})` : "Vehicles keep clear of balls, walls and ground";
    element("p", card, { id: "guard" }, guard);
    element("p", card, {}, "Keys: W A S D move, R F up and down, Q E turn, B adds a ball, drag moves it; space pauses");
    part("ending").after(document.createElement("p"));
    part("ending").nextSibling.id = "word";
    part("word").setAttribute("role", "status");
    part("word").hidden = true;
    const controls = part("controls"), before = part("cameras");
    const add = (id, text, title, deed) => {
      const button = element("button", controls, { type: "button", id, title }, text);
      button.addEventListener("click", deed);
      controls.insertBefore(button, before);
    };
    add("now", "Live", "Back to the live flight", () => this.present());
    add("again", "Restart", "Begin a new flight", () => order({ again: true }));
    add("end", "End", "End the flight", () => order({ stop: true }));
    document.addEventListener("keydown", (event) => this.press(event, true));
    document.addEventListener("keyup", (event) => this.press(event, false));
    window.addEventListener("blur", () => this.keys.clear());
  }

  /** A round pad that moves the target as seen on the screen: up is away from the viewer. */
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

  /** A slider of the share of messages that links lose. */
  network(card, loss) {
    element("h2", card, {}, "Messages lost");
    const value = String(Math.round(100 * loss));
    const input = setting(card, "share", "%", { min: "0", max: "95", step: "5", value, id: "loss" });
    input.addEventListener("input", () => order({ loss: Number(input.value) / 100 }));
  }

  /** A slider that springs back when released. */
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

  // -- balls --

  /** Put the next ball where the picture is clicked, or not. */
  arm(on) {
    this.arming = on;
    part("add-ball").setAttribute("aria-pressed", String(on));
    part("view").style.cursor = on ? "crosshair" : "";
    this.speak();
  }

  /** Where a pointer is at the height of a point; `upright`: in the upright plane through it that faces the eye. */
  pointed(event, through, upright) {
    const { renderer, camera } = this.scene, ray = renderer.ray(event.clientX, event.clientY), { eye } = camera;
    let normal = [0, 0, 1];
    if (upright || Math.abs(ray[2]) < 0.05) normal = unit([eye[0] - through[0], eye[1] - through[1], 0]);
    const along = dot(ray, normal), far = along ? dot(sub(through, eye), normal) / along : 0;
    return far > 0 && far < 1e4 ? add(eye, scaled(ray, far)) : null;
  }

  /** The ball under a pointer: the nearest one to the eye. */
  under(event) {
    const { scene } = this, { balls } = scene.state;
    let found = null, least = Infinity;
    for (const { slot } of this.recording.info.balls) {
      const place = Array.from(balls.subarray(4 * slot, 4 * slot + 3)), seen = scene.renderer.project(place);
      if (!seen) continue; // behind the eye, or not shown yet
      const size = Math.max(CLEAR, balls[4 * slot + 3] / scene.sized(place, 1));
      if (Math.hypot(seen[0] - event.clientX, seen[1] - event.clientY) < size && seen[2] < least) [found, least] = [{ slot, place }, seen[2]];
    }
    return found;
  }

  grab(event) {
    if (this.over || this.back || event.button !== 0) return false;
    const cm = Array.from(this.scene.state.cm);
    if (this.arming) {
      const place = this.pointed(event, cm, false);
      if (!place) return true;
      const way = sub(cm, place), speed = Number(part("fling").value);
      order({ ball: place, radius: Number(part("radius").value), velocity: scaled(length(way) > 1e-6 ? unit(way) : [0, 0, 0], speed) });
      this.arm(false);
      return true;
    }
    const ball = this.under(event);
    if (!ball) return false;
    this.choose(ball.slot);
    this.held = { slot: ball.slot, id: event.pointerId, to: null, place: ball.place };
    return true;
  }

  drag(event) {
    if (this.held?.id !== event.pointerId) return;
    const { held } = this, to = this.pointed(event, held.to ?? held.place, event.shiftKey);
    if (to) held.to = to;
  }

  release(event) {
    if (this.held?.id !== event.pointerId) return;
    const { slot, to } = this.held;
    this.held = null;
    order({ pull: slot, to }); // it stops when it is there; one that was not drawn stops at once
  }

  choose(slot) {
    this.scene.chosen = slot;
    this.stale = true;
  }

  removeBall() {
    const { balls } = this.recording.info, chosen = balls.find(({ slot }) => slot === this.scene.chosen) ?? balls.at(-1);
    if (chosen) order({ remove: chosen.slot });
  }

  /** Say what a command could not do, or what the next click does. */
  speak() {
    const { held_off } = this.recording.info;
    const words = refusal || (this.arming ? "Click where the ball shall be" : held_off ? `The target stays out of '${held_off}'` : "");
    const text = words && words[0].toUpperCase() + words.slice(1);
    if (part("word").textContent === text) return;
    part("word").textContent = text;
    part("word").classList.toggle("refused", Boolean(refusal));
    part("word").hidden = !text;
    this.resize(); // the card begins below
  }

  // -- controls --

  press(event, down) {
    const key = event.key.toLowerCase();
    if (down && !event.repeat && !event.ctrlKey && !event.metaKey && !event.altKey && !this.over && !part("help").open) {
      if (key === "b") this.arm(!this.arming);
      if (key === "escape") this.arm(false);
      if (key === "x") this.removeBall();
    }
    if (!(key in HANDS) || event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    if (down) this.keys.add(key);
    else this.keys.delete(key);
  }

  /** Axes of the view on the ground: forward and left. */
  view() {
    const a = this.scene.camera.azimuth;
    return [[-Math.cos(a), -Math.sin(a)], [Math.sin(a), -Math.cos(a)]];
  }

  /** Send the state of the controls to the flight. */
  push() {
    if (this.held?.to) order({ pull: this.held.slot, to: this.held.to });
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

  // -- messages of the flight --

  hear(story) {
    const { info } = this.recording;
    Object.assign(info, story);
    this.speed = story.speed;
    part("speed").value = String(story.speed);
    this.writeStory(info);
    this.mark(!story.paused);
    this.scene.ballNames = [];
    for (const { slot, name } of info.balls) this.scene.ballNames[slot] = name;
    if (!(this.scene.chosen in this.scene.ballNames)) this.choose(info.balls.at(-1)?.slot);
    part("remove-ball").disabled = !info.balls.length;
    this.speak();
    for (const button of this.choices.children) {
      const mine = button.dataset.formation;
      button.setAttribute("aria-pressed", String(mine === story.formation));
      button.classList.toggle("waiting", mine === story.waiting);
    }
  }

  /** Keep the page usable as a replay after the flight has ended. */
  end(words) {
    this.over = true;
    part("ending").textContent = [FAREWELL, words].filter(Boolean).join(" ");
    part("ending").classList.toggle("well", !this.recording.info.ending);
    part("ending").hidden = false;
    for (const id of ["fly", "play", "speed", "now", "again", "end"]) part(id).hidden = true;
    this.resize();
    this.tell();
  }

  // -- differences from a finished flight --

  speeds() {
    return this.recording.info.speeds;
  }

  keys() {
    const own = [["W A S D", "move the target: away, left, towards you, right"], ["R F", "raise or lower the target"], ["Q E", "turn the target left or right"],
      ["B", "add a ball where the picture is clicked"], ["X", "remove the ball with the ring"], ["drag a ball", "move it; with Shift up and down"]];
    return [...own, ...super.keys().map(([keys, deed]) => [keys, keys === "space" ? "pause or continue" : deed])];
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

  /** Look back in time while the flight goes on. */
  seek(time) {
    this.back = true;
    super.seek(time);
  }

  advance(wait) {
    const { recording } = this, { info } = recording;
    // One step behind the newest sample, so that there is always a next one.
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
    const ago = `${digits(recording.end - this.time)} s ago`, slow = info.pace < 0.9 ? `live, at ${info.pace}× real time` : "live";
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
    // A lost sample is replaced, so that times stay even.
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
