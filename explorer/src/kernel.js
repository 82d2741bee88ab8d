// The WebAssembly kernel, and memory for weights and activations of up to CAPACITY candidates.
import { PageError, read } from './files.js';

export const CAPACITY = 64; // rows, a multiple of 4

/** Weights (nin, nout) in panels of 8 columns, (nout / 8, nin, 8), as kernel.ts reads them. */
function panels(w, nin, nout) {
  const found = new Float32Array(w.length);
  for (let o = 0, to = 0; o < nout; o += 8) {
    for (let i = 0; i < nin; i++, to += 8) found.set(w.subarray(i * nout + o, i * nout + o + 8), to);
  }
  return found;
}

export class Kernel {
  static async load(reader = read) {
    if (!globalThis.WebAssembly) {
      throw new PageError('This browser lacks WebAssembly, or it is switched off; allow it, or open the page in Firefox 89, Chrome 91, Safari 16.4 or newer.');
    }
    const fused = new Uint8Array(await reader('kernel-fused.wasm'));
    const bytes = WebAssembly.validate(fused) ? fused : new Uint8Array(await reader('kernel.wasm'));
    if (!WebAssembly.validate(bytes)) {
      throw new PageError('This browser lacks WebAssembly SIMD; open the page in Firefox 89, Chrome 91, Safari 16.4 or newer.');
    }
    const { instance } = await WebAssembly.instantiate(bytes, { env: { abort() { throw new Error('the kernel stopped'); } } });
    return new Kernel(instance.exports);
  }

  constructor(exports) {
    Object.assign(this, { exports, memory: exports.memory, end: 65536 });
  }

  /** Address of room for n numbers. */
  room(n) {
    const at = this.end;
    this.end += Math.ceil(n / 8) * 32;
    if (this.end > this.memory.buffer.byteLength) this.memory.grow(Math.ceil((this.end - this.memory.buffer.byteLength) / 65536));
    return at;
  }

  put(data) {
    const at = this.room(data.length);
    this.view(at, data.length).set(data);
    return at;
  }

  view(at, n) {
    return new Float32Array(this.memory.buffer, at, n);
  }

  /** A layer of the export: w (nin, nout), b (nout) or zeros. */
  layer(arrays, name) {
    const [nin, nout] = arrays[`${name}.w`].shape, bias = arrays[`${name}.b`]?.data ?? new Float32Array(nout);
    return { w: this.put(panels(arrays[`${name}.w`].data, nin, nout)), b: this.put(bias), nin, nout };
  }

  /** y = init + x W; init: an address with one row, or rows ``stride`` apart; by default the bias. */
  linear(layer, x, y, rows, { xs = layer.nin, init = layer.b, stride = 0 } = {}) {
    this.exports.linear(x, xs, layer.nin, layer.w, init, stride, y, rows, layer.nout);
  }
}
