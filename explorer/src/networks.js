// The networks of tsmlib.models, free-running, for many candidates (rows) from one past.
//
// A past is { states (10, dx), actions (10, du) }: actions[k] led to states[k]. Results are states (rows, T, dx) under
// actions (rows, T, du). Codes are (rows, K, dz), each held for ``hold`` steps; without codes, the mode (z = 0).
import { CAPACITY } from './kernel.js';
import { readArrays } from './files.js';

const DU = 2, ANGLES = 2, L = 10;

/** A rollout in progress: where the state x_i and the action u_i that was taken in it are, i from -9 on. */
class Course {
  constructor(dx, past, actions, horizon, rows) {
    Object.assign(this, { dx, past, actions, horizon, rows, states: new Float32Array(rows * horizon * dx) });
  }

  state(row, i) { // x_i: [array, index]
    return i <= 0 ? [this.past.states, (L - 1 + i) * this.dx] : [this.states, (row * this.horizon + i - 1) * this.dx];
  }

  action(row, i) { // u_i
    return i < 0 ? [this.past.actions, (L + i) * DU] : [this.actions, (row * this.horizon + i) * DU];
  }

  /** x_{i+1} = x_i + step, from rows of ``width`` numbers. */
  advance(i, step, width) {
    for (let row = 0; row < this.rows; row++) {
      const [from, at] = this.state(row, i), to = (row * this.horizon + i) * this.dx;
      for (let d = 0; d < this.dx; d++) this.states[to + d] = from[at + d] + step[row * width + d];
    }
  }
}

/** Features of a state, standardised, and the action beside them (features.py). */
class Inputs {
  constructor(arrays, dx) {
    Object.assign(this, { dx, mean: arrays.mean.data, std: arrays.std.data, n: dx + ANGLES + DU });
  }

  write(course, i, to, width, offset, rows = course.rows) {
    const { mean, std } = this;
    for (let row = 0; row < rows; row++) {
      const [x, a] = course.state(row, i), [u, b] = course.action(row, i);
      let k = row * width + offset, f = 0;
      for (let d = 0; d < ANGLES; d++, f++) to[k++] = (Math.cos(x[a + d]) - mean[f]) / std[f];
      for (let d = 0; d < ANGLES; d++, f++) to[k++] = (Math.sin(x[a + d]) - mean[f]) / std[f];
      for (let d = ANGLES; d < this.dx; d++, f++) to[k++] = (x[a + d] - mean[f]) / std[f];
      for (let d = 0; d < DU; d++) to[k++] = u[b + d];
    }
  }
}

/** Codes of one segment (rows, dz), out of (rows, K, dz); zeros after the last. */
function segmentCodes(codes, k, rows, dz) {
  const found = new Float32Array(rows * dz);
  if (!codes) return found;
  const wide = codes.length / rows;
  for (let row = 0; row < rows && (k + 1) * dz <= wide; row++) {
    found.set(codes.subarray(row * wide + k * dz, row * wide + (k + 1) * dz), row * dz);
  }
  return found;
}

/** One-step and multi-step: x_{t+1} = x_t + f(x_t, u_t). */
class Feedforward {
  constructor(kernel, about, arrays, dx) {
    Object.assign(this, { kernel, about, dx });
    this.inputs = new Inputs(arrays, dx);
    this.layers = [...Array(about.layers).keys(), 'last'].map(name => kernel.layer(arrays, `${name}`));
    this.x = kernel.room(CAPACITY * this.inputs.n);
    this.y = this.layers.map(layer => kernel.room(CAPACITY * layer.nout));
  }

  rollout(rows, past, actions, horizon) {
    const { kernel, inputs, layers, y } = this, course = new Course(this.dx, past, actions, horizon, rows);
    for (let t = 0; t < horizon; t++) {
      inputs.write(course, t, kernel.view(this.x, rows * inputs.n), inputs.n, 0);
      let at = this.x;
      layers.forEach((layer, k) => {
        kernel.linear(layer, at, y[k], rows);
        at = y[k];
        if (layer !== layers.at(-1)) kernel.exports.silu(at, rows * layer.nout);
      });
      course.advance(t, kernel.view(at, rows * layers.at(-1).nout), layers.at(-1).nout);
    }
    return course.states;
  }
}

