// What the driver of _add_norm_ and its kernels agree on.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

// x += y, then y = x normalized over its last axis * weight + bias. S is float or bfloat16.
template <typename S>
struct AddNormArgs {
  S *x, *y;                    // (rows, width)
  const float *weight, *bias;  // (width,)
  float eps;
  int64_t width;
};

template <typename S>
struct AddNormKernels {
  void (*rows)(const AddNormArgs<S>&, int64_t begin, int64_t end);  // rows [begin, end)
};

}  // namespace darswin
