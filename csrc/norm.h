// The interface between the drivers of norms and their kernels.
#pragma once

#include <cstdint>

#include "numbers.h"
#include "tier.h"

namespace darswin {

// x normalized over its last axis * weight + bias. Out is float or uint8_t.
template <typename Out>
struct NormArgs {
  const float* x = nullptr;                        // (rows, width)
  Out* out = nullptr;                              // like x
  const float *weight = nullptr, *bias = nullptr;  // (width,)
  float eps = 0;
  int64_t width = 0;
  Quantizer quantizer = {};  // for uint8_t
};

template <typename Out>
struct NormKernels {
  void (*rows)(const NormArgs<Out>&, int64_t begin, int64_t end);  // rows [begin, end)
};

}  // namespace darswin
