// The generic tier: registers of 128 bits and no fused multiply-add. On x86 this is SSE2, which
// every such CPU has. On other CPUs the compiler chooses the instructions.
//
// The header of a tier holds everything that differs between tiers: the sizes of the registers, and
// a few functions for which the compiler makes slow code from plain vector code.
#pragma once

#if defined(__SSE2__)
#  include <emmintrin.h>
#endif

#include "../../numbers.h"
#include "../vector.h"
#include "four_lanes.h"

namespace darswin {
namespace {

constexpr int kTileRows = 4;  // rows of a tile of sums: 4 x 3 of 16 registers
constexpr bool kFused = false;
// There is add_fours, and it takes signed bytes: those of tokens less 128.
constexpr bool kHasFours = false, kSignedFours = false, kHasTiles = false;

inline Doubles to_doubles(Vector<int32_t, 2> x) { return __builtin_convertvector(x, Doubles); }

// Returns the whole part of numbers below 2^31.
inline Vector<int32_t, 2> to_ints(Doubles x) {
  return __builtin_convertvector(x, Vector<int32_t, 2>);
}

// Returns the whole part of numbers below 2^63.
inline Doubles whole_part(Doubles x) {
  return __builtin_convertvector(__builtin_convertvector(x, Vector<int64_t, 2>), Doubles);
}

// Widens bfloat16 to float32: the bits become the upper half of each float.
inline Floats widen_lanes(const bfloat16* from) {
  using Bits = Vector<uint32_t, 4>;
  const auto bits = __builtin_convertvector(load_bits<Vector<uint16_t, 4>>(from), Bits);
  return (Floats)(bits << 16);
}

// Stores the lowest byte of each lane.
inline void store_lowest_bytes(uint8_t* to, Vector<uint32_t, 4> v) {
  auto bytes = (Vector<uint8_t, 16>)v;
  bytes = evens(bytes, bytes);
  bytes = evens(bytes, bytes);
  __builtin_memcpy(to, &bytes, 4);
}

// Returns the products of the lower halves of the lanes.
inline Words lower_product(Words a, uint32_t b) {
  const Words factor = splat<Words>(static_cast<uint64_t>(b));
#if defined(__SSE2__)
  return (Words)_mm_mul_epu32((__m128i)a, (__m128i)factor);
#else
  return (a & 0xFFFFFFFF) * factor;
#endif
}

// Adds the products of two signed numbers of 16 bits to each sum. Tiers with kHasFours also have
// add_fours: the same for four bytes of a token and four signed bytes of the weights. Only some
// CPUs of a tier have its instruction; core/dispatch.h tells which.
inline Vector<int32_t, 4> add_pairs(Vector<int32_t, 4> sums, Vector<uint32_t, 4> x,
                                    Vector<uint32_t, 4> weights) {
#if defined(__SSE2__)
  return sums + (Vector<int32_t, 4>)_mm_madd_epi16((__m128i)x, (__m128i)weights);
#else
  const auto a = (Vector<int32_t, 4>)x, b = (Vector<int32_t, 4>)weights;
  return sums + (a << 16 >> 16) * (b << 16 >> 16) + (a >> 16) * (b >> 16);
#endif
}

}  // namespace
}  // namespace darswin
