// _add_norm_ on CPU: check, thread, call the kernel.
#include "add_norm.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>

#include "bfloat16.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// Values that are worth a thread of their own.
constexpr int64_t kGrain = 8192;

template <typename S>
void run(const Tensor& x, const Tensor& y, const Tensor& weight, const Tensor& bias, double eps) {
  const AddNormArgs<S> args{.x = static_cast<S*>(x.mutable_data_ptr()),
                            .y = static_cast<S*>(y.mutable_data_ptr()),
                            .weight = static_cast<const float*>(weight.const_data_ptr()),
                            .bias = static_cast<const float*>(bias.const_data_ptr()),
                            .eps = static_cast<float>(eps),
                            .width = weight.numel()};
  if (x.numel() == 0) return;
  const int64_t rows = x.numel() / args.width, each = std::max<int64_t>(kGrain / args.width, 1);
  parallel_ranges((rows + each - 1) / each, [&](int64_t begin, int64_t end) {
    kernels<AddNormKernels<S>>().rows(args, begin * each, std::min(end * each, rows));
  });
}

void add_norm_(Tensor x, Tensor y, const Tensor& weight, const Tensor& bias, double eps) {
  const bool half = x.scalar_type() == ScalarType::BFloat16;
  STD_TORCH_CHECK(half || x.scalar_type() == ScalarType::Float,
                  "add_norm_: x must be float32 or bfloat16");
  STD_TORCH_CHECK(y.is_cpu() && y.scalar_type() == x.scalar_type() && y.numel() == x.numel() &&
                      x.dim() > 0 && y.dim() > 0 && y.size(y.dim() - 1) == x.size(x.dim() - 1) &&
                      x.is_contiguous() && y.is_contiguous(),
                  "add_norm_: x and y must look alike and be contiguous");
  for (const Tensor* t : {&weight, &bias}) {
    STD_TORCH_CHECK(t->is_cpu() && t->scalar_type() == ScalarType::Float && t->dim() == 1 &&
                        t->size(0) == x.size(x.dim() - 1) && t->is_contiguous(),
                    "add_norm_: weight and bias must be float32 (D,), D the last size of x");
  }
  struct Bytes {
    const char *begin, *end;
    Bytes(const Tensor& t, int64_t count)
        : begin(static_cast<const char*>(t.const_data_ptr())), end(begin + count) {}
    bool apart(const Bytes& other) const { return end <= other.begin || other.end <= begin; }
  };
  const int64_t rows = x.numel() * (half ? 2 : 4), row = x.size(x.dim() - 1) * 4;
  const Bytes in_x(x, rows), in_y(y, rows), in_weight(weight, row), in_bias(bias, row);
  STD_TORCH_CHECK(in_x.apart(in_y) && in_x.apart(in_weight) && in_x.apart(in_bias) &&
                      in_y.apart(in_weight) && in_y.apart(in_bias),
                  "add_norm_: x and y change, so they must share no memory with each other nor "
                  "with weight or bias");
  half ? run<bfloat16>(x, y, weight, bias, eps) : run<float>(x, y, weight, bias, eps);
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) { m.impl("_add_norm_", TORCH_BOX(&darswin::add_norm_)); }
