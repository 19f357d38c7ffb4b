// Bilinear interpolation in a packed image (polar_image.h): first downwards, then to the right,
// four channels at a time.
#pragma once

#include <cstddef>

#include "polar_image.h"

namespace darswin {
namespace {

// Interpolation uses weights, (1 - t) * a + t * b, or differences, a + t * (b - a). Differences
// overflow between huge values and give NaN between infinite ones. Weights cost more, but not for
// registers of 512 bits, which hold four points. The other tiers try differences first and, where a
// sample is not finite, take the whole block of points again with weights; its other samples may
// then differ in their last bit.
template <typename T>
constexpr bool kTryDifferences = is_same_v<T, float> && kRegister < 64;

template <bool kWeights, typename V>
inline V between(V a, V b, V t) {
  if constexpr (kWeights) {
    return between(a, b, 1 - t, t);
  } else {
    return a + t * (b - a);
  }
}

// Four channels, or as many as a register holds.
template <typename T>
using Piece = Vector<T, (kLanes<T> < 4 ? kLanes<T> : 4)>;

// Writes four channels of a sample, given the upper left and the lower left pixel; their right
// neighbours follow them in memory. With differences, also adds what it writes to *sum.
template <bool kWeights, typename T>
inline void interpolate(const T* pixel, const T* below, T right, T lower, T* to, Piece<T>* sum) {
  using V = Piece<T>;
  const V along = splat<V>(right);
  const auto write = [&](int e, V v) {
    store(to + e, v);
    if constexpr (!kWeights) *sum += v;
  };
  if constexpr (is_same_v<T, float> && kRegister > 16) {
    // One load takes a pixel and its right neighbour.
    using Pair = Vector<T, 8>;
    const Pair pair = between<kWeights>(load<Pair>(pixel), load<Pair>(below), splat<Pair>(lower));
    write(0, between<kWeights>(lower_half(pair), upper_half(pair), along));
  } else {
    const V down = splat<V>(lower);
#pragma GCC unroll 2
    for (int e = 0; e < 4; e += kLanes<T>) {
      const V l = between<kWeights>(load<V>(pixel + e), load<V>(below + e), down);
      const V r = between<kWeights>(load<V>(pixel + 4 + e), load<V>(below + 4 + e), down);
      write(e, between<kWeights>(l, r, along));
    }
  }
}

// Four points in a register of 512 bits: two pairs of pixels and the two pairs below, then four
// pixels and their right neighbours. Loads and stores are what limits a single point; here one load
// each brings the weights of four, and points that follow each other are written by one store. A
// template, since only tiers with such registers have two_eights and pick.
template <typename T>
inline Vector<T, 16> interpolate_four(const T* pixels, const T* below, const int32_t* offset,
                                      const T* right, const T* lower) {
  using V = Vector<T, 16>;
  using Index = Vector<int32_t, 16>;
  constexpr Index first_two = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1};
  constexpr Index all = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
  const auto down = load<Vector<T, 4>>(lower), along = load<Vector<T, 4>>(right);
  const V top = two_eights(pixels + offset[0], pixels + offset[1]);
  const V bottom = two_eights(below + offset[0], below + offset[1]);
  const V top2 = two_eights(pixels + offset[2], pixels + offset[3]);
  const V bottom2 = two_eights(below + offset[2], below + offset[3]);
  const V pairs = between<true>(top, bottom, pick(down, first_two));
  const V pairs2 = between<true>(top2, bottom2, pick(down, first_two + 2));
  const V l = even_quads(pairs, pairs2), r = odd_quads(pairs, pairs2);
  return between<true>(l, r, pick(along, all));
}

// Whether all lanes are finite.
template <typename V>
inline bool all_finite(const V& v) {
  bool finite = true;
  for (std::size_t lane = 0; lane < sizeof(V) / sizeof(v[0]); ++lane)
    finite &= v[lane] - v[lane] == 0;
  return finite;
}

// Where the points of a block go: point k to to[place[k]]. joined[k] says whether the next three
// points follow it there.
struct Targets {
  int32_t place[kBlock];
  bool joined[kBlock];
};

// Samples `count` points of a packed image. A point stores four values even if it has fewer
// channels: the point that belongs behind it comes later and overwrites the rest. But behind a
// token may be what is written already, or what another thread writes. So from `last_row` on, where
// the last rows of tokens are, `width` points each, their last points store only their own values.
// Returns false if it used differences and a sample is not finite, which the sum of all samples
// shows. A function of its own, so that all it needs stays in registers.
template <bool kWeights, typename T>
[[gnu::noinline]] bool sample_points(const T* pixels, int64_t row, const PackedPlaces<T>& places,
                                     int64_t last_row, int64_t count, int64_t width,
                                     const Targets& targets, int64_t channels, T* to) {
  const T* below = pixels + row;
  const int32_t *offset = places.offset, *target = targets.place;
  const T *right = places.right, *lower = places.lower;
  Piece<T> sums[4]{};  // used in turn, so that no addition waits for the one before
  const auto sample = [&](int64_t k, T* out, Piece<T>* sum) {
    interpolate<kWeights>(pixels + offset[k], below + offset[k], right[k], lower[k], out, sum);
  };
  // First the rows before the last as one, then the last row, token by token.
  for (int64_t k = 0, end = last_row, exact = last_row; k < count;
       end = k + width, exact = end - 3 / channels) {
    if constexpr (is_same_v<T, float> && kRegister == 64) {
      for (; k + 4 <= exact; k += 4) {
        const auto v = interpolate_four(pixels, below, offset + k, right + k, lower + k);
        if (targets.joined[k]) {
          store_quarters(to + target[k], v, channels);
        } else {
          scatter_quarters(to, v, target + k);
        }
      }
    }
    for (; k + 4 <= exact; k += 4) {
#pragma GCC unroll 4
      for (int turn = 0; turn < 4; ++turn) sample(k + turn, to + target[k + turn], sums + turn);
    }
    for (; k < exact; ++k) sample(k, to + target[k], sums);
    for (; k < end; ++k) {
      T v[4];
      sample(k, v, sums);
      for (int64_t c = 0; c < channels; ++c) to[target[k] + c] = v[c];
    }
  }
  return kWeights || all_finite((sums[0] + sums[1]) + (sums[2] + sums[3]));
}

}  // namespace
}  // namespace darswin
