// The interface between the drivers of norms and their kernels.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// x += y, then out = x normalized over its last axis * weight + bias. S, the type of x and y, is
// float or bfloat16. Out, the type of `out`, is S or uint8_t. If it is S, `out` may be y.
template <typename S, typename Out>
struct AddNormArgs {
  S* x = nullptr;                                  // (rows, width)
  const S* y = nullptr;                            // like x; null adds nothing
  Out* out = nullptr;                              // like x
  const float *weight = nullptr, *bias = nullptr;  // (width,)
  float eps = 0;
  int64_t width = 0;
  Quantizer quantizer = {};  // for uint8_t
};

template <typename S, typename Out>
struct AddNormKernels {
  void (*rows)(const AddNormArgs<S, Out>&, int64_t begin, int64_t end);  // rows [begin, end)
};

}  // namespace darswin
