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

// Calls use<E>(), where E is the type of the output or of its gradient.
template <typename T, typename Use>
void with_output_type(const PolarSampleArgs<T>& a, Use use) {
  if constexpr (is_same_v<T, float>) {
    if (a.narrow) return use.template operator()<bfloat16>();
  }
  use.template operator()<T>();
}

// Writes the samples of a radius to the output: (num_azimuths, C) for tokens, else (C,
// num_azimuths).
template <typename T>
void write_row(const PolarSampleArgs<T>& a, int64_t b, int64_t i, const T* samples) {
  with_output_type(a, [&]<typename E>() {
    const Strides strides = output_strides(a);
    E* out = static_cast<E*>(a.out) + output_start(a, b, i);
    const int64_t piece = a.tokens ? strides.row : a.num_azimuths;
    const int64_t step = a.tokens ? strides.sector : strides.channel;
    for (int64_t values = a.num_azimuths * a.channels; values > 0; values -= piece) {
      copy(samples, piece, out);
      samples += piece, out += step;
    }
  });
}

// Reads the gradients of a radius as (num_azimuths, C).
template <typename T>
void read_row(const PolarSampleArgs<T>& a, int64_t b, int64_t i, T* to) {
  with_output_type(a, [&]<typename E>() {
    const Strides strides = output_strides(a);
    const E* from = static_cast<const E*>(a.grad_out) + output_start(a, b, i);
    if (a.tokens) {
      for (int64_t j = 0; j < a.num_azimuths; j += a.samples_a) {
        copy(from, strides.row, to);
        from += strides.sector, to += strides.row;
      }
      return;
    }
    for (int64_t j = 0; j < a.num_azimuths; ++j) {
      for (int64_t c = 0; c < a.channels; ++c) {
        to[j * a.channels + c] = load<T>(from + j + c * strides.channel);
      }
    }
  });
}

}  // namespace
}  // namespace darswin
