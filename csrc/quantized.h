// How numbers become 8 bits: round(x / scale) + zero_point, kept in 0 ... 255.
#pragma once

#include <cstdint>

namespace darswin {

struct Quantizer {
  float steps = 1;  // 1 / scale
  int32_t zero_point = 0;
};

}  // namespace darswin
