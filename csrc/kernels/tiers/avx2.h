// AVX2: registers of 256 bits, and fused multiply-add. generic.h says what each of these does.
#pragma once

#include <immintrin.h>

#include "../../numbers.h"
#include "../vector.h"

namespace darswin {
namespace {

constexpr int kRegister = 32;  // bytes
constexpr int kTileRows = 4;   // rows of a tile of sums: 4 x 3 of 16 registers
constexpr bool kFused = true;

using Floats = Vector<float, 8>;
using Doubles = Vector<double, 4>;
using Words = Vector<uint64_t, 4>;

template <typename V>
inline V unfused(V value) {
  asm("" : "+x"(value));
  return value;
}

// The compiler's own shuffle is a slow one.
inline Vector<float, 4> upper_half(Vector<float, 8> v) {
  return (Vector<float, 4>)_mm256_extractf128_ps((__m256)v, 1);
}

inline Floats repeat(Vector<float, 4> v) { return (Floats)_mm256_set_m128((__m128)v, (__m128)v); }

inline Doubles to_doubles(Vector<int32_t, 4> x) { return __builtin_convertvector(x, Doubles); }

inline Doubles whole_part(Doubles x) {
  return (Doubles)_mm256_round_pd((__m256d)x, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
}

inline Floats widen_lanes(const bfloat16* from) {
  const auto bits = (Vector<uint32_t, 8>)_mm256_cvtepu16_epi32(load_bits<__m128i>(from));
  return (Floats)(bits << 16);
}

inline Words lower_product(Words a, uint32_t b) {
  return (Words)_mm256_mul_epu32((__m256i)a, (__m256i)splat<Words>(static_cast<uint64_t>(b)));
}

inline Words interleave_lower(Words a, Words b) {
  return __builtin_shufflevector(a, b, 0, 4, 1, 5);
}
inline Words interleave_upper(Words a, Words b) {
  return __builtin_shufflevector(a, b, 2, 6, 3, 7);
}

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
inline void transpose_quads(Floats* rows) {
#pragma GCC unroll 4
  for (int lane = 0; lane < 4; ++lane) split_pairs<2>(rows + lane, 4, even_quads, odd_quads);
}

}  // namespace
}  // namespace darswin
