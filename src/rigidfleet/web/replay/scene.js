// The picture of a flight at one time, and its camera.

import {
  Lines, Mesh, NO_TURN, OWN, Places, ROTORS, add, cross, discMesh, dot, length, mixed,
  ballMesh, farVehicleMesh, noseMesh, quaternion, rotorMesh, scaled, smallVehicleMesh, sub, unit, vehicleMesh,
} from "./gl.js";
import { bodyAxes } from "./recording.js";

export const LEAST_EFFORT = 0.5; // least share of the resolution

const AXES = [[0.84, 0.15, 0.16], [0.13, 0.58, 0.22], [0.12, 0.36, 0.86]];
const IDLE = [0.42, 0.47, 0.53], PULL = [0.80, 0.11, 0.09], PUSH = [0.10, 0.33, 0.75];
const INK = [0.13, 0.15, 0.18], BOX = [0.88, 0.88, 0.87], RIM = [0.50, 0.56, 0.63], FENCE = [0.69, 0, 0.13], SOLID = [0.80, 0.77, 0.72], PEOPLE = [0.42, 0.24, 0.60], FALL = [0.90, 0.62, 0], LIMIT = [0.86, 0.05, 0.10], YIELDS = [0.90, 0.60, 0.0];
const SMALLEST = 6, DETAILED = 12; // radius of a vehicle on the screen: the least, and that from which all detail is drawn [px]
const HATCHES = 14; // lines over an area where nobody may be, or where people are
const HEARD = 0.5; // share of the silence that lets go of an edge from which it is drawn broken
const TRAIL = 8; // length of trails [s]
const FULL = 0.98; // share of its limit from which a rotor is drawn as being at it
const ORDER = [0, 3, 2, 1]; // rotors of `ROTORS` in the columns: front left, front right, rear right, rear left
const MANY = 300; // number of vehicles from which on drawing in software begins at the least resolution
const AWAY = 1e12; // a coordinate that no camera sees [m]
const NEAR = 500; // greatest number of vehicles of a swarm that are drawn with a shape
const DOT = 2.5, LARGE_DOT = 3.5; // least radius of a dot on the screen [px], in a swarm and in a crowd
const LIGHT = 9, SMALL_LIGHT = 5; // least radius of a light's glow on the screen [px], and in a crowd
const CROWD = 60; // number of vehicles beyond which each is drawn less prominently

/** Colour of an edge: `share` of the largest tension, from -1 (pushes) to 1 (pulls), by its square root. */
export function tensionColour(share) {
  return mixed(IDLE, share < 0 ? PUSH : PULL, Math.sqrt(Math.min(Math.abs(share), 1)));
}

/** How far a vehicle is off its slot at least [m], as far as this is known. */
export const offSlot = (state, i) => length(state.slot.subarray(3 * i, 3 * i + 3)) - (state.doubt?.[i] ?? 0);

const bytes = (colours) => Uint8Array.from(colours.flatMap((c) => [...c.map((x) => 255 * x), 255]));
const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);

// -- the camera ---------------------------------------------------------------------------------------

export const CAMERAS = ["follow", "overview", "top"];
const STEEP = 0.62; // elevation of the overview
const MARGIN = 1.06; // around the content of the overview
const PLACES = 2000; // positions of the flight that the overview takes into account

/** Unit vectors of a view from an azimuth and an elevation: to its right, upwards, and back to the eye. */
function viewAxes(azimuth, elevation) {
  const c = Math.cos(elevation), back = [c * Math.cos(azimuth), c * Math.sin(azimuth), Math.sin(elevation)];
  const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
  return { right, up: cross(back, right), back };
}

class Camera {
  constructor(recording) {
    const { info, columns, count } = recording, n = info.radius.length;
    this.info = info;
    this.sight = [...info.sight]; // points that the overview shows
    const every = Math.max(1, Math.ceil((count * n) / PLACES));
    for (let k = 0; k < count; k += every) {
      for (let i = k * n; i < (k + 1) * n; i++) this.sight.push(columns.position.subarray(3 * i, 3 * i + 3));
    }
    this.fov = (36 * Math.PI) / 180;
    this.steep = info.elevation ?? STEEP;
    this.centre = [0, 0]; // of the part of the page that nothing covers, and the part's size: shares of half the page
    this.free = [1, 1];
    this.use(info.camera, true);
    this.pan = [0, 0, 0];
  }

  /** Set the view of a mode; the picture moves there smoothly, unless `now`. */
  use(mode, now = false) {
    this.mode = mode;
    this.azimuth = mode === "top" ? -Math.PI / 2 : this.info.azimuth; // from above, north is up
    this.elevation = mode === "top" ? Math.PI / 2 : mode === "overview" ? this.steep : this.info.elevation ?? 0.4;
    this.zoom = 1;
    this.pan = [0, 0, 0];
    if (now) this.shown = null;
  }

  turn(dx, dy) {
    this.azimuth -= dx;
    this.elevation = Math.max(-0.15, Math.min(this.elevation + dy, Math.PI / 2));
  }

