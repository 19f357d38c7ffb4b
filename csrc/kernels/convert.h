// Loads that widen numbers and stores that round them. A kernel computes in float or double,
// whatever the storage type is. bfloat16 is the upper half of a float32. In this file, V is a float
// or a vector of floats.
#pragma once

#include "simd.h"

namespace darswin {
namespace {

template <typename V>
inline V load(const bfloat16* from) {
  if constexpr (is_same_v<V, float>) {
    return __builtin_bit_cast(float, static_cast<uint32_t>(from->bits) << 16);
  } else if constexpr (is_same_v<V, Floats>) {
    return widen_lanes(from);
  } else {
    const auto bits = load_bits<Vector<uint16_t, kCount<V>>>(from);
    return (V)(__builtin_convertvector(bits, Vector<uint32_t, kCount<V>>) << 16);
  }
}
// Four bytes are widened with zeros. The compiler's own conversion takes one byte at a time.
template <typename V>
inline V load(const uint8_t* from) {
  if constexpr (is_same_v<V, float>) {
    return *from;
  } else {
    static_assert(kCount<V> == 4);
    const auto bytes = (Vector<uint8_t, 16>)Vector<uint32_t, 4>{load_bits<uint32_t>(from)};
    const auto halves = (Vector<uint16_t, 8>)zipped(bytes, Vector<uint8_t, 16>{});
    return __builtin_convertvector((Vector<int32_t, 4>)zipped(halves, Vector<uint16_t, 8>{}), V);
  }
}

template <typename V>
struct BitsOfFloats {
  using type = Vector<uint32_t, kCount<V>>;
};
template <>
struct BitsOfFloats<float> {
  using type = uint32_t;
};
template <typename V>
using BitsOf = typename BitsOfFloats<V>::type;

// Returns bits whose upper half is the float, or each float of a vector, as a bfloat16. It rounds
// to nearest, ties to even. NaN stays NaN, even if its payload is only in the lower half.
template <typename V>
inline BitsOf<V> rounded(V x) {
  const auto bits = __builtin_bit_cast(BitsOf<V>, x);
  return x == x ? bits + 0x7FFF + ((bits >> 16) & 1) : bits | 0x400000;
}

inline void store(bfloat16* to, float x) { to->bits = static_cast<uint16_t>(rounded(x) >> 16); }
template <typename V>
inline void store(bfloat16* to, V x) {
  store_bits(to, __builtin_convertvector(rounded(x) >> 16, Vector<uint16_t, kCount<V>>));
}

// Copies short runs in whole registers. The last register overlaps the one before.
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
template <typename From, typename To>  // one of them is bfloat16, the other is float
inline void copy(const From* from, int64_t count, To* to) {
  constexpr int64_t lanes = kLanes<float>;
  int64_t e = 0;
  for (; e + lanes <= count; e += lanes) store(to + e, load<Floats>(from + e));
  for (; e < count; ++e) store(to + e, load<float>(from + e));
}

}  // namespace
}  // namespace darswin
