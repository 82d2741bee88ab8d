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

mkdirSync(at('dist/vendor'), { recursive: true });
for (const path of ['index.html', 'style.css', 'src']) cpSync(at(path), at(`dist/${path}`), { recursive: true });
for (const path of ['mujoco.js', 'mujoco.wasm']) cpSync(at(`node_modules/@mujoco/mujoco/${path}`), at(`dist/vendor/${path}`));
const licence = JSON.parse(readFileSync(at('node_modules/@mujoco/mujoco/package.json')));
writeFileSync(at('dist/vendor/README.txt'), `mujoco.js and mujoco.wasm: ${licence.name} ${licence.version}, ${licence.license}\n`);
await compile('kernel.wasm', ['simd']);
await compile('kernel-fused.wasm', ['simd', 'relaxed-simd']);
console.log('explorer/dist is built; python -m tsmlib explore serves it');
