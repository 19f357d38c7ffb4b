// The interface between the network and its kernels for plain numbers.
#pragma once

#include <cstdint>

#include "tier.h"

namespace darswin {

// Each function works on one thread.
struct ElementKernels {
  // Adds x to `to`, n numbers each.
  void (*add)(const float* x, float* to, int64_t n);
  // Adds the sums of the columns of x (rows, n) to `to`.
  void (*add_rows)(const float* x, int64_t rows, int64_t n, float* to);
  // Replaces n numbers by their GELU, or their ReLU.
  void (*gelu)(float* x, int64_t n);
  void (*relu)(float* x, int64_t n);
  // Replaces n numbers x by their GELU, and multiplies the gradients of these by its derivative.
  void (*derive_gelu)(float* x, float* grad, int64_t n);
  // Replaces n numbers by the larger ones of x; NaN is the largest.
  void (*largest)(const float* x, float* to, int64_t n);
  // Replaces n numbers x by the distances typical * e^(8 tanh(x / 8)).
  void (*distance)(float* x, int64_t n, float typical);
  // Writes the weighted sum of four rows of n numbers.
  void (*mix)(const float* const from[4], const float weights[4], float* to, int64_t n);
};

}  // namespace darswin
