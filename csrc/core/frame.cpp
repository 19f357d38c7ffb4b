#include "frame.h"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "dispatch.h"
#include "parallel.h"

namespace darswin {
namespace {

constexpr int64_t kMostReads = 16;  // along a side of a pixel: all points fit one block
constexpr int64_t kShortGap = 8;    // points: to sample them takes less than to skip them

int64_t length(const std::vector<PixelRun>& runs) {
  return runs.empty() ? 0 : runs.back().before + runs.back().end - runs.back().begin;
}

// Adds a pixel to the last run if at most `gap` pixels lie between, in the picture that begins with
// `first`. Else the pixel begins a run.
void add(int64_t pixel, int64_t first, int64_t gap, std::vector<PixelRun>& runs) {
  if (!runs.empty() && runs.back().begin >= first && pixel - runs.back().end <= gap) {
    runs.back().end = pixel + 1;
  } else {
    runs.push_back({pixel, pixel + 1, length(runs)});
  }
}

PixelRuns runs_of(const std::vector<PixelRun>& runs) {
  return {runs.data(), static_cast<int64_t>(runs.size())};
}

std::string shown(int64_t height, int64_t width) {
  return "(" + std::to_string(height) + ", " + std::to_string(width) + ")";
}

}  // namespace

void check_frame(const Frame& frame, int64_t height, int64_t width, size_t channels,
                 const std::string& what) {
  if (frame.height != height || frame.width != width) {
    throw std::invalid_argument(what + " must be of the plan's size, (H, W) = " +
                                shown(height, width) + ", got " + shown(frame.height, frame.width));
  }
  const bool known = frame.channels == 1 || frame.channels == 3;
  if (!known || (channels > 1 && frame.channels != static_cast<int64_t>(channels))) {
    throw std::invalid_argument(what + " must have the plan's " + std::to_string(channels) +
                                " channels, got " + std::to_string(frame.channels));
  }
  const auto span = [](int64_t size, int64_t stride) {
    return static_cast<double>(size - 1) * std::abs(static_cast<double>(stride));
  };
  if (span(height, frame.row_stride) + span(width, frame.column_stride) >= INT32_MAX) {
    throw std::invalid_argument(what + " must span less than 2 GB of memory");
  }
}

ByteImage image_of(const Frame& frame, const float* scale, const float* offset) {
  return {.pixels = frame.pixels,
          .height = frame.height,
          .width = frame.width,
          .channels = frame.channels,
          .row_stride = frame.height > 1 ? frame.row_stride : 0,
          .column_stride = frame.width > 1 ? frame.column_stride : 0,
          .channel_stride = frame.channels > 1 ? frame.channel_stride : 0,
          .scale = scale,
          .offset = offset};
}

std::optional<FrameOutput> output_of(const std::string& name) {
  if (name == "tokens") return FrameOutput::tokens;
  if (name == "image") return FrameOutput::planes;
  if (name == "uint8") return FrameOutput::bytes;
  return {};
}

FrameSampler::FrameSampler(const FramePlan& plan)
    : reads(plan.reads >= 1 && plan.reads <= kMostReads ? plan.reads * plan.reads : 0),
      shape(plan.shape.begin(), plan.shape.end() - (plan.reads > 1 && !plan.shape.empty())),
      height(plan.height),
      width(plan.width),
      scale(plan.scale),
      offset(plan.offset) {
  const size_t points = plan.columns.size();
  const auto output = output_of(plan.output);
  const bool tokens = output == FrameOutput::tokens;
  const bool sizes = height > 0 && width > 0 && height <= INT16_MAX && width <= INT16_MAX;
  const bool channels = scale.size() == 1 || scale.size() == 3;
  const bool axes =
      tokens ? shape.size() == 4 && reads == 1 : shape.size() == 2 || shape.size() == 3;
  if (!output || !sizes || !channels || scale.size() != offset.size() || reads < 1 || !axes ||
      (reads > 1 && plan.shape.back() != reads) || plan.rows.size() != points ||
      plan.right.size() != points || plan.lower.size() != points) {
    throw std::invalid_argument("the parts of the plan do not fit together");
  }
  kind = *output;
  for (size_t k = 0; k < points; ++k) {
    const float x = plan.right[k], y = plan.lower[k];
    if (!(x >= 0 && x <= 1 && y >= 0 && y <= 1)) {
      throw std::invalid_argument("the plan has distances outside of [0, 1]");
    }
  }
  const auto is_inside = [&](int64_t k) {
    const int64_t x = plan.columns[k], y = plan.rows[k];
    return x >= 0 && y >= 0 && x < width - 1 && y < height - 1;
  };
  const auto is_seen = [&](int64_t k) {
    const int64_t x = plan.columns[k], y = plan.rows[k];
    return x >= -1 && y >= -1 && x < width && y < height;
  };
  pixels = static_cast<int64_t>(points) / reads;
  picture = !tokens && shape.size() == 3 && shape[0] > 0 ? pixels / shape[0] : pixels;
  for (int64_t pixel = 0, first = 0; pixel < pixels; ++pixel) {
    if (pixel - first == picture) first = pixel;
    const int64_t begin = pixel * reads, end = begin + reads;
    bool all_inside = true, any_seen = false;
    for (int64_t k = begin; k < end; ++k) all_inside &= is_inside(k), any_seen |= is_seen(k);
    any_seen ? add(pixel, first, kShortGap / reads, seen) : add(pixel, first, 0, outside);
    for (int64_t k = begin; k < end && any_seen && !all_inside; ++k) {
      border.push_back({pixel, plan.columns[k], plan.rows[k], plan.right[k], plan.lower[k]});
    }
  }
  const size_t kept = length(seen) * reads + kFrameSpare;
  columns.resize(kept), rows.resize(kept), right.resize(kept), lower.resize(kept);
  for (const PixelRun& run : seen) {
    const int64_t first = run.begin * reads, count = (run.end - run.begin) * reads;
    const int64_t to = run.before * reads;
    for (int64_t k = 0; k < count; ++k) {
      const bool inside = is_inside(first + k);
      columns[to + k] = inside ? plan.columns[first + k] : 0;
      rows[to + k] = inside ? plan.rows[first + k] : 0;
    }
    std::copy_n(plan.right.begin() + first, count, right.begin() + to);
    std::copy_n(plan.lower.begin() + first, count, lower.begin() + to);
  }
}

int64_t FrameSampler::pixel_after(int64_t count) const {
  const auto is_behind = [](int64_t count, const PixelRun& run) { return count < run.before; };
  const auto run = std::upper_bound(seen.begin(), seen.end(), count, is_behind) - 1;
  return run->begin + count - run->before;
}

std::vector<int64_t> FrameSampler::output_shape(int64_t channels, bool has_axis) const {
  if (kind == FrameOutput::tokens) return {shape[0], shape[1], shape[2] * shape[3] * channels};
  std::vector<int64_t> sizes = shape;
  if (kind == FrameOutput::planes) sizes.insert(sizes.end() - 2, channels);
  if (kind == FrameOutput::bytes && has_axis) sizes.push_back(channels);
  return sizes;
}

void FrameSampler::normalization(float* scales, float* offsets) const {
  for (int c = 0; c < 3; ++c) {
    const size_t at = scale.size() > 1 ? c : 0;
    scales[c] = makes_bytes() ? 1 : scale[at];
    offsets[c] = makes_bytes() ? 0 : offset[at];
  }
}

void FrameSampler::sample(const Frame& frame, void* out) const {
  float scales[3], offsets[3];
  FrameArgs a{};
  normalization(scales, offsets);
  a.image = image_of(frame, scales, offsets);
  a.columns = columns.data(), a.rows = rows.data();
  a.right = right.data(), a.lower = lower.data();
  a.reads = reads;
  a.seen = runs_of(seen), a.outside = runs_of(outside);
  a.border = border.data(), a.border_points = static_cast<int64_t>(border.size());
  a.to = {kind, frame.channels, picture, out};
  const auto& kernel = kernels<FrameKernels>();
  const int64_t work = length(seen);
  // Threads share what is seen. The rest hardly takes time.
  parallel_ranges(std::max<int64_t>(work, 1), threads_for(frame_microseconds(work * reads)),
                  [&](int64_t begin, int64_t end) {
                    kernel.sample(a, begin > 0 ? pixel_after(begin) : 0,
                                  end < work ? pixel_after(end) : pixels);
                  });
}

void FrameSampler::normalize(const Frame& frame, float* out) const {
  float scales[3], offsets[3];
  normalization(scales, offsets);
  const ByteImage image = image_of(frame, scales, offsets);
  const int64_t numbers = width * image.channels;
  const auto rows_of = [&](int64_t begin, int64_t end) {
    for (int64_t y = begin; y < end; ++y) {
      for (int64_t c = 0; c < image.channels; ++c) {
        const uint8_t* from = image.pixels + y * image.row_stride + c * image.channel_stride;
        float* to = out + y * numbers + c;
        for (int64_t x = 0; x < width; ++x) {
          to[x * image.channels] = from[x * image.column_stride] * scales[c] + offsets[c];
        }
      }
    }
  };
  parallel_ranges(height, threads_for(frame_microseconds(height * numbers)), rows_of);
}

}  // namespace darswin
