// Samples of a frame at the places of a plan. polar_bytes.h does the work.
#include "polar_bytes.h"

namespace darswin {
namespace {

constexpr int64_t kPart = 16384;  // pixels that stay in the cache while several loops write to them

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

// Writes zeros to so many pixels of one picture.
void write_zeros(const FrameArgs& a, int64_t first, int64_t count) {
  const int64_t channels = a.image.channels;
  if (a.output == FrameOutput::planes) {
    float* plane = static_cast<float*>(a.out) + in_planes(a, first, 0);
    for (int64_t c = 0; c < channels; ++c) {
      __builtin_memset(plane + c * a.pixels, 0, static_cast<size_t>(count) * sizeof(float));
    }
    return;
  }
  const int64_t bytes = channels * (a.output == FrameOutput::bytes ? 1 : sizeof(float));
  __builtin_memset(static_cast<uint8_t*>(a.out) + first * bytes, 0,
                   static_cast<size_t>(count * bytes));
}

// Writes the pixel whose points begin at this one of `border`.
void write_border(const FrameArgs& a, const BorderPoint* points) {
  const int64_t channels = a.image.channels, k = points->pixel;
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

// The first of so many items for which the condition holds. It holds for all items after that.
template <typename Item, typename Condition>
const Item* first_of(const Item* items, int64_t count, Condition condition) {
  int64_t low = 0;
  while (low < count) {
    const int64_t middle = (low + count) / 2;
    condition(items[middle]) ? count = middle : low = middle + 1;
  }
  return items + low;
}

// Calls body(pixel, last, before) for the parts [pixel, last) of runs that are in [begin, end),
// with so many pixels of the runs before.
template <typename Body>
void for_runs(const PixelRuns& all, int64_t begin, int64_t end, Body body) {
  const PixelRun* last = all.runs + all.count;
  const auto reaches = [&](const PixelRun& run) { return run.end > begin; };
  for (const PixelRun* run = first_of(all.runs, all.count, reaches); run < last && run->begin < end;
       ++run) {
    const int64_t first = run->begin > begin ? run->begin : begin;
    body(first, smaller(run->end, end), run->before + first - run->begin);
  }
}

// Samples pixels [begin, end). What lies outside in short gaps is sampled first, and then zero.
void sample_part(const FrameArgs& a, int64_t begin, int64_t end, ByteBlock& block) {
  const int64_t most = kByteBlock / a.reads;
  const auto sample_run = [&](int64_t pixel, int64_t last, int64_t before) {
    for (int64_t count; pixel < last; pixel += count, before += count) {
      count = smaller(most, last - pixel);
      const int64_t first = before * a.reads;
      find_offsets(a, first, count * a.reads, block.offset);
      block.sample(a.image, a.right + first, a.lower + first, count * a.reads);
      if (a.reads > 1) average(a, count, block);
      write_block(a, pixel, count, block);
    }
  };
  // A frame of one row or column has no four neighbours: all that it shows are border points.
  if (a.image.height > 1 && a.image.width > 1) for_runs(a.seen, begin, end, sample_run);
  for_runs(a.outside, begin, end,
           [&](int64_t pixel, int64_t last, int64_t) { write_zeros(a, pixel, last - pixel); });
  const BorderPoint* last = a.border + a.border_points;
  const auto is_in = [&](const BorderPoint& point) { return point.pixel >= begin; };
  for (const BorderPoint* point = first_of(a.border, a.border_points, is_in);
       point < last && point->pixel < end; point += a.reads) {
    write_border(a, point);
  }
}

void sample(const FrameArgs& a, int64_t begin, int64_t end) {
  alignas(64) ByteBlock block;
  for (int64_t next; begin < end; begin = next) {
    next = smaller(begin + kPart, end);
    sample_part(a, begin, next, block);
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

// Adds `kCount` channels of a picture at a point to their sum.
template <int kCount, typename T>
void add_point(const ReadArgs<T>& a, const T* picture, float x, float y, float* sum) {
  const int height = static_cast<int>(a.height), width = static_cast<int>(a.width);
  if (!(x > -1 && x < static_cast<float>(width) && y > -1 && y < static_cast<float>(height))) {
    return;  // NaN too
  }
  // The floor. That of x + 1 may round to another pixel, below a power of 2.
  const int column = x < 0 ? -1 : static_cast<int>(x), row = y < 0 ? -1 : static_cast<int>(y);
  const float right = x - static_cast<float>(column), lower = y - static_cast<float>(row);
  float across[] = {1 - right, right}, down[] = {1 - lower, lower};
  int64_t next = a.channels, below = a.width * a.channels;
  const T* upper = picture + row * below + column * next;
  // A neighbour outside has no weight, and the one inside is read in its place.
  if (column < 0 || column + 1 >= width) {
    if (column < 0) across[0] = 0, upper += next;
    if (column + 1 >= width) across[1] = 0;
    next = 0;
  }
  if (row < 0 || row + 1 >= height) {
    if (row < 0) down[0] = 0, upper += below;
    if (row + 1 >= height) down[1] = 0;
    below = 0;
  }
  const T* under = upper + below;
  for (int c = 0; c < kCount; ++c) {
    sum[c] += down[0] * (across[0] * upper[c] + across[1] * upper[next + c]) +
              down[1] * (across[0] * under[c] + across[1] * under[next + c]);
  }
}

// Reads `kCount` channels at once.
template <int kCount, typename T>
void read_rows(const ReadArgs<T>& a, int64_t rows) {
  const float share = 1.0f / static_cast<float>(a.reads * a.reads);
  T* to = a.to;
  for (int64_t y = 0; y < rows; ++y) {
    for (int64_t x = 0; x < a.columns; ++x) {
      const float* points = a.points + 2 * (y * a.reads * a.columns + x) * a.reads;
      for (int64_t channel = 0; channel < a.channels; channel += kCount, to += kCount) {
        float sum[kCount] = {};
        for (int64_t k = 0; k < a.reads; ++k) {
          const float* point = points + 2 * k * a.columns * a.reads;
          for (int64_t i = 0; i < a.reads; ++i, point += 2) {
            add_point<kCount>(a, a.picture + channel, point[0], point[1], sum);
          }
        }
        for (int c = 0; c < kCount; ++c) {
          const float mean = sum[c] * share;
          to[c] = static_cast<T>(sizeof(T) == 1 ? to_byte(mean) : mean);
        }
      }
    }
  }
}

}  // namespace

TIER_TABLE(FrameKernels) = {.places = places, .sample = sample};
TIER_TABLE(ReadKernels<uint8_t>) = {read_rows<1>, read_rows<3>, read_rows<4>};
TIER_TABLE(ReadKernels<float>) = {read_rows<1>, read_rows<3>, read_rows<4>};

}  // namespace darswin
