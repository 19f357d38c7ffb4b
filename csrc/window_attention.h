// The interface between the driver of window_attention and its kernels.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// Windows of a polar map. Token (r, a) of the rolled map is token (r + shift_r, a + shift_a) of the
// original map. Windows are counted over all images: window w lies in image w / (windows of an
// image).
template <typename T>
struct WindowAttentionArgs {
  using Real = Arithmetic<T>;

  const T* qkv;      // (B, R, A, 3, heads, d)
  const Real* bias;  // (B or 1, heads, 2 M_r - 1, 2 M_a - 1)
  int64_t bias_rows, windows;
  int64_t rings, sectors, heads, head_dim;
  int64_t window_r, window_a, shift_r, shift_a;
  bool periodic_r, periodic_a;
  Real scale;

  T* out;              // forward: (B, R, A, heads, d)
  uint8_t* quantized;  // the same as 8 bits, instead of `out`; only for float, else null
  Quantizer quantizer;

  const T* grad_out;  // backward
  T* grad_qkv;        // like qkv
  double* grad_bias;  // (chunks of a bias row, B or 1, heads, 2 M_r - 1, 2 M_a - 1), to be summed
                      // over the chunks; zero on entry
  int64_t chunk;      // windows that share one row of bias gradients
};

// Kernels process the items [begin, end) on one thread. The driver owns the threads.
template <typename T>
struct WindowAttentionKernels {
  // bytes of scratch for each thread that runs one of the two functions below
  int64_t (*scratch)(const WindowAttentionArgs<T>&);
  // item: (window, head)
  void (*forward)(const WindowAttentionArgs<T>&, int64_t begin, int64_t end, void* scratch);
  // item: (chunk of windows, head)
  void (*backward)(const WindowAttentionArgs<T>&, int64_t begin, int64_t end, void* scratch);
};

}  // namespace darswin
