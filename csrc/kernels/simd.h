// Short vectors by the compiler's vector extension: the same source becomes SSE, AVX2 or AVX-512
// code, whatever the tier's flags allow. An operation works on every lane; a*b + c becomes one
// fused instruction where the tier has it. A vector wider than the registers is split by the
// compiler.
#pragma once

#include <cstdint>

#include "../dispatch.h"

namespace {

using darswin::bfloat16;

template <typename T, int N>
struct VectorOf {
  typedef T type __attribute__((vector_size(N * sizeof(T))));
};
template <typename T, int N>
using Vector = typename VectorOf<T, N>::type;

// Bytes of the tier's registers.
#if defined(__AVX512F__)
constexpr int kRegister = 64;
#elif defined(__AVX2__)
constexpr int kRegister = 32;
#else
constexpr int kRegister = 16;
#endif

// Lanes of T in one register.
template <typename T>
constexpr int kLanes = kRegister / static_cast<int>(sizeof(T));

// Unaligned load and store. A store may be of another alignment than the vector's, never of
// another type.
template <typename V, typename T>
inline V load(const T* from) {
  V v;
  __builtin_memcpy(&v, from, sizeof(V));
  return v;
}
template <typename V, typename T>
inline void store(T* to, const V& v) {
  __builtin_memcpy(to, &v, sizeof(V));
}

template <typename V, typename T>
inline V splat(T value) {
  return value - V{};  // x - 0 is x for every x, -0 included
}

// a where the mask's lane is all ones, else b.
template <typename M, typename V>
inline V select(M mask, V a, V b) {
  return mask ? a : b;
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

}  // namespace
