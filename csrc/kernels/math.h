// Scalar maths for both types. Built-ins rather than <cmath>: an inline function of the standard
// library, emitted here with AVX, could be the copy that the linker keeps for the whole program.
#pragma once

#include "simd.h"

namespace {

// The larger one in each lane; NaN where b is NaN.
template <typename V>
inline V larger(V a, V b) {
  return a > b ? a : b;
}

// e^x for x <= 0, within 1 unit in the last place; below 2^-126 it becomes 0. NaN stays NaN.
inline Vector<float, kLanes<float>> exponential_of_negative(Vector<float, kLanes<float>> x) {
  using V = Vector<float, kLanes<float>>;
  using Bits = Vector<uint32_t, kLanes<float>>;
  // x = n ln 2 + r. Adding 1.5 * 2^23 rounds to the nearest integer n and leaves it in the lower
  // bits; at the lowest x it is -127, which makes the power of two below a zero.
  const float shift = 12582912.0f;
  const V bounded = larger(splat<V>(-88.02969f), x);
  const V shifted = bounded * 1.44269504f + shift;
  const V n = shifted - shift;
  const V r = (bounded - n * 0.693359375f) + n * 2.12194440e-4f;
  V p = r * 1.9875691500e-4f + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * (r * r) + r + 1.0f;
  return p * (V)(((Bits)shifted + 127) << 23);
}
inline Vector<double, kLanes<double>> exponential_of_negative(Vector<double, kLanes<double>> x) {
  for (int i = 0; i < kLanes<double>; ++i) x[i] = __builtin_exp(x[i]);
  return x;
}

}  // namespace
