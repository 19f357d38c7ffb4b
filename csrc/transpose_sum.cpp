// _transpose_sum on CPU: check, allocate, thread, call the kernel.
#include "transpose_sum.h"

#include <tuple>

#include "checks.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

std::tuple<Tensor, Tensor> transpose_sum(const Tensor& x) {
  STD_TORCH_CHECK(
      x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() == 2 && x.is_contiguous(),
      "transpose_sum: x must be a contiguous float32 matrix");
  const int64_t rows = x.size(0), columns = x.size(1);
  const Tensor transposed = new_tensor(Sizes{columns, rows}, ScalarType::Float);
  const Tensor sum = new_zeros(x, Sizes{columns});
  if (x.numel() == 0) return {transposed, sum};
  const int64_t groups = (rows + kGroupRows - 1) / kGroupRows;
  const ThreadMemory memory(groups * columns * sizeof(float));
  auto* sums = static_cast<float*>(memory.get());
  const TransposeSumArgs args{.from = pointer<float>(x),
                              .to = mutable_pointer<float>(transposed),
                              .sums = sums,
                              .rows = rows,
                              .columns = columns};
  parallel_ranges(groups,
                  [&](auto... range) { kernels<TransposeSumKernels>().groups(args, range...); });
  // Adds up the groups in order, so that the result does not depend on the threads. The totals are
  // double, because there may be many thousands of groups. Only some columns are added at a time,
  // so that their totals stay in the first-level cache.
  constexpr int64_t kColumns = 128;
  auto* to = mutable_pointer<float>(sum);
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
