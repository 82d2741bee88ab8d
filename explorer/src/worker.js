// Plans in a worker, so that the page never waits.
//   in:  { type: 'plan', id, scene } | { type: 'imagine', id, knobs, values } | { type: 'load', task, model } | { type: 'stop' }
//   out: { type: 'ready', manifest } | { type: 'error', message } | an event of a try with its id | { type: 'imagined', id, from, states }
import { PageError, readManifest } from './files.js';
import { loadMujoco } from './physics.js';
import { Library, attempt, imagine } from './session.js';

const BUDGET = 150; // ms for a later plan: 0.2 s of arm time, less what the prediction and the drawing take
let current = 0, kept = null;

const pause = () => new Promise(resolve => { setTimeout(resolve); }); // lets messages in
const fail = error => postMessage({
  type: 'error', message: error instanceof PageError ? error.message : `Something went wrong (${error.message}); reload the page.`,
});

const library = (async () => {
  const manifest = await readManifest();
  const mujoco = import('../vendor/mujoco.js').then(({ default: factory }) => loadMujoco(factory));
  return { manifest, library: await Library.load(manifest, await mujoco) };
})();

library.then(({ manifest }) => postMessage({ type: 'ready', manifest }), fail);

async function plan(id, scene) {
  const { library: files } = await library;
  for await (const event of attempt(files, scene, { budget: BUDGET, keep: plan => { kept = { id, ...plan }; } })) {
    if (id !== current) return;
    postMessage({ ...event, id });
    await pause();
    if (id !== current) return;
  }
}

onmessage = async ({ data }) => {
  try {
    if (data.type === 'stop') current = 0;
    if (data.type === 'plan') {
      current = data.id;
      await plan(data.id, data.scene);
    }
    if (data.type === 'load') {
      const { library: files } = await library;
      await Promise.all([files.network(data.task, data.model), files.network(data.task, 'prior'), files.world(data.task)]);
      postMessage({ type: 'loaded' });
    }
    if (data.type === 'imagine' && kept?.id === data.id && kept.net.about.codes) {
      postMessage({ type: 'imagined', id: data.id, from: kept.from, states: imagine(kept, data.knobs, data.values) });
    }
  } catch (error) {
    fail(error);
  }
};
