// AVX2: registers of 256 bits, and fused multiply-add. generic.h and four_lanes.h
// explain each name.
#pragma once

#include <immintrin.h>

#include "../../numbers.h"
#include "../vector.h"

namespace darswin {
namespace {

constexpr int kRegister = 32;  // bytes
constexpr int kTileRows = 4;   // rows of a tile of sums: 4 x 3 of 16 registers
constexpr bool kFused = true;
constexpr bool kHasFours = true, kSignedFours = false, kHasTiles = false;

using Floats = Vector<float, 8>;
using Doubles = Vector<double, 4>;
using Words = Vector<uint64_t, 4>;

inline Floats repeat(Vector<float, 4> v) { return (Floats)_mm256_set_m128((__m128)v, (__m128)v); }

inline Doubles to_doubles(Vector<int32_t, 4> x) { return __builtin_convertvector(x, Doubles); }

inline Vector<int32_t, 4> to_ints(Doubles x) {
  return __builtin_convertvector(x, Vector<int32_t, 4>);
}

inline Doubles whole_part(Doubles x) {
  return (Doubles)_mm256_round_pd((__m256d)x, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
}

inline void stream_lanes(float* to, Floats v) { _mm256_stream_ps(to, (__m256)v); }

inline __m256i first_lanes(int64_t count) {
  const Vector<int32_t, 8> lanes = {0, 1, 2, 3, 4, 5, 6, 7};
  return (__m256i)(lanes < static_cast<int32_t>(count));
}
inline Floats load_first(const float* from, int64_t count) {
  return (Floats)_mm256_maskload_ps(from, first_lanes(count));
}
inline void store_first(float* to, Floats v, int64_t count) {
  _mm256_maskstore_ps(to, first_lanes(count), (__m256)v);
}

inline Floats gathered(const float* from, const int32_t* at) {
  return (Floats)_mm256_i32gather_ps(from, load_bits<__m256i>(at), sizeof(float));
}

inline Floats widen_lanes(const bfloat16* from) {
  const auto bits = (Vector<uint32_t, 8>)_mm256_cvtepu16_epi32(load_bits<__m128i>(from));
  return (Floats)(bits << 16);
}

inline void store_lowest_bytes(uint8_t* to, Vector<uint32_t, 8> v) {
  const __m256i first = _mm256_set1_epi32(0x0C080400);
  const __m256i fours = _mm256_shuffle_epi8((__m256i)v, first);
  const __m128i upper = _mm256_extracti128_si256(fours, 1);
  store_bits(to, _mm_cvtsi128_si64(_mm_unpacklo_epi32(_mm256_castsi256_si128(fours), upper)));
}

inline Words lower_product(Words a, uint32_t b) {
  return (Words)_mm256_mul_epu32((__m256i)a, (__m256i)splat<Words>(static_cast<uint64_t>(b)));
}

inline Vector<int32_t, 8> add_pairs(Vector<int32_t, 8> sums, Vector<uint32_t, 8> x,
                                    Vector<uint32_t, 8> weights) {
  return sums + (Vector<int32_t, 8>)_mm256_madd_epi16((__m256i)x, (__m256i)weights);
}

// The instruction is AVX-VNNI. Assembly needs no flag of the compiler.
inline Vector<int32_t, 8> add_fours(Vector<int32_t, 8> sums, Vector<uint32_t, 8> x,
                                    Vector<uint32_t, 8> weights) {
  asm("%{vex%} vpdpbusd %2, %1, %0" : "+x"(sums) : "x"(x), "x"(weights));
  return sums;
}

}  // namespace
}  // namespace darswin
