// Runs the instructions of a network.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <string>

#include "../elements.h"
#include "convolution.h"
#include "dispatch.h"
#include "network.h"
#include "parallel.h"
#include "to_image.h"

namespace darswin {
namespace {

// Blocks process a large batch in parts. A part is so small that its widest tokens stay below this
// size, in the caches.
constexpr int64_t kPartBytes = int64_t{16} << 20;
constexpr double kCopiesPerMicrosecond = 2000;  // numbers
constexpr int64_t kChunk = 4096;                // numbers that a thread takes at once

// Calls body(begin, end) on ranges of items that cost so many numbers each.
template <typename Body>
void share(int64_t items, int64_t numbers, Body body) {
  const double work = static_cast<double>(items) * numbers;
  parallel_ranges(items, threads_for(work / kCopiesPerMicrosecond), body);
}

// Bilinear weights and places of one axis.
struct Between {
  int64_t first, second;
  float part;  // of the second
};

Between between(int64_t k, int64_t size, int64_t from) {
  const float place =
      std::max((static_cast<float>(k) + 0.5f) * (static_cast<float>(from) / size) - 0.5f, 0.0f);
  const auto first = std::min(static_cast<int64_t>(place), from - 1);
  return {first, std::min(first + 1, from - 1), place - static_cast<float>(first)};
}

// Writes the channels of a map (height, width, channels) at a pixel (x, y), 0 outside.
void sample_at(const float* map, int64_t height, int64_t width, int64_t channels, float x, float y,
               float* out) {
  // NaN is outside too.
  if (!(x > -1 && x < static_cast<float>(width) && y > -1 && y < static_cast<float>(height))) {
    std::fill_n(out, channels, 0.0f);
    return;
  }
  const float left = std::floor(x), top = std::floor(y);
  const float right_part = x - left, lower_part = y - top;
  const auto column = static_cast<int64_t>(left), row = static_cast<int64_t>(top);
  const float* corners[4];
  float parts[4];
  for (int64_t corner = 0; corner < 4; ++corner) {
    const int64_t i = row + corner / 2, j = column + corner % 2;
    const bool inside = i >= 0 && i < height && j >= 0 && j < width;
    corners[corner] = map + (inside ? (i * width + j) * channels : 0);
    parts[corner] = inside ? (corner / 2 == 1 ? lower_part : 1 - lower_part) *
                                 (corner % 2 == 1 ? right_part : 1 - right_part)
                           : 0;
  }
  kernels<ElementKernels>().mix(corners, parts, out, channels);
}

}  // namespace

// One run: where the numbers of each slot are.
struct Network::Run {
  const Network& network;
  int64_t batch;
  std::vector<const float*> from;
  std::vector<float*> to;     // null for inputs
  std::vector<int64_t> rows;  // batch, or 1 for all images

  int64_t numbers(int64_t slot) const { return network.numbers(slot); }
  // The numbers from one image to the next.
  int64_t stride(int64_t slot) const { return rows[slot] == 1 ? 0 : numbers(slot); }
  const float* image(int64_t slot, int64_t b) const { return from[slot] + b * stride(slot); }
  float* result(int64_t slot, int64_t b) const { return to[slot] + b * numbers(slot); }
  // The numbers of a slot, with a row for each image.
  const float* all(int64_t slot) const {
    if (rows[slot] != batch) {
      throw std::invalid_argument("input " + std::to_string(slot) +
                                  " must have a row for each image");
    }
    return from[slot];
  }

  void linear(const Step& step, void* scratch) const {
    const int64_t* a = step.arguments;
    const int64_t count = batch * a[2];
    const void* tokens = all(a[0]);
    if (step.norm.dim > 0) {
      normalize(all(a[0]), count, step.norm, scratch, &step.layer);
      tokens = scratch;
    }
    multiply(tokens, count, step.layer, to[a[1]], a[8] != 0 ? After::gelu : After::nothing);
  }

