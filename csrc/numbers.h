// The types of numbers that drivers and kernels share.
#pragma once

#include <cstdint>
#include <type_traits>

namespace darswin {

// The upper half of a float32.
struct bfloat16 {
  uint16_t bits;
};

// The type used to compute with numbers of a storage type.
template <typename T>
using Arithmetic = std::conditional_t<std::is_same_v<T, bfloat16>, float, T>;

// Converts numbers to 8 bits: round(x / scale) + zero_point, clamped to 0 ... 255.
struct Quantizer {
  float steps = 1;  // 1 / scale
  int32_t zero_point = 0;
};

}  // namespace darswin