  /** Move the point looked at across the screen, in shares of the screen's height. */
  shift(dx, dy) {
    const { eye, target, right } = this, up = cross(unit(sub(eye, target)), right);
    const s = 2 * Math.tan(this.fov / 2) * length(sub(eye, target));
    this.pan = add(this.pan, add(scaled(right, -dx * s), scaled(up, dy * s)));
  }

  /** Target and distance that show the whole flight and nearby obstacles in the free part of the page. */
  overview(aspect) {
    const { right, up, back } = viewAxes(this.info.azimuth, this.steep), { middle } = this.info;
    const wide = Math.tan(this.fov / 2) * aspect * this.free[0], high = Math.tan(this.fov / 2) * this.free[1];
    // For each side of the picture, the distance at which the outermost point lies on its border.
    let [l, r, b, t] = [-Infinity, -Infinity, -Infinity, -Infinity];
    for (const p of this.sight) {
      const away = sub(p, middle), x = dot(away, right) / wide, y = dot(away, up) / high, z = dot(away, back);
      [l, r, b, t] = [Math.max(l, z - x), Math.max(r, z + x), Math.max(b, z - y), Math.max(t, z + y)];
    }
    const target = add(middle, add(scaled(right, (wide * (r - l)) / 2), scaled(up, (high * (t - b)) / 2)));
    return { target, distance: MARGIN * Math.max((l + r) / 2, (b + t) / 2, 1e-6) };
  }

  /** Move towards the wanted view, `wait` seconds after the last picture; true while still moving. */
  update(recording, state, aspect, wait) {
    const { info } = this, narrow = Math.tan(this.fov / 2) * Math.min(aspect * this.free[0], this.free[1]);
    let target, distance;
    if (this.mode === "overview") ({ target, distance } = this.overview(aspect));
    else {
      // Allow for the formation's size in the near future, so that a change of shape stays in the picture.
      const [k] = recording.place(state.time), rate = info.step > 0 ? 1 / info.step : 0;
      let reach = 0;
      target = state.cm;
      for (let ahead = -1; ahead <= 2; ahead += 0.25) {
        const at = Math.max(0, Math.min(k + Math.round(ahead * rate), recording.count - 1));
        reach = Math.max(reach, recording.reachAt(at));
      }
      distance = (reach * (this.mode === "top" ? 1.6 : 1.08)) / Math.sin(Math.atan(narrow));
    }
    const wanted = {
      distance: distance * this.zoom,
      azimuth: this.azimuth,
      elevation: this.elevation,
      target: add(target, this.pan),
    };
    // The view moves with the formation; only the rest of a change of view fades.
    if (!Number.isFinite(Math.log(this.shown?.distance))) this.shown = null; // seen in a frame without room
    const s = this.shown ?? { ...wanted, off: [0, 0, 0], mode: this.mode };
    if (s.mode !== this.mode) {
      s.off = sub(s.target, wanted.target);
      s.azimuth -= 2 * Math.PI * Math.round((s.azimuth - wanted.azimuth) / (2 * Math.PI)); // the short way round
    }
    const keep = Math.exp(-wait / 0.16), slow = Math.exp(-wait / 0.45);
    s.mode = this.mode;
    s.off = scaled(s.off, keep);
    s.target = add(wanted.target, s.off);
    s.azimuth = wanted.azimuth + (s.azimuth - wanted.azimuth) * keep;
    s.elevation = wanted.elevation + (s.elevation - wanted.elevation) * keep;
    s.distance = wanted.distance * Math.pow(s.distance / wanted.distance, slow);
    this.shown = s;
    const { right, back } = viewAxes(s.azimuth, s.elevation);
    this.target = s.target;
    this.right = right;
    this.eye = add(s.target, scaled(back, s.distance));
    if (info.solid) this.eye[2] = Math.max(this.eye[2], info.ground + 0.02 * s.distance + 0.05);
    this.distance = s.distance;
    this.near = s.distance * 0.02;
    this.far = s.distance * 4 + 4 * info.extent + length(sub(this.eye, info.middle));
    this.fog = Math.max(s.distance * 1.6, 0.5 * info.extent);
    return length(s.off) > 1e-3 * s.distance || Math.abs(s.distance / wanted.distance - 1) > 1e-3
      || Math.abs(s.azimuth - wanted.azimuth) + Math.abs(s.elevation - wanted.elevation) > 1e-3;
  }
}

// -- the scene ----------------------------------------------------------------------------------------

