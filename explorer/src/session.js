// One try: plan, predict, execute, once or again every ten steps. Runs in the worker, and in node for tests.
import { CAPACITY, Kernel } from './kernel.js';
import { loadNetwork } from './networks.js';
import { World } from './physics.js';
import { Direct, Latent, cem, returns } from './planning.js';
import { normal } from './random.js';

export const SAMPLES = 32; // futures of the fan, and behind a predicted return, as in tsmlib.planning.predictors
export const EVERY = 10; // steps executed before the next plan
const FEWEST = 12; // candidates of a later plan, at least
const ROUNDS = 8; // searches for the first plan, at most
const PATIENCE = 2; // searches in a row that better nothing, after which it ends
const BETTER = 0.05; // of return, by which a search has to better the best plan
const NEAR = 0.3; // share of its noise by which half of a later search stays near what is left of the plan before
const ALONE = 8; // rows in which CEM judges its start and its last mean
const L = 10, DU = 2;

/** Networks and arms of a page, loaded when they are first asked for. helpers: other workers that judge candidates. */
export class Library {
  constructor(manifest, kernel, mujoco, reader) {
    Object.assign(this, { manifest, kernel, mujoco, reader, loaded: new Map(), helpers: [] });
  }

  static async load(manifest, mujoco, reader) { // the kernel first: it says what a browser lacks
    return new Library(manifest, await Kernel.load(reader), await mujoco, reader);
  }

  once(key, load) {
    if (!this.loaded.has(key)) this.loaded.set(key, load());
    return this.loaded.get(key);
  }

  network(task, about) {
    return this.once(about.file, () => loadNetwork(this.kernel, about, this.manifest.tasks[task].stateDim, this.reader));
  }

  model(task, word) {
    return this.network(task, this.manifest.tasks[task].models[word].network);
  }

