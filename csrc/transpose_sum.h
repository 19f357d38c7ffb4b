// What the driver of _transpose_sum and its kernel agree on.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

// Rows are taken in groups of this many; each group has its own sums of columns.
constexpr int64_t kGroupRows = 64;

// to = the transpose of `from`.
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
