# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Deflate for rings: three times as fast as libdeflate, and smaller, because it knows what rings look like.

A section of rings (64 cells at one angle) is a few runs: free, occupied, unknown. And often it equals the section
before. So there are two kinds of match, distance 1 (a run) and distance 64 (sections again), and one Huffman code for
all chunks. The result is an ordinary deflate stream (RFC 1951) of one dynamic block, readable by any HDF5 library.

Why not a library: rings are half of all bytes that are compressed, and with libdeflate they took a seventh of the time
of `generate` (9 to 11 us per row against 3.3 us here, 221 B per row against 209 B).
"""

from __future__ import annotations

import heapq
from functools import cache

import numpy as np
import numpy.typing as npt

from navrep_data._kernels import kernel

SECTION = 64
MAX_VALUE = 2
_END = 256
_WORDS = 8
# Rows of the token table: _RUN * value + count, then _REPEAT for the end, _REPEAT + m for m sections again.
_RUN = SECTION + 1
_REPEAT = _RUN * (MAX_VALUE + 1)
# The longest match that is whole sections: deflate allows 258.
_MAX_REPEAT = 4
_ONES = np.uint64(0x0101010101010101)  # times a value: eight cells of it
# Share of each symbol per 10,000, counted on every fifth row of 20 sequences of soadrl (8 humans, 4 obstacles).
# Literals are cells; 257 to 276 lengths of runs; 276, 280, 282 and 284 also those of 64 to 256 repeated cells.
_COUNTS = {
    0: 1467, 1: 2001, 2: 3020, 256: 1,
    257: 77, 258: 60, 259: 60, 260: 65, 261: 75, 262: 85, 263: 96, 264: 117, 265: 295, 266: 218,
    267: 144, 268: 113, 269: 191, 270: 178, 271: 189, 272: 200, 273: 422, 274: 591, 275: 157, 276: 99,
    280: 32, 282: 19, 284: 30,
}  # fmt: skip
_CODE_LENGTH_ORDER = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)


def _length_symbol(length: int) -> tuple[int, int, int]:
    """Return symbol, number of extra bits and their value for a match length (RFC 1951, 3.2.5)."""
    if length <= 10:
        return 254 + length, 0, 0
    extra = (length - 3).bit_length() - 3
    base = 3 + (4 << extra)
    step = (length - base) >> extra
    return 261 + 4 * extra + step, extra, length - base - (step << extra)


def _huffman_lengths(counts: dict[int, int]) -> dict[int, int]:
    """Return the code length of each symbol."""
    heap: list[tuple[int, int, tuple[int, ...]]] = [
        (count, symbol, (symbol,)) for symbol, count in sorted(counts.items())
    ]
    heapq.heapify(heap)
    lengths = dict.fromkeys(counts, 0)
    while len(heap) > 1:
        a, b = heapq.heappop(heap), heapq.heappop(heap)
        for symbol in a[2] + b[2]:
            lengths[symbol] += 1
        heapq.heappush(heap, (a[0] + b[0], min(a[1], b[1]), a[2] + b[2]))
    return lengths


def _codes(lengths: dict[int, int]) -> dict[int, tuple[int, int]]:
    """Return (bits, length) per symbol: canonical codes, reversed because deflate writes them from the top."""
    code, before, result = 0, 0, {}
    for length, symbol in sorted((n, s) for s, n in lengths.items()):
        code <<= length - before
        before = length
        result[symbol] = (int(f"{code:0{length}b}"[::-1], 2), length)
        code += 1
    return result


@cache
def tables() -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.uint64]]:
    """Return the header bits and the tokens, both as rows of (bits, number of bits).

    Tokens: 65 v + n is a run of n cells of value v; then come the end of the block, and m sections again (m 1 to 4).
    """
    lengths = _huffman_lengths(_COUNTS)
    literal, distance = _codes(lengths), {0: (0, 1), 11: (1, 1)}
    tokens = np.zeros((_REPEAT + _MAX_REPEAT + 1, 2), np.uint64)

    def joined(*parts: tuple[int, int]) -> tuple[int, int]:
        bits, size = 0, 0
        for part, width in parts:
            bits |= part << size
            size += width
        return bits, size

    for value in range(MAX_VALUE + 1):
        for n in range(1, SECTION + 1):
            rest = [literal[value]] * (n - 1)
            if n - 1 >= 3:
                symbol, width, extra = _length_symbol(n - 1)
                rest = [literal[symbol], (extra, width), distance[0]]
            tokens[_RUN * value + n] = joined(literal[value], *rest)
    tokens[_REPEAT] = literal[_END]
    for m in range(1, _MAX_REPEAT + 1):
        symbol, width, extra = _length_symbol(SECTION * m)
        tokens[_REPEAT + m] = joined(literal[symbol], (extra, width), distance[11], (SECTION - 49, 4))
    return np.array(_header(lengths), np.uint64), tokens


def _header(lengths: dict[int, int]) -> list[tuple[int, int]]:
    """Return the head of a last, dynamic block with these literal codes and distances 0 and 11 of one bit each."""
    used = max(lengths) + 1
    sequence = [lengths.get(s, 0) for s in range(used)] + [1 if s in (0, 11) else 0 for s in range(12)]
    # every code length from 0 to 15 as a symbol of four bits: a plain, complete code
    order = [4 if s < 16 else 0 for s in _CODE_LENGTH_ORDER]
    bits = [(1, 1), (2, 2), (used - 257, 5), (12 - 1, 5), (len(order) - 4, 4), *((n, 3) for n in order)]
    return bits + [(int(f"{n:04b}"[::-1], 2), 4) for n in sequence]


@kernel
def _put(token, tokens, acc, size, at, out):
    """Append a token to the pending bits `acc`; whole 32-bit words go to `out` (uint32). Returns acc, size, at."""
    acc |= tokens[token, 0] << size
    size += tokens[token, 1]
    if size >= np.uint64(32):
        out[at] = np.uint32(acc & np.uint64(0xFFFFFFFF))
        at += 1
        acc >>= np.uint64(32)
        size -= np.uint64(32)
    return acc, size, at


@kernel
def _same(words, i, j):
    for w in range(_WORDS):
        if words[i, w] != words[j, w]:
            return False
    return True


@kernel
def encode_sections(cells, words, header, tokens, out):
    """Deflate cells (n, 64) uint8, also given as words (n, 8) uint64; returns the bytes written.

    Returns -1 for values over 2. `out` (uint32) needs room for one byte per cell and the header.
    """
    acc, size, at = np.uint64(0), np.uint64(0), 0
    for k in range(header.shape[0]):
        acc, size, at = _put(k, header, acc, size, at, out)
    n = cells.shape[0]
    i = 0
    while i < n:
        again = 0
        while i > 0 and i + again < n and again < _MAX_REPEAT and _same(words, i + again, i - 1):
            again += 1
        if again > 0:
            acc, size, at = _put(_REPEAT + again, tokens, acc, size, at, out)
            i += again
            continue
        value = np.int64(cells[i, 0])
        start = 0
        for w in range(_WORDS):
            if words[i, w] == _ONES * np.uint64(value):
                continue
            for b in range(8 * w, 8 * w + 8):
                cell = np.int64(cells[i, b])
                if cell != value:
                    if value > MAX_VALUE:
                        return -1
                    acc, size, at = _put(_RUN * value + b - start, tokens, acc, size, at, out)
                    value = cell
                    start = b
        if value > MAX_VALUE:
            return -1
        acc, size, at = _put(_RUN * value + SECTION - start, tokens, acc, size, at, out)
        i += 1
    acc, size, at = _put(_REPEAT, tokens, acc, size, at, out)
    out[at] = np.uint32(acc)
    return 4 * at + (np.int64(size) + 7) // 8


def deflate_rings(block: npt.NDArray[np.uint8]) -> bytes | None:
    """Return the raw deflate stream of rings (rows, 64, 64), or None where a value is over 2."""
    cells = np.ascontiguousarray(block).reshape(-1, SECTION)
    header, tokens = tables()
    out = np.empty(cells.size // 4 + 256, np.uint32)
    size = encode_sections(cells, cells.view(np.uint64), header, tokens, out)
    return None if size < 0 else out.astype("<u4", copy=False).view(np.uint8)[:size].tobytes()
