// NEON, which every CPU of the 64-bit ARM architecture has: 32 registers of 128 bits, and fused
// multiply-add. generic.h explains each name.
#pragma once

#include <arm_neon.h>

#include "../../numbers.h"
#include "../vector.h"

namespace darswin {
namespace {

constexpr int kRegister = 16;  // bytes
constexpr int kTileRows = 8;   // rows of a tile of sums: 8 x 3 of 32 registers
constexpr bool kFused = true;

using Floats = Vector<float, 4>;
using Doubles = Vector<double, 2>;
using Words = Vector<uint64_t, 2>;

inline Floats repeat(Vector<float, 4> v) { return v; }

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

inline Words lower_product(Words a, uint32_t b) {
  return (Words)vmull_n_u32(vmovn_u64((uint64x2_t)a), b);
}

}  // namespace
}  // namespace darswin