  // Consecutive blocks of one map, part by part of the batch.
  void blocks(const Step* begin, const Step* end, void* scratch) const {
    const int64_t slot = begin->arguments[0];
    int64_t most = batch;
    for (const Step* step = begin; step != end; ++step) most = std::min(most, part(*step));
    const int64_t parts = units(batch, most);
    for (int64_t k = 0; k < parts; ++k) {
      const int64_t first = batch * k / parts, count = batch * (k + 1) / parts - first;
      for (const Step* step = begin; step != end; ++step) {
        const int64_t table = step->arguments[22];
        step->block.run(result(slot, first), count, image(table, first),
                        rows[table] == 1 ? 1 : count, scratch);
      }
    }
  }
  int64_t part(const Step& step) const {
    const auto& block = step.block;
    const int64_t tokens = block.windows.rings * block.windows.sectors;
    const int64_t widest = std::max(block.qkv.columns, block.fc1.columns);
    const int64_t bytes = tokens * widest * static_cast<int64_t>(sizeof(float));
    return std::clamp<int64_t>(kPartBytes / bytes, 1, batch);
  }
  int64_t scratch(const Step& step) const {
    const int64_t* a = step.arguments;
    if (step.opcode == Opcode::linear && step.norm.dim > 0) {
      return batch * a[2] * a[3] * static_cast<int64_t>(sizeof(float)) + kSpare;
    }
    return step.opcode == Opcode::block ? step.block.scratch(part(step) * a[1] * a[2]) : 0;
  }

  // The two inner axes are a matrix, of which a thread takes a piece at once.
  void copy(const int64_t* a) const {
    const int64_t *sizes = a + 4, *reads = sizes + kCopyAxes, *writes = reads + kCopyAxes;
    const int64_t height = sizes[3], width = sizes[4];
    const int64_t across = std::min(width, kChunk), down = std::max(kChunk / across, int64_t{1});
    const int64_t wide = units(width, across), pieces = units(height, down) * wide;
    const int64_t outer = sizes[0] * sizes[1] * sizes[2];
    share(batch * outer * pieces, across * std::min(down, height), [&](int64_t begin, int64_t end) {
      for (int64_t item = begin; item < end; ++item) {
        const int64_t b = item / (outer * pieces), piece = item % pieces;
        const int64_t y = piece / wide * down, x = piece % wide * across;
        const float* source = image(a[0], b) + a[2] + y * reads[3] + x * reads[4];
        float* target = result(a[1], b) + a[3] + y * writes[3] + x * writes[4];
        int64_t place = item / pieces % outer;
        for (int axis = 2; axis >= 0; --axis) {
          const int64_t k = place % sizes[axis];
          place /= sizes[axis];
          source += k * reads[axis], target += k * writes[axis];
        }
        const int64_t rows = std::min(down, height - y), columns = std::min(across, width - x);
        for (int64_t row = 0; row < rows; ++row, source += reads[3], target += writes[3]) {
          if (reads[4] == 1 && writes[4] == 1) {
            std::memcpy(target, source, columns * sizeof(float));
          } else {
            for (int64_t k = 0; k < columns; ++k) target[k * writes[4]] = source[k * reads[4]];
          }
        }
      }
    });
  }

