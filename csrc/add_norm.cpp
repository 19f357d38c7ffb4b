// _add_norm_ on CPU: check, thread, call the kernel.
#include "add_norm.h"

#include <algorithm>
#include <optional>

#include "checks.h"
#include "core/dispatch.h"
#include "core/parallel.h"

namespace darswin {
namespace {

template <typename S, typename Out>
void run(AddNormArgs<S, Out> args, const Tensor& x, const Tensor& weight, const Tensor& bias,
         double eps) {
  args.x = mutable_pointer<S>(x);
  args.weight = pointer<float>(weight);
  args.bias = pointer<float>(bias);
  args.eps = static_cast<float>(eps);
  args.width = weight.numel();
  if (x.numel() == 0) return;
  constexpr double kPerMicrosecond = 4000;  // values
  const Threads threads = threads_for(static_cast<double>(x.numel()) / kPerMicrosecond);
  parallel_ranges(x.numel() / args.width, threads, [&](int64_t begin, int64_t end) {
    kernels<AddNormKernels<S, Out>>().rows(args, begin, end);
  });
}

// The bytes of a tensor's numbers.
struct Bytes {
  const char *begin, *end;
  explicit Bytes(const Tensor& t)
      : begin(pointer<char>(t)),
        end(begin + t.numel() * (t.scalar_type() == ScalarType::BFloat16 ? 2 : 4)) {}
  bool apart(const Bytes& other) const { return end <= other.begin || other.end <= begin; }
};

void check_alike(const Tensor& x, const Tensor& y) {
  STD_TORCH_CHECK(y.is_cpu() && y.scalar_type() == x.scalar_type() && y.numel() == x.numel() &&
                      x.dim() > 0 && y.dim() > 0 && y.size(y.dim() - 1) == x.size(x.dim() - 1) &&
                      x.is_contiguous() && y.is_contiguous(),
                  "add_norm_: x and y must look alike and be contiguous");
  STD_TORCH_CHECK(Bytes(x).apart(Bytes(y)), "add_norm_: x and y must share no memory");
}

void check_parameters(const Tensor& changes, const Tensor& weight, const Tensor& bias) {
  for (const Tensor* t : {&weight, &bias}) {
    STD_TORCH_CHECK(t->is_cpu() && t->scalar_type() == ScalarType::Float && t->dim() == 1 &&
                        t->size(0) == changes.size(changes.dim() - 1) && t->is_contiguous(),
                    "add_norm_: weight and bias must be float32 (D,), D the last size of x");
    STD_TORCH_CHECK(Bytes(changes).apart(Bytes(*t)),
                    "add_norm_: x and y change, so they must share no memory with weight or bias");
  }
}

void add_norm_(Tensor x, Tensor y, Tensor weight, Tensor bias, double eps) {
  check_alike(x, y);
  check_parameters(x, weight, bias);
  check_parameters(y, weight, bias);
  if (x.scalar_type() == ScalarType::BFloat16) {
    auto* out = mutable_pointer<bfloat16>(y);
    return run(AddNormArgs<bfloat16, bfloat16>{.y = out, .out = out}, x, weight, bias, eps);
  }
  STD_TORCH_CHECK(x.scalar_type() == ScalarType::Float, "add_norm_: x must be float32 or bfloat16");
  auto* out = mutable_pointer<float>(y);
  run(AddNormArgs<float, float>{.y = out, .out = out}, x, weight, bias, eps);
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) { m.impl("_add_norm_", TORCH_BOX(&darswin::add_norm_)); }
