// bfloat16 as drivers and kernels hand it to each other: the upper half of a float32.
#pragma once

#include <cstdint>

namespace darswin {

struct bfloat16 {
  uint16_t bits;
};

}  // namespace darswin
