// Reads and writes rows of samples in the operator's output or its gradient. A row holds all points
// of one radius.
#pragma once

#include "polar_image.h"

namespace darswin {
namespace {

// The steps in memory from a sample to that of the next radius, sector, azimuth and channel.
struct Strides {
  int64_t row, sector, sample, channel;
};

template <typename T>
Strides output_strides(const PolarSampleArgs<T>& a) {
  const int64_t piece = a.samples_a * a.channels;
  if (a.tokens) return {piece, a.samples_r * piece, a.channels, 1};
  return {a.num_azimuths, a.samples_a, 1, a.num_radii * a.num_azimuths};
}

// Returns the index of the first sample of radius i of image b in the output.
template <typename T>
int64_t output_start(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
  const Strides strides = output_strides(a);
  const int64_t image = b * a.num_radii * a.num_azimuths * a.channels;
  if (!a.tokens) return image + i * strides.row;
  const int64_t ring = a.samples_r * a.num_azimuths * a.channels;
  return image + i / a.samples_r * ring + i % a.samples_r * strides.row;
}

// Returns the bytes of one row, with pixels padded to four channels.
template <typename T>
int64_t row_bytes(const PolarSampleArgs<T>& a) {
  return round_up((a.num_azimuths * round_up(a.channels, 4) + 16) * sizeof(T), 64);
}

// Interleaves four planes: channel c of point k goes to to[k * step + c].
template <typename T, typename E>
void interleave(const E* const plane[4], int64_t count, T* to, int64_t step) {
  int64_t k = 0;
  if constexpr (is_same_v<T, float> && kRegister >= 32) {
    constexpr int kL = kLanes<float>;
    for (; step == 4 && k + kL <= count; k += kL) {
      const auto read = [&](int c) { return load<Floats>(plane[c] + k); };
      interleave_four(read(0), read(1), read(2), read(3), to + 4 * k);
    }
  }
  using V = Vector<T, 4>;
  for (; k + 4 <= count; k += 4) {
    const auto read = [&](int c) { return load<V>(plane[c] + k); };
    transpose4(read(0), read(1), read(2), read(3), to + k * step, step);
  }
  for (; k < count; ++k) {
    for (int c = 0; c < 4; ++c) to[k * step + c] = load<T>(plane[c] + k);
  }
}

// Calls use<E>(), where E is the type of the output or of its gradient.
template <typename T, typename Use>
void with_output_type(const PolarSampleArgs<T>& a, Use use) {
  if constexpr (is_same_v<T, float>) {
    if (a.narrow) return use.template operator()<bfloat16>();
  }
  use.template operator()<T>();
}

// Writes the samples of a radius to the output: (num_azimuths, C) for tokens, else the planes
// (channels, num_azimuths) of the channels from `channel` on.
template <typename T>
void write_row(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t channel, int64_t channels,
               const T* samples) {
  with_output_type(a, [&]<typename E>() {
    const Strides strides = output_strides(a);
    E* out = static_cast<E*>(a.out) + output_start(a, b, i) + channel * strides.channel;
    const int64_t piece = a.tokens ? strides.row : a.num_azimuths;
    const int64_t step = a.tokens ? strides.sector : strides.channel;
    for (int64_t values = a.num_azimuths * channels; values > 0; values -= piece) {
      copy(samples, piece, out);
      samples += piece, out += step;
    }
  });
}

// Returns the step between the gradients of two points that read_points() reads.
template <typename T>
int64_t gradient_step(const PolarSampleArgs<T>& a) {
  return a.tokens ? a.channels : round_up(a.channels, 4);
}

// Reads the gradients of points j to j + count of radius i. Planes are interleaved.
template <typename T>
void read_points(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t j, int64_t count,
                 T* to) {
  with_output_type(a, [&]<typename E>() {
    const Strides strides = output_strides(a);
    const E* from = static_cast<const E*>(a.grad_out) + output_start(a, b, i);
    if (a.tokens) {
      from += j / a.samples_a * strides.sector;
      for (int64_t sample = j % a.samples_a; count > 0; sample = 0, from += strides.sector) {
        const int64_t part = smaller(a.samples_a - sample, count), values = part * a.channels;
        copy(from + sample * a.channels, values, to);
        count -= part, to += values;
      }
      return;
    }
    const int64_t step = gradient_step(a);
    for (int64_t c = 0; c < a.channels; c += 4) {
      const E* plane[4];
      for (int64_t e = 0; e < 4; ++e) {  // further channels are read, but never used
        plane[e] = from + j + smaller(c + e, a.channels - 1) * strides.channel;
      }
      interleave<T>(plane, count, to + c, step);
    }
  });
}

}  // namespace
}  // namespace darswin
