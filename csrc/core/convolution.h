// A convolution of 3 x 3 with zeros around the map, as a linear layer of the neighbours of a pixel.
#pragma once

#include "layers.h"

namespace darswin {

// Maps are channels last: x (batch, H, W, C) and the result (batch, H, W, columns of the layer).
// The depth of the layer is 9 C, in the order (row, column, channel).
struct Convolution {
  const float* x = nullptr;
  int64_t stride = 0;  // from map to map; 0 if one is for all
  int64_t batch = 0, height = 0, width = 0, channels = 0;
  const Layer& layer;
  After after = After::nothing;  // of the product: gelu or relu
  // Perhaps a map to add then, and a function of the sum.
  const float* summand = nullptr;
  int64_t summand_stride = 0;
  After then = After::nothing;
  float* out = nullptr;

  void run() const;

 private:
  void copy_around(const float* map, int64_t y, int64_t x, int64_t rows, int64_t columns,
                   int64_t pitch, float* to) const;
};

}  // namespace darswin
