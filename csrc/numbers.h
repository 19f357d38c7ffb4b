// Numbers as drivers and kernels hand them to each other.
#pragma once

#include <cstdint>
#include <type_traits>

namespace darswin {

// The upper half of a float32.
struct bfloat16 {
  uint16_t bits;
};

// The type in which a storage type is computed.
template <typename T>
using Arithmetic = std::conditional_t<std::is_same_v<T, bfloat16>, float, T>;

// How numbers become 8 bits: round(x / scale) + zero_point, kept in 0 ... 255.
struct Quantizer {
  float steps = 1;  // 1 / scale
  int32_t zero_point = 0;
};

}  // namespace darswin
