// window_attention and its backward on CPU: check, allocate, thread, call the kernel.
// The checks here only keep memory safe; darswin/ops/window_attention.py explains wrong arguments.
#include "window_attention.h"

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <tuple>
#include <utility>
#include <vector>

#include "dispatch.h"
#include "parallel.h"
#include "quantizer.h"

namespace darswin {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using Sizes = std::vector<int64_t>;

template <typename T>
constexpr ScalarType type_of() {
  return sizeof(T) == sizeof(float) ? ScalarType::Float : ScalarType::Double;
}

// The arguments of one call, contiguous as the kernels want them. Owns what `args` points into.
template <typename T>
struct Call {
  Tensor qkv, bias;
  WindowAttentionArgs<T> args{};

  Call(const Tensor& qkv_, const Tensor& bias_, const Sizes& window, const Sizes& shift,
       const Sizes& periodic, double scale)
      : qkv(torch::stable::contiguous(qkv_)), bias(torch::stable::contiguous(bias_)) {
    STD_TORCH_CHECK(qkv.dim() == 6 && qkv.size(3) == 3 && bias.dim() == 4 && window.size() == 2 &&
                        shift.size() == 2 && periodic.size() == 2,
                    "window_attention: wrong number of dimensions");
    STD_TORCH_CHECK(bias.scalar_type() == type_of<Arithmetic<T>>() && bias.is_cpu(),
                    "window_attention: bias must be on the CPU and have the type of qkv, float32 "
                    "where that is bfloat16");
    for (int axis = 0; axis < 2; ++axis) {
      const int64_t size = qkv.size(1 + axis);
      STD_TORCH_CHECK(window[axis] > 0 && size > 0 && size % window[axis] == 0 &&
                          shift[axis] >= 0 && shift[axis] < size,
                      "window_attention: window must divide the map, shift must lie inside it");
      const int64_t entries = bias.size(2 + axis);  // twice the window, less one
      STD_TORCH_CHECK(entries % 2 == 1 && entries / 2 + 1 == window[axis],
                      "window_attention: bias does not fit the window");
    }
    const int64_t batch = qkv.size(0);
    STD_TORCH_CHECK((bias.size(0) == 1 || bias.size(0) == batch) && bias.size(1) == qkv.size(4),
                    "window_attention: bias does not fit the batch or the heads");

    args.qkv = static_cast<const T*>(qkv.const_data_ptr());
    args.bias = static_cast<const Arithmetic<T>*>(bias.const_data_ptr());
    args.bias_rows = bias.size(0);
    args.rings = qkv.size(1);
    args.sectors = qkv.size(2);
    args.heads = qkv.size(4);
    args.head_dim = qkv.size(5);
    args.window_r = window[0];
    args.window_a = window[1];
    args.windows = batch * (args.rings / args.window_r) * (args.sectors / args.window_a);
    args.shift_r = shift[0];
    args.shift_a = shift[1];
    args.periodic_r = periodic[0] != 0;
    args.periodic_a = periodic[1] != 0;
    args.scale = static_cast<Arithmetic<T>>(scale);
  }

