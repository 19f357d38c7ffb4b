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
        compute(image, c, {words[0], shift}, {words[1], shift + 8}, {words[2], shift},
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
      compute(image, c, {words[0], 0}, {words[0], 8}, {words[2], 0}, {words[2], 8}, right, lower,
              count);
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
  void compute(const ByteImage& image, int64_t c, Corner top_left, Corner top_right,
               Corner bottom_left, Corner bottom_right, const float* right, const float* lower,
               int64_t count) {
    const auto scale = splat<Floats>(image.scale[c]), shift = splat<Floats>(image.offset[c]);
    for (int64_t k = 0; k < count; k += kLanes<float>) {
      const Floats v =
          bilinear(top_left.read(k), top_right.read(k), bottom_left.read(k), bottom_right.read(k),
                   load<Floats>(right + k), load<Floats>(lower + k));
      store(samples[c] + k, normalized(v, scale, shift));
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
