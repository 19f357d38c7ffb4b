// Mathematical functions for float and double. They use compiler built-ins instead of <cmath>,
// because an inline function of the standard library would be compiled in every tier (see tier.h).
#pragma once

#include "simd.h"

// Selects the old version of exp, which every glibc has. The version of glibc 2.29 computes the
// same and only reports errors differently, and manylinux_2_28 lacks it (see portable.cpp).
#if defined(__GLIBC__) && defined(__x86_64__)
__asm__(".symver exp, exp@GLIBC_2.2.5");
#elif defined(__GLIBC__) && defined(__aarch64__)
__asm__(".symver exp, exp@GLIBC_2.17");
#endif

namespace darswin {
namespace {

// Returns the larger value in each lane, or NaN if b is NaN.
template <typename V>
inline V larger(V a, V b) {
  return a > b ? a : b;
}

inline float root(float x) { return __builtin_sqrtf(x); }
inline double root(double x) { return __builtin_sqrt(x); }

// Returns e^x for x <= 0, within 1 unit in the last place. Results below 2^-126 become 0. NaN stays
// NaN.
inline Floats exponential_of_negative(Floats x) {
  using V = Floats;
  using Bits = Vector<uint32_t, kLanes<float>>;
  // x = n ln 2 + r. Adding 1.5 * 2^23 rounds to the nearest integer n and leaves n in the lower
  // bits. At the lowest x, n is -127, and the power of two computed below becomes zero.
  const float shift = 12582912.0f;
  const V bounded = larger(splat<V>(-88.02969f), x);
  const V shifted = bounded * 1.44269504f + shift;
  const V n = shifted - shift;
  const V r = (bounded - n * 0.693359375f) + n * 2.12194440e-4f;
  const V power = (V)(((Bits)shifted + 127) << 23);
  // e^r = 1 + r + r^2 q(r), where q is fitted for the least relative error. q is computed as a
  // tree: in a chain, each product would wait for the one before.
  const V r2 = r * r;
  const V tail = r2 * 1.3814536e-3f + (r * 8.368745e-3f + 4.1668393e-2f);
  const V q = r2 * tail + (r * 0.16666521f + 0.49999994f);
  return power + power * (r2 * q + r);
}
inline Doubles exponential_of_negative(Doubles x) {
  for (int i = 0; i < kDoubles; ++i) x[i] = __builtin_exp(x[i]);
  return x;
}

constexpr double kPi = 3.14159265358979323846;

// Computes both to one or two units in the last place, at any angle. NaN and infinity give NaN.
inline void sin_cos(Doubles angle, Doubles* sin, Doubles* cos) {
  // For larger angles, the three parts of pi/2 below are not accurate enough.
  constexpr double limit = 1e5;
  const auto beyond = (angle > limit) | (angle < -limit);
  int64_t large = 0;
  for (int lane = 0; lane < kDoubles; ++lane) large |= beyond[lane];
  if (large != 0) {
    for (int lane = 0; lane < kDoubles; ++lane) {
      (*sin)[lane] = __builtin_sin(angle[lane]);
      (*cos)[lane] = __builtin_cos(angle[lane]);
    }
    return;
  }
  // angle = quarter * pi/2 + t with |t| <= pi/4. The first two parts of pi/2 have 33 bits each, so
  // that their products with `quarter` are exact. Adding 1.5 * 2^52 rounds to an integer, which is
  // then in the lowest bits.
  const Doubles shifted = angle * (2 / kPi) + 0x1.8p52;
  const Words quarter = (Words)shifted;
  const Doubles n = shifted - 0x1.8p52;
  const Doubles t =
      ((angle - n * 0x1.921fb544p0) - n * 0x1.0b4611a6p-34) - n * 0x1.3198a2e037073p-69;
  const Doubles z = t * t;
  Doubles s = splat<Doubles>(1 / 355687428096000.0);  // Taylor: 1/17!, 1/16!, ...
  Doubles c = splat<Doubles>(1 / 20922789888000.0);
  constexpr double odd[] = {-1 / 1307674368000.0, 1 / 6227020800.0, -1 / 39916800.0, 1 / 362880.0,
                            -1 / 5040.0,          1 / 120.0,        -1 / 6.0};
  constexpr double even[] = {-1 / 87178291200.0, 1 / 479001600.0, -1 / 3628800.0, 1 / 40320.0,
                             -1 / 720.0,         1 / 24.0,        -1 / 2.0};
#pragma GCC unroll 7
  for (int k = 0; k < 7; ++k) {
    s = s * z + odd[k];
    c = c * z + even[k];
  }
  s = t + t * z * s;
  c = 1 + z * c;
  const auto swap = (quarter & 1) != 0;
  const Words minus_sin = (quarter & 2) << 62, minus_cos = ((quarter + 1) & 2) << 62;
  *sin = (Doubles)((Words)select(swap, c, s) ^ minus_sin);
  *cos = (Doubles)((Words)select(swap, s, c) ^ minus_cos);
}

// Computes both to 3e-11, for angles of at most kTiny.
constexpr double kTiny = 0.02;
inline void tiny_sin_cos(Doubles t, Doubles* sin, Doubles* cos) {
  const Doubles z = t * t;
  *sin = t + t * z * (-1 / 6.0);
  *cos = 1 + z * (-1 / 2.0 + z * (1 / 24.0));
}

// Returns the azimuth of (x, y), in [-pi, pi], to two units in the last place. At (0, 0) it is 0.
// In lanes that are not `known`, x and y may be anything, and the azimuth is an arbitrary number.
template <typename Mask>
inline Floats arc_tangent(Floats y, Floats x, Mask known) {
  const Floats across = x < 0 ? -x : x, down = y < 0 ? -y : y;
  const auto steep = down > across;
  const Floats most = steep ? down : across, least = steep ? across : down;
  const Floats ratio = select(known & (most > 0), least / most, Floats{});
  // atan(q) / q as a polynomial of q^2, which interpolates at the Chebyshev nodes on [0, 1].
  constexpr float terms[] = {1.0487650e-2f, -3.0351866e-2f, 5.7089556e-2f, -8.3497249e-2f,
                             1.0932341e-1f, -1.4260016e-1f, 1.9998075e-1f, -3.3333278e-1f};
  const Floats z = ratio * ratio;
  Floats sum = splat<Floats>(-1.7011702e-3f);
#pragma GCC unroll 8
  for (int k = 0; k < 8; ++k) sum = sum * z + terms[k];
  Floats angle = ratio + ratio * z * sum;
  angle = steep ? static_cast<float>(kPi / 2) - angle : angle;
  angle = x < 0 ? static_cast<float>(kPi) - angle : angle;
  return y < 0 ? -angle : angle;
}
template <typename Mask>
inline Doubles arc_tangent(Doubles y, Doubles x, Mask known) {
  for (int lane = 0; lane < kDoubles; ++lane) y[lane] = __builtin_atan2(y[lane], x[lane]);
  return select(known, y, Doubles{});
}

}  // namespace
}  // namespace darswin
