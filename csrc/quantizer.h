// The Quantizer of an operator's arguments.
#pragma once

#include <torch/headeronly/util/Exception.h>

#include "quantized.h"

namespace darswin {

inline Quantizer quantizer(double scale, int64_t zero_point) {
  const double steps = 1 / scale;
  STD_TORCH_CHECK(steps >= 1e-30 && steps <= 1e30 && zero_point >= 0 && zero_point <= 255,
                  "scale must be in 1e-30 ... 1e30, zero_point in 0 ... 255");
  return {static_cast<float>(steps), static_cast<int32_t>(zero_point)};
}

}  // namespace darswin