/** The recurrent TSM and the LSTM (recurrence.py): one row holds [h, s, u], into which the cell writes the next h. */
class Recurrent {
  constructor(kernel, about, arrays, dx) {
    Object.assign(this, { kernel, about, dx });
    this.inputs = new Inputs(arrays, dx);
    this.cell = kernel.layer(arrays, 'cell');
    this.n = this.cell.nout / 4;
    this.width = this.n + this.inputs.n;
    this.codes = about.codes ? kernel.layer(arrays, 'codes') : null;
    this.hidden = 'hidden.w' in arrays ? kernel.layer(arrays, 'hidden') : null;
    this.last = kernel.layer(arrays, 'last');
    this.row = kernel.room(CAPACITY * this.width);
    this.q = kernel.room(CAPACITY * 4 * this.n);
    this.init = kernel.room(CAPACITY * 4 * this.n);
    this.c = kernel.room(CAPACITY * this.n);
    this.z = kernel.room(CAPACITY * Math.max(1, about.codes));
    this.inner = this.hidden ? kernel.room(CAPACITY * this.hidden.nout) : 0;
    this.out = kernel.room(CAPACITY * this.last.nout);
  }

  rollout(rows, past, actions, horizon, codes = null) {
    const { kernel, inputs, n, width, hidden, last } = this, { exports } = kernel;
    const course = new Course(this.dx, past, actions, horizon, rows);
    const step = (i, many, given) => {
      inputs.write(course, i, kernel.view(this.row, many * width), width, n, many);
      kernel.linear(this.cell, this.row, this.q, many, given);
      exports.cell(this.q, this.c, this.row, width, many, n);
    };
    kernel.view(this.row, 4 * width).fill(0);
    kernel.view(this.c, 4 * n).fill(0);
    for (let i = 1 - L; i < 0; i++) step(i, 4, {}); // the past is the same for all rows
    const row = kernel.view(this.row, rows * width), c = kernel.view(this.c, rows * n);
    for (let r = 1; r < rows; r++) {
      row.copyWithin(r * width, 0, n);
      c.copyWithin(r * n, 0, n);
    }
    let given = {};
    for (let t = 0; t < horizon; t++) {
      if (codes && t % this.about.hold === 0) {
        kernel.view(this.z, rows * this.about.codes).set(segmentCodes(codes, t / this.about.hold, rows, this.about.codes));
        kernel.linear(this.codes, this.z, this.init, rows, { init: this.cell.b });
        given = { init: this.init, stride: 4 * n };
      }
      step(t, rows, given);
      if (hidden) {
        kernel.linear(hidden, this.row, this.inner, rows, { xs: width });
        exports.silu(this.inner, rows * hidden.nout);
        kernel.linear(last, this.inner, this.out, rows);
      } else {
        kernel.linear(last, this.row, this.out, rows, { xs: width });
      }
      course.advance(t, kernel.view(this.out, rows * last.nout), last.nout);
    }
    return course.states;
  }
}

/** A stack of gated dilated causal layers (Eq. 1), one position at a time, each layer's last inputs in a ring. */
class Stack {
  constructor(kernel, about, arrays) {
    this.kernel = kernel;
    this.inlet = kernel.layer(arrays, 'inlet');
    const C = this.C = this.inlet.nout;
    this.layers = about.dilations.map((dilation, k) => ({
      dilation,
      earlier: kernel.layer(arrays, `${k}.earlier`),
      now: kernel.layer(arrays, `${k}.now`),
      out: kernel.layer(arrays, `${k}.out`),
      codes: kernel.layer(arrays, `${k}.codes`),
      coded: kernel.room(CAPACITY * 2 * C),
      ring: Array.from({ length: dilation + 1 }, () => kernel.room(CAPACITY * C)),
    }));
    this.head = ['hidden', 'last'].filter(name => `${name}.w` in arrays).map(name => kernel.layer(arrays, name));
    this.width = this.head.at(-1).nout;
    this.x = kernel.room(CAPACITY * this.inlet.nin);
    this.z = kernel.room(CAPACITY * about.codes);
    [this.y, this.h, this.spare, this.total] = [2 * C, C, C, C].map(n => kernel.room(CAPACITY * n));
    this.outputs = this.head.map(layer => kernel.room(CAPACITY * layer.nout));
  }

  begin(rows, z) {
    const { kernel, C } = this;
    this.position = 0;
    kernel.view(this.z, z.length).set(z);
    for (const { ring, codes, earlier, coded } of this.layers) {
      for (const at of ring) kernel.view(at, rows * C).fill(0);
      kernel.linear(codes, this.z, coded, rows, { init: earlier.b });
    }
  }

