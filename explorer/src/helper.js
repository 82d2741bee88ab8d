// A worker beside the planner's, which judges a share of the candidates.
//   in: [question, rows, parameters] of session.evaluate       out: { values } | { message }
import { readManifest } from './files.js';
import { Library, evaluate } from './session.js';

const library = readManifest().then(manifest => Library.load(manifest));
library.catch(() => {}); // said when it is asked

onmessage = async ({ data }) => {
  try {
    postMessage({ values: await evaluate(await library, ...data) });
  } catch ({ message }) {
    postMessage({ message });
  }
};
