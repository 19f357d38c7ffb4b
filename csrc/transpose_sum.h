// The interface between the driver of _transpose_sum and its kernel.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

// Rows are processed in groups of this many. Each group has its own sums of columns.
constexpr int64_t kGroupRows = 64;

// Writes the transpose of `from` to `to`, and the sums of the columns of each group to `sums`.
struct TransposeSumArgs {
  const float* from;  // (rows, columns)
  float* to;          // (columns, rows)
  float* sums;        // (groups, columns)
  int64_t rows, columns;
};

struct TransposeSumKernels {
  void (*groups)(const TransposeSumArgs&, int64_t begin, int64_t end);  // groups [begin, end)
};

}  // namespace darswin
