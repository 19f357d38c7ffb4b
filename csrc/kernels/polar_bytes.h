// Bilinear samples of an 8-bit image with one or three channels, which is read directly.
//
// Points are sampled in blocks. The first step only reads: it copies the pixels around each point
// to short arrays, one machine word for several channels where their bytes are neighbours. These
// loads do not wait for each other. The second step computes whole registers of points from the
// arrays. Points at the border are few. They are computed again, one at a time.
#pragma once

#include "../frames.h"
#include "polar_direct.h"

namespace darswin {
namespace {

constexpr int64_t kByteBlock = 256;  // points; their words stay in the first-level cache

using PointWords = Vector<uint32_t, kLanes<float>>;

// 8 bits of each word.
inline Floats byte_of(PointWords words, int shift) {
  const PointWords bits = (words >> shift) & 0xFF;
  return __builtin_convertvector((Vector<int32_t, kLanes<float>>)bits, Floats);
}

struct ByteBlock {
  int32_t offset[kByteBlock];
  uint32_t words[2][2 * kByteBlock];  // of the upper and the lower pixels
  float samples[3][kByteBlock];       // of each channel

  // Samples points of an image. `offset` has those of their upper left pixels, whose neighbours are
  // in the image too. Up to a register of `right` and `lower` is read behind the last point.
  void sample(const ByteImage& image, const float* right, const float* lower, int64_t count) {
    const int64_t below = image.row_stride, next = image.column_stride,
                  plane = image.channel_stride;
    if (image.channels == 3 && (plane == 1 || plane == -1) && next >= 3) {
      // The channels of a pixel are neighbours, in this order or the reverse. A word begins with a
      // pixel, or ends with its right neighbour, so it stays inside the image.
      const uint8_t* pixels = plane == 1 ? image.pixels : image.pixels - 2;
      const auto pair = [&](const uint8_t* left) {
        const uint64_t right = load_bits<uint32_t>(left + next - 1);
        return load_bits<uint32_t>(left) | right << 32;
      };
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t* top = pixels + offset[k];
        store_bits(words[0] + 2 * k, pair(top)), store_bits(words[1] + 2 * k, pair(top + below));
      }
      compute<2>(image, 0, 3, plane == 1 ? 0 : 16, plane == 1 ? 8 : -8, right, lower, count);
      return;
    }
    for (int64_t c = 0; c < image.channels; ++c) {
      const uint8_t* pixels = image.pixels + c * plane;
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t *top = pixels + offset[k], *bottom = top + below;
        if (next == 1) {
          words[0][k] = load_bits<uint16_t>(top), words[1][k] = load_bits<uint16_t>(bottom);
        } else {
          words[0][k] = top[0] | top[next] << 8, words[1][k] = bottom[0] | bottom[next] << 8;
        }
      }
      compute<1>(image, c, c + 1, 0, 0, right, lower, count);
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
  // Computes the samples of channels [c, last) from one word for each point, or two: one of the
  // left pixel and one of the right, whose bytes begin 8 bits later. `step` is from a channel to
  // the next.
  template <int kWords>
  void compute(const ByteImage& image, int64_t c, int64_t last, int shift, int step,
               const float* right, const float* lower, int64_t count) {
    const int64_t first = c;
    for (int64_t k = 0; k < count; k += kLanes<float>, c = first) {
      PointWords corners[2][2];
      for (int row = 0; row < 2; ++row) {
        const auto left = load<PointWords>(words[row] + kWords * k);
        corners[row][0] = corners[row][1] = left;
        if constexpr (kWords == 2) {
          const auto others = load<PointWords>(words[row] + kWords * k + kLanes<float>);
          corners[row][0] = evens(left, others), corners[row][1] = odds(left, others);
        }
      }
      const auto x = load<Floats>(right + k), y = load<Floats>(lower + k);
      for (int at = shift; c < last; ++c, at += step) {
        const Floats v = bilinear(byte_of(corners[0][0], at), byte_of(corners[0][1], at + 8),
                                  byte_of(corners[1][0], at), byte_of(corners[1][1], at + 8), x, y);
        store(samples[c] + k,
              normalized(v, splat<Floats>(image.scale[c]), splat<Floats>(image.offset[c])));
      }
    }
  }
};

// Returns channel c of a sample at the border or outside. Inlined, it would slow down the loop over
// all points, of which few are there.
[[gnu::noinline]] float border_sample(const ByteImage& image, int64_t column, int64_t row,
                                      float right, float lower, int64_t c) {
  const auto interpolate = [&](auto value) {
    const auto at = [&](int64_t y, int64_t x) {
      const bool inside = y >= 0 && y < image.height && x >= 0 && x < image.width;
      return inside ? value(y * image.row_stride + x * image.column_stride) : 0.0f;
    };
    return bilinear(at(row, column), at(row, column + 1), at(row + 1, column),
                    at(row + 1, column + 1), right, lower);
  };
  const uint8_t* pixels = image.pixels + c * image.channel_stride;
  const float sample = interpolate([&](int64_t offset) -> float { return pixels[offset]; });
  return normalized(sample, image.scale[c], image.offset[c],
                    interpolate([](int64_t) { return 1.0f; }));
}

}  // namespace
}  // namespace darswin
