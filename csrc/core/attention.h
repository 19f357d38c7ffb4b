// Runs a kernel of windowed attention on the threads that its work is worth.
#pragma once

#include "../window_attention.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {

// `steps` counts the products that the kernel computes for each pair, such as query times key.
template <typename T, typename Kernel>
void run_attention(const WindowAttentionArgs<T>& args, int64_t items, int64_t steps,
                   Kernel kernel) {
  constexpr double kPerMicrosecond = 2e4;  // multiply-adds, on a CPU with AVX2
  const int64_t tokens = args.window_r * args.window_a;
  const double work = static_cast<double>(args.windows) * args.heads * tokens * tokens;
  run_with_scratch(items, threads_for(work * args.head_dim * steps / kPerMicrosecond),
                   kernels<WindowAttentionKernels<T>>().scratch(args),
                   [&](auto... range) { kernel(args, range...); });
}

}  // namespace darswin