export class Scene {
  constructor(renderer, labels, recording) {
    const { info } = recording;
    this.recording = recording;
    this.info = info;
    this.n = info.radius.length;
    this.colours = info.colours.map(rgb);
    this.renderer = renderer;
    this.labels = new Labels(labels);
    this.night = Boolean(info.night); // then vehicles are their lights, and all else is shown if asked for
    renderer.night = this.night;
    document.documentElement.classList.toggle("night", this.night);
    const day = !this.night;
    this.show = { edges: day, trails: day, slots: day, axes: day, names: day, areas: true };
    this.camera = new Camera(recording);
    this.crowd = this.n > CROWD;
    const plain = this.crowd && renderer.software; // many triangles are slow without a graphics card
    if (this.n > MANY && renderer.software) renderer.effort = LEAST_EFFORT;
    // Dots for vehicles: in swarms always, in crowds without a graphics card while the picture moves.
    if (info.swarm || this.night || (this.n > MANY && renderer.software)) this.swarm = renderer.swarm(Float32Array.from(info.radius), bytes(this.colours));
    const upload = (mesh) => this.renderer.upload(mesh);
    this.meshes = {
      vehicle: upload(vehicleMesh()),
      small: upload(plain ? farVehicleMesh() : smallVehicleMesh()),
      rotor: upload(rotorMesh()),
      disc: upload(discMesh()),
      nose: upload(noseMesh()),
      box: upload(new Mesh().box([-0.5, -0.5, -0.5], [0.5, 0.5, 0.5], OWN)),
      cone: upload(new Mesh().prism([0, 0, 0], 1, 0, 1, 12, OWN)),
      pin: upload(new Mesh().prism([0, 0, 0], 1, 0, 1.3, 4, OWN).prism([0, 0, 0], 1, 0, -1.3, 4, OWN)),
      ball: upload(ballMesh()),
      shade: upload(new Mesh().ring([0, 0, 0], 0, 1, plain ? 6 : 16, OWN, [1, 0])),
    };
    const names = ["solid", "veils", "vehicles", "turned", "noses", "discs", "small", "ghosts", "smallGhosts", "cones", "pins", "shades", "balls", "ballVeils"];
    this.places = Object.fromEntries(names.map((name) => [name, new Places()]));
    this.lines = { ground: new Lines(), world: new Lines() };
    this.fade = info.boxes.map(() => 1);
    this.solids = (info.solids ?? []).map((solid) => new Solid(solid, upload));
    this.areas = info.areas.map((area) => new Area(area, info, upload));
    this.enlarged = 1;
    // Grid lines 1, 10, ... m apart, so that the formation covers some.
    const size = Math.max(...recording.columns.position ? [recording.reachAt(0)] : [1], 1e-3);
    this.gridStep = Math.pow(10, Math.floor(Math.log10(size) + 0.35));
  }

  /** Draw the flight at a time; true if the picture is not at rest. */
  draw(time, wait) {
    const { renderer, camera, recording } = this, { canvas } = renderer;
    const state = recording.at(time);
    this.state = state;
    if (this.night) this.colours.forEach((own, i) => own.forEach((_, c) => (own[c] = state.light[3 * i + c])));
    let moving = camera.update(recording, state, canvas.clientWidth / Math.max(canvas.clientHeight, 1), wait);
    renderer.begin(camera);
    for (const name in this.places) this.places[name].clear();
    for (const name in this.lines) this.lines[name].clear();
    this.labels.clear();
    // World length of a pixel at a distance of 1 m.
    this.pixel = (2 * Math.tan(camera.fov / 2)) / Math.max(canvas.clientHeight, 1);

    moving = this.placeBoxes(wait) || moving;
    for (const solid of this.solids) moving = solid.place(this, time, wait) || moving;
    if (this.show.areas) for (const area of this.areas) area.place(this);
    this.placeVehicles(state);
    if (state.fall && this.show.areas) this.placeFalls(state);
    if (this.show.trails && !this.info.swarm) this.placeTrails(time);
    if (this.show.edges) this.placeEdges(state);
    if (this.show.axes) this.placeAxes(state);
    if (state.target) this.placeTarget(state);
    if (state.balls) this.placeBalls(state);
    this.placePath();
    this.placeWaypoints(state);

    const { meshes, places, lines, info } = this;
    renderer.depth(null);
    const under = [camera.target[0], camera.target[1], info.ground];
    renderer.ground(under, Math.max(8 * camera.distance, 0.6 * info.extent), this.gridStep, info.solid);
    const { dotted } = this, pixels = 1 / this.pixel, least = info.swarm ? DOT : LARGE_DOT;
    renderer.meshes(meshes.shade, places.shades);
    if (dotted && !this.night) renderer.dots(this.swarm, this.far, pixels, 1.3 * least, info.ground);
    renderer.lines(lines.ground);
    renderer.depth(true);
    renderer.meshes(meshes.box, places.solid);
    for (const solid of this.solids) renderer.meshes(solid.mesh, solid.solid);
    renderer.meshes(meshes.vehicle, places.vehicles);
    renderer.meshes(meshes.vehicle, places.turned);
    renderer.meshes(meshes.nose, places.noses);
    renderer.meshes(meshes.small, places.small);
    if (dotted && !this.night) renderer.dots(this.swarm, this.far, pixels, least);
    renderer.meshes(meshes.cone, places.cones);
    renderer.meshes(meshes.pin, places.pins);
    renderer.meshes(meshes.ball, places.balls);
    renderer.depth(false);
    renderer.lines(lines.world);
    renderer.meshes(meshes.vehicle, places.ghosts);
    renderer.meshes(meshes.small, places.smallGhosts);
    renderer.meshes(meshes.rotor, places.vehicles);
    renderer.meshes(meshes.disc, places.discs);
    renderer.meshes(meshes.box, places.veils);
    if (this.show.areas) for (const area of this.areas) renderer.meshes(area.mesh, area.veil);
    renderer.meshes(meshes.ball, places.ballVeils);
    for (const solid of this.solids) renderer.meshes(solid.mesh, solid.veil);
    if (this.night) renderer.dots(this.swarm, this.far, pixels, this.n > MANY ? SMALL_LIGHT : LIGHT, null, bytes(this.colours));
    this.labels.flush();
    return moving;
  }

