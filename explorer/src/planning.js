// Search spaces and the cross-entropy method, as in tsmlib.planning, and the reward of the tasks.
import { CAPACITY } from './kernel.js';
import { normal } from './random.js';

const DU = 2;

/** Return (rows) of states (rows, T, dx) under actions: minus distance (m) and squared torque, summed over T steps. */
export function returns(rows, states, actions, target, { dx, position }) {
  const T = actions.length / rows / DU, found = new Float64Array(rows);
  for (let row = 0; row < rows; row++) {
    for (let t = 0; t < T; t++) {
      const i = (row * T + t) * dx + position, j = (row * T + t) * DU;
      found[row] -= Math.sqrt((states[i] - target[0]) ** 2 + (states[i + 1] - target[1]) ** 2 + 1e-12)
        + actions[j] ** 2 + actions[j + 1] ** 2;
    }
  }
  return found;
}

/** Eq. 3: one code per segment of the action prior. */
export class Latent {
  constructor(prior, horizon, pastActions) {
    Object.assign(this, { prior, horizon, pastActions, scale: 1 });
    this.size = Math.ceil(horizon / prior.about.hold) * prior.about.codes;
  }

  decode(rows, parameters) {
    return this.prior.decode(rows, this.pastActions, parameters);
  }

  noise(draw, to) {
    for (let i = 0; i < to.length; i++) to[i] = draw();
  }

  /** The plan that is left when ``steps`` actions, whole segments, are done. */
  left(parameters, steps) {
    return parameters.slice(steps / this.prior.about.hold * this.prior.about.codes);
  }
}

/** Eq. 2: the torques themselves, squashed by tanh; the noise is as smooth as the training torques. */
export class Direct {
  constructor(horizon) {
    Object.assign(this, { horizon, scale: 0.1, size: horizon * DU });
  }

  decode(rows, parameters) {
    return parameters.map(Math.tanh);
  }

  noise(draw, to) { // tsmlib.collection.smooth_torques after 20 steps, over its root mean square of 0.1
    const keep = Math.exp(-0.02 / 0.03), settle = 20;
    const settled = (1 - keep) ** 2 * Math.sqrt((1 + keep ** 2) / (1 - keep ** 2) ** 3);
    const once = [0, 0], twice = [0, 0];
    for (let t = 0; t < settle + this.horizon; t++) {
      for (let d = 0; d < DU; d++) {
        once[d] = keep * once[d] + (1 - keep) * draw();
        twice[d] = keep * twice[d] + (1 - keep) * once[d];
        if (t >= settle) to[(t - settle) * DU + d] = Math.min(1, Math.max(-1, twice[d] * 0.1 / settled)) / 0.1;
      }
    }
  }

  left(parameters, steps) {
    return parameters.slice(steps * DU);
  }
}

/**
 * Cross-entropy method (planners.py): sample around a mean, refit it to the elites, keep the best ever seen.
 *
 * near: the noise of every other first candidate, as a share of the others'. judge(rows, parameters) -> promise of returns, rows a multiple of 4 up to CAPACITY. Yields after each iteration, so
 * that whoever asks can show it or stop; its last value is { parameters, value }.
 */
export async function* cem(space, judge, { start = new Float32Array(space.size), candidates = CAPACITY, iterations = 6, elites = Math.max(2, Math.floor(candidates / 10)), keep = 0.1, seed = 0, near = 1 } = {}) {
  const n = space.size, draw = normal(seed), noise = new Float32Array(n);
  const mean = Float64Array.from(start), deviation = new Float64Array(n).fill(space.scale);
  const judgeOne = async parameters => {
    const four = new Float32Array(4 * n);
    for (let row = 0; row < 4; row++) four.set(parameters, row * n);
    return (await judge(4, four))[0];
  };
  let best = { parameters: Float32Array.from(start), value: await judgeOne(start) };
  const update = (parameters, value) => {
    if (Number.isFinite(value) && !(value <= best.value)) best = { parameters: Float32Array.from(parameters), value };
  };
  for (let iteration = 0; iteration < iterations; iteration++) {
    const parameters = new Float32Array(candidates * n);
    for (let row = 0; row < candidates; row++) {
      space.noise(draw, noise);
      for (let i = 0; i < n; i++) parameters[row * n + i] = mean[i] + (iteration || row % 2 === 0 ? 1 : near) * deviation[i] * noise[i];
    }
    if (iteration) parameters.set(mean, 0); // in the place of the best so far, whose return is known
    const found = await judge(candidates, parameters);
    if (iteration) {
      update(mean, found[0]);
      parameters.set(best.parameters, 0);
      found[0] = best.value;
    }
    const worst = Math.min(0, ...found.filter(Number.isFinite)); // a candidate on which the model diverges
    const order = [...found.keys()].sort((a, b) => (Number.isFinite(found[b]) ? found[b] : worst) - (Number.isFinite(found[a]) ? found[a] : worst));
    for (let i = 0; i < n; i++) {
      let average = 0, square = 0;
      for (let e = 0; e < elites; e++) average += parameters[order[e] * n + i] / elites;
      for (let e = 0; e < elites; e++) square += (parameters[order[e] * n + i] - average) ** 2;
      mean[i] = keep * mean[i] + (1 - keep) * average;
      deviation[i] = keep * deviation[i] + (1 - keep) * Math.sqrt(square / (elites - 1));
    }
    const top = order[0];
    update(parameters.subarray(top * n, (top + 1) * n), found[top]);
    yield { iteration: iteration + 1, value: best.value };
  }
  update(mean, await judgeOne(mean));
  return best;
}
