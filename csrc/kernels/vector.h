// Short vectors of any length by the compiler's vector extension. An operation works on every lane;
// a vector wider than the registers is split by the compiler.
#pragma once

#include <cstdint>
#include <type_traits>
#include <utility>

namespace darswin {
namespace {

using std::is_same_v;

template <typename T, int N>
struct VectorOf {
  typedef T type __attribute__((vector_size(N * sizeof(T))));
};
template <typename T, int N>
using Vector = typename VectorOf<T, N>::type;

// Unaligned load and store of lanes, or of one value, that have the type of what is pointed to, so
// that the compiler may assume that nothing else is touched.
template <typename V>
struct UnalignedOf {
  typedef V type __attribute__((aligned(1)));
};
template <typename V>
constexpr int64_t kLaneBytes = sizeof(V{}[0]);
template <>
constexpr int64_t kLaneBytes<float> = sizeof(float);
template <>
constexpr int64_t kLaneBytes<double> = sizeof(double);
template <typename V, typename T>
inline V load(const T* from) {
  static_assert(kLaneBytes<V> == sizeof(T));
  return *reinterpret_cast<const typename UnalignedOf<V>::type*>(from);
}
template <typename V, typename T>
inline void store(T* to, const V& v) {
  static_assert(kLaneBytes<V> == sizeof(T));
  *reinterpret_cast<typename UnalignedOf<V>::type*>(to) = v;
}

// The same for lanes of another type than what is pointed to.
template <typename V, typename T>
inline V load_bits(const T* from) {
  V v;
  __builtin_memcpy(&v, from, sizeof(V));
  return v;
}
template <typename V, typename T>
inline void store_bits(T* to, const V& v) {
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

// A value that is rounded as it stands. The compiler may else fuse the product in it into a sum in
// one copy of the code and not in another, and results would depend on which copy runs.
template <typename V>
inline V unfused(V value) {
#if defined(__AVX__)
  asm("" : "+x"(value));
#elif !defined(__SSE2__)
  asm("" : "+m"(value));
#endif
  return value;
}

// Lanes index(0), index(1), ... of a and, behind them, b.
template <auto index, typename V, int... lane>
inline V shuffle(V a, V b, std::integer_sequence<int, lane...>) {
  return __builtin_shufflevector(a, b, index(lane)...);
}
template <auto index, typename V>
inline V shuffle(V a, V b) {
  return shuffle<index>(a, b, std::make_integer_sequence<int, sizeof(V) / kLaneBytes<V>>());
}

// a0 a2 ... b0 b2 ... and a1 a3 ... b1 b3 ..., of lanes and of fours of lanes.
template <typename V>
inline V evens(V a, V b) {
  return shuffle<[](int i) { return 2 * i; }>(a, b);
}
template <typename V>
inline V odds(V a, V b) {
  return shuffle<[](int i) { return 2 * i + 1; }>(a, b);
}
template <typename V>
inline V even_quads(V a, V b) {
  return shuffle<[](int i) { return i / 4 * 8 + i % 4; }>(a, b);
}
template <typename V>
inline V odd_quads(V a, V b) {
  return shuffle<[](int i) { return i / 4 * 8 + 4 + i % 4; }>(a, b);
}

// One step of the square transpose of N vectors: pairs are split into their even and odd parts,
// these go to the lower and the upper half. After log2(N) steps row i of lane j is row j of lane i.
template <int N, typename V, typename Even, typename Odd>
inline void split_pairs(V* rows, int stride, Even even, Odd odd) {
  V next[N];
#pragma GCC unroll 8
  for (int i = 0; i < N / 2; ++i) {
    next[i] = even(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
    next[i + N / 2] = odd(rows[2 * i * stride], rows[(2 * i + 1) * stride]);
  }
#pragma GCC unroll 16
  for (int i = 0; i < N; ++i) rows[i * stride] = next[i];
}

}  // namespace
}  // namespace darswin
