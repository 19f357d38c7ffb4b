// _transpose_sum on CPU: check, allocate, thread, call the kernel.
#include "transpose_sum.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

using torch::stable::Tensor;

std::tuple<Tensor, Tensor> transpose_sum(const Tensor& x) {
  STD_TORCH_CHECK(x.is_cpu() && x.scalar_type() == torch::headeronly::ScalarType::Float &&
                      x.dim() == 2 && x.is_contiguous(),
                  "transpose_sum: x must be a contiguous float32 matrix");
  const int64_t rows = x.size(0), columns = x.size(1);
  if (x.numel() == 0) {
    return {torch::stable::new_empty(x, std::vector<int64_t>{columns, rows}),
            torch::stable::new_zeros(x, std::vector<int64_t>{columns})};
  }
  const int64_t groups = (rows + kGroupRows - 1) / kGroupRows;
  const Tensor transposed = torch::stable::new_empty(x, std::vector<int64_t>{columns, rows});
  const Tensor sum = torch::stable::new_empty(x, std::vector<int64_t>{columns});
  const ThreadMemory memory(groups * columns * sizeof(float));
  auto* sums = static_cast<float*>(memory.get());
  const TransposeSumArgs args{.from = static_cast<const float*>(x.const_data_ptr()),
                              .to = static_cast<float*>(transposed.mutable_data_ptr()),
                              .sums = sums,
                              .rows = rows,
                              .columns = columns};
  parallel_ranges(groups, [&](int64_t begin, int64_t end) {
    kernels<TransposeSumKernels>().groups(args, begin, end);
  });
  // Adds up the groups in order, whichever thread made them; in double, since there may be many
  // thousands. Some columns at a time, whose totals stay in the nearest cache.
  constexpr int64_t kColumns = 128;
  auto* to = static_cast<float*>(sum.mutable_data_ptr());
  for (int64_t first = 0; first < columns; first += kColumns) {
    const int64_t count = std::min(kColumns, columns - first);
    double totals[kColumns] = {};
    for (int64_t group = 0; group < groups; ++group) {
      const float* from = sums + group * columns + first;
      for (int64_t c = 0; c < count; ++c) totals[c] += from[c];
    }
    std::copy_n(totals, count, to + first);
  }
  return {transposed, sum};
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("_transpose_sum", TORCH_BOX(&darswin::transpose_sum));
}
