// _add_norm_ and _add_norm_quantized_ on CPU: check, thread, call the kernel.
#include "add_norm.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <optional>

#include "bfloat16.h"
#include "dispatch.h"
#include "parallel.h"
#include "quantizer.h"

namespace darswin {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// Values that are worth a thread of their own.
constexpr int64_t kGrain = 8192;

template <typename S, typename Out>
void run(AddNormArgs<S, Out> args, const Tensor& x, const Tensor& weight, const Tensor& bias,
         double eps) {
  args.x = static_cast<S*>(x.mutable_data_ptr());
  args.weight = static_cast<const float*>(weight.const_data_ptr());
  args.bias = static_cast<const float*>(bias.const_data_ptr());
  args.eps = static_cast<float>(eps);
  args.width = weight.numel();
  if (x.numel() == 0) return;
  const int64_t rows = x.numel() / args.width, each = std::max<int64_t>(kGrain / args.width, 1);
  parallel_ranges((rows + each - 1) / each, [&](int64_t begin, int64_t end) {
    kernels<AddNormKernels<S, Out>>().rows(args, begin * each, std::min(end * each, rows));
  });
}

// Bytes that a tensor's numbers lie in.
struct Bytes {
  const char *begin, *end;
  explicit Bytes(const Tensor& t)
      : begin(static_cast<const char*>(t.const_data_ptr())),
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

void add_norm_(Tensor x, Tensor y, const Tensor& weight, const Tensor& bias, double eps) {
  const bool half = x.scalar_type() == ScalarType::BFloat16;
  STD_TORCH_CHECK(half || x.scalar_type() == ScalarType::Float,
                  "add_norm_: x must be float32 or bfloat16");
  check_alike(x, y);
  check_parameters(x, weight, bias);
  check_parameters(y, weight, bias);
  const auto in_type = [&]<typename S>(S* out) {
    run(AddNormArgs<S, S>{.y = out, .out = out}, x, weight, bias, eps);
  };
  if (half) {
    in_type(static_cast<bfloat16*>(y.mutable_data_ptr()));
  } else {
    in_type(static_cast<float*>(y.mutable_data_ptr()));
  }
}

Tensor add_norm_quantized_(Tensor x, std::optional<Tensor> y, const Tensor& weight,
                           const Tensor& bias, double eps, double scale, int64_t zero_point) {
  STD_TORCH_CHECK(
      x.is_cpu() && x.scalar_type() == ScalarType::Float && x.dim() > 0 && x.is_contiguous(),
      "add_norm_quantized_: x must be float32 and contiguous");
  if (y.has_value()) check_alike(x, *y);
  check_parameters(x, weight, bias);
  const Tensor out = torch::stable::new_empty(x, x.sizes(), ScalarType::Byte);
  run(
      AddNormArgs<float, uint8_t>{
          .y = y.has_value() ? static_cast<const float*>(y->const_data_ptr()) : nullptr,
          .out = static_cast<uint8_t*>(out.mutable_data_ptr()),
          .quantizer = quantizer(scale, zero_point)},
      x, weight, bias, eps);
  return out;
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("_add_norm_", TORCH_BOX(&darswin::add_norm_));
  m.impl("_add_norm_quantized_", TORCH_BOX(&darswin::add_norm_quantized_));
}
