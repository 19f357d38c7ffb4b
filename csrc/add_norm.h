// What the drivers of _add_norm_ and _add_norm_quantized_ and their kernels agree on.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// x += y, then out = x normalized over its last axis * weight + bias. S is float or bfloat16, the
// Out of `out` S, which may be y, or uint8_t.
template <typename S, typename Out>
struct AddNormArgs {
  S* x = nullptr;                                  // (rows, width)
  const S* y = nullptr;                            // like x; null adds nothing
  Out* out = nullptr;                              // like x
  const float *weight = nullptr, *bias = nullptr;  // (width,)
  float eps = 0;
  int64_t width = 0;
  Quantizer quantizer = {};  // of uint8_t
};

template <typename S, typename Out>
struct AddNormKernels {
  void (*rows)(const AddNormArgs<S, Out>&, int64_t begin, int64_t end);  // rows [begin, end)
};

}  // namespace darswin
