// One try: plan, predict, execute, once or again every ten steps. Runs in the worker, and in node for tests.
import { CAPACITY, Kernel } from './kernel.js';
import { loadNetwork } from './networks.js';
import { World } from './physics.js';
import { Direct, Latent, cem, returns } from './planning.js';
import { normal } from './random.js';

export const SAMPLES = 32; // futures of the fan, and behind a predicted return, as in tsmlib.planning.predictors
export const EVERY = 10; // steps executed before the next plan
const L = 10, DU = 2;

/** Networks and arms of a page, loaded when they are first asked for. */
export class Library {
  constructor(manifest, kernel, mujoco, reader) {
    Object.assign(this, { manifest, kernel, mujoco, reader, loaded: new Map() });
  }

  static async load(manifest, mujoco, reader) {
    return new Library(manifest, await Kernel.load(reader), mujoco, reader);
  }

  once(key, load) {
    if (!this.loaded.has(key)) this.loaded.set(key, load());
    return this.loaded.get(key);
  }

  network(task, word) {
    const about = this.manifest.tasks[task], of = word === 'prior' ? about.prior : about.models[word];
    return this.once(of.file, () => loadNetwork(this.kernel, of, about.stateDim, this.reader));
  }

  world(task) {
    const { physics } = this.manifest.tasks[task];
    return this.once(physics.file, () => World.load(this.mujoco, physics, task, this.manifest.arm.links, this.reader));
  }
}

const repeated = (values, n) => {
  const found = new Float32Array(n * values.length);
  for (let row = 0; row < n; row++) found.set(values, row * values.length);
  return found;
};

/** The ten steps before the next one, of executed states and actions; before the start, standing still. */
function recent(start, states, actions, dx) {
  const past = { states: new Float32Array(L * dx), actions: new Float32Array(L * DU) }, done = actions.length / DU;
  for (let k = 0; k < L; k++) {
    const t = done - L + k; // actions[t] led to states[t]
    past.states.set(t < 0 ? start : states.slice(t * dx, (t + 1) * dx), k * dx);
    if (t >= 0) past.actions.set(actions.slice(t * DU, (t + 1) * DU), k * DU);
  }
  return past;
}

/** What a model predicts for a plan: the mode, and samples where it has codes. */
function predict(net, past, actions, horizon, seed, dx) {
  const mode = net.rollout(4, past, repeated(actions, 4), horizon).slice(0, horizon * dx);
  if (!net.about.codes) return { mode, samples: null };
  const draw = normal(seed), codes = new Float32Array(SAMPLES * Math.ceil(horizon / net.about.hold) * net.about.codes);
  for (let i = 0; i < codes.length; i++) codes[i] = draw();
  return { mode, samples: net.rollout(SAMPLES, past, repeated(actions, SAMPLES), horizon, codes) };
}

/** Candidates that fit into the time that a step of the arm takes, at the speed measured so far; a multiple of 4. */
export function affordable(msPerStep, steps, iterations, budget) {
  const fits = Math.floor(budget / (msPerStep * steps * iterations) / 4) * 4;
  return Math.max(12, Math.min(CAPACITY, fits));
}

/**
 * Run a try. Asynchronous generator of events:
 *   { type: 'progress', iteration, of, value }
 *   { type: 'part', from, predicted (T - from, dx), fan (32, T - from, 2) or null, actions, executed (steps, dx), ms, candidates }
 *   { type: 'done', predicted, executed, distance, success, mode }: the returns of the whole episode, as in the tables
 *
 * scene: { task, model, space, replan, start (dx), target (2), seed }. budget: milliseconds for each later plan, or
 * Infinity for the full search. keep: is told the past and the plan of each part, for ``imagine``.
 */
export async function* attempt(library, scene, { first = { candidates: CAPACITY, iterations: 6 }, again = { candidates: CAPACITY, iterations: 4 }, budget = Infinity, keep = () => {} } = {}) {
  const { task, model, space, replan, start, target, seed } = scene, about = library.manifest.tasks[task];
  const [net, prior, world] = await Promise.all([library.network(task, model), library.network(task, 'prior'), library.world(task)]);
  const dx = about.stateDim, T = about.horizon, place = { dx, position: task === 'push' ? 6 : 4 };
  const states = [], actions = [];
  let search = null, left, predicted = 0, rate = 0;
  world.reset(start);
  for (let from = 0; from < T; from += EVERY) {
    const began = performance.now(), horizon = T - from, past = recent(start, states, actions, dx);
    search = space === 'latent' ? new Latent(prior, horizon, past.actions) : new Direct(horizon);
    const { iterations, ...most } = from ? again : first;
    const candidates = from ? Math.min(most.candidates, affordable(rate, horizon, iterations, budget)) : most.candidates;
    const judge = (rows, parameters) => {
      const torques = search.decode(rows, parameters);
      return returns(rows, net.rollout(rows, past, torques, horizon), torques, target, place);
    };
    const planning = cem(search, judge, { start: left, candidates, iterations, seed: seed + 1000 * from });
    let step = planning.next();
    for (; !step.done; step = planning.next()) yield { type: 'progress', from, ...step.value, of: iterations };
    const plan = search.decode(4, repeated(step.value.parameters, 4)).slice(0, horizon * DU);
    rate = (performance.now() - began) / ((candidates + 4) * iterations * horizon);
    const { mode, samples } = predict(net, past, plan, horizon, seed + 1000 * from + 1, dx);
    if (!from) {
      const rows = samples ? SAMPLES : 1, of = returns(rows, samples ?? mode, samples ? repeated(plan, rows) : plan, target, place);
      predicted = of.reduce((a, b) => a + b) / rows;
    }
    keep({ net, past, plan, horizon, from });
    const steps = replan ? EVERY : T, executed = world.advance(plan.subarray(0, steps * DU));
    for (const x of executed) states.push(x);
    actions.push(...plan.subarray(0, steps * DU));
    left = replan ? search.left(step.value.parameters, EVERY) : undefined;
    const fan = samples && Float32Array.from({ length: SAMPLES * horizon * 2 }, (_, i) => samples[(i >> 1) * dx + place.position + (i & 1)]);
    yield { type: 'part', from, predicted: mode, fan, actions: plan, executed, ms: performance.now() - began, candidates };
    if (!replan) break;
  }
  const end = (T - 1) * dx + place.position, distance = Math.hypot(states[end] - target[0], states[end + 1] - target[1]);
  const [executed] = returns(1, states, actions, target, place);
  yield { type: 'done', predicted, executed, distance, success: distance < about.tolerance };
}

/** States (T, dx) of a kept plan with two numbers of the code turned, for all of its segments. */
export function imagine({ net, past, plan, horizon }, knobs, values) {
  const { codes, hold } = net.about, segments = Math.ceil(horizon / hold), z = new Float32Array(4 * segments * codes);
  for (let k = 0; k < 4 * segments; k++) knobs.forEach((knob, i) => { z[k * codes + knob] = values[i]; });
  const states = net.rollout(4, past, repeated(plan, 4), horizon, z);
  return states.slice(0, states.length / 4);
}