  void add(const int64_t* a) const {
    const int64_t count = numbers(a[1]), parts = units(count, kChunk);
    const auto& kernel = kernels<ElementKernels>();
    share(batch * parts, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t item = begin; item < end; ++item) {
        const int64_t b = item / parts, first = item % parts * kChunk;
        kernel.add(image(a[0], b) + first, result(a[1], b) + first,
                   std::min(kChunk, count - first));
      }
    });
  }

  // The rows are added one after the other.
  void mean(const int64_t* a) const {
    const auto& kernel = kernels<ElementKernels>();
    for (int64_t b = 0; b < batch; ++b) {
      const float* x = image(a[0], b);
      float* out = result(a[1], b);
      std::copy_n(x, a[3], out);
      for (int64_t row = 1; row < a[2]; ++row) kernel.add(x + row * a[3], out, a[3]);
      for (int64_t k = 0; k < a[3]; ++k) out[k] /= static_cast<float>(a[2]);
    }
  }

  // Calls body(b, y) for each row of pixels of each image.
  template <typename Body>
  void rows_of_pixels(int64_t height, int64_t numbers, Body body) const {
    share(batch * height, numbers, [&](int64_t begin, int64_t end) {
      for (int64_t item = begin; item < end; ++item) body(item / height, item % height);
    });
  }

  void conv(const Step& step) const {
    const int64_t* a = step.arguments;
    Convolution{.x = from[a[0]],
                .stride = stride(a[0]),
                .batch = batch,
                .height = a[2],
                .width = a[3],
                .channels = a[4],
                .layer = step.layer,
                .after = step.after,
                .summand = step.summand < 0 ? nullptr : from[step.summand],
                .summand_stride = step.summand < 0 ? 0 : stride(step.summand),
                .then = step.then,
                .out = to[a[1]]}
        .run();
  }

  void resize(const int64_t* a) const {
    const int64_t height = a[2], width = a[3], rows = a[4], columns = a[5], channels = a[6];
    const auto& kernel = kernels<ElementKernels>();
    rows_of_pixels(rows, columns * channels * 4, [&](int64_t b, int64_t y) {
      const Between down = between(y, rows, height);
      const float* x = image(a[0], b);
      const float *upper = x + down.first * width * channels,
                  *lower = x + down.second * width * channels;
      float* out = result(a[1], b) + y * columns * channels;
      for (int64_t k = 0; k < columns; ++k, out += channels) {
        const Between across = between(k, columns, width);
        const float* corners[] = {upper + across.first * channels, upper + across.second * channels,
                                  lower + across.first * channels,
                                  lower + across.second * channels};
        const float left = 1 - across.part, top = 1 - down.part;
        const float parts[] = {top * left, top * across.part, down.part * left,
                               down.part * across.part};
        kernel.mix(corners, parts, out, channels);
      }
    });
  }

  void pool(const int64_t* a) const {
    const int64_t height = a[2], width = a[3], channels = a[4];
    const int64_t rows = units(height, 2), columns = units(width, 2);
    const auto& kernel = kernels<ElementKernels>();
    rows_of_pixels(rows, columns * channels * 4, [&](int64_t b, int64_t y) {
      float* out = result(a[1], b) + y * columns * channels;
      for (int64_t row = 2 * y; row < std::min(2 * y + 2, height); ++row) {
        const float* x = image(a[0], b) + row * width * channels;
        for (int64_t k = 0; k < width; ++k) {
          float* to = out + k / 2 * channels;
          if (row == 2 * y && k % 2 == 0) {
            std::copy_n(x + k * channels, channels, to);
          } else {
            kernel.largest(x + k * channels, to, channels);
          }
        }
      }
    });
  }

  void sample(const int64_t* a) const {
    const int64_t height = a[2], width = a[3], rows = a[4], columns = a[5], channels = a[6];
    rows_of_pixels(rows, columns * channels * 4, [&](int64_t b, int64_t y) {
      const float *x = image(a[0], b), *points = image(a[7], b) + y * columns * 2;
      float* out = result(a[1], b) + y * columns * channels;
      for (int64_t k = 0; k < columns; ++k, out += channels, points += 2) {
        sample_at(x, height, width, channels, points[0], points[1], out);
      }
    });
  }

  void to_image(const int64_t* a) const {
    PolarToImageArgs<float> args{};
    args.x = all(a[0]), args.plan = from[a[7]], args.plans = rows[a[7]];
    args.radii_rows = args.place_rows = args.r_max_rows = 1;
    args.batch = batch, args.rings = a[2], args.sectors = a[3], args.channels = a[4];
    args.height = a[5], args.width = a[6], args.tokens = true;
    args.out = to[a[1]], args.lenses = 1;
    run_polar_to_image(args);
  }

  // Applies a function of numbers to a slot, in place.
  template <typename Apply>
  void each(int64_t slot, Apply apply) const {
    const int64_t count = batch * numbers(slot);
    share(units(count, kChunk), 4 * kChunk, [&](int64_t begin, int64_t end) {
      apply(to[slot] + begin * kChunk, std::min(end * kChunk, count) - begin * kChunk);
    });
  }

  void run(const Step& step, void* scratch) const {
    const int64_t* a = step.arguments;
    const auto& kernel = kernels<ElementKernels>();
    switch (step.opcode) {
      case Opcode::linear:
        return linear(step, scratch);
      case Opcode::norm:
        return normalize(all(a[0]), batch * a[2], step.norm, to[a[1]]);
      case Opcode::block:
        return blocks(&step, &step + 1, scratch);
      case Opcode::copy:
        return copy(a);
      case Opcode::add:
        return add(a);
      case Opcode::mean:
        return mean(a);
      case Opcode::apply:
        return each(a[0], static_cast<After>(a[1]) == After::gelu ? kernel.gelu : kernel.relu);
      case Opcode::conv:
        return conv(step);
      case Opcode::resize:
        return resize(a);
      case Opcode::sample:
        return sample(a);
      case Opcode::to_image:
        return to_image(a);
      case Opcode::distance:
        return each(a[0], [&](float* x, int64_t n) {
          kernel.distance(x, n, std::bit_cast<float>(static_cast<int32_t>(a[1])));
        });
      case Opcode::pool:
        return pool(a);
    }
  }
};

