// Bilinear samples of an 8-bit image with one or three channels, in place.
//
// Points are sampled in blocks. The first step only reads: it copies the pixels around each point
// to short arrays, one machine word for several channels where their bytes are neighbours. These
// loads do not wait for each other. The second step computes whole registers of points from the
// arrays. Points at the border are few. They are computed again, one at a time.
#pragma once

#include "../frames.h"
#include "polar_far.h"

namespace darswin {
namespace {

// Interpolation uses weights, (1 - t) * a + t * b, or differences, a + t * (b - a). Differences
// overflow between huge values and give NaN between infinite values. Weights cost more, except in
// registers of 512 bits, which hold four points. So the other tiers try differences first. If a
// sample is not finite, they compute the whole block of points again with weights. The other
// samples of the block may then differ in their last bit.
template <typename T>
constexpr bool kTryDifferences = is_same_v<T, float> && kRegister < 64;

constexpr int64_t kByteBlock = 256;  // points; their words stay in the first-level cache

// Interpolates from a to b, in one of these two forms.
template <bool kWeights, typename V>
inline V between(V a, V b, V t) {
  if constexpr (kWeights) {
    return between(a, b, 1 - t, t);
  } else {
    return a + t * (b - a);
  }
}

// The same by the rule of `blend`. 8-bit pixels are finite, so differences always do.
template <Blend blend, typename V>
inline V along(V a, V b, V t) {
  constexpr bool differences = blend == Blend::near_rows && kTryDifferences<float>;
  return between<!differences>(a, b, t);
}

template <Blend blend, typename V>
inline V bilinear(V top_left, V top_right, V bottom_left, V bottom_right, V right, V lower) {
  const V l = along<blend>(top_left, bottom_left, lower);
  const V r = along<blend>(top_right, bottom_right, lower);
  return along<blend>(l, r, right);
}

// A corner of the points of a block: 8 bits of each word.
struct Corner {
  const uint32_t* words;
  int shift;

  Floats read(int64_t k) const {
    using Bits = Vector<uint32_t, kLanes<float>>;
    using Ints = Vector<int32_t, kLanes<float>>;
    const Bits bits = (load<Bits>(words + k) >> shift) & 0xFF;
    return __builtin_convertvector((Ints)bits, Floats);
  }
};

struct ByteBlock {
  int32_t offset[kByteBlock];
  uint32_t words[4][kByteBlock];
  float samples[3][kByteBlock];  // of each channel

  // Samples points of an image. `offset` has those of their upper left pixels, whose neighbours are
  // in the image too. Up to a register of `right` and `lower` is read behind the last point.
  template <Blend blend>
  void sample(const ByteImage& image, const float* right, const float* lower, int64_t count) {
    const int64_t below = image.row_stride, next = image.column_stride,
                  plane = image.channel_stride;
    if (image.channels == 3 && (plane == 1 || plane == -1) && next >= 3) {
      // The channels of a pixel are neighbours, in this order or the reverse. A word begins with a
      // pixel, or ends with its right neighbour, so it stays inside the image.
      const uint8_t* pixels = plane == 1 ? image.pixels : image.pixels - 2;
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t *top = pixels + offset[k], *bottom = top + below;
        words[0][k] = load_bits<uint32_t>(top), words[1][k] = load_bits<uint32_t>(top + next - 1);
        words[2][k] = load_bits<uint32_t>(bottom);
        words[3][k] = load_bits<uint32_t>(bottom + next - 1);
      }
      for (int c = 0; c < 3; ++c) {
        const int shift = 8 * (plane == 1 ? c : 2 - c);
        compute<blend>(image, c, {words[0], shift}, {words[1], shift + 8}, {words[2], shift},
                       {words[3], shift + 8}, right, lower, count);
      }
      return;
    }
    for (int64_t c = 0; c < image.channels; ++c) {
      const uint8_t* pixels = image.pixels + c * plane;
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t *top = pixels + offset[k], *bottom = top + below;
        if (next == 1) {
          words[0][k] = load_bits<uint16_t>(top), words[2][k] = load_bits<uint16_t>(bottom);
        } else {
          words[0][k] = top[0] | top[next] << 8, words[2][k] = bottom[0] | bottom[next] << 8;
        }
      }
      compute<blend>(image, c, {words[0], 0}, {words[0], 8}, {words[2], 0}, {words[2], 8}, right,
                     lower, count);
    }
  }

  // Copies the samples to (points, C).
  void write(int64_t channels, int64_t count, float* to) const {
    if (channels == 1) return copy(samples[0], count, to);
    interleave(samples[0], samples[1], samples[2], count, to);
  }

  template <typename T>
  static void interleave(const T* x, const T* y, const T* z, int64_t count, T* to) {
    int64_t k = 0;
    if constexpr (is_same_v<T, float> && kRegister == 64) {
      using V = Vector<float, 16>;
      for (; k + 16 <= count; k += 16) {
        store_sixteen<float>(load<V>(x + k), load<V>(y + k), load<V>(z + k), to + 3 * k);
      }
    } else if constexpr (is_same_v<T, float>) {
      using V = Vector<float, 4>;
      for (; k + 4 <= count; k += 4) {
        store_fours(load<V>(x + k), load<V>(y + k), load<V>(z + k), to + 3 * k);
      }
    }
    for (; k < count; ++k) to[3 * k] = x[k], to[3 * k + 1] = y[k], to[3 * k + 2] = z[k];
  }

 private:
  // Computes the samples of channel c.
  template <Blend blend>
  void compute(const ByteImage& image, int64_t c, Corner top_left, Corner top_right,
               Corner bottom_left, Corner bottom_right, const float* right, const float* lower,
               int64_t count) {
    const float scale = image.scale[c], shift = image.offset[c];
    const auto value = [&](const Corner& corner, int64_t k) {
      const Floats v = corner.read(k);
      if constexpr (blend == Blend::near || blend == Blend::near_rows) return v * scale + shift;
      return v;
    };
    for (int64_t k = 0; k < count; k += kLanes<float>) {
      Floats v =
          bilinear<blend>(value(top_left, k), value(top_right, k), value(bottom_left, k),
                          value(bottom_right, k), load<Floats>(right + k), load<Floats>(lower + k));
      if constexpr (blend == Blend::far) v = v * scale + shift;
      store(samples[c] + k, v);
    }
  }
};

// Returns channel c of a sample at the border or outside. Pixels outside count as 0, after the
// normalization.
template <Blend blend>
float border_sample(const ByteImage& image, int64_t column, int64_t row, float right, float lower,
                    int64_t c) {
  if (column < -1 || column >= image.width || row < -1 || row >= image.height) return 0;
  const auto value = [&](int64_t y, int64_t x) {
    if (y < 0 || y >= image.height || x < 0 || x >= image.width) return 0.0f;
    const float v =
        image.pixels[y * image.row_stride + x * image.column_stride + c * image.channel_stride];
    return blend == Blend::raw ? v : v * image.scale[c] + image.offset[c];
  };
  return bilinear<blend>(value(row, column), value(row, column + 1), value(row + 1, column),
                         value(row + 1, column + 1), right, lower);
}

}  // namespace
}  // namespace darswin