  /** Metres that `px` pixels cover at a point. */
  sized(point, px) {
    return px * this.pixel * length(sub(point, this.camera.eye));
  }

  // -- things at rest --

  /** Boxes; those between the eye and the vehicles turn into veils. */
  placeBoxes(wait) {
    const { info, camera, state, places, lines } = this;
    let moving = false;
    const order = info.boxes.map((box, i) => [i, length(sub(camera.eye, mixed(box.min, box.max, 0.5)))]);
    for (const [i] of order.sort((a, b) => b[1] - a[1])) {
      const { min, max } = info.boxes[i], goal = this.hides(min, max, state) ? 0.13 : 1;
      this.fade[i] = goal + (this.fade[i] - goal) * Math.exp(-wait / 0.12);
      if (Math.abs(this.fade[i] - goal) < 0.01) this.fade[i] = goal;
      else moving = true;
      const alpha = this.fade[i];
      (alpha < 1 ? places.veils : places.solid).add(mixed(min, max, 0.5), sub(max, min), NO_TURN, BOX, alpha);
      this.frame(min, max, RIM, 0.35 + 0.45 * alpha);
      this.storeys(min, max, 0.22 * alpha);
    }
    if (info.fence) this.frame(info.fence.min, info.fence.max, FENCE, 0.45);
    return moving;
  }

  hides(low, high, state) {
    const { eye } = this.camera, every = Math.max(1, Math.floor(this.n / 24));
    for (let i = 0; i < this.n; i += every) {
      if (meets(eye, state.position.subarray(3 * i, 3 * i + 3), low, high)) return true;
    }
    return meets(eye, state.cm, low, high);
  }

  frame(low, high, colour, alpha) {
    const at = (k) => [k & 1 ? high[0] : low[0], k & 2 ? high[1] : low[1], k & 4 ? high[2] : low[2]];
    for (let k = 0; k < 8; k++) {
      for (const bit of [1, 2, 4]) if (!(k & bit)) this.lines.world.add(at(k), at(k | bit), 1.2, colour, alpha);
    }
  }

  /** Lines around a box at even heights, to show how large it is. */
  storeys(low, high, alpha) {
    const step = this.gridStep * (high[2] - low[2] > 40 * this.gridStep ? 10 : high[2] - low[2] > 8 * this.gridStep ? 5 : 1);
    for (let z = Math.ceil(low[2] / step + 0.01) * step; z < high[2]; z += step) {
      const at = [[low[0], low[1], z], [high[0], low[1], z], [high[0], high[1], z], [low[0], high[1], z]];
      at.forEach((p, k) => this.lines.world.add(p, at[(k + 1) % 4], 1, RIM, alpha));
    }
  }

  placeWaypoints(state) {
    const { info, lines, places } = this;
    const current = info.phases[state.phase];
    info.phases.forEach((phase, k) => {
      if (!phase.position) return;
      const p = phase.position, now = phase === current, past = k < state.phase;
      const size = this.sized(p, now ? 7 : 5), alpha = past ? 0.35 : 1;
      const colour = past ? mixed(RIM, this.renderer.look.background, 0.35) : now ? INK : RIM;
      places.pins.add(p, size, NO_TURN, colour, 1);
      lines.world.add(p, [p[0], p[1], info.ground], 1, RIM, 0.45 * alpha);
      places.shades.add([p[0], p[1], info.ground], this.sized(p, 7), NO_TURN, INK, 0.3 * alpha);
      if (this.show.names) this.labels.add(this.renderer.project(p), phase.name, now ? "now" : "place", 14);
    });
  }

  /** Path of the centre of mass through the whole flight. */
  placePath() {
    const { recording, lines, info } = this;
    if (!info.path || !this.show.trails) return;
    const { cm } = recording.columns, every = Math.max(1, Math.ceil(recording.count / (this.renderer.software ? 150 : 600)));
    const at = (k) => cm.subarray(3 * k, 3 * k + 3);
    for (let k = 0; k < recording.count - 1; k += every) {
      lines.world.add(at(k), at(Math.min(k + every, recording.count - 1)), 1.2, RIM, 0.38);
    }
  }

  // -- things that move --

