// The neighbours of a pixel in one row of the map are three pixels in a row, and they follow each
// other in memory. So the kernel of linear layers reads a token in three segments, and nobody has
// to collect it. It reads them from a copy of a few rows of the map, which has zeros around it and
// stays in the first-level cache. All that follows the product is done before the result leaves
// the cache.
#include "convolution.h"

#include <algorithm>

#include "../elements.h"
#include "dispatch.h"
#include "parallel.h"

namespace darswin {

void Convolution::run() const {
  constexpr int64_t kPixels = 64;          // of a piece of the map
  constexpr double kPerMicrosecond = 5e4;  // multiply-adds
  const int64_t depth = layer.depth, columns = layer.columns, panels = panel_count(columns);
  // A piece has some whole rows, or a part of one.
  const int64_t across = std::min(width, kPixels), down = kPixels / across;
  const int64_t wide = units(width, across), pieces = units(height, down) * wide;
  const int64_t pitch = (across + 2) * channels;
  const double work = static_cast<double>(batch) * height * width * depth * columns;
  const Threads threads = threads_for(work / kPerMicrosecond);
  // The threads share the columns too if there are few pixels.
  const int64_t parts = std::min(units(threads, batch * pieces), panels);
  const auto& elements = kernels<ElementKernels>();
  const auto each = [&](int64_t begin, int64_t end, void* memory) {
    auto* tokens = static_cast<float*>(memory);
    for (int64_t item = begin; item < end; ++item) {
      const int64_t b = item / parts / pieces, piece = item / parts % pieces, part = item % parts;
      const int64_t y = piece / wide * down, left = piece % wide * across;
      const int64_t rows = std::min(down, height - y), run = std::min(across, width - left);
      if (item == begin || part == 0) {
        copy_around(x + b * stride, y, left, rows, run, pitch, tokens);
      }
      const int64_t pixel = y * width + left, count = rows * run;
      float* const to = out + (b * height * width + pixel) * columns;
      const LinearArgs<float> args{.x = tokens,
                                   .packed = layer.packed,
                                   .rows = count,
                                   .depth = depth,
                                   .columns = columns,
                                   .stride = channels,
                                   .run = run,
                                   .pitch = pitch,
                                   .segments = 3,
                                   .after = after,
                                   .out = to};
      const int64_t first = panels * part / parts, last = panels * (part + 1) / parts;
      kernels<LinearKernels<float>>().rows(args, 0, count, first, last);
      if (summand == nullptr) continue;
      const float* from = summand + b * summand_stride + pixel * columns;
      const auto finish = [&](int64_t place, int64_t numbers) {
        elements.add(from + place, to + place, numbers);
        if (then == After::gelu) elements.gelu(to + place, numbers);
        if (then == After::relu) elements.relu(to + place, numbers);
      };
      if (parts == 1) {
        finish(0, count * columns);
        continue;
      }
      const int64_t column = first * kPanel, numbers = std::min(last * kPanel, columns) - column;
      for (int64_t k = 0; k < count; ++k) finish(k * columns + column, numbers);
    }
  };
  const int64_t floats = (down + 2) * pitch;
  run_with_scratch(batch * pieces * parts, threads, floats * static_cast<int64_t>(sizeof(float)),
                   each);
}

// Copies rows [y - 1, y + rows] and columns [x - 1, x + columns] of a map, with zeros around it.
void Convolution::copy_around(const float* map, int64_t y, int64_t x, int64_t rows, int64_t columns,
                              int64_t pitch, float* to) const {
  const int64_t first = std::max<int64_t>(x - 1, 0), last = std::min(x + columns + 1, width);
  for (int64_t row = y - 1; row <= y + rows; ++row, to += pitch) {
    float *const begin = to + (first - x + 1) * channels, *end = to;
    if (row >= 0 && row < height) {
      std::fill(to, begin, 0.0f);
      end = std::copy_n(map + (row * width + first) * channels, (last - first) * channels, begin);
    }
    std::fill(end, to + (columns + 2) * channels, 0.0f);
  }
}

}  // namespace darswin
