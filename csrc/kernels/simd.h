// Vector code that is the same on every tier: written once for registers of kRegister bytes, it
// becomes SSE, AVX2 or AVX-512 code, whatever the tier's flags allow; a*b + c becomes one fused
// instruction where the tier has it.
#pragma once

#include <cstdint>

#include "../bfloat16.h"
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

// Copies short runs: whole registers, the last of them over the one before.
template <typename T>
inline void copy(const T* from, int64_t count, T* to) {
  constexpr int64_t lanes = kLanes<T>;
  using V = Vector<T, lanes>;
  int64_t e = 0;
  for (; e + lanes <= count; e += lanes) store(to + e, load<V>(from + e));
  if (e == count) return;
  if (count > lanes) {
    store(to + count - lanes, load<V>(from + count - lanes));
  } else if (lanes > 2 && count >= lanes / 2) {
    using Half = Vector<T, lanes / 2>;
    store(to, load<Half>(from));
    store(to + count - lanes / 2, load<Half>(from + count - lanes / 2));
  } else {
    for (; e < count; ++e) to[e] = from[e];
  }
}

// Brings what will be read into the second-level cache: in the first, rows of an image whose width
// is a power of two share few sets. The empty assembly makes it count as doing something; functions
// that only prefetch are else called never.
inline void fetch(const void* what) {
  __builtin_prefetch(what, 0, 2);
  asm volatile("");
}

template <typename A, typename B>
constexpr bool kSame = false;
template <typename A>
constexpr bool kSame<A, A> = true;

// (1 - t) * a + t * b, given both weights. Weights rather than a + t * (b - a), since the
// difference of huge values overflows, and infinity less anything but itself would become NaN later
// on. Which of the two products is fused into the sum is fixed, so that every copy of the code
// gives the same; for single values in a form that loops over them can be made vectors of.
template <typename V, typename Weight>
inline V between(V a, V b, Weight one_less_t, Weight t) {
  if constexpr (kFused && kSame<V, float>) {
    return __builtin_fmaf(t, b, one_less_t * a);
  } else if constexpr (kFused && kSame<V, double>) {
    return __builtin_fma(t, b, one_less_t * a);
  } else {
    return unfused(one_less_t * a) + t * b;
  }
}

inline Vector<float, 4> lower_half(Vector<float, 8> v) {
  return __builtin_shufflevector(v, v, 0, 1, 2, 3);
}

// bfloat16 is the upper half of a float32. Narrowing rounds to nearest, ties to even.
inline float widen(bfloat16 x) {
  const uint32_t bits = static_cast<uint32_t>(x.bits) << 16;
  float wide;
  __builtin_memcpy(&wide, &bits, sizeof(wide));
  return wide;
}
inline bfloat16 narrow(float x) {
  uint32_t bits;
  __builtin_memcpy(&bits, &x, sizeof(bits));
  // A NaN whose payload lies in the lower half must stay one.
  const uint32_t rounded = (bits + 0x7FFF + ((bits >> 16) & 1)) >> 16;
  return {static_cast<uint16_t>(x != x ? (bits >> 16) | 0x40 : rounded)};
}

// The bits of x rounded to those that bfloat16 has, which are the upper ones; NaN stays NaN.
inline Vector<uint32_t, kLanes<float>> rounded(Floats x) {
  using Bits = Vector<uint32_t, kLanes<float>>;
  const Bits bits = (Bits)x;
  return x == x ? bits + 0x7FFF + ((bits >> 16) & 1) : bits | 0x400000;
}
inline void narrow_lanes(bfloat16* to, Floats x) {
  store_bits(to, __builtin_convertvector(rounded(x) >> 16, Vector<uint16_t, kLanes<float>>));
}
inline void narrow_all(const float* from, int64_t count, bfloat16* to) {
  constexpr int lanes = kLanes<float>;
  int64_t e = 0;
  for (; e + lanes <= count; e += lanes) narrow_lanes(to + e, load<Floats>(from + e));
  for (; e < count; ++e) to[e] = narrow(from[e]);
}

}  // namespace
}  // namespace darswin
