// SHA-256 (FIPS 180-4) of a file, piece by piece, in a worker. Browsers offer theirs only to pages from HTTPS or from
// this machine, and only for data that is in memory as a whole.

const FIRST = new Uint32Array([
  0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19,
]);
const ROUND = new Uint32Array(64);
for (let number = 2, i = 0; i < 64; number++) {
  if (![...Array(number).keys()].slice(2).some((part) => number % part === 0)) {
    const root = Math.cbrt(number);
    ROUND[i++] = Math.floor((root - Math.floor(root)) * 2 ** 32);
  }
}

class Sha256 {
  constructor() {
    this.state = FIRST.slice();
    this.rest = new Uint8Array(0);
    this.length = 0;
    this.words = new Uint32Array(64);
  }

  add(bytes) {
    this.length += bytes.length;
    const all = new Uint8Array(this.rest.length + bytes.length);
    all.set(this.rest);
    all.set(bytes, this.rest.length);
    const view = new DataView(all.buffer);
    let at = 0;
    for (; at + 64 <= all.length; at += 64) this.block(view, at);
    this.rest = all.slice(at);
  }

  block(view, at) {
    const w = this.words;
    for (let i = 0; i < 16; i++) w[i] = view.getUint32(at + 4 * i);
    for (let i = 16; i < 64; i++) {
      const a = w[i - 15];
      const b = w[i - 2];
      const s0 = ((a >>> 7) | (a << 25)) ^ ((a >>> 18) | (a << 14)) ^ (a >>> 3);
      const s1 = ((b >>> 17) | (b << 15)) ^ ((b >>> 19) | (b << 13)) ^ (b >>> 10);
      w[i] = (w[i - 16] + s0 + w[i - 7] + s1) | 0;
    }
    let [a, b, c, d, e, f, g, h] = this.state;
    for (let i = 0; i < 64; i++) {
      const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
      const t1 = (h + s1 + ((e & f) ^ (~e & g)) + ROUND[i] + w[i]) | 0;
      const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
      const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      h = g; g = f; f = e; e = (d + t1) | 0;
      d = c; c = b; b = a; a = (t1 + t2) | 0;
    }
    const s = this.state;
    s[0] += a; s[1] += b; s[2] += c; s[3] += d; s[4] += e; s[5] += f; s[6] += g; s[7] += h;
  }

  hex() {
    const bits = this.length * 8;
    const end = new Uint8Array(((this.rest.length + 9 + 63) & ~63) - this.rest.length);
    end[0] = 0x80;
    new DataView(end.buffer).setBigUint64(end.length - 8, BigInt(bits));
    this.add(end);
    return [...this.state].map((word) => word.toString(16).padStart(8, "0")).join("");
  }
}

self.onmessage = async ({ data: file }) => {
  const digest = new Sha256();
  const piece = 4 << 20;
  try {
    for (let at = 0; at < file.size; at += piece) {
      digest.add(new Uint8Array(await file.slice(at, at + piece).arrayBuffer()));
      self.postMessage({ read: Math.min(file.size, at + piece) });
    }
    self.postMessage({ hex: digest.hex() });
  } catch {
    self.postMessage({ failed: true }); // the page is not told of errors in promises
  }
};
