// Vector code for all tiers. It is written once, for registers of kRegister bytes. The flags of the
// tier turn it into SSE, AVX2, AVX-512 or NEON code. a*b + c becomes one fused instruction if the
// tier has it.
#pragma once

#include <cstdint>

#include "../numbers.h"
#include "vector.h"
#include TIER_HEADER  // tiers/*.h; CMakeLists.txt names it

namespace darswin {
namespace {

// The number of lanes of T in one register.
template <typename T>
constexpr int kLanes = kRegister / static_cast<int>(sizeof(T));
constexpr int kDoubles = kLanes<double>;

inline int64_t smaller(int64_t x, int64_t y) { return x < y ? x : y; }

// Prefetches into the second-level cache. The first-level cache would not do: rows of an image
// whose width is a power of two share few of its sets. The empty assembly gives the function a
// visible effect; otherwise the compiler drops calls to functions that only prefetch.
inline void fetch(const void* what) {
  __builtin_prefetch(what, 0, 2);
  asm volatile("");
}

// Stores a register past the caches, at a multiple of its size: for results that are too large to
// be in a cache when they are read next. An ordinary store would first read the old values. Other
// threads see the results after `finish_streams`.
template <typename V, typename T>
inline void stream(T* to, const V& v) {
#if defined(__AVX__)
  if constexpr (is_same_v<V, Floats>) {
    return stream_lanes(to, v);
  }
#endif
  store(to, v);
}
inline void finish_streams() {
#if defined(__AVX__)
  _mm_sfence();
#endif
}

// Returns (1 - t) * a + t * b, given both weights. The form a + t * (b - a) would not do: the
// difference of huge values overflows, and infinity minus anything but itself would become NaN
// later on. The code fixes which of the two products is fused into the sum, so that every copy of
// the code gives the same result. Single values use a form that the compiler can turn into vector
// code.
template <typename V, typename Weight>
inline V between(V a, V b, Weight one_less_t, Weight t) {
  if constexpr (kFused && is_same_v<V, float>) {
    return __builtin_fmaf(t, b, one_less_t * a);
  } else if constexpr (kFused && is_same_v<V, double>) {
    return __builtin_fma(t, b, one_less_t * a);
  } else {
    return unfused(one_less_t * a) + t * b;
  }
}

inline Vector<float, 4> lower_half(Vector<float, 8> v) {
  return __builtin_shufflevector(v, v, 0, 1, 2, 3);
}
inline Vector<float, 4> upper_half(Vector<float, 8> v) {
#if defined(__AVX__)  // the compiler's own shuffle is slow here
  return (Vector<float, 4>)_mm256_extractf128_ps((__m256)v, 1);
#else
  return __builtin_shufflevector(v, v, 4, 5, 6, 7);
#endif
}

// One step of the square transpose of N vectors. It splits pairs into their even and odd parts, and
// moves these to the lower and the upper half. After log2(N) steps, row i of lane j is row j of
// lane i.
template <int N, typename V, typename Even, typename Odd>
inline void split_pairs(V* rows, int stride, Even even, Odd odd) {
  V next[N];
#pragma GCC unroll 8
  for (int i = 0; i < N / 2; ++i) {
    next[i] = even(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
    next[i + N / 2] = odd(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
  }
#pragma GCC unroll 16
  for (int i = 0; i < N; ++i) rows[i * stride] = next[i];
}

// Joins the four floats at from + at[0], from + at[4], ... to a register.
template <int kQuads = kLanes<float> / 4>
inline Vector<float, 4 * kQuads> quads(const float* from, const int32_t* at) {
  if constexpr (kQuads == 1) {
    return load<Vector<float, 4>>(from + *at);
  } else {
    const auto front = quads<kQuads / 2>(from, at), back = quads<kQuads / 2>(from, at + 2 * kQuads);
    if constexpr (kQuads == 2) {
      return __builtin_shufflevector(front, back, 0, 1, 2, 3, 4, 5, 6, 7);
    } else {
      return __builtin_shufflevector(front, back, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14,
                                     15);
    }
  }
}

// Transposes the 4 x 4 square within each 128 bits of four registers.
inline void transpose_quads(Floats* rows) {
  constexpr int kL = kLanes<float>;
  const auto even = [](Floats a, Floats b) {
    return shuffle<[](int i) { return i / 4 * 4 + i % 2 * 2 + i / 2 % 2 * kL; }>(a, b);
  };
  const auto odd = [](Floats a, Floats b) {
    return shuffle<[](int i) { return i / 4 * 4 + i % 2 * 2 + i / 2 % 2 * kL + 1; }>(a, b);
  };
  split_pairs<4>(rows, 1, even, odd);
  split_pairs<4>(rows, 1, even, odd);
}

// Stores four registers as pixels of four channels, one after the other.
inline void interleave_four(Floats x, Floats y, Floats z, Floats w, float* to) {
  constexpr int kL = kLanes<float>;
  using Pairs = Vector<double, kL / 2>;
  constexpr auto front = [](int i) { return i / 2 + i % 2 * kL; };
  constexpr auto back = [](int i) { return kL / 2 + i / 2 + i % 2 * kL; };
  constexpr auto front_pairs = [](int i) { return i / 2 + i % 2 * (kL / 2); };
  constexpr auto back_pairs = [](int i) { return kL / 4 + i / 2 + i % 2 * (kL / 2); };
  const auto xy = (Pairs)shuffle<front>(x, y), zw = (Pairs)shuffle<front>(z, w);
  const auto xy2 = (Pairs)shuffle<back>(x, y), zw2 = (Pairs)shuffle<back>(z, w);
  store(to, (Floats)shuffle<front_pairs>(xy, zw));
  store(to + kL, (Floats)shuffle<back_pairs>(xy, zw));
  store(to + 2 * kL, (Floats)shuffle<front_pairs>(xy2, zw2));
  store(to + 3 * kL, (Floats)shuffle<back_pairs>(xy2, zw2));
}

// Writes the transpose of a square of kLanes x kLanes. The rows of `to` are `stride` apart. The
// first part transposes each 4 x 4 square within 128 bits. The second part transposes the blocks of
// 128 bits among themselves.
inline void transpose_square(Floats* rows, float* to, int64_t stride) {
  constexpr int kL = kLanes<float>, kQuads = kL / 4;
#pragma GCC unroll 4
  for (int quad = 0; quad < kQuads; ++quad) transpose_quads(rows + 4 * quad);
#pragma GCC unroll 4
  for (int lane = 0; lane < 4; ++lane) {
    for (int step = 1; step < kQuads; step *= 2) {
      split_pairs<kQuads>(rows + lane, 4, even_quads<Floats>, odd_quads<Floats>);
    }
  }
#pragma GCC unroll 16
  for (int i = 0; i < kL; ++i) store(to + i * stride, rows[i]);
}
template <typename V>  // V has four lanes, a register has more
inline void transpose_square(V* rows, float* to, int64_t stride) {
  transpose4(rows[0], rows[1], rows[2], rows[3], to, stride);
}

}  // namespace
}  // namespace darswin
