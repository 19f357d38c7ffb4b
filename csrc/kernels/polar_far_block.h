// A block of points in a far image whose channels are planes, sixteen points at a time: for
// registers of 512 bits. Gathers bring a pixel and its right neighbour as one value of 64 bits.
#pragma once

#include "polar_image.h"

namespace darswin {
namespace {

// The pixels around sixteen points. A template, since only tiers with such registers have
// gather_pairs and permuted.
template <typename T>
struct FarSixteen {
  using V = Vector<T, 16>;
  using Offsets = Vector<int64_t, 32 / sizeof(T)>;
  using Index = Vector<int32_t, 16>;

  Offsets offset, offset2;  // of the upper left pixels
  V up, up2, down, down2;   // weights of the upper and the lower pixels, each twice
  V left, right;

  FarSixteen(const FarPlaces<T>& places, int64_t k)
      : offset(load<Offsets>(places.offset + k)), offset2(load<Offsets>(places.offset + k + 8)) {
    constexpr Index twice = {0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7};
    const V lower = load<V>(places.lower + k);
    down = permuted(lower, twice);
    down2 = permuted(lower, twice + 8);
    up = 1 - down, up2 = 1 - down2;
    right = load<V>(places.right + k);
    left = 1 - right;
  }

  bool inside() const { return !any_negative(offset | offset2); }

  // Bilinear samples of a plane whose rows are `below` apart.
  V sample(const T* plane, int64_t below) const {
    const T* bottom = plane + below;
    const V pairs = between(gather_pairs(plane, offset), gather_pairs(bottom, offset), up, down);
    const V pairs2 =
        between(gather_pairs(plane, offset2), gather_pairs(bottom, offset2), up2, down2);
    const V l = __builtin_shufflevector(pairs, pairs2, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22,
                                        24, 26, 28, 30);
    const V r = __builtin_shufflevector(pairs, pairs2, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23,
                                        25, 27, 29, 31);
    return between(l, r, left, right);
  }
};

// Sixteen samples of three channels, one behind the other.
template <typename T, typename V = Vector<T, 16>>
inline void store_sixteen(const V& x, const V& y, const V& z, T* to) {
  const V a = __builtin_shufflevector(x, y, 0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5);
  const V b = __builtin_shufflevector(x, y, 21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26);
  const V c =
      __builtin_shufflevector(x, y, 0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0);
  store(to, __builtin_shufflevector(a, z, 0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15));
  store(to + 16,
        __builtin_shufflevector(b, z, 0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15));
  store(to + 32,
        __builtin_shufflevector(c, z, 26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31));
}

}  // namespace
}  // namespace darswin
