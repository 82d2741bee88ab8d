// Matrix products and activations of the networks, for AssemblyScript; compiled twice, with and without fused
// multiply-add (relaxed SIMD), by build.mjs. Numbers are float32 at byte addresses; rows are a multiple of 4, widths of
// products a multiple of 8.

@inline function multiplyAdd(a: v128, b: v128, c: v128): v128 { // a b + c
  if (ASC_FEATURE_RELAXED_SIMD) return f32x4.relaxed_madd(a, b, c);
  return f32x4.add(f32x4.mul(a, b), c);
}

// y[r] = init[r] + x[r] W; xs and is: floats from one row of x and of init to the next. W (nin, nout) lies in panels of 8
// columns, (nout / 8, nin, 8), each of which stays in the fastest cache while all rows use it.
export function linear(x: usize, xs: i32, nin: i32, w: usize, init: usize, is: i32, y: usize, rows: i32, nout: i32): void {
  const step = <usize>xs << 2, wide = <usize>nout << 2, from = <usize>is << 2;
  for (let o: usize = 0; o < wide; o += 32, w += <usize>nin << 5) {
    for (let r: usize = 0; r < <usize>rows; r += 4) {
      const i0 = init + r * from + o;
      let a0 = v128.load(i0), b0 = v128.load(i0, 16);
      let a1 = v128.load(i0 + from), b1 = v128.load(i0 + from, 16);
      let a2 = v128.load(i0 + 2 * from), b2 = v128.load(i0 + 2 * from, 16);
      let a3 = v128.load(i0 + 3 * from), b3 = v128.load(i0 + 3 * from, 16);
      let p = x + r * step, q = w;
      for (const end = w + (<usize>nin << 5); q < end; p += 4, q += 32) {
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
      let z = y + r * wide + o;
      v128.store(z, a0); v128.store(z, b0, 16); z += wide;
      v128.store(z, a1); v128.store(z, b1, 16); z += wide;
      v128.store(z, a2); v128.store(z, b2, 16); z += wide;
      v128.store(z, a3); v128.store(z, b3, 16);
    }
  }
}

@inline function constant(v: f32): v128 { return f32x4.splat(v); }
@inline function one(): v128 { return constant(1.0); }

// exp(k x), k x held within 40, where a product of two is finite: 2^n times a polynomial within half a power of two
@inline function exp(x: v128, k: f32): v128 {
  const t = f32x4.pmin(f32x4.pmax(f32x4.mul(x, constant(k * 1.44269504088896341)), constant(-57.0)), constant(57.0));
  const n = f32x4.add(t, constant(12582912.0)); // its lowest bits are t, rounded
  const f = f32x4.sub(t, f32x4.sub(n, constant(12582912.0)));
  let p = constant(1.327647206e-3);
  p = multiplyAdd(p, f, constant(9.675541397e-3)); p = multiplyAdd(p, f, constant(5.550713274e-2));
  p = multiplyAdd(p, f, constant(2.402211972e-1)); p = multiplyAdd(p, f, constant(6.931469671e-1));
  p = multiplyAdd(p, f, constant(1.000000072));
  return i32x4.add(p, i32x4.shl(n, 23));
}

// tanh(x) sigmoid(y), with one division
@inline function gated(x: v128, y: v128): v128 {
  const a = exp(x, -2.0), b = exp(y, -1.0);
  return f32x4.div(f32x4.sub(one(), a), f32x4.mul(f32x4.add(one(), a), f32x4.add(one(), b)));
}

// x sigmoid(y)
@inline function weighed(x: v128, y: v128): v128 {
  return f32x4.div(x, f32x4.add(one(), exp(y, -1.0)));
}

// Eq. 1: h = tanh(first half of y) * sigmoid(second half)
export function gate(y: usize, h: usize, rows: i32, channels: i32): void {
  const half = <usize>channels << 2;
  for (let r = 0; r < rows; r++, y += 2 * half, h += half)
    for (let o: usize = 0; o < half; o += 16) v128.store(h + o, gated(v128.load(y + o), v128.load(y + half + o)));
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
      const kept = weighed(v128.load(c + o), v128.load(q + o));
      const now = f32x4.add(kept, gated(v128.load(q + 3 * wide + o), v128.load(q + wide + o)));
      v128.store(c + o, now);
      v128.store(x + o, gated(now, v128.load(q + 2 * wide + o)));
    }
}

export function relu(y: usize, n: i32): void {
  for (let i = 0; i < n; i += 4, y += 16) v128.store(y, f32x4.max(v128.load(y), constant(0.0)));
}

export function silu(y: usize, n: i32): void {
  for (let i = 0; i < n; i += 4, y += 16) {
    const v = v128.load(y);
    v128.store(y, weighed(v, v));
  }
}
