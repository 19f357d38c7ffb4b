// Transposes a matrix and sums its columns, in one pass over memory.
//
// Backward of a linear layer needs both results for the gradient of its output. The transpose times
// the input is the gradient of the weight. The sums of the columns are the gradient of the bias.
// Rows are read in groups, so that the kernel writes whole cache lines of each column.
#include "../transpose_sum.h"

#include "simd.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;

// Writes to[c * to_stride + r] = from[r * columns + c] for r < kL, c < kL, and returns the sums
// over r.
inline Floats square(const float* from, int64_t columns, float* to, int64_t to_stride) {
  Floats rows[kL];
  Floats sums[4] = {};
#pragma GCC unroll 16
  for (int i = 0; i < kL; ++i) {
    rows[i] = load<Floats>(from + i * columns);
    sums[i % 4] += rows[i];
  }
  transpose_square(rows, to, to_stride);
  return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

void transpose_groups(const TransposeSumArgs& a, int64_t begin, int64_t end) {
  for (int64_t group = begin; group < end; ++group) {
    const int64_t first = group * kGroupRows;
    const int64_t rows = smaller(a.rows - first, kGroupRows);
    const float* from = a.from + first * a.columns;
    float *to = a.to + first, *sums = a.sums + group * a.columns;
    const int64_t whole_rows = rows / kL * kL, whole_columns = a.columns / kL * kL;
    for (int64_t c = 0; c < whole_columns; c += kL) {
      Floats sum{};
      for (int64_t r = 0; r < whole_rows; r += kL) {
        sum += square(from + r * a.columns + c, a.columns, to + c * a.rows + r, a.rows);
      }
      store(sums + c, sum);
    }
    // The remaining numbers: the last rows of all columns, if any, and all rows of the last
    // columns.
    for (int64_t c = whole_rows < rows ? 0 : whole_columns; c < a.columns; ++c) {
      const bool whole = c < whole_columns;
      float sum = whole ? sums[c] : 0;
      for (int64_t r = whole ? whole_rows : 0; r < rows; ++r) {
        const float value = from[r * a.columns + c];
        to[c * a.rows + r] = value;
        sum += value;
      }
      sums[c] = sum;
    }
  }
}

}  // namespace

TIER_TABLE(TransposeSumKernels) = {.groups = transpose_groups};

}  // namespace darswin
