// node test/engine.mjs < questions.json > answers.json: what the page computes, for tests in Python to compare.
// Each question is { what: 'physics' | 'rollout' | 'decode' | 'judge' | 'shared' | 'plan' | 'link', task, ... }; see the functions below.
import { readFileSync } from 'node:fs';
import { readManifest } from '../dist/src/files.js';
import { loadMujoco } from '../dist/src/physics.js';
import { Library, attempt, evaluate, judge } from '../dist/src/session.js';
import { fromLink, outside } from '../dist/src/scene.js';
import factory from '../dist/vendor/mujoco.js';

const reader = async path => {
  const data = readFileSync(new URL(`../dist/${path}`, import.meta.url));
  return data.buffer.slice(data.byteOffset, data.byteOffset + data.length);
};
const library = await Library.load(await readManifest(reader), await loadMujoco(factory), reader);
const repeated = (values, n) => Float32Array.from(Array(n).fill(values).flat());

/** { starts (N, dx), actions (N, T * 2) } -> states (N, T * dx) */
async function physics({ task, starts, actions }) {
  const arm = await library.world(task);
  return starts.map((start, i) => {
    arm.reset(start);
    return [...arm.advance(actions[i])];
  });
}

const asPast = ({ states, actions }) => ({ states: Float32Array.from(states), actions: Float32Array.from(actions) });

/** { model, pasts (N of { states, actions }), actions (N, T * 2), codes (N, K * dz)? } -> states (N, T * dx) */
async function rollout({ task, model, pasts, actions, codes }) {
  const net = await library.model(task, model);
  return pasts.map((past, i) => {
    const T = actions[i].length / 2, states = net.rollout(4, asPast(past), repeated(actions[i], 4), T, codes ? repeated(codes[i], 4) : null);
    return [...states.subarray(0, states.length / 4)];
  });
}

/** { past (10 * 2), codes (N, K * dz) } -> actions (N, K H * 2) */
async function decode({ task, past, codes }) {
  const prior = await library.prior(task);
  return codes.map(code => {
    const actions = prior.decode(4, Float32Array.from(past), repeated(code, 4));
    return [...actions.subarray(0, actions.length / 4)];
  });
}

/** { model, pasts, targets, codes (N, K * dz) } -> returns (N) over the model's mode */
async function judged({ task, model, pasts, targets, codes }) {
  const { horizon } = library.manifest.tasks[task];
  return Promise.all(pasts.map(async (past, i) => {
    const question = { task, model, space: 'latent', past: asPast(past), horizon, target: targets[i] };
    return (await judge(library, question, 4, repeated(codes[i], 4)))[0];
  }));
}

/** { model, past, target, codes (N, K * dz), workers } -> returns (N) by which CEM judges candidates */
async function shared({ task, model, past, target, codes, workers }) {
  const question = { task, model, space: 'latent', past: asPast(past), horizon: library.manifest.tasks[task].horizon, target };
  library.helpers = Array(workers - 1).fill((...job) => evaluate(library, ...job));
  const found = await judge(library, question, codes.length, Float32Array.from(codes.flat()));
  library.helpers = [];
  return [...found];
}

/** { model, space, replan, starts, targets, seed, first?, again?, rounds? } -> [{ predicted, executed, distance, success, ms, cpu }], ms: of each plan; cpu: seconds */
async function plan({ task, model, space, replan = false, starts, targets, seed, first, again, rounds }) {
  const found = [];
  for (const [i, start] of starts.entries()) {
    const scene = { task, model, space, replan, start, target: targets[i], seed: seed + i }, ms = [], began = process.cpuUsage();
    for await (const event of attempt(library, scene, { first, again, rounds })) {
      if (event.type === 'part') ms.push(event.ms);
      if (event.type === 'done') found.push({ ...event, ms, cpu: process.cpuUsage(began).user / 1e6 });
    }
  }
  return found;
}

/** { links } -> what the page says of each; nothing of one that it restores */
const link = ({ links }) => links.map(one => fromLink(one, library.manifest).problem);

/** { links } -> what of each scene lies outside the training data, in words */
function marks({ links }) {
  return links.map(one => fromLink(one, library.manifest).scene).map(scene => outside(scene, library.manifest.tasks[scene.task]));
}

const answers = [], ask = { physics, rollout, decode, judge: judged, shared, plan, link, marks };
for (const question of JSON.parse(readFileSync(0))) {
  answers.push(await ask[question.what](question));
}
process.stdout.write(JSON.stringify(answers));
