// Plans in a worker, so that the page never waits.
//   in:  { type: 'plan', id, scene, live, rival } | { type: 'imagine', id, knobs, values } | { type: 'load', task, model } | { type: 'stop' }
//   out: { type: 'ready', manifest } | { type: 'error', message } | an event of a try with its id | { type: 'rival', id, ... } its end the other way | { type: 'imagined', id, from, states }
import { PageError, readManifest } from './files.js';
import { loadMujoco } from './physics.js';
import { Library, attempt, imagine } from './session.js';

const BUDGET = 150; // ms for a later plan: 0.2 s of arm time, less what the prediction and the drawing take
const HELPERS = 3; // more workers at most, where there are so many processors
let current = 0, kept = null;

const { port1: next, port2: queue } = new MessageChannel();
const pause = () => new Promise(resolve => { // lets messages in; a timer would wait four milliseconds
  next.onmessage = resolve;
  queue.postMessage(0);
});
const fail = error => postMessage({
  type: 'error', message: error instanceof PageError ? error.message : `Something went wrong (${error.message}); reload the page.`,
});

/** Another worker as a function: session.evaluate without its first argument. It answers in order. */
function helper(files) {
  const waiting = [], worker = new Worker(new URL('./helper.js', import.meta.url), { type: 'module' });
  worker.onmessage = ({ data: { found, message } }) => {
    const { resolve, reject } = waiting.shift();
    if (found) resolve(found);
    else reject(new PageError(message));
  };
  worker.onerror = () => { // what it does not answer any more, this worker does itself
    files.helpers = [];
    for (const { reject } of waiting) reject(new PageError('A part of the planner stopped; reload the page.'));
  };
  return (...job) => new Promise((resolve, reject) => {
    waiting.push({ resolve, reject });
    worker.postMessage(job);
  });
}

const library = (async () => {
  const manifest = await readManifest();
  const mujoco = import('../vendor/mujoco.js').then(({ default: factory }) => loadMujoco(factory));
  const found = await Library.load(manifest, mujoco);
  found.helpers = Array.from({ length: Math.min(HELPERS, navigator.hardwareConcurrency - 1) }, () => helper(found));
  return { manifest, library: found };
})();

library.then(({ manifest }) => postMessage({ type: 'ready', manifest }), fail);

/** live: whether the plan is played while it is made, so that later parts have to be in time. */
async function plan(id, scene, live, rival) {
  const { library: files } = await library;
  const keep = rival ? undefined : plan => { kept = { id, ...plan }; };
  for await (const event of attempt(files, scene, { budget: live ? BUDGET : Infinity, keep })) {
    if (id !== current) return;
    if (!rival) postMessage({ ...event, id });
    else if (event.type === 'done') postMessage({ ...event, type: 'rival', id, model: scene.model, space: scene.space });
    await pause();
    if (id !== current) return;
  }
}

onmessage = async ({ data }) => {
  try {
    if (data.type === 'stop') current = 0;
    if (data.type === 'plan') {
      current = data.id;
      await plan(data.id, data.scene, data.live, data.rival);
    }
    if (data.type === 'load') {
      const { library: files } = await library;
      await Promise.all([files.model(data.task, data.model), files.prior(data.task), files.world(data.task)]);
      postMessage({ type: 'loaded' });
    }
    if (data.type === 'imagine' && kept?.id === data.id && kept.network.about.codes) {
      postMessage({ type: 'imagined', id: data.id, from: kept.from, states: imagine(kept, data.knobs, data.values) });
    }
  } catch (error) {
    fail(error);
  }
};
