// NEON, which every CPU of the 64-bit ARM architecture has: 32 registers of 128 bits, and fused
// multiply-add. generic.h and four_lanes.h explain each name.
#pragma once

#include <arm_neon.h>

#include "../../numbers.h"
#include "../vector.h"
#include "four_lanes.h"

namespace darswin {
namespace {

constexpr int kTileRows = 8;  // rows of a tile of sums: 8 x 3 of 32 registers
constexpr bool kFused = true;
#if defined(__clang__) && !defined(__ARM_FEATURE_DOTPROD)
// Clang assembles no instruction that its target lacks. Apple's targets have this one.
constexpr bool kHasFours = false, kSignedFours = false, kHasTiles = false;
#else
constexpr bool kHasFours = true, kSignedFours = true, kHasTiles = false;
#endif

inline Doubles to_doubles(Vector<int32_t, 2> x) {
  return (Doubles)vcvtq_f64_s64(vmovl_s32((int32x2_t)x));
}

inline Vector<int32_t, 2> to_ints(Doubles x) {
  return (Vector<int32_t, 2>)vmovn_s64(vcvtq_s64_f64((float64x2_t)x));
}

inline Doubles whole_part(Doubles x) { return (Doubles)vrndq_f64((float64x2_t)x); }

inline Floats widen_lanes(const bfloat16* from) {
  return (Floats)vshll_n_u16(load_bits<uint16x4_t>(from), 16);
}

inline void store_lowest_bytes(uint8_t* to, Vector<uint32_t, 4> v) {
  const auto halves = vcombine_u16(vmovn_u32((uint32x4_t)v), vdup_n_u16(0));
  vst1_lane_u32(reinterpret_cast<uint32_t*>(to), vreinterpret_u32_u8(vmovn_u16(halves)), 0);
}

inline Words lower_product(Words a, uint32_t b) {
  return (Words)vmull_n_u32(vmovn_u64((uint64x2_t)a), b);
}

inline Vector<int32_t, 4> add_pairs(Vector<int32_t, 4> sums, Vector<uint32_t, 4> x,
                                    Vector<uint32_t, 4> weights) {
  const auto tokens = vget_low_s16((int16x8_t)x);
  const int16x4_t even = vmovn_s32((int32x4_t)weights), odd = vshrn_n_s32((int32x4_t)weights, 16);
  return (Vector<int32_t, 4>)vmlal_lane_s16(vmlal_lane_s16((int32x4_t)sums, even, tokens, 0), odd,
                                            tokens, 1);
}

// The instruction is part of the dot products of ARMv8.2. Assembly needs no flag of the compiler.
inline Vector<int32_t, 4> add_fours(Vector<int32_t, 4> sums, Vector<uint32_t, 4> x,
                                    Vector<uint32_t, 4> weights) {
  asm(".arch armv8.2-a+dotprod\n\tsdot %0.4s, %1.16b, %2.16b" : "+w"(sums) : "w"(x), "w"(weights));
  return sums;
}

}  // namespace
}  // namespace darswin