  prior(task) {
    return this.network(task, this.manifest.tasks[task].prior);
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

/** What a network predicts for a plan: its mode (T, dx), and samples (SAMPLES, T, dx) where it has codes. */
function predict(network, past, actions, horizon, seed, dx) {
  const { codes, hold } = network.about, mode = network.rollout(4, past, repeated(actions, 4), horizon).slice(0, horizon * dx);
  if (!codes) return { mode, samples: null };
  const z = Float32Array.from({ length: SAMPLES * Math.ceil(horizon / hold) * codes }, normal(seed)); // one for every segment
  return { mode, samples: network.rollout(SAMPLES, past, repeated(actions, SAMPLES), horizon, z).slice() };
}

/** Eq. 3 or Eq. 2, for the rest of an episode. */
function searchSpace(space, prior, past, horizon) {
  return space === 'latent' ? new Latent(prior, horizon, past.actions) : new Direct(horizon);
}

const measured = (task, dx) => ({ dx, position: task === 'push' ? 6 : 4 });

/**
 * Returns (rows) of candidates over a model's mode.
 * question: { task, model, space, past, horizon, target }; parameters: (rows, ...) of the search space
 */
export async function evaluate(library, { task, model, space, past, horizon, target }, rows, parameters) {
  const [network, prior] = await Promise.all([library.model(task, model), library.prior(task)]);
  const actions = searchSpace(space, prior, past, horizon).decode(rows, parameters);
  const states = network.rollout(rows, past, actions, horizon);
  return returns(rows, states, actions, target, measured(task, library.manifest.tasks[task].stateDim));
}

/** Returns (rows) by which CEM judges candidates, shared out among this worker and its helpers. */
export async function judge(library, question, rows, parameters) {
  const workers = [(...job) => evaluate(library, ...job), ...library.helpers], width = parameters.length / rows;
  const many = Math.ceil(rows / 4 / workers.length) * 4, starts = [];
  for (let from = 0; from < rows; from += many) starts.push(from);
  const done = await Promise.all(starts.map((from, k) => { // this worker computes when all others have been asked
    const to = Math.min(rows, from + many);
    return workers[k](question, to - from, parameters.slice(from * width, to * width));
  }));
  const found = new Float64Array(rows);
  starts.forEach((from, k) => found.set(done[k], from));
  return found;
}

/** The search that fits into ``budget`` (ms) at the speed measured so far: fewer candidates, then fewer iterations. */
export function affordable({ candidates, iterations }, msPerStep, steps, budget) {
  const fits = budget / (msPerStep * steps) - ALONE; // candidates of all iterations
  const many = Math.min(candidates, Math.max(FEWEST, Math.floor(fits / iterations / 4) * 4));
  return { candidates: many, iterations: Math.min(iterations, Math.max(1, Math.floor(fits / many))) };
}

/** A plan as the tables judge it: its return in the mean over futures, which are the same for every plan of one step. */
function judged(network, past, plan, horizon, seed, target, place) {
  const { mode, samples } = predict(network, past, plan, horizon, seed, place.dx), rows = samples ? SAMPLES : 1;
  const found = returns(rows, samples ?? mode, samples ? repeated(plan, rows) : plan, target, place);
  return { mode, samples, value: found.reduce((a, b) => a + b) / rows };
}

/**
 * Run a try. The search for the first plan goes on, from the best plan so far and anew by turns, until it betters nothing any
 * more; each plan that betters the best is executed and shown in its place. Asynchronous generator of events:
 *   { type: 'progress', iteration, of, round, value }
 *   { type: 'part', from, round, predicted (T - from, dx), fan (32, T - from, 2) or null, actions, executed (steps, dx), ms, candidates, iterations },
 *   which where from is 0 comes again, in place of the one before, with a better plan
 *   { type: 'done', predicted, executed, distance, success, mode }: the returns of the whole episode, as in the tables
 *
 * scene: { task, model, space, replan, start (dx), target (2), seed }. budget: milliseconds for each later plan, or
 * Infinity for the full search. keep: is told the past and the plan of each part, for ``imagine``.
 */
export async function* attempt(library, scene, { first = { candidates: CAPACITY, iterations: 6 }, again = { candidates: CAPACITY, iterations: 4 }, budget = Infinity, rounds = ROUNDS, keep = () => {} } = {}) {
  const { task, model, space, replan, start, target, seed } = scene, about = library.manifest.tasks[task];
  const [network, prior, world] = await Promise.all([library.model(task, model), library.prior(task), library.world(task)]);
  const dx = about.stateDim, T = about.horizon, place = measured(task, dx);
  const states = [], actions = [];
  let search = null, left, predicted = 0, rate = 0;
  world.reset(start);
  for (let from = 0; from < T; from += EVERY) {
    const began = performance.now(), horizon = T - from, past = recent(start, states, actions, dx);
    search = searchSpace(space, prior, past, horizon);
    const { candidates, iterations } = from ? affordable(again, rate, horizon, budget) : first;
    const question = { task, model, space, past, horizon, target };
    const planOf = parameters => search.decode(4, repeated(parameters, 4)).slice(0, horizon * DU);
    let best = null, idle = 0;
    for (let round = 0; round < (from ? 1 : rounds) && idle < PATIENCE; round++) {
      const draws = seed + 1000 * from + 17 * round;
      const planning = cem(search, (rows, parameters) => judge(library, question, rows, parameters), { start: round % 2 ? best.parameters : left, candidates, iterations, seed: draws, near: from ? NEAR : 1 });
      let step = await planning.next();
      for (; !step.done; step = await planning.next()) yield { type: 'progress', from, round, ...step.value, of: iterations };
      if (!round) rate = (performance.now() - began) / ((candidates * iterations + ALONE) * horizon);
      const value = one => judged(network, past, planOf(one), horizon, seed + 1000 * from + 2, target, place).value;
      // What is left of the plan before goes on unless the new one is better in the mean over samples.
      const parameters = from && !(value(step.value.parameters) > value(left)) ? left : step.value.parameters;
      const plan = planOf(parameters), worth = value(parameters);
      idle = best && !(worth > best.value + BETTER) ? idle + 1 : 0;
      if (best && !(worth > best.value)) continue;
      best = { value: worth, plan, parameters };
      const { mode, samples, value: fresh } = judged(network, past, plan, horizon, seed + 1000 * from + 1, target, place);
      if (!from) {
        predicted = fresh;
        states.length = actions.length = 0;
        world.reset(start);
      }
      keep({ network, past, plan, horizon, from });
      const steps = replan ? EVERY : T, executed = world.advance(plan.subarray(0, steps * DU));
      for (const x of executed) states.push(x);
      actions.push(...plan.subarray(0, steps * DU));
      const fan = samples && Float32Array.from({ length: SAMPLES * horizon * 2 }, (_, i) => samples[(i >> 1) * dx + place.position + (i & 1)]);
      yield { type: 'part', from, predicted: mode, fan, actions: plan, executed, round, ms: performance.now() - began, candidates, iterations };
    }
    left = replan ? search.left(best.parameters, EVERY) : undefined;
    if (!replan) break;
  }
  const end = (T - 1) * dx + place.position, distance = Math.hypot(states[end] - target[0], states[end + 1] - target[1]);
  const [executed] = returns(1, states, actions, target, place);
  yield { type: 'done', predicted, executed, distance, success: distance < about.tolerance };
}

/** States (T, dx) of a kept plan with two numbers of the code turned, for all of its segments. */
export function imagine({ network, past, plan, horizon }, knobs, values) {
  const { codes, hold } = network.about, segments = Math.ceil(horizon / hold), z = new Float32Array(4 * segments * codes);
  for (let k = 0; k < 4 * segments; k++) knobs.forEach((knob, i) => { z[k * codes + knob] = values[i]; });
  const states = network.rollout(4, past, repeated(plan, 4), horizon, z);
  return states.slice(0, states.length / 4);
}
