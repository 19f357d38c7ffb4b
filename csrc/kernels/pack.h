// Writes weights in the layout of packed layers (see linear.h), in every step of a training.
#pragma once

#include "../linear.h"
#include "simd.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;

// Writes panels [first, last) of a weight (columns, depth), which it turns square by square.
inline void pack(const float* weight, int64_t columns, int64_t depth, int64_t first, int64_t last,
                 float* packed) {
  const int64_t padded = padded_columns(columns);
  for (int64_t column = first * kPanel; column < smaller(last * kPanel, padded); column += kL) {
    const int64_t begin = column / kPanel * kPanel, width = smaller(kPanel, padded - begin);
    float* to = packed + padded + begin * depth + column - begin;
    const float* from = weight + column * depth;
    int64_t k = 0;
    for (; column + kL <= columns && k + kL <= depth; k += kL) {
      Floats rows[kL];
      for (int64_t i = 0; i < kL; ++i) rows[i] = load<Floats>(from + i * depth + k);
      transpose_square(rows, to + k * width, width);
    }
    for (; k < depth; ++k) {
      for (int64_t i = 0; i < kL; ++i) {
        to[k * width + i] = column + i < columns ? from[i * depth + k] : 0;
      }
    }
  }
}

// Writes a panel of a transposed weight, whose rows lie as in the panel already.
inline void pack_rows(const float* rows, int64_t pitch, int64_t depth, int64_t columns,
                      float* panel) {
  const int64_t padded = padded_columns(columns);
  for (int64_t k = 0; k < depth; ++k, rows += pitch, panel += padded) {
    for (int64_t n = 0; n < padded; n += kL) {
      const int64_t count = columns < n ? 0 : smaller(kL, columns - n);
      store(panel + n, count == kL ? load<Floats>(rows + n) : load_first(rows + n, count));
    }
  }
}

}  // namespace
}  // namespace darswin
