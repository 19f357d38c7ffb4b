// window_attention and its backward on CPU: check, allocate, thread, call the kernel.
#include "window_attention.h"

#include <tuple>
#include <vector>

#include "checks.h"
#include "core/attention.h"

namespace darswin {
namespace {

constexpr char kAttention[] = "window_attention";

// The arguments of one call, contiguous for the kernels. This object owns the memory that `args`
// points into.
template <typename T>
struct AttentionCall {
  Tensor qkv, bias;
  WindowAttentionArgs<T> args{};

  AttentionCall(const Tensor& qkv_, const Tensor& bias_, const Sizes& window, const Sizes& shift,
                const Sizes& periodic, double scale)
      : qkv(as_contiguous(qkv_)), bias(as_contiguous(bias_)) {
    STD_TORCH_CHECK(qkv.dim() == 6 && qkv.size(3) == 3 && bias.dim() == 4 && window.size() == 2 &&
                        shift.size() == 2 && periodic.size() == 2,
                    kAttention, ": wrong number of dimensions");
    STD_TORCH_CHECK(bias.scalar_type() == type_of<Arithmetic<T>>() && bias.is_cpu(), kAttention,
                    ": bias must be on the CPU and have the type of qkv, float32 where that "
                    "is bfloat16");
    for (int axis = 0; axis < 2; ++axis) {
      const int64_t size = qkv.size(1 + axis);
      STD_TORCH_CHECK(window[axis] > 0 && size > 0 && size % window[axis] == 0 &&
                          shift[axis] >= 0 && shift[axis] < size,
                      kAttention, ": window must divide the map, shift must lie inside it");
      const int64_t entries = bias.size(2 + axis);  // twice the window, minus one
      STD_TORCH_CHECK(entries % 2 == 1 && entries / 2 + 1 == window[axis], kAttention,
                      ": bias does not fit the window");
    }
    const int64_t batch = qkv.size(0);
    STD_TORCH_CHECK((bias.size(0) == 1 || bias.size(0) == batch) && bias.size(1) == qkv.size(4),
                    kAttention, ": bias does not fit the batch or the heads");

    args.qkv = pointer<T>(qkv);
    args.bias = pointer<Arithmetic<T>>(bias);
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

  Sizes output_sizes() const {
    return {qkv.size(0), args.rings, args.sectors, args.heads * args.head_dim};
  }
};

template <typename T>
Tensor forward(AttentionCall<T>&& call) {
  auto& args = call.args;
  const Tensor out = new_tensor(call.output_sizes(), call.qkv.scalar_type());
  if (out.numel() == 0) return out;
  args.out = mutable_pointer<T>(out);
  run_attention(args, args.windows * args.heads, 2, kernels<WindowAttentionKernels<T>>().forward);
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
  run_attention(args, chunks * args.bias_rows * args.heads, 5,
                kernels<WindowAttentionKernels<T>>().backward);
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
