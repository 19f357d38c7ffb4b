// bfloat16 as drivers and kernels hand it to each other: the upper half of a float32.
#pragma once

#include <cstdint>

namespace darswin {

struct bfloat16 {
  uint16_t bits;
};

// The type in which a storage type is computed.
template <typename T>
struct ArithmeticOf {
  using type = T;
};
template <>
struct ArithmeticOf<bfloat16> {
  using type = float;
};
template <typename T>
using Arithmetic = typename ArithmeticOf<T>::type;

}  // namespace darswin
