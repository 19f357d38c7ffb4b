// Short vectors of any length, made with the compiler's vector extension. An operation works on
// every lane. The compiler splits a vector that is wider than the registers.
#pragma once

#include <cstddef>
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

// Unaligned load and store of lanes, or of one value. The lanes have the same type as the memory,
// so the compiler may assume that nothing else is touched.
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
template <typename V>
constexpr int kCount = sizeof(V) / kLaneBytes<V>;
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

// The same for lanes of another type than the memory.
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
  return value - V{};  // x - 0 is x for every x, also for -0
}

// Returns a where the mask's lane is all ones, else b.
template <typename M, typename V>
inline V select(M mask, V a, V b) {
  return mask ? a : b;
}

// Returns the value unchanged, and stops the compiler from fusing the product in it into a sum. The
// compiler may otherwise fuse in one copy of the code and not in another, and the results would
// depend on which copy runs.
template <typename V>
inline V unfused(V value) {
#if defined(__AVX__)
  asm("" : "+x"(value));
#elif defined(__aarch64__)
  asm("" : "+w"(value));
#elif !defined(__SSE2__)
  asm("" : "+m"(value));
#endif
  return value;
}

// Returns lanes index(0), index(1), ... of the lanes of a followed by those of b.
template <auto index, typename V, int... lane>
inline V shuffle(V a, V b, std::integer_sequence<int, lane...>) {
  return __builtin_shufflevector(a, b, index(lane)...);
}
template <auto index, typename V>
inline V shuffle(V a, V b) {
  return shuffle<index>(a, b, std::make_integer_sequence<int, kCount<V>>());
}

// Return a0 a2 ... b0 b2 ... and a1 a3 ... b1 b3 ..., for single lanes and for groups of four
// lanes.
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

// Returns a0 b0 a1 b1 ..., from the first half of each vector.
template <typename V>
inline V zipped(V a, V b) {
  return shuffle<[](int i) { return i / 2 + i % 2 * kCount<V>; }>(a, b);
}

// Writes the transpose of four rows of four. The rows of `to` are `stride` apart.
template <typename V, typename T>
inline void transpose4(V a, V b, V c, V d, T* to, int64_t stride) {
  const V ab = __builtin_shufflevector(a, b, 0, 4, 1, 5);
  const V cd = __builtin_shufflevector(c, d, 0, 4, 1, 5);
  const V ab2 = __builtin_shufflevector(a, b, 2, 6, 3, 7);
  const V cd2 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  store(to, __builtin_shufflevector(ab, cd, 0, 1, 4, 5));
  store(to + stride, __builtin_shufflevector(ab, cd, 2, 3, 6, 7));
  store(to + 2 * stride, __builtin_shufflevector(ab2, cd2, 0, 1, 4, 5));
  store(to + 3 * stride, __builtin_shufflevector(ab2, cd2, 2, 3, 6, 7));
}

}  // namespace
}  // namespace darswin
