// Samples of a frame at the places of a plan. polar_bytes.h does the work.
#include "polar_bytes.h"

namespace darswin {
namespace {

// Finds the offsets of points [first, first + count).
void find_offsets(const FrameArgs& a, int64_t first, int64_t count, int32_t* offset) {
  const auto row_stride = static_cast<int32_t>(a.image.row_stride),
             column_stride = static_cast<int32_t>(a.image.column_stride);
#pragma omp simd
  for (int64_t k = 0; k < count; ++k) {
    offset[k] = a.rows[first + k] * row_stride + a.columns[first + k] * column_stride;
  }
}

// Rounds a sample to 8 bits. The sum of rounded weights may be a little above 1.
inline uint8_t to_byte(float sample) {
  return static_cast<uint8_t>(sample < 255 ? sample + 0.5f : 255.0f);
}

// The place of channel c of a pixel among planes.
inline int64_t in_planes(const FrameArgs& a, int64_t pixel, int64_t c) {
  const int64_t picture = pixel / a.pixels;
  return (picture * a.image.channels + c) * a.pixels + pixel - picture * a.pixels;
}

// Replaces the samples of a block by the mean of each pixel's.
void average(const FrameArgs& a, int64_t count, ByteBlock& block) {
  const float share = 1.0f / static_cast<float>(a.reads);
  for (int64_t c = 0; c < a.image.channels; ++c) {
    for (int64_t k = 0; k < count; ++k) {
      float sum = 0;
      for (int64_t r = 0; r < a.reads; ++r) sum += block.samples[c][k * a.reads + r];
      block.samples[c][k] = sum * share;
    }
  }
}

// Writes the pixels of a block, which are in one picture, to the output.
void write_block(const FrameArgs& a, int64_t first, int64_t count, const ByteBlock& block) {
  const int64_t channels = a.image.channels;
  if (a.output == FrameOutput::tokens) {
    return block.write(channels, count, static_cast<float*>(a.out) + first * channels);
  }
  if (a.output == FrameOutput::planes) {
    for (int64_t c = 0; c < channels; ++c) {
      copy(block.samples[c], count, static_cast<float*>(a.out) + in_planes(a, first, c));
    }
    return;
  }
  uint8_t bytes[3][kByteBlock];
  for (int64_t c = 0; c < channels; ++c) {
#pragma omp simd
    for (int64_t k = 0; k < count; ++k) bytes[c][k] = to_byte(block.samples[c][k]);
  }
  uint8_t* to = static_cast<uint8_t*>(a.out) + first * channels;
  if (channels == 1) {
    __builtin_memcpy(to, bytes[0], static_cast<size_t>(count));
  } else {
    ByteBlock::interleave(bytes[0], bytes[1], bytes[2], count, to);
  }
}

// Writes the pixel whose points begin at this one of `border`.
void write_border(const FrameArgs& a, const BorderPoint* points) {
  const int64_t channels = a.image.channels, k = points->index / a.reads;
  for (int64_t c = 0; c < channels; ++c) {
    float v = 0;
    for (int64_t r = 0; r < a.reads; ++r) {
      const BorderPoint& p = points[r];
      v += border_sample(a.image, p.column, p.row, p.right, p.lower, c);
    }
    v *= 1.0f / static_cast<float>(a.reads);
    if (a.output == FrameOutput::planes) {
      static_cast<float*>(a.out)[in_planes(a, k, c)] = v;
    } else if (a.output == FrameOutput::tokens) {
      static_cast<float*>(a.out)[k * channels + c] = v;
    } else {
      static_cast<uint8_t*>(a.out)[k * channels + c] = to_byte(v);
    }
  }
}

void sample(const FrameArgs& a, int64_t begin, int64_t end) {
  alignas(64) ByteBlock block;
  // A frame of one row or column has no four neighbours: all its points are border points.
  const bool neighbours = a.image.height > 1 && a.image.width > 1;
  const int64_t most = kByteBlock / a.reads, last = end / a.reads;
  for (int64_t pixel = begin / a.reads, count; pixel < last && neighbours; pixel += count) {
    count = smaller(smaller(most, last - pixel), a.pixels - pixel % a.pixels);
    const int64_t first = pixel * a.reads;
    find_offsets(a, first, count * a.reads, block.offset);
    block.sample(a.image, a.right + first, a.lower + first, count * a.reads);
    if (a.reads > 1) average(a, count, block);
    write_block(a, pixel, count, block);
  }
  int64_t low = 0, high = a.border_points;  // finds the first border point from `begin` on
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    a.border[middle].index < begin ? low = middle + 1 : high = middle;
  }
  for (; low < a.border_points && a.border[low].index < end; low += a.reads) {
    write_border(a, a.border + low);
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
      points.find_direct<true>(a, strides, 0, i, j, count, 0);
      for (int64_t k = 0; k < count; ++k) {
        columns[to + k] = static_cast<int16_t>(points.direct.column[k]);
        rows[to + k] = static_cast<int16_t>(points.direct.row[k]);
        right[to + k] = points.direct.right[k];
        lower[to + k] = points.direct.lower[k];
      }
    }
  }
}

}  // namespace

TIER_TABLE(FrameKernels) = {.places = places, .sample = sample};

}  // namespace darswin
