// Vector code that is the same on every tier: written once for registers of kRegister bytes, it
// becomes SSE, AVX2 or AVX-512 code, whatever the tier's flags allow; a*b + c becomes one fused
// instruction where the tier has it.
#pragma once

#include <cstdint>

#include "../numbers.h"
#include "vector.h"
#include TIER_HEADER  // tiers/*.h, as CMakeLists.txt says

namespace darswin {
namespace {

// Lanes of T in one register.
template <typename T>
constexpr int kLanes = kRegister / static_cast<int>(sizeof(T));
constexpr int kDoubles = kLanes<double>;

// n, or the next multiple of `unit`.
constexpr int64_t round_up(int64_t n, int64_t unit) { return (n + unit - 1) / unit * unit; }

inline int64_t smaller(int64_t x, int64_t y) { return x < y ? x : y; }

// Brings what will be read into the second-level cache: in the first, rows of an image whose width
// is a power of two share few sets. The empty assembly makes it count as doing something; functions
// that only prefetch are else called never.
inline void fetch(const void* what) {
  __builtin_prefetch(what, 0, 2);
  asm volatile("");
}

// (1 - t) * a + t * b, given both weights. Weights rather than a + t * (b - a), since the
// difference of huge values overflows, and infinity less anything but itself would become NaN later
// on. Which of the two products is fused into the sum is fixed, so that every copy of the code
// gives the same; for single values in a form that loops over them can be made vectors of.
template <typename V, typename Weight>
inline V between(V a, V b, Weight one_less_t, Weight t) {
  if constexpr (kFused && is_same_v<V, float>) {
    return __builtin_fmaf(t, b, one_less_t * a);
  } else if constexpr (kFused && is_same_v<V, double>) {
    return __builtin_fma(t, b, one_less_t * a);
  } else {
    return unfused(one_less_t * a) + t * b;
  }
}

inline Vector<float, 4> lower_half(Vector<float, 8> v) {
  return __builtin_shufflevector(v, v, 0, 1, 2, 3);
}
inline Vector<float, 4> upper_half(Vector<float, 8> v) {
#if defined(__AVX__)  // the compiler's own shuffle is a slow one
  return (Vector<float, 4>)_mm256_extractf128_ps((__m256)v, 1);
#else
  return __builtin_shufflevector(v, v, 4, 5, 6, 7);
#endif
}

}  // namespace
}  // namespace darswin
