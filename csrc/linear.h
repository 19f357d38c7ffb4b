// The interface between the driver of linear layers and its kernels.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

// A packed linear layer is one array of floats. First comes the bias, then the weight in panels of
// kPanel columns. Each panel is a matrix (depth, columns of the panel). The last panel has the
// remaining columns. The columns are padded with zeros to a multiple of kPanelUnit.
constexpr int64_t kPanel = 48, kPanelUnit = 16;

// The step that follows the product.
enum class After {
  nothing,
  gelu,
  add,  // added to the values in `out`
};

// out = x * weight^T + bias
struct LinearArgs {
  const float* x;       // (rows, depth)
  const float* packed;  // bias and weight
  float* out;           // (rows, columns)
  int64_t rows, depth, columns;
  After after;
};

namespace {

inline int64_t padded_columns(const LinearArgs& a) {
  return (a.columns + kPanelUnit - 1) / kPanelUnit * kPanelUnit;
}
inline int64_t packed_size(const LinearArgs& a) { return padded_columns(a) * (1 + a.depth); }
inline int64_t panel_count(const LinearArgs& a) {
  return (padded_columns(a) + kPanel - 1) / kPanel;
}

}  // namespace

struct LinearKernels {
  // Computes the columns of panels [first, last) of rows [begin, end).
  void (*rows)(const LinearArgs&, int64_t begin, int64_t end, int64_t first, int64_t last);
};

}  // namespace darswin
