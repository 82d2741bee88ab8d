// Matrix products and activations of the networks, for AssemblyScript; compiled twice, with and without fused
// multiply-add (relaxed SIMD), by build.mjs. Numbers are float32 at byte addresses; rows are a multiple of 4, widths of
// products a multiple of 8.

@inline function multiplyAdd(a: v128, b: v128, c: v128): v128 { // a b + c
  if (ASC_FEATURE_RELAXED_SIMD) return f32x4.relaxed_madd(a, b, c);
  return f32x4.add(f32x4.mul(a, b), c);
}

// y[r] = init[r] + x[r] W, with W (nin, nout) row by row; xs and is: floats from one row of x and of init to the next
export function linear(x: usize, xs: i32, nin: i32, w: usize, init: usize, is: i32, y: usize, rows: i32, nout: i32): void {
  const step = <usize>xs << 2, wide = <usize>nout << 2, from = <usize>is << 2;
  for (let r: usize = 0; r < <usize>rows; r += 4) {
    const x0 = x + r * step, i0 = init + r * from, y0 = y + r * wide;
    for (let o: usize = 0; o < wide; o += 32) {
      let a0 = v128.load(i0 + o), b0 = v128.load(i0 + o, 16);
      let a1 = v128.load(i0 + from + o), b1 = v128.load(i0 + from + o, 16);
      let a2 = v128.load(i0 + 2 * from + o), b2 = v128.load(i0 + 2 * from + o, 16);
      let a3 = v128.load(i0 + 3 * from + o), b3 = v128.load(i0 + 3 * from + o, 16);
      let p = x0, q = w + o;
      for (let i = 0; i < nin; i++, p += 4, q += wide) {
        const wa = v128.load(q), wb = v128.load(q, 16);
        let s = v128.load32_splat(p);
        a0 = multiplyAdd(s, wa, a0); b0 = multiplyAdd(s, wb, b0);
        s = v128.load32_splat(p + step);
        a1 = multiplyAdd(s, wa, a1); b1 = multiplyAdd(s, wb, b1);
        s = v128.load32_splat(p + 2 * step);
        a2 = multiplyAdd(s, wa, a2); b2 = multiplyAdd(s, wb, b2);
        s = v128.load32_splat(p + 3 * step);
        a3 = multiplyAdd(s, wa, a3); b3 = multiplyAdd(s, wb, b3);
      }
      let z = y0 + o;
      v128.store(z, a0); v128.store(z, b0, 16); z += wide;
      v128.store(z, a1); v128.store(z, b1, 16); z += wide;
      v128.store(z, a2); v128.store(z, b2, 16); z += wide;
      v128.store(z, a3); v128.store(z, b3, 16);
    }
  }
}

@inline function constant(v: f32): v128 { return f32x4.splat(v); }

@inline function sigmoid(x: v128): v128 { // 1 / (1 + exp(-x)), exp as 2^n times a polynomial (Cephes)
  let t = f32x4.min(f32x4.max(f32x4.neg(x), constant(-87.0)), constant(87.0));
  const n = f32x4.floor(multiplyAdd(t, constant(1.44269504088896341), constant(0.5)));
  t = f32x4.sub(f32x4.sub(t, f32x4.mul(n, constant(0.693359375))), f32x4.mul(n, constant(-2.12194440e-4)));
  let p = constant(1.9875691500e-4);
  p = multiplyAdd(p, t, constant(1.3981999507e-3)); p = multiplyAdd(p, t, constant(8.3334519073e-3));
  p = multiplyAdd(p, t, constant(4.1665795894e-2)); p = multiplyAdd(p, t, constant(1.6666665459e-1));
  p = multiplyAdd(p, t, constant(5.0000001201e-1));
  p = f32x4.add(multiplyAdd(f32x4.mul(p, t), t, t), constant(1.0));
  const e = f32x4.mul(p, i32x4.shl(i32x4.add(i32x4.trunc_sat_f32x4_s(n), i32x4.splat(127)), 23));
  return f32x4.div(constant(1.0), f32x4.add(constant(1.0), e));
}

@inline function tanh(x: v128): v128 {
  return f32x4.sub(f32x4.mul(constant(2.0), sigmoid(f32x4.add(x, x))), constant(1.0));
}

// Eq. 1: h = tanh(first half of y) * sigmoid(second half)
export function gate(y: usize, h: usize, rows: i32, channels: i32): void {
  const half = <usize>channels << 2;
  for (let r = 0; r < rows; r++, y += 2 * half, h += half)
    for (let o: usize = 0; o < half; o += 16)
      v128.store(h + o, f32x4.mul(tanh(v128.load(y + o)), sigmoid(v128.load(y + half + o))));
}

// Residual (first half of y) to the next layer's input, skip (second half) into the total, which the first layer sets
export function share(y: usize, now: usize, next: usize, total: usize, rows: i32, channels: i32, first: i32): void {
  const half = <usize>channels << 2;
  for (let r = 0; r < rows; r++, y += 2 * half, now += half, next += half, total += half)
    for (let o: usize = 0; o < half; o += 16) {
      v128.store(next + o, f32x4.add(v128.load(now + o), v128.load(y + o)));
      const skip = v128.load(y + half + o);
      v128.store(total + o, first ? skip : f32x4.add(v128.load(total + o), skip));
    }
}

// LSTM cell: gates q (forget, write, read, candidate) move c on, and h into the first n of each row of x
export function cell(q: usize, c: usize, x: usize, xs: i32, rows: i32, n: i32): void {
  const wide = <usize>n << 2, step = <usize>xs << 2;
  for (let r = 0; r < rows; r++, q += 4 * wide, c += wide, x += step)
    for (let o: usize = 0; o < wide; o += 16) {
      const kept = f32x4.mul(sigmoid(v128.load(q + o)), v128.load(c + o));
      const now = f32x4.add(kept, f32x4.mul(sigmoid(v128.load(q + wide + o)), tanh(v128.load(q + 3 * wide + o))));
      v128.store(c + o, now);
      v128.store(x + o, f32x4.mul(sigmoid(v128.load(q + 2 * wide + o)), tanh(now)));
    }
}

export function relu(y: usize, n: i32): void {
  for (let i = 0; i < n; i += 4, y += 16) v128.store(y, f32x4.max(v128.load(y), constant(0.0)));
}

export function silu(y: usize, n: i32): void {
  for (let i = 0; i < n; i += 4, y += 16) {
    const v = v128.load(y);
    v128.store(y, f32x4.mul(v, sigmoid(v)));
  }
}
