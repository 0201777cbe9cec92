// A flight as samples at even times, and its state at any time in between.

import { grown, unit } from "./gl.js";

/** Read what `pack.py` has written: columns {name, width, step}, one after the other in `text`. */
export async function unpack(text, columns, count) {
  const letters = atob(text.trim()), packed = new Uint8Array(letters.length);
  for (let k = 0; k < letters.length; k++) packed[k] = letters.charCodeAt(k);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const out = {};
  let start = 0;
  for (const { name, width, step } of columns) {
    const n = count * width, data = new Float32Array(n);
    for (let c = 0; c < width; c++) {
      let value = 0, rise = 0; // second differences along time, in four planes of bytes
      for (let k = 0; k < count; k++) {
        const at = start + c * count + k;
        rise = (rise + (bytes[at] | (bytes[at + n] << 8) | (bytes[at + 2 * n] << 16) | (bytes[at + 3 * n] << 24))) | 0;
        value = (value + rise) | 0;
        data[k * width + c] = value === -2147483648 ? NaN : value * step;
      }
    }
    start += 4 * n;
    out[name] = data;
  }
  return out;
}

export class Recording {
  /** `info` describes the flight; `columns` name to samples (count x width); times from info.start by info.step [s]. */
  constructor(info, columns, count) {
    this.info = info;
    this.columns = columns;
    this.count = count;
    this.widths = Object.fromEntries(info.columns.map(({ name, width }) => [name, width]));
    this.state = { time: info.start, phase: 0 };
    for (const name in this.widths) this.state[name] = new Float32Array(this.widths[name]);
    this.reach = [];
  }

  get start() {
    return this.info.start;
  }

  get end() {
    return this.info.start + Math.max(this.count - 1, 0) * this.info.step;
  }

  /** Forget the first samples. */
  forget(samples) {
    for (const name in this.widths) this.columns[name] = this.columns[name].slice(samples * this.widths[name]);
    this.reach.splice(0, samples);
    this.count -= samples;
    this.info.start += samples * this.info.step;
  }

  /** Add a sample, values by name. */
  append(values) {
    for (const name in this.widths) {
      const width = this.widths[name];
      let data = this.columns[name] ?? new Float32Array(256 * width);
      if ((this.count + 1) * width > data.length) data = grown(data);
      data.set(values[name], this.count * width);
      this.columns[name] = data;
    }
    this.count++;
  }

  /** Index of the sample nearest to a time. */
  nearest(time) {
    const [k, f] = this.place(time);
    return k + Math.round(f);
  }

  /** Index of the sample before a time, and how far it is to the next (0 to 1). */
  place(time) {
    const x = this.info.step > 0 ? (time - this.info.start) / this.info.step : 0;
    const k = Math.max(0, Math.min(Math.floor(x), this.count - 2));
    return [k, this.count > 1 ? Math.max(0, Math.min(x - k, 1)) : 0];
  }

  /** The state at a time; the next call reuses the object. */
  at(time) {
    const { state } = this, [k, f] = this.place(time);
    state.time = time;
    state.phase = this.phaseAt(time);
    for (const name in this.widths) {
      if (name === "position" || name === "cm") this.smooth(name, k, f, state[name]);
      else this.straight(name, k, f, state[name]);
    }
    return state;
  }

  phaseAt(time) {
    const { phases } = this.info;
    let k = 0;
    while (k + 1 < phases.length && phases[k + 1].start <= time + 1e-9) k++;
    return k;
  }

  /** Linear interpolation between two samples; if one has no value, the nearer one. */
  straight(name, k, f, out) {
    const width = out.length, data = this.columns[name], a = k * width, b = this.count > 1 ? a + width : a;
    for (let c = 0; c < width; c++) {
      const low = data[a + c], high = data[b + c];
      out[c] = Number.isNaN(low + high) ? (f < 0.5 ? low : high) : low + f * (high - low);
    }
  }

  /** Smooth interpolation through the samples (Catmull and Rom). */
  smooth(name, k, f, out) {
    const width = out.length, data = this.columns[name], last = this.count - 1;
    const row = (i) => width * Math.max(0, Math.min(i, last));
    const [a, b, c, d] = [row(k - 1), row(k), row(k + 1), row(k + 2)];
    for (let s = 0; s < width; s++) {
      const p = data[a + s], q = data[b + s], r = data[c + s], t = data[d + s];
      out[s] = q + 0.5 * f * (r - p + f * (2 * p - 5 * q + 4 * r - t + f * (3 * (q - r) + t - p)));
    }
  }

  /** Largest distance [m] of a vehicle from the centre of mass at a sample. */
  reachAt(k) {
    if (this.reach[k] === undefined) {
      const { position, cm } = this.columns, n = this.widths.position / 3;
      const { radius } = this.info, x = cm[3 * k], y = cm[3 * k + 1], z = cm[3 * k + 2];
      let most = 0;
      for (let i = 0, at = 3 * k * n; i < n; i++, at += 3) {
        const a = position[at] - x, b = position[at + 1] - y, c = position[at + 2] - z, far = a * a + b * b + c * c, rest = most - radius[i];
        if (rest < 0 || far > rest * rest) most = Math.max(most, Math.sqrt(far) + radius[i]);
      }
      this.reach[k] = most;
    }
    return this.reach[k];
  }
}

/** Axes x, y, z of the body in the world, from the quaternion [w, x, y, z] world to body. */
export function bodyAxes([w, x, y, z]) {
  return [
    [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z],
  ].map(unit);
}