  placeVehicles(state) {
    this.dotted = this.info.swarm || this.night || (this.swarm && this.renderer.scale < 1);
    if (this.dotted) this.far = state.position.slice(); // all but those that have a shape
    if (this.info.swarm) {
      this.placeNear(state);
      return;
    }
    const { info, places, n, recording } = this, shade = this.crowd ? 0.2 : 0.28;
    const heading = Number.isNaN(state.attitude[0]) ? [1, 0, 0] : bodyAxes(state.attitude)[0];
    this.enlarged = 1;
    // Numbers, if there is room for them.
    const room = recording.reachAt(recording.place(state.time)[0]) / this.sized(state.cm, 1);
    const named = this.show.names && n <= 40 && room > 22 * Math.sqrt(n);
    for (let i = 0; i < n; i++) {
      const p = state.position.subarray(3 * i, 3 * i + 3), radius = info.radius[i];
      const pixel = this.sized(p, 1), size = Math.max(radius, SMALLEST * pixel), near = size > DETAILED * pixel;
      this.enlarged = Math.max(this.enlarged, size / Math.max(radius, 1e-9));
      if (this.dotted && !near) continue;
      if (this.dotted && !this.night) this.far[3 * i] = AWAY;
      const own = info.rotors?.[i]; // vehicles turn as they are, points along their thrust
      const q = own ? normal(state.turn.subarray(4 * i, 4 * i + 4)) : leaning(state.thrust.subarray(3 * i, 3 * i + 3), heading);
      (near ? (own ? places.turned : places.vehicles) : places.small).add(p, size, q, this.colours[i], 1);
      const error = state.slot.subarray(3 * i, 3 * i + 3), doubt = state.doubt?.[i] ?? 0;
      if (doubt > 0) places.ballVeils.add(p, size + doubt, NO_TURN, this.colours[i], 0.18); // where it may be
      // Barriers, from 1.5 on the guard; of a log, who is surely off its slot.
      const acts = offSlot(state, i) > info.off ? 2 : state.acts?.[i] ?? 0;
      if (acts > 0.5) places.discs.add(p, 5 * size, NO_TURN, acts > 1.5 ? LIMIT : YIELDS, 0.55);
      if (own) {
        places.noses.add(p, size, q, this.colours[i], 1);
        this.placeRotors(p, size, q, state.rotors.subarray(4 * i, 4 * i + 4), near, i);
      }
      if (this.show.slots && !Number.isNaN(error[0])) {
        this.placeGhost(near ? places.ghosts : places.smallGhosts, p, size, q, error, i);
      }
      const height = p[2] - info.ground;
      if (height > 0) {
        const blur = size * 1.2 + 0.02 * height;
        places.shades.add([p[0], p[1], info.ground], blur, NO_TURN, INK, (shade * size) / blur + 0.04);
      }
      if (named) this.labels.add(this.renderer.project(p), String(i + 1), "agent", 10 + (0.6 * size) / pixel, info.colours[i]);
    }
  }

  /** Vehicles of a swarm that are near enough to have a shape; all others are dots. */
  placeNear(state) {
    const { info, places, n, pixel } = this, [x, y, z] = this.camera.eye, { position } = state;
    for (let i = 0, at = 0; i < n; i++, at += 3) {
      const a = position[at] - x, b = position[at + 1] - y, c = position[at + 2] - z, reach = info.radius[i] / (SMALLEST * pixel);
      if (a * a + b * b + c * c > reach * reach || places.vehicles.count >= NEAR) continue;
      places.vehicles.add(position.subarray(at, at + 3), info.radius[i], NO_TURN, this.colours[i], 1);
      if (!this.night) this.far[at] = AWAY;
    }
    this.enlarged = Math.max(1, (DOT * this.sized(state.cm, 1)) / Math.max(info.radius[0], 1e-9));
  }

  /** Where vehicles fall that fail now. */
  placeFalls(state) {
    for (let i = 0; i < this.n; i++) {
      const p = [state.fall[2 * i], state.fall[2 * i + 1], this.info.ground], size = Math.max(0.7 * this.info.radius[i], this.sized(p, 4));
      for (const s of [size, -size]) this.lines.ground.add(add(p, [size, s, 0]), add(p, [-size, -s, 0]), 2, FALL, 0.9);
    }
  }

  /** Rotors of a vehicle, the denser the more they give, red at their limit; from afar only these. */
  placeRotors(p, size, q, shares, near, i) {
    const [x, y, z] = bodyAxes(q);
    ORDER.forEach((k, column) => {
      const share = shares[column], full = share >= FULL;
      if (!near && !full) return;
      const [, a, b] = ROTORS[k], place = add(add(scaled(x, a * size), scaled(y, b * size)), scaled(z, 0.15 * size));
      this.places.discs.add(add(p, place), size, q, full ? LIMIT : this.colours[i], full ? 1 : 0.1 + 0.35 * share);
    });
  }

  /** The slot of a vehicle; visible only if the vehicle is not there. */
  placeGhost(ghosts, p, size, q, error, i) {
    const off = length(error), slot = add(p, error);
    const alpha = Math.max(0, Math.min((off / size - 0.1) / 0.6, 1));
    if (alpha === 0) return;
    ghosts.add(slot, size, q, this.colours[i], 0.3 * alpha);
    if (off > size) this.lines.world.add(p, slot, 1.2, this.colours[i], 0.55 * alpha);
  }

  placeEdges(state) {
    const { info, lines } = this, { edges, tension } = info;
    const slim = edges.length > 200 ? 0.55 : 1, veil = edges.length > 200 ? 0.55 : 0.9;
    const at = (i) => state.position.subarray(3 * i, 3 * i + 3);
    const below = (p) => [p[0], p[1], info.ground];
    edges.forEach(([i, j], k) => {
      const pull = state.tension[k];
      if (Number.isNaN(pull)) return;
      const share = pull / tension, load = Math.sqrt(Math.min(Math.abs(share), 1));
      const width = slim * (2.2 + 2.8 * load), silent = state.silent?.[k] ?? 0;
      if (silent < HEARD) lines.world.add(at(i), at(j), width, tensionColour(share), veil);
      else this.breakEdge(at(i), at(j), width, silent, veil);
      if (edges.length <= 200) lines.ground.add(below(at(i)), below(at(j)), 1.5, INK, 0.09);
    });
  }

