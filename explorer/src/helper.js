// A worker beside the planner's, which judges a share of the candidates.
//   in: the arguments of session.evaluate after the first       out: { found } | { message }
import { readManifest } from './files.js';
import { Library, evaluate } from './session.js';

const library = readManifest().then(manifest => Library.load(manifest));
library.catch(() => {}); // said when it is asked

onmessage = async ({ data }) => {
  try {
    postMessage({ found: await evaluate(await library, ...data) });
  } catch ({ message }) {
    postMessage({ message });
  }
};
