// Short vectors by the compiler's vector extension: the same source becomes SSE, AVX2 or AVX-512
// code, whatever the tier's flags allow. An operation works on every lane; a*b + c becomes one
// fused instruction where the tier has it. A vector wider than the registers is split by the
// compiler.
#pragma once

#if defined(__SSE2__)
#  include <immintrin.h>
#endif

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

using Floats = Vector<float, kLanes<float>>;
using Doubles = Vector<double, kLanes<double>>;
using Words = Vector<uint64_t, kLanes<uint64_t>>;
constexpr int kDoubles = kLanes<double>;

// n, or the next multiple of `unit`.
constexpr int64_t round_up(int64_t n, int64_t unit) { return (n + unit - 1) / unit * unit; }

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
  } else {
    for (; e < count; ++e) to[e] = from[e];
  }
}

template <typename V, typename T>
inline V splat(T value) {
  return value - V{};  // x - 0 is x for every x, -0 included
}

// A value that is rounded as it stands. The compiler may else fuse the product in it into a sum in
// one copy of the code and not in another, and results would depend on which copy runs.
template <typename V>
inline V unfused(V value) {
#if defined(__FMA__)
  asm("" : "+x"(value));
#elif !defined(__SSE2__)
  asm("" : "+m"(value));
#endif
  return value;
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
#if defined(__FMA__)
  if constexpr (kSame<V, float>) return __builtin_fmaf(t, b, one_less_t * a);
  if constexpr (kSame<V, double>) return __builtin_fma(t, b, one_less_t * a);
#endif
  return unfused(one_less_t * a) + t * b;
}

// a where the mask's lane is all ones, else b.
template <typename M, typename V>
inline V select(M mask, V a, V b) {
  return mask ? a : b;
}

// Halves of a register. The compiler's own shuffle for the upper one is a slow one.
inline Vector<float, 4> lower_half(Vector<float, 8> v) {
  return __builtin_shufflevector(v, v, 0, 1, 2, 3);
}
inline Vector<float, 4> upper_half(Vector<float, 8> v) {
#if defined(__AVX__)
  return (Vector<float, 4>)_mm256_extractf128_ps((__m256)v, 1);
#else
  return __builtin_shufflevector(v, v, 4, 5, 6, 7);
#endif
}

// Four lanes, again and again in a register.
template <typename V>
inline V repeat(Vector<float, 4> v) {
#if defined(__AVX512F__)
  return (V)_mm512_maskz_broadcast_f32x4(0xFFFF, (__m128)v);
#elif defined(__AVX__)
  return (V)_mm256_set_m128((__m128)v, (__m128)v);
#else
  return v;
#endif
}

// Integers as doubles; the compiler's own conversion goes by halves of a register.
inline Doubles to_doubles(Vector<int32_t, kDoubles> x) {
#if defined(__AVX512F__)
  return (Doubles)_mm512_maskz_cvtepi32_pd(0xFF, (__m256i)x);
#else
  return __builtin_convertvector(x, Doubles);
#endif
}

// Two floats from here and two from there.
inline Vector<float, 4> two_pairs(const float* here, const float* there) {
  using Pairs = Vector<double, 2>;
  double first, second;
  __builtin_memcpy(&first, here, 8);
  __builtin_memcpy(&second, there, 8);
  return (Vector<float, 4>)Pairs{first, second};
}

#if defined(__AVX512F__)
// Eight floats from here and eight from there: a masked load, which needs no shuffle.
inline Vector<float, 16> two_eights(const float* here, const float* there) {
  const __m512 first = _mm512_castps256_ps512(_mm256_loadu_ps(here));
  return (Vector<float, 16>)_mm512_mask_broadcast_f32x8(first, 0xFF00, _mm256_loadu_ps(there));
}

// The lanes of v that `index` names.
inline Vector<float, 16> pick(Vector<float, 4> v, Vector<int32_t, 16> index) {
  return (Vector<float, 16>)_mm512_maskz_permutexvar_ps(0xFFFF, (__m512i)index,
                                                        _mm512_castps128_ps512((__m128)v));
}

// A quarter of a register, a few lanes of each behind one another, and the first lanes written.
template <int index>
inline Vector<float, 4> quarter(Vector<float, 16> v) {
  return (Vector<float, 4>)_mm512_maskz_extractf32x4_ps(0xF, (__m512)v, index);
}
inline Vector<float, 16> front_of_quarters(Vector<float, 16> v, int64_t lanes) {
  const auto mask = static_cast<__mmask16>(0x1111 * ((1 << lanes) - 1));
  return (Vector<float, 16>)_mm512_maskz_compress_ps(mask, (__m512)v);
}
inline void store_front(float* to, Vector<float, 16> v, int64_t lanes) {
  _mm512_mask_storeu_ps(to, static_cast<__mmask16>((1 << lanes) - 1), (__m512)v);
}
#endif

// The whole part of numbers below 2^63.
inline Doubles whole_part(Doubles x) {
#if defined(__AVX512F__)
  return (Doubles)_mm512_maskz_roundscale_pd(0xFF, (__m512d)x, _MM_FROUND_TO_ZERO);
#elif defined(__AVX2__)
  return (Doubles)_mm256_round_pd((__m256d)x, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC);
#else
  return __builtin_convertvector(__builtin_convertvector(x, Vector<int64_t, kDoubles>), Doubles);
#endif
}

// a0 b0 a1 b1 ... of the lower and of the upper halves of two registers of 64-bit lanes.
template <typename V>
inline V interleave_lower(V a, V b) {
#if defined(__AVX512F__)
  return __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
#elif defined(__AVX2__)
  return __builtin_shufflevector(a, b, 0, 4, 1, 5);
#else
  return __builtin_shufflevector(a, b, 0, 2);
#endif
}
template <typename V>
inline V interleave_upper(V a, V b) {
#if defined(__AVX512F__)
  return __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
#elif defined(__AVX2__)
  return __builtin_shufflevector(a, b, 2, 6, 3, 7);
#else
  return __builtin_shufflevector(a, b, 1, 3);
#endif
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

// A register of floats from as many bfloat16; the compiler's own conversion goes by halves of it.
inline Floats widen_lanes(const bfloat16* from) {
  using Bits = Vector<uint32_t, kLanes<float>>;
#if defined(__AVX512F__)
  const Bits bits = (Bits)_mm512_maskz_cvtepu16_epi32(0xFFFF, load_bits<__m256i>(from));
#elif defined(__AVX2__)
  const Bits bits = (Bits)_mm256_cvtepu16_epi32(load_bits<__m128i>(from));
#else
  const auto bits = __builtin_convertvector(load_bits<Vector<uint16_t, kLanes<float>>>(from), Bits);
#endif
  return (Floats)(bits << 16);
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
