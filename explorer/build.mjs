// node build.mjs: the page as plain files in dist/, beside the weights that export.py wrote there.
import { cpSync, mkdirSync, readFileSync, writeFileSync } from 'node:fs';
import { fileURLToPath } from 'node:url';
import asc from 'assemblyscript/asc';

const here = new URL('./', import.meta.url), at = path => fileURLToPath(new URL(path, here));

async function compile(name, features) {
  const options = ['-O3', '--runtime', 'stub', '--noAssert', '--initialMemory', '256'];
  const { error, stderr } = await asc.main(
    [at('kernel/kernel.ts'), '-o', at(`dist/${name}`), '--baseDir', at('.'), ...options,
      ...features.flatMap(feature => ['--enable', feature])],
  );
  if (error) throw new Error(`kernel.ts does not compile: ${error.message}\n${stderr}`);
}

/** A WebAssembly module without its custom sections, which hold names and debug information: half of MuJoCo's. */
function stripped(bytes) {
  const parts = [bytes.subarray(0, 8)];
  for (let from = 8, end; from < bytes.length; from = end) {
    let at = from + 1, size = 0, shift = 0, byte;
    do {
      byte = bytes[at++];
      size += (byte & 127) * 2 ** shift;
      shift += 7;
    } while (byte & 128);
    end = at + size;
    if (bytes[from]) parts.push(bytes.subarray(from, end));
  }
  return Buffer.concat(parts);
}

mkdirSync(at('dist/vendor'), { recursive: true });
for (const path of ['index.html', 'style.css', 'src']) cpSync(at(path), at(`dist/${path}`), { recursive: true });
cpSync(at('node_modules/@mujoco/mujoco/mujoco.js'), at('dist/vendor/mujoco.js'));
writeFileSync(at('dist/vendor/mujoco.wasm'), stripped(readFileSync(at('node_modules/@mujoco/mujoco/mujoco.wasm'))));
const licence = JSON.parse(readFileSync(at('node_modules/@mujoco/mujoco/package.json')));
writeFileSync(at('dist/vendor/README.txt'), `mujoco.js and mujoco.wasm: ${licence.name} ${licence.version}, ${licence.license}: LICENSE and LICENSES_THIRD_PARTY.md\n`);
await compile('kernel.wasm', ['simd']);
await compile('kernel-fused.wasm', ['simd', 'relaxed-simd']);
console.log('explorer/dist is built; python -m tsmlib explore serves it');
