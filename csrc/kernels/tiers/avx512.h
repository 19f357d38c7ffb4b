// AVX-512 (F, BW, VL, DQ): registers of 512 bits, and fused multiply-add. generic.h and
// four_lanes.h explain each name.
#pragma once

#include <immintrin.h>

#include "../../numbers.h"
#include "../vector.h"

namespace darswin {
namespace {

constexpr int kRegister = 64;  // bytes
constexpr int kTileRows = 8;   // rows of a tile of sums: 8 x 3 of 32 registers
constexpr bool kFused = true;
constexpr bool kHasFours = true, kSignedFours = false, kHasTiles = true;

using Floats = Vector<float, 16>;
using Doubles = Vector<double, 8>;
using Words = Vector<uint64_t, 8>;

inline Floats repeat(Vector<float, 4> v) {
  return (Floats)_mm512_maskz_broadcast_f32x4(0xFFFF, (__m128)v);
}

// The compiler's own conversions work on half a register at a time.
inline Doubles to_doubles(Vector<int32_t, 8> x) {
  return (Doubles)_mm512_maskz_cvtepi32_pd(0xFF, (__m256i)x);
}

inline Vector<int32_t, 8> to_ints(Doubles x) {
  return __builtin_convertvector(x, Vector<int32_t, 8>);
}

inline Doubles whole_part(Doubles x) {
  return (Doubles)_mm512_maskz_roundscale_pd(0xFF, (__m512d)x, _MM_FROUND_TO_ZERO);
}

inline void stream_lanes(float* to, Floats v) { _mm512_stream_ps(to, (__m512)v); }

inline __mmask16 first_lanes(int64_t count) { return static_cast<__mmask16>((1 << count) - 1); }
inline Floats load_first(const float* from, int64_t count) {
  return (Floats)_mm512_maskz_loadu_ps(first_lanes(count), from);
}
inline void store_first(float* to, Floats v, int64_t count) {
  _mm512_mask_storeu_ps(to, first_lanes(count), (__m512)v);
}

inline Floats gathered(const float* from, const int32_t* at) {
  const __m512i index = load_bits<__m512i>(at);
  return (Floats)_mm512_mask_i32gather_ps(_mm512_setzero_ps(), 0xFFFF, index, from, sizeof(float));
}

inline Floats widen_lanes(const bfloat16* from) {
  const __m256i halves = load_bits<__m256i>(from);
  return (Floats)((Vector<uint32_t, 16>)_mm512_maskz_cvtepu16_epi32(0xFFFF, halves) << 16);
}

inline void store_lowest_bytes(uint8_t* to, Vector<uint32_t, 16> v) {
  store_bits(to, __builtin_convertvector(v, Vector<uint8_t, 16>));
}

inline Words lower_product(Words a, uint32_t b) {
  const Words factor = splat<Words>(static_cast<uint64_t>(b));
  return (Words)_mm512_maskz_mul_epu32(0xFF, (__m512i)a, (__m512i)factor);
}

inline Vector<int32_t, 16> add_pairs(Vector<int32_t, 16> sums, Vector<uint32_t, 16> x,
                                     Vector<uint32_t, 16> weights) {
  return sums + (Vector<int32_t, 16>)_mm512_madd_epi16((__m512i)x, (__m512i)weights);
}

// The instruction is part of AVX-512 VNNI. Assembly needs no flag of the compiler.
inline Vector<int32_t, 16> add_fours(Vector<int32_t, 16> sums, Vector<uint32_t, 16> x,
                                     Vector<uint32_t, 16> weights) {
  asm("vpdpbusd %2, %1, %0" : "+v"(sums) : "v"(x), "v"(weights));
  return sums;
}

// The tiles of AMX: registers of up to 16 rows of 64 bytes. Tiles 0 to 2 have sums, 3 tokens, 4 and
// 5 weights; 6 and 7 have the last tokens and weights of a depth that fills no whole tile.
struct AmxTiles {
  // Says how many tokens a tile has, and how many words the last tile of a depth.
  static void shape(int64_t rows, int64_t last) {
    struct {
      uint8_t palette = 1, unused[15] = {};
      uint16_t bytes[16] = {64, 64, 64, 64, 64, 64};
      uint8_t rows[16] = {};
    } shapes;
    for (int k = 0; k < 4; ++k) shapes.rows[k] = static_cast<uint8_t>(rows);
    shapes.rows[4] = shapes.rows[5] = 16;
    if (last > 0) {
      shapes.bytes[6] = static_cast<uint16_t>(4 * last), shapes.rows[6] = shapes.rows[0];
      shapes.bytes[7] = 64, shapes.rows[7] = static_cast<uint8_t>(last);
    }
    asm volatile("ldtilecfg %0" : : "m"(shapes));
  }

  // Gives them back: the system keeps the tiles of a thread that has any.
  static void release() { asm volatile("tilerelease"); }

