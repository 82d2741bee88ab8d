// One try: plan, predict, execute, once or again every ten steps. Runs in the worker, and in node for tests.
//
// A model is a list of decoders, of which most have one. As in tsmlib: the return of a candidate is the mean over their
// modes (planning/predictors.py), a sample is drawn from one of them (models/recurrent.py), and what is shown as the
// prediction, and bent by the knobs, is the first one's.
import { CAPACITY, Kernel } from './kernel.js';
import { loadNetwork } from './networks.js';
import { World } from './physics.js';
import { Direct, Latent, cem, returns } from './planning.js';
import { normal, uniform } from './random.js';

export const SAMPLES = 32; // futures of the fan, and behind a predicted return, as in tsmlib.planning.predictors
export const EVERY = 10; // steps executed before the next plan
const FEWEST = 12; // candidates, of which one group of 4 is judged by all decoders
const ALONE = 8; // rows in which CEM judges its start and its last mean
const KEPT = 4; // of so many candidates one is judged by all decoders
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

  /** The decoders of a model. */
  model(task, word) {
    return Promise.all(this.manifest.tasks[task].models[word].decoders.map(about => this.network(task, about)));
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

/** What a model predicts for a plan: the first decoder's mode, and samples where it has codes. */
function predict(decoders, past, actions, horizon, seed, dx) {
  const [first] = decoders, mode = first.rollout(4, past, repeated(actions, 4), horizon).slice(0, horizon * dx);
  return { mode, samples: first.about.codes ? sample(decoders, past, actions, horizon, seed, dx) : null };
}

/** Samples (SAMPLES, T, dx): each of one decoder, drawn once, with a code for every segment. */
function sample(decoders, past, actions, horizon, seed, dx) {
  const { codes, hold } = decoders[0].about, wide = Math.ceil(horizon / hold) * codes, size = horizon * dx;
  const draw = normal(seed), choose = uniform(seed + 1), found = new Float32Array(SAMPLES * size);
  const z = Float32Array.from({ length: SAMPLES * wide }, draw);
  const chosen = Array.from({ length: SAMPLES }, () => Math.floor(choose() * decoders.length));
  decoders.forEach((decoder, k) => {
    const own = [...chosen.keys()].filter(row => chosen[row] === k), rows = Math.ceil(own.length / 4) * 4;
    const given = new Float32Array(rows * wide);
    own.forEach((row, i) => given.set(z.subarray(row * wide, (row + 1) * wide), i * wide));
    const states = rows ? decoder.rollout(rows, past, repeated(actions, rows), horizon, given) : null;
    own.forEach((row, i) => found.set(states.subarray(i * size, (i + 1) * size), row * size));
  });
  return found;
}

/** Eq. 3 or Eq. 2, for the rest of an episode. */
function searchSpace(space, prior, past, horizon) {
  return space === 'latent' ? new Latent(prior, horizon, past.actions) : new Direct(horizon);
}

const measured = (task, dx) => ({ dx, position: task === 'push' ? 6 : 4 });

/**
 * Returns (rows) of candidates over the mode of one decoder, and their actions: { values, actions }.
 * question: { task, model, space, past, horizon, target }; candidates: { parameters } of the search space, or { actions }
 */
export async function evaluate(library, { task, model, space, past, horizon, target }, decoder, rows, { parameters, actions }) {
  const [decoders, prior] = await Promise.all([library.model(task, model), library.prior(task)]);
  actions ??= searchSpace(space, prior, past, horizon).decode(rows, parameters);
  const states = decoders[decoder].rollout(rows, past, actions, horizon);
  return { actions, values: returns(rows, states, actions, target, measured(task, library.manifest.tasks[task].stateDim)) };
}

/** Rows of an array that holds ``rows`` of them. */
const rowsOf = (values, rows, from, to) => values.subarray(from * values.length / rows, to * values.length / rows);

/**
 * Mean returns over some decoders, and the actions, with the work shared out among this worker and its helpers: each has
 * one decoder and all candidates, or where there are fewer decoders than workers, some of the candidates.
 */
async function share(library, question, which, rows, candidates) {
  const workers = [(...job) => evaluate(library, ...job), ...library.helpers], [[kind, given]] = Object.entries(candidates);
  const many = Math.ceil(rows / 4 / Math.ceil(workers.length / which.length)) * 4, jobs = [];
  for (const decoder of which) {
    for (let from = 0; from < rows; from += many) jobs.push({ decoder, from, to: Math.min(rows, from + many) });
  }
  const done = await Promise.all(jobs.map(({ decoder, from, to }, k) => // this worker computes when all others have been asked
    workers[k % workers.length](question, decoder, to - from, { [kind]: rowsOf(given, rows, from, to).slice() })));
  const values = new Float64Array(rows), actions = new Float32Array(rows * question.horizon * DU);
  jobs.forEach(({ from }, k) => {
    done[k].values.forEach((value, row) => { values[from + row] += value / which.length; });
    actions.set(done[k].actions, from * question.horizon * DU);
  });
  return { values, actions };
}

/**
 * Returns by which CEM judges candidates. With several decoders the first sorts out all but the best quarter, whose
 * return is the mean over all decoders; the others are never elites, and are given minus infinity.
 */
export async function judge(library, question, rows, parameters) {
  const decoders = library.manifest.tasks[question.task].models[question.model].decoders.length;
  const { values: first, actions } = await share(library, question, [0], rows, { parameters });
  if (decoders === 1) return first;
  const order = [...first.keys()].sort((a, b) => (first[b] || -Infinity) - (first[a] || -Infinity));
  const best = order.slice(0, Math.ceil(rows / KEPT / 4) * 4), kept = new Float32Array(best.length * actions.length / rows);
  best.forEach((row, i) => kept.set(rowsOf(actions, rows, row, row + 1), i * actions.length / rows));
  const others = Array.from({ length: decoders - 1 }, (_, k) => k + 1);
  const { values: rest } = await share(library, question, others, best.length, { actions: kept });
  const found = new Float64Array(rows).fill(-Infinity);
  best.forEach((row, i) => { found[row] = (first[row] + others.length * rest[i]) / decoders; });
  return found;
}

/** The search that fits into ``budget`` (ms) at the speed measured so far: fewer candidates, then fewer iterations. */
export function affordable({ candidates, iterations }, msPerStep, steps, budget) {
  const fits = budget / (msPerStep * steps) - ALONE; // candidates of all iterations
  const many = Math.min(candidates, Math.max(FEWEST, Math.floor(fits / iterations / 4) * 4));
  return { candidates: many, iterations: Math.min(iterations, Math.max(1, Math.floor(fits / many))) };
}

/**
 * Run a try. Asynchronous generator of events:
 *   { type: 'progress', iteration, of, value }
 *   { type: 'part', from, predicted (T - from, dx), fan (32, T - from, 2) or null, actions, executed (steps, dx), ms, candidates, iterations }
 *   { type: 'done', predicted, executed, distance, success, mode }: the returns of the whole episode, as in the tables
 *
 * scene: { task, model, space, replan, start (dx), target (2), seed }. budget: milliseconds for each later plan, or
 * Infinity for the full search. keep: is told the past and the plan of each part, for ``imagine``.
 */
export async function* attempt(library, scene, { first = { candidates: CAPACITY, iterations: 6 }, again = { candidates: CAPACITY, iterations: 4 }, budget = Infinity, keep = () => {} } = {}) {
  const { task, model, space, replan, start, target, seed } = scene, about = library.manifest.tasks[task];
  const [decoders, prior, world] = await Promise.all([library.model(task, model), library.prior(task), library.world(task)]);
  const dx = about.stateDim, T = about.horizon, place = measured(task, dx);
  const states = [], actions = [];
  let search = null, left, predicted = 0, rate = 0;
  world.reset(start);
  for (let from = 0; from < T; from += EVERY) {
    const began = performance.now(), horizon = T - from, past = recent(start, states, actions, dx);
    search = searchSpace(space, prior, past, horizon);
    const { candidates, iterations } = from ? affordable(again, rate, horizon, budget) : first;
    const question = { task, model, space, past, horizon, target };
    const planning = cem(search, (rows, parameters) => judge(library, question, rows, parameters), { start: left, candidates, iterations, seed: seed + 1000 * from });
    let step = await planning.next();
    for (; !step.done; step = await planning.next()) yield { type: 'progress', from, ...step.value, of: iterations };
    const plan = search.decode(4, repeated(step.value.parameters, 4)).slice(0, horizon * DU);
    rate = (performance.now() - began) / ((candidates * iterations + ALONE) * horizon);
    const { mode, samples } = predict(decoders, past, plan, horizon, seed + 1000 * from + 1, dx);
    if (!from) {
      const rows = samples ? SAMPLES : 1, of = returns(rows, samples ?? mode, samples ? repeated(plan, rows) : plan, target, place);
      predicted = of.reduce((a, b) => a + b) / rows;
    }
    keep({ decoder: decoders[0], past, plan, horizon, from });
    const steps = replan ? EVERY : T, executed = world.advance(plan.subarray(0, steps * DU));
    for (const x of executed) states.push(x);
    actions.push(...plan.subarray(0, steps * DU));
    left = replan ? search.left(step.value.parameters, EVERY) : undefined;
    const fan = samples && Float32Array.from({ length: SAMPLES * horizon * 2 }, (_, i) => samples[(i >> 1) * dx + place.position + (i & 1)]);
    yield { type: 'part', from, predicted: mode, fan, actions: plan, executed, ms: performance.now() - began, candidates, iterations };
    if (!replan) break;
  }
  const end = (T - 1) * dx + place.position, distance = Math.hypot(states[end] - target[0], states[end + 1] - target[1]);
  const [executed] = returns(1, states, actions, target, place);
  yield { type: 'done', predicted, executed, distance, success: distance < about.tolerance };
}

/** States (T, dx) of a kept plan with two numbers of the code turned, for all of its segments. */
export function imagine({ decoder, past, plan, horizon }, knobs, values) {
  const { codes, hold } = decoder.about, segments = Math.ceil(horizon / hold), z = new Float32Array(4 * segments * codes);
  for (let k = 0; k < 4 * segments; k++) knobs.forEach((knob, i) => { z[k * codes + knob] = values[i]; });
  const states = decoder.rollout(4, past, repeated(plan, 4), horizon, z);
  return states.slice(0, states.length / 4);
}