  /** One position: inputs at ``x``; the address of outputs, rows of ``width`` numbers, where they are ``wanted``. */
  step(rows, wanted) {
    const { kernel, C, layers, y, h, total } = this, { exports } = kernel, t = this.position++;
    const input = ({ ring, dilation }, back) => ring[(t + dilation + 1 - back) % (dilation + 1)];
    kernel.linear(this.inlet, this.x, input(layers[0], 0), rows);
    layers.every((layer, k) => {
      const now = input(layer, 0), isLast = k + 1 === layers.length;
      if (isLast && !wanted) return false;
      kernel.linear(layer.earlier, input(layer, layer.dilation), y, rows, { init: layer.coded, stride: 2 * C });
      kernel.linear(layer.now, now, y, rows, { init: y, stride: 2 * C });
      exports.gate(y, h, rows, C);
      kernel.linear(layer.out, h, y, rows);
      exports.share(y, now, isLast ? this.spare : input(layers[k + 1], 0), total, rows, C, k === 0 ? 1 : 0);
      return true;
    });
    if (!wanted) return 0;
    exports.relu(total, rows * C);
    return this.head.reduce((at, layer, k) => {
      kernel.linear(layer, at, this.outputs[k], rows);
      if (k + 1 < this.head.length) exports.relu(this.outputs[k], rows * layer.nout);
      return this.outputs[k];
    }, total);
  }
}

/** TSM: a stack that reads each segment anew from the ten steps before it. */
class Gated {
  constructor(kernel, about, arrays, dx) {
    Object.assign(this, { kernel, about, dx, inputs: new Inputs(arrays, dx), stack: new Stack(kernel, about, arrays) });
  }

  rollout(rows, past, actions, horizon, codes = null) {
    const { kernel, inputs, stack, about } = this, course = new Course(this.dx, past, actions, horizon, rows);
    for (let from = 0; from < horizon; from += about.hold) {
      stack.begin(rows, segmentCodes(codes, from / about.hold, rows, about.codes));
      for (let i = from - L + 1; i < Math.min(from + about.hold, horizon); i++) {
        inputs.write(course, i, kernel.view(stack.x, rows * inputs.n), inputs.n, 0);
        const out = stack.step(rows, i >= from);
        if (i >= from) course.advance(i, kernel.view(out, rows * stack.width), stack.width);
      }
    }
    return course.states;
  }
}

/** The action prior (Eq. 3): codes (rows, K, dz) after past actions (10, du) to actions (rows, K H, du). */
class Prior {
  constructor(kernel, about, arrays) {
    Object.assign(this, { kernel, about, std: arrays.std.data, stack: new Stack(kernel, about, arrays) });
  }

  decode(rows, past, codes) {
    const { kernel, stack, about: { hold: H, codes: dz }, std } = this, K = codes.length / rows / dz, T = K * H;
    const actions = new Float32Array(rows * T * DU), action = (row, i) => // u_i
      (i < 0 ? [past, (L + i) * DU] : [actions, (row * T + i) * DU]);
    for (let k = 0; k < K; k++) {
      stack.begin(rows, segmentCodes(codes, k, rows, dz));
      for (let i = k * H - L; i < k * H + H - 1; i++) {
        const x = kernel.view(stack.x, rows * DU), wanted = i >= k * H - 1;
        for (let row = 0; row < rows; row++) {
          const [u, at] = action(row, i);
          for (let d = 0; d < DU; d++) x[row * DU + d] = u[at + d] / std[d];
        }
        const out = stack.step(rows, wanted);
        if (!wanted) continue;
        const step = kernel.view(out, rows * stack.width);
        for (let row = 0; row < rows; row++) {
          const [u, at] = action(row, i), to = (row * T + i + 1) * DU;
          for (let d = 0; d < DU; d++) actions[to + d] = Math.min(1, Math.max(-1, u[at + d] + step[row * stack.width + d]));
        }
      }
    }
    return actions;
  }
}

const KINDS = { feedforward: Feedforward, recurrent: Recurrent, gated: Gated, prior: Prior };

export async function loadNetwork(kernel, about, dx, reader) {
  return new KINDS[about.kind](kernel, about, await readArrays(about, reader), dx);
}