  // Adds the products of so many words of tokens and of weights (words, width) to kWide tiles of
  // sums, whose rows are `pitch` bytes apart. The sums start at zero if `starts`.
  template <int kWide>
  static void multiply(const uint8_t* x, int64_t depth, const uint32_t* weights, int64_t width,
                       int64_t words, void* sums, int64_t pitch, bool starts) {
    auto* to = static_cast<char*>(sums);
    if (starts) {
      asm volatile("tilezero %%tmm0; tilezero %%tmm1; tilezero %%tmm2" : :);
    } else {
      load<0>(to, pitch);
      if constexpr (kWide > 1) load<1>(to + 64, pitch);
      if constexpr (kWide > 2) load<2>(to + 128, pitch);
    }
    for (; words >= 16; words -= 16, x += 64, weights += 16 * width) {
      add<kWide, 3, 4, 5>(x, depth, weights, width);
    }
    if (words > 0) add<kWide, 6, 7, 7>(x, depth, weights, width);
    store<0>(to, pitch);
    if constexpr (kWide > 1) store<1>(to + 64, pitch);
    if constexpr (kWide > 2) store<2>(to + 128, pitch);
  }

 private:
  // Assembly needs no flag of the compiler, which itself uses no tiles.
  template <int kTile>
  static void load(const void* from, int64_t pitch) {
    asm volatile("tileloadd (%0,%1), %%tmm%c2" : : "r"(from), "r"(pitch), "i"(kTile) : "memory");
  }
  template <int kTile>
  static void store(void* to, int64_t pitch) {
    asm volatile("tilestored %%tmm%c2, (%0,%1)" : : "r"(to), "r"(pitch), "i"(kTile) : "memory");
  }
  template <int kSums, int kTokens, int kWeights>
  static void add_products() {
    asm volatile("tdpbusd %%tmm%c2, %%tmm%c1, %%tmm%c0"
                 :
                 : "i"(kSums), "i"(kTokens), "i"(kWeights));
  }
  template <int kWide, int kTokens, int kFirst, int kSecond>
  static void add(const uint8_t* x, int64_t depth, const uint32_t* weights, int64_t width) {
    const int64_t pitch = width * static_cast<int64_t>(sizeof(uint32_t));
    load<kTokens>(x, depth);
    load<kFirst>(weights, pitch);
    add_products<0, kTokens, kFirst>();
    if constexpr (kWide > 1) {
      load<kSecond>(weights + 16, pitch);
      add_products<1, kTokens, kSecond>();
    }
    if constexpr (kWide > 2) {
      load<kFirst>(weights + 32, pitch);
      add_products<2, kTokens, kFirst>();
    }
  }
};

// The rest is only for registers of 512 bits, which hold four pixels of four channels.

// Joins eight floats at `here` and eight floats at `there`. The masked load needs no shuffle.
inline Floats two_eights(const float* here, const float* there) {
  const __m512 first = _mm512_castps256_ps512(_mm256_loadu_ps(here));
  return (Floats)_mm512_mask_broadcast_f32x8(first, 0xFF00, _mm256_loadu_ps(there));
}

// Loads two floats from each of eight places.
inline Floats gather_pairs(const float* from, Vector<int64_t, 8> offset) {
  return (Floats)_mm512_mask_i64gather_pd(_mm512_setzero_pd(), 0xFF, (__m512i)offset, from,
                                          sizeof(float));
}

inline bool any_negative(Vector<int64_t, 8> v) { return _mm512_movepi64_mask((__m512i)v) != 0; }

inline Floats permuted(Floats v, Vector<int32_t, 16> index) {
  return (Floats)_mm512_maskz_permutexvar_ps(0xFFFF, (__m512i)index, (__m512)v);
}

// Returns the lanes of v that `index` lists.
inline Floats pick(Vector<float, 4> v, Vector<int32_t, 16> index) {
  return permuted((Floats)_mm512_castps128_ps512((__m128)v), index);
}

// Stores the first `lanes` lanes of each quarter of v, one quarter after the other.
inline void store_quarters(float* to, Floats v, int64_t lanes) {
  const auto fronts = static_cast<__mmask16>(0x1111 * ((1 << lanes) - 1));
  const auto joined = static_cast<__mmask16>((1 << 4 * lanes) - 1);
  _mm512_mask_storeu_ps(to, joined, _mm512_maskz_compress_ps(fronts, (__m512)v));
}

// Stores the first `lanes` lanes of each quarter of v at to[at[0]], to[at[1]], ...
inline void scatter_quarters(float* to, Floats v, const int32_t* at, int64_t lanes) {
  const auto fronts = static_cast<__mmask8>((1 << lanes) - 1);
  _mm_mask_storeu_ps(to + at[0], fronts, _mm512_maskz_extractf32x4_ps(0xF, (__m512)v, 0));
  _mm_mask_storeu_ps(to + at[1], fronts, _mm512_maskz_extractf32x4_ps(0xF, (__m512)v, 1));
  _mm_mask_storeu_ps(to + at[2], fronts, _mm512_maskz_extractf32x4_ps(0xF, (__m512)v, 2));
  _mm_mask_storeu_ps(to + at[3], fronts, _mm512_maskz_extractf32x4_ps(0xF, (__m512)v, 3));
}

}  // namespace
}  // namespace darswin
