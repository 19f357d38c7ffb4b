// Numbers as 8 bits, as oneDNN's integer products read them.
//
// Adding 1.5 * 2^23 to a float leaves no bits behind its point, which rounds it to the nearest
// integer, ties to even, and that integer stands in the lowest bits. What does not fit is cut
// before, so no conversion overflows; NaN becomes what 0 does.
#pragma once

#include "../quantized.h"
#include "simd.h"

namespace darswin {
namespace {

class Quantize {
 public:
  explicit Quantize(Quantizer q)
      : steps(q.steps),
        lowest(static_cast<float>(-q.zero_point)),
        highest(static_cast<float>(255 - q.zero_point)),
        zero_point(static_cast<uint32_t>(q.zero_point)) {}

  void operator()(uint8_t* to, Floats x) const {
    using Bits = Vector<uint32_t, kLanes<float>>;
    const Floats cut = bounded(x * steps, x);
    store_bits(to, __builtin_convertvector((Bits)(cut + kShift) + zero_point,
                                           Vector<uint8_t, kLanes<float>>));
  }
  void operator()(uint8_t* to, float x) const {
    const float shifted = bounded(x * steps, x) + kShift;
    uint32_t bits;
    __builtin_memcpy(&bits, &shifted, sizeof(bits));
    *to = static_cast<uint8_t>(bits + zero_point);
  }
  void operator()(uint8_t* to, const float* from, int64_t count) const {
    int64_t e = 0;
    for (; e + kLanes<float> <= count; e += kLanes<float>) (*this)(to + e, load<Floats>(from + e));
    for (; e < count; ++e) (*this)(to + e, from[e]);
  }

 private:
  static constexpr float kShift = 12582912.0f;  // its own lowest 22 bits are 0

  template <typename V>
  V bounded(V value, V x) const {
    value = x == x ? value : V{};
    value = value > lowest ? value : V{} + lowest;
    return value < highest ? value : V{} + highest;
  }

  float steps, lowest, highest;
  uint32_t zero_point;
};

}  // namespace
}  // namespace darswin
