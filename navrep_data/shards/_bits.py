# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Count zero bits at either end of a word: one machine instruction in kernels, plain Python without compiler."""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

WORD_BITS = 64


def low_zeros(word: Any) -> int:
    """Return how many of the lowest bits of a uint64 are 0; 64 for 0."""
    value = int(word)
    return (value & -value).bit_length() - 1 if value else WORD_BITS


def high_zeros(word: Any) -> int:
    """Return how many of the highest bits of a uint64 are 0; 64 for 0."""
    return WORD_BITS - int(word).bit_length()


def _instruction(name: str) -> Any:
    @intrinsic
    def count(typing_context, word):
        def generate(context, builder, signature, arguments):
            # false: zero is no undefined input, it gives all bits
            return getattr(builder, name)(arguments[0], cgutils.false_bit)

        return types.int64(types.uint64), generate

    return count


_cttz, _ctlz = _instruction("cttz"), _instruction("ctlz")


@overload(low_zeros)
def _low_zeros(word):
    return lambda word: _cttz(word)


@overload(high_zeros)
def _high_zeros(word):
    return lambda word: _ctlz(word)
