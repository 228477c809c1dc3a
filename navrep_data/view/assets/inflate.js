// Inflate (RFC 1951) for browsers without DecompressionStream('deflate-raw'). `size` is the length of the result.
function inflateRaw(input, size) {
  const out = new Uint8Array(size);
  let at = 0, filled = 0, hold = 0, held = 0;
  const fail = (why) => { throw new Error('deflate: ' + why); };
  const bits = (n) => {
    while (held < n) {
      if (at >= input.length) fail('they end early');
      hold |= input[at++] << held;
      held += 8;
    }
    const value = hold & ((1 << n) - 1);
    hold >>>= n;
    held -= n;
    return value;
  };
  // A code is how many symbols there are of each length, and the symbols in order.
  const makeCode = (lengths) => {
    const count = new Uint16Array(16), first = new Uint16Array(16), symbols = new Uint16Array(lengths.length);
    for (const length of lengths) count[length]++;
    count[0] = 0;
    for (let k = 1; k < 15; k++) first[k + 1] = first[k] + count[k];
    lengths.forEach((length, symbol) => { if (length) symbols[first[length]++] = symbol; });
    return { count, symbols };
  };
  const read = ({ count, symbols }) => {
    let code = 0, first = 0, index = 0;
    for (let length = 1; length < 16; length++) {
      code |= bits(1);
      if (code - count[length] < first) return symbols[index + (code - first)];
      index += count[length];
      first = (first + count[length]) << 1;
      code <<= 1;
    }
    return fail('unknown code');
  };
  const bases = (base, extra) => extra.map((_, k) => extra.slice(0, k).reduce((sum, n) => sum + (1 << n), base));
  const lengthExtra = Array.from({ length: 28 }, (_, k) => (k < 8 ? 0 : (k >> 2) - 1)).concat([0]);
  const lengthBase = bases(3, lengthExtra);
  lengthBase[28] = 258;
  const distanceExtra = Array.from({ length: 30 }, (_, k) => (k < 4 ? 0 : (k >> 1) - 1));
  const distanceBase = bases(1, distanceExtra);
  const dynamicCodes = () => {
    const literals = bits(5) + 257, distances = bits(5) + 1, used = bits(4) + 4;
    const order = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
    const small = new Array(19).fill(0);
    for (let k = 0; k < used; k++) small[order[k]] = bits(3);
    const code = makeCode(small), lengths = [];
    while (lengths.length < literals + distances) {
      const symbol = read(code);
      if (symbol < 16) { lengths.push(symbol); continue; }
      const value = symbol === 16 ? lengths[lengths.length - 1] : 0;
      let times = symbol === 16 ? 3 + bits(2) : symbol === 17 ? 3 + bits(3) : 11 + bits(7);
      while (times--) lengths.push(value);
    }
    return [makeCode(lengths.slice(0, literals)), makeCode(lengths.slice(literals, literals + distances))];
  };
  const fixedCodes = () => [
    makeCode(Array.from({ length: 288 }, (_, k) => (k < 144 ? 8 : k < 256 ? 9 : k < 280 ? 7 : 8))),
    makeCode(new Array(30).fill(5)),
  ];
  for (let last = 0; !last;) {
    last = bits(1);
    const kind = bits(2);
    if (kind === 3) fail('unknown block');
    if (kind === 0) {
      hold = held = 0;
      const length = input[at] | (input[at + 1] << 8);
      at += 4;
      if (at + length > input.length || filled + length > size) fail('a block is too long');
      out.set(input.subarray(at, at + length), filled);
      at += length;
      filled += length;
      continue;
    }
    const [literal, distance] = kind === 1 ? fixedCodes() : dynamicCodes();
    for (;;) {
      const symbol = read(literal);
      if (symbol === 256) break;
      if (symbol < 256) {
        if (filled >= size) fail('too long');
        out[filled++] = symbol;
        continue;
      }
      const length = lengthBase[symbol - 257] + bits(lengthExtra[symbol - 257]);
      const which = read(distance);
      const back = distanceBase[which] + bits(distanceExtra[which]);
      if (back > filled || filled + length > size) fail('a copy is out of range');
      for (let k = 0; k < length; k++, filled++) out[filled] = out[filled - back];
    }
  }
  if (filled !== size) fail('too short');
  return out;
}
