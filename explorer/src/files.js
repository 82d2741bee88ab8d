// Files of the page: fetched, and refused where they are of another format or version than this code.
const FORMAT = 3; // as in export.py

/** A failure that a person can do something about; its message is one sentence that says what. */
export class PageError extends Error {}

/** Read bytes of a file beside index.html. In node, tests give their own reader. */
export async function read(path) {
  const answer = await fetch(new URL(`../${path}`, import.meta.url)).catch(() => null);
  if (!answer?.ok) throw new PageError(`The file ${path} did not come; reload the page, or build it again with make explorer.`);
  return answer.arrayBuffer();
}

export async function readManifest(reader = read) {
  let manifest;
  try {
    manifest = JSON.parse(new TextDecoder().decode(await reader('manifest.json')));
  } catch (error) {
    if (error instanceof PageError) throw error;
    throw new PageError('manifest.json is damaged; build the page again with make explorer.');
  }
  if (manifest.format !== FORMAT) {
    throw new PageError(`The models are of format ${manifest.format}, this page reads ${FORMAT}; build it again with make explorer.`);
  }
  return manifest;
}

/** The arrays of a network, name -> Float32Array, checked against what the manifest says of them. */
export async function readArrays(about, reader = read) {
  const bytes = await reader(about.file);
  const damaged = new PageError(`${about.file} is not the file that belongs to this page; reload it, or build it again with make explorer.`);
  if (bytes.byteLength !== about.bytes) throw damaged;
  if (globalThis.crypto?.subtle) {
    const digest = [...new Uint8Array(await crypto.subtle.digest('SHA-256', bytes))];
    if (digest.map(byte => byte.toString(16).padStart(2, '0')).join('') !== about.sha256) throw damaged;
  }
  const all = new Float32Array(bytes), size = shape => shape.reduce((a, b) => a * b, 1);
  return Object.fromEntries(Object.entries(about.arrays).map(
    ([name, { at, shape }]) => [name, { data: all.subarray(at, at + size(shape)), shape }],
  ));
}