void Network::run(int64_t batch, const Input* given, float* const* results) const {
  if (batch == 0) return;
  if (batch > kMostNumbers / total) throw std::invalid_argument("the batch is too large");
  Run run{*this, batch, std::vector<const float*>(slots()), std::vector<float*>(slots()),
          std::vector<int64_t>(slots(), batch)};
  for (int64_t k = 0; k < input_count(); ++k) {
    if (given[k].rows != 1 && given[k].rows != batch) {
      throw std::invalid_argument("input " + std::to_string(k) +
                                  " must have a row for each image, or one for all");
    }
    run.from[k] = given[k].data, run.rows[k] = given[k].rows;
  }
  for (int64_t k = 0; k < output_count(); ++k) run.to[outputs[k].slot] = results[k];
  int64_t bytes = 0, scratch_bytes = 0;
  const auto size = [&](int64_t slot) {
    return round_up(batch * run.numbers(slot) * static_cast<int64_t>(sizeof(float)), 64);
  };
  for (int64_t slot = input_count(); slot < slots(); ++slot) {
    if (run.to[slot] == nullptr) bytes += size(slot);
  }
  for (const Step& step : steps) scratch_bytes = std::max(scratch_bytes, run.scratch(step));
  // The kernels of this thread use memory of their own at the same time.
  const ThreadMemoryOf<1> memory(bytes);
  const ThreadMemoryOf<2> scratch(scratch_bytes);
  auto* next = static_cast<char*>(memory.get());
  for (int64_t slot = input_count(); slot < slots(); ++slot) {
    if (run.to[slot] == nullptr) {
      run.to[slot] = reinterpret_cast<float*>(next);
      next += size(slot);
    }
    run.from[slot] = run.to[slot];
  }
  for (size_t k = 0; k < steps.size();) {
    size_t end = k + 1;
    if (steps[k].opcode == Opcode::block) {
      while (end < steps.size() && steps[end].opcode == Opcode::block &&
             steps[end].arguments[0] == steps[k].arguments[0]) {
        ++end;
      }
      run.blocks(&steps[k], &steps[k] + (end - k), scratch.get());
    } else {
      run.run(steps[k], scratch.get());
    }
    k = end;
  }
}

}  // namespace darswin