  // Runs `kernel` over `items` work items, each thread with its own scratch.
  template <typename Kernel>
  void run(int64_t items, Kernel kernel) {
    const int64_t bytes = kernels<WindowAttentionKernels<T>>().scratch(args);
    parallel_ranges(
        items, [&](int64_t begin, int64_t end) { kernel(args, begin, end, Scratch(bytes).get()); });
  }
};

template <typename T>
Tensor forward(Call<T>&& call) {
  auto& args = call.args;
  const Tensor out = torch::stable::new_empty(
      call.qkv, Sizes{call.qkv.size(0), args.rings, args.sectors, args.heads * args.head_dim});
  if (out.numel() == 0) return out;
  ask_for_large_pages(out);
  args.out = static_cast<T*>(out.mutable_data_ptr());
  call.run(args.windows * args.heads, kernels<WindowAttentionKernels<T>>().forward);
  return out;
}

Tensor forward_quantized(Call<float>&& call, Quantizer quantizer) {
  auto& args = call.args;
  const Sizes size{call.qkv.size(0), args.rings, args.sectors, args.heads * args.head_dim};
  const Tensor out = torch::stable::new_empty(call.qkv, size, ScalarType::Byte);
  if (out.numel() == 0) return out;
  args.quantized = static_cast<uint8_t*>(out.mutable_data_ptr());
  args.quantizer = quantizer;
  call.run(args.windows * args.heads, kernels<WindowAttentionKernels<float>>().forward);
  return out;
}

// How many windows share one row of bias gradients: many, so that few rows are left to add up, but
// not so many that threads get unequal work. It must not depend on the number of threads, or the
// sums would.
template <typename T>
int64_t chunk_size(const WindowAttentionArgs<T>& args) {
  const int64_t most = std::clamp<int64_t>(args.windows * args.heads / 32, 1, 16);
  const int64_t windows = args.windows / args.bias_rows, chunks = (windows + most - 1) / most;
  return (windows + chunks - 1) / chunks;
}

template <typename T>
std::tuple<Tensor, Tensor> backward(Call<T>&& call, const Tensor& grad_out_) {
  // Gradients arrive expanded or strided: `.sum().backward()` gives stride 0.
  const Tensor grad_out = torch::stable::contiguous(grad_out_);
  auto& args = call.args;
  STD_TORCH_CHECK(grad_out.numel() * 3 == call.qkv.numel() &&
                      grad_out.scalar_type() == call.qkv.scalar_type() && grad_out.is_cpu(),
                  "window_attention_backward: grad_out must look like the output");
  const Tensor grad_qkv = torch::stable::new_empty(call.qkv, call.qkv.sizes());
  const Tensor grad_bias = torch::stable::new_zeros(call.bias, call.bias.sizes());
  const int64_t row = grad_bias.numel();
  if (grad_qkv.numel() == 0) return {grad_qkv, grad_bias};
  ask_for_large_pages(grad_qkv);
  args.chunk = chunk_size(args);
  const int64_t chunks = (args.windows / args.bias_rows + args.chunk - 1) / args.chunk;
  std::vector<double> rows(chunks * row, 0.0);
  args.grad_out = static_cast<const T*>(grad_out.const_data_ptr());
  args.grad_qkv = static_cast<T*>(grad_qkv.mutable_data_ptr());
  args.grad_bias = rows.data();
  call.run(chunks * args.bias_rows * args.heads, kernels<WindowAttentionKernels<T>>().backward);

  auto* sums = static_cast<Arithmetic<T>*>(grad_bias.mutable_data_ptr());
  for (int64_t chunk = 1; chunk < chunks; ++chunk) {
    for (int64_t k = 0; k < row; ++k) rows[k] += rows[chunk * row + k];
  }
  for (int64_t k = 0; k < row; ++k) sums[k] = static_cast<Arithmetic<T>>(rows[k]);
  return {grad_qkv, grad_bias};
}

// use(Call<T>) for the T of qkv.
template <typename Use>
auto with_call(Use use, const Tensor& qkv, const Tensor& bias, const Sizes& window,
               const Sizes& shift, const Sizes& periodic, double scale) {
  switch (qkv.scalar_type()) {
    case ScalarType::Float:
      return use(Call<float>(qkv, bias, window, shift, periodic, scale));
    case ScalarType::Double:
      return use(Call<double>(qkv, bias, window, shift, periodic, scale));
    default:
      STD_TORCH_CHECK(qkv.scalar_type() == ScalarType::BFloat16,
                      "window_attention: qkv must be float32, float64 or bfloat16");
      return use(Call<bfloat16>(qkv, bias, window, shift, periodic, scale));
  }
}

Tensor window_attention(const Tensor& qkv, const Tensor& bias, Sizes window, Sizes shift,
                        Sizes periodic, double scale) {
  return with_call([](auto&& call) { return forward(std::move(call)); }, qkv, bias, window, shift,
                   periodic, scale);
}

Tensor window_attention_quantized(const Tensor& qkv, const Tensor& bias, Sizes window, Sizes shift,
                                  Sizes periodic, double scale, double out_scale,
                                  int64_t zero_point) {
  STD_TORCH_CHECK(qkv.scalar_type() == ScalarType::Float,
                  "window_attention_quantized: qkv must be float32");
  return forward_quantized(Call<float>(qkv, bias, window, shift, periodic, scale),
                           quantizer(out_scale, zero_point));
}

std::tuple<Tensor, Tensor> window_attention_backward(const Tensor& qkv, const Tensor& bias,
                                                     Sizes window, Sizes shift, Sizes periodic,
                                                     double scale, const Tensor& grad_out) {
  return with_call([&](auto&& call) { return backward(std::move(call), grad_out); }, qkv, bias,
                   window, shift, periodic, scale);
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("window_attention", TORCH_BOX(&darswin::window_attention));
  m.impl("_window_attention_quantized", TORCH_BOX(&darswin::window_attention_quantized));
  m.impl("window_attention_backward", TORCH_BOX(&darswin::window_attention_backward));
}
