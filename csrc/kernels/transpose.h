// Transposes of small squares in registers: log2(N) steps of shuffles, none through memory.
#pragma once

#include "simd.h"

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

// a0 a2 .. b0 b2 .. within each 128 bits, and a1 a3 .. b1 b3 ..; the same of whole 128 bits.
#if defined(__AVX512F__)
inline Floats even_lanes(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 0, 2, 16, 18, 4, 6, 20, 22, 8, 10, 24, 26, 12, 14, 28, 30);
}
inline Floats odd_lanes(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 1, 3, 17, 19, 5, 7, 21, 23, 9, 11, 25, 27, 13, 15, 29, 31);
}
inline Floats even_quads(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27);
}
inline Floats odd_quads(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}
#elif defined(__AVX2__)
inline Floats even_lanes(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14);
}
inline Floats odd_lanes(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}
inline Floats even_quads(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11);
}
inline Floats odd_quads(Floats a, Floats b) {
  return __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
#else
inline Floats even_lanes(Floats a, Floats b) { return __builtin_shufflevector(a, b, 0, 2, 4, 6); }
inline Floats odd_lanes(Floats a, Floats b) { return __builtin_shufflevector(a, b, 1, 3, 5, 7); }
#endif

// One step of the square transpose of N vectors: pairs are split into their even and odd parts,
// these go to the lower and the upper half. After log2(N) steps row i of lane j is row j of lane i.
template <int N, typename Even, typename Odd>
inline void split_pairs(Floats* rows, int stride, Even even, Odd odd) {
  Floats next[N];
#pragma GCC unroll 8
  for (int i = 0; i < N / 2; ++i) {
    next[i] = even(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
    next[i + N / 2] = odd(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
  }
#pragma GCC unroll 16
  for (int i = 0; i < N; ++i) rows[i * stride] = next[i];
}

// Writes the transpose of a square of kLanes x kLanes, its rows `stride` apart: of each 4 x 4
// inside its 128 bits, then of the 128 bits among themselves.
inline void transpose_square(Floats* rows, float* to, int64_t stride) {
  constexpr int kQuads = kLanes<float> / 4;
#pragma GCC unroll 4
  for (int quad = 0; quad < kQuads; ++quad) {
    split_pairs<4>(rows + 4 * quad, 1, even_lanes, odd_lanes);
    split_pairs<4>(rows + 4 * quad, 1, even_lanes, odd_lanes);
  }
#if defined(__AVX2__)
#  pragma GCC unroll 4
  for (int lane = 0; lane < 4; ++lane) {
    split_pairs<kQuads>(rows + lane, 4, even_quads, odd_quads);
    if constexpr (kQuads == 4) split_pairs<kQuads>(rows + lane, 4, even_quads, odd_quads);
  }
#endif
#pragma GCC unroll 16
  for (int i = 0; i < kLanes<float>; ++i) store(to + i * stride, rows[i]);
}

}  // namespace
