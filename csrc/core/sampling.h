// Bilinear samples of maps, channels last.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "../elements.h"
#include "dispatch.h"

namespace darswin {

// Writes n numbers of a map (height, width, channels) at a pixel (x, y), 0 outside. `map` is where
// those of the first pixel begin.
inline void sample_at(const float* map, int64_t height, int64_t width, int64_t channels, float x,
                      float y, float* out, int64_t n) {
  // NaN is outside too.
  if (!(x > -1 && x < static_cast<float>(width) && y > -1 && y < static_cast<float>(height))) {
    std::fill_n(out, n, 0.0f);
    return;
  }
  const float left = std::floor(x), top = std::floor(y);
  const float right_part = x - left, lower_part = y - top;
  const auto column = static_cast<int64_t>(left), row = static_cast<int64_t>(top);
  const float* corners[4];
  float parts[4];
  for (int64_t corner = 0; corner < 4; ++corner) {
    const int64_t i = row + corner / 2, j = column + corner % 2;
    const bool inside = i >= 0 && i < height && j >= 0 && j < width;
    corners[corner] = map + (inside ? (i * width + j) * channels : 0);
    parts[corner] = inside ? (corner / 2 == 1 ? lower_part : 1 - lower_part) *
                                 (corner % 2 == 1 ? right_part : 1 - right_part)
                           : 0;
  }
  kernels<ElementKernels>().mix(corners, parts, out, n);
}

}  // namespace darswin
