// A row of samples is all points of one radius: where the operator's output, or its gradient, holds
// them.
#pragma once

#include "polar_image.h"

namespace darswin {
namespace {

// Point (sector, s), channel c, of a row lies at
// first + sector * sector_stride + s * sample_stride + c * channel_stride.
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

// Room for one row, of pixels padded to four channels.
template <typename T>
int64_t row_bytes(const PolarSampleArgs<T>& a) {
  return round_up((a.num_azimuths * round_up(a.channels, 4) + 16) * sizeof(T), 64);
}

// Writes (num_azimuths, C) samples to a row of the output, of type E.
template <typename T, typename E>
void write_row(const PolarSampleArgs<T>& a, const Row& row, const T* samples, E* out) {
  out += row.first;
  const int64_t piece = a.samples_a * a.channels;
  if (a.tokens) {
    for (int64_t sector = 0; sector * a.samples_a < a.num_azimuths; ++sector) {
      E* to = out + sector * row.sector_stride;
      const T* from = samples + sector * piece;
      copy(from, piece, to);
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
}

template <typename T>
void write_row(const PolarSampleArgs<T>& a, const Row& row, const T* samples) {
  if constexpr (sizeof(T) == sizeof(float)) {
    if (a.narrow) return write_row(a, row, samples, static_cast<bfloat16*>(a.out));
  }
  write_row(a, row, samples, static_cast<T*>(a.out));
}

// Reads a row of gradients of type E as (num_azimuths, C).
template <typename T, typename E>
void read_row(const PolarSampleArgs<T>& a, const E* grad, const Row& row, T* to) {
  grad += row.first;
  const int64_t piece = a.samples_a * a.channels;
  for (int64_t sector = 0; sector * a.samples_a < a.num_azimuths; ++sector, to += piece) {
    const E* from = grad + sector * row.sector_stride;
    if (row.channel_stride != 1) {
      for (int64_t s = 0; s < a.samples_a; ++s) {
        for (int64_t c = 0; c < a.channels; ++c) {
          to[s * a.channels + c] = load<T>(from + s * row.sample_stride + c * row.channel_stride);
        }
      }
    } else {
      copy(from, piece, to);
    }
  }
}

template <typename T>
void read_row(const PolarSampleArgs<T>& a, const void* grad, const Row& row, T* to) {
  if constexpr (sizeof(T) == sizeof(float)) {
    if (a.narrow) return read_row(a, static_cast<const bfloat16*>(grad), row, to);
  }
  read_row(a, static_cast<const T*>(grad), row, to);
}

}  // namespace
}  // namespace darswin
