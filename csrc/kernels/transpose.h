// Transposes of small squares in registers: log2(N) steps of shuffles, none through memory.
#pragma once

#include "simd.h"

namespace darswin {
namespace {

// Writes the transpose of four rows of four, its rows `stride` apart.
template <typename V, typename T>
inline void transpose4(V a, V b, V c, V d, T* to, int64_t stride) {
  const V ab = __builtin_shufflevector(a, b, 0, 4, 1, 5);
  const V cd = __builtin_shufflevector(c, d, 0, 4, 1, 5);
  const V ab2 = __builtin_shufflevector(a, b, 2, 6, 3, 7);
  const V cd2 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  store(to, __builtin_shufflevector(ab, cd, 0, 1, 4, 5));
  store(to + stride, __builtin_shufflevector(ab, cd, 2, 3, 6, 7));
  store(to + 2 * stride, __builtin_shufflevector(ab2, cd2, 0, 1, 4, 5));
  store(to + 3 * stride, __builtin_shufflevector(ab2, cd2, 2, 3, 6, 7));
}

// Writes the transpose of a square of kLanes x kLanes, its rows `stride` apart: of each 4 x 4
// inside its 128 bits, then of the 128 bits among themselves.
inline void transpose_square(Floats* rows, float* to, int64_t stride) {
  constexpr int kL = kLanes<float>, kQuads = kL / 4;
  // As evens and odds, within each 128 bits.
  const auto even = [](Floats a, Floats b) {
    return shuffle<[](int i) { return i / 4 * 4 + i % 2 * 2 + i / 2 % 2 * kL; }>(a, b);
  };
  const auto odd = [](Floats a, Floats b) {
    return shuffle<[](int i) { return i / 4 * 4 + i % 2 * 2 + i / 2 % 2 * kL + 1; }>(a, b);
  };
#pragma GCC unroll 4
  for (int quad = 0; quad < kQuads; ++quad) {
    split_pairs<4>(rows + 4 * quad, 1, even, odd);
    split_pairs<4>(rows + 4 * quad, 1, even, odd);
  }
#pragma GCC unroll 4
  for (int lane = 0; lane < 4; ++lane) {
    for (int step = 1; step < kQuads; step *= 2) {
      split_pairs<kQuads>(rows + lane, 4, even_quads<Floats>, odd_quads<Floats>);
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < kL; ++i) store(to + i * stride, rows[i]);
}

}  // namespace
}  // namespace darswin