  /** An edge whose ends have not heard of each other for long: the longer, the wider the gap in it. */
  breakEdge(a, b, width, silent, veil) {
    const part = 0.5 * (1 - 0.6 * silent), along = (f) => a.map((x, q) => x + f * (b[q] - x));
    this.lines.world.add(a, along(part), width, LIMIT, veil);
    this.lines.world.add(along(1 - part), b, width, LIMIT, veil);
  }

  /** The last seconds of every vehicle's path. */
  placeTrails(time) {
    const { recording, lines, n, state } = this, { position, slot } = recording.columns;
    const [k] = recording.place(time), step = recording.info.step;
    if (!(step > 0)) return;
    const first = Math.max(0, k - Math.floor(TRAIL / step));
    const every = Math.max(1, Math.ceil(((k - first) * n) / (12000 * this.renderer.effort ** 3)), Math.round(0.06 / step));
    const of = (column, j, i) => column.subarray(3 * (j * n + i), 3 * (j * n + i) + 3), at = (j, i) => of(position, j, i);
    const planned = (j, i) => add(at(j, i), of(slot, j, i));
    // Points at fixed times, or the trail would flicker.
    const begin = Math.ceil(first / every) * every;
    const full = this.crowd ? 0.3 : 0.6;
    const fresh = (j) => Math.pow(Math.max(0, 1 - (time - recording.start - j * step) / TRAIL), 1.4) * full;
    for (let i = 0; i < n; i++) {
      const colour = this.colours[i];
      let j = begin;
      for (; j + every <= k; j += every) {
        lines.world.add(at(j, i), at(j + every, i), 2, colour, fresh(j), fresh(j + every));
        if (state.doubt) lines.world.add(planned(j, i), planned(j + every, i), 1.2, INK, fresh(j), fresh(j + every)); // a ghost
      }
      if (j <= k) lines.world.add(at(j, i), state.position.subarray(3 * i, 3 * i + 3), 2, colour, fresh(j), full);
    }
  }

  /** Target pose of the body in a live flight. */
  placeTarget(state) {
    const { lines, places, info, recording } = this, p = Array.from(state.target.subarray(0, 3)), cm = Array.from(state.cm);
    const [k] = recording.place(state.time), size = 0.3 * recording.reachAt(k);
    places.pins.add(p, this.sized(p, 6), NO_TURN, INK, 1);
    places.shades.add([p[0], p[1], info.ground], this.sized(p, 10), NO_TURN, INK, 0.4);
    lines.world.add(p, [p[0], p[1], info.ground], 1, RIM, 0.5);
    if (length(sub(p, cm)) > 0.02 * size) lines.world.add(cm, p, 1.6, INK, 0.35);
    bodyAxes(state.target.subarray(3, 7)).forEach((axis, a) => lines.world.add(p, add(p, scaled(axis, size)), 2, AXES[a], 0.7));
  }

  /** Balls of a live flight; the chosen one has a ring. */
  placeBalls(state) {
    const { places, lines, info } = this;
    for (let slot = 0; 4 * slot < state.balls.length; slot++) {
      const p = Array.from(state.balls.subarray(4 * slot, 4 * slot + 3)), radius = state.balls[4 * slot + 3];
      if (Number.isNaN(radius)) continue;
      const half = [radius, radius, radius], veil = this.hides(sub(p, half), add(p, half), state);
      (veil ? places.ballVeils : places.balls).add(p, radius, NO_TURN, SOLID, veil ? 0.3 : 1);
      places.shades.add([p[0], p[1], info.ground], 1.2 * radius, NO_TURN, INK, 0.35);
      lines.world.add(p, [p[0], p[1], info.ground], 1, RIM, 0.5);
      if (this.show.names) this.labels.add(this.renderer.project(add(p, [0, 0, radius])), this.ballNames?.[slot] ?? "", "place", 10);
      if (slot !== this.chosen) continue;
      const at = (k) => add(p, scaled([Math.cos(k * Math.PI / 18), Math.sin(k * Math.PI / 18), 0], 1.15 * radius));
      for (let k = 0; k < 36; k++) lines.world.add(at(k), at(k + 1), 2.5, AXES[2], 0.9);
    }
  }

