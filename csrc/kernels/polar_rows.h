// Reads and writes rows of samples in the operator's output or its gradient. A row holds all points
// of one radius.
#pragma once

#include "polar_image.h"

namespace darswin {
namespace {

// The layout of a row. Channel c of point (sector, s) is at first + sector * sector_stride + s *
// sample_stride + c * channel_stride.
struct Row {
  int64_t first, sector_stride, sample_stride, channel_stride;
};

template <typename T>
Row output_row(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
  if (!a.tokens) {
    const int64_t plane = a.num_radii * a.num_azimuths;
    return {b * a.channels * plane + i * a.num_azimuths, a.samples_a, 1, plane};
  }
  const int64_t rings = a.num_radii / a.samples_r, sectors = a.num_azimuths / a.samples_a;
  const int64_t piece = a.samples_a * a.channels, token = a.samples_r * piece;
  const int64_t ring = b * rings + i / a.samples_r;
  return {ring * sectors * token + i % a.samples_r * piece, token, a.channels, 1};
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

// Writes (num_azimuths, C) samples to a row of the output.
template <typename T>
void write_row(const PolarSampleArgs<T>& a, const Row& row, const T* samples) {
  with_output_type(a, [&]<typename E>() {
    E* out = static_cast<E*>(a.out) + row.first;
    const int64_t piece = a.samples_a * a.channels;
    if (a.tokens) {
      for (int64_t sector = 0; sector * a.samples_a < a.num_azimuths; ++sector) {
        copy(samples + sector * piece, piece, out + sector * row.sector_stride);
      }
      return;
    }
    for (int64_t c = 0; c < a.channels; ++c) {
      E* to = out + c * row.channel_stride;
      const T* from = samples + c;
      if (a.channels == 3) {  // a constant stride becomes shuffles
#pragma omp simd
        for (int64_t j = 0; j < a.num_azimuths; ++j) store(to + j, from[j * 3]);
      } else {
        for (int64_t j = 0; j < a.num_azimuths; ++j) store(to + j, from[j * a.channels]);
      }
    }
  });
}

// Reads a row of gradients as (num_azimuths, C).
template <typename T>
void read_row(const PolarSampleArgs<T>& a, const Row& row, T* to) {
  with_output_type(a, [&]<typename E>() {
    const E* from = static_cast<const E*>(a.grad_out) + row.first;
    const int64_t piece = a.samples_a * a.channels;
    for (int64_t j = 0; j < a.num_azimuths; j += a.samples_a, from += row.sector_stride) {
      T* sector = to + j * a.channels;
      if (row.channel_stride == 1) {
        copy(from, piece, sector);
        continue;
      }
      for (int64_t s = 0; s < a.samples_a; ++s) {
        for (int64_t c = 0; c < a.channels; ++c) {
          sector[s * a.channels + c] =
              load<T>(from + s * row.sample_stride + c * row.channel_stride);
        }
      }
    }
  });
}

}  // namespace
}  // namespace darswin
