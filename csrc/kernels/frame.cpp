// Bilinear samples of one 8-bit frame, at places that a plan has found before.
//
// Points are sampled in blocks. The first step only reads: it copies the pixels around each point
// to short arrays, one machine word for several channels where their bytes are neighbours. These
// loads do not wait for each other. The second step computes whole registers of points from the
// arrays. Points at the border are few. They are computed again, one at a time.
#include "../frames.h"
#include "polar_far.h"

namespace darswin {
namespace {

using Bits = Vector<uint32_t, kLanes<float>>;
constexpr int64_t kFrameBlock = 256;  // points; their words stay in the first-level cache

// The words around a block of points. A corner of a point is 8 bits of one of them.
struct Corner {
  const uint32_t* words;
  int shift;

  Floats read(int64_t k) const {
    using Ints = Vector<int32_t, kLanes<float>>;
    const Bits bits = (load<Bits>(words + k) >> shift) & 0xFF;
    return __builtin_convertvector((Ints)bits, Floats);
  }
};
struct Block {
  int32_t offset[kFrameBlock];
  uint32_t words[4][kFrameBlock];
  float samples[3][kFrameBlock];  // of each channel
};

// Interpolates from a to b. See `between` and kTryDifferences for the two forms.
template <Blend blend, typename V>
inline V along(V a, V b, V t) {
  if constexpr (blend == Blend::near_rows && kRegister < 64) {
    return a + t * (b - a);
  } else {
    return between(a, b, 1 - t, t);
  }
}

template <Blend blend, typename V>
inline V bilinear(V top_left, V top_right, V bottom_left, V bottom_right, V right, V lower) {
  const V l = along<blend>(top_left, bottom_left, lower);
  const V r = along<blend>(top_right, bottom_right, lower);
  return along<blend>(l, r, right);
}

// Samples one channel of a block.
template <Blend blend>
void blend_channel(const FrameArgs& a, int64_t first, int64_t count, const Corner corners[4],
                   int64_t channel, float* to) {
  const float scale = a.scale[channel], offset = a.offset[channel];
  const auto corner = [&](int n, int64_t k) {
    const Floats v = corners[n].read(k);
    if constexpr (blend == Blend::near || blend == Blend::near_rows) return v * scale + offset;
    return v;
  };
  for (int64_t k = 0; k < count; k += kLanes<float>) {
    Floats v =
        bilinear<blend>(corner(0, k), corner(1, k), corner(2, k), corner(3, k),
                        load<Floats>(a.right + first + k), load<Floats>(a.lower + first + k));
    if constexpr (blend == Blend::far) v = v * scale + offset;
    store(to + k, v);
  }
}

inline uint32_t load_word(const uint8_t* from) {
  uint32_t word;
  __builtin_memcpy(&word, from, 4);
  return word;
}
inline uint32_t load_half_word(const uint8_t* from) {
  uint16_t word;
  __builtin_memcpy(&word, from, 2);
  return word;
}

// Samples `count` points from `first` on into block.samples.
template <Blend blend>
void sample_block(const FrameArgs& a, int64_t first, int64_t count, Block& block) {
  using Shorts = Vector<int16_t, kLanes<float>>;
  using Ints = Vector<int32_t, kLanes<float>>;
  for (int64_t k = 0; k < count; k += kLanes<float>) {
    const Ints column = __builtin_convertvector(load<Shorts>(a.columns + first + k), Ints);
    const Ints row = __builtin_convertvector(load<Shorts>(a.rows + first + k), Ints);
    store(block.offset + k, row * static_cast<int32_t>(a.row_stride) +
                                column * static_cast<int32_t>(a.column_stride));
  }
  const int64_t below = a.row_stride, next = a.column_stride, plane = a.channel_stride;
  auto& w = block.words;
  if (a.channels == 3 && (plane == 1 || plane == -1) && next >= 3) {
    // The channels of a pixel are neighbours, in this order or the reverse. A word begins with a
    // pixel, or ends with its right neighbour, so it stays inside the frame.
    const uint8_t* pixels = plane == 1 ? a.pixels : a.pixels - 2;
    for (int64_t k = 0; k < count; ++k) {
      const uint8_t *top = pixels + block.offset[k], *bottom = top + below;
      w[0][k] = load_word(top), w[1][k] = load_word(top + next - 1);
      w[2][k] = load_word(bottom), w[3][k] = load_word(bottom + next - 1);
    }
    for (int c = 0; c < 3; ++c) {
      const int shift = 8 * (plane == 1 ? c : 2 - c);
      const Corner corners[] = {{w[0], shift}, {w[1], shift + 8}, {w[2], shift}, {w[3], shift + 8}};
      blend_channel<blend>(a, first, count, corners, c, block.samples[c]);
    }
    return;
  }
  for (int64_t c = 0; c < a.channels; ++c) {
    const uint8_t* pixels = a.pixels + c * plane;
    if (next == 1) {
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t* top = pixels + block.offset[k];
        w[0][k] = load_half_word(top), w[2][k] = load_half_word(top + below);
      }
    } else {
      for (int64_t k = 0; k < count; ++k) {
        const uint8_t *top = pixels + block.offset[k], *bottom = top + below;
        w[0][k] = top[0] | top[next] << 8, w[2][k] = bottom[0] | bottom[next] << 8;
      }
    }
    const Corner corners[] = {{w[0], 0}, {w[0], 8}, {w[2], 0}, {w[2], 8}};
    blend_channel<blend>(a, first, count, corners, c, block.samples[c]);
  }
}

// Rounds a sample to 8 bits. The sum of rounded weights may be a little above 1.
inline uint8_t to_byte(float sample) {
  return static_cast<uint8_t>(sample < 255 ? sample + 0.5f : 255.0f);
}

template <typename T>
inline void interleave_three(const T* x, const T* y, const T* z, int64_t count, T* to) {
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

// Writes the samples of a block to the output.
void write_block(const FrameArgs& a, int64_t first, int64_t count, const Block& block) {
  const auto& samples = block.samples;
  if (a.output == FrameOutput::planes) {
    for (int64_t c = 0; c < a.channels; ++c) {
      copy(samples[c], count, static_cast<float*>(a.out) + c * a.points + first);
    }
    return;
  }
  if (a.output == FrameOutput::tokens) {
    float* to = static_cast<float*>(a.out) + first * a.channels;
    if (a.channels == 1) return copy(samples[0], count, to);
    return interleave_three(samples[0], samples[1], samples[2], count, to);
  }
  uint8_t bytes[3][kFrameBlock];
  for (int64_t c = 0; c < a.channels; ++c) {
#pragma omp simd
    for (int64_t k = 0; k < count; ++k) bytes[c][k] = to_byte(samples[c][k]);
  }
  uint8_t* to = static_cast<uint8_t*>(a.out) + first * a.channels;
  if (a.channels == 1) {
    __builtin_memcpy(to, bytes[0], count);
  } else {
    interleave_three(bytes[0], bytes[1], bytes[2], count, to);
  }
}

// Samples a point at the border or outside. Pixels outside count as 0, after normalization.
template <Blend blend>
void sample_border(const FrameArgs& a, const BorderPoint& point) {
  const int64_t column = point.column, row = point.row, k = point.index;
  const auto value = [&](int64_t y, int64_t x, int64_t c) {
    if (y < 0 || y >= a.height || x < 0 || x >= a.width) return 0.0f;
    const float v = a.pixels[y * a.row_stride + x * a.column_stride + c * a.channel_stride];
    return blend == Blend::raw ? v : v * a.scale[c] + a.offset[c];
  };
  const bool outside = column < -1 || column >= a.width || row < -1 || row >= a.height;
  for (int64_t c = 0; c < a.channels; ++c) {
    const float v = outside
                        ? 0
                        : bilinear<blend>(value(row, column, c), value(row, column + 1, c),
                                          value(row + 1, column, c), value(row + 1, column + 1, c),
                                          point.right, point.lower);
    if (a.output == FrameOutput::planes) {
      static_cast<float*>(a.out)[c * a.points + k] = v;
    } else if (a.output == FrameOutput::tokens) {
      static_cast<float*>(a.out)[k * a.channels + c] = v;
    } else {
      static_cast<uint8_t*>(a.out)[k * a.channels + c] = to_byte(v);
    }
  }
}

template <Blend blend>
void sample_points(const FrameArgs& a, int64_t begin, int64_t end) {
  alignas(64) Block block;
  // A frame of one row or column has no four neighbours: all its points are border points.
  for (int64_t k = begin; k < end && a.height > 1 && a.width > 1; k += kFrameBlock) {
    const int64_t count = smaller(kFrameBlock, end - k);
    sample_block<blend>(a, k, count, block);
    write_block(a, k, count, block);
  }
  int64_t low = 0, high = a.border_points;  // finds the first border point from `begin` on
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    a.border[middle].index < begin ? low = middle + 1 : high = middle;
  }
  for (; low < a.border_points && a.border[low].index < end; ++low) {
    sample_border<blend>(a, a.border[low]);
  }
}

void sample(const FrameArgs& a, int64_t begin, int64_t end) {
  switch (a.blend) {
    case Blend::raw:
      return sample_points<Blend::raw>(a, begin, end);
    case Blend::far:
      return sample_points<Blend::far>(a, begin, end);
    case Blend::near:
      return sample_points<Blend::near>(a, begin, end);
    case Blend::near_rows:
      return sample_points<Blend::near_rows>(a, begin, end);
  }
}

void places(PolarSampleArgs<float> a, double* angles, int64_t padded, int16_t* columns,
            int16_t* rows, float* right, float* lower) {
  a.cosines = angles + padded, a.sines = angles + 2 * padded;
  directions(angles, padded, angles + padded, angles + 2 * padded);
  constexpr int64_t strides[] = {0, 0};
  PlacedPoints<float> points;
  for (int64_t i = 0; i < a.num_radii; ++i) {
    for (int64_t j = 0; j < a.num_azimuths; j += kBlock) {
      const int64_t count = smaller(kBlock, a.num_azimuths - j), to = i * a.num_azimuths + j;
      points.find_far<true>(a, strides, 0, i, j, count, 0);
      for (int64_t k = 0; k < count; ++k) {
        columns[to + k] = static_cast<int16_t>(points.far.column[k]);
        rows[to + k] = static_cast<int16_t>(points.far.row[k]);
        right[to + k] = points.far.right[k];
        lower[to + k] = points.far.lower[k];
      }
    }
  }
}

}  // namespace

TIER_TABLE(FrameKernels) = {.places = places, .sample = sample};

}  // namespace darswin
