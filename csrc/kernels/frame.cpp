// Samples of a frame at the places of a plan. polar_bytes.h does the work.
#include "polar_bytes.h"

namespace darswin {
namespace {

constexpr int64_t kAhead = 512;   // reads of a rig whose pixels are asked for before
constexpr int64_t kPart = 16384;  // pixels that stay in the cache while several loops write to them

// Samples points [first, first + count) of the places of `a` in an image.
template <typename Args>
void sample_block(const ByteImage& image, const Args& a, int64_t first, int64_t count,
                  ByteBlock& block) {
  const auto row_stride = static_cast<int32_t>(image.row_stride),
             column_stride = static_cast<int32_t>(image.column_stride);
#pragma omp simd
  for (int64_t k = 0; k < count; ++k) {
    block.offset[k] = a.rows[first + k] * row_stride + a.columns[first + k] * column_stride;
  }
  block.sample(image, a.right + first, a.lower + first, count);
}

// Rounds a sample to 8 bits. The sum of rounded weights may be a little above 1. All is computed
// outside of the condition: else compilers keep a branch, and take one sample at a time.
inline uint8_t to_byte(float sample) {
  const float more = sample + 0.5f;
  return static_cast<uint8_t>(more < 255 ? more : 255.0f);
}

// The place of channel c of a pixel among planes.
inline int64_t in_planes(const FrameTarget& to, int64_t pixel, int64_t c) {
  const int64_t picture = pixel / to.pixels;
  return (picture * to.channels + c) * to.pixels + pixel - picture * to.pixels;
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

// Writes samples of each channel, the pixels of a block in one picture.
void write_block(const FrameTarget& to, int64_t first, int64_t count,
                 const float (&samples)[3][kByteBlock]) {
  const int64_t channels = to.channels;
  if (to.output == FrameOutput::tokens && channels == 3) {
    return ByteBlock::interleave(samples[0], samples[1], samples[2], count,
                                 static_cast<float*>(to.out) + first * channels);
  }
  if (to.output != FrameOutput::bytes) {  // tokens of one channel too
    for (int64_t c = 0; c < channels; ++c) {
      copy(samples[c], count, static_cast<float*>(to.out) + in_planes(to, first, c));
    }
    return;
  }
  uint8_t bytes[3][kByteBlock];
  for (int64_t c = 0; c < channels; ++c) {
#pragma omp simd
    for (int64_t k = 0; k < count; ++k) bytes[c][k] = to_byte(samples[c][k]);
  }
  uint8_t* out = static_cast<uint8_t*>(to.out) + first * channels;
  if (channels == 1) {
    __builtin_memcpy(out, bytes[0], static_cast<size_t>(count));
  } else {
    ByteBlock::interleave(bytes[0], bytes[1], bytes[2], count, out);
  }
}

// Writes zeros to so many pixels of one picture.
void write_zeros(const FrameTarget& to, int64_t first, int64_t count) {
  const int64_t channels = to.channels;
  if (to.output == FrameOutput::planes) {
    float* plane = static_cast<float*>(to.out) + in_planes(to, first, 0);
    for (int64_t c = 0; c < channels; ++c) {
      __builtin_memset(plane + c * to.pixels, 0, static_cast<size_t>(count) * sizeof(float));
    }
    return;
  }
  const int64_t bytes = channels * (to.output == FrameOutput::bytes ? 1 : sizeof(float));
  __builtin_memset(static_cast<uint8_t*>(to.out) + first * bytes, 0,
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
    if (a.to.output == FrameOutput::planes) {
      static_cast<float*>(a.to.out)[in_planes(a.to, k, c)] = v;
    } else if (a.to.output == FrameOutput::tokens) {
      static_cast<float*>(a.to.out)[k * channels + c] = v;
    } else {
      static_cast<uint8_t*>(a.to.out)[k * channels + c] = to_byte(v);
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
      sample_block(a.image, a, before * a.reads, count * a.reads, block);
      if (a.reads > 1) average(a, count, block);
      write_block(a.to, pixel, count, block.samples);
    }
  };
  // A frame of one row or column has no four neighbours: all that it shows are border points.
  if (a.image.height > 1 && a.image.width > 1) for_runs(a.seen, begin, end, sample_run);
  for_runs(a.outside, begin, end,
           [&](int64_t pixel, int64_t last, int64_t) { write_zeros(a.to, pixel, last - pixel); });
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

// Asks for the pixels of reads [first, last), which most likely are of this image. Reads of a rig
// are far from each other, and without this the kernel waits for half of its time.
void fetch_ahead(const ByteImage& image, const RigArgs& a, int64_t first, int64_t last) {
  constexpr int kLevel = 2;  // the second-level cache
  for (int64_t k = first; k < last; k += 2) {
    const auto at = reinterpret_cast<uintptr_t>(image.pixels) + a.rows[k] * image.row_stride +
                    a.columns[k] * image.column_stride;
    __builtin_prefetch(reinterpret_cast<const void*>(at), 0, kLevel);
    __builtin_prefetch(reinterpret_cast<const void*>(at + image.row_stride), 0, kLevel);
  }
}

// Adds the weighted samples of a block to the sums of a group's pixels.
void add_block(const RigArgs& a, const RigRun& run, int64_t first, int64_t count,
               const ByteBlock& block, float (&sums)[3][kByteBlock]) {
  const float* weights = a.weights + first;
  const uint8_t* pixels = a.pixels + first;
  for (int64_t c = 0; c < a.to.channels; ++c) {
    const float* samples = block.samples[c];
    float* sum = sums[c] + (run.in_order ? pixels[0] : 0);
    if (run.in_order && run.unweighted) {
#pragma omp simd
      for (int64_t k = 0; k < count; ++k) sum[k] += samples[k];
    } else if (run.in_order) {
#pragma omp simd
      for (int64_t k = 0; k < count; ++k) sum[k] += weights[k] * samples[k];
    } else {
      for (int64_t k = 0; k < count; ++k) sum[pixels[k]] += weights[k] * samples[k];
    }
  }
}

void sample_rig(const RigArgs& a, int64_t begin, int64_t end) {
  alignas(64) ByteBlock block;
  alignas(64) float sums[3][kByteBlock];
  const int64_t reads = a.groups[end].read;
  for (const RigGroup* group = a.groups + begin; group < a.groups + end; ++group) {
    const int64_t count = group->end - group->begin;
    if (group->run == group[1].run) {
      write_zeros(a.to, group->begin, count);
      continue;
    }
    // A group of one block needs no sums.
    const bool alone = group->run + 1 == group[1].run && a.runs[group->run].in_order &&
                       a.runs[group->run].unweighted;
    for (int64_t c = 0; c < a.to.channels && !alone; ++c) {
      __builtin_memset(sums[c], 0, static_cast<size_t>(count) * sizeof(float));
    }
    int64_t read = group->read;
    for (const RigRun* run = a.runs + group->run; run < a.runs + group[1].run; ++run) {
      for (int64_t left = run->count, next; left > 0; left -= next, read += next) {
        next = smaller(kByteBlock, left);
        fetch_ahead(a.images[run->source], a, read + kAhead, smaller(read + kAhead + next, reads));
        sample_block(a.images[run->source], a, read, next, block);
        if (!alone) add_block(a, *run, read, next, block, sums);
      }
    }
    auto& found = alone ? block.samples : sums;
    for (int64_t c = 0; c < a.to.channels && a.to.output != FrameOutput::bytes; ++c) {
#pragma omp simd
      for (int64_t k = 0; k < count; ++k) found[c][k] = found[c][k] * a.scale[c] + a.offset[c];
    }
    write_block(a.to, group->begin, count, found);
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

TIER_TABLE(FrameKernels) = {.places = places, .sample = sample, .sample_rig = sample_rig};
TIER_TABLE(ReadKernels<uint8_t>) = {read_rows<1>, read_rows<3>, read_rows<4>};
TIER_TABLE(ReadKernels<float>) = {read_rows<1>, read_rows<3>, read_rows<4>};

}  // namespace darswin
