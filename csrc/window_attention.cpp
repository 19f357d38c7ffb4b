// window_attention and its backward on CPU: check, allocate, thread, call the kernel.
// The checks here only keep memory safe; darswin/ops/window_attention.py explains wrong arguments.
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <tuple>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using Sizes = std::vector<int64_t>;

// The arguments of one call, contiguous as the kernels want them. Owns what `args` points into.
template <typename T>
struct Call {
  Tensor qkv, bias;
  WindowAttentionArgs<T> args{};
  int64_t batch, windows;

  Call(const Tensor& qkv_, const Tensor& bias_, const Sizes& window, const Sizes& shift,
       const std::vector<bool>& periodic, double scale)
      : qkv(torch::stable::contiguous(qkv_)),
        bias(torch::stable::contiguous(bias_)),
        batch(qkv_.size(0)) {
    STD_TORCH_CHECK(qkv.dim() == 6 && qkv.size(3) == 3 && bias.dim() == 4 && window.size() == 2 &&
                        shift.size() == 2 && periodic.size() == 2,
                    "window_attention: wrong number of dimensions");
    STD_TORCH_CHECK(bias.scalar_type() == qkv.scalar_type() && bias.is_cpu(),
                    "window_attention: bias must be on the CPU and have the type of qkv");
    for (int axis = 0; axis < 2; ++axis) {
      const int64_t size = qkv.size(1 + axis);
      STD_TORCH_CHECK(window[axis] > 0 && size > 0 && size % window[axis] == 0 &&
                          shift[axis] >= 0 && shift[axis] < size,
                      "window_attention: window must divide the map, shift must lie inside it");
      STD_TORCH_CHECK(bias.size(2 + axis) == 2 * window[axis] - 1,
                      "window_attention: bias does not fit the window");
    }
    STD_TORCH_CHECK((bias.size(0) == 1 || bias.size(0) == batch) && bias.size(1) == qkv.size(4),
                    "window_attention: bias does not fit the batch or the heads");

    args.qkv = qkv.template const_data_ptr<T>();
    args.bias = bias.template const_data_ptr<T>();
    args.rings = qkv.size(1);
    args.sectors = qkv.size(2);
    args.heads = qkv.size(4);
    args.head_dim = qkv.size(5);
    args.window_r = window[0];
    args.window_a = window[1];
    args.shift_r = shift[0];
    args.shift_a = shift[1];
    args.periodic_r = periodic[0];
    args.periodic_a = periodic[1];
    args.scale = static_cast<T>(scale);
    args.bias_stride = bias.size(0) == 1 ? 0 : table_size() * args.heads;
    windows = (args.rings / args.window_r) * (args.sectors / args.window_a);
  }

  int64_t table_size() const { return (2 * args.window_r - 1) * (2 * args.window_a - 1); }

  // Runs `kernel` over `items` work items, each thread with its own scratch.
  template <typename Kernel>
  void run(int64_t items, Kernel kernel) {
    const int64_t size = kernels().table<T>().window_attention_scratch(args);
    std::vector<double> scratch(size * num_threads(items));
    parallel_ranges(items, [&](int64_t begin, int64_t end, int64_t thread) {
      kernel(args, begin, end, scratch.data() + thread * size);
    });
  }
};

template <typename T>
std::tuple<Tensor, Tensor> forward(Call<T>&& call) {
  auto& args = call.args;
  const Tensor out = torch::stable::new_empty(
      call.qkv, Sizes{call.batch, args.rings, args.sectors, args.heads * args.head_dim});
  const Tensor lse = torch::stable::new_empty(
      call.qkv, Sizes{call.batch, args.rings, args.sectors, args.heads}, ScalarType::Double);
  if (lse.numel() == 0) return {out, lse};
  args.out = out.template mutable_data_ptr<T>();
  args.lse = lse.template mutable_data_ptr<double>();
  call.run(call.batch * call.windows * args.heads, kernels().table<T>().window_attention);
  return {out, lse};
}

template <typename T>
std::tuple<Tensor, Tensor> backward(Call<T>&& call, const Tensor& grad_out_, const Tensor& lse_) {
  // Gradients arrive expanded or strided: `.sum().backward()` gives stride 0.
  const Tensor grad_out = torch::stable::contiguous(grad_out_);
  const Tensor lse = torch::stable::contiguous(lse_);
  auto& args = call.args;
  STD_TORCH_CHECK(grad_out.numel() * 3 == call.qkv.numel() &&
                      lse.numel() * args.head_dim == grad_out.numel() &&
                      grad_out.scalar_type() == call.qkv.scalar_type() &&
                      lse.scalar_type() == ScalarType::Double,
                  "window_attention_backward: grad_out and lse must look like the outputs");
  const Tensor grad_qkv = torch::stable::new_empty(call.qkv, call.qkv.sizes());
  std::vector<double> bias_rows(call.batch * args.heads * call.table_size(), 0.0);
  args.grad_out = grad_out.template const_data_ptr<T>();
  args.lse = const_cast<double*>(lse.template const_data_ptr<double>());
  args.grad_qkv = grad_qkv.template mutable_data_ptr<T>();
  args.grad_bias = bias_rows.data();
  call.run(call.batch * args.heads, kernels().table<T>().window_attention_backward);
  return {grad_qkv, fold_rows<T>(call.bias, bias_rows)};
}

std::tuple<Tensor, Tensor> window_attention(const Tensor& qkv, const Tensor& bias, Sizes window,
                                            Sizes shift, std::vector<bool> periodic, double scale) {
  if (qkv.scalar_type() == ScalarType::Float) {
    return forward(Call<float>(qkv, bias, window, shift, periodic, scale));
  }
  STD_TORCH_CHECK(qkv.scalar_type() == ScalarType::Double, "window_attention: float32 or float64");
  return forward(Call<double>(qkv, bias, window, shift, periodic, scale));
}

std::tuple<Tensor, Tensor> window_attention_backward(const Tensor& grad_out, const Tensor& qkv,
                                                     const Tensor& bias, const Tensor& lse,
                                                     Sizes window, Sizes shift,
                                                     std::vector<bool> periodic, double scale) {
  if (qkv.scalar_type() == ScalarType::Float) {
    return backward(Call<float>(qkv, bias, window, shift, periodic, scale), grad_out, lse);
  }
  STD_TORCH_CHECK(qkv.scalar_type() == ScalarType::Double, "window_attention: float32 or float64");
  return backward(Call<double>(qkv, bias, window, shift, periodic, scale), grad_out, lse);
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("window_attention", TORCH_BOX(&darswin::window_attention));
  m.impl("window_attention_backward", TORCH_BOX(&darswin::window_attention_backward));
}