  /** Body axes at the centre of mass and, faintly, the commanded ones if they differ. */
  placeAxes(state) {
    const { lines, places, recording } = this;
    if (Number.isNaN(state.attitude[0])) return;
    const origin = Array.from(state.cm), [k] = recording.place(state.time);
    const size = Math.max(0.42 * recording.reachAt(k), this.sized(origin, 26));
    bodyAxes(state.attitude).forEach((axis, a) => {
      const tip = add(origin, scaled(axis, size)), head = 0.05 * size + this.sized(tip, 3);
      lines.world.add(origin, tip, 2.6, AXES[a], 0.95);
      const across = unit(cross(axis, Math.abs(axis[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1]));
      places.cones.add(tip, [0.45 * head, 0.45 * head, 1.3 * head], quaternion(across, cross(axis, across), axis), AXES[a], 1);
      if (this.show.names) this.labels.add(this.renderer.project(add(tip, scaled(axis, 1.9 * head))), "xyz"[a], "axis", 0, `rgb(${AXES[a].map((c) => 255 * c)})`);
    });
    if (Number.isNaN(state.reference[0])) return;
    bodyAxes(state.reference).forEach((axis, a) => {
      lines.world.add(origin, add(origin, scaled(axis, 1.15 * size)), 1.4, AXES[a], 0.4);
    });
  }
}

/** A quaternion of norm 1. */
function normal(q) {
  const size = Math.hypot(...q) || 1;
  return Array.from(q, (x) => x / size);
}

/** The turn of a point's picture: rotors along its thrust, nose along the formation's heading. */
function leaning(thrust, heading) {
  const z = unit(thrust), y = unit(cross(z, Math.abs(dot(z, heading)) > 0.999 ? [0, 1, 0] : heading));
  return quaternion(cross(y, z), y, z);
}

/** An obstacle that is no box along the axes: its surface, where it is, and how much it hides. */
class Solid {
  constructor(info, upload) {
    this.info = info;
    const { corners, triangles } = info, mesh = new Mesh();
    this.low = [0, 1, 2].map((a) => Math.min(...corners.map((p) => p[a])));
    this.high = [0, 1, 2].map((a) => Math.max(...corners.map((p) => p[a])));
    // About its middle: vertices of a mesh are known to a tenth of a millimetre.
    this.middle = mixed(this.low, this.high, 0.5);
    const at = (k) => sub(corners[triangles[k]], this.middle);
    for (let k = 0; k < triangles.length; k += 3) mesh.triangle(at(k), at(k + 1), at(k + 2), OWN);
    this.mesh = upload(mesh);
    this.solid = new Places();
    this.veil = new Places();
    this.fade = 1;
  }

  /** Displacement at a time: straight between waypoints, at rest before and after them. */
  shift(time) {
    const { times, ways } = this.info;
    if (times.length < 2) return ways[0] ?? [0, 0, 0];
    let k = 0;
    while (k < times.length - 2 && times[k + 1] < time) k++;
    const share = (time - times[k]) / (times[k + 1] - times[k]);
    return mixed(ways[k], ways[k + 1], Math.max(0, Math.min(share, 1)));
  }

  /** The last seconds of its middle's way. */
  trail(scene, time, colour) {
    const { times, there: [since] } = this.info, least = since ?? scene.recording.start;
    if (times.length < 2) return;
    // From waypoint to waypoint, and at even times for what fades.
    const begin = Math.max(time - TRAIL, least, scene.recording.start), at = [begin, ...times.filter((t) => t > begin && t < time), time];
    for (let k = 1; k < TRAIL; k++) if (time - k > begin) at.push(time - k);
    at.sort((a, b) => a - b);
    const place = (t) => add(this.middle, this.shift(t)), fresh = (t) => 0.7 * Math.pow(Math.max(0, 1 - (time - t) / TRAIL), 1.4);
    for (let k = 1; k < at.length; k++) scene.lines.world.add(place(at[k - 1]), place(at[k]), 2, colour, fresh(at[k - 1]), fresh(at[k]));
  }

  /** Place it at a time; a zone is a veil, and so is what hides vehicles. True while its opacity changes. */
  place(scene, time, wait) {
    this.solid.clear();
    this.veil.clear();
    const { corners, lines, zone, there } = this.info, [since, until] = there;
    if (time < (since ?? -Infinity) || time > (until ?? Infinity)) return false;
    const shift = this.shift(time), colour = zone ? FENCE : SOLID;
    const goal = scene.hides(add(this.low, shift), add(this.high, shift), scene.state) ? 0.25 : 1;
    this.fade = goal + (this.fade - goal) * Math.exp(-wait / 0.12);
    const moving = Math.abs(this.fade - goal) >= 0.01;
    if (!moving) this.fade = goal;
    const alpha = zone ? 0.12 : this.fade;
    (alpha < 1 ? this.veil : this.solid).add(add(this.middle, shift), 1, NO_TURN, colour, alpha);
    const edge = zone ? FENCE : RIM;
    if (scene.show.trails) this.trail(scene, time, edge);
    for (let k = 0; k < lines.length; k += 2) {
      const a = add(corners[lines[k]], shift), b = add(corners[lines[k + 1]], shift);
      scene.lines.world.add(a, b, 1.2, edge, zone ? 0.5 : 0.25 + 0.35 * alpha);
    }
    return moving;
  }
}

/** A fence or a place with people: walls that fade upwards where they have no end, and hatches where nobody may be. */
class Area {
  constructor({ name, kind, hatched, rings, heights }, info, upload) {
    const all = rings.flat(), low = heights[0] ?? info.ground;
    const wide = [0, 1].map((a) => Math.max(...all.map((p) => p[a])) - Math.min(...all.map((p) => p[a])));
    const high = heights[1] ?? low + 0.5 * Math.max(...wide), full = { soft: 0.05, fence: 0.09, people: 0.13 }[kind];
    const at = ([x, y], z) => [x, y, z], mesh = new Mesh();
    const [far, near] = [heights[1] === null ? 0 : full, full];
    this.name = name;
    this.colour = mixed(kind === "people" ? PEOPLE : FENCE, [1, 1, 1], info.night ? 0.25 : 0);
    this.lines = []; // [from, to, width, opacity]
    for (const ring of rings) {
      ring.forEach((a, k) => {
        const b = ring[(k + 1) % ring.length];
        mesh.triangle(at(a, low), at(b, low), at(b, high), OWN, [near, near, far]);
        mesh.triangle(at(a, low), at(b, high), at(a, high), OWN, [near, far, far]);
        const edge = (z, width, alpha) => this.lines.push(...dashes(at(a, z), at(b, z), kind === "soft" ? 12 : 1).map((line) => [...line, width, alpha]));
        edge(low, 1.8, 0.8);
        if (heights[1] !== null) edge(high, 1, 0.5);
      });
    }
    if (hatched) for (const line of hatches(rings, Math.max(...wide) / HATCHES)) this.lines.push([...line.map((p) => at(p, low)), 1, 0.5]);
    this.top = at(rings[0].reduce((a, b) => (a[1] < b[1] ? a : b)), low);
    this.mesh = upload(mesh);
    this.veil = new Places();
    this.veil.add([0, 0, 0], 1, NO_TURN, this.colour, 1);
  }

