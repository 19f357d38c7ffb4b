// window_attention and its backward on CPU: check, allocate, thread, call the kernel.
#include <tuple>
#include <vector>

#include "window_attention_call.h"

namespace darswin {
namespace {

template <typename T>
Tensor forward(AttentionCall<T>&& call) {
  auto& args = call.args;
  const Tensor out = new_tensor(call.output_sizes(), call.qkv.scalar_type());
  if (out.numel() == 0) return out;
  args.out = mutable_pointer<T>(out);
  call.run(args.windows * args.heads, 2, kernels<WindowAttentionKernels<T>>().forward);
  return out;
}

// Returns how many windows share one row of bias gradients. Many windows leave few rows to add up,
// but too many would give threads unequal work. The number must not depend on the threads, because
// the sums would then depend on them.
template <typename T>
int64_t chunk_size(const WindowAttentionArgs<T>& args) {
  const int64_t most = std::clamp<int64_t>(args.windows * args.heads / 32, 1, 16);
  const int64_t windows = args.windows / args.bias_rows, chunks = units(windows, most);
  return units(windows, chunks);
}

template <typename T>
std::tuple<Tensor, Tensor> backward(AttentionCall<T>&& call, Tensor grad_out) {
  const TorchThreads in_training;
  auto& args = call.args;
  grad_out = checked_gradient(grad_out, call.output_sizes(), call.qkv.scalar_type(), kAttention);
  const Tensor grad_qkv = new_tensor(call.qkv.sizes(), call.qkv.scalar_type());
  if (grad_qkv.numel() == 0) return {grad_qkv, new_zeros(call.bias, call.bias.sizes())};
  args.chunk = chunk_size(args);
  const int64_t chunks = units(args.windows / args.bias_rows, args.chunk);
  const int64_t row = call.bias.numel();
  std::vector<double> rows(chunks * row);
  args.grad_out = pointer<T>(grad_out);
  args.grad_qkv = mutable_pointer<T>(grad_qkv);
  args.grad_bias = rows.data();
  call.run(chunks * args.bias_rows * args.heads, 5, kernels<WindowAttentionKernels<T>>().backward);
  for (int64_t chunk = 1; chunk < chunks; ++chunk) {
    for (int64_t k = 0; k < row; ++k) rows[k] += rows[chunk * row + k];
  }
  rows.resize(row);
  return {grad_qkv, rounded_like<Arithmetic<T>>(call.bias, rows)};
}

Tensor window_attention(Tensor qkv, Tensor bias, Sizes window, Sizes shift, Sizes periodic,
                        double scale) {
  return with_real_type(qkv, kAttention, [&]<typename T>() {
    return forward(AttentionCall<T>(qkv, bias, window, shift, periodic, scale));
  });
}

auto window_attention_backward(Tensor qkv, Tensor bias, Sizes window, Sizes shift, Sizes periodic,
                               double scale, Tensor grad_out) {
  return with_real_type(qkv, kAttention, [&]<typename T>() {
    return backward(AttentionCall<T>(qkv, bias, window, shift, periodic, scale), grad_out);
  });
}

}  // namespace
}  // namespace darswin

STABLE_TORCH_LIBRARY_IMPL(darswin, CPU, m) {
  m.impl("window_attention", TORCH_BOX(&darswin::window_attention));
  m.impl("window_attention_backward", TORCH_BOX(&darswin::window_attention_backward));
}
