// One call of windowed attention, as drivers prepare it.
#pragma once

#include "checks.h"
#include "core/attention.h"
#include "window_attention.h"

namespace darswin {

inline constexpr char kAttention[] = "window_attention";

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

  // As `run_attention`.
  template <typename Kernel>
  void run(int64_t items, int64_t steps, Kernel kernel) {
    run_attention(args, items, steps, kernel);
  }
};

}  // namespace darswin
