// Maths for both types. Built-ins rather than <cmath>: an inline function of the standard library
// would come out of every tier (see tier.h).
#pragma once

#include "simd.h"

// The exp that glibc has had from the start: the one of 2.29 computes the same and reports errors
// in another way, and manylinux_2_28 lacks it (see portable.cpp).
#if defined(__GLIBC__) && defined(__x86_64__)
__asm__(".symver exp, exp@GLIBC_2.2.5");
#elif defined(__GLIBC__) && defined(__aarch64__)
__asm__(".symver exp, exp@GLIBC_2.17");
#endif

namespace darswin {
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
  const V power = (V)(((Bits)shifted + 127) << 23);
  // e^r = 1 + r + r^2 q(r), with q fitted for the least relative error; a tree, since a chain of
  // products would keep the next ones waiting.
  const V r2 = r * r;
  const V tail = r2 * 1.3814536e-3f + (r * 8.368745e-3f + 4.1668393e-2f);
  const V q = r2 * tail + (r * 0.16666521f + 0.49999994f);
  return power + power * (r2 * q + r);
}
inline Vector<double, kLanes<double>> exponential_of_negative(Vector<double, kLanes<double>> x) {
  for (int i = 0; i < kLanes<double>; ++i) x[i] = __builtin_exp(x[i]);
  return x;
}

}  // namespace
}  // namespace darswin