  place(scene) {
    for (const [a, b, width, alpha] of this.lines) scene.lines.world.add(a, b, width, this.colour, alpha);
    if (scene.show.names) scene.labels.add(scene.renderer.project(this.top), this.name, "place", 8);
  }
}

/** Pieces of the segment from a to b: one, or `n` with gaps between them. */
const dashes = (a, b, n) => Array.from({ length: n }, (_, k) => [mixed(a, b, k / n), mixed(a, b, (k + (n > 1 ? 0.6 : 1)) / n)]);

/** Slanted lines `step` apart inside rings, where a line has crossed them an odd number of times. */
function hatches(rings, step) {
  const edges = rings.flatMap((ring) => ring.map((a, k) => [a, ring[(k + 1) % ring.length]])), lines = [];
  const level = ([x, y]) => y - x, levels = rings.flat().map(level);
  for (let c = Math.min(...levels) + step / 2; c < Math.max(...levels); c += step) {
    const cut = edges.filter(([a, b]) => level(a) > c !== level(b) > c).map(([a, b]) => mixed(a, b, (c - level(a)) / (level(b) - level(a))));
    cut.sort((a, b) => a[0] - b[0]);
    for (let k = 0; k + 1 < cut.length; k += 2) lines.push([cut[k], cut[k + 1]]);
  }
  return lines;
}

/** Whether the segment from a to b meets a box. */
function meets(a, b, low, high) {
  let from = 0, to = 1;
  for (let s = 0; s < 3; s++) {
    const d = b[s] - a[s];
    if (Math.abs(d) < 1e-9) {
      if (a[s] < low[s] || a[s] > high[s]) return false;
      continue;
    }
    const x = (low[s] - a[s]) / d, y = (high[s] - a[s]) / d;
    from = Math.max(from, Math.min(x, y));
    to = Math.min(to, Math.max(x, y));
  }
  return from < to;
}

// -- labels in the picture -----------------------------------------------------------------------------

/** Labels over the picture; those that would cover an earlier one are left out. */
class Labels {
  constructor(box) {
    this.box = box;
    this.pool = [];
    this.wanted = [];
  }

  clear() {
    this.wanted.length = 0;
  }

  /** A label `lift` pixels above a point (from `Renderer.project`). */
  add(point, text, kind, lift, colour = "") {
    if (point) this.wanted.push({ x: point[0], y: point[1] - lift, far: point[2], text, kind, colour });
  }

  flush() {
    const { wanted, pool, box } = this, taken = [];
    const rank = (label) => ({ axis: 0, agent: 1, now: 2, place: 3 })[label.kind];
    wanted.sort((a, b) => rank(a) - rank(b) || a.far - b.far);
    let used = 0;
    for (const label of wanted) {
      const half = (label.kind === "now" ? 4.2 : 3.4) * label.text.length + 3, wide = box.clientWidth;
      if (label.x < -half || label.x > wide + half || label.y < 0 || label.y > box.clientHeight + 9) continue;
      // Labels of visible things are kept inside the picture, too.
      if (label.x > 0 && label.x < wide && wide > 2 * half) label.x = Math.max(half, Math.min(label.x, wide - half));
      const covers = (t) => Math.abs(t.x - label.x) < t.half + half && Math.abs(t.y - label.y) < 13;
      if (label.kind !== "agent" && label.kind !== "axis" && taken.some(covers)) continue;
      taken.push({ ...label, half });
      const span = (pool[used] ??= box.appendChild(document.createElement("span")));
      used++;
      if (span.textContent !== label.text) span.textContent = label.text;
      if (span.className !== label.kind) span.className = label.kind;
      if (span.style.color !== label.colour) span.style.color = label.colour;
      span.style.transform = `translate(-50%, -50%) translate(${label.x.toFixed(1)}px, ${label.y.toFixed(1)}px)`;
      span.hidden = false;
    }
    for (; used < pool.length; used++) pool[used].hidden = true;
  }
}
