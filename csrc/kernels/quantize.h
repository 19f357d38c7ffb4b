// Rounds numbers to 8 bits, as integer products read them.
//
// After adding 1.5 * 2^23, a float has no bits left for a fraction. So the sum is rounded to the
// nearest integer, ties to even, and this integer is in the lowest bits. Values out of range are
// clamped before, so that no conversion overflows. NaN gets the same result as 0.
#pragma once

#include "convert.h"

namespace darswin {
namespace {

// Works on one float, on a register, Floats, or on a part of one.
class Quantize {
 public:
  explicit Quantize(Quantizer q)
      : steps(q.steps),
        lowest(-static_cast<float>(q.zero_point)),
        highest(255 - static_cast<float>(q.zero_point)),
        zero_point(static_cast<uint32_t>(q.zero_point)) {}

  template <typename V>
  void operator()(uint8_t* to, V x) const {
    constexpr float kShift = 12582912.0f;  // its own lowest 22 bits are 0
    V value = x == x ? x * steps : V{};
    value = value > lowest ? value : splat<V>(lowest);
    value = value < highest ? value : splat<V>(highest);
    const auto bits = __builtin_bit_cast(BitsOf<V>, value + kShift) + zero_point;
    if constexpr (is_same_v<V, float>) {
      *to = static_cast<uint8_t>(bits);
    } else if constexpr (is_same_v<V, Floats>) {
      store_lowest_bytes(to, bits);
    } else {
      store_bits(to, __builtin_convertvector(bits, Vector<uint8_t, sizeof(V) / sizeof(float)>));
    }
  }
  void operator()(uint8_t* to, const float* from, int64_t count) const {
    int64_t e = 0;
    for (; e + kLanes<float> <= count; e += kLanes<float>) (*this)(to + e, load<Floats>(from + e));
    for (; e < count; ++e) (*this)(to + e, from[e]);
  }

 private:
  float steps, lowest, highest;
  uint32_t zero_point;
};

}  // namespace
}  // namespace darswin
